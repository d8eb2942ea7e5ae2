"""The explorer without the environment: the simulator's scans and poses go in, and the same choices come out."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import shapely

from baselines import make_policy
from polyexplore_gym import observation
from polyexplore_gym.config import EnvConfig, RobotConfig, SensorConfig, from_mapping
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.errors import InvalidActionError, InvalidConfigError, InvalidScanError
from polyexplore_gym.exploration import shapes
from polyexplore_gym.explorer import Explorer, Leg
from polyexplore_gym.floorplan import FloorPlan, generate
from polyexplore_gym.mapping import read_log
from polyexplore_gym.routes import cut_off, length, rest_of
from polyexplore_gym.scan import beam_angles, carried, filled, on_beams
from polyexplore_gym.sim.pose import PoseModel, with_stops
from polyexplore_gym.sim.world import DriveResult, World

SENSING = {
    "stops": {},
    "passing": {"scan_every": 0.5},
    "settled": {"scan_every": 0.5, "decide": "settled"},
    "interval": {"scan_every": 0.5, "decide": "interval", "decide_every": 1.5},
}


def config(drive: str, sensing: str, placement: str = "midpoint", pose: str = "exact") -> EnvConfig:
    exploration = {**SENSING[sensing], "placement": placement}
    return from_mapping(EnvConfig, {"drive": {"mode": drive}, "exploration": exploration, "pose": {"mode": pose}})


MOUNT = (0.12, -0.05, 2.0)


def on_robot(pose: np.ndarray) -> np.ndarray:
    """The pose of a laser at `MOUNT`, by complex numbers."""
    place = complex(*pose[:2]) + complex(*MOUNT[:2]) * np.exp(1j * pose[2])
    return np.array([place.real, place.imag, pose[2] + MOUNT[2]])


class SimulatedRobot:
    """What a robot's own software does: drives legs, takes scans, knows a pose. `tells` more than it has to, or not."""

    def __init__(self, plan: FloorPlan, config: EnvConfig, seed: int, *, tells: bool, aside: bool = False) -> None:
        _, start_rng, self.laser_rng, pose_rng = gymnasium.utils.seeding.np_random(seed)[0].spawn(4)
        start = plan.sample_start(start_rng, config.robot.radius)
        self.explorer, self.config, self.tells = Explorer(config, MOUNT if aside else (0, 0, 0)), config, tells
        self.laser_at = on_robot if aside else np.array
        robot = RobotConfig(max_speed=self.explorer.max_speed)
        self.world = World(plan.segments, robot, config.sensor, config.drive, start)
        self.pose = PoseModel(config.pose, start, pose_rng)
        self.track, self.driven = [self.world.pose[None]], 0.0

    def look(self, at: np.ndarray) -> Any:
        ranges = self.world.laser.measure(self.world.segments, self.laser_at(at), self.laser_rng)
        look = self.explorer.look(ranges, *self.pose.measured(at))
        if self.config.pose.mode == "slam":
            self.pose.correct(look.pose, look.covariance)
        return look

    def drive(self, leg: Leg) -> DriveResult:
        path = self.pose.to_true(leg.path)
        path[0] = self.world.pose[:2]
        heading = None if leg.heading is None else self.pose.to_true(np.array([[0.0, 0.0, leg.heading]]))[0, 2]
        return self.moved(self.world.drive(path, heading, distance=leg.distance, turn=leg.turn))

    def moved(self, result: DriveResult) -> DriveResult:
        way, done = result.trajectory, 0
        if self.config.pose.mode == "slam":
            way, stops = with_stops(way, self.config.pose.correct_every)
            for stop in stops:
                self.pose.moved(way[done : stop + 1])
                self.look(way[stop])
                done = stop
        self.pose.moved(way[done:])
        self.track.append(result.trajectory)
        self.driven += result.distance
        return result

    def begin(self) -> None:
        for i, heading in enumerate(self.explorer.start_headings(self.world.pose[2])):
            if i:
                self.moved(self.world.drive(self.world.pose[None, :2], heading))
            self.explorer.insert(self.look(self.world.pose))
        self.explorer.plan()

    def go(self, action: int) -> None:
        explorer, begun = self.explorer, self.driven
        leg: Leg | None = explorer.choose(action)
        self.track = []
        while leg is not None:
            result = self.drive(leg)
            rest = np.concatenate((self.pose.estimate[None, :2], leg.route[result.next_vertex :]))
            if result.ended not in ("arrived", "cut"):
                self.drive(explorer.stopped(result.ended, self.pose.estimate, result.contact))
            look, plans = self.look(self.world.pose), explorer.plans
            told: dict[str, Any] = {"halt": self.pose.to_estimated(self.world.halt[None])[0]}
            if self.tells:
                way = np.concatenate((*self.track, self.world.pose[None]))[:, :2]
                told["came"] = self.pose.to_estimated(way)
            if result.ended == "cut":
                more = {"rest": rest, "driven": self.driven - begun} if self.tells else {}
                leg = explorer.passing(look, **told, **more)
            else:
                leg = explorer.arrived(look, **told)
            if explorer.plans > plans:
                self.track = []


