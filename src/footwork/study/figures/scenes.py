"""The paper's Figures 1 to 4: the three tasks as MuJoCo renders them, or drawn without OpenGL; and the hierarchy."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle, FancyArrowPatch, FancyBboxPatch, Polygon

from footwork.arena import DIRECTIONS, Arena, bandit, extent_of
from footwork.palette import DIRECTION_COLOURS, GOAL_COLOUR, rgb
from footwork.render import GLPainter, Shot, View, choose_platform, project, standing
from footwork.study.experiments import ANT_BANDIT, ANT_MAZE, ANT_WALKER
from footwork.study.results import Results
from footwork.tasks.task import Task

_LEGS = ((1, 1), (-1, 1), (-1, -1), (1, -1))  # as in assets/ant.xml
_KNEE = math.radians(62.0)  # how far the shins bend down
_SHIN = 0.4 * math.sqrt(2)  # m
_LIMB, _TORSO = "#D98E4A", "#C4752F"
_FLOOR, _GRID = "#F3F1EB", "#DEDAD0"


class _View:
    """A parallel projection: looked down upon at an angle."""

    def __init__(self, azimuth: float, elevation: float) -> None:
        a, e = math.radians(azimuth), math.radians(elevation)
        self.right = np.array([-math.sin(a), math.cos(a), 0.0])
        self.towards = np.array([math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)])
        self.up = np.cross(self.towards, self.right)

    def flat(self, points: Any) -> Any:
        """Points [..., 3] on the page [..., 2]."""
        xyz = np.asarray(points, np.float64)
        return np.stack([xyz @ self.right, xyz @ self.up], axis=-1)

    def nearness(self, points: Any) -> float:
        return float((np.asarray(points, np.float64) @ self.towards).mean())


def _axes(size: tuple[float, float]) -> tuple[Any, Any]:
    figure, ax = plt.subplots(figsize=size)
    ax.set_aspect("equal")
    ax.axis("off")
    return figure, ax


def _floor(ax: Any, view: _View, half_x: float, half_y: float, step: float) -> None:
    corners = [(-half_x, -half_y, 0), (half_x, -half_y, 0), (half_x, half_y, 0), (-half_x, half_y, 0)]
    ax.add_patch(Polygon(view.flat(corners), fc=_FLOOR, ec=_GRID, zorder=0))
    for x in np.arange(-half_x, half_x + 1e-9, step):
        ax.plot(*view.flat([(x, -half_y, 0), (x, half_y, 0)]).T, color=_GRID, lw=0.6, zorder=1)
    for y in np.arange(-half_y, half_y + 1e-9, step):
        ax.plot(*view.flat([(-half_x, y, 0), (half_x, y, 0)]).T, color=_GRID, lw=0.6, zorder=1)


def draw_ant(ax: Any, view: _View, x: float, y: float, scale: float = 1.0, zorder: float = 10) -> None:
    """The ant standing at (x, y), limbs and torso in the right sizes times ``scale``; far parts first."""
    height = _SHIN * math.sin(_KNEE) + 0.08
    torso = np.array([0.0, 0.0, height])
    across = 72 * _points_per_metre(ax)
    parts = []
    for side_x, side_y in _LEGS:
        knee = torso + np.array([0.4 * side_x, 0.4 * side_y, 0.0])
        reach = 0.4 * math.cos(_KNEE)
        foot = knee + np.array([reach * side_x, reach * side_y, -_SHIN * math.sin(_KNEE)])
        parts += [(torso, knee), (knee, foot)]
    place = np.array([x, y, 0.0])
    ax.add_patch(Circle(view.flat(place), 0.55 * scale, fc="black", alpha=0.10, zorder=zorder))
    for number, (one, other) in enumerate(sorted(parts, key=view.nearness)):
        ends = view.flat(np.stack([one, other]) * scale + place)
        for width, colour in ((0.19, "#5A3A1C"), (0.16, _LIMB)):
            line: dict[str, Any] = {"lw": width * scale * across, "solid_capstyle": "round", "color": colour}
            ax.plot(*ends.T, zorder=zorder + 0.02 * number + (0.01 if colour == _LIMB else 0), **line)
    centre = view.flat(torso * scale + place)
    ax.add_patch(Circle(centre, 0.25 * scale, fc=_TORSO, ec="#5A3A1C", lw=0.8, zorder=zorder + 0.5))
    ax.add_patch(
        Circle(centre + np.array([-0.07, 0.09]) * scale, 0.08 * scale, fc="white", alpha=0.35, zorder=zorder + 0.51)
    )


def _points_per_metre(ax: Any) -> float:
    """Inches on the page per metre; the axes' limits must be set."""
    box = ax.get_position()
    (low, high), width = ax.get_xlim(), box.width * ax.figure.get_size_inches()[0]
    (bottom, top), height = ax.get_ylim(), box.height * ax.figure.get_size_inches()[1]
    return float(min(width / (high - low), height / (top - bottom)))


