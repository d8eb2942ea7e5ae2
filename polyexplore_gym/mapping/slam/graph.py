"""The pose graph: poses of scans, and measurements of one seen from another. Sparse least squares with a robust kernel.

Steps are taken in the frame of each pose, by Levenberg and Marquardt's rule; the first pose is the frame and stays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numba import njit
from scipy.sparse.linalg import SuperLU, splu

from polyexplore_gym.mapping.logs.poses import between, compose

KERNEL = 2.0
"""Scale of the robust kernel (Cauchy), standard deviations: a wrong loop loses its weight beyond."""
ROUNDS = 100
"""Most iterations."""
SETTLED = 1e-6
"""Relative decrease of the cost at which to stop."""
DAMPING = 1e-8, 1e8
"""Damping to begin with, and with which to give up."""


class Edges(NamedTuple):
    """Measurements between scans, e of them."""

    ends: np.ndarray
    """(e, 2) indices i, j of the scans."""
    measured: np.ndarray
    """(e, 3) the pose of j seen from i: x, y (m), heading (rad)."""
    information: np.ndarray
    """(e, 3, 3) inverse of its covariance, in the frame of j."""
    robust: np.ndarray
    """(e,) whether it may be wrong altogether."""

    @classmethod
    def of(cls, rows: list[tuple[int, int, np.ndarray, np.ndarray, bool]]) -> Edges:
        """Edges from rows (i, j, measured, information, robust)."""
        if not rows:
            return cls(np.zeros((0, 2), np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, bool))
        i, j, measured, information, robust = zip(*rows, strict=True)
        return cls(np.stack([i, j], axis=1), np.array(measured), np.array(information), np.array(robust))


def solve(poses: np.ndarray, edges: Edges) -> np.ndarray:
    """(n, 3) the most likely poses; the first stays where it is.

    Args:
        poses: (n, 3) first guess: x, y (m), heading (rad).
        edges: between them. All poses must hang together.
    """
    damping = DAMPING[0]
    cost = _cost(poses, edges)
    for _ in range(ROUNDS):
        h, g = _normal(poses, edges)
        while damping < DAMPING[1]:
            step = np.zeros_like(poses)
            step[1:] = _factor(h + sp.diags_array(damping * h.diagonal())).solve(-g).reshape(-1, 3)
            moved = compose(poses, step)
            now = _cost(moved, edges)
            if now <= cost:
                break
            damping *= 10.0
        else:
            return poses
        damping = max(0.1 * damping, DAMPING[0])
        poses, settled, cost = moved, cost - now <= SETTLED * cost, now
        if settled:
            break
    return poses


def covariances(poses: np.ndarray, edges: Edges) -> np.ndarray:
    """(n, 3, 3) covariance of each pose in the frame of the map, given the first: m2, m rad, rad2.

    Args:
        poses: (n, 3) of `solve`.
        edges: that they were solved with.

    Of the inverse of the normal matrix only what the factor has entries for is worked out (Takahashi, Fagan and Chen,
    "Formation of a sparse bus impedance matrix and its application to short circuit study", 1973).
    """
    out = np.zeros((len(poses), 3, 3))
    if len(poses) > 1:
        factor = _factor(_normal(poses, edges)[0])
        lower = factor.L.tocsc()
        lower.sort_indices()
        inverse = _sparse_inverse(lower.indptr, lower.indices, lower.data, factor.U.diagonal())
        out[1:] = _blocks(lower.indptr, lower.indices, inverse, factor.perm_c.reshape(-1, 3))
    return turned(out, poses[:, 2])


def local_covariances(poses: np.ndarray, edges: Edges) -> np.ndarray:
    """(n, 3, 3) covariance of each pose in the frame of the map, given all others: m2, m rad, rad2.

    It tells how well a scan fits the walls around it, and leaves out what it shares with its neighbours.

    Args:
        poses: (n, 3) of `solve`.
        edges: that they were solved with.
    """
    i, j = edges.ends.T
    _, first, second, weighted = _linear(poses, edges)
    own = np.zeros((len(poses), 3, 3))
    np.add.at(own, i, first.transpose(0, 2, 1) @ weighted @ first)
    np.add.at(own, j, second.transpose(0, 2, 1) @ weighted @ second)
    return turned(np.linalg.inv(own), poses[:, 2]) if len(edges.ends) else own


def turned(covariance: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """(n, 3, 3) covariances of poses, from their own frames to the one in which they have these headings (n,)."""
    c, s = np.cos(heading), np.sin(heading)
    turn = np.zeros((len(heading), 3, 3))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = c, -s, s, c, 1.0
    return turn @ covariance @ turn.transpose(0, 2, 1)


def errors(poses: np.ndarray, edges: Edges) -> np.ndarray:
    """(e,) squared error of each edge at these poses, in its standard deviations (Mahalanobis)."""
    i, j = edges.ends.T
    off = between(edges.measured, between(poses[i], poses[j]))
    return np.einsum("ka,kab,kb->k", off, edges.information, off)


def _cost(poses: np.ndarray, edges: Edges) -> float:
    d2 = errors(poses, edges)
    k2 = KERNEL * KERNEL
    return float(np.where(edges.robust, k2 * np.log1p(d2 / k2), d2).sum())


def _linear(poses: np.ndarray, edges: Edges) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Error (e, 3) of each edge, its derivatives (e, 3, 3) by steps of i and of j, its information, weighted."""
    i, j = edges.ends.T
    seen = between(poses[i], poses[j])
    off = between(edges.measured, seen)
    weight = 1.0 / (1.0 + np.where(edges.robust, errors(poses, edges) / KERNEL**2, 0.0))
    c, s = np.cos(off[:, 2]), np.sin(off[:, 2])
    second = np.zeros((len(off), 3, 3))
    second[:, 0, 0], second[:, 0, 1], second[:, 1, 0], second[:, 1, 1], second[:, 2, 2] = c, -s, s, c, 1.0
    # a step of i moves j, as seen from j, by the adjoint of the inverse of `seen`
    c, s = np.cos(seen[:, 2]), np.sin(seen[:, 2])
    x, y = -c * seen[:, 0] - s * seen[:, 1], s * seen[:, 0] - c * seen[:, 1]
    back = np.zeros((len(off), 3, 3))
    back[:, 0, 0], back[:, 0, 1], back[:, 0, 2] = c, s, y
    back[:, 1, 0], back[:, 1, 1], back[:, 1, 2] = -s, c, -x
    back[:, 2, 2] = 1.0
    return off, -second @ back, second, weight[:, None, None] * edges.information


