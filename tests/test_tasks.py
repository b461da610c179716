"""Laws of the tasks: what is seen, what is paid, when it ends; and that a quarter turn changes nothing."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from footwork.arena import DIRECTIONS, MAZES, geodesic_field, maze, open_field, shortest_path
from footwork.physics.batch import BatchPhysics
from footwork.robot import ROBOTS
from footwork.study.experiments import ANT_BANDIT, ANT_MAZE, ANT_WALKER
from footwork.tasks.observe import observe_walker, turn_action, turn_observation
from footwork.tasks.task import Task
from footwork.tasks.terms import WALKER_WEIGHTS, RewardWeights, straight_progress
from footwork.types import PhysicsState

HEAVY = ROBOTS["heavy"]
LOW, HIGH = np.array(HEAVY.joint_limits()).T
DT = HEAVY.control_dt
FAR_GOALS = np.float32(ANT_WALKER.arena.goals)

# Most of the time here is compilation: ask for quick code.
jit = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False})
advance = jit(Task.advance, static_argnums=0)
observe_task = jit(Task.observe, static_argnums=0)
observe = jit(observe_walker, static_argnums=1)
turned_observation = jit(turn_observation)
turned_action = jit(turn_action)
progress_speed = jit(straight_progress, static_argnums=3)
progress = jit(Task.progress, static_argnums=0)
reset_pose = jit(Task.reset_pose, static_argnums=(0, 2))


def state_of(qpos, qvel=None, contact=None, collision=None, diverged=None):
    rows = len(qpos)
    return PhysicsState(
        qpos=jnp.asarray(qpos, jnp.float32),
        qvel=jnp.zeros((rows, 14)) if qvel is None else jnp.asarray(qvel, jnp.float32),
        foot_contact=jnp.zeros((rows, 4)) if contact is None else jnp.asarray(contact, jnp.float32),
        foot_collision=jnp.zeros((rows, 4)) if collision is None else jnp.asarray(collision, jnp.float32),
        diverged=jnp.zeros(rows, bool) if diverged is None else jnp.asarray(diverged),
    )


def standing(rows=1, xy=(0.0, 0.0), height=HEAVY.reset_height):
    """Upright, every joint in the middle of its range."""
    qpos = np.zeros((rows, 15))
    qpos[:, :2], qpos[:, 2], qpos[:, 3], qpos[:, 7:] = xy, height, 1.0, (LOW + HIGH) / 2
    return qpos


def random_state(rows, seed=0, flipped=False):
    """Everywhere and in every attitude, but clear of +-90 degrees of pitch and of the observation's clip."""
    generator = np.random.default_rng(seed)
    qpos = np.zeros((rows, 15))
    qpos[:, :2], qpos[:, 2] = generator.uniform(-3, 3, (rows, 2)), generator.uniform(0.3, 0.9, rows)
    qpos[:, 7:] = generator.uniform(LOW, HIGH, (rows, 8))
    axis, tilt = generator.uniform(0, 2 * np.pi, rows), np.radians(generator.uniform(5, 60, rows))
    leaning = quaternion(np.stack([np.cos(axis), np.sin(axis), 0 * axis], axis=1), tilt + np.pi * flipped)
    qpos[:, 3:7] = product(about_z(generator.uniform(-np.pi, np.pi, rows)), leaning)
    qvel = np.concatenate([generator.uniform(-4, 4, (rows, 6)), generator.uniform(-20, 20, (rows, 8))], axis=1)
    contact, collision = generator.integers(0, 2, (2, rows, 4))
    return state_of(qpos, qvel, contact, collision)


def quaternion(axis, angle):
    return np.concatenate([np.cos(angle / 2)[:, None], np.sin(angle / 2)[:, None] * axis], axis=1)


def about_z(angle):
    angle = np.atleast_1d(angle)
    return quaternion(np.tile([0.0, 0.0, 1.0], (len(angle), 1)), angle)


