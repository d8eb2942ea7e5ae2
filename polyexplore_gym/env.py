"""PolyExploreEnv: one decision is one step; choose a node, the robot drives there and measures."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

from polyexplore_gym import observation
from polyexplore_gym.config import EnvConfig, RobotConfig, from_mapping
from polyexplore_gym.errors import InvalidActionError, InvalidConfigError, InvalidFloorPlanError
from polyexplore_gym.exploration import ExplorationMap, Remains
from polyexplore_gym.floorplan import FloorPlan, Suite, list_suites, load_plan
from polyexplore_gym.floorplan import suite as suite_named
from polyexplore_gym.mapping import Beams, Correction, LineMap, Localizer, ScanLines, extract_lines, walls_of
from polyexplore_gym.rewards import StepOutcome, rewards
from polyexplore_gym.scan import Scan
from polyexplore_gym.sim.coverage import Coverage, grid_points, grid_spacing
from polyexplore_gym.sim.pose import PoseModel
from polyexplore_gym.sim.robot import contact_along
from polyexplore_gym.sim.world import DriveResult, World
from polyexplore_gym.snapshot import Snapshot

WINDOW_FPS = 10.0
"""The window shows at most so many pictures a second."""
WINDOW_STEP = 0.5
"""Way between two pictures of a drive in the window, m."""
_SCAN_TURN = 0.5 * math.pi
"""Scans on the way are also taken after so much turning (rad) or half the field of view, if that is less."""
_CREEP, _HALT = 0.4, 0.1
"""A robot that decides on the way looks again before its disc enters what no scan has shown, and in there after so many
radii at a time; it can halt so many radii behind that place. Tuned: few bumps for little time."""
_ON_THE_WAY = ("settled", "interval", "blocked")
"""Ends of a drive at a scan on the way: none is made in addition."""


class PolyExploreEnv(gymnasium.Env[dict[str, np.ndarray], np.int64]):
    """Explore an unknown floor plan with a noisy laser, one frontier node at a time.

    Observation: see `polyexplore_gym.observation`. Action: the index of a node; `action_masks()`, the
    observation and `info` say which are valid; a masked one does nothing and is penalised, one out
    of range raises. Reward: minus the metres driven by default (`RewardConfig`). The episode
    terminates when no reachable jump edge is left and is truncated after `EnvConfig.max_decisions`.
    A plan seen whole from the start terminates in the first step, whatever the action, at no cost.

    Version history: v0, the first. v1: openings instead of chains, a look counts only where it could have shown
    something, paths through tight doorways, lengths from robot and sensor, swept contact; `info["outcome"]`. v2: scans
    on the way are taken in motion, and the next node may be chosen there (`ExplorationConfig.decide`); the observation
    has `node_pursued`, `info["ended"]` says why a drive ended.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array", "human"], "render_fps": 4}  # type: ignore[misc]

    def __init__(
        self,
        plan: FloorPlan | str | Path | None = None,
        suite: str | None = None,
        config: EnvConfig | Mapping[str, Any] | None = None,
        render_mode: str | None = None,
    ) -> None:
        """The plan to explore, or the name of a suite from which each episode draws one.

        Args:
            plan: a floor plan, or the path of one in any known format. Of a file that falls into parts for this robot
                the largest is taken, or that with the start given to `reset`, with a warning; a `FloorPlan` that does
                is refused.
            suite: such as "home-train"; see `polyexplore_gym.floorplan.list_suites()`.
            config: an `EnvConfig`, a nested mapping of its fields, or None for the defaults.
            render_mode: "rgb_array", "human" or None.

        Raises:
            InvalidConfigError: a field of the configuration is unknown or out of range, no such suite, or
                a plan and a suite.
            InvalidFloorPlanError: the plan cannot be read or is invalid.
        """
        if plan is not None and suite is not None:
            raise InvalidConfigError(f"a plan and the suite {suite!r}: give one (PolyExplore-Plan-v2 takes a plan)")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InvalidConfigError(f"render_mode {render_mode!r}: must be None, 'rgb_array' or 'human'")
        self.config = (
            config if isinstance(config, EnvConfig) else from_mapping(EnvConfig, {} if config is None else config)
        )
        self.render_mode = render_mode
        self._suite = None if suite is None else _suite(suite)
        self._plan = None if plan is None else self._checked(plan)
        self._plan_file = None if isinstance(plan, FloorPlan) else plan
        self.observation_space = observation.space(self.config.observation)  # type: ignore[assignment]
        self.action_space = spaces.Discrete(self.config.observation.max_nodes)
        self._world: World | None = None
        self._window: Any = None

    # Gymnasium ------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start an episode.

        Args:
            seed: of all randomness: plan, start, laser and pose each get a stream of their own.
            options: "plan": a `FloorPlan` or a path; "start": (x, y, heading) in metres and radians.

        Raises:
            InvalidFloorPlanError: the plan or the start is unusable.
            InvalidConfigError: an unknown option, or no plan was given anywhere.
        """
        super().reset(seed=seed)
        plan_rng, start_rng, self._laser_rng, pose_rng = self.np_random.spawn(4)
        options = dict(options or {})
        given, start = options.pop("plan", None), options.pop("start", None)
        if options:
            raise InvalidConfigError(f"reset: unknown option {min(options)!r}; known: plan, start")
        c = self.config
        plan = self._plan
        if given is not None:
            plan = self._checked(given, start)
        elif self._suite is not None:
            plan = self._suite.plan(int(plan_rng.integers(len(self._suite))))
        elif self._plan_file is not None and start is not None and plan is not None and not plan.covers(start):
            plan = self._checked(self._plan_file, start)
        if plan is None:
            raise InvalidConfigError("no floor plan: give plan= to the environment or options={'plan': ...} to reset")
        if start is None:
            pose = plan.sample_start(start_rng, c.robot.radius)
        else:
            plan.check_start(start, c.robot.radius)
            pose = np.array([*start, 0.0][:3], dtype=np.float64)
        self.plan = plan
        self._world = World(plan.segments, _careful(c), c.sensor, c.drive, pose)
        self._pose_model = PoseModel(c.pose, pose, pose_rng)
        self._coverage = Coverage(grid_points(plan.segments, grid_spacing(c.robot.radius, plan.area)))
        self._mapping = c.mapping.resolved(c.robot.radius)
        self._lines = LineMap(self._mapping, c.sensor)
        self._localizer = Localizer() if c.pose.mode == "slam" else None
        self._exploration = ExplorationMap(c.exploration, c.sensor, c.robot.radius)
        self._decisions = self._measurements = self._collisions = 0
        self._distance = self._sim_time = 0.0
        self._completed = False
        self._trajectory = [self._world.pose[None]]
        self._measured_at: list[np.ndarray] = []
        self._covariances: list[np.ndarray] = []
        self._felt: float | None = None
        self._target, self._ended, self._parts = -1, "start", 0
        self._path = self._pose_model.estimate[None, :2]
        self._look_around(c.exploration.look_around)
        if not c.exploration.look_around and not self._exploration.reachable.any():
            self._look_around(True)  # close to a wall there may be nothing else to do
        self._observe()
        info = self._info(StepOutcome(), invalid=False, truncated=False)
        if self.render_mode == "human":
            self.render()
        return self._observation(), info

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Drive to node `action`, measure there, and observe.

        Raises:
            InvalidActionError: not an integer, or outside the action space.
        """
        if self._world is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        node = self._checked_action(action)
        scene = self.snapshot() if self.render_mode == "human" else None
        self._decisions += 1
        before = (self._distance, self._coverage.share, self._measurements, self._collisions)
        choice = self._observed.arrays["action_mask"].any()
        valid = bool(self._observed.arrays["action_mask"][node])
        if valid:
            self._go(int(self._observed.rows[node]))
            self._observe()
        else:
            self._path, self._ended = self._pose_model.estimate[None, :2], "invalid"
        terminated = not self._observed.arrays["action_mask"].any()
        outcome = StepOutcome(
            distance=self._distance - before[0],
            coverage=self._coverage.share - before[1],
            measurement=self._measurements - before[2],
            collision=self._collisions - before[3],
            completion=float(terminated and not self._completed),
            invalid_action=float(choice and not valid),
        )
        self._completed = terminated
        truncated = not terminated and self._decisions >= self.config.max_decisions
        info = self._info(outcome, invalid=not valid, truncated=truncated)
        reward = float(sum(info["rewards"].values()))
        if scene is not None:
            self._show_motion(scene, node if valid else None)
        return self._observation(), reward, terminated, truncated, info

    def action_masks(self) -> np.ndarray:
        """(max_nodes,) bool: which actions are valid (the name that sb3-contrib's MaskablePPO looks for)."""
        if self._world is None:
            raise gymnasium.error.ResetNeeded("call reset() before action_masks()")
        return self._observed.arrays["action_mask"].astype(bool)

    def render(self) -> np.ndarray | None:
        """A picture (h, w, 3) uint8 in `rgb_array` mode; shows it in a window in `human` mode."""
        from polyexplore_gym import rendering

        if self.render_mode is None or self._world is None:
            gymnasium.logger.warn("render() needs a render_mode and a reset()")
            return None
        picture = rendering.frame(self.snapshot())
        if self.render_mode == "rgb_array":
            return picture
        self._show(picture)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _show(self, picture: np.ndarray) -> bool:
        """Show a picture in the window; False once the user has closed it."""
        from polyexplore_gym import rendering

        if self._window is None:
            self._window = rendering.Window("polyexplore_gym", WINDOW_FPS)
        return bool(self._window.show(picture))

    def _show_motion(self, before: Snapshot, chosen: int | None) -> None:
        """Show a step as it happened: the choice, the drive, and what is known after it."""
        from polyexplore_gym import rendering

        after = self.snapshot()
        for scene in (*rendering.motion(before, after, chosen, WINDOW_STEP), after):
            if not self._show(rendering.frame(scene)):
                break

    # What happens in a step -------------------------------------------------------------------

    def _look_around(self, all_round: bool) -> None:
        """Measure at the start, all round by turning on the spot or not, and plan."""
        assert self._world is not None
        fov = self.config.sensor.field_of_view
        turns = math.ceil(2.0 * math.pi / fov - 1e-9) if all_round else 1
        heading = self._world.pose[2]
        for i in range(turns):
            if i:
                self._turn(heading + i * 2.0 * math.pi / turns)
            self._measure()
        lines = self._lines
        self._exploration.plan(self._pose_model.estimate, lines.segments, lines.alive, lone=lines.lone)

    def _go(self, row: int) -> None:
        """Drive to a node and measure there, on the way too if so configured; and plan anew."""
        exploration = self._exploration
        target, heading = int(exploration.chains.id[row]), float(exploration.chains.node[row, 2])
        self._target, self._path = target, exploration.path_to(row)
        self._parts = len(self._trajectory)
        self._ended = self._approach(target, self._path, heading)
        if self._felt is not None:
            estimate = self._pose_model.estimate
            exploration.bump(estimate, self._felt + estimate[2])
        if self._ended not in _ON_THE_WAY:
            arrived = self._ended == "arrived"
            if not arrived:
                # A bump ends the drive, but the robot can still look where it wanted to.
                self._turn(self._pose_model.to_true(np.array([[0.0, 0.0, heading]]))[0, 2])
            self._measure(target, arrived=arrived)
        elif self._ended == "blocked":
            exploration.attempted(target)
        self._update()

    def _approach(self, target: int, path: np.ndarray, heading: float) -> str:
        """Drive along a path (k, 2) to the node of a jump edge; scans on the way are taken without slowing down.

        Returns why the drive ended: that of `DriveResult.ended`, or `_ON_THE_WAY`.
        """
        exploration, c = self._exploration, self.config.exploration
        start = self._distance
        while True:
            ended, path = self._drive(path, heading)
            if ended != "cut":
                return ended
            self._measure()
            if c.decide == "arrival":
                continue
            if target not in exploration.chains.id:
                return "settled"
            if c.decide == "interval" and self._distance - start >= c.decide_every - 1e-9:
                return "interval"
            if exploration.blocked(path, self._lines.segments, self._lines.alive, self._lines.lone):
                self._update()
                row = np.flatnonzero(exploration.chains.id == target)
                if not len(row) or not exploration.reachable[row[0]]:
                    return "blocked"
                path, heading = exploration.path_to(int(row[0])), float(exploration.chains.node[row[0], 2])
                self._path = path

    def _drive(self, path: np.ndarray, heading: float) -> tuple[str, np.ndarray]:
        """Drive along a path (k, 2), then turn to a heading, until it is time for a scan on the way.

        Returns why the drive ended, and what is left of the path. Both frames are those of the estimate.
        """
        assert self._world is not None
        c, radius = self.config.exploration, self.config.robot.radius
        distance = turn = math.inf
        if c.scan_every > 0.0:
            if not self.config.sensor.full_circle:
                turn = min(_SCAN_TURN, 0.5 * self.config.sensor.field_of_view)
            if np.hypot(*np.diff(path, axis=0).T).sum() > 1.5 * c.scan_every:  # else the scan at the end will do
                distance = c.scan_every
        end, whole = path, True
        if c.decide != "arrival":
            seen = max(contact_along(self._exploration.pieces.segments, path, radius), _CREEP * radius)
            distance = min(distance, seen)
            end, whole = _cut_off(path, seen + _HALT * radius)
        true_path = self._pose_model.to_true(end)
        true_path[0] = self._world.pose[:2]
        true_heading = self._pose_model.to_true(np.array([[0.0, 0.0, heading]]))[0, 2] if whole else None
        result = self._take(self._world.drive(true_path, true_heading, distance=distance, turn=turn))
        rest = path[result.next_vertex :]
        return result.ended, np.concatenate((self._pose_model.estimate[None, :2], rest))

    def _turn(self, heading: float) -> None:
        """Turn on the spot to a true heading."""
        assert self._world is not None
        self._take(self._world.drive(self._world.pose[None, :2], heading))

    def _take(self, result: DriveResult) -> DriveResult:
        """Take over what a drive did."""
        self._follow(result.trajectory)
        self._trajectory.append(result.trajectory)
        self._distance += result.distance
        self._sim_time += result.duration
        self._collisions += int(result.collided)
        self._felt = result.contact
        return result

    def _update(self) -> None:
        """Bring nodes and paths up to date; the way of this decision leads back."""
        assert self._world is not None
        to_estimated = self._pose_model.to_estimated
        came = to_estimated(np.concatenate((*self._trajectory[self._parts :], self._world.pose[None]))[:, :2])
        self._parts = len(self._trajectory)
        halt = to_estimated(self._world.halt[None])[0]
        lines = self._lines
        self._exploration.plan(self._pose_model.estimate, lines.segments, lines.alive, came, halt, lines.lone)

    def _follow(self, way: np.ndarray) -> None:
        """Advance the estimated pose along true poses (m, 3); in the mode slam it is corrected on the way."""
        done = 0
        if self._localizer is not None:
            way, stops = _with_stops(way, self.config.pose.correct_every)
            for stop in stops:
                self._pose_model.moved(way[done : stop + 1])
                self._scan_lines(way[stop])
                done = stop
        self._pose_model.moved(way[done:])

    def _scan_lines(self, pose: np.ndarray) -> tuple[np.ndarray, ScanLines, Correction]:
        """Ranges and lines of a scan from a true pose, and what they say of the estimated one."""
        assert self._world is not None
        laser = self._world.laser
        ranges = laser.measure(self._world.segments, pose, self._laser_rng)
        found = extract_lines(laser.angles, ranges, self.config.sensor, self._mapping)
        estimate, covariance = self._pose_model.measured(pose)
        if self._localizer is None:
            return ranges, found, Correction.none(estimate, covariance)
        fix = self._localizer.correct(found, self._lines, estimate, covariance)
        self._pose_model.correct(fix.pose, fix.covariance)
        return ranges, found, fix

    def _measure(self, target: int | None = None, *, arrived: bool = True) -> None:
        """Scan from where the robot is and take the scan into both maps."""
        assert self._world is not None
        pose = self._world.pose
        ranges, found, fix = self._scan_lines(pose)
        scan = Scan(self._world.laser.angles, ranges, fix.pose, fix.covariance, self.config.sensor.full_circle)
        drifting = self.config.pose.mode == "odometry"
        touched = self._lines.insert(found, fix.pose, fix.relative, drifting=drifting)
        if self._localizer is not None:
            self._localizer.learn(self._lines)
        self._exploration.insert(
            scan,
            self._lines.segments,
            self._lines.alive,
            touched,
            point_segment=found.point_segment,
            ranges=found.smoothed,
            target=target,
            arrived=arrived,
        )
        if len(self._covariances) < self._exploration.n_scans:  # else the scan showed nothing new and is not kept
            self._covariances.append(fix.relative)
        self._coverage.add(self._world.segments, pose, self.config.sensor)
        self._measurements += 1
        self._scan = scan
        self._measured_at.append(pose)

    def _observe(self) -> None:
        self._observed = observation.observe(
            self._exploration,
            self._lines,
            self._pose_model.estimate,
            self._pose_model.covariance,
            self.config.sensor.max_range,
            self.config.observation,
            self._target,
        )

    def _observation(self) -> dict[str, np.ndarray]:
        """The observation, the caller's own to change."""
        return {key: value.copy() for key, value in self._observed.arrays.items()}

    def _outcome(self, truncated: bool) -> dict[str, Any]:
        """How the episode stands, and which jump edges (number and metres) it leaves."""
        if not truncated and self._observed.arrays["action_mask"].any():
            return {"status": "running", **Remains(0, 0.0, 0, 0.0)._asdict()}
        left = self._exploration.remains()
        status = "budget" if truncated else "unreached" if left.unreached or left.given_up else "complete"
        return {"status": status, **left._asdict()}

    def _info(self, outcome: StepOutcome, *, invalid: bool, truncated: bool) -> dict[str, Any]:
        return {
            "action_mask": self._observed.arrays["action_mask"].copy(),
            "distance": self._distance,
            "coverage": self._coverage.share,
            "measurements": self._measurements,
            "sim_time": self._sim_time,
            "collisions": self._collisions,
            # No array: Gymnasium's vector environments stack arrays, and the paths differ in length.
            "path": tuple(map(tuple, self._path.tolist())),
            "rewards": rewards(outcome, self.config.reward),
            "invalid_action": invalid,
            "ended": self._ended,
            "outcome": self._outcome(truncated),
            "cut": {"nodes": self._observed.cut_nodes, "lines": self._observed.cut_lines},
        }

    def _checked_action(self, action: Any) -> int:
        if isinstance(action, np.ndarray) and action.ndim == 0:
            action = action[()]
        if isinstance(action, (bool, np.bool_)) or not isinstance(action, (int, np.integer)):
            raise InvalidActionError(f"action {action!r}: expected an integer, the index of a node")
        if not 0 <= action < self.action_space.n:  # type: ignore[attr-defined]
            raise InvalidActionError(f"action {action}: must lie in 0 to {self.action_space.n - 1}")  # type: ignore[attr-defined]
        return int(action)

    def _checked(self, plan: FloorPlan | str | Path, start: Sequence[float] | None = None) -> FloorPlan:
        """The plan, or of a file the part that the robot can reach (from the start); raises if it falls apart."""
        if not isinstance(plan, (FloorPlan, str, Path)):
            raise InvalidFloorPlanError(f"plan: expected a FloorPlan or a path, got {type(plan).__name__}")
        if not isinstance(plan, FloorPlan):
            plan = load_plan(plan, radius=self.config.robot.radius, start=start)
        plan.check_connected(self.config.robot.radius)
        return plan

    # For whoever looks on ---------------------------------------------------------------------

    @property
    def exploration(self) -> ExplorationMap:
        """The exploration map of this episode."""
        return self._exploration

    @property
    def line_map(self) -> LineMap:
        """The line map of this episode."""
        return self._lines

    @property
    def true_pose(self) -> np.ndarray:
        """(3,) where the robot really is: for scores and pictures, not for policies."""
        assert self._world is not None
        return self._world.pose

    def floor_plan(self, name: str = "explored") -> FloorPlan:
        """What was explored so far as one valid floor plan, in the map frame: `save_plan` writes it.

        What is unknown is closed; `meta` has the stretches of the walls that nobody saw (`unknown`, each x1, y1, x2,
        y2 in m), their length (`unknown_length`, m) and share of all walls (`unknown_share`).

        Raises:
            InvalidFloorPlanError: what was seen is no floor.
        """
        from polyexplore_gym.outline import floor_plan, trace, views_of

        if self._world is None:
            raise gymnasium.error.ResetNeeded("call reset() before floor_plan()")
        sensor, scans = self.config.sensor, self._exploration.scans
        poses = np.column_stack((scans.apexes, scans.headings))
        beams = [
            Beams(scans.angles, np.hypot(*points.T), pose, covariance)
            for points, pose, covariance in zip(scans.points, poses, self._covariances, strict=True)
        ]
        walls = walls_of(self._lines, beams, sensor)
        return floor_plan(trace(views_of(beams, sensor.max_range), walls, sensor, door=self._lines.door), name)

    def snapshot(self) -> Snapshot:
        """This moment as plain arrays, for `polyexplore_gym.rendering`."""
        from polyexplore_gym.exploration import shapes

        e, lines = self._exploration, self._lines
        rows = self._observed.rows
        alive = np.flatnonzero(lines.alive)
        return Snapshot(
            exterior=self.plan.exterior,
            holes=self.plan.holes,
            walls=lines.segments[alive].copy(),
            wall_fitted=lines.line[alive] >= 0,
            explored=shapes.rings(shapes.exploration_polygon(e)),
            jump_edges=shapes.jump_edges(e),
            node_positions=e.chains.node[rows, :2].copy(),
            node_headings=e.chains.node[rows, 2].copy(),
            node_mask=np.isfinite(e.chains.path_length[rows]),
            chosen=None,
            trajectory=np.concatenate(self._trajectory),
            measured_at=np.array(self._measured_at),
            path=self._path,
            scan=shapes.scan_points(self._scan, self.config.sensor.max_range),
            scan_pose=self._scan.pose.copy(),
            pose=self.true_pose,
            estimate=self._pose_model.estimate,
            radius=self.config.robot.radius,
            distance=self._distance,
            coverage=self._coverage.share,
            measurements=self._measurements,
            title=self.plan.name,
        )


