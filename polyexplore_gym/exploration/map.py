"""The exploration map: what has been seen, where it is open, and how to get there.

Sees scans, pose estimates and fitted walls; never the floor plan.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from polyexplore_gym.config import ExplorationConfig, SensorConfig
from polyexplore_gym.exploration import jump_edges, nodes, scan_polygon
from polyexplore_gym.exploration.corners import Known
from polyexplore_gym.exploration.path_graph import PathGraph
from polyexplore_gym.scan import Scan

_PIECE = 2.0
"""Open edges are cut into pieces of at most this length, m."""
_SLACK = 0.3
"""Paths may cross an open edge this near (m) to the node or robot at their end."""
_TRAIL_STEP = 0.3
"""Spacing of the way points on a way driven, m."""
_BACK = 1.0
"""In contact with walls on both sides the robot goes back so far (m) at most before paths begin."""
_SAME_PLACE = 0.001
"""Points of the way driven this near (m) are one place."""
_AT_NODE = 0.75
"""A jump edge counts as measured from its node only within this distance (m) of where that should be."""
_ON_EDGE = 0.4
_AHEAD = 0.5
"""And, farther than this (m) from its middle, only with this cosine or more to its normal."""
_SPARE = 0.05
"""Paths round corners keep this much more than the robot's radius, m."""


@njit(cache=True)
def _near(segments, alive, x, y, reach):
    """Living segments whose bounding box comes within `reach` of a point (in the maximum norm)."""
    n = segments.shape[0]
    rows = np.empty(n, np.int64)
    count = 0
    for i in range(n):
        if (
            alive[i]
            and min(segments[i, 0], segments[i, 2]) <= x + reach
            and max(segments[i, 0], segments[i, 2]) >= x - reach
            and min(segments[i, 1], segments[i, 3]) <= y + reach
            and max(segments[i, 1], segments[i, 3]) >= y - reach
        ):
            rows[count] = i
            count += 1
    return rows[:count].copy()


def _resampled(way: np.ndarray) -> np.ndarray:
    """Points (k, 2) of a way every `_TRAIL_STEP` m, and the last: the same ones again when the way has grown."""
    run = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))))
    at = np.append(np.arange(0.0, run[-1], _TRAIL_STEP), run[-1])
    return np.stack((np.interp(at, run, way[:, 0]), np.interp(at, run, way[:, 1])), axis=1)


@dataclass(slots=True)
class Chains:
    """The jump edges, one row each; `node` and what follows describe the node in front of it."""

    id: np.ndarray
    """(c,) identity: kept as long as the jump edge does not change."""
    length: np.ndarray
    """(c,) l_n, m."""
    middle: np.ndarray
    """(c, 2) point at half the length."""
    normal: np.ndarray
    """(c, 2) unit vector into the unknown."""
    ends: np.ndarray
    """(c, 4) its end points."""
    kind: np.ndarray
    """(c,) `scan_polygon` label of most of it."""
    visits: np.ndarray
    """(c,) measurements made for it in vain, and attempts that ended before its node, which count half."""
    node: np.ndarray
    """(c, 3) position and heading of the node."""
    vertex: np.ndarray
    """(c,) vertex in the path graph, -1 where the robot can stand nowhere for it."""
    gain: np.ndarray
    """(c,) g_n, rad."""
    path_length: np.ndarray
    """(c,) c_n from the robot, m; inf where there is no path."""

    @classmethod
    def none(cls) -> Chains:
        """An empty table."""
        z = np.zeros(0)
        i = np.zeros(0, np.int64)
        return cls(i, z, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 4)), i.astype(np.int8), i,
                   np.zeros((0, 3)), i, z, z)  # fmt: skip

    def __len__(self) -> int:
        return len(self.id)

    def take(self, rows: np.ndarray) -> Chains:
        """The table of some rows."""
        return Chains(*(getattr(self, name)[rows] for name in self.__slots__))

    def join(self, other: Chains) -> Chains:
        """Both tables, one below the other."""
        return Chains(*(np.concatenate((getattr(self, n), getattr(other, n))) for n in self.__slots__))


