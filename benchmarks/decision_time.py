"""What does a decision of each policy cost, by the number of nodes to choose from?

    python benchmarks/decision_time.py [--plans FILE ...] [--repeat 3] [--policies NAME ...] [--sensing moving]
                                       [--scan-every 0.5]

Explores plans with `nearest` (nodes in front of the jump edges, kinematic drive) and asks every policy at every state
what it would do, in turns, on one thread: the observation has 64 nodes at most. One row a policy: milliseconds, the
median and the 95 % quantile of states with so many reachable nodes; each is the fastest of `--repeat` calls.

FILE (`--plans`) are plan JSON files; default: `office_chewlane.json` and `shop_brain_big_retail.json` in `floorplans`
under $POLYEXPLORE_DATA, or ../shared/data/floorplans beside the checkout; without them two plans of office-test, which
have fewer nodes.
"""

from __future__ import annotations

import argparse
import itertools
import time
from pathlib import Path

import numpy as np
import sensing
from plan_statistics import default_folder
from tqdm import tqdm

from polyexplore_gym.cli import LOOK_AHEAD
from polyexplore_gym.config import DriveConfig, EnvConfig, ExplorationConfig
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.evaluation.policy import Policy, load_policy
from polyexplore_gym.evaluation.runner import name_policies
from polyexplore_gym.evaluation.tables import format_table
from polyexplore_gym.floorplan import FloorPlan, load_plan, suite

PLANS = ("office_chewlane.json", "shop_brain_big_retail.json")
NODES = (1, 9, 17, 33, 64)
"""Groups of states by their reachable nodes: from one of these to less than the next; the last is the most of all."""


def milliseconds(
    plan: FloorPlan, policies: dict[str, Policy], repeat: int, config: EnvConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Reachable nodes (n,) at each decision of an exploration, and what each policy's choice costs (n, p), ms."""
    env = PolyExploreEnv(config=config)
    seen, info = env.reset(seed=0, options={"plan": plan})
    counts: list[int] = []
    took: list[list[float]] = []
    rng = np.random.default_rng(0)
    over = not seen["action_mask"].any()
    with tqdm(desc=plan.name, unit="decision") as bar:
        while not over:
            counts.append(int(seen["action_mask"].sum()))
            took.append([])
            for policy in policies.values():
                calls = []
                for _ in range(repeat):
                    began = time.perf_counter()
                    policy.act(seen, info, rng)
                    calls.append(time.perf_counter() - began)
                took[-1].append(1e3 * min(calls))
            nearest = np.where(seen["action_mask"] > 0, seen["node_path_length"], np.inf).argmin()
            seen, _, terminated, truncated, info = env.step(int(nearest))
            over = terminated or truncated
            bar.update()
    return np.array(counts), np.array(took)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plans", type=Path, nargs="+", help="plan JSON files")
    parser.add_argument("--repeat", type=int, default=3, help="calls a state, of which the fastest counts")
    parser.add_argument("--policies", nargs="+", default=["nearest", *LOOK_AHEAD, "learned"])
    sensing.add_options(parser)
    options = parser.parse_args()
    config = EnvConfig(drive=DriveConfig(mode="kinematic"), exploration=ExplorationConfig(placement="in_front"))
    config = sensing.sensing_so(config, options.sensing, options.scan_every)
    files = options.plans or [file for name in PLANS if (file := default_folder() / name).is_file()]
    plans = [load_plan(file) for file in files] or [suite("office-test").plan(i) for i in (6, 7)]
    policies = {name: load_policy(spec) for name, spec in name_policies(options.policies).items()}
    print(f"plans: {', '.join(plan.name for plan in plans)}", flush=True)
    milliseconds(suite("home-test").plan(0), policies, 1, config)  # compiles
    measured = [milliseconds(plan, policies, options.repeat, config) for plan in plans]
    counts, took = (np.concatenate(part) for part in zip(*measured, strict=True))
    groups = [(a, b - 1) for a, b in itertools.pairwise(NODES)] + [(NODES[-1], NODES[-1])]
    groups = [(a, b) for a, b in groups if ((counts >= a) & (counts <= b)).any()]
    masks = [(counts >= a) & (counts <= b) for a, b in groups]
    header = ["policy", *(f"{a} to {b} nodes ({m.sum()})" if a < b else f"{a} nodes ({m.sum()})"
                          for (a, b), m in zip(groups, masks, strict=True))]  # fmt: skip
    rows = [
        [name, *(f"{np.median(took[m, i]):.2f} ({np.quantile(took[m, i], 0.95):.2f})" for m in masks)]
        for i, name in enumerate(policies)
    ]
    print(f"\nms a decision, median (95 %)\n\n{format_table(header, rows, 'markdown')}")


if __name__ == "__main__":
    main()
