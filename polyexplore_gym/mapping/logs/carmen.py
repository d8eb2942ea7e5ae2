"""CARMEN logs: text, plain or gzip, one message a line; ranges and poses in m and rad.

    FLASER n r_1 .. r_n x y theta odom_x odom_y odom_theta [timestamp host logger_timestamp]
    ROBOTLASER1 LASER n r_1 .. r_n [m e_1 .. e_m] x y theta robot_x robot_y robot_theta tv rv forward side [turn_axis]
        [timestamp host logger_timestamp]
    RAWLASER1 LASER n r_1 .. r_n [m e_1 .. e_m] [timestamp host logger_timestamp]
    ODOM x y theta tv rv accel [timestamp host logger_timestamp]
    LASER = type start_angle field_of_view angular_resolution maximum_range accuracy remission_mode

x, y, theta is the pose of the laser, odom and robot that of the robot. If a log holds several kinds of scans, the first
of FLASER (which SLAM programs write), ROBOTLASER1 and RAWLASER1 is read. FLASER does not give the beams' angles (see
`read_log`); RAWLASER1 has no pose, which comes from the ODOM lines.
"""

from __future__ import annotations

import gzip
import math
import re
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import IO, Literal, NamedTuple

import numpy as np

from polyexplore_gym.errors import InvalidLogError
from polyexplore_gym.mapping.extract import LEAST_RANGE
from polyexplore_gym.mapping.logs.poses import between, compose
from polyexplore_gym.mapping.logs.record import FARTHEST, LEAST_BEAMS, MOST_BEAMS, WIDEST, Broken, LaserLog, Track, Way

MESSAGES = ("FLASER", "ROBOTLASER1", "RAWLASER1")
"""Messages with scans; the first that occurs in a log is read."""
MAX_LINE = 4 << 20
"""Longest line, bytes."""
TOO_LONG = f"longer than {MAX_LINE >> 20} MiB"
GIVE_UP = 10_000
"""So many broken lines before the first scan, and the file is no log."""
CODES = 80.0
"""SICK lasers write error codes as ranges of 81.83 m and more; their range ends at 80 m."""
SICK = 90, 180, 360, 720
"""Beams of lasers with a field of view of 180 degrees, one more or less."""
ROUNDING = 1e-6
"""Angular resolutions are written with six decimals, rad."""
MOUNTS = {"robot_frontlaser_offset": 0, "robot_frontlaser_side_offset": 1, "robot_frontlaser_angular_offset": 2}
"""Parameters of where the laser sits on the robot, and the component of the pose that each is."""
SAME = 0.02, math.radians(1.0)
"""Poses that differ by no more tell of one trajectory, m and rad."""
MOVED = 0.1, 0.1
"""A robot that went and turned less than that has not moved, m and rad."""
_NAME = re.compile(r"[A-Z][A-Z0-9_]*$")


class _LineError(ValueError):
    """Why a line is broken."""


class _Beams(NamedTuple):
    """How a scan is written and its beams lie."""

    message: str
    fields: int
    """Behind the ranges, but for remissions."""
    size: int
    start: float
    step: float
    max_range: float | None

    @property
    def angles(self) -> np.ndarray:
        return self.start + self.step * np.arange(self.size)


class _Scan(NamedTuple):
    line: int
    beams: _Beams
    ranges: np.ndarray
    """In the order of the file."""
    pose: np.ndarray
    """(6,) of the laser and of the robot; NaN where the message has none."""
    time: float
    """NaN where the message has none."""
    before: int
    """ODOM lines before it."""


@dataclass(slots=True)
class _Found:
    """What the lines of a log hold."""

    scans: list[_Scan] = field(default_factory=list)
    odom: list[tuple[float, float, float, float]] = field(default_factory=list)
    """Time (NaN: none), x, y, theta of the ODOM lines."""
    mount: dict[int, float] = field(default_factory=dict)
    rewritten: bool = False
    """By GMapping, which leaves NEFF lines."""
    broken: list[tuple[int, str]] = field(default_factory=list)
    lines: int = 0


