"""MJX behind the Physics protocol, and the loops of a traceable engine: the same bodies, compiled as a whole.

The loops are tested on an engine without mechanics; what needs MJX itself needs the extra footwork[mjx].
"""

from __future__ import annotations

from importlib.util import find_spec

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from footwork import evaluate as evaluating
from footwork import physics as engines
from footwork import train as training
from footwork.arena import open_field
from footwork.evaluate import play_episodes, transitions
from footwork.physics import physics_for
from footwork.record import RunDir, read_metrics
from footwork.study.experiments import with_engine
from footwork.train import begin_learning, build_environment, iterate
from footwork.types import PhysicsState
from test_physics import HEAVY, assert_same, drive, place, rows
from test_train import needed_by, tiny, untrained

N = 16
mjx = pytest.mark.skipif(not find_spec("mujoco.mjx"), reason="mujoco-mjx is not installed: pip install 'footwork[mjx]'")


# ---------------------------------------------------------------- the loops


class Hovercraft:
    """An engine without mechanics, for the host or for a device: the first actions push, and friction slows."""

    resumable = True
    restore_alters = False

    def __init__(self, robot, arena, num_envs, traceable):
        self.traceable, self.num_envs, self.control_dt = traceable, num_envs, robot.control_dt
        self._xp = jnp if traceable else np

    def initial(self):
        zeros = lambda *shape: self._xp.zeros((self.num_envs, *shape), np.float32)  # noqa: E731
        upright = zeros(15) + np.eye(15, dtype=np.float32)[3]
        return PhysicsState(upright, zeros(14), zeros(4), zeros(4), zeros() > 0, zeros())

    def reset(self, state, mask, qpos, qvel):
        mask = self._xp.asarray(mask)[:, None]
        qpos, qvel = (self._xp.where(mask, new, old) for new, old in ((qpos, state.qpos), (qvel, state.qvel)))
        return state._replace(qpos=qpos, qvel=qvel)

    def step(self, state, action, active=None):
        active = np.ones(self.num_envs, bool) if active is None else active
        action = self._xp.clip(self._xp.asarray(action), -1, 1)
        force = self._xp.concatenate([action, 0 * action[:, :6]], axis=1)
        qvel = np.float32(0.9) * self._xp.asarray(state.qvel) + force
        turned = self._xp.concatenate([qvel[:, :3], 0 * qvel[:, :4], qvel[:, 6:]], axis=1)
        moved = self._xp.asarray(state.qpos) + np.float32(self.control_dt) * turned
        keep = lambda new, old: self._xp.where(self._xp.asarray(active)[:, None], new, old)  # noqa: E731
        return state._replace(qpos=keep(moved, state.qpos), qvel=keep(qvel, state.qvel))

    def snapshot(self):
        return {}

    def close(self):
        pass


@pytest.fixture(params=["walker/interleaved", "maze/hrl/plain"])
def on_both(request, monkeypatch):
    """Calls a function of the row with the engine on the host, and with it on a device."""

    def call(function):
        answers = []
        for traceable in (False, True):
            make = lambda engine, robot, arena, n, threads=0, on=traceable: Hovercraft(robot, arena, n, on)  # noqa: E731
            for module in (training, evaluating):
                monkeypatch.setattr(module, "physics_for", make)
            answers.append(function(tiny(request.param)))
        return answers

    return call


def close(one, other):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


def test_training_is_the_same_under_both_loops(on_both):
    def two_iterations(experiment):
        env = build_environment(experiment, 1, needed_by(experiment))
        learning = begin_learning(experiment, env, (0,))
        for _ in range(2):
            learning, metrics = iterate(experiment, env, learning, 0)
        return metrics, learning.learners.params, learning.carry.obs

    close(*on_both(two_iterations))


def test_evaluation_is_the_same_under_both_loops(on_both):
    def episodes(experiment):
        trained = untrained(experiment.name)
        subs = None if experiment.needs is None else untrained(experiment.needs).sub_policies()
        return vars(play_episodes(trained, subs, 4, 0))

    close(*on_both(episodes))


def test_transitions_are_the_same_under_both_loops(on_both):
    def handovers(experiment):
        if experiment.is_master:
            pytest.skip("of sub-policies only")
        report = transitions(untrained(experiment.name), ants=4, periods=(200,))
        return report["handover"], report["switching"]

    close(*on_both(handovers))


def test_a_rollout_on_a_device_is_one_program(on_both):
    """The body is traced once, however many steps and iterations there are: the host is not in the loop."""
    steps = []

    def count(experiment):
        env = build_environment(experiment, 1, needed_by(experiment))
        step = env.physics.step
        env.physics.step = lambda *arguments: steps.append(env.physics.traceable) or step(*arguments)
        learning = begin_learning(experiment, env, (0,))
        for _ in range(3):
            learning, _ = iterate(experiment, env, learning, 0)
        return experiment.ppo.num_steps * (experiment.option_steps if experiment.is_master else 1)

    per_rollout, _ = on_both(count)
    assert steps.count(False) == 3 * per_rollout
    assert 1 <= steps.count(True) <= 2  # JAX may trace a loop's body again for its weak types


def test_the_missing_extra_is_named(monkeypatch):
    monkeypatch.setattr(engines, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"engine mjx needs an extra: pip install 'footwork\[mjx\]'"):
        physics_for("mjx", HEAVY, open_field(), 1)


# ---------------------------------------------------------------- MJX


