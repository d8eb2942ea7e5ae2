"""Which criterion drives least, and does it depend on sensor, noise, pose error, placement or when it senses?

    python benchmarks/factorial.py [--plans FOLDER] [--largest 1000] [--first N] [--sensing stops moving]
                                   [--scan-every 0.5] [--workers 2] [--out results/factorial]
                                   [--figure docs/factorial.png]

Factors: field of view (180, 360 degrees), maximum range (8, 30 m), laser noise (1, 5 times 0.01 m and 0.1 degrees),
pose (exact, gaussian, odometry, slam), all criteria, both placements, and scans and decisions at stops or on the way
(`--sensing`). Every plan meets each pose model once and each level of the first three twice: half of their 2 x 2 x 2
combinations, such that no two of the factors go together, with the pose models dealt out at random. On a plan all
criteria, placements and ways to sense meet the same start and noise. Plans are generated (`plan_statistics.SUITES`)
and, where they are, the shared ones. The drive is kinematic. Odometry that nothing corrects is played on plans of at
most 300 m2 only: on larger ones the map falls apart before it is complete.

Tables: the effect of each factor on the distance of `nearest` (least squares on log distances with a mean for each
plan, errors clustered by building); the ratios between criteria at each level of each factor, by family and by size,
with 95 % intervals over buildings; what ended, and how much was seen. The figure shows the ratios. A run that was
stopped goes on where it was.

FOLDER (`--plans`) holds plan JSON files; default: `floorplans` under $POLYEXPLORE_DATA, or ../shared/data/floorplans
beside the checkout.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import statistics
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.stats
import sensing
from plan_statistics import SUITES, default_folder

from polyexplore_gym.config import DriveConfig, EnvConfig, PoseConfig, SensorConfig
from polyexplore_gym.evaluation import EpisodeRecord, Setting, Study, evaluate, name_policies
from polyexplore_gym.evaluation.statistics import Interval, bootstrap_interval, geometric_mean
from polyexplore_gym.evaluation.summary import finished
from polyexplore_gym.evaluation.tables import format_table
from polyexplore_gym.floorplan import FloorPlan, load_plan, suite

POLICIES = ("nearest", "distance_advantage", "modified_sum", "ekman_ratio")
PLACEMENTS = ("midpoint", "in_front")
POSES = ("exact", "gaussian", "odometry", "slam")
FACTORS: dict[str, tuple[str, ...]] = {
    "field of view": ("180 degrees", "360 degrees"),
    "maximum range": ("8 m", "30 m"),
    "laser noise": ("1 x", "5 x"),
    "pose": POSES,
}
SIZES = ((0, 100), (100, 300), (300, 1000), (1000, math.inf))
"""Groups of plans by area, m2."""
DRIFTING = 300.0
"""The largest plan on which odometry is left uncorrected, m2."""
CONTRASTS = (("modified_sum", "ekman_ratio"), ("modified_sum", "nearest"), ("ekman_ratio", "nearest"),
             ("distance_advantage", "nearest"))  # fmt: skip


@dataclass(frozen=True)
class Condition:
    """One level of each factor."""

    wide: bool
    far: bool
    noisy: bool
    pose: str

    @property
    def levels(self) -> dict[str, str]:
        """By factor."""
        picked = (int(self.wide), int(self.far), int(self.noisy), POSES.index(self.pose))
        return {name: levels[i] for (name, levels), i in zip(FACTORS.items(), picked, strict=True)}

    @property
    def name(self) -> str:
        return "_".join(level.replace(" ", "") for level in self.levels.values())

    def config(self) -> EnvConfig:
        noise = 5.0 if self.noisy else 1.0
        sensor = SensorConfig(
            beams=720 if self.wide else 361,
            field_of_view=2.0 * math.pi if self.wide else math.pi,
            max_range=30.0 if self.far else 8.0,
            sigma_range=0.01 * noise,
            sigma_angle=math.radians(0.1) * noise,
        )
        pose = PoseConfig(mode=self.pose)  # type: ignore[arg-type]
        return EnvConfig(sensor=sensor, pose=pose, drive=DriveConfig(mode="kinematic"), max_decisions=1000)


@dataclass(frozen=True)
class Run:
    """A record with what it was played under."""

    record: EpisodeRecord
    condition: Condition
    area: float
    shared: bool


def deal(plans: Sequence[FloorPlan], rng: np.random.Generator) -> dict[Condition, list[FloorPlan]]:
    """Which plans are played under which condition: four for every plan, see the top."""
    dealt: dict[Condition, list[FloorPlan]] = defaultdict(list)
    corners = list(itertools.product((False, True), repeat=3))
    for plan in plans:
        parity = int(rng.integers(2))
        half = [corner for corner in corners if sum(corner) % 2 == parity]
        for corner, pose in zip(half, rng.permutation(POSES), strict=True):
            if pose != "odometry" or plan.area <= DRIFTING:
                dealt[Condition(*corner, str(pose))].append(plan)
    return dealt


def play(dealt: Mapping[Condition, Sequence[FloorPlan]], options: argparse.Namespace, shared: set[str]) -> list[Run]:
    """All episodes, those of each condition in a folder of its own."""
    out = options.out / sensing.folder_name(options.sensing, options.scan_every)
    runs: list[Run] = []
    for k, (condition, plans) in enumerate(sorted(dealt.items(), key=lambda item: item[0].name), 1):
        print(f"{k}/{len(dealt)} {condition.name}: {len(plans)} plans", flush=True)
        study = Study(
            policies=name_policies(options.policies),
            plans=plans,
            placements=PLACEMENTS,
            sensing=options.sensing,
            config=sensing.scanning(condition.config(), options.scan_every),
        )
        areas = {plan.content_hash: plan.area for plan in plans}
        records = evaluate(study, out=out / condition.name, workers=options.workers)
        runs += [Run(r, condition, areas[r.plan_hash], r.plan_hash in shared) for r in records]
    return runs


def within(runs: Sequence[Run]) -> dict[str, tuple[str, ...]]:
    """The factors of which every plan meets every level: fields of the record."""
    return {factor: tuple(dict.fromkeys(getattr(r.record, factor) for r in runs)) for factor in Setting._fields}


def groups(runs: Sequence[Run]) -> dict[str, dict[str, list[Run]]]:
    """The runs by factor and level, the plans' family and size among them."""
    found: dict[str, dict[str, list[Run]]] = {"": {"all": list(runs)}}
    for factor, levels in FACTORS.items():
        found[factor] = {level: [r for r in runs if r.condition.levels[factor] == level] for level in levels}
    for factor, levels in within(runs).items():
        found[factor] = {level: [r for r in runs if getattr(r.record, factor) == level] for level in levels}
    families = {r.record.stratum for r in runs if not r.shared}
    found["plans"] = {
        f"generated: {f}": [r for r in runs if not r.shared and r.record.stratum == f] for f in sorted(families)
    }
    found["plans"]["real and drawn"] = [r for r in runs if r.shared]
    found["area"] = {
        f"{low:g} to {high:g} m2" if math.isfinite(high) else f"from {low:g} m2": [
            r for r in runs if low < r.area <= high
        ]
        for low, high in SIZES
    }
    return {factor: {level: some for level, some in levels.items() if some} for factor, levels in found.items()}