def read_carmen(
    raw: IO[bytes], compressed: bool, field_of_view: float | None, watch: Callable[[int], object] | None
) -> LaserLog:
    """The log in an open file; see `polyexplore_gym.mapping.read_log`."""
    found = _scan_lines(raw, compressed, field_of_view, watch)
    if not found.scans:
        why = f"; line {found.broken[0][0]}: {found.broken[0][1]}" if found.broken else ""
        kinds = f"{', '.join(MESSAGES[:-1])} or {MESSAGES[-1]}"
        raise InvalidLogError(f"no usable {kinds} message in {found.lines} lines{why}")
    total = Counter(scan.beams.message for scan in found.scans)
    message = next(name for name in MESSAGES if total[name])
    kept = _alike([scan for scan in found.scans if scan.beams.message == message], found.broken)
    shared: dict[_Beams, np.ndarray] = {}
    angles, ranges = [], []
    for scan in kept:
        turn = slice(None, None, -1 if scan.beams.step < 0 else 1)
        angles.append(shared.setdefault(scan.beams, scan.beams.angles[turn]))
        ranges.append(np.where(scan.ranges >= LEAST_RANGE, scan.ranges, math.nan)[turn])
    limits = [scan.beams.max_range for scan in kept if scan.beams.max_range is not None]
    return LaserLog(
        angles=angles,
        ranges=ranges,
        **_poses(kept, found)._asdict(),
        max_range=max(limits) if limits else None,
        broken=tuple(Broken(f"line {line}", reason) for line, reason in sorted(found.broken)),
        unread={name: count for name, count in total.items() if name != message},
        read=message,
        notes=_notes(kept[0].beams, field_of_view),
    )


def _scan_lines(
    raw: IO[bytes], compressed: bool, field_of_view: float | None, watch: Callable[[int], object] | None
) -> _Found:
    found = _Found()
    for number, line in enumerate(_lines(gzip.GzipFile(fileobj=raw) if compressed else raw), start=1):
        found.lines = number
        if watch is not None and number % 64 == 0:
            watch(raw.tell())
        try:
            _parse(line, number, field_of_view, found)
        except _LineError as error:
            reason = str(error)
            found.broken.append((number, reason))
            if not found.scans and (len(found.broken) >= GIVE_UP or reason == TOO_LONG):
                break
    if watch is not None:
        watch(raw.tell())
    return found


def _lines(stream: IO[bytes] | gzip.GzipFile) -> Iterator[bytes | _LineError]:
    """The lines; an error for what cannot be read as a line. Damage in a compressed file ends them."""
    try:
        while line := stream.readline(MAX_LINE):
            yield line
            while len(line) == MAX_LINE and not line.endswith(b"\n"):  # the rest of a line without an end
                line = stream.readline(MAX_LINE)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        yield _LineError(f"the compressed file is damaged or cut off here ({error})")


def _parse(line: bytes | _LineError, number: int, field_of_view: float | None, found: _Found) -> None:
    """Add what a line holds to what was found."""
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
        return
    if fields[0] in MESSAGES:
        found.scans.append(_scan(fields, number, field_of_view, len(found.odom)))
    elif fields[0] == "ODOM":
        if len(fields) < 7:
            raise _LineError("truncated ODOM message")
        x, y, heading = _pose(_numbers(fields[1:4], "field")).tolist()
        found.odom.append((_time(fields[7:]), x, y, heading))
    elif fields[0] == "PARAM":
        if len(fields) > 2 and fields[1] in MOUNTS:
            found.mount[MOUNTS[fields[1]]] = float(_numbers(fields[2:3], f"{fields[1]}, field")[0])
    elif fields[0] == "NEFF":
        found.rewritten = True
    elif not _NAME.match(fields[0]):
        raise _LineError("not a CARMEN message")


