import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from polyexplore_gym.evaluation.statistics import (
    area_under_coverage,
    arithmetic_mean,
    bootstrap_interval,
    coverage_at,
    geometric_mean,
    holm,
    interquartile_mean,
    mean_band,
    probability_of_improvement,
    proportion_band,
    proportion_interval,
    signed_rank_p,
)


def test_statistics_are_those_of_scipy():
    rng = np.random.default_rng(0)
    for n in (4, 8, 40, 100):
        values = rng.lognormal(size=(3, n))
        np.testing.assert_allclose(interquartile_mean(values), scipy.stats.trim_mean(values, 0.25, axis=1))
        np.testing.assert_allclose(geometric_mean(values), scipy.stats.gmean(values, axis=1))
    # By hand: of 1, 2, 9 the middle half is 1/4 of 1, all of 2, 1/4 of 9 (in units of a value).
    assert interquartile_mean(np.array([9.0, 1.0, 2.0])) == pytest.approx((0.25 + 2 + 2.25) / 1.5)
    assert interquartile_mean(np.array([5.0])) == 5.0


def twin(values, clusters, strata, rng, statistic, resamples):
    """`bootstrap_interval` run by run, with the same draws."""
    log = min(values) > 0
    y = [float(np.log(v)) if log else float(v) for v in values]
    names = sorted(set(clusters))
    runs = {name: [i for i, c in enumerate(clusters) if c == name] for name in names}
    kind = {name: strata[runs[name][0]] for name in names}
    alone = [k for k in set(kind.values()) if list(kind.values()).count(k) == 1]
    kind = {name: "alone" if k in alone else k for name, k in kind.items()}
    if len(names) - len(set(kind.values())) < 2:
        kind = dict.fromkeys(names, "all")
    freedom = len(names) - len(set(kind.values()))

    def centres(y):
        mean = {name: float(np.mean([y[i] for i in runs[name]])) for name in names}
        centre = {k: float(np.mean([mean[name] for name in names if kind[name] == k])) for k in set(kind.values())}
        return centre, float(np.sqrt(sum((mean[name] - centre[kind[name]]) ** 2 for name in names) / freedom))

    centre, spread = centres(y)
    peers = {name: sum(kind[other] == kind[name] for other in names) for name in names}
    able = [name for name in names if peers[name] > 1]
    width = 1.06 * len(able) ** -0.2
    picks = rng.choice([names.index(name) for name in able], size=(resamples, len(names)))
    noise = rng.standard_normal((resamples, len(names)))
    worlds = []
    for pick, push in zip(picks, noise, strict=True):
        drawn = [0.0] * len(y)
        for name, donor, more in zip(names, pick, push, strict=True):
            giver = names[donor]
            for at, i in enumerate(runs[name]):
                source = runs[giver][at % len(runs[giver])]
                away = (y[source] - centre[kind[giver]]) * np.sqrt(peers[giver] / (peers[giver] - 1))
                drawn[i] = centre[kind[name]] + (away + width * spread * more) / np.sqrt(1 + width**2)
        worlds.append(drawn)

    def unit(y):
        return np.exp(y) if log else np.array(y)

    def scale(figure):
        return np.log(figure) if log else figure

    truth = scale(statistic(unit(np.ravel(worlds))))
    errors = [(scale(statistic(unit(world))) - truth) / centres(world)[1] for world in worlds]
    low, high = np.quantile(errors, [0.025, 0.975])
    estimate = scale(statistic(np.asarray(values)))
    return float(unit(estimate - high * spread)), float(unit(estimate - low * spread))


@pytest.mark.parametrize("statistic", [arithmetic_mean, geometric_mean, interquartile_mean])
@pytest.mark.parametrize("kinds", ["one", "some", "each", "two"])
def test_the_interval_is_that_of_its_slow_twin(statistic, kinds):
    rng = np.random.default_rng(1)
    clusters = [f"b{i}" for i in rng.integers(0, 9, size=20)]
    strata = {"one": [""] * 20, "some": [f"k{int(c[1]) % 3 if c != 'b8' else 9}" for c in clusters]}
    strata |= {"each": clusters, "two": [f"k{int(c[1]) // 2}" for c in clusters]}
    values = rng.lognormal(size=20)
    samples = [values] if statistic is geometric_mean else [values, np.round(values) - 1.0]
    for sample in samples:
        arguments = (sample, clusters, strata[kinds])
        ours = bootstrap_interval(*arguments, np.random.default_rng(2), statistic, resamples=60)
        assert (ours.low, ours.high) == pytest.approx(twin(*arguments, np.random.default_rng(2), statistic, 60))
        assert ours.estimate == pytest.approx(float(statistic(sample)))


