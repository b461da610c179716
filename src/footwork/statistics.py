"""Statistics over seeds: what a few runs say, and how sure they are of it.

Definitions are those of Agarwal et al., "Deep Reinforcement Learning at the Edge of the
Statistical Precipice" (2021): interquartile mean, stratified bootstrap, probability of
improvement, performance profiles. Scores of one row of the table are an array [S] or
[S, T]: S seeds, T strata (directions, tasks). Randomness is an argument, a numpy Generator.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Hashable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Statistic = Callable[[Floats], Floats]  # of scores [draws, S, T], over the last two axes: [draws]

DRAWS = 20_000  # resamples of an interval that decides something; 2000 leave its ends 1.3 % of its width of noise
BAND_DRAWS = 2000  # of a figure's band, at every point
CONFIDENCE = 0.95


class Effect(NamedTuple):
    """A number with its 95 % interval."""

    estimate: float
    low: float
    high: float


def generator_for(name: str) -> np.random.Generator:
    """A generator of its own for everything that has a name, the same in every process."""
    return np.random.default_rng(zlib.crc32(name.encode()))


def as_scores(values: npt.ArrayLike) -> Floats:
    """Scores [S, T] from [S] or [S, T].

    Raises:
        ValueError: there are none, or one is not finite.
    """
    scores = np.asarray(values, np.float64)
    scores = scores[:, None] if scores.ndim == 1 else scores
    if scores.ndim != 2 or scores.size == 0:
        raise ValueError(f"scores must be [seeds] or [seeds, strata] and not empty, got shape {scores.shape}")
    if not np.isfinite(scores).all():
        raise ValueError("scores must be finite")
    return scores


def iqm(scores: npt.ArrayLike, axis: int | None = None) -> Floats:
    """Interquartile mean: of what is left when a quarter of the values is cut off at either end.

    As many whole values are cut as fit into a quarter; below four values it is the mean.
    """
    values = np.asarray(scores, np.float64)
    values, axis = (values.reshape(-1), 0) if axis is None else (values, axis)
    cut = values.shape[axis] // 4
    ordered = np.sort(values, axis=axis)
    kept = np.take(ordered, range(cut, values.shape[axis] - cut), axis=axis)
    return np.asarray(kept.mean(axis=axis))


def overall_iqm(scores: Floats) -> Floats:
    """The IQM over the last two axes."""
    return iqm(scores.reshape(*scores.shape[:-2], -1), axis=-1)


def spread(scores: Floats) -> Floats:
    """Standard deviation across seeds [..., S, T], its square averaged over the strata."""
    return np.sqrt(np.mean(np.var(scores, axis=-2, ddof=1 if scores.shape[-2] > 1 else 0), axis=-1))


def draw_seeds(seeds: int, draws: int, generator: np.random.Generator) -> npt.NDArray[np.int64]:
    """Which seeds a bootstrap draws, with replacement [draws, S].

    A seed comes with all its strata, where rliable draws within each on its own: here they depend on each
    other (four directions that were trained on one another's ants).
    """
    return generator.integers(0, seeds, (draws, seeds))


def percentile_interval(distribution: npt.ArrayLike, axis: int = 0) -> Floats:
    """Bounds [2, ...] between which the middle 95 % of a bootstrap distribution lie."""
    tail = 100 * (1 - CONFIDENCE) / 2
    return np.asarray(np.percentile(np.asarray(distribution), (tail, 100 - tail), axis=axis))


def contrast(
    groups: Sequence[npt.ArrayLike],
    weights: Sequence[float],
    generator: np.random.Generator,
    statistic: Statistic = overall_iqm,
    draws: int = DRAWS,
    units: Sequence[Sequence[Hashable]] | None = None,
) -> Effect:
    """A weighted sum of a statistic over groups of runs, with its stratified-bootstrap interval.

    The groups (rows of the table) are the strata: each is resampled on its own, by whole
    seeds. Weights (1, -1) make a difference, (1, -1, -1, 1) a difference of differences.
    Groups whose runs stand on the same things (masters on the same sub-policies) are not
    independent: those with the same units are drawn together, as in a paired comparison.

    Args:
        groups: scores [S] or [S, T] of each, as many seeds as there are.
        weights: one per group.
        generator: of the resamples.
        statistic: over the last two axes.
        draws: resamples.
        units: of each group, what each of its scores stands on; None: every score on something of its own.

    Raises:
        ValueError: a group is empty or not finite, or there are not as many weights or units as groups or scores.
    """
    if len(groups) != len(weights) or not groups:
        raise ValueError(f"as many weights as groups, got {len(weights)} and {len(groups)}")
    scores = [as_scores(group) for group in groups]
    if units is not None and [len(each) for each in units] != [len(each) for each in scores]:
        raise ValueError(f"one unit per score, got {[len(u) for u in units]} for {[len(s) for s in scores]}")
    estimate = sum(w * float(statistic(s)) for w, s in zip(weights, scores, strict=True))
    chosen: dict[Hashable, npt.NDArray[np.int64]] = {}
    samples = []
    for i, group in enumerate(scores):
        shared: Hashable = i if units is None else tuple(units[i])
        if shared not in chosen:
            chosen[shared] = draw_seeds(len(group), draws, generator)
        samples.append(statistic(group[chosen[shared]]))
    total = sum((w * s for w, s in zip(weights, samples, strict=True)), np.zeros(draws))
    low, high = percentile_interval(total)
    return Effect(float(estimate), float(low), float(high))


def probability_of_improvement(one: npt.ArrayLike, other: npt.ArrayLike) -> float:
    """Probability that a run of ``one`` scores higher than a run of ``other``, ties counted half, averaged over strata.

    The Mann-Whitney U statistic divided by the number of pairs.

    Raises:
        ValueError: there are no scores, or different numbers of strata.
    """
    a, b = as_scores(one), as_scores(other)
    if a.shape[1] != b.shape[1]:
        raise ValueError(f"as many strata on both sides, got {a.shape[1]} and {b.shape[1]}")
    pairs = a[:, None, :] - b[None, :, :]
    return float(np.mean((pairs > 0) + 0.5 * (pairs == 0)))


def rank_correlation(groups: Sequence[npt.ArrayLike], generator: np.random.Generator, draws: int = DRAWS) -> Effect:
    """Spearman's correlation of pairs [S, 2] within groups, with its stratified-bootstrap interval.

    Ranks are taken within each group, ties sharing theirs, and counted from the group's mean, so that what sets
    groups apart adds nothing; with one group it is Spearman's rho. A group in which one side is constant says nothing
    and is left out; a larger group weighs more, about as the cube of its size. Each group's pairs are resampled on
    their own; a resample in which nothing varies counts as no correlation.

    Raises:
        ValueError: there are no pairs, they are not finite, or there is no group in which both sides vary.
    """
    pairs = [np.asarray(group, np.float64) for group in groups]
    if not pairs or any(group.ndim != 2 or group.shape[1] != 2 or not len(group) for group in pairs):
        raise ValueError(f"groups of pairs [seeds, 2], got shapes {[group.shape for group in pairs]}")
    if not all(np.isfinite(group).all() for group in pairs):
        raise ValueError("pairs must be finite")
    pairs = [group for group in pairs if all(np.ptp(side) for side in group.T)]
    if not pairs:
        raise ValueError("there is no group in which both sides vary")
    here = _pooled_correlation([group[None] for group in pairs])[0]
    drawn = _pooled_correlation([group[draw_seeds(len(group), draws, generator)] for group in pairs])
    low, high = percentile_interval(np.nan_to_num(drawn))
    return Effect(float(here), float(low), float(high))


def _pooled_correlation(groups: Sequence[Floats]) -> Floats:
    """Of pairs [draws, S, 2] of each group: their centred ranks' correlation [draws]; NaN where nothing varies."""
    centred = []
    for group in groups:
        below = (group[:, None] < group[:, :, None]) + 0.5 * (group[:, None] == group[:, :, None])  # [draws, S, S, 2]
        ranks = below.sum(axis=2)
        centred.append(ranks - ranks.mean(axis=1, keepdims=True))
    ranks = np.concatenate(centred, axis=1)
    both, one, other = (np.sum(ranks[..., i] * ranks[..., j], axis=1) for i, j in ((0, 1), (0, 0), (1, 1)))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(both / np.sqrt(one * other))


def performance_profile(scores: npt.ArrayLike, thresholds: npt.ArrayLike) -> Floats:
    """Share of runs that score above each threshold (rliable's score distribution)."""
    values = as_scores(scores).reshape(-1)
    return np.asarray((values[:, None] > np.asarray(thresholds, np.float64)[None]).mean(axis=0))


def profile_band(
    scores: npt.ArrayLike, thresholds: npt.ArrayLike, generator: np.random.Generator, draws: int = BAND_DRAWS
) -> tuple[Floats, Floats]:
    """Performance profile of runs [S] or [S, T] at each threshold [X], and its interval [2, X]; seeds drawn whole."""
    values, at = as_scores(scores), np.asarray(thresholds, np.float64)
    above = (values[:, :, None] > at).mean(axis=1)  # [S, X]
    samples = above[draw_seeds(len(values), draws, generator)].mean(axis=1)
    return performance_profile(values, at), percentile_interval(samples)


def curve_band(curves: npt.ArrayLike, generator: np.random.Generator, draws: int = BAND_DRAWS) -> tuple[Floats, Floats]:
    """IQM over seeds of curves [S, X] and its interval [2, X]; a curve is drawn whole."""
    values = np.asarray(curves, np.float64)
    samples = iqm(values[draw_seeds(len(values), draws, generator)], axis=1)
    return iqm(values, axis=0), percentile_interval(samples)


def wilson(hits: float, count: float) -> tuple[float, float]:
    """95 % interval of a rate (Wilson 1927), which stays honest at 0 and at 1.

    Raises:
        ValueError: not 0 <= hits <= count, or count is 0.
    """
    if not count > 0 or not 0 <= hits <= count:
        raise ValueError(f"0 <= hits <= count and count > 0, got {hits} of {count}")
    z, rate = 1.959964, hits / count
    middle = (rate + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(rate * (1 - rate) / count + z * z / (4 * count * count))
    low = 0.0 if hits == 0 else max(middle - half, 0.0)  # by arithmetic alone it would miss both ends by a last digit
    return low, 1.0 if hits == count else min(middle + half, 1.0)


def rate_over_seeds(hits: npt.ArrayLike) -> tuple[float, float]:
    """95 % interval of a rate from E episodes of each of S seeds: hits, bool [S, E].

    Wilson's, with as many episodes as they are worth: their number over the design effect (Kish
    1965), the variance of the seeds' rates over what binomial chance alone would give, at least 1.
    Seeds that differ widen the interval; with one seed it says nothing about others.
    """
    by_seed = np.atleast_2d(np.asarray(hits, bool))
    seeds, episodes = by_seed.shape
    rate = float(by_seed.mean())
    by_chance = rate * (1 - rate) / episodes
    across = float(np.var(by_seed.mean(axis=1), ddof=1)) if seeds > 1 else 0.0
    count = by_seed.size / max(1.0, across / by_chance if by_chance > 0 else 1.0)
    return wilson(rate * count, count)


def mean_over_seeds(
    values: Sequence[npt.ArrayLike], generator: np.random.Generator, draws: int = BAND_DRAWS
) -> tuple[float, float]:
    """95 % bootstrap interval of the mean of all episodes: seeds are drawn, and then episodes of each.

    Args:
        values: one array per seed, of any length but not all empty; of a seed without values nothing is drawn.
        generator: of the resamples.
        draws: resamples.
    """
    groups = [np.asarray(group, np.float64) for group in values if np.size(group)]
    means = np.empty(draws)
    for draw in range(draws):
        chosen = [groups[i] for i in generator.integers(0, len(groups), len(groups))]
        again = [group[generator.integers(0, group.size, group.size)] for group in chosen]
        means[draw] = sum(part.sum() for part in again) / sum(part.size for part in again)
    low, high = percentile_interval(means)
    return float(low), float(high)


__all__ = [
    "BAND_DRAWS",
    "CONFIDENCE",
    "DRAWS",
    "Effect",
    "as_scores",
    "contrast",
    "curve_band",
    "draw_seeds",
    "generator_for",
    "iqm",
    "mean_over_seeds",
    "overall_iqm",
    "percentile_interval",
    "performance_profile",
    "probability_of_improvement",
    "profile_band",
    "rank_correlation",
    "rate_over_seeds",
    "spread",
    "wilson",
]
