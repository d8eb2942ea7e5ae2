"""The simulated world: walls, the robot's true pose, and its drives. It knows nothing of the task."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from polyexplore_gym.config import DriveConfig, RobotConfig, SensorConfig
from polyexplore_gym.errors import InvalidMotionError
from polyexplore_gym.sim import follower
from polyexplore_gym.sim.engine import Engine
from polyexplore_gym.sim.laser import Laser
from polyexplore_gym.sim.pose import wrap
from polyexplore_gym.sim.robot import (
    ARRIVED,
    BUMP,
    CUT,
    LOST,
    TIME,
    apart,
    glide,
    nearest_wall,
    walls_around,
    way_length,
    wrap_headings,
)

_PATH_START = 0.004
"""A path starts no farther from the robot than this, radii."""
_SHORTEST_LEG = 4e-4
"""Points of a path nearer than this to the one before (radii) are left out."""
_MARGIN = 3.0
"""Walls this far (radii) beyond the robot's rim from the path take part in a drive from its start; where the robot
gets farther off, those around it are looked up anew."""
_ARRIVED = 0.2
"""A drive that ends farther than this (radii) from the end of its path has not arrived."""
_SAME, _SAME_COURSE = 0.2, 0.1
"""A drive carries on with the one that was cut short if the next vertex lies no farther than this from where it was:
radii, and share of the leg to it."""
_PENETRATION = 8e-5
"""The disc may start so deep in a wall, radii: what is left where poses were rounded."""
_ROWS = 2048


Ended = Literal["arrived", "cut", "bump", "time", "lost"]
_ENDED: dict[int, Ended] = {ARRIVED: "arrived", CUT: "cut", BUMP: "bump", TIME: "time", LOST: "lost"}


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
    ended: Ended
    """`arrived`: the end of the path and the heading were reached; `cut`: the way or the turn asked for was driven, and
    the robot moves on; `bump`: a wall ended it; `time`: the time limit; `lost`: the robot could not keep to the path,
    as one that covers many of its lengths in a step."""
    next_vertex: int
    """Index in the path given of the next vertex that the robot had not passed; the length of the path where none was
    left: it carries on along [its position, *path[next_vertex:]]."""
    contact: float | None
    """Where on the rim a bump was felt: bearing in the robot frame, rad; None without a bump."""

    @property
    def arrived(self) -> bool:
        return self.ended == "arrived"

    @property
    def collided(self) -> bool:
        return self.ended == "bump"


@dataclass(frozen=True, slots=True)
class _Cut:
    """The motion of a drive that was cut short: what the next one carries on with."""

    state: np.ndarray
    """As in `sim.follower`; in `kinematic` pose, speed and turn rate only."""
    behind: tuple[float, float]
    """m, where the leg began, or the end of the path where none is left."""
    ahead: tuple[float, float] | None
    """m, the next vertex, if any."""
    time: float
    """Driven so far, s: the time limit holds for all the pieces of a drive together."""
    braking: np.ndarray | None = None
    """(2, 2) m, the way straight ahead on which it brakes before it takes up its path, if it does."""

    @classmethod
    def of(
        cls, state: np.ndarray, path: np.ndarray, vertex: int, time: float, braking: np.ndarray | None = None
    ) -> _Cut:
        """From the path (k, 2) driven and the index in it of the next vertex."""
        ahead = tuple(path[vertex].tolist()) if vertex < len(path) else None
        return cls(state, tuple(path[min(vertex, len(path)) - 1].tolist()), ahead, time, braking)

    def goes_on(self, path: np.ndarray, radius: float) -> bool:
        """Whether a path (k, 2) leads on to the same next vertex."""
        if self.ahead is None or len(path) == 1:
            return self.ahead is None and len(path) == 1
        x, y = path[1].tolist()
        off = math.hypot(x - self.ahead[0], y - self.ahead[1])
        return off <= _SAME * radius and off <= _SAME_COURSE * math.dist(self.ahead, self.behind)


class World:
    """Owner of the true state. Walls are static; the robot is a disc on two driven wheels.

    In `physics` mode a follower commands the wheels within their limits at a fixed time step. Where no wall is in the
    way a physics engine only integrates velocities, so the follower's kernel does that itself (the same sum, to
    rounding); as soon as a step would touch a wall pymunk takes over and resolves the contact, see `sim.engine`. Each
    of its steps is swept, so neither speed nor time step lets the disc into a wall. A wall that takes more than 8 % of
    the radius (2 cm at 0.25 m) of the commanded motion is a bump and ends the drive; grazing along a wall does not.

    In `kinematic` mode the robot follows the path exactly, turns on the spot at its vertices and halts 0.4 % of the
    radius before the first wall that its disc would touch.

    A drive may be cut short: the robot then moves on at the speed it has, and the next drive begins with that. If its
    path leads to the same next vertex, it is the same drive: it goes on along the same leg, as if it had not been cut
    (in `physics` to the last bit while no wall is touched), and the time limit holds for all its pieces together. On
    another path it is a new drive; of the old one it keeps the motion, and what walls have taken of it: cutting hides
    no bump. Where a new path does not lead on, a robot in `physics` first brakes straight ahead and takes it up from
    there, so it should lead through `halt`; a `kinematic` robot halts at once, and only the time counts that it would
    take to brake.
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
        self._cut: _Cut | None = None
        self._shortest_leg = _SHORTEST_LEG * robot.radius
        self._limits = (robot.max_speed, robot.max_turn_rate, robot.max_acceleration, robot.max_turn_acceleration)

    @property
    def pose(self) -> np.ndarray:
        """(3,) true x, y (m) and heading (rad), a copy."""
        return self._pose.copy()

    @property
    def segments(self) -> np.ndarray:
        """(M, 4) walls, read-only."""
        return self._walls

    @property
    def velocity(self) -> tuple[float, float]:
        """Speed (m/s) and turn rate (rad/s) at which the robot moves: zero but after a drive that was cut short."""
        if self._cut is None:
            return 0.0, 0.0
        return float(self._cut.state[follower.SPEED]), float(self._cut.state[follower.RATE])

    @property
    def halt(self) -> np.ndarray:
        """(2,) the place straight ahead where the robot can come to rest at the earliest, m; where it stands at rest.

        A new path that leads there first is taken up without a swing, whatever its next leg.
        """
        step = self.config.time_step if self.config.mode == "physics" else 0.0
        way = follower.stopping_distance(self.velocity[0], self._limits, step)
        x, y, heading = self._pose.tolist()
        return np.array([x + way * math.cos(heading), y + way * math.sin(heading)])

    def measure(self, rng: np.random.Generator) -> np.ndarray:
        """One noisy scan from the true pose: ranges (n,) m, inf for no return."""
        return self.laser.measure(self._walls, self._pose, rng)

    def stop(self) -> DriveResult:
        """Brake to rest straight ahead. It has arrived where it stands then; a wall may end it sooner."""
        path = self._pose[None, :2]
        return self.drive(np.vstack([path, self.halt]) if self.velocity[0] > 0.0 else path)

    def drive(
        self,
        path: np.ndarray,
        heading: float | None = None,
        *,
        distance: float = math.inf,
        turn: float = math.inf,
    ) -> DriveResult:
        """Drive along path (k, 2), k >= 1, true frame, from the robot's position; then turn to heading (rad), if any.

        After so much way (distance, m) or so much turning to and fro (turn, rad), whichever comes first, it returns
        with the robot moving on (`physics`: after the time step in which that is reached). A path of one point stops
        a robot that moves.

        Raises `InvalidMotionError` for an array that is not finite (k, 2), a path that starts more than 0.4 % of the
        radius from the robot, a heading that is not finite, or a distance or turn that is not positive.
        """
        points = self._checked_path(path)
        final_turn = heading is not None
        goal = 0.0 if heading is None else float(heading)
        if not math.isfinite(goal):
            raise InvalidMotionError(f"heading {heading!r}: expected a finite number")
        if not (distance > 0.0 and turn > 0.0):
            raise InvalidMotionError(f"distance {distance!r}, turn {turn!r}: expected positive numbers")
        drive = self._glide if self.config.mode == "kinematic" else self._follow
        return drive(points, goal, final_turn, float(distance), float(turn))

    def _checked_path(self, path: np.ndarray) -> np.ndarray:
        points = np.array(path, dtype=np.float64, order="C")
        if points.ndim != 2 or points.shape[1] != 2 or len(points) == 0 or len(apart(points, 0.0)[0]) < len(points):
            raise InvalidMotionError(f"path of shape {points.shape}: expected finite (k, 2), k >= 1")
        if math.dist(points[0].tolist(), self._pose[:2].tolist()) > _PATH_START * self.robot.radius:
            raise InvalidMotionError(
                f"path starts at {points[0].tolist()}, the robot stands at {self._pose[:2].tolist()}"
            )
        return points

    def _contact(self, collided: bool) -> float | None:
        """What a ring of bumpers feels: the bearing of the nearest wall in the robot frame."""
        if not collided:
            return None
        _, px, py = nearest_wall(self._walls, self._pose[0], self._pose[1])
        return wrap(math.atan2(py - self._pose[1], px - self._pose[0]) - self._pose[2])

    def _carried_on(self, points: np.ndarray) -> _Cut | None:
        """The drive that a path carries on, if any; the path then begins where the leg began."""
        cut = self._cut
        if cut is None or not cut.goes_on(points, self.robot.radius):
            return None
        points[0] = cut.behind
        return cut

    def _glide(self, points: np.ndarray, heading: float, final_turn: bool, way: float, turn: float) -> DriveResult:
        drive = self._carried_on(points)
        before = drive.time if drive else 0.0
        path, keep = apart(points, self._shortest_leg)
        trajectory, distance, duration, ended, vertex, speed, rate = glide(
            self._walls,
            self._pose,
            self.velocity,
            path,
            heading,
            final_turn,
            self.robot.radius,
            self._limits,
            max(0.0, self.config.time_limit - before),
            (way, turn),
        )
        following = int(keep[vertex]) if vertex < len(keep) else len(points)
        cut = None
        if ended == CUT:
            cut = _Cut.of(np.array([*trajectory[-1], speed, rate]), path, vertex, before + duration)
        return self._end(trajectory, distance, duration, ended, following, cut)

    def _follow(self, points: np.ndarray, heading: float, final_turn: bool, way: float, turn: float) -> DriveResult:
        robot, step, limits = self.robot, self.config.time_step, self._limits
        drive = self._carried_on(points)
        before = round(drive.time / step) if drive else 0
        path, keep = apart(points, self._shortest_leg)
        speeds = follower.vertex_speeds(path, limits, robot.radius, step)
        state = np.zeros(9)
        state[:3] = self._pose
        if self._cut is not None:
            state[:] = self._cut.state
            state[follower.LEG] = 0.0
        braking = self._begin(state, drive, path, speeds)
        steps = max(1, math.ceil(self.config.time_limit / step)) - before
        run = _Run(robot, self._walls, step, limits, state, steps, np.array([way, turn]))
        if braking is not None:
            run.along(braking, follower.vertex_speeds(braking, limits, robot.radius, step), 0.0, False)
            vertex = 1
            if state[follower.PHASE] == follower.DONE:
                braking, points[0] = None, state[:2]
                path, keep = apart(points, self._shortest_leg)
                speeds = follower.vertex_speeds(path, limits, robot.radius, step)
                state[follower.PHASE] = follower.ALIGN if len(path) > 1 else follower.FINAL
                state[follower.LEG] = 0.0
        if braking is None:
            run.along(path, speeds, heading, final_turn)
            vertex = int(state[follower.LEG]) + 1
        trajectory, ended = np.concatenate(run.parts), run.ended(path[-1])
        following = int(keep[vertex]) if vertex < len(keep) else len(points)
        cut = _Cut.of(state, path, vertex, (before + run.done) * step, braking) if ended == CUT else None
        return self._end(trajectory, way_length(trajectory), run.done * step, ended, following, cut)

    def _begin(self, state: np.ndarray, drive: _Cut | None, path: np.ndarray, speeds: np.ndarray) -> np.ndarray | None:
        """Set the phase for a path (k, 2); returns the way (2, 2) to brake on first, if it must not be taken up yet."""
        limits, radius = self._limits, self.robot.radius
        if drive is not None:
            if drive.braking is not None:
                return drive.braking
            if len(path) == 1 or follower.can_stop(state, path, speeds, limits, radius):
                return None
        else:
            state[follower.MET] = state[follower.DEFICIT] > 0.0
            if state[follower.SPEED] == 0.0:
                state[follower.PHASE] = follower.ALIGN if len(path) > 1 else follower.FINAL
                return None
        state[follower.PHASE] = follower.FOLLOW
        if drive is None and follower.leads_on(state, path, speeds, limits, radius):
            return None
        return np.array([state[:2], self.halt])

    def _end(
        self, trajectory: np.ndarray, distance: float, duration: float, ended: int, following: int, cut: _Cut | None
    ) -> DriveResult:
        wrap_headings(trajectory)
        self._pose, self._cut = trajectory[-1].copy(), cut
        contact = self._contact(ended == BUMP)
        return DriveResult(trajectory, float(distance), float(duration), _ENDED[ended], following, contact)


