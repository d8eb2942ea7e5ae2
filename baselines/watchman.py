"""The first node of a short tour over groups of nodes of which one suffices: a generalised travelling salesman."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from baselines.choice import NOTHING, best, number
from baselines.pockets import pockets
from baselines.tours import group_tours, ways


class Watchman:
    """Goal selection by the distance-limited watchman route of Kulich, Miranda-Bront and Preucil (2017, 2019).

    Theirs samples goals from which the frontiers within a distance are seen, and visits one goal of each group. The
    nodes here are such goals already, one a jump edge. Reconstructed: nodes form a group when rays from the jump edge
    of the one end on that of the other, as both then lead into one room; one of them is visited.
    """

    name = "watchman"

    def __init__(self, near: float = 2.0, shared: float = 0.25) -> None:
        """near: additional weight of the first leg, at least 0; shared: least share of rays that end on the other."""
        self.near, self.shared = number("near", near), number("shared", shared, 0.01, 1.0)

    def act(self, observation: Mapping[str, np.ndarray], info: Mapping[str, Any], rng: np.random.Generator) -> int:
        """The first node of the shortest tour; needs `observation.pairwise`."""
        slots, cost, between = ways(observation)
        if not len(slots):
            return NOTHING
        _, shared = pockets(observation, slots)
        joined = scipy.sparse.csr_array(np.minimum(shared, shared.T) >= self.shared)
        group = connected_components(joined, directed=False)[1].astype(np.int64)
        score = np.zeros(len(observation["action_mask"]))
        score[slots] = -group_tours(cost, between, group) - self.near * cost
        return best(score, observation)
