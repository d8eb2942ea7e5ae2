"""Near to the robot, far from the rest: Ericson, Pedro, Jensfelt, "Information Gain Is Not All You Need" (2025)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from baselines.choice import best, column


class DistanceAdvantage:
    """A(n) = mean over u of d(u, n) - c_n: how much nearer node n is from here than from elsewhere.

    Taken from the paper (arXiv 2504.01980) and its authors' published proof of concept: the form of
    the score, the choice of its maximum, path lengths for d, and a horizon beyond which frontiers
    are left out (61 cells of 0.25 m there). Reconstructed: theirs takes the mean over the free
    cells of a grid map within the horizon; here u are the other reachable nodes, the abstract's
    "remoteness from other frontiers", since the observation has no grid. Guessed: all nodes weigh
    the same, and the paper's filter on gain is the environment's own rule for what is a node.

    Args:
        horizon: nodes with a longer path (m) wait until no nearer one is left; inf: none waits.
    """

    name = "distance_advantage"

    def __init__(self, horizon: float = 15.0) -> None:
        if not (isinstance(horizon, (int, float)) and horizon > 0):
            raise ValueError(f"horizon = {horizon!r}: must be a positive number (m)")
        self.horizon = float(horizon)

    def act(self, observation: Mapping[str, np.ndarray], info: Mapping[str, Any], rng: np.random.Generator) -> int:
        """The reachable node with the greatest advantage."""
        cost = column(observation, "node_path_length")
        nodes = np.flatnonzero(observation["action_mask"])
        nodes = nodes[cost[nodes] <= max(self.horizon, cost[nodes].min(initial=math.inf))]
        between = column(observation, "path_lengths")[np.ix_(nodes, nodes)]
        if len(nodes) > 1 and not between.any() and np.ptp(observation["node_position"][nodes], axis=0).any():
            raise ValueError("distance_advantage needs the path lengths between nodes: observation.pairwise = True")
        score = np.full(len(cost), -math.inf)
        score[nodes] = between.sum(axis=1) / max(len(nodes) - 1, 1) - cost[nodes]
        return best(score, observation)
