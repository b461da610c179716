"""Trained policies as objects that predict, found by row name or by the folder of a run or an export."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from footwork.arena import DIRECTIONS
from footwork.learn.networks import Categorical, Policy
from footwork.options import SubPolicies
from footwork.study.runs import find_trained, packaged
from footwork.train import Experiment, Trained
from footwork.types import Params

NOWHERE = Path(os.devnull)  # runs are looked for there: none is found


@dataclass(eq=False)
class LoadedPolicy:
    """A trained policy: a flat policy or a master, or the sub-policy of one direction.

    Args:
        experiment: the row it comes from.
        policy: the network.
        params: its parameters, without leading axes.
        walkers: of a walker row: the four sub-policies, in whose place ``params`` is None.
        direction: of a walker row: which one acts.
        seed: of the samples that :meth:`predict` draws.
    """

    experiment: Experiment
    policy: Policy
    params: Params
    walkers: SubPolicies | None = None
    direction: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        self._count = 0  # predictions so far: each sample has randomness of its own
        self._predict = jax.jit(self._act, static_argnums=1)

    @property
    def obs_size(self) -> int:
        """D."""
        return self.policy.obs_size

    def predict(
        self, obs: Any, deterministic: bool = False, *, state: Any = None, episode_start: Any = None
    ) -> tuple[np.ndarray, Any]:
        """The action for one observation [D] or for several [N, D], as Stable-Baselines3's ``predict`` has it.

        ``state`` and ``episode_start`` are there for its sake and unused. Gaussian actions are
        not clipped; a master's action is the number of a sub-policy.

        Returns:
            The action, [8] or [N, 8] float32, of a master a number or [N] int32; and ``state`` as it came.

        Raises:
            ValueError: ``obs`` has another shape, or is not finite.
        """
        rows = np.asarray(obs, np.float32)
        if rows.ndim not in (1, 2) or rows.shape[-1] != self.obs_size:
            raise ValueError(f"obs must be [{self.obs_size}] or [N, {self.obs_size}], got shape {rows.shape}")
        if not np.isfinite(rows).all():
            raise ValueError(f"obs {_first_bad(rows)}is not finite")
        self._count += 1
        action = self._predict(np.atleast_2d(rows), bool(deterministic), np.int32(self._count))
        return np.array(action)[0] if rows.ndim == 1 else np.array(action), state

    def _act(self, obs: Any, deterministic: bool, count: Any) -> Any:
        key = jax.random.fold_in(jax.random.key(self.seed), count)
        if self.walkers is not None:
            subs = SubPolicies(self.policy, self.walkers.params, self.walkers.symmetric, deterministic)
            return subs.act(obs, jnp.full(obs.shape[0], self.direction, jnp.int32), key)
        return self.policy.mode(self.params, obs) if deterministic else self.policy.act(self.params, obs, key)[0]

    @property
    def chooses(self) -> bool:
        """Whether its action is the number of a sub-policy."""
        return isinstance(self.policy.head, Categorical)


def load_policy(
    address: str, direction: str = "right", seed_index: int = 0, runs: Path | str = "runs", seed: int = 0
) -> LoadedPolicy:
    """A trained policy by its address.

    Args:
        address: a row, or the folder of a run or of ``footwork export``.
        direction: of a walker row: right, up, left or down.
        seed_index: which of the run's seeds.
        runs: where runs are kept; a row not found there comes from the package.
        seed: of the samples that it draws.

    Raises:
        ValueError: the address, the direction or the seed is unknown.
        RunError: nothing has been trained there.
    """
    trained = find_trained(address, Path(runs))
    if direction not in DIRECTIONS:
        raise ValueError(f"unknown direction {direction!r}; known: {', '.join(DIRECTIONS)}")
    if not 0 <= seed_index < len(trained.seeds):
        raise ValueError(f"seed_index must be in 0..{len(trained.seeds) - 1}, got {seed_index}")
    return of_trained(trained, DIRECTIONS.index(direction), seed_index, seed)


def of_trained(trained: Trained, direction: int = 0, seed_index: int = 0, seed: int = 0) -> LoadedPolicy:
    """One of a run's policies."""
    experiment = trained.experiment
    make = partial(LoadedPolicy, experiment, experiment.policy(), direction=direction, seed=seed)
    if experiment.is_walker:
        return make(None, walkers=trained.sub_policies(seed_index))
    return make(trained.single(seed_index))


def find_policies(address: str) -> Trained:
    """What an environment stands on: the packaged row if there is one, so that an id means the same everywhere.

    Raises:
        ValueError: the address is unknown.
        RunError: nothing has been trained there.
    """
    return find_trained(address, NOWHERE if packaged(address).is_file() else Path("runs"))


def _first_bad(rows: np.ndarray) -> str:
    if rows.ndim == 1:
        return ""
    return f"of row {int(np.flatnonzero(~np.isfinite(rows).all(axis=1))[0])} "


__all__ = ["NOWHERE", "LoadedPolicy", "find_policies", "load_policy", "of_trained"]
