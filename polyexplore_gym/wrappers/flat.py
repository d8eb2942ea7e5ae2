"""`Flat`: the nodes as one vector, for learners that take nothing else."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from polyexplore_gym.wrappers.scaled import Arrays, Relative, scaled

FEATURES = (
    "x", "y", "cos_heading", "sin_heading", "path_length", "edge_length", "gain", "jump", "range_limit", "view_limit",
    "visits", "pursued", "reachable",
)  # fmt: skip
"""What a node is described by, in the units of `scaled`; all 0 where there is no node."""


def node_features(seen: Arrays) -> np.ndarray:
    """(n, len(FEATURES)) float32 of an observation that is `scaled`."""
    columns = (
        seen["node_position"], seen["node_heading"], seen["node_path_length"][:, None],
        seen["node_edge_length"][:, None], seen["node_gain"][:, None], seen["node_kind"],
        seen["node_visits"][:, None], seen["node_pursued"][:, None], seen["action_mask"][:, None],
    )  # fmt: skip
    return np.concatenate(columns, axis=1, dtype=np.float32)


class Flat(Relative):
    """A vector (n * len(FEATURES),): the features of node 0, of node 1, and so on; the nodes alone, without walls.

    Works with any learner that takes a Box; with MaskablePPO as it is:
    `MaskablePPO("MlpPolicy", Flat(gymnasium.make(...)))`.
    """

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        size = self.sizes.max_nodes * len(FEATURES)
        self.observation_space = spaces.Box(-1.0, 1.0, (size,), np.float32)

    def observation(self, observation: Any) -> np.ndarray:
        return node_features(scaled(observation)).ravel()
