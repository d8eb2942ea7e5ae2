"""The observation: `space()` and `observe()` side by side, so that they cannot drift apart.

A dictionary of padded, bounded float32 arrays and int8 masks. Row i of everything called `node_...`,
of `edges` and of `path_lengths` is action i. Padding is 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from gymnasium import spaces

from polyexplore_gym.config import ObservationConfig
from polyexplore_gym.exploration import ExplorationMap
from polyexplore_gym.mapping import LineMap

LIMIT = 1e5
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
) -> Observed:
    """Observe the state of the maps from the estimated `pose` (3,) with `covariance` (3, 3)."""
    n, m = config.max_nodes, config.max_lines
    c = exploration.chains
    rows = np.arange(len(c))
    if len(c) > n:
        rows = np.sort(np.lexsort((rows, c.path_length))[:n])
    k = len(rows)
    frame = pose if config.relative else np.zeros(3)
    arrays = {
        "pose": pose.astype(np.float32),
        "pose_covariance": np.clip(covariance, -_VARIANCE, _VARIANCE).astype(np.float32),
        "max_range": np.array([min(max_range, LIMIT)], np.float32),
        "edges": _padded(_seen_from(c.ends[rows].reshape(-1, 2), frame).reshape(-1, 4), n, 4),
        "node_position": _padded(_seen_from(c.node[rows, :2], frame), n, 2),
        "node_heading": _padded(_wrapped(c.node[rows, 2] - frame[2]), n),
        "node_path_length": _padded(np.minimum(c.path_length[rows], LIMIT), n),
        "node_edge_length": _padded(c.length[rows], n),
        "node_gain": _padded(c.gain[rows], n),
        "node_kind": _padded(c.kind[rows] - 1.0, n),
        "node_visits": _padded(c.visits[rows], n),
        "node_mask": np.zeros(n, np.int8),
        "action_mask": np.zeros(n, np.int8),
        "path_lengths": np.zeros((n, n), np.float32),
    }
    arrays["node_mask"][:k] = 1
    arrays["action_mask"][:k] = np.isfinite(c.path_length[rows])
    if config.pairwise and k:
        arrays["path_lengths"][:k, :k] = np.minimum(exploration.path_lengths(rows), LIMIT)
    arrays["lines"], arrays["line_mask"], cut_lines = _lines(lines, pose, frame, m)
    return Observed(arrays, rows, len(c) - k, cut_lines)


def _lines(lines: LineMap, pose: np.ndarray, frame: np.ndarray, m: int) -> tuple[np.ndarray, np.ndarray, int]:
    """The segments nearest to the robot: end points, rho, alpha and their covariance (zero for fragments).

    Which of them, and how many were cut.
    """
    rows = np.flatnonzero(lines.alive)
    cut = max(len(rows) - m, 0)
    segments = lines.segments[rows]
    if cut:
        keep = np.sort(np.argsort(_distance(segments, pose), kind="stable")[:m])
        rows, segments = rows[keep], segments[keep]
    k = len(rows)
    out = np.zeros((m, 9), np.float32)
    mask = np.zeros(m, np.int8)
    mask[:k] = 1
    out[:k, :4] = _seen_from(segments.reshape(-1, 2), frame).reshape(-1, 4)
    fitted = np.flatnonzero(lines.line[rows] >= 0)
    of = lines.line[rows[fitted]]
    alpha, rho, p = lines.alpha[of], lines.rho[of], lines.covariance[of]
    paa, par, prr = p[:, 0, 0], p[:, 0, 1], p[:, 1, 1]
    if frame.any():
        # The line about the robot: DESIGN section 5 inverted, H = [[1, 0], [-dpsi, 1]].
        ca, sa = np.cos(alpha), np.sin(alpha)
        shift = -(frame[1] * ca - frame[0] * sa)
        rho = rho - frame[0] * ca - frame[1] * sa
        prr = prr + 2.0 * shift * par + shift * shift * paa
        par = par + shift * paa
        flip = rho < 0
        alpha = _wrapped(alpha - frame[2] + np.where(flip, math.pi, 0.0))
        rho = np.abs(rho)
        par = np.where(flip, -par, par)
    out[fitted, 4] = rho
    out[fitted, 5] = alpha
    out[fitted, 6:] = np.clip(np.stack((paa, par, prr), axis=1), -_VARIANCE, _VARIANCE)
    return out, mask, cut


def _padded(values: np.ndarray, *shape: int) -> np.ndarray:
    out = np.zeros(shape, np.float32)
    out[: len(values)] = values
    return out


def _seen_from(points: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Points (k, 2) of the map frame in the frame of a pose."""
    if not frame.any():
        return points
    c, s = math.cos(frame[2]), math.sin(frame[2])
    x, y = points[:, 0] - frame[0], points[:, 1] - frame[1]
    return np.stack((c * x + s * y, c * y - s * x), axis=1)


def _distance(segments: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Distance (k,) of segments (k, 4) from the position of a pose."""
    a, d = segments[:, :2] - pose[:2], segments[:, 2:] - segments[:, :2]
    along = np.clip(-(a * d).sum(axis=1) / np.maximum((d * d).sum(axis=1), 1e-12), 0.0, 1.0)
    return np.hypot(*(a + along[:, None] * d).T)


def _wrapped(angles: np.ndarray) -> np.ndarray:
    return math.pi - (math.pi - angles) % (2.0 * math.pi)
