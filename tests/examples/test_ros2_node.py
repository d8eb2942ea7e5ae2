"""The ROS 2 sketch explores a plan to the end, with stand-ins for the packages of ROS that it imports."""

from __future__ import annotations

import math
import re
import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import shapely

from polyexplore_gym.config import preset
from polyexplore_gym.exploration import shapes
from polyexplore_gym.floorplan import generate
from polyexplore_gym.sim.world import World

NODE = Path(__file__).resolve().parents[2] / "examples" / "10_ros2_node.py"
MOUNT = (-0.04, 0.0, 0.5 * math.pi)  # of the laser on a TurtleBot 4
TICK = 0.05  # m driven between two scans


def message() -> Any:
    """A message with the fields of a stamped pose or a path."""
    place = SimpleNamespace(position=SimpleNamespace(x=0.0, y=0.0), orientation=SimpleNamespace(z=0.0, w=1.0))
    return SimpleNamespace(header=SimpleNamespace(frame_id="", stamp=None), pose=place, poses=[])


class Future:
    """Done at once, or when `finish` is called."""

    def __init__(self, value: Any = None) -> None:
        self.value, self.calls = value, []

    def result(self) -> Any:
        return self.value

    def add_done_callback(self, call: Any) -> None:
        self.calls.append(call)
        if self.value is not None:
            call(self)

    def finish(self, value: Any) -> None:
        self.value = value
        for call in self.calls:
            call(self)


class Robot:
    """The simulator's world behind /tf, the scans and the controller; it drives at its tick's pace."""

    def __init__(self) -> None:
        self.config, self.plan, self.rng = preset("turtlebot4"), generate("home", 3), np.random.default_rng(0)
        start = self.plan.sample_start(self.rng, self.config.robot.radius)
        self.world = World(self.plan.segments, self.config.robot, self.config.sensor, self.config.drive, start)
        self.path: np.ndarray | None = None
        self.heading, self.done, self.paths, self.told = 0.0, Future(), 0, []

    # What the node calls.

    def lookup_transform(self, frame: str, other: str, stamp: float) -> Any:
        x, y, heading = {("map", "base_link"): self.world.pose, ("base_link", "laser"): MOUNT}[frame, other]
        turn = SimpleNamespace(z=math.sin(heading / 2), w=math.cos(heading / 2))
        return SimpleNamespace(transform=SimpleNamespace(translation=SimpleNamespace(x=x, y=y), rotation=turn))

    def send_goal_async(self, goal: Any) -> Future:
        assert goal.path.header.frame_id == "map"
        points = [point.pose for point in goal.path.poses]
        self.path = np.array([[p.position.x, p.position.y] for p in points])
        self.heading = 2.0 * math.atan2(points[-1].orientation.z, points[-1].orientation.w)
        old, self.done, self.paths = self.done, Future(), self.paths + 1
        old.finish(SimpleNamespace(status=6))  # aborted: the new goal takes its place
        return Future(SimpleNamespace(get_result_async=lambda: self.done))

    # What goes on meanwhile.

    def tick(self) -> None:
        if self.path is None:
            return
        self.path[0] = self.world.pose[:2]
        result = self.world.drive(self.path, self.heading, distance=TICK)
        self.path = np.concatenate((self.world.pose[None, :2], self.path[result.next_vertex :]))
        if result.ended != "cut":
            self.path = None
            self.done.finish(SimpleNamespace(status=4 if result.ended == "arrived" else 6))

    def scan(self) -> Any:
        pose, n = self.world.pose, self.config.sensor.beams
        c, s = math.cos(pose[2]), math.sin(pose[2])
        pose += (c * MOUNT[0] - s * MOUNT[1], s * MOUNT[0] + c * MOUNT[1], MOUNT[2])
        ranges = self.world.laser.measure(self.world.segments, pose, self.rng)
        ranges = np.roll(ranges, n // 2).astype(np.float32)  # this driver begins at 0
        header = SimpleNamespace(frame_id="laser", stamp=0.0)
        return SimpleNamespace(
            header=header, angle_min=0.0, angle_increment=2 * math.pi / n, ranges=ranges.tolist(), range_min=0.15
        )


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch) -> Robot:
    robot = Robot()
    log = SimpleNamespace(info=robot.told.append)
    node = type("Node", (), {
        "__init__": lambda self, name: None, "get_logger": lambda self: log,
        "create_subscription": lambda self, kind, topic, call, depth: setattr(robot, "listener", (topic, call)),
    })  # fmt: skip
    modules: dict[str, dict[str, Any]] = {
        "rclpy": {}, "rclpy.node": {"Node": node}, "rclpy.action": {"ActionClient": lambda node, kind, name: robot},
        "geometry_msgs": {}, "geometry_msgs.msg": {"PoseStamped": message}, "nav_msgs": {},
        "nav_msgs.msg": {"Path": message}, "sensor_msgs": {}, "sensor_msgs.msg": {"LaserScan": object},
        "nav2_msgs": {}, "nav2_msgs.action": {"FollowPath": SimpleNamespace(Goal=SimpleNamespace)},
        "tf2_ros": {"Buffer": lambda: robot, "TransformListener": lambda buffer, node: None},
    }  # fmt: skip
    for name, content in modules.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    return robot


def test_it_explores_to_the_end(robot):
    content = runpy.run_path(str(NODE), run_name="node")
    node = content["ExploreNode"]()
    topic, on_scan = robot.listener
    assert topic == "scan"
    for _ in range(20_000):
        on_scan(robot.scan())
        robot.tick()
        if robot.told:
            break
    assert re.match("done: {'status': '(complete|unreached)'", robot.told[0])
    assert node.explorer.scans > 10
    assert robot.paths > 10
    assert node.explorer.done
    seen = shapes.exploration_polygon(node.explorer.exploration).buffer(0.05)
    floor = shapely.Polygon(robot.plan.exterior, robot.plan.holes)
    assert seen.intersection(floor).area > 0.98 * floor.area
    assert seen.difference(floor.buffer(0.2)).area < 0.01 * floor.area
