import math
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pymunk
import pytest
import shapely
from sim_scenes import boxed, clear_point, lines_of, random_walls

from polyexplore_gym.config import RobotConfig
from polyexplore_gym.sim.engine import Engine


def slid(walls: np.ndarray, start: np.ndarray, way: np.ndarray, radius: float) -> np.ndarray:
    """The way (n, 2) of a disc that a time step would carry along `way`, from its start."""
    engine = Engine(RobotConfig(radius=radius), walls)
    return stepped(engine, start, way)


def stepped(engine: Engine, start: np.ndarray, way: np.ndarray) -> np.ndarray:
    state = np.array([*start, math.atan2(way[1], way[0]), math.hypot(*way) / 0.04])
    return np.vstack([start, engine.step(state, 0.04)])


def test_slides_as_in_many_small_steps() -> None:
    """pymunk with its velocity set anew in every small step, and nothing swept, is the slow twin."""
    rng, radius, off, along = np.random.default_rng(4), 0.25, [], 0
    for _ in range(150):
        walls = boxed(random_walls(rng, 12, side=6.0), 3.0)
        start, way = clear_point(rng, walls, 2.5, radius), rng.uniform(-2, 2, 2)
        space = pymunk.Space()
        space.collision_slop, space.collision_bias = 1e-6, 0.0
        body = pymunk.Body(1.0, 1.0)
        body.position = tuple(start)
        shape = pymunk.Circle(body, radius)
        shape.friction = 0.0
        static = space.static_body
        space.add(body, shape, *(pymunk.Segment(static, w[:2], w[2:], 0.0) for w in walls.tolist()))
        for _ in range(2000):
            body.velocity = tuple(way)
            space.step(1 / 2000)
        got = slid(walls, start, way, radius)
        along += len(got) > 2
        off.append(math.dist(got[-1], body.position))
    assert along > 60
    assert np.median(off) < 0.002
    # on a wall's end that it meets head-on, rounding decides the side
    assert np.mean(np.array(off) < 0.01) > 0.97


def misses_walls(body: pymunk.Body, step: float) -> None:
    body.position += body.velocity * step
    body.velocity += body.force * (step / body.mass)


def throws(body: pymunk.Body, step: float) -> None:
    misses_walls(body, step)
    body.position += (0.7, -30.0)
    body.velocity *= 50.0


def stands_still(body: pymunk.Body, step: float) -> None:
    pass


def is_no_number(body: pymunk.Body, step: float) -> None:
    body.position = body.velocity = math.nan, math.nan


WRONG: list[Callable[[pymunk.Body, float], None]] = [misses_walls, throws, stands_still, is_no_number]


@pytest.mark.parametrize("longest", [0.1, 3.0, 300.0, 30_000.0])
@pytest.mark.parametrize("wrong", [None, *WRONG])
def test_never_into_a_wall_whatever_the_engine_answers(
    longest: float, wrong: Callable[[pymunk.Body, float], None] | None
) -> None:
    rng, bent, free, same = np.random.default_rng(5), 0, 0, []
    for _ in range(300 if wrong is None else 60):
        radius = 10.0 ** rng.uniform(-1.7, 0.3)
        walls, shift = boxed(random_walls(rng, 25, side=30.0), 16.0), rng.uniform(-100, 100, 2)
        start = radius * clear_point(rng, walls, 15.0, 1.0) + shift
        walls = radius * walls + np.tile(shift, 2)
        lines, engine = lines_of(walls), Engine(RobotConfig(radius=radius), walls)
        if wrong is not None:
            body, answer = engine.body, wrong
            engine.space = SimpleNamespace(  # type: ignore[assignment]
                step=lambda step, body=body, answer=answer: answer(body, step),
                add=lambda wall: None,
                static_body=engine.space.static_body,
            )
        for _ in range(4):  # on from where it was held
            angle = rng.uniform(-math.pi, math.pi)
            way = longest * radius * rng.uniform() * np.array([math.cos(angle), math.sin(angle)])
            got = stepped(engine, start, way)
            # (Rounding grows with the motion.)
            assert shapely.distance(lines, shapely.linestrings(got)) > radius * (1 - 1e-9 - 1e-10 * longest)
            assert np.hypot(*np.diff(got, axis=0).T).sum() <= math.hypot(*way) * (1 + 1e-9)
            assert (np.diff(got, axis=0) @ way >= -1e-12 * radius * math.hypot(*way)).all()
            if wrong is not stands_still:
                same.append(math.dist(got[-1], slid(walls, start, way, radius)[-1]) / radius)
                if shapely.distance(lines, shapely.linestrings([start, start + way])) > radius * (1 + 1e-6):
                    np.testing.assert_allclose(got, [start, start + way], rtol=1e-12)
                    free += 1
                bent += len(got) > 2
            start = got[-1]
    if wrong is not stands_still:
        assert bent > (1 if longest < 1.0 else 30)
        assert free > 90 or longest > 1.0
        # the sweep alone finds what pymunk does, but where rounding decides the side of a wall's end
        assert np.mean(np.array(same) < 1e-6) > 0.98


