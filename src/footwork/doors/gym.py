"""Gymnasium's door: the tasks as single and as vector environments, registered with Gymnasium on import.

========================== ============================ =========================================
id                         action                       one step
========================== ============================ =========================================
footwork/AntWalker-v0      8 torques in [-1, 1]         one control step, 16.5 ms
footwork/AntBandit-v0      8 torques in [-1, 1]         one control step
footwork/AntMaze-v0        8 torques in [-1, 1]         one control step
footwork/AntMazeOptions-v0 which of 4 sub-policies acts ``option_steps`` control steps
========================== ============================ =========================================

``gymnasium.make_vec`` gives a real vector environment: one call steps all rows, in C on
all cores. Row i of one that was reset with ``seed`` does what a single environment reset
with ``seed + i`` does, bit for bit, whatever the number of rows and of threads.

This module stays light: what computes is imported when an environment is made.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from numbers import Integral
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.utils import seeding
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError(f"footwork.doors.gym needs Gymnasium: pip install 'footwork[gym]' ({error})") from None

if TYPE_CHECKING:
    from footwork.doors.frames import Shower
    from footwork.doors.rows import Outcome, Rows
    from footwork.doors.settings import Setting

IDS = ("AntWalker-v0", "AntBandit-v0", "AntMaze-v0", "AntMazeOptions-v0")
NAMESPACE = "footwork"
_RENDER_MODES = ("human", "rgb_array")


def register() -> None:
    """Make the ids known to Gymnasium; known ones are left as they are."""
    for name in IDS:
        if f"{NAMESPACE}/{name}" not in gymnasium.registry:
            kind = name.split("-", maxsplit=1)[0]
            gymnasium.register(
                f"{NAMESPACE}/{name}", f"{__name__}:{kind}", vector_entry_point=f"{__name__}:{kind}Vector"
            )


class _Offered:
    """What single and vector environments have in common: a setting, and the rows that play it."""

    kind: ClassVar[str]  # one of footwork.doors.settings.MAKERS, which say what the keyword arguments mean

    def _offer(self, num_envs: int, num_threads: int, render_mode: str | None, fields: dict[str, Any]) -> None:
        from footwork.doors import settings

        if render_mode not in (None, *_RENDER_MODES):
            raise ValueError(f"render_mode must be human, rgb_array or None, got {render_mode!r}")
        if render_mode == "human" and not _has_screen():
            raise ValueError("render_mode 'human' needs a screen, and there is none here: use 'rgb_array'")
        self.setting: Setting = settings.read_fields(self.kind, fields)
        self.render_mode = render_mode
        self.metadata = {
            "render_modes": [mode for mode in _RENDER_MODES if mode != "human" or _has_screen()],
            "render_fps": max(1, round(1 / (self.setting.option_steps * self.setting.task.robot.control_dt))),
        }
        self._num_rows, self._num_threads = num_envs, _count("num_threads", num_threads, lowest=0)
        self._made: Rows | None = None
        self._shower: Shower | None = None

    @property
    def rows(self) -> Rows:
        """The ants, made when they are first needed: a process that forks before has nothing to lose."""
        if self._made is None:
            from footwork.doors.rows import Rows

            self._made = Rows(self.setting, self._num_rows, self._num_threads)
        return self._made

    def _observation_space(self) -> spaces.Space[Any]:
        from footwork.doors.settings import bounds, reach

        low, high = bounds(self.setting.task)
        if not self.setting.goal_conditioned:
            return spaces.Box(low, high)
        far = reach(self.setting.task).astype(np.float32)
        place = spaces.Box(-far, far)
        return spaces.Dict(
            observation=spaces.Box(low[:-2], high[:-2]), achieved_goal=place, desired_goal=spaces.Box(-far, far)
        )

    def _action_space(self) -> spaces.Space[Any]:
        if self.setting.sub_policies is not None:
            return spaces.Discrete(4)
        return spaces.Box(-1.0, 1.0, (8,))

    def _draw(self, row: int) -> np.ndarray | None:
        if self.render_mode is None:
            raise gymnasium.error.Error(
                "render() needs a render_mode: make the environment with 'rgb_array' or 'human'"
            )
        if self._shower is None:
            from footwork.doors.frames import shower

            self._shower = shower(self.setting.task, self.render_mode)
        goal = self.rows.goal[row] if self.setting.has_goal else None
        return self._shower.draw(self.rows.qpos[row], goal, int(self.rows.choice[row]))

    def _close(self) -> None:
        if self._shower is not None:
            self._shower.close()
        self._shower = self._made = None

    # Goals, for learners that relabel them

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        """The reward for being at ``achieved_goal`` [..., 2] when ``desired_goal`` [..., 2] was wanted (m)."""
        near = self.compute_terminated(achieved_goal, desired_goal, info)
        if self.setting.reward == "sparse":
            return np.float64(near) if np.ndim(near) == 0 else near.astype(np.float64)
        if self.setting.reward == "dense":
            return -_distance(achieved_goal, desired_goal)
        raise gymnasium.error.Error("compute_reward needs an environment made with reward='sparse' or 'dense'")

    def compute_terminated(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        """Whether ``achieved_goal`` is within the goal radius of ``desired_goal``."""
        return _distance(achieved_goal, desired_goal) <= (self.setting.task.goal_radius or -1.0)

    def compute_truncated(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        """Never on account of goals."""
        return np.zeros(np.shape(achieved_goal)[:-1], bool)[()]

    def _rewarded(self, outcome: Outcome, stepped: Any = True) -> Outcome:
        """The outcome with the reward that the setting asks for, zero where no step was taken."""
        if self.setting.reward == "task":
            return outcome
        figures = {name: value for name, value in outcome.figures.items() if not name.startswith("reward_")}
        here = np.stack([figures["x_position"], figures["y_position"]], axis=-1)
        reward = self.compute_reward(here.astype(np.float32), self.rows.goal, {})
        return outcome._replace(reward=reward * stepped, figures=figures)

    def _observation(self, obs: np.ndarray, goal: np.ndarray) -> Any:
        """Rows [N, D] as the space has them."""
        if not self.setting.goal_conditioned:
            return obs
        scale = np.float32(self.setting.task.xy_scale)
        return {
            "observation": obs[..., :-2].copy(),
            "achieved_goal": obs[..., -2:] / scale,
            "desired_goal": goal.astype(np.float32),
        }


class AntEnv(_Offered, gymnasium.Env[Any, Any]):
    """One ant. See docs/environments for what it observes, does and earns.

    Args:
        render_mode: ``rgb_array``, ``human`` or None.
        **fields: of the task; see :mod:`footwork.doors.settings`.
    """

    metadata: dict[str, Any] = {"render_modes": list(_RENDER_MODES), "render_fps": 61}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None, **fields: Any):
        self._offer(1, 1, render_mode, fields)
        self.observation_space = self._observation_space()
        self.action_space = self._action_space()
        self._playing = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode. No ``options`` are known."""
        super().reset(seed=seed)
        _refuse_unknown(options, ())
        obs = self.rows.restart(np.ones(1, bool), _episode_key(self.np_random)[None])
        self._playing = True
        if self.render_mode == "human":
            self._draw(0)
        return self._observation(obs[0], self.rows.goal[0]), _scalars(_place(self.rows), 0)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One step.

        Raises:
            ValueError: the action has another shape, is not finite or not among the choices.
            gymnasium.error.ResetNeeded: no episode is on.
        """
        if not self._playing:
            raise gymnasium.error.ResetNeeded("the episode has ended, or none has begun: call reset() first")
        outcome = self._rewarded(self.rows.step(_checked(np.asarray(action)[None], self.setting, 1, single=True)))
        terminated, truncated = bool(outcome.terminated[0]), bool(outcome.truncated[0])
        self._playing = not (terminated or truncated)
        if self.render_mode == "human":
            self._draw(0)
        obs = self._observation(outcome.obs[0], self.rows.goal[0])
        return obs, float(outcome.reward[0]), terminated, truncated, _scalars(outcome.figures, 0)

    def render(self) -> np.ndarray | None:
        """The ant as [height, width, 3] uint8, or None where a window shows it."""
        return self._draw(0)

    def close(self) -> None:
        """Give back what drawing holds."""
        self._close()


class AntVectorEnv(_Offered, VectorEnv[Any, Any, Any]):
    """N ants in one call. Its answers are those of ``gymnasium.vector.SyncVectorEnv`` over :class:`AntEnv`.

    Args:
        num_envs: N.
        autoreset_mode: what follows the end of an episode, as an ``AutoresetMode`` or its value; with
            ``Disabled``, ended rows must be reset by ``reset(options={"reset_mask": mask})``.
        render_mode: ``rgb_array``, ``human`` (shows row 0) or None.
        num_threads: of the physics; 0: all cores. Changes no number.
        max_episode_steps: truncate after this many steps, if that is earlier than the task does.
        **fields: of the task; see :mod:`footwork.doors.settings`.
    """

    def __init__(
        self,
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        num_threads: int = 0,
        max_episode_steps: int | None = None,
        **fields: Any,
    ):
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        num_envs = _count("num_envs", num_envs)
        self._offer(num_envs, num_threads, render_mode, fields)
        if max_episode_steps is not None:
            self.setting = self.setting.at_most(_count("max_episode_steps", max_episode_steps))
        self.metadata["autoreset_mode"] = self.autoreset_mode
        self.num_envs = num_envs
        self.single_observation_space = self._observation_space()
        self.single_action_space = self._action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._generators: list[np.random.Generator] = []
        self._over = np.ones(num_envs, bool)  # no episode is on in these rows
        self._obs = np.zeros((num_envs, self.setting.task.obs_size), np.float32)

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:
        """The generator of each row."""
        return tuple(self._generators)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin episodes in all rows, or in those of ``options["reset_mask"]`` [N] bool.

        Row i takes ``seed + i``, or its entry of a list; without a seed it goes on with its own randomness.
        """
        seeds = self._seeds(seed)
        _refuse_unknown(options, ("reset_mask",))
        mask = _reset_mask(options, self.num_envs)
        if not self._generators:
            if not mask.all():
                raise gymnasium.error.ResetNeeded("the first reset must be of all rows")
            self._generators = [seeding.np_random(s)[0] for s in seeds]
        for row in np.flatnonzero(mask).tolist():
            if seeds[row] is not None:
                self._generators[row] = seeding.np_random(seeds[row])[0]
        self._begin_episodes(mask)
        if self.render_mode == "human":
            self._draw(0)
        return self._observation(self._obs.copy(), self.rows.goal), _batched(_place(self.rows), mask)

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of all rows.

        Raises:
            ValueError: the actions have another shape, or one is not finite or not among the choices; names its row.
            gymnasium.error.ResetNeeded: a row has no episode, and none begins by itself.
        """
        waiting = self._over
        if waiting.any() and (self.autoreset_mode is not AutoresetMode.NEXT_STEP or not self._generators):
            row = int(np.flatnonzero(waiting)[0])
            raise gymnasium.error.ResetNeeded(f"row {row} has no episode: reset() it first")
        outcome = self._rewarded(self.rows.step(_checked(actions, self.setting, self.num_envs)), ~waiting)
        self._obs = outcome.obs
        done = outcome.terminated | outcome.truncated
        if self.autoreset_mode is AutoresetMode.SAME_STEP and done.any():
            infos = self._end_and_begin(outcome, done)
        elif waiting.any():  # the rows held them, so that they neither moved nor earned in this step
            self._begin_episodes(waiting)
            infos = _merged(_batched(_place(self.rows), waiting), _batched(outcome.figures, ~waiting))
            self._over = done
        else:
            infos = _batched(outcome.figures, ~waiting)
            self._over = done
        if self.render_mode == "human":
            self._draw(0)
        obs = self._observation(self._obs.copy(), self.rows.goal)
        return obs, outcome.reward, outcome.terminated, outcome.truncated, infos

    def _end_and_begin(self, outcome: Outcome, done: np.ndarray) -> dict[str, Any]:
        """Begin the next episode of ended rows at once; what they came to is kept in the infos."""
        last = self._observation(outcome.obs, self.rows.goal)
        final = np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(done).tolist():
            final[row] = row_of(last, row)
        infos: dict[str, Any] = {"final_obs": final, "_final_obs": done.copy()}
        infos |= {"final_info": _batched(outcome.figures, done), "_final_info": done.copy()}
        self._begin_episodes(done)
        return {**infos, **_merged(_batched(_place(self.rows), done), _batched(outcome.figures, ~done))}

    def _begin_episodes(self, mask: np.ndarray) -> None:
        keys = np.stack([_episode_key(self._generators[row]) for row in np.flatnonzero(mask)])
        begun = self.rows.restart(mask, keys)
        self._obs = self._obs.copy()  # an earlier one may be in somebody's hands
        self._obs[mask] = begun
        self._over = self._over & ~mask

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, Integral) and not isinstance(seed, bool):
            return [int(seed) + row for row in range(self.num_envs)]
        if not isinstance(seed, Sequence | np.ndarray) or isinstance(seed, str) or len(seed) != self.num_envs:
            raise ValueError(f"seed must be a number or {self.num_envs} of them, got {seed!r}")
        return list(seed)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Every row as [height, width, 3] uint8; where a window shows row 0, None."""
        if self.render_mode == "human":
            self._draw(0)
            return None
        return tuple(image for row in range(self.num_envs) if (image := self._draw(row)) is not None)

    def close_extras(self, **kwargs: Any) -> None:
        """Give back what drawing holds."""
        self._close()


