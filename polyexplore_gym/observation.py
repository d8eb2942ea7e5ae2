"""The observation: `space()` and `observe()` side by side, so that they cannot drift apart.

A dictionary of padded, bounded float32 arrays and int8 masks. Row i of everything called `node_...`,
of `edges` and of `path_lengths` is action i. Padding is 0.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from gymnasium import spaces
from numba import njit

from polyexplore_gym.config import LONGEST, ObservationConfig
from polyexplore_gym.exploration import ExplorationMap
from polyexplore_gym.mapping import LineMap

LIMIT = LONGEST
"""Bound of every position and length, m; also the path length to what cannot be reached."""

_VARIANCE = 1e6


def space(config: ObservationConfig) -> spaces.Dict:
    """The observation space."""
    n, m = config.max_nodes, config.max_lines

    def box(low: float, high: float, *shape: int) -> spaces.Box:
        return spaces.Box(low, high, shape, np.float32)

    def mask(size: int) -> spaces.Box:
        return spaces.Box(0, 1, (size,), np.int8)

    return spaces.Dict({
        "pose": box(-LIMIT, LIMIT, 3),
        "pose_covariance": box(-_VARIANCE, _VARIANCE, 3, 3),
        "max_range": box(0.0, LIMIT, 1),
        "lines": box(-_VARIANCE, _VARIANCE, m, 9),
        "line_mask": mask(m),
        "edges": box(-LIMIT, LIMIT, n, 4),
        "node_position": box(-LIMIT, LIMIT, n, 2),
        "node_heading": box(-math.pi - 1e-6, math.pi + 1e-6, n),
        "node_path_length": box(0.0, LIMIT, n),
        "node_edge_length": box(0.0, LIMIT, n),
        "node_gain": box(0.0, LIMIT, n),
        "node_kind": box(0.0, 2.0, n),
        "node_visits": box(0.0, LIMIT, n),
        "node_pursued": mask(n),
        "node_mask": mask(n),
        "action_mask": mask(n),
        "path_lengths": box(0.0, LIMIT, n, n),
    })  # fmt: skip


@dataclass(frozen=True, slots=True)
class Observed:
    """An observation, and what it left out."""

    arrays: dict[str, np.ndarray]
    """The observation itself."""
    rows: np.ndarray
    """(k,) row of the exploration map's chains behind each node, k <= max_nodes."""
    cut_nodes: int
    """Nodes that did not fit: the unreachable first, then the farthest by path."""
    cut_lines: int
    """Line segments that did not fit: the farthest from the robot."""


def observe(
    exploration: ExplorationMap,
    lines: LineMap,
    pose: np.ndarray,
    covariance: np.ndarray,
    max_range: float,
    config: ObservationConfig,
    target: int = -1,
) -> Observed:
    """Observe the state of the maps from the estimated `pose` (3,) with `covariance` (3, 3).

    `target` is the id of the jump edge that the robot was driving to.
    """
    n, m = config.max_nodes, config.max_lines
    c = exploration.chains
    rows = np.arange(c.size)
    if c.size > n:
        rows = np.sort(np.lexsort((rows, c.path_length))[:n])
    k = len(rows)
    frame = pose if config.relative else np.zeros(3)
    arrays: dict[str, np.ndarray] = {key: np.zeros(shape, dtype) for key, shape, dtype in _layout(n, m)}
    arrays["pose"][:] = pose
    arrays["pose_covariance"][:] = np.clip(covariance, -_VARIANCE, _VARIANCE)
    arrays["max_range"][:] = max_range
    arrays["node_mask"][:k] = 1
    arrays["node_pursued"][:k] = c.id[rows] == target
    _nodes(
        rows, c.ends, c.node, c.path_length, c.length, c.gain, c.kind, c.visits, frame, arrays["edges"],
        arrays["node_position"], arrays["node_heading"], arrays["node_path_length"], arrays["node_edge_length"],
        arrays["node_gain"], arrays["node_kind"], arrays["node_visits"], arrays["action_mask"],
    )  # fmt: skip
    if config.pairwise and k:
        np.minimum(exploration.path_lengths(rows), LIMIT, out=arrays["path_lengths"][:k, :k], casting="same_kind")
    which = np.flatnonzero(lines.alive)
    cut_lines = max(len(which) - m, 0)
    if cut_lines:
        which = np.sort(np.argsort(_distances(lines.segments, which, pose), kind="stable")[:m])
        which = np.flatnonzero(lines.alive)[which]
    arrays["line_mask"][: len(which)] = 1
    _lines(which, lines.segments, lines.line, lines.alpha, lines.rho, lines.covariance, frame, arrays["lines"])
    return Observed(arrays, rows, c.size - k, cut_lines)


