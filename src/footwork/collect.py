"""Collect: run a policy in an environment and return what a learner needs."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from footwork.env import Environment, host_jit, scan_over, split_phases
from footwork.learn.networks import Policy
from footwork.types import Array, Float, Int, Key, Params, Transition


class Carry(NamedTuple):
    """Where a rollout stopped and the next one goes on."""

    state: Any
    obs: Float[Array, "N D"]
    sums: EpisodeSums


class EpisodeSums(NamedTuple):
    """The unfinished episode of each row so far."""

    terms: dict[str, Float[Array, " N"]]
    steps: Int[Array, " N"]


class Tally(NamedTuple):
    """Per step and row, what is counted and never learned from; axes [T, N]."""

    terms: dict[str, Any]
    events: dict[str, Any]
    done: Any  # the row's episode ended with this step


def start(env: Environment, key: Key) -> Carry:
    """A first episode in every row."""
    state, obs = env.initial(key)
    _, shape = jax.eval_shape(env.finish, state, key)
    zeros = {name: jnp.zeros(env.num_envs) for name in shape.terms}
    return Carry(state, obs, EpisodeSums(zeros, jnp.zeros(env.num_envs, jnp.int32)))


def collect(
    env: Environment, policy: Policy, params: Params, carry: Carry, key: Key, num_steps: int
) -> tuple[Carry, Transition, dict[str, Array]]:
    """Run ``num_steps`` steps of R policies, each on its block of N / R rows.

    Args:
        env: N rows, in R equal blocks.
        policy: the network common to all runs.
        params: leading axis R.
        carry: from :func:`start` or the last rollout.
        key: of this rollout.
        num_steps: T.

    Returns:
        The carry, the transitions with axes [R, T, N / R, ...], and per-run episode
        statistics (see :func:`_episode_metrics`).
    """
    run = _compiled_rollout if env.physics.traceable else _rollout
    return run(env, policy, num_steps, params, carry, key)


def _rollout(env: Environment, policy: Policy, num_steps: int, params: Params, carry: Carry, key: Key) -> Any:
    body = partial(_environment_step, env, policy, params, key)
    rollout = (carry.state, carry.obs)
    (state, obs), (transition, tally) = scan_over(env.physics)(body, rollout, np.arange(num_steps))
    num_runs = jax.tree.leaves(params)[0].shape[0]
    sums, transition, metrics = _summarise(num_runs, carry.sums, transition, tally)
    return Carry(state, obs, sums), transition, metrics


_compiled_rollout = jax.jit(_rollout, static_argnums=(0, 1, 2))  # all steps in one program, on the engine's device


def _environment_step(env: Environment, policy: Policy, params: Params, key: Key, rollout: Any, t: Any) -> Any:
    state, obs = rollout
    state, action, log_prob, simulate_key, finish_key = _act(env, policy, params, state, obs, key, t)
    state = env.simulate(state, simulate_key)
    state, step = _advance(env, state, finish_key)
    transition = Transition(
        obs=obs,
        action=action,
        log_prob=log_prob,
        reward=step.reward,
        terminated=step.terminated,
        truncated=step.truncated | step.handover,
        next_obs=step.next_obs,
        valid=step.valid,
    )
    return (state, step.obs), (transition, Tally(step.terms, step.events, step.terminated | step.truncated))


@partial(host_jit, num_static=2)
def _act(env: Environment, policy: Policy, params: Params, state: Any, obs: Array, key: Key, t: Any) -> Any:
    """The first jitted call of a step: every run's policy on its own rows, and the environment's begin."""
    act_key, env_key = jax.random.split(jax.random.fold_in(key, t))
    begin_key, simulate_key, finish_key = split_phases(env_key)
    num_runs = jax.tree.leaves(params)[0].shape[0]
    rows = obs.reshape(num_runs, -1, obs.shape[-1])
    action, log_prob = jax.vmap(policy.act)(params, rows, jax.random.split(act_key, num_runs))
    action = action.reshape(obs.shape[:1] + action.shape[2:])
    return env.begin(state, action, begin_key), action, log_prob.reshape(-1), simulate_key, finish_key


@host_jit
def _advance(env: Environment, state: Any, key: Key) -> Any:
    """The second jitted call of a step."""
    return env.finish(state, key)


@host_jit
def _summarise(num_runs: int, sums: EpisodeSums, transition: Transition, tally: Tally) -> Any:
    """Transitions by run, and the episodes that ended in this rollout."""

    def add(sums: EpisodeSums, now: tuple[dict[str, Array], Array]) -> tuple[EpisodeSums, EpisodeSums]:
        terms, done = now
        total = EpisodeSums({k: v + terms[k] for k, v in sums.terms.items()}, sums.steps + 1)
        return jax.tree.map(lambda leaf: jnp.where(done, 0, leaf), total), total

    sums, totals = jax.lax.scan(add, sums, (tally.terms, tally.done))
    by_run = partial(jax.tree.map, lambda leaf: _split_runs(leaf, num_runs))
    transition, tally, totals = by_run(transition), by_run(tally), by_run(totals)
    return sums, transition, jax.vmap(_episode_metrics)(tally, totals)


def _split_runs(leaf: Array, num_runs: int) -> Array:
    """[T, R * n, ...] to [R, T, n, ...]."""
    return jnp.moveaxis(leaf.reshape(leaf.shape[0], num_runs, -1, *leaf.shape[2:]), 1, 0)


def _episode_metrics(tally: Tally, totals: EpisodeSums) -> dict[str, Array]:
    """Of one run: means over the episodes that ended in the rollout (NaN where none did), and counts.

    An interleaved row's episode passes through several ants; its sums are the row's.
    """
    count = jnp.sum(tally.done)
    mean = lambda value: jnp.sum(jnp.where(tally.done, value, 0.0)) / count  # noqa: E731
    terms = {f"episode/{name}": mean(value) for name, value in totals.terms.items()}
    counts = {name: jnp.sum(tally.events[name]) for name in ("fallen", "flipped", "diverged", "reached")}
    return {
        **terms,
        "episode/return": sum(terms.values(), jnp.zeros(())),
        "episode/steps": mean(totals.steps),
        "episode/count": count,
        **{f"count/{name}": value for name, value in counts.items()},
        "rollout/progress": jnp.mean(tally.terms["progress"]),
    }
