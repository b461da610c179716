"""Statistics against published values, against scipy, and against arithmetic done by hand."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from footwork import statistics

# The score matrices (runs x tasks) of rliable's own test, with the values published there.
RLIABLE_X = np.array([[1, 2], [2, 2], [1, 1], [2, 1]])
RLIABLE_Y = np.array([[1, 1], [2, 2], [3, 3]])


def test_the_values_that_rliable_publishes():
    assert statistics.iqm(RLIABLE_X) == 1.5
    assert statistics.iqm(RLIABLE_Y) == 2
    assert statistics.probability_of_improvement(RLIABLE_X, RLIABLE_Y) == pytest.approx(1 / 3)


def test_iqm_cuts_a_quarter_at_either_end():
    assert statistics.iqm([100.0, 1, 2, 3, 4, 5, 6, -50]) == pytest.approx((2 + 3 + 4 + 5) / 4)
    assert statistics.iqm([1.0, 2, 6]) == 3  # below four values nothing is cut
    np.testing.assert_array_equal(statistics.iqm([[0.0, 10], [1, 20], [2, 30], [900, -900]], axis=0), [1.5, 15])


@given(hnp.arrays(np.float64, st.integers(1, 40), elements=st.floats(-1e3, 1e3)))
def test_iqm_is_scipys_trimmed_mean(values):
    assert statistics.iqm(values) == pytest.approx(scipy.stats.trim_mean(values, 0.25), abs=1e-9)


@given(
    hnp.arrays(np.int64, st.integers(1, 12), elements=st.integers(0, 5)),
    hnp.arrays(np.int64, st.integers(1, 12), elements=st.integers(0, 5)),
)
def test_probability_of_improvement_is_mann_whitney(one, other):
    expected = scipy.stats.mannwhitneyu(one, other, alternative="greater").statistic / (one.size * other.size)
    found = statistics.probability_of_improvement(one, other)
    assert found == pytest.approx(expected)
    assert found + statistics.probability_of_improvement(other, one) == pytest.approx(1)


def test_wilson_at_newcombes_published_examples():
    """Newcombe, Statistics in Medicine 17 (1998), table I, method 3."""
    for hits, count, low, high in [
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ]:
        assert statistics.wilson(hits, count) == pytest.approx((low, high), abs=5e-5)
    for count in range(1, 300):
        assert statistics.wilson(0, count)[0] == 0.0
        assert statistics.wilson(count, count)[1] == 1.0
    with pytest.raises(ValueError, match="got 3 of 2"):
        statistics.wilson(3, 2)


def test_a_rate_over_seeds_that_agree_is_wilsons_and_seeds_that_differ_widen_it():
    alike = np.tile(np.arange(100) < 30, (4, 1))
    assert statistics.rate_over_seeds(alike) == pytest.approx(statistics.wilson(120, 400))
    assert statistics.rate_over_seeds(alike[0]) == pytest.approx(statistics.wilson(30, 100))
    apart = np.stack([np.ones(100, bool), np.zeros(100, bool)] * 2)  # a seed has it or has it not: 2 of 4
    low, high = statistics.rate_over_seeds(apart)
    assert low < statistics.wilson(2, 4)[0] + 0.05
    assert high > statistics.wilson(2, 4)[1] - 0.05
    assert statistics.rate_over_seeds(np.ones((3, 50))) == pytest.approx(statistics.wilson(150, 150))


def test_a_mean_over_seeds_covers_the_truth_where_pooling_does_not():
    """Seeds 1.0 apart and episodes 1.0 apart: 95 % is reached to within what few seeds cost a bootstrap."""
    generator = np.random.default_rng(0)
    covered = pooled = 0
    for _ in range(100):
        values = 5.0 + generator.normal(size=(10, 1)) + generator.normal(size=(10, 50))
        low, high = statistics.mean_over_seeds(values, generator, draws=200)
        covered += low <= 5.0 <= high
        low, high = statistics.mean_over_seeds([values.ravel()], generator, draws=200)
        pooled += low <= 5.0 <= high
    assert covered >= 82
    assert pooled <= 50


def test_a_mean_over_one_seed_agrees_with_theory():
    values = np.random.default_rng(0).normal(3.0, 2.0, 400)
    interval = statistics.mean_over_seeds([values, []], np.random.default_rng(1))
    assert interval == pytest.approx((values.mean() - 0.196, values.mean() + 0.196), abs=0.03)


def test_seeds_are_drawn_with_replacement_and_evenly():
    drawn = statistics.draw_seeds(2, 4000, np.random.default_rng(0))
    # The mean of two draws of {0, 1} is 0, 1/2 or 1 with probability 1/4, 1/2, 1/4.
    np.testing.assert_allclose(
        [(drawn.mean(axis=1) == value).mean() for value in (0, 0.5, 1)], (0.25, 0.5, 0.25), atol=0.03
    )


def test_a_difference_has_the_interval_that_scipy_finds():
    key = np.random.default_rng(3)
    one, other = key.normal(1.0, 1.0, 30), key.normal(0.0, 1.0, 25)
    found = statistics.contrast([one, other], (1, -1), np.random.default_rng(1), draws=20_000)
    mean = lambda a, b, axis: statistics.iqm(a, axis=axis) - statistics.iqm(b, axis=axis)  # noqa: E731
    expected = scipy.stats.bootstrap(
        (one, other), mean, vectorized=True, method="percentile", n_resamples=20_000, rng=np.random.default_rng(2)
    ).confidence_interval
    assert found.estimate == pytest.approx(float(statistics.iqm(one) - statistics.iqm(other)))
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high), abs=0.02)
    again = statistics.contrast([one, other], (1, -1), np.random.default_rng(1), draws=20_000)
    assert again == found  # the generator is all the randomness there is


def test_a_difference_of_differences():
    exact = statistics.contrast([[5.0] * 4, [1.0] * 4, [3.0] * 4, [2.0] * 4], (1, -1, -1, 1), np.random.default_rng(0))
    assert exact == (3, 3, 3)


def test_runs_on_the_same_things_are_compared_pair_by_pair():
    """Two masters on each of ten sub-policies that differ by 1.0, and by 0.1 beside: a paired comparison sees that."""
    key, found = np.random.default_rng(5), {"paired": [], "apart": []}
    shared, own = [("walker", i) for i in range(10)], [[("a", i) for i in range(10)], [("b", i) for i in range(10)]]
    for _ in range(100):
        base = key.normal(0, 1.0, 10)
        one, other = base + 0.2 + key.normal(0, 0.1, 10), base + key.normal(0, 0.1, 10)
        for name, units in (("paired", [shared, shared]), ("apart", own)):
            found[name].append(statistics.contrast([one, other], (1, -1), key, draws=400, units=units))
    width = {name: np.mean([e.high - e.low for e in effects]) for name, effects in found.items()}
    covers = np.mean([e.low <= 0.2 <= e.high for e in found["paired"]])
    assert width["paired"] < 0.35 * width["apart"]
    assert covers >= 0.88
    assert found["paired"][0].estimate == found["apart"][0].estimate
    same = statistics.contrast([one, one], (1, -1), key, units=[shared, shared])
    assert same == (0, 0, 0)


def test_a_unit_for_every_score():
    with pytest.raises(ValueError, match="one unit per score"):
        statistics.contrast([[1.0, 2.0]], (1,), np.random.default_rng(0), units=[["a"]])


def test_intervals_cover_as_often_as_they_say():
    key, hits = np.random.default_rng(0), 0
    for _ in range(300):
        effect = statistics.contrast([key.normal(0, 1, 30)], (1,), key, draws=400)
        hits += effect.low <= 0 <= effect.high
    assert 0.90 <= hits / 300 <= 0.98


def test_spread_is_within_strata():
    assert statistics.spread(np.array([[0.0, 100], [2, 102]])) == pytest.approx(np.sqrt(2))
    assert statistics.spread(np.array([[1.0], [3], [5]])) == pytest.approx(2)


PAIRS = hnp.arrays(np.float64, st.tuples(st.integers(3, 12), st.just(2)), elements=st.integers(0, 6).map(float))


@given(PAIRS)
def test_rank_correlation_of_one_group_is_spearmans(pairs):
    if any(len(set(side)) == 1 for side in pairs.T):
        with pytest.raises(ValueError, match="both sides vary"):
            statistics.rank_correlation([pairs], np.random.default_rng(0), draws=10)
        return
    found = statistics.rank_correlation([pairs], np.random.default_rng(0), draws=50)
    assert found.estimate == pytest.approx(scipy.stats.spearmanr(*pairs.T).statistic, abs=1e-9)
    assert -1 - 1e-9 <= found.low <= found.high <= 1 + 1e-9


def test_what_sets_groups_apart_is_no_rank_correlation():
    """Groups on a falling line, seeds of each on a rising one: the kinds would say -, the seeds say +."""
    key = np.random.default_rng(0)
    groups = [np.column_stack([np.arange(8) + 100 * g, np.arange(8) - 100 * g]).astype(float) for g in range(3)]
    assert scipy.stats.spearmanr(*np.concatenate(groups).T).statistic < -0.5
    assert statistics.rank_correlation(groups, key, draws=50) == pytest.approx((1, 1, 1))
    stretched = [np.exp(group / 100) for group in groups]
    assert statistics.rank_correlation(stretched, key, draws=50).estimate == pytest.approx(1)


def test_a_group_at_its_ceiling_takes_nothing_from_a_rank_correlation():
    rising = np.column_stack([np.arange(8.0), np.arange(8.0)])
    at_ceiling = np.column_stack([np.ones(8), np.arange(8.0)])
    found = statistics.rank_correlation([rising, at_ceiling], np.random.default_rng(0), draws=50)
    assert found.estimate == pytest.approx(1)


def test_intervals_of_a_rank_correlation_cover_as_often_as_they_say():
    key, hits = np.random.default_rng(1), 0
    for _ in range(200):
        own = key.normal(0, 1, (4, 10, 2))
        pairs = np.stack([own[..., 0], 0.7 * own[..., 0] + np.sqrt(0.51) * own[..., 1]], axis=-1)
        effect = statistics.rank_correlation(list(pairs), key, draws=200)
        hits += effect.low <= 6 / np.pi * np.arcsin(0.35) <= effect.high
    assert 0.90 <= hits / 200 <= 0.99


@pytest.mark.parametrize(
    ("groups", "message"),
    [([], "groups of pairs"), ([[1.0, 2.0]], "groups of pairs"), ([[[1.0, np.nan], [2.0, 3.0]]], "finite")],
)
def test_pairs_that_say_nothing_are_refused(groups, message):
    with pytest.raises(ValueError, match=message):
        statistics.rank_correlation(groups, np.random.default_rng(0))


def test_profiles_and_bands():
    np.testing.assert_array_equal(
        statistics.performance_profile([0.1, 0.5, 0.9, 0.9], [0.0, 0.5, 0.89, 1]), [1, 0.5, 0.5, 0]
    )
    middle, (low, high) = statistics.curve_band([[0.0, 1], [0, 3], [0, 5]], np.random.default_rng(0))
    np.testing.assert_array_equal(middle, [0, 3])
    assert low[0] == high[0] == 0
    assert 1 <= low[1] < 3 < high[1] <= 5


@pytest.mark.parametrize(("values", "message"), [([], "not empty"), ([1.0, np.nan], "finite")])
def test_scores_that_say_nothing_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        statistics.contrast([values], (1,), np.random.default_rng(0))
