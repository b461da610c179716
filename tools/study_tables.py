"""Put what was measured of the regularisers' lengths into docs/study.md, seed by seed, from the report's own results.

python tools/study_tables.py
"""

from collections.abc import Callable
from pathlib import Path

from footwork.study.experiments import Grid, grids_of
from footwork.study.measure import TRANSITIONS
from footwork.study.plan import Study
from footwork.study.results import Results, Sample

ROOT = Path(__file__).parents[1]
HEAD = "| | t | seeds |"
MANY = 4  # seeds and more are a range


def _switched(every: int, what: str) -> Callable[[Results, Sample], float]:
    def share(results: Results, sample: Sample) -> float:
        return float((results.entry(sample, TRANSITIONS) or {})["switching"][str(every)][what])

    return share


SWITCHED = tuple(_switched(every, what) for every in (50, 200) for what in ("idle", "upside_down"))


def lines_of(results: Results, grid: Grid) -> list[str]:
    """A line per length of a regulariser: speed, hand-overs, and what random switching does."""
    kind = grid.base.removeprefix("walker/").replace("-", " ")
    lines = []
    for value, row in grid.points().items():
        samples = [sample for sample in results.samples(row) if results.entry(sample, TRANSITIONS) is not None]
        if not samples:
            continue
        seeds = [sample.seed for sample in samples]
        which = f"{len(seeds)}, their range" if len(seeds) >= MANY else ", ".join(map(str, seeds))
        speeds, handovers = (results.scores_by_seed(row, metric) for metric in ("speed", "handover"))
        cells = [
            _listed([f"{speeds[seed]:.2f}" for seed in seeds]),
            _listed([f"{100 * handovers[seed]:.1f}" for seed in seeds]),
            *(_listed([f"{100 * share(results, sample):.1f}" for sample in samples]) for share in SWITCHED),
        ]
        lines.append(f"| {' | '.join([kind, str(value), which, *cells])} |\n")
    return lines


def _listed(values: list[str]) -> str:
    """Seed by seed; of many, from the lowest to the highest."""
    if len(values) < MANY:
        return ", ".join(values)
    ordered = sorted(values, key=float)
    return f"{ordered[0]} to {ordered[-1]}"


def with_lengths(page: str, results: Results) -> str:
    """The page with the table of lengths as the results have it."""
    lines = page.splitlines(keepends=True)
    start = next(i for i, line in enumerate(lines) if line.startswith(HEAD)) + 2
    end = next(i for i in range(start, len(lines)) if not lines[i].startswith("|"))
    lines[start:end] = [line for grid in grids_of("t") for line in lines_of(results, grid)]
    return "".join(lines)


if __name__ == "__main__":
    path = ROOT / "docs" / "study.md"
    found = Results(Study(ROOT / "report" / "results"))
    path.write_text(with_lengths(path.read_text(encoding="utf-8"), found), encoding="utf-8")
