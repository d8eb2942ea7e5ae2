"""The first node of a short open tour over all nodes: looking ahead by the order of visits, no more."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from baselines.choice import NOTHING, best, number
from baselines.tours import tours, ways


class Tour:
    """Shortest tour from the robot over all reachable nodes, ending anywhere, that begins with the node.

    Only the first leg is driven before the map changes, so that it counts `near` times more than the rest.
    """

    name = "tour"

    def __init__(self, near: float = 2.0) -> None:
        """near: additional weight of the first leg, at least 0."""
        self.near = number("near", near)

    def act(self, observation: Mapping[str, np.ndarray], info: Mapping[str, Any], rng: np.random.Generator) -> int:
        """The first node of the shortest tour; needs `observation.pairwise`."""
        slots, cost, between = ways(observation)
        if not len(slots):
            return NOTHING
        score = np.zeros(len(observation["action_mask"]))
        score[slots] = -tours(cost, between)[0] - self.near * cost
        return best(score, observation)
