"""Stable-Baselines3's door: one of our vector environments as its VecEnv."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from footwork.doors.gym import AntVectorEnv, make_vector, row_of

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise ImportError(f"footwork.doors.sb3 needs Stable-Baselines3: pip install 'footwork[sb3]' ({error})") from None


class FootworkVecEnv(VecEnv):
    """A vector environment of ours where Stable-Baselines3 wants a VecEnv.

    Infos are as Stable-Baselines3 reads them, in the step that ends an episode:
    ``terminal_observation``, ``TimeLimit.truncated``, ``is_success``, ``episode`` (its return ``r``
    and length ``l``: no VecMonitor is needed) and what our info says of that step. In other
    steps they are empty, unless ``every_info`` asks for all of them: they would cost more
    than the physics.

    Args:
        env: made with ``autoreset_mode="SameStep"``.
        every_info: fill the infos of every step.
        staggered: cut the first episode of each row short, at a random step, so that a rollout holds all
            phases of an episode and not the same one of every row. For training; a cut episode is
            truncated, and reported neither as an ``episode`` nor as a success.
    """

    def __init__(self, env: AntVectorEnv, every_info: bool = False, staggered: bool = False):
        if not isinstance(env, AntVectorEnv):
            raise ValueError(f"env must be a vector environment of footwork, got {type(env).__name__}")
        if env.autoreset_mode.value != "SameStep":
            raise ValueError(f"env must be made with autoreset_mode='SameStep', got {env.autoreset_mode.value!r}")
        self.env = env
        self.render_mode = env.render_mode
        self._every_info, self._staggered = every_info, staggered
        self._cut_at = np.zeros(env.num_envs, np.int64)  # step that cuts the first episode; 0: none
        self._actions: Any = None
        self._returns, self._lengths = np.zeros(env.num_envs), np.zeros(env.num_envs, np.int64)
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Any:
        """Begin episodes in all rows, with what :meth:`seed` said."""
        seeds = [None if seed is None else int(seed) for seed in self._seeds]
        obs, infos = self.env.reset(seed=seeds)
        self.reset_infos = [_info_of(infos, row) for row in range(self.num_envs)]
        self._returns[:], self._lengths[:] = 0.0, 0
        if self._staggered:
            self._cut_at = np.array([rng.integers(0, self.env.setting.most_steps) for rng in self.env.np_random])
        self._reset_seeds()
        self._reset_options()
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for :meth:`step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """One step of all rows."""
        obs, rewards, terminated, truncated, infos = self.env.step(self._actions)
        self._returns += rewards
        self._lengths += 1
        done = terminated | truncated
        rows = [_info_of(infos, row) if self._every_info else {} for row in range(self.num_envs)]
        for row in np.flatnonzero(done):
            rows[row] = self._last_info(infos, int(row), bool(truncated[row] and not terminated[row]))
        cut = ~done & (self._lengths == self._cut_at)
        self._cut_at[done | cut] = 0
        if cut.any():
            for row in np.flatnonzero(cut):
                rows[row] |= {"terminal_observation": row_of(obs, int(row)), "TimeLimit.truncated": True}
            obs, _ = self.env.reset(options={"reset_mask": cut})
            done = done | cut
        self._returns[done], self._lengths[done] = 0.0, 0
        return obs, rewards.astype(np.float32), done, rows

    def _last_info(self, infos: dict[str, Any], row: int, truncated: bool) -> dict[str, Any]:
        info = _info_of(infos["final_info"], row)
        info["terminal_observation"] = infos["final_obs"][row]
        info["TimeLimit.truncated"] = truncated
        if "success" in info:
            info["is_success"] = info["success"]
        info["episode"] = {"r": float(self._returns[row]), "l": int(self._lengths[row])}
        return info

    def close(self) -> None:
        """Close the environment below."""
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Every row's picture."""
        return self.env.render() or ()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute, once per row."""
        return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refused: rows share one environment."""
        raise NotImplementedError("the rows of a footwork environment share their fields: make another environment")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method, such as ``compute_reward``: once, its answer stands for every row asked."""
        answer = getattr(self.env, method_name)(*method_args, **method_kwargs)
        return [answer] * len(list(self._get_indices(indices)))

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Never: rows are not wrapped one by one. Episodes are monitored all the same."""
        from stable_baselines3.common.monitor import Monitor

        return [wrapper_class is Monitor] * len(list(self._get_indices(indices)))


def make_vec_env(
    name: str, num_envs: int, every_info: bool = False, staggered: bool = False, **fields: Any
) -> FootworkVecEnv:
    """A VecEnv of an id, such as ``footwork/AntMazeOptions-v0``.

    Args:
        name: the id.
        num_envs: rows.
        every_info: fill the infos of every step.
        staggered: cut first episodes short at random, so that rows are not in step.
        **fields: of the environment.
    """
    return FootworkVecEnv(make_vector(name, num_envs, autoreset_mode="SameStep", **fields), every_info, staggered)


def _info_of(infos: dict[str, Any], row: int) -> dict[str, Any]:
    """One row's entries of a vector's infos."""
    return {
        name: value[row].item()
        for name, value in infos.items()
        if not name.startswith("_") and name not in ("final_obs", "final_info") and infos[f"_{name}"][row]
    }
