"""Laws of the reports: on an ant that glides where its action points, every figure is known beforehand."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from footwork import evaluate as evaluating
from footwork.arena import DIRECTIONS, Arena, open_field
from footwork.evaluate import evaluate, handover_matrix, play_episodes, random_switching
from footwork.learn.config import PPOConfig
from footwork.learn.networks import gaussian_policy
from footwork.options import SubPolicies
from footwork.robot import HEAVY
from footwork.statistics import wilson
from footwork.study.experiments import ANT_BANDIT, ANT_WALKER
from footwork.tasks.terms import PENALISED_WEIGHTS
from footwork.train import Experiment, Trained
from footwork.types import PhysicsState

TOP_SPEED = 3.0  # m/s of the gliding ant at action 1
DT = HEAVY.control_dt
CONFIG = PPOConfig(hidden_sizes=(2,))
UNIT = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])


class Glider:
    """An engine without mechanics: actions 0 and 1 are a velocity, actions 2 and 3 flip and lay down the ant."""

    traceable = False
    resumable = True
    restore_alters = False
    control_dt = DT
    seen: list[np.ndarray]  # every action, of the newest engine

    def __init__(self, robot, arena, num_envs, num_threads=0):
        self.num_envs = num_envs
        type(self).seen = []

    def initial(self):
        qpos = np.zeros((self.num_envs, 15), np.float32)
        flags, velocity = np.zeros((2, self.num_envs, 4), np.float32), np.zeros((self.num_envs, 14), np.float32)
        off, engine = np.zeros(self.num_envs, bool), np.arange(self.num_envs, dtype=np.int32)
        return PhysicsState(qpos, velocity, flags[0], flags[1], off, engine)

    def reset(self, state, mask, qpos, qvel):
        mask = np.asarray(mask)[:, None]
        return state._replace(
            qpos=np.where(mask, qpos, state.qpos),
            qvel=np.where(mask, qvel, state.qvel),
            engine=np.asarray(state.engine),
        )

    def step(self, state, action, active=None):
        active = np.ones(self.num_envs, bool) if active is None else np.asarray(active)
        action, qpos = np.clip(np.asarray(action), -1, 1), np.array(state.qpos)
        self.seen.append(action)
        qpos[active, :2] += DT * TOP_SPEED * action[active, :2]
        upright, flipped = np.eye(4)[:2]
        qpos[active, 2] = np.where(action[active, 3] > 0.5, 0.1, 0.75)
        qpos[active, 3:7] = np.where(action[active, 2:3] > 0.5, flipped, upright)
        return state._replace(qpos=qpos)

    def snapshot(self):
        return {}

    def restore(self, arrays):
        pass

    def close(self):
        pass


@pytest.fixture
def glider(monkeypatch):
    monkeypatch.setattr(evaluating, "physics_for", lambda engine, *rest: Glider(*rest))
    return Glider


def constant(policy, outputs):
    """Parameters with which a policy's outputs are these numbers in every state; leading axes as in ``outputs``."""
    outputs = np.asarray(outputs, np.float32)
    shapes = jax.eval_shape(policy.init, jax.random.key(0))
    params = jax.tree.map(lambda leaf: jnp.zeros((*outputs.shape[:-1], *leaf.shape)), shapes)
    bias = params["actor"]["output"]["bias"]
    params["actor"]["output"]["bias"] = bias.at[..., : outputs.shape[-1]].set(outputs)
    return params


WALKER = gaussian_policy(CONFIG, 32, 8)


def velocities(speeds):
    """Actions [4, 8] that glide in each direction with its speed (m/s)."""
    actions = np.zeros((4, 8))
    actions[:, :2] = UNIT * np.reshape(speeds, (4, 1)) / TOP_SPEED
    return actions


def walkers(speeds, flips=(), lies_down=()):
    actions = velocities(speeds)
    actions[list(flips), 2] = 1.0
    actions[list(lies_down), 3] = 1.0
    return SubPolicies(WALKER, constant(WALKER, actions), deterministic=True)


# ---------------------------------------------------------------- hand-overs


def test_the_matrix_names_first_and_second(glider):
    speeds = np.array([2.0, 1.5, 1.0, 0.5])
    matrix = handover_matrix(walkers(speeds, flips=[2], lies_down=[3]), ANT_WALKER, ants=3, seed=1)
    for name, expected in (("speed_mps", speeds), ("flip", [0, 0, 1, 0]), ("fall", [0, 0, 0, 1])):
        found = np.array([[entry[name] for entry in row] for row in matrix])
        np.testing.assert_allclose(found, np.tile(expected, (4, 1)), atol=1e-3, err_msg=name)
    direction = np.argmax(np.stack([action[:, :2] @ UNIT.T for action in glider.seen]), axis=-1)
    np.testing.assert_array_equal(direction[0], np.repeat([0, 1, 2, 3], 12))
    np.testing.assert_array_equal(direction[-1], np.tile(np.repeat([0, 1, 2, 3], 3), 4))
    changes = (direction != direction[0]).argmax(axis=0)[direction[0] != direction[-1]]
    assert changes.min() >= 100
    assert changes.max() <= 200
    assert len(direction) >= changes.max() + 300


