"""Whole episodes in small plans that once ended too early: they end complete, with (nearly) all seen."""

from __future__ import annotations

import math

import numpy as np
import pytest

from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.floorplan import FloorPlan, generate

pytestmark = pytest.mark.bounds

PLACEMENTS = ("midpoint", "in_front")


def episode(plan, start=None, seed=0, **config):
    """The info at the end of an episode in which the nearest node is chosen."""
    env = PolyExploreEnv(plan, config={"drive": {"mode": "kinematic"}, **config})
    observation, info = env.reset(seed=seed, options=None if start is None else {"start": start})
    over = not info["action_mask"].any()
    while not over:
        valid = np.flatnonzero(observation["action_mask"])
        action = int(valid[observation["node_path_length"][valid].argmin()])
        observation, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    return info


def check(info):
    assert info["outcome"]["status"] == "complete", info["outcome"]
    assert info["coverage"] >= 0.99


def rooms_with_doors(width):
    """Three rooms with doors of `width` m through walls of 0.2 m."""
    return FloorPlan.create([
        [5, 0], [5, 2], [5.2, 2], [5.2, 0], [10, 0], [10, 5], [7 + width, 5], [7 + width, 5.2], [10, 5.2], [10, 9],
        [0, 9], [0, 5.2], [7, 5.2], [7, 5], [5.2, 5], [5.2, 2 + width], [5, 2 + width], [5, 5], [0, 5], [0, 0],
    ])  # fmt: skip


def hall(width, depth):
    return FloorPlan.create([[0, 0], [width, 0], [width, depth], [0, depth]])


def maze(cell, n, rng):
    """A perfect maze of n x n square cells with walls of a twelfth of a cell, as the area of its corridors."""
    import shapely

    half = 0.5 * (1.0 - 1.0 / 12.0)
    boxes, seen, stack = [], {(0, 0)}, [(0, 0)]
    while stack:
        i, j = stack[-1]
        ways = [(i + di, j + dj) for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        ways = [w for w in ways if 0 <= w[0] < n and 0 <= w[1] < n and w not in seen]
        boxes.append(shapely.box(i - half, j - half, i + half, j + half))
        if not ways:
            stack.pop()
            continue
        a, b = ways[int(rng.integers(len(ways)))]
        seen.add((a, b))
        stack.append((a, b))
        boxes.append(shapely.box(min(i, a) - half, min(j, b) - half, max(i, a) + half, max(j, b) + half))
    area = shapely.union_all(boxes, grid_size=1e-6)
    rings = [cell * shapely.get_coordinates(r)[:-1] for r in (area.exterior, *area.interiors)]
    return FloorPlan.create(rings[0], rings[1:])


@pytest.mark.parametrize("radius", [0.44, 0.6])
def test_robots_of_any_size(radius):
    plan = FloorPlan.create([
        [0, 0], [9.8, 0], [9.8, 4.5], [10, 4.5], [10, 0], [19.8, 0], [19.8, 12], [10, 12], [10, 7.5], [9.8, 7.5],
        [9.8, 12], [0, 12],
    ])  # fmt: skip
    check(episode(plan, robot={"radius": radius}))


def test_a_hall_wider_than_the_sensor_sees():
    check(episode(hall(60, 60), sensor={"max_range": 16.0}))


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_sparse_beams(placement):
    """All is seen. (Stretches of wall between two beams may be left: nothing tells that they are wall.)"""
    info = episode(
        generate("home", 3),
        sensor={"beams": 60, "field_of_view": 2 * math.pi},
        robot={"radius": 0.2},
        exploration={"placement": placement},
    )
    assert info["outcome"]["status"] in ("complete", "unreached")
    assert info["coverage"] >= 0.99


def test_few_beams_that_reach_far():
    """Neighbouring beams end 38 m apart: a kernel once wrote behind its array (`make bounds` would tell)."""
    sensor = {"beams": 31, "max_range": 190.0, "sigma_range": 0.0, "sigma_angle": 0.0}
    info = episode(hall(400, 400), start=(200, 200, 0), sensor=sensor, max_decisions=6)
    assert info["outcome"]["status"] == "budget"
    assert info["coverage"] >= 0.3


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_a_range_of_a_metre(placement):
    check(episode(hall(6, 5), sensor={"max_range": 1.0}, exploration={"placement": placement}))


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize("width", [0.53, 0.55, 0.6])
def test_doors_little_wider_than_the_robot(width, placement):
    check(episode(rooms_with_doors(width), exploration={"placement": placement}))


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_doors_little_wider_than_the_robot_between_sparse_beams(placement):
    """The pieces about lone returns, as wide as their beams, stick out of the walls and into the doors."""
    sensor = {"beams": 25, "field_of_view": 2 * math.pi, "max_range": 30.0, "sigma_range": 0.0, "sigma_angle": 0.0}
    plan = rooms_with_doors(0.53)
    check(episode(plan, start=(2.5, 2.5, 0.0), sensor=sensor, exploration={"placement": placement}))


def test_a_start_against_a_wall_without_looking_around():
    check(episode(hall(6, 5), start=(0.26, 2.5, math.pi), exploration={"look_around": False}))


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_a_maze_of_small_cells(placement):
    info = episode(
        maze(0.16, 5, np.random.default_rng(2)),
        robot={"radius": 0.04},
        sensor={"beams": 360, "field_of_view": 2 * math.pi, "max_range": 1.0, "sigma_range": 0.002},
        exploration={"placement": placement},
    )
    check(info)
