"""Environments: a task on a physics engine, and the protocol that every wrapper keeps.

A step has three phases, so that everything but the engine is pure and is compiled
into two calls per control step, however many wrappers there are:

* ``begin(state, action, key)``   pure: decides what the ants will do
* ``simulate(state, key)``        the engine moves; on a C engine this is host code
* ``finish(state, key)``          pure: rewards, ends, observations

Nothing resets by itself: a row whose episode ended is held, costs nothing and earns
nothing until ``restart`` begins its next episode. The engine learns of a restart
lazily, at its next step: ``stale`` marks the rows it must overwrite first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial, wraps
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from footwork.tasks.task import Task, last_finite
from footwork.types import Array, Bool, Float, Int, Key, Physics, PhysicsState, TimeStep

# What a host loop calls is small and full of random bits: to optimise them takes XLA seconds, and gains nothing.
_COMPILER_OPTIONS = {"xla_backend_optimization_level": 1}


class Environment(Protocol):
    """What Env, its wrappers and Options have in common. ``state`` is a pytree of the environment's own."""

    @property
    def num_envs(self) -> int:
        """N."""

    @property
    def physics(self) -> Physics:
        """The engine at the bottom."""

    def initial(self, key: Key) -> tuple[Any, Array]:
        """A first episode in every row: (state, obs [N, D])."""

    def begin(self, state: Any, action: Array, key: Key) -> Any:
        """Take the policy's action, pure."""

    def simulate(self, state: Any, key: Key) -> Any:
        """Let the engine move."""

    def finish(self, state: Any, key: Key) -> tuple[Any, TimeStep]:
        """What the step brought, pure."""

    def restart(self, state: Any, mask: Bool[Array, " N"], key: Key) -> tuple[Any, Array]:
        """Begin a new episode in the masked rows, pure: (state, obs [N, D])."""


class EnvState(NamedTuple):
    """N ants on one task."""

    physics: PhysicsState
    previous: PhysicsState  # before the last control step
    action: Float[Array, "N 8"]
    goal: Float[Array, "N 2"]  # m
    t: Int[Array, " N"]  # control steps of this episode so far
    held: Bool[Array, " N"]  # the episode has ended and no new one has begun
    stale: Bool[Array, " N"]  # the engine has yet to be told of this row's restart


@jax.tree_util.register_pytree_node_class
@dataclass(frozen=True)
class _Changes:
    """What a function returned, less the leaves that it returned as they were given."""

    leaves: list[Any]
    source: tuple[int | None, ...]  # of every leaf of the result: its place among the arguments' leaves, None: changed
    tree: Any  # the result's structure

    def tree_flatten(self) -> tuple[list[Any], tuple[Any, Any]]:
        return self.leaves, (self.source, self.tree)

    @classmethod
    def tree_unflatten(cls, static: tuple[Any, Any], leaves: Any) -> _Changes:
        return cls(list(leaves), *static)

    def applied_to(self, given: list[Any]) -> Any:
        """The function's result."""
        changed = iter(self.leaves)
        return self.tree.unflatten([next(changed) if place is None else given[place] for place in self.source])


@cache
def _is_traced(kind: type) -> bool:
    return issubclass(kind, jax.core.Tracer)


def host_jit(function: Callable[..., Any], num_static: int = 1) -> Callable[..., Any]:
    """``jax.jit`` for the calls of a host loop; the first ``num_static`` arguments are static.

    A state has some forty leaves, and a phase of a step changes few of them. XLA would
    copy all others, which on a CPU takes longer than the phase: they pass by instead.
    Within somebody else's jit the function is part of that.
    """

    @partial(jax.jit, static_argnums=tuple(range(num_static)), compiler_options=_COMPILER_OPTIONS)
    @wraps(function)
    def changes(*args: Any) -> _Changes:
        places = {id(leaf): place for place, leaf in enumerate(jax.tree.leaves(args[num_static:]))}
        leaves, tree = jax.tree.flatten(function(*args))
        source = tuple(places.get(id(leaf)) for leaf in leaves)
        return _Changes([leaf for leaf, place in zip(leaves, source, strict=True) if place is None], source, tree)

    @wraps(function)
    def call(*args: Any) -> Any:
        given = jax.tree.leaves(args[num_static:])
        if any(map(_is_traced, map(type, given))):
            return function(*args)
        return changes(*args).applied_to(given)

    return call


