"""Short open tours over nodes: nearest neighbour, then reversals and moves (2-opt, Or-opt) until nothing helps."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numba import njit

from polyexplore_gym.errors import InvalidConfigError

_PASSES = 10
"""So many passes of moves at most."""


@njit(cache=True)
def tours(cost: np.ndarray, between: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For every first node (k,): a short open way over all nodes, and the way that always takes the nearest next.

    Args:
        cost: (k,) path lengths from the robot, m.
        between: (k, k) path lengths between the nodes, m.

    Returns:
        Lengths (k,) of the two. The short way is the other one after `improve`.
    """
    k = len(cost)
    tour, greedy = np.empty(k), np.empty(k)
    way = np.empty(k, dtype=np.int64)
    for first in range(k):
        left = np.ones(k, dtype=np.bool_)
        way[0] = first
        left[first] = False
        for i in range(1, k):
            best = -1
            for j in range(k):
                if left[j] and (best < 0 or between[way[i - 1], j] < between[way[i - 1], best]):
                    best = j
            way[i] = best
            left[best] = False
        length = cost[first]
        for i in range(1, k):
            length += between[way[i - 1], way[i]]
        greedy[first] = length
        tour[first] = length - improve(way, between)
    return tour, greedy


@njit(cache=True)
def improve(way: np.ndarray, between: np.ndarray) -> float:
    """Shorten an open way (k,) by 2-opt and Or-opt moves, in place, its first node fixed; returns the metres saved."""
    k = len(way)
    total = 0.0
    for _ in range(_PASSES):
        gained = 0.0
        # Reverse way[i..j]; the end is free.
        for i in range(1, k - 1):
            for j in range(i + 1, k):
                old = between[way[i - 1], way[i]]
                new = between[way[i - 1], way[j]]
                if j + 1 < k:
                    old += between[way[j], way[j + 1]]
                    new += between[way[i], way[j + 1]]
                if new < old - 1e-9:
                    gained += old - new
                    a, b = i, j
                    while a < b:
                        way[a], way[b] = way[b], way[a]
                        a += 1
                        b -= 1
        # Move way[i] between way[j] and way[j + 1].
        for i in range(1, k):
            node = way[i]
            out = between[way[i - 1], node]
            if i + 1 < k:
                out += between[node, way[i + 1]] - between[way[i - 1], way[i + 1]]
            best, at = out - 1e-9, -1
            for j in range(k):
                if j == i or j == i - 1:
                    continue
                add = between[way[j], node]
                if j + 1 < k:
                    add += between[node, way[j + 1]] - between[way[j], way[j + 1]]
                if add < best:
                    best, at = add, j
            if at >= 0:
                gained += out - best
                if at < i:
                    for a in range(i, at + 1, -1):
                        way[a] = way[a - 1]
                    way[at + 1] = node
                else:
                    for a in range(i, at):
                        way[a] = way[a + 1]
                    way[at] = node
        total += gained
        if gained < 1e-9:
            break
    return total


@njit(cache=True)
def group_tours(cost: np.ndarray, between: np.ndarray, group: np.ndarray) -> np.ndarray:
    """For every first node (k,): the length of a short open way over one node of every other group.

    Groups are entered at their nearest node, the way is shortened by `improve`, and then for this order of the groups
    the best node of each is found by dynamic programming, until nothing helps.

    Args:
        cost: (k,) path lengths from the robot, m.
        between: (k, k) path lengths between the nodes, m.
        group: (k,) number of each node's group, 0 to g - 1.
    """
    k, g = len(cost), group.max() + 1
    out = np.empty(k)
    way = np.empty(g, np.int64)
    reach, came = np.empty((g, k)), np.empty((g, k), np.int64)
    for first in range(k):
        left = np.ones(g, np.bool_)
        way[0] = first
        left[group[first]] = False
        length = cost[first]
        for i in range(1, g):
            best = -1
            for j in range(k):
                if left[group[j]] and (best < 0 or between[way[i - 1], j] < between[way[i - 1], best]):
                    best = j
            length += between[way[i - 1], best]
            way[i] = best
            left[group[best]] = False
        for _ in range(_PASSES):
            length -= improve(way, between)
            if g == 1:
                break
            # the best node of each group in this order
            reach[0, first] = cost[first]
            for i in range(1, g):
                for v in range(k):
                    if group[v] != group[way[i]]:
                        continue
                    reach[i, v] = np.inf
                    for u in range(k):
                        if (i == 1 and u == first) or (i > 1 and group[u] == group[way[i - 1]]):
                            d = reach[i - 1, u] + between[u, v]
                            if d < reach[i, v]:
                                reach[i, v], came[i, v] = d, u
            end = -1
            for v in range(k):
                if group[v] == group[way[g - 1]] and (end < 0 or reach[g - 1, v] < reach[g - 1, end]):
                    end = v
            shorter = reach[g - 1, end]
            for i in range(g - 1, 0, -1):
                way[i] = end
                end = came[i, end]
            if shorter > length - 1e-9:
                break
            length = shorter
        out[first] = length
    return out


def ways(observation: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nodes that can be chosen (k,), and the path lengths to them (k,) and between them (k, k), m.

    Raises:
        InvalidConfigError: the observation lacks the path lengths between nodes.
    """
    slots = np.flatnonzero(observation["action_mask"])
    if len(slots) == 0:
        raise ValueError("no node can be chosen: the episode is over")
    between = np.asarray(observation["path_lengths"], dtype=np.float64)[np.ix_(slots, slots)]
    position = np.asarray(observation["node_position"], dtype=np.float64)[slots]
    if not between.any() and np.ptp(position, axis=0).any():
        raise InvalidConfigError("tours need the path lengths between nodes: observation.pairwise = True")
    return slots, np.asarray(observation["node_path_length"], dtype=np.float64)[slots], between
