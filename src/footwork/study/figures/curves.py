"""Training curves: the paper's Figures 5 to 10, and success against steps and against wall time."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from footwork.arena import DIRECTIONS, shortest_path
from footwork.palette import DIRECTION_COLOURS
from footwork.statistics import Floats, curve_band, generator_for
from footwork.study.experiments import SCHEDULES, find_row
from footwork.study.figures.style import (
    count_in_words,
    empty,
    label_of,
    legend_below,
    log_axis,
    look_of,
    panels,
    seeds_of,
)
from footwork.study.results import Results, Sample, seeds_in_words
from footwork.study.training_curves import Curve
from footwork.train import Experiment

_POINTS = 100
_SMOOTH = 20  # curves of tasks are averaged over the last twentieth of the training each time
_DECADES = 2.7  # of a logarithmic axis, at most
_MARKED = 14  # points of a curve from one mark to the next
Value = Callable[[Sample, Curve], Floats]  # of a seed's curve, [X]


def way_at_start(experiment: Experiment) -> float:
    """Distance to the goal at the start in the row's own potential, m."""
    task = experiment.task
    if task.potential == "straight":
        return float(np.hypot(*np.subtract(task.arena.goals[0], task.arena.start)))
    way = np.array(shortest_path(task.arena))
    return float(np.hypot(*np.diff(way, axis=0).T).sum())


def share_of_way(sample: Sample, curve: Curve) -> Floats:
    """The distance part of the reward, in the row's own potential, as a share of what the whole way pays."""
    metres = _smooth(curve, "progress") * sample.experiment.task.robot.control_dt
    return np.asarray(metres / way_at_start(sample.experiment))


def success(sample: Sample, curve: Curve) -> Floats:
    """Share of the training episodes that ended in the goal."""
    return _smooth(curve, "success")