def _walls(ax: Any, view: _View, arena: Arena, height: float) -> None:
    """Boxes, far ones first, each face in its own shade."""
    boxes = sorted(arena.walls, key=lambda w: view.nearness([(w.x, w.y, 0)]))
    for number, w in enumerate(boxes):
        x0, x1, y0, y1 = w.x - w.half_x, w.x + w.half_x, w.y - w.half_y, w.y + w.half_y
        faces = [
            ([(x1, y0, 0), (x1, y1, 0), (x1, y1, height), (x1, y0, height)], "#7C8088"),
            ([(x0, y0, 0), (x1, y0, 0), (x1, y0, height), (x0, y0, height)], "#9A9EA6"),
            ([(x0, y0, height), (x1, y0, height), (x1, y1, height), (x0, y1, height)], "#B9BCC3"),
        ]
        for face, colour in faces:
            ax.add_patch(Polygon(view.flat(face), fc=colour, ec="#5C6068", lw=0.5, zorder=2 + 0.01 * number))


def _orb(ax: Any, view: _View, x: float, y: float, z: float, radius: float, faint: bool = False) -> Any:
    centre = view.flat((x, y, z))
    ax.add_patch(Circle(centre, radius, fc=GOAL_COLOUR, ec="#7A3200", lw=0.8, alpha=0.45 if faint else 1.0, zorder=9))
    ax.add_patch(Circle(centre + radius * np.array([-0.3, 0.35]), 0.3 * radius, fc="white", alpha=0.5, zorder=9.1))
    return centre


def _frame(ax: Any, view: _View, points: Iterable[Any], margin: float) -> None:
    flat = view.flat(list(points))
    ax.set_xlim(flat[:, 0].min() - margin, flat[:, 0].max() + margin)
    ax.set_ylim(flat[:, 1].min() - margin, flat[:, 1].max() + margin)


class _Photograph:
    """A task's scene by MuJoCo's renderer, to be written on; coordinates are px of the picture."""

    def __init__(self, task: Task, extent: tuple[float, float, float, float], size: tuple[int, int], platform: str):
        goal = None if task.goal_radius is None else np.array(task.arena.goals[0])
        self._view = View(*size, "arena", extent, still=True)
        painter = GLPainter(task, self._view, platform)
        shot = Shot(standing(task.arena.start), rgb(_LIMB), goal, (), np.array(task.arena.start))
        picture = painter.paint(shot)
        painter.close()
        self.figure, self.ax = _axes((6.4, 6.4 * size[1] / size[0]))
        self.ax.set_position((0, 0, 1, 1))
        self.ax.imshow(picture, interpolation="lanczos")
        self.ax.set_xlim(0, size[0])
        self.ax.set_ylim(size[1], 0)

    def at(self, *point: float) -> tuple[float, float]:
        """Where a point (x, y, z) in m is."""
        column, row = project(self._view, np.array([point]))[0]
        return float(column), float(row)

    def word(self, text: str, *point: float, **style: Any) -> None:
        """Text at a point."""
        style = {"ha": "center", "va": "center", "fontsize": 9, "weight": "bold", **style}
        ground = {"boxstyle": "round", "fc": "white", "ec": "none", "alpha": 0.8}
        self.ax.text(*self.at(*point), text, bbox=ground, **style)

    def arrow(self, start: tuple[float, ...], end: tuple[float, ...], **style: Any) -> None:
        """An arrow from a point to another."""
        style = {"arrowstyle": "-|>", "mutation_scale": 15, "lw": 2.4, "shrinkA": 0, "shrinkB": 0, **style}
        self.ax.add_patch(FancyArrowPatch(self.at(*start), self.at(*end), **style))


def walker_scene(results: Results, rows: tuple[str, ...]) -> Any:
    """AntWalker: one of four directions, its target 10 km away."""
    platform, _ = choose_platform()
    return _drawn_walker() if platform is None else _photographed_walker(platform)


def _photographed_walker(platform: str) -> Any:
    photograph = _Photograph(ANT_WALKER, (0.6, 0.1, 2.9, 1.9), (1280, 860), platform)
    for i, name in enumerate(DIRECTIONS):
        unit = np.array([math.cos(i * math.pi / 2), math.sin(i * math.pi / 2)])
        photograph.arrow((*1.0 * unit, 0.02), (*1.75 * unit, 0.02), color=DIRECTION_COLOURS[i])
        photograph.word(name, *2.05 * unit, 0.02, color=DIRECTION_COLOURS[i])
    photograph.word("target of “right”: (10 km, 0) →", 2.6, 0.45, 0.02, color=GOAL_COLOUR, fontsize=8)
    return photograph.figure


