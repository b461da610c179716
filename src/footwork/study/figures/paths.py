"""Paths and learning curves, drawn from results alone. Colours keep apart for the colour-blind and in print."""

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
from footwork.palette import DIRECTION_COLOURS, FLAT_COLOUR, GOAL_COLOUR
from footwork.study.experiments import find_row
from footwork.study.measure import EVALUATION, STUCK_WITHIN, straight_line_stop
from footwork.study.results import Results, seeds_in_words

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


def _crop(axes: Any, arena: Arena, margin: float = 0.5) -> None:
    """Show a maze without most of its border."""
    if arena.grid:
        inside_x = (len(arena.grid[0]) / 2 - 1) * arena.cell + margin
        inside_y = (len(arena.grid) / 2 - 1) * arena.cell + margin
        axes.set_xlim(-inside_x, inside_x)
        axes.set_ylim(-inside_y, inside_y)
    axes.grid(False)
    axes.tick_params(labelsize=7)


def _draw_path(axes: Any, points: Any, choices: Any) -> None:
    """A master's path [N, 2], its pieces coloured by the sub-policy in use [N - 1]; without, grey."""
    if not len(choices):
        axes.plot(points[:, 0], points[:, 1], color=FLAT_COLOUR, lw=0.8, alpha=0.7)
        return
    segments = np.stack([points[:-1], points[1:]], axis=1)
    colours = [DIRECTION_COLOURS[choice] for choice in choices]
    axes.add_collection(LineCollection(list(segments), colors=colours, linewidths=1.1, alpha=0.75))


def draw_paths(axes: Any, arena: Arena, episodes: Episodes, goal_radius: float | None, most: int = 40) -> None:
    """Paths seen from above; a master's are coloured by the sub-policy in use."""
    for row in range(min(most, episodes.paths.shape[1])):
        _draw_path(axes, episodes.paths[:, row], episodes.choices[:, row] if episodes.choices.size else ())
    _draw_arena(axes, arena, goal_radius)


def _directions() -> list[Line2D]:
    """Of the legend: the sub-policy in use."""
    named = zip(DIRECTIONS, DIRECTION_COLOURS, strict=True)
    return [Line2D([], [], color=colour, lw=2, label=f"sub-policy {name}") for name, colour in named]


def _places() -> list[Line2D]:
    """Of the legend: start and goal."""
    start = Line2D([], [], marker="o", ls="", mfc="white", mec="black", label="start")
    return [start, Line2D([], [], marker="o", ls="", mfc=GOAL_COLOUR, mec="black", ms=9, label="goal")]


def paths_figure(
    path: Path, arena: Arena, panels: dict[str, Episodes], goal_radius: float | None, note: str = ""
) -> Path:
    """One panel per row of the table, side by side; written to ``path``."""
    figure, axes = plt.subplots(1, len(panels), figsize=(5.2 * len(panels), 5.6), squeeze=False)
    for ax, (title, episodes) in zip(axes[0], panels.items(), strict=True):
        draw_paths(ax, arena, episodes, goal_radius)
        ax.set_title(title, fontsize=11)
    handles = [*_directions(), *_places()]
    figure.legend(handles=handles, loc="lower center", ncols=6, frameon=False, fontsize=9)
    if note:
        figure.suptitle(note, fontsize=11)
    figure.tight_layout(rect=(0, 0.06, 1, 1))
    return write(figure, path)


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
    return write(figure, path)


def write(figure: Any, path: Path) -> Path:
    """Save a figure and let go of it; its directory is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    plt.close(figure)
    return path


def maze_paths(results: Results, rows: tuple[str, ...]) -> Any:
    """Paths through the maze from above, those of a master coloured by sub-policy; of each row's first seed."""
    columns = 3
    lines = -(-len(rows) // columns)
    figure, axes = plt.subplots(lines, columns, figsize=(7.2, 2.6 * lines), squeeze=False)
    for ax, row in zip(axes.flat, rows, strict=False):
        entry = next(iter(results.measurements(row, EVALUATION)), None)
        for path in [] if entry is None else entry["paths"]:
            points = np.array(path["xy"])
            _draw_path(ax, points, path["choices"][: len(points) - 1])
        _draw_arena(ax, find_row(row).task.arena, None)
        _crop(ax, find_row(row).task.arena)
        words = (
            "no finished runs yet"
            if entry is None
            else f"seed {entry['seed']}: {100 * entry['success']['1.0']:.0f} % within 1 m"
        )
        ax.set_title(f"{row}\n{words}", fontsize=8)
    for ax in axes.flat[len(rows) :]:
        ax.axis("off")
    figure.legend(handles=[*_directions(), *_places()], loc="outside lower center", ncols=3)
    return figure


def flat_ends(results: Results, rows: tuple[str, ...]) -> Any:
    """Where the episodes of flat policies end, all seeds, and the place where the straight line meets the wall."""
    figure, axes = plt.subplots(-(-len(rows) // 2), 2, figsize=(6.4, 5.8), squeeze=False)
    for ax, row in zip(axes.flat, rows, strict=True):
        arena, entries = find_row(row).task.arena, results.measurements(row, EVALUATION)
        _draw_arena(ax, arena, None)
        _crop(ax, arena)
        for entry in entries:
            ax.plot(*np.array(entry["ends"]).T, ".", ms=2.5, color="#0072B2", alpha=0.5, zorder=7, mew=0)
        stop = straight_line_stop(arena)
        if stop is not None:
            ax.add_patch(Circle(stop, STUCK_WITHIN, fc="none", ec="#E69F00", lw=1.5, zorder=6))
        share = np.mean([entry["stuck"] for entry in entries]) if entries else None
        seeds = seeds_in_words(len(entries))
        words = "no finished runs yet" if share is None else f"{100 * share:.0f} % in the circle, {seeds}"
        ax.set_title(f"{row.removeprefix('maze/')}\n{words}", fontsize=8)
    end = Line2D([], [], marker=".", ls="", color="#0072B2", label="end of an episode")
    circle = Line2D([], [], marker="o", ls="", mfc="none", mec="#E69F00", ms=12, label="at the wall")
    figure.legend(handles=[*_places(), circle, end], loc="outside lower center", ncols=4)
    return figure
