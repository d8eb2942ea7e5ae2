"""Any reachable node, all with the same probability: the floor that every criterion has to clear."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from baselines.choice import NOTHING


class Uniform:
    """The policy `random`."""

    name = "random"

    def act(self, observation: Mapping[str, np.ndarray], info: Mapping[str, Any], rng: np.random.Generator) -> int:
        """A reachable node drawn from `rng`."""
        reachable = np.flatnonzero(observation["action_mask"])
        if len(reachable) == 0:
            return NOTHING
        return int(reachable[rng.integers(len(reachable))])
