"""How many walls of an office scan are found, how many lines are true, and what it costs.

Scenes are rectangular rooms along a corridor, with doors and thick walls. A wall counts if at least
0.5 m of it is seen by at least 10 beams; a segment counts as right if it lies within 3 degrees and
5 cm of a wall and half the length agrees. Precision is given for segments under the same bar, and
for all. Times are of one core's work. Run: python benchmarks/line_extraction.py [--scans 200]
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from typing import Literal

import cv2
import numpy as np
import shapely
from standard_hough import candidates_counted

from polyexplore_gym.config import MappingConfig, SensorConfig
from polyexplore_gym.evaluation.tables import format_table
from polyexplore_gym.mapping import LineMap, ScanLines, extract_lines
from polyexplore_gym.mapping.hough import VOTES
from polyexplore_gym.sim.laser import cast_rays

ANGLES = np.linspace(-math.pi / 2, math.pi / 2, 361)
STARTS: dict[str, tuple[Literal["endpoint", "hough"], int | None]] = {
    "end points": ("endpoint", None),
    "probabilistic Hough": ("hough", None),
    f"standard Hough, {VOTES} votes": ("hough", VOTES),
    "standard Hough, 8 votes": ("hough", 8),
    "standard Hough, 20 votes": ("hough", 20),
}
"""Start of the lines, and votes of the standard transform if it takes the place of the probabilistic one."""


def office(rng: np.random.Generator) -> tuple[np.ndarray, shapely.Polygon]:
    """Walls (M, 4) and free space of two rows of rooms along a corridor, with pillars and cupboards."""
    thickness, corridor = 0.15, rng.uniform(1.6, 2.6)
    parts, furniture = [], []
    for sign in (-1, 1):
        x = 0.0
        while x < 20.0:
            width, depth = rng.uniform(2.8, 6.0), rng.uniform(3.0, 5.5)
            near = sign * (0.5 * corridor + thickness)
            far = near + sign * depth
            parts.append(shapely.box(x, min(near, far), x + width, max(near, far)))
            door = x + rng.uniform(0.3, width - 1.3)
            parts.append(shapely.box(door, min(0, near), door + 0.9, max(0, near)))
            if rng.random() < 0.6:  # a cupboard against the far wall
                left, deep = x + rng.uniform(0.2, width - 1.4), rng.uniform(0.3, 0.6)
                furniture.append(
                    shapely.box(left, min(far, far - sign * deep), left + 1.2, max(far, far - sign * deep))
                )
            if rng.random() < 0.3:  # a door to the next room
                at = near + sign * rng.uniform(0.5, depth - 1.5)
                parts.append(
                    shapely.box(x + width - 0.1, min(at, at + sign), x + width + thickness + 0.1, max(at, at + sign))
                )
            x += width + thickness
    parts.append(shapely.box(0.0, -0.5 * corridor, 20.0, 0.5 * corridor))
    free = shapely.union_all(parts).difference(shapely.union_all(furniture))
    free = max(free.geoms, key=lambda g: g.area) if free.geom_type == "MultiPolygon" else free
    free = free.simplify(1e-6)
    rings = [np.array(r.coords) for r in (free.exterior, *free.interiors)]
    return np.vstack([np.hstack([r[:-1], r[1:]]) for r in rings]), free


def scans(
    count: int, sensor: SensorConfig, rng: np.random.Generator
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Walls in the robot frame, noise-free ranges and noisy ranges of so many scans."""
    out = []
    while len(out) < count:
        walls, free = office(rng)
        inner = free.buffer(-0.4)
        for _ in range(10):
            x, y = rng.uniform(0, 20), rng.uniform(-7, 7)
            if not shapely.contains_xy(inner, x, y):
                continue
            heading = rng.uniform(-math.pi, math.pi)
            c, s = math.cos(heading), math.sin(heading)
            turn = np.array([[c, -s], [s, c]])
            local = ((walls.reshape(-1, 2) - (x, y)) @ turn).reshape(-1, 4)
            exact = cast_rays(local, 0.0, 0.0, ANGLES, sensor.max_range)
            noisy = cast_rays(local, 0.0, 0.0, ANGLES + rng.normal(0, sensor.sigma_angle, 361), sensor.max_range)
            out.append((local, exact, np.maximum(noisy + rng.normal(0, sensor.sigma_range, 361), 1e-3)))
    return out[:count]


