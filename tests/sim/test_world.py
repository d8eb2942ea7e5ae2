import copy
import math
import pickle
from collections import Counter

import numpy as np
import pytest
import shapely
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from sim_scenes import (
    any_robot,
    boxed,
    clear_point,
    lines_of,
    load_polygon,
    polygon_walls,
    random_path,
    random_walls,
    shared_plans,
)

from polyexplore_gym.config import DriveConfig, RobotConfig, SensorConfig
from polyexplore_gym.errors import InvalidMotionError
from polyexplore_gym.sim.world import DriveResult, World

ROOM = boxed(np.empty((0, 4)), 5.0)
RADIUS = RobotConfig().radius


def make(mode: str, pose: tuple[float, float, float], walls: np.ndarray = ROOM, **drive: float) -> World:
    config = DriveConfig(mode=mode, **drive)  # type: ignore[arg-type]
    return World(walls, RobotConfig(), SensorConfig(), config, np.array(pose))


def gaps(walls: np.ndarray, trajectory: np.ndarray) -> np.ndarray:
    return shapely.distance(lines_of(walls), shapely.points(trajectory[:, :2])) - RADIUS


def way_gap(walls: np.ndarray, trajectory: np.ndarray, radius: float) -> float:
    """Smallest gap between the walls and the rim of the disc on its way, also between the poses."""
    points = trajectory[:, :2]
    way = shapely.linestrings(points) if len(points) > 1 else shapely.points(points[0])
    return float(shapely.distance(lines_of(walls), way)) - radius


both_modes = pytest.mark.parametrize("mode", ["physics", "kinematic"])


@both_modes
def test_drives_to_the_end_of_a_path(mode: str) -> None:
    world = make(mode, (0.0, 0.0, 0.0))
    path = np.array([[0.0, 0.0], [2.0, 1.0], [2.0, 1.0], [3.0, -2.0]])
    result = world.drive(path, 1.0)
    assert result.arrived
    assert not result.collided
    assert result.distance == pytest.approx(shapely.LineString(path).length, rel=0.01)
    np.testing.assert_allclose(world.pose, [3.0, -2.0, 1.0], atol=0.009)
    np.testing.assert_array_equal(result.trajectory[0], [0.0, 0.0, 0.0])
    np.testing.assert_array_equal(result.trajectory[-1], world.pose)
    assert result.distance == pytest.approx(np.hypot(*np.diff(result.trajectory[:, :2], axis=0).T).sum())


def test_kinematic_duration_is_the_sum_of_its_trapezoids() -> None:
    robot = RobotConfig()
    world = make("kinematic", (0.0, 0.0, 0.0))
    result = world.drive(np.array([[0.0, 0.0], [4.0, 0.0]]), math.pi / 2)
    ahead = 4.0 / robot.max_speed + robot.max_speed / robot.max_acceleration
    turn = 2 * math.sqrt(math.pi / 2 / robot.max_turn_acceleration)  # too short to reach the top rate
    assert result.duration == pytest.approx(ahead + turn)
    np.testing.assert_allclose(world.pose, [4.0, 0.0, math.pi / 2])


@both_modes
def test_turns_on_the_spot_and_stands_still(mode: str) -> None:
    world = make(mode, (1.0, 2.0, 3.0))
    result = world.drive(np.array([[1.0, 2.0]]), -3.0)  # the short way, across the seam
    assert result.arrived
    assert result.distance == 0.0
    assert abs(math.remainder(world.pose[2] + 3.0, 2 * math.pi)) < math.radians(0.5)
    assert result.duration < 1.0
    pose = world.pose
    assert world.drive(np.array([[1.0, 2.0]])).duration <= 0.04
    np.testing.assert_allclose(world.pose, pose, atol=1e-3)