def _scan(fields: list[str], number: int, field_of_view: float | None, before: int) -> _Scan:
    message = fields[0]
    at = 1 if message == "FLASER" else 8
    if len(fields) <= at:
        raise _LineError(f"truncated {message} message")
    try:
        count = int(fields[at])
    except ValueError:
        raise _LineError(f"the number of ranges is {fields[at][:20]!r}") from None
    if not LEAST_BEAMS <= count <= MOST_BEAMS:
        raise _LineError(f"{count} ranges; a scan has {LEAST_BEAMS} to {MOST_BEAMS}")
    rest = fields[at + 1 + count :]
    tail = _tail(message, rest)
    if tail is None:
        raise _LineError(f"{len(fields)} fields do not fit a {message} message of {count} ranges, truncated perhaps")
    ranges = _numbers(fields[at + 1 : at + 1 + count], "range")
    first, end = tail
    numbers, behind = _numbers(rest[first:end], "field behind the ranges,"), len(rest) - first
    pose = np.full(6, math.nan)
    if message != "RAWLASER1":
        pose[:3], pose[3:] = _pose(numbers[:3]), numbers[3:6]
    if message == "FLASER":
        beams = _flaser(behind, count, field_of_view)
    else:
        beams = _laser(message, behind, count, _numbers(fields[1:8], "field"))
    return _Scan(number, beams, ranges, pose, _time(rest[end:]), before)


def _tail(message: str, rest: list[str]) -> tuple[int, int] | None:
    """Where in the fields behind the ranges the numbers begin and end; None if they are too many or too few.

    With a range too many or too few the pose would be read from beside it.
    """
    n = len(rest)
    if message == "FLASER":
        return (0, 6) if n in (6, 9) else None
    remissions = int(rest[0]) if n and rest[0].isdecimal() and len(rest[0]) <= 6 else n
    if message == "RAWLASER1":  # older logs: no remissions
        if n in (0, 3) and n - 1 - remissions not in (0, 3):
            return 0, 0
        return (1 + remissions, 1 + remissions) if n - 1 - remissions in (0, 3) else None
    if n in (10, 13):  # older logs: no remissions, no turn_axis
        return 0, 10
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


def _pose(numbers: np.ndarray) -> np.ndarray:
    x, y, heading = numbers.tolist()
    if not (abs(heading) <= FARTHEST and abs(x) <= FARTHEST and abs(y) <= FARTHEST):
        raise _LineError(f"the pose is {x}, {y}, {heading}")
    return numbers


def _time(fields: list[str]) -> float:
    """The time stamp that a message ends with, NaN without one."""
    try:
        time = float(fields[0]) if len(fields) >= 3 else math.nan
    except ValueError:
        return math.nan
    return time if math.isfinite(time) and time > 0.0 else math.nan


def _flaser(behind: int, count: int, field_of_view: float | None) -> _Beams:
    if field_of_view is None:
        # 181 and 361 beams: both ends of 180 degrees; 180 and 360: the last beam is left out.
        start, step = -math.pi / 2, math.pi / (count - 1 if count % 2 else count)
    else:
        start, step = -field_of_view / 2, field_of_view / (count - 1)
    return _Beams("FLASER", behind, count, start, step, None)


def _notes(beams: _Beams, field_of_view: float | None) -> tuple[str, ...]:
    """What is guessed of the beams."""
    if beams.message != "FLASER" or field_of_view is not None or min(abs(beams.size - n) for n in SICK) <= 1:
        return ()
    return (f"FLASER does not say how its {beams.size} beams lie: a field of view of 180 degrees is assumed",)


def _laser(message: str, behind: int, count: int, settings: np.ndarray) -> _Beams:
    start, view, step, max_range = (float(value) for value in settings[1:5])
    exact = min((view / (count - 1), view / count), key=lambda exact: abs(exact - step))
    if abs(exact - step) <= ROUNDING:  # as it was before it was written with six decimals
        step = exact
    if not (abs(start) <= 2 * math.pi and 0 < abs(step) * (count - 1) <= WIDEST):
        raise _LineError(f"start angle {start} and angular resolution {step} do not fit {count} ranges")
    limit = min(max_range, CODES) if 0 < max_range < math.inf else None
    return _Beams(message, behind, count, start, step, limit)


