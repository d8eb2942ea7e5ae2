"""A laser log to a line map: `map_log`."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely

from polyexplore_gym.config import MappingConfig, SensorConfig
from polyexplore_gym.errors import InvalidConfigError, InvalidLogError
from polyexplore_gym.mapping.evidence import RATIO, Beams, held_against
from polyexplore_gym.mapping.extract import LEAST_RANGE, check_scan, extract_lines
from polyexplore_gym.mapping.line_map import LineMap
from polyexplore_gym.mapping.logs import LaserLog, deskewed

MAX_RANGE = 30.0
"""Range from which on a beam has no return, if neither the log nor the user says, m."""
TURN = 0.5
"""A turn by so much counts as much as the least travel between two scans, rad."""
MISFIT = 0.2
"""With a larger `LogMap.misfit` the poses are wrong: it is 0.01 and 0.06 in good logs (intel and csail), 0.17 and 0.23
there with errors of 5 cm and 1 degree added to each pose, 0.7 with raw odometry."""


@dataclass(frozen=True, slots=True)
class LogMap:
    """The line map of a log: L lines, K segments of wall on them, F fragments (obstacles without a line), map frame."""

    rho: np.ndarray
    """(L,) distance of each line from the map's origin, m: x cos(alpha) + y sin(alpha) = rho."""
    alpha: np.ndarray
    """(L,) direction of the line's normal, rad."""
    covariance: np.ndarray
    """(L, 2, 2) in the order (alpha, rho): rad2, rad m, m2."""
    segments: np.ndarray
    """(K, 4) end points x1, y1, x2, y2, m; the free space lies on the left."""
    segment_line: np.ndarray
    """(K,) index of the line of each segment."""
    segment_sigma: np.ndarray
    """(K,) standard deviation across each segment, m."""
    fragments: np.ndarray
    """(F, 4) end points, m."""
    used: np.ndarray
    """(scans used,) which scans of the log."""
    path: np.ndarray
    """(scans used, 3) x, y (m), heading (rad) of the laser."""
    points: np.ndarray
    """(P, 2) all returns of the scans used, m."""
    point_scan: np.ndarray
    """(P,) index of each return's scan in `path`."""
    on_line: np.ndarray
    """(P,) whether a return lies on a line of its own scan."""
    distances: np.ndarray
    """(P,) distance of each return to the nearest segment, m; inf without any."""
    lines_of_scans: int
    """Lines of the single scans, before merging."""
    contradicted: int
    """Segments that were dropped or cut because beams passed through them."""
    fragments_contradicted: int
    """Fragments likewise."""
    misfits: np.ndarray
    """(scans used,) share of each scan's beams that passed through a wall of the map, of those that met one; NaN: none
    did. The walls are those before anything was cut."""

    @property
    def compression(self) -> float:
        """1 - lines / returns."""
        return 1.0 - self.rho.size / max(len(self.points), 1)

    @property
    def median_distance(self) -> float:
        """Median distance of the returns on lines to the nearest segment, m; inf without any."""
        return float(np.median(self.distances[self.on_line])) if self.on_line.any() else math.inf

    @property
    def misfit(self) -> float:
        """How badly walls that were seen again fit, 0 to 1: the median of `misfits`."""
        known = self.misfits[np.isfinite(self.misfits)]
        return float(np.median(known)) if known.size else 0.0


def sensor_of(
    log: LaserLog, max_range: float | None = None, sigma_range: float = 0.01, sigma_angle: float = math.radians(0.1)
) -> SensorConfig:
    """The laser of a log. max_range (m): None for what the log says, else 30; the noise is in m and rad."""
    angles = max(log.angles, key=np.size)
    return SensorConfig(
        beams=angles.size,
        field_of_view=_view(angles),
        max_range=max_range if max_range is not None else log.max_range or MAX_RANGE,
        sigma_range=sigma_range,
        sigma_angle=sigma_angle,
    )


def _view(angles: np.ndarray) -> float:
    """Field of view of a scan, rad: closed if the last beam neighbours the first."""
    span = float(np.ptp(angles))
    return 2.0 * math.pi if span + 1.5 * span / (angles.size - 1) > 2.0 * math.pi else span


