"""PyBullet behind the Physics protocol: the contract with pybullet_envs' AntBulletEnv-v0, and the laws of an engine.

Needs the extra footwork[bullet]; the contract needs pybullet_envs_gymnasium too.
"""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from footwork import train as training
from footwork.arena import MAZES, Arena, inside_walls, open_field
from footwork.env import Env
from footwork.evaluate import random_switching
from footwork.options import SubPolicies
from footwork.record import RunDir, RunError, read_metrics
from footwork.robot import ROBOTS
from footwork.rotations import quaternion_to_matrix
from footwork.study.experiments import ANT_WALKER, EXPERIMENTS, find_row, with_engine, with_robot
from footwork.study.runs import find_trained, train_row
from footwork.train import Interrupted, build_environment
from footwork.types import PhysicsState
from test_physics import HEAVY, ON_TOES, STANDING, assert_same, drive, place, pose, rows
from test_train import tiny, untrained

pytest.importorskip("pybullet", reason="pybullet is not installed: pip install 'footwork[bullet]'")

from footwork.physics.bullet import BulletPhysics, OriginalEnvPhysics

N = 4


@pytest.fixture
def bullet():
    """Makes engines and their first states, and ends their processes."""
    made = []

    def make(num_envs=N, workers=1, arena=None, **options):
        made.append(BulletPhysics(HEAVY, arena or open_field(), num_envs, workers, **options))
        return made[-1], made[-1].initial()

    yield make
    for physics in made:
        physics.close()


# ---------------------------------------------------------------- the contract with the original

TRANSITIONS = 10_000
# The original's target is 1 km away, and it leaves out the penalty for colliding feet.
ORIGINAL_TASK = replace(
    ANT_WALKER,
    arena=Arena("kilometre", (0.0, 0.0), ((1000.0, 0.0),)),
    weights=replace(ANT_WALKER.weights, feet_collision=0.0),
)
OURS = {"joints": slice(0, 16), "feet": slice(16, 20), "height": slice(20, 21), "velocity": slice(21, 24)}
OURS |= {"tilt": slice(24, 26), "sine": slice(26, 29), "cosine": slice(29, 32)}
THEIRS = {"joints": slice(8, 24), "feet": slice(24, 28), "height": slice(0, 1), "velocity": slice(3, 6)}


class Original:
    """One AntBulletEnv-v0, and what its robot knows beyond the observation."""

    def __init__(self):
        pytest.importorskip("pybullet_envs_gymnasium", reason="pip install pybullet_envs_gymnasium==0.6.0 to compare")
        import gymnasium

        self.env = gymnasium.make("AntBulletEnv-v0").unwrapped

    def reset(self, seed):
        obs, _ = self.env.reset(seed=seed)
        return self._seen(obs, [0.0] * 5)

    def joints(self):
        return [joint.get_state()[0] for joint in self.env.robot.ordered_joints]

    def step(self, action):
        obs, _, done, _, _ = self.env.step(action)
        return self._seen(obs, self.env.rewards), done

    def _seen(self, obs, rewards):
        robot = self.env.robot
        tilt = np.array(robot.body_rpy)
        return {
            **{name: obs[part] for name, part in THEIRS.items()},
            "tilt": obs[6:8],
            "sine": np.sin(tilt),
            "cosine": np.cos(tilt),
            "rewards": np.array(rewards),
            "position": np.array(robot.body_xyz),
        }


class Played(NamedTuple):
    """Transitions of both, side by side; leading axis the transition."""

    before: PhysicsState
    action: np.ndarray
    now: PhysicsState
    theirs: dict[str, np.ndarray]  # after the step
    start: np.ndarray  # their position before the step, where an episode begins; else NaN
    episode: np.ndarray  # of its environment