class ExplorationMap:
    """Owner of the exploration's state: scan polygons, open edges, jump edges, nodes and paths.

    `insert` takes a scan, `plan` then brings nodes and paths up to date for a robot at a pose.
    """

    def __init__(self, config: ExplorationConfig, sensor: SensorConfig, radius: float) -> None:
        """`radius` of the robot's disc, m."""
        self.config = config
        self.sensor = sensor
        self.min_gap = 2.0 * radius if config.min_gap is None else config.min_gap
        noise = math.hypot(sensor.sigma_range, 0.5 * sensor.sigma_angle * sensor.max_range)
        self.nudge = 0.03 + 2.0 * noise
        self.cover = 0.04 + 3.0 * sensor.sigma_range
        self.join = 0.05 + 2.0 * noise
        self.full = sensor.full_circle
        n = sensor.beams
        self.n_scans = 0
        self.apexes = np.zeros((16, 2))
        self.headings = np.zeros(16)
        self.points = np.zeros((16, n, 2))
        self.rays = np.zeros((16, n, 2))
        self.labels: list[np.ndarray] = []
        self.angles = np.zeros(n)
        self.pieces = np.zeros((0, 4))
        self.kinds = np.zeros(0, np.int8)
        self.visits = np.zeros(0, np.int64)  # in halves: an attempt that ends before the node counts half
        self.done = np.zeros(0, np.bool_)
        self.owner = np.zeros(0, np.int64)
        self.chains = Chains.none()
        self.graph = PathGraph(radius, _SPARE, 0.012, _SLACK)
        self.robot = -1
        self._start: list[tuple[float, float]] = []
        self._next_id = 0
        self._trail: list[np.ndarray] = []
        self._touched: list[np.ndarray] = []
        self._box = np.array([math.inf, math.inf, -math.inf, -math.inf])

    # Scans -----------------------------------------------------------------------------------

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
        s = self._store(scan, ranges)
        x, y = float(scan.pose[0]), float(scan.pose[1])
        reach = self.sensor.max_range + 0.1
        self._touched.append(touched)
        self._box = np.array([
            min(self._box[0], x - reach), min(self._box[1], y - reach),
            max(self._box[2], x + reach), max(self._box[3], y + reach),
        ])  # fmt: skip
        near_walls = walls[_near(walls, alive, x, y, reach)]
        labels = scan_polygon.label_edges(
            scan.angles, ranges, point_segment, self.sensor.max_range, self.sensor.sigma_range,
            self.sensor.sigma_angle, self.min_gap, self.full,
        )  # fmt: skip
        self.labels.append(labels)
        fresh, fresh_kinds = scan_polygon.open_edges(self.points[s], labels, self.sensor.max_range, _PIECE, self.full)
        fresh += np.array([x, y, x, y])
        fresh, origin, _ = self._clip(fresh, 0, s, near_walls)
        fresh_kinds = fresh_kinds[origin]

        local = _near(self.pieces, np.ones(len(self.pieces), np.bool_), x, y, reach)
        kept, origin, changed = self._clip(self.pieces[local], s, s + 1, near_walls)
        fresh, again = jump_edges.clip_known(fresh, kept, self.nudge, 0.02)
        fresh_kinds = fresh_kinds[again]
        dirty = np.zeros(len(self.pieces), np.bool_)
        dirty[local[changed]] = True
        if target is not None:
            mine = self.owner == target
            arrived = arrived and self._measured(target, x, y)
            self.visits[mine] += 2 if arrived else 1
            dirty |= mine
        self._rechain(local, kept, origin, dirty, fresh, fresh_kinds, s, target if arrived else None)
        if target is not None:
            self._drop_nodes(np.flatnonzero(self.chains.id == target))  # the same place again would show no more

    def _measured(self, target: int, x: float, y: float) -> bool:
        """Whether a scan from (x, y) measures a jump edge; a look from afar or from the side is an attempt only."""
        row = np.flatnonzero(self.chains.id == target)
        if not len(row):
            return True
        dx, dy = self.chains.middle[row[0]] - (x, y)
        distance = math.hypot(dx, dy)
        ahead = dx * self.chains.normal[row[0], 0] + dy * self.chains.normal[row[0], 1]
        front = self.config.front_distance if self.config.placement == "in_front" else 0.0
        return distance <= front + _AT_NODE and (distance <= _ON_EDGE or ahead >= _AHEAD * distance)

    def _store(self, scan: Scan, ranges: np.ndarray) -> int:
        s = self.n_scans
        if s == len(self.headings):
            self.apexes = np.concatenate((self.apexes, np.zeros_like(self.apexes)))
            self.headings = np.concatenate((self.headings, np.zeros_like(self.headings)))
            self.points = np.concatenate((self.points, np.zeros_like(self.points)))
            self.rays = np.concatenate((self.rays, np.zeros_like(self.rays)))
        self.apexes[s] = scan.pose[:2]
        self.headings[s] = scan.pose[2]
        self.angles = scan.angles
        self.points[s], self.rays[s] = scan_polygon.corner_points(
            scan.angles, ranges, float(scan.pose[2]), self.sensor.max_range
        )
        self.n_scans += 1
        return s

    def _clip(
        self, pieces: np.ndarray, first: int, last: int, walls: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return jump_edges.clip(
            pieces, self.apexes, self.headings, self.points, self.rays, first, last, self.angles, self.full,
            self.sensor.max_range + 0.2, self.nudge, walls, self.cover, 0.02,
        )  # fmt: skip

    def _rechain(
        self,
        local: np.ndarray,
        kept: np.ndarray,
        origin: np.ndarray,
        dirty: np.ndarray,
        fresh: np.ndarray,
        fresh_kinds: np.ndarray,
        scan: int,
        measured: int | None,
    ) -> None:
        """Put what is left of the local pieces and the fresh ones in their place; make new chains where needed."""
        finished = np.zeros(len(kept), np.bool_)
        if measured is not None:
            finished = jump_edges.looked_at(
                kept, self.apexes[scan], self.headings[scan], self.points[scan], self.angles, self.full, self.nudge
            ) & (self.owner[local[origin]] == measured)
        self.pieces, self.kinds, self.visits, self.done, self.owner, ids, data, ends, kind, visits = (
            jump_edges.rechain(
                self.pieces, self.kinds, self.visits, self.done, self.owner, dirty, local, kept, origin, fresh,
                fresh_kinds, finished, 2 * self.config.max_visits, self.join, self.min_gap, self.sensor.max_range,
                self._next_id,
            )
        )  # fmt: skip
        alive = np.zeros(self._next_id + len(ids) + 1, np.bool_)
        self._next_id += len(ids)
        alive[self.owner] = True  # the last one stands for pieces without a chain
        c = self.chains
        staying = alive[c.id]
        long_enough = np.flatnonzero(data[:, 0] >= self.min_gap)
        gone = np.flatnonzero(~staying)
        again = jump_edges.unchanged(data[long_enough], ends[long_enough], gone, c.middle, c.ends)
        for q, row in zip(long_enough, again, strict=True):
            if row >= 0:
                self.owner[self.owner == ids[q]] = c.id[row]
                c.visits[row], c.kind[row] = (visits[q] + 1) // 2, kind[q]
                staying[row] = True
        self._drop_vertices(c.vertex[~staying])
        new = long_enough[again < 0]
        m = len(new)
        added = Chains(
            ids[new], data[new, 0], data[new, 1:3], data[new, 3:5], ends[new], kind[new], (visits[new] + 1) // 2,
            np.zeros((m, 3)), np.full(m, -1, np.int64), np.zeros(m), np.full(m, math.inf),
        )  # fmt: skip
        self.chains = c.take(np.flatnonzero(staying)).join(added)

    def _drop_nodes(self, which: np.ndarray) -> None:
        self._drop_vertices(self.chains.vertex[which])
        self.chains.vertex[which] = -1

    def _drop_vertices(self, vertices: np.ndarray) -> None:
        vertices = vertices[vertices >= 0]
        if len(vertices):
            self.graph.remove_leaves(vertices)

    def bump(self, pose: np.ndarray, bearing: float) -> None:
        """Remember an obstacle felt at `bearing` (rad, map frame) on the robot's rim at `pose` (3,): plan around it."""
        c, s = math.cos(bearing), math.sin(bearing)
        x, y = pose[0] + self.graph.radius * c, pose[1] + self.graph.radius * s
        self.graph.add_felt(np.array([x + 0.01 * s, y - 0.01 * c, x - 0.01 * s, y + 0.01 * c]))

    # Nodes and paths -------------------------------------------------------------------------

    def plan(self, pose: np.ndarray, walls: np.ndarray, alive: np.ndarray, came: np.ndarray | None = None) -> None:
        """Bring nodes, gains and shortest paths up to date for a robot at the estimated `pose` (3,).

        `came` (k, 2) is the way that it came, the way back out of a tight place.
        """
        g, c = self.graph, self.chains
        if self._touched:
            g.set_walls(walls, alive, np.unique(np.concatenate(self._touched)), self._known(), self._box)
            g.set_pieces(self.pieces, self.owner, self._box)
            g.add_way_point(float(pose[0]), float(pose[1]))
        if self.robot >= 0:
            g.remove_leaves(np.array([self.robot]))
        if came is not None:
            self._trail.append(came)
        self._start = self._way_out(float(pose[0]), float(pose[1]))
        self.robot = int(g.add_leaves(np.array(self._start[-1:]), np.array([-2]))[0])
        reach = self.sensor.max_range
        local = np.all((c.middle >= self._box[:2] - reach) & (c.middle <= self._box[2:] + reach), axis=1)
        self._place(np.flatnonzero(local))
        self._update_paths()
        if len(c) and not np.isfinite(c.path_length).any() and self._trail:
            g.add_trail(_resampled(np.concatenate(self._trail)), self.robot)
            self._update_paths()
            local[:] = True
        self._place_within(np.flatnonzero(local & ~np.isfinite(c.path_length)))
        if not np.isfinite(c.path_length).any():
            # What is left lies behind slivers of the unknown: look at it across them.
            self._place_within(np.arange(len(c)), through_unknown=True)
        nodes.gains(
            np.flatnonzero(local), c.node, c.vertex, c.middle, c.ends, c.id, self.sensor.max_range, g.walls,
            *g.wall_grid, g.pieces, *g.piece_grid, g.piece_owner, c.gain,
        )  # fmt: skip
        g.recycle()
        self._touched = []
        self._box = np.array([math.inf, math.inf, -math.inf, -math.inf])

    def _known(self) -> Known:
        n = self.n_scans
        return Known(self.apexes[:n], self.headings[:n], self.points[:n], self.angles, self.full, self.sensor.max_range)

    def _way_out(self, x: float, y: float) -> list[tuple[float, float]]:
        """The first way points: the place itself or, in contact with a wall, on to where paths begin.

        That is a place near by or, in a passage as wide as the robot, back on the way that it came, past earlier bumps
        in the same passage but not round and round between them.
        """
        rx, ry, found = self.graph.retreat(x, y)
        if found:
            return [(x, y)] if (rx, ry) == (x, y) else [(x, y), (rx, ry)]
        points, driven = [(x, y)], [0.0]
        for px, py in itertools.chain.from_iterable(way[::-1].tolist() for way in reversed(self._trail)):
            been = [math.dist((px, py), p) < _SAME_PLACE for p in points]
            if any(been):
                first = been.index(True)
                del points[first + 1 :], driven[first + 1 :]
                continue
            driven.append(driven[-1] + math.dist((px, py), points[-1]))
            points.append((px, py))
            if self.graph.clearance(px, py) >= self.graph.need or driven[-1] > _BACK:
                break
        return points

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
        g, c, config = self.graph, self.chains, self.config
        front = config.front_distance if config.placement == "in_front" else 0.0
        node, outcome = nodes.place(
            which, c.node, c.vertex, c.middle, c.normal, c.length, c.id, front,
            config.samples * self.sensor.resolution, g.walls, *g.wall_grid, g.pieces, *g.piece_grid, g.piece_owner,
            g.need,
        )  # fmt: skip
        self._drop_nodes(which[outcome > 0])
        self._set_nodes(which[outcome == 2], node[outcome == 2])

    def _place_within(self, which: np.ndarray, through_unknown: bool = False) -> None:
        """Put nodes at the reachable places nearest to their jump edges that see them; without any they stay masked."""
        if not len(which):
            return
        g, c = self.graph, self.chains
        seen, known = np.isfinite(g.distances(self.robot, np.arange(len(g.kind)))), self._known()
        node, found = np.zeros((len(which), 3)), np.zeros(len(which), np.bool_)
        for k, i in enumerate(which):
            *node[k], found[k] = nodes.nearest_reachable(
                np.flatnonzero(self.owner == c.id[i]), *c.middle[i], *c.normal[i], c.id[i], g.position, g.kind, seen,
                known, g.walls, *g.wall_grid, g.pieces, *g.piece_grid, g.piece_owner, g.need, _SLACK, through_unknown,
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

    def path_lengths(self, rows: np.ndarray) -> np.ndarray:
        """Path lengths (k, k) between the nodes `rows`, m; inf where there is no path."""
        vertices = self.chains.vertex[rows]
        result = np.full((len(rows), len(rows)), math.inf)
        standing = np.flatnonzero(vertices >= 0)
        result[standing[:, None], standing] = self.graph.between(
            vertices[standing], self.chains.path_length[rows[standing]], self.robot
        )
        return result
