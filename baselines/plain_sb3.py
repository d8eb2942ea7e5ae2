"""A learner of your own: plain MaskablePPO of sb3-contrib on a flattened observation, and a sketch for others.

    python -m baselines.plain_sb3 [--steps 100000] [--first 24] [--workers 1] [--out results/plain_sb3]

Reads top to bottom: the environment, the learner, its policy in the benchmark, and what it reaches on home-test.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import FilterObservation
from sb3_contrib import MaskablePPO
from stable_baselines3.common.vec_env import DummyVecEnv

from polyexplore_gym.config import EnvConfig, from_mapping
from polyexplore_gym.evaluation import Study, evaluate, name_policies, summarize, summary_text
from polyexplore_gym.floorplan import suite

# 1. The environment. Kinematic, as that is faster; positions seen from the robot; as few nodes as a home needs. The
# reward is minus the distance: in units of 10 m, so that returns are of the order of one.
CONFIG = from_mapping(EnvConfig, {
    "drive": {"mode": "kinematic"},
    "exploration": {"placement": "in_front"},
    "observation": {"max_nodes": 16, "max_lines": 64, "relative": True, "pairwise": False},
    "reward": {"distance": -0.1},
    "max_decisions": 100,
})  # fmt: skip
# What the network sees; `MultiInputPolicy` flattens all of it into one vector.
KEYS = ("node_position", "node_path_length", "node_edge_length", "node_gain", "node_visits", "node_mask")


class Masked(FilterObservation):
    """A wrapper hides the environment's `action_masks`, by which MaskablePPO asks for the mask."""

    def action_masks(self) -> np.ndarray:
        return np.asarray(self.unwrapped.action_masks())  # type: ignore[attr-defined]


def make_env() -> gym.Env:
    return Masked(gym.make("polyexplore_gym:PolyExplore-Home-v2", config=CONFIG), KEYS)


# 2. The learner.
def train(steps: int, seed: int = 0, *, horizon: int = 256) -> MaskablePPO:
    model = MaskablePPO(
        "MultiInputPolicy",
        DummyVecEnv([make_env] * 4),
        n_steps=horizon,
        batch_size=min(256, 4 * horizon),
        gamma=0.98,
        seed=seed,
        device="cpu",
    )
    return model.learn(steps, progress_bar=False)


# 3. In the benchmark a policy is anything with `act`. It gets the whole observation of the study's configuration.
class Trained:
    name = "plain_sb3"

    def __init__(self, model: MaskablePPO) -> None:
        self.model = model

    def act(self, observation: Mapping[str, np.ndarray], info: Mapping[str, Any], rng: np.random.Generator) -> int:
        seen = {key: observation[key] for key in KEYS}
        action, _ = self.model.predict(seen, action_masks=observation["action_mask"].astype(bool), deterministic=True)
        return int(action)


# 4. Other algorithms need no more than this loop; a value-based one takes the best of the nodes that the mask allows.
def rollout(env: gym.Env, values: Any, rng: np.random.Generator, epsilon: float = 0.1) -> list[tuple[Any, int, float]]:
    """One episode by values(observation) -> (n,) with epsilon-greedy choices: (observation, action, reward) a step."""
    steps: list[tuple[Any, int, float]] = []
    seen, info = env.reset(seed=int(rng.integers(2**31)))
    over = not info["action_mask"].any()
    while not over:
        allowed = np.flatnonzero(info["action_mask"])
        greedy = allowed[np.argmax(np.asarray(values(seen))[allowed])]
        action = int(rng.choice(allowed) if rng.random() < epsilon else greedy)
        after, reward, terminated, truncated, info = env.step(action)
        steps.append((seen, action, float(reward)))
        seen, over = after, terminated or truncated
    return steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=100_000, help="decisions to learn from")
    parser.add_argument("--first", type=int, default=24, help="plans of home-test")
    parser.add_argument("--workers", type=int, default=1, help="processes of the comparison")
    parser.add_argument("--out", type=Path, default=Path("results/plain_sb3"), help="folder of the results")
    options = parser.parse_args()
    model = train(options.steps)
    study = Study(
        policies={**name_policies(["nearest", "modified_sum", "random"]), "plain_sb3": Trained(model)},
        plans=[suite("home-test").plan(i) for i in range(options.first)],
        placements=("in_front",),
        config=CONFIG,
    )
    records = evaluate(study, out=options.out, workers=options.workers)
    print(summary_text(summarize(records, np.random.default_rng(0))))


if __name__ == "__main__":
    main()
