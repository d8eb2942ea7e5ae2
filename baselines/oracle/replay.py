"""Driving a reference's tour in the simulated world, by the environment's rules, and scoring any run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from baselines.oracle.reference import Tour
from polyexplore_gym.config import EnvConfig, SensorConfig
from polyexplore_gym.floorplan import FloorPlan
from polyexplore_gym.sim.coverage import Coverage
from polyexplore_gym.sim.world import World


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """What driving a tour came to."""

    distance: float
    """Driven, m, as the environment counts it."""
    coverage: float
    """Share of the checkpoints seen in the scans, 0 to 1."""
    scans: int
    """Scans taken."""
    collisions: int
    """Bumps."""
    trajectory: np.ndarray
    """(m, 3) true poses."""


def replay(
    plan: FloorPlan,
    start: Sequence[float] | np.ndarray,
    tour: Tour,
    checkpoints: np.ndarray,
    config: EnvConfig | None = None,
) -> Replay:
    """Drive a stop-and-scan tour through the world of the environment: to each stop, then scan in its headings.

    start: x, y and perhaps a heading. checkpoints (C, 2): `Reference.checkpoints`. config: robot, sensor, drive.
    """
    config = config or EnvConfig()
    x, y, heading = [*map(float, start), 0.0][:3]
    world = World(plan.segments, config.robot, config.sensor, config.drive, np.array([x, y, heading]))
    coverage = Coverage(checkpoints)
    distance, scans, collisions = 0.0, 0, 0
    trajectory = [world.pose[None]]
    for k, headings in enumerate(tour.headings):
        path = world.pose[None, :2] if k == 0 else np.vstack([world.pose[:2], tour.legs[k - 1][1:]])
        for turn in headings or (None,):
            result = world.drive(path, turn)
            distance += result.distance
            collisions += int(result.collided)
            trajectory.append(result.trajectory[1:])
            path = world.pose[None, :2]
            if turn is not None:
                coverage.add(world.segments, world.pose, config.sensor)
                scans += 1
    return Replay(distance, coverage.share, scans, collisions, np.concatenate(trajectory))


def distance_to_see(
    plan: FloorPlan,
    checkpoints: np.ndarray,
    trajectory: np.ndarray,
    sensor: SensorConfig,
    *,
    share: float = 1.0,
    step: float = 0.1,
) -> float | None:
    """Way (m) along a trajectory (m, 2 or 3) until a share of the checkpoints is seen by a sensor that looks all round.

    It looks at every pose and at most every `step` m between: never too often, so what it finds is no shorter than the
    true way. None: never.
    """
    full = SensorConfig(max_range=sensor.max_range, field_of_view=2.0 * math.pi)
    coverage = Coverage(checkpoints)
    way = np.asarray(trajectory, dtype=np.float64)[:, :2]
    driven = 0.0
    for k in range(len(way)):
        leg = math.hypot(*(way[k] - way[k - 1])) if k else 0.0
        if k and leg == 0.0:
            continue  # turned on the spot
        pieces = max(1, math.ceil(leg / step))
        for i in range(1, pieces + 1):
            at = way[k] if i == pieces else way[k - 1] + (way[k] - way[k - 1]) * (i / pieces)
            coverage.add(plan.segments, np.array([at[0], at[1], 0.0]), full)
            if coverage.share >= share - 1e-12:
                return driven + leg * i / pieces
        driven += leg
    return None
