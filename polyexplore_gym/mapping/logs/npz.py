"""Logs as numpy archives, written with `numpy.savez`:

angles           (b,) beam angles in the laser's frame, rad; they may decrease, or jump from pi to -pi
ranges           (n, b) m; NaN or less than 1e-6: nothing is known; inf, or max_range and more: no return
poses            (n, 3) x, y (m), heading (rad) of the laser in the map frame, optional
max_range        m, optional
pose_covariance  (3, 3) or (n, 3, 3) m2, m rad, rad2, optional
odometry         (n, 3) pose of the laser by odometry alone, optional
times            (n,) s, of the poses, optional
time_increment   s from each beam to the next, in the order of `angles`, optional: the first is measured at `times`
"""

from __future__ import annotations

import math
from typing import IO

import numpy as np

from polyexplore_gym.errors import InvalidLogError
from polyexplore_gym.mapping.extract import LEAST_RANGE, increasing
from polyexplore_gym.mapping.logs.record import (
    FARTHEST,
    LEAST_BEAMS,
    LONGEST_RANGE,
    MOST_BEAMS,
    WIDEST,
    Broken,
    LaserLog,
)

KEYS = ("angles", "ranges", "poses", "max_range", "pose_covariance", "odometry", "times", "time_increment")
LARGEST = 1e6
"""A larger variance of a pose is none, m2 or rad2."""
LONGEST = 2.0
"""A scan that takes longer is not one, s."""


def read_npz(raw: IO[bytes]) -> LaserLog:
    """The log in an open file; see `polyexplore_gym.mapping.read_log`."""
    arrays = _arrays(raw)
    angles, ranges = arrays["angles"], arrays["ranges"]
    n, b = len(ranges) if ranges.ndim else 0, angles.size
    if angles.shape != (b,) or ranges.shape != (n, b):
        raise InvalidLogError(f"expected angles (b,) and ranges (n, b), got {angles.shape} and {ranges.shape}")
    if not LEAST_BEAMS <= b <= MOST_BEAMS:
        raise InvalidLogError(f"angles: {b} beams; a scan has {LEAST_BEAMS} to {MOST_BEAMS}")
    if not np.isfinite(angles).all():
        raise InvalidLogError(f"angles: the one of beam {int((~np.isfinite(angles)).argmax())} is not finite")
    order, turned = increasing(angles)
    step = np.diff(turned)
    if not (step > 0).all():
        raise InvalidLogError(f"angles: {turned[int((step <= 0).argmax())]:g} occurs twice")
    if np.ptp(turned) > WIDEST:
        raise InvalidLogError(f"angles: span {np.ptp(turned):g} rad, more than a full turn: are they degrees?")
    sound, broken = np.ones(n, bool), []
    for name in ("poses", "odometry"):
        if name in arrays:
            if arrays[name].shape != (n, 3):
                raise InvalidLogError(f"{name}: expected (n, 3) for {n} scans, got {arrays[name].shape}")
            bad = ~(np.abs(arrays[name]) <= FARTHEST).all(axis=1)
            what = "pose" if name == "poses" else name
            broken += [
                Broken(f"scan {k}", f"the {what} is {', '.join(map(str, arrays[name][k].tolist()))}")
                for k in np.flatnonzero(bad & sound).tolist()
            ]
            sound &= ~bad
    if not sound.any():
        raise InvalidLogError(f"no usable scan in the .npz{f'; {broken[0]}' if broken else ''}")
    known = np.where(ranges >= LEAST_RANGE, ranges, math.nan)[:, order][sound]
    poses, odometry = (arrays[name][sound] if name in arrays else None for name in ("poses", "odometry"))
    times, beam_times = _times(arrays, n, order)
    return LaserLog(
        angles=turned,
        ranges=known,
        poses=odometry if poses is None else poses,
        pose_covariance=_covariances(arrays["pose_covariance"], n)[sound] if "pose_covariance" in arrays else None,
        max_range=_max_range(arrays.get("max_range")),
        poses_are="odometry" if poses is None and odometry is not None else "unknown",
        why="poses of the .npz" if poses is not None else "the .npz has no poses",
        odometry=odometry,
        times=None if times is None else times[sound],
        beam_times=None if beam_times is None else (beam_times,) * int(sound.sum()),
        broken=tuple(sorted(broken, key=lambda part: int(part.where.split()[1]))),
        read=".npz",
    )


def _arrays(raw: IO[bytes]) -> dict[str, np.ndarray]:
    try:
        with np.load(raw, allow_pickle=False) as data:
            arrays = {key: np.asarray(data[key]) for key in KEYS if key in data}
    except Exception as error:  # zipfile, zlib and numpy's header parser raise many kinds on damaged files
        raise InvalidLogError(f"not a readable .npz: {error}") from error
    missing = [key for key in KEYS[:2] if key not in arrays]
    if missing:
        raise InvalidLogError(f"not a laser log: no array {' or '.join(map(repr, missing))} in the .npz")
    for key, array in arrays.items():
        if array.dtype.kind not in "fiu":
            raise InvalidLogError(f"{key}: expected real numbers, got {array.dtype}")
        arrays[key] = array.astype(np.float64)
    return arrays


def _times(arrays: dict[str, np.ndarray], n: int, order: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Times of the scans (n,), and of the beams (b,) after them in the order of increasing angles."""
    times = arrays.get("times")
    if times is not None and not (times.shape == (n,) and np.isfinite(times).all()):
        raise InvalidLogError(f"times: must be {n} finite numbers")
    increment = arrays.get("time_increment")
    if increment is None:
        return times, None
    if times is None:
        raise InvalidLogError("time_increment: needs times as well")
    if not (increment.size == 1 and abs(increment.item()) * order.size <= LONGEST):
        raise InvalidLogError(f"time_increment: must be one number, so that a scan takes at most {LONGEST:g} s")
    return times, increment.item() * order


def _covariances(given: np.ndarray, n: int) -> np.ndarray:
    if given.shape not in ((3, 3), (n, 3, 3)):
        raise InvalidLogError(f"pose_covariance: expected (3, 3) or ({n}, 3, 3), got {given.shape}")
    if not (np.abs(given) <= LARGEST).all():
        raise InvalidLogError(f"pose_covariance: must be finite, and {LARGEST:g} at most")
    symmetric = np.allclose(given, np.swapaxes(given, -1, -2))
    if not (symmetric and np.linalg.eigvalsh(given).min() >= -1e-9):
        raise InvalidLogError("pose_covariance: must be symmetric and not negative")
    return np.broadcast_to(given, (n, 3, 3))


def _max_range(given: np.ndarray | None) -> float | None:
    if given is None:
        return None
    if given.size != 1 or not 0 < given.item() <= LONGEST_RANGE:
        raise InvalidLogError(f"max_range: must be one number, positive and at most {LONGEST_RANGE:g} m")
    return given.item()
