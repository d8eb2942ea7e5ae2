"""Train MaskablePPO of sb3-contrib on the nodes as one vector. Needs the extra "train".

    python examples/05_train.py [--steps 100000]

(Slots of a vector have no order that means anything: `polyexplore train` has a network that does not mind.)
"""

import argparse

import gymnasium as gym
from sb3_contrib import MaskablePPO
from stable_baselines3.common.vec_env import DummyVecEnv

from polyexplore_gym.wrappers import Flat

CONFIG = {
    "drive": {"mode": "kinematic"},  # faster
    "observation": {"max_nodes": 16, "relative": True, "pairwise": False},
    "reward": {"distance": -0.1},  # returns of the order of one
    "max_decisions": 100,
}


def make_env():
    return Flat(gym.make("polyexplore_gym:PolyExplore-Home-v2", config=CONFIG))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=100_000)
    steps = parser.parse_args().steps
    # Masks are found by the name action_masks. An episode is a walk through a flat: about 20 decisions.
    model = MaskablePPO(
        "MlpPolicy", DummyVecEnv([make_env] * 4), n_steps=min(256, steps // 4), batch_size=64, gamma=0.98, seed=0,
        device="cpu", verbose=1,
    )  # fmt: skip
    model.learn(steps)
    model.save("trained.zip")

    env = make_env()
    seen, info = env.reset(seed=1)
    over = not info["action_mask"].any()
    while not over:
        action, _ = model.predict(seen, action_masks=env.action_masks(), deterministic=True)
        seen, _, terminated, truncated, info = env.step(int(action))
        over = terminated or truncated
    print(f"{info['outcome']['status']}: {info['distance']:.1f} m driven")
