"""The borders of viewer regions in pieces, and smallest distances between them.

A witness's viewer region is entered through its border (`sight.windows`). The border is sampled every few centimetres
and cut into gates, runs of neighbouring samples. The distance between two gates is the smallest one between their
samples, less the half spacing at either end: every point of a gate lies that near to one of its samples, within the
free space. So it is below every way from any point of the one to any point of the other.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from numba import njit

from baselines.oracle.space import Space, sights

SPACING = 0.05
"""Samples of a border are at most so far apart, m."""
LENGTH = 0.8
"""Gates are at most so long at first, m."""


@njit(cache=True)
def _fields(between, points, low, high, indptr, indices, nodes):  # type: ignore[no-untyped-def]
    """Smallest ways from the samples low[g] .. high[g] of each gate to the corners: (G, V)."""
    out = np.full((low.size, nodes.shape[0]), np.inf)
    steps = np.empty(nodes.shape[0])
    for g in range(low.size):
        steps[:] = np.inf
        for i in range(low[g], high[g]):
            for e in range(indptr[i], indptr[i + 1]):
                j = indices[e]
                step = math.hypot(nodes[j, 0] - points[i, 0], nodes[j, 1] - points[i, 1])
                steps[j] = min(steps[j], step)
        for j in range(nodes.shape[0]):
            if steps[j] < np.inf:
                for v in range(nodes.shape[0]):
                    out[g, v] = min(out[g, v], steps[j] + between[j, v])
    return out


@njit(cache=True)
def _gate_distances(fields, points, gate, indptr, indices, nodes, sight_ptr, sight_to):  # type: ignore[no-untyped-def]
    """Smallest distances between gates (G, G) by corners and by sight; gate (Q,) of each sample."""
    count = fields.shape[0]
    out = np.full((count, count), np.inf)
    steps = np.empty(nodes.shape[0])
    low = 0
    while low < gate.size:
        g, high = gate[low], low
        steps[:] = np.inf
        while high < gate.size and gate[high] == g:
            for e in range(indptr[high], indptr[high + 1]):
                j = indices[e]
                step = math.hypot(nodes[j, 0] - points[high, 0], nodes[j, 1] - points[high, 1])
                steps[j] = min(steps[j], step)
            for e in range(sight_ptr[high], sight_ptr[high + 1]):
                o = sight_to[e]
                step = math.hypot(points[o, 0] - points[high, 0], points[o, 1] - points[high, 1])
                out[g, gate[o]] = min(out[g, gate[o]], step)
            high += 1
        for j in range(nodes.shape[0]):
            if steps[j] < np.inf:
                for f in range(count):
                    out[g, f] = min(out[g, f], fields[f, j] + steps[j])
        low = high
    for g in range(count):
        for f in range(g):
            out[g, f] = out[f, g] = min(out[g, f], out[f, g])
    return out


class Gates:
    """All gates so far. Gate g: samples `low[g]` up to `high[g]`, of the border of witness `owner[g]`."""

    def __init__(self, space: Space, start: np.ndarray) -> None:
        self.space, self.start = space, start
        self.samples = np.zeros((0, 2))
        """(Q, 2) m: samples of the borders."""
        self.reach = np.zeros(0)
        """(Q,) m: half the spacing of the samples there."""
        self.first_of = np.zeros(0)
        """(Q,) m: ways from the start."""
        self.owner = np.zeros(0, np.int64)
        self.low = np.zeros(0, np.int64)
        self.high = np.zeros(0, np.int64)
        self.first = np.zeros(0)
        """(G,) m: no way from the start to the gate is shorter."""
        self.between = np.zeros((0, 0))
        """(G, G) m: no way between two gates is shorter."""
        self._field = space.field(start)
        self._rows = (np.zeros(1, np.int64), np.zeros(0, np.int32))
        self._sights: list[np.ndarray] = []
        self._known: dict[tuple[int, int], np.ndarray] = {}

    def add(self, borders: list[list[np.ndarray]]) -> list[bool]:
        """Take in the borders of new witnesses: polylines (k, 2) each. Whether each has a gate that can be reached."""
        space, old = self.space, len(self.samples)
        first_owner = int(self.owner.max()) + 1 if len(self.owner) else 0
        parts, reach, ends, owner = [], [], [], []
        taken: list[bool] = []
        size = old
        for lines in borders:
            found = False
            for line in lines:
                points, half = _sampled(line)
                if not math.isfinite(self._from_start(points[:1])[0]):
                    continue  # a place that the start is cut off from
                found = True
                parts.append(points)
                reach.append(np.full(len(points), half))
                count = max(1, math.ceil(2.0 * half * len(points) / LENGTH))
                cuts = size + np.linspace(0, len(points), count + 1).astype(int)
                ends += list(itertools.pairwise(cuts))
                owner += [first_owner + sum(taken)] * count
                size += len(points)
            taken.append(found)
        if not parts:
            return taken
        new = np.vstack(parts)
        rows = space.sees(new)
        self._rows = _stacked(self._rows, rows)
        self.samples = np.vstack([self.samples, new])
        self.reach = np.concatenate([self.reach, *reach])
        self.first_of = np.concatenate([self.first_of, space.distances(self.start, new, rows, self._field)])
        indptr, indices = sights(space.walls, new, self.samples, 1e6)
        self._sights += [indices[a:b] for a, b in itertools.pairwise(indptr)]
        self.owner = np.concatenate([self.owner, owner])
        self.low = np.concatenate([self.low, [e[0] for e in ends]])
        self.high = np.concatenate([self.high, [e[1] for e in ends]])
        self._measure()
        return taken

    def split(self, chosen: np.ndarray) -> np.ndarray:
        """Halve gates of more than one sample; the old gate of each new one."""
        parent = np.sort(np.concatenate([np.arange(len(self.owner)), chosen]))
        second = np.concatenate([[False], parent[1:] == parent[:-1]])
        first = np.concatenate([second[1:], [False]])
        middle = (self.low + self.high) // 2
        low = np.where(second, middle[parent], self.low[parent])
        high = np.where(first, middle[parent], self.high[parent])
        self.owner, self.low, self.high = self.owner[parent], low, high
        self._measure()
        return parent

    def keep(self, witnesses: np.ndarray) -> np.ndarray:
        """Keep the gates of these witnesses (sorted), which are renumbered; the old gate of each new one."""
        parent = np.flatnonzero(np.isin(self.owner, witnesses))
        self.owner = np.searchsorted(witnesses, self.owner[parent])
        self.low, self.high = self.low[parent], self.high[parent]
        self._measure()
        return parent

    def place(self, gate: int) -> np.ndarray:
        """A point (2,) of a gate: its middle sample."""
        return np.asarray(self.samples[(self.low[gate] + self.high[gate]) // 2])

    def _from_start(self, points: np.ndarray) -> np.ndarray:
        return self.space.distances(self.start, points, self.space.sees(points), self._field)

    def _measure(self) -> None:
        space = self.space
        order = np.concatenate([np.arange(a, b) for a, b in zip(self.low, self.high, strict=True)])
        gate = np.repeat(np.arange(len(self.owner)), self.high - self.low)
        keys = list(zip(self.low.tolist(), self.high.tolist(), strict=True))
        fresh = [k for k in keys if k not in self._known]
        if fresh:
            ends = np.array(fresh)
            fields = _fields(space.between, self.samples, ends[:, 0], ends[:, 1], *self._rows, space.nodes)
            self._known = {k: v for k, v in self._known.items() if k in set(keys)}
            self._known.update(zip(fresh, fields, strict=True))
        # Samples that no gate holds any more drop out.
        place = np.full(len(self.samples), -1)
        place[order] = np.arange(len(order))
        indptr, indices = _chosen(self._rows, order)
        looks = [place[self._sights[i]] for i in order]
        looks = [v[v >= 0] for v in looks]
        sight_ptr = np.concatenate([[0], np.cumsum([len(v) for v in looks])])
        fields = np.stack([self._known[k] for k in keys])
        points = np.ascontiguousarray(self.samples[order])
        between = _gate_distances(fields, points, gate, indptr, indices, space.nodes, sight_ptr, np.concatenate(looks))
        edge = self.reach[self.low]
        starts = np.searchsorted(gate, np.arange(len(self.owner)))
        self.first = np.maximum(0.0, np.minimum.reduceat(self.first_of[order], starts) - edge)
        self.between = np.maximum(0.0, between - (edge[:, None] + edge))


def _sampled(line: np.ndarray) -> tuple[np.ndarray, float]:
    """Samples (n, 2) of a polyline (k, 2) such that every point of it is at most the second result (m) from one."""
    ends = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    count = max(1, math.ceil(ends[-1] / SPACING))
    at = (np.arange(count) + 0.5) * (ends[-1] / count)
    points = np.stack([np.interp(at, ends, line[:, 0]), np.interp(at, ends, line[:, 1])], axis=1)
    return points, float(ends[-1] / count / 2.0)


def _stacked(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    return np.concatenate([a[0], b[0][1:] + a[0][-1]]), np.concatenate([a[1], b[1]])


def _chosen(rows: tuple[np.ndarray, np.ndarray], order: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Some rows of a CSR structure."""
    indptr, indices = rows
    counts = np.diff(indptr)[order]
    starts = np.concatenate([[0], np.cumsum(counts)])
    which = np.repeat(indptr[order] - starts[:-1], counts) + np.arange(starts[-1])
    return starts, indices[which]
