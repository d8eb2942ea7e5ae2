"""Means, intervals and tests for runs that are grouped by building.

Runs on plans of one building are alike, so whole buildings are resampled (a cluster bootstrap),
within strata such as kinds of building (Davison and Hinkley, "Bootstrap Methods and their
Application", 1997, sections 3.2 and 3.8). The interquartile mean and the probability of improvement
follow Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (2021).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

_BLOCK = 2_000_000
"""Weights held at a time."""
_EXACT = 13
"""Up to so many pairs the signed-rank test goes through all signs."""

Statistic = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(values (n,), weights (B, n)) -> (B,)."""


@dataclass(frozen=True, slots=True)
class Interval:
    """An estimate with its bootstrap interval; nan bounds when there are too few buildings for one."""

    estimate: float
    low: float
    high: float


def weighted_mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(B,) means of `values` (n,) under `weights` (B, n)."""
    return weights @ values / weights.sum(axis=1)


def geometric_mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(B,) geometric means of positive `values` (n,) under `weights` (B, n)."""
    return np.exp(weighted_mean(np.log(values), weights))


def interquartile_mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(B,) means of the middle half of the weight; a value on a quartile counts in part.

    With equal weights and n divisible by 4 this is `scipy.stats.trim_mean(values, 0.25)`.
    """
    order = np.argsort(values, kind="stable")
    w = weights[:, order]
    upper = np.cumsum(w, axis=1)
    total = upper[:, -1:]
    inside = np.minimum(upper, 0.75 * total) - np.maximum(upper - w, 0.25 * total)
    return np.maximum(inside, 0.0) @ values[order] / (0.5 * total[:, 0])


def probability_of_improvement(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """(n,) 1 where `ours` is smaller (better), 0.5 where equal, 0 elsewhere: its mean is the probability."""
    return np.where(ours < theirs, 1.0, np.where(ours == theirs, 0.5, 0.0))


def resampled_weights(
    clusters: Sequence[str], strata: Sequence[str], rng: np.random.Generator, resamples: int
) -> np.ndarray:
    """(resamples, n) how often each run counts when whole clusters are drawn with replacement.

    As many clusters are drawn from each stratum as it has. A stratum of one cluster could not vary:
    all such strata are thrown together.

    Args:
        clusters: (n,) the building of each run.
        strata: (n,) the stratum of each run; the first run of a cluster speaks for all of it.
        rng: source of the draws.
        resamples: how many.
    """
    names, first, of_run = np.unique(np.asarray(clusters, dtype=str), return_index=True, return_inverse=True)
    stratum = np.asarray(strata, dtype=str)[first]
    kinds, sizes = np.unique(stratum, return_counts=True)
    groups = [np.flatnonzero(stratum == kind) for kind in kinds[sizes > 1]]
    if (sizes == 1).any():
        groups.append(np.flatnonzero(np.isin(stratum, kinds[sizes == 1])))
    counts = np.zeros((resamples, len(names)))
    for members in groups:
        draws = rng.multinomial(len(members), np.full(len(members), 1 / len(members)), size=resamples)
        counts[:, members] = draws
    return counts[:, of_run.ravel()]


def bootstrap_interval(
    values: np.ndarray,
    clusters: Sequence[str],
    strata: Sequence[str],
    rng: np.random.Generator,
    statistic: Statistic = weighted_mean,
    *,
    resamples: int = 5000,
    confidence: float = 0.95,
) -> Interval:
    """A statistic with its stratified cluster-bootstrap percentile interval.

    Args:
        values: (n,) one a run.
        clusters: (n,) the building of each run.
        strata: (n,) the stratum of each run.
        rng: source of the resampling.
        statistic: of values and weights; see `Statistic`.
        resamples: bootstrap samples.
        confidence: content of the interval.
    """
    values = np.asarray(values, dtype=np.float64)
    if len(values) == 0:
        return Interval(np.nan, np.nan, np.nan)
    estimate = float(statistic(values, np.ones((1, len(values))))[0])
    if len(set(clusters)) < 2:
        return Interval(estimate, np.nan, np.nan)
    block = max(1, _BLOCK // len(values))
    parts = [
        statistic(values, resampled_weights(clusters, strata, rng, min(block, resamples - start)))
        for start in range(0, resamples, block)
    ]
    tail = (1 - confidence) / 2
    low, high = np.quantile(np.concatenate(parts), [tail, 1 - tail])
    return Interval(estimate, float(low), float(high))


def signed_rank_p(differences: np.ndarray, clusters: Sequence[str]) -> float:
    """Two-sided p of Wilcoxon's signed-rank test on the clusters' mean differences.

    Runs of one building are averaged first: the test asks for independent pairs. Clusters without a
    difference are left out; 1 when that leaves none, nan with fewer than two clusters to begin with.
    """
    from scipy.stats import rankdata, wilcoxon

    names, of_run = np.unique(np.asarray(clusters, dtype=str), return_inverse=True)
    if len(names) < 2:
        return float("nan")
    means = np.bincount(of_run.ravel(), weights=differences) / np.bincount(of_run.ravel())
    means = means[means != 0.0]
    n = len(means)
    if n == 0:
        return 1.0
    if n > _EXACT:
        return float(wilcoxon(means).pvalue)
    # All 2^n signs: exact with ties as well, where scipy takes seconds.
    ranks = rankdata(np.abs(means))
    sums = (np.arange(2**n)[:, None] >> np.arange(n) & 1) @ ranks
    found = ranks[means > 0].sum()
    return float(min(1.0, 2.0 * min((sums <= found).mean(), (sums >= found).mean())))


def holm(p: Sequence[float]) -> np.ndarray:
    """Holm's step-down correction (1979) of several tests' p; a nan is no test and stays."""
    values = np.asarray(p, dtype=np.float64)
    corrected = np.full(len(values), np.nan)
    order = [i for i in np.argsort(values, kind="stable") if not np.isnan(values[i])]
    highest = 0.0
    for rank, i in enumerate(order):
        highest = max(highest, min(1.0, (len(order) - rank) * values[i]))
        corrected[i] = highest
    return corrected


def coverage_at(distance: np.ndarray, coverage: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Coverage known after `at` metres: that of the last measurement at or before; the final one beyond the end.

    Args:
        distance: (k,) driven at the measurements, not decreasing, starting at 0.
        coverage: (k,) coverage there.
        at: (g,) distances asked for, m, not negative.
    """
    row = np.searchsorted(distance, at, side="right") - 1
    return np.asarray(coverage, dtype=np.float64)[np.maximum(row, 0)]


def area_under_coverage(distance: np.ndarray, coverage: np.ndarray, horizon: float) -> float:
    """Mean coverage over the first `horizon` metres (the step function of `coverage_at`), 0 to 1.

    A horizon of 0 gives the coverage at the start.
    """
    if horizon <= 0:
        return float(coverage_at(distance, coverage, np.zeros(1))[0])
    ends = np.clip(np.append(distance[1:], max(horizon, distance[-1])), 0.0, horizon)
    return float(np.dot(coverage, ends - np.clip(distance, 0.0, horizon)) / horizon)
