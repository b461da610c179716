"""The benchmark's picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

from footwork.palette import DIRECTION_COLOURS, FLAT_COLOUR
from footwork.study.figures.paths import write


def bench_figure(path: Path, report: dict[str, Any]) -> Path:
    """Every contestant's control steps per second, and how they change along each axis; written to ``path``."""
    measured = {name: r["steps_per_second"] for name, r in report["contestants"].items() if "steps_per_second" in r}
    figure = plt.figure(figsize=(12.5, max(4.5, 0.36 * len(measured) + 1.2)))
    grid = figure.add_gridspec(2, 4, width_ratios=(2.4, 0.75, 1, 1))
    bars = figure.add_subplot(grid[:, 0])
    for height, (name, rate) in enumerate(reversed(measured.items())):
        reach = [[rate["median"] - rate["low"]], [rate["high"] - rate["median"]]]
        colour = FLAT_COLOUR if name.startswith(("sb3", "sbx")) else DIRECTION_COLOURS["physics" in name]
        bars.barh(height, rate["median"], xerr=reach, color=colour, error_kw={"lw": 1})
    bars.set_yticks(range(len(measured)), [*reversed(measured)], fontsize=8)
    bars.set_xscale("log")
    bars.set_xlabel("control steps per second (median, least, largest)")
    bars.grid(axis="x", alpha=0.3)
    for number, (axis, points) in enumerate(report["growth"].items()):
        panel = figure.add_subplot(grid[number // 2, 2 + number % 2])
        _draw_growth(panel, axis, [point for point in points if "skipped" not in point])
    figure.tight_layout()
    return write(figure, path)


def _draw_growth(axes: Any, name: str, points: list[dict[str, Any]]) -> None:
    sizes = [point["size"] for point in points]
    rates = [point["over_reference"]["median"] for point in points]
    axes.plot(sizes, rates, marker="o", ms=4, color=DIRECTION_COLOURS[0])
    axes.set_xscale("symlog", linthresh=1.0)
    axes.set_xticks(sizes, [str(size) for size in sizes], fontsize=8)
    axes.minorticks_off()
    axes.set_ylim(bottom=0.0)
    axes.set_title(f"steps/s over physics alone\n(one thread), by {name}", fontsize=9)
    axes.grid(alpha=0.3)
