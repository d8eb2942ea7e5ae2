"""The exploration graph: shortest collision-free paths for the robot's disc through known space.

A visibility graph over the inflated wall ends, kept between decisions. Nodes and the robot are leaves: paths end at
them, none leads through. Sources (leaves) keep fields of distances that are repaired where the graph changed.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from polyexplore_gym.exploration import fields
from polyexplore_gym.exploration.corners import (
    CORNER,
    EVERYTHING,
    LEAF,
    OPEN_SPACE,
    REACH,
    TRAIL,
    Known,
    corner_vertices,
    distinct,
    retire,
)
from polyexplore_gym.exploration.links import (
    Links,
    anchors,
    components,
    connect,
    insert,
    isolate,
    repack,
    sever,
    unblocked,
)
from polyexplore_gym.exploration.segments import (
    bucket,
    build_grid,
    clearance,
    clearances,
    point_segment_distance,
    segment_distance,
)

_STILL = 0.002
"""A wall whose ends moved by less than this (m) since they were last looked at has not moved."""
_IDLE = 32
"""So many fields are kept that nobody asks for at the moment: nodes that were too far come back."""
_WAY_POINT = 4.0
_CORNER_NEAR = 1.5
"""A scan's place becomes a vertex where no other such place and no corner stands within these distances, m."""


@njit(cache=True)
def retreat(x, y, walls, start, items, need):
    """The nearest place with clearance `need` to go to from (x, y) leaving all near walls: (x, y, found).

    A robot that bumped stands closer to a wall than paths do, and the map is only good to
    millimetres: sliding along the wall would bump again.
    """
    mask = start.size - 2
    b = bucket(math.floor(x), math.floor(y), mask)
    for step in range(1, 11):
        d = 0.04 * step
        best = need
        bx = x
        by = y
        for k in range(32):
            ux = math.cos(k * math.pi / 16)
            uy = math.sin(k * math.pi / 16)
            c = clearance(x + d * ux, y + d * uy, walls, start, items, REACH)
            if c < best:
                continue
            away = True
            for e in range(start[b], start[b + 1]):
                w = walls[items[e]]
                near = point_segment_distance(x, y, w[0], w[1], w[2], w[3])
                if near < need and (
                    point_segment_distance(x + 0.02 * ux, y + 0.02 * uy, w[0], w[1], w[2], w[3]) < near + 0.006
                ):
                    away = False
                    break
                if segment_distance(x, y, x + d * ux, y + d * uy, w[0], w[1], w[2], w[3]) < min(near, need) - 1e-6:
                    away = False
                    break
            if away:
                best = c + 1e-9
                bx = x + d * ux
                by = y + d * uy
        if best > need:
            return bx, by, True
    return x, y, False


@njit(cache=True)
def lonely(x, y, position, shape, kind, n_vertices):
    """Whether no corner and no way point stands near."""
    for v in range(n_vertices):
        near = _WAY_POINT if shape[v, 6] >= OPEN_SPACE else _CORNER_NEAR
        if kind[v] == CORNER and abs(position[v, 0] - x) < near and abs(position[v, 1] - y) < near:
            return False
    return True


