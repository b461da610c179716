"""Figures, drawn from results alone. Colours keep apart for the colour-blind and in print."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle

from footwork.arena import DIRECTIONS, Arena
from footwork.evaluate import Episodes
from footwork.study.palette import DIRECTION_COLOURS, FLAT_COLOUR, GOAL_COLOUR

_WALL_COLOUR = "#4A4E57"


def _draw_arena(axes: Any, arena: Arena, goal_radius: float | None) -> None:
    for wall in arena.walls:
        corner = (wall.x - wall.half_x, wall.y - wall.half_y)
        axes.add_patch(Rectangle(corner, 2 * wall.half_x, 2 * wall.half_y, color=_WALL_COLOUR, lw=0))
    axes.plot(*arena.start, marker="o", ms=7, mfc="white", mec="black", zorder=5)
    for goal in arena.goals:
        axes.add_patch(Circle(goal, goal_radius or 0.5, fc=GOAL_COLOUR, ec="black", alpha=0.85, zorder=5))
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")


def draw_paths(axes: Any, arena: Arena, episodes: Episodes, goal_radius: float | None, most: int = 40) -> None:
    """Paths seen from above; a master's are coloured by the sub-policy in use."""
    for row in range(min(most, episodes.paths.shape[1])):
        points = episodes.paths[:, row]
        if not episodes.choices.size:
            axes.plot(points[:, 0], points[:, 1], color=FLAT_COLOUR, lw=0.8, alpha=0.6)
            continue
        segments = np.stack([points[:-1], points[1:]], axis=1)
        colours = [DIRECTION_COLOURS[choice] for choice in episodes.choices[:, row]]
        axes.add_collection(LineCollection(list(segments), colors=colours, linewidths=1.1, alpha=0.75))
    _draw_arena(axes, arena, goal_radius)


def paths_figure(
    path: Path, arena: Arena, panels: dict[str, Episodes], goal_radius: float | None, note: str = ""
) -> Path:
    """One panel per row of the table, side by side; written to ``path``."""
    figure, axes = plt.subplots(1, len(panels), figsize=(5.2 * len(panels), 5.6), squeeze=False)
    for ax, (title, episodes) in zip(axes[0], panels.items(), strict=True):
        draw_paths(ax, arena, episodes, goal_radius)
        ax.set_title(title, fontsize=11)
    handles = [
        Line2D([], [], color=c, lw=2, label=f"sub-policy {d}")
        for d, c in zip(DIRECTIONS, DIRECTION_COLOURS, strict=True)
    ]
    handles += [
        Line2D([], [], marker="o", ls="", mfc="white", mec="black", label="start"),
        Line2D([], [], marker="o", ls="", mfc=GOAL_COLOUR, mec="black", ms=9, label="goal"),
    ]
    figure.legend(handles=handles, loc="lower center", ncols=6, frameon=False, fontsize=9)
    if note:
        figure.suptitle(note, fontsize=11)
    figure.tight_layout(rect=(0, 0.06, 1, 1))
    return _write(figure, path)


def learning_curve(path: Path, metrics: list[dict[str, Any]], title: str) -> Path:
    """Success and progress of training episodes against control steps; written to ``path``."""
    steps = np.array([line["step"] for line in metrics])
    count = np.array([np.sum(line["episode/count"]) for line in metrics], float)
    reached = np.array([np.sum(line["count/reached"]) for line in metrics], float)
    window = max(1, len(metrics) // 25)
    kernel = np.ones(window)
    success = np.convolve(reached, kernel)[: len(steps)] / np.maximum(np.convolve(count, kernel)[: len(steps)], 1)
    success[np.convolve(count, kernel)[: len(steps)] == 0] = np.nan
    speed = np.array([np.mean(line["rollout/progress"]) for line in metrics])
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(6.4, 5.2), sharex=True)
    top.plot(steps, 100 * success, color=DIRECTION_COLOURS[0])
    top.set_ylabel("episodes that end\nin the goal (%)")
    top.set_ylim(-3, 103)
    bottom.plot(steps, speed, color=DIRECTION_COLOURS[2])
    bottom.set_ylabel("reward for distance,\nper option")
    bottom.set_xlabel("control steps")
    for ax in (top, bottom):
        ax.grid(alpha=0.3)
    top.set_title(f"{title} (running mean over {window} updates)", fontsize=10)
    figure.tight_layout()
    return _write(figure, path)


def _write(figure: Any, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    plt.close(figure)
    return path
