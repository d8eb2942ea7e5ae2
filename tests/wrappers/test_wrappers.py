"""Wrappers: valid environments, what they say is what the environment says, and learners take them as they are."""

from __future__ import annotations

import math

import gymnasium
import numpy as np
import pytest
import shapely
from gymnasium.utils.env_checker import check_env
from scipy.ndimage import maximum_filter

import polyexplore_gym  # noqa: F401  (registers the environments)
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.errors import InvalidConfigError
from polyexplore_gym.exploration import shapes
from polyexplore_gym.floorplan import generate
from polyexplore_gym.wrappers import FEATURES, Flat, Graph, GridImage, Scaled
from polyexplore_gym.wrappers.grid import JUMP_EDGES, NODES, SEEN, WALLS

WRAPPERS = {"scaled": Scaled, "flat": Flat, "graph": Graph, "grid": GridImage}
SIZES = {"max_nodes": 16, "max_lines": 64, "relative": True}


def made(wrapper, observation=SIZES, **settings):
    config = {"drive": {"mode": "kinematic"}, "observation": observation, "pose": {"mode": "gaussian"}, **settings}
    return wrapper(PolyExploreEnv(generate("home", 5), config=config))


def scenes(env, count=12):
    """Observations of the wrapper and of the environment below it along a way of `nearest`."""
    inside, info = env.reset(seed=2)
    for _ in range(count):
        outer = env.unwrapped.explorer.observation()
        yield inside, outer
        valid = np.flatnonzero(info["action_mask"])
        if not len(valid):
            return
        inside, *_, info = env.step(int(valid[outer["node_path_length"][valid].argmin()]))


@pytest.mark.parametrize("wrapper", WRAPPERS.values(), ids=WRAPPERS)
@pytest.mark.filterwarnings("ignore:.*different from the unwrapped version.*")
def test_each_is_an_environment(wrapper):
    check_env(made(wrapper), skip_render_check=True)


@pytest.mark.parametrize("wrapper", WRAPPERS.values(), ids=WRAPPERS)
@pytest.mark.filterwarnings("ignore:.*different from the unwrapped version.*")
def test_gymnasium_makes_each_again(wrapper):
    config = {"observation": SIZES, "drive": {"mode": "kinematic"}}
    env = wrapper(gymnasium.make("PolyExplore-Home-v2", config=config))
    check_env(env, skip_render_check=True)
    again = gymnasium.make(env.spec)
    assert again.observation_space == env.observation_space
    assert isinstance(again, wrapper)
    with pytest.raises(InvalidConfigError, match="as it is"):
        wrapper(env)
    with pytest.raises(InvalidConfigError, match="as it is"):
        wrapper(gymnasium.make("CartPole-v1"))


@pytest.mark.parametrize("wrapper", WRAPPERS.values(), ids=WRAPPERS)
def test_masks_stay_and_all_lies_within_the_space(wrapper):
    env = made(wrapper)
    for inside, outer in scenes(env, 30):
        assert env.observation_space.contains(inside)
        assert np.array_equal(env.action_masks(), outer["action_mask"].astype(bool))
        if wrapper is not Flat:
            assert np.array_equal(inside["action_mask"], outer["action_mask"])


@pytest.mark.parametrize("wrapper", WRAPPERS.values(), ids=WRAPPERS)
def test_what_they_need_is_asked_for(wrapper):
    with pytest.raises(InvalidConfigError, match=f"{wrapper.__name__} needs what is seen from the robot"):
        made(wrapper, {**SIZES, "relative": False})
    with pytest.raises(InvalidConfigError, match="Graph needs the paths"):
        made(Graph, {**SIZES, "pairwise": False})
    for settings, match in (({"size": 2}, "size = 2"), ({"resolution": 0.0}, "resolution = 0.0")):
        with pytest.raises(InvalidConfigError, match=match):
            made(lambda env: GridImage(env, **settings))  # noqa: B023
    with pytest.raises(InvalidConfigError, match="neighbours = -1"):
        made(lambda env: Graph(env, neighbours=-1))


