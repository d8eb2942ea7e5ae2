"""What does pose error do to the map, and does `slam` know how far it is off?

    python benchmarks/pose_error.py [--plans FOLDER] [--largest 400] [--first 6] [--seeds 2] [--sensing stops moving]
                                    [--scan-every 0.5] [--workers 2]

Explorations by the nearest node (in front of the jump edges, kinematic) under each pose model with its default errors:
`gaussian` 2 cm and 0.5 degrees a measurement, `odometry` and `slam` a drift of 2 % and 1 degree at 1 m. Plans: the
first of home-test, angled-test and office-test, and shared ones. One row a model and way to sense:

- ended: explorations that ended by themselves; seen: share of the free area; distance: over that with the exact pose;
- NEES of the pose at the decisions, e' P^-1 e over x, y and heading: 3 in the mean if the covariance is right, with
  a 95 % interval over the explorations; its median (2.37 if right); the share of poses within the 95 % ellipsoid;
- error of the pose at the end, m and degrees: median and 95 %;
- error of the map: distance of points on its walls, one every 5 cm, to the nearest true wall, cm: median and 95 %.

FOLDER (`--plans`) holds plan JSON files; default: `floorplans` under $POLYEXPLORE_DATA, or ../shared/data/floorplans
beside the checkout.
"""

from __future__ import annotations

import argparse
import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.stats
import sensing
import shapely
from joblib import Parallel, delayed
from plan_statistics import default_folder
from tqdm import tqdm

from baselines import make_policy
from polyexplore_gym.config import EnvConfig, from_mapping
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.evaluation.tables import format_table
from polyexplore_gym.floorplan import FloorPlan, load_plan, suite

MODES = ("exact", "gaussian", "odometry", "slam")
SPACING = 0.05


@dataclass(frozen=True)
class Outcome:
    """Of one exploration."""

    mode: str
    sensing: str
    ended: bool
    coverage: float
    distance: float
    nees: np.ndarray
    """(n,) at the decisions."""
    final: tuple[float, float]
    """Error of the pose at the end, m and degrees."""
    walls: np.ndarray
    """(k,) distance of points on the map's walls to the nearest true one, m."""


def explore(plan: FloorPlan, mode: str, way: str, every: float, seed: int) -> Outcome:
    """Explore the plan by the nearest node, sensing in one way, with scans on the way so far apart, m."""
    config = from_mapping(EnvConfig, {
        "drive": {"mode": "kinematic"}, "exploration": {"placement": "in_front"}, "pose": {"mode": mode},
        "observation": {"max_lines": 4096, "pairwise": False}, "max_decisions": 600 if way == "stops" else 1200,
    })  # fmt: skip
    config = sensing.sensing_so(config, way, every)
    env = PolyExploreEnv(plan=plan, config=config)
    policy, rng = make_policy("nearest"), np.random.default_rng(seed)
    seen, info = env.reset(seed=seed)
    nees: list[float] = []
    terminated = not info["action_mask"].any()
    truncated = False
    while not (terminated or truncated):
        seen, _, terminated, truncated, info = env.step(policy.act(seen, info, rng))
        covariance = seen["pose_covariance"].astype(np.float64)
        if np.linalg.det(covariance) > 0.0:
            e = error(env, seen)
            nees.append(float(e @ np.linalg.solve(covariance, e)))
    e = error(env, seen)
    lines = seen["lines"][seen["line_mask"] > 0, :4].astype(np.float64).reshape(-1, 2, 2)
    points = np.concatenate([
        a + np.arange(0.0, 1.0, SPACING / max(math.dist(a, b), SPACING))[:, None] * (b - a) for a, b in lines
    ])  # fmt: skip
    truth = shapely.STRtree(shapely.linestrings(plan.segments.reshape(-1, 2, 2)))
    distances = truth.query_nearest(shapely.points(points), return_distance=True, all_matches=False)[1]
    return Outcome(mode, way, terminated, float(info["coverage"]), float(info["distance"]), np.array(nees),
                   (math.hypot(e[0], e[1]), abs(math.degrees(e[2]))), distances)  # fmt: skip


