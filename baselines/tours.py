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
        between: (k, k) path lengths between the nodes, m, symmetric.

    Returns:
        Lengths (k,) of the two. The short way is the other one after `improve`.
    """
    k = len(cost)
    tour, greedy = np.empty(k), np.empty(k)
    way = np.empty(k, dtype=np.uint16)
    near = np.empty((k, k), np.uint16)
    for i in range(k):
        near[i] = np.argsort(between[i], kind="mergesort")
    left = np.empty(k, dtype=np.bool_)
    for first in range(k):
        left[:] = True
        left[first] = False
        way[0] = at = first
        length = cost[first]
        for i in range(1, k):
            n = 0
            while not left[near[at, n]]:
                n += 1
            nearest = near[at, n]
            length += between[at, nearest]
            way[i] = at = nearest
            left[nearest] = False
        greedy[first] = length
        tour[first] = length - improve(way, between)
    return tour, greedy


@njit(cache=True)
def improve(way: np.ndarray, between: np.ndarray) -> float:
    """Shorten an open way (k,) by 2-opt and Or-opt moves, in place, its first node fixed; returns the metres saved.

    Whether there is any move of a node is asked first, of all places at once: a loop without branches or gathers, which
    the compiler turns into vector instructions. `between` (n, n) must be symmetric.
    """
    k = len(way)
    total = 0.0
    leg = np.zeros(k)  # from each node to the next; the end has none, so that it may be anywhere
    for j in range(k - 1):
        leg[j] = between[way[j], way[j + 1]]
    here, there = np.zeros(k + 1), np.zeros(k + 1)
    for _ in range(_PASSES):
        gained = 0.0
        # Reverse way[i..j]; `here` (k,) are the lengths from way[i - 1] to all, `there` those from way[i].
        for j in range(k):
            here[j] = between[way[0], way[j]]
        for i in range(1, k - 1):
            _lengths(way[i], way, between, there)
            start = i + 1
            while True:
                last = leg[i - 1]
                low = start & ~7  # few different lengths of the loop, which the processor can foresee
                for j in range(low, start):
                    here[j] = np.inf
                hits = 0
                for j in range(low, k):
                    hits += here[j] + there[j + 1] < last + leg[j] - 1e-9
                if hits == 0:
                    break
                j = start
                while not here[j] + there[j + 1] < last + leg[j] - 1e-9:
                    j += 1
                gained += last + leg[j] - (here[j] + there[j + 1])
                a, b = i, j
                while a < b:
                    way[a], way[b] = way[b], way[a]
                    here[a], here[b] = here[b], here[a]
                    a += 1
                    b -= 1
                for a in range(i - 1, min(j + 1, k - 1)):
                    leg[a] = between[way[a], way[a + 1]]
                _lengths(way[i], way, between, there)
                start = j + 1
            here, there = there, here
        # Move way[i] between way[j] and way[j + 1].
        for i in range(1, k):
            node = way[i]
            out = leg[i - 1]
            if i + 1 < k:
                out += leg[i] - between[way[i - 1], way[i + 1]]
            best, at = out - 1e-9, -1
            _lengths(node, way, between, here)
            here[i] = np.inf  # not beside itself
            hits = 0
            for j in range(k):
                hits += here[j] + (here[j + 1] - leg[j]) < best
            if hits == 0:
                continue
            for j in range(k):
                add = here[j] + (here[j + 1] - leg[j])
                if add < best:
                    best, at = add, j
            gained += out - best
            if at < i:
                for a in range(i, at + 1, -1):
                    way[a] = way[a - 1]
                way[at + 1] = node
            else:
                for a in range(i, at):
                    way[a] = way[a + 1]
                way[at] = node
            for a in range(min(at, i - 1), min(max(at, i) + 1, k - 1)):
                leg[a] = between[way[a], way[a + 1]]
        total += gained
        if gained < 1e-9:
            break
    return total


@njit(cache=True)
def _lengths(node: int, way: np.ndarray, between: np.ndarray, out: np.ndarray) -> None:
    """Lengths from a node to all of a way (k,), then 0: beyond its end there is nothing to reach."""
    for j in range(len(way)):
        out[j] = between[node, way[j]]
    out[len(way)] = 0.0


@njit(cache=True)
def group_tours(cost: np.ndarray, between: np.ndarray, group: np.ndarray) -> np.ndarray:
    """For every first node (k,): the length of a short open way over one node of every other group.

    Groups are entered at their nearest node, the way is shortened by `improve`, and then for this order of the groups
    the best node of each is found by dynamic programming, until nothing helps.

    Args:
        cost: (k,) path lengths from the robot, m.
        between: (k, k) path lengths between the nodes, m, symmetric.
        group: (k,) number of each node's group, 0 to g - 1.
    """
    k, g = len(cost), group.max() + 1
    out = np.empty(k)
    way = np.empty(g, np.uint16)
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
    between = np.asarray(observation["path_lengths"], dtype=np.float64)[np.ix_(slots, slots)]
    position = np.asarray(observation["node_position"], dtype=np.float64)[slots]
    if len(slots) and not between.any() and np.ptp(position, axis=0).any():
        raise InvalidConfigError("tours need the path lengths between nodes: observation.pairwise = True")
    return slots, np.asarray(observation["node_path_length"], dtype=np.float64)[slots], between
