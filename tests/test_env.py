"""Laws of environments: options, automatic reset, regularisers, collecting. Ants are real, policies are known."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from footwork.arena import DIRECTIONS
from footwork.autoreset import AutoReset
from footwork.collect import collect, start
from footwork.env import Env, host_jit, host_scan
from footwork.learn.config import PPOConfig
from footwork.learn.networks import categorical_policy, gaussian_policy
from footwork.options import Options, SubPolicies
from footwork.physics.batch import BatchPhysics
from footwork.regularisers import (
    AppropriateBias,
    Interleave,
    Interleaved,
    Intervention,
    RandomRepeated,
    RandomStart,
    Symmetric,
    directions_of_rows,
    expect_handovers,
    regularise,
)
from footwork.study.experiments import ANT_MAZE, ANT_WALKER
from footwork.tasks.observe import observe_walker, turn_action, turn_observation
from footwork.types import Transition

N = 8
CONFIG = PPOConfig(hidden_sizes=(4,))
POLICY = gaussian_policy(CONFIG, 32, 8)
STANDING = replace(ANT_WALKER, fall_rule="none")  # nothing but time ends an episode
EQUAL = replace(STANDING, robot=replace(STANDING.robot, reset_joint_noise=0.0))  # every ant starts the same

# Most of the time here is compilation: ask for quick code.
jit = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False})


@partial(jit, static_argnums=0)
def begin(env, state, action, key):
    return env.begin(state, action, key)


@partial(jit, static_argnums=0)
def finish(env, state, key):
    return env.finish(state, key)


turn = jit(turn_observation)


@jit
def observe(physics):
    return observe_walker(physics, STANDING.robot)


@partial(jit, static_argnums=0)
def init_all(policy, keys):
    return jax.vmap(policy.init)(keys)


def numpy_of(tree):
    return jax.tree.map(np.array, tree)


def play(env, actions, state=None, seed=0):
    """Step the environment with the given actions: states (the first one before any step) and time steps."""
    keys = jax.random.split(jax.random.key(seed), (len(actions) + 1, 3))
    if state is None:
        state, _ = env.initial(keys[-1, 0])
    states, steps = [numpy_of(state)], []
    for action, key in zip(actions, keys, strict=False):
        state = env.simulate(begin(env, state, action, key[0]), key[1])
        state, step = finish(env, state, key[2])
        states.append(numpy_of(state))
        steps.append(numpy_of(step))
    return states, steps


def stacked(records, field):
    return np.stack([getattr(record, field) for record in records])


def walkers(task=STANDING, num_envs=N, **fields):
    physics = BatchPhysics(task.robot, task.arena, num_envs, 1)
    return Env(task, physics, directions_of_rows(num_envs, range(4)), **fields)


def constant_policies(actions):
    """Sub-policies that always do the same, one action of every joint per direction."""
    shapes = jax.eval_shape(POLICY.init, jax.random.key(0))
    params = jax.tree.map(lambda leaf: jnp.zeros((len(actions), *leaf.shape)), shapes)
    params["actor"]["output"]["bias"] = params["actor"]["output"]["bias"].at[:, :8].set(jnp.array(actions)[:, None])
    return SubPolicies(POLICY, params, deterministic=True)


def lively_policies(symmetric=False):
    """Sub-policies that react to what they see, each in its own way."""
    params = init_all(POLICY, jax.random.split(jax.random.key(3), 4))
    params["actor"]["output"]["weight"] *= 60.0
    if symmetric:
        params = jax.tree.map(lambda leaf: leaf[0], params)
    return SubPolicies(POLICY, params, symmetric, deterministic=True)


def choices(num_steps, seed=1):
    return np.random.default_rng(seed).integers(0, 4, (num_steps, N)).astype(np.int32)


IDLE = np.zeros((30, N, 8), np.float32)


# ---------------------------------------------------------------- options

MAZE = replace(ANT_MAZE, episode_steps=6)


@pytest.fixture(scope="module")
def lively():
    return lively_policies()


def options(lively, option_steps):
    return Options(Env(MAZE, BatchPhysics(MAZE.robot, MAZE.arena, N, 1)), lively, option_steps)


@pytest.fixture(scope="module")
def one_step_option(lively):
    return options(lively, 1)


@pytest.fixture(scope="module")
def four_step_option(lively):
    return options(lively, 4)


def begun_at(env, t):
    """A first state whose rows are ``t`` steps into their episodes."""
    state, _ = env.initial(jax.random.key(5))
    if isinstance(env, Env):
        return state._replace(t=jnp.asarray(t, jnp.int32))
    return state._replace(inner=state.inner._replace(t=jnp.asarray(t, jnp.int32)))


def test_an_option_of_one_step_is_its_inner_step(lively, one_step_option):
    env = Env(MAZE, BatchPhysics(MAZE.robot, MAZE.arena, N, 1))
    act = jit(lively.act)
    state, obs = env.initial(jax.random.key(5))
    states, steps = play(one_step_option, choices(7), begun_at(one_step_option, np.zeros(N)))
    for choice, after, step in zip(choices(7), states[1:], steps, strict=True):
        state = begin(env, state, act(obs, choice, jax.random.key(0)), jax.random.key(0))
        state, inner = finish(env, env.simulate(state, jax.random.key(0)), jax.random.key(0))
        obs = inner.obs
        jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4), step, numpy_of(inner))
        np.testing.assert_allclose(after.inner.physics.qpos, state.physics.qpos, atol=1e-5)
    assert steps[5].truncated.all()
    assert not steps[6].reward.any()  # the seventh step of a six-step episode


def test_an_option_sums_its_steps_and_holds_what_ended(one_step_option, four_step_option):
    t = np.arange(N) % 6  # rows end after 6, 5, ..., 1 steps
    choice = choices(2)
    states, steps = play(four_step_option, choice, begun_at(four_step_option, t))
    single_states, single = play(one_step_option, choice.repeat(4, axis=0), begun_at(one_step_option, t))
    for option in range(2):
        part = single[4 * option : 4 * option + 4]
        step = steps[option]
        np.testing.assert_allclose(step.reward, stacked(part, "reward").sum(axis=0), rtol=1e-4, atol=1e-4)
        for name, value in step.terms.items():
            np.testing.assert_allclose(value, sum(p.terms[name] for p in part), rtol=1e-4, atol=1e-4)
        np.testing.assert_array_equal(step.truncated, stacked(part, "truncated").any(axis=0))
        np.testing.assert_array_equal(step.valid, stacked(part, "valid").any(axis=0))
        distance = np.min([p.events["goal_distance"] for p in part], axis=0)
        np.testing.assert_allclose(step.events["goal_distance"], distance, atol=1e-5)
        np.testing.assert_allclose(
            states[option + 1].inner.physics.qpos, single_states[4 * option + 4].inner.physics.qpos, atol=1e-5
        )
    lasted = 6 - t
    for row in range(N):
        end, last = single_states[lasted[row]].inner.physics, states[-1].inner.physics
        np.testing.assert_allclose(last.qpos[row], end.qpos[row], atol=1e-5)
        rewards = stacked(single, "reward")[:, row]
        assert rewards[: lasted[row]].all()
        assert not rewards[lasted[row] :].any()
    time_moved = four_step_option.physics.snapshot()["state"][:, 0] / (MAZE.robot.control_dt)
    np.testing.assert_allclose(time_moved, lasted)  # not stepped any further, either


def test_held_rows_do_not_move_and_earn_nothing(four_step_option):
    states, steps = play(four_step_option, choices(3), begun_at(four_step_option, np.full(N, 4)))
    assert steps[0].truncated.all()
    for state, step in zip(states[2:], steps[1:], strict=True):
        jax.tree.map(np.testing.assert_array_equal, state.inner.physics, states[1].inner.physics)
        assert not any(np.any(x) for x in (step.reward, step.valid, step.terminated, step.truncated))
        assert not any(value.any() for value in step.terms.values())


def test_a_row_that_diverges_within_an_option_poisons_nothing(four_step_option, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings into the working directory
    states, _ = play(four_step_option, choices(1), begun_at(four_step_option, np.zeros(N)))
    physics = four_step_option.physics
    for spoilt in (np.nan, 1e15):
        engine = physics.snapshot()
        engine["state"][2, 1 + 15] = spoilt  # a velocity; a simulation's row starts with its time and 15 positions
        physics.restore(engine)
        before = states[-1]
        after, steps = play(
            four_step_option, choices(2), before._replace(inner=before.inner._replace(t=np.zeros(N, "i")))
        )
        only = np.arange(N) == 2
        np.testing.assert_array_equal(steps[0].events["diverged"], only)
        np.testing.assert_array_equal(steps[0].terminated, only)
        for step in steps:
            assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(step._replace(events={})))
        assert steps[0].events["goal_distance"][2] == pytest.approx(8.0, abs=0.5)  # where it was last, near the start
        assert not steps[1].reward[2]
        assert np.isfinite(after[-1].obs).all()
        restarted, _ = four_step_option.restart(
            jax.tree.map(jnp.asarray, after[-1]), jnp.asarray(only), jax.random.key(0)
        )
        states, steps = play(four_step_option, choices(1), restarted)
        assert not steps[0].events["diverged"].any()


def test_sub_policies_act_for_their_direction_on_32_numbers(lively):
    obs = jax.random.normal(jax.random.key(0), (N, 36))
    direction = jnp.arange(N) % 4
    act, mode = jit(lively.act), jit(POLICY.mode)
    action = act(obs, direction, jax.random.key(0))
    for row in range(N):
        params = jax.tree.map(lambda leaf, row=row: leaf[row % 4], lively.params)
        np.testing.assert_allclose(action[row], mode(params, obs[row, :32]), rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(act(obs.at[:, 32:].add(9.0), direction, jax.random.key(0)), action)


def test_one_symmetric_policy_serves_four_directions():
    act, turn_back = jit(lively_policies(symmetric=True).act), jit(turn_action)
    obs = walkers().initial(jax.random.key(0))[1]
    obs = obs.at[:, :24].add(0.3 * jax.random.normal(jax.random.key(1), (N, 24)))
    for quarters in (1, 2, 3):
        turns = jnp.full(N, quarters)
        for direction in range(4):
            ahead, there = jnp.full(N, direction), jnp.full(N, (direction - quarters) % 4)
            turned = act(turn(obs, turns), there, jax.random.key(0))
            expected = turn_back(act(obs, ahead, jax.random.key(0)), turns)
            np.testing.assert_allclose(turned, expected, rtol=1e-3, atol=1e-3)


# ---------------------------------------------------------------- automatic reset


def test_a_new_episode_follows_in_the_same_step():
    task = replace(STANDING, episode_steps=5)
    t = np.array([0, 1, 2, 3, 4, 0, 1, 2])
    bare, auto = walkers(task), AutoReset(walkers(task))
    action = 0.5 * np.ones((12, N, 8), np.float32)
    _, plain = play(bare, action[:5], begun_at(bare, t))
    states, steps = play(auto, action, begun_at(auto.inner, t))
    truncated = stacked(steps, "truncated")
    expected = (t + 1 + np.arange(12)[:, None]) % 5 == 0
    np.testing.assert_array_equal(truncated, expected)
    assert not stacked(steps, "terminated").any()
    obs, next_obs = stacked(steps, "obs"), stacked(steps, "next_obs")
    first_end = expected.argmax(axis=0)
    for row in range(N):  # the true successor: what the environment saw that never resets
        end = first_end[row]
        np.testing.assert_allclose(next_obs[: end + 1, row], stacked(plain, "next_obs")[: end + 1, row], atol=1e-5)
    np.testing.assert_array_equal(obs[~truncated], next_obs[~truncated])
    fresh = obs[truncated]
    np.testing.assert_allclose(fresh[:, 16:32], np.tile([0.0] * 13 + [1.0] * 3, (len(fresh), 1)), atol=1e-6)
    assert not fresh[:, 1:16:2].any()  # at rest
    assert (next_obs[truncated][:, 20] < 0.0).all()  # while the old ant had begun to fall
    for before, after, ended in zip(states[:-1], states[1:], truncated, strict=True):
        np.testing.assert_array_equal(after.t, np.where(ended, 0, before.t + 1))
        height = after.physics.qpos[:, 2]
        np.testing.assert_allclose(height[ended], task.robot.reset_height)
        assert (np.abs(after.physics.qpos[:, :2]) < 0.2).all()  # nobody gets far in five steps, all start anew


def test_a_restart_leaves_the_other_rows_alone():
    env = walkers()
    state = play(env, IDLE[:3])[0][-1]
    mask = np.arange(N) % 3 == 0
    state = jax.tree.map(jnp.asarray, state)
    after, obs = env.restart(state, jnp.asarray(mask), jax.random.key(0))
    np.testing.assert_allclose(obs, observe(after.physics), atol=1e-6)
    for old, new in zip(jax.tree.leaves(state), jax.tree.leaves(after), strict=True):
        np.testing.assert_array_equal(np.asarray(old)[~mask], np.asarray(new)[~mask])
    np.testing.assert_array_equal(after.goal, state.goal)  # goals belong to rows
    assert np.all(np.abs(after.physics.qpos[mask, 2] - STANDING.robot.reset_height) < 1e-6)


# ---------------------------------------------------------------- noise and partners


def who_acted(env, num_steps, state=None):
    """Steps of learners that do nothing: whoever pays for torque did not learn."""
    _, steps = play(env, np.zeros((num_steps, N, 8), np.float32), state)
    return steps, np.stack([step.terms["stall_torque"] for step in steps])


TEN_STEPS = replace(STANDING, episode_steps=10)


@pytest.mark.parametrize(
    ("regulariser", "episode"),
    [(RandomStart(3), "NNNLLLLLLL"), (RandomRepeated(4, 1), "LLLNLLLNLL"), (RandomRepeated(5, 3), "LLNNNLLNNN")],
    ids=str,
)
def test_noise_acts_when_it_should_and_is_not_learned(regulariser, episode):
    env = AutoReset(Intervention(walkers(TEN_STEPS), regulariser))
    steps, paid = who_acted(env, 23)
    learner = np.array([letter == "L" for letter in (3 * episode)[:24]])
    for step, cost, acts, acts_next in zip(steps, paid, learner[:-1], learner[1:], strict=True):
        assert (step.valid == acts).all()
        assert ((cost == 0.0) == acts).all()
        if not step.truncated.any():
            assert (step.handover == (acts and not acts_next)).all()
    assert [bool(step.truncated.all()) for step in steps] == [(i + 1) % 10 == 0 for i in range(23)]


def test_the_learned_orthogonal_policies_lead_in():
    strength = np.array([0.1, 0.2, 0.4, 0.8])
    env = AutoReset(Intervention(walkers(TEN_STEPS), AppropriateBias(4), constant_policies(strength)))
    steps, paid = who_acted(env, 30)
    direction = np.repeat(np.arange(4), 2)
    partners = set()
    for episode in range(3):
        part = slice(10 * episode, 10 * episode + 10)
        assert (paid[part][4:] == 0.0).all()
        assert stacked(steps[part], "valid").tolist() == [[i >= 4] * N for i in range(10)]
        led = np.sqrt(-10.0 * paid[part][:4])  # the stall torque costs 0.1 x torque^2
        partner = np.abs(led[..., None] - strength).argmin(axis=-1)
        np.testing.assert_allclose(strength[partner], led, rtol=1e-3)
        assert (partner == partner[0]).all()  # one partner per episode
        assert ((partner[0] - direction) % 2 == 1).all()  # orthogonal
        partners |= set(zip(direction.tolist(), partner[0].tolist(), strict=True))
    assert len(partners) > 4  # over the episodes, both neighbours of some


# ---------------------------------------------------------------- changing hands


def rollout_of(obs):
    flat = jnp.zeros(obs.shape[:-1])
    return Transition(obs, flat, flat, flat, flat > 0, flat > 0, obs, flat == 0)


def test_every_direction_hears_what_the_other_three_expect():
    two_seeds = constant_policies(np.zeros(8)).params
    critic = jnp.arange(8.0)[:, None] ** 2  # runs: seed, then direction
    two_seeds = {**two_seeds, "critic": jax.tree.map(jnp.zeros_like, two_seeds["critic"])}
    two_seeds["critic"]["output"]["bias"] = critic
    rollout = rollout_of(jnp.zeros((8, 3, 2, 32)))
    handovers = expect_handovers(Interleaved(mean_steps=30), False, POLICY, two_seeds, rollout).handovers
    others = [np.mean([r**2 for r in range(4 * (i // 4), 4 * (i // 4) + 4) if r != i]) for i in range(8)]
    np.testing.assert_allclose(handovers.value, np.broadcast_to(np.reshape(others, (8, 1, 1)), (8, 3, 2)), rtol=1e-6)
    np.testing.assert_allclose(handovers.chance, 0.75 / 30)


def test_a_symmetric_policy_expects_what_it_would_in_the_other_frames():
    params = jax.vmap(POLICY.init)(jax.random.split(jax.random.key(1), 1))
    obs = jax.random.normal(jax.random.key(2), (1, 3, 2, 32))
    handovers = expect_handovers(Interleaved(mean_steps=30), True, POLICY, params, rollout_of(obs)).handovers
    only = jax.tree.map(lambda leaf: leaf[0], params)
    for index in np.ndindex(3, 2):
        row = obs[0][index][None]
        values = [POLICY.value(only, turn(row, jnp.array([quarter]))) for quarter in (1, 2, 3)]
        assert handovers.value[0][index] == pytest.approx(np.mean(values), rel=1e-3, abs=1e-5)
    np.testing.assert_allclose(handovers.chance, 1 / 30)


@pytest.fixture(scope="module")
def interleave():
    return AutoReset(Interleave(walkers(num_envs=2 * N), Interleaved(mean_steps=3, every=2), num_groups=2))


@pytest.fixture(scope="module")
def exchanged(interleave):
    return play(interleave, np.zeros((20, 2 * N, 8), np.float32))


def test_ants_change_hands_and_rows_keep_their_direction(interleave, exchanged):
    states, steps = exchanged
    engine = np.stack([state.inner.physics.engine for state in states])
    assert (np.sort(engine, axis=1) == np.arange(2 * N)).all()  # a permutation at all times
    assert (engine // N == np.arange(2 * N) // N).all()  # within its group
    goal = np.stack([state.inner.goal for state in states])
    np.testing.assert_array_equal(goal, np.tile(interleave.inner.inner.task.goals.repeat(4, axis=0), (21, 1, 1)))
    np.testing.assert_array_equal(stacked(steps, "handover"), engine[1:] != engine[:-1])
    exchanges = (engine[1:] != engine[:-1]).any(axis=1)
    assert not exchanges[0::2].any()  # only at every second step
    assert exchanges[1::2].sum() >= 8
    assert len(np.unique(engine[:, 0])) > 3


def test_no_simulation_notices_the_exchange(exchanged):
    plain = walkers(num_envs=2 * N)
    states, _ = exchanged
    alone, _ = play(plain, np.zeros((20, 2 * N, 8), np.float32))
    for state, other in zip(states, alone, strict=True):
        by_simulation = np.argsort(state.inner.physics.engine)
        for name in ("qpos", "qvel", "foot_contact", "diverged"):
            mine, theirs = getattr(state.inner.physics, name), getattr(other.physics, name)
            np.testing.assert_array_equal(mine[by_simulation], theirs, err_msg=name)


def test_after_an_exchange_a_row_sees_the_ant_it_got(exchanged):
    states, steps = exchanged
    for before, after, step in zip(states[:-1], states[1:], steps, strict=True):
        place = np.argsort(before.inner.physics.engine)  # the row that drove a simulation during the step
        source = place[after.inner.physics.engine]
        np.testing.assert_array_equal(step.obs, step.next_obs[source])
        np.testing.assert_array_equal(after.inner.t, before.inner.t[source] + 1)


def test_ants_whose_episode_ended_stay_where_they_are(interleave, exchanged):
    state, clock = exchanged[0][-1], np.int32(1)
    t = np.where(np.arange(2 * N) % 3 == 0, 999, 5)
    state = state._replace(inner=state.inner._replace(t=t.astype(np.int32)), clock=clock)
    ends = moves = 0
    for seed in range(4):
        states, (step,) = play(interleave, np.zeros((1, 2 * N, 8), np.float32), state, seed)
        np.testing.assert_array_equal(step.truncated, t == 999)
        assert not (step.truncated & step.handover).any()
        fresh = states[1].inner.physics.qpos[step.truncated]
        np.testing.assert_allclose(fresh[:, 2], STANDING.robot.reset_height)
        np.testing.assert_array_equal(states[1].inner.t[step.truncated], 0)
        ends, moves = ends + step.truncated.sum(), moves + step.handover.sum()
        # the engine learns of these restarts at its next step, whatever the order of its rows
        state = states[1]._replace(inner=states[1].inner._replace(t=t.astype(np.int32)), clock=clock)
    assert min(ends, moves) > 0


def test_four_equal_ants_in_four_frames_see_the_same():
    env = Symmetric(walkers(EQUAL, 4))
    actions = np.random.default_rng(0).uniform(-1, 1, (25, 1, 8)).astype(np.float32).repeat(4, axis=1)
    states, steps = play(env, actions)
    for step in steps:
        for row in range(1, 4):
            np.testing.assert_allclose(step.obs[row], step.obs[0], atol=5e-4)
            assert step.reward[row] == pytest.approx(step.reward[0], abs=5e-3)
    place = states[-1].inner.physics.qpos[:, :2]
    assert np.abs(place).max() > 0.01
    x, y = place[0]
    np.testing.assert_allclose(place, [(x, y), (-y, x), (-x, -y), (y, -x)], atol=1e-3)


def test_with_one_policy_the_ant_changes_direction_instead():
    env = AutoReset(Symmetric(walkers(TEN_STEPS), Interleaved(mean_steps=3, every=2)))
    states, steps = play(env, 0.3 * np.ones((30, N, 8), np.float32))
    goals = STANDING.goals
    changes = 0
    for i, (before, after, step) in enumerate(zip(states[:-1], states[1:], steps, strict=True)):
        np.testing.assert_array_equal(after.inner.goal, goals[after.direction])
        np.testing.assert_array_equal(step.handover, after.direction != before.direction)
        assert not (step.handover & step.truncated).any()
        assert i % 2 == 1 or not step.handover.any()
        np.testing.assert_array_equal(after.inner.physics.engine, np.arange(N))
        direction, obs = jnp.asarray(after.direction), observe(jax.tree.map(jnp.asarray, after.inner.physics))
        seen = turn(obs, direction)
        np.testing.assert_allclose(step.obs, seen, atol=1e-4)
        same = ~(step.handover | step.truncated)
        np.testing.assert_allclose(step.obs[same], step.next_obs[same], atol=1e-5)
        changes += step.handover.sum()
    assert changes > N


# ---------------------------------------------------------------- collecting

NUM_STEPS, RUNS = 10, 4


def rollouts(env, policy, num_rollouts=3, num_runs=RUNS, carry=None):
    params = init_all(policy, jax.random.split(jax.random.key(0), num_runs))
    carry, transitions, metrics = carry or start(env, jax.random.key(1)), [], []
    for i in range(num_rollouts):
        carry, transition, more = collect(env, policy, params, carry, jax.random.key(2 + i), NUM_STEPS)
        transitions.append(numpy_of(transition))
        metrics.append(numpy_of(more))
    return params, jax.tree.map(lambda *parts: np.concatenate(parts, axis=1), *transitions), metrics


def count_calls(monkeypatch, owner, name):
    """Count from now on how often a method's Python runs: of what is compiled, once per trace."""
    calls, method = [], getattr(owner, name)

    def counted(*arguments):
        calls.append(name)
        return method(*arguments)

    monkeypatch.setattr(owner, name, counted)
    return calls