@cache
def played() -> Played:
    """Two AntBulletEnvs and two ants of ours in lockstep: the same starts, the same actions.

    One is driven by torques drawn at random, in and out of range, and held for a while, or falls without any; the
    other by the packaged walker to the right, so that there are running ants and not only struggling ones.
    """
    originals = [Original(), Original()]
    physics = OriginalEnvPhysics(HEAVY, open_field(), 2, 1)
    state, generator = physics.initial(), np.random.default_rng(0)
    done, episode, age = np.ones(2, bool), np.full(2, -1), np.zeros(2)
    torque, records = np.zeros(8), []
    for t in range(TRANSITIONS // 2):
        age, episode = np.where(done, 0, age + 1), episode + done
        qpos, start = pose(HEAVY.reset_height, num_envs=2), np.full((2, 3), np.nan)
        for row in np.flatnonzero(done):
            start[row] = originals[row].reset(seed=int(1000 * row + episode[row]))["position"]
            qpos[row, 7:] = originals[row].joints()
        state = physics.reset(state, done, qpos, np.zeros((2, 14)))
        if generator.random() < 0.1:
            torque = generator.uniform(-1.3, 1.3, 8).astype(np.float32) * (episode[0] % 3 == 0)
        action = np.stack([torque, walk(state, jax.random.key(t))])
        before = physics.read(state.engine, np.float64)
        state = physics.step(state, action)
        theirs, fallen = zip(*(o.step(a) for o, a in zip(originals, action, strict=True)), strict=True)
        records.append((before, action, physics.read(state.engine, np.float64), theirs, start, episode))
        done = np.array(fallen) | (age >= 999)  # Gymnasium truncates after 1000 steps
    physics.close()
    before, actions, now, theirs, starts, episodes = zip(*records, strict=True)
    return Played(
        stacked(before),
        np.concatenate(actions),
        stacked(now),
        {name: np.stack([row[name] for step in theirs for row in step]) for name in theirs[0][0]},
        np.concatenate(starts),
        np.concatenate(episodes),
    )


@cache
def walker():
    return find_trained("walker/plain", Path("nowhere")).sub_policies()


def walk(state, key):
    """The action of the last row."""
    return _act(state, walker().params, key)


@jax.jit
def _act(state, params, key):
    obs = ORIGINAL_TASK.observe(state, jnp.zeros((state.qpos.shape[0], 2)))
    return SubPolicies(walker().policy, params).act(obs[-1:], jnp.zeros(1, int), key)[0]


def stacked(states):
    return PhysicsState(*(np.concatenate(leaves) for leaves in zip(*states, strict=True)))


@cache
def ours(exact):
    """What the task makes of the played states: in double precision, or in the float32 of every training."""
    transitions = played()
    dtype = np.float64 if exact else np.float32
    with jax.enable_x64(exact):
        convert = lambda leaf: jnp.asarray(leaf, dtype if leaf.dtype.kind == "f" else leaf.dtype)  # noqa: E731
        before, now = (jax.tree.map(convert, states) for states in (transitions.before, transitions.now))
        size = len(transitions.action)
        goal = jnp.broadcast_to(convert(ORIGINAL_TASK.goals), (size, 2))
        step = ORIGINAL_TASK.advance(before, convert(transitions.action), now, goal, jnp.ones(size, jnp.int32))
        return jax.tree.map(np.asarray, step)


def float32_of_a_position():
    """m/s that rounding two positions to float32 may add to a progress: 2e-4 at 40 m."""
    return np.spacing(np.abs(played().now.qpos[:, 0]).astype(np.float32)).astype(float) / HEAVY.control_dt


def test_both_go_the_same_way():
    """Same starts and actions, same states: not nearly, but to the rounding of a mean over 22 parts."""
    transitions = played()
    assert len(transitions.action) >= TRANSITIONS
    assert transitions.episode.max() >= 5
    assert transitions.now.qpos[:, 0].max() > 10.0  # somebody runs
    np.testing.assert_allclose(transitions.now.qpos[:, :3], transitions.theirs["position"], rtol=0, atol=1e-12)


@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize("part", ["joints", "height", "velocity", "feet", "tilt", "sine", "cosine"])
def test_the_observation_is_the_originals(part, exact):
    got, wanted = ours(exact).obs[:, OURS[part]], played().theirs[part]
    print(f"{part}: {np.abs(got - wanted).max():.1e}")
    np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-5)
    if part == "feet":
        np.testing.assert_array_equal(got, wanted)
        assert 0.1 < wanted.mean() < 0.95


