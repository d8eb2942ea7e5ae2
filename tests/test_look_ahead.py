"""Planners that look ahead: tours against all orders, played-out ways against a plain loop."""

import itertools

import numpy as np
import pytest

from baselines import make_policy
from baselines.rollout import played_out
from baselines.tours import group_tours, improve, tours
from polyexplore_gym.cli import LOOK_AHEAD
from polyexplore_gym.config import EnvConfig, from_mapping
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.errors import InvalidConfigError
from polyexplore_gym.floorplan import suite


def scattered(rng, k):
    """Path lengths to and between points in a square."""
    points = rng.uniform(0, 10, size=(k, 2))
    return np.hypot(*points.T), np.hypot(*np.moveaxis(points[:, None] - points[None], 2, 0))


@pytest.mark.parametrize("k", [1, 2, 6])
def test_tours_beside_all_orders(k):
    rng = np.random.default_rng(k)
    ratios = []
    for _ in range(20):
        cost, between = scattered(rng, k)
        tour, greedy = tours(cost, between)
        for first in range(k):
            rest = [j for j in range(k) if j != first]
            ways = ((first, *order) for order in itertools.permutations(rest))
            best = min(cost[first] + sum(between[a, b] for a, b in itertools.pairwise(way)) for way in ways)
            assert best - 1e-9 <= tour[first] <= greedy[first] + 1e-9
            ratios.append(tour[first] / best)
    assert np.mean(ratios) < 1.02


def shortened(way, between):
    """2-opt and Or-opt moves until nothing helps, one comparison at a time: the way and the metres saved."""

    def length(a, b):
        return between[way[a], way[b]] if b < k else 0.0

    way, k, total = list(way), len(way), 0.0
    for _ in range(10):
        gained = 0.0
        for i in range(1, k - 1):
            for j in range(i + 1, k):
                saved = length(i - 1, i) + length(j, j + 1) - (length(i - 1, j) + length(i, j + 1))
                if saved > 1e-9:
                    gained += saved
                    way[i : j + 1] = way[i : j + 1][::-1]
        for i in range(1, k):
            out = length(i - 1, i) + length(i, i + 1) - length(i - 1, i + 1)
            more = {j: length(j, i) + length(i, j + 1) - length(j, j + 1)
                    for j in range(k) if j not in (i - 1, i)}  # fmt: skip
            j = min(more, key=more.__getitem__, default=i)
            if j != i and more[j] < out - 1e-9:
                gained += out - more[j]
                node = way.pop(i)
                way.insert(j if j > i else j + 1, node)
        total += gained
        if gained < 1e-9:
            break
    return way, total


@pytest.mark.parametrize("k", [1, 2, 3, 9, 24, 40])
def test_improve_beside_a_plain_loop(k):
    rng = np.random.default_rng(k)
    for _ in range(12 if k < 20 else 4):
        _, between = scattered(rng, k)
        way = rng.permutation(k)
        expected, saved = shortened(way, between)
        found = way.copy()
        assert improve(found, between) == pytest.approx(saved, abs=1e-9)
        assert found.tolist() == expected


@pytest.mark.parametrize("groups", [1, 3, 5])
def test_group_tours_beside_all_choices(groups):
    rng = np.random.default_rng(groups)
    ratios = []
    for _ in range(20):
        group = np.concatenate((np.arange(groups), rng.integers(groups, size=7 - groups)))
        cost, between = scattered(rng, 7)
        found = group_tours(cost, between, group)
        for first in range(7):
            rest = [np.flatnonzero(group == g) for g in range(groups) if g != group[first]]
            ways = [(first, *way) for chosen in itertools.product(*rest) for way in itertools.permutations(chosen)]
            best = min(cost[first] + sum(between[a, b] for a, b in itertools.pairwise(way)) for way in ways)
            assert found[first] >= best - 1e-9
            ratios.append(found[first] / best)
    assert np.mean(ratios) < 1.02


def test_groups_of_one_node_make_the_tour():
    cost, between = scattered(np.random.default_rng(4), 9)
    np.testing.assert_allclose(group_tours(cost, between, np.arange(9)), tours(cost, between)[0])


def plainly(cost, between, further, first):
    """One way of `played_out`, with the nodes behind as a list of chains."""
    chains = []
    for row in further:
        stops = [0.0]
        for d in row:
            if not np.isfinite(d):
                break
            stops.append(stops[-1] + d)
        chains.append(stops)
    at, inside, way = first, 0.0, cost[first]
    seen = [0] * len(chains)  # how many stops of each chain were visited
    seen[first] = 1
    while any(seen[j] < len(chains[j]) for j in range(len(chains))):
        legs = {
            j: chains[j][seen[j]] - inside if j == at else inside + between[at, j] + chains[j][seen[j]]
            for j in range(len(chains))
            if seen[j] < len(chains[j])
        }
        at = min(legs, key=lambda j: (legs[j], j))
        way += legs[at]
        inside = chains[at][seen[at]]
        seen[at] += 1
    return way


def test_played_out_ways_beside_a_plain_loop():
    rng = np.random.default_rng(2)
    for k in (1, 2, 6):
        cost, between = scattered(rng, k)
        further = rng.exponential(size=(8, k, 4))
        further[rng.random(further.shape) > 0.5] = np.inf
        expected = [np.mean([plainly(cost, between, f, first) for f in further]) for first in range(k)]
        np.testing.assert_allclose(played_out(cost, between, further), expected)


@pytest.mark.parametrize("name", LOOK_AHEAD)
def test_they_need_the_path_lengths_between_nodes(name):
    config = from_mapping(EnvConfig, {"drive": {"mode": "kinematic"}, "observation": {"pairwise": False}})
    env = PolyExploreEnv(plan=suite("home-validation").plan(3), config=config)
    seen, info = env.reset(seed=0)
    with pytest.raises(InvalidConfigError, match="pairwise = True"):
        make_policy(name).act(seen, info, np.random.default_rng(0))


@pytest.mark.parametrize(
    "parameters", ["tour:near=-1", "tour:near=x", "watchman:shared=0", "rollout:chance=1", "rollout:samples=0"]
)
def test_parameters_out_of_range_are_told(parameters):
    from polyexplore_gym.evaluation import load_policy

    with pytest.raises(InvalidConfigError, match=parameters.split(":")[1].split("=")[0]):
        load_policy(parameters)


def test_the_far_end_first_when_the_way_leads_back():
    # Three nodes in a row: the nearest is in the middle, and a tour that starts there goes there and back.
    from test_baselines import observation

    between = np.zeros((6, 6))
    at = np.array([-4.0, 3.0, 12.0])
    between[:3, :3] = np.abs(at[:, None] - at)
    seen = observation(node_path_length=[4.0, 3.0, 12.0, 0, 0, 0], path_lengths=between, action_mask=[1, 1, 1, 0, 0, 0])
    assert make_policy("nearest").act(seen, {}, np.random.default_rng(0)) == 1
    assert make_policy("tour").act(seen, {}, np.random.default_rng(0)) == 0


def test_rollouts_repeat_with_equal_generators():
    from test_baselines import observation

    policy = make_policy("rollout", samples=4)
    seen = [observation(seed=seed) for seed in range(20)]
    runs = []
    for _ in range(2):
        rng = np.random.default_rng(5)
        runs.append([policy.act(one, {}, rng) for one in seen])
    assert runs[0] == runs[1]
    assert len(set(runs[0])) > 1
