"""Regularisers: ways to make a sub-policy meet states it did not bring about (paper, section 6).

Each regulariser is a wrapper that acts now and then in the learner's place; it never
touches a state. Steps taken by somebody else are not ``valid``, so they weigh nothing
in the losses, and ``handover`` stops a return where somebody else acts next.

The paper names no length t; the defaults here are ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from footwork.env import Env, EnvState
from footwork.learn.networks import Policy
from footwork.options import SubPolicies
from footwork.tasks.observe import turn_action, turn_observation
from footwork.types import Array, Bool, Float, Handovers, Int, Key, Params, Physics, TimeStep, Transition

NUM_DIRECTIONS = 4


def _at_least(minimum: int, **fields: int) -> None:
    for name, value in fields.items():
        if value < minimum:
            raise ValueError(f"{name} must be >= {minimum}, got {value}")


@dataclass(frozen=True)
class RandomStart:
    """Random actions for the first ``steps`` control steps of an episode (the paper's t)."""

    steps: int = 50

    def __post_init__(self) -> None:
        _at_least(1, steps=self.steps)


@dataclass(frozen=True)
class RandomRepeated:
    """Random actions for ``duration`` control steps, ``every`` control steps (the paper's t)."""

    every: int = 100
    duration: int = 10

    def __post_init__(self) -> None:
        _at_least(1, every=self.every, duration=self.duration)
        if self.duration >= self.every:
            raise ValueError(f"duration must be < every ({self.every}), got {self.duration}")


@dataclass(frozen=True)
class AppropriateBias:
    """The learned policy of a random orthogonal direction walks the first ``steps`` control steps (t)."""

    steps: int = 100
    partners: str = "walker/plain"  # the row whose policies they are

    def __post_init__(self) -> None:
        _at_least(1, steps=self.steps)


@dataclass(frozen=True)
class Interleaved:
    """Ours: the directions train together, and ants change hands between them at random times.

    Every policy so learns from the states that the others really leave behind. At every
    ``every``-th step each ant is up for exchange with a probability that makes a stay last
    ``mean_steps`` on average; an exchange among four directions brings one in four ants
    back to its own, so that its stays with one direction last a third longer. With a
    symmetric policy the ant changes direction instead.

    With ``cooperative`` a policy also cares for what it leaves behind: its returns count
    the chance of a hand-over, and what the ant is then worth to the others.
    """

    mean_steps: int = 40
    every: int = 8
    cooperative: bool = True

    def __post_init__(self) -> None:
        _at_least(1, mean_steps=self.mean_steps, every=self.every)
        if self.mean_steps < self.every:
            raise ValueError(f"mean_steps must be >= every ({self.every}), got {self.mean_steps}")

    def due(self, clock: Int[Array, ""], num_envs: int, key: Key) -> Bool[Array, " N"]:
        """Rows whose stay ends now."""
        chance = jax.random.uniform(key, (num_envs,)) < self.every / self.mean_steps
        return chance & (clock % self.every == 0)


Regulariser = RandomStart | RandomRepeated | AppropriateBias | Interleaved


def others_turn(regulariser: RandomStart | RandomRepeated | AppropriateBias, t: Int[Array, " N"]) -> Bool[Array, " N"]:
    """Whether somebody else acts at step ``t`` (from 0) of an episode."""
    if isinstance(regulariser, RandomRepeated):
        return (t % regulariser.every) >= regulariser.every - regulariser.duration
    return t < regulariser.steps


class InterventionState(NamedTuple):
    """The environment below, and who intervenes."""

    inner: EnvState
    obs: Float[Array, "N 32"]  # what the partner acts on
    partner: Int[Array, " N"]  # direction of the partner of this episode
    acted: Bool[Array, " N"]  # the last action was not the learner's


@dataclass(frozen=True, eq=False)
class Intervention:
    """Random start, random repeated and appropriate bias: noise or a partner acts in place of the learner.

    Args:
        inner: the walking task, rows grouped by direction in ``env.goal_index``.
        regulariser: when, and whether noise or a partner.
        partners: the learned policies of the four directions (appropriate bias only).
    """

    inner: Env
    regulariser: RandomStart | RandomRepeated | AppropriateBias
    partners: SubPolicies | None = None

    def __post_init__(self) -> None:
        if isinstance(self.regulariser, AppropriateBias) and self.partners is None:
            raise ValueError("appropriate bias needs the policies of the orthogonal directions")

    @property
    def num_envs(self) -> int:
        """N."""
        return self.inner.num_envs

    @property
    def physics(self) -> Physics:
        """The engine below."""
        return self.inner.physics

    def initial(self, key: Key) -> tuple[InterventionState, Array]:
        """A first episode in every row."""
        inner_key, partner_key = jax.random.split(key)
        inner, obs = self.inner.initial(inner_key)
        return InterventionState(inner, obs, self._draw_partners(partner_key), jnp.zeros(self.num_envs, bool)), obs

    def begin(self, state: InterventionState, action: Array, key: Key) -> InterventionState:
        """The learner's action, or somebody else's."""
        acted = others_turn(self.regulariser, state.inner.t)
        other = self._other_action(state, key)
        inner = self.inner.begin(state.inner, jnp.where(acted[:, None], other, action), key)
        return state._replace(inner=inner, acted=acted)

    def simulate(self, state: InterventionState, key: Key) -> InterventionState:
        """The engine moves."""
        return state._replace(inner=self.inner.simulate(state.inner, key))

    def finish(self, state: InterventionState, key: Key) -> tuple[InterventionState, TimeStep]:
        """The inner step, marked with who took it and who acts next."""
        inner, step = self.inner.finish(state.inner, key)
        next_acted = others_turn(self.regulariser, inner.t)
        step = step._replace(valid=step.valid & ~state.acted, handover=next_acted & ~state.acted)
        return state._replace(inner=inner, obs=step.obs), step

    def restart(self, state: InterventionState, mask: Bool[Array, " N"], key: Key) -> tuple[InterventionState, Array]:
        """A new episode, with a new partner."""
        inner_key, partner_key = jax.random.split(key)
        inner, obs = self.inner.restart(state.inner, mask, inner_key)
        partner = jnp.where(mask, self._draw_partners(partner_key), state.partner)
        obs = jnp.where(mask[:, None], obs, state.obs)
        return state._replace(inner=inner, obs=obs, partner=partner), obs

    def _draw_partners(self, key: Key) -> Int[Array, " N"]:
        """For every row one of the two directions orthogonal to its own."""
        side = 1 + 2 * jax.random.bernoulli(key, shape=(self.num_envs,)).astype(jnp.int32)
        return (jnp.array(self.inner.goal_index) + side) % NUM_DIRECTIONS

    def _other_action(self, state: InterventionState, key: Key) -> Float[Array, "N 8"]:
        if isinstance(self.regulariser, AppropriateBias) and self.partners is not None:
            return self.partners.act(state.obs, state.partner, key)
        return jax.random.uniform(key, (self.num_envs, 8), minval=-1.0, maxval=1.0)


class InterleaveState(NamedTuple):
    """The ants, in the order of the learners' rows."""

    inner: EnvState
    clock: Int[Array, ""]


@dataclass(frozen=True, eq=False)
class Interleave:
    """Ants change hands between learners: rows exchange ants, a row keeps its goal.

    The exchange is a permutation among the rows that are due, so every learner keeps
    its number of rows. No simulation is touched: a row only drives another ant.

    Args:
        inner: the walking task.
        regulariser: when.
        num_groups: equal blocks of rows that do not mix (seeds).
    """

    inner: Env
    regulariser: Interleaved
    num_groups: int = 1

    @property
    def num_envs(self) -> int:
        """N."""
        return self.inner.num_envs

    @property
    def physics(self) -> Physics:
        """The engine below."""
        return self.inner.physics

    def initial(self, key: Key) -> tuple[InterleaveState, Array]:
        """A first episode in every row."""
        inner, obs = self.inner.initial(key)
        return InterleaveState(inner, jnp.zeros((), jnp.int32)), obs

    def begin(self, state: InterleaveState, action: Array, key: Key) -> InterleaveState:
        """Every learner acts on the ants it holds."""
        return state._replace(inner=self.inner.begin(state.inner, action, key))

    def simulate(self, state: InterleaveState, key: Key) -> InterleaveState:
        """The engine moves."""
        return state._replace(inner=self.inner.simulate(state.inner, key))

    def finish(self, state: InterleaveState, key: Key) -> tuple[InterleaveState, TimeStep]:
        """The inner step; then ants that are due, and whose episode goes on, change hands."""
        due_key, order_key = jax.random.split(key)
        inner, step = self.inner.finish(state.inner, key)
        clock = state.clock + 1
        due = self.regulariser.due(clock, self.num_envs, due_key) & ~(step.terminated | step.truncated)
        source = _permute_among(due, self.num_groups, order_key)
        moved = jax.tree.map(lambda leaf: leaf[source], inner)._replace(goal=inner.goal)
        handover = source != jnp.arange(self.num_envs)
        step = step._replace(obs=step.obs[source], handover=handover)
        return InterleaveState(moved, clock), step

    def restart(self, state: InterleaveState, mask: Bool[Array, " N"], key: Key) -> tuple[InterleaveState, Array]:
        """A new episode in the masked rows."""
        inner, obs = self.inner.restart(state.inner, mask, key)
        return state._replace(inner=inner), obs


def _permute_among(mask: Bool[Array, " N"], num_groups: int, key: Key) -> Int[Array, " N"]:
    """A permutation that is random among the masked rows of each group and leaves the others in place."""
    group = jnp.arange(mask.size) * num_groups // mask.size
    members = jnp.lexsort((~mask, group))
    shuffled = jnp.lexsort((jnp.where(mask, jax.random.uniform(key, mask.shape), 2.0), group))
    return jnp.zeros(mask.shape, jnp.int32).at[members].set(shuffled)


class SymmetricState(NamedTuple):
    """The environment below, and the direction in which each row's frame is turned."""

    inner: EnvState
    direction: Int[Array, " N"]
    clock: Int[Array, ""]


@dataclass(frozen=True, eq=False)
class Symmetric:
    """Ours: one policy in four frames. The ant is the same after a quarter turn, so it need learn only one walk.

    Observations are turned so that every row walks along +x, actions are turned back.
    With ``interleaved``, ants change direction at random times.
    """

    inner: Env
    interleaved: Interleaved | None = None

    @property
    def num_envs(self) -> int:
        """N."""
        return self.inner.num_envs

    @property
    def physics(self) -> Physics:
        """The engine below."""
        return self.inner.physics

    def initial(self, key: Key) -> tuple[SymmetricState, Array]:
        """A first episode in every row."""
        inner, obs = self.inner.initial(key)
        direction = jnp.array(self.inner.goal_index)
        return SymmetricState(inner, direction, jnp.zeros((), jnp.int32)), turn_observation(obs, direction)

    def begin(self, state: SymmetricState, action: Array, key: Key) -> SymmetricState:
        """Turn the action out of the policy's frame."""
        turned = turn_action(action, -state.direction)
        return state._replace(inner=self.inner.begin(state.inner, turned, key))

    def simulate(self, state: SymmetricState, key: Key) -> SymmetricState:
        """The engine moves."""
        return state._replace(inner=self.inner.simulate(state.inner, key))

    def finish(self, state: SymmetricState, key: Key) -> tuple[SymmetricState, TimeStep]:
        """The inner step in the policy's frame; then ants that are due change direction."""
        due_key, direction_key = jax.random.split(key)
        inner, step = self.inner.finish(state.inner, key)
        clock = state.clock + 1
        before = state.direction
        step = step._replace(next_obs=turn_observation(step.next_obs, before))
        if self.interleaved is None:
            return state._replace(inner=inner, clock=clock), step._replace(obs=step.next_obs)
        due = self.interleaved.due(clock, self.num_envs, due_key) & ~(step.terminated | step.truncated)
        turn = jax.random.randint(direction_key, (self.num_envs,), 1, NUM_DIRECTIONS)
        direction = jnp.where(due, (before + turn) % NUM_DIRECTIONS, before)
        goal = jnp.asarray(self.inner.task.goals)[direction]
        step = step._replace(obs=turn_observation(step.obs, direction), handover=due)
        return SymmetricState(inner._replace(goal=goal), direction, clock), step

    def restart(self, state: SymmetricState, mask: Bool[Array, " N"], key: Key) -> tuple[SymmetricState, Array]:
        """A new episode in the masked rows, in their present direction."""
        goal = state.inner.goal
        inner, obs = self.inner.restart(state.inner, mask, key)
        return state._replace(inner=inner._replace(goal=goal)), turn_observation(obs, state.direction)


def regularise(
    env: Env,
    regulariser: Regulariser | None,
    symmetric: bool = False,
    num_groups: int = 1,
    partners: SubPolicies | None = None,
) -> Env | Intervention | Interleave | Symmetric:
    """Wrap a walking environment as a row of the table asks."""
    if symmetric:
        if not isinstance(regulariser, Interleaved | None):
            raise ValueError(f"a symmetric policy trains plain or interleaved, not with {type(regulariser).__name__}")
        return Symmetric(env, regulariser)
    if regulariser is None:
        return env
    if isinstance(regulariser, Interleaved):
        return Interleave(env, regulariser, num_groups)
    return Intervention(env, regulariser, partners)


@partial(jax.jit, static_argnums=(0, 1, 2))
def expect_handovers(
    regulariser: Interleaved, symmetric: bool, policy: Policy, params: Params, transition: Transition
) -> Transition:
    """Tell every learner what the others expect of its ants, should they take over.

    Args:
        regulariser: how often they do.
        symmetric: one policy in four frames, instead of four policies per seed.
        policy: the network common to all runs.
        params: leading axis R: the seeds, and within each its directions.
        transition: axes [R, T, n, ...].

    Returns:
        The transition with its ``handovers``: per control step the chance of going to
        another direction, and the mean of the three other directions' values.
    """
    if symmetric:
        value = jax.vmap(partial(_value_in_other_frames, policy))(params, transition.next_obs)
        chance = 1.0 / regulariser.mean_steps
    else:
        by_seed = lambda leaf: leaf.reshape(-1, NUM_DIRECTIONS, *leaf.shape[1:])  # noqa: E731
        by_seeds = jax.tree.map(by_seed, (params, transition.next_obs))
        value = jax.vmap(partial(_value_to_other_directions, policy))(*by_seeds).reshape(transition.reward.shape)
        chance = (NUM_DIRECTIONS - 1) / NUM_DIRECTIONS / regulariser.mean_steps  # the exchange may bring one's own
    return transition._replace(handovers=Handovers(jnp.full_like(value, chance), value))


def _value_in_other_frames(policy: Policy, params: Params, obs: Float[Array, "T N 32"]) -> Float[Array, "T N"]:
    rows = obs.reshape(-1, obs.shape[-1])
    turns = jnp.arange(1, NUM_DIRECTIONS)[:, None].repeat(rows.shape[0], axis=1)
    value = policy.value(params, jax.vmap(turn_observation, in_axes=(None, 0))(rows, turns))
    return value.mean(axis=0).reshape(obs.shape[:-1])


def _value_to_other_directions(policy: Policy, params: Params, obs: Float[Array, "4 T N 32"]) -> Float[Array, "4 T N"]:
    value = jax.vmap(policy.value, in_axes=(0, None))(params, obs)  # axes: who values, whose ant
    own = jnp.diagonal(value).transpose(2, 0, 1)
    return (value.sum(axis=0) - own) / (NUM_DIRECTIONS - 1)


def directions_of_rows(num_envs: int, directions: Sequence[int]) -> tuple[int, ...]:
    """Rows in equal blocks, one per direction, in the order given."""
    if num_envs % len(directions):
        raise ValueError(f"{num_envs} rows do not divide among {len(directions)} directions")
    return tuple(np.repeat(directions, num_envs // len(directions)).tolist())