@both_modes
@pytest.mark.parametrize("degrees", [90, 60, 35])
def test_bump_stops_the_drive_and_the_robot_can_leave(mode: str, degrees: float) -> None:
    world = make(mode, (4.0, 0.0, 0.0))
    angle = math.radians(90 - degrees)
    ahead = np.array([math.cos(angle), math.sin(angle)])
    result = world.drive(np.array([[4.0, 0.0], np.array([4.0, 0.0]) + 3.0 * ahead]), 2.0)
    assert result.collided
    assert not result.arrived
    contact = 0.75 / ahead[0] * ahead + [4.0, 0.0]
    assert math.hypot(*(world.pose[:2] - contact)) < 0.08
    assert 0.0 <= gaps(ROOM, world.pose[None])[0] < 1.1e-3
    # on the spot it may turn, into the wall it may not drive, away it may
    assert world.drive(world.pose[None, :2], 0.0).arrived
    again = world.drive(np.array([world.pose[:2], world.pose[:2] + np.array([1.0, 0.0])]))
    assert again.collided
    assert again.distance < 0.01
    back = world.drive(np.array([world.pose[:2], [2.0, -1.0]]), 0.5)
    assert back.arrived
    assert not back.collided


def test_grazing_along_a_wall_is_no_bump() -> None:
    world = make("physics", (0.0, -4.75, 0.0))
    result = world.drive(np.array([[0.0, -4.75], [3.0, -4.78]]))  # 3 cm into the wall over 3 m
    assert result.arrived
    assert not result.collided
    assert gaps(ROOM, result.trajectory).min() >= 0.0


@both_modes
@pytest.mark.parametrize("fast", [False, True])
def test_never_stands_in_a_wall_whatever_it_is_told(mode: str, fast: bool) -> None:
    rng = np.random.default_rng(5)
    robot = RobotConfig(max_speed=3.0, max_acceleration=3.0) if fast else RobotConfig()
    bumps = 0
    for _ in range(12):
        walls = boxed(random_walls(rng, 25, side=12.0), 7.0)
        start = clear_point(rng, walls, 6.0, RADIUS)
        world = World(walls, robot, SensorConfig(), DriveConfig(mode=mode), np.array([*start, 0.0]))  # type: ignore[arg-type]
        for k in range(20):
            pose = world.pose
            path = np.vstack([pose[:2], pose[:2] + np.cumsum(rng.uniform(-3, 3, (1 + k % 3, 2)), axis=0)])
            result = world.drive(path, rng.uniform(-3, 3) if k % 2 else None)
            bumps += result.collided
            assert way_gap(walls, result.trajectory, RADIUS) > -1e-8
            assert not (result.collided and result.arrived)
            assert result.collided or result.arrived  # nothing else ends a drive, and none hangs
    assert bumps > 50


def next_path(rng: np.random.Generator, world: World, rest: np.ndarray) -> np.ndarray:
    """From where the robot is: on along the rest of its path, anywhere, or anywhere by way of where it can halt."""
    here, kind = world.pose[:2], rng.integers(3)
    if kind == 0 and len(rest):
        return np.vstack([here, rest])
    steps = rng.normal(0.0, 12.0 * world.robot.radius, (rng.integers(1, 4), 2))
    return np.vstack([*([here, world.halt] if kind == 2 else [here]), here + np.cumsum(steps, axis=0)])