def product(p, q):
    """Of quaternions wxyz, as scalars and vectors."""
    scalar = p[:, 0] * q[:, 0] - np.sum(p[:, 1:] * q[:, 1:], axis=1)
    vector = p[:, :1] * q[:, 1:] + q[:, :1] * p[:, 1:] + np.cross(p[:, 1:], q[:, 1:])
    return np.concatenate([scalar[:, None], vector], axis=1)


def rotated(vectors, quarters):
    """Counter-clockwise by whole quarters, exactly."""
    vectors = np.array(vectors, np.float64)
    for _ in range(quarters % 4):
        vectors[:, 0], vectors[:, 1] = -vectors[:, 1], vectors[:, 0].copy()
    return vectors


# ---------------------------------------------------------------- what is seen


@pytest.mark.parametrize(("task", "size"), [(ANT_WALKER, 32), (ANT_BANDIT, 36), (ANT_MAZE, 34)])
def test_observations_have_the_papers_sizes(task, size):
    state, goal = random_state(3), jnp.array([[7.0, -7.0]] * 3)
    obs = observe_task(task, state, goal)
    assert obs.shape == (3, size) == (3, task.obs_size)
    np.testing.assert_array_equal(obs[:, :32], observe_task(ANT_WALKER, state, goal))
    if size > 32:
        np.testing.assert_array_equal(obs[:, 32:34], state.qpos[:, :2])
    if size > 34:
        np.testing.assert_array_equal(obs[:, 34:], goal)
    scaled = observe_task(replace(task, xy_scale=0.5), state, goal)
    np.testing.assert_allclose(scaled[:, 32:], 0.5 * obs[:, 32:])


ROLL, PITCH, YAW = (
    (lambda angle, axis=axis: {3: np.cos(angle / 2), 3 + axis: np.sin(angle / 2)}) for axis in (1, 2, 3)
)
# What is set in qpos, qvel and the feet of a standing ant, and the numbers that differ from those of one at rest.
SEEN = {
    "at rest": ({}, {}, {}, {}),
    "somewhere else": ({0: 3.0, 1: -4.0}, {}, {}, {}),
    "roll": (ROLL(0.4), {}, {}, {24: 0.4, 26: np.sin(0.4), 29: np.cos(0.4)}),
    "pitch": (PITCH(0.4), {}, {}, {25: 0.4, 27: np.sin(0.4), 30: np.cos(0.4)}),
    "yaw": (YAW(2.5), {}, {}, {28: np.sin(2.5), 31: np.cos(2.5)}),
    "height": ({2: HEAVY.reset_height + 0.2}, {}, {}, {20: 0.2}),
    "forward": ({}, {0: 2.0}, {}, {21: 0.6}),
    "sideways and down": ({}, {1: 2.0, 2: -1.0}, {}, {22: 0.6, 23: -0.3}),
    # the velocity's frame turns with the heading, and with nothing else
    "north, heading north": (YAW(np.pi / 2), {1: 2.0}, {}, {21: 0.6, 28: 1.0, 31: 0.0}),
    "east, nose down": (PITCH(0.4), {0: 2.0}, {}, {21: 0.6, 25: 0.4, 27: np.sin(0.4), 30: np.cos(0.4)}),
    "too fast": ({}, {0: 100.0, 6: -1e6}, {}, {21: 5.0, 1: -5.0}),
    **{f"joint {j} low": ({7 + j: LOW[j]}, {}, {}, {2 * j: -1.0}) for j in range(8)},
    **{f"joint {j} high": ({7 + j: HIGH[j]}, {}, {}, {2 * j: 1.0}) for j in range(8)},
    **{f"joint {j} fast": ({}, {6 + j: 7.0}, {}, {2 * j + 1: 0.7}) for j in range(8)},
    **{f"foot {f}": ({}, {}, {f: 1.0}, {16 + f: 1.0}) for f in range(4)},
}


@cache
def seen():
    """The observation of every case, by name."""
    arrays = standing(len(SEEN)), np.zeros((len(SEEN), 14)), np.zeros((len(SEEN), 4))
    for row, settings in enumerate(SEEN.values()):
        for array, setting in zip(arrays, settings[:3], strict=True):
            array[row, list(setting)] = list(setting.values())
    return dict(zip(SEEN, np.asarray(observe(state_of(*arrays), HEAVY)), strict=True))


