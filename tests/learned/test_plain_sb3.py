import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("sb3_contrib")

from baselines.plain_sb3 import CONFIG, Trained, make_env, rollout, train  # noqa: E402
from polyexplore_gym.env import PolyExploreEnv  # noqa: E402
from polyexplore_gym.evaluation import run_episode  # noqa: E402
from polyexplore_gym.floorplan import suite  # noqa: E402


def test_the_example_learns_and_explores():
    torch.set_num_threads(1)
    policy = Trained(train(64, horizon=16))
    record = run_episode(PolyExploreEnv(config=CONFIG), policy, suite("home-validation").plan(3), 0, label="plain")
    assert record.ended
    assert record.invalid_actions == 0


def test_the_loop_for_other_algorithms_plays_an_episode():
    def values(seen):
        return -seen["node_path_length"]

    steps = rollout(make_env(), values, np.random.default_rng(0), epsilon=0.5)
    assert len(steps) > 1
    assert all(seen["node_mask"][action] == 1 for seen, action, _ in steps)
    assert sum(reward for _, _, reward in steps) < 0.0
