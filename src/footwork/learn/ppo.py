"""Proximal policy optimisation of one run, as a pure function of arrays.

The paper's Section 7 with the clipped objective, or with the adaptive KL penalty;
both after Schulman et al. 2017 (equations 7 and 8). Written for one run: batch over
runs from outside with ``jax.vmap``, ``jax.lax.map`` or ``shard_map``. Letters beside
those of :mod:`footwork.types`: ``S`` sample of the whole batch (T times N),
``I`` epoch, ``M`` minibatch of an epoch, ``B`` slot of a minibatch.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from footwork.learn.config import PPOConfig
from footwork.learn.gae import gae
from footwork.learn.networks import Policy
from footwork.types import Array, Bool, Float, Int, Key, Metrics, Params, Transition


class TrainState(NamedTuple):
    """All that a learner carries from one update to the next."""

    params: Params
    opt_state: Any  # Adam's, over the parameters laid out as one vector
    kl_coef: Float[Array, ""]  # moves in the penalty form only
    num_updates: Int[Array, ""]


class Samples(NamedTuple):
    """A rollout digested for the epochs: what one gradient needs of each step."""

    obs: Float[Array, "S D"]
    action: Any  # Float[Array, "S A"] or Int[Array, "S"]
    log_prob: Float[Array, " S"]
    advantage: Float[Array, " S"]
    return_: Float[Array, " S"]
    old_outputs: Any  # Float[Array, "S O"] in the penalty form, else ()


def init(policy: Policy, config: PPOConfig, key: Key) -> TrainState:
    """A fresh learner."""
    params = policy.init(key)
    opt_state = _optimizer(config).init(ravel_pytree(params)[0])
    return TrainState(params, opt_state, jnp.float32(config.initial_kl_coef), jnp.int32(0))


def update(
    policy: Policy, config: PPOConfig, train_state: TrainState, transition: Transition, key: Key
) -> tuple[TrainState, Metrics]:
    """Improve the policy on one rollout [T, N, ...] of it; ``key`` shuffles.

    Steps that are not valid have no part in it, whatever their arrays hold. T and N
    are those of the rollout. The metrics are float32 scalars: means over the
    minibatches of all epochs, except for those that describe the rollout.
    """
    samples, valid, metrics = digest(policy, config, train_state.params, transition)
    num_minibatches = config.count_minibatches(valid.size)
    index, mask = minibatches(valid, num_minibatches, config.update_epochs, key)
    vector, unravel = ravel_pytree(train_state.params)
    optimizer = _optimizer(config)
    ent_coef = config.ent_coef * anneal(config, config.final_ent_coef_share, train_state.num_updates)
    step_scale = anneal(config, config.final_learning_rate_share, train_state.num_updates)
    coefs = (train_state.kl_coef, ent_coef)

    # One vector of parameters makes Adam one fused loop in place of twelve small ones.
    def take_step(carry: tuple[Array, Any], minibatch: tuple[Array, Array]) -> tuple[tuple[Array, Any], Metrics]:
        index, mask = minibatch
        batch = jax.tree.map(lambda x: x[index], samples)
        gradient_of = jax.value_and_grad(loss, argnums=2, has_aux=True)
        (_, step_metrics), gradient = gradient_of(policy, config, unravel(carry[0]), batch, mask, *coefs)
        gradient = ravel_pytree(gradient)[0]
        change, opt_state = optimizer.update(gradient, carry[1])
        step_metrics["grad_norm"] = jnp.linalg.norm(gradient)
        moved = (carry[0] + step_scale * change, opt_state)
        return jax.tree.map(lambda new, old: jnp.where(mask[0], new, old), moved, carry), step_metrics

    one_epoch = partial(jax.lax.scan, take_step)
    (vector, opt_state), per_step = jax.lax.scan(one_epoch, (vector, train_state.opt_state), (index, mask))
    params, filled = unravel(vector), mask[..., 0]
    metrics |= {name: _mean(x, filled) for name, x in per_step.items()}
    kl_coef = train_state.kl_coef
    if config.loss == "penalty":
        divergence = policy.head.kl(samples.old_outputs, policy.outputs(params, samples.obs))
        metrics["kl"] = _mean(divergence, valid)
        kl_coef = adapt_kl_coef(kl_coef, metrics["kl"], config.target_kl)
    metrics["kl_coef"] = kl_coef
    return TrainState(params, opt_state, kl_coef, train_state.num_updates + 1), metrics


def digest(
    policy: Policy, config: PPOConfig, params: Params, transition: Transition
) -> tuple[Samples, Bool[Array, " S"], Metrics]:
    """Advantages and returns of a rollout, flattened; with the mask of its valid samples and metrics of the whole.

    The sum of later rewards also ends before a step that is not valid, so that what
    somebody else earned never counts for the learner. Where others may take a row over,
    the expectation over that chance stands in place of its outcome: a successor is worth
    the mixture of both values, and later rewards count as far as they are still the learner's.
    """
    value, next_value = policy.value(params, jnp.stack((transition.obs, transition.next_obs)))
    gae_lambda: Any = config.gae_lambda
    if transition.handovers is not None:
        chance, other_value = transition.handovers
        next_value = next_value + chance * (other_value - next_value)
        gae_lambda = gae_lambda * (1.0 - chance)
    next_valid = jnp.concatenate((transition.valid[1:], jnp.ones_like(transition.valid[:1])))
    advantage, return_ = gae(
        config.reward_scale * transition.reward,
        value,
        next_value,
        transition.terminated,
        transition.truncated | ~next_valid,
        config.gamma,
        gae_lambda,
    )
    valid = transition.valid
    std = jnp.sqrt(_variance(advantage, valid))
    explained = 1.0 - _variance(return_ - value, valid) / jnp.maximum(_variance(return_, valid), 1e-8)
    metrics = {
        "explained_variance": explained,
        "advantage_std": std,
        "valid_fraction": jnp.mean(valid, dtype=jnp.float32),
    }
    if config.normalize_advantage:
        advantage = (advantage - _mean(advantage, valid)) / (std + 1e-8)
    old_outputs = policy.outputs(params, transition.obs) if config.loss == "penalty" else ()
    samples = Samples(transition.obs, transition.action, transition.log_prob, advantage, return_, old_outputs)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), samples), valid.reshape(-1), metrics


def minibatches(
    valid: Bool[Array, " S"], num_minibatches: int, num_epochs: int, key: Key
) -> tuple[Int[Array, "I M B"], Bool[Array, "I M B"]]:
    """Which sample stands in which slot: a fresh shuffle per epoch, dealt out evenly.

    Each valid sample is in exactly one slot of every epoch, and the minibatches of an
    epoch differ in size by one at most. Slots left over are masked and name a valid
    sample all the same, so that nothing invalid is ever gathered; a minibatch's
    first slot is masked only if there are fewer valid samples than minibatches.
    """
    size = valid.size
    num_slots = -(-size // num_minibatches)
    rank = jax.random.bits(key, (num_epochs, size), jnp.uint32) >> 1
    order = jnp.argsort(jnp.where(valid, rank, jnp.uint32(2**32 - 1)), axis=-1)
    bounds = jnp.arange(num_minibatches + 1) * jnp.sum(valid) // num_minibatches
    place = bounds[:-1, None] + jnp.arange(num_slots)
    mask = place < bounds[1:, None]
    index = order[:, jnp.where(mask, place, 0)]
    return index, jnp.broadcast_to(mask, index.shape)


def loss(
    policy: Policy,
    config: PPOConfig,
    params: Params,
    batch: Samples,
    mask: Bool[Array, " B"],
    kl_coef: Float[Array, ""],
    ent_coef: Float[Array, ""],
) -> tuple[Float[Array, ""], Metrics]:
    """The objective of one minibatch, to be minimised, and its parts.

    Policy surrogate + vf_coef * squared error of the value - ent_coef * entropy, each a
    mean over the samples in ``mask``. The two coefficients move from update to update.
    """
    outputs = policy.outputs(params, batch.obs)
    log_ratio = policy.head.log_prob(outputs, batch.action) - batch.log_prob
    ratio = jnp.exp(log_ratio)
    if config.loss == "clip":
        clipped = jnp.clip(ratio, 1.0 - config.clip_eps, 1.0 + config.clip_eps)
        surrogate = jnp.minimum(ratio * batch.advantage, clipped * batch.advantage)
    else:
        surrogate = ratio * batch.advantage - kl_coef * policy.head.kl(batch.old_outputs, outputs)
    metrics = {
        "policy_loss": -_mean(surrogate, mask),
        "value_loss": _mean((policy.value(params, batch.obs) - batch.return_) ** 2, mask),
        "entropy": _mean(policy.head.entropy(outputs), mask),
        "approx_kl": _mean(ratio - 1.0 - log_ratio, mask),
        "clip_fraction": _mean((jnp.abs(ratio - 1.0) > config.clip_eps).astype(ratio.dtype), mask),
    }
    total = metrics["policy_loss"] + config.vf_coef * metrics["value_loss"] - ent_coef * metrics["entropy"]
    return total, metrics


def anneal(config: PPOConfig, final_share: float, num_updates: Int[Array, ""]) -> Float[Array, ""]:
    """The factor of a coefficient after ``num_updates`` updates: 1, or on its linear way to ``final_share``."""
    if config.anneal_updates is None:
        return jnp.float32(1.0)
    return 1.0 - (1.0 - final_share) * jnp.minimum(1.0, num_updates / config.anneal_updates)


def adapt_kl_coef(kl_coef: Float[Array, ""], kl: Float[Array, ""], target_kl: float) -> Float[Array, ""]:
    """Halve the penalty after an update well short of the target, double it after one well beyond.

    The factors 1.5 and 2 are those of Schulman et al. 2017, Section 4.
    """
    return jnp.where(kl < target_kl / 1.5, kl_coef / 2.0, jnp.where(kl > target_kl * 1.5, kl_coef * 2.0, kl_coef))


def _optimizer(config: PPOConfig) -> optax.GradientTransformation:
    adam = optax.adam(config.learning_rate, eps=config.adam_eps)
    if config.max_grad_norm is None:
        return adam
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), adam)


def _mean(x: Float[Array, "..."], mask: Bool[Array, "..."]) -> Float[Array, ""]:
    """Mean where ``mask`` holds, 0 where it holds nowhere; the rest may be NaN."""
    return jnp.sum(jnp.where(mask, x, 0.0)) / jnp.maximum(jnp.sum(mask), 1)


def _variance(x: Float[Array, "..."], mask: Bool[Array, "..."]) -> Float[Array, ""]:
    return _mean((x - _mean(x, mask)) ** 2, mask)


__all__ = ["Samples", "TrainState", "adapt_kl_coef", "anneal", "digest", "init", "loss", "minibatches", "update"]
