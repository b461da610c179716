"""Tables of rows: sub-policies with the masters on them side by side, and every row with all that it has."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from footwork.evaluate import IDLE_SPEED
from footwork.study.claims import MIN_SEEDS, Setting
from footwork.study.experiments import ANNEALED, INTERLEAVED_WITHOUT, KINDS, find_row, grids_of, is_row
from footwork.study.figures import count_in_words
from footwork.study.metrics import METRICS, SWITCHED_EVERY
from footwork.study.pages import TableBlock
from footwork.study.results import Results, prefixes_at_hand

_SWITCHED = {f"idle, k = {SWITCHED_EVERY}": "idle", f"upside down, k = {SWITCHED_EVERY}": "upside down"}
_OF_SUB_POLICIES = {
    "m/s": "speed",
    "training return": "return",
    "hand-overs": "handover",
    "m/s after": "handover speed",
    **_SWITCHED,
}
_OF_POLICIES = {
    "way": "way",
    "around walls": "route",
    "within 1 m": "success",
    "0.5 m": "success close",
    "turned over": "turned over",
}

_SETTINGS = {
    "AntBandit, our reward": ("bandit", "hrl"),
    "AntMaze, our reward": ("maze", "hrl"),
    "AntBandit, the paper's": ("bandit", "paper"),
    "AntMaze, the paper's": ("maze", "paper"),
}
_ANNEALED_KINDS = tuple(row.name.rpartition("/")[2] for row in ANNEALED)
# A line's name, the row of its sub-policies, and those of its masters or flat policies: of any task and setting.
_LINES: tuple[tuple[str, str, str], ...] = (
    *((kind, f"walker/{kind}", f"{{place}}/{{schedule}}/{kind}") for kind in KINDS),
    *(
        (f"{kind}, annealed", f"ablation/annealed/{kind}", f"ablation/{{place}}/{{schedule}}-annealed/{kind}")
        for kind in _ANNEALED_KINDS
    ),
    *(
        (
            f"interleaved without {row.name.rpartition('/')[2].replace('-', ' ')}",
            row.name,
            row.name.replace("ablation/", "ablation/{place}/{schedule}-"),
        )
        for row in INTERLEAVED_WITHOUT
    ),
    *(
        (
            f"{grid.base.removeprefix('walker/')}, {grid.words.partition(' (')[0]} = {value}",
            f"{grid.name}/{value}",
            f"{grid.name.replace('ablation/', 'ablation/{place}/{schedule}-')}/{value}",
        )
        for grid in grids_of("t")
        for value in grid.values
    ),
    *((f"flat policy, {kind}", "", f"{{place}}/flat/{{guided}}{kind}") for kind in ("free", "penalised")),
)


def side_by_side(results: Results) -> TableBlock:
    """What each kind of sub-policies does, and how often masters on them reach the goal; flat policies below."""
    of_sub_policies = {"m/s": "speed", "hand-overs": "handover", **_SWITCHED}
    lines = []
    for prefix in prefixes_at_hand(results):
        for name, walkers, policy in _LINES:
            cells = [_cell(results, prefix + walkers, metric) if walkers else "" for metric in of_sub_policies.values()]
            for place, schedule in _SETTINGS.values():
                row = Setting(prefix, schedule).fill(policy.replace("{place}", place))
                cells.append(_cell(results, row, "success"))
            lines.append((prefix + name, *cells))
    shown = tuple(line for line in lines if any(cell not in ("", "-") for cell in line[1:]))
    return TableBlock(("sub-policies", *of_sub_policies, *_SETTINGS), shown)


def side_by_side_caption(results: Results) -> str:
    """What the columns of :func:`side_by_side` are."""
    named = ("walker/plain", "walker/symmetric", "bandit/hrl/plain", "maze/hrl/plain", "maze/flat/free")
    rows = map(results.study.row, named)
    own = ", ".join(
        f"{grid.base.removeprefix('walker/')} {value}"
        for grid in grids_of("t")
        for value, row in grid.points().items()
        if row == grid.base
    )
    four, one, bandit, maze, flat = (count_in_words(row.total_steps * row.runs_per_seed) for row in rows)
    return (
        "Shares in per cent, interquartile means over seeds with 95 % intervals (one without width says only that the "
        f"seeds agree); (3): of 3 seeds instead of {MIN_SEEDS}, whose interval is only their range. m/s: speed "
        "along the direction, without hand-overs. Hand-overs: orthogonal ones that succeed, as said above. k = "
        f"{SWITCHED_EVERY}: switched at random every {SWITCHED_EVERY} control steps, options that gain less than "
        f"{IDLE_SPEED} m/s along their direction (idle), ants upside down in the end. The tasks: episodes in which a "
        "master on these sub-policies, or a flat policy, comes within 1 m of the goal (both settings); free: without "
        "stability penalties. t, mean stay: another length of the regulariser (in control steps) than its kind has "
        f"above ({own}). Control steps of training: four sub-policies {four} (those of appropriate bias stand on as "
        f"many of plain ones), a symmetric one {one}, masters {bandit} on AntBandit and {maze} on AntMaze besides, "
        f"flat policies {flat}."
    )


def sub_policies(results: Results, rows: Sequence[str]) -> TableBlock:
    """Every row of sub-policies among some, with all its numbers."""
    return _table(results, [row for row in rows if find_row(row).is_walker], _OF_SUB_POLICIES)


def task_policies(results: Results, rows: Sequence[str]) -> TableBlock:
    """Every row of masters and flat policies among some, with all its numbers."""
    return _table(results, [row for row in rows if not find_row(row).is_walker], _OF_POLICIES, worst="success")


def _table(results: Results, rows: Sequence[str], columns: dict[str, str], worst: str | None = None) -> TableBlock:
    lines = []
    for row in rows:
        samples, seconds = results.samples(row), results.training_seconds(row)
        steps = sorted({sample.control_steps for sample in samples})
        taken = " to ".join(f"{n:,}" for n in dict.fromkeys((steps[0], steps[-1])))
        minutes = f"{np.mean(seconds) / 60:.1f}" if seconds else "-"
        cells = [_cell(results, row, metric, len(samples), with_unit=True) for metric in columns.values()]
        if worst is not None:
            scores = results.scores(row, worst)
            cells.append(METRICS[worst].show(scores.min()) if len(scores) else "-")
        lines.append((row, str(len(samples)), taken, minutes, *cells))
    more = () if worst is None else (f"worst seed, {next(name for name in columns if columns[name] == worst)}",)
    return TableBlock(("row", "seeds", "control steps", "minutes", *columns, *more), tuple(lines))


def _cell(results: Results, row: str, metric: str, usual: int = MIN_SEEDS, with_unit: bool = False) -> str:
    """A row's number, and how many seeds have it where that is not the usual number; empty if there is no such row."""
    if not is_row(row):
        return ""
    effect, seeds, kind = results.middle(row, metric), len(results.scores(row, metric)), METRICS[metric]
    if effect is None:
        return "-"
    unit = " %" if with_unit and kind.is_share else ""
    return kind.with_interval(effect, alone=seeds == 1) + unit + ("" if seeds == usual else f" ({seeds})")


__all__ = ["side_by_side", "side_by_side_caption", "sub_policies", "task_policies"]
