"""Poses of laser logs by `linemap --poses`: error against relations checked by hand, wall thickness, cost.

Run: python benchmarks/log_slam.py [--data FOLDER] [--none]

FOLDER holds `laser_logs`; default: $POLYEXPLORE_DATA, or ../shared/data beside the checkout. Logs that are absent are
left out.

Relations (intel): for each the estimated relative pose is held against it, length of the translation and absolute angle
(Kuemmerle et al., "On measuring the accuracy of SLAM algorithms", Autonomous Robots 2009); mean and standard deviation.
A relation names two moments at which ODOM lines were written. The stamps of the lines are rounded, to a millisecond and
after 1,000 s to ten, and lines were written in bursts, so that several may have one stamp: of these a moment takes the
one whose rank is that of the moment within what was rounded. Poses of the particle filter, and those found without
odometry, are brought to the lines between the scans by odometry whose error is spread.

Thickness: median over returns of the standard deviation, across the wall, of all returns within 10 cm. The residual
within one scan is 7 to 9 mm. Cost: processor time from the log in memory to its poses, the second of two runs.
"""

from __future__ import annotations

import argparse
import gzip
import os
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from polyexplore_gym.evaluation.tables import format_table
from polyexplore_gym.mapping import LaserLog, correct_poses, read_log, sensor_of
from polyexplore_gym.mapping.logs.poses import between
from polyexplore_gym.mapping.slam.odometry import filled, way_of

RADIUS = 0.1
"""Returns so near each other belong to one piece of wall, m."""
LEAST = 10
"""Fewest of them."""
SAMPLES = 4000
"""Pieces of wall that are looked at."""
FINE = 1000.0, 0.001, 0.01
"""Stamps of intel up to so many seconds after the first are rounded to so much, those after it to so much, s."""


def relations(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Moments (r, 2), s, and relative poses (r, 3) between them, m and rad."""
    with gzip.open(path, "rt") as file:
        data = np.loadtxt(file)
    return data[:, :2], data[:, [2, 3, 7]]


def line_of(moments: np.ndarray, stamps: np.ndarray) -> np.ndarray:
    """(k,) the lines, of these stamps (m,), that moments (k,) stand for."""
    order = np.argsort(stamps, kind="stable")
    by_time = np.round(stamps[order], 6)
    after = np.clip(np.searchsorted(by_time, moments), 1, len(by_time) - 1)
    earlier = moments - by_time[after - 1] < by_time[after] - moments
    near = np.where(earlier, by_time[after - 1], by_time[after])
    low, high = np.searchsorted(by_time, near - 1e-6), np.searchsorted(by_time, near + 1e-6)
    rounded = np.where(near - by_time[0] < FINE[0], FINE[1], FINE[2])
    rank = np.clip((moments - near) / rounded + 0.5, 0.0, 0.999)
    return order[low + (rank * (high - low)).astype(int)]


def relation_errors(
    stamps: np.ndarray, poses: np.ndarray, moments: np.ndarray, relative: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Errors (r,) in translation, m, and rotation, degrees, of poses (m, 3) at stamps (m,)."""
    first, second = (poses[line_of(column, stamps)] for column in moments.T)
    off = between(relative, between(first, second))
    return np.hypot(off[:, 0], off[:, 1]), np.degrees(np.abs(off[:, 2]))


def thickness(log: LaserLog, poses: np.ndarray) -> float:
    """Median standard deviation of returns across walls, m."""
    sensor = sensor_of(log)
    points = []
    for angles, ranges, (x, y, heading) in zip(log.angles, log.ranges, poses, strict=True):
        hit = (ranges > 0.1) & (ranges < min(sensor.max_range, 79.0))
        turned, r = angles[hit] + heading, ranges[hit]
        points.append(np.column_stack([x + r * np.cos(turned), y + r * np.sin(turned)]))
    everything = np.concatenate(points)
    tree = cKDTree(everything)
    chosen = everything[np.linspace(0, len(everything) - 1, SAMPLES).astype(int)]
    around = [everything[near] for near in tree.query_ball_point(chosen, RADIUS) if len(near) >= LEAST]
    return float(np.median([np.sqrt(max(np.linalg.eigvalsh(np.cov(some.T))[0], 0.0)) for some in around]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("POLYEXPLORE_DATA") or beside))
    parser.add_argument("--none", action="store_true", help="without odometry as well")
    arguments = parser.parse_args()
    folder = arguments.data / "laser_logs"
    rows = []
    for name, other in (("intel-raw", "intel-corrected"), ("csail-corrected", "csail-corrected")):
        path = folder / f"{name}.log.gz"
        if not path.is_file():
            print(f"left out: no {path.name} in {folder}")
            continue
        log = read_log(path)
        way = way_of(log)
        found: list[tuple[str, np.ndarray, np.ndarray, str]] = [("odometry", way.poses[way.scans], way.poses, "-")]
        if (folder / f"{other}.log.gz").is_file():
            filtered = read_log(folder / f"{other}.log.gz").poses
            assert filtered is not None
            found.append(("particle filter", filtered, filled(way.poses, way.scans, filtered), "-"))
        sources = ("odometry", "none") if arguments.none else ("odometry",)
        for source in sources:
            for _ in range(2):  # the first one compiles
                begin = time.process_time()
                made = correct_poses(log, sensor_of(log), source=source)  # type: ignore[arg-type]
                spent = time.process_time() - begin
            everywhere = made.way.poses if source == "odometry" else filled(way.poses, way.scans, made.poses)
            found.append((f"--poses {source}", made.poses, everywhere, f"{1e3 * spent / len(log):.1f}"))
            print(f"{name}, {source}: {len(made.keys)} key scans, {made.loops} loops, {made.lost} not recognised")
        for kind, poses, everywhere, cost in found:
            errors = ["-", "-"]
            if name == "intel-raw" and (folder / "intel.relations.gz").is_file():
                given = relations(folder / "intel.relations.gz")
                errors = [f"{e.mean():.4f} +- {e.std():.4f}" for e in relation_errors(way.stamps, everywhere, *given)]
            rows.append([name, kind, *errors, f"{1e3 * thickness(log, poses):.1f}", cost])
    print(format_table(["log", "poses", "translation, m", "rotation, degrees", "thickness, mm", "ms a scan"], rows))


if __name__ == "__main__":
    main()