@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize(
    ("place_of_it", "names"),
    [(0, ["alive"]), (1, ["progress"]), (2, ["electricity", "stall_torque"]), (3, ["joints_at_limit"])],
)
def test_each_reward_term_is_the_originals(place_of_it, names, exact):
    got, wanted = sum(ours(exact).terms[name] for name in names), played().theirs["rewards"][:, place_of_it]
    print(f"{names}: {np.abs(got - wanted).max():.1e}")
    allowed = 1e-5 + (float32_of_a_position() if names == ["progress"] and not exact else 0.0)
    assert (np.abs(got - wanted) <= allowed).all(), np.abs(got - wanted).max()


def test_an_episode_ends_where_the_originals_does():
    fell = played().theirs["rewards"][:, 0] < 0
    np.testing.assert_array_equal(ours(False).terminated, fell)
    assert fell.sum() >= 5


def test_the_originals_colliding_feet_cost_nothing():
    assert (played().theirs["rewards"][:, 4] == 0.0).all()


def test_a_fresh_environment_counts_21_parts_and_a_used_one_22():
    transitions = played()
    first = np.isfinite(transitions.start[:, 0])
    np.testing.assert_allclose(transitions.before.qpos[first, :3], transitions.start[first], rtol=0, atol=1e-12)
    assert set(transitions.episode[first]) >= {0, 1, 2}


def test_the_peculiarities_are_off_unless_asked_for(bullet):
    """Torso instead of parts, contacts of now instead of those of the step before; the rest is the same."""
    (plain, one), (odd, other) = bullet(), bullet(original_env=True)
    one, other = (place(p, s, pose(0.62, STANDING, N)) for p, s in ((plain, one), (odd, other)))
    assert (one.qpos[:, :2] == 0).all()
    steps, odd_steps = drive(plain, one, 40), drive(odd, other, 40)
    for then, now, seen in zip(steps[:-1], steps[1:], odd_steps[1:], strict=True):
        np.testing.assert_array_equal(seen.qpos[:, 2:], now.qpos[:, 2:])
        np.testing.assert_array_equal(seen.qvel, now.qvel)
        np.testing.assert_array_equal(seen.foot_contact, then.foot_contact)
    assert any((a.foot_contact != b.foot_contact).any() for a, b in zip(steps, odd_steps, strict=True))
    away = place(odd, odd_steps[-1], pose(0.75, STANDING, N) + np.eye(15)[0] * 100.0)
    assert away.qpos[:, 0] == pytest.approx([100.0 * 21 / 22] * N, abs=0.1)  # FACTS: teleported to x = 100, 95.46


def test_progress_counts_from_where_the_engine_sees_a_fresh_ant():
    """The first step of an episode, through the environment that every training uses."""
    env = Env(ORIGINAL_TASK, OriginalEnvPhysics(HEAVY, open_field(), N, 1))
    key = jax.random.key(0)
    state, _ = env.initial(key)
    after, first = jax.jit(env.finish)(env.simulate(env.begin(state, jnp.zeros((N, 8)), key), key), key)
    seen = np.asarray(after.physics.qpos - after.previous.qpos)[:, 0] / HEAVY.control_dt
    np.testing.assert_allclose(first.terms["progress"], seen, atol=1e-4)
    assert np.abs(first.terms["progress"]).max() < 1.0
    assert (np.abs(after.previous.qpos[:, :2]) > 1e-5).any()  # not the torso's, which is at 0
    env.physics.close()


# ---------------------------------------------------------------- the ant and its world


