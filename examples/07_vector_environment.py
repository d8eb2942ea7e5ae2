"""Many environments at once, as learners want them: one process each, masks in the info.

python examples/07_vector_environment.py
"""

import gymnasium as gym
import numpy as np

import polyexplore_gym  # noqa: F401  (registers the environments)

CONFIG = {"drive": {"mode": "kinematic"}, "observation": {"max_nodes": 16, "max_lines": 64}}

if __name__ == "__main__":
    envs = gym.make_vec("PolyExplore-Mixed-v2", num_envs=3, vectorization_mode="async", config=CONFIG)
    seen, info = envs.reset(seed=[1, 2, 3])
    episodes, total = 0, np.zeros(3)
    for _ in range(40):
        path = np.where(info["action_mask"], seen["node_path_length"], np.inf)
        # A row without a node is that of an episode that is over: any action resets it in the next step.
        seen, rewards, terminated, truncated, info = envs.step(path.argmin(axis=1))
        total += rewards
        episodes += int((terminated | truncated).sum())
    print(f"{episodes} episodes ended, {-total.sum():.0f} m driven in 120 decisions")
    envs.close()
