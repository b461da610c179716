"""Reward terms, each a function of arrays; the weights are PyBullet's walker's (FACTS: WalkerBaseBulletEnv).

A term here is unweighted. The paper names the terms (section 3.1) without weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp

from footwork.types import Array, Bool, Float

AT_LIMIT = 0.99  # |scaled position| beyond which a joint is stuck at its limit


@dataclass(frozen=True)
class RewardWeights:
    """Weight of each term; a term's value times its weight is what metrics report."""

    progress: float = 1.0
    alive: float = 1.0
    electricity: float = -2.0
    stall_torque: float = -0.1
    joints_at_limit: float = -0.1
    feet_collision: float = -1.0  # switched off in PyBullet's own code; the paper has it
    flip: float = 0.0  # once per step upside down; not in the paper
    goal: float = 0.0  # once, in the step that ends inside the goal radius; not in the paper


WALKER_WEIGHTS = RewardWeights()
# On tasks with a goal, reaching it ends the episode: a bonus for staying alive would pay for staying away.
PENALISED_WEIGHTS = RewardWeights(alive=0.0)
FREE_WEIGHTS = RewardWeights(alive=0.0, electricity=0.0, stall_torque=0.0, joints_at_limit=0.0, feet_collision=0.0)


def straight_progress(
    before: Float[Array, "N 2"], now: Float[Array, "N 2"], goal: Float[Array, "N 2"], dt: float
) -> Float[Array, " N"]:
    """Speed towards the goal in m/s: the drop of the distance over dt.

    Written as a product of displacement and distance sums, since at 10 km a float32
    distance has steps of 1 mm, 0.06 of reward.
    """
    far, near = goal - before, goal - now
    total = jnp.linalg.norm(far, axis=-1) + jnp.linalg.norm(near, axis=-1)
    drop = jnp.sum((now - before) * (far + near), axis=-1) / jnp.maximum(total, 1e-6)
    return drop / dt


def alive(fallen: Bool[Array, " N"]) -> Float[Array, " N"]:
    """+1 while standing, -1 in the step of a fall."""
    return jnp.where(fallen, -1.0, 1.0)


def electricity(action: Float[Array, "N 8"], joint_speed: Float[Array, "N 8"]) -> Float[Array, " N"]:
    """Mean power drawn, in units of action times scaled joint speed."""
    return jnp.mean(jnp.abs(action * joint_speed), axis=-1)


def stall_torque(action: Float[Array, "N 8"]) -> Float[Array, " N"]:
    """Mean squared action: torque costs even where nothing moves."""
    return jnp.mean(jnp.square(action), axis=-1)


def joints_at_limit(joint_position: Float[Array, "N 8"]) -> Float[Array, " N"]:
    """Number of joints stuck at a limit."""
    return jnp.sum(jnp.abs(joint_position) > AT_LIMIT, axis=-1).astype(jnp.float32)


def feet_collision(foot_collision: Float[Array, "N 4"]) -> Float[Array, " N"]:
    """Number of feet that touch another foot."""
    return jnp.sum(foot_collision, axis=-1)
