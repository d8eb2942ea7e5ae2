"""ROS 2 glue, a sketch: laser scans and /tf in, paths for Nav2's controller out. Needs ROS 2 with Nav2.

    python examples/10_ros2_node.py

Poses come from a localiser or SLAM program by /tf; the laser sees all round. Check `CONFIG` against your robot first.
"""

import math

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from nav2_msgs.action import FollowPath
from nav_msgs.msg import Path
from rclpy.action import ActionClient
from rclpy.node import Node
from sensor_msgs.msg import LaserScan
from tf2_ros import Buffer, TransformListener

from baselines import make_policy
from polyexplore_gym.explorer import Explorer
from polyexplore_gym.scan import on_beams

CONFIG = {"preset": "turtlebot4", "exploration": {"scan_every": 0.5, "decide": "settled"}, "pose": {"mode": "gaussian"}}
COVARIANCE = np.diag([0.02, 0.02, math.radians(0.5)]) ** 2


class ExploreNode(Node):
    def __init__(self):
        super().__init__("explore")
        self.explorer, self.policy, self.rng = None, make_policy("nearest"), np.random.default_rng(0)
        self.tf = Buffer()
        self.listener = TransformListener(self.tf, self)
        self.controller = ActionClient(self, FollowPath, "follow_path")
        self.leg, self.goals, self.ended, self.pose, self.driven = None, 0, None, None, 0.0
        self.create_subscription(LaserScan, "scan", self.on_scan, 10)

    def where(self, frame, other, stamp):
        at = self.tf.lookup_transform(frame, other, stamp).transform
        return np.array([at.translation.x, at.translation.y, 2.0 * math.atan2(at.rotation.z, at.rotation.w)])

    def on_scan(self, scan):
        angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
        if self.explorer is None:
            self.explorer = Explorer(CONFIG, mount=self.where("base_link", scan.header.frame_id, scan.header.stamp))
        pose = self.where("map", "base_link", scan.header.stamp)
        readings = np.where(np.array(scan.ranges) < scan.range_min, math.nan, scan.ranges)  # too near: unknown
        look = self.explorer.look(on_beams(angles, readings, self.explorer.config.sensor), pose, COVARIANCE)
        if self.leg is None:
            self.explorer.insert(look)
            self.explorer.plan()
            return self.drive(None)
        self.driven, self.pose = self.driven + math.dist(pose[:2], self.pose[:2]), pose
        if self.ended is None:
            return self.drive(self.explorer.passing(look)) if self.driven >= self.leg.distance else None
        if self.ended != "arrived":
            self.explorer.stopped(self.ended, pose)
        return self.drive(self.explorer.arrived(look))

    def drive(self, leg):
        if leg is None:  # time to choose
            if self.explorer.done:
                return self.get_logger().info(f"done: {self.explorer.outcome()}")
            action = self.policy.act(self.explorer.observation(), self.explorer.info(), self.rng)
            leg = self.explorer.choose(action)
        self.leg, self.ended, self.driven, self.goals = leg, None, 0.0, self.goals + 1
        self.pose, goal, path = np.append(leg.path[0], 0.0), FollowPath.Goal(), Path()
        path.header.frame_id = "map"
        way = np.diff(leg.path, axis=0, append=leg.path[-1:] + np.diff(leg.path[-2:], axis=0)[-1:])
        headings = np.arctan2(way[:, 1], way[:, 0]) if len(leg.path) > 1 else np.zeros(1)
        if leg.heading is not None:
            headings[-1] = leg.heading
        for (x, y), heading in zip(leg.path, headings, strict=True):
            point = PoseStamped()
            point.header.frame_id, point.pose.position.x, point.pose.position.y = "map", float(x), float(y)
            point.pose.orientation.z, point.pose.orientation.w = math.sin(heading / 2), math.cos(heading / 2)
            path.poses.append(point)
        goal.path, number = path, self.goals
        self.controller.send_goal_async(goal).add_done_callback(
            lambda sent: sent.result().get_result_async().add_done_callback(lambda done: self.on_end(number, done))
        )

    def on_end(self, number, done):
        if number == self.goals:  # else a newer path took its place
            self.ended = "arrived" if done.result().status == 4 else "aborted"  # GoalStatus.STATUS_SUCCEEDED


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(ExploreNode())