def test_where_ants_are_large_the_matrix_takes_no_more_at_once_than_switching_does(monkeypatch):
    """One first direction after the other, each with noise of its own; the numbers are the same where there is none."""
    sizes, keys, walk = [], [], evaluating._Walk

    def watched(env, key):
        keys.append(tuple(jax.random.key_data(key).tolist()))
        return walk(env, key)

    def glide(engine, robot, arena, num_envs, num_threads):
        sizes.append(num_envs)
        return Glider(robot, arena, num_envs, num_threads)

    monkeypatch.setattr(evaluating, "physics_for", glide)
    monkeypatch.setattr(evaluating, "_Walk", watched)
    subs = walkers(np.array([2.0, 1.5, 1.0, 0.5]), flips=[2], lies_down=[3])
    matrices = [handover_matrix(subs, ANT_WALKER, ants=2, seed=1, engine=engine) for engine in ("mujoco", "bullet")]
    assert sizes == [32, 8, 8, 8, 8]
    assert len(set(keys)) == 5
    assert matrices[0] == matrices[1]


@pytest.mark.parametrize("orthogonal", [False, True])
def test_random_switching_counts_what_each_option_did(glider, monkeypatch, orthogonal):
    monkeypatch.setattr(evaluating, "SWITCHING_STEPS", 500)
    subs = walkers([2.0, 2.0, 0.19, 0.19], flips=[1])
    report = random_switching(subs, ANT_WALKER, 50, ants=64, seed=3, orthogonal=orthogonal)
    direction = np.argmax(np.stack([action[:, :2] @ UNIT.T for action in glider.seen]), axis=-1)
    options = direction.reshape(10, 50, 64)
    assert (options == options[:, :1]).all()  # fifty steps of each
    turn = (options[1:, 0] - options[:-1, 0]) % 4
    assert set(np.unique(turn)) == ({1, 3} if orthogonal else {0, 1, 2, 3})
    slow = (options[1:, 0] >= 2).mean()
    assert 0.4 < slow < 0.6
    assert report["idle"] == pytest.approx(slow)
    assert report["speed_mps"] == pytest.approx(0.19 * slow + 2.0 * (1 - slow), abs=1e-3)
    assert report["upside_down"] == pytest.approx((options[-1, 0] == 1).mean())
    assert report["fallen"] == 0.0


def test_an_ant_that_does_nothing_is_idle(monkeypatch):
    """The real ant, with torques of zero: it drops and lies flat."""
    monkeypatch.setattr(evaluating, "SWITCHING_STEPS", 150)
    report = random_switching(walkers(np.zeros(4)), ANT_WALKER, 50, ants=2, num_threads=1)
    assert report["idle"] == 1.0
    assert abs(report["speed_mps"]) < 0.1
    assert report["upside_down"] == 0.0


def test_transitions_are_means_over_seeds(glider, monkeypatch):
    monkeypatch.setattr(evaluating, "SWITCHING_STEPS", 100)
    experiment = Experiment("walker/test", ANT_WALKER, CONFIG, 1)
    params = constant(WALKER, np.stack([velocities([2.0] * 4), velocities([0.1] * 4)]))
    trained = Trained(experiment, (5, 6), params, "here")
    lines = []
    report = evaluating.transitions(trained, ants=4, deterministic=True, periods=(25,), report=lines.append)
    assert report["row"] == "walker/test"
    speeds = [entry["speed_mps"] for row in report["handover"] for entry in row]
    assert speeds == pytest.approx([1.05] * 16, abs=1e-3)
    assert report["switching"]["25"]["speed_mps"] == pytest.approx(1.05, abs=1e-3)
    assert report["switching"]["25"]["idle"] == 0.5
    assert [seed["idle"] for seed in report["switching_by_seed"]["25"]] == [0.0, 1.0]
    assert (report["engine"], report["orthogonal"]) == ("mujoco", False)
    assert len(lines) == 4
    flat = replace(experiment, name="bandit/test", task=ANT_BANDIT)
    with pytest.raises(ValueError, match="transitions are measured on sub-policies"):
        evaluating.transitions(trained._replace(experiment=flat))
    with pytest.raises(ValueError, match="option_steps must be a multiple of 25, got 30"):
        random_switching(walkers(np.zeros(4)), ANT_WALKER, 30)


# ---------------------------------------------------------------- episodes

ASIDE = (0.2, 0.47, 0.7, 3.0, 7.0)  # m by which the five goals stand beside the way of an ant that glides along +x
PASSING = replace(
    ANT_BANDIT, arena=Arena("passing", (0.0, 0.0), tuple((3.0, y) for y in ASIDE)), weights=PENALISED_WEIGHTS
)
FLAT_STEPS = 100  # of 5 cm


def flat_policy(task=PASSING):
    experiment = Experiment("test/flat", replace(task, episode_steps=FLAT_STEPS), CONFIG, 1)
    outputs = np.zeros((1, 1, 8))
    outputs[..., 0] = 1.0
    return Trained(experiment, (0,), constant(experiment.policy(), outputs), "here")


