"""From records to figures: what each policy achieved, and how the policies compare.

Failed and truncated episodes are counted, never averaged in: a policy that gives up early has driven
little. Means, and everything that compares, use only the (plan, seed) pairs that all policies
finished in that setting (placement and sensing); how many those are is part of the result. Finished is what ended by
itself, whether complete or with jump edges that it could not reach; those are counted apart, and told.
An episode that ended by itself but saw less than another one on the same plan (by more than
`SHORTFALL`) stopped short: it is not finished, or giving up early would look like exploring fast. A
policy that finished nothing in a setting is left out of its comparison, so that it does not leave
the others nothing.
"""

from __future__ import annotations

import dataclasses
import functools
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from polyexplore_gym.errors import ResultsError
from polyexplore_gym.evaluation.bounds import RATIOS, Bounds, over
from polyexplore_gym.evaluation.records import EpisodeRecord, Key, Pair
from polyexplore_gym.evaluation.setting import Setting
from polyexplore_gym.evaluation.statistics import (
    Interval,
    area_under_coverage,
    bootstrap_interval,
    geometric_mean,
    holm,
    interquartile_mean,
    probability_of_improvement,
    proportion_interval,
    signed_rank_p,
)

Side = tuple[str, Setting]
"""What is compared: a policy in a setting."""
SHORTFALL = 0.02
"""Share of the free area by which an episode may stay behind the most that was seen on the plan and be finished."""

METRICS: dict[str, Callable[[EpisodeRecord], float | None]] = {
    "distance": lambda r: r.distance,
    "distance_90": lambda r: r.distance_90,
    "distance_95": lambda r: r.distance_95,
    "distance_99": lambda r: r.distance_99,
    "coverage": lambda r: r.coverage,
    "decisions": lambda r: r.decisions,
    "measurements": lambda r: r.measurements,
    "sim_time": lambda r: r.sim_time,
    "collisions": lambda r: r.collisions,
    "latency": lambda r: r.timing.get("act_mean"),
}
"""Figures of a record. `auc`, the area under the coverage, needs all records and is added to them, as are the ratios
to the bounds (`bounds.RATIOS`) where there are any."""


@dataclass(frozen=True, slots=True)
class Metric:
    """One figure of one policy over `pairs` starts."""

    pairs: int
    mean: Interval
    iqm: Interval