def test_a_rollout_is_what_the_learner_needs(monkeypatch):
    env = AutoReset(
        Interleave(walkers(TEN_STEPS, 2 * N, staggered=True), Interleaved(mean_steps=6, every=2), num_groups=1)
    )
    carry = start(env, jax.random.key(1))
    begins, finishes = (count_calls(monkeypatch, AutoReset, name) for name in ("begin", "finish"))
    params, rollout, metrics = rollouts(env, POLICY, carry=carry)
    assert (len(begins), len(finishes)) == (1, 1)  # traced once in three rollouts
    shape = (RUNS, 3 * NUM_STEPS, 2 * N // RUNS)
    assert rollout.obs.shape == rollout.next_obs.shape == (*shape, 32)
    assert rollout.action.shape == (*shape, 8)
    for leaf in (rollout.log_prob, rollout.reward, rollout.terminated, rollout.truncated, rollout.valid):
        assert leaf.shape == shape
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(rollout))
    stays = ~(rollout.terminated | rollout.truncated)[:, :-1]
    np.testing.assert_array_equal(rollout.obs[:, 1:][stays], rollout.next_obs[:, :-1][stays])
    apart = (rollout.obs[:, 1:] != rollout.next_obs[:, :-1]).any(axis=-1)
    np.testing.assert_array_equal(apart, ~stays)  # at every end and every hand-over, and nowhere else
    assert 0.1 < (~stays).mean() < 0.9
    for run in range(RUNS):  # every run acts by its own policy
        own = jax.tree.map(lambda leaf, run=run: leaf[run], params)
        log_prob = POLICY.head.log_prob(POLICY.outputs(own, rollout.obs[run]), rollout.action[run])
        np.testing.assert_allclose(log_prob, rollout.log_prob[run], rtol=1e-3, atol=1e-3)
    counted = sum(m["episode/count"] for m in metrics)
    assert counted.sum() == 2 * N * 3  # ten-step episodes, each row ends three in thirty steps