@both_modes
@pytest.mark.parametrize("cut", [False, True])
def test_walls_hold_whatever_the_robot(mode: str, cut: bool) -> None:
    """Any legal radius, speed, acceleration and step; the exact twin is shapely's distance of the whole way.

    With cuts: most drives are cut short, and the next begins at speed.
    """
    rng, bumps, long_steps, at_speed = np.random.default_rng(12), 0, 0, 0
    for _ in range(120 if cut else 250):
        robot, step = any_robot(rng)
        r = robot.radius
        room = boxed(random_walls(rng, 20, side=24.0), 14.0)
        pose = np.array([*clear_point(rng, room, 13.0, 1.0) * r, rng.uniform(-3, 3)])
        walls = room * r
        # where the centre may be, in one piece for each place that the disc cannot leave
        inside = shapely.box(*np.array([-14.0, -14.0, 14.0, 14.0]) * r).difference(lines_of(walls).buffer(r * 0.999))
        config = DriveConfig(mode=mode, time_step=step, time_limit=60.0)  # type: ignore[arg-type]
        world = World(walls, robot, SensorConfig(), config, pose)
        rest = np.empty((0, 2))
        for k in range(8 if cut else 4):
            at = world.pose[:2]
            path = np.vstack([at, at + np.cumsum(rng.normal(0.0, 12.0 * r, (1 + k % 3, 2)), axis=0)])
            short = {}
            if cut:
                path, short = next_path(rng, world, rest), {"distance": r * 10.0 ** rng.uniform(-2.0, 1.3)}
            result = world.drive(path, rng.uniform(-3, 3) if k % 2 else None, **short)
            rest = path[result.next_vertex :]
            at_speed += world.velocity[0] > 0.0
            bumps += result.collided
            long_steps += robot.max_speed * step > 2.0 * r
            points = result.trajectory[:, :2]
            assert way_gap(walls, result.trajectory, r) > -1e-6 * r
            part = [g for g in shapely.get_parts(inside) if g.contains(shapely.points(at))]
            assert part[0].contains(shapely.points(points[-1]))
            if mode == "physics":
                longest = np.hypot(*np.diff(points, axis=0).T).max(initial=0.0)
                assert longest <= robot.max_speed * step * (1 + 1e-9) + 1e-9 * r  # no wall throws it
            assert result.distance <= robot.max_speed * result.duration * (1 + 1e-9) + 1e-9 * r
            assert not (result.collided and result.arrived)
    assert bumps > (150 if cut else 300)
    assert long_steps > 100
    assert at_speed > 300 or not cut


@pytest.mark.parametrize("step", [0.005, 0.04])
def test_no_wall_throws_the_robot(step: float) -> None:
    """pymunk once spent in one long step the velocity by which it had removed an overlap in a short one."""
    rng, room = np.random.default_rng(13), boxed(np.empty((0, 4)), 5.0)
    robot = RobotConfig()
    for _ in range(60):
        at = np.array([rng.uniform(2.0, 4.7), rng.uniform(-4.0, 4.0)])
        world = make("physics", (*at, rng.uniform(-3, 3)), room, time_step=step)
        way = world.drive(np.array([at, [7.0, at[1] + rng.uniform(-3, 3)]])).trajectory
        assert np.hypot(*np.diff(way[:, :2], axis=0).T).max() <= robot.max_speed * step * (1 + 1e-9)
        assert (np.diff(way[:, 0])[way[1:, 0] > 4.74] >= -1e-12).all()  # at the wall it is only ever held


def test_a_bump_is_felt_as_soon_with_short_steps() -> None:
    times = []
    for step in (0.001, 0.005, 0.02, 0.04):
        world = make("physics", (4.7499, 0.0, 0.0), time_step=step)
        result = world.drive(np.array([[4.7499, 0.0], [6.0, 0.0]]))
        assert result.collided
        times.append(result.duration)
    assert max(times) - min(times) < 0.1


def scaled_drives(mode: str, scale: float) -> list[DriveResult]:
    """Ten drives among walls, everything that has a length made larger; times and angles as they are."""
    rng, out = np.random.default_rng(14), []
    for _ in range(10):
        walls = boxed(random_walls(rng, 20, side=9.0), 5.0)
        start, turn, goals = clear_point(rng, walls, 4.0, RADIUS), rng.uniform(-3, 3), rng.uniform(-4, 4, (3, 2))
        default = RobotConfig()
        robot = RobotConfig(
            radius=RADIUS * scale,
            track=default.track * scale,
            max_speed=default.max_speed * scale,
            max_acceleration=default.max_acceleration * scale,
        )
        pose = np.array([*(start * scale), turn])
        world = World(walls * scale, robot, SensorConfig(), DriveConfig(mode=mode), pose)  # type: ignore[arg-type]
        out.append(world.drive(np.vstack([start, goals]) * scale, turn))
        out.append(world.drive(np.vstack([world.pose[:2], goals[1] * scale])))  # from the wall, if it was held
    return out


