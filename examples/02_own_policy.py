"""A policy of your own: anything with a method `act`. Everything random in it comes from `rng`.

python examples/02_own_policy.py
"""

import numpy as np

from polyexplore_gym.evaluation import Study, evaluate, name_policies, summarize, summary_text
from polyexplore_gym.floorplan import suite


class Frugal:
    """Near nodes first; a long jump edge is worth a detour of `rate` times its length."""

    def __init__(self, rate=1.0):
        self.rate = rate
        self.name = f"frugal {rate}"  # under which results are kept

    def reset(self):  # called before every episode: forget what belongs to the last one
        self.chosen = 0

    def act(self, observation, info, rng):
        self.chosen += 1
        score = self.rate * observation["node_edge_length"] - observation["node_path_length"]
        return int(np.where(observation["action_mask"], score, -np.inf).argmax())


if __name__ == "__main__":
    study = Study(
        policies=name_policies(["nearest", Frugal(), Frugal(0.2)]),
        plans=[suite("home-validation").plan(i) for i in range(3)],
        seeds=(0, 1),
    )
    records = evaluate(study, out="results/frugal", workers=1)
    print(summary_text(summarize(records, np.random.default_rng(0))))
