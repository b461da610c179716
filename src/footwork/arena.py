"""Where the ant walks, as data: walls, a start, goals, and how far it is to go around the walls.

An :class:`Arena` says what stands on the floor; engines build it, tasks read its
goals, drawings show it. Four makers cover the study: :func:`open_field` for
learning one direction, :func:`bandit` for the four corners of a square,
:func:`maze` for a drawn grid, and :data:`MAZES` for the mazes with a name.

:func:`geodesic_field` tabulates the length of the shortest way to a goal, so that
a potential can be looked up by bilinear interpolation (:meth:`DistanceField.at`).

Lengths are in metres, seen from above: +x is right (east), +y is up (north).
"""

from __future__ import annotations

import heapq
import math
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Point = tuple[float, float]
Cell = tuple[int, int]  # (row, column); row 0 is the north
Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

DIRECTIONS = ("right", "up", "left", "down")  # quarter turns 0, 1, 2, 3 from +x
FAR = 10_000.0  # m to the targets of the open field (the paper's "10 km")
CLEARANCE = 0.4  # m; torso radius 0.25 and a hand's breadth, so that the torso's shortest way does not rub a corner

WALL, FREE, START, GOAL, EITHER = "#", ".", "r", "g", "c"
LETTERS = {"#": WALL, "1": WALL, ".": FREE, "0": FREE, " ": FREE, "r": START, "s": START, "g": GOAL, "c": EITHER}

_STEPS = ((0, 1), (-1, 0), (0, -1), (1, 0))  # (row, column) of a step right, up, left, down
_SLACK = 1e-4  # m; walls grow by half of it and corners keep all of it, so that touching walls leave no crack
_MARGIN = 4.0  # m that a field shows around an arena without a grid
_MAX_SAMPLES = 4_000_000


@dataclass(frozen=True)
class Wall:
    """An upright box on the floor, sides along the axes: centre and half sizes in m."""

    x: float
    y: float
    half_x: float
    half_y: float

    def __post_init__(self) -> None:
        """Store floats; raise ValueError for what is not finite or has no size."""
        for field in ("x", "y", "half_x", "half_y"):
            object.__setattr__(self, field, _finite(f"wall {field}", getattr(self, field)))
        for field in ("half_x", "half_y"):
            if not getattr(self, field) > 0:
                raise ValueError(f"wall {field} must be > 0, got {getattr(self, field)}")


@dataclass(frozen=True)
class Arena:
    """A floor with walls, one start and at least one goal; immutable and hashable.

    ``start_noise`` (m, uniform in +- x and y) and ``wall_height`` (m) are not in the
    paper. A maze keeps its drawing in ``grid`` (letters ``#``, ``.``, ``r``, ``g``;
    row 0 is the north) with ``cell`` m per letter, else ``grid`` is empty.

    Raises:
        ValueError: a number is not finite or out of range, there is no goal, the start (with
            its noise) comes nearer than :data:`CLEARANCE` to a wall, a goal is in a wall, or
            the grid does not fit the walls.
    """

    name: str
    start: Point
    goals: tuple[Point, ...]
    start_noise: float = 0.0
    walls: tuple[Wall, ...] = ()
    wall_height: float = 2.0
    grid: tuple[str, ...] = ()
    cell: float = 4.0

    def __post_init__(self) -> None:
        """Store tuples and floats; raise ValueError for what cannot be built."""
        if not isinstance(self.name, str) or not self.name:
            raise ValueError(f"arena name must be a non-empty str, got {self.name!r}")
        settle = object.__setattr__
        settle(self, "start", _point("start", self.start))
        settle(self, "goals", tuple(_point("goal", goal) for goal in self.goals))
        settle(self, "walls", tuple(self.walls))
        settle(self, "grid", tuple(self.grid))
        for field in ("start_noise", "wall_height", "cell"):
            settle(self, field, _finite(field, getattr(self, field)))
        _check_sizes(self)
        _check_clear_of_walls(self)
        if self.grid:
            _check_grid(self.grid)
            if set(self.walls) != set(_merged_walls(self.grid, self.cell)):
                raise ValueError("walls must be those of grid and cell; build such an arena with maze()")


