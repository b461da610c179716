"""AutoReset: an ended episode is followed at once by the next one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from footwork.env import Environment
from footwork.types import Array, Bool, Key, Physics, TimeStep


@dataclass(frozen=True, eq=False)
class AutoReset:
    """Restarts ended rows within the step that ended them.

    ``obs`` then belongs to the new episode, while ``next_obs`` stays the true last
    observation, which a truncated return bootstraps from.
    """

    inner: Environment

    @property
    def num_envs(self) -> int:
        """N."""
        return self.inner.num_envs

    @property
    def physics(self) -> Physics:
        """The engine below."""
        return self.inner.physics

    def initial(self, key: Key) -> tuple[Any, Array]:
        """As the inner environment."""
        return self.inner.initial(key)

    def begin(self, state: Any, action: Array, key: Key) -> Any:
        """As the inner environment."""
        return self.inner.begin(state, action, key)

    def simulate(self, state: Any, key: Key) -> Any:
        """As the inner environment."""
        return self.inner.simulate(state, key)

    def finish(self, state: Any, key: Key) -> tuple[Any, TimeStep]:
        """The inner step, and a new episode where one ended."""
        finish_key, restart_key = jax.random.split(key)
        state, step = self.inner.finish(state, finish_key)
        done = step.terminated | step.truncated
        state, fresh = self.inner.restart(state, done, restart_key)
        return state, step._replace(obs=jnp.where(done[:, None], fresh, step.obs))

    def restart(self, state: Any, mask: Bool[Array, " N"], key: Key) -> tuple[Any, Array]:
        """As the inner environment."""
        return self.inner.restart(state, mask, key)
