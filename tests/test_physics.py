"""Laws of the MuJoCo engine: the model is the row of the table, rows are independent, nothing depends on threads."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from footwork.arena import MAZES, inside_walls, open_field
from footwork.physics import physics_for
from footwork.physics.batch import BatchPhysics
from footwork.physics.mjcf import build_model
from footwork.robot import JOINT_NAMES, ROBOTS
from footwork.study.experiments import find_row
from footwork.study.runs import train_row
from footwork.types import PhysicsState

HEAVY = ROBOTS["heavy"]
N = 6
STANDING = {"ankle_1": 60, "ankle_2": -60, "ankle_3": -60, "ankle_4": 60}


def fresh(num_envs=N, threads=1, robot=HEAVY, arena=None):
    physics = BatchPhysics(robot, arena or open_field(), num_envs, threads)
    return physics, physics.initial()


def place(physics, state, qpos, qvel=None):
    everyone = np.ones(physics.num_envs, bool)
    qvel = np.zeros((physics.num_envs, 14)) if qvel is None else qvel
    return physics.reset(state, everyone, qpos, qvel)


def pose(height=0.75, joints=None, num_envs=1):
    """Upright ants with the joints named in ``joints`` at the given degrees."""
    qpos = np.zeros((num_envs, 15))
    qpos[:, 2:4] = height, 1.0
    for name, angle in (joints or {}).items():
        qpos[:, 7 + JOINT_NAMES.index(name)] = np.radians(angle)
    return qpos


def drive(physics, state, num_steps, seed=0, active=None):
    generator = np.random.default_rng(seed)
    states = []
    for _ in range(num_steps):
        state = physics.step(state, generator.uniform(-1, 1, (physics.num_envs, 8)), active)
        states.append(state)
    return states


def rows(state, index):
    """Those rows of a state, without the engine's own."""
    return PhysicsState(*(np.asarray(leaf)[index] for leaf in state[:-1]))


def assert_same(one, other):
    for name, a, b in zip(PhysicsState._fields[:-1], one[:5], other[:5], strict=True):
        np.testing.assert_array_equal(a, b, err_msg=name)


@pytest.fixture
def logless(tmp_path, monkeypatch):
    """MuJoCo writes its warnings into the working directory."""
    monkeypatch.chdir(tmp_path)


# ---------------------------------------------------------------- the model


@cache
def model_of(name):
    return build_model(ROBOTS[name], open_field())


# FACTS.md, section 1.2: what PyBullet and Gymnasium load.
@pytest.mark.parametrize(("name", "mass"), [("heavy", 182.18), ("stiff", 182.18), ("light", 0.911)])
def test_the_ants_weigh_what_they_weigh(name, mass):
    assert model_of(name).body_mass.sum() == pytest.approx(mass, rel=1e-3)


def test_the_heavy_ants_parts_weigh_what_bullets_do():
    model = model_of("heavy")
    assert [model.body(f"shin_{leg}").mass[0] for leg in (1, 2, 3, 4)] == pytest.approx([13.518] * 4, rel=1e-3)
    assert [model.body(f"thigh_{leg}").mass[0] for leg in (1, 2, 3, 4)] == pytest.approx([7.832] * 4, rel=1e-3)


@pytest.mark.parametrize(
    ("name", "torque", "hip", "ankle"),
    [("heavy", 250.0, (-40.0, 40.0), (30.0, 100.0)), ("light", 150.0, (-30.0, 30.0), (30.0, 70.0))],
)
def test_torques_and_limits_are_the_papers(name, torque, hip, ankle):
    model, mirrored = model_of(name), (-ankle[1], -ankle[0])
    degrees = [tuple(np.degrees(model.joint(joint).range)) for joint in JOINT_NAMES]
    expected = [hip, ankle, hip, mirrored, hip, mirrored, hip, ankle]
    np.testing.assert_allclose(degrees, expected, atol=1e-4)
    np.testing.assert_allclose(ROBOTS[name].joint_limits(), np.radians(expected), atol=1e-6)
    gear = {joint: model.actuator(joint).gear[0] for joint in JOINT_NAMES}
    assert {gear[joint] for joint in JOINT_NAMES if joint.startswith("hip")} == {torque}
    assert all(gear[joint] == ROBOTS[name].ankle_torque <= torque for joint in JOINT_NAMES if joint.startswith("ankle"))
    np.testing.assert_array_equal(model.actuator_ctrlrange, [[-1.0, 1.0]] * 8)