def test_a_wall_takes_what_leads_into_it_and_no_more() -> None:
    floor, side = np.array([[-5.0, 0.0, 1.0, 0.0]]), np.array([[0.9, 0.0, 0.9, 3.0]])
    got = slid(floor, np.array([0.0, 0.3]), np.array([0.5, -0.5]), 0.25)
    np.testing.assert_allclose(got[1:], [[0.05, 0.25], [0.5, 0.25]], atol=1e-7)
    got = slid(np.vstack([floor, side]), np.array([0.0, 0.25]), np.array([4.0, -0.5]), 0.25)
    np.testing.assert_allclose(got[-1], [0.65, 0.25], atol=1e-7)  # in the corner both hold it
    np.testing.assert_array_equal(slid(floor, np.array([0.0, 0.25]), np.array([0.0, -1.0]), 0.25)[-1], [0.0, 0.25])
    # round the end of the floor: on a circle about it, and then down
    got = slid(floor, np.array([0.9, 0.25]), np.array([1.0, -2.0]), 0.25)
    gaps = np.hypot(*(got - [1.0, 0.0]).T)
    assert gaps[1:-1].min() > 0.25
    assert gaps[1:-1].max() < 0.2505
    assert got[-1, 0] - got[-2, 0] == pytest.approx((got[-2, 1] - got[-1, 1]) / 2)
    got = slid(np.empty((0, 4)), np.zeros(2), np.array([3.0, 4.0]), 0.25)
    np.testing.assert_allclose(got[1:], [[3.0, 4.0]])


@pytest.mark.parametrize("mass", [1e-3, 9.0, 1e6])
def test_the_impulse_of_a_wall_follows_from_the_mass_and_the_way_does_not(mass: float) -> None:
    engine = Engine(RobotConfig(mass=mass), np.array([[-5.0, 0.0, 5.0, 0.0]]))
    rows = engine.step(np.array([0.0, 0.26, -math.pi / 6, 2.0]), 0.1)
    np.testing.assert_allclose(rows[-1], [0.2 * math.cos(math.pi / 6), 0.25], atol=1e-7)
    impulses: list[pymunk.Vec2d] = []
    engine.body.each_arbiter(lambda arbiter: impulses.append(arbiter.total_impulse))
    assert len(impulses) == 1
    assert abs(impulses[0].x) < 1e-9 * mass
    assert abs(impulses[0].y) == pytest.approx(mass * 1.0)  # half of 2 m/s led into the wall


def test_walls_join_the_space_as_the_robot_comes_near() -> None:
    walls = np.array([[x, -1.0, x, 1.0] for x in np.arange(0.0, 100.0, 5.0)])
    engine = Engine(RobotConfig(), walls)
    for k, x in enumerate((2.5, 2.6, 7.5)):
        engine.step(np.array([x, 0.0, 0.0, 70.0]), 0.04)
        assert len(engine.space.static_body.shapes) == (2, 2, 3)[k]
