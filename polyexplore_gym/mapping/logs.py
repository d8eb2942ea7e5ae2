"""Laser logs on disk: CARMEN text, plain or gzip, and a plain .npz. `read_log` tells them apart by content.

CARMEN (the formats as in the head of every CARMEN log, one message a line; ranges and poses in m and rad):

    FLASER n r_1 .. r_n x y theta odom_x odom_y odom_theta [timestamp host logger_timestamp]
    ROBOTLASER1 type start_angle field_of_view angular_resolution maximum_range accuracy remission_mode n r_1 .. r_n
        [m e_1 .. e_m] x y theta robot_x robot_y robot_theta tv rv forward side [turn_axis]
        [timestamp host logger_timestamp]

x, y, theta is the pose of the laser, corrected where a SLAM program wrote the log. If a log holds both kinds, FLASER is
read: it is what such programs write. FLASER does not give the beams' angles (see `read_log`).

The .npz, written with `numpy.savez`:

    angles           (b,) beam angles in the laser's frame, rad, increasing
    ranges           (n, b) m; less than 1e-6, inf, or max_range and more: no return
    poses            (n, 3) x, y (m), heading (rad) of the laser in the map frame
    max_range        m, optional
    pose_covariance  (3, 3) or (n, 3, 3) m2, m rad, rad2, optional
"""

from __future__ import annotations

import gzip
import math
import re
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Literal, NamedTuple

import numpy as np

from polyexplore_gym.errors import InvalidLogError
from polyexplore_gym.mapping.extract import LEAST_RANGE

MESSAGES = ("FLASER", "ROBOTLASER1")
"""CARMEN messages that are read; the first that occurs in a log."""
MAX_LINE = 4 << 20
"""Longest line of a CARMEN log, bytes."""
TOO_LONG = f"longer than {MAX_LINE >> 20} MiB"
GIVE_UP = 10_000
"""So many broken lines before the first scan, and the file is no log."""
BEAMS = (3, 100_000)
"""Fewest and most beams of a scan."""
CODES = 80.0
"""SICK lasers write error codes as ranges of 81.83 m and more; their range ends at 80 m."""
FARTHEST = 1e8
"""A pose farther from the origin is garbage, m."""
_NAME = re.compile(r"[A-Z][A-Z0-9_]*$")


class Broken(NamedTuple):
    """A part of a log that could not be used."""

    where: str
    reason: str

    def __str__(self) -> str:
        return f"{self.where}: {self.reason}"


class Track(NamedTuple):
    """Poses over time, denser than the scans."""

    times: np.ndarray
    """(m,) s, increasing strictly."""
    poses: np.ndarray
    """(m, 3) x, y (m) and heading (rad) of the laser in the odometry frame."""


@dataclass(frozen=True, slots=True)
class LaserLog:
    """The scans of a log: n scans, the k-th of b_k beams. All poses are those of the laser, mounting applied."""

    angles: Sequence[np.ndarray] | np.ndarray
    """n arrays (b_k,) of beam angles in the laser's frame, rad, strictly increasing. Scans whose beams are alike share
    one array; a single array (b,) stands for all scans."""
    ranges: Sequence[np.ndarray] | np.ndarray
    """n arrays (b_k,), m; an array (n, b) does as well. inf: nothing within the maximum range, free as far as that.
    NaN: nothing is known about that beam."""
    poses: np.ndarray | None
    """(n, 3) x, y (m) and heading (rad) in the map frame as the log gives them; `poses_are` says what they are."""
    pose_covariance: np.ndarray | None = None
    """(n, 3, 3) covariance of the poses, m2, m rad, rad2, if the log gives it."""
    max_range: float | None = None
    """Range from which on a beam has no return, m, if the log gives it."""
    poses_are: Literal["corrected", "odometry", "unknown"] = "unknown"
    """corrected by a SLAM program or a localiser; raw odometry, then equal to `odometry`; or the log does not say."""
    why: str = ""
    """How that is known: one sentence for the user."""
    odometry: np.ndarray | None = None
    """(n, 3) pose by odometry alone when the scan was taken, in the odometry frame, if the log gives it."""
    track: Track | None = None
    """Odometry between the scans, if the log gives it with times."""
    times: np.ndarray | None = None
    """(n,) when the pose of each scan holds, s, not always increasing, if the log gives it."""
    beam_times: Sequence[np.ndarray] | None = None
    """n arrays (b_k,): when each beam was measured, s after `times`; None where a scan is taken at once."""
    mount: np.ndarray | None = None
    """(3,) x, y (m) and heading (rad) of the laser on the robot, if the log gives it. Applied already."""
    broken: tuple[Broken, ...] = ()
    """What was left out, in the order of the file."""
    unread: dict[str, int] = field(default_factory=dict)
    """Scans in messages of another kind than the one read, by message or topic."""

    def __post_init__(self) -> None:
        n = len(self.ranges)
        if isinstance(self.angles, np.ndarray) and self.angles.ndim == 1:
            object.__setattr__(self, "angles", (self.angles,) * n)
        for name in ("angles", "ranges", "beam_times"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, tuple(value))

    def __len__(self) -> int:
        """Number of scans."""
        return len(self.ranges)


