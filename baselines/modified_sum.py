"""Edge length plus nearness: the criterion of Iles, Seder and Petrovic's improvement on Ekman's ratio."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from baselines.choice import best, column

SHORTEST = 1e-3
"""Paths count as at least this long, m: a node under the robot must not divide by zero."""


class ModifiedSum:
    """C(n) = l_n / R_max + R_max / c_n, with the fraction bars that the paper's print lost."""

    name = "modified_sum"

    def act(self, observation: Mapping[str, np.ndarray], info: Mapping[str, Any], rng: np.random.Generator) -> int:
        """The reachable node with the highest sum."""
        max_range = float(observation["max_range"][0])
        cost = np.maximum(column(observation, "node_path_length"), SHORTEST)
        return best(column(observation, "node_edge_length") / max_range + max_range / cost, observation)