def back(share, unit):
    """A squashed length in metres."""
    return share * unit / (1.0 - np.abs(share))


def test_scaled_says_the_same():
    for inside, outer in scenes(made(Scaled)):
        unit = outer["max_range"][0]
        for key in ("edges", "node_position", "node_edge_length"):
            assert back(inside[key].astype(float), unit) == pytest.approx(outer[key], abs=1e-4), key
        there = outer["node_mask"] > 0
        near = outer["action_mask"] > 0
        assert back(inside["node_path_length"][near], unit) == pytest.approx(outer["node_path_length"][near], rel=1e-4)
        assert (inside["node_path_length"][there & ~near] > 0.999).all()
        assert np.array_equal(np.argsort(inside["node_path_length"][near]), np.argsort(outer["node_path_length"][near]))
        angle = np.arctan2(inside["node_heading"][there, 1], inside["node_heading"][there, 0])
        assert np.cos(angle - outer["node_heading"][there]) == pytest.approx(1.0)
        assert np.array_equal(inside["node_kind"][there].argmax(axis=1), outer["node_kind"][there])
        assert (inside["node_kind"][there].sum(axis=1) == 1).all()
        assert back(inside["node_visits"][there], 1.0) == pytest.approx(outer["node_visits"][there], abs=1e-5)
        assert back(inside["lines"][:, :4].astype(float), unit) == pytest.approx(outer["lines"][:, :4], abs=1e-3)
        assert np.array_equal(inside["lines"][:, 4] > 0, outer["lines"][:, 8] > 0)
        sigma = back(inside["pose_sigma"].astype(float), np.array([unit, unit, math.pi]))
        assert sigma**2 == pytest.approx(np.diag(outer["pose_covariance"]), rel=1e-3)
        for key, value in inside.items():
            assert not value[len(there) :].any() or key in ("lines", "line_mask")
            if key.startswith("node_") or key == "edges":
                assert not value[~there].any(), key


def test_flat_is_the_nodes_one_after_the_other():
    scaled, flat = made(Scaled), made(Flat)
    for (inside, _), (vector, _) in zip(scenes(scaled), scenes(flat), strict=True):
        for i in range(16):
            row = dict(zip(FEATURES, vector.reshape(16, -1)[i], strict=True))
            assert (row["x"], row["y"]) == tuple(inside["node_position"][i])
            assert (row["cos_heading"], row["sin_heading"]) == tuple(inside["node_heading"][i])
            assert row["path_length"] == inside["node_path_length"][i]
            assert [row[k] for k in ("jump", "range_limit", "view_limit")] == inside["node_kind"][i].tolist()
            assert row["reachable"] == inside["action_mask"][i]
            assert (row["edge_length"], row["gain"]) == (inside["node_edge_length"][i], inside["node_gain"][i])
            assert (row["visits"], row["pursued"]) == (inside["node_visits"][i], inside["node_pursued"][i])


@pytest.mark.parametrize("neighbours", [0, 2, 99])
def test_the_graph_has_the_ways_between_nodes(neighbours):
    seen = 0
    for inside, outer in scenes(made(lambda env: Graph(env, neighbours=neighbours))):
        nodes, pairs, lengths = Graph.unpadded(inside)
        unit, n = outer["max_range"][0], 16
        slots = np.flatnonzero(outer["action_mask"])
        wanted = {(n, int(i)): outer["node_path_length"][i] for i in slots}
        wanted |= {(b, a): length for (a, b), length in wanted.items()}
        for i in slots:
            others = sorted((float(outer["path_lengths"][i, j]), int(j)) for j in slots if j != i)
            wanted |= {(int(i), j): length for length, j in others[:neighbours] if length < 1e5}
        assert {tuple(pair) for pair in pairs.T.tolist()} == set(wanted)
        assert pairs.shape[1] == len(wanted) == inside["edge_mask"].sum()
        for pair, share in zip(pairs.T.tolist(), lengths[:, 0], strict=True):
            assert back(float(share), unit) == pytest.approx(wanted[tuple(pair)], rel=1e-4)
        assert nodes[n, -1] == 1.0
        assert not nodes[:n, -1].any()
        assert not inside["edge_index"][:, inside["edge_mask"] == 0].any()
        seen += len(wanted)
    assert seen > 20


