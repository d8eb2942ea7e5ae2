"""The node of the longest jump edge, however far: gain without cost."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from baselines.choice import best, column


class Largest:
    """Largest l_n, the length of the node's jump edge."""

    name = "largest"

    def act(self, observation: Mapping[str, np.ndarray], info: Mapping[str, Any], rng: np.random.Generator) -> int:
        """The reachable node with the longest jump edge."""
        return best(column(observation, "node_edge_length"), observation)
