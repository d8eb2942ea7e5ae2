"""How much could any one choice gain? The best next node, found by playing each to the end in the real building.

    python benchmarks/hindsight.py [--plans FOLDER] [--largest 200] [--first N] [--tried 8] [--sensing moving]
                                   [--scan-every 0.5] [--workers 2]

Whoever chooses here knows the future, with its noise: at each decision up to so many nodes (that of the base policy and
the nearest others) are played to the end in copies of the environment that follow the base policy, and the one with
the shortest way is taken. No selector can know as much, so the gain bounds what selectors that improve on the base
by one choice at a time may hope for; part of it is luck that nobody can foresee. One row a set of plans and base
policy (`nearest`, `tour`): distance over that of `nearest` with 95 % intervals over buildings. Nodes in front of the
jump edges, kinematic drive, one start a plan.

FOLDER (`--plans`) holds plan JSON files; default: `floorplans` under $POLYEXPLORE_DATA, or ../shared/data/floorplans
beside the checkout. Sets of which fewer than three plans are small enough are left out.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import sensing
from joblib import Parallel, delayed
from look_ahead import plan_sets, text
from plan_statistics import default_folder
from tqdm import tqdm

from baselines.learned.rollouts import Choose, costs, nearest
from baselines.tour import Tour
from polyexplore_gym.config import DriveConfig, EnvConfig, ExplorationConfig
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.evaluation.episode import building
from polyexplore_gym.evaluation.statistics import bootstrap_interval, geometric_mean
from polyexplore_gym.evaluation.tables import format_table
from polyexplore_gym.floorplan import FloorPlan


def tour(observations: list[Mapping[str, np.ndarray]]) -> list[int]:
    rng = np.random.default_rng(0)  # not used
    return [Tour().act(seen, {}, rng) for seen in observations]


FEWEST = 3
"""Sets with fewer plans are left out: they say nothing."""
BASES: dict[str, Choose] = {"nearest": nearest, "tour": tour}  # type: ignore[dict-item]


def drive(plan: FloorPlan, base: str, tried: int, config: EnvConfig) -> float:
    """Metres to a complete map, from the start with seed 0; `tried` 1: the base policy itself."""
    env = PolyExploreEnv(config=config)
    seen, info = env.reset(seed=0, options={"plan": plan})
    over = not seen["action_mask"].any()
    while not over:
        action = BASES[base]([seen])[0]
        length = np.where(seen["action_mask"] > 0, seen["node_path_length"], np.inf)
        length[action] = -1.0
        nodes = np.argsort(length, kind="stable")[: min(tried, int(seen["action_mask"].sum()))]
        if len(nodes) > 1:
            action = int(nodes[costs(env, nodes, BASES[base], pairwise=base == "tour").argmin()])
        seen, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    return float(info["distance"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plans", type=Path, default=default_folder(), help="folder of plan JSON files")
    parser.add_argument("--largest", type=float, default=200.0, help="only plans of at most so many m2")
    parser.add_argument("--first", type=int, help="only the first so many plans of each set")
    parser.add_argument("--tried", type=int, default=8, help="nodes played to the end at a decision")
    sensing.add_options(parser)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    options = parser.parse_args()
    sets = {
        name: [plan for plan in plans if plan.area <= options.largest]
        for name, plans in plan_sets(options.plans, options.largest, options.first).items()
    }
    sets = {name: plans for name, plans in sets.items() if len(plans) >= FEWEST}
    runs = [("nearest", 1), ("tour", 1), ("nearest", options.tried), ("tour", options.tried)]
    config = EnvConfig(drive=DriveConfig(mode="kinematic"), exploration=ExplorationConfig(placement="in_front"))
    config = sensing.sensing_so(config, options.sensing, options.scan_every)
    tasks = [(name, plan, *run) for name, plans in sets.items() for plan in plans for run in runs]
    parallel = Parallel(n_jobs=options.workers, return_as="generator", batch_size=1)
    driven = list(tqdm(parallel(delayed(drive)(*task[1:], config) for task in tasks), total=len(tasks), unit="run"))
    table = []
    for name, plans in sets.items():
        ways = {
            run: np.array([d for task, d in zip(tasks, driven, strict=True) if task[0] == name and task[2:] == run])
            for run in runs
        }
        for base, tried in runs[1:]:
            found = bootstrap_interval(
                ways[base, tried] / ways["nearest", 1], [building(plan) for plan in plans], [name] * len(plans),
                np.random.default_rng(0), geometric_mean,
            )  # fmt: skip
            table.append([name, f"{len(plans)}", base, "-" if tried == 1 else f"{tried}", text(found, 3)])
    print(f"\n{format_table(('plans', 'number', 'base', 'played out', 'distance / nearest'), table, 'markdown')}")


if __name__ == "__main__":
    main()
