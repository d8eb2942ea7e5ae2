"""Scans a second: our laser kernel beside pymunk's ray query and ir-sim's lidar, in the same worlds, in one run.

Worlds are office floors of growing size: rooms with doors and a pillar each on both sides of corridors. Poses are
random in the free space; 361 beams over 180 degrees, 8 m. All give true ranges here (noise costs extra, last column:
our whole noisy measurement) and their ranges are compared before their speed. ir-sim gets the walls both ways, as one
object and as one object a wall, and the faster counts. It is optional: pip install "polyexplore-gym[peers]".

Run: python benchmarks/laser_speed.py [--poses 100] [--seconds 1.0]
"""

from __future__ import annotations

import argparse
import contextlib
import io
import logging
import math
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pymunk
import shapely
import yaml

from polyexplore_gym.config import SensorConfig
from polyexplore_gym.sim.laser import Laser

SENSOR = SensorConfig()
Scan = Callable[[np.ndarray], np.ndarray]


def office(target: int) -> tuple[np.ndarray, shapely.Polygon]:
    """Walls (M, 4), M about target, and the free space of an office floor; always the same for one target."""
    rng = np.random.default_rng(target)
    rooms = max(2, round(target / 12))
    columns = max(1, round(math.sqrt(rooms / 2 * 1.6)))
    parts, pillars, y, left = [], [], 0.0, rooms
    while left > 0:
        parts.append(shapely.box(0.0, y, 4.0 * columns, y + 2.0))
        for side in (-1, 1):
            for column in range(min(columns, left)):
                near, far = (y - 0.15, y - 4.0) if side < 0 else (y + 2.15, y + 6.0)
                x0 = 4.0 * column + 0.08
                parts.append(shapely.box(x0, min(near, far), x0 + 3.84, max(near, far)))
                door = x0 + rng.uniform(0.4, 2.5)
                parts.append(shapely.box(door, min(near, y), door + 0.9, max(near, y + 2.0)))
                px, py = x0 + rng.uniform(1.0, 2.6), 0.5 * (near + far) + rng.uniform(-0.8, 0.8)
                pillars.append(shapely.box(px, py, px + 0.3, py + 0.3))
            left -= min(columns, left)
        parts.append(shapely.box(0.0, y, 1.6, y + 12.0) if left > 0 else shapely.Polygon())
        y += 10.2
    free = shapely.difference(shapely.union_all(parts), shapely.union_all(pillars))
    free = max(getattr(free, "geoms", [free]), key=lambda g: g.area)
    rings = [np.asarray(r.coords) for r in (free.exterior, *free.interiors)]
    return np.concatenate([np.hstack([r[:-1], r[1:]]) for r in rings]), free


def poses_in(free: shapely.Polygon, count: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    room = free.buffer(-0.3)
    x0, y0, x1, y1 = room.bounds
    points = rng.uniform([x0, y0], [x1, y1], (200 * count, 2))
    points = points[shapely.contains_xy(room, *points.T)][:count]
    return np.column_stack([points, rng.uniform(-math.pi, math.pi, len(points))])


def with_ours(walls: np.ndarray) -> tuple[Scan, Scan]:
    laser, rng, zero = Laser(SENSOR), np.random.default_rng(0), np.zeros((2, SENSOR.beams))
    return lambda pose: laser.scan(walls, pose, zero), lambda pose: laser.measure(walls, pose, rng)


def with_pymunk(walls: np.ndarray) -> Scan:
    space = pymunk.Space()
    space.add(*(pymunk.Segment(space.static_body, w[:2], w[2:], 0.0) for w in walls.tolist()))
    nominal, everything = Laser(SENSOR).angles, pymunk.ShapeFilter()
    query, reach = space.segment_query_first, SENSOR.max_range

    def scan(pose: np.ndarray) -> np.ndarray:
        x, y = float(pose[0]), float(pose[1])
        angles = nominal + pose[2]
        ends = zip((x + reach * np.cos(angles)).tolist(), (y + reach * np.sin(angles)).tolist(), strict=True)
        hits = [query((x, y), end, 0.0, everything) for end in ends]
        return np.array([math.inf if hit is None else hit.alpha * reach for hit in hits])

    return scan


def with_irsim(walls: np.ndarray, one_object: bool) -> Scan | None:
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):  # window backends
            import irsim
    except ImportError:
        return None
    lines = [w.reshape(2, 2).tolist() for w in walls]
    shapes = [{"name": "linestring", "vertices": line} for line in (lines[:1] if one_object else lines)]
    lidar = {
        "name": "lidar2d",
        "range_min": 0.0,
        "range_max": SENSOR.max_range,
        "angle_range": SENSOR.field_of_view,
        "number": SENSOR.beams,
        "noise": False,
    }
    low, high = walls.reshape(-1, 2).min(axis=0) - 1.0, walls.reshape(-1, 2).max(axis=0) + 1.0
    world = {
        "world": {"width": float(high[0] - low[0]), "height": float(high[1] - low[1]), "offset": low.tolist()},
        "robot": [{"kinematics": {"name": "diff"}, "shape": {"name": "circle", "radius": 0.2}, "sensors": [lidar]}],
    }
    world["obstacle"] = [{"shape": shape, "state": [0, 0, 0]} for shape in shapes]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "world.yaml"
        file.write_text(yaml.safe_dump(world))
        env = irsim.make(str(file), headless=True, disable_all_plot=True, log_level="ERROR")
    if one_object:  # a single linestring in the file would also join the walls to each other
        env.obstacle_list[0]._geometry = shapely.multilinestrings(walls.reshape(-1, 2, 2))
        env.build_tree()
    sensor = env.robot.lidar

    def scan(pose: np.ndarray) -> np.ndarray:
        sensor.step(pose.reshape(3, 1))
        return np.where(sensor.valid, sensor.range_data, math.inf)

    return scan