def test_an_action_turns_the_joint_it_is_named_for(bullet):
    physics, state = bullet(8)
    state = place(physics, state, pose(2.0, STANDING, 8))
    after = physics.step(state, np.eye(8))
    assert (np.argmax(after.qvel[:, 6:], axis=1) == np.arange(8)).all()
    assert (np.diag(after.qpos[:, 7:] - state.qpos[:, 7:]) > 0).all()


def test_what_is_placed_is_what_is_read(bullet):
    physics, state = bullet(1)
    generator = np.random.default_rng(0)
    qpos, qvel = generator.uniform(-0.5, 0.5, (1, 15)), generator.uniform(-1, 1, (1, 14))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7])
    state = place(physics, state, qpos, qvel)
    turned = np.where(np.dot(state.qpos[0, 3:7], qpos[0, 3:7]) < 0, -1.0, 1.0)  # q and -q turn alike
    state.qpos[0, 3:7] *= turned
    np.testing.assert_allclose(state.qpos, qpos, atol=1e-6)
    np.testing.assert_allclose(state.qvel, qvel, atol=1e-6)


def test_spin_is_in_the_torsos_frame(bullet):
    """An ant pitched by 90 degrees and spinning about its own z axis turns about the world's x axis."""
    physics, state = bullet(1)
    qpos, qvel = pose(5.0, STANDING), np.zeros((1, 14))
    qpos[0, 3:7] = np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0
    qvel[0, 5] = 2.0
    state = place(physics, state, qpos, qvel)
    np.testing.assert_allclose(state.qvel[0, 3:6], [0, 0, 2], atol=1e-5)
    before = quaternion_to_matrix(jnp.asarray(state.qpos[:, 3:7]))
    state = physics.step(state, np.zeros((1, 8)))
    turn = np.asarray(quaternion_to_matrix(jnp.asarray(state.qpos[:, 3:7])) @ jnp.swapaxes(before, 1, 2))[0]
    assert turn[2, 1] == pytest.approx(2.0 * 0.0165, rel=0.05)  # sine of the angle about x
    assert abs(turn[0, 2]) + abs(turn[1, 0]) < 0.003


def test_one_step_takes_the_control_time(bullet):
    physics, state = bullet(1)
    state = place(physics, state, pose(5.0, STANDING))
    for _ in range(20):
        state = physics.step(state, np.zeros((1, 8)))
    assert state.qvel[0, 2] == pytest.approx(-9.8 * 20 * 0.0165, rel=0.03)  # Bullet damps every motion


@pytest.mark.parametrize("leg", [1, 2, 3, 4])
def test_a_lifted_foot_is_known_by_its_number(bullet, leg):
    physics, state = bullet(1)
    lifted = {**STANDING, f"ankle_{leg}": STANDING[f"ankle_{leg}"] / 2}
    state = physics.step(place(physics, state, pose(ON_TOES + 0.01, lifted)), np.zeros((1, 8)))
    assert state.foot_contact[0].tolist() == [float(foot != leg) for foot in (1, 2, 3, 4)]


def test_bullets_ant_passes_through_itself(bullet):
    """So the feet's flags are always zero there. In MuJoCo these collide: test_physics.py."""
    physics, state = bullet(1)
    crossed = pose(2.0, {"hip_1": 70, "hip_2": -70})
    state = physics.step(place(physics, state, crossed), np.zeros((1, 8)))
    np.testing.assert_allclose(state.qpos[0, 7:], crossed[0, 7:], atol=1e-3)
    assert not state.foot_collision.any()


def test_walls_hold(bullet):
    """Ants thrown at the walls of a maze stay among its free cells."""
    arena = MAZES["u"]
    generator, num_envs = np.random.default_rng(0), 6
    physics, state = bullet(num_envs, 2, arena)
    qpos, qvel = pose(0.75, STANDING, num_envs), np.zeros((num_envs, 14))
    qpos[:, :2] = arena.start
    angle = generator.uniform(0, 2 * np.pi, num_envs)
    qvel[:, :2] = 6.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    states = drive(physics, place(physics, state, qpos, qvel), 100)
    for now in states:
        assert not inside_walls(arena, now.qpos[:, :2].astype(float)).any()
    assert np.linalg.norm(states[-1].qpos[:, :2] - qpos[:, :2], axis=1).max() > 0.8


