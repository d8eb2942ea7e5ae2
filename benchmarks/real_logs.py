"""The line map of real CARMEN laser logs: compression, distance of the points to their lines, cost.

Run: python benchmarks/real_logs.py LOG.gz [LOG.gz ...] [--picture DIRECTORY]
"""

from __future__ import annotations

import argparse
import gzip
import math
import time
from pathlib import Path

import numpy as np

from polyexplore_gym.config import MappingConfig, SensorConfig
from polyexplore_gym.mapping import LineMap, ScanLines, extract_lines


def read(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Beam angles (n,), ranges (scans, n) and laser poses (scans, 3) of the FLASER records of a log."""
    ranges, poses = [], []
    with gzip.open(path, "rt") as log:
        for record in log:
            fields = record.split()
            if fields and fields[0] == "FLASER":
                n = int(fields[1])
                ranges.append([float(v) for v in fields[2 : 2 + n]])
                poses.append([float(v) for v in fields[2 + n : 5 + n]])
    n = len(ranges[0])
    angles = -math.pi / 2 + np.arange(n) * math.pi / (n - 1 if n % 2 else n)
    table = np.array(ranges)
    return angles, np.where(table > 0, table, np.inf), np.array(poses)


def point_distances(lines: ScanLines, angles: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    """Distance of each return on a line to its line, m."""
    on = np.flatnonzero(lines.point_segment >= 0)
    line = lines.segment_line[lines.point_segment[on]]
    return np.abs(ranges[on] * np.cos(lines.alpha[line] - angles[on]) - lines.rho[line])


def crossed(line_map: LineMap, angles: np.ndarray, ranges: np.ndarray, pose: np.ndarray, depth: float) -> np.ndarray:
    """(M,) number of beams that pass through each row and on by more than `depth`, well inside its ends, m."""
    s = line_map.segments
    count = np.zeros(len(s), int)
    near = line_map.alive & (np.hypot(s[:, 0] - pose[0], s[:, 1] - pose[1]) < 20)
    for row in np.flatnonzero(near):
        ax, ay, bx, by = s[row] - np.tile(pose[:2], 2)
        length = math.hypot(bx - ax, by - ay)
        if length < 0.3:
            continue
        c, q = np.cos(angles + pose[2]), np.sin(angles + pose[2])
        cross = c * (by - ay) - q * (bx - ax)
        with np.errstate(divide="ignore", invalid="ignore"):
            r = (ax * (by - ay) - ay * (bx - ax)) / cross
            t = (ax * q - ay * c) / cross * length
        through = (r > 0) & (t > 0.15) & (t < length - 0.15) & ((ranges - r) * np.abs(cross) / length > depth)
        count[row] = through.sum()
    return count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("logs", nargs="+", type=Path)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    sensor = SensorConfig(max_range=30.0, sigma_range=0.01, sigma_angle=math.radians(0.1))
    config = MappingConfig(range_floor=0.01)
    pose_covariance = np.diag([0.02**2, 0.02**2, math.radians(0.3) ** 2])
    for path in arguments.logs:
        angles, ranges, poses = read(path)
        line_map, found, cost = LineMap(config, sensor), [], 0.0
        for k in range(len(poses)):
            begin = time.process_time()
            found.append(extract_lines(angles, ranges[k], sensor, config))
            line_map.insert(found[-1], poses[k], pose_covariance)
            cost += time.process_time() - begin if k else 0.0
        returns = int((ranges < sensor.max_range).sum())
        lines = int(line_map.line_alive.sum())
        single = sum(f.rho.size for f in found)
        distances = np.concatenate([point_distances(f, angles, r) for f, r in zip(found, ranges, strict=True)])
        on = line_map.alive & (line_map.line >= 0)
        seen_through = np.zeros(line_map.alive.size, int)
        for k in range(0, len(poses), 3):
            seen_through += crossed(line_map, angles, np.minimum(ranges[k], 30.0), poses[k], 0.3) > 3
        print(
            f"{path.name}: {len(poses)} scans, {returns} points, {single} lines of single scans, {lines} lines merged "
            f"(compression {1 - lines / returns:.4f}), {on.sum()} segments, {(line_map.alive & ~on).sum()} fragments; "
            f"points on lines {distances.size / returns:.3f}, median distance {1e3 * np.median(distances):.1f} mm; "
            f"segments seen through in 3 scans or more {np.sum(seen_through[on] >= 3)}; "
            f"{1e3 * cost / (len(poses) - 1):.3f} ms a scan"
        )
        if arguments.picture:
            draw(line_map, angles, ranges, poses, seen_through, arguments.picture / f"{path.name}.png")


def draw(line_map: LineMap, angles: np.ndarray, ranges: np.ndarray, poses: np.ndarray, through: np.ndarray, path: Path):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    _, axes = plt.subplots(figsize=(24, 24))
    for k in range(0, len(poses), 4):
        t, r = angles + poses[k, 2], np.where(ranges[k] < 30, ranges[k], np.nan)
        axes.plot(poses[k, 0] + r * np.cos(t), poses[k, 1] + r * np.sin(t), ".", color="0.8", ms=2)
    axes.plot(poses[:, 0], poses[:, 1], "c.", ms=3)
    for row in np.flatnonzero(line_map.alive):
        s = line_map.segments[row]
        color = "m" if line_map.line[row] < 0 else "r" if through[row] >= 3 else "k"
        axes.plot(s[::2], s[1::2], "-", color=color, lw=1)
    axes.set_aspect("equal")
    plt.savefig(path, dpi=60, bbox_inches="tight")
    plt.close()


if __name__ == "__main__":
    main()
