"""Tables of rows: sub-policies with the masters on them side by side, and every row with all that it has."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from footwork.study.claims import MIN_SEEDS, Setting
from footwork.study.experiments import ANNEALED, SCHEDULES, WALKERS, find_row, is_row
from footwork.study.metrics import METRICS, SWITCHED_EVERY
from footwork.study.pages import TableBlock
from footwork.study.results import Results, prefixes_at_hand

_WALKING = ("speed", "handover", "idle", "upside down")
_SETTINGS = tuple((place, schedule) for schedule in reversed(SCHEDULES) for place in ("bandit", "maze"))
_KINDS = tuple(row.name.removeprefix("walker/") for row in WALKERS)
_ANNEALED_KINDS = tuple(row.name.rpartition("/")[2] for row in ANNEALED)
# A line's name, its sub-policies' row, and its masters' or flat policies': PLACE is a task, the rest a setting's.
_LINES: tuple[tuple[str, str, str], ...] = (
    *((kind, f"walker/{kind}", f"PLACE/{{schedule}}/{kind}") for kind in _KINDS),
    *(
        (f"{kind}, annealed", f"ablation/annealed/{kind}", f"ablation/PLACE/{{schedule}}-annealed/{kind}")
        for kind in _ANNEALED_KINDS
    ),
    *((f"flat policy, {kind}", "", f"PLACE/flat/{{guided}}{kind}") for kind in ("free", "penalised")),
)


def side_by_side(results: Results) -> TableBlock:
    """What each kind of sub-policies does, and how often masters on them reach the goal; flat policies below."""
    lines = []
    for prefix in prefixes_at_hand(results):
        for name, walkers, policy in _LINES:
            cells = [_cell(results, prefix + walkers, metric) if walkers else "" for metric in _WALKING]
            rows = [Setting(prefix, schedule).fill(policy.replace("PLACE", place)) for place, schedule in _SETTINGS]
            lines.append((prefix + name, *cells, *(_cell(results, row, "success") for row in rows)))
    header = (
        "sub-policies",
        "m/s",
        "hand-overs",
        f"idle, k = {SWITCHED_EVERY}",
        f"upside down, k = {SWITCHED_EVERY}",
        "AntBandit, our reward",
        "AntMaze, our reward",
        "AntBandit, the paper's",
        "AntMaze, the paper's",
    )
    return TableBlock(header, tuple(line for line in lines if any(cell not in ("", "-") for cell in line[1:])))


SIDE_BY_SIDE = (
    "Interquartile means over seeds with 95 % intervals, shares in per cent; in brackets behind, the number of seeds "
    f"where it is not {MIN_SEEDS}. Speed of each sub-policy by itself; orthogonal hand-overs that succeed; switched at "
    f"random every {SWITCHED_EVERY} control steps, options that hardly move the ant, and ants upside down in the end; "
    "episodes in which a master on these sub-policies, or a flat policy, comes within 1 m of the goal. How long each "
    "was trained stands under Rows."
)


def _cell(results: Results, row: str, metric: str) -> str:
    """A number for a table that names units elsewhere; how many seeds it has, unless as many as claims ask for."""
    if not is_row(row):
        return ""
    effect, seeds = results.middle(row, metric), len(results.scores(row, metric))
    if effect is None:
        return "-"
    return METRICS[metric].with_interval(effect, alone=seeds == 1) + ("" if seeds == MIN_SEEDS else f" ({seeds})")


def sub_policies(results: Results, rows: Sequence[str]) -> TableBlock:
    """Every row of sub-policies among some, with all its numbers."""
    columns = {
        "m/s": "speed",
        "training return": "return",
        "hand-overs": "handover",
        f"idle, k = {SWITCHED_EVERY}": "idle",
        f"upside down, k = {SWITCHED_EVERY}": "upside down",
    }
    return _table(results, [row for row in rows if find_row(row).is_walker], columns)


def task_policies(results: Results, rows: Sequence[str]) -> TableBlock:
    """Every row of masters and flat policies among some, with all its numbers."""
    columns = {
        "way": "way",
        "around walls": "route",
        "within 1 m": "success",
        "0.5 m": "success close",
        "turned over": "turned over",
    }
    return _table(results, [row for row in rows if not find_row(row).is_walker], columns)


def _table(results: Results, rows: Sequence[str], columns: dict[str, str]) -> TableBlock:
    lines = []
    for row in rows:
        samples = results.samples(row)
        seconds = results.training_seconds(row)
        steps = sorted({sample.control_steps for sample in samples})
        taken = " to ".join(f"{n:,}" for n in dict.fromkeys((steps[0], steps[-1])))
        minutes = f"{np.mean(seconds) / 60:.1f}" if seconds else "-"
        cells = (_shown(results, row, metric) for metric in columns.values())
        lines.append((row, str(len(samples)), taken, minutes, *cells))
    return TableBlock(("row", "seeds", "control steps", "minutes", *columns), tuple(lines))


def _shown(results: Results, row: str, metric: str) -> str:
    effect, kind = results.middle(row, metric), METRICS[metric]
    if effect is None:
        return "-"
    return kind.with_interval(effect, alone=len(results.samples(row)) == 1) + (" %" if kind.is_share else "")


__all__ = ["SIDE_BY_SIDE", "side_by_side", "sub_policies", "task_policies"]
