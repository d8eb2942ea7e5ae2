import subprocess
import sys

import numpy as np
import pytest

from baselines import make_policy, policy_names
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.errors import InvalidConfigError
from polyexplore_gym.evaluation import Policy, run_episode
from polyexplore_gym.floorplan import FloorPlan

N = 6


def observation(**given):
    """Nodes 0 to 4 exist, 4 cannot be reached, slot 5 is padding; everything random but what is given."""
    rng = np.random.default_rng(given.pop("seed", 0))
    mask = np.array([1, 1, 1, 1, 0, 0], dtype=np.int8)
    between = rng.uniform(1, 9, size=(N, N))
    values = {
        "max_range": np.array([8.0]),
        "node_position": rng.uniform(0, 9, size=(N, 2)),
        "node_path_length": np.where(mask, rng.uniform(0.5, 9, size=N), 0.0),
        "node_edge_length": rng.uniform(0.3, 5, size=N),
        "node_gain": rng.uniform(0.5, 4, size=N),
        "action_mask": mask,
        "path_lengths": between + between.T,
        "pose": np.zeros(3),
        "edges": rng.uniform(0, 9, size=(N, 4)),
        "node_heading": rng.uniform(-3, 3, size=N),
        "node_kind": rng.integers(0, 3, size=N),
        "node_visits": np.zeros(N),
        "lines": rng.uniform(0, 9, size=(4, 9)),
        "line_mask": np.array([1, 1, 1, 0]),
    }
    values |= {k: np.asarray(v) for k, v in given.items()}
    return {k: v.astype(np.int8 if k == "action_mask" else np.float32) for k, v in values.items()}


def choose(name, seen, seed=0, **parameters):
    return make_policy(name, **parameters).act(seen, {"action_mask": seen["action_mask"]}, np.random.default_rng(seed))


@pytest.mark.parametrize("name", policy_names())
def test_every_policy_chooses_a_reachable_node(name):
    policy = make_policy(name)
    assert isinstance(policy, Policy)
    assert policy.name == name
    rng = np.random.default_rng(1)
    for seed in range(100):
        mask = np.random.default_rng(seed).integers(0, 2, size=N)
        mask[seed % N] = 1
        seen = observation(seed=seed, action_mask=mask)
        before = {key: value.copy() for key, value in seen.items()}
        action = policy.act(seen, {}, rng)
        assert type(action) is int
        assert mask[action]
        for key, value in before.items():
            np.testing.assert_array_equal(seen[key], value)


@pytest.mark.parametrize("name", policy_names())
def test_every_policy_has_an_answer_where_nothing_is_left(name):
    action = choose(name, observation(action_mask=[0] * N))
    assert (action, type(action)) == (0, int)


@pytest.mark.parametrize("name", policy_names())
def test_every_policy_explores_a_plan_that_is_seen_whole_from_the_start(name):
    config = {"sensor": {"field_of_view": 2 * np.pi, "beams": 720}, "drive": {"mode": "kinematic"}}
    env, policy, rng = PolyExploreEnv(config=config), make_policy(name), np.random.default_rng(0)
    for side in (2.0, 3.0, 4.0):
        room = FloorPlan.create([[0, 0], [side, 0], [side, side], [0, side]], name="room")
        for seed in range(3):
            seen, info = env.reset(seed=seed, options={"plan": room})
            assert not info["action_mask"].any()
            # The README's loop does not begin; one that asks for an action first gets it, and ends at no cost.
            _, reward, terminated, truncated, info = env.step(policy.act(seen, info, rng))
            assert (reward, terminated, truncated, info["distance"]) == (0.0, True, False, 0.0)
            record = run_episode(env, policy, room, seed, label=name)
            assert (record.ended, record.decisions, record.error) == (True, 0, None)


@pytest.mark.parametrize("name", [n for n in policy_names() if n not in ("random", "learned", "rollout")])
def test_ties_go_to_the_lower_index_and_the_choice_repeats(name):
    alike = {key: [2.0] * N for key in ("node_path_length", "node_edge_length", "node_gain")}
    seen = observation(**alike, path_lengths=np.full((N, N), 3.0), action_mask=[0, 1, 1, 0, 1, 0])
    assert [choose(name, seen, seed) for seed in range(5)] == [1] * 5