def test_episode_sums_run_on_over_rollouts():
    task = replace(STANDING, episode_steps=15)
    env = AutoReset(walkers(task, 4))
    _, rollout, metrics = rollouts(env, POLICY)
    assert [m["episode/count"].tolist() for m in metrics] == [[0] * 4, [1] * 4, [1] * 4]
    assert np.isnan(metrics[0]["episode/return"]).all()
    for run in range(4):
        first, second = rollout.reward[run, :15, 0].sum(), rollout.reward[run, 15:, 0].sum()
        assert metrics[1]["episode/return"][run] == pytest.approx(first, rel=1e-4)
        assert metrics[2]["episode/return"][run] == pytest.approx(second, rel=1e-4)
        assert metrics[1]["episode/steps"][run] == metrics[2]["episode/steps"][run] == 15
    by_rollout = rollout.reward.reshape(4, 3, NUM_STEPS).mean(axis=-1)
    assert by_rollout.std() > 0


def test_a_master_is_traced_once_too(lively, monkeypatch):
    task = replace(ANT_MAZE, episode_steps=7)
    sub_policies = replace(lively)  # not those that another test has had traced
    env = AutoReset(Options(Env(task, BatchPhysics(task.robot, task.arena, N, 1), staggered=True), sub_policies, 2))
    master = categorical_policy(CONFIG, 34, 4)
    carry = start(env, jax.random.key(1))
    methods = ((AutoReset, "begin"), (AutoReset, "finish"), (SubPolicies, "act"), (Env, "finish"))
    calls = [count_calls(monkeypatch, owner, name) for owner, name in methods]
    _, rollout, _ = rollouts(env, master, num_runs=1, carry=carry)
    assert [len(found) for found in calls] == [1, 1, 1, 1]
    assert set(np.unique(rollout.action)) <= {0, 1, 2, 3}
    stays = ~(rollout.terminated | rollout.truncated)[:, :-1]
    np.testing.assert_array_equal(rollout.obs[:, 1:][stays], rollout.next_obs[:, :-1][stays])
    assert (rollout.truncated.sum(axis=1) >= 3).all()
    assert rollout.valid.all()  # a new episode begins with the next option


