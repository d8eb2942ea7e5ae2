"""The outline of what was seen, as one valid polygon made of the map's lines: `trace`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
import shapely

from polyexplore_gym.config import SensorConfig
from polyexplore_gym.errors import InvalidFloorPlanError
from polyexplore_gym.mapping import Walls
from polyexplore_gym.outline.polygon import corners, crossings, straightened
from polyexplore_gym.outline.sides import Side, labels, reduced, sides_of
from polyexplore_gym.outline.views import CLEARANCE, Views, seen

TOLERANCE = 0.03
"""Greatest deviation of what was measured from a side that stands for it, m."""
DOOR = 0.5
"""Nobody goes through what is narrower, m: what nobody saw is closed there by the walls on both sides."""
LEAST_HOLE = 0.03
"""Holes narrower than this (twice the area over the perimeter), m, are noise; and holes without any return on their
boundary are no obstacles unless a disc of a door's width fits into them."""
STEP = 0.05
"""Known and unknown boundary are told apart every so many metres."""
NEAR = 0.1
"""Boundary is known where a wall or a return lies so near, m."""


class Outline(NamedTuple):
    """What was seen, closed."""

    exterior: np.ndarray
    """(n, 2) counter-clockwise, m"""
    holes: tuple[np.ndarray, ...]
    """clockwise, (k, 2) each"""
    unknown: np.ndarray
    """(U, 4) stretches x1, y1, x2, y2 of the boundary, m, where no wall was seen: beyond them the plan may go on"""
    perimeter: float
    """of all rings, m"""
    left_out: float
    """area that was seen but is not connected to the rest, m2"""

    @property
    def unknown_length(self) -> float:
        """Length of the unknown boundary, m."""
        return float(np.hypot(*(self.unknown[:, 2:] - self.unknown[:, :2]).T).sum())

    @property
    def unknown_share(self) -> float:
        """Share of the unknown boundary in all, 0 to 1."""
        return self.unknown_length / self.perimeter


def trace(
    views: Views,
    walls: Walls,
    sensor: SensorConfig,
    *,
    door: float = DOOR,
    tolerance: float = TOLERANCE,
    track: Callable[[Iterable[int], str], Iterable[int]] = lambda scans, what: scans,
) -> Outline:
    """The outline of what scans saw: of the part in which most of them were made.

    The union of the scans' polygons, whose beams end on the walls of the map, says what is joined with what. Its
    boundary is cut into sides, each on a line of the map or, elsewhere, along the returns; sides that nothing speaks
    for go, and neighbours meet where their lines do. Where such sides would cross, that of which less was measured
    follows the boundary instead, so that the polygon is valid. What nobody saw is closed by straight sides and told of.

    Args:
        views, walls: what was seen, and the walls that are left when all beams have been held against them.
        sensor: its noise.
        door: width of a door, m, such as the robot's diameter: what is narrower is no passage.
        tolerance: greatest deviation of what was measured from a side that stands for it, m.
        track: wraps the scans, to show progress.

    Raises:
        InvalidFloorPlanError: nothing was seen.
    """
    area, loose = seen(views, walls, sensor, track)
    parts = [part for part in shapely.get_parts(area) if part.geom_type == "Polygon" and part.area > 0.0]
    if not parts:
        raise InvalidFloorPlanError("no floor plan: the scans saw no area")
    places = shapely.points(views.apexes)
    part = max(parts, key=lambda p: (int(shapely.intersects(p, places).sum()), p.area))
    wall_tree = _tree(walls.segments.reshape(-1, 2, 2), shapely.linestrings)
    loose_tree = _tree(loose, shapely.points)
    trees = [tree for tree in (wall_tree, loose_tree) if tree is not None]
    wide = [p for p in shapely.get_parts(part.difference(_glimpses(part, trees, door))) if p.area > 0.0]
    part = max(wide or [part], key=lambda p: (int(shapely.intersects(p, places).sum()), p.area))
    left_out = max(sum(p.area for p in parts) - part.area, 0.0)
    holes = [ring for ring in map(shapely.Polygon, part.interiors) if _obstacle(ring, trees, door)]
    rings = [shapely.get_coordinates(ring.exterior)[:-1] for ring in (shapely.Polygon(part.exterior), *holes)]
    rings = [ring if (_area(ring) > 0) == (k == 0) else ring[::-1] for k, ring in enumerate(rings)]
    sides = [
        reduced(sides_of(ring, labels(ring, walls, wall_tree), walls, loose_tree, tolerance), ring, tolerance, door)
        for ring in rings
    ]
    done = _polygon(rings, sides, door)
    return Outline(done[0], tuple(done[1:]), _unknown(done, trees), _length(done), left_out)


def _glimpses(area: shapely.Polygon, trees: list[Any], door: float) -> Any:
    """Parts of the area, narrower than a door, whose borders were not measured: what was seen through slits."""
    wide = area.buffer(-0.5 * door).buffer(0.5 * door + 1e-3)
    shapely.prepare(wide)
    out = []
    for part in shapely.get_parts(area.difference(wide)):
        if part.geom_type != "Polygon" or part.length < 2.0 * door:
            continue
        points = shapely.points(shapely.get_coordinates(part.exterior.segmentize(STEP))[:-1])
        border = points[~shapely.dwithin(wide, points, NEAR)]
        if _open(border, trees).sum() > 0.5 * max(len(border), door / STEP):
            out.append(part.buffer(1e-3))
    return shapely.union_all(out)


