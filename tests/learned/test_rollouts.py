import itertools

import numpy as np
from observations import CONFIG, environment, observation

from baselines.learned.rollouts import branch, candidates, costs, nearest, shorn, states
from polyexplore_gym.config import EnvConfig, from_mapping
from polyexplore_gym.floorplan import suite


def play(env, seen):
    driven = []
    while seen["action_mask"].any():
        seen, _, terminated, truncated, info = env.step(nearest([seen])[0])
        driven.append((info["distance"], info["coverage"]))
        if terminated or truncated:
            break
    return driven


def test_a_copy_goes_on_as_the_original_does():
    env, seen = environment()
    twin = branch(env, pairwise=False)
    other = play(twin, {key: value.copy() for key, value in seen.items()})
    assert play(env, seen) == other
    assert len(other) > 3


def test_costs_are_the_ways_to_the_end():
    env, seen = environment()
    before = env.unwrapped._distance
    nodes = np.flatnonzero(seen["action_mask"])[:3]
    found = costs(env, nodes, nearest, pairwise=True)
    again = costs(env, nodes, nearest, pairwise=False)
    np.testing.assert_array_equal(found, again)
    assert env._distance == before
    near = nearest([seen])[0]
    assert found[nodes.tolist().index(near)] == play(env, seen)[-1][0] - before


def test_candidates_hold_the_chosen_node():
    seen = observation()
    reachable = np.flatnonzero(seen["action_mask"])
    for seed in range(20):
        rng = np.random.default_rng(seed)
        some = candidates(seen, int(reachable[-1]), 3, rng)
        assert len(set(some.tolist())) == 3
        assert reachable[-1] in some
        assert set(some.tolist()) <= set(reachable.tolist())
    np.testing.assert_array_equal(candidates(seen, int(reachable[0]), 99, rng), reachable)


def test_states_repeat_and_have_no_padding():
    plan = suite("home-train").plan(5)
    config = from_mapping(EnvConfig, CONFIG)

    def some():
        made = states(iter([plan] * 9), config, np.random.default_rng(3), base=nearest, pairwise=False, tried=3)
        return list(itertools.islice(made, 3))

    first, second = some(), some()
    assert len(first) == 3
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.cost, b.cost)
        np.testing.assert_array_equal(a.nodes, b.nodes)
        assert 2 <= len(a.nodes) <= 3
        assert a.seen["path_lengths"].shape == (len(a.seen["edges"]),) * 2
        assert (a.cost > 0).all()


def test_shorn_observations_have_the_same_features():
    from baselines.learned.features import features

    seen = observation()
    full, short = features(seen), features(shorn(seen))
    for name in ("node", "pair", "whole", "slots"):
        np.testing.assert_array_equal(getattr(full, name), getattr(short, name))