def test_an_action_turns_the_joint_it_is_named_for():
    physics, state = fresh(8)
    state = place(physics, state, pose(2.0, {"ankle_1": 60, "ankle_2": -60, "ankle_3": -60, "ankle_4": 60}, 8))
    after = physics.step(state, np.eye(8))
    moved = after.qpos[:, 7:]
    assert (np.argmax(after.qvel[:, 6:], axis=1) == np.arange(8)).all()
    assert (np.diag(moved - state.qpos[:, 7:]) > 0).all()


def test_one_step_takes_the_control_time():
    physics, state = fresh(1)
    state = place(physics, state, pose(5.0, STANDING))
    for _ in range(20):
        state = physics.step(state, np.zeros((1, 8)))
    seconds = 20 * 0.0165
    assert state.qvel[0, 2] == pytest.approx(-9.8 * seconds, rel=1e-3)  # nothing but gravity acts on a limp, bent ant
    assert 5.0 - state.qpos[0, 2] == pytest.approx(9.8 * seconds**2 / 2, rel=0.03)
    assert physics.control_dt == 0.0165


# ---------------------------------------------------------------- many simulations


def test_threads_change_no_bit():
    ends = []
    for threads in (1, 2):
        physics, state = fresh(N, threads)
        ends.append((drive(physics, state, 100)[-1], physics.snapshot()))
    assert_same(ends[0][0], ends[1][0])
    for name, array in ends[0][1].items():
        np.testing.assert_array_equal(array, ends[1][1][name], err_msg=name)


def test_a_reset_touches_only_its_rows():
    physics, state = fresh()
    state = drive(physics, state, 20)[-1]
    before = physics.snapshot()
    mask = np.array([False, True, False, False, True, False])
    qpos, qvel = np.full((N, 15), np.nan), np.full((N, 14), np.nan)
    qpos[mask], qvel[mask] = pose(1.0), 0.5
    after = physics.reset(state, mask, qpos, qvel)
    assert_same(rows(after, ~mask), rows(state, ~mask))
    np.testing.assert_array_equal(after.qpos[mask], np.float32(qpos[mask]))
    np.testing.assert_array_equal(after.qvel[mask], np.float32(qvel[mask]))
    for name, array in physics.snapshot().items():
        np.testing.assert_array_equal(array[~mask], before[name][~mask], err_msg=name)


def test_what_went_before_a_reset_is_forgotten():
    physics, state = fresh()
    used = drive(physics, state, 30)[-1]
    physics_2, state_2 = fresh()
    again, first = (place(p, s, pose(0.6, {"ankle_1": 50}, N)) for p, s in ((physics, used), (physics_2, state_2)))
    for one, other in zip(drive(physics, again, 10), drive(physics_2, first, 10), strict=True):
        assert_same(one, other)


def test_held_rows_are_not_stepped():
    physics, state = fresh()
    state = drive(physics, state, 25)[-1]
    assert state.foot_contact.any()
    before = physics.snapshot()["state"]
    active = np.array([True, False, True, False, False, True])
    later = drive(physics, state, 5, active=active)
    for step in later:
        assert_same(rows(step, ~active), rows(state, ~active))
    motion = slice(0, 1 + 15 + 14)  # a simulation's row starts with the time, positions and velocities
    np.testing.assert_array_equal(physics.snapshot()["state"][~active, motion], before[~active, motion])
    physics_2, state_2 = fresh()
    alone = drive(physics_2, drive(physics_2, state_2, 25)[-1], 5)[-1]
    assert_same(rows(later[-1], active), rows(alone, active))  # the others went on as if nothing were held
    with_none = physics.step(later[-1], np.zeros((N, 8)), np.zeros(N, bool))
    assert_same(with_none, later[-1])


