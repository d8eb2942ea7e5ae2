"""Floor plans of explorations: always valid, near the truth, explored again."""

import warnings

import gymnasium
import numpy as np
import pytest
import shapely

from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.floorplan import FAMILIES, FloorPlan, generate, load_plan, save_plan
from polyexplore_gym.floorplan import suite as named_suite

KINEMATIC = {"drive": {"mode": "kinematic"}}


def nearest(observation, info):
    """The action of the nearest node."""
    mask = info["action_mask"].astype(bool)
    return int(np.argmin(np.where(mask, observation["node_path_length"], np.inf)))


def play(env, seed, options=None, most=1000):
    """Explore by the nearest node; returns the way driven."""
    observation, info = env.reset(seed=seed, options=options)
    for _ in range(most):
        if not info["action_mask"].any():
            break
        observation, _, _, _, info = env.step(nearest(observation, info))
    return info["distance"]


def overlap(plan, truth):
    a, b = plan.polygon, truth.polygon
    common = a.intersection(b).area
    return common / (a.area + b.area - common)


def corners_off(plan, truth):
    own = np.concatenate(plan.rings)
    return np.array([np.hypot(*(own - corner).T).min() for corner in np.concatenate(truth.rings)])


@pytest.mark.parametrize(("name", "number"), [("home-validation", 0), ("home-validation", 3), ("office-validation", 1)])
def test_an_explored_plan_is_the_truth(name, number, tmp_path):
    truth = named_suite(name).plan(number)
    env = PolyExploreEnv(truth, config=KINEMATIC)
    play(env, 0)
    plan = env.floor_plan("home")
    assert overlap(plan, truth) > 0.99
    assert plan.n_vertices <= 1.15 * truth.n_vertices
    assert np.median(corners_off(plan, truth)) < 0.02
    assert plan.meta["unknown_share"] < 0.05
    save_plan(plan, tmp_path / "home.json")
    assert load_plan(tmp_path / "home.json") == plan


def test_it_is_explored_again():
    truth = named_suite("home-validation").plan(0)
    env = PolyExploreEnv(truth, config=KINEMATIC)
    play(env, 0)
    plan = env.floor_plan()
    assert plan.name == "explored"
    starts = [tuple(truth.sample_start(np.random.default_rng(k), 0.25)) for k in range(6)]
    ways = np.array([[play(env, k, {"plan": p, "start": start}) for p in (truth, plan)]
                     for k, start in enumerate(starts)])  # fmt: skip
    assert ways[:, 1].sum() == pytest.approx(ways[:, 0].sum(), rel=0.1)


def test_before_all_is_seen_the_unknown_is_marked():
    """From the start on: each plan is valid and grows, and what no scan has seen is not in it."""
    truth = named_suite("office-validation").plan(0)
    env = PolyExploreEnv(truth, config={**KINEMATIC, "sensor": {"sigma_range": 0.0, "sigma_angle": 0.0}})
    observation, info = env.reset(seed=1)
    areas, unknown = [], []
    for _ in range(12):
        plan = env.floor_plan()
        areas.append(plan.area)
        unknown.append(plan.meta["unknown_length"])
        assert plan.polygon.difference(truth.polygon.buffer(0.02)).area < 0.01 * plan.area
        on_border = shapely.dwithin(
            plan.polygon.boundary, shapely.linestrings(np.array(plan.meta["unknown"]).reshape(-1, 2, 2)), 1e-3
        )
        assert on_border.all()
        observation, _, _, _, info = env.step(nearest(observation, info))
    assert areas[-1] > 2 * areas[0]
    assert min(unknown) > 0.5
    # Of the floor that is seen, nearly all is in the plan.
    assert areas[-1] == pytest.approx(env.snapshot().coverage * truth.area, rel=0.15)


@pytest.mark.parametrize("mode", ["exact", "gaussian", "slam"])
@pytest.mark.parametrize("family", FAMILIES)
def test_plans_of_unfinished_explorations_are_valid(family, mode):
    """Whatever has been seen, with twice the noise: `FloorPlan` checks that it is one valid polygon."""
    for number in range(4):
        truth = generate(family, 100 + number)
        config = {**KINEMATIC, "pose": {"mode": mode}, "sensor": {"sigma_range": 0.02, "sigma_angle": 0.0035}}
        env = PolyExploreEnv(truth, config=config)
        rng = np.random.default_rng(number)
        _, info = env.reset(seed=number)
        for step in range(24):
            if not info["action_mask"].any():
                break
            _, _, _, _, info = env.step(int(rng.choice(np.flatnonzero(info["action_mask"]))))
            if step % 8 == 0:
                plan = env.floor_plan()
                assert isinstance(plan, FloorPlan)
                assert plan.polygon.is_valid
                assert 0.0 <= plan.meta["unknown_share"] <= 1.0


def test_the_plan_does_not_change_the_exploration():
    truth = named_suite("home-validation").plan(2)
    distances = []
    for look in (False, True):
        env = PolyExploreEnv(truth, config=KINEMATIC)
        observation, info = env.reset(seed=0)
        while info["action_mask"].any():
            observation, _, _, _, info = env.step(nearest(observation, info))
            if look:
                first, again = env.floor_plan(), env.floor_plan()
                assert first == again
        distances.append(info["distance"])
    assert distances[0] == distances[1]


def test_a_plan_needs_a_reset():
    env = PolyExploreEnv(named_suite("home-validation").plan(2), config=KINEMATIC)
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"call reset\(\) before floor_plan\(\)"):
        env.floor_plan()


def test_a_made_environment_has_it():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make("polyexplore_gym:PolyExplore-Plan-v2", plan=named_suite("home-validation").plan(2))
        env.reset(seed=0)
        assert env.unwrapped.floor_plan().area > 1.0