def test_the_hosts_loop_keeps_lax_scans_contract():
    def body(carry, x):
        return (carry[0] + x["a"], carry[1] * 2), {"sum": carry[0], "row": x["b"]}

    xs = {"a": jnp.arange(5.0), "b": jnp.arange(10.0).reshape(5, 2)}
    carry = (jnp.float32(1.0), jnp.int32(1))
    jax.tree.map(np.testing.assert_array_equal, host_scan(body, carry, xs), jax.lax.scan(body, carry, xs))


# ---------------------------------------------------------------- bad fields


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RandomStart(0), "steps must be >= 1, got 0"),
        (lambda: RandomRepeated(0, 1), "every must be >= 1, got 0"),
        (lambda: RandomRepeated(10, 10), r"duration must be < every \(10\), got 10"),
        (lambda: AppropriateBias(-1), "steps must be >= 1, got -1"),
        (lambda: Interleaved(4, 8), r"mean_steps must be >= every \(8\), got 4"),
        (lambda: directions_of_rows(10, range(4)), "10 rows do not divide among 4 directions"),
        (lambda: replace(walkers(), goal_index=(0, 1)), "goal_index must have one entry per row, got 2 for 8"),
        (lambda: Options(walkers(), lively_policies(), 0), "option_steps must be >= 1, got 0"),
        (
            lambda: Intervention(walkers(), AppropriateBias()),
            "appropriate bias needs the policies of the orthogonal directions",
        ),
        (
            lambda: regularise(walkers(), RandomStart(), symmetric=True),
            "a symmetric policy trains plain or interleaved, not with RandomStart",
        ),
    ],
)
def test_bad_fields_are_refused(make, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        make()


def test_the_rows_of_a_direction_stand_together():
    assert directions_of_rows(8, range(len(DIRECTIONS))) == (0, 0, 1, 1, 2, 2, 3, 3)


# ---------------------------------------------------------------- host_jit


def test_host_jit_gives_what_the_function_gives_and_passes_on_what_it_leaves_alone():
    def function(scale, state, shift):
        shifted = state["moves"] * scale + shift
        return {"moves": shifted, "stays": state["stays"]}, (state["host"], shifted)

    compiled = host_jit(function)
    state = {"moves": jnp.arange(3.0), "stays": jnp.ones(2), "host": np.arange(4, dtype=np.int32)}
    for scale in (2.0, 3.0):  # static: a trace of its own
        expected, (_, shifted) = jax.jit(function, static_argnums=0)(scale, state, jnp.float32(0.5))
        result, (host, second) = compiled(scale, state, jnp.float32(0.5))
        np.testing.assert_array_equal(result["moves"], expected["moves"])
        np.testing.assert_array_equal(second, shifted)
        assert result["stays"] is state["stays"]
        assert host is state["host"]


def test_host_jit_within_a_jit_is_part_of_it():
    compiled = host_jit(lambda scale, x, y: (x * scale, y))
    result, y = jax.jit(lambda x, y: compiled(2.0, x, y))(jnp.ones(2), jnp.zeros(2))
    np.testing.assert_array_equal(result, 2.0)
    np.testing.assert_array_equal(y, 0.0)