@pytest.mark.parametrize("robot", ["bullet", "light", "stiff"])
def test_other_ants_are_refused(tmp_path, robot):
    message = f"engine bullet has PyBullet's own ant, robot 'heavy': '{robot}' differs in"
    with pytest.raises(ValueError, match=message):
        BulletPhysics(ROBOTS[robot], open_field(), 1, 1)
    with pytest.raises(ValueError, match=message):
        train_row(with_robot(find_row("bullet/walker/plain"), ROBOTS[robot]), (0,), tmp_path)
    assert not list(tmp_path.iterdir())  # a refusal leaves nothing behind


def test_what_is_out_of_range_is_refused():
    for arguments, message in (
        ((0, 1), "num_envs must be >= 1, got 0"),
        ((1, -1), "num_workers must be >= 0"),
        ((1001, 1), "PyBullet holds 1000 ants per process"),
        ((10**7, 10**5), "ants on engine bullet take 330000 GB"),
    ):
        with pytest.raises(ValueError, match=message):
            BulletPhysics(HEAVY, open_field(), *arguments)


# ---------------------------------------------------------------- many worlds


def test_workers_change_no_bit(bullet):
    ends = [drive(*bullet(5, workers), 60)[-1] for workers in (1, 2, 3)]
    assert_same(ends[0], ends[1])
    assert_same(ends[0], ends[2])


def test_a_reset_touches_only_its_rows(bullet):
    (physics, state), (alone, untouched) = bullet(), bullet()
    state, untouched = drive(physics, state, 20)[-1], drive(alone, untouched, 20)[-1]
    mask = np.array([False, True, False, True])
    qpos, qvel = np.full((N, 15), np.nan), np.full((N, 14), np.nan)
    qpos[mask], qvel[mask] = pose(1.0), 0.5
    after = physics.reset(state, mask, qpos, qvel)
    assert_same(rows(after, ~mask), rows(state, ~mask))
    np.testing.assert_allclose(after.qpos[mask], np.float32(qpos[mask]), atol=1e-6)
    later, expected = drive(physics, after, 10)[-1], drive(alone, untouched, 10)[-1]
    assert_same(rows(later, ~mask), rows(expected, ~mask))


def test_what_went_before_a_reset_is_forgotten(bullet):
    (physics, state), (other, fresh) = bullet(), bullet()
    used = drive(physics, state, 60)[-1]
    assert used.foot_contact.any()
    start = pose(0.4, STANDING, N)
    again, first = place(physics, used, start), place(other, fresh, start)
    for one, two in zip(drive(physics, again, 30), drive(other, first, 30), strict=True):
        assert_same(one, two)


def test_held_rows_are_not_stepped(bullet):
    (physics, state), (other, fresh) = bullet(), bullet()
    state = drive(physics, state, 25)[-1]
    active = np.array([True, False, True, False])
    later = drive(physics, state, 5, active=active)
    for now in later:
        assert_same(rows(now, ~active), rows(state, ~active))
    alone = drive(other, drive(other, fresh, 25)[-1], 5)[-1]
    assert_same(rows(later[-1], active), rows(alone, active))
    assert_same(physics.step(later[-1], np.zeros((N, 8)), np.zeros(N, bool)), later[-1])


def test_permuted_rows_are_permuted_ants(bullet):
    order = np.array([2, 0, 3, 1])
    (physics, state), (other, state_2) = bullet(), bullet()
    state, state_2 = drive(physics, state, 10)[-1], drive(other, state_2, 10)[-1]
    permuted = PhysicsState(*(leaf[order] for leaf in state))
    for action in np.random.default_rng(4).uniform(-1, 1, (10, N, 8)):
        active = action[:, 0] < 0.5
        state_2 = other.step(state_2, action, active)
        permuted = physics.step(permuted, action[order], active[order])
        assert_same(permuted, rows(state_2, order))