def read_log(
    path: str | Path, *, field_of_view: float | None = None, watch: Callable[[int], object] | None = None
) -> LaserLog:
    """Read a laser log. Lines and scans that are broken are left out and named in `LaserLog.broken`.

    Args:
        path: CARMEN log or .npz (see the module).
        field_of_view: angle between the first and the last beam of FLASER messages, rad. None: that of a SICK
            laser, 180 degrees for an odd number of beams, one step less for an even number.
        watch: called with the number of bytes read so far, now and then.

    Raises:
        InvalidLogError: the file cannot be read, is no such log, or holds no usable scan.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> from polyexplore_gym.mapping import read_log
        >>> path = tempfile.mkdtemp() + "/scans.npz"
        >>> np.savez(path, angles=[-0.1, 0.0, 0.1], ranges=[[2.0, 2.0, 0.0]], poses=[[1.0, 0.0, 0.0]])
        >>> read_log(path).ranges[0]
        array([ 2.,  2., inf])
    """
    path = Path(path)
    try:
        if not path.exists():
            raise InvalidLogError("does not exist")
        if path.is_dir():
            raise InvalidLogError("is a folder, not a log")
        if not path.is_file():
            raise InvalidLogError("is not a regular file")
        with path.open("rb") as raw:
            magic = raw.read(4)
            raw.seek(0)
            if not magic:
                raise InvalidLogError("is empty")
            if magic[:2] == b"PK":
                return _read_npz(raw)
            return _read_carmen(raw, magic[:2] == b"\x1f\x8b", field_of_view, watch)
    except InvalidLogError as error:
        raise InvalidLogError(f"{path}: {error}") from error.__cause__
    except OSError as error:
        raise InvalidLogError(f"{path}: cannot be read: {error.strerror or error}") from error


class _Beams(NamedTuple):
    """How a scan is written and its beams lie; the scans of one log share it."""

    message: str
    fields: int
    """Behind the ranges, but for remissions."""
    size: int
    start: float
    step: float
    max_range: float | None


class _Scan(NamedTuple):
    line: int
    ranges: np.ndarray
    pose: tuple[float, ...]


def _read_carmen(
    raw: IO[bytes], compressed: bool, field_of_view: float | None, watch: Callable[[int], object] | None
) -> LaserLog:
    scans: dict[_Beams, list[_Scan]] = {}
    broken: list[tuple[int, str]] = []
    number = 0
    for number, line in enumerate(_lines(gzip.GzipFile(fileobj=raw) if compressed else raw), start=1):
        if watch is not None and number % 64 == 0:
            watch(raw.tell())
        try:
            found = _parse(line, field_of_view)
        except _LineError as error:
            reason = str(error)
            broken.append((number, reason))
            if not scans and (len(broken) >= GIVE_UP or reason == TOO_LONG):
                break
            continue
        if found is not None:
            beams, ranges, pose = found
            scans.setdefault(beams, []).append(_Scan(number, ranges, pose))
    if watch is not None:
        watch(raw.tell())
    if not scans:
        why = f"; line {broken[0][0]}: {broken[0][1]}" if broken else ""
        raise InvalidLogError(f"no usable {' or '.join(MESSAGES)} message in {number} lines{why}")

    total: Counter[str] = Counter()
    for beams, some in scans.items():
        total[beams.message] += len(some)
    message = next(name for name in MESSAGES if total[name])
    # Most scans decide; the first of equals. With ranges too many or too few a line may still be some other message.
    beams = max((b for b in scans if b.message == message), key=lambda b: len(scans[b]))
    kept = scans[beams]
    for other, some in scans.items():
        if other.message == message and other != beams:
            form = f"{other.size} beams from {math.degrees(other.start):.2f} degrees on, {other.fields} fields behind"
            reason = f"unlike most scans of the log: {form}"
            broken += [(scan.line, reason) for scan in some]
    return LaserLog(
        angles=beams.start + beams.step * np.arange(beams.size),
        ranges=np.array([scan.ranges for scan in kept]),
        poses=np.array([scan.pose for scan in kept]),
        max_range=beams.max_range,
        broken=tuple(Broken(f"line {line}", reason) for line, reason in sorted(broken)),
        unread={name: count for name, count in total.items() if name != message},
    )