@both_modes
@pytest.mark.parametrize("scale", [0.125, 8.0, 0.1, 0.4, 10.0])
def test_robot_plan_and_path_made_larger_give_the_same_drive_larger(mode: str, scale: float) -> None:
    exact = math.frexp(scale)[0] == 0.5  # a power of two: to the last bit
    bumps = 0
    for one, other in zip(scaled_drives(mode, 1.0), scaled_drives(mode, scale), strict=True):
        bumps += one.collided
        assert (one.collided, one.arrived) == (other.collided, other.arrived)
        assert one.trajectory.shape == other.trajectory.shape
        expected = one.trajectory * [scale, scale, 1.0]
        if exact:
            np.testing.assert_array_equal(other.trajectory, expected)
            assert (other.duration, other.contact) == (one.duration, one.contact)
        else:
            np.testing.assert_allclose(other.trajectory, expected, rtol=0.0, atol=1e-7 * scale)
            assert other.duration == pytest.approx(one.duration, rel=1e-9, abs=1e-6)
    assert bumps >= 5


@both_modes
def test_time_limit_gives_up_where_it_stands(mode: str) -> None:
    world = make(mode, (-4.0, 0.0, 0.0), time_limit=2.0)
    result = world.drive(np.array([[-4.0, 0.0], [4.0, 0.0]]), 1.0)
    assert result.duration == pytest.approx(2.0)
    assert not result.arrived
    assert not result.collided
    assert result.distance == pytest.approx(1.2, abs=0.05)  # half of 0.6 m/s2 over 2 s squared
    world = make(mode, (-4.0, 0.0, 0.0), time_limit=0.4)
    assert not world.drive(np.array([[-4.0, 0.0]]), 3.0).arrived
    assert 0.0 < world.pose[2] < 0.5


@both_modes
def test_drives_repeat_also_through_pickle(mode: str) -> None:
    rng = np.random.default_rng(9)
    walls = boxed(random_walls(rng, 20, side=9.0), 5.0)
    start = clear_point(rng, walls, 4.0, RADIUS)
    first = make(mode, (*start, 0.0), walls)
    goals = rng.uniform(-4, 4, (10, 2))
    second = make(mode, (*start, 0.0), walls)
    for goal in goals:
        a = first.drive(np.array([first.pose[:2], goal]))
        second = pickle.loads(pickle.dumps(second))
        b = second.drive(np.array([second.pose[:2], goal]))
        np.testing.assert_array_equal(a.trajectory, b.trajectory)


def in_pieces(
    rng: np.random.Generator, world: World, path: np.ndarray, heading: float | None
) -> tuple[list[DriveResult], list[tuple[float, float]]]:
    """A drive cut short at random until it ends by itself, and the velocities at the cuts."""
    pieces, velocities = [], []
    while not pieces or pieces[-1].ended == "cut":
        way, turn = world.robot.radius * 10.0 ** rng.uniform(-1.5, 1.5), 10.0 ** rng.uniform(-2.0, 1.0)
        pieces.append(world.drive(path, heading, distance=way, turn=turn))
        velocities.append(world.velocity)
        if world.config.mode == "kinematic":
            assert pieces[-1].distance <= way * (1 + 1e-12)
        path = np.vstack([world.pose[:2], path[pieces[-1].next_vertex :]])
    return pieces, velocities


