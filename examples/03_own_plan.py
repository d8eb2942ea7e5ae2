"""A floor plan of your own: an outline with holes, in metres; or a file (JSON, GeoJSON, DXF, SVG, a ROS map).

python examples/03_own_plan.py
"""

import gymnasium as gym
import numpy as np

from polyexplore_gym.floorplan import FloorPlan, load_plan, save_plan

outline = [[0, 0], [9, 0], [9, 5], [6, 5], [6, 8], [0, 8]]
pillar = [[3, 3], [4, 3], [4, 4], [3, 4]]
save_plan(FloorPlan.create(outline, [pillar], name="studio"), "studio.json")
print(load_plan("studio.json", radius=0.25))  # the radius of the robot: is all of it within reach?

env = gym.make("polyexplore_gym:PolyExplore-Plan-v2", plan="studio.json", config={"drive": {"mode": "kinematic"}})
seen, info = env.reset(seed=0, options={"start": (1.0, 1.0, 0.0)})  # x, y in m, heading in rad
while info["action_mask"].any():
    nodes = np.flatnonzero(info["action_mask"])
    seen, _, _, _, info = env.step(nodes[seen["node_gain"][nodes].argmax()])  # the best view, however far
print(f"{info['outcome']['status']}: {info['distance']:.1f} m, {100 * info['coverage']:.1f} % seen")