class PathGraph:
    """Owner of the graph. Positions in the map frame, lengths in metres."""

    def __init__(self, radius: float, spare: float, tolerance: float, slack: float) -> None:
        """For a disc of `radius`: corners are passed at radius + `spare`, way points keep radius + `tolerance` to all
        walls, and the straight legs between them a fifth of the tolerance (a leg cuts the arc round a corner). An open
        edge may be crossed within `slack` of a leaf."""
        self.radius = radius
        self.rho = radius + spare
        self.need = radius + tolerance
        self.sweep = radius + 0.2 * tolerance
        self.slack = slack
        self.n_vertices = 0
        self.position = np.zeros((256, 2))
        self.shape = np.zeros((256, 7))
        self.kind = np.full(256, -1, np.int8)
        self.relaxed = np.full(256, math.inf)
        self.owner = np.full(256, -1, np.int64)
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
        self.walls = np.zeros((0, 4))
        self.alive = np.zeros(0, np.bool_)
        self.wall_grid = build_grid(self.walls, self.alive, REACH)
        self._touched_felt = np.zeros(0, np.int64)
        self.pieces = np.zeros((0, 4))
        self.piece_owner = np.zeros(0, np.int64)
        self.piece_grid = build_grid(self.pieces, np.zeros(0, np.bool_), 0.0)
        self._cut: list[np.ndarray] = []
        self._added: list[tuple[np.ndarray, np.ndarray]] = []

    # Obstacles -------------------------------------------------------------------------------

    def add_felt(self, segment: np.ndarray) -> None:
        """An obstacle (4,) that is no wall of the line map. It counts from the next `set_walls` on."""
        self.walls = np.insert(self.walls, self.felt, segment, axis=0)
        self.alive = np.insert(self.alive, self.felt, True)
        self._touched_felt = np.append(self._touched_felt, self.felt)
        self.felt += 1

    def set_walls(
        self,
        walls: np.ndarray,
        alive: np.ndarray,
        touched: np.ndarray,
        known: Known = EVERYTHING,
        box: np.ndarray | None = None,
    ) -> None:
        """Take over the walls (m, 4) of the line map; only the `touched` rows changed since the last call.

        `known` tells which space is known, `box` (x0, y0, x1, y1) where that may have changed.
        """
        if self._added:
            self.repair()
        before, after = self._take(walls, alive, touched)
        self.wall_grid = build_grid(self.walls, self.alive, REACH)
        again = retire(
            self.position, self.kind, self.shape, self.n_vertices, np.concatenate((before, after)), self.walls,
            *self.wall_grid, self.need,
        )  # fmt: skip
        self._sever(after)
        waiting = self.waiting
        if box is not None:
            inside = ((waiting >= box[:2]) & (waiting <= box[2:])).all(axis=1)
            waiting, self.waiting = waiting[inside], waiting[~inside]
        ends = np.concatenate((again, after[:, :2], after[:, 2:], waiting))
        candidates, shape, more = corner_vertices(
            ends, self.walls, *self.wall_grid, self.rho, self.need, known, len(ends) - len(waiting), self._scans_known
        )
        self._scans_known = len(known.headings)
        self.waiting = np.concatenate((self.waiting, ends[more]))
        keep = distinct(candidates, shape, self.position, self.shape, self.kind, self.n_vertices)
        self._new_vertices(candidates[keep], shape[keep])

    def _take(self, walls: np.ndarray, alive: np.ndarray, touched: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Copy what has moved: where those walls were (a, 4) and are now (b, 4).

        The map breathes with every scan. Walls stay here where they were last looked at, until they have
        moved for good.
        """
        new = self.felt + len(walls) - len(self.walls)
        if new > 0:
            self.walls = np.concatenate((self.walls, np.zeros((new, 4))))
            self.alive = np.concatenate((self.alive, np.zeros(new, np.bool_)))
        rows = touched + self.felt
        was, is_ = self.alive[rows], alive[touched]
        moved = (np.abs(self.walls[rows] - walls[touched]) > _STILL).any(axis=1)
        gone, come = was & (moved | ~is_), is_ & (moved | ~was)
        before = self.walls[rows[gone]]
        self.walls[rows[come]] = walls[touched[come]]
        self.alive[rows] = is_
        after = self.walls[np.concatenate((self._touched_felt, rows[come]))]
        self._touched_felt = self._touched_felt[:0]
        return before, after

    def _sever(self, walls: np.ndarray) -> None:
        cut, keep = sever(
            self.position, self.kind, self.shape, self.n_vertices, self.links, self.blocked, self._blocked_want, walls,
            self.need,
        )  # fmt: skip
        self._cut.append(cut)
        self._keep_blocked(keep)

    def _keep_blocked(self, keep: np.ndarray) -> None:
        if not keep.all():
            self.blocked = self.blocked[keep]
            self._blocked_length = self._blocked_length[keep]
            self._blocked_want = self._blocked_want[keep]

    def set_pieces(self, pieces: np.ndarray, owner: np.ndarray, box: np.ndarray) -> None:
        """Take over the open edges (m, 4) and the chain that owns each; open what they no longer block in `box`."""
        self.pieces = pieces
        self.piece_owner = owner
        self.piece_grid = build_grid(pieces, np.ones(len(pieces), np.bool_), 0.0)
        if len(self.blocked):
            free = unblocked(
                self.blocked, self.position, self.kind, box, pieces, *self.piece_grid, owner, self.owner, self.slack
            )
            if free.any():
                self._insert(self.blocked[free], self._blocked_length[free], self._blocked_want[free])
                self._keep_blocked(~free)

    def clearance(self, x: float, y: float) -> float:
        """Distance to the nearest wall, m, `REACH` at most."""
        return float(clearance(x, y, self.walls, *self.wall_grid, REACH))

    def retreat(self, x: float, y: float) -> tuple[float, float, bool]:
        """Where to go first from a place nearer to a wall than paths are, and whether there is such a place."""
        if self.clearance(x, y) >= self.need:
            return x, y, True
        return retreat(x, y, self.walls, *self.wall_grid, self.need)

    # Vertices and edges ----------------------------------------------------------------------

    def add_way_point(self, x: float, y: float) -> None:
        """Make a place where the robot stood a vertex, if others are far: halls have no corners in their middle."""
        if lonely(x, y, self.position, self.shape, self.kind, self.n_vertices):
            self._new_vertices(np.array([[x, y]]), np.array([[x + 1e6, y, 1.0, 0.0, 1.0, 0.0, OPEN_SPACE]]))

    def add_leaves(self, points: np.ndarray, owner: np.ndarray) -> np.ndarray:
        """Vertices (k,) where paths end, at points (k, 2). `connect` joins them to all that they see."""
        ids = self._new_vertices(points, np.zeros((len(points), 7)), LEAF, owner)
        self.relaxed[ids] = np.maximum(clearances(points, self.walls, *self.wall_grid, REACH) - 0.005, 0.05)
        return ids

    def remove_leaves(self, vertices: np.ndarray) -> None:
        """Take leaves out, and their fields; no other path leads through them."""
        isolate(vertices, self.links)
        self.kind[vertices] = -1
        rows = self.row_of[vertices]
        self.source_of[rows[rows >= 0]] = -1
        self.row_of[vertices] = -1

    def add_trail(self, points: np.ndarray, robot: int) -> None:
        """Make the way driven (k, 2) part of the graph, up to the robot: it led here, so it leads back.

        Only the points that no corner can stand for are laid, and those between two parts of the graph.
        """
        anchor = anchors(
            points, self.position, self.kind, self.n_vertices, self.walls, *self.wall_grid, self.pieces,
            *self.piece_grid, self.piece_owner, self.sweep,
        )  # fmt: skip
        part = np.where(anchor < 0, -1, components(self.links, self.kind, self.n_vertices)[anchor])
        changes = part[:-1] != part[1:]
        laid = np.flatnonzero((part < 0) | np.append(changes, True) | np.append(True, changes))
        ids = self._trail_vertices(points[laid])
        self.connect()
        neighbours = np.flatnonzero(np.diff(laid) == 1)
        held = np.flatnonzero(anchor[laid] >= 0)
        pairs = np.concatenate((
            np.stack((ids[neighbours], ids[neighbours + 1]), axis=1),
            np.stack((ids[held], anchor[laid[held]]), axis=1),
            [[ids[-1], robot]],
        ))  # fmt: skip
        pairs = pairs[[u != v and v not in self.neighbours(u) for u, v in pairs]]
        length = np.hypot(*(self.position[pairs[:, 0]] - self.position[pairs[:, 1]]).T)
        self._insert(pairs, length, np.zeros(len(pairs)))

    def _trail_vertices(self, points: np.ndarray) -> np.ndarray:
        """Vertices (k,) at points (k, 2) of the trail: those of an earlier call, else new ones."""
        n = self.n_vertices
        old = np.flatnonzero((self.kind[:n] == CORNER) & (self.shape[:n, 6] == TRAIL))
        known = {(x, y): v for v, (x, y) in zip(old.tolist(), self.position[old].tolist(), strict=True)}
        ids = np.array([known.get((x, y), -1) for x, y in points.tolist()], np.int64)
        fresh = ids < 0
        ids[fresh] = self._new_vertices(points[fresh], np.tile([1e9, 0.0, 1.0, 0.0, 1.0, 0.0, TRAIL], (fresh.sum(), 1)))
        return ids

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
        pairs, length, wants, free = connect(
            fresh, self.position, self.shape, self.kind, self.n_vertices, self.walls, *self.wall_grid,
            self.pieces, *self.piece_grid, self.piece_owner, self.owner, self.sweep, self.relaxed, self.slack,
        )  # fmt: skip
        if not free.all():
            self.blocked = np.concatenate((self.blocked, pairs[~free]))
            self._blocked_length = np.concatenate((self._blocked_length, length[~free]))
            self._blocked_want = np.concatenate((self._blocked_want, wants[~free]))
            pairs, length, wants = pairs[free], length[free], wants[free]
        self._insert(pairs, length, wants)

    def _insert(self, pairs: np.ndarray, length: np.ndarray, wants: np.ndarray) -> None:
        used = insert(pairs, length, wants, self.links, self._used)
        if used < 0:
            self._make_room(len(self.kind), -used)
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
        self, position: np.ndarray, shape: np.ndarray, kind: int = CORNER, owner: int | np.ndarray = -1
    ) -> np.ndarray:
        m = len(position)
        ids = self._free_ids[:m]
        if len(ids) < m:
            extra = np.arange(self.n_vertices, self.n_vertices + m - len(ids))
            self.n_vertices += len(extra)
            self._grow(self.n_vertices)
            ids = np.concatenate((ids, extra))
        self._free_ids = self._free_ids[m:]
        self.position[ids] = position
        self.shape[ids] = shape
        self.kind[ids] = kind
        self.owner[ids] = owner
        self.relaxed[ids] = math.inf
        self.dist[:, ids] = math.inf
        self.parent[:, ids] = -1
        if m:
            self._fresh.append(ids)
        return ids

    def _grow(self, size: int) -> None:
        capacity = len(self.kind)
        if size <= capacity:
            return
        while capacity < size:
            capacity *= 2
        extra = capacity - len(self.kind)
        self.position = np.concatenate((self.position, np.zeros((extra, 2))))
        self.shape = np.concatenate((self.shape, np.zeros((extra, 7))))
        self.kind = np.concatenate((self.kind, np.full(extra, -1, np.int8)))
        self.relaxed = np.concatenate((self.relaxed, np.full(extra, math.inf)))
        self.owner = np.concatenate((self.owner, np.full(extra, -1, np.int64)))
        self.row_of = np.concatenate((self.row_of, np.full(extra, -1, np.int64)))
        k = len(self.dist)
        self.dist = np.concatenate((self.dist, np.full((k, extra), math.inf)), axis=1)
        self.parent = np.concatenate((self.parent, np.full((k, extra), -1, np.int32)), axis=1)
        self._make_room(capacity, 0)

    def recycle(self) -> None:
        """Free the indices of dead vertices. Call after `repair`."""
        if len(self.blocked):
            self._keep_blocked(np.all(self.kind[self.blocked] >= 0, axis=1))
        self._free_ids = np.flatnonzero(self.kind[: self.n_vertices] < 0)

    # Fields ----------------------------------------------------------------------------------

    def repair(self) -> None:
        """Bring all distance fields up to date."""
        if self._cut or self._added:
            cut = np.concatenate(self._cut) if self._cut else np.zeros((0, 2), np.int64)
            added = np.concatenate([pairs for pairs, _ in self._added]) if self._added else cut[:0]
            length = np.concatenate([length for _, length in self._added]) if self._added else np.zeros(0)
            self._cut, self._added = [], []
            fields.repair(self.dist, self.parent, self.reach, self.source_of, cut, added, length, self.links, self.kind)

    def set_sources(self, vertices: np.ndarray) -> None:
        """Keep whole fields for these leaves (k,) from now on, beside those that there are."""
        self._sources(vertices)
        for row in self.row_of[vertices]:
            if self.reach[row] < math.inf:
                fields.grow(
                    row, self.source_of[row], math.inf, self.dist, self.parent, self.reach, self.links, self.kind
                )

    def between(self, vertices: np.ndarray, guess: np.ndarray, keep: int) -> np.ndarray:
        """Path lengths (k, k) between leaves; inf where there is no path. `guess` (k,): from any one place to each.

        Their fields are kept from now on, as far as they were needed, beside that of `keep` and a few others.
        """
        kept = np.zeros(len(self.kind), np.bool_)
        kept[vertices] = kept[keep] = True
        idle = np.flatnonzero((self.source_of >= 0) & ~kept[self.source_of])
        if len(idle) > _IDLE:
            self.row_of[self.source_of[idle]] = -1
            self.source_of[idle] = -1
        self._sources(vertices)
        return fields.between(
            self.row_of[vertices], vertices, guess, self.dist, self.parent, self.reach, self.links, self.kind
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
        points = [self.position[vertex]]
        v = vertex
        while v != source:
            v = int(parent[v])
            points.append(self.position[v])
        return np.array(points)