def test_scores_by_hand():
    cost, edge, gain = [1.0, 2.0, 4.0, 8.0, 0.1, 0.0], [0.5, 3.0, 4.0, 5.0, 9.0, 0.0], [0.5, 0.9, 3.0, 3.1, 9.0, 0.0]
    seen = observation(node_path_length=cost, node_edge_length=edge, node_gain=gain)
    assert choose("nearest", seen) == 0
    assert choose("largest", seen) == 3
    assert choose("ekman_ratio", seen) == 2  # 0.5, 0.45, 0.75, 0.39
    assert choose("modified_sum", seen) == 0  # 0.06 + 8, 0.38 + 4, 0.5 + 2, 0.63 + 1
    assert choose("modified_sum", {**seen, "max_range": np.array([1.0])}) == 3  # 1.5, 3.5, 4.25, 5.13
    assert choose("utility", seen) == 1  # 0.41, 2.01, 1.80, 1.01
    assert choose("utility", seen, rate=0.0) == 3
    assert choose("utility", seen, rate=5.0) == 0


def test_distance_advantage_by_hand():
    # Node 1 is a little farther than node 0 but away from the rest: go there now, not later.
    cost = [2.0, 3.0, 2.5, 4.0, 0.0, 0.0]
    between = np.zeros((N, N))
    between[:4, :4] = [[0, 5, 1, 2], [5, 0, 5.5, 7], [1, 5.5, 0, 2], [2, 7, 2, 0]]
    seen = observation(node_path_length=cost, path_lengths=between)
    # Means to the others 2.67, 5.83, 2.83, 3.67; less the cost 0.67, 2.83, 0.33, -0.33.
    assert choose("distance_advantage", seen) == 1
    assert choose("nearest", seen) == 0
    # Beyond the horizon it waits; and of what is all beyond, the nearest comes first.
    assert choose("distance_advantage", seen, horizon=2.6) == 0  # of 0 and 2: 1 - 2, 1 - 2.5
    assert choose("distance_advantage", seen, horizon=0.5) == 0
    assert choose("distance_advantage", observation(action_mask=[0, 0, 0, 1, 0, 0])) == 3


def test_distance_advantage_asks_for_pairwise_path_lengths():
    with pytest.raises(ValueError, match="pairwise = True"):
        choose("distance_advantage", observation(path_lengths=np.zeros((N, N))))


def test_a_node_under_the_robot_divides_by_no_zero():
    seen = observation(node_path_length=[3.0, 0.0, 2.0, 1.0, 0.0, 0.0])
    for name in ("ekman_ratio", "modified_sum", "nearest"):
        with np.errstate(all="raise"):
            assert choose(name, seen) == 1


def test_random_draws_all_reachable_nodes_alike():
    policy, rng = make_policy("random"), np.random.default_rng(3)
    seen = observation(action_mask=[1, 0, 1, 0, 1, 0])
    counts = np.bincount([policy.act(seen, {}, rng) for _ in range(3000)], minlength=N)
    assert set(np.flatnonzero(counts)) == {0, 2, 4}
    assert counts[[0, 2, 4]].min() > 900


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("nearest", {"rate": 1}),
        ("utility", {"rate": -0.1}),
        ("utility", {"rate": float("nan")}),
        ("utility", {"rate": "fast"}),
        ("distance_advantage", {"horizon": 0}),
        ("no_such", {}),
    ],
)
def test_bad_names_and_parameters(name, parameters):
    with pytest.raises(InvalidConfigError, match=name):
        make_policy(name, **parameters)


def test_scripted_policies_import_no_torch_and_no_plans():
    code = (
        "import sys, baselines\n"
        "[baselines.make_policy(n) for n in baselines.policy_names() if n != 'learned']\n"
        "bad = [m for m in sys.modules if m.split('.')[0] in ('torch', 'matplotlib', 'pygame', 'cv2')]\n"
        "bad += [m for m in sys.modules if m.startswith(('polyexplore_gym.floorplan', 'polyexplore_gym.sim'))]\n"
        "sys.exit(repr(bad) if bad else 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