@pytest.mark.parametrize("case", SEEN)
def test_each_number_stands_in_its_place(case):
    expected, differences = np.zeros(32), SEEN[case][3]
    expected[29:] = 1.0  # the cosines of no roll, no pitch, no yaw
    expected[list(differences)] = list(differences.values())
    np.testing.assert_allclose(seen()[case], expected, atol=1e-5)


# ---------------------------------------------------------------- a quarter turn changes nothing


def turn_world(state, quarters):
    """The state in a world turned about the origin: everything goes along, the ant too."""
    qpos, qvel = np.array(state.qpos, np.float64), np.array(state.qvel, np.float64)
    qpos[:, :2] = rotated(qpos[:, :2], quarters)
    qpos[:, 3:7] = product(about_z(np.full(len(qpos), quarters * np.pi / 2)), qpos[:, 3:7])
    qvel[:, :3] = rotated(qvel[:, :3], quarters)  # the angular velocity is in the torso's frame
    return state._replace(qpos=jnp.asarray(qpos, jnp.float32), qvel=jnp.asarray(qvel, jnp.float32))


def stepped(state, seed=9):
    """A state a control step later."""
    shift = np.random.default_rng(seed).uniform(-0.06, 0.06, (len(state.qpos), 2))
    return state._replace(qpos=state.qpos.at[:, :2].add(jnp.asarray(shift, jnp.float32)))


EVERY_TERM = RewardWeights(feet_collision=-1.0, flip=-1.0)


@pytest.mark.parametrize("quarters", [1, 2, 3])
@pytest.mark.parametrize("task", [ANT_WALKER, replace(ANT_BANDIT, weights=EVERY_TERM)], ids=lambda task: task.name)
def test_turning_world_and_goal_leaves_the_reward(task, quarters):
    before = random_state(64)
    now = stepped(before)
    goal = task.goals[np.arange(64) % 4]
    action = jax.random.uniform(jax.random.key(0), (64, 8), minval=-1.0)
    t = jnp.ones(64, jnp.int32)
    one = advance(task, before, action, now, jnp.asarray(goal), t)
    turned_goal = jnp.asarray(rotated(goal, quarters), jnp.float32)
    other = advance(task, turn_world(before, quarters), action, turn_world(now, quarters), turned_goal, t)
    for name, value in one.terms.items():
        np.testing.assert_allclose(other.terms[name], value, atol=1e-3, err_msg=name)
    np.testing.assert_array_equal(other.terminated, one.terminated)
    np.testing.assert_allclose(other.next_obs[:, :28], one.next_obs[:, :28], atol=1e-5)  # all but the heading


def test_turning_the_maze_leaves_the_geodesic_reward():
    arena = MAZES["u"]
    turned_arena = maze(["".join(row) for row in np.rot90([list(row) for row in arena.grid])], cell=arena.cell)
    np.testing.assert_allclose(turned_arena.goals, rotated(arena.goals, 1))
    task, turned_task = (replace(ANT_MAZE, arena=a, potential="geodesic") for a in (arena, turned_arena))
    way = np.array(
        [(-4.0, -4.0), (0.0, -4.0), (4.0, -4.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)]
    )  # over the cells' middles
    before, now = np.float32(way[:-1]), np.float32(way[1:])
    goal = jnp.zeros((len(now), 2))
    one = progress(task, jnp.asarray(before), jnp.asarray(now), goal)
    other = progress(turned_task, *(jnp.asarray(rotated(xy, 1), jnp.float32) for xy in (before, now)), goal)
    np.testing.assert_allclose(other * DT, one * DT, atol=0.02)
    assert np.all(one > 0)


