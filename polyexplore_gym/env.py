"""PolyExploreEnv: one decision is one step; choose a node, the robot drives there and measures."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

from polyexplore_gym import observation
from polyexplore_gym.config import EnvConfig, from_mapping
from polyexplore_gym.errors import InvalidActionError, InvalidConfigError, InvalidFloorPlanError
from polyexplore_gym.exploration import ExplorationMap
from polyexplore_gym.explorer import Explorer, Leg, Look
from polyexplore_gym.floorplan import FloorPlan, Suite, list_suites, load_plan
from polyexplore_gym.floorplan import suite as suite_named
from polyexplore_gym.mapping import LineMap
from polyexplore_gym.rewards import StepOutcome, rewards
from polyexplore_gym.sim.coverage import Coverage, grid_points, grid_spacing
from polyexplore_gym.sim.pose import PoseModel, with_stops
from polyexplore_gym.sim.world import DriveResult, World
from polyexplore_gym.snapshot import Snapshot

WINDOW_FPS = 10.0
"""The window shows at most so many pictures a second."""
WINDOW_STEP = 0.5
"""Way between two pictures of a drive in the window, m."""


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
        self._explorer = Explorer(c)
        robot = dataclasses.replace(c.robot, max_speed=self._explorer.max_speed)
        self._world = World(plan.segments, robot, c.sensor, c.drive, pose)
        self._pose_model = PoseModel(c.pose, pose, pose_rng)
        self._coverage = Coverage(grid_points(plan.segments, grid_spacing(c.robot.radius, plan.area)))
        self._decisions = self._collisions = 0
        self._distance = self._sim_time = 0.0
        self._completed = False
        self._trajectory = [self._world.pose[None]]
        self._measured_at: list[np.ndarray] = []
        self._ended, self._parts = "start", 0
        self._path = self._pose_model.estimate[None, :2]
        self._look_around(c.exploration.look_around)
        if not c.exploration.look_around and self._explorer.done:
            self._look_around(True)  # close to a wall there may be nothing else to do
        info = self._info(StepOutcome(), invalid=False, truncated=False)
        if self.render_mode == "human":
            self.render()
        return self._explorer.observation(), info

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
        before = (self._distance, self._coverage.share, self._explorer.scans, self._collisions)
        mask = self._explorer.observed.arrays["action_mask"]
        choice, valid = mask.any(), bool(mask[node])
        if valid:
            self._go(node)
            self._path, self._ended = self._explorer.route, self._explorer.ended
        else:
            self._path, self._ended = self._pose_model.estimate[None, :2], "invalid"
        terminated = self._explorer.done
        outcome = StepOutcome(
            distance=self._distance - before[0],
            coverage=self._coverage.share - before[1],
            measurement=self._explorer.scans - before[2],
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
        return self._explorer.observation(), reward, terminated, truncated, info

    def action_masks(self) -> np.ndarray:
        """(max_nodes,) bool: which actions are valid (the name that sb3-contrib's MaskablePPO looks for)."""
        if self._world is None:
            raise gymnasium.error.ResetNeeded("call reset() before action_masks()")
        return self._explorer.action_masks()

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
        for i, heading in enumerate(self._explorer.start_headings(self._world.pose[2], all_round)):
            if i:
                self._take(self._world.drive(self._world.pose[None, :2], heading))
            self._explorer.insert(self._measure())
        self._explorer.plan()

    def _go(self, node: int) -> None:
        """Drive to a node and measure there, on the way too if so configured."""
        explorer, start = self._explorer, self._distance
        leg: Leg | None = explorer.choose(node)
        self._parts = len(self._trajectory)
        while leg is not None:
            result = self._drive(leg)
            rest = np.concatenate((self._pose_model.estimate[None, :2], leg.route[result.next_vertex :]))
            if result.ended not in ("arrived", "cut"):
                # A bump ends the drive, but the robot can still look where it wanted to.
                self._drive(explorer.stopped(result.ended, self._pose_model.estimate, result.contact))
            look, plans = self._measure(), explorer.plans
            came, halt = self._way()
            if result.ended == "cut":
                leg = explorer.passing(look, rest=rest, driven=self._distance - start, came=came, halt=halt)
            else:
                leg = explorer.arrived(look, came=came, halt=halt)
            if explorer.plans > plans:
                self._parts = len(self._trajectory)

    def _drive(self, leg: Leg) -> DriveResult:
        """Drive a leg, which is in the frame of the estimate."""
        assert self._world is not None
        path = self._pose_model.to_true(leg.path)
        path[0] = self._world.pose[:2]
        heading = leg.heading
        if heading is not None:
            heading = self._pose_model.to_true(np.array([[0.0, 0.0, heading]]))[0, 2]
        return self._take(self._world.drive(path, heading, distance=leg.distance, turn=leg.turn))

    def _take(self, result: DriveResult) -> DriveResult:
        """Take over what a drive did."""
        self._follow(result.trajectory)
        self._trajectory.append(result.trajectory)
        self._distance += result.distance
        self._sim_time += result.duration
        self._collisions += int(result.collided)
        return result

    def _way(self) -> tuple[np.ndarray, np.ndarray]:
        """As the robot knows them: the way (k, 2) since paths were planned last, and where it can halt (2,)."""
        assert self._world is not None
        to_estimated = self._pose_model.to_estimated
        came = to_estimated(np.concatenate((*self._trajectory[self._parts :], self._world.pose[None]))[:, :2])
        return came, to_estimated(self._world.halt[None])[0]

    def _follow(self, way: np.ndarray) -> None:
        """Advance the estimated pose along true poses (m, 3); in the mode slam it is corrected on the way."""
        done = 0
        if self.config.pose.mode == "slam":
            way, stops = with_stops(way, self.config.pose.correct_every)
            for stop in stops:
                self._pose_model.moved(way[done : stop + 1])
                self._look(way[stop])
                done = stop
        self._pose_model.moved(way[done:])

    def _look(self, pose: np.ndarray) -> Look:
        """A scan from a true pose; in the mode slam it corrects the estimated one."""
        assert self._world is not None
        ranges = self._world.laser.measure(self._world.segments, pose, self._laser_rng)
        look = self._explorer.look(ranges, *self._pose_model.measured(pose))
        if self.config.pose.mode == "slam":
            self._pose_model.correct(look.pose, look.covariance)
        return look

    def _measure(self) -> Look:
        """Scan from where the robot is."""
        assert self._world is not None
        pose = self._world.pose
        look = self._look(pose)
        self._coverage.add(self._world.segments, pose, self.config.sensor)
        self._scan = look.scan
        self._measured_at.append(pose)
        return look

    def _info(self, outcome: StepOutcome, *, invalid: bool, truncated: bool) -> dict[str, Any]:
        return {
            **self._explorer.info(truncated),
            "distance": self._distance,
            "coverage": self._coverage.share,
            "sim_time": self._sim_time,
            "collisions": self._collisions,
            # No array: Gymnasium's vector environments stack arrays, and the paths differ in length.
            "path": tuple(map(tuple, self._path.tolist())),
            "rewards": rewards(outcome, self.config.reward),
            "invalid_action": invalid,
            "ended": self._ended,
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
        return self._explorer.exploration

    @property
    def line_map(self) -> LineMap:
        """The line map of this episode."""
        return self._explorer.line_map

    @property
    def explorer(self) -> Explorer:
        """What the robot knows, and what it is about to do."""
        return self._explorer

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
        from polyexplore_gym.outline import explored

        if self._world is None:
            raise gymnasium.error.ResetNeeded("call reset() before floor_plan()")
        return explored(self._explorer.beams(), self._explorer.line_map, self.config.sensor, name)

    def snapshot(self) -> Snapshot:
        """This moment as plain arrays, for `polyexplore_gym.rendering`."""
        from polyexplore_gym.exploration import shapes

        e, lines = self.exploration, self.line_map
        rows = self._explorer.observed.rows
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
            measurements=self._explorer.scans,
            title=self.plan.name,
        )


def _suite(name: str) -> Suite:
    if name not in list_suites():
        raise InvalidConfigError(f"unknown suite {name!r}; known: {', '.join(list_suites())}")
    return suite_named(name)
