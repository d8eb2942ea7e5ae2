"""Where the robot's disc can be, and shortest ways there: a visibility graph of the inflated walls.

Two graphs are made of the same plan. That of the upper bounds (`inner`) keeps the disc clear of all walls: its paths
can be driven. That of the lower bound (`outer`) lets the disc be a little smaller: no path of the true disc is
shorter than the graph's. In between lies the error of arcs drawn as chords, 1 to 2 cm at a corner.
"""

from __future__ import annotations

import math

import numpy as np
import shapely
from numba import njit
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from polyexplore_gym.errors import InvalidFloorPlanError
from polyexplore_gym.floorplan import FloorPlan
from polyexplore_gym.sim.coverage import visible

_ARC = 4
"""Chords a quarter circle."""
_CHORD = math.cos(math.pi / (4 * _ARC))
"""Distance of a chord's middle from the centre, over the radius."""
_CLEAR = 0.002
"""The disc of the inner graph is larger by this, m: more than what the arithmetic loses."""
_NODE = 0.004
"""The inner graph's nodes stand this far (m) off the walls that block its edges."""
_SIMPLIFY = 0.010
"""Polygons lose vertices that change them by no more than this, m."""
_OUTER = 0.005
"""The disc of the outer graph is smaller by this (m), beside `_SIMPLIFY`: physics lets a bump go 0.1 mm deep,
and GEOS moves a buffer's border by up to 1 % of the radius."""
_TAUT = 1e-6


@njit(cache=True)
def _sights(walls, points, targets, reach):  # type: ignore[no-untyped-def]
    """Which targets (n, 2) each point (k, 2) sees among walls (M, 4) within reach: rows of a CSR matrix.

    Returns indptr (k + 1,), indices int32."""
    k, n = points.shape[0], targets.shape[0]
    indptr = np.zeros(k + 1, np.int64)
    out = np.empty(1024, np.int32)
    near, dx, dy = np.empty(n, np.int32), np.empty(n), np.empty(n)
    for i in range(k):
        x, y = points[i, 0], points[i, 1]
        m = 0
        for j in range(n):
            ux, uy = targets[j, 0] - x, targets[j, 1] - y
            if ux * ux + uy * uy <= reach * reach:
                near[m], dx[m], dy[m] = j, ux, uy
                m += 1
        shown = visible(walls, x, y, dx[:m], dy[:m], reach)
        filled = indptr[i]
        if filled + m > out.size:
            larger = np.empty(2 * (filled + m), np.int32)
            larger[:filled] = out[:filled]
            out = larger
        for j in range(m):
            if shown[j]:
                out[filled] = near[j]
                filled += 1
        indptr[i + 1] = filled
    return indptr, out[: indptr[k]].copy()


def sights(walls: np.ndarray, points: np.ndarray, targets: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """What each point (k, 2) sees of targets (n, 2) among walls (M, 4) within reach m: CSR indptr (k + 1,), indices.

    Geometric visibility as in `polyexplore_gym.sim.coverage`: a sight line through a wall's very end is blocked.
    """
    points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 2)
    targets = np.ascontiguousarray(targets, dtype=np.float64).reshape(-1, 2)
    return _sights(np.ascontiguousarray(walls), points, targets, float(reach))  # type: ignore[no-any-return]


@njit(cache=True)
def _keep_taut(points, indptr, indices, nodes, before, after, own):  # type: ignore[no-untyped-def]
    """Drop sights to nodes that no shortest path turns at: those not tangent there (own: and at the point)."""
    filled, ends = 0, indptr.copy()
    for i in range(points.shape[0]):
        for e in range(ends[i], ends[i + 1]):
            j = indices[e]
            dx, dy = nodes[j, 0] - points[i, 0], nodes[j, 1] - points[i, 1]
            length = math.hypot(dx, dy)
            if length == 0.0:
                continue
            keep = _tangent(dx, dy, length, nodes[j], before[j], after[j])
            if keep and own:
                keep = _tangent(dx, dy, length, points[i], before[i], after[i])
            if keep:
                indices[filled] = j
                filled += 1
        indptr[i + 1] = filled
    return indptr, indices[:filled].copy()