class _Run:
    """The time steps of a drive in `physics`."""

    def __init__(
        self,
        robot: RobotConfig,
        walls: np.ndarray,
        step: float,
        limits: tuple[float, float, float, float],
        state: np.ndarray,
        steps: int,
        left: np.ndarray,
    ) -> None:
        """state (9,) and left (2,) as in `follower.follow`, changed as it drives; steps: at most so many."""
        self.robot, self.walls, self.step, self.limits = robot, walls, step, limits
        self.state, self.steps, self.left = state, steps, left
        self.parts, self.done = [state[None, :3].copy()], 0
        self.engine: Engine | None = None
        """No longer than the drive or its piece: none depends on the contacts of an earlier one, and a copy of a world
        goes on as the original."""

    @property
    def used_up(self) -> bool:
        way, turn = self.left.tolist()
        return way <= 0.0 or turn <= 0.0

    @property
    def over(self) -> bool:
        return self.done >= self.steps or self.state[follower.PHASE] >= follower.DONE or self.used_up

    def along(self, path: np.ndarray, speeds: np.ndarray, heading: float, final_turn: bool) -> None:
        """Drive on until it is over."""
        robot, state, step = self.robot, self.state, self.step
        body, rows, contact = (robot.radius, robot.track), np.empty((_ROWS, 3)), False
        margin = (1.0 + _MARGIN) * robot.radius + robot.max_speed * step
        while not self.over:
            if not contact:
                box, walls = walls_around(self.walls, path, state, margin)
            count, contact = follower.follow(
                state,
                path,
                speeds,
                heading,
                final_turn,
                self.limits,
                body,
                step,
                self.steps - self.done,
                self.left,
                walls,
                box,
                rows,
            )
            self.parts.append(rows[:count].copy())
            self.done += count
            if contact:
                self._touch()

    def _touch(self) -> None:
        """A time step of which walls take something."""
        state = self.state
        self.engine = self.engine or Engine(self.robot, self.walls)
        before = float(state[follower.HEADING])
        part = np.array([(*point, before) for point in self.engine.step(state, self.step)])
        self.left[0] -= way_length(np.vstack([state[None, :3], part]))
        self.left[1] -= abs(state[follower.RATE]) * self.step
        follower.feel(state, part[-1, 0], part[-1, 1], self.limits[2], self.step, self.robot.radius)
        part[-1, 2] = state[follower.HEADING]
        self.parts.append(part)
        self.done += 1

    def ended(self, end: np.ndarray) -> int:
        """Why it is over; end (2,) of the path, m."""
        state = self.state
        away = math.dist(state[:2].tolist(), end.tolist()) > _ARRIVED * self.robot.radius
        if state[follower.PHASE] == follower.DONE and not away:
            return ARRIVED
        if state[follower.PHASE] >= follower.DONE:
            return BUMP if state[follower.MET] > 0.0 else LOST
        return CUT if self.used_up else TIME