def _smooth(curve: Curve, name: str) -> Floats:
    """Mean over the episodes of the last twentieth of the training, each time."""
    episodes = curve.episodes[:, 0]
    total = np.nan_to_num(curve.values[name][:, 0]) * episodes
    window = np.ones(max(1, len(episodes) // _SMOOTH))
    with np.errstate(invalid="ignore"):
        return np.asarray(np.convolve(total, window)[: len(total)] / np.convolve(episodes, window)[: len(total)])


def on_common_grid(xs: list[Floats], ys: list[Floats], log: bool = False) -> tuple[Floats, Floats] | None:
    """Curves of several seeds at the same points: x [X] and y [S, X]; None where nothing is finite."""
    kept = [np.isfinite(y) & (x > 0 if log else True) for x, y in zip(xs, ys, strict=True)]
    pairs = [(x[k], y[k]) for x, y, k in zip(xs, ys, kept, strict=True)]
    pairs = [(x, y) for x, y in pairs if x.size]
    if not pairs:
        return None
    low, high = max(x[0] for x, _ in pairs), min(x[-1] for x, _ in pairs)
    grid = np.geomspace(min(low, high), high, _POINTS) if log else np.linspace(min(low, high), high, _POINTS)
    return grid, np.stack([np.interp(grid, x, y) for x, y in pairs])


def draw_curve(
    ax: Any,
    xs: list[Floats],
    ys: list[Floats],
    name: str,
    colour: str,
    label: str,
    line: Any = "-",
    mark: str = "",
    log: bool = False,
) -> bool:
    """IQM over seeds with its pointwise 95 % band; whether there was anything to draw."""
    found = on_common_grid(xs, ys, log)
    if found is None:
        return False
    x, y = found
    middle, (low, high) = curve_band(y, generator_for(f"curve {name}"))
    first = zlib.crc32(label.encode()) % _MARKED  # not every row's marks at the same places
    style = {"marker": mark, "ms": 4.0, "markevery": (first, _MARKED)} if mark else {}
    ax.plot(x, middle, color=colour, ls=line, lw=1.4, label=label, **style)
    if len(y) > 1:
        ax.fill_between(x, low, high, color=colour, alpha=0.15, lw=0)
    return True


def draw_row(
    ax: Any, results: Results, row: str, value: Value, label: str, x: str = "step", log: bool = False, line: Any = "-"
) -> bool:
    """A row's curve against control steps or minutes."""
    curves = results.curves(row)
    if not curves:
        return False
    look = look_of(row)
    xs = [curve.step if x == "step" else curve.seconds / 60 for _, curve in curves]
    ys = [value(sample, curve) for sample, curve in curves]
    name = f"{row} {x} {value.__name__}"
    return draw_curve(ax, xs, ys, name, look.colour, label, line, look.mark, log)


def task_curves(results: Results, rows: tuple[str, ...]) -> Any:
    """Masters (and flat policies) of one task, with the paper's reward and schedule and with ours."""
    kinds = {"paper": [r for r in rows if not _guided(r)], "hrl": [r for r in rows if _guided(r)]}
    log = any(find_row(row).total_steps > 4 * find_row(rows[0]).total_steps for row in rows)
    same = len({_progress(mine) for mine in kinds.values() if mine}) < 2  # measure, and so the scale
    figure, axes = panels(1, 2, 3.6, share_y=same)
    for ax, (schedule, mine) in zip(axes[0], kinds.items(), strict=True):
        drawn = [draw_row(ax, results, row, share_of_way, label_of(row), log=log) for row in mine]
        ax.set_title(f"{SCHEDULES[schedule]};\n{_progress(mine)}")
        _steps(ax, log, seeds_of(results, mine))
        if any(drawn) and (same or ax.get_ylim()[1] > 0.5):
            ax.axhline(1.0, color="#999999", lw=0.8, ls=":")
        elif any(drawn):
            ax.text(
                0.98, 0.02, "the goal, 1, is far off this scale", ha="right", color="#777777", transform=ax.transAxes
            )
        if not any(drawn):
            empty(ax, "no finished runs yet" if mine else "no such rows")
    axes[0, 0].set_ylabel("distance part of the reward\n(share of the whole way; 1: at the goal)")
    legend_below(figure, axes[0])
    return figure


def _progress(rows: Sequence[str]) -> str:
    """What the distance part of some rows' reward measures."""
    straight = all(find_row(row).task.potential == "straight" for row in rows)
    return f"progress {'along the straight line' if straight else 'around the walls'}"


def _guided(row: str) -> bool:
    """Whether arriving pays: our reward."""
    return find_row(row).task.weights.goal > 0


def penalty_curves(results: Results, rows: tuple[str, ...]) -> Any:
    """Masters with and without stability penalties in their reward, on both tasks."""
    figure, axes = panels(2, 2, 2.8, share_y=True)
    for line, place in zip(axes, ("bandit", "maze"), strict=True):
        for ax, schedule in zip(line, SCHEDULES, strict=True):
            mine = [row for row in rows if row.startswith((f"{place}/{schedule}/", f"{place}/{schedule}-penalised/"))]
            drawn = [
                draw_row(ax, results, row, share_of_way, _with_or_without(row), line=":" if _penalised(row) else "-")
                for row in mine
            ]
            ax.set_title(f"Ant{place.capitalize()}: {SCHEDULES[schedule]};\n{_progress(mine)}")
            _steps(ax, False, seeds_of(results, mine))
            if not any(drawn):
                empty(ax, "no finished runs yet")
        line[0].set_ylabel("distance part of the reward\n(share of the whole way)")
    legend_below(figure, list(axes.flat), columns=2)
    return figure


def direction_curves(results: Results, rows: tuple[str, ...]) -> Any:
    """Training reward of sub-policies, one curve per direction, one panel per row."""
    columns = min(len(rows), 2)
    figure, axes = panels(-(-len(rows) // columns), columns, 2.7 if len(rows) > 1 else 3.4, share_y=True)
    for ax, row in zip(axes.flat, rows, strict=False):
        curves = results.curves(row)
        for i, direction in enumerate(DIRECTIONS):
            if curves and curves[0][1].values["return"].shape[1] == len(DIRECTIONS):
                xs = [curve.step for _, curve in curves]
                ys = [curve.values["return"][:, i] for _, curve in curves]
                line = ("-", (0, (5, 1)), (0, (1, 1)), (0, (3, 1, 1, 1)))[i]
                draw_curve(ax, xs, ys, f"{row} {direction}", DIRECTION_COLOURS[i], direction, line)
        ax.set_title(f"{row}\n({seeds_in_words(len(curves))})")
        _steps(ax, False)
        ax.set_xlabel("control steps per direction")
        if not curves:
            empty(ax, "no finished runs yet")
    for ax in axes[:, 0]:
        ax.set_ylabel("training reward per episode")
    legend_below(figure, list(axes.flat), columns=4)
    return figure


def _penalised(row: str) -> bool:
    return find_row(row).task.weights.electricity < 0


def _with_or_without(row: str) -> str:
    return f"{row.rpartition('/')[2]}, {'with penalties' if _penalised(row) else 'without'}"


def success_curves(results: Results, rows: tuple[str, ...]) -> Any:
    """Share of training episodes that end in the goal, against control steps and against wall time."""
    figure, axes = panels(2, 2, 2.7, share_y=True)
    for line, place in zip(axes, ("bandit", "maze"), strict=True):
        for ax, x in zip(line, ("step", "minutes"), strict=True):
            mine = [row for row in rows if f"/{place}/" in f"/{row}"]
            drawn = [draw_row(ax, results, row, success, label_of(row), x, log=True) for row in mine]
            ax.set_title(f"Ant{place.capitalize()}")
            _steps(ax, True, seeds_of(results, mine))
            if x == "minutes":
                log_axis(ax, lambda minutes: f"{minutes:g}", _DECADES)
                ax.set_xlabel("minutes of training (logarithmic)")
            ax.set_ylim(-0.03, 1.03)
            if not any(drawn):
                empty(ax, "no finished runs yet")
        line[0].set_ylabel("episodes that end in the goal")
    legend_below(figure, list(axes.flat))
    return figure


def _steps(ax: Any, log: bool, seeds: str = "") -> None:
    """The x axis of control steps, with how many seeds are drawn."""
    ax.set_xlabel("control steps" + (" (logarithmic)" if log else "") + (f"; {seeds}" if seeds else ""))
    if log:
        log_axis(ax, count_in_words, _DECADES)
        return
    ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.xaxis.set_major_formatter(lambda x, _: count_in_words(x) if x else "0")
    ax.set_xlim(left=0)