@njit(cache=True, inline="always")
def _tangent(dx, dy, length, node, before, after):  # type: ignore[no-untyped-def]
    """Whether both walls at a node lie on one side of the line through it along (dx, dy)."""
    a = (dx * (before[1] - node[1]) - dy * (before[0] - node[0])) / length
    b = (dx * (after[1] - node[1]) - dy * (after[0] - node[0])) / length
    return (a >= -_TAUT and b >= -_TAUT) or (a <= _TAUT and b <= _TAUT)


@njit(cache=True)
def _over(field, points, indptr, indices, nodes):  # type: ignore[no-untyped-def]
    """Smallest field (V,) at a node plus the way on from it, for each point by its sights: (k,)."""
    out = np.full(points.shape[0], np.inf)
    for i in range(points.shape[0]):
        for e in range(indptr[i], indptr[i + 1]):
            j = indices[e]
            d = field[j] + math.hypot(nodes[j, 0] - points[i, 0], nodes[j, 1] - points[i, 1])
            if d < out[i]:
                out[i] = d
    return out


class Space:
    """Shortest paths among fixed points: a finite set of them, with distances and ways by the visibility graph."""

    def __init__(self, walls: np.ndarray, corners: np.ndarray, before: np.ndarray, after: np.ndarray) -> None:
        """walls (M, 4) block; paths turn at corners (V, 2), whose two walls end at before and after, (V, 2) each."""
        self.walls, self.nodes = walls, corners
        self._before, self._after = before, after
        self._reach = float(np.hypot(*(walls[:, :2].max(axis=0) - walls[:, :2].min(axis=0)))) + 1.0
        rows = sights(walls, corners, corners, self._reach)
        indptr, indices = _keep_taut(corners, *rows, corners, before, after, True)
        starts = np.repeat(np.arange(len(corners)), np.diff(indptr))
        lengths = np.hypot(*(corners[indices] - corners[starts]).T)
        graph = csr_array((lengths, indices, indptr), shape=(len(corners),) * 2)
        self.between, self._previous = dijkstra(graph, return_predecessors=True)
        """(V, V) m: ways between corners; inf where there is none."""

    @classmethod
    def inner(cls, plan: FloorPlan, radius: float, start: np.ndarray) -> Space:
        """Paths that keep a disc of `radius` (m) clear of all walls, around `start` (2,).

        Raises `InvalidFloorPlanError` if the disc fits nowhere.
        """
        offset = (radius + _CLEAR) / _CHORD
        walls = plan.polygon.buffer(-offset, quad_segs=_ARC)
        nodes = plan.polygon.buffer(-(offset + _NODE + _SIMPLIFY), quad_segs=_ARC).simplify(_SIMPLIFY)
        return cls(*_graph(plan, walls, nodes, start))

    @classmethod
    def outer(cls, plan: FloorPlan, radius: float, start: np.ndarray) -> Space:
        """Ways no longer than any of a disc of `radius` (m), around `start` (2,).

        Shortest paths in a polygon P that holds all places of the disc turn at P's reflex corners only, and lie in
        the polygon that blocks, which holds P: the graph has them, or shorter ones.
        """
        nodes = plan.polygon.buffer(-(radius - _OUTER - _SIMPLIFY), quad_segs=_ARC).simplify(_SIMPLIFY)
        walls = plan.polygon.buffer(-(radius - 2.0 * _OUTER - 2.0 * _SIMPLIFY), quad_segs=_ARC)
        space = cls(*_graph(plan, walls, nodes, start))
        space.area = _part(plan, nodes, start)
        shapely.prepare(space.area)
        return space

    area: shapely.Polygon
    """outer only: the polygon P, the part with the start."""

    def sees(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Corners to which a shortest path from each point (k, 2) may lead first: CSR indptr, indices."""
        points = np.ascontiguousarray(points)
        rows = sights(self.walls, points, self.nodes, self._reach)
        result: tuple[np.ndarray, np.ndarray] = _keep_taut(points, *rows, self.nodes, self._before, self._after, False)
        return result

    def field(self, point: np.ndarray) -> np.ndarray:
        """(V,) m: shortest ways from a point (2,) to the corners."""
        _, first = self.sees(point[None])
        if not len(first):
            return np.full(len(self.nodes), np.inf)
        steps = np.hypot(*(self.nodes[first] - point).T)
        return np.min(steps[:, None] + self.between[first], axis=0)

    def distances(
        self,
        point: np.ndarray,
        points: np.ndarray,
        rows: tuple[np.ndarray, np.ndarray],
        field: np.ndarray | None = None,
    ) -> np.ndarray:
        """(k,) m: shortest ways from a point (2,) to points (k, 2) whose `sees` are given as rows."""
        out = _over(self.field(point) if field is None else field, points, *rows, self.nodes)
        straight = sights(self.walls, point[None], points, self._reach)[1]
        out[straight] = np.hypot(*(points[straight] - point).T)
        return np.asarray(out)

    def path(self, a: np.ndarray, b: np.ndarray) -> list[int]:
        """Corners on a shortest way from a to b, none if it is straight; raises ValueError if there is no way."""
        if len(sights(self.walls, a[None], b[None], self._reach)[1]):
            return []
        first, last = self.sees(a[None])[1], self.sees(b[None])[1]
        if len(first) and len(last):
            ways = (
                np.hypot(*(self.nodes[first] - a).T)[:, None]
                + self.between[np.ix_(first, last)]
                + np.hypot(*(self.nodes[last] - b).T)
            )
            i, j = np.unravel_index(np.argmin(ways), ways.shape)
            if np.isfinite(ways[i, j]):
                way = [int(last[j])]
                while way[-1] != first[i]:
                    way.append(int(self._previous[first[i], way[-1]]))
                return way[::-1]
        raise ValueError(f"no way from {a.tolist()} to {b.tolist()}")


def _part(plan: FloorPlan, area: shapely.Geometry, start: np.ndarray) -> shapely.Polygon:
    parts = [p for p in shapely.get_parts(area) if p.geom_type == "Polygon" and not p.is_empty]
    if not parts:
        raise InvalidFloorPlanError(f"{plan.name}: no room for the robot")
    point = shapely.Point(start[:2])
    return min(parts, key=lambda p: (p.distance(point), -p.area))


def _rings(polygon: shapely.Polygon) -> list[np.ndarray]:
    """Rings (n, 2), not closed, free space on the left."""
    polygon = shapely.geometry.polygon.orient(polygon)
    return [np.asarray(ring.coords)[:-1] for ring in (polygon.exterior, *polygon.interiors)]


def _graph(
    plan: FloorPlan, walls: shapely.Geometry, nodes: shapely.Geometry, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Walls (M, 4) of one polygon, and the reflex corners of another with their neighbours, (V, 2) each."""
    rings = _rings(_part(plan, walls, start))
    blocking = np.ascontiguousarray(np.concatenate([np.hstack([r, np.roll(r, -1, axis=0)]) for r in rings]))
    corners, before, after = [], [], []
    for part in shapely.get_parts(nodes):
        for ring in _rings(part) if part.geom_type == "Polygon" and not part.is_empty else ():
            previous, following = np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0)
            a, b = ring - previous, following - ring
            reflex = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] < 0.0
            corners.append(ring[reflex])
            before.append(previous[reflex])
            after.append(following[reflex])
    stacked = [np.ascontiguousarray(np.concatenate(c)) if c else np.zeros((0, 2)) for c in (corners, before, after)]
    return blocking, stacked[0], stacked[1], stacked[2]