class _LineError(ValueError):
    """Why a line is broken."""


def _lines(stream: IO[bytes] | gzip.GzipFile) -> Iterator[bytes | _LineError]:
    """The lines; an error for what cannot be read as a line. Damage in a compressed file ends them."""
    try:
        while line := stream.readline(MAX_LINE):
            yield line
            while len(line) == MAX_LINE and not line.endswith(b"\n"):  # the rest of a line without an end
                line = stream.readline(MAX_LINE)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        yield _LineError(f"the compressed file is damaged or cut off here ({error})")


def _parse(
    line: bytes | _LineError, field_of_view: float | None
) -> tuple[_Beams, np.ndarray, tuple[float, ...]] | None:
    """The scan in a line, None for a line that holds another message or none."""
    if isinstance(line, _LineError):
        raise line
    if len(line) == MAX_LINE:
        raise _LineError(TOO_LONG)
    try:
        text = line.decode("utf-8")
    except UnicodeDecodeError:
        raise _LineError("not text") from None
    fields = text.split()
    if not fields or fields[0].startswith("#"):
        return None
    if fields[0] not in MESSAGES:
        if _NAME.match(fields[0]):
            return None
        raise _LineError("not a CARMEN message")
    at = 1 if fields[0] == "FLASER" else 8
    if len(fields) <= at:
        raise _LineError(f"truncated {fields[0]} message")
    try:
        count = int(fields[at])
    except ValueError:
        raise _LineError(f"the number of ranges is {fields[at][:20]!r}") from None
    if not BEAMS[0] <= count <= BEAMS[1]:
        raise _LineError(f"{count} ranges; a scan has {BEAMS[0]} to {BEAMS[1]}")
    rest = fields[at + 1 + count :]
    tail = _tail(fields[0], rest)
    if tail is None:
        raise _LineError(f"{len(fields)} fields do not fit a {fields[0]} message of {count} ranges, truncated perhaps")
    ranges = _numbers(fields[at + 1 : at + 1 + count], "range")
    if np.isnan(ranges).any():
        raise _LineError(f"range {int(np.isnan(ranges).argmax()) + 1} is NaN")
    numbers, behind = _numbers(rest[slice(*tail)], "field behind the ranges,"), len(rest) - tail[0]
    x, y, heading = numbers[:3].tolist()
    if not (math.isfinite(heading) and abs(x) <= FARTHEST and abs(y) <= FARTHEST):
        raise _LineError(f"the pose is {x}, {y}, {heading}")
    if at == 1:
        beams = _flaser(behind, count, field_of_view)
    else:
        beams = _robotlaser(behind, count, _numbers(fields[1:8], "field"))
    return beams, np.where(ranges >= LEAST_RANGE, ranges, np.inf), (x, y, heading)


def _tail(message: str, rest: list[str]) -> tuple[int, int] | None:
    """Where in the fields behind the ranges the numbers lie that begin with the pose; None if they are too many or few.

    With a range too many or too few the pose would be read from beside it.
    """
    n = len(rest)
    if message == "FLASER":
        return (0, 6) if n in (6, 9) else None
    if n in (10, 13):  # older logs: no remissions, no turn_axis
        return 0, 10
    remissions = int(rest[0]) if n and rest[0].isdecimal() and len(rest[0]) <= 6 else n
    return (1 + remissions, 12 + remissions) if n - 1 - remissions in (11, 14) else None


def _numbers(fields: list[str], what: str) -> np.ndarray:
    try:
        return np.array([float(value) for value in fields])
    except ValueError:
        for k, value in enumerate(fields):
            try:
                float(value)
            except ValueError:
                raise _LineError(f"{what} {k + 1} is {value[:20]!r}, not a number") from None
        raise