def error(env: PolyExploreEnv, seen: dict[str, np.ndarray]) -> np.ndarray:
    """(3,) true less estimated pose."""
    e = np.asarray(env.true_pose) - seen["pose"].astype(np.float64)
    e[2] = (e[2] + math.pi) % (2.0 * math.pi) - math.pi
    return e


def row(outcomes: list[Outcome], exact: list[Outcome]) -> list[str]:
    """The figures of one pose model and way to sense; those with the exact pose beside them."""
    both = [(o.distance, x.distance) for o, x in zip(outcomes, exact, strict=True) if o.ended and x.distance > 0]
    nees = [o.nees.mean() for o in outcomes if len(o.nees)]
    all_nees = np.concatenate([o.nees for o in outcomes])
    if len(nees) > 1:
        half = scipy.stats.t.ppf(0.975, len(nees) - 1) * np.std(nees, ddof=1) / math.sqrt(len(nees))
        inside = np.mean(all_nees < scipy.stats.chi2.ppf(0.95, 3))
        consistent = [f"{np.mean(nees):.2f} +- {half:.2f}", f"{np.median(all_nees):.2f}", f"{100 * inside:.0f}"]
    else:
        consistent = ["-", "-", "-"]
    metres, degrees = np.array([o.final for o in outcomes]).T
    walls = 100 * np.concatenate([o.walls for o in outcomes])
    seen = 100 * np.array([o.coverage for o in outcomes])
    return [
        outcomes[0].mode,
        outcomes[0].sensing,
        f"{sum(o.ended for o in outcomes)}/{len(outcomes)}",
        f"{np.median(seen):.1f} ({seen.min():.1f})",
        f"{np.exp(np.mean([math.log(a / b) for a, b in both])):.2f}",
        *consistent,
        f"{np.median(metres):.2f}, {np.quantile(metres, 0.95):.2f}",
        f"{np.median(degrees):.1f}, {np.quantile(degrees, 0.95):.1f}",
        f"{np.median(walls):.1f}, {np.quantile(walls, 0.95):.1f}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plans", type=Path, default=default_folder(), help="folder of plan JSON files")
    parser.add_argument("--largest", type=float, default=400.0, help="only plans of at most so many m2")
    parser.add_argument("--first", type=int, default=6, help="plans of each kind")
    parser.add_argument("--seeds", type=int, default=2, help="starts on each plan")
    sensing.add_options(parser, default=["stops"])
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    options = parser.parse_args()
    drawn = [suite(name).plans() for name in ("home-test", "angled-test", "office-test")]
    real = [load_plan(path) for path in sorted(options.plans.glob("*.json"))]
    plans = [p for some in (*drawn, real) for p in [p for p in some if p.area <= options.largest][: options.first]]
    tasks = [(plan, mode, way, options.scan_every, seed) for way in options.sensing for mode in MODES for plan in plans
             for seed in range(options.seeds)]  # fmt: skip
    parallel = Parallel(n_jobs=options.workers, return_as="generator", batch_size=1)
    found = list(tqdm(parallel(delayed(explore)(*task) for task in tasks), total=len(tasks), unit="exploration"))
    by_way = {(way, mode): [o for o in found if (o.sensing, o.mode) == (way, mode)]
              for way in options.sensing for mode in MODES}  # fmt: skip
    header = ("pose", "sensing", "ended", "seen %, median (least)", "distance / exact", "NEES", "median", "within 95 %",
              "pose at the end, m", "degrees", "map, cm")  # fmt: skip
    print(f"{len(plans)} plans, {options.seeds} starts each; pairs of figures are median and 95 %\n")
    rows = [row(outcomes, by_way[way, "exact"]) for (way, _), outcomes in by_way.items()]
    print(format_table(header, rows, "markdown"))


if __name__ == "__main__":
    main()