def _alike(scans: list[_Scan], broken: list[tuple[int, str]]) -> list[_Scan]:
    """The scans that are written like most of them; the first of equals. The others are broken.

    With ranges too many or too few a line may still be some other message. The beams of FLASER scans lie alike, as
    the message does not say how; in the others they may vary.
    """

    def kind(scan: _Scan) -> tuple[int, int]:
        return scan.beams.fields, scan.beams.size if scan.beams.message == "FLASER" else 0

    usual = Counter(map(kind, scans)).most_common(1)[0][0]
    for scan in scans:
        if kind(scan) != usual:
            form = f"{scan.beams.size} beams, {scan.beams.fields} fields behind"
            broken.append((scan.line, f"unlike most scans of the log: {form}"))
    return [scan for scan in scans if kind(scan) == usual]


class _Poses(NamedTuple):
    """Fields of `LaserLog`."""

    poses: np.ndarray | None
    poses_are: Literal["corrected", "odometry", "unknown"]
    why: str
    odometry: np.ndarray | None
    track: Track | None
    way: Way | None
    times: np.ndarray | None
    mount: np.ndarray | None


def _poses(scans: list[_Scan], found: _Found) -> _Poses:
    """The poses of the scans, and whether a program corrected them or they are raw odometry."""
    message = scans[0].beams.message
    times = _times(np.array([scan.time for scan in scans]))
    odom = np.array(found.odom).reshape(-1, 4)
    mount = np.array([found.mount.get(k, 0.0) for k in range(3)])
    if message == "RAWLASER1":
        if not len(odom):
            why = "RAWLASER1 has no poses and the log no ODOM lines"
            return _Poses(None, "unknown", why, None, None, None, times, mount)
        poses = compose(_at_scans(odom, scans, times), mount)
        why = "RAWLASER1 has no poses: those of the ODOM lines"
        way = _way(odom, mount, scans, poses)
        return _Poses(poses, "odometry", why, poses, _track(odom, mount), way, times, mount)

    laser, robot = np.array([scan.pose[:3] for scan in scans]), np.array([scan.pose[3:] for scan in scans])
    of_robot = "odom_x odom_y odom_theta" if message == "FLASER" else "robot_x robot_y robot_theta"
    told = bool((np.abs(robot) <= FARTHEST).all()) and (_moves(robot) or not _moves(laser))
    if told:
        fixed = _constant(between(robot, laser))
        if fixed is None:
            odometry = compose(robot, mount)
            followed = bool(len(odom)) and _follow(robot, odom, scans, times)
            track = _track(odom, mount) if followed else None
            between_scans = _way(odom, mount, scans, odometry) if followed else None
            why = f"x y theta differ from {of_robot}"
            return _Poses(laser, "corrected", why, odometry, track, between_scans, times, mount)
        mount = fixed
    else:
        robot = compose(laser, between(mount, np.zeros(3)))
    same = f"x y theta go with {of_robot}" if told else f"{of_robot} do not move"
    if not len(odom):
        why = f"{same}, and there are no ODOM lines to tell by"
        return _Poses(laser, "unknown", why, laser if told else None, None, None, times, mount)
    if found.rewritten or _rewritten(robot, odom, scans):
        odometry, lines = _chained(robot, odom, scans, mount)
        track, way = _track(lines, mount), _way(lines, mount, scans, odometry)
        sign = "there are the NEFF lines of GMapping" if found.rewritten else "they jump between the ODOM lines"
        return _Poses(laser, "corrected", f"{same}, but {sign}", odometry, track, way, times, mount)
    if _follow(robot, odom, scans, times):
        way = _way(odom, mount, scans, laser)
        return _Poses(laser, "odometry", f"{same} and the ODOM lines", laser, _track(odom, mount), way, times, mount)
    odometry = compose(_at_scans(odom, scans, times), mount)
    track, way = _track(odom, mount), _way(odom, mount, scans, odometry)
    return _Poses(laser, "corrected", f"{same}, but not with the ODOM lines", odometry, track, way, times, mount)


def _times(stamps: np.ndarray) -> np.ndarray | None:
    """The time stamps, if all have one and they were not written with too few digits."""
    sound = np.isfinite(stamps).all() and 2 * np.unique(stamps).size > stamps.size
    return stamps if sound else None