def _open(points: np.ndarray, trees: list[Any]) -> np.ndarray:
    """(n,) of points, those to which nothing that was measured lies near."""
    out = np.ones(len(points), np.bool_)
    for tree in trees:
        out[tree.query(points, predicate="dwithin", distance=NEAR)[0]] = False
    return out


def _obstacle(hole: shapely.Polygon, trees: list[Any], door: float) -> bool:
    """Whether a hole in what was seen is more than noise, or floor in the shadow of things that no scan looked into."""
    if 2.0 * hole.area <= LEAST_HOLE * hole.length:
        return False
    measured = any(len(tree.query(hole.exterior, predicate="dwithin", distance=CLEARANCE)) for tree in trees)
    return measured or not hole.buffer(-0.5 * door).is_empty


def _area(ring: np.ndarray) -> float:
    after = np.roll(ring - ring[0], -1, axis=0)
    return 0.5 * float(((ring - ring[0])[:, 0] * after[:, 1] - after[:, 0] * (ring - ring[0])[:, 1]).sum())


def _tree(points: np.ndarray, shape: Any) -> Any:
    return shapely.STRtree(shape(points)) if len(points) else None


def _polygon(rings: list[np.ndarray], sides: list[list[Side]], door: float) -> list[np.ndarray]:
    """Rings of a valid polygon: where sides cross, the boundary as it was seen takes their place."""
    exact: set[int] = set()
    while True:
        made, owners = [], []
        for k, (ring, some) in enumerate(zip(rings, sides, strict=True)):
            points, owner = corners(some, ring, door)
            points, owner = (points, owner) if k in exact else straightened(points, owner)
            made.append(points)
            owners.append(owner)
        bad = _faults(made)
        if not bad:
            return made
        again, blamed = False, set()
        for edges in bad:
            blamed |= {k for k, _ in edges}
            again |= _give_way(edges, sides, owners, rings)
        if not again:
            if not blamed <= exact:
                exact |= blamed
            elif shapely.Polygon(made[0], made[1:]).is_valid:  # rings that touch in a point
                return made
            else:
                raise InvalidFloorPlanError("no floor plan: what was seen has no valid outline")


def _give_way(
    edges: tuple[tuple[int, int], ...], sides: list[list[Side]], owners: list[np.ndarray], rings: list[np.ndarray]
) -> bool:
    """Let the side of which least was measured be as it was seen, of those to which some edges belong that do not go
    together; edge -1: all sides of a ring. Whether that changes anything."""
    some: list[tuple[int, int]] = []
    for k, edge in edges:
        if edge < 0:
            changed = [_as_seen(sides[k], i, len(rings[k])) for i in range(len(sides[k]))]
            return any(changed)
        owner = int(owners[k][edge])
        some += [(k, i) for i in ([owner] if owner >= 0 else _beside(owners[k], edge))]
    some.sort(key=lambda at: (sides[at[0]][at[1]].line >= 0, sides[at[0]][at[1]].support))
    return any(_as_seen(sides[k], i, len(rings[k])) for k, i in some)


def _beside(owner: np.ndarray, edge: int) -> list[int]:
    """The sides before and after a step between two."""
    n = len(owner)
    return [int(owner[(edge + k) % n]) for k in (-1, 1) if owner[(edge + k) % n] >= 0]


def _as_seen(sides: list[Side], i: int, n: int) -> bool:
    """Let a side be the boundary as it was seen, on to the next side; whether that changes anything."""
    side = sides[i]
    if side.held == 2:
        return False
    side.held += 1
    after = sides[(i + 1) % len(sides)]
    side.stop = side.start + ((after.start - side.start) % n or n)
    return True


def _faults(rings: list[np.ndarray]) -> list[tuple[tuple[int, int], ...]]:
    """What makes a polygon invalid: edges that do not go together, each by its ring and number; -1: all of a ring."""
    whole = [((k, -1),) for k, ring in enumerate(rings) if len(ring) < 3 or (_area(ring) > 0) != (k == 0)]
    if whole:
        return list(whole)
    bad = crossings(rings)
    if bad:
        return list(bad)
    outer = shapely.Polygon(rings[0])
    whole = [((k, -1),) for k, ring in enumerate(rings) if k and not outer.covers(shapely.Polygon(ring))]
    if not whole and not shapely.Polygon(rings[0], rings[1:]).is_valid:
        whole = [((k, -1),) for k, ring in enumerate(rings) if not shapely.Polygon(ring).is_valid]
        whole = whole or [((k, -1),) for k in range(len(rings))]
    return list(whole)


def _length(rings: list[np.ndarray]) -> float:
    return float(sum(np.hypot(*(np.roll(ring, -1, axis=0) - ring).T).sum() for ring in rings))


def _unknown(rings: list[np.ndarray], trees: list[Any]) -> np.ndarray:
    """(U, 4) stretches of the rings, m, longer than two steps, to which nothing that was measured lies near."""
    out = []
    for ring in rings:
        for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            length = math.hypot(*(b - a))
            n = max(math.ceil(length / STEP), 1)
            points = shapely.points(a + (np.arange(n)[:, None] + 0.5) / n * (b - a))
            edges = np.flatnonzero(np.diff(_open(points, trees).astype(int), prepend=0, append=0)).reshape(-1, 2) / n
            out += [[*(a + s * (b - a)), *(a + t * (b - a))] for s, t in edges if (t - s) * length > 2 * STEP]
    return np.array(out).reshape(-1, 4)