@pytest.mark.parametrize("how", ["action", "reset", "speed"])
def test_a_diverged_row_is_reported_until_it_is_reset(bullet, how):
    (physics, state), (healthy, untouched) = bullet(3), bullet(3)
    qpos, qvel, action = pose(num_envs=3), np.zeros((3, 14)), np.zeros((3, 8))
    if how == "reset":
        qvel[1, 3] = np.nan
    elif how == "speed":
        qvel[1, 3:6] = 1e200
    else:
        action[1, 2] = np.inf
    state = physics.step(place(physics, state, qpos, qvel), action)
    assert state.diverged.tolist() == [False, True, False]
    state = drive(physics, state, 3)[-1]
    assert state.diverged.tolist() == [False, True, False]
    untouched = healthy.step(place(healthy, untouched, qpos), np.zeros((3, 8)))
    untouched = drive(healthy, untouched, 3)[-1]
    assert_same(rows(state, [0, 2]), rows(untouched, [0, 2]))
    state, untouched = (place(p, s, qpos) for p, s in ((physics, state), (healthy, untouched)))
    assert not state.diverged.any()
    assert_same(drive(physics, state, 10)[-1], drive(healthy, untouched, 10)[-1])  # as good as new


def test_a_killed_worker_is_said_in_one_line(bullet):
    physics, state = bullet(2, 2)
    physics._workers[1].kill()
    with pytest.raises(ChildProcessError, match="a PyBullet process ended with status -9"):
        drive(physics, state, 2)


# ---------------------------------------------------------------- whole trainings


def test_every_task_trains_on_it(tmp_path):
    for row in ("bullet/walker/interleaved", "bullet/bandit/hrl/plain", "bullet/maze/flat/free"):
        experiment = with_engine(tiny(row.removeprefix("bullet/")), "bullet")
        needed = None if experiment.needs is None else untrained("walker/plain")
        env = build_environment(experiment, 1, needed, 1)
        learning = training.begin_learning(experiment, env, (0,))
        after, metrics = training.iterate(experiment, env, learning, 0)
        assert np.isfinite(metrics["policy_loss"]).all()
        assert after.iteration == 1
        env.physics.close()


def stop_in(iteration, monkeypatch):
    """Ctrl-C in the iteration of that number."""
    real, begun = training.iterate, []

    def interrupted(*arguments):
        begun.append(1)
        if len(begun) == iteration:
            os.kill(os.getpid(), signal.SIGINT)
        return real(*arguments)

    monkeypatch.setattr(training, "iterate", interrupted)


def test_a_run_is_kept_apart(tmp_path, monkeypatch):
    experiment = with_engine(tiny("walker/symmetric", 2), "bullet")
    monkeypatch.setitem(EXPERIMENTS, "walker/symmetric", with_engine(experiment, "mujoco"))
    done = train_row(experiment, (0,), tmp_path, num_threads=1)
    assert find_trained("bullet/walker/symmetric", tmp_path).source == done.source
    with pytest.raises(RunError, match="no finished run of walker/symmetric"):
        find_trained("walker/symmetric", tmp_path)
    assert train_row(experiment, (0,), tmp_path, resume=True).source == done.source  # it is finished


def test_all_that_are_restored_from_a_snapshot_go_on_alike(bullet):
    """The engine that it was taken from, the same after other things happened, and a new one."""
    (physics, state), (other, elsewhere) = bullet(3), bullet(3, 2)
    state = drive(physics, state, 60)[-1]
    assert state.foot_contact.any()
    spoilt = np.zeros((3, 8))
    spoilt[1, 2] = np.inf
    state = physics.step(state, spoilt)
    taken = physics.snapshot()
    assert taken["failed"].tolist() == [False, True, False]
    ways = []
    for engine, now in ((physics, state), (physics, state), (other, elsewhere)):
        engine.restore(taken)
        on = drive(engine, now, 30)
        ways.append([*on, place(engine, on[-1], pose(num_envs=3)), *drive(engine, on[-1], 10)])
    for one, two, three in zip(*ways, strict=True):
        assert_same(one, two)
        assert_same(one, three)


