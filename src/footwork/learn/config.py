"""What PPO is run with: Table 1 of the paper, and the switches the paper does not mention.

Nothing here imports JAX, so that a command line can read and print it at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal


@dataclass(frozen=True)
class PPOConfig:
    """The hyper-parameters of one learner, checked when they are written down.

    The schedule of the paper's Section 7 reads ``S = num_envs * num_steps``,
    ``I = update_epochs`` and ``B = num_minibatches``. Its S and B do not always
    divide (S = 40, B = 32), so B may also be read as a size: ``minibatch_size``.
    """

    learning_rate: float = 3e-4
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip_eps: float = 0.2
    vf_coef: float = 0.5  # times the mean squared error of the value
    update_epochs: int = 10  # the paper's I
    num_minibatches: int = 32  # the paper's B, read as the number of batches
    minibatch_size: int | None = None  # the paper's B, read as a size; overrides num_minibatches
    num_envs: int = 32  # rows of one run
    num_steps: int = 64  # steps of each row per update
    loss: Literal["clip", "penalty"] = "clip"  # the paper trains with clip; penalty is its Section 2's other flavour
    hidden_sizes: tuple[int, ...] = (64, 64)  # the paper's Section 4, for the actor and for the critic

    # Not in the paper.
    ent_coef: float = (
        0.02  # times the entropy, added to the objective; in a pilot at 0 one of four walkers never walked
    )
    anneal_updates: int | None = None  # updates in which ent_coef and learning_rate fall linearly; None: both stay
    final_ent_coef_share: float = 0.0  # of ent_coef, when annealed
    final_learning_rate_share: float = 0.1  # of learning_rate, when annealed
    max_grad_norm: float | None = None  # the gradient is scaled down to this norm; None leaves it alone
    normalize_advantage: bool = True  # to mean 0 and deviation 1 over all valid samples of the update
    adam_eps: float = 1e-5
    reward_scale: float = 1.0  # the learner sees rewards times this; what is reported stays unscaled
    target_kl: float = 0.01  # penalty only: the divergence per update that is aimed at
    initial_kl_coef: float = 1.0  # penalty only
    initial_log_std: float = 0.0  # Gaussian heads, as are the next two
    min_log_std: float = -5.0
    max_log_std: float = 2.0

    def __post_init__(self) -> None:
        for name in ("update_epochs", "num_minibatches", "num_envs", "num_steps"):
            _check_count(name, getattr(self, name))
        for name in ("minibatch_size", "anneal_updates"):
            if getattr(self, name) is not None:
                _check_count(name, getattr(self, name))
        for name in ("learning_rate", "clip_eps", "adam_eps", "reward_scale", "target_kl", "initial_kl_coef"):
            _check_range(name, getattr(self, name), above=0.0)
        if self.max_grad_norm is not None:
            _check_range("max_grad_norm", self.max_grad_norm, above=0.0)
        for name in ("gamma", "gae_lambda"):
            _check_range(name, getattr(self, name), at_least=0.0, at_most=1.0)
        for name in ("final_ent_coef_share", "final_learning_rate_share"):
            _check_range(name, getattr(self, name), at_least=0.0, at_most=1.0)
        for name in ("vf_coef", "ent_coef"):
            _check_range(name, getattr(self, name), at_least=0.0)
        _check_range("initial_log_std", self.initial_log_std, above=self.min_log_std, below=self.max_log_std)
        if self.loss not in ("clip", "penalty"):
            raise ValueError(f"loss must be clip or penalty, got {self.loss!r}")
        if not self.hidden_sizes:
            raise ValueError("hidden_sizes must name at least one layer, got ()")
        for size in self.hidden_sizes:
            _check_count("hidden_sizes", size)

    @property
    def batch_size(self) -> int:
        """Environment steps per update of one run: the paper's S."""
        return self.num_envs * self.num_steps

    def count_minibatches(self, batch_size: int) -> int:
        """Minibatches per epoch for a batch of ``batch_size`` samples; never more than there are samples."""
        if self.minibatch_size is not None:
            return -(-batch_size // self.minibatch_size)
        return min(self.num_minibatches, batch_size)


def _check_count(name: str, value: Any) -> None:
    if not isinstance(value, int) or isinstance(value, bool):
        raise ValueError(f"{name} must be a whole number, got {value!r}")
    if value < 1:
        raise ValueError(f"{name} must be >= 1, got {value}")


def _check_range(
    name: str,
    value: float,
    *,
    above: float = -math.inf,
    below: float = math.inf,
    at_least: float = -math.inf,
    at_most: float = math.inf,
) -> None:
    """Refuse what is not finite and not within all of the bounds given (NaN is within none)."""
    if math.isfinite(value) and above < value < below and at_least <= value <= at_most:
        return
    bounds = (("> ", above), (">= ", at_least), ("< ", below), ("<= ", at_most))
    wanted = " and ".join(f"{sign}{bound:g}" for sign, bound in bounds if math.isfinite(bound)) or "finite"
    raise ValueError(f"{name} must be {wanted}, got {value}")


# Table 1 of the paper, with the S of its sub-policies and flat policies.
PAPER = PPOConfig(
    learning_rate=3e-4,
    gamma=0.99,
    gae_lambda=0.95,
    clip_eps=0.2,
    vf_coef=0.5,
    update_epochs=10,
    num_minibatches=32,
    num_envs=32,
    num_steps=64,
    hidden_sizes=(64, 64),
)


__all__ = ["PAPER", "PPOConfig"]
