"""The loop: reset, choose a node that can be reached, step. Here always the nearest one, by path.

python examples/01_first_loop.py
"""

import gymnasium as gym
import numpy as np

env = gym.make("polyexplore_gym:PolyExplore-Home-v2", config={"drive": {"mode": "kinematic"}})
seen, info = env.reset(seed=1)
done = not info["action_mask"].any()  # a plan may be seen whole from the start
while not done:
    nodes = np.flatnonzero(seen["action_mask"])
    action = nodes[seen["node_path_length"][nodes].argmin()]
    seen, reward, terminated, truncated, info = env.step(action)
    done = terminated or truncated
print(f"{info['distance']:.1f} m driven in {info['measurements']} scans, {100 * info['coverage']:.1f} % seen")
