import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from polyexplore_gym.evaluation.statistics import (
    area_under_coverage,
    bootstrap_interval,
    coverage_at,
    geometric_mean,
    holm,
    interquartile_mean,
    probability_of_improvement,
    resampled_weights,
    signed_rank_p,
    weighted_mean,
)


def ones(values) -> np.ndarray:
    return np.ones((1, len(values)))


def test_interquartile_mean_is_the_trimmed_mean():
    rng = np.random.default_rng(0)
    for n in (4, 8, 40, 100):
        values = rng.lognormal(size=n)
        assert interquartile_mean(values, ones(values))[0] == pytest.approx(scipy.stats.trim_mean(values, 0.25))
    # By hand: of 1, 2, 9 the middle half is 1/4 of 1, all of 2, 1/4 of 9 (in units of a value).
    assert interquartile_mean(np.array([9.0, 1.0, 2.0]), np.ones((1, 3)))[0] == pytest.approx((0.25 + 2 + 2.25) / 1.5)
    assert interquartile_mean(np.array([5.0]), np.ones((1, 1)))[0] == 5.0


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.floats(0.1, 100), st.integers(0, 4)), min_size=1, max_size=20), st.integers(0, 2**32))
def test_weights_count_like_copies(pairs, seed):
    values, counts = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    if counts.sum() == 0:
        counts[0] = 1
    copies = np.repeat(values, counts)
    for statistic in (weighted_mean, geometric_mean, interquartile_mean):
        weighted = statistic(values, counts[None].astype(float))[0]
        assert weighted == pytest.approx(statistic(copies, ones(copies))[0], rel=1e-9)
    assert geometric_mean(copies, ones(copies))[0] == pytest.approx(scipy.stats.gmean(copies), rel=1e-9)


def test_interval_agrees_with_scipy():
    values = np.random.default_rng(1).lognormal(sigma=0.5, size=40)
    names = [f"plan {i}" for i in range(40)]
    for statistic, theirs in (
        (weighted_mean, np.mean),
        (interquartile_mean, lambda v, axis: scipy.stats.trim_mean(v, 0.25, axis=axis)),
    ):
        ours = bootstrap_interval(values, names, [""] * 40, np.random.default_rng(2), statistic, resamples=40_000)
        expected = scipy.stats.bootstrap(
            (values,), theirs, n_resamples=40_000, method="percentile", rng=np.random.default_rng(3)
        ).confidence_interval
        spread = expected.high - expected.low
        assert ours.low == pytest.approx(expected.low, abs=0.02 * spread)
        assert ours.high == pytest.approx(expected.high, abs=0.02 * spread)
        assert ours.estimate == pytest.approx(float(theirs(values, axis=0)))


def test_buildings_are_drawn_whole_and_within_their_stratum():
    clusters = ["a", "a", "b", "c", "c", "c", "d", "e"]
    strata = ["home", "home", "home", "office", "office", "office", "office", "shed"]
    weights = resampled_weights(clusters, strata, np.random.default_rng(0), 4000)
    assert weights.shape == (4000, 8)
    assert (weights[:, 0] == weights[:, 1]).all()
    assert (weights[:, 3] == weights[:, 4]).all()
    assert (weights[:, 0] + weights[:, 2] == 2).all()  # two homes
    assert (weights[:, 3] + weights[:, 6] == 2).all()  # two offices
    assert (weights[:, 7] == 1).all()  # the only shed has nobody to be exchanged with
    np.testing.assert_allclose(weights.mean(axis=0), 1.0, atol=0.05)
    # Three strata of one building each are one stratum of three.
    weights = resampled_weights(["a", "b", "c"], ["x", "y", "z"], np.random.default_rng(0), 4000)
    assert (weights.sum(axis=1) == 3).all()
    assert weights.std() > 0.5