def test_a_restored_ant_has_forgotten_the_wall_it_leans_on(bullet):
    """Where a link touches at several points, PyBullet's memory of them would decide what comes next."""
    (physics, state), (other, elsewhere) = bullet(16, arena=MAZES["u"]), bullet(16, arena=MAZES["u"])
    wall = MAZES["u"].walls[0]
    start, speed = pose(num_envs=16), np.zeros((16, 14))
    start[:, 0] = np.linspace(wall.x - wall.half_x, wall.x + wall.half_x, 16)
    start[:, 1] = wall.y - wall.half_y - 1.2
    speed[:, 1] = 4.0
    state = place(physics, state, start, speed)
    push = np.random.default_rng(7).uniform(-1, 1, (16, 8))
    for _ in range(60):
        state = physics.step(state, push)
    physics.restore(taken := physics.snapshot())
    other.restore(taken)
    for _ in range(5):
        state, elsewhere = physics.step(state, push), other.step(elsewhere, push)
        assert_same(state, elsewhere)


def test_a_snapshot_leaves_the_ants_alone_and_a_restored_ant_is_where_it_was(bullet):
    (physics, state), (other, untouched) = bullet(), bullet()
    state, untouched = drive(physics, state, 60)[-1], drive(other, untouched, 60)[-1]
    taken = physics.snapshot()
    assert_same(drive(physics, state, 20)[-1], drive(other, untouched, 20)[-1])
    physics.restore(taken)
    now = physics.read(state.engine, np.float64)
    np.testing.assert_allclose(now.qpos, taken["qpos"], atol=1e-12)
    np.testing.assert_allclose(now.qvel, taken["qvel"], atol=1e-9)
    np.testing.assert_array_equal(now.foot_contact, taken["touching"])


def small(row, iterations):
    """The row on PyBullet, a few updates that are long enough to come down and struggle."""
    experiment = tiny(row.removeprefix("bullet/"))
    ppo = replace(experiment.ppo, num_steps=24 if experiment.steps_per_decision == 1 else 12)
    task = replace(experiment.task, episode_steps=200)
    return with_engine(replace(experiment, ppo=ppo, task=task, total_steps=iterations * 96), "bullet")


def left_by(run, policies):
    """What a run leaves that must not depend on how it got there."""
    lines = [{k: v for k, v in line.items() if not k.startswith("time/")} for line in read_metrics(run.metrics_path)]
    return policies.params, lines


def assert_left_the_same(one, other):
    jax.tree.map(np.testing.assert_array_equal, one[0], other[0])
    np.testing.assert_equal(one[1], other[1])


@pytest.mark.parametrize("row", ["walker/appropriate-bias", "walker/interleaved", "bandit/hrl/plain", "maze/flat/free"])
def test_a_run_that_was_stopped_goes_on_bit_for_bit_from_where_all_are_saved(tmp_path, monkeypatch, row):
    experiment = small(row, 5)
    needed = {"needed": untrained("walker/plain")} if experiment.needs else {}
    monkeypatch.setattr(training, "SAVE_EVERY_STEPS", 2 * experiment.runs_per_seed * 96)
    whole = RunDir.create(tmp_path / "whole", {})
    expected = left_by(whole, training.train(experiment, (0,), whole, num_threads=1, checkpoint_seconds=0.0, **needed))
    assert [step for step, _ in whole.checkpoints()] == [192, 384]
    for stopped_in, saved in ((1, "nothing is saved in .* yet"), (3, "saved at step 192 in .*")):
        run = RunDir.create(tmp_path / f"{stopped_in}", {})
        with monkeypatch.context() as patch:
            stop_in(stopped_in, patch)
            with pytest.raises(Interrupted, match=f"{saved}, the same command with --resume goes on"):
                training.train(experiment, (0,), run, num_threads=1, checkpoint_seconds=0.0, **needed)
        assert_left_the_same(left_by(run, training.train(experiment, (0,), run, num_threads=2, **needed)), expected)