def comparable(runs: Sequence[Run]) -> list[Run]:
    """Runs that ended by themselves and saw about as much as the best one on the same plan, condition by condition."""
    by_condition: dict[Condition, list[Run]] = defaultdict(list)
    for run in runs:
        by_condition[run.condition].append(run)
    kept: list[Run] = []
    for some in by_condition.values():
        keys = {record.key for record in finished([run.record for run in some])}
        kept += [run for run in some if run.record.key in keys]
    return kept


def ratio(runs: Sequence[Run], ours: str, theirs: str, rng: np.random.Generator) -> tuple[Interval, int] | None:
    """Geometric mean of our distance over theirs where both are comparable, and the number of pairs."""
    known = {(r.record.policy, r.record.setting, r.record.plan_hash, r.condition): r for r in runs}
    pairs = [(r, known[theirs, *key[1:]]) for key, r in known.items() if key[0] == ours and (theirs, *key[1:]) in known]
    pairs = [(a, b) for a, b in pairs if a.record.distance > 0 and b.record.distance > 0]
    if not pairs:
        return None
    values = np.array([a.record.distance / b.record.distance for a, b in pairs])
    buildings, strata = [a.record.group for a, _ in pairs], [a.record.stratum for a, _ in pairs]
    return bootstrap_interval(values, buildings, strata, rng, geometric_mean), len(pairs)