def test_intervals_repeat_and_ask_for_two_buildings():
    values = np.arange(10.0)
    names = [str(i // 2) for i in range(10)]
    one, two = (bootstrap_interval(values, names, [""] * 10, np.random.default_rng(7)) for _ in range(2))
    assert one == two
    alone = bootstrap_interval(values, ["a"] * 10, [""] * 10, np.random.default_rng(7))
    assert alone.estimate == 4.5
    assert np.isnan(alone.low)
    assert np.isnan(alone.high)
    nothing = bootstrap_interval(np.array([]), [], [], np.random.default_rng(7))
    assert np.isnan(nothing.estimate)


def test_intervals_hold_what_they_promise():
    """Runs of a building share an offset: intervals over buildings cover, those over runs are far too short."""
    rng = np.random.default_rng(5)
    buildings = np.repeat(np.arange(30), 4)
    hits = {"buildings": 0, "runs": 0}
    trials = 400
    for _ in range(trials):
        values = 3.0 + rng.normal(size=30)[buildings] + 0.3 * rng.normal(size=120)
        for unit, names in (("buildings", buildings.astype(str)), ("runs", np.arange(120).astype(str))):
            interval = bootstrap_interval(values, list(names), [""] * 120, rng, resamples=500)
            hits[unit] += interval.low <= 3.0 <= interval.high
    assert 0.90 <= hits["buildings"] / trials <= 0.98
    assert hits["runs"] / trials < 0.80


def test_probability_of_improvement_by_hand():
    better = probability_of_improvement(np.array([1.0, 2.0, 3.0, 4.0]), np.array([2.0, 2.0, 2.0, 5.0]))
    np.testing.assert_array_equal(better, [1.0, 0.5, 0.0, 1.0])
    interval = bootstrap_interval(better, list("abcd"), [""] * 4, np.random.default_rng(0), resamples=20_000)
    assert interval.estimate == 0.625
    # All draws of 4 with replacement, one by one.
    draws = np.array(np.meshgrid(*[better] * 4)).reshape(4, -1).mean(axis=0)
    assert (interval.low, interval.high) == tuple(np.quantile(draws, [0.025, 0.975]))


def test_signed_rank_is_that_of_the_buildings():
    rng = np.random.default_rng(3)
    differences = rng.normal(0.3, 1.0, size=24)
    alone = [str(i) for i in range(24)]
    assert signed_rank_p(differences, alone) == pytest.approx(scipy.stats.wilcoxon(differences).pvalue)
    twice = np.concatenate([differences + 0.1, differences - 0.1])  # two runs a building do not make it surer
    assert signed_rank_p(twice, alone * 2) == pytest.approx(scipy.stats.wilcoxon(differences).pvalue)
    for n in range(2, 14):  # exact, with ties and zeros
        rounded = np.round(rng.normal(0.5, 1.0, size=n), 1)
        rounded[0] = 0.0
        if rounded.any():
            assert signed_rank_p(rounded, alone[:n]) == pytest.approx(scipy.stats.wilcoxon(rounded).pvalue)
    assert signed_rank_p(np.zeros(5), alone[:5]) == 1.0
    assert np.isnan(signed_rank_p(np.array([1.0, 2.0]), ["a", "a"]))


def test_holm_by_hand():
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])
    np.testing.assert_allclose(holm([0.5, np.nan, 0.9]), [1.0, np.nan, 1.0])
    np.testing.assert_allclose(holm([np.nan, 0.02]), [np.nan, 0.02])
    assert len(holm([])) == 0


def test_area_under_coverage_by_hand():
    distance, coverage = np.array([0.0, 2.0, 2.0, 6.0]), np.array([0.2, 0.5, 0.6, 1.0])
    assert area_under_coverage(distance, coverage, 6.0) == pytest.approx((2 * 0.2 + 4 * 0.6) / 6)
    assert area_under_coverage(distance, coverage, 10.0) == pytest.approx((2 * 0.2 + 4 * 0.6 + 4 * 1.0) / 10)
    assert area_under_coverage(distance, coverage, 3.0) == pytest.approx((2 * 0.2 + 1 * 0.6) / 3)
    assert area_under_coverage(distance, coverage, 0.0) == pytest.approx(0.2)
    assert area_under_coverage(np.zeros(1), np.ones(1), 5.0) == 1.0
    np.testing.assert_array_equal(
        coverage_at(distance, coverage, np.array([0.0, 1.9, 2.0, 5.9, 6.0, 50.0])), [0.2, 0.2, 0.6, 0.6, 1.0, 1.0]
    )


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.floats(0, 5), st.floats(0, 0.2)), min_size=1, max_size=12), st.floats(0.1, 40))
def test_area_under_coverage_is_the_mean_of_the_steps(steps, horizon):
    distance = np.concatenate([[0.0], np.cumsum([s[0] for s in steps])])
    coverage = np.minimum(np.concatenate([[0.1], 0.1 + np.cumsum([s[1] for s in steps])]), 1.0)
    fine = (np.arange(200_000) + 0.5) * horizon / 200_000
    assert area_under_coverage(distance, coverage, horizon) == pytest.approx(
        coverage_at(distance, coverage, fine).mean(), abs=1e-4
    )
