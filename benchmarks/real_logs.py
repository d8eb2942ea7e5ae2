"""The line map of real laser logs: compression, distance of the points to their lines, doorways, cost.

Run: python benchmarks/real_logs.py LOG [LOG ...] [--pictures FOLDER]

`polyexplore linemap` makes the same maps. Here every map is made twice, without and with the check of all beams against
all walls, and held against the raw beams once more, more plainly: a stretch of a segment counts as open where more than
three beams pass by more than 20 cm for each return within 10 cm of it, counted on pieces of 5 cm.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import numpy as np

from polyexplore_gym.config import MappingConfig, SensorConfig
from polyexplore_gym.evaluation.tables import format_table
from polyexplore_gym.mapping import LaserLog, LineMap, LogMap, extract_lines, map_log, read_log, save_map, sensor_of

STEP = 0.05
"""Length of the pieces of a segment on which beams are counted, m."""
DOOR = 0.5
"""Shortest open stretch of interest, m."""


def read(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Beam angles (n,), ranges (scans, n) and laser poses (scans, 3) of a log."""
    log = read_log(path)
    return log.angles[0], np.array(log.ranges), log.poses


def open_stretches(made: LogMap, log: LaserLog, max_range: float) -> list[float]:
    """Lengths of the stretches of segments that beams pass, m, longest first."""
    turned = np.concatenate([pose[2] + angles for pose, angles in zip(log.poses, log.angles, strict=True)])
    ray = np.stack([np.cos(turned), np.sin(turned)], axis=1)
    origin = np.repeat(log.poses[:, :2], [angles.size for angles in log.angles], axis=0)
    reach = np.minimum(np.concatenate(log.ranges), max_range)
    end = origin + reach[:, None] * ray
    returned = reach < max_range
    found = []
    for segment in made.segments:
        first, length = segment[:2], math.dist(segment[:2], segment[2:])
        along = (segment[2:] - first) / length
        normal = np.array([-along[1], along[0]])
        pieces = max(1, math.ceil(length / STEP))
        before, behind = (origin - first) @ normal, (end - first) @ normal
        slope = ray @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            met = (origin + (-before / slope)[:, None] * ray - first) @ along
        through = (before * behind < 0) & (np.abs(behind) > 0.2) & (np.abs(slope) > 0.17) & (met >= 0) & (met < length)
        at = (end - first) @ along
        on = returned & (np.abs(behind) < 0.1) & (at >= 0) & (at < length)
        passed = np.bincount((met[through] / length * pieces).astype(int), minlength=pieces)
        stopped = np.bincount((at[on] / length * pieces).astype(int), minlength=pieces)
        edges = np.flatnonzero(np.diff((passed > 3 * stopped).astype(int), prepend=0, append=0)).reshape(-1, 2)
        found += [float(b - a) * length / pieces for a, b in edges]
    return sorted((f for f in found if f >= DOOR), reverse=True)


def cost(log: LaserLog, sensor: SensorConfig, config: MappingConfig) -> float:
    """Mean time to extract the lines of a scan and merge them, the first (compilation) left out, ms."""
    line_map, covariance, spent = LineMap(config, sensor), np.diag([0.02, 0.02, math.radians(0.3)]) ** 2, 0.0
    for k, (ranges, pose) in enumerate(zip(log.ranges, log.poses, strict=True)):
        begin = time.process_time()
        line_map.insert(extract_lines(log.angles[k], ranges, sensor, config), pose, covariance)
        spent += time.process_time() - begin if k else 0.0
    return 1e3 * spent / max(len(log.poses) - 1, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="+", type=Path)
    parser.add_argument("--pictures", type=Path, help="folder for a picture of each map")
    arguments = parser.parse_args()
    head = [
        "log", "check", "scans", "points", "lines of scans", "lines", "compression", "segments", "fragments",
        "on lines", "distance", "distance, all", "misfit", "open stretches", "ms a scan",
    ]  # fmt: skip
    rows = []
    for path in arguments.logs:
        log = read_log(path)
        sensor, config = sensor_of(log), MappingConfig(range_floor=0.01)
        spent = cost(log, sensor, config)
        for ratio in (0.0, 3.0):
            made = map_log(log, sensor, config, ratio=ratio)
            gaps = open_stretches(made, log, sensor.max_range)
            name = path.name.partition(".")[0]
            rows.append(
                [
                    name,
                    "yes" if ratio else "no",
                    str(len(made.path)),
                    str(len(made.points)),
                    str(made.lines_of_scans),
                    str(made.rho.size),
                    f"{100 * made.compression:.2f} %",
                    str(len(made.segments)),
                    str(len(made.fragments)),
                    f"{100 * made.on_line.mean():.1f} %",
                    f"{1e3 * made.median_distance:.1f} mm",
                    f"{1e3 * np.median(made.distances):.1f} mm",
                    f"{100 * made.misfit:.1f} %",
                    f"{len(gaps)}" + (f", up to {gaps[0]:.2f} m" if gaps else ""),
                    f"{spent:.3f}",
                ]
            )
        if arguments.pictures:
            arguments.pictures.mkdir(parents=True, exist_ok=True)
            save_map(made, arguments.pictures / f"{name}.png", name=name)
    print(format_table(head, rows))
    print("distance: median, from the points on lines (all: from all points) to the nearest segment")
    print("misfit: beams that pass through a wall of those that meet one, median over the scans")
    print(f"open stretches: of {DOOR} m or more")


if __name__ == "__main__":
    main()
