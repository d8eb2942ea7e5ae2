"""The exploration map: what has been seen, where it is open, and how to get there.

Sees scans, pose estimates and fitted walls; never the floor plan.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
from numba import njit

from polyexplore_gym.config import ExplorationConfig, SensorConfig
from polyexplore_gym.exploration import jump_edges, nodes, scan_polygon
from polyexplore_gym.exploration.jump_edges import Opened, Pieces
from polyexplore_gym.exploration.path_graph import PathGraph, way_back
from polyexplore_gym.exploration.scan_polygon import Scans
from polyexplore_gym.exploration.segments import near_point, point_segment_distance, segment_distance
from polyexplore_gym.exploration.tolerances import end_noise, squeezed, tolerances
from polyexplore_gym.scan import Scan

VISIT = 2
"""A measurement made for a jump edge in vain counts so much: an attempt that ended before its node counts one."""
_MOST_TRIED, _ENOUGH = 64, 8
"""For so many jump edges without a node another place is looked for at most, and so many are enough where there is no
other: they are as many as an observation holds."""
_PATIENCE = 5
"""So often in a row the robot may bump at one spot before that is held against the jump edges that it set out for."""
_LONGEST_WAY, _LONGEST_TRAIL = 20_000, 200_000
"""So many poses of the way back are looked at, and so many places of it laid into the graph: a robot that bumps about
on a drifted map has driven for ever."""
_AHEAD = 0.5
"""A look from farther than `on_edge` measures a jump edge only with this cosine or more to its normal."""


@njit(cache=True)
def _too_near(path, walls, least):
    """Whether a wall (m, 4) comes nearer to a path (k, 2) than `least`."""
    for i in range(path.shape[0] - 1):
        x1, y1 = path[i]
        x2, y2 = path[i + 1]
        for w in walls:
            if (
                max(w[0], w[2]) > min(x1, x2) - least
                and min(w[0], w[2]) < max(x1, x2) + least
                and max(w[1], w[3]) > min(y1, y2) - least
                and min(w[1], w[3]) < max(y1, y2) + least
                and segment_distance(x1, y1, x2, y2, w[0], w[1], w[2], w[3]) < least
            ):
                return True
    return False


@njit(cache=True)
def _thinned(way, step, off):
    """Points (p, 2) of a way (k, 2) between which it is straight to `off` m: farther apart than `step` m only where
    the way has no points between."""
    n = 1
    moved = way.copy()
    for k in range(1, way.shape[0]):
        if math.hypot(way[k, 0] - moved[n - 1, 0], way[k, 1] - moved[n - 1, 1]) > 0.5 * off:  # not on the spot
            moved[n] = way[k]
            n += 1
    last = way[-1]
    way = moved[:n]
    out = np.empty((n + 1, 2))
    out[0] = way[0]
    count = 1
    first = 0
    for k in range(2, n):
        ax, ay = way[first]
        bx, by = way[k]
        good = math.hypot(bx - ax, by - ay) <= step
        for i in range(first + 1, k):
            good = good and point_segment_distance(way[i, 0], way[i, 1], ax, ay, bx, by) <= off
        if not good:
            first = k - 1
            out[count] = way[first]
            count += 1
    out[count] = last
    return out[: count + 1].copy()


def _resampled(way: np.ndarray, step: float, off: float) -> np.ndarray:
    """Points (p, 2) at most `step` m apart of a way (k, 2) that is straight between them to `off` m, and the last.

    The same ones again when the way has grown.
    """
    corners = _thinned(way, step, off)
    legs = np.diff(corners, axis=0)
    parts = np.maximum(np.ceil(np.hypot(*legs.T) / step), 1.0).astype(np.int64)
    share = (np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)) / np.repeat(parts, parts)
    between = np.repeat(corners[:-1], parts, axis=0) + share[:, None] * np.repeat(legs, parts, axis=0)
    return np.concatenate((between, corners[-1:]))


class JumpEdges(NamedTuple):
    """The jump edges, one row each; `node` and what follows describe the node in front of it."""

    id: np.ndarray
    """(c,) identity: kept as long as the jump edge does not change."""
    length: np.ndarray
    """(c,) l_n, m."""
    width: np.ndarray
    """(c,) of the opening: with the gaps in it, on to the walls at its ends, m."""
    middle: np.ndarray
    """(c, 2) point at half the length."""
    normal: np.ndarray
    """(c, 2) unit vector into the unknown."""
    ends: np.ndarray
    """(c, 4) its end points."""
    kind: np.ndarray
    """(c,) `scan_polygon` label of most of it."""
    visits: np.ndarray
    """(c,) measurements made for it in vain, rounded up; attempts that ended before its node count half."""
    node: np.ndarray
    """(c, 3) position and heading of the node."""
    vertex: np.ndarray
    """(c,) vertex in the path graph, -1 where the robot can stand nowhere for it."""
    gain: np.ndarray
    """(c,) g_n, rad."""
    path_length: np.ndarray
    """(c,) c_n from the robot, m; inf where there is no path."""

    @classmethod
    def new(cls, opened: Opened, which: np.ndarray) -> JumpEdges:
        """Some of the chains as jump edges that have no node yet."""
        m = len(which)
        return cls(
            opened.id[which], opened.length[which], opened.width[which], opened.middle[which], opened.normal[which],
            opened.ends[which], opened.kind[which], -(-opened.visits[which] // VISIT), np.zeros((m, 3)),
            np.full(m, -1, np.int64), np.zeros(m), np.full(m, math.inf),
        )  # fmt: skip

    @property
    def size(self) -> int:
        """How many there are."""
        return len(self.id)

    def take(self, rows: np.ndarray) -> JumpEdges:
        """The table of some rows."""
        return JumpEdges(*(column[rows] for column in self))

    def join(self, other: JumpEdges) -> JumpEdges:
        """Both tables, one below the other."""
        return JumpEdges(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


class Remains(NamedTuple):
    """What an exploration left open."""

    unreached: int
    """Jump edges that no place in reach sees."""
    unreached_length: float
    """Their length together, m."""
    given_up: int
    """Jump edges measured or attempted in vain too often."""
    given_up_length: float
    """Their length together, m."""


def _nothing() -> Opened:
    z, i = np.zeros(0), np.zeros(0, np.int64)
    return Opened(i, z, z, z, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 4)), i.astype(np.int8), i)


_EVERYWHERE = np.array([-math.inf, -math.inf, math.inf, math.inf])


def _no_box() -> np.ndarray:
    return np.array([math.inf, math.inf, -math.inf, -math.inf])


class ExplorationMap:
    """Owner of the exploration's state: scan polygons, open edges, jump edges, nodes and paths.

    `insert` takes a scan, `plan` then brings nodes and paths up to date for a robot at a pose.
    """

    def __init__(self, config: ExplorationConfig, sensor: SensorConfig, radius: float) -> None:
        """`radius` of the robot's disc, m."""
        self.config = config
        self.sensor = sensor
        self.tol = tolerances(config, sensor, radius)
        self.least_width = self.tol.gap - 3.0 * sensor.sigma_range
        """Openings narrower than this are no jump edges: the robot's diameter, less what noise may take off. Nor are
        those along which a disc of this diameter fits nowhere between the walls: however long, as the way into a slit,
        nobody can go through. What can be reached lies behind others too."""
        n = sensor.beams
        self.n_scans = 0
        """Scan polygons kept: those that showed something new."""
        self.n_looks = 0
        """All scans so far."""
        self._looks = np.zeros((16, 3))
        self._apexes = np.zeros((16, 2))
        self._headings = np.zeros(16)
        self._boxes = np.zeros((16, 4))
        self._points = np.zeros((16, n, 2))
        self._rays = np.zeros((16, n, 2))
        self._angles = np.zeros(n)
        self.pieces = Pieces.none()
        self.chains = JumpEdges.new(_nothing(), np.zeros(0, np.int64))
        self.graph = self._wide = PathGraph(self.tol)
        self._tight: PathGraph | None = None
        """Paths through passages that noise or the space between beams closes: made when nothing else is in reach."""
        self._tight_touched: list[np.ndarray] = []
        self.robot = -1
        self._start: list[tuple[float, float]] = []
        self._next_id = 0
        self._trail: list[np.ndarray] = []
        self._touched: list[np.ndarray] = []
        self._felt: list[tuple[float, float, float, float, float]] = []
        self._felt_again = False
        self._stuck = 0
        self._halt = np.zeros(2)
        self._walls = np.zeros((0, 4))
        self._box = _no_box()

    # Scans -----------------------------------------------------------------------------------

    @property
    def scans(self) -> Scans:
        """The scan polygons so far (views)."""
        n = self.n_scans
        return Scans(
            self._apexes[:n], self._headings[:n], self._boxes[:n], self._points[:n], self._rays[:n], self._angles,
            self.sensor.full_circle, self.sensor.max_range,
        )  # fmt: skip

    def insert(
        self,
        scan: Scan,
        walls: np.ndarray,
        alive: np.ndarray,
        touched: np.ndarray,
        *,
        point_segment: np.ndarray | None = None,
        ranges: np.ndarray | None = None,
        target: int | None = None,
        arrived: bool = True,
    ) -> None:
        """Take in a scan.

        `walls` (m, 4) with `alive` (m,) are the rows of the line map and `touched` those that this scan
        changed; `point_segment` (n,) names the fitted segment of each return and `ranges` (n,) the
        smoothed ranges. `target` is the id of the jump edge that the robot set out to measure.
        """
        ranges = scan.ranges if ranges is None else ranges
        if point_segment is None:
            point_segment = np.full(len(scan.angles), -1, np.int64)
        self._remember(scan.pose)
        s = self._store(scan, ranges)
        tol = self.tol
        x, y = float(scan.pose[0]), float(scan.pose[1])
        reach = tol.max_range + tol.gap
        self._touched.append(touched)
        self._box = np.array([
            min(self._box[0], x - reach), min(self._box[1], y - reach),
            max(self._box[2], x + reach), max(self._box[3], y + reach),
        ])  # fmt: skip
        halves = 0
        if target is not None:
            if arrived and self._measured(target, x, y):
                halves = VISIT
            elif not self._felt_again or self._stuck > _PATIENCE:
                halves = 1  # else the spot is to blame, not the edge: what is felt closes it in the end
            self._stuck = self._stuck + 1 if self._felt_again else 0
            self._felt_again = False
        near = walls[near_point(walls, alive, x, y, reach)]
        pieces, opened, left_of, useful = jump_edges.take_in(
            s, ranges, point_segment, self.scans, self.pieces, near, -1 if target is None else target, halves,
            VISIT * self.config.max_visits, self._next_id, tol,
        )  # fmt: skip
        if not useful:
            self.n_scans -= 1  # its polygon lies within the others, but for slivers: kept, it would only cost memory
        self._take_over(pieces, opened, left_of)
        if target is not None:
            self._drop_nodes(np.flatnonzero(self.chains.id == target))  # the same place again would show no more

    def attempted(self, target: int) -> None:
        """Count an attempt to get to a jump edge that no path led to in the end."""
        p, c = self.pieces, self.chains
        mine = p.owner == target
        p.visits[mine] += 1
        if mine.any():
            c.visits[c.id == target] = -(-p.visits[mine].max() // VISIT)

    def _measured(self, target: int, x: float, y: float) -> bool:
        """Whether a scan from (x, y) measures a jump edge; a look from afar or from the side is an attempt only."""
        row = np.flatnonzero(self.chains.id == target)
        if not len(row):
            return True
        dx, dy = self.chains.middle[row[0]] - (x, y)
        distance = math.hypot(dx, dy)
        ahead = dx * self.chains.normal[row[0], 0] + dy * self.chains.normal[row[0], 1]
        return distance <= self._front + self.tol.at_node and (
            distance <= self.tol.on_edge or ahead >= _AHEAD * distance
        )

    @property
    def _front(self) -> float:
        return self.tol.front if self.config.placement == "in_front" else 0.0

    def _remember(self, pose: np.ndarray) -> None:
        if self.n_looks == len(self._looks):
            self._looks = np.concatenate((self._looks, np.zeros_like(self._looks)))
        self._looks[self.n_looks] = pose
        self.n_looks += 1

    def _store(self, scan: Scan, ranges: np.ndarray) -> int:
        s = self.n_scans
        if s == len(self._headings):
            self._apexes = np.concatenate((self._apexes, np.zeros_like(self._apexes)))
            self._headings = np.concatenate((self._headings, np.zeros_like(self._headings)))
            self._boxes = np.concatenate((self._boxes, np.zeros_like(self._boxes)))
            self._points = np.concatenate((self._points, np.zeros_like(self._points)))
            self._rays = np.concatenate((self._rays, np.zeros_like(self._rays)))
        self._apexes[s] = scan.pose[:2]
        self._headings[s] = scan.pose[2]
        self._angles = scan.angles
        self._points[s], self._rays[s] = scan_polygon.corner_points(
            scan.angles, ranges, float(scan.pose[2]), self.tol.max_range
        )
        self._boxes[s] = scan_polygon.box_of(self._points[s], *scan.pose[:2])
        self.n_scans += 1
        return s

    def _take_over(self, pieces: Pieces, opened: Opened, left_of: np.ndarray) -> None:
        """Make pieces and the chains that are new among them the map's own."""
        self.pieces, c = pieces, self.chains
        self._next_id += len(opened.id)
        staying, same_as, new = jump_edges.succeed(
            pieces.owner, opened, left_of, c.id, c.middle, c.ends, self.least_width
        )
        for q in np.flatnonzero(same_as >= 0):
            c.visits[same_as[q]], c.kind[same_as[q]] = -(-opened.visits[q] // VISIT), opened.kind[q]
        if not staying.all():
            self._drop_vertices(c.vertex[~staying])
            c = c.take(np.flatnonzero(staying))
        self.chains = c.join(JumpEdges.new(opened, new)) if len(new) else c

    def _drop_nodes(self, which: np.ndarray) -> None:
        self._drop_vertices(self.chains.vertex[which])
        self.chains.vertex[which] = -1

    def _drop_vertices(self, vertices: np.ndarray) -> None:
        vertices = vertices[vertices >= 0]
        if len(vertices):
            self.graph.remove_leaves(vertices)

    def bump(self, pose: np.ndarray, bearing: float) -> None:
        """Remember an obstacle felt at `bearing` (rad, map frame) on the robot's rim at `pose` (3,): plan around it.

        Felt again at the same spot, it is twice as wide: so that no way leads into it for ever.
        """
        c, s = math.cos(bearing), math.sin(bearing)
        r = self.tol.radius
        x, y = pose[0] + r * c, pose[1] + r * s
        half = 0.04 * r
        for fx, fy, before, _, _ in self._felt:
            away = math.hypot(fx - x, fy - y)
            self._felt_again |= away < 0.3 * r and self._still_there(pose)
            if away < 0.08 * r:
                half = max(half, min(2.0 * before, r))
        self._felt.append((x, y, half, c, s))
        for graph in (self._wide, self._tight):
            if graph is not None:
                self._put_felt(graph, x, y, half, c, s)

    def _still_there(self, pose: np.ndarray) -> bool:
        """Whether the robot stands where its last scan was made: it got nowhere."""
        last = self._looks[self.n_looks - 1]
        return math.hypot(pose[0] - last[0], pose[1] - last[1]) < 0.4 * self.tol.radius

    def _put_felt(self, graph: PathGraph, x: float, y: float, half: float, c: float, s: float) -> None:
        # Felt walls stand where they are: no path may squeeze into them.
        near = self.tol.need - graph.tol.need
        x, y = x - near * c, y - near * s
        graph.add_felt(np.array([x + half * s, y - half * c, x - half * s, y + half * c]))

    # Nodes and paths -------------------------------------------------------------------------

    def plan(
        self,
        pose: np.ndarray,
        walls: np.ndarray,
        alive: np.ndarray,
        came: np.ndarray | None = None,
        halt: np.ndarray | None = None,
        lone: np.ndarray | None = None,
    ) -> None:
        """Bring nodes, gains and shortest paths up to date for a robot at the estimated `pose` (3,).

        `came` (k, 2) is the way that it came, the way back out of a tight place. `halt` (2,) is where a robot that
        moves can come to rest at the earliest: paths lead there first. `lone` (m,) is that of the line map: which walls
        stand for a single return.
        """
        if came is not None:
            self._trail.append(came)
        self._halt = pose[:2] if halt is None else halt
        self._walls = walls[alive]
        touched = np.unique(np.concatenate(self._touched)) if self._touched else np.zeros(0, np.int64)
        self._switch(self._wide)
        if self._touched:
            self._show(self._wide, walls, alive, touched, self._box)
        if self._tight is not None:
            self._tight_touched.append(touched)
        self._plan(pose)
        while not self.reachable.any():
            if self.chains.size and self._squeeze(pose, walls, alive, lone):
                break
            again = self._look_again()
            self._switch(self._wide)
            if not again:
                self._plan(pose)
                break
            self._show(self._wide, walls, alive, touched[:0], _EVERYWHERE)
            self._box = _EVERYWHERE
            self._plan(pose)
        self._touched = []
        self._box = _no_box()

    def _show(
        self, graph: PathGraph, walls: np.ndarray, alive: np.ndarray, touched: np.ndarray, box: np.ndarray
    ) -> None:
        """Let a path graph know what is new."""
        graph.set_walls(walls, alive, touched, self.scans, box)
        graph.set_pieces(self.pieces.segments, self.pieces.sigma, self.pieces.owner, box)

    def _switch(self, graph: PathGraph) -> None:
        """Use another path graph: all nodes are placed anew."""
        if graph is self.graph:
            return
        self._drop_nodes(np.arange(self.chains.size))
        if self.robot >= 0:
            self.graph.remove_leaves(np.array([self.robot]))
            self.robot = -1
        self.graph = graph
        self._box = _EVERYWHERE

    def _squeeze(self, pose: np.ndarray, walls: np.ndarray, alive: np.ndarray, lone: np.ndarray | None) -> bool:
        """Look for ways through passages that noise or the space between beams closes. Whether one leads to a node."""
        if self._tight is None:
            self._tight = PathGraph(squeezed(self.tol))
            self._tight_touched = [np.arange(len(walls))]
            for felt in self._felt:
                self._put_felt(self._tight, *felt)
        touched = np.unique(np.concatenate(self._tight_touched)) if self._tight_touched else np.zeros(0, np.int64)
        self._switch(self._tight)
        self._show(self._tight, *self._certain(walls, alive, lone), touched, _EVERYWHERE)
        self._tight_touched = []
        self._plan(pose)
        return bool(self.reachable.any())

    def _certain(self, walls: np.ndarray, alive: np.ndarray, lone: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Walls (m, 4) as short as they may be, and which there are: those about a lone return shrink to it.

        Such a wall is as wide as its beam, across it: by half of that it may stick out of a wall seen at a slant.
        """
        certain = self._shortened(walls)
        if lone is None:
            return certain, alive
        about = np.isfinite(lone)
        way = walls[about, 2:] - walls[about, :2]
        certain[about] = np.tile(walls[about, :2] + lone[about, None] * way, 2)
        return certain, alive & ~(about & ((lone < 0.0) | (lone > 1.0)))

    def _shortened(self, walls: np.ndarray) -> np.ndarray:
        """Walls (m, 4) less what noise may have added at their ends."""
        way = walls[:, 2:] - walls[:, :2]
        length = np.hypot(*way.T)
        less = end_noise(self.tol)
        share = np.minimum(less / np.maximum(length, 1e-300), 1.0 / 3.0)[:, None]  # of a speck, the middle is left
        return np.concatenate((walls[:, :2] + share * way, walls[:, 2:] - share * way), axis=1)

    def _plan(self, pose: np.ndarray) -> None:
        """Nodes, gains and paths in the current graph."""
        g, x, y = self.graph, float(pose[0]), float(pose[1])
        if self._touched:
            g.add_way_point(x, y)
        if self.robot >= 0:
            g.remove_leaves(np.array([self.robot]))
        at = float(self._halt[0]), float(self._halt[1])
        self._start = self._way_out(*at)
        if at != (x, y):
            self._start.insert(0, (x, y))
        self.robot = int(g.add_leaves(np.array(self._start[-1:]), np.array([-2]))[0])
        on_trail = g.trail_at(*self._start[-1])
        if len(on_trail):
            g.join_trail(self.robot, on_trail)
        c = self.chains
        reach = self.tol.max_range
        local = np.all((c.middle >= self._box[:2] - reach) & (c.middle <= self._box[2:] + reach), axis=1)
        self._place(np.flatnonzero(local))
        self._update_paths()
        if c.size and not self.reachable.any() and self._trail:
            way = _resampled(np.concatenate(self._trail), self.tol.trail_step, self.tol.still)
            g.add_trail(way[-_LONGEST_TRAIL:], self.robot)
            self._update_paths()
            local[:] = True
        self._place_within(np.flatnonzero(local & ~self.reachable), last=not self.reachable.any())
        if not self.reachable.any():
            # What is left lies behind slivers of the unknown: look at it across them.
            self._place_within(np.arange(c.size), through_unknown=True, last=True)
        nodes.gains(np.flatnonzero(local), c, g.walls, g.pieces, self.config.gain == "visible", self.tol, c.gain)
        g.recycle()

    def _look_again(self) -> bool:
        """Before all ends: what was given up gets one more visit, on the map as it is now. Whether there is any."""
        p, most = self.pieces, VISIT * self.config.max_visits
        again = ~p.settled & ~p.retried & (p.visits >= most)
        if not again.any():
            return False
        p = p._replace(visits=np.where(again, most - VISIT, p.visits), retried=p.retried | again)
        everything, none = np.ones(len(p.kind), np.bool_), np.zeros(0, np.int64)
        self._take_over(*jump_edges.rechain(
            p, everything, none, Pieces.none(), Pieces.none(), self._walls, most, self._next_id, self.tol
        ))  # fmt: skip
        return self.chains.size > 0

    def remains(self) -> Remains:
        """The jump edges that are left: out of reach, and given up."""
        c, p = self.chains, self.pieces
        out = ~self.reachable
        given_up = np.flatnonzero(~p.settled & (p.visits >= VISIT * self.config.max_visits))
        order, offsets = jump_edges.link(p.segments[given_up], p.sigma[given_up], self._walls, self.tol)
        rows = given_up[order]
        lost = jump_edges.summarise(
            p.segments[rows], p.kind[rows], p.visits[rows], np.arange(len(rows)), offsets, self._walls, 0, self.tol
        )
        wide = np.minimum(lost.width, lost.room) >= self.least_width
        return Remains(int(out.sum()), float(c.length[out].sum()), int(wide.sum()), float(lost.length[wide].sum()))

    def _way_out(self, x: float, y: float) -> list[tuple[float, float]]:
        """The first way points: the place itself or, in contact with a wall, on to where paths begin.

        That is a place near by or, in a passage as wide as the robot, back on the way that it came, past earlier bumps
        in the same passage but not round and round between them. Where the graph has that way already paths begin at
        once: back first and then forward again the robot would never get through while it decides on the way.
        """
        rx, ry, found = self.graph.retreat(x, y)
        if found:
            return [(x, y)] if (rx, ry) == (x, y) else [(x, y), (rx, ry)]
        if len(self.graph.trail_at(x, y)):
            return [(x, y)]
        last, length = [], 0
        for way in reversed(self._trail):
            last.append(way[::-1])
            length += len(way)
            if length >= _LONGEST_WAY:
                break
        back = np.concatenate([np.array([[x, y]]), *last])[: _LONGEST_WAY + 1]
        return [(px, py) for px, py in way_back(back, self.graph.walls, self.tol).tolist()]

    def _update_paths(self) -> None:
        g, c = self.graph, self.chains
        g.connect()
        rows = np.flatnonzero(c.vertex >= 0)
        g.set_sources(np.array([self.robot]))
        out = sum(math.dist(a, b) for a, b in itertools.pairwise(self._start))
        c.path_length[:] = math.inf
        c.path_length[rows] = g.distances(self.robot, c.vertex[rows]) + out

    def _place(self, which: np.ndarray) -> None:
        """Put the nodes of jump edges at their configured places, if the disc can stand there."""
        g = self.graph
        node, outcome = nodes.place(which, self.chains, self._front, g.walls, g.pieces, self.tol)
        self._drop_nodes(which[outcome > 0])
        self._set_nodes(which[outcome == 2], node[outcome == 2])

    def _place_within(self, which: np.ndarray, through_unknown: bool = False, last: bool = False) -> None:
        """Put nodes at the reachable places nearest to their jump edges that see them; without any they stay masked."""
        if not len(which):
            return
        g, c = self.graph, self.chains
        seen = np.isfinite(g.distances(self.robot, np.arange(g.n_vertices)))
        looks, half_view = self._looks[: self.n_looks], 0.5 * self.sensor.field_of_view
        node, found = np.zeros((len(which), 3)), np.zeros(len(which), np.bool_)
        here = g.vertices.position[self.robot]
        order = np.argsort(np.hypot(*(c.middle[which] - here).T), kind="stable")
        # On a map in shreds there may be thousands: the nearest will do, and when nothing else is left, a few.
        for tried, (k, i) in enumerate(zip(order, which[order], strict=True)):
            if (tried == _MOST_TRIED and not last) or (last and np.count_nonzero(found) == _ENOUGH):
                break
            *node[k], found[k] = nodes.nearest_reachable(
                np.flatnonzero(self.pieces.owner == c.id[i]), i, c, g.vertices, seen, looks, half_view, g.walls,
                g.pieces, self.tol, through_unknown,
            )  # fmt: skip
        if found.any():
            self._drop_vertices(c.vertex[which[found]])
            self._set_nodes(which[found], node[found])
            self._update_paths()

    def _set_nodes(self, which: np.ndarray, node: np.ndarray) -> None:
        c = self.chains
        c.node[which] = node
        c.vertex[which] = self.graph.add_leaves(node[:, :2], c.id[which])

    @property
    def reachable(self) -> np.ndarray:
        """Which nodes (c,) the robot can go to."""
        return np.isfinite(self.chains.path_length)

    def path_to(self, i: int) -> np.ndarray:
        """Way points (k, 2) of the shortest path from the robot to node i."""
        way = self.graph.path(self.robot, int(self.chains.vertex[i]))[::-1]
        return np.concatenate((np.array(self._start[:-1]).reshape(-1, 2), way))

    def blocked(self, path: np.ndarray, walls: np.ndarray, alive: np.ndarray, lone: np.ndarray | None = None) -> bool:
        """Whether walls that came since the last `plan` leave the disc no room on a path (k, 2)."""
        if not self._touched:
            return False
        if self.graph is self._tight:
            walls, alive = self._certain(walls, alive, lone)
        rows = np.concatenate(self._touched)
        return bool(_too_near(path, walls[rows[alive[rows]]], self.tol.radius))

    def path_lengths(self, rows: np.ndarray) -> np.ndarray:
        """Path lengths (k, k) between the nodes `rows`, m; inf where there is no path."""
        vertices = self.chains.vertex[rows]
        result = np.full((len(rows), len(rows)), math.inf)
        standing = np.flatnonzero(vertices >= 0)
        result[standing[:, None], standing] = self.graph.between(
            vertices[standing], self.chains.path_length[rows[standing]], self.robot
        )
        return result
