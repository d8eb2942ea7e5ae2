"""Gain discounted by cost: Gonzalez-Banos, Latombe, "Navigation strategies for exploring indoor environments" 2002."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from baselines.choice import best, column


class Utility:
    """C(n) = l_n exp(-rate c_n).

    The paper's gain is the area that may come into view; here it is the length of the jump edge
    (m), which the area grows with.

    Args:
        rate: the paper's lambda, 1/m; 0 is the policy `largest`, a high rate comes near `nearest`.
    """

    name = "utility"

    def __init__(self, rate: float = 0.2) -> None:
        if not (isinstance(rate, (int, float)) and math.isfinite(rate) and rate >= 0):
            raise ValueError(f"rate = {rate!r}: must be a number, not negative (1/m)")
        self.rate = float(rate)

    def act(self, observation: Mapping[str, np.ndarray], info: Mapping[str, Any], rng: np.random.Generator) -> int:
        """The reachable node with the highest utility."""
        # The logarithm orders alike and does not underflow at the end of a long corridor.
        gain = np.log(np.maximum(column(observation, "node_edge_length"), 1e-9))
        return best(gain - self.rate * column(observation, "node_path_length"), observation)
