import math

import numpy as np
import pymunk
import pytest
import shapely
from sim_scenes import any_robot, boxed, random_path

from polyexplore_gym.config import DriveConfig, RobotConfig, SensorConfig
from polyexplore_gym.sim import follower
from polyexplore_gym.sim.world import World

NO_WALLS = np.empty((0, 4))


def wrapped(angle: np.ndarray) -> np.ndarray:
    return np.remainder(angle + math.pi, 2 * math.pi) - math.pi


@pytest.mark.parametrize(("shortest", "longest"), [(1.0, 4.0), (0.05, 0.6), (0.01, 0.15)])
@pytest.mark.parametrize(
    "robot", [RobotConfig(), RobotConfig(max_speed=0.5, max_turn_rate=1.0, max_turn_acceleration=2.0)]
)
def test_stays_on_the_path_within_the_limits(shortest: float, longest: float, robot: RobotConfig) -> None:
    rng, step = np.random.default_rng(4), 0.04
    for _ in range(60):
        path, heading = random_path(rng, shortest, longest), rng.uniform(-3, 3)
        world = World(NO_WALLS, robot, SensorConfig(), DriveConfig(), np.array([0, 0, rng.uniform(-3, 3)]))
        result = world.drive(path, heading)
        way = result.trajectory
        assert result.arrived
        assert not result.collided
        assert result.duration == pytest.approx((len(way) - 1) * step)
        assert shapely.distance(shapely.LineString(path), shapely.points(way[:, :2])).max() < 0.02
        assert math.hypot(*(way[-1, :2] - path[-1])) < 0.01
        assert abs(wrapped(way[-1, 2] - heading)) < math.radians(0.5)
        speed = np.hypot(*np.diff(way[:, :2], axis=0).T) / step
        rate = wrapped(np.diff(way[:, 2])) / step
        assert (speed + np.abs(rate) * robot.track / 2).max() <= robot.max_speed + 1e-6  # the outer wheel
        assert np.abs(rate).max() <= robot.max_turn_rate + 1e-6
        assert np.abs(np.diff(speed, prepend=0.0)).max() <= robot.max_acceleration * step + 1e-6
        assert np.abs(np.diff(rate, prepend=0.0)).max() <= robot.max_turn_acceleration * step + 1e-6
        # the body moves where it points: no sideways slip
        moved = speed > 1e-9
        course = np.arctan2(*np.diff(way[:, :2], axis=0).T[::-1])
        assert np.abs(wrapped(course - way[:-1, 2])[moved]).max() < 1e-5


def test_free_motion_is_what_pymunk_integrates() -> None:
    robot, step = RobotConfig(), 0.04
    limits = (robot.max_speed, robot.max_turn_rate, robot.max_acceleration, robot.max_turn_acceleration)
    path = np.array([[0.0, 0.0], [2.0, 0.3], [2.5, 1.5], [1.0, 3.0]])
    speeds = follower.vertex_speeds(path, limits, robot.radius, step)
    space = pymunk.Space()
    body = pymunk.Body(1.0, 1.0)
    space.add(body, pymunk.Circle(body, robot.radius))
    state = np.zeros(9)
    state[follower.PHASE] = follower.ALIGN
    rows = []
    while True:
        follower.command(state, path, speeds, 1.0, True, limits, (robot.radius, robot.track), step)
        if state[follower.PHASE] >= follower.DONE:
            break
        body.velocity = state[follower.SPEED] * math.cos(body.angle), state[follower.SPEED] * math.sin(body.angle)
        body.angular_velocity = state[follower.RATE]
        space.step(step)
        state[:3] = *body.position, body.angle
        rows.append(state[:3].copy())
    world = World(NO_WALLS, robot, SensorConfig(), DriveConfig(), np.zeros(3))
    way = world.drive(path, 1.0).trajectory
    assert len(way) == len(rows) + 1
    np.testing.assert_allclose(way[1:, :2], np.array(rows)[:, :2], atol=1e-9)
    np.testing.assert_allclose(wrapped(way[1:, 2] - np.array(rows)[:, 2]), 0.0, atol=1e-9)


