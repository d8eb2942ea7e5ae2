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

from baselines.pockets import LIFT, RAYS, REACH, rays, shares
from baselines.tours import tours

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

    length, ends_on = rays(edges, heading, np.ascontiguousarray(lines), RAYS, LIFT, REACH * reach)
    tour, greedy = tours(cost, between)
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
    first = len(SCALARS) + 2 * len(VECTORS)
    node[:, first : first + RAYS] = length / reach
    node[:, first + RAYS : first + 2 * RAYS] = ends_on == -1
    node[:, first + 2 * RAYS :] = ends_on >= 0

    pair = np.zeros((k, k, PAIR), dtype=np.float32)
    straight = np.hypot(*np.moveaxis(position[:, None] - position[None], 2, 0))
    shared = shares(ends_on)
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