def _careful(config: EnvConfig) -> RobotConfig:
    """The robot; if it decides on the way, no faster than lets it halt within the way between two scans."""
    robot, exploration = config.robot, config.exploration
    if exploration.decide == "arrival":
        return robot
    speed = math.sqrt(2.0 * robot.max_acceleration * exploration.scan_every)
    return dataclasses.replace(robot, max_speed=min(robot.max_speed, speed))


def _cut_off(path: np.ndarray, way: float) -> tuple[np.ndarray, bool]:
    """The first so many metres of a path (k, 2), and whether that is all of it."""
    run = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))))
    if way >= run[-1]:
        return path, True
    k = int(np.searchsorted(run, way))
    share = (way - run[k - 1]) / (run[k] - run[k - 1])
    return np.concatenate((path[:k], path[k - 1 : k] + share * (path[k] - path[k - 1]))), False


def _suite(name: str) -> Suite:
    if name not in list_suites():
        raise InvalidConfigError(f"unknown suite {name!r}; known: {', '.join(list_suites())}")
    return suite_named(name)


def _with_stops(way: np.ndarray, every: float) -> tuple[np.ndarray, list[int]]:
    """A trajectory (m, 3) with a pose at every so many metres put in, and the rows of those; none near the end.

    A radian turned counts as a metre.
    """
    run = np.hypot(*np.diff(way[:, :2], axis=0).T)
    run += np.abs(np.remainder(np.diff(way[:, 2]) + math.pi, 2.0 * math.pi) - math.pi)
    driven = np.concatenate(([0.0], np.cumsum(run)))
    marks = np.arange(every, driven[-1] - 0.5 * every, every)
    if not len(marks):
        return way, []
    nxt = np.searchsorted(driven, marks)
    share = ((marks - driven[nxt - 1]) / (driven[nxt] - driven[nxt - 1]))[:, None]
    step = way[nxt] - way[nxt - 1]
    step[:, 2] = np.remainder(step[:, 2] + math.pi, 2.0 * math.pi) - math.pi
    return np.insert(way, nxt, way[nxt - 1] + share * step, axis=0), (nxt + np.arange(len(marks))).tolist()