class AntWalker(AntEnv):
    """footwork/AntWalker-v0."""

    kind = "AntWalker"


class AntBandit(AntEnv):
    """footwork/AntBandit-v0."""

    kind = "AntBandit"


class AntMaze(AntEnv):
    """footwork/AntMaze-v0."""

    kind = "AntMaze"


class AntMazeOptions(AntEnv):
    """footwork/AntMazeOptions-v0."""

    kind = "AntMazeOptions"


class AntWalkerVector(AntVectorEnv):
    """footwork/AntWalker-v0, vectorised."""

    kind = "AntWalker"


class AntBanditVector(AntVectorEnv):
    """footwork/AntBandit-v0, vectorised."""

    kind = "AntBandit"


class AntMazeVector(AntVectorEnv):
    """footwork/AntMaze-v0, vectorised."""

    kind = "AntMaze"


class AntMazeOptionsVector(AntVectorEnv):
    """footwork/AntMazeOptions-v0, vectorised."""

    kind = "AntMazeOptions"


def _has_screen() -> bool:
    return sys.platform in ("win32", "darwin") or bool({"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys())


def make_vector(name: str, num_envs: int, **fields: Any) -> AntVectorEnv:
    """``gymnasium.make_vec`` of one of our ids.

    Raises:
        ValueError: the id is another's.
    """
    env = gymnasium.make_vec(name, num_envs, **fields)
    if not isinstance(env, AntVectorEnv):
        raise ValueError(f"{name} is not one of {', '.join(f'{NAMESPACE}/{known}' for known in IDS)}")
    return env


# Numbers in and out -------------------------------------------------------------------------------------------------


def _count(name: str, value: Any, lowest: int = 1) -> int:
    """A whole number, numpy's too.

    Raises:
        ValueError: it is none, or less than the lowest.
    """
    if isinstance(value, bool) or not isinstance(value, Integral) or value < lowest:
        raise ValueError(f"{name} must be a whole number >= {lowest}, got {value!r}")
    return int(value)


def _checked(actions: Any, setting: Setting, num_envs: int, single: bool = False) -> np.ndarray:
    """Actions as the rows take them, or a ValueError that names the row."""
    of_row: Callable[[int], str] = lambda row: "action" if single else f"action of row {row}"  # noqa: E731
    wanted = (num_envs,) if setting.sub_policies is not None else (num_envs, 8)
    try:
        array = np.asarray(actions)
        numbers = array.astype(np.float32)
    except (TypeError, ValueError):
        raise ValueError(f"actions must be an array of shape {wanted[single:]}, got {actions!r}") from None
    if array.shape != wanted:
        what = "action" if single else "actions"
        raise ValueError(f"{what} must have shape {wanted[single:]}, got {array.shape[single:]}")
    finite = np.isfinite(numbers)
    if not finite.all():
        row = int(np.flatnonzero(~finite.reshape(num_envs, -1).all(axis=1))[0])
        raise ValueError(f"{of_row(row)} is not finite: {array[row]}")
    if setting.sub_policies is None:
        return numbers
    choices = array.astype(np.int32)
    known = (choices == numbers) & (choices >= 0) & (choices < 4)
    if not known.all():
        row = int(np.flatnonzero(~known)[0])
        raise ValueError(f"{of_row(row)} must be 0, 1, 2 or 3, got {array[row]}")
    return choices


def _refuse_unknown(options: dict[str, Any] | None, known: tuple[str, ...]) -> None:
    unknown = [name for name in options or {} if name not in known]
    if unknown:
        raise ValueError(f"unknown reset options {', '.join(map(repr, unknown))}; known: {', '.join(known) or 'none'}")


def _reset_mask(options: dict[str, Any] | None, num_envs: int) -> np.ndarray:
    mask = (options or {}).get("reset_mask")
    if mask is None:
        return np.ones(num_envs, bool)
    mask = np.asarray(mask)
    if mask.dtype != np.bool_ or mask.shape != (num_envs,) or not mask.any():
        raise ValueError(f"reset_mask must hold {num_envs} bools, one of them true at least, got {mask!r}")
    return mask.copy()


def _autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return mode if isinstance(mode, AutoresetMode) else AutoresetMode(mode)
    except ValueError:
        known = ", ".join(known.value for known in AutoresetMode)
        raise ValueError(f"autoreset_mode must be one of {known}, got {mode!r}") from None


def _episode_key(generator: np.random.Generator) -> np.ndarray:
    """The randomness of one episode, [2] uint32."""
    return generator.integers(0, 2**32, 2, np.uint32)


def _distance(achieved_goal: Any, desired_goal: Any) -> Any:
    return np.linalg.norm(np.asarray(achieved_goal, np.float64) - np.asarray(desired_goal, np.float64), axis=-1)


def _place(rows: Rows) -> dict[str, np.ndarray]:
    """What is known when an episode begins."""
    xy = rows.qpos[:, :2].astype(np.float64)
    return {"x_position": xy[:, 0], "y_position": xy[:, 1]}


def _scalars(figures: dict[str, np.ndarray], row: int) -> dict[str, Any]:
    return {name: value[row].item() for name, value in figures.items()}


def _batched(figures: dict[str, np.ndarray], mask: np.ndarray) -> dict[str, Any]:
    """Figures of the masked rows as Gymnasium's vector infos have them: with a mask beside each."""
    if not mask.any():
        return {}
    everyone = bool(mask.all())
    infos: dict[str, Any] = {}
    for name, value in figures.items():
        infos[name] = value if everyone else np.where(mask, value, np.zeros((), value.dtype))
        infos[f"_{name}"] = mask.copy()
    return infos


def _merged(one: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """Infos of rows that are in one or in the other."""
    both = {**one, **other}
    for name in one.keys() & other.keys():
        both[name] = one[name] | other[name] if one[name].dtype == bool else one[name] + other[name]
    return both


def row_of(obs: Any, row: int) -> Any:
    """One row's observation."""
    return {name: part[row] for name, part in obs.items()} if isinstance(obs, dict) else obs[row]


register()