@dataclass(frozen=True, slots=True)
class Row:
    """One policy in one setting."""

    policy: str
    setting: Setting
    episodes: int
    complete: int
    """Finished, and nothing is left."""
    unreached: int
    """Finished, with jump edges left that could not be reached or were given up."""
    short: int
    """Ended by itself, having seen less of the plan than others."""
    truncated: int
    failed: int
    metrics: dict[str, Metric]
    """By name; each over the pairs for which all compared policies have the figure."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """One policy in one setting against another, over the pairs that both sides finished."""

    ours: Side
    theirs: Side
    pairs: int
    buildings: int
    ratio: Interval
    """Geometric mean of our distance over theirs; below 1 is better."""
    time: Interval
    """The same of the simulated time."""
    improvement: Interval
    """Probability that ours is the shorter on a pair, ties half."""
    p: float
    """Two-sided Wilcoxon signed-rank test on log distances, buildings averaged."""
    p_holm: float
    """The same, corrected for all comparisons made with it."""
    ratios: tuple[float, ...]
    """Our distance over theirs, pair by pair."""


@dataclass(frozen=True, slots=True)
class Summary:
    """All figures of a study."""

    reference: str
    rows: list[Row]
    """By setting, the shortest mean distance first."""
    against_reference: list[Comparison]
    """Every other policy against the reference, in the same setting; the best ratio first, as below."""
    between_settings: list[Comparison]
    """Every policy against itself in another setting: at a further placement against the first one with the same
    sensing, and with a further way to sense against the first one at the same placement."""
    bounds: Mapping[Pair, Bounds]
    """Of the starts for which they are known."""
    notes: list[str]
    """What a reader must know of the figures: how many pairs were compared, what was left out."""


def summarize(
    records: Sequence[EpisodeRecord],
    rng: np.random.Generator,
    *,
    reference: str = "nearest",
    bounds: Mapping[Pair, Bounds] | None = None,
    resamples: int = 2000,
    confidence: float = 0.95,
) -> Summary:
    """The figures of a study's records.

    The area under the coverage is the mean coverage over the plan's horizon: the longest of the
    distances compared on that plan, all policies, settings and seeds together.

    Args:
        records: one an episode.
        rng: source of the bootstrap.
        reference: policy to compare with; when it was not run, the first of the records' is taken.
        bounds: on the best possible exploration of the starts (`evaluation.bounds`); None: unknown.
        resamples: bootstrap samples.
        confidence: content of the intervals.

    Raises:
        ResultsError: there are no records.
    """
    if not records:
        raise ResultsError("there are no records to summarize")
    policies = list(dict.fromkeys(r.policy for r in records))
    settings = list(dict.fromkeys(r.setting for r in records))
    if reference not in policies:
        reference = policies[0]
    table = _Table(records, rng, resamples, confidence)

    rows: list[Row] = []
    against: list[Comparison] = []
    notes: list[str] = []
    common: dict[Setting, list[Pair]] = {}
    for setting in settings:
        compared = [p for p in policies if table.finished(p, setting)]
        common[setting] = _common_pairs(table.finished(p, setting) for p in compared)
        notes += _notes(records, setting, policies, compared, len(common[setting]))
    horizons = table.horizons(policies, common)
    for setting in settings:
        compared = [p for p in policies if table.finished(p, setting)]
        found = table.rows(policies, compared, setting, common[setting], horizons, bounds or {})
        rows += sorted(found, key=_sort_key)
        against += table.against(reference, compared, setting, common[setting])
    between: list[Comparison] = []
    for ours, theirs in _one_apart(settings):
        sides = [((p, ours), (p, theirs)) for p in policies]
        pairs = [_common_pairs(table.finished(*side) for side in two) for two in sides]
        kept = [i for i, p in enumerate(pairs) if p]
        between += table.compare([sides[i] for i in kept], [pairs[i] for i in kept])
    return Summary(reference, rows, against, between, bounds or {}, notes)


def compare(
    records: Sequence[EpisodeRecord],
    rng: np.random.Generator,
    *,
    reference: str = "nearest",
    resamples: int = 2000,
    confidence: float = 0.95,
) -> list[Comparison]:
    """`Summary.against_reference` alone, for a part of the records; empty where the reference finished nothing."""
    policies = list(dict.fromkeys(r.policy for r in records))
    table = _Table(records, rng, resamples, confidence)
    found: list[Comparison] = []
    for setting in dict.fromkeys(r.setting for r in records):
        compared = [p for p in policies if table.finished(p, setting)]
        common = _common_pairs(table.finished(p, setting) for p in compared)
        found += table.against(reference, compared, setting, common)
    return found


def finished(records: Sequence[EpisodeRecord]) -> list[EpisodeRecord]:
    """The records that are compared: ended by themselves, and not short of what was seen on the plan."""
    most: dict[str, float] = {}
    for r in records:
        most[r.plan_hash] = max(most.get(r.plan_hash, 0.0), r.coverage)
    return [r for r in records if r.ended and r.coverage >= most[r.plan_hash] - SHORTFALL]


class _Table:
    """Records by policy, setting and pair, and the resampling that all figures share."""

    def __init__(
        self, records: Sequence[EpisodeRecord], rng: np.random.Generator, resamples: int, confidence: float
    ) -> None:
        self._records = {(r.policy, r.setting, r.pair): r for r in records}
        self._finished: set[Key] = {r.key for r in finished(records)}
        self._confidence = confidence
        self._interval = functools.partial(bootstrap_interval, rng=rng, resamples=resamples, confidence=confidence)

    def finished(self, policy: str, setting: Setting) -> list[Pair]:
        return [
            pair
            for (p, where, pair), r in self._records.items()
            if (p, where) == (policy, setting) and r.key in self._finished
        ]

    def horizons(self, policies: list[str], common: dict[Setting, list[Pair]]) -> dict[str, float]:
        """By plan: the longest distance compared on it."""
        longest: dict[str, float] = {}
        for setting, pairs in common.items():
            for policy in policies:
                for pair in pairs:
                    record = self._records.get((policy, setting, pair))
                    if record is not None and record.key in self._finished:
                        longest[pair[0]] = max(longest.get(pair[0], 0.0), record.distance)
        return longest

    def rows(
        self,
        policies: list[str],
        compared: list[str],
        setting: Setting,
        pairs: list[Pair],
        horizons: dict[str, float],
        bounds: Mapping[Pair, Bounds],
    ) -> list[Row]:
        metrics: dict[str, dict[str, Metric]] = {policy: {} for policy in policies}
        get = {**METRICS, "auc": lambda r: _auc(r, horizons)}
        get |= {name: functools.partial(over, bounds=bounds, name=name) for name in RATIOS if bounds}
        for name, figure in get.items():
            values = {(p, pair): figure(self._records[p, setting, pair]) for p in compared for pair in pairs}
            kept = [pair for pair in pairs if all(values[p, pair] is not None for p in compared)]
            for policy in compared:
                metrics[policy][name] = self._metric(policy, setting, kept, [values[policy, pair] for pair in kept])
        found = []
        for policy in policies:
            own = [r for (p, where, _), r in self._records.items() if (p, where) == (policy, setting)]
            if own:
                count = Counter("short" if r.ended and r.key not in self._finished else r.status for r in own)
                counts = {name: count[name] for name in ("complete", "unreached", "short", "truncated", "failed")}
                found.append(Row(policy, setting, len(own), **counts, metrics=metrics[policy]))
        return found

    def against(self, reference: str, compared: list[str], setting: Setting, pairs: list[Pair]) -> list[Comparison]:
        if reference not in compared:
            return []
        sides = [((p, setting), (reference, setting)) for p in compared if p != reference]
        return self.compare(sides, [pairs] * len(sides))

    def compare(self, sides: list[tuple[Side, Side]], pairs: list[list[Pair]]) -> list[Comparison]:
        """Each (ours, theirs) over its pairs; the tests are corrected as one family. The best ratio first."""
        found = []
        for (ours, theirs), both in zip(sides, pairs, strict=True):
            mine, other = ([self._records[(*side, pair)] for pair in both] for side in (ours, theirs))
            a, b = (np.array([r.distance for r in some]) for some in (mine, other))
            clusters, strata = self._buildings(*ours, both)
            ratio = _ratio(a, b)
            times = _ratio(*(np.array([r.sim_time for r in some]) for some in (mine, other)))
            better = probability_of_improvement(a, b)
            found.append(
                Comparison(
                    ours,
                    theirs,
                    len(both),
                    len(set(clusters)),
                    self._interval(ratio, clusters, strata, statistic=geometric_mean),
                    self._interval(times, clusters, strata, statistic=geometric_mean),
                    proportion_interval(better, clusters, confidence=self._confidence),
                    signed_rank_p(np.log(ratio), clusters) if both else float("nan"),
                    float("nan"),
                    tuple(ratio.tolist()),
                )
            )
        corrected = holm([c.p for c in found])
        found = [dataclasses.replace(c, p_holm=float(p)) for c, p in zip(found, corrected, strict=True)]
        return sorted(found, key=lambda c: c.ratio.estimate)

    def _metric(self, policy: str, setting: Setting, pairs: list[Pair], values: list[float | None]) -> Metric:
        clusters, strata = self._buildings(policy, setting, pairs)
        array = np.array(values, dtype=np.float64)
        mean = self._interval(array, clusters, strata)
        iqm = self._interval(array, clusters, strata, statistic=interquartile_mean)
        return Metric(len(pairs), mean, iqm)

    def _buildings(self, policy: str, setting: Setting, pairs: list[Pair]) -> tuple[list[str], list[str]]:
        records = [self._records[policy, setting, pair] for pair in pairs]
        return [r.group for r in records], [r.stratum for r in records]


def _one_apart(settings: Sequence[Setting]) -> list[tuple[Setting, Setting]]:
    """Each setting beside those that have, of one factor, the first value instead of its own."""
    pairs = []
    for factor in Setting._fields:
        first = getattr(settings[0], factor)
        for setting in settings:
            other = setting._replace(**{factor: first})
            if other != setting and other in settings:
                pairs.append((setting, other))
    return pairs


def _ratio(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a over b; where all was seen from the start both are nothing, a tie."""
    both = (a > 0) & (b > 0)
    return np.where(both, a, 1.0) / np.where(both, b, 1.0)


