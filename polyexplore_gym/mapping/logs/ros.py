"""ROS bags, by the package rosbags and without ROS.

Read are the scans of one topic (sensor_msgs/LaserScan, or the first echoes of MultiEchoLaserScan) and the transforms of
/tf and /tf_static from the scan's frame up to a frame whose name contains `odom` (odometry) and on to the root, mostly
`map` (corrected). Where /tf says nothing of the robot's way it comes from nav_msgs/Odometry.

In the messages inf means that nothing was met as far as `range_max`, and so does exactly `range_max`. NaN, and what
lies outside `range_min` and `range_max`, says nothing.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from polyexplore_gym.errors import InvalidLogError, MissingDependencyError
from polyexplore_gym.mapping.extract import LEAST_RANGE, increasing
from polyexplore_gym.mapping.logs.npz import LONGEST
from polyexplore_gym.mapping.logs.poses import compose
from polyexplore_gym.mapping.logs.record import LEAST_BEAMS, LONGEST_RANGE, MOST_BEAMS, WIDEST, Broken, LaserLog, Track
from polyexplore_gym.mapping.logs.tf import Frames
from polyexplore_gym.mapping.logs.trajectory import chosen, covered

BAG, MCAP, SQLITE = b"#ROSBAG", b"\x89MCAP", b"SQLite format 3"
"""How the files begin."""
SCANS = ("sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan")
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
ODOMETRY = "nav_msgs/msg/Odometry"
EQUAL = 1e-5
"""A range that equals range_max to such a part is range_max: they are 32 bit floats."""


def read_bag(path: Path, magic: bytes, topic: str | None, watch: Callable[[int], object] | None) -> LaserLog:
    """The log in a bag; see `polyexplore_gym.mapping.read_log`. magic: first bytes of a file, nothing for a folder."""
    try:
        import rosbags.highlevel  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError('ROS bags need rosbags: pip install "polyexplore-gym[logs]"') from error
    path = _storage(path, magic)
    found = _Found()
    with ExitStack() as stack:
        try:
            reader = _reader(path)
            stack.enter_context(reader)
            connections = list(reader.connections)
            total = reader.message_count
        except InvalidLogError:
            raise
        except Exception as error:  # damaged files make rosbags raise many kinds
            raise InvalidLogError(f"not a readable bag: {_reason(error)}{_remedy(path, error)}") from error
        found.topic, found.unread = _topic(connections, topic)
        wanted = [c for c in connections if c.topic == found.topic or c.msgtype in (*TRANSFORMS, ODOMETRY)]
        size = path.stat().st_size if path.is_file() else sum(f.stat().st_size for f in path.iterdir() if f.is_file())
        for done, message in enumerate(_messages(reader, wanted, found)):
            if watch is not None and done % 64 == 0:
                watch(int(size * min(done / max(total, 1), 1.0)))
            _add(*message, found)
        for name, count in _announced(wanted).items():
            if found.counts[name] < count:
                found.broken.append(Broken(name, f"{found.counts[name]} messages of {count} are there"))
    if watch is not None:
        watch(size)
    return _log(found)


def _storage(path: Path, magic: bytes) -> Path:
    """What rosbags opens: it goes by names."""
    if magic:
        suffix = ".bag" if magic.startswith(BAG) else ".mcap" if magic.startswith(MCAP) else ".db3"
        if suffix != ".bag" and path.suffix != suffix:
            raise InvalidLogError(f"is a ROS 2 bag of the kind {suffix}; its name has to end so")
        return path
    if (path / "metadata.yaml").exists():
        return path
    files = [file for file in sorted(path.iterdir()) if file.suffix in (".db3", ".mcap")]
    if not files:
        raise InvalidLogError("is a folder without a ROS 2 bag: no metadata.yaml, .db3 or .mcap in it")
    if len(files) > 1:
        raise InvalidLogError(f"is a folder of {len(files)} parts of a bag without metadata.yaml: ros2 bag reindex")
    return files[0]


def _reader(path: Path) -> Any:
    from rosbags import rosbag1, rosbag2

    with_magic = path.is_file() and path.open("rb").read(len(BAG)) == BAG
    return rosbag1.Reader(path) if with_magic else rosbag2.Reader(path)


def _reason(error: Exception) -> str:
    if isinstance(error, MemoryError):
        return "damaged: a length in it makes no sense"
    return str(error).strip().rstrip(".") or type(error).__name__


def _remedy(path: Path, error: Exception) -> str:
    """What may help with a bag whose recording was cut off."""
    if "index" in str(error):
        return f"; rosbag reindex {path.name} may help"
    return f"; mcap recover {path.name} may help" if "end magic" in str(error) else ""


def _announced(connections: list[Any]) -> Counter[str]:
    """How many messages the bag is said to hold, by topic."""
    counts: Counter[str] = Counter()
    for connection in connections:
        counts[connection.topic] += connection.msgcount or 0
    return counts


def _topic(connections: list[Any], topic: str | None) -> tuple[str, dict[str, int]]:
    """The topic of the scans to read, and the number of messages in the others."""
    counts = _announced([connection for connection in connections if connection.msgtype in SCANS])
    there = ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in connections})) or "none"
    if not counts:
        raise InvalidLogError(f"no topic of laser scans; the topics are: {there}")
    if topic is None:
        topic = min(counts, key=lambda name: (-counts[name], len(name), name))
    elif topic not in counts:
        raise InvalidLogError(f"topic {topic}: not one of laser scans; those are: {', '.join(sorted(counts))}")
    return topic, {name: count for name, count in counts.items() if name != topic}


class _Scan(NamedTuple):
    frame: str
    geometry: tuple[float, float, float, int]
    """angle_min, angle_increment (rad), time_increment (s), number of ranges."""
    ranges: np.ndarray
    """As in the message, but for what it does not mean."""
    stamp: float
    recorded: float
    where: str


@dataclass(slots=True)
class _Found:
    """What the messages of a bag hold."""

    topic: str = ""
    unread: dict[str, int] = field(default_factory=dict)
    scans: list[_Scan] = field(default_factory=list)
    frames: Frames = field(default_factory=Frames)
    odometry: dict[str, Frames] = field(default_factory=dict)
    """Transforms in nav_msgs/Odometry, by topic."""
    max_range: float | None = None
    outside: int = 0
    """Readings outside range_min and range_max."""
    broken: list[Broken] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    """Messages so far, by topic."""
    notes: dict[str, None] = field(default_factory=dict)


def _messages(reader: Any, wanted: list[Any], found: _Found) -> Iterator[tuple[str, float, Any]]:
    """Topic, time of recording (s) and message; what cannot be decoded is broken."""
    from rosbags.rosbag1 import Reader as Reader1

    first = isinstance(reader, Reader1)
    store = _typestore(first)
    for c in wanted:
        if first and c.digest and c.digest != store.generate_msgdef(c.msgtype)[1]:
            raise InvalidLogError(f"topic {c.topic}: its {c.msgtype} has another definition than that of ROS 1")
    decode = store.deserialize_ros1 if first else store.deserialize_cdr
    messages = iter(reader.messages(connections=wanted))
    while True:
        try:
            connection, time, raw = next(messages)
        except StopIteration:
            return
        except Exception as error:  # as above
            found.broken.append(Broken(f"after message {sum(found.counts.values())}", f"damaged: {_reason(error)}"))
            return
        found.counts[connection.topic] += 1
        where = f"{connection.topic}, message {found.counts[connection.topic]}"
        try:
            message = decode(raw, connection.msgtype)
        except Exception as error:  # as above
            found.broken.append(Broken(where, f"cannot be decoded: {_reason(error)}"))
            continue
        yield connection.topic, 1e-9 * time, message


@cache
def _typestore(first: bool) -> Any:
    """The message definitions of ROS 1 or ROS 2; those in a bag are not needed."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    for kind in TRANSFORMS:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    return store