def effects(runs: Sequence[Run], *, confidence: float = 0.95) -> list[tuple[str, str, Interval]]:
    """By what each level multiplies the distance, against the first level of its factor.

    Least squares on log distances with a mean for each plan; the covariance of the estimate is that of
    Liang and Zeger 1986 with buildings as clusters, and Student's t with buildings less one degrees.
    """
    runs = [r for r in runs if r.record.distance > 0]
    factors = {**FACTORS, **within(runs)}
    columns = [(factor, level) for factor, levels in factors.items() for level in levels[1:]]
    levels = [{**r.condition.levels, **r.record.setting._asdict()} for r in runs]
    x = np.array([[float(of[factor] == level) for factor, level in columns] for of in levels])
    y = np.log([r.record.distance for r in runs])
    plans = np.unique([r.record.plan_hash for r in runs], return_inverse=True)[1]
    count = np.bincount(plans)
    y = y - (np.bincount(plans, y) / count)[plans]
    x = x - np.stack([np.bincount(plans, column) / count for column in x.T], axis=1)[plans]
    inverse = np.linalg.inv(x.T @ x)
    beta = inverse @ x.T @ y
    buildings = np.unique([r.record.group for r in runs], return_inverse=True)[1]
    score = np.zeros((buildings.max() + 1, len(columns)))
    np.add.at(score, buildings, x * (y - x @ beta)[:, None])
    g = len(score)
    error = np.sqrt(np.diag(inverse @ score.T @ score @ inverse) * g / (g - 1))
    t = scipy.stats.t.ppf(0.5 + confidence / 2, g - 1)
    return [
        (factor, level, Interval(*np.exp([b, b - t * e, b + t * e])))
        for (factor, level), b, e in zip(columns, beta, error, strict=True)
    ]


def text(found: Interval) -> str:
    return f"{found.estimate:.3f} [{found.low:.3f}, {found.high:.3f}]"


def ended_rows(runs: Sequence[Run]) -> list[list[str]]:
    """By level: episodes, those that ended by themselves, and the share of the free area seen."""
    rows = []
    for factor, levels in groups(runs).items():
        for level, some in levels.items():
            records = [run.record for run in some]
            seen = sorted(100 * r.coverage for r in records)
            rows.append([factor, level, f"{len(records)}", f"{sum(r.status == 'failed' for r in records)}",
                         f"{sum(r.status == 'truncated' for r in records)}", f"{statistics.median(seen):.2f}",
                         f"{seen[len(seen) // 20]:.1f}", f"{seen[0]:.1f}",
                         f"{100 * len(comparable(some)) / len(some):.1f}"])  # fmt: skip
    return rows


