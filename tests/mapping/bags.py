"""Small bags for the tests, written with rosbags: a robot that drives through a room."""

import functools
import math
from pathlib import Path

import numpy as np
from line_scenes import box, cast

from polyexplore_gym.mapping.logs.poses import between, compose

ROOM = box(0.0, 0.0, 6.0, 4.0)
MOUNT = np.array([0.2, 0.05, 0.3])
"""Laser on the robot."""
BEAMS = 180
PAUSE = 5e-4
"""Time from beam to beam, s."""
START = 1_700_000_000.0
"""s"""


def robot(times):
    """(n, 3) poses of the robot in the map: a round in the middle of the room, 0.6 m/s."""
    turn = 0.6 * np.asarray(times)
    return np.stack([3.0 + np.cos(turn), 2.0 + np.sin(turn), turn + 0.5 * math.pi], axis=-1)


def drift(times):
    """(n, 3) the odometry frame in the map frame."""
    times = np.asarray(times)
    return np.stack([0.02 * times, -0.03 * times, 0.01 * times], axis=-1)


def odometry(times):
    """(n, 3) poses of the robot in the odometry frame."""
    return between(drift(times), robot(times))


def laser(times):
    """(n, 3) poses of the laser in the map."""
    return compose(robot(times), MOUNT)


@functools.cache
def typestore(first):
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    return store


class Bag:
    """Writes a bag of kind `bag`, `db3` or `mcap`; all times are s after START."""

    def __init__(self, path: Path, kind: str, compression: str = ""):
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2

        self.kind = kind
        self.path = path.with_suffix(".bag") if kind == "bag" else path
        self.store = typestore(kind == "bag")
        if kind == "bag":
            self.writer = Writer1(self.path)
        else:
            plugin = StoragePlugin.SQLITE3 if kind == "db3" else StoragePlugin.MCAP
            self.writer = Writer2(self.path, version=9, storage_plugin=plugin)
        if compression and kind == "bag":
            self.writer.set_compression(Writer1.CompressionFormat[compression])
        elif compression:
            self.writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
        self.connections = {}

    def __enter__(self):
        self.writer.open()
        return self

    def __exit__(self, *error):
        self.writer.close()

    def make(self, name, *values):
        return self.store.types[name](*values)

    def header(self, time, frame):
        ns = round((START + time) * 1e9)
        stamp = self.make("builtin_interfaces/msg/Time", ns // 10**9, ns % 10**9)
        if self.kind == "bag":
            return self.make("std_msgs/msg/Header", 0, stamp, frame)
        return self.make("std_msgs/msg/Header", stamp, frame)

    def write(self, topic, time, message):
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        encode = self.store.serialize_ros1 if self.kind == "bag" else self.store.serialize_cdr
        self.writer.write(self.connections[topic], round((START + time) * 1e9), encode(message, kind))

    def rotation(self, turn, upside_down=False):
        with np.errstate(invalid="ignore"):
            c, s = np.cos(0.5 * turn), np.sin(0.5 * turn)
        # heading after a roll of pi: the laser hangs upside down
        values = (c, s, 0.0, 0.0) if upside_down else (0.0, 0.0, s, c)
        return self.make("geometry_msgs/msg/Quaternion", *map(float, values))

    def transform(self, time, parent, child, pose, upside_down=False):
        x, y, turn = map(float, pose)
        offset = self.make("geometry_msgs/msg/Vector3", x, y, 0.1)
        transform = self.make("geometry_msgs/msg/Transform", offset, self.rotation(turn, upside_down))
        return self.make("geometry_msgs/msg/TransformStamped", self.header(time, parent), child, transform)

    def tf(self, time, *transforms, topic="/tf"):
        self.write(topic, time, self.make("tf2_msgs/msg/TFMessage", list(transforms)))

    def odometry(self, time, pose, topic="/odom", parent="odom", child="base_link"):
        zero = self.make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        point = self.make("geometry_msgs/msg/Point", float(pose[0]), float(pose[1]), 0.0)
        inner = self.make("geometry_msgs/msg/Pose", point, self.rotation(pose[2]))
        posed = self.make("geometry_msgs/msg/PoseWithCovariance", inner, np.zeros(36))
        twist = self.make("geometry_msgs/msg/Twist", zero, zero)
        twisted = self.make("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36))
        self.write(topic, time, self.make("nav_msgs/msg/Odometry", self.header(time, parent), child, posed, twisted))

    def scan(self, time, ranges, topic="/scan", frame="laser", start=-math.pi, step=2 * math.pi / BEAMS, pause=PAUSE,
             limits=(0.1, 12.0), stamp=None, end=None):  # fmt: skip
        ranges = np.asarray(ranges, np.float32)
        head = self.header(time if stamp is None else stamp, frame)
        end = start + step * (len(ranges) - 1) if end is None else end
        numbers = start, end, step, pause, pause * len(ranges), *limits
        scan = self.make("sensor_msgs/msg/LaserScan", head, *numbers, ranges, np.zeros(0, np.float32))
        self.write(topic, time, scan)


@functools.cache
def measured(time, pause=PAUSE, sign=1.0):
    """Ranges of a scan that begins at a time, each beam from where the laser is then; sign -1: upside down."""
    angles = sign * (-math.pi + 2 * math.pi / BEAMS * np.arange(BEAMS))
    poses = compose(robot(time + pause * np.arange(BEAMS)), MOUNT)
    return np.array([cast(ROOM, pose, np.array([a]), 20.0)[0] for pose, a in zip(poses, angles, strict=True)])


def drive(
    path,
    kind,
    *,
    scans=20,
    corrected=True,
    with_tf=True,
    with_odom=True,
    upside_down=False,
    pause=PAUSE,
    slash="",
    compression="",
):
    """A bag of the drive: scans at 5 Hz, odometry and tf at 50 Hz."""
    mount = MOUNT
    times = np.arange(0.0, scans / 5 + 0.3, 0.02)
    with Bag(path, kind, compression) as bag:
        if with_tf:
            bag.tf(
                0.0, bag.transform(0.0, f"{slash}base_link", f"{slash}laser", mount, upside_down), topic="/tf_static"
            )
        for k, time in enumerate(times):
            if with_odom:
                bag.odometry(time, odometry(time))
            if with_tf:
                moved = [bag.transform(time, f"{slash}odom", f"{slash}base_link", odometry(time))]
                if corrected:
                    moved.append(bag.transform(time, f"{slash}map", f"{slash}odom", drift(time)))
                bag.tf(time, *moved)
            if k % 10 == 0 and k // 10 < scans:
                ranges = measured(time, pause, -1.0 if upside_down else 1.0)
                bag.scan(time, ranges, pause=pause, frame=f"{slash}laser")
        return bag.path
