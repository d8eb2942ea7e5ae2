"""One plan, start and sensor: a proven lower bound and the best known offline tours, kept on disk."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.utils import seeding

from baselines.oracle.sight import CHECKPOINT_SPACING, Checkpoints, checkpoint_grid
from baselines.oracle.space import Space
from polyexplore_gym.config import RobotConfig, SensorConfig
from polyexplore_gym.floorplan import FloorPlan

VERSION = 1
"""Raised whenever a reference would come out differently: kept ones are then computed anew."""
ITERATIONS = 300
"""Rounds of destroy and repair of each tour."""
EFFORT = 2.5e8
"""Work on the lower bound, about 1e7 a second."""
_LARGE = 2500.0
"""Plans of more m2 have places 0.6 m apart instead of 0.3 m."""
_DIGITS = 6


@dataclass(frozen=True, eq=False)
class Tour:
    """A tour that sees all checkpoints."""

    length: float
    """Way, m."""
    legs: tuple[np.ndarray, ...]
    """Polylines (k, 2), m, from the start to the first stop, from there to the second, and so on."""
    headings: tuple[tuple[float, ...], ...] = ()
    """Where the robot scans, its headings there, rad: at the start, then at each stop. Empty: it senses all the way."""

    @cached_property
    def way(self) -> np.ndarray:
        """(m, 2) m: the whole way."""
        return np.vstack([self.legs[0][:1], *(leg[1:] for leg in self.legs)])

    @property
    def scans(self) -> int:
        """Number of scans."""
        return sum(map(len, self.headings))


@dataclass(frozen=True, eq=False)
class Reference:
    """What the best possible exploration costs: lower <= the optimum <= upper_sensing <= upper_stop_and_scan.

    The optimum is the shortest way of the disc's centre from the start from which all checkpoints are seen, by a
    sensor of this range that looks all round, all the time. `lower` is proven for it, in the continuous plane (see
    `baselines.oracle.lower`), so also for every sensor that sees less and every run that sees all checkpoints. The
    two tours are the best known, not the best possible: one senses along the way (360 degrees), the other only in scans
    at stops, with the field of view at hand.
    """

    plan_hash: str
    start: tuple[float, float]
    """m."""
    lower: float
    """m; proven."""
    upper_sensing: float
    """m; best known tour, sensing along the way, 360 degrees."""
    upper_stop_and_scan: float
    """m; best known tour, scans at stops only."""
    witnesses: np.ndarray
    """(n, 2) m: the checkpoints from which the lower bound follows."""
    tour_sensing: Tour
    tour_stop_and_scan: Tour
    unseen: np.ndarray
    """(k, 2) m: samples of the plan that nothing the robot can reach sees: no checkpoints."""
    seconds: dict[str, float] = field(default_factory=dict)
    """CPU time of the parts when it was computed, s."""

    @property
    def gap(self) -> float:
        """upper_sensing / lower; 1 where all is seen from the start."""
        return self.upper_sensing / self.lower if self.lower > 0.0 else (1.0 if self.upper_sensing == 0.0 else math.inf)

    def checkpoints(self, plan: FloorPlan) -> np.ndarray:
        """(C, 2) m: the points whose being seen makes an exploration complete.

        Raises ValueError if the reference is of another plan.
        """
        if plan.content_hash != self.plan_hash:
            raise ValueError(f"{plan.name}: this reference belongs to another plan")
        points = checkpoint_grid(plan)
        if not len(self.unseen):
            return points
        unseen = {tuple(p) for p in np.rint(self.unseen / 1e-4).astype(int).tolist()}
        keep = [tuple(p) not in unseen for p in np.rint(points / 1e-4).astype(int).tolist()]
        return np.ascontiguousarray(points[keep])

    def ratios(self, distance: float) -> dict[str, float]:
        """A complete exploration's way (m) over `lower` and over both tours; nan where all is seen from the start."""
        names = ("lower", "upper_sensing", "upper_stop_and_scan")
        return {name: distance / getattr(self, name) if getattr(self, name) > 0 else math.nan for name in names}


