"""Record a policy as a Minari data set, and clone it: one small network that scores every node alike.

python examples/11_record_and_clone.py [--episodes 200]      (extras "datasets" and "train")"""

import argparse
import tempfile

import gymnasium as gym
import minari
import numpy as np
import torch

from polyexplore_gym.config import EnvConfig, from_mapping
from polyexplore_gym.evaluation.recording import Recording, record
from polyexplore_gym.floorplan import suite
from polyexplore_gym.wrappers import FEATURES, Flat

CONFIG = {"drive": {"mode": "kinematic"}, "observation": {"max_nodes": 32, "relative": True}}
NEAR, VALID = FEATURES.index("path_length"), FEATURES.index("reachable")


def explored(env, score):
    """Metres driven until all was seen, over five flats, by the node with the best score."""
    total = 0.0
    for seed in range(5):
        seen, info = env.reset(seed=seed, options={"plan": suite("home-validation").plan(seed)})
        over = not info["action_mask"].any()
        while not over:
            nodes = torch.tensor(seen).reshape(32, -1)
            action = score(nodes).masked_fill(nodes[:, VALID] == 0, -1e9).argmax()
            seen, _, terminated, truncated, info = env.step(int(action))
            over = terminated or truncated
        total += info["distance"]
    return total


if __name__ == "__main__":
    (parser := argparse.ArgumentParser()).add_argument("--episodes", type=int, default=200)
    plans = [suite("home-train").plan(i) for i in range(parser.parse_args().episodes)]
    config = from_mapping(EnvConfig, CONFIG)
    teacher = Recording(policy="modified_sum", plans=plans, config=config, observation="flat")
    with tempfile.TemporaryDirectory() as folder:
        episodes = list(minari.MinariDataset(record(teacher, folder, "polyexplore/modified-sum-v0")))

    seen = torch.tensor(np.concatenate([e.observations[:-1] for e in episodes])).reshape(-1, 32, len(FEATURES))
    chosen = torch.tensor(np.concatenate([e.actions for e in episodes]))
    torch.manual_seed(0)
    score = torch.nn.Sequential(torch.nn.Linear(len(FEATURES), 64), torch.nn.ReLU(), torch.nn.Linear(64, 1))
    optimizer = torch.optim.Adam(score.parameters(), 3e-3)
    for _ in range(500):
        rows = torch.randint(len(seen), (256,))
        logits = score(seen[rows])[..., 0].masked_fill(seen[rows][..., VALID] == 0, -1e9)
        loss = torch.nn.functional.cross_entropy(logits, chosen[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    env = Flat(gym.make("polyexplore_gym:PolyExplore-Plan-v2", config=CONFIG))
    clone, nearest = explored(env, lambda nodes: score(nodes)[:, 0]), explored(env, lambda nodes: -nodes[:, NEAR])
    print(f"clone: {clone:.1f} m, nearest: {nearest:.1f} m")