def draw(ratios: Mapping[tuple[str, str], Mapping[tuple[str, str], Interval]], file: Path) -> None:
    """One panel a contrast, one line a level: the ratio with its interval."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    lines = list(dict.fromkeys(line for found in ratios.values() for line in found))
    heights, height, before = {}, 0.0, None
    for line in lines:
        height += 1.0 if before in (None, line[0]) else 1.6
        heights[line], before = height, line[0]
    figure, panels = plt.subplots(
        1, len(ratios), figsize=(2.0 + 2.2 * len(ratios), 0.9 + 0.2 * height), sharey=True, layout="constrained"
    )
    for panel, ((ours, theirs), found) in zip(panels, ratios.items(), strict=True):
        panel.axvline(1.0, color="0.3", linewidth=0.8)
        for line, interval in found.items():
            sure = interval.high < 1.0, interval.low > 1.0
            colour = "#1a7f37" if sure[0] else "#b42318" if sure[1] else "0.45"
            panel.plot([interval.low, interval.high], [heights[line]] * 2, color=colour, linewidth=1.8)
            panel.plot(interval.estimate, heights[line], "o", color=colour, markersize=4)
        panel.set_title(f"{ours}\n/ {theirs}", fontsize=9)
        panel.grid(axis="x", color="0.9", linewidth=0.6)
        panel.tick_params(labelsize=8, length=2)
        for side in ("top", "right"):
            panel.spines[side].set_visible(False)
    names = [level if factor in ("", "plans", "area") else f"{factor}: {level}" for factor, level in lines]
    panels[0].set_yticks([heights[line] for line in lines], names)
    panels[0].set_ylim(height + 0.7, 0.3)
    figure.supxlabel("ratio of the distances, 95 % intervals (green: below 1, red: above 1)", fontsize=9)
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=120)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plans", type=Path, default=default_folder(), help="folder of plan JSON files")
    parser.add_argument("--largest", type=float, default=1000.0, help="only real plans of at most so many m2")
    parser.add_argument("--first", type=int, help="only the first so many plans of each kind")
    parser.add_argument("--policies", nargs="+", default=list(POLICIES), help="criteria")
    sensing.add_options(parser, default=["stops", "moving"])
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--out", type=Path, default=Path("results/factorial"), help="folder of the results")
    parser.add_argument("--figure", type=Path, help="file of the figure (default: factorial.png in the folder)")
    options = parser.parse_args()
    real = [load_plan(path) for path in sorted(options.plans.glob("*.json"))]
    real = [plan for plan in real if plan.area <= options.largest][: options.first]
    drawn = [suite(name).plan(i) for name, n in SUITES.items() for i in range(n)[: options.first]]
    if not real:
        print(f"no plans in {options.plans}: generated plans only (--plans names another folder)")
    dealt = deal([*real, *drawn], np.random.default_rng(0))
    runs = play(dealt, options, {plan.content_hash for plan in real})

    header = ("factor", "level", "episodes", "failed", "cut off", "seen %, median", "5 %", "least", "compared %")
    print(f"\n{format_table(header, ended_rows(runs), 'markdown')}\n")
    kept = comparable(runs)
    base = [run for run in kept if run.record.policy == options.policies[0]]
    rows = [[factor, level, text(found)] for factor, level, found in effects(base)]
    title = f"distance of {options.policies[0]}"
    print(f"{format_table(('factor', 'level', title), rows, 'markdown')}\n")

    rng = np.random.default_rng(1)
    ratios: dict[tuple[str, str], dict[tuple[str, str], Interval]] = {}
    table: dict[tuple[str, str], list[str]] = {}
    contrasts = [c for c in CONTRASTS if set(c) <= set(options.policies)]
    for factor, levels in groups(kept).items():
        for level, some in levels.items():
            cells = [factor, level, f"{len({run.record.group for run in some})}"]
            for contrast in contrasts:
                found = ratio(some, *contrast, rng)
                cells.append("-" if found is None else text(found[0]))
                if found is not None and math.isfinite(found[0].low):
                    ratios.setdefault(contrast, {})[factor, level] = found[0]
            table[factor, level] = cells
    header = ("factor", "level", "buildings", *(f"{ours} / {theirs}" for ours, theirs in contrasts))
    print(format_table(header, list(table.values()), "markdown"))
    if ratios:
        draw(ratios, options.figure or options.out / "factorial.png")


if __name__ == "__main__":
    main()