@both_modes
def test_a_drive_in_pieces_is_the_whole(mode: str) -> None:
    """Cut at random, carried on along the rest of the path: the same way in the same time, also along walls."""
    rng, ends, turning, driving = np.random.default_rng(21), Counter(), 0, 0
    for t in range(300):
        robot, step = any_robot(rng) if t % 2 else (RobotConfig(), 0.04)
        r = robot.radius
        walls = boxed(random_walls(rng, 20, side=24.0), 14.0)
        path = random_path(rng, *((4.0, 16.0), (0.2, 2.4), (0.04, 0.6))[t % 3]) + clear_point(rng, walls, 13.0, 1.0)
        path, pose, heading = path * r, np.array([*path[0] * r, rng.uniform(-3, 3)]), rng.uniform(-3, 3)
        config = DriveConfig(mode=mode, time_step=step, time_limit=200.0)  # type: ignore[arg-type]
        one, other = (World(walls * r, robot, SensorConfig(), config, pose) for _ in range(2))
        whole = one.drive(path, heading if t % 4 else None)
        pieces, velocities = in_pieces(rng, other, path, heading if t % 4 else None)
        ends[pieces[-1].ended] += 1
        driving += sum(v > 0.0 for v, _ in velocities)
        turning += sum(v == 0.0 and w != 0.0 for v, w in velocities)
        assert pieces[-1].ended == whole.ended
        assert pieces[-1].next_vertex <= len(path)
        assert sum(p.duration for p in pieces) == pytest.approx(whole.duration, rel=1e-9, abs=1e-12)
        assert sum(p.distance for p in pieces) == pytest.approx(whole.distance, rel=1e-9, abs=1e-9 * r)
        np.testing.assert_allclose(other.pose[:2], one.pose[:2], rtol=0.0, atol=1e-9 * r)
        assert other.velocity == one.velocity == (0.0, 0.0)
        if mode == "physics":  # step by step; the walls' answers but for rounding, all else to the last bit
            way = np.concatenate([whole.trajectory[:1], *(p.trajectory[1:] for p in pieces)])
            np.testing.assert_allclose(way, whole.trajectory, rtol=0.0, atol=1e-9 * r)
            if not np.isfinite(way_gap(walls * r, way, r)) or way_gap(walls * r, way, r) > 1e-3 * r:
                np.testing.assert_array_equal(way, whole.trajectory)
    assert min(ends["arrived"], ends["bump"]) > 80
    assert driving > 400
    assert turning > 400


@both_modes
def test_cutting_hides_no_bump(mode: str) -> None:
    """Pressing along a wall, cut every few centimetres: on the same path, and on another each time."""
    rng, r = np.random.default_rng(22), RADIUS
    for steady in (True, False):
        for degrees in (25.0, 40.0, 90.0):
            angle = math.radians(degrees)
            world = make(mode, (-4.0, -4.0, -angle))
            goal = world.pose[:2] + 9.0 * np.array([math.cos(angle), -math.sin(angle)])
            spent = 0.0
            while spent < 60.0:
                path = np.vstack([world.pose[:2], goal])
                result = world.drive(path, distance=0.1 * r)
                spent += result.duration
                if result.ended != "cut":
                    break
                if not steady:
                    goal = world.pose[:2] + rng.uniform(1.0, 5.0) * np.array([math.cos(angle), -math.sin(angle)])
            assert result.collided
            assert spent < 10.0
            assert world.velocity == (0.0, 0.0)


def moving(rng: np.random.Generator, mode: str, walls: np.ndarray = ROOM * 9.0) -> World:
    """A world in which a drive was cut short at speed."""
    while True:
        world = make(mode, (0.0, 0.0, rng.uniform(-3, 3)), walls)
        world.drive(random_path(rng, 1.0, 4.0), distance=rng.uniform(0.05, 6.0))
        if world.velocity[0] > 0.0:
            return world


@both_modes
def test_halts_where_it_says(mode: str) -> None:
    rng, robot = np.random.default_rng(23), RobotConfig()
    for _ in range(60):
        world = moving(rng, mode)
        pose, halt, speed = world.pose, world.halt, world.velocity[0]
        way = math.hypot(*(halt - pose[:2]))
        assert way == pytest.approx(speed**2 / (2 * robot.max_acceleration), rel=0.2, abs=0.05)
        np.testing.assert_allclose(pose[:2] + way * np.array([math.cos(pose[2]), math.sin(pose[2])]), halt)
        other = copy.deepcopy(world)
        stopped, led = world.stop(), other.drive(np.vstack([pose[:2], halt]))
        for it, result in ((world, stopped), (other, led)):
            assert result.arrived
            assert it.velocity == (0.0, 0.0)
            np.testing.assert_array_equal(it.halt, it.pose[:2])
            assert result.duration >= speed / robot.max_acceleration - 0.04
            assert result.distance <= way + 0.005
        np.testing.assert_allclose(other.pose[:2], halt, atol=0.02)
        np.testing.assert_array_equal(world.pose, other.pose)
        assert world.stop().duration <= 0.04


