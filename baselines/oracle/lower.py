"""A lower bound on every route that sees all checkpoints, sensing all round from everywhere along it.

What is bounded. The disc's centre moves on a continuous curve from the start, at least the robot's radius away from
all walls. A checkpoint is seen if from some point of the curve it lies within the sensor's range and no wall stands in
between. Claim: no curve that sees all of a plan's checkpoints is shorter than `LowerBound.length`. Only the checkpoints
are a finite set; the curve, and what it sees, are continuous: no discretisation error is left to subtract.

Proof. 1. Let P be the polygon of `Space.outer`: it holds every place of the centre. Take a checkpoint w whose viewer
region V(w), what w sees within the range, does not hold the start. The region is closed, so a curve that sees w has a
first point in it, on the border of V(w) and in P: that is, on one of the lines of `sight.windows` (drawn around the
region, never inside it), hence on one of w's gates. 2. So a curve that sees the witnesses w1 .. wn touches a gate of
each. Order the witnesses by these first points p1 .. pn. The curve is no shorter than the ways start - p1 - .. - pn,
each a way in P. 3. Such a way is no shorter than the distance of the two gates in `Gates`: the visibility graph finds
a way in P, or something shorter, between two of their samples, and a gate's points lie within half a spacing of its
samples, along the gate, which lies in P: the triangle inequality. 4. So the curve is no shorter than the shortest open
route from the start over one gate of each witness under these distances: that is found exactly (`exact`) for few
witnesses, and bounded from below (`witnesses`) for more. Leaving out witnesses only lowers it, so any set of them
proves a bound, whether their regions are disjoint or not, and the largest one counts.

Rounding: coordinates are exact to 1e-9 m, sums of ways to 1e-10; `_ROUNDING` is subtracted for it.
A robot that is let a little into the walls, as the physics does for a time step (0.1 mm), is covered by P.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from baselines.oracle import exact
from baselines.oracle.gates import Gates
from baselines.oracle.sight import Checkpoints, windows
from baselines.oracle.space import Space
from baselines.oracle.witnesses import Cuts, Tour

_RANGE_TOLERANCE = 1e-9
_ROUNDING = 1e-6
"""m."""
_LOOK = 0.4
"""Spacing of the looks along the ways of a solution, m."""
_TABLE_STEP = 0.01
"""Effort of a step of the exact table, in units of that of the linear program."""
_TABLE = 1e7
"""Largest effort of an exact table; beyond it the linear program bounds the tour."""
_IDLE = 1e-3
"""A witness that adds less than this (m) to an exact tour may make room for another."""
_AFTER = 1e8
"""Most effort of linear programs that follow exact tables."""
_TURN = 1e6
"""Effort of everything else in a turn."""
_ROUNDS = 60
"""Most rounds of cuts in a turn."""
_SLOW = 1.02
"""When finer gates gain less than this factor it is time for more witnesses."""
_STALE = 1.0003
"""When there are none, and three turns in a row gain less than this factor, it is enough."""


@dataclass(frozen=True)
class LowerBound:
    """A proven bound and what proves it."""

    length: float
    """No route that sees all checkpoints is shorter, m."""
    witnesses: np.ndarray
    """(n, 2) checkpoints whose viewer regions the bound's route touches."""


def lower_bound(
    space: Space, sight: Checkpoints, start: np.ndarray, effort: float, log: Callable[[str], None] | None = None
) -> LowerBound:
    """A bound on every route of the disc from start (2,) that sees all checkpoints from anywhere along it.

    space: `Space.outer`. effort: about 1e7 a second. log: told of the progress.
    """
    return _Search(space, sight, start).run(effort, log)