def _normal(poses: np.ndarray, edges: Edges) -> tuple[sp.csc_array, np.ndarray]:
    """Half the Hessian and the gradient of the cost by the steps of all poses but the first."""
    i, j = edges.ends.T
    off, first, second, weighted = _linear(poses, edges)
    blocks, rows, columns = [], [], []
    gradient = np.zeros_like(poses)
    for a, by_a in ((i, first), (j, second)):
        half = by_a.transpose(0, 2, 1) @ weighted
        np.add.at(gradient, a, np.einsum("kab,kb->ka", half, off))
        for b, by_b in ((i, first), (j, second)):
            blocks.append(half @ by_b)
            rows.append(3 * a[:, None, None] + np.arange(3)[None, :, None] + np.zeros((1, 1, 3), np.int64))
            columns.append(3 * b[:, None, None] + np.arange(3)[None, None, :] + np.zeros((1, 3, 1), np.int64))
    at = np.concatenate(rows).ravel(), np.concatenate(columns).ravel()
    n = 3 * len(poses)
    h = sp.coo_array((np.concatenate(blocks).ravel(), at), shape=(n, n)).tocsc()
    return h[3:, 3:], gradient.ravel()[3:]


def _factor(h: sp.csc_array) -> SuperLU:
    return splu(h.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


@njit(cache=True)
def _sparse_inverse(begin: np.ndarray, rows: np.ndarray, lower: np.ndarray, diagonal: np.ndarray) -> np.ndarray:
    """Entries of the inverse of L D L' where L, of unit diagonal and in columns of increasing rows, has some."""
    n = len(begin) - 1
    out, place = np.zeros(len(lower)), np.full(n, -1, np.int64)
    for j in range(n - 1, -1, -1):
        for a in range(begin[j] + 1, begin[j + 1]):
            place[rows[a]] = a
        for a in range(begin[j] + 1, begin[j + 1]):
            k = rows[a]
            out[a] -= lower[a] * out[begin[k]]
            for b in range(begin[k] + 1, begin[k + 1]):
                at = place[rows[b]]
                if at >= 0:
                    out[at] -= lower[a] * out[b]
                    out[a] -= lower[at] * out[b]
        out[begin[j]] = 1.0 / diagonal[j]
        for a in range(begin[j] + 1, begin[j + 1]):
            out[begin[j]] -= lower[a] * out[a]
            place[rows[a]] = -1
    return out


@njit(cache=True)
def _blocks(begin: np.ndarray, rows: np.ndarray, values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """(n, 3, 3) of a symmetric matrix, given by columns from the diagonal down, the rows and columns chosen (n, 3)."""
    out = np.zeros((len(chosen), 3, 3))
    for k in range(len(chosen)):
        for a in range(3):
            for b in range(3):
                i, j = max(chosen[k, a], chosen[k, b]), min(chosen[k, a], chosen[k, b])
                out[k, a, b] = values[begin[j] + np.searchsorted(rows[begin[j] : begin[j + 1]], i)]
    return out
