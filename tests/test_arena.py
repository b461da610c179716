"""Laws of arenas: what is drawn is what stands, a turned maze is the same maze, and the field is the shortest way."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
import pytest

from footwork.arena import (
    DEFAULT_MAZE,
    DIRECTIONS,
    FAR,
    MAZES,
    Arena,
    Wall,
    bandit,
    direction_changes,
    geodesic_field,
    inside_walls,
    maze,
    open_field,
    shortest_path,
    straight_line_blocked,
)

ROOM = maze(("######", "#r...#", "#....#", "#...g#", "######"), name="room")
PATCHY = maze("#########\n#r..#...#\n#.#...#.#\n#.##.##.#\n#...#..g#\n#########", name="patchy", cell=3.0)
ALL_MAZES = [*MAZES.values(), ROOM, PATCHY]


def by_name(arena: Arena) -> str:
    return arena.name


def half_extent(arena: Arena) -> np.ndarray:
    return np.array([len(arena.grid[0]), len(arena.grid)]) * arena.cell / 2


def scatter(arena: Arena, count: int, clearance: float, seed: int = 0) -> np.ndarray:
    """Random points [count', 2] of the arena that keep ``clearance`` from its walls."""
    half = half_extent(arena)
    points = np.random.default_rng(seed).uniform(-half, half, size=(count, 2))
    return points[~inside_walls(arena, points, clearance)]


def samples(field: Any) -> np.ndarray:
    """Coordinates [H, W, 2] of the samples of a field."""
    height, width = field.values.shape
    axes = field.origin[0] + field.spacing * np.arange(width), field.origin[1] + field.spacing * np.arange(height)
    return np.stack(np.meshgrid(*axes), axis=-1)


def length(path: list[tuple[float, float]]) -> float:
    return sum(math.dist(a, b) for a, b in itertools.pairwise(path))


def exact(arena: Arena, points: np.ndarray, clearance: float) -> np.ndarray:
    """Shortest way to the arena's goal from each of the points, through the drawing's own routine."""
    return np.array(
        [
            length(shortest_path(Arena("probe", tuple(p), arena.goals, walls=arena.walls), clearance=clearance))
            for p in points
        ]
    )


# Walls ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("arena", ALL_MAZES, ids=by_name)
def test_walls_cover_exactly_the_wall_cells(arena: Arena) -> None:
    half, rng = half_extent(arena), np.random.default_rng(1)
    for i, row in enumerate(arena.grid):
        for j, letter in enumerate(row):
            corner = np.array([j * arena.cell - half[0], half[1] - (i + 1) * arena.cell])
            inside = corner + arena.cell * rng.uniform(0.001, 0.999, size=(20, 2))
            assert (inside_walls(arena, inside) == (letter == "#")).all()


@pytest.mark.parametrize("arena", ALL_MAZES, ids=by_name)
def test_walls_do_not_overlap_and_are_fewer_than_the_cells(arena: Arena) -> None:
    cells = "".join(arena.grid).count("#")
    area = sum(4 * wall.half_x * wall.half_y for wall in arena.walls)
    assert area == pytest.approx(cells * arena.cell**2)  # with full cover, no more area means no overlap
    assert len(arena.walls) <= cells / 2


@pytest.mark.parametrize("arena", ALL_MAZES, ids=by_name)
def test_a_quarter_turn_of_the_drawing_turns_the_arena(arena: Arena) -> None:
    turned = maze(np.rot90([list(row) for row in arena.grid]).tolist(), cell=arena.cell)
    assert turned.start == pytest.approx((-arena.start[1], arena.start[0]))
    assert turned.goals[0] == pytest.approx((-arena.goals[0][1], arena.goals[0][0]))
    points = np.random.default_rng(2).uniform(-half_extent(arena), half_extent(arena), size=(2000, 2))
    about = np.stack([-points[:, 1], points[:, 0]], axis=-1)
    np.testing.assert_array_equal(inside_walls(turned, about), inside_walls(arena, points))
    assert direction_changes(turned) == direction_changes(arena)
    assert length(shortest_path(turned)) == pytest.approx(length(shortest_path(arena)))


def test_the_three_ways_to_draw_a_maze_agree() -> None:
    nested = [[1, 1, 1, 1, 1], [1, "g", 0, 0, 1], [1, 1, 1, 0, 1], [1, "r", 0, 0, 1], [1, 1, 1, 1, 1]]
    text = """
        11111
        1G  1
        111.1
        1S001
        11111
    """
    assert maze(nested, name="u") == maze(text, name="u") == DEFAULT_MAZE
    assert hash(maze(text, name="u")) == hash(DEFAULT_MAZE)


@pytest.mark.parametrize(
    ("either", "plain"), [("#c..c#", "#r..g#"), ("#r..c#", "#r..g#"), ("#c..g#", "#r..g#"), ("#c..r#", "#g..r#")]
)
def test_an_either_cell_becomes_what_is_missing(either: str, plain: str) -> None:
    assert maze(("######", either, "######")) == maze(("######", plain, "######"))


# The arenas of the study ----------------------------------------------------------------------------------------------


def test_open_field_goals_are_the_quarter_turns_of_the_first() -> None:
    arena = open_field()
    angles = [math.atan2(y, x) % math.tau for x, y in arena.goals]
    assert angles == pytest.approx([quarter * math.pi / 2 for quarter in range(len(DIRECTIONS))])
    assert [math.hypot(*goal) for goal in arena.goals] == [FAR] * 4
    assert not arena.walls


def test_bandit_goals_are_the_quarter_turns_of_the_first() -> None:
    goals = bandit(3.0).goals
    assert goals[0] == (3.0, 3.0)
    assert all((-y, x) == after for (x, y), after in zip(goals, goals[1:] + goals[:1], strict=True))


@pytest.mark.parametrize("arena", MAZES.values(), ids=by_name)
def test_no_named_maze_can_be_walked_straight(arena: Arena) -> None:
    assert straight_line_blocked(arena)
    assert direction_changes(arena) >= 2
    assert MAZES[arena.name] is arena


def test_direction_changes_counts_corners_of_shortest_ways_only() -> None:
    assert direction_changes(DEFAULT_MAZE) == 2
    assert direction_changes(MAZES["spiral"]) == 4
    assert direction_changes(ROOM) == 1
    assert direction_changes(maze(("######", "#r..g#", "######"))) == 0
    assert not straight_line_blocked(ROOM)
    # Over the top: 6 steps, 4 changes. Along the bottom: only 2 changes, but 8 steps.
    assert direction_changes(maze(("#######", "##...##", "#r.#.g#", "#.###.#", "#.....#", "#######"))) == 4


# The field ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("arena", [ROOM, bandit(4.0)], ids=by_name)
def test_field_is_the_straight_distance_where_nothing_stands(arena: Arena) -> None:
    goal = arena.goals[-1]
    field = geodesic_field(arena, goal, clearance=0.3)
    points = samples(field)
    straight = np.hypot(points[..., 0] - goal[0], points[..., 1] - goal[1])
    free = ~inside_walls(arena, points, 0.301)
    np.testing.assert_allclose(field.values[free], straight[free], atol=1e-4)
    assert field.values.min() == field.at(goal) == 0.0


@pytest.mark.parametrize("arena", ALL_MAZES, ids=by_name)
@pytest.mark.parametrize("clearance", [0.0, 0.4])
def test_field_is_finite_symmetric_and_one_lipschitz(arena: Arena, clearance: float) -> None:
    field = geodesic_field(arena, clearance=clearance)
    assert field.values.dtype == np.float32
    assert not field.values.flags.writeable
    assert np.isfinite(field.values).all()
    assert (field.values >= 0).all()
    points = samples(field)
    free = ~inside_walls(arena, points, clearance + 0.001)
    for axis in (0, 1):
        slope = np.abs(np.diff(field.values, axis=axis)) / field.spacing
        both = free[1:] & free[:-1] if axis == 0 else free[:, 1:] & free[:, :-1]
        assert slope[both].max() <= 1 + 1e-4
    straight = np.hypot(*(points - arena.goals[0])[free].T)
    assert (field.values[free] >= straight - 1e-3).all()
    back = Arena("back", arena.goals[0], (arena.start,), walls=arena.walls)
    assert field.at(arena.start) == pytest.approx(length(shortest_path(back, clearance=clearance)), abs=0.05)


@pytest.mark.parametrize("arena", ALL_MAZES, ids=by_name)
def test_triangle_inequality_between_start_goal_and_any_point(arena: Arena) -> None:
    to_goal, to_start = geodesic_field(arena), geodesic_field(arena, arena.start)
    points = scatter(arena, 3000, 0.7)
    detour = to_goal.at(points) + to_start.at(points)
    direct = length(shortest_path(arena))
    assert (detour >= direct - 0.02).all()
    on_the_way = np.array(shortest_path(arena))
    np.testing.assert_allclose(to_goal.at(on_the_way) + to_start.at(on_the_way), direct, atol=0.3)


@pytest.mark.parametrize("clearance", [0.0, 0.4, 1.0])
def test_field_of_the_u_is_the_way_around_two_corners(clearance: float) -> None:
    # Start (-4, -4), goal (-4, 4); the wall between them ends at x = 2 and reaches from y = -2 to 2.
    corner = 2.0 + clearance
    by_hand = 2 * math.hypot(corner + 4, 4 - corner) + 2 * corner
    distance = geodesic_field(DEFAULT_MAZE, clearance=clearance).at(DEFAULT_MAZE.start)
    assert by_hand - 1e-3 <= distance <= 1.02 * by_hand
    assert length(shortest_path(DEFAULT_MAZE, clearance=clearance)) == pytest.approx(by_hand, abs=1e-2)


@pytest.mark.parametrize("arena", [DEFAULT_MAZE, PATCHY, MAZES["medium"]], ids=by_name)
@pytest.mark.parametrize("clearance", [0.0, 0.4])
def test_interpolation_stays_close_to_the_exact_way_up_to_the_walls(arena: Arena, clearance: float) -> None:
    field = geodesic_field(arena, clearance=clearance)
    points = scatter(arena, 700, max(clearance + 0.001, 0.401))
    error = np.abs(field.at(points) - exact(arena, points, clearance))
    assert error.max() <= 0.3 * field.spacing
    assert (error / np.maximum(field.at(points), 2.0)).max() <= 0.02


@pytest.mark.parametrize("arena", ALL_MAZES, ids=by_name)
@pytest.mark.parametrize("clearance", [0.0, 0.4])
def test_the_goal_is_the_only_local_minimum_even_inside_walls(arena: Arena, clearance: float) -> None:
    values = geodesic_field(arena, clearance=clearance).values
    around = np.pad(values, 1, constant_values=np.inf)
    windows = np.lib.stride_tricks.sliding_window_view(around, (3, 3))
    lowest = windows.min(axis=(2, 3)) == values
    assert values[lowest].tolist() == [0.0]


@pytest.mark.parametrize("arena", [PATCHY, MAZES["spiral"], MAZES["large"]], ids=by_name)
def test_field_lies_below_the_way_over_the_lattice_and_not_far(arena: Arena) -> None:
    field = geodesic_field(arena)
    free = ~inside_walls(arena, samples(field), 0.4)
    over_lattice = king_moves(free, field.values == 0) * field.spacing
    ratio = over_lattice[free] / np.maximum(field.values[free], 2.0)
    assert ratio.max() <= 1.083  # a king's way is at most 1 / cos(22.5 deg) of the straight one
    assert (over_lattice[free] >= field.values[free] - 0.3).all()  # it may cut a wall's corner by half a step


def king_moves(free: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Shortest ways in sample spacings over the eight neighbours, relaxed until nothing gets shorter."""
    cost, before = np.where(goal, 0.0, np.inf), None
    while before is None or (cost < before).any():
        before = cost.copy()
        for i, j in ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
            cost = np.where(free, np.minimum(cost, np.roll(cost, (i, j), (0, 1)) + math.hypot(i, j)), np.inf)
    return cost


def test_no_way_leads_along_the_seam_of_two_walls_or_between_touching_corners() -> None:
    seam = Arena("seam", (-3.0, 0.0), ((3.0, 0.0),), walls=(Wall(0, 2, 1, 2), Wall(0, -2, 1, 2)))
    assert length(shortest_path(seam, clearance=0.0)) == pytest.approx(2 * math.hypot(2, 4) + 2, abs=1e-2)
    touching = Arena("touching", (-3.0, 3.0), ((3.0, -3.0),), walls=(Wall(2, 2, 2, 2), Wall(-2, -2, 2, 2)))
    assert length(shortest_path(touching, clearance=0.0)) > 1.2 * math.hypot(6, 6)


def test_a_wall_parts_its_two_sides() -> None:
    field = geodesic_field(DEFAULT_MAZE)
    near, far = field.at((-4.0, 2.0)), field.at((-4.0, -2.0))  # the two faces of the wall between start and goal
    assert far - near > 10
    assert field.at((-4.0, 1.0)) > near  # into the wall is never a way forward
    assert field.at((-4.0, -1.0)) > far


def test_beyond_the_lattice_the_field_grows_with_the_distance() -> None:
    field = geodesic_field(DEFAULT_MAZE)
    edge = field.at((10.0, 3.0))
    assert field.at((17.0, 3.0)) == pytest.approx(edge + 7.0)


def test_lookup_in_jax_equals_lookup_in_numpy() -> None:
    jax = pytest.importorskip("jax")
    field = geodesic_field(PATCHY)
    points = np.random.default_rng(3).uniform(-20, 20, size=(64, 4, 2)).astype(np.float32)
    looked_up = jax.jit(lambda xy: field.at(xy, jax.numpy))(points)
    np.testing.assert_allclose(looked_up, field.at(points), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("arena", ALL_MAZES, ids=by_name)
def test_shortest_path_keeps_its_clearance_and_its_ends(arena: Arena) -> None:
    path = np.array(shortest_path(arena, clearance=0.4))
    assert tuple(path[0]) == arena.start
    assert tuple(path[-1]) == arena.goals[0]
    along = np.linspace(0, 1, 50)[:, None, None]
    walked = path[:-1] + along * (path[1:] - path[:-1])
    assert not inside_walls(arena, walked, 0.4).any()
    assert length([tuple(p) for p in path]) <= shortest_over_cells(arena) + 1e-9


def shortest_over_cells(arena: Arena) -> float:
    """Length in m of a way from cell centre to cell centre, by flooding: an upper bound that shares no code."""
    free = np.array([[letter != "#" for letter in row] for row in arena.grid])
    here = np.array([[letter == "r" for letter in row] for row in arena.grid])
    goal = np.array([[letter == "g" for letter in row] for row in arena.grid])
    steps = 0
    while not here[goal].any():
        spread = here.copy()
        for axis in (0, 1):
            spread |= np.roll(here, 1, axis) | np.roll(here, -1, axis)
        here, steps = spread & free, steps + 1
    return steps * arena.cell


# Refusals -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ((), "empty"),
        ("", "empty"),
        (("",), "empty"),
        (None, "text or rows"),
        ([1, 0, 1], "text or rows"),
        (("####", "#rg#", "###"), r"equally long, got lengths \[4, 4, 3\]"),
        (("####", "#rx#", "####"), "unknown maze cell 'x'; known: '#' '1'"),
        ([[1, 1, 1], [1, 2, 1], [1, 1, 1]], "unknown maze cell 2"),
        (("####", "#.g#", "####"), "exactly one start .*got 0"),
        (("#####", "#rrg#", "#####"), "exactly one start .*got 2"),
        (("####", "#r.#", "####"), "exactly one goal .*got 0"),
        (("####", "#.c#", "####"), "exactly one goal .*got 0"),
        (("#####", "#rgg#", "#####"), "exactly one goal .*got 2"),
        (("#####", "#rgc#", "#####"), "1 cells 'c' where 0"),
        (("#####", "#ccc#", "#####"), "3 cells 'c' where 2"),
        (("####", "#rg.", "####"), r"enclosed by walls.*row 1, column 3"),
        (("#.##", "#rg#", "####"), r"enclosed by walls.*row 0, column 1"),
        (("#####", "#r#g#", "#####"), "no path from start to goal"),
        (("####", "#r##", "##g#", "####"), "no path from start to goal"),
    ],
)
def test_bad_drawings_are_refused(rows: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        maze(rows)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cell": 0.0}, "cell must be > 0.8"),
        ({"cell": -4.0}, "cell must be > 0.8"),
        ({"cell": math.nan}, "cell must be finite"),
        ({"cell": "wide"}, "cell must be a number"),
        ({"start_noise": -1.0}, "start_noise must be >= 0"),
        ({"start_noise": math.inf}, "start_noise must be finite"),
        ({"start_noise": 1.9}, "must keep 0.4 m from every wall"),
        ({"wall_height": 0.0}, "wall_height must be > 0"),
        ({"name": ""}, "name must be a non-empty str"),
    ],
)
def test_bad_numbers_of_a_maze_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        maze(DEFAULT_MAZE.grid, **change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cell": 8.0}, "walls must be those of grid"),
        ({"walls": ()}, "walls must be those of grid"),
        ({"walls": ("#",)}, "walls must hold Wall"),
        ({"grid": ("###", "#?#", "###")}, "unknown letters"),
        ({"goals": ()}, "at least one"),
        ({"goals": (1.0, 2.0)}, "goal must be a pair"),
        ({"goals": ((math.inf, 0.0),)}, "goal x must be finite"),
        ({"goals": ((0.0, 0.0),)}, "must not be in a wall"),
        ({"start": (0.0, 0.0)}, "must keep 0.4 m"),
        ({"start": (0.0, 0.0, 0.0)}, "start must be a pair"),
    ],
)
def test_an_arena_that_contradicts_itself_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(DEFAULT_MAZE, **change)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_sizes_that_are_no_sizes_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="half_size"):
        bandit(bad)
    with pytest.raises(ValueError, match="half_x"):
        Wall(0.0, 0.0, bad, 1.0)
    with pytest.raises(ValueError, match="resolution"):
        geodesic_field(DEFAULT_MAZE, resolution=bad)


def test_questions_without_an_answer_are_refused() -> None:
    with pytest.raises(ValueError, match="4 goals: name one"):
        geodesic_field(bandit())
    with pytest.raises(ValueError, match="needs an arena with a grid"):
        direction_changes(bandit(), (8.0, 8.0))
    with pytest.raises(ValueError, match="must lie in a free cell"):
        direction_changes(DEFAULT_MAZE, (0.0, 0.0))
    with pytest.raises(ValueError, match="samples, at most"):
        geodesic_field(open_field(), (FAR, 0.0))
    with pytest.raises(ValueError, match="clearance must be >= 0"):
        geodesic_field(DEFAULT_MAZE, clearance=-0.1)
    with pytest.raises(ValueError, match="more than clearance 2 m"):
        geodesic_field(DEFAULT_MAZE, clearance=2.0)
    with pytest.raises(ValueError, match=r"resolution must be <= 0\.1"):
        geodesic_field(Arena("thin", (0.0, 0.0), ((3.0, 0.0),), walls=(Wall(1.5, 0, 0.1, 1),)), clearance=0.0)
    narrow = Arena("narrow", (-3.0, 0.0), ((3.0, 0.0),), walls=(Wall(0, 20.3, 1, 20), Wall(0, -20.3, 1, 20)))
    assert len(shortest_path(narrow, clearance=0.2)) == 2
    assert length(shortest_path(narrow, clearance=0.4)) > 80


def test_a_goal_the_clearance_shuts_off_is_refused() -> None:
    box = (Wall(0, 3, 4, 1), Wall(0, -3, 4, 1), Wall(-3, 0, 1, 2), Wall(3, 1.3, 1, 0.9), Wall(3, -1.3, 1, 0.9))
    cellar = Arena("cellar", (8.0, 0.0), ((0.0, 0.0),), walls=box)
    assert length(shortest_path(cellar, clearance=0.3)) == pytest.approx(8.0)
    with pytest.raises(ValueError, match="no way from start"):
        shortest_path(cellar, clearance=0.5)
    with pytest.raises(ValueError, match="no way from start"):
        geodesic_field(cellar, clearance=0.5)
