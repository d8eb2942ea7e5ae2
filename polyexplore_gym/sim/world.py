"""The simulated world: walls, the robot's true pose, and its drives. It knows nothing of the task."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from polyexplore_gym.config import DriveConfig, RobotConfig, SensorConfig
from polyexplore_gym.errors import InvalidMotionError
from polyexplore_gym.sim import follower
from polyexplore_gym.sim.engine import Engine
from polyexplore_gym.sim.laser import Laser
from polyexplore_gym.sim.pose import wrap
from polyexplore_gym.sim.robot import glide, nearest_wall, walls_near, way_length

_PATH_START = 0.004
"""A path starts no farther from the robot than this, radii."""
_SHORTEST_LEG = 4e-4
"""Points of a path nearer than this to the one before (radii) are left out."""
_MARGIN = 3.0
"""Walls this far (radii) beyond the robot's rim from the path take part in a drive from its start; where the robot
gets farther off, those around it are looked up anew."""
_ARRIVED = 0.2
"""A drive that ends farther than this (radii) from the end of its path has not arrived."""
_PENETRATION = 8e-5
"""The disc may start so deep in a wall, radii: what is left where poses were rounded."""
_ROWS = 2048


@dataclass(frozen=True, slots=True)
class DriveResult:
    """What a drive did."""

    trajectory: np.ndarray
    """(m, 3) true poses along the way, the first the start: at every vertex (kinematic), or after every time step and
    where walls bend the way (physics); m >= 1. The centre moves straight from one to the next."""
    distance: float
    """Way travelled by the centre of the body, m."""
    duration: float
    """Simulated time, s."""
    collided: bool
    """Whether a wall ended the drive."""
    contact: float | None
    """Where on the rim a bump was felt: bearing in the robot frame, rad; None without a bump."""
    arrived: bool
    """Whether the end of the path and the heading were reached; False after a bump, at the time limit, or where a
    robot that covers many of its lengths in a step could not keep to the path."""


class World:
    """Owner of the true state. Walls are static; the robot is a disc on two driven wheels.

    In `physics` mode a follower commands the wheels within their limits at a fixed time step. Where no wall is in the
    way a physics engine only integrates velocities, so the follower's kernel does that itself (the same sum, to
    rounding); as soon as a step would touch a wall pymunk takes over and resolves the contact, see `sim.engine`. Each
    of its steps is swept, so neither speed nor time step lets the disc into a wall. A wall that takes more than 8 % of
    the radius (2 cm at 0.25 m) of the commanded motion is a bump and ends the drive; grazing along a wall does not.

    In `kinematic` mode the robot follows the path exactly, turns on the spot at its vertices and halts 0.4 % of the
    radius before the first wall that its disc would touch.
    """

    def __init__(
        self,
        segments: np.ndarray,
        robot: RobotConfig,
        sensor: SensorConfig,
        drive: DriveConfig,
        pose: np.ndarray,
    ) -> None:
        """segments (M, 4) m, the walls; pose (3,) the true start pose.

        Raises `InvalidMotionError` if an array has another shape or is not finite, or the disc overlaps a wall.
        """
        walls = np.array(segments, dtype=np.float64, order="C")
        if walls.ndim != 2 or walls.shape[1] != 4 or not np.isfinite(walls).all():
            raise InvalidMotionError(f"walls of shape {walls.shape}: expected finite (M, 4)")
        walls.flags.writeable = False
        start = np.array(pose, dtype=np.float64)
        if start.shape != (3,) or not np.isfinite(start).all():
            raise InvalidMotionError(f"start pose {pose!r}: expected three finite numbers")
        start[2] = wrap(start[2])
        distance = nearest_wall(walls, start[0], start[1])[0]
        if distance < (1.0 - _PENETRATION) * robot.radius:
            raise InvalidMotionError(
                f"start pose {start.tolist()}: {distance:.3f} m from a wall, the robot's radius is {robot.radius} m"
            )
        self.robot, self.config = robot, drive
        self.laser = Laser(sensor)
        self._walls = walls
        self._pose = start
        self._limits = (robot.max_speed, robot.max_turn_rate, robot.max_acceleration, robot.max_turn_acceleration)

    @property
    def pose(self) -> np.ndarray:
        """(3,) true x, y (m) and heading (rad), a copy."""
        return self._pose.copy()

    @property
    def segments(self) -> np.ndarray:
        """(M, 4) walls, read-only."""
        return self._walls

    def measure(self, rng: np.random.Generator) -> np.ndarray:
        """One noisy scan from the true pose: ranges (n,) m, inf for no return."""
        return self.laser.measure(self._walls, self._pose, rng)

    def drive(self, path: np.ndarray, heading: float | None = None) -> DriveResult:
        """Drive along path (k, 2), k >= 1, true frame, from the robot's position; then turn to heading (rad), if any.

        Raises `InvalidMotionError` for an array that is not finite (k, 2), a path that starts more than 0.4 % of the
        radius from the robot, or a heading that is not finite.
        """
        way = self._checked_path(path)
        final_turn = heading is not None
        goal = 0.0 if heading is None else float(heading)
        if not math.isfinite(goal):
            raise InvalidMotionError(f"heading {heading!r}: expected a finite number")
        if self.config.mode == "kinematic":
            return self._glide(way, goal, final_turn)
        return self._follow(way, goal, final_turn)

    def _checked_path(self, path: np.ndarray) -> np.ndarray:
        way = np.array(path, dtype=np.float64, order="C")
        if way.ndim != 2 or way.shape[1] != 2 or len(way) == 0 or not np.isfinite(way).all():
            raise InvalidMotionError(f"path of shape {way.shape}: expected finite (k, 2), k >= 1")
        if math.hypot(way[0, 0] - self._pose[0], way[0, 1] - self._pose[1]) > _PATH_START * self.robot.radius:
            raise InvalidMotionError(f"path starts at {way[0].tolist()}, the robot stands at {self._pose[:2].tolist()}")
        keep = [0]
        for i in range(1, len(way)):
            if math.hypot(*(way[i] - way[keep[-1]])) >= _SHORTEST_LEG * self.robot.radius:
                keep.append(i)
        return way if len(keep) == len(way) else np.ascontiguousarray(way[keep])

    def _contact(self, collided: bool) -> float | None:
        """What a ring of bumpers feels: the bearing of the nearest wall in the robot frame."""
        if not collided:
            return None
        _, px, py = nearest_wall(self._walls, self._pose[0], self._pose[1])
        return wrap(math.atan2(py - self._pose[1], px - self._pose[0]) - self._pose[2])

    def _glide(self, path: np.ndarray, heading: float, final_turn: bool) -> DriveResult:
        trajectory, distance, duration, collided, arrived = glide(
            self._walls,
            self._pose,
            path,
            heading,
            final_turn,
            self.robot.radius,
            self._limits,
            self.config.time_limit,
        )
        trajectory[:, 2] = math.pi - (math.pi - trajectory[:, 2]) % (2.0 * math.pi)
        self._pose = trajectory[-1].copy()
        return DriveResult(
            trajectory, float(distance), float(duration), bool(collided), self._contact(collided), bool(arrived)
        )

    def _follow(self, path: np.ndarray, heading: float, final_turn: bool) -> DriveResult:
        robot, step = self.robot, self.config.time_step
        state = np.zeros(9)
        state[:3] = self._pose
        state[follower.PHASE] = follower.ALIGN if len(path) > 1 else follower.FINAL
        speeds = follower.vertex_speeds(path, self._limits, robot.radius, step)
        steps = max(1, math.ceil(self.config.time_limit / step))
        body, rows = (robot.radius, robot.track), np.empty((_ROWS, 3))
        engine: Engine | None = None  # no longer than the drive, so that none depends on the contacts of an earlier one
        parts, done, contact = [self._pose[None]], 0, False
        while done < steps and state[follower.PHASE] < follower.DONE:
            if not contact:
                box, walls = self._around(path, state)
            count, contact = follower.follow(
                state, path, speeds, heading, final_turn, self._limits, body, step, steps - done, walls, box, rows
            )
            parts.append(rows[:count].copy())
            done += count
            if contact:
                engine = engine or Engine(robot, self._walls)
                before = float(state[follower.HEADING])
                part = np.array([(*point, before) for point in engine.step(state, step)])
                follower.feel(state, part[-1, 0], part[-1, 1], robot.max_acceleration, step, robot.radius)
                part[-1, 2] = state[follower.HEADING]
                parts.append(part)
                done += 1
        trajectory = np.concatenate(parts)
        trajectory[:, 2] = math.pi - (math.pi - trajectory[:, 2]) % (2.0 * math.pi)
        self._pose = trajectory[-1].copy()
        ended = state[follower.PHASE] >= follower.DONE and state[follower.MET] > 0.0
        away = math.hypot(self._pose[0] - path[-1, 0], self._pose[1] - path[-1, 1]) > _ARRIVED * robot.radius
        arrived = bool(state[follower.PHASE] == follower.DONE) and not away
        collided = bool(ended and not arrived)
        return DriveResult(
            trajectory, float(way_length(trajectory)), done * step, collided, self._contact(collided), arrived
        )

    def _around(self, path: np.ndarray, state: np.ndarray) -> tuple[tuple[float, ...], np.ndarray]:
        """A box (x, y min, x, y max) around the path and the robot, and the walls that meet it."""
        robot = self.robot
        margin = (1.0 + _MARGIN) * robot.radius + robot.max_speed * self.config.time_step
        low = np.minimum(path.min(axis=0), state[:2]) - margin
        high = np.maximum(path.max(axis=0), state[:2]) + margin
        box = (*low.tolist(), *high.tolist())
        return box, self._walls[walls_near(self._walls, *box)]