def open_field() -> Arena:
    """A floor without walls and four goals 10 km away, in the order of :data:`DIRECTIONS`."""
    return Arena("open_field", (0.0, 0.0), ((FAR, 0.0), (0.0, FAR), (-FAR, 0.0), (0.0, -FAR)))


def bandit(half_size: float = 8.0) -> Arena:
    """A floor without walls and four goals at the corners of a square, counter-clockwise from (+, +).

    Args:
        half_size: half the side of the square, m; not in the paper.

    Raises:
        ValueError: ``half_size`` is not finite or not > 0.
    """
    half = _finite("half_size", half_size)
    if not half > 0:
        raise ValueError(f"half_size must be > 0, got {half_size}")
    return Arena("bandit", (0.0, 0.0), ((half, half), (-half, half), (-half, -half), (half, -half)))


def maze(
    rows: str | Sequence[str | Sequence[int | str]],
    name: str = "maze",
    cell: float = 4.0,
    start_noise: float = 0.0,
    wall_height: float = 2.0,
) -> Arena:
    """A maze from a drawing: text rows, one text of several lines, or nested lists as Gymnasium-Robotics has them.

    Letters, in either case: ``#`` or ``1`` wall; ``.``, ``0`` or a blank free; ``r`` or
    ``s`` start; ``g`` goal; ``c`` either. A ``c`` becomes the start where no start is
    drawn, then the goal where no goal is drawn. Cell (i, j) has its centre at
    x = (j + 1/2) cell - width/2, y = height/2 - (i + 1/2) cell, so the maze is centred on the origin.

    Args:
        rows: the drawing, north first; its border must be all wall.
        name: what the arena is called.
        cell: side of a cell, m; more than twice :data:`CLEARANCE`.
        start_noise: the start is uniform within +- this in x and y, m; not in the paper.
        wall_height: m.

    Raises:
        ValueError: the drawing is empty, ragged, open at the border, has an unknown letter,
            not exactly one start and one goal, or no way between them; or a number is out of range.

    Source: the meaning of letters and coordinates follows Gymnasium-Robotics' maze environments.
    """
    grid = _assign_either(_read_rows(rows))
    _check_grid(grid)
    side = _check_cell(cell)
    return Arena(
        name=name,
        start=_centre(grid, side, _find(grid, START)[0]),
        goals=(_centre(grid, side, _find(grid, GOAL)[0]),),
        start_noise=start_noise,
        walls=_merged_walls(grid, side),
        wall_height=wall_height,
        grid=grid,
        cell=side,
    )


def extent_of(
    arena: Arena, points: npt.ArrayLike | None = None, margin: float = 1.0
) -> tuple[float, float, float, float]:
    """Centre x, y and half sizes (m) of what there is to see: start, points [P, 2], and a maze within its border.

    Without points the goals are seen too.
    """
    every = [np.array([arena.start]), np.array(arena.goals if points is None else points, np.float64)]
    if arena.grid:
        half = np.array([len(arena.grid[0]) - 2, len(arena.grid) - 2]) * arena.cell / 2
        every.append(np.stack([-half, half]))
    together = np.concatenate(every)
    low, high = together.min(axis=0), together.max(axis=0)
    (x, y), (half_x, half_y) = (low + high) / 2, (high - low) / 2 + margin
    return float(x), float(y), float(half_x), float(half_y)


def inside_walls(arena: Arena, points: npt.ArrayLike, clearance: float = 0.0) -> Bools:
    """Which of the points [..., 2] (m) are in a wall grown by ``clearance`` (m) on all four sides: bool [...]."""
    xy = np.asarray(points, dtype=np.float64)
    return _covered(xy, _boxes(arena.walls, clearance))