def _auc(record: EpisodeRecord, horizons: dict[str, float]) -> float:
    distance, coverage = np.array(record.curve_distance), np.array(record.curve_coverage)
    return area_under_coverage(distance, coverage, horizons[record.plan_hash])


def _common_pairs(finished: Iterable[list[Pair]]) -> list[Pair]:
    """Pairs that are in all lists, in the order of the first."""
    lists = list(finished)
    if not lists:
        return []
    others = [set(pairs) for pairs in lists[1:]]
    return [pair for pair in lists[0] if all(pair in other for other in others)]


def _sort_key(row: Row) -> tuple[bool, float]:
    metric = row.metrics.get("distance")
    return (metric is None or metric.pairs == 0, metric.mean.estimate if metric else 0.0)


def _notes(
    records: Sequence[EpisodeRecord], setting: Setting, policies: list[str], compared: list[str], common: int
) -> list[str]:
    here = [r for r in records if r.setting == setting]
    pairs = {r.pair for r in here}
    notes = [f"{setting}: compared on {common} of {len(pairs)} starts, those finished by all {len(compared)} policies"]
    left_out = [p for p in policies if p not in compared and any(r.policy == p for r in records)]
    if left_out:
        notes.append(f"{setting}: left out of the comparison, as nothing was finished: {', '.join(left_out)}")
    errors = [r for r in here if r.status == "failed"]
    for r in errors[:3]:
        notes.append(f"{setting}: {r.policy} failed on {r.plan} (seed {r.seed}): {(r.error or '?').splitlines()[0]}")
    if len(errors) > 3:
        notes.append(f"{setting}: {len(errors) - 3} more failed; see the field `error` of the records")
    left = [r for r in finished(records) if r.setting == setting and not r.complete]
    if left:
        notes.append(f"{setting}: {len(left)} episodes that are compared left jump edges: {_left(left)}")
    short = sum(r.ended for r in here) - sum(r.setting == setting for r in finished(records))
    if short:
        notes.append(
            f"{setting}: {short} episodes ended having seen over {100 * SHORTFALL:.0f} % less of a plan than others "
            "did: stopped short, not compared"
        )
    cut = sum(r.cut_nodes > 0 or r.cut_lines > 0 for r in here)
    if cut:
        notes.append(f"{setting}: in {cut} episodes the observation had no room for all nodes or lines at some time")
    return notes


def _left(records: Sequence[EpisodeRecord]) -> str:
    n, lost = sum(r.unreached for r in records), sum(r.unreached_length for r in records)
    m, vain = sum(r.given_up for r in records), sum(r.given_up_length for r in records)
    return f"{n} ({lost:.1f} m) out of reach, {m} ({vain:.1f} m) given up"
