"""How good are the floor plans that explorations give? `env.unwrapped.floor_plan()` against the truth.

    python benchmarks/floor_plans.py [--modes exact slam] [--generated 50] [--shared 30] [--starts 5] [--noise 1]
                                     [--drive kinematic] [--plans FOLDER] [--out results/floor_plans]

Each plan is explored by `nearest`, once in each pose mode. The floor plan is written, read back and compared:

- IoU with what was seen: the true floor that is visible, exactly, from the true poses of all scans (`exact.view`).
- vertices over those of the true plan; distance from each true corner to the nearest of the floor plan, median.
- share of the boundary that is marked as unknown.
- explored again: the way that `nearest` drives in the floor plan over that in the true plan, from the same `--starts`
  places with the same seeds, mean over mean. "Again in the truth" is the same with the truth in place of the floor plan
  and other seeds of the noise: what of a deviation is chance.

Plans are the first of the test suites of homes, offices and angled buildings, and of the folder (see
`shared_plans.py`) as many, evenly spread over the names. A run that was stopped goes on where it was. The floor plans
stay in the folder of the results, and a picture of the worst of each mode: truth grey, floor plan red, unknown orange.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import exact
import numpy as np
import shapely
from plan_statistics import default_folder
from tqdm import tqdm

from polyexplore_gym.config import DriveConfig, EnvConfig, PoseConfig, SensorConfig
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.errors import PolyExploreError
from polyexplore_gym.evaluation.policy import load_policy
from polyexplore_gym.evaluation.tables import format_table
from polyexplore_gym.floorplan import FloorPlan, load_plan, save_plan, suite

SUITES = ("home-test", "office-test", "angled-test")
IOU, VERTICES, CORNER, WAY = 0.99, 1.15, 0.03, 0.03
"""What is asked for: at least, at most, m, share."""
_GRID = 2.5e-6
"""Polygons are overlaid on a grid of this, m."""


def plans(generated: int, shared: int, folder: Path) -> Iterator[tuple[str, FloorPlan]]:
    """Names and plans, as many as asked for."""
    for i in range(generated):
        name = SUITES[i % len(SUITES)]
        yield f"{name}-{i // len(SUITES)}", suite(name).plan(i // len(SUITES))
    files = sorted(folder.glob("*.json"))
    for i in range(min(shared, len(files))):
        file = files[i * len(files) // shared]
        yield file.stem, load_plan(file)


def floor_seen(plan: FloorPlan, scans: np.ndarray, sensor: SensorConfig) -> shapely.Geometry:
    """What of the floor is visible from true poses (n, 3)."""
    poses = np.unique(scans, axis=0)
    views = [
        exact.view(plan.segments, pose, sensor.max_range, sensor.field_of_view, 0.005, outer=True) for pose in poses
    ]
    floor = shapely.Polygon(plan.exterior, plan.holes)
    return shapely.difference(floor, exact._without(floor, views, _GRID), grid_size=_GRID)


def compared(found: FloorPlan, plan: FloorPlan, seen: shapely.Geometry) -> dict[str, float]:
    """The figures of one floor plan."""
    corners, own = np.concatenate(plan.rings), np.concatenate(found.rings)
    tree = shapely.STRtree(shapely.points(own))
    off = tree.query_nearest(shapely.points(corners), return_distance=True, all_matches=False)[1]
    area = shapely.Polygon(found.exterior, found.holes)
    common = shapely.intersection(area, seen, grid_size=_GRID).area
    return {
        "iou": common / (area.area + seen.area - common),
        "vertices": found.n_vertices / plan.n_vertices,
        "corner": float(np.median(off)),
        "unknown": found.meta["unknown_share"],
        "left_out": found.meta["left_out"],
    }


def ways(plan: FloorPlan, starts: np.ndarray, config: EnvConfig, first_seed: int) -> float:
    """Mean way of `nearest` in a plan from each of the starts (n, 3), m."""
    env, total = PolyExploreEnv(config=config), 0.0
    for k, start in enumerate(starts):
        options = {"plan": plan, "start": tuple(start)}
        total += exact.play(env, load_policy("nearest"), first_seed + k, options)[2]["distance"]
    return total / len(starts)


def measured(name: str, plan: FloorPlan, config: EnvConfig, starts: int, out: Path) -> dict[str, Any]:
    """One plan in one pose mode: the figures, or an `error`."""
    env = PolyExploreEnv(plan=plan, config=config)
    info = exact.play(env, load_policy("nearest"), 0)[2]
    snapshot = env.snapshot()
    line: dict[str, Any] = {"coverage": info["coverage"], "scans": len(snapshot.measured_at)}
    line["pose_error"] = math.dist(env.true_pose[:2], snapshot.estimate[:2])
    began = time.perf_counter()
    file = out / f"{name}-{config.pose.mode}.json"
    try:
        save_plan(env.floor_plan(name), file)
        line["seconds"] = time.perf_counter() - began
        found = load_plan(file)
        line |= compared(found, plan, floor_seen(plan, snapshot.measured_at, config.sensor))
        line["true_vertices"] = plan.n_vertices
        if starts and config.pose.mode == "exact":
            rng, radius = np.random.default_rng(0), config.robot.radius
            again = load_plan(file, radius=radius)
            places = np.array([plan.sample_start(rng, radius) for _ in range(starts)])
            truth = ways(plan, places, config, 100)
            line["way"] = ways(again, places, config, 100) / truth
            line["truth_again"] = ways(plan, places, config, 200) / truth
    except PolyExploreError as error:
        line["error"] = f"{type(error).__name__}: {error}"
    return line


def draw(name: str, plan: FloorPlan, found: FloorPlan, file: Path) -> None:
    """A picture of the truth and a floor plan."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    x0, y0, x1, y1 = plan.bounds
    scale = 14.0 / max(x1 - x0, y1 - y0)
    figure, axes = plt.subplots(figsize=(scale * (x1 - x0) + 1, scale * (y1 - y0) + 1))
    for shape, style in (
        (plan, {"color": "0.6", "lw": 2.5}),
        (found, {"color": "tab:red", "lw": 1, "marker": ".", "ms": 3}),
    ):
        for ring in shape.rings:
            axes.plot(*np.vstack((ring, ring[:1])).T, **style)
    for line in found.meta["unknown"]:
        axes.plot(line[::2], line[1::2], color="tab:orange", lw=3)
    axes.set_aspect("equal")
    axes.set_title(name)
    figure.savefig(file, dpi=90, bbox_inches="tight")
    plt.close(figure)