def _add(topic: str, recorded: float, message: Any, found: _Found) -> None:
    """Add a message to what was found."""
    where = f"{topic}, message {found.counts[topic]}"
    kind = message.__msgtype__
    if kind in SCANS:
        reason = _add_scan(message, recorded, where, found)
    elif kind == ODOMETRY:
        frames = found.odometry.setdefault(topic, Frames())
        names = _name(message.header.frame_id) or "odom", _name(message.child_frame_id) or "base_link"
        value = _value(message.pose.pose.position, message.pose.pose.orientation)
        reason = frames.add(*names, _stamp(message.header.stamp) or recorded, value, False)
    else:
        reasons = [
            found.frames.add(
                _name(t.header.frame_id), _name(t.child_frame_id), _stamp(t.header.stamp) or recorded,
                _value(t.transform.translation, t.transform.rotation), topic.endswith("tf_static"),
            )
            for t in message.transforms
        ]  # fmt: skip
        reason = next(filter(None, reasons), "")
    if reason:
        found.broken.append(Broken(where, reason))


def _name(frame: str) -> str:
    return frame.strip("/")


def _stamp(stamp: Any) -> float:
    return stamp.sec + 1e-9 * stamp.nanosec


def _value(position: Any, rotation: Any) -> tuple[float, ...]:
    return position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w


