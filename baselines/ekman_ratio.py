"""Gain over cost: Ekman, Torne and Stromberg, "Exploration of polygonal environments using range data" (1997)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from baselines.choice import best, column

SHORTEST = 1e-3
"""Paths count as at least this long, m: a node under the robot must not divide by zero."""


class EkmanRatio:
    """C(n) = g_n / c_n: the sum of the angles that jump edges subtend at the node, over the path's length."""

    name = "ekman_ratio"

    def act(self, observation: Mapping[str, np.ndarray], info: Mapping[str, Any], rng: np.random.Generator) -> int:
        """The reachable node with the highest ratio."""
        cost = np.maximum(column(observation, "node_path_length"), SHORTEST)
        return best(column(observation, "node_gain") / cost, observation)
