"""What a selector sees of an observation: numbers of nodes, of pairs of nodes and of the whole, without slots.

Lengths are in laser ranges, positions in the robot's frame. Only reachable nodes take part, so nothing depends
on the size of the arrays or on the frame of the map. Beside what the observation says of a node there are

- rays from the middle of its jump edge into the unknown, in directions fixed to the edge: how far to the next
  known wall or jump edge. They tell a closet from a hall;
- the length of a short tour over all nodes that begins with it, and of the tour that always takes the nearest;
- its rank by path length, and how near the other nodes are.

Of a pair: the path between the two, the straight line, and how many rays of one end on the jump edge of the
other (both lead into the same room).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numba import njit

RAYS = 12
"""Rays from a jump edge into the unknown, evenly spread over the half circle."""
REACH = 2.0
"""They end after so many laser ranges."""
_LIFT = 0.05
"""They start so far (m) beyond the edge, off the walls that it ends on."""
_LIMIT = 8.0
"""Lengths count as at most so many laser ranges; logarithms take over beyond."""

SCALARS = (
    "path", "path_log", "path_over_nearest", "path_over_nearest_log", "rank", "edge", "gain", "visits", "jump",
    "range_limit", "view_limit", "straight", "to_others", "to_next", "to_second", "advantage", "tour", "tour_log",
    "tour_over_best", "greedy_over_best", "greedy_over_tour", "pocket",
)  # fmt: skip
VECTORS = ("position", "heading", "edge_middle", "edge_along")
"""Each has an x and a y, which turn with the scene."""
NODE = len(SCALARS) + 2 * len(VECTORS) + 3 * RAYS
"""Numbers per node: scalars, vectors, then of every ray its length, whether a wall and whether an edge ends it."""
PAIR = 7
"""Numbers per pair of nodes."""
WHOLE = 8
"""Numbers of the whole."""


@dataclass(frozen=True, slots=True)
class Features:
    """What a network gets of an observation with k reachable nodes."""

    node: np.ndarray
    """(k, NODE) float32."""
    pair: np.ndarray
    """(k, k, PAIR) float32."""
    whole: np.ndarray
    """(WHOLE,) float32."""
    slots: np.ndarray
    """(k,) the action of each node."""


def features(seen: Mapping[str, np.ndarray]) -> Features:
    """The features of an observation, padded or not.

    Raises:
        ValueError: no node can be reached, or the path lengths between nodes are missing.
    """
    slots = np.flatnonzero(seen["action_mask"])
    k = len(slots)
    if k == 0:
        raise ValueError("no node can be chosen: the episode is over")
    reach = float(seen["max_range"][0])
    cost = np.asarray(seen["node_path_length"], dtype=np.float64)[slots]
    between = np.asarray(seen["path_lengths"], dtype=np.float64)[np.ix_(slots, slots)]
    position = np.asarray(seen["node_position"], dtype=np.float64)[slots]
    if k > 1 and not between.any() and np.ptp(position, axis=0).any():
        raise ValueError("a learned selector needs the path lengths between nodes: observation.pairwise = True")
    edges = np.asarray(seen["edges"], dtype=np.float64)[slots]
    heading = np.asarray(seen["node_heading"], dtype=np.float64)[slots]
    lines = np.asarray(seen["lines"], dtype=np.float64)[:, :4]
    if "line_mask" in seen:
        lines = lines[np.asarray(seen["line_mask"]) > 0]
    pose = np.asarray(seen["pose"], dtype=np.float64)

    length, ends_on = _rays(edges, heading, np.ascontiguousarray(lines), RAYS, _LIFT, REACH * reach)
    tour, greedy = _tours(cost, between)
    node = np.zeros((k, NODE), dtype=np.float32)
    ordered = np.sort(between + np.where(np.eye(k) > 0, np.inf, 0.0), axis=1) if k > 1 else np.zeros((1, 1))
    order = np.argsort(np.argsort(cost, kind="stable"), kind="stable")
    mean = between.sum(axis=1) / max(k - 1, 1)
    columns = [
        np.minimum(cost / reach, _LIMIT),
        np.log1p(cost / reach),
        np.minimum((cost - cost.min()) / reach, _LIMIT),
        np.log1p((cost - cost.min()) / reach * 4.0),
        order / max(k - 1, 1),
        np.asarray(seen["node_edge_length"], dtype=np.float64)[slots] / reach,
        np.asarray(seen["node_gain"], dtype=np.float64)[slots] / math.pi,
        np.asarray(seen["node_visits"], dtype=np.float64)[slots],
        *(np.asarray(seen["node_kind"])[slots] == kind for kind in range(3)),
        np.minimum(np.hypot(*(position - pose[:2]).T) / reach, _LIMIT),
        np.minimum(mean / reach, _LIMIT),
        np.minimum(ordered[:, 0] / reach, _LIMIT),
        np.minimum(ordered[:, min(1, k - 2) if k > 1 else 0] / reach, _LIMIT),
        np.clip((mean - cost) / reach, -_LIMIT, _LIMIT),
        np.minimum(tour / reach, _LIMIT) / 4.0,
        np.log1p(tour / reach),
        np.minimum((tour - tour.min()) / reach, _LIMIT),
        np.minimum((greedy - greedy.min()) / reach, _LIMIT),
        np.minimum((greedy - tour) / reach, _LIMIT),
        np.sqrt((length**2).sum(axis=1) / RAYS) / reach,
    ]
    for i, column in enumerate(columns):
        node[:, i] = column
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turn = np.array([[c, -s], [s, c]])
    middle = 0.5 * (edges[:, :2] + edges[:, 2:])
    vectors = [
        _shortened((position - pose[:2]) @ turn / reach),
        np.stack((np.cos(heading), np.sin(heading)), axis=1) @ turn,
        _shortened((middle - pose[:2]) @ turn / reach),
        _shortened((edges[:, 2:] - edges[:, :2]) @ turn / reach),
    ]
    for i, vector in enumerate(vectors):
        node[:, len(SCALARS) + 2 * i : len(SCALARS) + 2 * i + 2] = vector
    rays = len(SCALARS) + 2 * len(VECTORS)
    node[:, rays : rays + RAYS] = length / reach
    node[:, rays + RAYS : rays + 2 * RAYS] = ends_on == -1
    node[:, rays + 2 * RAYS :] = ends_on >= 0

    pair = np.zeros((k, k, PAIR), dtype=np.float32)
    straight = np.hypot(*np.moveaxis(position[:, None] - position[None], 2, 0))
    shared = np.stack([(ends_on == j).sum(axis=1) for j in range(k)], axis=1) / RAYS
    pair[..., 0] = np.minimum(between / reach, _LIMIT)
    pair[..., 1] = np.log1p(between / reach)
    pair[..., 2] = np.exp(-2.0 * between / reach)
    pair[..., 3] = np.minimum(straight / reach, _LIMIT)
    pair[..., 4] = np.clip((cost[:, None] + between - cost[None]) / reach, 0.0, _LIMIT)
    pair[..., 5] = shared
    pair[..., 6] = shared.T
    span = np.ptp(lines.reshape(-1, 2), axis=0) / reach if len(lines) else np.zeros(2)
    whole = np.array([
        k / 16.0, math.log(k), math.log1p(cost.min() / reach), math.log1p(cost.max() / reach),
        math.log1p(tour.min() / reach), (greedy.min() - tour.min()) / (tour.min() + reach),
        math.log1p(len(lines) / 32.0), 0.25 * math.log1p(span[0] * span[1]),
    ], dtype=np.float32)  # fmt: skip
    return Features(node, pair, whole, slots)


def _shortened(vectors: np.ndarray) -> np.ndarray:
    """Vectors (k, 2) with their lengths l replaced by log(1 + l): direction kept, far away not far out of range."""
    length = np.hypot(*vectors.T)[:, None]
    return vectors * np.where(length > 1e-9, np.log1p(length) / np.maximum(length, 1e-9), 1.0)


@njit(cache=True)
def _rays(edges, heading, lines, rays, lift, reach):  # type: ignore[no-untyped-def]
    """Lengths (k, rays) and what ends them: -2 nothing within reach, -1 a line (m, 4), j >= 0 the jump edge j."""
    k = len(edges)
    length = np.full((k, rays), reach)
    ends_on = np.full((k, rays), -2, dtype=np.int64)
    m = len(lines)
    for i in range(k):
        ex, ey = edges[i, 2] - edges[i, 0], edges[i, 3] - edges[i, 1]
        size = max(math.hypot(ex, ey), 1e-9)
        nx, ny = -ey / size, ex / size
        if nx * math.cos(heading[i]) + ny * math.sin(heading[i]) < 0.0:
            nx, ny = -nx, -ny
        ox = 0.5 * (edges[i, 0] + edges[i, 2]) + lift * nx
        oy = 0.5 * (edges[i, 1] + edges[i, 3]) + lift * ny
        for r in range(rays):
            a = math.pi * ((r + 0.5) / rays - 0.5)
            c, s = math.cos(a), math.sin(a)
            dx, dy = c * nx - s * ny, s * nx + c * ny
            for j in range(m + k):
                if j < m:
                    ax, ay, bx, by = lines[j, 0], lines[j, 1], lines[j, 2], lines[j, 3]
                elif j - m != i:
                    ax, ay, bx, by = edges[j - m, 0], edges[j - m, 1], edges[j - m, 2], edges[j - m, 3]
                else:
                    continue
                wx, wy = bx - ax, by - ay
                det = dx * wy - dy * wx
                if abs(det) < 1e-12:
                    continue
                px, py = ax - ox, ay - oy
                t = (px * wy - py * wx) / det
                u = (px * dy - py * dx) / det
                if 0.0 <= t < length[i, r] and 0.0 <= u <= 1.0:
                    length[i, r] = t
                    ends_on[i, r] = -1 if j < m else j - m
    return length, ends_on


@njit(cache=True)
def _tours(cost, between):  # type: ignore[no-untyped-def]
    """For every first node (k,): a short way over all nodes, and the way that always takes the nearest next.

    The short one is the latter improved by reversing parts and moving nodes (2-opt, Or-opt) until nothing helps.
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
        for _ in range(10):
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
            length -= gained
            if gained < 1e-9:
                break
        tour[first] = length
    return tour, greedy