def test_a_held_row_is_not_judged_by_its_action():
    physics, state = fresh(2)
    after = physics.step(state, np.array([[0.0] * 8, [np.nan] * 8]), np.array([True, False]))
    assert not after.diverged.any()


def test_permuted_rows_are_permuted_simulations():
    order = np.random.default_rng(3).permutation(N)
    physics, state = fresh()
    physics_2, state_2 = fresh()
    state, state_2 = (drive(p, s, 10)[-1] for p, s in ((physics, state), (physics_2, state_2)))
    permuted = PhysicsState(*(leaf[order] for leaf in state))
    actions = np.random.default_rng(4).uniform(-1, 1, (20, N, 8))
    for action in actions:
        active = action[:, 0] < 0.5
        state_2 = physics_2.step(state_2, action, active)
        permuted = physics.step(permuted, action[order], active[order])
        assert_same(permuted, rows(state_2, order))
    mask = np.arange(N) < 2
    reset = physics.reset(permuted, mask[order], pose(1.0, num_envs=N), np.zeros((N, 14)))
    assert_same(reset, rows(place_some(physics_2, state_2, mask), order))


def place_some(physics, state, mask):
    return physics.reset(state, mask, pose(1.0, num_envs=N), np.zeros((N, 14)))


def test_a_snapshot_goes_on_bit_for_bit():
    physics, state = fresh()
    state = drive(physics, state, 30)[-1]
    kept, kept_state = physics.snapshot(), state
    first = drive(physics, state, 20, seed=7)
    other, _ = fresh()
    other.restore(kept)
    for one, two in zip(first, drive(other, kept_state, 20, seed=7), strict=True):
        assert_same(one, two)
    physics.restore(kept)  # and in place, after other things happened
    assert_same(drive(physics, kept_state, 20, seed=7)[-1], first[-1])


# ---------------------------------------------------------------- divergence


def spoil(physics, column, value):
    """Write into the state of simulation 1, as a simulation that goes wrong would."""
    engine = physics.snapshot()
    engine["state"][1, column] = value
    physics.restore(engine)


@pytest.mark.parametrize("how", ["position", "speed", "action", "reset"])
def test_a_diverged_row_is_reported_until_it_is_reset(logless, how):
    physics, state = fresh(3)
    qvel, action = np.zeros((3, 14)), np.zeros((3, 8))
    if how == "reset":
        qvel[1, 3] = np.nan
    state = place(physics, state, pose(num_envs=3), qvel)
    if how == "position":
        spoil(physics, 1 + 2, np.nan)  # a row starts with the time, then come positions and velocities
    elif how == "speed":
        spoil(physics, 1 + 15 + 3, 1e15)
    elif how == "action":
        action[1, 2] = np.inf
    state = physics.step(state, action)
    assert state.diverged.tolist() == [False, True, False]
    state = drive(physics, state, 3)[-1]
    assert state.diverged.tolist() == [False, True, False]
    healthy, untouched = fresh(3)
    untouched = place(healthy, untouched, pose(num_envs=3))
    untouched = drive(healthy, healthy.step(untouched, np.zeros((3, 8))), 3)[-1]
    assert_same(rows(state, [0, 2]), rows(untouched, [0, 2]))
    kept = physics.snapshot()
    other, _ = fresh(3)
    other.restore(kept)
    assert other.step(state, np.zeros((3, 8)), np.zeros(3, bool)).diverged.tolist() == [False, True, False]
    state = physics.reset(state, state.diverged, pose(num_envs=3), np.zeros((3, 14)))
    assert not state.diverged.any()
    state = drive(physics, state, 10)[-1]
    assert not state.diverged.any()
    assert np.isfinite(state.qpos).all()


