"""Upper bounds: the best offline tours known, for sensing all along the way and for scans at stops only.

View planning: a greedy set cover of the checkpoints by places, an open tour through them by PyVRP, then prune,
shift, and destroy-and-repair on exact ways. Nothing here is optimal; every tour is complete and can be driven.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from baselines.oracle.sight import Checkpoints
from baselines.oracle.space import Space

LOOK = 0.25
"""On the way the sensor looks at most every so many metres: fewer looks than it takes, so the tour is complete."""
_UNIT = 1e-3
"""Unit of the tour solver's integer lengths, m."""
_TOUR_ITERATIONS = 200
_FIELDS = 2000
"""Fields of distances kept."""
_CANDIDATES = 400
_HEAT = 0.02
"""Share of its length by which a tour may at first be longer than the one it replaces."""
_AIM = math.radians(1.0)
"""Nothing that counts lies nearer than this to the sides of a scan, rad: drives do not end in exactly their heading."""
_NUDGES = (0.2, 0.1, 0.05, 0.02)
"""Steps by which the stops are moved in the end, m."""


@njit(cache=True)
def _lower_gain(gain, checkpoints, viewers, starts):  # type: ignore[no-untyped-def]
    """Take checkpoints that are no longer sought off the gain (N,) of the places that see them."""
    for c in checkpoints:
        for k in range(starts[c], starts[c + 1]):
            gain[viewers[k]] -= 1


@dataclass(frozen=True)
class Found:
    """A complete tour."""

    length: float
    """Way, m."""
    stops: np.ndarray
    """(k, 2) m, the first the start."""
    legs: tuple[np.ndarray, ...]
    """Polylines (m, 2), m: the ways from stop to stop; one point if there is only the start."""


