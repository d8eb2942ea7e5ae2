"""Do the 95 % intervals hold the truth in 95 % of experiments? Simulated experiments whose truth is known.

    python benchmarks/interval_coverage.py [--experiments 1000] [--designs 18 10 86 ...] [--figures mean ...] [--seed 0]
                                           [--results FOLDER] [--percentiles]

An experiment draws new buildings of the kinds that a study has and two policies' distances on them: log-normal, with
the spread between buildings, within a building and between policies that was found in real results, and some ties.
The figures are those of the tables: mean and interquartile mean of a distance, the geometric mean of the policies'
ratio, and the probability that one is shorter. A row says how often the interval held the truth, how often it lay
wholly above or below it, and how wide it is; with `--percentiles` also how often those of a plain stratified bootstrap
held it (many times slower).

With `--results` the last design is drawn from that folder of `polyexplore bench`: the distances of two of its
policies, building by building with replacement within each kind, so that nothing is assumed of their distribution.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from polyexplore_gym.evaluation import read_records
from polyexplore_gym.evaluation.statistics import (
    Interval,
    arithmetic_mean,
    bootstrap_interval,
    geometric_mean,
    interquartile_mean,
    probability_of_improvement,
    proportion_interval,
)
from polyexplore_gym.evaluation.summary import finished

POPULATION = 200_000
"""Runs from which the truth is taken where no formula gives it."""

# Log distance (m) of `nearest`, placement in_front, on the 18 plans of `polyexplore bench` and the 86 shared plans:
# mean by kind, standard deviation over the buildings of a kind (all kinds together), and the runs of each building.
BENCH, SHARED = 0.69, 0.75
DESIGNS: dict[str, list[tuple[Sequence[int], float, float]]] = {
    "18": [([1] * 12, 3.93, BENCH), ([1] * 4, 4.83, BENCH), ([1] * 2, 6.22, BENCH)],  # homes, angled, offices
    "18, 3 starts": [([3] * 12, 3.93, BENCH), ([3] * 4, 4.83, BENCH), ([3] * 2, 6.22, BENCH)],
    "10": [([1] * 10, 3.93, BENCH)],
    "86": [
        ([1] * 23 + [2], 3.51, SHARED),  # homes
        ([1] * 12 + [2] * 3, 6.36, SHARED),  # offices
        ([1] * 8 + [2] * 4, 6.78, SHARED),  # schools
        ([1] * 5 + [2, 3, 5], 6.29, SHARED),  # campus
        ([1, 1, 2], 5.35, SHARED),  # laboratories
        ([1, 1], 5.04, SHARED),  # floors of apartments
        ([1, 1], 2.47, SHARED),  # arenas like homes
        ([1], 5.2, SHARED),  # three of which there is one
        ([1], 5.2, SHARED),
        ([2], 5.2, SHARED),
    ],
}
# As above, but each kind with the spread found in it, where there are more than two of it.
DESIGNS["86, kinds unlike"] = [
    (sizes, mean, spread)
    for (sizes, mean, _), spread in zip(DESIGNS["86"], (0.81, 0.48, 0.5, 1.19, 1.02, *[SHARED] * 5), strict=True)
]
WITHIN = 0.25
"""Share of the log distance's variance that runs of one building have for themselves."""
RATIO_SPREAD, RATIO_WITHIN, TIES = 0.12, 0.5, 0.1
"""Log ratio of two policies on a plan: standard deviation, share of its variance within a building, share of ties."""
RATIO_MEANS = (-0.1, 0.15)
"""Mean log ratio: each experiment draws its own."""
FIGURES = ("mean", "IQM", "ratio", "P(shorter)")


@dataclass(frozen=True)
class Experiment:
    """Distances of two policies on the same runs (n,), and the truth of each figure."""

    ours: np.ndarray
    theirs: np.ndarray
    clusters: list[str]
    strata: list[str]
    truth: dict[str, float]


class Simulated:
    """Log-normal experiments of a design."""

    def __init__(self, design: list[tuple[Sequence[int], float, float]], rng: np.random.Generator) -> None:
        sizes = np.concatenate([kind_sizes for kind_sizes, _, _ in design])
        self.building = np.repeat(np.arange(len(sizes)), sizes)
        kind = np.repeat(np.arange(len(design)), [sum(kind_sizes) for kind_sizes, _, _ in design])
        self.mean, self.spread = (np.array([row[i] for row in design])[kind] for i in (1, 2))
        self.clusters, self.strata = [f"b{b}" for b in self.building], [f"k{k}" for k in kind]
        rows = rng.integers(len(kind), size=POPULATION)
        population = np.exp(self.mean[rows] + self.spread[rows] * rng.standard_normal(POPULATION))
        self.truth = {
            "mean": float(np.exp(self.mean + self.spread**2 / 2).mean()),
            "IQM": float(interquartile_mean(population)),
        }

    def draw(self, rng: np.random.Generator) -> Experiment:
        theirs = np.exp(self.mean + self.spread * self._effects(WITHIN, rng))
        better = rng.uniform(*RATIO_MEANS)
        log_ratio = better + RATIO_SPREAD * self._effects(RATIO_WITHIN, rng)
        same = rng.random(len(theirs)) < TIES
        ours = theirs * np.where(same, 1.0, np.exp(log_ratio))
        return Experiment(ours, theirs, self.clusters, self.strata, {**self.truth, **_pair_truth(better)})

    def _effects(self, within: float, rng: np.random.Generator) -> np.ndarray:
        """(n,) standard normal, alike in a building but for `within` of the variance."""
        shared = rng.standard_normal(self.building[-1] + 1)[self.building]
        return np.sqrt(1 - within) * shared + np.sqrt(within) * rng.standard_normal(len(self.building))


