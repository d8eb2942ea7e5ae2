"""Does every exploration end by itself? All scripted criteria on all shared plans, through the evaluation library.

    python benchmarks/shared_plans.py [--policies nearest ...] [--placement midpoint in_front] [--sensing stops moving]
                                      [--scan-every 0.5] [--drive physics] [--noise 1] [--exact] [--first N]
                                      [--workers 2] [--out results/shared_plans]

One row a criterion and setting: episodes that ended by themselves, exceptions, truncations, median and smallest
coverage (share of the free area seen, with the plan), the smallest clearance of the robot's disc from the true walls
where it measured and anywhere on the way (below 0: overlap), the way driven in all, bumps an episode, drives that ended
since no path was left, by the time limit or off the path, and with `--exact` the most floor that one place within reach
would still show (`exact.py`). `--noise` scales the laser's noise of range and angle. A run that was stopped goes on
where it was with the same arguments.

FOLDER (`--plans`) holds plan JSON files; default: `floorplans` under $POLYEXPLORE_DATA, or ../shared/data/floorplans
beside the checkout.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import exact
import gymnasium
import numpy as np
import sensing
import shapely
from plan_statistics import default_folder

from polyexplore_gym.cli import SCRIPTED
from polyexplore_gym.config import DriveConfig, EnvConfig, SensorConfig
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.evaluation import EpisodeRecord, Study, evaluate
from polyexplore_gym.evaluation.tables import format_table
from polyexplore_gym.floorplan import FloorPlan, load_plan

CLEARANCES = "clearances.jsonl"
Key = tuple[str, int]
"""Plan hash and seed."""


class Watched(gymnasium.Wrapper):
    """Writes down the smallest clearance of the disc when an episode ends."""

    def __init__(self, env: PolyExploreEnv, file: Path, exact: bool) -> None:
        super().__init__(env)
        self.file, self.exact = file, exact
        self._seed: int | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self._seed = seed
        observation, info = self.env.reset(seed=seed, options=options)
        if not info["action_mask"].any():
            self._write()
        return observation, info

    def step(self, action: Any) -> Any:
        result = self.env.step(action)
        if result[2] or result[3]:
            self._write()
        return result

    def _write(self) -> None:
        env: Any = self.unwrapped
        snapshot = env.snapshot()
        line = {
            "key": [env.plan.content_hash, self._seed],
            "standing": float(env.plan.clearance(snapshot.measured_at[:, :2]).min()) - snapshot.radius,
            "on the way": clearance(snapshot.trajectory, env.plan, snapshot.radius),
            "left": exact.check(env).area if self.exact else 0.0,
        }
        with self.file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")


@dataclass(frozen=True)
class MakeWatched:
    """Makes the environment for the evaluation; a folder is of one policy and setting."""

    folder: Path
    exact: bool

    def __call__(self, config: EnvConfig) -> gymnasium.Env:
        return Watched(PolyExploreEnv(config=config), self.folder / CLEARANCES, self.exact)


def clearance(trajectory: np.ndarray, plan: FloorPlan, radius: float) -> float:
    """Smallest distance (m) of the disc from the walls along a trajectory (m, 3); negative inside."""
    way = trajectory[:, :2]
    moved = np.flatnonzero(np.any(np.diff(way, axis=0) != 0.0, axis=1))
    steps = np.stack((way[moved], way[moved + 1]), axis=1) if len(moved) else way[None, [0, 0]]
    tree = shapely.STRtree(shapely.linestrings(plan.segments.reshape(-1, 2, 2)))
    distances = tree.query_nearest(shapely.linestrings(steps), return_distance=True, all_matches=False)[1]
    return float(distances.min()) - radius


def read_clearances(folder: Path) -> dict[Key, tuple[float, float, float]]:
    """Clearance standing and on the way, m, and what one place would still show, m2.

    An episode played again counts once, a torn last line not at all.
    """
    known: dict[Key, tuple[float, float, float]] = {}
    file = folder / CLEARANCES
    for line in file.read_text(encoding="utf-8").splitlines() if file.exists() else ():
        try:
            entry = json.loads(line)
        except ValueError:
            continue
        known[tuple(entry["key"])] = entry["standing"], entry["on the way"], entry["left"]
    return known


def row(records: Sequence[EpisodeRecord], clearances: dict[Key, tuple[float, float, float]]) -> list[str]:
    """The figures of one policy and setting."""
    played = [r for r in records if r.status != "failed"]
    ended = [r for r in records if r.ended]
    cells = [records[0].policy, str(records[0].setting), f"{len(ended)}/{len(records)}",
             f"{sum(not r.complete for r in ended)}", f"{len(records) - len(played)}",
             f"{sum(r.status == 'truncated' for r in records)}"]  # fmt: skip
    if not played:
        return [*cells, *["-"] * 8]
    least = min(played, key=lambda r: r.coverage)
    standing, moving, left = zip(*(clearances[r.pair] for r in played), strict=True)
    return [
        *cells,
        f"{100 * statistics.median(r.coverage for r in played):.2f}",
        f"{100 * least.coverage:.2f} ({least.plan})",
        f"{1e3 * min(standing):.2f}",
        f"{1e3 * min(moving):.2f} ({played[moving.index(min(moving))].plan})",
        f"{sum(r.distance for r in played) / 1e3:.2f}",
        f"{statistics.fmean(r.collisions for r in played):.2f}",
        ", ".join(f"{sum(r.ends.get(end, 0) for r in played)}" for end in ("blocked", "time", "lost")),
        f"{max(left):.2f} ({played[left.index(max(left))].plan})",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policies", nargs="+", default=list(SCRIPTED), help="criteria")
    parser.add_argument("--placement", nargs="+", choices=("midpoint", "in_front"), default=["midpoint", "in_front"])
    sensing.add_options(parser, default=["stops"])
    parser.add_argument("--drive", choices=("physics", "kinematic"), default="physics")
    parser.add_argument("--noise", type=float, default=1.0, help="factor of the laser's noise; 0 for none")
    parser.add_argument("--seeds", type=int, default=1, help="starts on each plan")
    parser.add_argument("--exact", action="store_true", help="also look for places that would show more (exact.py)")
    parser.add_argument("--first", type=int, help="only the first so many plans")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--plans", type=Path, default=default_folder(), help="folder of plan JSON files")
    parser.add_argument("--out", type=Path, default=Path("results/shared_plans"), help="folder of the results")
    options = parser.parse_args()
    plans = [load_plan(path) for path in sorted(options.plans.glob("*.json"))][: options.first]
    if not plans:
        raise SystemExit(f"no plans in {options.plans}: name a folder with --plans")
    sensor = SensorConfig()
    noisy = replace(
        sensor, sigma_range=options.noise * sensor.sigma_range, sigma_angle=options.noise * sensor.sigma_angle
    )
    config = sensing.scanning(EnvConfig(sensor=noisy, drive=DriveConfig(mode=options.drive)), options.scan_every)
    rows, failed = [], []
    # A folder for each set of arguments, so that one study never meets the files of another.
    out = options.out / f"{options.drive}-noise{options.noise:g}-{len(plans)}x{options.seeds}"
    for policy in options.policies:
        for placement, way in itertools.product(options.placement, options.sensing):
            study = Study(policies={policy: policy}, plans=plans, placements=[placement], sensing=[way],
                          seeds=range(options.seeds), config=config)  # fmt: skip
            name = sensing.folder_name([way], options.scan_every)
            folder = out / f"{policy.replace(':', '_')}-{placement}-{name}"
            records = evaluate(study, out=folder, workers=options.workers, make_env=MakeWatched(folder, options.exact))
            rows.append(row(records, read_clearances(folder)))
            failed += [r for r in records if not r.complete]
    print(f"\n{len(plans)} plans x {options.seeds} starts, {options.drive}, {options.noise:g} x the laser's noise:\n")
    header = ("policy", "setting", "ended by itself", "with edges left", "exceptions", "truncated", "seen, median %",
              "seen, least % (plan)", "clearance measuring, least mm", "on the way, least mm (plan)",
              "driven, km", "bumps an episode", "blocked, time, lost",
              "still to be seen from one place, most m2")  # fmt: skip
    print(format_table(header, rows, "markdown"))
    for r in failed:
        print(f"\n{r.status}: {r.policy}, {r.setting}, {r.plan}, seed {r.seed}: "
              f"{r.error or f'{r.decisions} decisions, {100 * r.coverage:.1f} % seen'}")  # fmt: skip


if __name__ == "__main__":
    main()