def test_success_counts_the_closest_approach(glider):
    trained = flat_policy()
    episodes = play_episodes(trained, None, 200, seed=7, deterministic=True)
    goal = np.abs(episodes.closest[:, None] - np.maximum(ASIDE, 0.43)).argmin(axis=1)  # the first one ends within 0.45
    counts = np.bincount(goal, minlength=5)
    assert (counts > 20).all()  # every goal is drawn
    assert (np.abs(episodes.closest[goal == 0] - 0.43) < 0.03).all()
    for number in range(1, 5):
        np.testing.assert_allclose(episodes.closest[goal == number], ASIDE[number], atol=0.01)
    report = evaluate(trained, None, 200, seed=7, deterministic=True)
    shares = np.cumsum(counts) / 200
    assert report["success"] == pytest.approx({"0.45": shares[0], "0.5": shares[1], "1.0": shares[2], "5.0": shares[3]})
    assert report["interval"]["success"]["1.0"] == pytest.approx(list(wilson((goal < 3).sum(), 200)))
    assert (report["episodes"], report["fall_rate"], report["flip_rate"]) == (200, 0.0, 0.0)
    # time to the radius of the task, 0.5 m, where it was reached
    entry = np.array([3.0 - np.sqrt(0.25 - ASIDE[i] ** 2) for i in (0, 1)]) / TOP_SPEED
    assert np.isnan(episodes.time_to_goal[goal > 1]).all()
    for number in (0, 1):
        time = episodes.time_to_goal[goal == number]
        assert (time > entry[number]).all()
        assert (time < entry[number] + 2 * DT).all()
    # progress is what the distance lost, until the end of the episode or of the way
    end = np.where(goal == 0, episodes.closest, np.hypot(3.0 - FLAT_STEPS * DT * TOP_SPEED, np.array(ASIDE)[goal]))
    np.testing.assert_allclose(episodes.progress, np.hypot(3.0, np.array(ASIDE)[goal]) - end, atol=0.01)
    assert report["progress_m"] == pytest.approx(episodes.progress.mean(), abs=1e-4)


def test_falls_and_flips_count_at_any_time_of_the_episode(glider, monkeypatch):
    step, mishaps = Glider.step, iter(range(10_000))

    def stumble(self, state, action, active=None):
        action = np.array(action)
        if next(mishaps) == 3:
            action[:10, 2], action[:5, 3] = 1.0, 1.0  # ten ants flip for one step, five of them fall
        return step(self, state, action, active)

    monkeypatch.setattr(Glider, "step", stumble)
    report = evaluate(flat_policy(), None, 40, deterministic=True)
    assert (report["flip_rate"], report["fall_rate"]) == (0.25, 0.125)


def test_walkers_are_judged_by_their_direction(glider):
    task = replace(ANT_WALKER, episode_steps=30)
    experiment = Experiment("walker/test", task, CONFIG, 1)
    params = constant(WALKER, np.stack([velocities([2.0, 1.5, 1.0, 0.5]), velocities([0.4, 0.3, 0.2, 0.1])]))
    report = evaluate(Trained(experiment, (3, 4), params, "here"), None, 8, deterministic=True)
    assert report["success"] is None
    assert report["time_to_goal_s"] is None
    speeds = dict(zip(DIRECTIONS, [[2.0, 0.4], [1.5, 0.3], [1.0, 0.2], [0.5, 0.1]], strict=True))
    for name, by_seed in report["speed_mps"].items():
        assert by_seed == pytest.approx(speeds[name], abs=0.01)
    assert report["seeds"] == [3, 4]


def test_a_masters_choices_and_path_are_kept(glider):
    task = replace(PASSING, arena=Arena("ahead", (0.0, 0.0), ((0.0, 3.0),)), episode_steps=200)
    experiment = Experiment("test/master", task, CONFIG, 1, sub_policies="walker/plain", option_steps=10)
    params = constant(experiment.policy(), [[[0.0, 5.0, 0.0, 0.0]]])  # always up
    episodes = play_episodes(Trained(experiment, (0,), params, ""), walkers([2.0] * 4), 3, seed=0, deterministic=True)
    decisions = len(episodes.choices)
    assert (episodes.choices == 1).all()
    assert episodes.paths.shape == (decisions + 1, 3, 2)
    np.testing.assert_allclose(episodes.paths[:, :, 0], 0.0, atol=1e-6)
    np.testing.assert_allclose(np.diff(episodes.paths[:-1, 0, 1]), 10 * DT * 2.0, atol=1e-4)
    arrival = (3.0 - 0.5) / 2.0
    assert arrival < episodes.time_to_goal[0] <= arrival + 10 * DT  # rounded up to a whole option
    assert decisions == np.ceil((3.0 - 0.45) / 2.0 / (10 * DT))  # and then it is over
    np.testing.assert_allclose(episodes.closest, 0.44, atol=0.02)


def test_the_switching_task_never_ends():
    task = evaluating.switching_task(replace(ANT_BANDIT, fall_rule="either"))
    assert (task.fall_rule, task.goal_radius, task.arena) == ("none", None, open_field())
    assert task.episode_steps > evaluating.SWITCHING_STEPS