def test_engines_are_known_by_name_and_a_missing_one_names_its_extra(tmp_path, monkeypatch):
    assert isinstance(physics_for("mujoco", HEAVY, open_field(), 1), BatchPhysics)
    with pytest.raises(ValueError, match="unknown engine 'ode'; known engines: mujoco, mjx, bullet, bullet-original"):
        physics_for("ode", HEAVY, open_field(), 1)
    monkeypatch.setattr("footwork.physics.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"^engine bullet needs an extra: pip install 'footwork\[bullet\]'$"):
        physics_for("bullet", HEAVY, open_field(), 1)
    with pytest.raises(ImportError, match="extra"):
        train_row(find_row("bullet/walker/plain"), (0,), tmp_path)
    assert not list(tmp_path.iterdir())  # a refusal leaves nothing behind


def test_bad_sizes_are_refused():
    with pytest.raises(ValueError, match="num_envs must be >= 1, got 0"):
        BatchPhysics(HEAVY, open_field(), 0)


# ---------------------------------------------------------------- contacts and walls

ON_TOES = 0.08 + 0.4 * np.sqrt(2) * np.sin(np.radians(60))  # m, height of a torso whose bent shins just reach the floor


def flags(height, joints):
    physics, state = fresh(1)
    state = place(physics, state, pose(height, joints))
    return state.foot_contact[0].tolist(), state.foot_collision[0].tolist()


def test_feet_on_the_floor_and_above_it():
    assert flags(ON_TOES - 0.01, STANDING) == ([1, 1, 1, 1], [0, 0, 0, 0])
    assert flags(ON_TOES + 0.05, STANDING) == ([0, 0, 0, 0], [0, 0, 0, 0])


@pytest.mark.parametrize("leg", [1, 2, 3, 4])
def test_a_lifted_foot_is_known_by_its_number(leg):
    lifted = {**STANDING, f"ankle_{leg}": STANDING[f"ankle_{leg}"] / 2}
    contact, _ = flags(ON_TOES - 0.01, lifted)
    assert contact == [float(foot != leg) for foot in (1, 2, 3, 4)]


@pytest.mark.parametrize(("left", "right"), [(1, 2), (2, 3), (3, 4), (4, 1)])
def test_crossed_feet_collide_and_only_they(left, right):
    """Neighbouring legs turned towards each other; legs are numbered counter-clockwise."""
    contact, collision = flags(2.0, {f"hip_{left}": 70, f"hip_{right}": -70})
    assert contact == [0, 0, 0, 0]
    assert collision == [float(foot in (left, right)) for foot in (1, 2, 3, 4)]


def test_flags_follow_the_motion():
    physics, state = fresh(1)
    state = place(physics, state, pose(1.0, STANDING))
    states = drive(physics, state, 60)
    contact = np.array([s.foot_contact[0] for s in states])
    assert not contact[:3].any()
    assert contact[-20:].any()


def test_walls_hold():
    """Ants thrown at the walls of a maze from every free cell stay among its free cells."""
    arena = MAZES["u"]
    half = (len(arena.grid[0]) * arena.cell / 2, len(arena.grid) * arena.cell / 2)
    centres = [
        ((j + 0.5) * arena.cell - half[0], half[1] - (i + 0.5) * arena.cell)
        for i, row in enumerate(arena.grid)
        for j, letter in enumerate(row)
        if letter != "#"
    ]
    generator = np.random.default_rng(0)
    num_envs = 3 * len(centres)
    physics, state = fresh(num_envs, arena=arena)
    qpos, qvel = pose(0.75, STANDING, num_envs), np.zeros((num_envs, 14))
    qpos[:, :2] = np.tile(centres, (3, 1))
    angle = generator.uniform(0, 2 * np.pi, num_envs)
    qvel[:, :2] = np.repeat((4.0, 6.0, 8.0), len(centres))[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    state = place(physics, state, qpos, qvel)
    farthest = np.zeros(num_envs)
    states = drive(physics, state, 300)
    for step in states:
        xy = step.qpos[:, :2]
        assert not inside_walls(arena, xy).any()
        assert (np.abs(xy) < half).all()
        farthest = np.maximum(farthest, np.abs(xy - qpos[:, :2]).max(axis=1))
    assert not states[-1].diverged.any()
    assert (farthest > arena.cell / 2 - 1.0).mean() > 0.5  # most of them did come near a wall