def test_a_finished_run_that_is_to_be_longer_goes_on_from_its_last_checkpoint(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "SAVE_EVERY_STEPS", 2 * 96)
    row, short, long = "walker/symmetric", small("walker/symmetric", 3), small("walker/symmetric", 5)
    monkeypatch.setitem(EXPERIMENTS, row, with_engine(short, "mujoco"))
    expected = train_row(long, (0,), tmp_path, "whole", num_threads=1)
    run = RunDir(tmp_path / "bullet" / row / "parts")
    train_row(short, (0,), tmp_path, "parts", num_threads=1)
    with monkeypatch.context() as patch:
        stop_in(1, patch)
        with pytest.warns(match="not finished any more: it ended at step 288"), pytest.raises(Interrupted, match="192"):
            train_row(long, (0,), tmp_path, "parts", resume=True, num_threads=1)
    assert not run.finished  # its metrics no longer reach the end that it had
    done = train_row(long, (0,), tmp_path, "parts", resume=True, num_threads=1)
    whole = RunDir(tmp_path / "bullet" / row / "whole")
    assert_left_the_same(left_by(run, done), left_by(whole, expected))


def test_a_run_of_another_pybullet_is_not_gone_on_with(tmp_path, monkeypatch):
    short, long = (with_engine(tiny("walker/symmetric", n), "bullet") for n in (2, 3))
    train_row(short, (0,), tmp_path, "run", num_threads=1)
    path = tmp_path / "bullet/walker/symmetric/run/config.json"
    content = json.loads(path.read_text())
    for then, said in (("3.2.6", "was begun with pybullet 3.2.6, this is"), (None, "did not record its pybullet")):
        content["versions"] |= {"pybullet": then}
        content["versions"] = {name: value for name, value in content["versions"].items() if value}
        path.write_text(json.dumps(content))
        assert train_row(short, (0,), tmp_path, "run", resume=True)  # it is finished
        with pytest.raises(ValueError, match=said):
            train_row(long, (0,), tmp_path, "run", resume=True)


def test_a_run_that_sees_the_ant_as_the_original_does_cannot_be_resumed(tmp_path, monkeypatch):
    experiment = with_engine(tiny("walker/symmetric", 3), "bullet-original")
    with monkeypatch.context() as patch:
        stop_in(2, patch)
        with pytest.raises(Interrupted, match=r"stopped at step 24 of 36; .* but engine bullet-original cannot resume"):
            train_row(experiment, (0,), tmp_path, "run", num_threads=1)
    run = RunDir(tmp_path / "bullet-original/walker/symmetric/run")
    before = read_metrics(run.metrics_path)
    assert run.latest_checkpoint().step == 24  # the policy is not lost
    with pytest.raises(ValueError, match="no ant can be put back from that"):
        train_row(experiment, (0,), tmp_path, "run", resume=True, num_threads=1)
    assert read_metrics(run.metrics_path) == before


def test_the_same_seed_gives_the_same_numbers_on_any_number_of_workers(tmp_path):
    experiment = with_engine(tiny("walker/plain", 2), "bullet")
    ends = [train_row(experiment, (0,), tmp_path / str(n), "run", num_threads=n).params for n in (1, 2)]
    jax.tree.map(np.testing.assert_array_equal, *ends)


def test_policies_of_one_engine_are_measured_on_another():
    figures = {
        engine: random_switching(walker(), ANT_WALKER, 200, ants=4, num_threads=1, engine=engine)
        for engine in ("mujoco", "bullet")
    }
    assert figures["mujoco"] != figures["bullet"]
    assert all(np.isfinite(list(values.values())).all() for values in figures.values())
