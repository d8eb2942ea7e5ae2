"""The node at the end of the shortest path: nearest-frontier exploration (Yamauchi, 1997)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from baselines.choice import best, column


class Nearest:
    """Smallest c_n, the length of the collision-free path and not of the straight line."""

    name = "nearest"

    def act(self, observation: Mapping[str, np.ndarray], info: Mapping[str, Any], rng: np.random.Generator) -> int:
        """The reachable node with the shortest path."""
        return best(-column(observation, "node_path_length"), observation)