def straight_line_blocked(arena: Arena, goal: Point | None = None) -> bool:
    """Whether a wall stands between the start and the goal (the arena's only one, if none is named).

    Raises:
        ValueError: no goal is named and the arena has several.
    """
    ends = np.array([arena.start, _the_goal(arena, goal)])
    return not bool(_clear(ends[:1], ends[1:], _boxes(arena.walls, 0.0))[0])


def direction_changes(arena: Arena, goal: Point | None = None) -> int:
    """Fewest changes of direction among the shortest ways over the grid's cells, from start to goal.

    Raises:
        ValueError: the arena has no grid, no goal is named and it has several, or a wall cell is named.
    """
    if not arena.grid:
        raise ValueError(f"direction_changes needs an arena with a grid, got {arena.name!r} without one")
    ends = [_cell_of(arena, arena.start), _cell_of(arena, _the_goal(arena, goal))]
    found = _search(arena.grid, ends[0], ends[1])
    if found is None:
        raise ValueError(f"no way over the cells of {arena.name!r} from {ends[0]} to {ends[1]}")
    return found[1]


def shortest_path(arena: Arena, goal: Point | None = None, clearance: float = CLEARANCE) -> list[Point]:
    """Waypoints (m) of the shortest way from the start to the goal, both included, around walls grown by ``clearance``.

    Raises:
        ValueError: no goal is named and the arena has several, or no way is left with this clearance.
    """
    graph = _visibility_graph(arena, _the_goal(arena, goal), _at_least_zero("clearance", clearance))
    _, first = _distances(np.array([arena.start]), graph)
    _check_reached(arena, first[0] >= 0, clearance)
    path, node = [arena.start], int(first[0])
    while node >= 0:
        path.append((float(graph.nodes[node, 0]), float(graph.nodes[node, 1])))
        node = int(graph.onward[node])
    return path


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Length of the shortest way to one goal, sampled on a square lattice.

    ``values[i, j]`` (m, float32 [H, W], read-only, finite everywhere) belongs to the point
    (origin[0] + j spacing, origin[1] + i spacing): rows ascend in y, columns in x.
    The goal is one of the samples.
    """

    origin: Point
    spacing: float
    values: npt.NDArray[np.float32]

    def at(self, points: Any, xp: Any = np) -> Any:
        """Distance in m [...] at points [..., 2] in m, interpolated bilinearly.

        Beyond the lattice it is the value at its nearest point plus the distance to it.
        ``xp`` is the array namespace to compute in: numpy, or jax.numpy inside a jitted function.
        """
        xy, values = xp.asarray(points), xp.asarray(self.values)
        last = np.array([values.shape[1] - 1, values.shape[0] - 1], dtype=np.float32)
        place = (xy - np.array(self.origin, dtype=np.float32)) / np.float32(self.spacing)
        held = xp.clip(place, 0.0, last)
        low = xp.clip(xp.floor(held), 0.0, last - 1.0).astype(np.int32)
        along = held - low
        j, i, u, v = low[..., 0], low[..., 1], along[..., 0], along[..., 1]
        south = values[i, j] * (1.0 - u) + values[i, j + 1] * u
        north = values[i + 1, j] * (1.0 - u) + values[i + 1, j + 1] * u
        beyond = xp.sqrt(xp.sum((place - held) ** 2, axis=-1)) * np.float32(self.spacing)
        return south * (1.0 - v) + north * v + beyond


def geodesic_field(
    arena: Arena, goal: Point | None = None, resolution: float = 0.25, clearance: float = CLEARANCE
) -> DistanceField:
    """Tabulate the shortest distance to a goal around walls grown by ``clearance`` on all four sides.

    At every sample outside the grown walls the value is the exact Euclidean shortest way (a
    visibility graph over the corners; rounding and slack stay below 1 cm). Inside them, the
    first sample counts its distance to the wall's face plus the way from there, and deeper
    ones add the steps of the lattice to their neighbour's value: the middle of a wall parts
    its two sides. Interpolating errs by up to 0.3 ``resolution``, most of it along walls and
    beside the goal.

    Args:
        arena: without walls the field is the straight distance.
        goal: point in m; the arena's only goal, if none is named.
        resolution: spacing of the samples, m.
        clearance: m kept from walls; 0.4 by default, see :data:`CLEARANCE`.

    Raises:
        ValueError: a number is out of range, the goal is in a grown wall, no way leads to it
            from the start, a wall is too thin for the resolution, or the arena is too large for it.
    """
    target = _the_goal(arena, goal)
    spacing = _finite("resolution", resolution)
    if not spacing > 0:
        raise ValueError(f"resolution must be > 0, got {resolution}")
    graph = _visibility_graph(arena, target, _at_least_zero("clearance", clearance))
    thinnest = min((2 * min(half) for half in graph.boxes[:, 2:]), default=math.inf)
    if thinnest < 2 * spacing:
        raise ValueError(f"resolution must be <= {thinnest / 2:g}, half the thinnest grown wall, got {resolution}")
    start, _ = _distances(np.array([arena.start]), graph)
    _check_reached(arena, bool(np.isfinite(start[0])), clearance)
    xs, ys = _lattice(arena, target, spacing)
    points = np.stack(np.meshgrid(xs, ys), axis=-1)
    reached, _ = _distances(points.reshape(-1, 2), graph)
    everywhere = _fill(_first_ring(reached.reshape(points.shape[:2]), points, graph), spacing)
    values = everywhere.astype(np.float32)
    values.setflags(write=False)
    return DistanceField((float(xs[0]), float(ys[0])), spacing, values)


# Numbers and points ---------------------------------------------------------------------------------------------------


def _finite(what: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{what} must be a number, got {value!r}") from None
    if not math.isfinite(number):
        raise ValueError(f"{what} must be finite, got {value}")
    return number


def _at_least_zero(what: str, value: Any) -> float:
    if _finite(what, value) < 0:
        raise ValueError(f"{what} must be >= 0, got {value}")
    return float(value)


def _point(what: str, value: Any) -> Point:
    try:
        x, y = value
    except (TypeError, ValueError):
        raise ValueError(f"{what} must be a pair (x, y) in m, got {value!r}") from None
    return _finite(f"{what} x", x), _finite(f"{what} y", y)


def _the_goal(arena: Arena, goal: Point | None) -> Point:
    if goal is not None:
        return _point("goal", goal)
    if len(arena.goals) > 1:
        raise ValueError(f"arena {arena.name!r} has {len(arena.goals)} goals: name one of {arena.goals}")
    return arena.goals[0]


def _check_sizes(arena: Arena) -> None:
    if not arena.goals:
        raise ValueError("goals must hold at least one (x, y), got none")
    _at_least_zero("start_noise", arena.start_noise)
    for field in ("wall_height", "cell"):
        if not getattr(arena, field) > 0:
            raise ValueError(f"{field} must be > 0, got {getattr(arena, field)}")
    for wall in arena.walls:
        if not isinstance(wall, Wall):
            raise ValueError(f"walls must hold Wall records, got {wall!r}")
    if arena.grid:
        _check_cell(arena.cell)


def _check_cell(cell: Any) -> float:
    side = _finite("cell", cell)
    if not side > 2 * CLEARANCE:
        raise ValueError(f"cell must be > {2 * CLEARANCE:g} m for the ant to pass, got {cell}")
    return side


def _check_clear_of_walls(arena: Arena) -> None:
    if inside_walls(arena, arena.start, arena.start_noise + CLEARANCE):
        raise ValueError(
            f"start {arena.start} +- start_noise {arena.start_noise:g} must keep {CLEARANCE:g} m from every wall"
        )
    for goal in arena.goals:
        if inside_walls(arena, goal):
            raise ValueError(f"goal {goal} must not be in a wall")


def _check_reached(arena: Arena, reached: bool, clearance: float) -> None:
    if not reached:
        raise ValueError(
            f"no way from start {arena.start} to the goal in {arena.name!r} with clearance {clearance:g} m; "
            "try a smaller clearance"
        )


# The grid -------------------------------------------------------------------------------------------------------------


def _read_rows(rows: str | Sequence[str | Sequence[int | str]]) -> tuple[str, ...]:
    """Translate any of the accepted drawings to rows of the five letters."""
    if isinstance(rows, str):
        lines: Iterable[Any] = [line.rstrip() for line in textwrap.dedent(rows).strip("\n").rstrip().split("\n")]
    else:
        lines = rows
    try:
        grid = tuple("".join(_letter(cell) for cell in line) for line in lines)
    except TypeError:
        raise ValueError(f"maze rows must be text or rows of cells, got {rows!r}") from None
    if not grid or not any(grid):
        raise ValueError("maze rows must not be empty")
    return grid


def _letter(cell: Any) -> str:
    known = LETTERS.get(str(cell).lower())
    if known is None:
        raise ValueError(f"unknown maze cell {cell!r}; known: {' '.join(repr(letter) for letter in LETTERS)}")
    return known


def _find(grid: tuple[str, ...], letter: str) -> list[Cell]:
    return [(i, j) for i, row in enumerate(grid) for j, here in enumerate(row) if here == letter]


def _assign_either(grid: tuple[str, ...]) -> tuple[str, ...]:
    """Give the cells ``c`` to whichever of start and goal is missing, the start first."""
    missing = [letter for letter in (START, GOAL) if not _find(grid, letter)]
    either = len(_find(grid, EITHER))
    if either > len(missing):
        raise ValueError(
            f"maze has {either} cells 'c' where {len(missing)} of start and goal are missing: "
            "one start and one goal in all are allowed"
        )
    text = "\n".join(grid)
    for letter in missing[:either]:
        text = text.replace(EITHER, letter, 1)
    return tuple(text.split("\n"))


def _check_grid(grid: tuple[str, ...]) -> None:
    widths = [len(row) for row in grid]
    if len(set(widths)) > 1:
        raise ValueError(f"maze rows must be equally long, got lengths {widths}")
    unknown = {letter for row in grid for letter in row} - {WALL, FREE, START, GOAL}
    if unknown:
        raise ValueError(f"unknown letters {sorted(unknown)} in the grid; known: # . r g")
    for letter, what in ((START, "start (r or s)"), (GOAL, "goal (g)")):
        if len(_find(grid, letter)) != 1:
            raise ValueError(f"maze must have exactly one {what}, got {len(_find(grid, letter))}")
    for i, j in np.ndindex(len(grid), widths[0]):
        if (i in (0, len(grid) - 1) or j in (0, widths[0] - 1)) and grid[i][j] != WALL:
            raise ValueError(f"maze must be enclosed by walls, but border cell (row {i}, column {j}) is not wall")
    if _search(grid, _find(grid, START)[0], _find(grid, GOAL)[0]) is None:
        raise ValueError("maze has no path from start to goal")


def _search(grid: tuple[str, ...], start: Cell, goal: Cell) -> tuple[int, int] | None:
    """Fewest steps, then fewest changes of direction, from start to goal within an enclosed grid."""
    queue: list[tuple[int, int, Cell, Cell | None]] = [(0, 0, start, None)]
    seen: set[tuple[Cell, Cell | None]] = set()
    while queue:
        steps, turns, here, heading = heapq.heappop(queue)
        if here == goal:
            return steps, turns
        if (here, heading) in seen:
            continue
        seen.add((here, heading))
        for step in _STEPS:
            there = (here[0] + step[0], here[1] + step[1])
            if grid[there[0]][there[1]] != WALL:
                turned = heading is not None and step != heading
                heapq.heappush(queue, (steps + 1, turns + turned, there, step))
    return None


def _centre(grid: tuple[str, ...], cell: float, where: Cell) -> Point:
    return (where[1] + 0.5 - len(grid[0]) / 2) * cell, (len(grid) / 2 - where[0] - 0.5) * cell


def _cell_of(arena: Arena, point: Point) -> Cell:
    height, width = len(arena.grid), len(arena.grid[0])
    where = math.floor(height / 2 - point[1] / arena.cell), math.floor(point[0] / arena.cell + width / 2)
    if not (0 <= where[0] < height and 0 <= where[1] < width) or arena.grid[where[0]][where[1]] == WALL:
        raise ValueError(f"point {point} must lie in a free cell of {arena.name!r}")
    return where


def _merged_walls(grid: tuple[str, ...], cell: float) -> tuple[Wall, ...]:
    """Cover the wall cells by few boxes that do not overlap: from each first bare cell, the larger of two growths."""
    bare = np.array([[letter == WALL for letter in row] for row in grid])
    walls = []
    for i, j in np.ndindex(*bare.shape):
        if bare[i, j]:
            rest = bare[i:, j:]
            wide, (width, height) = _grow(rest), _grow(rest.T)
            rows, columns = wide if wide[0] * wide[1] >= height * width else (height, width)
            bare[i : i + rows, j : j + columns] = False
            x, y = _centre(grid, cell, (i, j))
            far_x, far_y = _centre(grid, cell, (i + rows - 1, j + columns - 1))
            walls.append(Wall((x + far_x) / 2, (y + far_y) / 2, columns * cell / 2, rows * cell / 2))
    return tuple(walls)


def _grow(bare: Bools) -> tuple[int, int]:
    """Rows and columns of the box that grows from [0, 0] along its row first, then over whole rows."""
    columns = int(np.logical_and.accumulate(bare[0]).sum())
    rows = int(np.logical_and.accumulate(bare[:, :columns].all(axis=1)).sum())
    return rows, columns


# Geometry of shortest ways --------------------------------------------------------------------------------------------


class _Graph(NamedTuple):
    boxes: Floats  # [B, 4] x, y, half_x, half_y of the grown walls
    nodes: Floats  # [V, 2] the goal first, then the corners a shortest way can turn at
    cost: Floats  # [V] m to the goal, inf where no way leads
    onward: npt.NDArray[np.intp]  # [V] the node that comes next, -1 at the goal


def _boxes(walls: Sequence[Wall], grown: float) -> Floats:
    boxes = np.array([(w.x, w.y, w.half_x, w.half_y) for w in walls], dtype=np.float64).reshape(-1, 4)
    grown_by = np.array([0.0, 0.0, grown, grown], dtype=np.float64)
    return np.asarray(boxes + grown_by, dtype=np.float64)


def _covered(points: Floats, boxes: Floats) -> Bools:
    """Which points [..., 2] lie strictly inside one of the boxes [B, 4]."""
    x, y = points[..., 0], points[..., 1]
    inside = np.zeros(x.shape, dtype=np.bool_)
    for box_x, box_y, half_x, half_y in boxes:
        inside |= (np.abs(x - box_x) < half_x) & (np.abs(y - box_y) < half_y)
    return inside


def _clear(start: Floats, end: Floats, boxes: Floats) -> Bools:
    """Which segments start-end ([P, 2] each) touch none of the boxes: separating axes x, y and the segment's normal."""
    (mid_x, mid_y), (reach_x, reach_y) = ((start + end) / 2).T, ((end - start) / 2).T
    wide, high = np.abs(reach_x), np.abs(reach_y)
    hit = np.zeros(len(start), dtype=np.bool_)
    for box_x, box_y, half_x, half_y in boxes:
        x, y = mid_x - box_x, mid_y - box_y
        near = (np.abs(x) <= half_x + wide) & (np.abs(y) <= half_y + high)
        hit |= near & (np.abs(reach_x * y - reach_y * x) <= half_x * high + half_y * wide)
    return ~hit


