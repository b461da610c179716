"""Actor and critic as plain pytrees, and the two action distributions they speak through.

The networks are the paper's (Section 4): actor and critic are separate, each with
two tanh layers of 64 units, and a Gaussian's mean and variance both depend on the
state. Letters beside those of :mod:`footwork.types`: ``O`` what the actor puts out
for its head, ``A`` action component, ``*B`` any batch axes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp

from footwork.learn.config import PPOConfig
from footwork.types import Array, Float, Int, Key, Params

HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


@runtime_checkable
class Head(Protocol):
    """A family of action distributions, parametrised by the actor's linear outputs.

    Every method treats the last axis of ``outputs`` as the parameters of one
    distribution and all axes before it as a batch.
    """

    @property
    def num_outputs(self) -> int:
        """O, the number of linear outputs the actor must have."""

    def sample(self, outputs: Float[Array, "*B O"], key: Key) -> Any:
        """Draw one action per distribution."""

    def mode(self, outputs: Float[Array, "*B O"]) -> Any:
        """The most likely action of each distribution."""

    def log_prob(self, outputs: Float[Array, "*B O"], action: Any) -> Float[Array, "*B"]:
        """The log of the probability (or density) of ``action``."""

    def entropy(self, outputs: Float[Array, "*B O"]) -> Float[Array, "*B"]:
        """In nats; of a density, so it may be negative."""

    def kl(self, outputs_old: Float[Array, "*B O"], outputs_new: Float[Array, "*B O"]) -> Float[Array, "*B"]:
        """KL(old || new), in nats."""


@dataclass(frozen=True)
class Gaussian:
    """A diagonal Gaussian over actions in R^A; whoever executes an action clips it.

    The outputs are A means and A raw deviations. A raw deviation x becomes a log_std
    through a sigmoid from ``min_log_std`` to ``max_log_std``, placed so that x = 0
    gives ``initial_log_std`` with slope 1. A hard clip would have no gradient beyond
    its bounds, and a state that strayed there could never come back by itself.
    """

    action_size: int
    min_log_std: float = -5.0
    max_log_std: float = 2.0
    initial_log_std: float = 0.0

    @property
    def num_outputs(self) -> int:
        return 2 * self.action_size

    def mean_and_log_std(self, outputs: Float[Array, "*B O"]) -> tuple[Float[Array, "*B A"], Float[Array, "*B A"]]:
        """The distribution's parameters, each one per action component."""
        mean, raw = jnp.split(outputs, 2, axis=-1)
        span = self.max_log_std - self.min_log_std
        level = (self.initial_log_std - self.min_log_std) / span
        slope = 1.0 / (span * level * (1.0 - level))
        return mean, self.min_log_std + span * jax.nn.sigmoid(slope * raw + math.log(level / (1.0 - level)))

    def sample(self, outputs: Float[Array, "*B O"], key: Key) -> Float[Array, "*B A"]:
        mean, log_std = self.mean_and_log_std(outputs)
        return mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape, mean.dtype)

    def mode(self, outputs: Float[Array, "*B O"]) -> Float[Array, "*B A"]:
        return self.mean_and_log_std(outputs)[0]

    def log_prob(self, outputs: Float[Array, "*B O"], action: Float[Array, "*B A"]) -> Float[Array, "*B"]:
        mean, log_std = self.mean_and_log_std(outputs)
        standardised = (action - mean) * jnp.exp(-log_std)
        return -jnp.sum(0.5 * standardised**2 + log_std + HALF_LOG_2PI, axis=-1)

    def entropy(self, outputs: Float[Array, "*B O"]) -> Float[Array, "*B"]:
        return jnp.sum(self.mean_and_log_std(outputs)[1] + (0.5 + HALF_LOG_2PI), axis=-1)

    def kl(self, outputs_old: Float[Array, "*B O"], outputs_new: Float[Array, "*B O"]) -> Float[Array, "*B"]:
        mean_old, log_std_old = self.mean_and_log_std(outputs_old)
        mean_new, log_std_new = self.mean_and_log_std(outputs_new)
        log_ratio = log_std_old - log_std_new
        shift = (mean_old - mean_new) * jnp.exp(-log_std_new)
        return jnp.sum(0.5 * (jnp.exp(2.0 * log_ratio) + shift**2 - 1.0) - log_ratio, axis=-1)


@dataclass(frozen=True)
class Categorical:
    """A choice among ``num_actions`` numbered actions; the outputs are its logits."""

    num_actions: int

    @property
    def num_outputs(self) -> int:
        return self.num_actions

    def sample(self, outputs: Float[Array, "*B O"], key: Key) -> Int[Array, "*B"]:
        return jax.random.categorical(key, outputs).astype(jnp.int32)

    def mode(self, outputs: Float[Array, "*B O"]) -> Int[Array, "*B"]:
        return jnp.argmax(outputs, axis=-1).astype(jnp.int32)

    def log_prob(self, outputs: Float[Array, "*B O"], action: Int[Array, "*B"]) -> Float[Array, "*B"]:
        log_p = jax.nn.log_softmax(outputs)
        return jnp.take_along_axis(log_p, action[..., None], axis=-1)[..., 0]

    def entropy(self, outputs: Float[Array, "*B O"]) -> Float[Array, "*B"]:
        log_p = jax.nn.log_softmax(outputs)
        return -jnp.sum(jnp.exp(log_p) * log_p, axis=-1)

    def kl(self, outputs_old: Float[Array, "*B O"], outputs_new: Float[Array, "*B O"]) -> Float[Array, "*B"]:
        log_p, log_q = jax.nn.log_softmax(outputs_old), jax.nn.log_softmax(outputs_new)
        return jnp.sum(jnp.exp(log_p) * (log_p - log_q), axis=-1)