@functools.cache
def _layout(n: int, m: int) -> tuple[tuple[str, tuple[int, ...], type], ...]:
    """Name, shape and type of every array of the space."""
    spaces_of = space(ObservationConfig(max_nodes=n, max_lines=m)).spaces
    return tuple((key, box.shape, box.dtype.type) for key, box in spaces_of.items())  # type: ignore[misc, union-attr]


@njit(cache=True, inline="always")
def _wrapped(angle: float) -> float:
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


@njit(cache=True)
def _nodes(rows, ends, node, path_length, length, gain, kind, visits, frame, edges, position, heading, reach, size,
           angle, label, count, valid):  # fmt: skip
    """Fill in what describes the nodes, as seen from `frame` (3,)."""
    c = math.cos(frame[2])
    s = math.sin(frame[2])
    for i in range(rows.size):
        r = rows[i]
        for e in range(2):
            dx = ends[r, 2 * e] - frame[0]
            dy = ends[r, 2 * e + 1] - frame[1]
            edges[i, 2 * e] = c * dx + s * dy
            edges[i, 2 * e + 1] = c * dy - s * dx
        dx = node[r, 0] - frame[0]
        dy = node[r, 1] - frame[1]
        position[i, 0] = c * dx + s * dy
        position[i, 1] = c * dy - s * dx
        heading[i] = _wrapped(node[r, 2] - frame[2])
        reach[i] = min(path_length[r], LIMIT)
        size[i] = length[r]
        angle[i] = gain[r]
        label[i] = kind[r] - 1.0
        count[i] = visits[r]
        valid[i] = path_length[r] < math.inf


@njit(cache=True)
def _lines(which, segments, line, alpha, rho, covariance, frame, out):
    """Fill in the segments `which`: end points, rho, alpha and their covariance (zero for fragments)."""
    c = math.cos(frame[2])
    s = math.sin(frame[2])
    for i in range(which.size):
        r = which[i]
        for e in range(2):
            dx = segments[r, 2 * e] - frame[0]
            dy = segments[r, 2 * e + 1] - frame[1]
            out[i, 2 * e] = c * dx + s * dy
            out[i, 2 * e + 1] = c * dy - s * dx
        of = line[r]
        if of < 0:
            continue
        # The line about the robot: `fit.to_map` inverted, H = [[1, 0], [-dpsi, 1]].
        ca = math.cos(alpha[of])
        sa = math.sin(alpha[of])
        shift = frame[0] * sa - frame[1] * ca
        about = rho[of] - frame[0] * ca - frame[1] * sa
        paa = covariance[of, 0, 0]
        par = covariance[of, 0, 1] + shift * paa
        prr = covariance[of, 1, 1] + 2.0 * shift * covariance[of, 0, 1] + shift * shift * paa
        normal = alpha[of] - frame[2]
        if about < 0.0:
            about = -about
            par = -par
            normal += math.pi
        out[i, 4] = about
        out[i, 5] = _wrapped(normal)
        out[i, 6] = min(paa, _VARIANCE)
        out[i, 7] = min(max(par, -_VARIANCE), _VARIANCE)
        out[i, 8] = min(prr, _VARIANCE)


@njit(cache=True)
def _distances(segments, which, pose):
    """Distance (k,) of the segments `which` from the position of a pose."""
    out = np.empty(which.size)
    for i in range(which.size):
        r = which[i]
        ax = segments[r, 0] - pose[0]
        ay = segments[r, 1] - pose[1]
        dx = segments[r, 2] - segments[r, 0]
        dy = segments[r, 3] - segments[r, 1]
        along = min(max(-(ax * dx + ay * dy) / max(dx * dx + dy * dy, 1e-12), 0.0), 1.0)
        out[i] = math.hypot(ax + along * dx, ay + along * dy)
    return out