def _turning_points(boxes: Floats) -> Floats:
    """Outer corners [C, 2] of the union of boxes, half the slack outside it."""
    signs = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)], dtype=np.float64)
    corners = (boxes[:, None, :2] + signs * (boxes[:, None, 2:] + _SLACK / 2)).reshape(-1, 2)
    inward = -2 * _SLACK * np.tile(signs, (len(boxes), 1))
    buried = _covered(corners, boxes)
    for axis in (0, 1):  # at an outer corner both faces go on in the open; elsewhere one runs into another wall
        beside = corners.copy()
        beside[:, axis] += inward[:, axis]
        buried |= _covered(beside, boxes)
    return corners[~buried]


def _visibility_graph(arena: Arena, goal: Point, clearance: float) -> _Graph:
    boxes = _boxes(arena.walls, clearance + _SLACK / 2)
    target = np.array([goal], dtype=np.float64)
    if _covered(target, boxes)[0]:
        raise ValueError(f"goal {goal} must be more than clearance {clearance:g} m from every wall")
    nodes = np.concatenate([target, _turning_points(boxes)])
    i, j = np.triu_indices(len(nodes), 1)
    seen = _clear(nodes[i], nodes[j], boxes)
    length = np.full((len(nodes), len(nodes)), np.inf)
    length[i[seen], j[seen]] = length[j[seen], i[seen]] = np.hypot(*(nodes[i[seen]] - nodes[j[seen]]).T)
    return _Graph(boxes, nodes, *_from_first(length))