@dataclass(frozen=True)
class Policy:
    """An actor and a critic of the same shape, which share nothing but their input.

    The parameters are ``{"actor": net, "critic": net}``; a net is
    ``{"hidden_1": layer, ..., "output": layer}``, a layer ``{"weight": [in, out], "bias": [out]}``.
    """

    obs_size: int
    head: Head
    hidden_sizes: tuple[int, ...] = (64, 64)

    def init(self, key: Key) -> Params:
        """Orthogonal weights with gain sqrt 2, 0.01 for the head and 1 for the value; zero biases.

        The paper does not say how it starts. The small gain makes the first policy
        nearly the same in every state.
        """
        actor_key, critic_key = jax.random.split(key)
        actor = _init_net(actor_key, (self.obs_size, *self.hidden_sizes, self.head.num_outputs), 0.01)
        critic_key = _once_there(actor["output"]["weight"], critic_key)
        return {"actor": actor, "critic": _init_net(critic_key, (self.obs_size, *self.hidden_sizes, 1), 1.0)}

    def outputs(self, params: Params, obs: Float[Array, "*B D"]) -> Float[Array, "*B O"]:
        """What the actor tells its head."""
        return _apply_net(params["actor"], obs)

    def value(self, params: Params, obs: Float[Array, "*B D"]) -> Float[Array, "*B"]:
        """The critic's estimate of the discounted return from ``obs`` on."""
        return _apply_net(params["critic"], obs)[..., 0]

    def act(self, params: Params, obs: Float[Array, "*B D"], key: Key) -> tuple[Any, Float[Array, "*B"]]:
        """Draw an action for every row of ``obs``; returns it with its log-probability."""
        outputs = self.outputs(params, obs)
        action = self.head.sample(outputs, key)
        return action, self.head.log_prob(outputs, action)

    def mode(self, params: Params, obs: Float[Array, "*B D"]) -> Any:
        """The most likely action in every row, for evaluation without exploration."""
        return self.head.mode(self.outputs(params, obs))


def gaussian_policy(config: PPOConfig, obs_size: int, action_size: int) -> Policy:
    """A policy over R^action_size, as sub-policies and flat policies are."""
    head = Gaussian(action_size, config.min_log_std, config.max_log_std, config.initial_log_std)
    return Policy(obs_size, head, config.hidden_sizes)


def categorical_policy(config: PPOConfig, obs_size: int, num_actions: int) -> Policy:
    """A policy over ``num_actions`` choices, as the master is."""
    return Policy(obs_size, Categorical(num_actions), config.hidden_sizes)


def _init_net(key: Key, sizes: tuple[int, ...], output_gain: float) -> Params:
    num_layers = len(sizes) - 1
    names = [f"hidden_{i + 1}" for i in range(num_layers - 1)] + ["output"]
    gains = [math.sqrt(2.0)] * (num_layers - 1) + [output_gain]
    net: dict[str, Params] = {}
    for i, layer_key in enumerate(jax.random.split(key, num_layers)):
        if i > 0:
            layer_key = _once_there(net[names[i - 1]]["weight"], layer_key)
        weight = jax.nn.initializers.orthogonal(gains[i])(layer_key, (sizes[i], sizes[i + 1]), jnp.float32)
        net[names[i]] = {"weight": weight, "bias": jnp.zeros(sizes[i + 1], jnp.float32)}
    return net


def _once_there(weight: Array, key: Key) -> Key:
    """The key, but not before the weight is computed.

    Two QR factorisations of one program may each hold a thread of XLA's pool and wait for ever for
    another (seen with jaxlib 0.10.2 on two cores), so they take turns. XLA drops an
    ``optimization_barrier`` before it schedules, but it cannot know that no weight is NaN.
    """
    data = jax.random.key_data(key)
    return jax.random.wrap_key_data(jnp.where(jnp.isnan(weight[0, 0]), ~data, data), impl=jax.random.key_impl(key))


def _apply_net(net: Params, x: Float[Array, "*B d_in"]) -> Float[Array, "*B d_out"]:
    for i in range(len(net) - 1):
        layer = net[f"hidden_{i + 1}"]
        x = jnp.tanh(x @ layer["weight"] + layer["bias"])
    return x @ net["output"]["weight"] + net["output"]["bias"]


__all__ = ["Categorical", "Gaussian", "Head", "Policy", "categorical_policy", "gaussian_policy"]
