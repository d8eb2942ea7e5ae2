"""What the scripted policies share: the best of the reachable nodes, and parameters within their limits."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

NOTHING = 0
"""What a policy answers where no node can be chosen, as on a plan seen whole from the start: any action ends that."""


def best(score: np.ndarray, observation: Mapping[str, np.ndarray]) -> int:
    """Index of the highest score among the nodes that can be chosen; ties go to the lower index. None: `NOTHING`.

    Args:
        score: (max_nodes,) one a slot; those of masked slots are not looked at.
        observation: its `action_mask` (max_nodes,) says which slots can be chosen.

    Raises:
        ValueError: a reachable node's score is not a number.
    """
    reachable = np.flatnonzero(observation["action_mask"])
    if len(reachable) == 0:
        return NOTHING
    scores = np.asarray(score, dtype=np.float64)[reachable]
    if np.isnan(scores).any():
        raise ValueError("the score of a reachable node is not a number")
    return int(reachable[np.argmax(scores)])


def column(observation: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """(max_nodes,) a quantity of all nodes in double precision, so that scores do not round to ties."""
    return np.asarray(observation[name], dtype=np.float64)


def number(name: str, value: float, low: float = 0.0, high: float = math.inf) -> float:
    """A policy's parameter; raises ValueError if it is not a number from `low` to `high`."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise ValueError(f"{name} = {value!r}: must be a number from {low:g} to {high:g}")
    return value