def _drawn_walker() -> Any:
    figure, ax = _axes((5.6, 4.0))
    view = _View(-62.0, 38.0)
    _frame(ax, view, [(-2.6, -2.2, 0), (4.0, -2.2, 0), (4.0, 2.2, 0), (-2.6, 2.2, 0), (0, 0, 1.2)], 0.15)
    _floor(ax, view, 6.0, 6.0, 1.0)
    for i, name in enumerate(DIRECTIONS):
        unit = np.array([math.cos(i * math.pi / 2), math.sin(i * math.pi / 2), 0.0])
        start, end = view.flat(1.0 * unit), view.flat(1.9 * unit)
        arrow: dict[str, Any] = {"arrowstyle": "-|>", "mutation_scale": 13, "lw": 2.2, "color": DIRECTION_COLOURS[i]}
        ax.add_patch(FancyArrowPatch(start, end, zorder=4, **arrow))
        ax.text(*view.flat(2.25 * unit), name, color=DIRECTION_COLOURS[i], ha="center", va="center", weight="bold")
    draw_ant(ax, view, 0.0, 0.0)
    target = _orb(ax, view, 3.2, 0.0, 0.5, 0.17)
    ax.text(target[0], target[1] + 0.32, "target of “right”:\n(10 km, 0)", ha="center", va="bottom", fontsize=8)
    return figure


def bandit_scene(results: Results, rows: tuple[str, ...]) -> Any:
    """AntBandit: one of four corners is the goal of the episode."""
    platform, _ = choose_platform()
    return _drawn_bandit() if platform is None else _photographed_bandit(platform)


def _photographed_bandit(platform: str) -> Any:
    photograph = _Photograph(ANT_BANDIT, (0.0, 0.0, 9.5, 8.8), (1280, 960), platform)
    corners = [*ANT_BANDIT.arena.goals, ANT_BANDIT.arena.goals[0]]
    photograph.ax.plot(
        *np.array([photograph.at(*corner, 0.0) for corner in corners]).T, color="#8A8478", ls="--", lw=1.0
    )
    for number, (x, y) in enumerate(ANT_BANDIT.arena.goals):
        words, height = ("this episode's goal", 3.2) if number == 0 else ("not this time", 0.0)
        photograph.word(words, x, y, height, color=GOAL_COLOUR if number == 0 else "#6A6458", fontsize=8)
    photograph.word(f"{2 * corners[0][0]:.0f} m", 0.0, -corners[0][1], 0.0, color="#6A6458", fontsize=8)
    return photograph.figure


def _drawn_bandit() -> Any:
    figure, ax = _axes((5.6, 4.2))
    view, arena = _View(-70.0, 42.0), bandit()
    corners = [(x, y, 0) for x, y in arena.goals]
    _frame(ax, view, [(-10, -10, 0), (10, -10, 0), (10, 10, 0), (-10, 10, 0)], 0.6)
    _floor(ax, view, 10.0, 10.0, 2.0)
    ax.add_patch(Polygon(view.flat(corners), fc="none", ec="#8A8478", ls="--", lw=1.0, zorder=3))
    draw_ant(ax, view, *arena.start, scale=1.6)
    for number, (x, y) in enumerate(arena.goals):
        centre = _orb(ax, view, x, y, 0.6, 0.5, faint=number > 0)
        words = "this episode's goal" if number == 0 else "not this time"
        ax.text(centre[0], centre[1] + 0.75, words, ha="center", va="bottom", fontsize=8)
    ax.annotate("", view.flat(corners[1]), view.flat(corners[2]), arrowprops={"arrowstyle": "<->", "color": "#8A8478"})
    middle = view.flat(np.mean([corners[1], corners[2]], axis=0))
    side = 2 * arena.goals[0][0]
    ax.text(middle[0] - 0.4, middle[1], f"{side:.0f} m", ha="right", va="center", fontsize=8, color="#6A6458")
    return figure


def maze_scene(results: Results, rows: tuple[str, ...]) -> Any:
    """AntMaze: the goal lies behind a wall."""
    platform, _ = choose_platform()
    return _drawn_maze() if platform is None else _photographed_maze(platform)


def _photographed_maze(platform: str) -> Any:
    arena = ANT_MAZE.arena
    photograph = _Photograph(ANT_MAZE, extent_of(arena), (1280, 1000), platform)
    (start_x, start_y), (goal_x, goal_y) = arena.start, arena.goals[0]
    photograph.word("goal", goal_x + 1.4, goal_y, 0.0, color=GOAL_COLOUR)
    photograph.word("start", start_x, start_y - 1.3, 0.0, color="#444444")
    line = np.array([photograph.at(start_x, start_y + 0.9, 0.6), photograph.at(goal_x, goal_y - 0.9, 0.6)])
    photograph.ax.plot(*line.T, color=GOAL_COLOUR, lw=1.4, ls=":")
    photograph.arrow((goal_x, goal_y - 0.9, 0.6), (goal_x, goal_y - 0.6, 0.6), color=GOAL_COLOUR, lw=1.4)
    photograph.word("tiles of 2 m", 0.0, -1.4 * arena.cell, 0.0, color="#6A6458", fontsize=8)
    return photograph.figure


