"""Trajectories in the TUM format: a text line for each pose, `time x y z qx qy qz qw` (s, m, unit quaternion)."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from polyexplore_gym.errors import InvalidLogError, ResultsError
from polyexplore_gym.mapping.logs.record import FARTHEST, Broken, LaserLog, Track

LONGEST_GAP = 1.0
"""A pose is worked out between two that lie so far apart in time at most, s ..."""
NEAR = 0.01
"""... or taken from one that is as near as that, s ..."""
STILL = 0.05, 0.05
"""... or worked out between two that differ by no more, m and rad."""
UNIT = 0.01
"""The length of a quaternion may differ from 1 by as much."""


def read_trajectory(path: str | Path) -> Track:
    """The poses of a file; height, roll and pitch are left out.

    Raises:
        InvalidLogError: the file cannot be read, or a line is no pose; it is named.

    Example:
        >>> import tempfile
        >>> from polyexplore_gym.mapping.logs import read_trajectory
        >>> path = tempfile.mkdtemp() + "/poses.txt"
        >>> _ = open(path, "w").write("# t x y z qx qy qz qw\\n0.5 1 2 0 0 0 1 0\\n")
        >>> read_trajectory(path).poses.round(3)
        array([[1.   , 2.   , 3.142]])
    """
    path = Path(path)
    try:
        text = path.read_bytes().decode("utf-8")
    except OSError as error:
        raise InvalidLogError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise InvalidLogError(f"{path}: is not text: byte {error.start} is no UTF-8") from error
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.replace(",", " ").split()
        if not fields or fields[0].startswith("#"):
            continue
        try:
            rows.append(_row(fields))
        except ValueError as error:
            raise InvalidLogError(f"{path}: line {number}: {error}") from error
    if not rows:
        raise InvalidLogError(f"{path}: holds no pose")
    data = np.array(rows)
    return Track.sorted(data[:, 0], data[:, 1:])


def save_trajectory(track: Track, path: str | Path) -> None:
    """Write poses in the plane, all digits of times, heights 0; in one go, so that there is no half a file.

    Raises:
        ResultsError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> from polyexplore_gym.mapping.logs import Track, save_trajectory
        >>> path = tempfile.mkdtemp() + "/poses.txt"
        >>> save_trajectory(Track(np.array([0.5]), np.array([[1.0, 2.0, np.pi]])), path)
        >>> print(open(path).read().splitlines()[1])
        0.500000 1.000000 2.000000 0 0 0 1.000000000 0.000000000
    """
    path = Path(path)
    lines = ["# time x y z qx qy qz qw"]
    for time, (x, y, heading) in zip(track.times.tolist(), track.poses.tolist(), strict=True):
        qz, qw = math.sin(0.5 * heading), math.cos(0.5 * heading)
        lines.append(f"{time:.6f} {x:.6f} {y:.6f} 0 0 0 {qz:.9f} {qw + 0.0:.9f}")
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")
        os.replace(part, path)
    except OSError as error:
        raise ResultsError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)


def _row(fields: list[str]) -> tuple[float, float, float, float]:
    if len(fields) != 8:
        raise ValueError(f"{len(fields)} fields; a pose is: time x y z qx qy qz qw")
    for name, value in zip(("time", "x", "y", "z", "qx", "qy", "qz", "qw"), fields, strict=True):
        try:
            sound = math.isfinite(float(value))
        except ValueError:
            sound = False
        if not sound:
            raise ValueError(f"{name} is {value[:20]!r}, not a finite number")
    time, x, y, _, *quaternion = map(float, fields)
    if max(abs(x), abs(y)) > FARTHEST:
        raise ValueError(f"the pose is {x}, {y}")
    length = math.hypot(*quaternion)
    if abs(length - 1.0) > UNIT:
        raise ValueError(f"the quaternion has the length {length:g}, not 1")
    qx, qy, qz, qw = quaternion
    return time, x, y, math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))


def with_trajectory(log: LaserLog, trajectory: Track, name: str) -> LaserLog:
    """The log with poses of the laser from a trajectory; scans that it has no pose for are left out.

    Raises:
        InvalidLogError: the log has no times, or the trajectory has no pose for any scan.
    """
    if log.times is None:
        raise InvalidLogError(f"{name}: cannot be used: the scans of the log have no times")
    known = covered(trajectory, log.times)
    if not known.any():
        a, b = trajectory.times[[0, -1]]
        raise InvalidLogError(
            f"{name}: has no pose for any scan: its times are {a:.3f} to {b:.3f} s, "
            f"those of the scans {log.times.min():.3f} to {log.times.max():.3f} s"
        )
    missing = [
        Broken(f"scan at {time:.3f} s", f"the trajectory has no pose within {LONGEST_GAP:g} s")
        for time in log.times[~known].tolist()
    ]
    posed = replace(
        log, poses=trajectory.at(log.times), pose_covariance=None, poses_are="corrected", why=f"poses of {name}"
    )
    return chosen(posed, known, missing)


def covered(track: Track, times: np.ndarray) -> np.ndarray:
    """(n,) whether a track tells the pose at each of these times (n,)."""
    after = np.clip(np.searchsorted(track.times, times), 1, max(track.times.size - 1, 1))
    before, after = after - 1, np.minimum(after, track.times.size - 1)
    a, b = track.times[before], track.times[after]
    near = np.minimum(np.abs(times - a), np.abs(times - b)) <= NEAR
    step = track.poses[after] - track.poses[before]
    turn = np.abs(np.remainder(step[:, 2] + np.pi, 2 * np.pi) - np.pi)
    close = (b - a <= LONGEST_GAP) | ((np.hypot(step[:, 0], step[:, 1]) <= STILL[0]) & (turn <= STILL[1]))
    return near | ((times >= a) & (times <= b) & close)


def chosen(log: LaserLog, keep: np.ndarray, broken: list[Broken]) -> LaserLog:
    """The log with those of its n scans for which `keep` (n,) is true; `broken` says why the others are not."""
    at = np.flatnonzero(keep)
    fields: dict[str, Any] = {}
    for name in ("poses", "pose_covariance", "odometry", "times"):
        value = getattr(log, name)
        fields[name] = None if value is None else value[at]
    for name in ("angles", "ranges", "beam_times"):
        value = getattr(log, name)
        fields[name] = None if value is None else tuple(value[k] for k in at)
    way = None if log.way is None else log.way._replace(scans=log.way.scans[at])
    return replace(log, **fields, way=way, broken=(*log.broken, *broken))
