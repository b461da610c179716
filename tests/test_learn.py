"""Laws of the learner: advantages by hand, heads against Monte Carlo, PPO on problems with known answers."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from footwork.learn import ppo
from footwork.learn.config import PAPER, PPOConfig
from footwork.learn.gae import gae
from footwork.learn.networks import Categorical, Gaussian, categorical_policy, gaussian_policy
from footwork.types import Handovers, Transition

SMALL = PPOConfig(
    num_envs=4,
    num_steps=6,
    update_epochs=2,
    num_minibatches=3,
    hidden_sizes=(8, 8),
    learning_rate=1e-2,
    ent_coef=0.0,
)
PROBE = PPOConfig(
    num_envs=8,
    num_steps=64,
    update_epochs=4,
    num_minibatches=4,
    hidden_sizes=(16, 16),
    learning_rate=1e-3,
    gamma=0.5,
    min_log_std=-1.0,
)
POLICIES = {
    "gaussian": partial(gaussian_policy, action_size=2),
    "categorical": partial(categorical_policy, num_actions=3),
}

# Most of the time here is compilation: ask for quick code, compile once per policy and config, and share it.
QUICKLY = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
jit = partial(jax.jit, compiler_options=QUICKLY)
update = jit(ppo.update, static_argnums=(0, 1))
digest = jit(ppo.digest, static_argnums=(0, 1))
init = jit(ppo.init, static_argnums=(0, 1))
loss_and_gradient = jit(jax.value_and_grad(ppo.loss, argnums=2, has_aux=True), static_argnums=(0, 1))


advantages = jit(gae, static_argnums=(5, 6))


def column(*numbers):
    return jnp.array(numbers)[:, None]


def make_policy(kind, config, obs_size=3):
    return POLICIES[kind](config, obs_size)


@partial(jit, static_argnums=(0, 1))
def make_rollout(policy, shape, params, key):
    """Noise for observations and rewards, some ends, and actions of ``params`` itself."""
    keys = jax.random.split(key, 6)
    obs, next_obs = (jax.random.normal(k, (*shape, policy.obs_size)) for k in keys[:2])
    action, log_prob = policy.act(params, obs, keys[2])
    terminated, truncated = (jax.random.bernoulli(k, 0.1, shape) for k in keys[3:5])
    reward = jax.random.normal(keys[5], shape)
    return Transition(obs, action, log_prob, reward, terminated, truncated, next_obs, jnp.ones(shape, bool))


@cache
def started(kind, config, seed=0):
    policy = make_policy(kind, config)
    state = init(policy, PPOConfig(max_grad_norm=config.max_grad_norm), jax.random.key(seed))  # all that init reads
    shape = (config.num_steps, config.num_envs)
    return policy, state, make_rollout(policy, shape, state.params, jax.random.key(seed + 100))


def all_finite(tree):
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


# ---------------------------------------------------------------- configuration


def test_paper_is_table_1():
    table = (PAPER.learning_rate, PAPER.gamma, PAPER.gae_lambda, PAPER.clip_eps, PAPER.vf_coef)
    assert table == (3e-4, 0.99, 0.95, 0.2, 0.5)
    assert (PAPER.update_epochs, PAPER.num_minibatches, PAPER.batch_size) == (10, 32, 2048)
    assert (PAPER.loss, PAPER.max_grad_norm, PAPER.minibatch_size) == ("clip", None, None)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("num_minibatches", 0, "num_minibatches must be >= 1, got 0"),
        ("minibatch_size", -4, "minibatch_size must be >= 1, got -4"),
        ("learning_rate", 0.0, "learning_rate must be > 0, got 0.0"),
        ("learning_rate", float("nan"), "learning_rate must be > 0, got nan"),
        ("clip_eps", -0.1, "clip_eps must be > 0, got -0.1"),
        ("gamma", 1.1, "gamma must be >= 0 and <= 1, got 1.1"),
        ("gae_lambda", -0.1, "gae_lambda must be >= 0 and <= 1, got -0.1"),
        ("vf_coef", -1.0, "vf_coef must be >= 0, got -1.0"),
        ("max_grad_norm", 0.0, "max_grad_norm must be > 0, got 0.0"),
        ("initial_log_std", 3.0, "initial_log_std must be > -5 and < 2, got 3.0"),
        ("hidden_sizes", (), r"hidden_sizes must name at least one layer, got \(\)"),
        ("hidden_sizes", (64, 0), "hidden_sizes must be >= 1, got 0"),
    ],
)
def test_config_refuses_nonsense(field, value, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        PPOConfig(**{field: value})


@pytest.mark.parametrize(("field", "value"), [("num_envs", 2.0), ("hidden_sizes", (64, 1.5)), ("loss", "trust")])
def test_config_refuses_wrong_types(field, value):
    with pytest.raises((ValueError, TypeError), match=field):  # TypeError where the array checks are on (conftest.py)
        PPOConfig(**{field: value})


def test_b_as_a_count_and_as_a_size():
    assert [PPOConfig(num_minibatches=32).count_minibatches(s) for s in (2048, 40, 20)] == [32, 32, 20]
    assert [PPOConfig(minibatch_size=32).count_minibatches(s) for s in (2048, 40, 20)] == [64, 2, 1]


# ---------------------------------------------------------------- advantages


@pytest.mark.parametrize(
    ("terminated", "truncated", "advantage"),
    [
        ((0, 0, 0), (0, 0, 0), (1.6875, 2.75, 3.0)),  # deltas 1, 2, 3 and a decay of 1/4
        ((0, 1, 0), (0, 0, 0), (1.25, 1.0, 3.0)),  # the second step loses its future of 0.5 * 2
        ((0, 0, 0), (0, 1, 0), (1.5, 2.0, 3.0)),  # the future's value stays, the sum ends
        ((0, 0, 0), (0, 0, 1), (1.6875, 2.75, 3.0)),  # at the end of the rollout there is no sum to end
        ((0, 1, 0), (0, 1, 0), (1.25, 1.0, 3.0)),  # death wins over a time limit
    ],
)
def test_gae_by_hand(terminated, truncated, advantage):
    reward, value, next_value = column(1.0, 2.0, 3.0), column(0.5, 1.0, 2.0), column(1.0, 2.0, 4.0)
    got, returns = advantages(reward, value, next_value, column(*terminated) > 0, column(*truncated) > 0, 0.5, 0.5)
    np.testing.assert_allclose(got[:, 0], advantage)
    np.testing.assert_allclose(returns[:, 0], np.add(advantage, (0.5, 1.0, 2.0)))


def test_gae_keeps_rows_apart_and_nan_behind_an_end():
    reward = jnp.array([[1.0, 5.0], [jnp.nan, 7.0]])
    value = jnp.zeros((2, 2))
    next_value = jnp.array([[jnp.nan, 1.0], [0.0, 2.0]])
    terminated = jnp.array([[True, False], [False, False]])
    advantage, _ = advantages(reward, value, next_value, terminated, jnp.zeros((2, 2), bool), 0.5, 0.5)
    assert advantage[0, 0] == 1.0  # a death's successor and the next episode do not matter
    np.testing.assert_allclose(advantage[:, 1], (5.5 + 0.25 * 8.0, 8.0))


def test_expected_handovers_are_the_mean_over_their_outcomes():
    """With lambda 1 a return is that of the rows which the chance spares, and of those that it does not, by odds."""
    config = replace(SMALL, gamma=0.9, gae_lambda=1.0)
    policy, state, rollout = started("gaussian", config)
    never = jnp.zeros_like(rollout.terminated)
    other_value = jax.random.normal(jax.random.key(5), never.shape)
    chance = jnp.full(never.shape, 0.3)
    next_obs = jnp.concatenate((rollout.obs[1:], rollout.next_obs[-1:]))
    rollout = rollout._replace(terminated=never, truncated=never, next_obs=next_obs)
    rollout = rollout._replace(handovers=Handovers(chance, other_value))
    expected = digest(policy, config, state.params, rollout)[0].return_.reshape(never.shape)
    last_value = policy.value(state.params, rollout.next_obs[-1])
    outcome = 0.0  # of the first step's return: taken over after step k, or never
    for k in range(config.num_steps):
        earned = sum(config.gamma**i * rollout.reward[i] for i in range(k + 1))
        outcome += 0.3 * 0.7**k * (earned + config.gamma ** (k + 1) * other_value[k])
    outcome += 0.7**config.num_steps * (earned + config.gamma**config.num_steps * last_value)
    np.testing.assert_allclose(expected[0], outcome, rtol=1e-4, atol=1e-5)


# ---------------------------------------------------------------- heads


@pytest.mark.parametrize("head", [Gaussian(2), Categorical(5)])
def test_entropy_and_kl_agree_with_monte_carlo(head):
    @jit
    def both_ways(key):
        old, new = 0.7 * jax.random.normal(key, (2, head.num_outputs))
        many_old, many_new = (jnp.broadcast_to(x, (200_000, head.num_outputs)) for x in (old, new))
        action = head.sample(many_old, key)
        log_p, log_q = head.log_prob(many_old, action), head.log_prob(many_new, action)
        exact = head.entropy(old), head.kl(old, new), head.kl(old, old)
        return exact, (-log_p.mean(), (log_p - log_q).mean(), 0.0)

    exact, sampled = both_ways(jax.random.key(1))
    np.testing.assert_allclose(exact, sampled, atol=0.02)
    assert exact[2] == pytest.approx(0.0, abs=1e-6)


def test_probabilities_sum_to_one():
    logits = np.random.default_rng(0).normal(size=5).astype(np.float32)
    log_p = jit(Categorical(5).log_prob)(jnp.asarray(np.tile(logits, (5, 1))), jnp.arange(5))
    assert np.exp(log_p).sum() == pytest.approx(1.0, abs=1e-6)
    axis = np.linspace(-8.0, 8.0, 401, dtype=np.float32)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1)
    outputs = np.broadcast_to(np.float32([0.5, -1.0, -0.3, 0.2]), (401, 401, 4))
    density = np.exp(jit(Gaussian(2).log_prob)(jnp.asarray(outputs), jnp.asarray(grid)))
    assert density.sum() * (axis[1] - axis[0]) ** 2 == pytest.approx(1.0, abs=1e-4)


def test_log_std_is_bounded_and_starts_where_it_is_told():
    head = Gaussian(1, min_log_std=-3.0, max_log_std=1.0, initial_log_std=-0.5)

    def log_std(raw):
        return head.mean_and_log_std(jnp.stack((0.0 * raw, raw)))[1][0]

    raw = jnp.array([0.0, -1e9, 1e9, -5.0, 5.0])
    value, slope = jit(jax.vmap(jax.value_and_grad(log_std)))(raw)
    np.testing.assert_allclose(value[:3], (-0.5, -3.0, 1.0), atol=1e-6)
    assert slope[0] == pytest.approx(1.0, abs=1e-5)
    assert min(slope[3:]) > 0.0


@pytest.mark.parametrize("kind", POLICIES)
def test_act_reports_the_probability_of_what_it_did(kind):
    policy, (params, *_), rollout = started(kind, SMALL)

    @jit
    def judge(obs, action):
        outputs = policy.outputs(params, obs)
        best = policy.mode(params, obs)
        return policy.head.log_prob(outputs, action), policy.head.log_prob(outputs, best), policy.value(params, obs)

    log_prob, log_prob_of_mode, value = judge(rollout.obs, rollout.action)
    assert rollout.log_prob.shape == value.shape == (6, 4)
    np.testing.assert_allclose(rollout.log_prob, log_prob, rtol=1e-5)
    assert (np.asarray(log_prob_of_mode) >= np.asarray(log_prob)).all()


def test_actor_and_critic_share_nothing():
    policy, (params, *_), rollout = started("gaussian", SMALL)

    @jit
    def gradients(obs):
        of_value = jax.grad(lambda p: policy.value(p, obs).sum())(params)
        return of_value["actor"], jax.grad(lambda p: policy.outputs(p, obs).sum())(params)["critic"]

    assert not any(np.any(leaf) for leaf in jax.tree.leaves(gradients(rollout.obs)))


# ---------------------------------------------------------------- PPO where the answer is known

# Six situations, told apart by a one-hot observation. The fifth and sixth pay for the right action.
PAYS_AND_ENDS, PAYS_AND_IS_CUT, COSTS_AND_ENDS, LEADS_TO_PAY, LEFT, RIGHT = range(6)
KNOWN_VALUES = (1.0, 2.0, -1.0, 0.5)  # with gamma 1/2: 1; 1 + 1/2 + 1/4 + ...; -1; 1/2 * 1


def earned(situation, action):
    """The best Gaussian action is (-0.5, -0.5) at LEFT and (0.5, 0.5) at RIGHT, the best choice 0 and 2."""
    if action.ndim == situation.ndim:
        right_one = (action == jnp.where(situation == LEFT, 0, 2)).astype(jnp.float32)
    else:
        miss = action - jnp.where(situation == LEFT, -0.5, 0.5)[..., None]
        right_one = jnp.exp(-jnp.sum(miss**2, axis=-1))
    return jnp.where(situation >= LEFT, right_one, jnp.array([1.0, 1.0, -1.0, 0.0, 0.0, 0.0])[situation])


@cache
def trained(kind, loss):
    """A policy after 100 updates on the six situations, and the metrics of every update."""
    config = replace(PROBE, loss=loss)
    policy = make_policy(kind, config, 6)
    shape = (config.num_steps, config.num_envs)

    def improve(state, key):
        obs_key, act_key, update_key = jax.random.split(key, 3)
        situation = jax.random.randint(obs_key, shape, 0, 6)
        obs = jax.nn.one_hot(situation, 6)
        action, log_prob = policy.act(state.params, obs, act_key)
        goes_on = (situation == PAYS_AND_IS_CUT) | (situation == LEADS_TO_PAY)
        next_obs = jax.nn.one_hot(jnp.where(situation == LEADS_TO_PAY, PAYS_AND_ENDS, situation), 6)
        reward, valid = earned(situation, action), jnp.ones(shape, bool)
        rollout = Transition(obs, action, log_prob, reward, ~goes_on, goes_on, next_obs, valid)
        return ppo.update(policy, config, state, rollout, update_key)

    state = init(policy, config, jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), 100)
    return policy, *jit(partial(jax.lax.scan, improve))(state, keys)


EACH_FORM = pytest.mark.parametrize(
    ("kind", "loss"), [("gaussian", "clip"), ("categorical", "clip"), ("gaussian", "penalty")]
)


@EACH_FORM
def test_values_are_the_known_ones(kind, loss):
    policy, state, metrics = trained(kind, loss)
    np.testing.assert_allclose(policy.value(state.params, jnp.eye(6)[:4]), KNOWN_VALUES, atol=0.15)
    assert metrics["explained_variance"][-1] > metrics["explained_variance"][0]


@EACH_FORM
def test_the_action_that_pays_is_learned(kind, loss):
    policy, state, metrics = trained(kind, loss)
    best = policy.mode(state.params, jnp.eye(6)[LEFT:])
    if kind == "categorical":
        assert best.tolist() == [0, 2]
        assert metrics["entropy"][-1] < metrics["entropy"][0]
    else:
        np.testing.assert_allclose(best, [[-0.5, -0.5], [0.5, 0.5]], atol=0.15)


def test_the_learner_sees_scaled_rewards():
    policy, state, rollout = started("gaussian", SMALL)
    full, _, _ = digest(policy, SMALL, state.params, rollout)
    half, _, _ = digest(policy, replace(SMALL, reward_scale=0.5), state.params, rollout)
    same, _, _ = digest(policy, SMALL, state.params, rollout._replace(reward=0.5 * rollout.reward))
    np.testing.assert_allclose(half.return_, same.return_, rtol=1e-5, atol=1e-6)
    assert not np.allclose(half.return_, full.return_)


# ---------------------------------------------------------------- the update


@pytest.mark.parametrize("loss", ["clip", "penalty"])
@pytest.mark.parametrize("kind", POLICIES)
def test_invalid_samples_have_no_effect_at_all(kind, loss):
    config = replace(SMALL, loss=loss)
    policy, state, rollout = started(kind, config)
    valid = jax.random.bernoulli(jax.random.key(5), 0.6, rollout.valid.shape)
    rollout = rollout._replace(valid=valid)
    flipped = Transition(
        obs=jnp.nan * rollout.obs,
        action=jnp.zeros_like(rollout.action),
        log_prob=rollout.log_prob + 7.0,
        reward=jnp.nan * rollout.reward,
        terminated=~rollout.terminated,
        truncated=~rollout.truncated,
        next_obs=jnp.nan * rollout.next_obs,
        valid=valid,
    )

    def mix(kept, other):
        return jnp.where(valid.reshape(valid.shape + (1,) * (kept.ndim - 2)), kept, other)

    clean = update(policy, config, state, rollout, jax.random.key(1))
    dirty = update(policy, config, state, jax.tree.map(mix, rollout, flipped), jax.random.key(1))
    jax.tree.map(np.testing.assert_array_equal, clean, dirty)
    assert all_finite(clean)
    assert clean[1]["valid_fraction"] == pytest.approx(float(valid.mean()))


def test_a_rollout_without_valid_samples_changes_nothing():
    policy, state, rollout = started("gaussian", SMALL)
    state, _ = update(policy, SMALL, state, rollout, jax.random.key(0))  # Adam has momentum now
    nothing = rollout._replace(valid=jnp.zeros_like(rollout.valid))
    after, metrics = update(policy, SMALL, state, nothing, jax.random.key(1))
    assert after.num_updates == 2
    jax.tree.map(np.testing.assert_array_equal, after._replace(num_updates=state.num_updates), state)
    assert all_finite(metrics)


@pytest.mark.parametrize(("size", "num_minibatches"), [(40, 32), (40, 7), (64, 4), (5, 5)])
def test_every_valid_sample_is_used_once_per_epoch(size, num_minibatches):
    deal = jit(partial(ppo.minibatches, num_minibatches=num_minibatches, num_epochs=3))
    for share in (1.0, 0.7, 0.1, 0.0):
        valid = np.random.default_rng(size).random(size) < share
        index, mask = (np.asarray(x) for x in deal(jnp.asarray(valid), key=jax.random.key(0)))
        assert index.shape == mask.shape == (3, num_minibatches, -(-size // num_minibatches))
        for epoch in range(3):
            assert sorted(index[epoch][mask[epoch]]) == np.flatnonzero(valid).tolist()
        sizes = mask.sum(axis=-1)
        assert sizes.max() - sizes.min() <= 1
        assert valid[index].all() or not valid.any()
        np.testing.assert_array_equal(mask[..., 0], sizes > 0)
        if valid.sum() > 8:
            assert not np.array_equal(index[0], index[1])


@pytest.mark.parametrize(
    ("batch", "num_minibatches"),
    [({"num_minibatches": 32}, 32), ({"num_minibatches": 64}, 40), ({"minibatch_size": 32}, 2)],
)
def test_the_papers_uneven_batches_work(batch, num_minibatches):
    config = replace(SMALL, num_envs=8, num_steps=5, **batch)  # S = 40
    policy, state, rollout = started("categorical", config)
    after, metrics = update(policy, config, state, rollout, jax.random.key(0))
    assert all_finite((after, metrics))
    assert metrics["grad_norm"] > 0.0
    assert after.opt_state[0].count == num_minibatches * config.update_epochs


def test_the_first_gradient_is_taken_where_the_data_was():
    config = replace(SMALL, update_epochs=1, num_minibatches=1)
    policy, state, rollout = started("gaussian", config)
    after, metrics = update(policy, config, state, rollout, jax.random.key(0))
    assert metrics["clip_fraction"] == 0.0
    assert metrics["approx_kl"] == pytest.approx(0.0, abs=1e-6)
    assert metrics["policy_loss"] == pytest.approx(0.0, abs=1e-5)  # minus the mean of normalised advantages
    assert after.num_updates == 1


@pytest.mark.parametrize(("advantage", "old_is_lower", "pulls"), [(1, True, False), (-1, True, True), (1, False, True)])
def test_the_clip_lets_go_only_beyond_a_gain(advantage, old_is_lower, pulls):
    policy, state, rollout = started("gaussian", SMALL)
    samples, valid, _ = digest(policy, SMALL, state.params, rollout)
    shift = -0.4 if old_is_lower else 0.4  # ratios of 1.49 and 0.67, both outside 0.8..1.2
    samples = samples._replace(log_prob=samples.log_prob + shift, advantage=advantage * jnp.ones_like(samples.return_))
    (_, metrics), gradient = loss_and_gradient(policy, SMALL, state.params, samples, valid, state.kl_coef, 0.0)
    assert metrics["clip_fraction"] == 1.0
    assert any(np.any(leaf) for leaf in jax.tree.leaves(gradient["actor"])) == pulls


def test_the_gradient_norm_is_limited_when_asked():
    config = replace(SMALL, adam_eps=1e6, learning_rate=1e6)  # so large an eps makes Adam follow the plain gradient
    config = replace(config, update_epochs=1, num_minibatches=1, max_grad_norm=0.01)
    policy, state, rollout = started("gaussian", config)
    after, metrics = update(policy, config, state, rollout, jax.random.key(0))
    changes = jax.tree.map(lambda a, b: np.sum((np.asarray(a) - np.asarray(b)) ** 2), after.params, state.params)
    assert np.sqrt(sum(jax.tree.leaves(changes))) == pytest.approx(0.01, rel=1e-2)
    assert metrics["grad_norm"] > 0.1  # reported as it was


def test_the_entropy_bonus_widens_the_policy():
    policy, state, rollout = started("gaussian", SMALL)
    samples, valid, _ = digest(policy, SMALL, state.params, rollout)
    samples = samples._replace(advantage=jnp.zeros_like(samples.advantage))  # nothing but entropy to gain

    def pull(ent_coef):
        _, gradient = loss_and_gradient(policy, SMALL, state.params, samples, valid, state.kl_coef, ent_coef)
        return gradient["actor"]["output"]["bias"][2:]  # the raw deviations

    np.testing.assert_array_equal(pull(0.0), 0.0)
    assert jnp.all(pull(0.5) < 0.0)  # descent raises them


def test_the_entropy_bonus_falls_to_nothing():
    annealed = replace(SMALL, ent_coef=0.5, anneal_updates=10, final_learning_rate_share=1.0)
    policy, state, rollout = started("gaussian", annealed)

    def learned(config, num_updates):
        later = state._replace(num_updates=jnp.int32(num_updates))
        after, _ = update(policy, config, later, rollout, jax.random.key(0))
        return ravel_pytree(after.params)[0]

    for updates, share in ((0, 1.0), (5, 0.5), (10, 0.0), (1000, 0.0)):
        constant = learned(replace(SMALL, ent_coef=0.5 * share), updates)
        np.testing.assert_allclose(learned(annealed, updates), constant, atol=1e-6)
    assert not np.allclose(learned(annealed, 0), learned(annealed, 5), atol=1e-5)


def test_the_learning_rate_falls_to_its_last_share():
    annealed = replace(SMALL, update_epochs=1, num_minibatches=1, anneal_updates=4, final_learning_rate_share=0.25)
    policy, state, rollout = started("gaussian", annealed)

    def step_size(config, num_updates):
        """The first step of Adam is the learning rate long in every parameter that has a gradient."""
        later = state._replace(num_updates=jnp.int32(num_updates))
        after, _ = update(policy, config, later, rollout, jax.random.key(0))
        return np.abs(ravel_pytree(after.params)[0] - ravel_pytree(state.params)[0]).max()

    constant = step_size(replace(annealed, anneal_updates=None), 0)
    shares = [step_size(annealed, updates) / constant for updates in (0, 2, 4, 1000)]
    assert shares == pytest.approx([1.0, 0.625, 0.25, 0.25], rel=1e-2)


def test_the_penalty_charges_for_distance_from_the_old_policy():
    config = replace(SMALL, loss="penalty")
    policy, state, rollout = started("gaussian", config)
    samples, valid, _ = digest(policy, config, state.params, rollout)
    old_outputs = samples.old_outputs.at[:, 0].add(0.6)  # at a deviation of 1: a divergence of 0.6^2 / 2
    samples = samples._replace(old_outputs=old_outputs, advantage=jnp.zeros_like(samples.advantage))
    for kl_coef in (0.0, 1.0, 3.0):
        (_, metrics), _ = loss_and_gradient(policy, config, state.params, samples, valid, jnp.float32(kl_coef), 0.0)
        assert metrics["policy_loss"] == pytest.approx(0.18 * kl_coef, rel=0.05)


def test_the_penalty_adapts_both_ways():
    policy, state, rollout = started("gaussian", replace(SMALL, loss="penalty"))
    after = {}
    for target in (1e-9, 1e9):
        config = replace(SMALL, loss="penalty", target_kl=target)
        new, metrics = update(policy, config, state, rollout, jax.random.key(0))
        after[target] = float(new.kl_coef)
        assert metrics["kl"] > 0.0
        assert metrics["kl_coef"] == new.kl_coef
    assert after == {1e-9: 2.0, 1e9: 0.5}
    assert ppo.adapt_kl_coef(jnp.float32(3.0), jnp.float32(0.012), 0.01) == 3.0
    clipped, _ = update(policy, SMALL, state, rollout, jax.random.key(0))
    assert clipped.kl_coef == state.kl_coef


def test_runs_side_by_side_learn_what_they_learn_alone():
    runs = [started("gaussian", SMALL, seed) for seed in range(3)]
    policy = runs[0][0]
    keys = jax.random.split(jax.random.key(9), 3)
    states, rollouts = (jax.tree.map(lambda *x: jnp.stack(x), *[run[i] for run in runs]) for i in (1, 2))
    together = jit(jax.vmap(partial(ppo.update, policy, SMALL)))(states, rollouts, keys)
    for i, (_, state, rollout) in enumerate(runs):
        one = jax.tree.map(lambda x, i=i: x[i], together)
        alone = update(policy, SMALL, state, rollout, keys[i])
        jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-4), one, alone)


def test_an_update_is_traced_once_and_repeats_itself():
    policy, state, rollout = started("gaussian", SMALL)
    traces = []

    @jit
    def counted(state, rollout, key):
        traces.append(key)
        return ppo.update(policy, SMALL, state, rollout, key)

    first, metrics = counted(state, rollout, jax.random.key(0))
    again, _ = counted(state, rollout, jax.random.key(0))
    jax.tree.map(np.testing.assert_array_equal, first, again)
    counted(first, rollout._replace(valid=rollout.valid.at[0].set(False)), jax.random.key(1))
    assert len(traces) == 1
    assert all(x.shape == () and x.dtype == jnp.float32 for x in metrics.values())
    assert set(metrics) >= {"policy_loss", "value_loss", "entropy", "approx_kl", "clip_fraction", "grad_norm"}
    assert set(metrics) >= {"explained_variance", "kl_coef", "advantage_std", "valid_fraction"}
