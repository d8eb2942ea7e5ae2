"""The robot's side of an exploration: scans and poses in, maps, nodes and the next way out. No simulator, no truth.

The environment is built on it. On a robot it is used as it stands; `drive` is the robot's own and returns "arrived",
"cut" (the leg's distance or turn is used up) or what stopped it:

    explorer = Explorer({"preset": "turtlebot3", "exploration": {"scan_every": 0.5, "decide": "settled"}})
    for heading in explorer.start_headings(pose[2]):
        ...                                                  # turn there
        explorer.insert(explorer.look(ranges, pose, covariance))
    explorer.plan()
    while not explorer.done:
        leg = explorer.choose(policy.act(explorer.observation(), explorer.info(), rng))
        while leg is not None:
            ended = drive(leg)
            if ended not in ("arrived", "cut"):
                drive(explorer.stopped(ended, pose))         # turns to where it wanted to look
            look = explorer.look(ranges, pose, covariance)
            leg = explorer.passing(look) if ended == "cut" else explorer.arrived(look)
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from polyexplore_gym.config import EnvConfig, ObservationConfig, from_mapping
from polyexplore_gym.disc import contact_along
from polyexplore_gym.errors import InvalidActionError, InvalidConfigError, InvalidScanError
from polyexplore_gym.exploration import ExplorationMap, Remains
from polyexplore_gym.mapping import Beams, Correction, LineMap, Localizer, ScanLines, extract_lines
from polyexplore_gym.observation import Observed, observe
from polyexplore_gym.routes import cut_off, length, rest_of
from polyexplore_gym.scan import Scan, beam_angles, carried, filled, readings

_SCAN_TURN = 0.5 * math.pi
"""Scans on the way are also taken after so much turning (rad) or half the field of view, if that is less."""
_CREEP, _HALT = 0.4, 0.1
"""A robot that decides on the way looks again before its disc enters what no scan has shown, and in there after so many
radii at a time; it can halt so many radii behind that place. Tuned: few bumps for little time."""


def _is_covariance(matrix: np.ndarray) -> bool:
    """Whether a matrix (3, 3) is symmetric and positive semidefinite, but for rounding."""
    small = 1e-9 * np.abs(matrix).max()
    return bool(np.abs(matrix - matrix.T).max() <= small and np.linalg.eigvalsh(matrix)[0] >= -small)


class Leg(NamedTuple):
    """What to drive until the next scan."""

    path: np.ndarray
    """(k, 2) the way, from where the robot is, m; to be at rest at its end. One point: turn on the spot."""
    heading: float | None
    """Where to turn to at its end, rad; None: there is no need to, the route goes on."""
    distance: float
    """Scan after so much way, m, without stopping: the leg is cut there. inf: at its end."""
    turn: float
    """Scan after so much turning, too, rad."""
    route: np.ndarray
    """(m, 2) the whole way to the node; `path` is its beginning."""


@dataclass(frozen=True, slots=True)
class Look:
    """One scan, what lines it shows and what they say of the pose."""

    scan: Scan
    """Readings at the laser's corrected pose; what is unknown claims nothing (`scan.filled`)."""
    lines: ScanLines
    """In the laser's frame."""
    smoothed: np.ndarray
    """(n,) ranges, m, on a line where the nominal beam meets it."""
    correction: Correction
    """The laser's pose as the walls correct it, if `pose.mode` is "slam", else as it was given."""
    pose: np.ndarray
    """(3,) the robot's corrected x, y (m) and heading (rad)."""
    covariance: np.ndarray
    """(3, 3) its covariance, m2, m rad, rad2."""