def turn_ant(state, quarters):
    """The same ant in a frame turned by ``quarters``, built in coordinates of positions and velocities.

    World and torso are both relabelled: the orientation is turned from both sides, every
    vector goes back by as much, and leg k takes the place of its neighbour behind it.
    An ankle that bends downwards still bends downwards, with the sign of its new place.
    """
    qpos, qvel = np.array(state.qpos, np.float64), np.array(state.qvel, np.float64)
    half = np.full(len(qpos), quarters * np.pi / 2)
    qpos[:, :2] = rotated(qpos[:, :2], -quarters)
    qpos[:, 3:7] = product(product(about_z(-half), qpos[:, 3:7]), about_z(half))
    qvel[:, :3], qvel[:, 3:6] = rotated(qvel[:, :3], -quarters), rotated(qvel[:, 3:6], -quarters)
    qpos[:, 7:], qvel[:, 6:] = turn_joints(qpos[:, 7:], quarters), turn_joints(qvel[:, 6:], quarters)
    feet = [np.roll(np.asarray(flags), -quarters, axis=1) for flags in (state.foot_contact, state.foot_collision)]
    return state_of(qpos, qvel, *feet)


def turn_joints(values, quarters):
    downward = (1, -1, -1, 1)
    turned = np.empty_like(values)
    for leg in range(4):
        new = (leg - quarters) % 4
        turned[:, 2 * new] = values[:, 2 * leg]
        turned[:, 2 * new + 1] = downward[leg] * downward[new] * values[:, 2 * leg + 1]
    return turned


@pytest.mark.parametrize("flipped", [False, True])
def test_a_turned_ant_is_seen_as_the_turned_observation(flipped):
    state = random_state(64, flipped=flipped)
    obs = observe(state, HEAVY)
    for quarters in range(4):
        physical = observe(turn_ant(state, quarters), HEAVY)
        turned = turned_observation(obs, jnp.full(64, quarters))
        apart = np.abs(physical - turned)
        apart[:, 24] = np.minimum(apart[:, 24], 2 * np.pi - apart[:, 24])  # a roll of -180 is one of 180
        assert apart.max() < 2e-4


def test_four_turns_are_none_and_turns_are_undone():
    state = random_state(16)
    obs = jnp.concatenate([observe(state, HEAVY), jnp.ones((16, 2))], axis=1)
    action = jax.random.uniform(jax.random.key(0), (16, 8), minval=-1.0)
    one = jnp.ones(16, jnp.int32)
    seen, done = obs, action
    for _ in range(4):
        seen, done = turned_observation(seen, one), turned_action(done, one)
    np.testing.assert_allclose(seen, obs, atol=1e-5)
    np.testing.assert_array_equal(done, action)
    direction = jnp.arange(16) % 4
    np.testing.assert_array_equal(turned_action(turned_action(action, direction), -direction), action)
    back = turned_observation(turned_observation(obs, direction), -direction)
    np.testing.assert_allclose(back, obs, atol=1e-5)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_actions_turn_as_joints_do(quarters):
    action = jax.random.uniform(jax.random.key(0), (16, 8), minval=-1.0)
    turned = turned_action(action, jnp.full(16, quarters))
    np.testing.assert_array_equal(turned, turn_joints(np.asarray(action), quarters))


def test_the_engine_agrees_with_the_symmetry():
    """Four ants, each the first one turned once more, driven by turned actions, stay each other's turns."""
    physics = BatchPhysics(HEAVY, open_field(), 4, 1)
    generator = np.random.default_rng(5)
    first = state_of(standing(height=0.55), generator.uniform(-0.5, 0.5, (1, 14)))
    ants = jax.tree.map(lambda *rows: np.concatenate(rows), *(turn_ant(first, q) for q in range(4)))
    state = physics.reset(physics.initial(), np.ones(4, bool), ants.qpos, ants.qvel)
    touched = np.zeros(4)
    for action in generator.uniform(-1, 1, (30, 1, 8)):
        state = physics.step(state, np.concatenate([turn_joints(action, q) for q in range(4)]))
        one = jax.tree.map(lambda leaf: leaf[:1], state)
        for quarters in range(4):
            turned = turn_ant(one, quarters)
            np.testing.assert_allclose(state.qpos[quarters], turned.qpos[0], atol=2e-4)
            np.testing.assert_allclose(state.qvel[quarters], turned.qvel[0], atol=5e-3)
            np.testing.assert_array_equal(state.foot_contact[quarters], turned.foot_contact[0])
        touched += state.foot_contact[0]
    assert touched.any()