def test_paths_by_way_of_the_halt_are_kept_to_at_speed() -> None:
    rng, speeds = np.random.default_rng(24), []
    for _ in range(150):
        world = moving(rng, "physics")
        here, halt, speed = world.pose[:2], world.halt, world.velocity[0]
        path = np.vstack([here, halt, halt + random_path(rng, 0.3, 4.0)[1:]])
        speeds.append(speed)
        result = world.drive(path, rng.uniform(-3, 3))
        assert result.arrived
        off = shapely.distance(shapely.LineString(path), shapely.points(result.trajectory[:, :2])).max()
        assert off < 0.02
    assert np.mean(np.array(speeds) > 0.9) > 0.3


@both_modes
def test_other_paths_are_taken_up_from_where_it_halts(mode: str) -> None:
    rng = np.random.default_rng(25)
    for _ in range(60):
        world = moving(rng, mode)
        pose, halt, speed = world.pose, world.halt, world.velocity[0]
        aside = pose[2] + rng.choice([-1, 1]) * rng.uniform(0.9, 3.1)
        goal = pose[:2] + 3.0 * np.array([math.cos(aside), math.sin(aside)])
        result = world.drive(np.vstack([pose[:2], goal]))
        assert result.arrived
        assert result.duration > speed / world.robot.max_acceleration
        np.testing.assert_allclose(world.pose[:2], goal, atol=0.01)
        corner = pose[:2] if mode == "kinematic" else halt
        way = shapely.LineString([pose[:2], corner, goal]).buffer(0.02)
        assert shapely.contains_xy(way, result.trajectory[:, :2]).all()


@both_modes
@pytest.mark.parametrize("before", [0.02, 0.1, 0.3, 0.8, 2.0])
def test_the_way_beyond_the_next_vertex_may_change(mode: str, before: float) -> None:
    """Planned to pass the vertex at speed, it is told to turn there, however near it is."""
    for turn in (0.2, 1.0, 2.0, 3.1):
        world = make(mode, (-4.0, 0.0, 0.0), ROOM * 2.0)
        path = np.array([[-4.0, 0.0], [0.0, 0.0], [4.0, 0.1]])
        result = world.drive(path, distance=4.0 - before)
        assert result.next_vertex == 1
        goal = np.array([3.0 * math.cos(turn), 3.0 * math.sin(turn)])
        result = world.drive(np.vstack([world.pose[:2], path[1], goal]))
        assert result.arrived
        np.testing.assert_allclose(world.pose[:2], goal, atol=0.01)


@both_modes
def test_goes_straight_on_without_braking(mode: str) -> None:
    """A new path each half metre, all along one straight line, takes as long as that line."""
    rng = np.random.default_rng(26)
    end = np.array([9.0, 3.0])
    world, whole = make(mode, (0.0, 0.0, 0.0), ROOM * 4.0), make(mode, (0.0, 0.0, 0.0), ROOM * 4.0)
    duration, speeds, ended = 0.0, [0.0], "cut"
    while ended == "cut":
        here = world.pose[:2]
        result = world.drive(np.array([here, here + rng.uniform(0.3, 0.9) * (end - here), end]), distance=0.5)
        ended, duration = result.ended, duration + result.duration
        speeds.append(world.velocity[0])
    assert ended == "arrived"
    expected = whole.drive(np.vstack([np.zeros(2), end])).duration
    # a kinematic robot halts at every vertex, so that it brakes for those it comes near to
    assert duration == pytest.approx(expected, abs=0.041 if mode == "physics" else 2.0)
    assert max(speeds) == pytest.approx(1.2) or mode == "kinematic"