def _moves(poses: np.ndarray) -> bool:
    """Whether the poses (n, 3) differ."""
    off = between(poses[0], poses)
    return bool((np.hypot(off[:, 0], off[:, 1]) > MOVED[0]).any() or (np.abs(off[:, 2]) > MOVED[1]).any())


def _constant(seen: np.ndarray) -> np.ndarray | None:
    """The pose (3,) that all but a tenth of the poses (n, 3) equal, if there is one."""
    middle = np.median(seen, axis=0)
    off = between(middle, seen)
    middle = compose(middle, np.median(off, axis=0))
    off = between(middle, seen)
    same = (np.hypot(off[:, 0], off[:, 1]) < SAME[0]) & (np.abs(off[:, 2]) < SAME[1])
    if same.mean() < 0.9:
        return None
    return np.where(np.abs(middle) < 1e-4, 0.0, middle)


def _track(odom: np.ndarray, mount: np.ndarray) -> Track | None:
    """The ODOM lines (m, 4) as poses of the laser, if they have times."""
    stamped = odom[np.isfinite(odom[:, 0])]
    if len(stamped) < 2 or _times(stamped[:, 0]) is None:
        return None
    return Track.sorted(stamped[:, 0], compose(stamped[:, 1:], mount))


def _way(odom: np.ndarray, mount: np.ndarray, scans: list[_Scan], at_scans: np.ndarray) -> Way:
    """The ODOM lines (m, 4) and the poses of the laser at the scans (n, 3), as they follow each other."""
    before = np.array([scan.before for scan in scans])
    stamps = np.insert(odom[:, 0], before, [scan.time for scan in scans])
    poses = np.insert(compose(odom[:, 1:], mount), before, at_scans, axis=0)
    return Way(stamps, poses, before + np.arange(len(scans)))


def _at_scans(odom: np.ndarray, scans: list[_Scan], times: np.ndarray | None) -> np.ndarray:
    """(n, 3) poses of the ODOM lines when the scans were taken: by time, or those of the line before each."""
    track = _track(odom, np.zeros(3))
    if times is not None and track is not None:
        return track.at(times)
    return odom[[max(scan.before - 1, 0) for scan in scans], 1:]


def _follow(robot: np.ndarray, odom: np.ndarray, scans: list[_Scan], times: np.ndarray | None) -> bool:
    """Whether the ODOM lines lead through the poses of the robot (n, 3)."""
    off = np.hypot(*(_at_scans(odom, scans, times) - robot)[:, :2].T)
    step = np.hypot(*np.diff(odom[:, 1:3], axis=0, prepend=odom[:1, 1:3]).T)
    near = [max(scan.before - 1, 0) for scan in scans], [min(scan.before, len(odom) - 1) for scan in scans]
    return bool((off <= SAME[0] + np.maximum(step[near[0]], step[near[1]])).mean() > 0.9)


def _rewritten(robot: np.ndarray, odom: np.ndarray, scans: list[_Scan]) -> bool:
    """Whether each scan has the pose of the ODOM line after it, but not of the line before: put there by a program."""
    inside = [k for k, scan in enumerate(scans) if 0 < scan.before < len(odom)]
    if not inside:
        return False
    at = np.array([scans[k].before for k in inside])
    before, after = (np.abs(odom[i, 1:] - robot[inside]).max(axis=1) < 1e-6 for i in (at - 1, at))
    return bool(after.mean() > 0.9 and before.mean() < 0.1)


def _chained(
    robot: np.ndarray, odom: np.ndarray, scans: list[_Scan], mount: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Raw odometry from a log in which it goes on from each corrected pose: at the scans (n, 3), ODOM lines (m, 4)."""
    lines = odom.copy()
    out = [robot[0]]
    for k in range(1, len(scans)):
        lo, hi = scans[k - 1].before, scans[k].before
        lines[lo:hi, 1:] = compose(out[-1], between(robot[k - 1], odom[lo:hi, 1:]))
        out.append(lines[hi - 1, 1:] if hi > lo else compose(out[-1], between(robot[k - 1], robot[k])))
    lo = scans[-1].before
    lines[lo:, 1:] = compose(out[-1], between(robot[-1], odom[lo:, 1:]))
    return compose(np.array(out), mount), lines
