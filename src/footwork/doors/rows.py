"""Rows of ants stepped from the host, each with a random stream of its own: what every Gymnasium environment stands on.

Row i of many does, bit for bit, what the same row would do alone. Two things make it so:
every draw of a row comes from the row's own key, and the arithmetic runs on whole blocks
of :data:`BLOCK` rows (XLA compiles a lone row to other instructions than a block; rows
that fill a block up are held, and cost nothing).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from footwork.doors.settings import Setting, bounds, term_names
from footwork.env import Env, Environment, EnvState
from footwork.footage import NOBODY
from footwork.options import Options, OptionsState, task_state
from footwork.physics import DEFAULT_ENGINE, physics_for
from footwork.tasks.task import Task
from footwork.train import COMPILER_OPTIONS
from footwork.types import NUM_FEET, NUM_JOINTS, QPOS_SIZE, QVEL_SIZE, PhysicsState

BLOCK = 8
_SIZES = (QPOS_SIZE, QVEL_SIZE, NUM_FEET, NUM_FEET, NUM_JOINTS, 1)  # of a packed state
FLAGS = ("fallen", "flipped", "diverged")


class Outcome(NamedTuple):
    """What a step brought to N rows, as numpy arrays that nobody else holds."""

    obs: np.ndarray  # [N, D] float32
    reward: np.ndarray  # [N] float64
    terminated: np.ndarray  # [N] bool
    truncated: np.ndarray  # [N] bool
    figures: dict[str, np.ndarray]  # by name, [N] float64 or bool: what goes into info


@dataclass(frozen=True)
class _NoEngine:
    """Stands where the engine would, in what is compiled: equal settings then share one compilation."""

    num_envs: int
    traceable = False

    def initial(self) -> PhysicsState:
        zeros = partial(jnp.zeros, dtype=jnp.float32)
        n = self.num_envs
        rows = jnp.arange(n, dtype=jnp.int32)
        touching = zeros((n, NUM_FEET))
        return PhysicsState(zeros((n, QPOS_SIZE)), zeros((n, QVEL_SIZE)), touching, touching, jnp.zeros(n, bool), rows)


@lru_cache(maxsize=64)
def _pure(task: Task, direction: int | None, num_rows: int) -> Env:
    """The task's environment without its engine."""
    goal_index = None if direction is None else (direction,) * num_rows
    return Env(task, _NoEngine(num_rows), goal_index)  # type: ignore[arg-type]


class _Master(Options):
    """Options that are equal where what is compiled of them is, whatever engine stands below: compiled once for all."""

    @cached_property
    def _compiled(self) -> tuple[Any, ...]:
        return self.inner.task, self.num_envs, self.sub_policies, self.option_steps

    @cached_property
    def _hash(self) -> int:  # asked for twice per control step, and a task is large
        return hash(self._compiled)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Master) and self._compiled == other._compiled

    def __hash__(self) -> int:
        return self._hash


class Rows:
    """N episodes side by side. Nothing begins by itself: :meth:`restart` does it, also the first time.

    Args:
        setting: the environment.
        num_envs: N.
        num_threads: of the physics; changes no number.
    """

    def __init__(self, setting: Setting, num_envs: int, num_threads: int = 0):
        if num_envs < 1:
            raise ValueError(f"num_envs must be >= 1, got {num_envs}")
        self._setting, self._num_envs = setting, num_envs
        num_rows = -(-num_envs // BLOCK) * BLOCK
        task = setting.task
        physics = physics_for(DEFAULT_ENGINE, task.robot, task.arena, num_rows, num_threads)
        pure = _pure(task, setting.direction, num_rows)
        self._pure: Environment = pure
        self._env: Environment = replace(pure, physics=physics)
        if setting.sub_policies is not None:
            self._pure = _Master(pure, setting.sub_policies, setting.option_steps)
            self._env = replace(self._pure, inner=self._env)
        self._state: Any = _nothing_begun(self._pure, physics.initial())
        self._keys = np.zeros((num_rows, 2), np.uint32)  # of each row's episode

    @property
    def _inner(self) -> EnvState:
        return task_state(self._state)

    @property
    def qpos(self) -> np.ndarray:
        """Position, quaternion and joints, [N, 15]."""
        return np.array(self._inner.physics.qpos)[: self._num_envs]

    @property
    def goal(self) -> np.ndarray:
        """Where each row is to go, [N, 2] in m."""
        return np.array(self._inner.goal)[: self._num_envs]

    @property
    def choice(self) -> np.ndarray:
        """Direction of the sub-policy at work in each row, [N]; :data:`~footwork.footage.NOBODY` where none is."""
        if isinstance(self._state, OptionsState):
            return np.array(self._state.choice)[: self._num_envs]
        return np.full(self._num_envs, NOBODY if self._setting.direction is None else self._setting.direction)

    def restart(self, mask: np.ndarray, keys: np.ndarray) -> np.ndarray:
        """A new episode in the masked rows: their observations, [masked, D].

        Args:
            mask: [N].
            keys: [masked, 2] uint32, each the randomness of a whole episode.
        """
        everyone = np.zeros(len(self._keys), bool)
        everyone[: self._num_envs] = mask
        self._keys[everyone] = keys
        self._state, obs = _restart(self._pure, self._state, everyone, self._keys)
        return np.asarray(obs)[everyone]

    def step(self, action: Any) -> Outcome:
        """One step of every row whose episode is on; the others stay as they are and earn nothing.

        Args:
            action: [N, 8] float32, or [N] int32 for masters.
        """
        n = self._num_envs
        if n < len(self._keys):
            action = np.concatenate([action, np.zeros((len(self._keys) - n, *action.shape[1:]), action.dtype)])
        key = None
        if isinstance(self._state, OptionsState):
            key = _keys_now(self._keys, self._inner.t)
            state = _begin_option(self._pure, self._state, action)
        else:
            state = self._env.begin(self._state, action, None)
        state = self._env.simulate(state, key)
        if isinstance(state, EnvState):  # one transfer instead of eight: at 256 rows, 4 % of the step
            self._state, obs, figures, flags = _finish(self._pure, *_pack(state))
        else:
            self._state, obs, figures, flags = _finish(self._pure, state, None)
        figures, flags = np.array(figures, np.float64)[:, :n], np.array(flags)[:, :n]
        names = [f"reward_{name}" for name in term_names(self._setting.task)]
        named = dict(zip(("reward", "x_position", "y_position", "goal_distance", *names), figures, strict=True))
        reward = named.pop("reward")
        events = dict(zip(("terminated", "truncated", "success", *FLAGS), flags, strict=True))
        terminated, truncated = events.pop("terminated"), events.pop("truncated")
        if not self._setting.has_goal:
            del named["goal_distance"], events["success"]
        return Outcome(np.array(obs)[:n], reward, terminated, truncated, {**named, **events})


def _nothing_begun(env: Environment, physics: PhysicsState) -> Any:
    """The state before any restart, in which every row is held; of the right form without compiling anything."""
    form, _ = jax.eval_shape(env.initial, jax.eval_shape(lambda: jax.random.key(0)))
    state = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), form)
    held: Any = np.ones(env.num_envs, bool)
    if isinstance(state, OptionsState):
        return state._replace(inner=state.inner._replace(physics=physics, previous=physics, held=held))
    return state._replace(physics=physics, previous=physics, held=held)