@both_modes
def test_time_limit_holds_for_all_pieces_of_a_drive(mode: str) -> None:
    world, path = make(mode, (-4.0, 0.0, 0.0), time_limit=2.0), np.array([[-4.0, 0.0], [4.0, 0.0]])
    spent, result = 0.0, world.drive(path, distance=0.1)
    while result.ended == "cut":
        spent += result.duration
        result = world.drive(np.vstack([world.pose[:2], path[result.next_vertex :]]), distance=0.1)
    assert result.ended == "time"
    assert spent + result.duration == pytest.approx(2.0)
    assert world.velocity == (0.0, 0.0)
    assert world.pose[0] == pytest.approx(-2.8, abs=0.05)  # as without cuts
    world = make(mode, (-4.0, 0.0, 0.0), time_limit=2.0)
    assert world.drive(path, distance=0.8).ended == "cut"
    elsewhere = world.drive(np.vstack([world.pose[:2], [4.0, -1.0]]))  # a new drive
    assert elsewhere.ended == "time"
    assert elsewhere.duration == pytest.approx(2.0)


@both_modes
def test_a_copy_of_a_moving_world_goes_on_as_the_original(mode: str) -> None:
    rng, at_speed = np.random.default_rng(27), 0
    for _ in range(15):
        walls = boxed(random_walls(rng, 20, side=9.0), 5.0)
        worlds = [make(mode, (*clear_point(rng, walls, 4.0, RADIUS), 0.0), walls)]
        rest = np.empty((0, 2))
        for _ in range(8):
            path, way = next_path(rng, worlds[0], rest), rng.uniform(0.05, 1.5)
            results = [world.drive(path, 1.0, distance=way) for world in worlds]
            for world, result in zip(worlds[1:], results[1:], strict=True):
                np.testing.assert_array_equal(result.trajectory, results[0].trajectory)
                assert (result.ended, world.velocity) == (results[0].ended, worlds[0].velocity)
            rest = path[results[0].next_vertex :]
            at_speed += worlds[0].velocity[0] > 0.0
            worlds = [worlds[0], copy.deepcopy(worlds[0]), pickle.loads(pickle.dumps(worlds[0]))]
    assert at_speed > 30


@both_modes
def test_says_which_vertex_is_next(mode: str) -> None:
    world = make(mode, (0.0, 0.0, 0.0))
    path = np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 1.0], [1.0, 1.0]])
    seen = []
    while not seen or seen[-1][1] == "cut":
        result = world.drive(path, -3.0, distance=0.45, turn=1.2)
        seen.append((len(path) - result.next_vertex, result.ended))
        path = np.vstack([world.pose[:2], path[result.next_vertex :]])
    left = [n for n, _ in seen]
    assert left == sorted(left, reverse=True)  # passed, one after the other
    assert set(left) == {4, 2, 0}
    assert seen[-1] == (0, "arrived")


@both_modes
def test_bad_input_is_refused(mode: str) -> None:
    world = make(mode, (0.0, 0.0, 0.0))
    for path in (np.empty((0, 2)), np.zeros((2, 3)), np.array([[0.0, 0.0], [np.nan, 1.0]])):
        with pytest.raises(InvalidMotionError, match="path of shape"):
            world.drive(path)
    with pytest.raises(InvalidMotionError, match="path starts"):
        world.drive(np.array([[0.1, 0.0], [1.0, 0.0]]))
    for cut in ({"distance": 0.0}, {"turn": -1.0}, {"distance": math.nan}):
        with pytest.raises(InvalidMotionError, match="expected positive"):
            world.drive(np.zeros((1, 2)), **cut)
    with pytest.raises(InvalidMotionError, match="heading"):
        world.drive(np.zeros((1, 2)), math.nan)
    with pytest.raises(InvalidMotionError, match="from a wall"):
        make(mode, (4.9, 0.0, 0.0))
    with pytest.raises(InvalidMotionError, match="start pose"):
        make(mode, (0.0, math.inf, 0.0))
    for walls in (np.zeros((3, 2)), np.full((1, 4), np.nan)):
        with pytest.raises(InvalidMotionError, match="walls"):
            make(mode, (0.0, 0.0, 0.0), walls)
    np.testing.assert_array_equal(world.pose, np.zeros(3))
    with pytest.raises(ValueError, match="read-only"):
        world.segments[0, 0] = 1.0


