"""Random walls for the tests of the simulated world, and the shared floor plans where they exist."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path

import numpy as np
import shapely

from polyexplore_gym.config import RobotConfig


def random_walls(rng: np.random.Generator, count: int, side: float = 14.0) -> np.ndarray:
    """Free-standing walls (count, 4) strewn over a square: every third axis-parallel, now and then two joined."""
    start = rng.uniform(-side / 2, side / 2, (count, 2))
    way = rng.normal(0.0, 1.5, (count, 2))
    way[::3, 0] = 0.0
    walls = np.hstack([start, start + way])
    for k in range(1, count, 4):
        walls[k, :2] = walls[k - 1, 2:]
    return walls


def boxed(walls: np.ndarray, half: float) -> np.ndarray:
    """The walls and a square around them, free space on the left."""
    ring = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    return np.vstack([walls, np.hstack([ring, np.roll(ring, -1, axis=0)])])


def clear_point(rng: np.random.Generator, walls: np.ndarray, half: float, radius: float) -> np.ndarray:
    lines = shapely.multilinestrings(walls.reshape(-1, 2, 2))
    while True:
        point = rng.uniform(-half, half, 2)
        if shapely.distance(lines, shapely.points(point)) > radius:
            return point


def any_robot(rng: np.random.Generator) -> tuple[RobotConfig, float]:
    """A robot anywhere in the legal range, and a time step (s): it covers 0.0001 to 300 radii in one."""

    def draw(low: float, high: float) -> float:
        return float(low * (high / low) ** rng.uniform())

    radius, rate, speed, step = draw(0.02, 2.0), draw(0.3, 30.0), draw(0.05, 50.0), draw(0.001, 0.2)
    robot = RobotConfig(
        radius=radius,
        track=radius * rng.uniform(0.5, 2.0),
        max_speed=speed,
        max_acceleration=speed * draw(0.2, 200.0),
        max_turn_rate=rate,
        max_turn_acceleration=rate * draw(0.5, 200.0),
    )
    return robot, step


def random_path(rng: np.random.Generator, shortest: float, longest: float) -> np.ndarray:
    """From the origin, two to eight points: gentle and sharp turns, legs from shortest to longest (m)."""
    points, heading = [np.zeros(2)], rng.uniform(-3, 3)
    for _ in range(rng.integers(1, 8)):
        points.append(points[-1] + rng.uniform(shortest, longest) * np.array([math.cos(heading), math.sin(heading)]))
        heading += rng.normal(0, 0.3) if rng.random() < 0.5 else rng.uniform(-2.5, 2.5)
    return np.array(points)


def lines_of(walls: np.ndarray) -> shapely.Geometry:
    return shapely.multilinestrings(walls.reshape(-1, 2, 2))


def shared_plans() -> list[Path]:
    """The shared plans' files, smallest first; empty when there are none."""
    default = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "floorplans"
    folder = Path(os.environ.get("POLYEXPLORE_DATA", default))
    return sorted(folder.glob("*.json"), key=lambda p: (p.stat().st_size, p.name))


def load_polygon(path: Path) -> shapely.Polygon:
    data = json.loads(path.read_text())
    return shapely.Polygon(data["exterior"], data["holes"])


def polygon_walls(polygon: shapely.Polygon) -> np.ndarray:
    rings = [np.asarray(r.coords) for r in (polygon.exterior, *polygon.interiors)]
    return np.concatenate([np.hstack([r[:-1], r[1:]]) for r in rings])