class Planner:
    """Searches tours through places that together see all checkpoints.

    A tour is a list of stops, the first the start. Stops are numbers of places of the grid, or, beyond them, of
    points added later. With `along` what is seen on the way counts too.
    """

    def __init__(self, space: Space, sight: Checkpoints, along: bool) -> None:
        self.space, self.sight, self.along = space, sight, along
        self.points = list(sight.places)
        self._fields: dict[int, np.ndarray] = {}
        self._ways: dict[tuple[int, int], list[int]] = {}
        self._views: dict[tuple[int, int], np.ndarray] = {}
        self._edges: dict[tuple[bytes, bytes], np.ndarray] = {}

    # Distances and views ----------------------------------------------------------------------

    def field(self, stop: int) -> np.ndarray:
        """(N,) m: shortest ways from a stop to all places of the grid."""
        if stop not in self._fields:
            if len(self._fields) >= _FIELDS:
                del self._fields[next(iter(self._fields))]
            point = self.points[stop]
            self._fields[stop] = self.space.distances(point, self.sight.places, self.sight.rows)
        return self._fields[stop]

    def way(self, a: int, b: int) -> np.ndarray:
        """(k, 2) m: the polyline from a to b."""
        if (a, b) not in self._ways:
            if (b, a) in self._ways:
                self._ways[a, b] = self._ways[b, a][::-1]
            else:
                self._ways[a, b] = self.space.path(self.points[a], self.points[b])
        return np.vstack([self.points[a], self.space.nodes[self._ways[a, b]], self.points[b]])

    def distance(self, a: int, b: int) -> float:
        if b < len(self.sight.places) and a in self._fields:
            return float(self._fields[a][b])
        if a < len(self.sight.places) and b in self._fields:
            return float(self._fields[b][a])
        return float(np.hypot(*np.diff(self.way(a, b), axis=0).T).sum())

    def view(self, a: int, b: int) -> np.ndarray:
        """Checkpoints that going from a to b adds: those seen at b, and with `along` those seen on the way."""
        key = (min(a, b), max(a, b)) if self.along else (b, b)
        if key not in self._views:
            if not self.along:
                point = self.points[b]
                self._views[key] = self.sight.view(b) if b < len(self.sight.places) else self._edge(point, point)
            else:
                way = self.way(*key)
                parts = [self._edge(p, q) for p, q in itertools.pairwise(way)]
                self._views[key] = parts[0] if len(parts) == 1 else np.unique(np.concatenate(parts))
        return self._views[key]

    def _edge(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        key = (p.tobytes(), q.tobytes())
        if key not in self._edges:
            turned = (key[1], key[0])
            self._edges[key] = self._edges[turned] if turned in self._edges else self.sight.seen_along(p, q, LOOK)
        return self._edges[key]

    def length(self, stops: list[int]) -> float:
        return sum(self.distance(a, b) for a, b in itertools.pairwise(stops))

    def seen(self, stops: list[int]) -> np.ndarray:
        """(C,) how often each checkpoint is seen: once for the start, once for each leg."""
        count = np.zeros(len(self.sight.points), np.int32)
        count[self.sight.view(0)] += 1
        for a, b in itertools.pairwise(stops):
            count[self.view(a, b)] += 1
        return count

    # Moves --------------------------------------------------------------------------------------

    def remove(self, stops: list[int], count: np.ndarray, k: int, *, forced: bool = False) -> bool:
        """Take stop k out, if all is still seen without it (or `forced`); tells whether it did."""
        a, s = stops[k - 1], stops[k]
        b = stops[k + 1] if k + 1 < len(stops) else None
        old = [self.view(a, s)] if b is None else [self.view(a, s), self.view(s, b)]
        new = None if b is None else self.view(a, b)
        for v in old:
            count[v] -= 1
        if new is not None:
            count[new] += 1
        if forced or all((count[v] > 0).all() for v in old):
            del stops[k]
            return True
        if new is not None:
            count[new] -= 1
        for v in old:
            count[v] += 1
        return False

    def insert(self, stops: list[int], count: np.ndarray, k: int, stop: int) -> None:
        """Put a stop in before stop k."""
        a = stops[k - 1]
        if k < len(stops):
            count[self.view(a, stops[k])] -= 1
            count[self.view(stop, stops[k])] += 1
        count[self.view(a, stop)] += 1
        stops.insert(k, stop)

    def prune(self, stops: list[int], count: np.ndarray) -> None:
        """Take out all stops that are not needed, the most costly first."""
        while True:
            saved = [(self._detour(stops, k), k) for k in range(1, len(stops))]
            for _, k in sorted(saved, reverse=True):
                if self.remove(stops, count, k):
                    break
            else:
                return

    def _detour(self, stops: list[int], k: int) -> float:
        a, s = stops[k - 1], stops[k]
        if k + 1 == len(stops):
            return self.distance(a, s)
        b = stops[k + 1]
        return self.distance(a, s) + self.distance(s, b) - self.distance(a, b)

    def repair(self, stops: list[int], count: np.ndarray, rng: np.random.Generator) -> None:
        """Insert places until all is seen: those that see what few places see, at little way for what they see."""
        sight = self.sight
        few = np.diff(sight.viewer_starts)
        greed = rng.choice((0.0, 0.3, 0.7))
        while True:
            unseen = np.flatnonzero(count == 0)
            if not len(unseen):
                return
            hardest = unseen[np.argmin(few[unseen] * rng.uniform(1.0, 1.5, len(unseen)))]
            places = sight.viewers_of(hardest)
            if len(places) > _CANDIDATES:
                places = rng.choice(places, _CANDIDATES, replace=False)
            fields = np.stack([self.field(s)[places] for s in stops])
            legs = np.array([self.distance(a, b) for a, b in itertools.pairwise(stops)])
            cost = fields.copy()
            cost[:-1] += fields[1:] - legs[:, None]
            slot = np.argmin(cost, axis=0)
            least = np.maximum(cost[slot, np.arange(len(places))], 0.0)
            if greed > 0.0:
                wanted = count == 0
                gain = np.array([np.count_nonzero(wanted[sight.view(p)]) for p in places])
                least = (least + 0.3) / np.maximum(gain, 1) ** greed
            best = int(np.argmin(least))
            self.insert(stops, count, int(slot[best]) + 1, int(places[best]))

    # The search -----------------------------------------------------------------------------------

    def cover(self) -> list[int]:
        """Greedy set cover: the place that sees the most of what is left, again and again; the start first."""
        sight = self.sight
        gain = np.diff(sight.indptr)
        left = np.ones(len(sight.points), bool)
        stops: list[int] = []
        best = 0
        while True:
            new = sight.view(best)[left[sight.view(best)]]
            left[new] = False
            _lower_gain(gain, new, sight.viewers, sight.viewer_starts)
            stops.append(best)
            if not left.any():
                return stops
            best = int(np.argmax(gain))

    def order(self, stops: list[int]) -> list[int]:
        """The stops in the order of a short open tour from the first, by PyVRP."""
        between = np.array([[self.distance(a, b) for b in stops] for a in stops])
        return [stops[i] for i in open_tour(between)]

    def search(self, rng: np.random.Generator, iterations: int) -> Found:
        """The best tour after so many rounds of destroy and repair."""
        stops = self.cover()
        for s in stops:
            self.field(s)
        stops = self.order(stops)
        count = self.seen(stops)
        self.prune(stops, count)
        length = self.length(stops)
        best, best_length = list(stops), length
        for turn in range(iterations):
            if len(stops) < 2:
                break
            heat = _HEAT * (1.0 - turn / iterations)
            trial, seen = list(stops), count.copy()
            if turn % 25 == 24:
                trial = self.order(trial)
                seen = self.seen(trial)
            else:
                for k in sorted(self._chosen(trial, rng), reverse=True):
                    self.remove(trial, seen, k, forced=True)
            self.repair(trial, seen, rng)
            self.prune(trial, seen)
            found = self.length(trial)
            if found < length * (1.0 + heat * rng.random()) - 1e-9:
                stops, count, length = trial, seen, found
                if length < best_length - 1e-9:
                    best, best_length = list(stops), length
        return self.finish(best)

    def _chosen(self, stops: list[int], rng: np.random.Generator) -> list[int]:
        """Which stops to take out: a stretch of the tour, or those around one of them."""
        size = int(rng.integers(1, max(2, min(len(stops) - 1, 8)) + 1))
        k = int(rng.integers(1, len(stops)))
        if rng.random() < 0.5:
            return list(range(k, min(k + size, len(stops))))
        far = self.field(stops[k])[[s if s < len(self.sight.places) else 0 for s in stops[1:]]]
        return [int(i) + 1 for i in np.argsort(far, kind="stable")[:size]]

    def finish(self, stops: list[int]) -> Found:
        """Move each stop to where the tour is shorter while all is still seen; the tour as a polyline."""
        stops = list(stops)
        count = self.seen(stops)
        for step in _NUDGES:
            moved = True
            while moved:
                moved = False
                for k in range(1, len(stops)):
                    moved |= self._nudge(stops, count, k, step)
        self.prune(stops, count)
        legs = tuple(self.way(a, b) for a, b in itertools.pairwise(stops)) or (self.points[0][None],)
        length = float(sum(np.hypot(*np.diff(leg, axis=0).T).sum() for leg in legs))
        return Found(length, np.array([self.points[s] for s in stops]), legs)

    def headings(self, stops: np.ndarray, field_of_view: float) -> tuple[tuple[float, ...], ...]:
        """For each stop (k, 2) the headings in which scans show what no scan before did: greedy, few."""
        left = np.ones(len(self.sight.points), bool)
        half = math.pi if field_of_view >= 2.0 * math.pi - 1e-9 else 0.5 * field_of_view - _AIM
        out = []
        for stop in stops:
            new = self.sight.seen_from(stop[None])
            new = new[left[new]]
            left[new] = False
            bearings = np.arctan2(*(self.sight.points[new] - stop).T[::-1])
            chosen: list[float] = []
            while len(bearings):
                # Some best scan begins at a bearing: turn the view until its right side meets one.
                centres = np.array([0.0]) if field_of_view >= 2.0 * math.pi - 1e-9 else bearings + half
                inside = np.abs((bearings - centres[:, None] + math.pi) % (2.0 * math.pi) - math.pi) <= half + 1e-9
                best = int(np.argmax(inside.sum(axis=1)))
                chosen.append(float((centres[best] + math.pi) % (2.0 * math.pi) - math.pi))
                bearings = bearings[~inside[best]]
            out.append(tuple(chosen))
        return tuple(out)

    def _nudge(self, stops: list[int], count: np.ndarray, k: int, step: float) -> bool:
        """Move stop k by step towards where the tour gets shorter, if all is still seen; whether it did."""
        a, s = stops[k - 1], stops[k]
        b = stops[k + 1] if k + 1 < len(stops) else None
        before = self.distance(a, s) + (self.distance(s, b) if b is not None else 0.0)
        here = self.points[s]
        towards = [self.way(s, t)[1] - here for t in (a, b) if t is not None]
        units = [v / max(np.hypot(*v), 1e-9) for v in towards]
        both = sum(units)
        options = [*units, both / max(np.hypot(*both), 1e-9)]
        options += [np.array([-o[1], o[0]]) for o in options[-1:]] + [np.array([o[1], -o[0]]) for o in options[-1:]]
        for option in options:
            point = here + step * option
            new = len(self.points)
            self.points.append(point)
            try:
                after = self.distance(a, new) + (self.distance(new, b) if b is not None else 0.0)
            except ValueError:
                after = math.inf
            if after < before - 0.2 * 1e-2:
                old = [self.view(a, s)] + ([self.view(s, b)] if b is not None else [])
                fresh = [self.view(a, new)] + ([self.view(new, b)] if b is not None else [])
                for v in old:
                    count[v] -= 1
                for v in fresh:
                    count[v] += 1
                if all((count[v] > 0).all() for v in old):
                    stops[k] = new
                    return True
                for v in fresh:
                    count[v] -= 1
                for v in old:
                    count[v] += 1
            self._forget(new)
        return False

    def _forget(self, stop: int) -> None:
        self.points.pop()
        for cache in (self._ways, self._views):
            for key in [key for key in list(cache)[-8:] if stop in key]:
                del cache[key]  # type: ignore[attr-defined]


def open_tour(between: np.ndarray) -> list[int]:
    """A short open tour from row 0 through all rows of a symmetric matrix (k, k), m: the order of the rows.

    PyVRP's iterated local search, one vehicle that need not come back; so many iterations, not seconds.
    """
    from pyvrp import Client, Depot, Location, ProblemData, VehicleType, solve
    from pyvrp.stop import MaxIterations

    size = len(between)
    if size < 3:
        return list(range(size))
    lengths: Any = np.zeros((size + 1, size + 1), np.int64)  # the last place: the end, at no way from anywhere
    lengths[:size, :size] = np.rint(between / _UNIT)
    data = ProblemData(
        locations=[Location(0, 0) for _ in range(size + 1)],
        clients=[Client(place) for place in range(1, size)],
        depots=[Depot(0), Depot(size)],
        vehicle_types=[VehicleType(1, start_depot=0, end_depot=1)],
        distance_matrices=[lengths],
        duration_matrices=[np.zeros_like(lengths)],
    )
    result = solve(data, MaxIterations(_TOUR_ITERATIONS), seed=0, display=False, collect_stats=False)
    (route,) = result.best.routes()
    return [0, *(stop.idx + 1 for stop in route if stop.is_client())]