def _add_scan(message: Any, recorded: float, where: str, found: _Found) -> str:
    """Add a scan; says what is wrong with it, or nothing."""
    if message.__msgtype__ == SCANS[1]:
        ranges = np.array([echo.echoes[0] if len(echo.echoes) else math.nan for echo in message.ranges], np.float64)
    else:
        with np.errstate(invalid="ignore"):  # NaN of all kinds
            ranges = np.asarray(message.ranges, np.float64)
    start, step, size = float(message.angle_min), float(message.angle_increment), ranges.size
    if not LEAST_BEAMS <= size <= MOST_BEAMS:
        return f"{size} ranges; a scan has {LEAST_BEAMS} to {MOST_BEAMS}"
    if not (abs(start) <= 4 * math.pi and 0 < abs(step) * (size - 1) <= WIDEST):
        return f"angle_min {start:g} and angle_increment {step:g} do not fit {size} ranges"
    if abs(start + step * (size - 1) - message.angle_max) > 2.5 * abs(step):
        found.notes["angle_max does not fit the other angles of the scans; it is left out of account"] = None
    pause = float(message.time_increment)
    if not 0.0 <= pause * size <= LONGEST:
        found.notes[f"time_increment {pause:g} s makes no sense: scans are taken as made at once"] = None
        pause = 0.0
    low, high = float(message.range_min), float(message.range_max)
    high = high if 0.0 < high <= LONGEST_RANGE else math.inf
    finite = np.isfinite(ranges)
    free = ranges >= (1.0 - EQUAL) * high
    unknown = ~(ranges >= max(low if math.isfinite(low) else 0.0, LEAST_RANGE))
    unknown |= finite & (ranges > (1.0 + EQUAL) * high)
    found.outside += int((unknown & finite & (ranges > LEAST_RANGE)).sum())
    if high < math.inf:
        found.max_range = max(high, found.max_range or 0.0)
    ranges = np.where(unknown, math.nan, np.where(free, math.inf, ranges))
    stamp = _stamp(message.header.stamp)
    found.scans.append(
        _Scan(_name(message.header.frame_id), (start, step, pause, size), ranges, stamp, recorded, where)
    )
    return ""


