"""The exploration graph: shortest collision-free paths for the robot's disc through known space.

A visibility graph over the inflated wall ends, kept between decisions. Nodes and the robot are leaves: paths end at
them, none leads through. Sources (leaves) keep fields of distances that are repaired where the graph changed.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from polyexplore_gym.exploration import fields
from polyexplore_gym.exploration.corners import (
    BEND,
    CORNER,
    LEAF,
    OPEN_SPACE,
    TRAIL,
    Shapes,
    bend_vertices,
    corner_vertices,
    distinct,
    retire,
    still_there,
)
from polyexplore_gym.exploration.links import (
    Links,
    Vertices,
    anchors,
    components,
    connect,
    insert,
    isolate,
    repack,
    sever,
    trail_under,
    unblocked,
)
from polyexplore_gym.exploration.scan_polygon import EVERYTHING, Scans
from polyexplore_gym.exploration.segments import (
    bucket,
    bucket_at,
    clearance,
    clearances,
    indexed,
    point_segment_distance,
    segment_distance,
)
from polyexplore_gym.exploration.tolerances import Tolerances

_IDLE = 32
"""So many fields are kept that nobody asks for at the moment: nodes that were too far come back."""


@njit(cache=True)
def retreat(x, y, walls, tol):
    """The nearest place with clearance `tol.need` to go to from (x, y) leaving all near walls: (x, y, found).

    A robot that bumped stands closer to a wall than paths do, and the map is only good to
    millimetres: sliding along the wall would bump again.
    """
    b = bucket_at(x, y, walls)
    for step in range(1, 11):
        d = 0.16 * tol.radius * step
        best = tol.need
        bx = x
        by = y
        for k in range(32):
            ux = math.cos(k * math.pi / 16)
            uy = math.sin(k * math.pi / 16)
            c = clearance(x + d * ux, y + d * uy, walls, tol.reach)
            if c < best:
                continue
            away = True
            ahead = 10.0 * tol.still
            for e in range(walls.start[b], walls.start[b + 1]):
                w = walls.segments[walls.items[e]]
                near = point_segment_distance(x, y, w[0], w[1], w[2], w[3])
                if near < tol.need and (
                    point_segment_distance(x + ahead * ux, y + ahead * uy, w[0], w[1], w[2], w[3]) < near + 0.3 * ahead
                ):
                    away = False
                    break
                least = min(near, tol.need) - 1e-3 * tol.still
                if segment_distance(x, y, x + d * ux, y + d * uy, w[0], w[1], w[2], w[3]) < least:
                    away = False
                    break
            if away:
                best = c + 1e-9 * tol.radius
                bx = x + d * ux
                by = y + d * uy
        if best > tol.need:
            return bx, by, True
    return x, y, False


@njit(cache=True)
def way_back(way, walls, tol):
    """The first part (p, 2) of the way `way` (k, 2) that leads to a place where paths begin, without its loops: where
    it comes to a place once more, what lies between is left out."""
    points = np.empty_like(way)
    driven = np.zeros(way.shape[0])
    keys = np.empty(way.shape, np.int64)
    n_slots = 16
    while n_slots < 2 * way.shape[0]:
        n_slots *= 2
    slots = np.full(n_slots, -1)  # the place in `points`, by a hash of its cell
    n = 0
    for x, y in way:
        kx = round(x / tol.same_point)
        ky = round(y / tol.same_point)
        slot = bucket(kx, ky, n_slots - 1)
        before = -1
        while slots[slot] >= 0:
            i = slots[slot]
            if i < n and keys[i, 0] == kx and keys[i, 1] == ky:
                before = i
                break
            slot = (slot + 1) & (n_slots - 1)
        if before >= 0:
            n = before + 1
            continue
        if n > 0:
            driven[n] = driven[n - 1] + math.hypot(x - points[n - 1, 0], y - points[n - 1, 1])
        points[n, 0], points[n, 1] = x, y
        keys[n, 0], keys[n, 1] = kx, ky
        slots[slot] = n
        n += 1
        if n > 1 and (clearance(x, y, walls, tol.reach) >= tol.need or driven[n - 1] > tol.back):
            break
    return points[:n].copy()


@njit(cache=True)
def lonely(x, y, vertices, n_vertices, tol):
    """Whether no corner and no way point stands near."""
    position = vertices.position
    for v in range(n_vertices):
        near = tol.way_point if vertices.shape.limit[v] >= OPEN_SPACE else tol.corner_near
        if vertices.kind[v] == CORNER and abs(position[v, 0] - x) < near and abs(position[v, 1] - y) < near:
            return False
    return True


def _vertices(rows: int) -> Vertices:
    """So many rows for vertices, none in use."""
    return Vertices(
        np.zeros((rows, 2)),
        Shapes.none(rows),
        np.full(rows, -1, np.int8),
        np.full(rows, -1, np.int64),
        np.full(rows, math.inf),
    )


class PathGraph:
    """Owner of the graph. Positions in the map frame, lengths in metres."""

    def __init__(self, tol: Tolerances) -> None:
        self.tol = tol
        self.n_vertices = 0
        self.vertices = _vertices(256)
        self.links = Links.none(256, 4096)
        self._used = 0
        self.blocked = np.zeros((0, 2), np.int64)
        self._blocked_length = np.zeros(0)
        self._blocked_want = np.zeros(0)
        self._free_ids = np.zeros(0, np.int64)
        self._fresh: list[np.ndarray] = []
        self.waiting = np.zeros((0, 2))
        self._scans_known = 0
        self.source_of = np.full(16, -1, np.int64)
        self.row_of = np.full(256, -1, np.int64)
        self.reach = np.zeros(16)
        self.dist = np.full((16, 256), math.inf)
        self.parent = np.full((16, 256), -1, np.int32)
        self.felt = 0
        self._has_trail = False
        self._segments = np.zeros((0, 4))
        self._alive = np.zeros(0, np.bool_)
        self._touched_felt = np.zeros(0, np.int64)
        self.walls = self._indexed(self._segments, self._alive, tol.reach)
        self.pieces = self._indexed(self._segments, self._alive, 0.0)
        self._cut: list[np.ndarray] = []
        self._added: list[tuple[np.ndarray, np.ndarray]] = []

    def _indexed(self, segments: np.ndarray, alive: np.ndarray, margin: float) -> Any:
        return indexed(segments, np.full(len(segments), -1, np.int64), alive, margin, self.tol.cell)

    # Obstacles -------------------------------------------------------------------------------

    def add_felt(self, segment: np.ndarray) -> None:
        """An obstacle (4,) that is no wall of the line map. It counts from the next `set_walls` on."""
        self._segments = np.insert(self._segments, self.felt, segment, axis=0)
        self._alive = np.insert(self._alive, self.felt, True)
        self._touched_felt = np.append(self._touched_felt, self.felt)
        self.felt += 1

    def set_walls(
        self,
        walls: np.ndarray,
        alive: np.ndarray,
        touched: np.ndarray,
        known: Scans = EVERYTHING,
        box: np.ndarray | None = None,
    ) -> None:
        """Take over the walls (m, 4) of the line map; only the `touched` rows changed since the last call.

        `known` tells which space is known, `box` (x0, y0, x1, y1) where that may have changed.
        """
        if self._added:
            self.repair()
        before, after = self._take(walls, alive, touched)
        self.walls = self._indexed(self._segments, self._alive, self.tol.reach)
        again = retire(
            self.vertices.position, self.vertices.kind, self.vertices.shape, self.n_vertices,
            np.concatenate((before, after)), self.walls, self.tol,
        )  # fmt: skip
        self._sever(after)
        waiting = self.waiting
        if box is not None:
            inside = ((waiting >= box[:2]) & (waiting <= box[2:])).all(axis=1)
            waiting, self.waiting = waiting[inside], waiting[~inside]
        ends = np.concatenate((again, after[:, :2], after[:, 2:], waiting))
        candidates, shape, more = corner_vertices(
            ends, self.walls, known, len(ends) - len(waiting), self._scans_known, self.tol
        )
        self._scans_known = len(known.headings)
        self.waiting = np.concatenate((self.waiting, ends[more]))
        keep = distinct(
            candidates, shape, self.vertices.position, self.vertices.shape, self.vertices.kind, self.n_vertices,
            self.tol,
        )  # fmt: skip
        self._new_vertices(candidates[keep], Shapes(*shape).take(keep))

    def _take(self, walls: np.ndarray, alive: np.ndarray, touched: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Copy what has moved: where those walls were (a, 4) and are now (b, 4).

        The map breathes with every scan. Walls stay here where they were last looked at, until they have
        moved for good.
        """
        new = self.felt + len(walls) - len(self._segments)
        if new > 0:
            self._segments = np.concatenate((self._segments, np.zeros((new, 4))))
            self._alive = np.concatenate((self._alive, np.zeros(new, np.bool_)))
        rows = touched + self.felt
        was, is_ = self._alive[rows], alive[touched]
        moved = (np.abs(self._segments[rows] - walls[touched]) > self.tol.still).any(axis=1)
        gone, come = was & (moved | ~is_), is_ & (moved | ~was)
        before = self._segments[rows[gone]]
        self._segments[rows[come]] = walls[touched[come]]
        self._alive[rows] = is_
        after = self._segments[np.concatenate((self._touched_felt, rows[come]))]
        self._touched_felt = self._touched_felt[:0]
        return before, after

    def _sever(self, walls: np.ndarray) -> None:
        cut, keep = sever(self.vertices, self.n_vertices, self.links, self.blocked, self._blocked_want, walls, self.tol)
        self._cut.append(cut)
        self._keep_blocked(keep)

    def _keep_blocked(self, keep: np.ndarray) -> None:
        if not keep.all():
            self.blocked = self.blocked[keep]
            self._blocked_length = self._blocked_length[keep]
            self._blocked_want = self._blocked_want[keep]

    def set_pieces(self, pieces: np.ndarray, sigma: np.ndarray, owner: np.ndarray, box: np.ndarray) -> None:
        """Take over the open edges (m, 4), their noise (m,) and the chain that owns each.

        Only those in `box` changed since the last call: bends stand where they are now, and edges that they no longer
        block are open.
        """
        self.pieces = indexed(pieces, owner, np.ones(len(pieces), np.bool_), 0.0, self.tol.cell)
        self._set_bends(pieces, sigma, box)
        if len(self.blocked):
            free = unblocked(self.blocked, self.vertices, box, self.pieces, self.tol.slack)
            if free.any():
                self._insert(self.blocked[free], self._blocked_length[free], self._blocked_want[free])
                self._keep_blocked(~free)

    def _set_bends(self, pieces: np.ndarray, sigma: np.ndarray, box: np.ndarray) -> None:
        v = self.vertices
        candidates, shape = bend_vertices(pieces, sigma, box, self.walls, self.tol)
        gone, new = still_there(v.position, v.kind, self.n_vertices, candidates, box, self.tol)
        if gone.any():
            if self._added:
                self.repair()
            v.kind[: self.n_vertices][gone] = -1
            self._sever(np.zeros((0, 4)))
        self._new_vertices(candidates[new], Shapes(*shape).take(new), BEND)

    def clearance(self, x: float, y: float) -> float:
        """Distance to the nearest wall, m, `tol.reach` at most."""
        return float(clearance(x, y, self.walls, self.tol.reach))

    def retreat(self, x: float, y: float) -> tuple[float, float, bool]:
        """Where to go first from a place nearer to a wall than paths are, and whether there is such a place."""
        if self.clearance(x, y) >= self.tol.need:
            return x, y, True
        return retreat(x, y, self.walls, self.tol)

    # Vertices and edges ----------------------------------------------------------------------

    def add_way_point(self, x: float, y: float) -> None:
        """Make a place where the robot stood a vertex, if others are far: halls have no corners in their middle."""
        if lonely(x, y, self.vertices, self.n_vertices, self.tol):
            place = np.array([[x, y]])
            self._new_vertices(place, Shapes.free(place, OPEN_SPACE))

    def add_leaves(self, points: np.ndarray, owner: np.ndarray) -> np.ndarray:
        """Vertices (k,) where paths end, at points (k, 2). `connect` joins them to all that they see."""
        ids = self._new_vertices(points, Shapes.none(len(points)), LEAF, owner)
        room = clearances(points, self.walls, self.tol.reach)
        self.vertices.relaxed[ids] = np.maximum(room - 0.02 * self.tol.radius, 0.2 * self.tol.radius)
        return ids

    def remove_leaves(self, vertices: np.ndarray) -> None:
        """Take leaves out, and their fields; no other path leads through them."""
        isolate(vertices, self.links)
        self.vertices.kind[vertices] = -1
        rows = self.row_of[vertices]
        self.source_of[rows[rows >= 0]] = -1
        self.row_of[vertices] = -1

    def add_trail(self, points: np.ndarray, robot: int) -> None:
        """Make the way driven (k, 2) part of the graph, up to the robot: it led here, so it leads back.

        Only the points that no corner can stand for are laid, and those between two parts of the graph.
        """
        self._has_trail = True
        anchor = self._laid_before(points)
        new = anchor < 0
        anchor[new] = anchors(points[new], self.vertices, self.n_vertices, self.walls, self.pieces, self.tol)
        part = np.where(anchor < 0, -1, components(self.links, self.vertices.kind, self.n_vertices)[anchor])
        changes = part[:-1] != part[1:]
        laid = np.flatnonzero((part < 0) | np.append(changes, True) | np.append(True, changes))
        ids = self._laid_before(points[laid])
        fresh = ids < 0
        ids[fresh] = self._new_vertices(points[laid[fresh]], Shapes.free(points[laid[fresh]], TRAIL))
        self.connect()
        neighbours = np.flatnonzero(np.diff(laid) == 1)
        held = np.flatnonzero(anchor[laid] >= 0)
        pairs = np.concatenate((
            np.stack((ids[neighbours], ids[neighbours + 1]), axis=1),
            np.stack((ids[held], anchor[laid[held]]), axis=1),
            [[ids[-1], robot]],
        ))  # fmt: skip
        pairs = pairs[[u != v and v not in self.neighbours(u) for u, v in pairs]]
        length = np.hypot(*(self.vertices.position[pairs[:, 0]] - self.vertices.position[pairs[:, 1]]).T)
        self._insert(pairs, length, np.zeros(len(pairs)))

    def trail_at(self, x: float, y: float) -> np.ndarray:
        """The ends (k,) of those edges from the way laid by `add_trail` on which a place lies."""
        if not self._has_trail:
            return np.zeros(0, np.int64)
        return trail_under(x, y, self.vertices, self.n_vertices, self.links, self.tol)

    def join_trail(self, leaf: int, ends: np.ndarray) -> None:
        """Join a leaf that stands on the way driven to vertices (k,) of it: it leads from there to both sides."""
        self.connect()
        known = self.neighbours(leaf)
        pairs = np.array([(u, leaf) for u in ends if u not in known], np.int64).reshape(-1, 2)
        length = np.hypot(*(self.vertices.position[pairs[:, 0]] - self.vertices.position[pairs[:, 1]]).T)
        self._insert(pairs, length, np.zeros(len(pairs)))

    def _laid_before(self, points: np.ndarray) -> np.ndarray:
        """The vertices (k,) that an earlier call made of points (k, 2) of the trail, or -1."""
        n = self.n_vertices
        old = np.flatnonzero((self.vertices.kind[:n] == CORNER) & (self.vertices.shape.limit[:n] == TRAIL))
        known = {(x, y): v for v, (x, y) in zip(old.tolist(), self.vertices.position[old].tolist(), strict=True)}
        return np.array([known.get((x, y), -1) for x, y in points.tolist()], np.int64)

    def neighbours(self, v: int) -> np.ndarray:
        """The vertices (k,) that open edges join to v."""
        first = self.links.first[v]
        return self.links.target[first : first + self.links.degree[v]]

    def connect(self) -> None:
        """Join the vertices that came since the last call to all that they see."""
        if not self._fresh:
            return
        fresh = np.concatenate(self._fresh)
        self._fresh = []
        pairs, length, wants, free = connect(fresh, self.vertices, self.n_vertices, self.walls, self.pieces, self.tol)
        if not free.all():
            self.blocked = np.concatenate((self.blocked, pairs[~free]))
            self._blocked_length = np.concatenate((self._blocked_length, length[~free]))
            self._blocked_want = np.concatenate((self._blocked_want, wants[~free]))
            pairs, length, wants = pairs[free], length[free], wants[free]
        self._insert(pairs, length, wants)

    def _insert(self, pairs: np.ndarray, length: np.ndarray, wants: np.ndarray) -> None:
        used = insert(pairs, length, wants, self.links, self._used)
        if used < 0:
            self._make_room(len(self.vertices.kind), -used)
            used = insert(pairs, length, wants, self.links, self._used)
        self._used = used
        self._added.append((pairs, length))

    def _make_room(self, vertices: int, more: int) -> None:
        """Move all edges to new tables, with space for `more` half-edges beside twice those in use."""
        rows = int(self.links.degree.sum())
        links = Links.none(vertices, 4 * rows + 2 * more + 16 * self.n_vertices)
        self._used = repack(self.links, links)
        self.links = links

    def _new_vertices(
        self, position: np.ndarray, shape: Shapes, kind: int = CORNER, owner: int | np.ndarray = -1
    ) -> np.ndarray:
        m = len(position)
        ids = self._free_ids[:m]
        if len(ids) < m:
            extra = np.arange(self.n_vertices, self.n_vertices + m - len(ids))
            self.n_vertices += len(extra)
            self._grow(self.n_vertices)
            ids = np.concatenate((ids, extra))
        self._free_ids = self._free_ids[m:]
        self.vertices.position[ids] = position
        self.vertices.shape.put(ids, shape)
        self.vertices.kind[ids] = kind
        self.vertices.owner[ids] = owner
        self.vertices.relaxed[ids] = math.inf
        self.dist[:, ids] = math.inf
        self.parent[:, ids] = -1
        if m:
            self._fresh.append(ids)
        return ids

    def _grow(self, size: int) -> None:
        capacity = had = len(self.vertices.kind)
        if size <= capacity:
            return
        while capacity < size:
            capacity *= 2
        old, new = self.vertices, _vertices(capacity)
        rows = np.arange(had)
        new.shape.put(rows, old.shape)
        for mine, theirs in ((new.position, old.position), (new.kind, old.kind), (new.owner, old.owner),
                             (new.relaxed, old.relaxed)):  # fmt: skip
            mine[:had] = theirs
        self.vertices = new
        self.row_of = np.concatenate((self.row_of, np.full(capacity - had, -1, np.int64)))
        k = len(self.dist)
        self.dist = np.concatenate((self.dist, np.full((k, capacity - had), math.inf)), axis=1)
        self.parent = np.concatenate((self.parent, np.full((k, capacity - had), -1, np.int32)), axis=1)
        self._make_room(capacity, 0)

    def recycle(self) -> None:
        """Free the indices of dead vertices. Call after `repair`."""
        if len(self.blocked):
            self._keep_blocked(np.all(self.vertices.kind[self.blocked] >= 0, axis=1))
        self._free_ids = np.flatnonzero(self.vertices.kind[: self.n_vertices] < 0)

    # Fields ----------------------------------------------------------------------------------

    def repair(self) -> None:
        """Bring all distance fields up to date."""
        if self._cut or self._added:
            cut = np.concatenate(self._cut) if self._cut else np.zeros((0, 2), np.int64)
            added = np.concatenate([pairs for pairs, _ in self._added]) if self._added else cut[:0]
            length = np.concatenate([length for _, length in self._added]) if self._added else np.zeros(0)
            self._cut, self._added = [], []
            fields.repair(self.dist, self.parent, self.reach, self.source_of, cut, added, length, self.links,
                          self.vertices.kind)  # fmt: skip

    def set_sources(self, vertices: np.ndarray) -> None:
        """Keep whole fields for these leaves (k,) from now on, beside those that there are."""
        self._sources(vertices)
        for row in self.row_of[vertices]:
            if self.reach[row] < math.inf:
                fields.grow(
                    row,
                    self.source_of[row],
                    math.inf,
                    self.dist,
                    self.parent,
                    self.reach,
                    self.links,
                    self.vertices.kind,
                )

    def between(self, vertices: np.ndarray, guess: np.ndarray, keep: int) -> np.ndarray:
        """Path lengths (k, k) between leaves; inf where there is no path. `guess` (k,): from any one place to each.

        Their fields are kept from now on, as far as they were needed, beside that of `keep` and a few others.
        """
        kept = np.zeros(len(self.vertices.kind), np.bool_)
        kept[vertices] = kept[keep] = True
        idle = np.flatnonzero((self.source_of >= 0) & ~kept[self.source_of])
        if len(idle) > _IDLE:
            self.row_of[self.source_of[idle]] = -1
            self.source_of[idle] = -1
        self._sources(vertices)
        return fields.between(
            self.row_of[vertices], vertices, guess, self.dist, self.parent, self.reach, self.links,
                    self.vertices.kind,
        )  # fmt: skip

    def distances(self, source: int, vertices: np.ndarray) -> np.ndarray:
        """Path lengths (k,) from a source with a whole field to vertices; inf where there is no path."""
        return self.dist[self.row_of[source], vertices]

    def _sources(self, vertices: np.ndarray) -> None:
        """Make leaves (k,) sources; those that had no field get one that reaches nowhere yet."""
        self.repair()
        new = vertices[self.row_of[vertices] < 0]
        short = len(new) - np.count_nonzero(self.source_of < 0)
        if short > 0:
            k = len(self.source_of)
            self.source_of = np.concatenate((self.source_of, np.full(k + short, -1)))
            self.reach = np.concatenate((self.reach, np.zeros(k + short)))
            self.dist = np.concatenate((self.dist, np.full((k + short, self.dist.shape[1]), math.inf)))
            self.parent = np.concatenate((self.parent, np.full((k + short, self.dist.shape[1]), -1, np.int32)))
        rows = np.flatnonzero(self.source_of < 0)[: len(new)]
        self.source_of[rows] = new
        self.row_of[new] = rows
        self.reach[rows] = -1.0
        self.dist[rows] = math.inf
        self.dist[rows, new] = 0.0
        self.parent[rows] = -1

    def path(self, source: int, vertex: int) -> np.ndarray:
        """Way points (k, 2) from a vertex to a source, both included."""
        parent = self.parent[self.row_of[source]]
        points = [self.vertices.position[vertex]]
        v = vertex
        while v != source:
            v = int(parent[v])
            points.append(self.vertices.position[v])
        return np.array(points)
