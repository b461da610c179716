"""Generalised advantage estimation (Schulman et al. 2015b; the paper's Section 7)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from footwork.types import Array, Bool, Float


def gae(
    reward: Float[Array, "T N"],
    value: Float[Array, "T N"],
    next_value: Float[Array, "T N"],
    terminated: Bool[Array, "T N"],
    truncated: Bool[Array, "T N"],
    gamma: float,
    gae_lambda: float | Float[Array, "T N"],
) -> tuple[Float[Array, "T N"], Float[Array, "T N"]]:
    """Advantages, and the returns (advantage + value) that the critic is fitted to.

    ``next_value`` is the value of each step's own true successor, so nothing is
    shifted here and a reset between two steps does no harm. A terminated step has no
    future; a truncated one has the future that ``next_value`` promises. The sum over
    later steps ends at either. What lies beyond such an end is left out by selection
    and not by a factor of zero: it may be NaN, and stays without effect. ``gae_lambda``
    may differ from step to step.
    """
    delta = reward + gamma * jnp.where(terminated, 0.0, next_value) - value
    decay = jnp.broadcast_to(gamma * gae_lambda, delta.shape)

    def step_back(later: Array, now: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        delta_t, decay_t, ends = now
        advantage = delta_t + jnp.where(ends, 0.0, decay_t * later)
        return advantage, advantage

    steps = (delta, decay, terminated | truncated)
    _, advantage = jax.lax.scan(step_back, jnp.zeros_like(delta[0]), steps, reverse=True)
    return advantage, advantage + value


__all__ = ["gae"]