def both(plan: FloorPlan, c: EnvConfig, policy: str, *, seed: int = 3, decisions: int = 30, tells: bool = True) -> int:
    """Explore with the environment and without it; all that a policy sees and chooses is the same. How many choices."""
    env = PolyExploreEnv(plan, config=c)
    robot = SimulatedRobot(plan, c, seed, tells=tells)
    chooser, rngs = make_policy(policy), [np.random.default_rng(0) for _ in range(2)]
    seen, info = env.reset(seed=seed)
    over = False
    robot.begin()
    for k in range(decisions):
        told, known = robot.explorer.observation(), robot.explorer.info()
        assert all(np.array_equal(seen[key], told[key]) for key in seen)
        keys = known.keys() - {"action_mask"} - (set() if k else {"path"})  # at the start there is none
        assert {key: info[key] for key in keys} == {key: known[key] for key in keys}
        assert np.array_equal(info["action_mask"], known["action_mask"])
        if robot.explorer.done:
            assert over
            return k
        action = chooser.act(seen, info, rngs[0])
        assert chooser.act(told, known, rngs[1]) == action
        seen, _, over, _, info = env.step(action)
        robot.go(action)
        assert np.array_equal(robot.world.pose, env.true_pose)
    return decisions


@pytest.mark.parametrize("placement", ["midpoint", "in_front"])
@pytest.mark.parametrize("sensing", SENSING)
def test_it_chooses_as_the_environment_does(sensing, placement):
    made = 0
    for drive, pose in (
        ("kinematic", "exact"),
        ("physics", "gaussian"),
        ("physics", "slam"),
        ("kinematic", "odometry"),
    ):
        made += both(generate("home", 6), config(drive, sensing, placement, pose), "ekman_ratio")
    assert made > 40


@pytest.mark.parametrize("policy", ["nearest", "random", "tour"])
def test_any_policy_chooses_from_it(policy):
    assert both(generate("angled", 3), config("physics", "settled"), policy) > 10


@pytest.mark.parametrize("placement", ["midpoint", "in_front"])
@pytest.mark.parametrize("sensing", SENSING)
def test_scan_pose_and_halt_are_enough(sensing, placement):
    """What is left of the route, the way driven and its length it finds itself: on an exact path, exactly."""
    assert both(generate("home", 6), config("kinematic", sensing, placement), "nearest", tells=False) >= 7