def test_keeps_to_the_path_whatever_the_robot() -> None:
    rng, coarse = np.random.default_rng(6), 0
    for _ in range(150):
        robot, step = any_robot(rng)
        path, heading = random_path(rng, 0.5 * robot.radius, 16.0 * robot.radius), rng.uniform(-3, 3)
        pose = np.array([0.0, 0.0, rng.uniform(-3, 3)])
        world = World(NO_WALLS, robot, SensorConfig(), DriveConfig(time_step=step, time_limit=7200.0), pose)
        result = world.drive(path, heading)
        assert not result.collided
        assert result.contact is None
        reach = robot.max_speed * step / robot.radius  # radii in a step
        coarse += reach > 1.0
        assert result.arrived or reach > 100.0
        some = result.trajectory[:: 1 + len(result.trajectory) // 2000, :2]
        off = shapely.distance(shapely.LineString(path), shapely.points(some)).max()
        assert off < 0.7 * robot.radius
    assert coarse > 20


def test_ends_before_it_leaves_the_box_of_known_walls() -> None:
    robot, step = RobotConfig(), 0.04
    limits = (robot.max_speed, robot.max_turn_rate, robot.max_acceleration, robot.max_turn_acceleration)
    path = np.array([[0.0, 0.0], [9.0, 0.0]])
    walls = boxed(NO_WALLS, 30.0)
    state, rows, done = np.zeros(9), [], 0
    for edge in (3.0, 6.0, 12.0):
        part = np.empty((2048, 3))
        count, contact = follower.follow(
            state,
            path,
            follower.vertex_speeds(path, limits, robot.radius, step),
            1.0,
            True,
            limits,
            (robot.radius, robot.track),
            step,
            10_000 - done,
            np.full(2, np.inf),
            walls,
            (-3.0, -3.0, edge, 3.0),
            part,
        )
        assert not contact
        assert part[:count, 0].max() + robot.radius < edge
        assert (state[follower.PHASE] == follower.DONE) == (edge == 12.0)
        rows.append(part[:count])
        done += count
    whole = World(walls, robot, SensorConfig(), DriveConfig(), np.zeros(3)).drive(path, 1.0)
    np.testing.assert_allclose(np.concatenate(rows)[:, :2], whole.trajectory[1:, :2])
    assert done == len(whole.trajectory) - 1


def test_vertex_speeds_leave_room_to_brake() -> None:
    rng = np.random.default_rng(8)
    for _ in range(100):
        path = random_path(rng, 0.05, 3.0)
        speeds = follower.vertex_speeds(path, (1.2, 3.0, 0.6, 5.0), 0.25, 0.04)
        legs = np.hypot(*np.diff(path, axis=0).T)
        turns = np.abs(wrapped(np.diff(np.arctan2(*np.diff(path, axis=0).T[::-1]))))
        assert speeds[-1] == 0.0
        assert (speeds[:-1] ** 2 <= speeds[1:] ** 2 + 2 * 0.6 * legs + 1e-9).all()
        assert (speeds[1:-1][turns > math.radians(45)] == 0.0).all()
        assert speeds.max() <= 1.2


@pytest.mark.parametrize("step", [0.001, 0.04, 0.2])
def test_stopping_distance_is_what_braking_takes(step: float) -> None:
    limits = (1.2, 3.0, 0.6, 5.0)
    change = 0.9 * 0.6 * step
    for n in range(1, int(1.2 / change) + 1):  # from n changes of speed: a step at each
        way = sum(k * change * step for k in range(1, n + 1))
        assert follower.stopping_distance(n * change, limits, step) == pytest.approx(way)
    for speed in np.linspace(0.0, 1.2, 100):
        way = follower.stopping_distance(speed, limits, step)
        assert follower._braking(way, 0.0, 0.9 * 0.6, step) == pytest.approx(speed)
    assert follower.stopping_distance(1.2, limits, 0.0) == pytest.approx(1.2)


def test_a_robot_that_moves_takes_up_what_leads_on() -> None:
    limits, state = (1.2, 3.0, 0.6, 5.0), np.zeros(9)

    def leads_on(speed: float, *points: tuple[float, float]) -> bool:
        state[follower.SPEED] = speed
        path = np.array([(0.0, 0.0), *points])
        return follower.leads_on(state, path, follower.vertex_speeds(path, limits, 0.25, 0.04), limits, 0.25)

    assert not leads_on(0.1)
    assert leads_on(1.2, (3.0, 0.0))
    assert leads_on(1.2, (3.0, 2.9))
    assert not leads_on(1.2, (3.0, 3.1))
    assert not leads_on(1.2, (-3.0, 0.0))
    assert leads_on(1.2, (1.0, 0.0))
    assert leads_on(1.2, (0.5, 0.0), (5.0, 0.1))
    assert not leads_on(1.2, (0.5, 0.0), (0.6, 0.0), (0.6, 5.0))  # a stop that it would overshoot
    assert leads_on(0.5, (0.5, 0.0), (0.6, 0.0), (0.6, 5.0))