@pytest.fixture(scope="session")
def ants():
    """One engine for all tests: its step takes long to compile."""
    return physics_for("mjx", HEAVY, open_field(), N)


def shared_states(num_rounds, seed=0):
    """Poses from episodes of random torque in C, [rounds x N] of them, with an action for each."""
    physics = physics_for("mujoco", HEAVY, open_field(), N, 1)
    generator = np.random.default_rng(seed)
    qpos = np.zeros((N, 15))
    qpos[:, 2:4], qpos[:, 7:] = (0.75, 1.0), generator.uniform(-0.1, 0.1, (N, 8))
    state = place(physics, physics.initial(), qpos)
    for _ in range(num_rounds):
        for _ in range(3):
            action = generator.uniform(-1, 1, (N, 8))
            for _ in range(10):
                state = physics.step(state, action)
        yield physics, state, action


@mjx
def test_single_steps_agree_with_c(ants):
    """Bounds: docs/parity.md, measured on 10,000 states."""
    distance, speed, equal = [], [], []
    for physics, state, action in shared_states(20):
        ours, theirs = (
            engine.step(place(engine, engine.initial(), state.qpos, state.qvel), action) for engine in (ants, physics)
        )
        distance.append(np.abs(ours.qpos - theirs.qpos))
        speed.append(np.abs(ours.qvel - theirs.qvel))
        equal.append(np.asarray(ours.foot_contact) == theirs.foot_contact)
        np.testing.assert_array_equal(ours.foot_collision, theirs.foot_collision)
        assert 0.1 < theirs.foot_contact.mean() < 1.0
    assert np.max(distance) < 5e-4
    assert np.max(speed) < 3e-2
    assert np.mean(equal) >= 0.999


@mjx
def test_only_masked_rows_are_reset(ants):
    moved = drive(ants, ants.initial(), 5)[-1]
    first = ants.initial()
    mask = np.arange(N) % 2 == 0
    after = ants.reset(moved, mask, first.qpos, first.qvel)
    assert_same(rows(after, ~mask), rows(moved, ~mask))
    assert_same(rows(after, mask), rows(first, mask))
    np.testing.assert_array_equal(after.engine[~mask], moved.engine[~mask])
    assert not after.engine[mask].any()
    assert np.asarray(moved.engine).any()


@mjx
def test_permuted_rows_drive_the_same_ants(ants):
    start = drive(ants, ants.initial(), 25)[-1]
    order = np.random.default_rng(1).permutation(N)
    action = np.random.default_rng(2).uniform(-1, 1, (N, 8)).astype(np.float32)
    straight = ants.step(start, action)
    permuted = ants.step(jax.tree.map(lambda leaf: leaf[order], start), action[order])
    for a, b in zip(rows(straight, order), rows(permuted, slice(None)), strict=False):
        np.testing.assert_allclose(a, b, atol=1e-5)


@mjx
def test_inactive_rows_are_held_and_actions_clipped(ants):
    start = drive(ants, ants.initial(), 3)[-1]
    active = np.arange(N) < 3
    after = ants.step(start, np.full((N, 8), 7.0), active)
    assert_same(rows(after, ~active), rows(start, ~active))
    assert_same(rows(after, active), rows(ants.step(start, np.ones((N, 8))), active))


@mjx
def test_divergence_stays_in_its_row_until_reset(ants):
    start = ants.initial()
    action = np.zeros((N, 8), np.float32)
    action[2, 3] = np.nan
    broken = start._replace(qvel=start.qvel.at[5].set(1e20))
    after = ants.step(broken, action)
    assert np.flatnonzero(after.diverged).tolist() == [2, 5]
    sound = np.setdiff1d(np.arange(N), [2, 5])
    assert_same(rows(after, sound), rows(ants.step(start, np.zeros((N, 8))), sound))
    assert ants.step(after, np.zeros((N, 8))).diverged[2]
    again = ants.reset(after, np.asarray(after.diverged), start.qpos, start.qvel)
    assert not again.diverged.any()
    assert np.isfinite(again.engine).all()
    assert not ants.step(again, np.zeros((N, 8))).diverged.any()


@mjx
@pytest.mark.parametrize(("arguments", "message"), [((0,), "num_envs must be >= 1"), ((1, -1), "num_threads must be")])
def test_bad_sizes_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        physics_for("mjx", HEAVY, open_field(), *arguments)


@mjx
@pytest.mark.parametrize("row", ["walker/interleaved", "bandit/hrl/plain"])
def test_a_row_trains_on_mjx(row, tmp_path):
    experiment = with_engine(tiny(row, iterations=2), "mjx")
    needed = needed_by(tiny(row))
    run = RunDir.create(tmp_path / "run", {})
    trained = training.train(experiment, (0,), run, needed)
    lines = read_metrics(run.metrics_path)
    assert len(lines) == 2
    assert all(np.isfinite(line[name]).all() for line in lines for name in ("policy_loss", "rollout/progress"))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(trained.params))
    assert trained.experiment.engine == "mjx"


@mjx
def test_a_run_on_mjx_goes_on_bit_for_bit(tmp_path):
    once, twice = (with_engine(tiny("walker/interleaved", iterations), "mjx") for iterations in (1, 2))
    straight = training.train(twice, (0,), RunDir.create(tmp_path / "straight", {}))
    run = RunDir.create(tmp_path / "stopped", {})
    training.train(once, (0,), run)
    resumed = training.train(twice, (0,), run)
    jax.tree.map(np.testing.assert_array_equal, straight.params, resumed.params)