@pytest.mark.parametrize("aside", [False, True], ids=["middle", "aside"])
@pytest.mark.parametrize("pose", ["exact", "gaussian", "slam"])
def test_a_robot_that_tells_little_sees_all(pose, aside):
    """Also one with its laser aside, turned by 115 degrees: it turns so that the laser looks where it should."""
    plan = generate("home", 8)
    for c in (config("physics", "settled", pose=pose), config("kinematic", "stops", "in_front", pose)):
        robot = SimulatedRobot(plan, c, 1, tells=False, aside=aside)
        robot.begin()
        nearest = make_policy("nearest")
        while not robot.explorer.done:
            assert robot.explorer.plans < 200
            robot.go(nearest.act(robot.explorer.observation(), robot.explorer.info(), np.random.default_rng(0)))
        assert robot.explorer.outcome()["status"] == "complete"
        seen = shapes.exploration_polygon(robot.explorer.exploration)
        floor = shapely.Polygon(plan.exterior, plan.holes)
        assert seen.buffer(0.1).intersection(floor).area > 0.97 * floor.area
        assert seen.difference(floor.buffer(0.25)).area < 0.01 * floor.area
        off = robot.pose.estimate - robot.world.pose
        assert np.hypot(*off[:2]) < (1e-9 if pose == "exact" else 0.1)
        assert abs(math.remainder(off[2], math.tau)) < (1e-9 if pose == "exact" else 0.05)


def test_the_laser_need_not_be_the_middle_of_the_robot():
    rng, mount = np.random.default_rng(0), np.array(MOUNT)
    for _ in range(20):
        pose, spread = rng.uniform(-3, 3, 3), rng.standard_normal((3, 3)) * 1e-3
        covariance = spread @ spread.T
        at, moved = carried(pose, covariance, mount)
        assert at[:2] == pytest.approx(on_robot(pose)[:2])
        assert math.cos(at[2] - on_robot(pose)[2]) == pytest.approx(1.0)
        back, again = carried(at, moved, mount, back=True)
        assert back[:2] == pytest.approx(pose[:2])
        assert math.cos(back[2] - pose[2]) == pytest.approx(1.0)
        assert again == pytest.approx(covariance, abs=1e-15)
        drawn = np.array([on_robot(pose + spread @ rng.standard_normal(3)) for _ in range(4000)])
        assert np.cov(drawn.T) == pytest.approx(moved, rel=0.15, abs=0.1 * np.trace(moved))
    with pytest.raises(InvalidConfigError, match="mount"):
        Explorer(mount=(0.0, math.nan, 0.0))


def test_either_frame_can_be_asked_for():
    views = {}
    for relative in (False, True):
        env = PolyExploreEnv(generate("home", 6), config={"observation": {"relative": relative}})
        seen, info = env.reset(seed=1)
        seen, *_ = env.step(int(info["action_mask"].argmax()))
        views[relative] = env.explorer.observation(not relative)
        assert all(np.array_equal(seen[key], value) for key, value in env.explorer.observation().items())
        assert all(np.array_equal(seen[key], value) for key, value in env.explorer.observation(relative).items())
        if relative:
            assert all(np.array_equal(seen[key], value) for key, value in views[False].items())
    assert not np.array_equal(views[True]["node_position"], views[False]["node_position"])


def test_what_is_left_of_a_route():
    route = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 3.0], [5.0, 3.0]])
    for along, left in (((0.0, 0.0), 3), ((1.2, 0.1), 3), ((2.1, 0.5), 2), ((2.2, 3.1), 1), ((5.0, 3.0), 1)):
        rest = rest_of(route, np.array([along]))
        assert np.array_equal(rest[0], along)
        assert np.array_equal(rest[1:], route[len(route) - left :])
    assert np.array_equal(rest_of(route[:1], np.array([[0.3, 0.2]])), [[0.3, 0.2]])


def test_the_beginning_of_a_path():
    path = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]])
    for way, end in ((1.0, [1.0, 0.0]), (3.0, [3.0, 0.0]), (5.0, [3.0, 2.0])):
        cut, whole = cut_off(path, way)
        assert not whole
        assert cut[-1] == pytest.approx(end)
        assert length(cut) == pytest.approx(way)
    assert cut_off(path, 7.0)[1]
    assert cut_off(path, 8.0)[0] is path


