"""The simulated world: walls, the robot's true pose, and its drives. It knows nothing of the task."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pymunk

from polyexplore_gym.config import DriveConfig, RobotConfig, SensorConfig
from polyexplore_gym.errors import InvalidMotionError
from polyexplore_gym.sim import follower
from polyexplore_gym.sim.laser import Laser
from polyexplore_gym.sim.pose import wrap
from polyexplore_gym.sim.robot import glide, nearest_wall, walls_near, way_length

_PATH_START = 1e-3
_SHORTEST_LEG = 1e-4
_MARGIN = 0.75
"""Walls this far (m) beyond the robot's rim from the path take part in a drive; the follower gives up before."""
_SUBSTEP = 0.001
"""In contact the robot moves at most this share of its radius in a step of the engine."""
_BUMP = 0.02
"""A drive ends when a wall has taken this much of the commanded motion, m."""
_ARRIVED = 0.05
"""A drive that ends farther than this (m) from the end of its path has not arrived."""
_PENETRATION = 2e-5
"""The disc never stands deeper than this in a wall, m."""
_ROWS = 2048


@dataclass(frozen=True, slots=True)
class DriveResult:
    """What a drive did."""

    trajectory: np.ndarray
    """(m, 3) true poses along the way, the first the start; m >= 1."""
    distance: float
    """Way travelled by the centre of the body, m."""
    duration: float
    """Simulated time, s."""
    collided: bool
    """Whether a wall ended the drive."""
    contact: float | None
    """Where on the rim a bump was felt: bearing in the robot frame, rad; None without a bump."""
    arrived: bool
    """Whether the end of the path and the heading were reached; False after a bump or at the time limit."""