# ---------------------------------------------------------------- what is paid


def test_progress_towards_far_targets_is_accurate():
    """The target is 10 km away; a float32 distance would be off by 0.06 m/s."""
    generator = np.random.default_rng(0)
    before = np.float32(generator.uniform(-50, 50, (1000, 2)))
    now = np.float32(before + generator.uniform(-0.06, 0.06, (1000, 2)))
    goal = FAR_GOALS[np.arange(1000) % 4]
    exact = [np.linalg.norm(np.float64(goal) - np.float64(xy), axis=1) for xy in (before, now)]
    speed = progress_speed(jnp.asarray(before), jnp.asarray(now), jnp.asarray(goal), DT)
    np.testing.assert_allclose(speed, (exact[0] - exact[1]) / DT, atol=1e-3)


def test_progress_is_a_speed_in_the_goals_direction():
    before = jnp.zeros((4, 2))
    now = jnp.full((4, 2), jnp.array([0.02, 0.01]))
    speeds = np.asarray(progress_speed(before, now, jnp.asarray(FAR_GOALS), DT))
    metres = {name: speed * DT for name, speed in zip(DIRECTIONS, speeds, strict=True)}
    assert metres == pytest.approx({"right": 0.02, "up": 0.01, "left": -0.02, "down": -0.01}, abs=1e-5)


@pytest.mark.parametrize("potential", ["straight", "geodesic"])
def test_progress_adds_up_to_what_the_distance_lost(potential):
    task = replace(ANT_MAZE, potential=potential)
    way = np.array(shortest_path(task.arena))
    place = np.concatenate([np.linspace(a, b, 40) for a, b in pairwise(way)])
    before, now = jnp.asarray(place[:-1], jnp.float32), jnp.asarray(place[1:], jnp.float32)
    goal = jnp.broadcast_to(jnp.asarray(task.goals[0]), before.shape)
    covered = np.cumsum(progress(task, before, now, goal)) * DT
    length = np.linalg.norm(np.diff(way, axis=0), axis=1).sum()
    if potential == "straight":
        assert covered[-1] == pytest.approx(np.linalg.norm(way[0] - way[-1]), abs=1e-3)
        assert covered.min() < -1.0  # it pays for walking at the wall, and the way around it costs
    else:
        assert covered[-1] == pytest.approx(length, abs=0.1)
        assert np.diff(covered).min() > -1e-3
        field = geodesic_field(task.arena)
        np.testing.assert_allclose(covered, field.at(place[0]) - field.at(place[1:]), atol=1e-3)


def pay(task=ANT_WALKER, qpos=None, qvel=None, action=0.0, collision=None, shift=0.0):
    """The terms of one step of one ant that moves by ``shift`` along x."""
    qpos = standing() if qpos is None else qpos
    now = qpos + np.eye(15)[0] * shift
    actions, goal = jnp.full((1, 8), action), jnp.asarray(task.goals[:1])
    step = advance(task, state_of(qpos), actions, state_of(now, qvel, None, collision), goal, jnp.ones(1, jnp.int32))
    assert float(step.reward[0]) == pytest.approx(sum(float(value[0]) for value in step.terms.values()), abs=1e-5)
    return {name: float(value[0]) for name, value in step.terms.items() if abs(value[0]) > 1e-6}


def test_terms_by_hand():
    assert pay() == {"alive": 1.0}
    assert pay(shift=0.033) == pytest.approx({"alive": 1.0, "progress": 2.0}, abs=1e-4)
    assert pay(action=-0.5) == pytest.approx({"alive": 1.0, "stall_torque": -0.025})
    fast = np.zeros((1, 14))
    fast[0, 6:] = (10.0, -10.0) * 4
    assert pay(action=0.5, qvel=fast)["electricity"] == pytest.approx(-1.0)  # -2 x 0.5 x 0.1 x 10
    assert "electricity" not in pay(qvel=fast)
    stuck = standing()
    stuck[0, 7], stuck[0, 8], stuck[0, 10] = LOW[0], HIGH[1], LOW[3] - 0.1
    assert pay(qpos=stuck) == pytest.approx({"alive": 1.0, "joints_at_limit": -0.3})
    assert pay(collision=[[1, 0, 0, 1]]) == {"alive": 1.0, "feet_collision": -2.0}
    assert pay(qpos=standing(height=0.1)) == {"alive": -1.0}