def room(explorer: Explorer, side: float = 6.0) -> np.ndarray:
    """Ranges of a square room's walls from its middle."""
    c, s = np.abs(np.cos(explorer.angles)), np.abs(np.sin(explorer.angles))
    return 0.5 * side / np.maximum(c, s)


def test_unusable_input_is_named():
    explorer = Explorer({"sensor": {"beams": 181}})
    ranges, pose = room(explorer), np.zeros(3)
    with pytest.raises(InvalidScanError, match="no scan so far"):
        explorer.plan()
    with pytest.raises(InvalidScanError, match="no scan so far"):
        assert explorer.done  # nothing known is not all known
    with pytest.raises(InvalidScanError, match="needs the covariance"):
        Explorer({"sensor": {"beams": 181}, "pose": {"mode": "slam"}}).look(ranges, pose)
    for bad, at, covariance, match in (
        (ranges[1:], pose, None, "expected 181 numbers"),
        (ranges.astype(str), pose, None, "expected 181 numbers"),
        (ranges, pose[:2], None, "pose .*shape"),
        (ranges, [0.0, math.nan, 0.0], None, "pose .*finite"),
        (ranges, pose, np.full((3, 3), math.inf), "covariance .*finite"),
        (ranges, pose, np.zeros(3), "covariance .*shape"),
        (ranges, pose, -0.01 * np.eye(3), "covariance .*positive semidefinite"),
        (ranges, pose, 0.01 * np.eye(3, k=1), "covariance .*symmetric"),
        (np.full(181, math.nan), pose, None, "no beam says anything"),
    ):
        with pytest.raises(InvalidScanError, match=match):
            explorer.look(bad, at, covariance)
    with pytest.raises(InvalidConfigError, match="beems"):
        Explorer({"sensor": {"beems": 3}})
    explorer.insert(explorer.look(ranges, pose))
    explorer.plan()
    for call in (explorer.passing, explorer.arrived, lambda look: explorer.stopped("bump", pose)):
        with pytest.raises(InvalidActionError, match="no drive is under way"):
            call(explorer.look(ranges, pose))
    for action in (-1, 64, 63, 0.0, None, True):
        with pytest.raises(InvalidActionError, match=f"action {action}: no node"):
            explorer.choose(action)


def test_readings_that_say_nothing_open_no_way_and_close_none():
    """A room with a dead beam here and there is a room; with a dead quarter it has to be looked at again."""
    sensor = {"beams": 720, "field_of_view": 2 * math.pi}
    whole = Explorer({"sensor": sensor})
    whole.insert(whole.look(room(whole), np.zeros(3)))
    whole.plan()
    assert whole.done
    for unknown in (math.nan, 0.0, -1.0):
        dead = Explorer({"sensor": sensor})
        ranges = room(dead)
        ranges[[0, 5, 6, 300, 719]] = unknown
        dead.insert(dead.look(ranges, np.zeros(3)))
        dead.plan()
        assert dead.done
        quarter = Explorer({"sensor": sensor})
        ranges = room(quarter)
        ranges[100:280] = unknown
        quarter.insert(quarter.look(ranges, np.zeros(3)))
        quarter.plan()
        assert not quarter.done
        assert quarter.line_map.rho.size >= 3
        quarter.insert(quarter.look(ranges, np.array([0.0, 0.0, math.pi])))
        quarter.plan()
        assert quarter.done