def reference(
    plan: FloorPlan,
    start: Sequence[float] | np.ndarray,
    sensor: SensorConfig | None = None,
    robot: RobotConfig | None = None,
    *,
    cache: str | Path | None = None,
    iterations: int = ITERATIONS,
    effort: float = EFFORT,
) -> Reference:
    """The reference for a plan, start and sensor; the same on every run, however fast the machine.

    Args:
        plan: the floor plan.
        start: x, y (m) and perhaps a heading, which does not matter.
        sensor: range and field of view count; None: the default sensor.
        robot: its radius counts; None: the default robot.
        cache: folder where references are kept; None: nowhere. A damaged file is computed anew.
        iterations: rounds of the search for each tour.
        effort: of the lower bound, about 1e7 a second.

    Raises:
        InvalidFloorPlanError: the start is unusable.
    """
    sensor, robot = sensor or SensorConfig(), robot or RobotConfig()
    plan.check_start(np.asarray(start, dtype=np.float64), robot.radius)
    x, y = (round(float(v), _DIGITS) for v in start[:2])
    parameters = {
        "version": VERSION,
        "plan": plan.content_hash,
        "start": [x, y],
        "max_range": sensor.max_range,
        "field_of_view": sensor.field_of_view,
        "radius": robot.radius,
        "iterations": iterations,
        "effort": effort,
    }
    key = _digest(parameters)
    file = None if cache is None else Path(cache) / f"{plan.content_hash[:16]}-{key[:16]}.json"
    kept = None if file is None else _read(file, parameters)
    if kept is not None:
        return kept
    found = _compute(plan, np.array([x, y]), sensor, robot, iterations, effort)
    if file is not None:
        _write(file, parameters, found)
    return found


def start_of(plan: FloorPlan, seed: int, robot: RobotConfig | None = None) -> np.ndarray:
    """(3,): where an environment reset with `seed` on this plan starts: x, y (m) and heading (rad)."""
    streams = seeding.np_random(seed)[0].spawn(4)  # as in the reset: plan, start, laser, pose
    return plan.sample_start(streams[1], (robot or RobotConfig()).radius)


def _compute(
    plan: FloorPlan, start: np.ndarray, sensor: SensorConfig, robot: RobotConfig, iterations: int, effort: float
) -> Reference:
    from time import process_time

    from baselines.oracle.lower import lower_bound
    from baselines.oracle.upper import Planner

    times = [process_time()]
    inner = Space.inner(plan, robot.radius, start)
    spacing = CHECKPOINT_SPACING * (1 if plan.area <= _LARGE else 2)
    sight = Checkpoints(plan, inner, start, sensor.max_range, spacing)
    times.append(process_time())
    sensing = Planner(inner, sight, along=True).search(np.random.default_rng(0), iterations)
    times.append(process_time())
    scanning = Planner(inner, sight, along=False)
    scans = scanning.search(np.random.default_rng(0), iterations)
    if scans.length < sensing.length:  # it can be driven with the sensor on, too
        sensing = scans
    headings = scanning.headings(scans.stops, sensor.field_of_view)
    times.append(process_time())
    bound = lower_bound(Space.outer(plan, robot.radius, start), sight, start, effort)
    times.append(process_time())
    parts = ("checkpoints", "sensing", "stop and scan", "lower bound")
    return Reference(
        plan_hash=plan.content_hash,
        start=(float(start[0]), float(start[1])),
        lower=bound.length,
        upper_sensing=sensing.length,
        upper_stop_and_scan=scans.length,
        witnesses=bound.witnesses,
        tour_sensing=Tour(sensing.length, sensing.legs),
        tour_stop_and_scan=Tour(scans.length, scans.legs, headings),
        unseen=sight.unseen,
        seconds={name: round(b - a, 3) for name, a, b in zip(parts, times[:-1], times[1:], strict=True)},
    )


# On disk ------------------------------------------------------------------------------------------


def _digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    if dataclasses.is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    return value


def _tour(values: dict[str, Any]) -> Tour:
    legs = tuple(np.array(leg, dtype=np.float64).reshape(-1, 2) for leg in values["legs"])
    return Tour(float(values["length"]), legs, tuple(tuple(map(float, h)) for h in values["headings"]))


def _write(file: Path, parameters: dict[str, Any], found: Reference) -> None:
    content = {"parameters": parameters, "reference": _plain(found)}
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_suffix(f".{os.getpid()}.part")
    part.write_text(json.dumps({**content, "sha256": _digest(content)}), encoding="utf-8")
    part.replace(file)


def _read(file: Path, parameters: dict[str, Any]) -> Reference | None:
    """The reference in a file; None if there is none, or it is damaged or of other parameters."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        checksum = content.pop("sha256")
        if checksum != _digest(content) or content["parameters"] != parameters:
            return None
        values = dict(content["reference"])
        for name in ("witnesses", "unseen"):
            values[name] = np.array(values[name], dtype=np.float64).reshape(-1, 2)
        for name in ("tour_sensing", "tour_stop_and_scan"):
            values[name] = _tour(values[name])
        return Reference(**{**values, "start": tuple(values["start"])})
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