class _Search:
    def __init__(self, space: Space, sight: Checkpoints, start: np.ndarray) -> None:
        self.space, self.sight, self.start = space, sight, start
        self.gates = Gates(space, start)
        self.witnesses: list[int] = []
        self.views: dict[tuple[bytes, bytes], np.ndarray] = {}
        self.tree = cKDTree(sight.places)
        pairs = self.tree.query_pairs(1.5 * _spacing(sight.places, self.tree), output_type="ndarray")
        lengths = np.hypot(*(sight.places[pairs[:, 0]] - sight.places[pairs[:, 1]]).T)
        self.grid = csr_array((lengths, (pairs[:, 0], pairs[:, 1])), shape=(len(sight.places),) * 2)
        self.home = np.zeros(len(sight.points), bool)
        self.home[sight.seen_from(start[None])] = True

    def depth(self, route: np.ndarray) -> np.ndarray:
        """(C,) about how far a route's points (k, 2) stay from the viewers of each checkpoint, m."""
        near = np.unique(self.tree.query(route)[1])
        far = dijkstra(self.grid, directed=False, indices=near, min_only=True)
        return np.nan_to_num(np.minimum.reduceat(far[self.sight.viewers], self.sight.viewer_starts[:-1]), posinf=0.0)

    def independent(self, score: np.ndarray, count: int) -> list[int]:
        """Checkpoints of the highest positive score, none seen from a place that sees another of them."""
        used = np.zeros(len(self.sight.places), bool)
        chosen: list[int] = []
        for c in np.argsort(-score, kind="stable"):
            if score[c] <= 0.0 or len(chosen) == count:
                break
            viewers = self.sight.viewers_of(c)
            if not used[viewers].any():
                used[viewers] = True
                chosen.append(int(c))
        return chosen

    def add(self, checkpoints: list[int]) -> np.ndarray:
        """Take checkpoints as witnesses; parent gates of the new set of gates."""
        old = len(self.gates.owner)
        reach = self.sight.max_range + _RANGE_TOLERANCE
        sight, area = self.sight, self.space.area
        borders = [windows(sight.walls, sight.points[c], reach, area, self.start) for c in checkpoints]
        taken = self.gates.add(borders)
        self.witnesses += [c for c, ok in zip(checkpoints, taken, strict=True) if ok]
        return np.concatenate([np.arange(old), np.full(len(self.gates.owner) - old, -1)])

    def drop(self, witnesses: list[int]) -> np.ndarray:
        """Leave witnesses (rows) out; parent gates of the new set of gates."""
        kept = np.setdiff1d(np.arange(len(self.witnesses)), witnesses)
        self.witnesses = [self.witnesses[w] for w in kept]
        return self.gates.keep(kept)

    def idle(self, order: list[int]) -> list[int]:
        """Witnesses whose gates an exact tour (gates in order) passes at no cost, never two in a row."""
        gates, out, last = self.gates, [], -2
        for k, g in enumerate(order):
            before = gates.first if k == 0 else gates.between[order[k - 1]]
            if k + 1 == len(order):
                detour = before[g]
            else:
                detour = before[g] + gates.between[g, order[k + 1]] - before[order[k + 1]]
            if detour < _IDLE and last != k - 1:
                out.append(int(gates.owner[g]))
                last = k
        return out

    def seen(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Checkpoints seen on a shortest way from a to b."""
        way = np.vstack([a, self.space.nodes[self.space.path(a, b)], b])
        parts = []
        for p, q in itertools.pairwise(way):
            key = (p.tobytes(), q.tobytes())
            if key not in self.views:
                self.views[key] = self.sight.seen_along(p, q, _LOOK)
            parts.append(self.views[key])
        return np.unique(np.concatenate(parts))

    def missed(self, pairs: np.ndarray, shares: np.ndarray) -> np.ndarray:
        """(C,) share to which a fractional route fails to see each checkpoint."""
        seen = self.home.astype(np.float64)
        for (p, q), share in zip(pairs, shares, strict=True):
            a = self.start if p < 0 else self.gates.place(p)
            seen[self.seen(a, self.gates.place(q))] += share
        seen[self.witnesses] = 1.0
        return np.maximum(0.0, 1.0 - seen)

    def run(self, effort: float, log: Callable[[str], None] | None) -> LowerBound:
        """Tour the witnesses, refine their gates, take in checkpoints that the tour misses, until `effort` is spent."""
        sight, gates = self.sight, self.gates
        deep = self.depth(self.start[None])
        few = np.diff(sight.viewer_starts)
        self.add(self.independent(np.where((deep > 0.0) & ~self.home, 1.0 / few, 0.0), len(sight.points)))
        if not self.witnesses:
            return LowerBound(0.0, np.zeros((0, 2)))
        cuts, columns = Cuts.none(len(gates.owner)), np.zeros((0, 2), np.int64)
        best, before, spent, stale = 0.0, 0.0, 0.0, 0
        witnesses = list(self.witnesses)
        while True:
            steps = _TABLE_STEP * exact.work(len(gates.owner), len(self.witnesses))
            if steps < _TABLE:
                length, order = exact.shortest_tour(gates.first, gates.between, gates.owner)
                idle = self.idle(order)
                taken = np.bincount(order, minlength=len(gates.owner)).astype(np.float64)
                pairs, shares = np.stack([[-1, *order[:-1]], order], axis=1), np.ones(len(order))
                spent += steps
            else:
                if len(cuts.idle) == 0 and spent > 0.0:  # after exact tables there is little left to gain
                    effort = min(effort, spent + _AFTER)
                solution = Tour(gates.owner, gates.first, gates.between, cuts, columns).solve(_ROUNDS, effort - spent)
                length, taken, pairs, shares = solution.bound, solution.taken, solution.pairs, solution.shares
                cuts, columns = solution.cuts, solution.columns
                spent += solution.work
            if length > best:
                best, witnesses = length, list(self.witnesses)
            if log is not None:
                size = f"{len(self.witnesses)} witnesses, {len(gates.owner)} gates, {len(cuts.idle)} cuts"
                log(f"{length:8.2f} m, {size}, effort {spent:.2g}")
            coarse = np.flatnonzero((taken > 0.2) & (gates.high - gates.low > 1))
            chosen: list[int] = []
            if length < _SLOW * before or not len(coarse):
                missed = self.missed(pairs, shares)
                route = np.vstack([self.start, *(gates.place(int(g)) for g in np.flatnonzero(taken > 0.3))])
                score = np.where(missed > 0.05, missed * (0.1 + self.depth(route)), 0.0)
                chosen = self.independent(score, max(3, len(self.witnesses) // 4))
                fits = _fitting(len(gates.owner), len(self.witnesses))
                if steps < _TABLE and len(chosen) > fits and idle:
                    self.drop(idle)  # room for others; the exact table needs no cuts
                    cuts, columns = Cuts.none(len(gates.owner)), columns[:0]
                    coarse = coarse[:0]
                    fits = _fitting(len(gates.owner), len(self.witnesses))
                if steps < _TABLE and fits > 0:
                    chosen = chosen[:fits]
            stale = 0 if chosen or length > _STALE * before else stale + 1
            before = length
            spent += _TURN
            if spent >= effort or stale == 3 or not (len(coarse) or chosen):
                return LowerBound(max(0.0, best - _ROUNDING), sight.points[witnesses])
            if len(coarse):
                parent = gates.split(coarse)
                cuts, columns = cuts.regrouped(parent, gates.between), _children(columns, parent)
            if chosen:
                parent = self.add(chosen)
                cuts = cuts.regrouped(parent, gates.between)


def _fitting(gates: int, witnesses: int) -> int:
    """How many more witnesses, of ten gates each, an exact table has room for."""
    more = 0
    while _TABLE_STEP * exact.work(gates + 10 * (more + 1), witnesses + more + 1) < _TABLE:
        more += 1
    return more


def _children(columns: np.ndarray, parent: np.ndarray) -> np.ndarray:
    """Pairs of new gates whose parents were a pair."""
    size = int(parent.max()) + 1
    where = [np.flatnonzero(parent == g) for g in range(size)]
    out = [(a, b) for p, q in columns for a in where[p] for b in where[q]]
    return np.array(out, np.int64).reshape(-1, 2)


def _spacing(places: np.ndarray, tree: cKDTree) -> float:
    if len(places) < 3:
        return 1.0
    return float(np.median(tree.query(places[1:], k=2)[0][:, 1]))