def _flaser(behind: int, count: int, field_of_view: float | None) -> _Beams:
    if field_of_view is None:
        # 181 and 361 beams: both ends of 180 degrees; 180 and 360: the last beam is left out.
        start, step = -math.pi / 2, math.pi / (count - 1 if count % 2 else count)
    else:
        start, step = -field_of_view / 2, field_of_view / (count - 1)
    return _Beams("FLASER", behind, count, start, step, None)


def _robotlaser(behind: int, count: int, settings: np.ndarray) -> _Beams:
    start, step, max_range = (float(value) for value in settings[[1, 3, 4]])
    if not (abs(start) <= 2 * math.pi and 0 < step <= (2 * math.pi + 1e-6) / (count - 1)):
        raise _LineError(f"start angle {start} and angular resolution {step} do not fit {count} ranges")
    return _Beams("ROBOTLASER1", behind, count, start, step, min(max_range, CODES) if max_range > 0 else None)


def _read_npz(raw: IO[bytes]) -> LaserLog:
    keys = ("angles", "ranges", "poses", "max_range", "pose_covariance")
    try:
        with np.load(raw, allow_pickle=False) as data:
            arrays = {key: np.asarray(data[key]) for key in keys if key in data}
    except Exception as error:  # zipfile, zlib and numpy's header parser raise many kinds on damaged files
        raise InvalidLogError(f"not a readable .npz: {error}") from error
    missing = [key for key in keys[:3] if key not in arrays]
    if missing:
        raise InvalidLogError(f"not a laser log: no array {' or '.join(map(repr, missing))} in the .npz")
    for key, array in arrays.items():
        if array.dtype.kind not in "fiu":
            raise InvalidLogError(f"{key}: expected real numbers, got {array.dtype}")
        arrays[key] = array.astype(np.float64)
    angles, ranges, poses = (arrays[key] for key in keys[:3])
    n, b = len(ranges) if ranges.ndim else 0, angles.size
    if angles.shape != (b,) or ranges.shape != (n, b) or poses.shape != (n, 3):
        shapes = ", ".join(f"{key} {arrays[key].shape}" for key in keys[:3])
        raise InvalidLogError(f"expected angles (b,), ranges (n, b) and poses (n, 3), got {shapes}")
    if not BEAMS[0] <= b <= BEAMS[1]:
        raise InvalidLogError(f"{b} beams; a scan has {BEAMS[0]} to {BEAMS[1]}")
    if not (np.isfinite(angles).all() and (np.diff(angles) > 0).all() and np.ptp(angles) <= 2 * math.pi + 1e-6):
        raise InvalidLogError("angles: must be finite, increase strictly and span 2 pi at most")
    bad_range = np.isnan(ranges).any(axis=1)
    bad_pose = ~(np.isfinite(poses).all(axis=1) & (np.abs(poses[:, :2]) <= FARTHEST).all(axis=1))
    bad = bad_range | bad_pose
    broken = tuple(
        Broken(f"scan {k}", "a range is NaN" if bad_range[k] else f"the pose is {', '.join(map(str, poses[k]))}")
        for k in np.flatnonzero(bad).tolist()
    )
    if bad.all():
        raise InvalidLogError(f"no usable scan in the .npz{f'; {broken[0]}' if broken else ''}")
    covariance = arrays.get("pose_covariance")
    return LaserLog(
        angles=angles,
        ranges=np.where(ranges >= LEAST_RANGE, ranges, np.inf)[~bad],
        poses=poses[~bad],
        pose_covariance=None if covariance is None else _covariances(covariance, n)[~bad],
        max_range=_max_range(arrays.get("max_range")),
        broken=broken,
    )


def _covariances(given: np.ndarray, n: int) -> np.ndarray:
    if given.shape not in ((3, 3), (n, 3, 3)):
        raise InvalidLogError(f"pose_covariance: expected (3, 3) or ({n}, 3, 3), got {given.shape}")
    symmetric = np.allclose(given, np.swapaxes(given, -1, -2))
    if not (np.isfinite(given).all() and symmetric and np.linalg.eigvalsh(given).min() >= -1e-9):
        raise InvalidLogError("pose_covariance: must be finite, symmetric and not negative")
    return np.broadcast_to(given, (n, 3, 3))


def _max_range(given: np.ndarray | None) -> float | None:
    if given is None:
        return None
    if given.size != 1 or not (math.isfinite(given.item()) and given.item() > 0):
        raise InvalidLogError("max_range: must be one positive number")
    return given.item()
