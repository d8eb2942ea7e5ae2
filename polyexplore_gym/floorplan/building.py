"""What the generators share: rooms as boxes between wall axes, doors in the walls, and the finished plan.

Lengths are whole millimetres, so that unions of axis-parallel boxes are exact and the same on every
platform; the plan is in metres.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from polyexplore_gym.errors import InvalidFloorPlanError
from polyexplore_gym.floorplan.model import FloorPlan

CLEAR_RADIUS = 300
"""A generated plan stays connected for a disc of this radius, mm (the robot's 250 and a little)."""
DOOR_WIDTHS = (800, 1600)
"""Narrowest and widest door, mm."""

Box = tuple[int, int, int, int]
"""x0, y0, x1, y1, mm."""


@dataclass(slots=True)
class Cell:
    """A room or a piece of corridor: the box between the axes of its walls."""

    box: Box
    kind: str = "room"

    @property
    def width(self) -> int:
        """Extent in x, mm."""
        return self.box[2] - self.box[0]

    @property
    def depth(self) -> int:
        """Extent in y, mm."""
        return self.box[3] - self.box[1]

    @property
    def area(self) -> float:
        """m2."""
        return self.width * self.depth * 1e-6


@dataclass(slots=True, frozen=True)
class Wall:
    """The wall that cells `a` and `b` share: at `position` on one axis, from `low` to `high` on the other."""

    a: int
    b: int
    vertical: bool
    position: int
    low: int
    high: int

    @property
    def length(self) -> int:
        """mm."""
        return self.high - self.low


def shared_walls(cells: Sequence[Cell], shortest: int) -> list[Wall]:
    """Walls between neighbouring cells that are at least `shortest` mm long, in order of the cells."""
    boxes = np.array([c.box for c in cells], dtype=np.int64).reshape(-1, 4)
    low = np.maximum(boxes[:, None, :2], boxes[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], boxes[None, :, 2:])
    extent = high - low
    walls = []
    for axis in (0, 1):
        touching = (extent[:, :, axis] == 0) & (extent[:, :, 1 - axis] >= shortest)
        for a, b in zip(*np.nonzero(np.triu(touching, 1)), strict=True):
            span = int(low[a, b, 1 - axis]), int(high[a, b, 1 - axis])
            walls.append(Wall(int(a), int(b), axis == 0, int(low[a, b, axis]), *span))
    return sorted(walls, key=lambda w: (w.a, w.b, w.vertical))


def opening(wall: Wall, low: int, high: int, thickness: int) -> Box:
    """The box that opens a wall from `low` to `high` along it."""
    near, far = wall.position - thickness // 2, wall.position + thickness // 2
    return (near, low, far, high) if wall.vertical else (low, near, high, far)


def place_door(rng: np.random.Generator, wall: Wall, width: int, thickness: int, corner: float = 0.6) -> Box:
    """A door somewhere in a wall, near one of its ends with probability `corner`."""
    margin = thickness // 2 + 100
    low, high = wall.low + margin, wall.high - margin - width
    if high <= low:
        start = (wall.low + wall.high - width) // 2
    elif rng.random() < corner:
        start = low if rng.random() < 0.5 else high
    else:
        start = int(rng.integers(low, high + 1))
    return opening(wall, start, start + width, thickness)


def open_wall(wall: Wall, thickness: int) -> Box:
    """The opening that removes a shared wall between its crossings with other walls."""
    return opening(wall, wall.low + thickness // 2, wall.high - thickness // 2, thickness)


def inner_box(cell: Cell, thickness: int) -> Box:
    """The cell without its halves of the walls."""
    t = thickness // 2
    x0, y0, x1, y1 = cell.box
    return x0 + t, y0 + t, x1 - t, y1 - t


def spanning_walls(
    rng: np.random.Generator, cells: Sequence[Cell], walls: Sequence[Wall], hub: int, cost: Any
) -> list[Wall]:
    """Walls to pierce so that every cell that can be reached is: a tree grown from `hub`, cheapest first.

    `cost(a, b)` says how unusual a door from cell a, already reached, into cell b is; a random part
    below 1 is added.
    """
    noise = rng.random(len(walls))
    reached = {hub}
    tree: list[Wall] = []
    while True:
        best, choice = None, None
        for k, wall in enumerate(walls):
            if (wall.a in reached) == (wall.b in reached):
                continue
            a, b = (wall.a, wall.b) if wall.a in reached else (wall.b, wall.a)
            price = cost(cells[a], cells[b]) + noise[k]
            if best is None or price < best:
                best, choice = price, (wall, b)
        if choice is None:
            return tree
        tree.append(choice[0])
        reached.add(choice[1])


def union_of(boxes: Iterable[Box]) -> Any:
    """Union of boxes as a shapely geometry, mm."""
    array = np.array(list(boxes), dtype=np.float64).reshape(-1, 4)
    return shapely.union_all(shapely.box(*array.T))


def finish(free: Any, obstacles: Sequence[Any], name: str, meta: dict[str, Any]) -> FloorPlan | None:
    """The plan of a free space (mm) without the obstacles; None if it is not one for the robot.

    Obstacles that cut off a part of the free space are left out.
    """
    base = _single(shapely.set_precision(free, 1.0))
    if base is None or _pockets(base):
        return None
    obstacles = list(obstacles)
    polygon = base
    while obstacles:
        cleared = shapely.set_precision(base.difference(shapely.union_all(obstacles)), 1.0)
        single = _single(cleared)
        pockets = _pockets(cleared) if single is None else _pockets(single)
        if single is not None and not pockets:
            polygon = single
            break
        # What stands around a pocket goes; without a pocket (a sliver came loose), the last one.
        blocked = shapely.union_all(pockets).buffer(CLEAR_RADIUS + 50)
        kept = [item for item in obstacles if not item.intersects(blocked)]
        obstacles = kept if len(kept) < len(obstacles) else obstacles[:-1]
    rings = [_integer_ring(ring) for ring in (polygon.exterior, *polygon.interiors)]
    corner = rings[0].min(axis=0)
    # Canonical order, so that the arrays do not depend on the version of GEOS.
    rings = [_first_vertex_first((ring - corner + 1000) / 1000.0) for ring in rings]
    holes = sorted(rings[1:], key=lambda ring: tuple(ring[0]))
    try:
        return FloorPlan.create(rings[0], holes, name=name, meta=meta)
    except InvalidFloorPlanError:
        return None


def within(plan: FloorPlan | None, area: tuple[float, float], vertices: tuple[int, int]) -> FloorPlan | None:
    """The plan if its area (m2) and number of vertices lie in the ranges, else None."""
    if plan is None or not area[0] <= plan.area <= area[1] or not vertices[0] <= plan.n_vertices <= vertices[1]:
        return None
    return plan


def _single(geometry: Any) -> Any:
    """The geometry if it is one polygon."""
    return geometry if geometry.geom_type == "Polygon" and not geometry.is_empty else None


def _pockets(geometry: Any) -> list[Any]:
    """Parts of the disc's free space besides the largest; the whole if the disc fits nowhere."""
    parts = sorted(shapely.get_parts(geometry.buffer(-CLEAR_RADIUS, quad_segs=8)), key=lambda p: -p.area)
    if not parts or parts[0].is_empty:
        return [geometry]
    return parts[1:]


def _integer_ring(ring: Any) -> np.ndarray:
    """Ring (n, 2) of whole mm without vertices on straight walls."""
    points = np.rint(np.asarray(ring.coords)[:-1]).astype(np.int64)
    arriving = points - np.roll(points, 1, axis=0)
    leaving = np.roll(points, -1, axis=0) - points
    straight = arriving[:, 0] * leaving[:, 1] == arriving[:, 1] * leaving[:, 0]
    return points[~straight]


def _first_vertex_first(ring: np.ndarray) -> np.ndarray:
    return np.roll(ring, -int(np.lexsort((ring[:, 1], ring[:, 0]))[0]), axis=0)