class World:
    """Owner of the true state. Walls are static; the robot is a disc on two driven wheels.

    In `physics` mode a follower commands the wheels within their limits at a fixed time step. Away from walls a
    physics engine only integrates velocities, so the follower's kernel does that itself (the same sum, to
    rounding); as soon as a step would touch a wall pymunk takes over and resolves the contact. A wall that takes
    more than 2 cm of the commanded motion is a bump and ends the drive; grazing along a wall does not.

    In `kinematic` mode the robot follows the path exactly, turns on the spot at its vertices and halts 1 mm
    before the first wall that its disc would touch.
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
        if distance < robot.radius - _PENETRATION:
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

        Raises `InvalidMotionError` for an array that is not finite (k, 2), a path that starts more than 1 mm from
        the robot, or a heading that is not finite.
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
        if math.hypot(way[0, 0] - self._pose[0], way[0, 1] - self._pose[1]) > _PATH_START:
            raise InvalidMotionError(f"path starts at {way[0].tolist()}, the robot stands at {self._pose[:2].tolist()}")
        keep = [0]
        for i in range(1, len(way)):
            if math.hypot(*(way[i] - way[keep[-1]])) >= _SHORTEST_LEG:
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
        reach = robot.radius + _MARGIN
        walls = self._walls[walls_near(self._walls, *(path.min(axis=0) - reach), *(path.max(axis=0) + reach))]
        state = np.zeros(8)
        state[:3] = self._pose
        state[follower.PHASE] = follower.ALIGN if len(path) > 1 else follower.FINAL
        speeds = follower.vertex_speeds(path, self._limits)
        steps = max(1, math.ceil(self.config.time_limit / step))
        engine: _Engine | None = None
        parts, done, collided = [self._pose[None].copy()], 0, False
        while done < steps:
            rows = np.empty((min(_ROWS, steps - done), 3))
            filled, contact = follower.run_free(
                state, path, speeds, heading, final_turn, self._limits, robot.track, step, walls, robot.radius, rows
            )
            parts.append(rows[:filled])
            done += filled
            if state[follower.PHASE] >= follower.DONE:
                break
            if contact:
                engine = engine or _Engine(robot, walls)
                engine.step(state, step)
                parts.append(state[None, :3].copy())
                done += 1
                if state[follower.DEFICIT] > _BUMP:
                    collided = True
                    break
        trajectory = np.concatenate(parts)
        if engine is not None:
            trajectory = self._settle(trajectory, walls)
        trajectory[:, 2] = math.pi - (math.pi - trajectory[:, 2]) % (2.0 * math.pi)
        self._pose = trajectory[-1].copy()
        ended = state[follower.PHASE] >= follower.DONE
        away = math.hypot(self._pose[0] - path[-1, 0], self._pose[1] - path[-1, 1]) > _ARRIVED
        arrived = bool(state[follower.PHASE] == follower.DONE) and not away
        collided = collided or (ended and not arrived)  # nothing but a wall keeps the follower from its goal
        return DriveResult(
            trajectory, float(way_length(trajectory)), done * step, bool(collided), self._contact(collided), arrived
        )

    def _settle(self, trajectory: np.ndarray, walls: np.ndarray) -> np.ndarray:
        """Move the last pose out of the walls by what the contact left of penetration, some millimetres at most.

        In a wedge too acute for that the robot is set back along its way to where it stood clear.
        """
        radius, end = self.robot.radius, trajectory[-1]
        for _ in range(50):
            distance, px, py = nearest_wall(walls, end[0], end[1])
            if distance >= radius or distance == 0.0:
                break
            scale = (radius + 1e-7 - distance) / distance
            end[0] += (end[0] - px) * scale
            end[1] += (end[1] - py) * scale
        while len(trajectory) > 1 and nearest_wall(walls, *trajectory[-1, :2])[0] < radius - _PENETRATION:
            trajectory = trajectory[:-1]
        return trajectory


class _Engine:
    """The pymunk space of one drive: the walls near the path as static segments, and the robot's body.

    It lives no longer than the drive, so that no drive depends on the contacts of an earlier one.
    """

    def __init__(self, robot: RobotConfig, walls: np.ndarray) -> None:
        self._space = pymunk.Space()
        self._space.collision_slop = 1e-4
        self._space.collision_bias = 0.0  # overlap is removed within a step
        self._body = pymunk.Body(robot.mass, pymunk.moment_for_circle(robot.mass, 0.0, robot.radius))
        shape = pymunk.Circle(self._body, robot.radius)
        shape.friction = 0.0
        static = self._space.static_body
        self._space.add(
            self._body, shape, *(pymunk.Segment(static, (a, b), (c, d), 0.0) for a, b, c, d in walls.tolist())
        )
        self._radius = robot.radius
        self._stands: tuple[float, float] | None = None

    def step(self, state: np.ndarray, step: float) -> None:
        """One time step at the commanded velocity (wheels do not slip on command), contacts resolved."""
        body = self._body
        speed, heading, rate = float(state[follower.SPEED]), float(state[follower.HEADING]), float(state[follower.RATE])
        c, s = math.cos(heading), math.sin(heading)
        x, y = float(state[follower.X]), float(state[follower.Y])
        if (x, y) != self._stands:  # it came here freely; else it still has the velocity the contact left it
            body.position, body.velocity = (x, y), (speed * c, speed * s)
        body.angle, body.angular_velocity = heading, rate
        fastest = max(speed, body.velocity.length)
        count = max(1, math.ceil(fastest * step / (_SUBSTEP * self._radius)))
        push = body.mass * count / step
        for _ in range(count):
            vx, vy = body.velocity
            body.force = push * (speed * c - vx), push * (speed * s - vy)  # the wheels, against what the wall takes
            self._space.step(step / count)
        end = body.position
        self._stands = (end.x, end.y)
        dx, dy = end.x - x, end.y - y
        achieved = dx * c + dy * s
        state[follower.DEFICIT] += speed * step - achieved
        state[follower.SPEED] = max(0.0, achieved / step)
        state[follower.X], state[follower.Y] = end.x, end.y
        state[follower.HEADING] = wrap(heading + rate * step)
        follower.forget(state, achieved)