def test_a_normal_sample_has_students_interval():
    for n in (5, 12, 60):
        values = np.random.default_rng(n).normal(size=n)
        names = [f"plan {i}" for i in range(n)]
        low, high = scipy.stats.ttest_1samp(values, 0.0).confidence_interval()
        band = mean_band(values[:, None], names, [""] * n)[:, 0]
        np.testing.assert_allclose(band, [values.mean(), low, high])
        for ours in (
            bootstrap_interval(values, names, [""] * n, np.random.default_rng(2), resamples=20_000),
            bootstrap_interval(
                np.exp(values), names, [""] * n, np.random.default_rng(2), geometric_mean, resamples=20_000
            ),
        ):
            bounds = (ours.low, ours.high) if ours.low < 0 else (np.log(ours.low), np.log(ours.high))
            assert bounds == pytest.approx((low, high), abs=0.08 * (high - low))


def test_buildings_are_drawn_whole():
    """Two runs a building that are equal tell no more than one; and a stratum's mean shifts nothing."""
    rng = np.random.default_rng(3)
    values, names = rng.normal(size=12), [f"b{i:02d}" for i in range(12)]
    once = bootstrap_interval(values, names, [""] * 12, np.random.default_rng(0))
    twice = bootstrap_interval(np.repeat(values, 2), np.repeat(names, 2), [""] * 24, np.random.default_rng(0))
    assert (twice.low, twice.high) == pytest.approx((once.low, once.high))
    kinds = ["home", "office"] * 6
    near, far = (
        bootstrap_interval(values + np.array([0.0, shift] * 6), names, kinds, np.random.default_rng(0))
        for shift in (0.0, 1000.0)
    )
    assert (far.low - 500, far.high - 500) == pytest.approx((near.low, near.high))
    # A column of a band is a sample of its own.
    columns = rng.normal(size=(12, 3))
    for band in (lambda v: mean_band(v, names, kinds), lambda v: proportion_band(v > 0, names)):
        np.testing.assert_allclose(band(columns)[:, 1:2], band(columns[:, 1:2]))


def test_intervals_repeat_and_ask_for_three_buildings():
    values = np.arange(10.0)
    names = [str(i // 2) for i in range(10)]
    one, two = (bootstrap_interval(values, names, [""] * 10, np.random.default_rng(7)) for _ in range(2))
    assert one == two
    for few in (["a"] * 10, ["a", "b"] * 5):
        interval = bootstrap_interval(values, few, [""] * 10, np.random.default_rng(7))
        assert interval.estimate == 4.5
        assert np.isnan([interval.low, interval.high]).all()
        assert np.isnan(proportion_interval(values > 4, few).low)
        assert np.isnan(mean_band(values[:, None], few, few)[1:]).all()
    nothing = bootstrap_interval(np.array([]), [], [], np.random.default_rng(7))
    assert np.isnan(nothing.estimate)
    assert np.isnan(proportion_interval(np.array([]), []).estimate)
    for value in (0.0, 1.0, 0.3):
        alike = bootstrap_interval(np.full(5, value), list("abcde"), [""] * 5, np.random.default_rng(7))
        assert (alike.low, alike.high) == pytest.approx((value, value))


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
    assert 0.92 <= hits["buildings"] / trials <= 0.98
    assert hits["runs"] / trials < 0.80


def test_probability_of_improvement_by_hand():
    better = probability_of_improvement(np.array([1.0, 2.0, 3.0, 4.0]), np.array([2.0, 2.0, 2.0, 5.0]))
    np.testing.assert_array_equal(better, [1.0, 0.5, 0.0, 1.0])
    for values, names in ((better, list("abcd")), (np.tile(better, 5), [str(i // 2) for i in range(20)])):
        interval = proportion_interval(values, names)
        assert interval.estimate == 0.625
        # The shares that a score test of the variance found does not reject.
        sums = [sum(v - 0.625 for v, name in zip(values, names, strict=True) if name == n) for n in set(names)]
        variance = len(sums) / (len(sums) - 1) * sum(s**2 for s in sums) / len(values) ** 2
        for bound in (interval.low, interval.high):
            error = np.sqrt(bound * (1 - bound) * variance / (0.625 * 0.375))
            assert abs(bound - 0.625) == pytest.approx(scipy.stats.norm.ppf(0.975) * error)
    # Where all agree, it is Wilson's interval of so many buildings.
    wilson = scipy.stats.binomtest(6, 6).proportion_ci(method="wilson")
    sure = proportion_interval(np.ones(12), [str(i // 2) for i in range(12)])
    assert (sure.low, sure.high) == pytest.approx((wilson.low, wilson.high))


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
