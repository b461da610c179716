"""Options: the master's environment. One of its steps is k control steps of a frozen sub-policy (paper, section 4)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from footwork.env import Env, EnvState, host_jit, scan_over
from footwork.learn.networks import Policy
from footwork.tasks.observe import WALKER_OBS_SIZE, turn_action, turn_observation
from footwork.types import Array, Bool, Float, Int, Key, Params, Physics, TimeStep


@dataclass(frozen=True, eq=False)
class SubPolicies:
    """The frozen sub-policies of the four directions.

    Args:
        policy: their common network.
        params: their parameters, leading axis the directions; without that axis where ``symmetric``.
        symmetric: one policy in four frames.
        deterministic: act by the mode of the distribution instead of a sample. Not in the paper.
    """

    policy: Policy
    params: Params
    symmetric: bool = False
    deterministic: bool = False

    def act(self, obs: Float[Array, "N D"], direction: Int[Array, " N"], key: Key) -> Float[Array, "N 8"]:
        """Each row's action by the sub-policy of its direction, from the first 32 numbers alone.

        ``key`` is one for all rows, or one for each, [N]: a row then draws what it would draw alone.
        """
        obs = obs[:, :WALKER_OBS_SIZE]
        if self.symmetric:
            action = self._act(self.params, turn_observation(obs, direction), key)
            return turn_action(action, -direction)
        num_directions = jax.tree.leaves(self.params)[0].shape[0]
        if key.ndim:  # a row's directions may share a key: only one of them is used
            actions = jax.vmap(self._act, in_axes=(0, None, None))(self.params, obs, key)
        else:
            actions = jax.vmap(self._act, in_axes=(0, None, 0))(self.params, obs, jax.random.split(key, num_directions))
        return actions[direction, jnp.arange(obs.shape[0])]

    def _act(self, params: Params, obs: Array, key: Key) -> Array:
        if self.deterministic:
            return self.policy.mode(params, obs)
        if key.ndim:
            return jax.vmap(self.policy.act, in_axes=(None, 0, 0))(params, obs, key)[0]
        return self.policy.act(params, obs, key)[0]


class OptionsState(NamedTuple):
    """The environment below, in the middle of an option."""

    inner: EnvState
    obs: Float[Array, "N D"]
    choice: Int[Array, " N"]
    total: TimeStep  # what the option has brought so far


def task_state(state: Any) -> EnvState:
    """The state of the task, below an option if there is one."""
    return state.inner if isinstance(state, OptionsState) else state


@dataclass(frozen=True, eq=False)
class Options:
    """Runs k control steps of the chosen sub-policy and sums the rewards.

    A row whose episode ends within an option is held for the rest of it. No joint is
    ever reset. Flags and events are those of any step of the option, the distance to
    the goal is the closest.

    Args:
        inner: the task.
        sub_policies: what the master chooses among.
        option_steps: the paper's k, which it does not state.
    """

    inner: Env
    sub_policies: SubPolicies
    option_steps: int

    def __post_init__(self) -> None:
        if self.option_steps < 1:
            raise ValueError(f"option_steps must be >= 1, got {self.option_steps}")

    @property
    def num_envs(self) -> int:
        """N."""
        return self.inner.num_envs

    @property
    def physics(self) -> Physics:
        """The engine below."""
        return self.inner.physics

    def initial(self, key: Key) -> tuple[OptionsState, Array]:
        """A first episode in every row."""
        inner, obs = self.inner.initial(key)
        _, shape = jax.eval_shape(self.inner.finish, inner, key)
        total = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape)
        return OptionsState(inner, obs, jnp.zeros(self.num_envs, jnp.int32), total), obs

    def begin(self, state: OptionsState, action: Array, key: Key) -> OptionsState:
        """Take the master's choice."""
        nothing = jax.tree.map(jnp.zeros_like, state.total)
        far = {**nothing.events, "goal_distance": jnp.full((self.num_envs,), jnp.inf, jnp.float32)}
        return state._replace(choice=action, total=nothing._replace(events=far))

    def simulate(self, state: OptionsState, key: Key) -> OptionsState:
        """Run the option; ``key`` is one for all rows, or one for each, [N]."""
        state, _ = scan_over(self.physics)(partial(self.control_step, key), state, np.arange(self.option_steps))
        return state

    def control_step(self, key: Key, state: OptionsState, i: Int[Array, ""]) -> tuple[OptionsState, None]:
        """Control step ``i`` of the option: what :meth:`simulate` runs k of, for those who want to see each."""
        action = _act(self.sub_policies, state.obs, state.choice, key, i)
        inner = self.inner.simulate(self.inner.begin(state.inner, action, key), key)
        return _option_finish(self, state._replace(inner=inner), key, i), None

    def finish(self, state: OptionsState, key: Key) -> tuple[OptionsState, TimeStep]:
        """What the whole option brought."""
        return state, state.total

    def restart(self, state: OptionsState, mask: Bool[Array, " N"], key: Key) -> tuple[OptionsState, Array]:
        """A new episode in the masked rows."""
        inner, fresh = self.inner.restart(state.inner, mask, key)
        obs = jnp.where(mask[:, None], fresh, state.obs)
        return state._replace(inner=inner, obs=obs), obs


@host_jit
def _act(sub_policies: SubPolicies, obs: Array, choice: Array, key: Key, i: Int[Array, ""]) -> Array:
    """The chosen sub-policies' actions, from these alone and not the whole state: a call pays for each leaf."""
    split = jax.vmap(jax.random.split, out_axes=1) if key.ndim else jax.random.split
    act_key, _ = split(_fold(key, 2 * i))
    return sub_policies.act(obs, choice, act_key)


@host_jit
def _option_finish(env: Options, state: OptionsState, key: Key, i: Int[Array, ""]) -> OptionsState:
    inner, step = env.inner.finish(state.inner, _fold(key, 2 * i + 1))
    return state._replace(inner=inner, obs=step.obs, total=accumulate(state.total, step))


def _fold(key: Key, number: Int[Array, ""]) -> Key:
    """``fold_in`` of one key, or of each in [N]."""
    return jax.vmap(jax.random.fold_in, in_axes=(0, None))(key, number) if key.ndim else jax.random.fold_in(key, number)


def accumulate(total: TimeStep, step: TimeStep) -> TimeStep:
    """Two consecutive stretches of an episode as one."""
    events = {
        name: jnp.minimum(value, step.events[name]) if name == "goal_distance" else value | step.events[name]
        for name, value in total.events.items()
    }
    return step._replace(
        reward=total.reward + step.reward,
        terms={name: value + step.terms[name] for name, value in total.terms.items()},
        terminated=total.terminated | step.terminated,
        truncated=total.truncated | step.truncated,
        valid=total.valid | step.valid,
        handover=total.handover | step.handover,
        events=events,
    )