@jax.jit
def _keys_now(keys: Any, t: Any) -> Any:
    """Each row's randomness from control step ``t`` of its episode on."""
    return jax.vmap(jax.random.fold_in)(jax.random.wrap_key_data(keys), t)


@partial(jax.jit, static_argnums=0)
def _begin_option(env: Options, state: OptionsState, action: Any) -> OptionsState:
    return env.begin(state, action, None)


@partial(jax.jit, static_argnums=0, compiler_options=COMPILER_OPTIONS)
def _restart(env: Environment, state: Any, mask: Any, keys: Any) -> Any:
    """A row's new episode is drawn as if it were alone: a one-row environment, once per row."""
    rows = jax.tree.map(lambda leaf: leaf[:, None], state)
    state, obs = jax.vmap(_one_row(env).restart)(rows, mask[:, None], jax.random.wrap_key_data(keys))
    state, obs = jax.tree.map(lambda leaf: leaf[:, 0], (state, obs))
    return state, jnp.clip(obs, *bounds(_task(env)))


def _pack(state: EnvState) -> tuple[EnvState, np.ndarray]:
    """What came from the engine and the policy as one array [N, 46], and the rest of the state."""
    now = state.physics
    parts: Any = (now.qpos, now.qvel, now.foot_contact, now.foot_collision, state.action, now.diverged[:, None])
    rest: Any = {"physics": None, "action": None, "stale": None}
    return state._replace(**rest), np.concatenate(parts, axis=1, dtype=np.float32)


def _unpack(state: EnvState, packed: Any) -> EnvState:
    *parts, action, diverged = jnp.split(packed, np.cumsum(_SIZES)[:-1], axis=1)
    qpos, qvel, contact, collision = parts
    physics = PhysicsState(qpos, qvel, contact, collision, diverged[:, 0] > 0, state.previous.engine)
    return state._replace(physics=physics, action=action, stale=jnp.zeros_like(state.held))


def _task(env: Any) -> Task:
    return env.inner.task if isinstance(env, Options) else env.task


def _one_row(env: Any) -> Any:
    if isinstance(env, Options):
        return replace(env, inner=_one_row(env.inner))
    return _pure(env.task, None if env.goal_index is None else env.goal_index[0], 1)


@partial(jax.jit, static_argnums=0, compiler_options=COMPILER_OPTIONS)
def _finish(env: Any, state: Any, packed: Any) -> Any:
    """The step's outcome in two arrays, one of numbers and one of flags: few transfers."""
    state, step = env.finish(state if packed is None else _unpack(state, packed), None)
    inner = task_state(state)
    task = _task(env)
    terms = [step.terms[name] for name in term_names(task)]
    xy = inner.physics.qpos[:, :2]
    figures = jnp.stack([step.reward, xy[:, 0], xy[:, 1], step.events["goal_distance"], *terms])
    flags = [step.terminated, step.truncated, step.events["reached"], *(step.events[name] for name in FLAGS)]
    return state, jnp.clip(step.obs, *bounds(task)), figures, jnp.stack(flags)