def _from_first(length: Floats) -> tuple[Floats, npt.NDArray[np.intp]]:
    """Dijkstra over a matrix of lengths [V, V] from node 0: cost [V] and the next node on the way back [V]."""
    cost, onward = np.full(len(length), np.inf), np.full(len(length), -1)
    cost[0], open_nodes = 0.0, np.ones(len(length), dtype=np.bool_)
    for _ in range(len(length)):
        node = int(np.argmin(np.where(open_nodes, cost, np.inf)))
        open_nodes[node] = False
        through = cost[node] + length[node]
        shorter = open_nodes & (through < cost)
        cost[shorter], onward[shorter] = through[shorter], node
    return cost, onward


def _distances(points: Floats, graph: _Graph) -> tuple[Floats, npt.NDArray[np.intp]]:
    """Shortest way in m from points [P, 2], inf where there is none, and the first node on it (-1 if none).

    Nodes are tried in the order of the length they promise; the first one in sight is the shortest way.
    """
    values, first = np.full(len(points), np.inf), np.full(len(points), -1)
    reachable = np.flatnonzero(np.isfinite(graph.cost))
    waiting = np.flatnonzero(~_covered(points, graph.boxes))
    apart = points[waiting, None] - graph.nodes[reachable]
    promise = graph.cost[reachable] + np.hypot(apart[..., 0], apart[..., 1])
    order = np.argsort(promise, axis=1)
    left = np.arange(len(waiting))  # rows of promise and order that still see nothing
    for turn in range(len(reachable)):
        node = order[left, turn]
        seen = _clear(points[waiting[left]], graph.nodes[reachable[node]], graph.boxes)
        values[waiting[left[seen]]] = promise[left[seen], node[seen]]
        first[waiting[left[seen]]] = reachable[node[seen]]
        left = left[~seen]
        if not len(left):
            break
    return values, first


