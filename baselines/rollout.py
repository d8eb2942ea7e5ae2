"""The node after which the rest is expected to be shortest: nearest-node exploration played out in guessed rooms."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numba import njit

from baselines.choice import NOTHING, best, number
from baselines.pockets import pockets
from baselines.tours import ways

_DEEPEST = 4
"""So many further nodes at most are guessed behind one."""


class Rollout:
    """Base policy: the nearest node, always. Each choice is followed by it through the same guesses of the unknown.

    A guess: behind a node that is visited there is, with probability `chance`, a further one, `scale` times as far as
    the pocket is deep (rays into the unknown), times a random number of mean 1. So a jump edge leads to a chain of
    nodes, and leaving it means coming back for the rest. `chance` and `scale` are the best of a few values tried on
    generated validation plans.
    """

    name = "rollout"

    def __init__(self, chance: float = 0.4, scale: float = 0.5, samples: int = 32, near: float = 2.0) -> None:
        """samples: guesses, at least 1; near: additional weight of the first leg, at least 0."""
        self.chance, self.scale = number("chance", chance, high=0.95), number("scale", scale)
        self.samples, self.near = int(number("samples", samples, 1, 10_000)), number("near", near)

    def act(self, observation: Mapping[str, np.ndarray], info: Mapping[str, Any], rng: np.random.Generator) -> int:
        """The node with the shortest mean of the ways played out; needs `observation.pairwise`."""
        slots, cost, between = ways(observation)
        if not len(slots):
            return NOTHING
        radius, _ = pockets(observation, slots)
        shape = (self.samples, len(slots), _DEEPEST)
        further = self.scale * radius[:, None] * rng.exponential(size=shape)
        further[rng.random(shape) >= self.chance] = np.inf
        score = np.zeros(len(observation["action_mask"]))
        score[slots] = -played_out(cost, between, further) - self.near * cost
        return best(score, observation)


@njit(cache=True)
def played_out(cost: np.ndarray, between: np.ndarray, further: np.ndarray) -> np.ndarray:
    """Mean ways (k,), m, until nothing is left when the nearest node is taken after each first one.

    Args:
        cost: (k,) path lengths from the robot.
        between: (k, k) path lengths between the nodes.
        further: (s, k, d) distance from the node, or from the last one behind it, to the next; inf where none follows.
    """
    samples, k, deepest = further.shape
    total = np.zeros(k)
    depth, behind = np.empty(k), np.empty(k, np.int64)
    for first in range(k):
        for s in range(samples):
            depth[:] = 0.0
            behind[:] = 0
            at, inside, way, left = first, 0.0, cost[first], k
            while True:
                # the node at hand is seen: what is behind it shows, or nothing does
                n = behind[at]
                if n < deepest and np.isfinite(further[s, at, n]):
                    depth[at] += further[s, at, n]
                    behind[at] = n + 1
                else:
                    behind[at] = deepest + 1
                    left -= 1
                    if left == 0:
                        break
                nearest, step = -1, np.inf
                for j in range(k):
                    if behind[j] <= deepest:
                        d = depth[j] - inside if j == at else inside + between[at, j] + depth[j]
                        if d < step:
                            nearest, step = j, d
                way += step
                at, inside = nearest, depth[nearest]
            total[first] += way
    return total / samples