def test_measures_from_where_it_stands() -> None:
    world = World(
        ROOM, RobotConfig(), SensorConfig(sigma_range=0.0, sigma_angle=0.0), DriveConfig(), np.array([1.0, 0, 0])
    )
    assert world.measure(np.random.default_rng(0))[180] == pytest.approx(4.0)
    world.drive(np.array([[1.0, 0.0], [2.0, 0.0]]))
    assert world.measure(np.random.default_rng(0))[180] == pytest.approx(5.0 - world.pose[0])


class Planner:
    """Shortest grid paths, pulled straight, that leave the disc a spare clearance."""

    def __init__(self, polygon: shapely.Polygon, spare: float, step: float = 0.25) -> None:
        self.free = polygon.buffer(-(RADIUS + spare))
        shapely.prepare(self.free)
        x0, y0, x1, y1 = polygon.bounds
        x, y = np.meshgrid(np.arange(x0, x1, step), np.arange(y0, y1, step))
        inside = shapely.contains_xy(self.free, x, y)
        index = np.full(inside.shape, -1)
        index[inside] = np.arange(inside.sum())
        self.points = np.stack([x[inside], y[inside]], axis=1)
        pairs = []
        for a, b in (
            (index[:, :-1], index[:, 1:]),
            (index[:-1], index[1:]),
            (index[:-1, :-1], index[1:, 1:]),
            (index[:-1, 1:], index[1:, :-1]),
        ):
            keep = (a >= 0) & (b >= 0)
            pairs.append(np.stack([a[keep], b[keep]], axis=1))
        joined = np.concatenate(pairs)
        joined = joined[shapely.covers(self.free, shapely.linestrings(self.points[joined]))]
        lengths = np.hypot(*(self.points[joined[:, 0]] - self.points[joined[:, 1]]).T)
        self.graph = coo_matrix((lengths, joined.T), shape=(len(self.points),) * 2).tocsr()

    def path(self, source: int, target: int) -> np.ndarray | None:
        reach, before = dijkstra(self.graph, directed=False, indices=source, return_predecessors=True)
        if not np.isfinite(reach[target]) or source == target:
            return None
        chain = [target]
        while chain[-1] != source:
            chain.append(before[chain[-1]])
        way, out, at = self.points[chain[::-1]], [0], 0
        while at < len(way) - 1:
            at += 1
            while at + 1 < len(way) and self.free.covers(shapely.LineString(way[[out[-1], at + 1]])):
                at += 1
            out.append(at)
        return way[out]


@pytest.mark.skipif(not shared_plans(), reason="no shared floor plans here")
def test_kinematic_distances_follow_the_physical_ones_on_shared_plans() -> None:
    rng, ratios = np.random.default_rng(6), []
    for file in shared_plans()[:50:7]:
        polygon = load_polygon(file)
        walls, planner = polygon_walls(polygon), Planner(polygon, 0.035)
        for _ in range(6):
            path = planner.path(*rng.integers(0, len(planner.points), 2))
            if path is None:
                continue
            pose, heading = (*path[0], rng.uniform(-3, 3)), rng.uniform(-3, 3)
            results = [make(mode, pose, walls).drive(path, heading) for mode in ("physics", "kinematic")]
            for result in results:
                assert result.arrived, file.name
                assert not result.collided, file.name
            assert shapely.distance(shapely.LineString(path), shapely.points(results[0].trajectory[:, :2])).max() < 0.02
            assert gaps(walls, results[0].trajectory).min() > 0.0
            ratios.append(results[0].distance / results[1].distance)
    assert len(ratios) > 20
    assert min(ratios) > 0.99
    assert max(ratios) < 1.001