def test_filled_ranges_claim_no_more_than_is_known():
    """Against its twin, beam by beam."""
    rng = np.random.default_rng(0)
    for view, beams in ((math.pi, 31), (2 * math.pi, 40), (1.0, 12)):
        sensor = SensorConfig(beams=beams, field_of_view=view)
        for _ in range(50):
            ranges = rng.uniform(0.3, 9.0, beams)
            ranges[ranges > 8.0] = math.inf
            ranges[rng.random(beams) < rng.choice([0.1, 0.5, 0.9])] = math.nan
            out = filled(ranges, sensor, 0.5, 0.25)
            assert not np.isnan(out).any()
            for i in range(beams):
                if not math.isnan(ranges[i]):
                    assert out[i] == ranges[i]
                    continue
                ends = []
                for way in (-1, 1):
                    k = i + way
                    while (sensor.full_circle or 0 <= k < beams) and math.isnan(ranges[k % beams]) and k % beams != i:
                        k += way
                    ends.append(k if sensor.full_circle or 0 <= k < beams else None)
                wanted = 0.25
                if None not in ends and not math.isnan(ranges[ends[0] % beams]):
                    near = min(ranges[k % beams] for k in ends)
                    if min(near, 8.0) * (ends[1] - ends[0]) * sensor.resolution <= 0.5:
                        wanted = near
                assert out[i] == wanted


def test_beams_of_another_scanner():
    """As drivers give them: from 0 to a full turn, backwards, coarser; each wanted beam gets the nearest reading."""
    rng = np.random.default_rng(1)
    sensor = SensorConfig(beams=90, field_of_view=2 * math.pi)
    wanted = beam_angles(sensor)
    for given in (np.arange(90) * math.tau / 90, wanted[::-1] + 0.01, np.linspace(-1.0, 1.0, 50), wanted[10:11]):
        ranges = rng.uniform(1, 5, len(given))
        got = on_beams(given, ranges, sensor)
        for angle, reading in zip(wanted, got, strict=True):
            off = np.abs(np.remainder(given - angle + math.pi, math.tau) - math.pi)
            if math.isnan(reading):
                assert off.min() > 0.75 * sensor.resolution - 1e-9
            else:
                assert off[ranges == reading].min() == pytest.approx(off.min(), abs=1e-9)
    ranges = rng.uniform(1, 5, 90)
    assert np.array_equal(on_beams(wanted, ranges, sensor), ranges)


DATA = Path(os.environ.get("POLYEXPLORE_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
LOG = DATA / "laser_logs" / "intel-corrected.log.gz"


@pytest.mark.skipif(not LOG.exists(), reason="needs the real laser logs")
def test_a_real_log_gives_nodes_and_ways_that_keep_clear_of_its_walls():
    log = read_log(LOG)
    angles = log.angles[0]
    sensor = {"beams": len(angles), "field_of_view": float(np.ptp(angles)), "max_range": 8.0, "sigma_range": 0.02}
    explorer = Explorer({"sensor": sensor, "mapping": {"range_floor": 0.01}, "pose": {"mode": "gaussian"}})
    covariance, last = np.diag([0.03, 0.03, 0.006]) ** 2, None
    nearest, space = make_policy("nearest"), observation.space(explorer.config.observation)
    for at, ranges in zip(log.poses, log.ranges, strict=True):
        if (
            last is not None
            and math.dist(at[:2], last[:2]) < 0.5
            and abs(math.remainder(at[2] - last[2], 6.2832)) < 0.5
        ):
            continue
        last = at
        explorer.insert(explorer.look(on_beams(angles - angles.mean(), ranges, explorer.config.sensor), at, covariance))
        explorer.plan()
        seen = explorer.observation()
        assert space.contains(seen)
        if explorer.done:
            continue
        leg = explorer.choose(nearest.act(seen, explorer.info(), np.random.default_rng(0)))
        assert leg.path[0] == pytest.approx(at[:2])
        way = shapely.LineString(leg.path[1:]) if len(leg.path) > 2 else shapely.Point(leg.path[-1])
        walls = shapely.MultiLineString(list(explorer.line_map.segments[explorer.line_map.alive].reshape(-1, 2, 2)))
        # (From the first point it first has to get away from walls that it stands too near to.)
        assert way.distance(walls) > 0.8 * explorer.config.robot.radius
        if explorer.scans == 40:
            break
    assert explorer.line_map.line_alive.sum() > 30
    assert explorer.action_masks().sum() > 5