def _closed(sensor: SensorConfig, angles: np.ndarray) -> SensorConfig:
    """The sensor, but of an open field of view for a scan that is part of a full turn."""
    view = _view(angles)
    return sensor if not sensor.full_circle or view >= 2.0 * math.pi else replace(sensor, field_of_view=view)


def map_log(
    log: LaserLog,
    sensor: SensorConfig | None = None,
    config: MappingConfig | None = None,
    *,
    sigma_xy: float = 0.02,
    sigma_heading: float = math.radians(0.3),
    every: int = 1,
    min_travel: float = 0.0,
    ratio: float = RATIO,
    track: Callable[[Iterable[int], str], Iterable[int]] = lambda scans, what: scans,
) -> LogMap:
    """The line map of a log.

    The map only gains walls, so in the end every beam is held against every wall: where more than `ratio` beams
    passed through for each that ended there the wall is cut (see `polyexplore_gym.mapping.evidence`). A UserWarning
    says so if walls that were seen again do not fit. Scans that were taken on the move are straightened first.

    Args:
        log: of `read_log`.
        sensor: of `sensor_of`, which is the default.
        config: numbers and limits of the fit; by default a range floor of 1 cm, which real lasers need.
        sigma_xy, sigma_heading: standard deviation of the poses (m, rad), if the log gives no covariance.
        every: only every so many-th scan.
        min_travel: only scans at least so far (m) from the last one used, or turned against it by 0.5 rad.
        ratio: 0 keeps every wall.
        track: wraps the scans of each pass, to show progress; its second argument names the pass.

    Raises:
        InvalidConfigError: a number is out of range.
        InvalidLogError: the log gives no poses, or all its readings are the maximum range and more, or none.

    Example:
        >>> import numpy as np
        >>> from polyexplore_gym.mapping import LaserLog, map_log
        >>> angles = np.linspace(-0.5, 0.5, 101)
        >>> log = LaserLog(angles, np.array([2.0 / np.cos(angles)]), np.zeros((1, 3)))
        >>> map_log(log).segments.round(2) + 0.0
        array([[ 2.  , -1.09,  2.  ,  1.09]])
    """
    poses = log.poses
    if poses is None:
        raise InvalidLogError(f"no poses to map with: {log.why or 'the log gives none'}; {_remedy(log)}")
    sensor = sensor_of(log) if sensor is None else sensor
    config = MappingConfig(range_floor=0.01) if config is None else config
    for name, value, least in (
        ("every", every, 1), ("min_travel", min_travel, 0), ("ratio", ratio, 0),
        ("sigma_xy", sigma_xy, 0), ("sigma_heading", sigma_heading, 0),
    ):  # fmt: skip
        if not (math.isfinite(value) and value >= least):
            raise InvalidConfigError(f"{name} = {value}: must be at least {least}")
    _check_returns(log, sensor.max_range)
    log = deskewed(log)
    used = _apart(poses, range(0, len(poses), every), min_travel)
    if log.pose_covariance is None:
        covariances = np.broadcast_to(np.diag([sigma_xy, sigma_xy, sigma_heading]) ** 2, (len(poses), 3, 3))
    else:
        covariances = log.pose_covariance
    line_map, lines = LineMap(config, sensor), 0
    points, on_line = [], []
    for k in track(used, "lines"):
        angles, ranges = log.angles[k], log.ranges[k]
        found = extract_lines(angles, ranges, _closed(sensor, angles), config)
        line_map.insert(found, poses[k], covariances[k])
        lines += found.rho.size
        hit = (ranges >= LEAST_RANGE) & (ranges < sensor.max_range)
        points.append(_placed(angles[hit], ranges[hit], poses[k]))
        on_line.append(found.point_segment[hit] >= 0)

    def beams() -> Iterable[Beams]:
        for k in track(used, "check"):
            _, angles, ranges = check_scan(log.angles[k], log.ranges[k])
            yield Beams(angles, ranges, poses[k], covariances[k])

    noise = max(sensor.sigma_range, config.range_floor) ** 2, sensor.sigma_angle**2
    rows, parts, of, misfits = held_against(line_map, beams(), sensor.max_range, *noise, ratio)
    whole, line = line_map.segments[rows], line_map.line[rows]
    intact = np.zeros(rows.size, bool)
    same = (parts == whole[of]).all(axis=1)
    intact[of[same]] = True

    wall = line[of] >= 0
    kept, segment_line = np.unique(line[of][wall], return_inverse=True)
    tree: Any = shapely.STRtree(shapely.linestrings(parts[wall].reshape(-1, 2, 2)))
    distances = [_nearest(some, tree) for some, _ in zip(points, track(used, "distances"), strict=True)]
    made = LogMap(
        rho=line_map.rho[kept].copy(),
        alpha=line_map.alpha[kept].copy(),
        covariance=line_map.covariance[kept].copy(),
        segments=parts[wall],
        segment_line=segment_line,
        segment_sigma=line_map.sigma[rows][of][wall],
        fragments=parts[~wall],
        used=np.array(used),
        path=poses[used],
        points=np.concatenate(points),
        point_scan=np.repeat(np.arange(len(points)), [len(some) for some in points]),
        on_line=np.concatenate(on_line),
        distances=np.concatenate(distances),
        lines_of_scans=lines,
        contradicted=int((~intact & (line >= 0)).sum()),
        fragments_contradicted=int((~intact & (line < 0)).sum()),
        misfits=misfits,
    )
    if made.misfit > MISFIT:
        warnings.warn(_misfit_text(made.misfit, log), stacklevel=2)
    return made