@dataclass(frozen=True, eq=False)
class Env:
    """Task x Physics.

    Args:
        task: what is observed, rewarded and ended.
        physics: the engine, with the task's arena in it.
        goal_index: [N], the goal of each row among the task's; None: drawn anew in every episode.
        staggered: rows begin their first episodes at random times, so that a rollout holds all
            phases of an episode and not the same one of every row. For training.
    """

    task: Task
    physics: Physics
    goal_index: tuple[int, ...] | None = None
    staggered: bool = False

    def __post_init__(self) -> None:
        if self.goal_index is not None and len(self.goal_index) != self.num_envs:
            raise ValueError(f"goal_index must have one entry per row, got {len(self.goal_index)} for {self.num_envs}")
        if self.goal_index is not None and max(self.goal_index) >= len(self.task.goals):
            raise ValueError(
                f"{self.task.name} has {len(self.task.goals)} goals, goal_index names {max(self.goal_index)}"
            )

    @property
    def num_envs(self) -> int:
        """N."""
        return self.physics.num_envs

    def initial(self, key: Key) -> tuple[EnvState, Array]:
        """All rows at the start of an episode."""
        return _first_episodes(self, self.physics.initial(), key)

    def begin(self, state: EnvState, action: Array, key: Key) -> EnvState:
        """Hand the action to the engine, as the policy gave it."""
        return state._replace(action=action)

    def simulate(self, state: EnvState, key: Key) -> EnvState:
        """One control step of the rows that are not held."""
        before = state.physics
        physics = self.physics.reset(before, state.stale, before.qpos, before.qvel)
        if physics is not before:  # progress counts from where the engine sees a fresh ant
            xp = jnp if self.physics.traceable else np
            before = before._replace(qpos=xp.where(xp.asarray(state.stale)[:, None], physics.qpos, before.qpos))
        if self.physics.traceable:
            moved = self.physics.step(physics, state.action, ~state.held)
        else:
            held = np.asarray(state.held)
            moved = self.physics.step(physics, state.action, ~held if held.any() else None)
        xp = jnp if self.physics.traceable else np  # outside jit, an operation of JAX costs as much as 10 ants
        return state._replace(physics=moved, previous=before, stale=xp.zeros(self.num_envs, bool))

    def finish(self, state: EnvState, key: Key) -> tuple[EnvState, TimeStep]:
        """Reward and end of the step; a held row earns nothing and ends nothing."""
        active = ~state.held
        t = state.t + active
        step = self.task.advance(state.previous, state.action, state.physics, state.goal, t)
        step = step._replace(
            reward=step.reward * active,
            terms={name: value * active for name, value in step.terms.items()},
            terminated=step.terminated & active,
            truncated=step.truncated & active,
            valid=step.valid & active,
        )
        done = step.terminated | step.truncated
        physics = last_finite(state.previous, state.physics)  # a row that diverged stays where it last was
        return state._replace(physics=physics, t=t, held=state.held | done), step

    def restart(self, state: EnvState, mask: Bool[Array, " N"], key: Key) -> tuple[EnvState, Array]:
        """A new episode in the masked rows, airborne: no foot touches anything yet."""
        pose_key, goal_key = jax.random.split(key)
        qpos, qvel = self.task.reset_pose(pose_key, self.num_envs)
        if self.goal_index is None:
            index = jax.random.randint(goal_key, (self.num_envs,), 0, len(self.task.goals))
        else:
            index = jnp.array(self.goal_index)
        goal = jnp.where(mask[:, None], jnp.asarray(self.task.goals)[index], state.goal)
        old = state.physics
        physics = old._replace(
            qpos=jnp.where(mask[:, None], qpos, old.qpos),
            qvel=jnp.where(mask[:, None], qvel, old.qvel),
            foot_contact=jnp.where(mask[:, None], 0.0, old.foot_contact),
            foot_collision=jnp.where(mask[:, None], 0.0, old.foot_collision),
            diverged=old.diverged & ~mask,
        )
        state = state._replace(
            physics=physics,
            goal=goal,
            t=jnp.where(mask, 0, state.t),
            held=state.held & ~mask,
            stale=state.stale | mask,
        )
        return state, self.task.observe(physics, goal)


@host_jit  # step by step, JAX would compile each operation for itself: seconds
def _first_episodes(env: Env, physics: PhysicsState, key: Key) -> tuple[EnvState, Array]:
    off = jnp.zeros(env.num_envs, bool)
    state = EnvState(
        physics=physics,
        previous=physics,
        action=jnp.zeros((env.num_envs, 8)),
        goal=jnp.zeros((env.num_envs, 2)),
        t=jnp.zeros(env.num_envs, jnp.int32),
        held=off,
        stale=off,
    )
    state, obs = env.restart(state, ~off, key)
    if env.staggered:
        t = jax.random.randint(jax.random.fold_in(key, 1), (env.num_envs,), 0, env.task.episode_steps)
        state = state._replace(t=t)
    return state, obs


def split_phases(key: Key) -> tuple[Key, Key, Key]:
    """Keys for the three phases of a step."""
    begin, simulate, finish = jax.random.split(key, 3)
    return begin, simulate, finish


def step(env: Environment, state: Any, action: Array, key: Key) -> tuple[Any, TimeStep]:
    """One whole step of any environment."""
    begin_key, simulate_key, finish_key = split_phases(key)
    state = env.begin(state, action, begin_key)
    state = simulate(env, state, simulate_key)
    return env.finish(state, finish_key)


def simulate(env: Environment, state: Any, key: Key) -> Any:
    """``env.simulate``, from the host: one compiled call on a traceable engine, which then need not come back."""
    return _compiled_simulate(env, state, key) if env.physics.traceable else env.simulate(state, key)


@partial(jax.jit, static_argnums=0)
def _compiled_simulate(env: Environment, state: Any, key: Key) -> Any:
    return env.simulate(state, key)


def host_scan(body: Any, carry: Any, xs: Any) -> tuple[Any, Any]:
    """``lax.scan``'s contract as a Python loop, for bodies that step a C engine; outputs are stacked as numpy."""
    outputs = []
    for i in range(len(jax.tree.leaves(xs)[0])):
        carry, y = body(carry, jax.tree.map(lambda leaf, i=i: leaf[i], xs))
        outputs.append(y)
    return carry, jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *outputs)


def scan_over(physics: Physics) -> Any:
    """The loop that a body stepping ``physics`` runs under."""
    return jax.lax.scan if physics.traceable else host_scan


def loop_over(physics: Physics, body: Any) -> Any:
    """``body`` in that loop, as a function of carry and xs; on a traceable engine all of it is compiled, once."""
    return jax.jit(partial(jax.lax.scan, body)) if physics.traceable else partial(host_scan, body)