def visible(walls: np.ndarray, exact: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Seen piece of each wall (M, 4), and the number of beams on it."""
    seen, beams = walls.copy(), np.zeros(len(walls), int)
    hit = np.isfinite(exact)
    points = np.c_[exact[hit] * np.cos(ANGLES[hit]), exact[hit] * np.sin(ANGLES[hit])]
    for i, w in enumerate(walls):
        u = w[2:] - w[:2]
        length = math.hypot(*u)
        u = u / length
        t = (points - w[:2]) @ u
        off = (points - w[:2]) @ np.array([-u[1], u[0]])
        on = (np.abs(off) < 1e-6) & (t > -1e-6) & (t < length + 1e-6)
        beams[i] = on.sum()
        if beams[i]:
            seen[i, :2], seen[i, 2:] = w[:2] + t[on].min() * u, w[:2] + t[on].max() * u
    return seen, beams


def agree(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether segment a lies within 3 degrees and 5 cm of segment b, with half of a's length beside b."""
    ua, ub = a[2:] - a[:2], b[2:] - b[:2]
    la, lb = math.hypot(*ua), math.hypot(*ub)
    if la < 1e-9 or lb < 1e-9:
        return False
    ua, ub = ua / la, ub / lb
    if abs(ua[0] * ub[1] - ua[1] * ub[0]) > math.sin(math.radians(3)):
        return False
    t = np.sort([(a[:2] - b[:2]) @ ub, (a[2:] - b[:2]) @ ub])
    low, high = max(t[0], 0.0), min(t[1], lb)
    if high - low < 0.5 * la:
        return False
    middle = 0.5 * (a[:2] + a[2:]) - b[:2]
    return abs(middle[0] * ub[1] - middle[1] * ub[0]) < 0.05


def score(sample: list, found: list[ScanLines]) -> dict[str, float]:
    walls_n = walls_ok = big_n = big_ok = all_n = all_ok = 0
    for (walls, exact, _), lines in zip(sample, found, strict=True):
        seen, beams = visible(walls, exact)
        length = np.hypot(seen[:, 2] - seen[:, 0], seen[:, 3] - seen[:, 1])
        points = np.bincount(lines.point_segment[lines.point_segment >= 0], minlength=len(lines.segments))
        for i in np.flatnonzero((length >= 0.5) & (beams >= 10)):
            walls_n += 1
            walls_ok += any(agree(seen[i], s) for s in lines.segments)
        for s, n in zip(lines.segments, points, strict=True):
            right = any(agree(s, seen[i]) for i in np.flatnonzero(beams > 0))
            all_n, all_ok = all_n + 1, all_ok + right
            if n >= 10 and math.hypot(s[2] - s[0], s[3] - s[1]) >= 0.5:
                big_n, big_ok = big_n + 1, big_ok + right
    return {
        "recall": walls_ok / walls_n,
        "precision": big_ok / big_n,
        "precision of all": all_ok / all_n,
        "walls": walls_n,
        "segments": all_n,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    header = ("noise", "start", "recall", "precision", "of all", "segments", "candidates", "ms a scan", "times")
    rows: list[tuple[str, ...]] = []
    for sigma_range, degrees in ((0.01, 0.1), (0.02, 0.2), (0.05, 0.5)):
        sensor = SensorConfig(sigma_range=sigma_range, sigma_angle=math.radians(degrees))
        sample = scans(arguments.scans, sensor, np.random.default_rng(arguments.seed))
        found, cost, candidates = extract_all(sample, sensor)
        for name in STARTS:
            result = score(sample, found[name])
            rows.append(
                (
                    f"{sigma_range} m, {degrees} deg",
                    name,
                    *(f"{result[key]:.4f}" for key in ("recall", "precision", "precision of all")),
                    f"{result['segments']}",
                    f"{candidates[name]:.1f}" if candidates[name] else "-",
                    f"{1e3 * cost[name]:.3f}",
                    f"{cost[name] / cost['end points']:.2f}",
                )
            )
    print(f"{arguments.scans} scans, {result['walls']} walls at the last noise")
    print(format_table(header, rows))
    print("candidates: lines of the first search of a scan, mean; times: cost over that of the start 'end points'")
    print("\nInsert of a scan into a map, ms; poses known to 2 cm and 0.5 degrees")
    table = []
    for name, make in (("offices", offices), ("walls with steps of 0.3 m", stepped), ("walls of 0.4 m", crooked)):
        for size in (100, 5_000, 20_000):
            held, a_scan, *spent = insert_times(make, size, SensorConfig(), np.random.default_rng(0))
            table.append((name, f"{held}", f"{a_scan:.1f}", *(f"{1e3 * t:.3f}" for t in spent)))
    print(format_table(("map", "lines", "lines a scan", "median", "mean", "99 %"), table))


def extract_all(
    sample: list, sensor: SensorConfig
) -> tuple[dict[str, list[ScanLines]], dict[str, float], dict[str, float]]:
    """By start: lines of each scan, median seconds a scan, mean number of candidate lines. Starts take turns."""
    found: dict[str, list[ScanLines]] = {name: [] for name in STARTS}
    times: dict[str, list[float]] = {name: [] for name in STARTS}
    candidates: dict[str, list[int]] = {name: [] for name in STARTS}
    cv2.setNumThreads(1)
    for k, (_, _, ranges) in enumerate([sample[0], *sample]):  # the first is scanned twice: it also compiles
        for name, (start, votes) in STARTS.items():
            config = MappingConfig(start=start)
            with candidates_counted(votes) as searches:
                begin = time.thread_time()
                lines = extract_lines(ANGLES, ranges, sensor, config)
                seconds = time.thread_time() - begin
            if k:
                found[name].append(lines)
                times[name].append(seconds)
                candidates[name].append(searches[0] if searches else 0)
    return (
        found,
        {name: float(np.median(values)) for name, values in times.items()},
        {name: float(np.mean(values)) for name, values in candidates.items()},
    )


def stepped(rng: np.random.Generator) -> np.ndarray:
    """Walls (M, 4) of a room of 6 m by 5 m whose long walls step in and out by 0.3 m."""
    corners = []
    for sign in (-1, 1):
        x, deep = -3.0, False
        while x < 3.0:
            corners.append((sign * -x, sign * (2.5 - 0.3 * deep)))
            x = min(x + rng.uniform(0.5, 1.4), 3.0)
            corners.append((sign * -x, sign * (2.5 - 0.3 * deep)))
            deep = not deep
    return np.hstack([corners, np.roll(corners, -1, 0)])


def crooked(rng: np.random.Generator) -> np.ndarray:
    """Walls (M, 4) of a round room of 60 walls of about 0.4 m, no two in line."""
    t = np.linspace(0, 2 * math.pi, 60, endpoint=False)
    corners = (rng.uniform(3.4, 4.6, 60) * np.array([np.cos(t), np.sin(t)])).T
    return np.hstack([corners, np.roll(corners, -1, 0)])


def offices(rng: np.random.Generator) -> np.ndarray:
    """Walls (M, 4) of an office, its middle at the origin."""
    return office(rng)[0] - np.array([10.0, 0.0] * 2)


def insert_times(make: Callable, size: int, sensor: SensorConfig, rng: np.random.Generator) -> tuple[float, ...]:
    """Lines of a map of at least `size` lines, lines a scan, and median, mean and 99 % of the time of an insert, s.

    The map holds places 30 m apart, each seen 15 times from poses known to 2 cm and 0.5 degrees; 500 more scans follow.
    """
    line_map, places = LineMap(sensor=sensor), []
    sigma = np.array([0.02, 0.02, math.radians(0.5)])
    times, lines = [], []

    def look(at: np.ndarray, walls: np.ndarray) -> None:
        pose = np.array([*rng.uniform((-2.0, -0.6), (2.0, 0.6)), rng.uniform(-math.pi, math.pi)])
        beams = pose[2] + ANGLES + rng.normal(0.0, sensor.sigma_angle, 361)
        ranges = cast_rays(walls, pose[0], pose[1], beams, sensor.max_range) + rng.normal(0, sensor.sigma_range, 361)
        found = extract_lines(ANGLES, np.maximum(ranges, 1e-3), sensor)
        pose = pose + np.append(at, 0.0) + rng.normal(0.0, sigma)
        begin = time.thread_time()
        line_map.insert(found, pose, np.diag(sigma**2))
        times.append(time.thread_time() - begin)
        lines.append(found.rho.size)

    while line_map.line_alive.sum() < size:
        places.append((30.0 * np.array(divmod(len(places), 40)), make(rng)))
        for _ in range(15):
            look(*places[-1])
    held = int(line_map.line_alive.sum())
    for k in range(500):
        look(*places[k * 37 % len(places)])
    last = times[-500:]
    return held, np.mean(lines[-500:]), np.median(last), np.mean(last), np.percentile(last, 99)


if __name__ == "__main__":
    main()