def _drawn_maze() -> Any:
    figure, ax = _axes((5.6, 4.6))
    view, arena = _View(-74.0, 52.0), ANT_MAZE.arena
    height = 0.6 * arena.wall_height  # lower than they are, so that one sees over them
    half = 2.5 * arena.cell
    _frame(ax, view, [(-half, -half, 0), (half, -half, 0), (half, half, height), (-half, half, height)], 0.4)
    _floor(ax, view, half, half, arena.cell)
    _walls(ax, view, arena, height)
    draw_ant(ax, view, *arena.start, scale=1.5, zorder=20)
    goal = arena.goals[0]
    _orb(ax, view, *goal, 0.6, 0.5)
    start, end = view.flat((*arena.start, 0.3)), view.flat((*goal, 0.3))
    ax.plot(*np.stack([start, end]).T, color=GOAL_COLOUR, ls=":", lw=1.6, zorder=8)
    ax.text(*(view.flat((goal[0] + 0.9, goal[1], 0.5))), "goal", fontsize=9, weight="bold", va="center", zorder=30)
    ax.text(*(view.flat((arena.start[0] + 1.5, arena.start[1], 0.4))), "start", fontsize=9, va="center", zorder=30)
    return figure


def hierarchy(results: Results, rows: tuple[str, ...]) -> Any:
    """Who decides what, and how often."""
    figure, ax = _axes((7.2, 4.2))
    ax.set_xlim(0, 20)
    ax.set_ylim(0.4, 9.6)
    _box(ax, 5.2, 7.6, 9.2, 1.6, "master", "chooses a sub-policy every k control steps", "#EEEAF5", "#4B3B7A")
    for i, name in enumerate(DIRECTIONS):
        x = 2.2 + 3.95 * i
        _box(ax, x, 4.4, 3.5, 1.4, f"sub-policy {name}", "frozen", "#FFFFFF", DIRECTION_COLOURS[i])
        _arrow(ax, (7.4 + 1.6 * i, 7.5), (x + 1.75, 5.9), DIRECTION_COLOURS[i])
        _arrow(ax, (x + 1.75, 4.3), (7.4 + 1.6 * i, 2.7), DIRECTION_COLOURS[i])
        _route(ax, [(x + 3.0, 3.85), (x + 3.0, 4.33)])
    _box(ax, 5.2, 0.9, 9.2, 1.6, "ant in its task", "8 torques every control step (16.5 ms)", "#FBF3EA", _LIMB)
    _route(ax, [(5.1, 1.7), (1.2, 1.7), (1.2, 8.4), (5.1, 8.4)])
    ax.text(1.4, 9.15, "all observations\n(34 or 36)", fontsize=8, va="center", color="#555555")
    ax.text(1.4, 7.8, "sum of k rewards", fontsize=8, va="center", color="#555555")
    ax.plot([14.5, 18.9, 18.9, 5.2], [1.7, 1.7, 3.85, 3.85], color="#777777", lw=1.1, ls="--", zorder=0)
    ax.text(14.8, 1.1, "first 32 observations, to each", fontsize=8, va="center", color="#555555")
    return figure


def _route(ax: Any, points: list[tuple[float, float]]) -> None:
    """A dashed way with right angles and an arrow at its end."""
    ax.plot(*np.array(points[:-1]).T, color="#777777", lw=1.1, ls="--", zorder=0)
    style: dict[str, Any] = {"arrowstyle": "-|>", "mutation_scale": 11, "lw": 1.1, "color": "#777777", "ls": "--"}
    ax.add_patch(FancyArrowPatch(points[-2], points[-1], shrinkA=0, shrinkB=0, zorder=0, **style))


def _box(ax: Any, x: float, y: float, width: float, height: float, head: str, text: str, fill: str, edge: str) -> None:
    ax.add_patch(
        FancyBboxPatch((x, y), width, height, boxstyle="round,pad=0.05,rounding_size=0.25", fc=fill, ec=edge, lw=1.8)
    )
    ax.text(x + width / 2, y + 0.66 * height, head, ha="center", va="center", weight="bold")
    ax.text(x + width / 2, y + 0.28 * height, text, ha="center", va="center", fontsize=8)


def _arrow(ax: Any, start: tuple[float, float], end: tuple[float, float], colour: str) -> None:
    ax.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=12, lw=1.4, color=colour, zorder=0))
