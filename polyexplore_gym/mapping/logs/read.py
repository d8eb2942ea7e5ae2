"""`read_log`: a laser log, of whatever format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from polyexplore_gym.errors import InvalidLogError
from polyexplore_gym.mapping.logs.carmen import read_carmen
from polyexplore_gym.mapping.logs.npz import read_npz
from polyexplore_gym.mapping.logs.record import FARTHEST, LaserLog
from polyexplore_gym.mapping.logs.ros import BAG, MCAP, SQLITE, read_bag
from polyexplore_gym.mapping.logs.trajectory import read_trajectory, with_trajectory

NOT_METRES = 100.0
"""Half of the returns farther than that, and ranges are not in metres, m."""


def read_log(
    path: str | Path,
    *,
    topic: str | None = None,
    trajectory: str | Path | None = None,
    field_of_view: float | None = None,
    watch: Callable[[int], object] | None = None,
) -> LaserLog:
    """Read a laser log. Lines and scans that are broken are left out and named in `LaserLog.broken`.

    Args:
        path: ROS 1 bag, ROS 2 bag (a folder with metadata.yaml, or a .db3 or .mcap file), CARMEN log or .npz, told
            apart by content; see `polyexplore_gym.mapping.logs` for what is read from each.
        topic: of the scans in a bag. None: the one with the most scans.
        trajectory: file of poses of the laser in the TUM format, which replace those of the log.
        field_of_view: angle between the first and the last beam of FLASER messages, rad. None: that of a SICK
            laser, 180 degrees for an odd number of beams, one step less for an even number.
        watch: called with the number of bytes read so far, now and then.

    Raises:
        InvalidLogError: the file cannot be read, is no such log, holds no usable scan, or readings make no sense.
        MissingDependencyError: a bag, and rosbags is not installed.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> from polyexplore_gym.mapping import read_log
        >>> path = tempfile.mkdtemp() + "/scans.npz"
        >>> np.savez(path, angles=[-0.1, 0.0, 0.1], ranges=[[2.0, np.inf, 0.0]], poses=[[1.0, 0.0, 0.0]])
        >>> read_log(path).ranges[0]
        array([ 2., inf, nan])
    """
    path = Path(path)
    poses = None if trajectory is None else read_trajectory(trajectory)
    try:
        log = _read(path, topic, field_of_view, watch)
        if poses is not None:
            log = with_trajectory(log, poses, str(trajectory))
        check_readings(log)
    except InvalidLogError as error:
        raise InvalidLogError(f"{path}: {error}") from error.__cause__
    except OSError as error:
        raise InvalidLogError(f"{path}: cannot be read: {error.strerror or error}") from error
    return log


def _read(
    path: Path, topic: str | None, field_of_view: float | None, watch: Callable[[int], object] | None
) -> LaserLog:
    if not path.exists():
        raise InvalidLogError("does not exist")
    if path.is_dir():
        return read_bag(path, b"", topic, watch)
    if not path.is_file():
        raise InvalidLogError("is not a regular file")
    with path.open("rb") as raw:
        magic = raw.read(16)
        raw.seek(0)
        if not magic:
            raise InvalidLogError("is empty")
        if magic.startswith((BAG, MCAP, SQLITE)):
            return read_bag(path, magic, topic, watch)
        if topic is not None:
            raise InvalidLogError(f"has no topic {topic}: it is no bag")
        if magic[:2] == b"PK":
            return read_npz(raw)
        return read_carmen(raw, magic[:2] == b"\x1f\x8b", field_of_view, watch)


def check_readings(log: LaserLog) -> None:
    """InvalidLogError for ranges that cannot be those of a laser, in metres."""
    readings = np.concatenate(log.ranges)
    if np.isnan(readings).all():
        raise InvalidLogError(f"{log.read}: no reading in {len(log)} scans: all ranges are zero, negative or NaN")
    finite = np.minimum(readings[np.isfinite(readings)], FARTHEST)
    if not finite.size:
        return
    limit = np.inf if log.max_range is None else log.max_range
    returns = finite[(finite < limit) & (finite < finite.max())]  # the largest may be a code for no return
    returns = returns if returns.size else finite
    middle = float(np.median(returns))
    if middle > NOT_METRES:
        raise InvalidLogError(
            f"{log.read}: the median range is {middle:g}: ranges must be in metres, these look like "
            f"{'millimetres' if middle > 10 * NOT_METRES else 'centimetres or millimetres'}"
        )