def seconds_a_scan(scan: Scan, poses: np.ndarray, budget: float) -> float:
    """Best mean over the poses among the rounds that fit the budget (s): the least disturbed one."""
    scan(poses[0])
    best, end = math.inf, time.perf_counter() + budget
    while True:
        start = time.perf_counter()
        for pose in poses:
            scan(pose)
        now = time.perf_counter()
        best = min(best, (now - start) / len(poses))
        if now > end:
            return best


def agreement(scan: Scan, reference: Scan, poses: np.ndarray) -> float:
    """Share of beams on which two scanners agree within 1 mm."""
    pairs = [(scan(p), reference(p)) for p in poses[:20]]
    return float(np.mean([np.isclose(a, b, atol=1e-3) for a, b in pairs]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--poses", type=int, default=100, help="poses per world")
    parser.add_argument("--seconds", type=float, default=1.0, help="time spent on each measurement")
    parser.add_argument("--sizes", type=int, nargs="+", default=[40, 300, 1000, 3000], help="walls, roughly")
    arguments = parser.parse_args()
    logging.disable(logging.WARNING)
    print(f"{SENSOR.beams} beams, {math.degrees(SENSOR.field_of_view):.0f} degrees, {SENSOR.max_range:g} m; scans/s")
    heads = ("walls", 6), ("ours", 9), ("us/scan", 8), ("Mrays/s", 8), ("pymunk", 8), ("ratio", 6), ("ir-sim", 8)
    print(" ".join(f"{name:>{width}}" for name, width in (*heads, ("ratio", 6), ("noisy us", 9))))
    for size in arguments.sizes:
        walls, free = office(size)
        poses = poses_in(free, arguments.poses)
        ours, noisy = with_ours(walls)
        peers = [[with_pymunk(walls)]]
        if size <= 1000 or size == min(arguments.sizes):
            peers.append([s for s in (with_irsim(walls, True), with_irsim(walls, False)) if s is not None])
        own = seconds_a_scan(ours, poses, arguments.seconds)
        row = f"{len(walls):6d} {1 / own:9.0f} {own * 1e6:8.1f} {SENSOR.beams / own / 1e6:8.1f}"
        for scanners in [*peers, []][:2]:
            for scanner in scanners:
                share = agreement(scanner, ours, poses)
                if share < 0.999:
                    raise SystemExit(f"{len(walls)} walls: a peer's ranges agree on {share:.1%} of the beams only")
            if scanners:
                peer = min(seconds_a_scan(s, poses[:30], arguments.seconds) for s in scanners)
                row += f" {1 / peer:8.0f} {peer / own:6.0f}"
            else:
                row += f" {'-':>8} {'-':>6}"
        print(row + f" {seconds_a_scan(noisy, poses, arguments.seconds) * 1e6:9.1f}", flush=True)


if __name__ == "__main__":
    main()