def _misfit_text(misfit: float, log: LaserLog) -> str:
    kind = {
        "odometry": "raw odometry",
        "corrected": "corrected ones",
        "unknown": "of unknown origin",
        "matched": "what SLAM found",
    }[log.poses_are]
    return (
        f"walls that were seen again do not fit: in half of the scans {100 * misfit:.0f} % of the beams or more pass "
        f"through walls that they should have met; up to {100 * MISFIT:.0f} % is usual. The poses are wrong: they are "
        f"{kind}{f' ({log.why})' if log.why else ''}; {_remedy(log)}"
    )


def _remedy(log: LaserLog) -> str:
    """What to do about poses that are wrong or missing."""
    if log.poses_are == "matched":
        return "scans at shorter distances, or a trajectory from elsewhere, are needed"
    raw = log.odometry is not None or (log.poses is not None and log.poses_are != "corrected")
    source = "odometry" if raw else "none"
    return f'--poses {source} finds better ones from the scans (`correct_poses`, source="{source}")'


def _check_returns(log: LaserLog, max_range: float) -> None:
    """InvalidLogError if there are readings, but none of a wall."""
    known = finite = False
    for ranges in log.ranges:
        reading = ranges >= LEAST_RANGE  # not NaN
        if (reading & (ranges < max_range)).any():
            return
        known |= bool(reading.any())
        finite |= bool(np.isfinite(ranges).any())
    if not known:
        raise InvalidLogError(f"no reading in {len(log)} scans: all ranges are zero, negative or NaN")
    if finite:
        raise InvalidLogError(f"all readings of {len(log)} scans are {max_range:g} m, the maximum range, or more")


def _apart(poses: np.ndarray, candidates: Iterable[int], travel: float) -> list[int]:
    """Those of the scans that lie so far apart, or are turned against each other; the first is always in."""
    used: list[int] = []
    for k in candidates:
        if used and travel > 0:
            dx, dy, turn = poses[k] - poses[used[-1]]
            if math.hypot(dx, dy) < travel and abs(math.remainder(turn, 2.0 * math.pi)) < TURN:
                continue
        used.append(k)
    return used


def _placed(angles: np.ndarray, ranges: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """(m, 2) end points of beams in the map frame, m."""
    return pose[:2] + ranges[:, None] * np.stack([np.cos(angles + pose[2]), np.sin(angles + pose[2])], axis=1)


def _nearest(points: np.ndarray, tree: Any) -> np.ndarray:
    """(m,) distance of each point (m, 2) to the nearest segment in a `shapely.STRtree`, m; inf without any."""
    out = np.full(len(points), np.inf)
    (at, _), distance = tree.query_nearest(shapely.points(points), all_matches=False, return_distance=True)
    out[at] = distance
    return out