def _lattice(arena: Arena, goal: Point, spacing: float) -> tuple[Floats, Floats]:
    """Ascending x [W] and y [H] of samples that cover the arena and meet the goal."""
    points = np.array([arena.start, goal, *arena.goals])
    margin = 0.0 if arena.grid else _MARGIN
    boxes = _boxes(arena.walls, 0.0)
    corners = np.concatenate([points, boxes[:, :2] - boxes[:, 2:], boxes[:, :2] + boxes[:, 2:]])
    low = np.floor((corners.min(axis=0) - margin - goal) / spacing)
    high = np.ceil((corners.max(axis=0) + margin - goal) / spacing)
    count = math.prod(high - low + 1)
    if count > _MAX_SAMPLES:
        raise ValueError(f"field of {arena.name!r} would need {count:.3g} samples, at most {_MAX_SAMPLES} are allowed")
    xs, ys = (goal[axis] + spacing * np.arange(low[axis], high[axis] + 1) for axis in (0, 1))
    return xs, ys


def _neighbours(table: npt.NDArray[Any], outside: Any) -> Iterator[tuple[float, npt.NDArray[Any]]]:
    """The eight tables of neighbours with their distance in spacings, the four nearest first."""
    height, width = table.shape[:2]
    padded = np.pad(table, [(1, 1), (1, 1), *[(0, 0)] * (table.ndim - 2)], constant_values=outside)
    for i, j in ((1, 2), (2, 1), (1, 0), (0, 1), (2, 2), (2, 0), (0, 0), (0, 2)):
        yield math.hypot(i - 1, j - 1), padded[i : i + height, j : j + width]