def _log(found: _Found) -> LaserLog:
    """The log made of what was found."""
    if not found.scans:
        why = f"; {found.broken[0]}" if found.broken else ""
        raise InvalidLogError(f"topic {found.topic}: no usable scan{why}")
    frame, _ = Counter(scan.frame for scan in found.scans).most_common(1)[0]
    for scan in found.scans:
        if scan.frame != frame:
            found.broken.append(Broken(scan.where, f"frame {scan.frame!r}, not {frame!r} as in most scans"))
    scans = [scan for scan in found.scans if scan.frame == frame]
    if found.outside and all(np.isnan(scan.ranges).all() for scan in scans):
        raise InvalidLogError(f"topic {found.topic}: all readings lie outside range_min and range_max")
    times = np.array([scan.stamp for scan in scans])
    if 2 * np.unique(times).size <= times.size and times.size > 1:
        found.notes["the scans have no time stamps: the times of recording are used"] = None
        times = np.array([scan.recorded for scan in scans])
    where = _where(found, frame, times)
    shared: dict[Any, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
    angles, ranges, beam_times = [], [], []
    for scan in scans:
        if scan.geometry not in shared:
            start, step, pause, size = scan.geometry
            order, turned = increasing((start + step * np.arange(size)) * (-1.0 if where.upside_down else 1.0))
            shared[scan.geometry] = turned, order, pause * order
        turned, order, after = shared[scan.geometry]
        angles.append(turned)
        ranges.append(scan.ranges[order])
        beam_times.append(after)
    log = LaserLog(
        angles=angles,
        ranges=ranges,
        poses=where.poses,
        max_range=found.max_range,
        poses_are=where.kind,
        why=where.why,
        odometry=where.odometry,
        track=where.track,
        times=times,
        beam_times=beam_times if any(scan.geometry[2] > 0 for scan in scans) else None,
        mount=where.mount,
        broken=tuple(found.broken),
        unread=found.unread,
        read=found.topic,
        notes=tuple(found.notes),
    )
    if where.known.all():
        return log
    if not where.known.any():
        raise InvalidLogError(
            f"topic {found.topic}: /tf has no pose of {frame} at the time of any scan, from {times.min():.3f} to "
            f"{times.max():.3f} s"
        )
    missing = [
        Broken(scan.where, f"/tf has no pose of {frame} at {time:.3f} s")
        for scan, time, known in zip(scans, times.tolist(), where.known, strict=True)
        if not known
    ]
    return chosen(log, where.known, missing)


@dataclass(slots=True)
class _Where:
    """Where the laser was; see `LaserLog`."""

    known: np.ndarray
    """(n,) whether a pose is told."""
    poses: np.ndarray | None = None
    kind: Any = "unknown"
    why: str = "the bag has neither /tf nor odometry"
    odometry: np.ndarray | None = None
    track: Track | None = None
    mount: np.ndarray | None = None
    upside_down: bool = False


def _where(found: _Found, frame: str, times: np.ndarray) -> _Where:
    """Where the laser was at these times (n,)."""
    frames = found.frames
    out = _Where(known=np.ones(times.size, bool))
    topic = _join_odometry(found, frame)
    chain = frames.above(frame)
    for name in chain:
        if frames.others[name]:
            found.notes[f"/tf gives {name} several parents: {frames.edges[name].parent} is used"] = None
    fixed = frames.lowest(chain)
    out.mount, out.upside_down = frames.pose(chain[: fixed + 1], np.zeros(1))
    out.mount = out.mount[0]
    if fixed + 1 == len(chain):
        if len(chain) > 1:
            out.why = f"the bag has no odometry, and /tf no frame in which {frame} moves"
        return out
    of_odometry = {f.edges[name].parent for f in found.odometry.values() for name in f.edges}
    odom = next((k for k in range(fixed + 1, len(chain)) if "odom" in chain[k].lower()), None)
    if odom is None:
        odom = next((k for k in range(fixed + 1, len(chain)) if chain[k] in of_odometry), None)
    out.known = frames.known(chain, times)
    out.poses, out.upside_down = frames.pose(chain, times)
    root = chain[-1]
    source = topic or "/tf"
    if odom is None:
        out.why = f"{source} gives {frame} in the frame {root}, which is not called odom"
        _beside(found, chain, times, out)
        return out
    below = chain[: odom + 1]
    out.odometry, _ = frames.pose(below, times)
    own = np.unique(np.concatenate([frames.edges[name].times for name in below[fixed:-1]]))
    own = own[frames.known(below, own)]
    out.track = Track(own, frames.pose(below, own)[0]) if own.size > 1 else None
    if any(frames.edges[name].moves() for name in chain[odom:-1]):
        out.kind, out.why = "corrected", f"/tf corrects the frame {chain[odom]} in {root}"
    else:
        out.kind, out.why = "odometry", f"{source} gives {frame} in {chain[odom]}, and nothing corrects it"
        out.poses = out.odometry
    return out


def _beside(found: _Found, chain: list[str], times: np.ndarray, out: _Where) -> None:
    """Add the odometry of nav_msgs/Odometry where /tf gives the robot's pose without it."""
    for topic in sorted(found.odometry, key=lambda name: (-found.counts[name], len(name), name)):
        for child, edge in found.odometry[topic].edges.items():
            track = edge.plane()
            if child in chain and track.times.size > 1 and covered(track, times[out.known]).all():
                at, _ = found.frames.pose(chain[: chain.index(child) + 1], np.zeros(1))
                out.odometry = compose(track.at(times), at[0])
                out.track = Track(track.times, compose(track.poses, at[0]))
                return


def _join_odometry(found: _Found, frame: str) -> str:
    """Take nav_msgs/Odometry for what /tf does not tell of the robot's way; returns the topic used."""
    frames = found.frames
    chain = frames.above(frame)
    if frames.lowest(chain) + 1 < len(chain) or not found.odometry:
        return ""
    topic = min(found.odometry, key=lambda name: (-found.counts[name], len(name), name))
    for child, edge in found.odometry[topic].edges.items():
        if child not in chain:
            if len(chain) > 1 or frame == "":
                found.notes[f"/tf does not say where {frame} is on {child}: {chain[-1]} is taken for {child}"] = None
            else:
                found.notes[f"the bag does not say where the laser {frame} is on {child}: taken as there itself"] = None
            frames.add(child, chain[-1], 0.0, (0, 0, 0, 0, 0, 0, 1), True)
        frames.edges[child] = edge
    return topic