def test_a_weight_scales_its_term_alone():
    hard = {"qvel": np.full((1, 14), 3.0), "action": 0.7, "collision": [[1, 1, 0, 0]], "shift": 0.01}
    qpos = upside_down()
    qpos[0, 7] = LOW[0]
    plain = pay(replace(ANT_WALKER, weights=EVERY_TERM), qpos=qpos, **hard)
    factor = {name: 2.0 + i for i, name in enumerate(plain)}
    weights = RewardWeights(**{name: factor[name] * getattr(EVERY_TERM, name) for name in factor})
    scaled = pay(replace(ANT_WALKER, weights=weights), qpos=qpos, **hard)
    assert set(scaled) == set(vars(weights)) - {"goal"}  # nobody arrives on a task without a goal radius
    assert scaled == pytest.approx({name: factor[name] * value for name, value in plain.items()})


# ---------------------------------------------------------------- when it ends


def upside_down(height=0.5):
    qpos = standing(height=height)
    qpos[:, 3:7] = 0.0, 1.0, 0.0, 0.0
    return qpos


def end(task, qpos, t=1, diverged=None):
    rows = len(qpos)
    now = state_of(qpos, diverged=diverged)
    goal = jnp.broadcast_to(jnp.asarray(task.goals[0]), (rows, 2))
    before = state_of(standing(rows, np.nan_to_num(qpos[:, :2])))
    return advance(task, before, jnp.zeros((rows, 8)), now, goal, jnp.full(rows, t, jnp.int32))


@pytest.mark.parametrize(
    ("rule", "ends"),
    [("height", [0, 1, 0, 1]), ("flip", [0, 0, 1, 1]), ("either", [0, 1, 1, 1]), ("none", [0, 0, 0, 0])],
)
def test_falls_are_counted_both_ways_and_end_as_the_rule_says(rule, ends):
    low = HEAVY.fall_height
    qpos = np.concatenate([standing(height=low + 0.01), standing(height=low), upside_down(), upside_down(low - 0.1)])
    step = end(replace(ANT_WALKER, fall_rule=rule), qpos)
    assert step.events["fallen"].tolist() == [False, True, False, True]
    assert step.events["flipped"].tolist() == [False, False, True, True]
    assert step.terminated.tolist() == [bool(x) for x in ends]
    assert step.terms["alive"].tolist() == [1.0, -1.0, 1.0, -1.0]
    assert not step.truncated.any()


@pytest.mark.parametrize("radius", [0.5, 2.0, None])
def test_the_episode_ends_inside_the_goal_radius(radius):
    distance = np.array([0.0, 0.49, 0.51, 1.99, 2.01])
    qpos = standing(5, np.array(ANT_BANDIT.arena.goals[0]) - np.stack([0.6 * distance, 0.8 * distance], axis=1))
    step = end(replace(ANT_BANDIT, goal_radius=radius), qpos)
    expected = distance <= radius if radius else np.zeros(5, bool)
    np.testing.assert_array_equal(step.terminated, expected)
    np.testing.assert_array_equal(step.events["reached"], expected)
    np.testing.assert_allclose(step.events["goal_distance"], distance, atol=1e-5)


def test_time_runs_out_where_nothing_else_ends_it():
    task = replace(ANT_WALKER, episode_steps=7)
    qpos = np.concatenate([standing(), standing(height=0.1)])
    assert not end(task, qpos, t=6).truncated.any()
    step = end(task, qpos, t=7)
    assert step.truncated.tolist() == [True, False]
    assert step.terminated.tolist() == [False, True]