def _pair_truth(better: float) -> dict[str, float]:
    from scipy.stats import norm

    shorter = (1 - TIES) * float(norm.cdf(-better / RATIO_SPREAD)) + TIES / 2
    return {"ratio": float(np.exp((1 - TIES) * better)), "P(shorter)": shorter}


class Resampled:
    """Experiments of buildings drawn from a folder of results, with replacement within each kind."""

    def __init__(self, folder: Path) -> None:
        done = finished(read_records(folder))
        policies = list(dict.fromkeys(r.policy for r in done))
        theirs_name = "nearest" if "nearest" in policies else policies[0]
        ours_name = next(p for p in policies if p != theirs_name)
        setting = done[0].setting
        found = {(r.policy, *r.pair): r for r in done if r.setting == setting and r.distance > 0}
        pairs = [
            (found[ours_name, *key[1:]], r)
            for key, r in found.items()
            if key[0] == theirs_name and (ours_name, *key[1:]) in found
        ]
        kinds: dict[str, dict[str, list[tuple[float, float]]]] = {}
        for mine, other in pairs:
            kinds.setdefault(other.stratum, {}).setdefault(other.group, []).append((mine.distance, other.distance))
        self.kinds = {kind: [np.array(runs) for runs in buildings.values()] for kind, buildings in kinds.items()}
        ours, theirs = np.concatenate([runs for buildings in self.kinds.values() for runs in buildings]).T
        self.truth = {
            "mean": float(theirs.mean()),
            "IQM": float(interquartile_mean(theirs)),
            "ratio": float(geometric_mean(ours / theirs)),
            "P(shorter)": float(probability_of_improvement(ours, theirs).mean()),
        }

    def draw(self, rng: np.random.Generator) -> Experiment:
        runs, clusters, strata = [], [], []
        for kind, buildings in self.kinds.items():
            for number, i in enumerate(rng.integers(len(buildings), size=len(buildings))):
                runs.append(buildings[i])
                clusters += [f"{kind} {number}"] * len(buildings[i])
                strata += [kind] * len(buildings[i])
        ours, theirs = np.concatenate(runs).T
        return Experiment(ours, theirs, clusters, strata, self.truth)


def interval(e: Experiment, figure: str, rng: np.random.Generator, method=bootstrap_interval) -> Interval:
    """The interval of a figure."""
    better = probability_of_improvement(e.ours, e.theirs)
    if figure == "P(shorter)" and method is bootstrap_interval:
        return proportion_interval(better, e.clusters)
    values, statistic = {
        "mean": (e.theirs, arithmetic_mean),
        "IQM": (e.theirs, interquartile_mean),
        "ratio": (e.ours / e.theirs, geometric_mean),
        "P(shorter)": (better, arithmetic_mean),
    }[figure]
    return method(values, e.clusters, e.strata, rng, statistic)


def percentiles(values, clusters, strata, rng: np.random.Generator, statistic, resamples: int = 400) -> Interval:
    """The plain way: whole buildings drawn with replacement within their stratum, the middle 95 % of the results."""
    members: dict[str, list[np.ndarray]] = {}
    for name in dict.fromkeys(clusters):
        runs = np.flatnonzero(np.array(clusters) == name)
        members.setdefault(strata[runs[0]], []).append(runs)
    found = []
    for _ in range(resamples):
        rows = [group[i] for group in members.values() for i in rng.integers(len(group), size=len(group))]
        found.append(statistic(values[np.concatenate(rows)]))
    return Interval(float(statistic(values)), *np.quantile(found, [0.025, 0.975]).tolist())


def coverage(
    world: Simulated | Resampled, figure: str, experiments: int, rng: np.random.Generator, method=bootstrap_interval
) -> dict[str, float]:
    """Shares of experiments in which the interval held the truth, lay above or below it; its median width."""
    above = below = 0
    widths = []
    for _ in range(experiments):
        experiment = world.draw(rng)
        truth = experiment.truth[figure]
        found = interval(experiment, figure, rng, method)
        above += truth < found.low
        below += truth > found.high
        widths.append((found.high - found.low) / truth)
    shares = {"held": experiments - above - below, "above": above, "below": below}
    return {name: count / experiments for name, count in shares.items()} | {"width": float(np.median(widths))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--experiments", type=int, default=1000)
    parser.add_argument("--designs", nargs="+", default=list(DESIGNS), choices=list(DESIGNS))
    parser.add_argument("--figures", nargs="+", default=list(FIGURES), choices=FIGURES)
    parser.add_argument("--results", type=Path, help="folder of `polyexplore bench` to draw experiments from")
    parser.add_argument("--percentiles", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    worlds: dict[str, Simulated | Resampled] = {
        name: Simulated(DESIGNS[name], np.random.default_rng(arguments.seed)) for name in arguments.designs
    }
    if arguments.results:
        worlds[f"as in {arguments.results.name}"] = Resampled(arguments.results)
    methods = {"": bootstrap_interval} | ({", percentiles": percentiles} if arguments.percentiles else {})
    print("| plans | figure | held % | above % | below % | width / truth |\n| --- | --- | --: | --: | --: | --: |")
    for name, world in worlds.items():
        for figure in arguments.figures:
            for remark, method in methods.items():
                c = coverage(world, figure, arguments.experiments, np.random.default_rng(arguments.seed), method)
                shares = " | ".join(f"{100 * c[part]:.1f}" for part in ("held", "above", "below"))
                print(f"| {name} | {figure}{remark} | {shares} | {c['width']:.2f} |", flush=True)


if __name__ == "__main__":
    main()