class Explorer:
    """Owner of what a robot knows while it explores: the line map, the exploration map, and what it is about to do.

    It is told of scans (`look`, then `insert`, `passing` or `arrived`) and of what stopped a drive (`stopped`), and
    says where to drive (`choose`, `passing`). Poses are those of the middle of the body.
    """

    def __init__(
        self, config: EnvConfig | Mapping[str, Any] | None = None, mount: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> None:
        """Begin an exploration in which nothing is known.

        Args:
            config: as the environment's; of use are `sensor`, `robot`, `mapping`, `exploration`, `observation`, and
                `pose.mode`: "exact" or "gaussian" if a localiser gives poses with independent errors, "odometry" if
                they drift, "slam" if they drift and are to be corrected by the walls.
            mount: x, y (m) and heading (rad) of the laser in the robot's frame.

        Raises:
            InvalidConfigError: a field is unknown or out of range, or the mount is no pose.
        """
        c = config if isinstance(config, EnvConfig) else from_mapping(EnvConfig, {} if config is None else config)
        self.config = c
        self.mount = np.array(mount, np.float64)
        if self.mount.shape != (3,) or not np.isfinite(self.mount).all():
            raise InvalidConfigError(f"mount = {mount!r}: must be x, y (m) and heading (rad) of the laser")
        self.angles = beam_angles(c.sensor)
        """(n,) the beams that `look` expects, rad in the laser's frame."""
        self._mapping = c.mapping.resolved(c.robot.radius)
        self.line_map = LineMap(self._mapping, c.sensor)
        self.exploration = ExplorationMap(c.exploration, c.sensor, c.robot.radius)
        self.localizer = Localizer() if c.pose.mode == "slam" else None
        self.scans = 0
        """Scans taken into the maps."""
        self.plans = 0
        """How often paths were planned."""
        self.ended = "start"
        """Why the last drive ended: "arrived", "settled", "interval", "blocked", or what `stopped` was told."""
        self.route = np.zeros((1, 2))
        """(m, 2) the way to the node chosen last, as it was planned last, m."""
        self._target, self._chosen_heading, self._heading = -1, 0.0, 0.0
        self._driven, self._came = 0.0, [np.zeros((1, 2))]
        self._stopped = False
        self._way: np.ndarray | None = None
        self._covariances: list[np.ndarray] = []
        self._look: Look | None = None
        self._observed: Observed | None = None

    # Scans ------------------------------------------------------------------------------------

    def look(self, ranges: np.ndarray, pose: np.ndarray, covariance: np.ndarray | None = None) -> Look:
        """Find the lines of a scan, and correct the pose by them in the mode "slam". Goes into no map yet.

        Args:
            ranges: (n,) m, of the beams `angles`; inf, or the maximum range and more: nothing met; NaN, zero and
                negative: unknown. (`polyexplore_gym.scan.on_beams` takes over readings of other beams.)
            pose: (3,) x, y (m) and heading (rad) of the robot in the map frame when it was taken.
            covariance: (3, 3) of the pose, m2, m rad, rad2; None: exact (not with "slam").

        Raises:
            InvalidScanError: an array has another shape, the pose or its covariance is not finite or none at all, the
                covariance is missing in the mode "slam", or no beam says anything.
        """
        if covariance is None and self.localizer is not None:
            raise InvalidScanError('pose.mode "slam" needs the covariance of the pose: by how much it may be corrected')
        ranges, pose = np.asarray(ranges), np.array(pose, np.float64)
        covariance = np.zeros((3, 3)) if covariance is None else np.array(covariance, np.float64)
        sensor = self.config.sensor
        if ranges.shape != (sensor.beams,) or ranges.dtype.kind not in "fiu":
            raise InvalidScanError(f"ranges of shape {ranges.shape}: expected {sensor.beams} numbers (sensor.beams)")
        for name, array, shape in (("pose", pose, (3,)), ("covariance", covariance, (3, 3))):
            if array.shape != shape or not np.isfinite(array).all():
                raise InvalidScanError(f"{name} {array.tolist()}: expected finite numbers of shape {shape}")
        if covariance.any() and not _is_covariance(covariance):
            raise InvalidScanError(f"covariance {covariance.tolist()}: must be symmetric and positive semidefinite")
        if not (ranges > 0.0).any():
            raise InvalidScanError("no beam says anything, neither wall nor free: is the laser on?")
        found = extract_lines(self.angles, ranges, sensor, self._mapping)
        pose, covariance = carried(pose, covariance, self.mount)
        if self.localizer is None:
            fix = Correction.none(pose, covariance)
        else:
            fix = self.localizer.correct(found, self.line_map, pose, covariance)
        limits = sensor, self.exploration.tol.gap, self.config.robot.radius
        scan = Scan(
            self.angles, filled(readings(ranges, sensor), *limits), fix.pose, fix.covariance, sensor.full_circle
        )
        robot = carried(fix.pose, fix.covariance, self.mount, back=True)
        return Look(scan, found, filled(found.smoothed, *limits), fix, *robot)

    def insert(self, look: Look, target: int | None = None, *, arrived: bool = True) -> None:
        """Take a scan into both maps; `target`: id of the jump edge that the robot set out to measure by it."""
        drifting = self.config.pose.mode == "odometry"
        lines, fix = self.line_map, look.correction
        touched = lines.insert(look.lines, fix.pose, fix.relative, drifting=drifting)
        if self.localizer is not None:
            self.localizer.learn(lines)
        self.exploration.insert(
            look.scan, lines.segments, lines.alive, touched, point_segment=look.lines.point_segment,
            ranges=look.smoothed, target=target, arrived=arrived,
        )  # fmt: skip
        if len(self._covariances) < self.exploration.n_scans:  # else the scan showed nothing new and is not kept
            self._covariances.append(fix.relative)
        self._look, self._observed = look, None
        self.scans += 1

    def start_headings(self, heading: float, all_round: bool | None = None) -> list[float]:
        """Headings (rad) to scan in before the first choice: all round, or `heading` alone.

        Args:
            heading: of the robot, rad.
            all_round: None: as `exploration.look_around` says. (Where one scan shows no way, look all round.)
        """
        turns = 1
        if self.config.exploration.look_around if all_round is None else all_round:
            turns = math.ceil(2.0 * math.pi / self.config.sensor.field_of_view - 1e-9)
        return [heading + i * 2.0 * math.pi / turns for i in range(turns)]

    def plan(self, came: np.ndarray | None = None, halt: np.ndarray | None = None) -> None:
        """Bring nodes and paths up to date for a robot where the last scan was made.

        Args:
            came: (k, 2) the way driven since paths were planned last, m: the way back out of a tight place.
            halt: (2,) where the robot can come to rest at the earliest, m, if it moves: paths lead there first.
        """
        pose, lines = self._last.pose, self.line_map
        self.exploration.plan(pose, lines.segments, lines.alive, came, halt, lines.lone)
        self.plans += 1
        if self._target < 0:
            self.route = pose[None, :2]
        self._came = [pose[None, :2]]
        self._observed = None

    # Decisions --------------------------------------------------------------------------------

    @property
    def done(self) -> bool:
        """Whether no node can be reached: the exploration is over.

        Raises:
            InvalidScanError: no scan was taken in so far.
        """
        _ = self._last
        return not self.exploration.reachable.any()

    @property
    def observed(self) -> Observed:
        """The observation as it stands, with what it left out; not to be changed."""
        if self._observed is None:
            self._observed = self._observe(self.config.observation)
        return self._observed

    def _observe(self, config: ObservationConfig) -> Observed:
        look, reach = self._last, self.config.sensor.max_range
        return observe(self.exploration, self.line_map, look.pose, look.covariance, reach, config, self._target)

    def observation(self, relative: bool | None = None) -> dict[str, np.ndarray]:
        """What a policy gets, as from the environment; the caller's own to change.

        `relative`: seen from the robot or in the map frame; None: as `observation.relative` says.
        """
        config = self.config.observation
        if relative is None or relative == config.relative:
            return {key: value.copy() for key, value in self.observed.arrays.items()}
        return self._observe(dataclasses.replace(config, relative=relative)).arrays

    def action_masks(self) -> np.ndarray:
        """(max_nodes,) bool: which nodes can be chosen."""
        return self.observed.arrays["action_mask"].astype(bool)

    def outcome(self, budget: bool = False) -> dict[str, Any]:
        """How the exploration stands, and which jump edges (number and metres) it leaves; `budget`: it is used up."""
        if not budget and self.observed.arrays["action_mask"].any():
            return {"status": "running", **Remains(0, 0.0, 0, 0.0)._asdict()}
        left = self.exploration.remains()
        status = "budget" if budget else "unreached" if left.unreached or left.given_up else "complete"
        return {"status": status, **left._asdict()}

    def info(self, budget: bool = False) -> dict[str, Any]:
        """What a policy gets beside the observation: of the environment's `info` what a robot knows itself."""
        return {
            "action_mask": self.observed.arrays["action_mask"].copy(),
            "measurements": self.scans,
            "path": tuple(map(tuple, self.route.tolist())),
            "ended": self.ended,
            "outcome": self.outcome(budget),
            "cut": {"nodes": self.observed.cut_nodes, "lines": self.observed.cut_lines},
        }

    def beams(self) -> list[Beams]:
        """The scans that showed anything new, as `outline.explored` makes a floor plan of them and the line map."""
        scans = self.exploration.scans
        poses = np.column_stack((scans.apexes, scans.headings))
        return [
            Beams(scans.angles, np.hypot(*points.T), pose, covariance)
            for points, pose, covariance in zip(scans.points, poses, self._covariances, strict=True)
        ]

    @property
    def max_speed(self) -> float:
        """Drive no faster, m/s: one that decides on the way can then halt within the way between two scans."""
        robot, exploration = self.config.robot, self.config.exploration
        if exploration.decide == "arrival":
            return robot.max_speed
        return min(robot.max_speed, math.sqrt(2.0 * robot.max_acceleration * exploration.scan_every))

    def choose(self, action: int) -> Leg:
        """Set out for a node: what to drive first.

        Raises:
            InvalidActionError: no such node, or it cannot be reached.
        """
        mask = self.observed.arrays["action_mask"]
        if (
            isinstance(action, bool)
            or not isinstance(action, (int, np.integer))
            or not 0 <= action < len(mask)
            or not mask[action]
        ):
            valid = np.flatnonzero(mask).tolist()
            raise InvalidActionError(f"action {action}: no node that can be reached; those are {valid}")
        row, chains = int(self.observed.rows[action]), self.exploration.chains
        self._target = int(chains.id[row])
        self._heading = self._chosen_heading = self._robot_heading(row)
        self.route = self.exploration.path_to(row)
        self._driven, self._stopped = 0.0, False
        return self._leg(self.route)

    def passing(
        self,
        look: Look,
        *,
        rest: np.ndarray | None = None,
        driven: float | None = None,
        came: np.ndarray | None = None,
        halt: np.ndarray | None = None,
    ) -> Leg | None:
        """Take in a scan on the way: what to drive next, or None if it is time to choose again.

        Args:
            look: the scan.
            rest: (k, 2) what is left of the leg's route, from where the robot is, m. None: from the place of the scan
                on along the nearest part of the route.
            driven: way since the choice, m. None: along the route.
            came: (k, 2) the way since paths were planned last (`plans` counts that), m. None: along the route.
            halt: see `plan`.
        """
        exploration, lines, c = self.exploration, self.line_map, self.config.exploration
        here, route = look.pose[None, :2], self._under_way()
        rest = rest_of(route, here) if rest is None else rest
        passed = np.concatenate((route[:1], route[1 : len(route) - len(rest) + 1], here))
        self._driven = self._driven + length(passed) if driven is None else driven
        self._came.append(passed[1:])
        self.insert(look)
        if c.decide == "arrival":
            return self._leg(rest)
        if self._target not in exploration.chains.id:
            return self._decide("settled", came, halt)
        if c.decide == "interval" and self._driven >= c.decide_every - 1e-9:
            return self._decide("interval", came, halt)
        if not exploration.blocked(rest, lines.segments, lines.alive, lines.lone):
            return self._leg(rest)
        self.plan(np.concatenate(self._came) if came is None else came, halt)
        row = np.flatnonzero(exploration.chains.id == self._target)
        if not len(row) or not exploration.reachable[row[0]]:
            exploration.attempted(self._target)
            return self._decide("blocked", here, halt)
        self.route, self._heading = exploration.path_to(int(row[0])), self._robot_heading(int(row[0]))
        return self._leg(self.route)

    def stopped(self, why: str, pose: np.ndarray, bearing: float | None = None) -> Leg:
        """Something ended the drive before its time: how to turn, from where the robot is, to look all the same.

        The scan after it goes to `arrived`.

        Args:
            why: such as "bump", for `ended`.
            pose: (3,) where the robot is, m and rad.
            bearing: where on its rim it felt an obstacle, rad in its frame; paths will lead around that.
        """
        self._under_way()
        pose = np.asarray(pose, np.float64)
        if pose.shape != (3,) or not np.isfinite(pose).all():
            raise InvalidScanError(f"pose {pose.tolist()}: expected finite numbers of shape (3,)")
        if bearing is not None:
            self.exploration.bump(pose, bearing + pose[2])
        self.ended, self._stopped = why, True
        here = pose[None, :2]
        return Leg(here, self._chosen_heading, math.inf, math.inf, here)

    def arrived(self, look: Look, *, came: np.ndarray | None = None, halt: np.ndarray | None = None) -> Leg | None:
        """Take in the scan at the end of a drive; None: it is time to choose again. `came`, `halt`: see `passing`."""
        way = self._under_way()[: 0 if self._stopped else None]
        self.insert(look, self._target, arrived=not self._stopped)
        self._came += [way[1:], look.pose[None, :2]]
        return self._decide(self.ended if self._stopped else "arrived", came, halt)

    def _decide(self, ended: str, came: np.ndarray | None, halt: np.ndarray | None) -> Leg | None:
        """End a drive: plan for the next choice. There is no next leg."""
        self.ended, self._way = ended, None
        self.plan(np.concatenate(self._came) if came is None else came, halt)
        return None

    def _leg(self, route: np.ndarray) -> Leg:
        """What to drive of a route (k, 2) until it is time for a scan on the way."""
        c, radius, sensor = self.config.exploration, self.config.robot.radius, self.config.sensor
        self._way = route
        distance = turn = math.inf
        if c.scan_every > 0.0:
            if not sensor.full_circle:
                turn = min(_SCAN_TURN, 0.5 * sensor.field_of_view)
            if length(route) > 1.5 * c.scan_every:  # else the scan at the end will do
                distance = c.scan_every
        if c.decide == "arrival":
            return Leg(route, self._heading, distance, turn, route)
        seen = max(contact_along(self.exploration.pieces.segments, route, radius), _CREEP * radius)
        path, whole = cut_off(route, seen + _HALT * radius)
        return Leg(path, self._heading if whole else None, min(distance, seen), turn, route)

    def _under_way(self) -> np.ndarray:
        """The route driven at the moment (k, 2)."""
        if self._way is None:
            raise InvalidActionError("no drive is under way: choose() comes first")
        return self._way

    def _robot_heading(self, row: int) -> float:
        """How the robot must head at a node for the laser to look at its jump edge, rad."""
        return float(self.exploration.chains.node[row, 2] - self.mount[2])

    @property
    def _last(self) -> Look:
        if self._look is None:
            raise InvalidScanError("no scan so far: look() and insert() come first")
        return self._look
