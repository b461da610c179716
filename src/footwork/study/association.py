"""Whether masters do better on the sub-policies that hand over better: seed by seed, within each kind.

Not one of the claims: it was looked at when the runs were there. The paper's hypothesis (section 8) is
that sub-policies which hand over smoothly serve a master better; it compares kinds, this the seeds of a kind.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from footwork.statistics import Effect, Floats, generator_for, rank_correlation
from footwork.study.experiments import KINDS, is_row
from footwork.study.results import Results

OF_SUB_POLICIES, OF_MASTERS = "handover", "success"  # the metric of sub-policies, and that of the masters on them


@dataclass(frozen=True)
class Association:
    """A task in a setting, whose masters are set beside their sub-policies.

    Args:
        words: the task and the setting.
        place: of the masters' rows, as ``maze/hrl``.
    """

    words: str
    place: str

    @property
    def rows(self) -> tuple[str, ...]:
        """Rows of sub-policies, and of the masters on them."""
        return (*(f"walker/{kind}" for kind in KINDS), *self.masters)

    @property
    def masters(self) -> tuple[str, ...]:
        """Rows of the masters."""
        return tuple(f"{self.place}/{kind}" for kind in KINDS)


# On AntMaze with the paper's reward no master arrives: nothing to set beside anything.
ASSOCIATIONS: tuple[Association, ...] = (
    Association("AntBandit, our reward", "bandit/hrl"),
    Association("AntBandit, the paper's", "bandit/paper"),
    Association("AntMaze, our reward", "maze/hrl"),
)


def seed_pairs(results: Results, association: Association, prefix: str = "") -> dict[str, Floats]:
    """Of each kind that has runs, [S, 2]: what a seed's sub-policies do and what the master on them does.

    A master of seed s stands on the sub-policies of seed s.
    """
    found = {}
    for kind in KINDS:
        sub_policies, masters = f"{prefix}walker/{kind}", f"{prefix}{association.place}/{kind}"
        if not is_row(sub_policies) or not is_row(masters):
            continue
        mine, theirs = (
            results.scores_by_seed(sub_policies, OF_SUB_POLICIES),
            results.scores_by_seed(masters, OF_MASTERS),
        )
        both = [(mine[seed], theirs[seed]) for seed in mine if seed in theirs]
        if both:
            found[kind] = np.array(both, np.float64)
    return found


def strength(results: Results, association: Association, prefix: str = "") -> Effect | None:
    """The rank correlation of the pairs within kinds; None where no kind has three seeds and varies on both sides."""
    found = seed_pairs(results, association, prefix).values()
    groups = [pairs for pairs in found if len(pairs) > 2 and all(np.ptp(side) for side in pairs.T)]
    generator = generator_for(f"association {prefix}{association.place}")
    return rank_correlation(groups, generator) if groups else None


__all__ = ["ASSOCIATIONS", "OF_MASTERS", "OF_SUB_POLICIES", "Association", "seed_pairs", "strength"]