@pytest.mark.parametrize("task", [ANT_WALKER, replace(ANT_MAZE, fall_rule="none")], ids=lambda task: task.name)
def test_a_diverged_row_ends_is_counted_and_poisons_nothing(task):
    qpos = standing(3, task.arena.start)
    healthy = end(task, qpos)
    qpos[1] = np.nan
    step = end(task, qpos, diverged=[False, True, False])
    assert step.terminated.tolist() == step.events["diverged"].tolist() == [False, True, False]
    assert step.valid.tolist() == [True, False, True]
    assert not step.truncated.any()
    for leaf, kept in zip(jax.tree.leaves(step), jax.tree.leaves(healthy), strict=True):
        assert np.isfinite(leaf).all()
        np.testing.assert_array_equal(np.asarray(leaf)[[0, 2]], np.asarray(kept)[[0, 2]])


# ---------------------------------------------------------------- starts, and bad fields


def test_episodes_start_at_rest_around_the_start():
    arena = replace(MAZES["u"], start_noise=0.5)
    qpos, qvel = reset_pose(replace(ANT_MAZE, arena=arena), jax.random.key(0), 200)
    offset = np.asarray(qpos[:, :2]) - arena.start
    assert 0.4 < np.abs(offset).max() <= 0.5 + 1e-5
    np.testing.assert_allclose(qpos[:, 2], HEAVY.reset_height)
    np.testing.assert_array_equal(qpos[:, 3:7], np.tile([1.0, 0.0, 0.0, 0.0], (200, 1)))
    noise = np.asarray(qpos[:, 7:]) - HEAVY.reset_joints()
    assert 0.09 < np.abs(noise).max() <= HEAVY.reset_joint_noise + 1e-6
    assert not np.any(qvel)
    again, _ = reset_pose(ANT_MAZE, jax.random.key(0), 200)
    np.testing.assert_allclose(again[:, :2], np.tile(ANT_MAZE.arena.start, (200, 1)))
    np.testing.assert_array_equal(again[:, 7:], qpos[:, 7:])  # the same key, the same joints


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"episode_steps": 0}, r"episode_steps must be >= 1 and < 2\*\*31, got 0"),
        ({"episode_steps": 2**31}, r"episode_steps must be >= 1 and < 2\*\*31, got 2147483648"),
        ({"fall_rule": "knee"}, "fall_rule must be height, flip, either or none, got 'knee'"),
        ({"potential": "magic"}, "potential must be straight or geodesic, got 'magic'"),
        ({"goal_radius": 0.0}, "goal_radius must be > 0, got 0.0"),
        ({"goal_radius": float("nan")}, "goal_radius must be > 0, got nan"),
        ({"potential": "geodesic"}, "a geodesic potential needs one goal, open_field has 4"),
    ],
)
def test_bad_fields_of_a_task_are_refused(change, message):
    task = object.__new__(Task)  # without the constructor, whose types are checked in tests and nowhere else
    vars(task).update(vars(ANT_WALKER) | change)
    with pytest.raises(ValueError, match=f"^{message}$"):
        task.__post_init__()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"density": 0.0}, "density must be > 0, got 0.0"),
        ({"substeps": 0}, "substeps must be > 0, got 0"),
        ({"control_dt": float("nan")}, "control_dt must be > 0, got nan"),
        ({"friction": -0.1}, "friction must be >= 0, got -0.1"),
        ({"hip_range_deg": (10.0, 10.0)}, r"hip_range_deg must rise, got 10.0\.\.10.0"),
        ({"integrator": "RK4"}, "integrator must be Euler or implicitfast, got 'RK4'"),
    ],
)
def test_bad_fields_of_a_robot_are_refused(change, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        replace(HEAVY, **change)


def test_the_papers_weights():
    weights = WALKER_WEIGHTS
    assert (weights.progress, weights.alive, weights.electricity, weights.stall_torque) == (1.0, 1.0, -2.0, -0.1)
    assert (weights.joints_at_limit, weights.feet_collision) == (-0.1, -1.0)