def _first_ring(values: Floats, points: Floats, graph: _Graph) -> Floats:
    """Continue values [H, W] to the samples next to them: way from the wall's face, plus the distance to it."""
    origin = np.full(points.shape, np.nan)
    known = np.where(np.isfinite(values)[..., None], points, np.nan)
    for _, neighbour in _neighbours(known, np.nan):
        origin = np.where(np.isnan(origin), neighbour, origin)
    ring = ~np.isfinite(values) & ~np.isnan(origin[..., 0])
    outside, inside = origin[ring], points[ring]
    for _ in range(16):  # halve the step until the face is found to a few micrometres
        middle = (outside + inside) / 2
        covered = _covered(middle, graph.boxes)[:, None]
        outside, inside = np.where(covered, outside, middle), np.where(covered, middle, inside)
    faces, _ = _distances(outside, graph)
    continued = values.copy()
    continued[ring] = faces + np.hypot(*(points[ring] - outside).T)
    return continued


def _fill(values: Floats, spacing: float) -> Floats:
    """Continue values [H, W] to every sample, ring by ring, each adding the step to its neighbour."""
    filled: Floats = values.copy()
    while not np.isfinite(filled).all():
        reached: Floats = np.full_like(filled, np.inf)
        for step, around in _neighbours(filled, np.inf):
            reached = np.minimum(reached, around + step * spacing)
        unknown = ~np.isfinite(filled)
        filled[unknown] = reached[unknown]
    return filled


# Mazes with a name ----------------------------------------------------------------------------------------------------

# A U lying on its side: the goal is 8 m north of the start, behind a wall.
DEFAULT_MAZE = maze(("#####", "#g..#", "###.#", "#r..#", "#####"), name="u")

MAZES: dict[str, Arena] = {
    arena.name: arena
    for arena in (
        DEFAULT_MAZE,
        # Ours: once around and into the middle, four turns, every one of them to the right.
        maze(("#######", "#r....#", "#####.#", "#..g#.#", "#.###.#", "#.....#", "#######"), name="spiral"),
        # The walls of D4RL, Gymnasium-Robotics and OGBench; start and goal at opposite ends.
        maze(
            ("########", "#r.##..#", "#..#...#", "##...###", "#..#...#", "#.#..#.#", "#...#.g#", "########"),
            name="medium",
        ),
        maze(
            (
                "############",
                "#r...#.....#",
                "#.##.#.#.#.#",
                "#......#...#",
                "#.####.###.#",
                "#..#.#.....#",
                "##.#.#.#.###",
                "#..#...#..g#",
                "############",
            ),
            name="large",
        ),
    )
}