def test_the_picture_shows_what_the_map_holds():
    size, resolution = 80, 0.2
    env = made(lambda env: GridImage(env, size=size, resolution=resolution))
    for inside, outer in scenes(env):
        explorer, pose = env.unwrapped.explorer, outer["pose"].astype(float)
        seen = shapes.exploration_polygon(explorer.exploration)
        walls = shapely.union_all([shapely.LineString(w.reshape(2, 2)) for w in explorer.line_map.segments[
            explorer.line_map.alive]])  # fmt: skip
        column, row = np.meshgrid(np.arange(size), np.arange(size))
        ahead, left = (0.5 * (size - 1) - row) * resolution, (0.5 * (size - 1) - column) * resolution
        c, s = math.cos(pose[2]), math.sin(pose[2])
        points = shapely.points(pose[0] + c * ahead - s * left, pose[1] + s * ahead + c * left)
        clear = shapely.distance(points, seen.boundary) > resolution
        assert np.array_equal(inside["image"][SEEN][clear] > 0, shapely.contains(seen, points)[clear])
        far = shapely.distance(points, walls)
        assert (far[inside["image"][WALLS] > 0] < 1.5 * resolution).all()
        beside = maximum_filter(inside["image"][WALLS], 3)  # a stroke is a pixel wide
        inner = (np.minimum(column, row) > 0) & (np.maximum(column, row) < size - 1)
        assert (beside[inner & (far < 0.5 * resolution)] == 255).all()
        assert np.unique(inside["image"]).tolist() in ([0, 255], [255])
        for i in np.flatnonzero(outer["action_mask"]):
            x, y = outer["node_position"][i]
            wanted = -np.array([y, x]) / (0.5 * size * resolution)
            if np.abs(wanted).max() < 0.95:
                assert inside["node_pixel"][i] == pytest.approx(wanted, abs=1e-5)
                at = np.rint((inside["node_pixel"][i] * size + size - 1) / 2).astype(int)
                assert inside["image"][NODES][at[1], at[0]] == 255
            else:
                assert np.abs(inside["node_pixel"][i]).max() <= 1.0
        assert bool(inside["image"][JUMP_EDGES].any()) == bool((outer["node_mask"] > 0).any())


def test_a_vector_environment_takes_them():
    envs = gymnasium.make_vec(
        "PolyExplore-Home-v2", 2, "sync", wrappers=[Flat], config={"drive": {"mode": "kinematic"}, "observation": SIZES}
    )
    seen, info = envs.reset(seed=0)
    assert seen.shape == (2, 16 * len(FEATURES))
    seen, *_ = envs.step(info["action_mask"].argmax(axis=1))
    assert envs.observation_space.contains(seen)
    envs.close()


@pytest.mark.parametrize(("wrapper", "policy"), [(Flat, "MlpPolicy"), (Scaled, "MultiInputPolicy"),
                                                 (GridImage, "MultiInputPolicy")])  # fmt: skip
def test_maskable_ppo_learns_from_them(wrapper, policy):
    torch = pytest.importorskip("torch")
    sb3 = pytest.importorskip("sb3_contrib")
    torch.set_num_threads(1)
    env = made(wrapper)
    model = sb3.MaskablePPO(policy, env, n_steps=16, batch_size=16, n_epochs=1, seed=0, device="cpu")
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(32)
    assert any((a != b).any() for a, b in zip(before, model.policy.parameters(), strict=True))
    seen, info = env.reset(seed=1)
    for _ in range(5):
        if not info["action_mask"].any():
            break
        action, _ = model.predict(seen, action_masks=env.action_masks(), deterministic=True)
        seen, *_, info = env.step(int(action))
        assert not info["invalid_action"]