def rows(results: list[dict[str, Any]]) -> Iterator[list[str]]:
    """A row of the table for each mode, generated and shared plans apart."""
    for mode in dict.fromkeys(r["mode"] for r in results):
        for kind in ("generated", "shared"):
            some = [r for r in results if r["mode"] == mode and r["kind"] == kind]
            good = [r for r in some if "error" not in r]
            if not good:
                continue

            def spread(key: str, factor: float, low: bool, good: list[dict[str, Any]] = good) -> str:
                values = [factor * r[key] for r in good]
                return f"{np.median(values):.4g} ({min(values) if low else max(values):.4g})"

            again = [r for r in good if "way" in r]
            both = [f"{np.mean([r[key] for r in again]):.3f}, {sum(abs(r[key] - 1) <= WAY for r in again)}/{len(again)}"
                    for key in ("way", "truth_again")] if again else ["-", "-"]  # fmt: skip
            reached = (
                sum(r["iou"] >= IOU for r in good),
                sum(r["vertices"] <= VERTICES for r in good),
                sum(r["corner"] <= CORNER for r in good),
            )
            yield [
                mode, kind, f"{len(good)}/{len(some)}", spread("iou", 1, True), spread("vertices", 1, False),
                spread("corner", 1e3, False), ", ".join(f"{n}" for n in reached), spread("unknown", 100, False),
                *both, spread("pose_error", 1e3, False), spread("seconds", 1, False),
            ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--modes", nargs="+", choices=("exact", "gaussian", "odometry", "slam"), default=["exact", "slam"]
    )
    parser.add_argument("--generated", type=int, default=50, help="generated plans")
    parser.add_argument("--shared", type=int, default=30, help="plans of the folder")
    parser.add_argument("--starts", type=int, default=5, help="explorations of each floor plan; 0: none")
    parser.add_argument("--noise", type=float, default=1.0, help="factor of the laser's noise")
    parser.add_argument("--drive", choices=("physics", "kinematic"), default="kinematic")
    parser.add_argument("--plans", type=Path, default=default_folder(), help="folder of plan JSON files")
    parser.add_argument("--out", type=Path, default=Path("results/floor_plans"), help="folder of the results")
    options = parser.parse_args()
    out = options.out / f"{options.drive}-noise{options.noise:g}-starts{options.starts}"
    out.mkdir(parents=True, exist_ok=True)
    lines = out / "results.jsonl"
    known = {}
    for text in lines.read_text(encoding="utf-8").splitlines() if lines.exists() else ():
        try:
            line = json.loads(text)
        except ValueError:
            continue  # torn
        known[line["name"], line["mode"]] = line
    sensor = SensorConfig()
    sensor = replace(
        sensor, sigma_range=options.noise * sensor.sigma_range, sigma_angle=options.noise * sensor.sigma_angle
    )
    some = dict(plans(options.generated, options.shared, options.plans))
    results = []
    for mode in options.modes:
        config = EnvConfig(sensor=sensor, drive=DriveConfig(mode=options.drive), pose=PoseConfig(mode=mode))
        for k, (name, plan) in enumerate(tqdm(some.items(), desc=mode, unit="plan", dynamic_ncols=True)):
            line = known.get((name, mode))
            if line is None:
                kind = "generated" if k < options.generated else "shared"
                line = {"name": name, "mode": mode, "kind": kind, **measured(name, plan, config, options.starts, out)}
                with lines.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(line) + "\n")
            results.append(line)
        good = [r for r in results if r["mode"] == mode and "error" not in r]
        if good:
            worst = min(good, key=lambda r: r["iou"])["name"]
            draw(f"{worst}, {mode}", some[worst], load_plan(out / f"{worst}-{mode}.json"), out / f"worst-{mode}.png")
    header = ("pose", "plans", "valid", "IoU, median (least)", "vertices / truth, median (most)",
              "corners off, mm, median (most)", f"IoU >= {IOU}, vertices <= {VERTICES}, corners <= {1e3 * CORNER:g} mm",
              "unknown, %, median (most)", "way again / in truth, mean, within 3 %", "truth again, likewise",
              "pose off at the end, mm, median (most)", "s a floor plan, median (most)")  # fmt: skip
    print(format_table(header, list(rows(results)), "markdown"))
    for r in results:
        missed = [f"{key} {r[key]:.4g}" for key, bad in (
            ("iou", r.get("iou", 1) < IOU), ("vertices", r.get("vertices", 0) > VERTICES),
            ("corner", r.get("corner", 0) > CORNER), ("way", abs(r.get("way", 1) - 1) > WAY)) if bad]  # fmt: skip
        if "error" in r or (missed and r["mode"] == "exact"):
            print(f"{r['name']}, {r['mode']}: {r.get('error') or ', '.join(missed)}")


if __name__ == "__main__":
    main()
