"""What does looking ahead gain? Tours, roll-outs and learned selectors against the nearest node.

    python benchmarks/look_ahead.py [--models MODEL ...] [--plans FOLDER] [--largest N] [--first N] [--seeds 1]
                                    [--sensing stops moving] [--scan-every 0.5] [--workers 2]
                                    [--out results/look_ahead]

Nodes in front of the jump edges, kinematic drive. One row a planner, set of plans and way to sense: generated plans
(`plan_statistics.SUITES`), and the shared ones where there are any. Distance over that of `nearest` on the same start
(geometric mean and ratio of the means) and probability of the shorter way, with 95 % intervals over buildings, over the
starts that all planners finished; milliseconds a decision, mean and longest. With `--models`, selectors trained with
different seeds, the last table says what the seed changes: mean over the models, Student's 95 % interval.

FOLDER (`--plans`) holds plan JSON files; default: `floorplans` under $POLYEXPLORE_DATA, or ../shared/data/floorplans
beside the checkout. A run that was stopped goes on where it was.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
from pathlib import Path

import numpy as np
import scipy.stats
import sensing
from plan_statistics import SUITES, default_folder

from baselines import make_policy
from polyexplore_gym.cli import LOOK_AHEAD
from polyexplore_gym.config import DriveConfig, EnvConfig
from polyexplore_gym.evaluation import EpisodeRecord, PolicySpec, Study, evaluate, name_policies
from polyexplore_gym.evaluation.statistics import Interval
from polyexplore_gym.evaluation.summary import compare
from polyexplore_gym.evaluation.tables import format_table
from polyexplore_gym.floorplan import FloorPlan, load_plan, suite


def plan_sets(folder: Path | None, largest: float, first: int | None) -> dict[str, list[FloorPlan]]:
    """The plans by set; those in `folder` only if one is given."""
    sets = {name: [suite(name).plan(i) for i in range(count)][:first] for name, count in SUITES.items()}
    real = [load_plan(path) for path in sorted(folder.glob("*.json"))] if folder else []
    sets["real and drawn"] = [plan for plan in real if plan.area <= largest][:first]
    return {name: plans for name, plans in sets.items() if plans}


def text(found: Interval, digits: int) -> str:
    return f"{found.estimate:.{digits}f} [{found.low:.{digits}f}, {found.high:.{digits}f}]"


def rows(name: str, records: list[EpisodeRecord], rng: np.random.Generator) -> tuple[list[list[str]], dict[str, float]]:
    """The table's rows of one set of plans, and each planner's ratio to `nearest`."""
    cells, ratios = [], {}
    for c in compare(records, rng):
        own = [r for r in records if r.policy == c.ours[0]]
        both = {r.pair for r in own if r.ended} & {r.pair for r in records if r.policy == "nearest"}
        means = [
            statistics.fmean(r.distance for r in records if r.policy == policy and r.pair in both)
            for policy in (c.ours[0], "nearest")
        ]
        ratios[c.ours[0]] = c.ratio.estimate
        cells.append([name, c.ours[0], f"{c.pairs}/{len(own)}", text(c.ratio, 3), f"{means[0] / means[1]:.3f}",
                      text(c.improvement, 2), f"{100 * min(r.coverage for r in own):.1f}",
                      f"{1e3 * statistics.fmean(r.timing['act_mean'] for r in own):.2f}",
                      f"{1e3 * max(r.timing['act_max'] for r in own):.0f}"])  # fmt: skip
    return cells, ratios


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", type=Path, nargs="*", default=[], help="trained selectors beside the shipped one")
    parser.add_argument("--plans", type=Path, default=default_folder(), help="folder of plan JSON files")
    parser.add_argument("--largest", type=float, default=math.inf, help="only real plans of at most so many m2")
    parser.add_argument("--first", type=int, help="only the first so many plans of each set")
    parser.add_argument("--seeds", type=int, default=1, help="starts on each plan")
    sensing.add_options(parser, default=["stops"])
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--out", type=Path, default=Path("results/look_ahead"), help="folder of the results")
    options = parser.parse_args()
    policies: dict[str, PolicySpec] = dict(name_policies(["nearest", *LOOK_AHEAD, "learned"]))
    for path in options.models:
        policies[path.stem] = make_policy("learned", model=path)
    table: list[list[str]] = []
    found: dict[str, dict[str, float]] = {}
    for name, plans in plan_sets(options.plans, options.largest, options.first).items():
        print(f"{name}: {len(plans)} plans", flush=True)
        study = Study(
            policies=policies,
            plans=plans,
            placements=("in_front",),
            sensing=options.sensing,
            seeds=range(options.seeds),
            config=sensing.scanning(EnvConfig(drive=DriveConfig(mode="kinematic")), options.scan_every),
        )
        folder = f"{name.replace(' ', '-')}-{sensing.folder_name(options.sensing, options.scan_every)}"
        records = evaluate(study, out=options.out / folder, workers=options.workers)
        for way in options.sensing:
            label = name if way == "stops" else f"{name}, {way}"
            some = [r for r in records if r.sensing == way]
            cells, found[label] = rows(label, some, np.random.default_rng(0))
            table += cells
    header = ("plans", "planner", "starts", "distance / nearest", "of the means", "P(shorter)", "least seen %", "ms",
              "longest")  # fmt: skip
    print(f"\n{format_table(header, table, 'markdown')}")
    if len(options.models) > 1:
        seeds = []
        for name, ratios in found.items():
            own = np.array([ratios[path.stem] for path in options.models])
            half = scipy.stats.t.ppf(0.975, len(own) - 1) * own.std(ddof=1) / math.sqrt(len(own))
            mean = own.mean()
            seeds.append([name, f"{len(own)}", text(Interval(mean, mean - half, mean + half), 3),
                          f"{own.min():.3f} to {own.max():.3f}"])  # fmt: skip
        print(f"\n{format_table(('plans', 'models', 'distance / nearest', 'range'), seeds, 'markdown')}")


if __name__ == "__main__":
    main()
