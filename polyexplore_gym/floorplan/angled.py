"""Procedural plans without a common right angle: rotated wings, slanted walls, polygonal halls, arcs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
import shapely.affinity

from polyexplore_gym.floorplan import offices
from polyexplore_gym.floorplan.building import Cell, finish, within
from polyexplore_gym.floorplan.model import FloorPlan

AREA_RANGE = (40.0, 2500.0)
"""Free area of an angled plan, m2."""
VERTEX_RANGE = (30, 900)
"""Vertices of an angled plan."""
_STEP = math.radians(6.0)
_SPACE = 750


def draw_angled(rng: np.random.Generator, name: str, meta: dict[str, Any]) -> FloorPlan | None:
    """One plan of a random style, or None if the draw failed."""
    style = str(rng.choice(["wings", "slanted", "arc"], p=[0.4, 0.4, 0.2]))
    drawn = {"wings": _wings, "slanted": _slanted, "arc": _arc}[style](rng)
    if drawn is None:
        return None
    free, obstacles = drawn
    if free.geom_type != "Polygon":
        return None
    obstacles = [*obstacles, *_standing(rng, free, obstacles)]
    turn = float(rng.uniform(0, 360))
    # Half a centimetre is less than any wall; it removes the slivers of nearly equal directions.
    free = shapely.simplify(_turned(free, turn), 5.0, preserve_topology=True)
    plan = finish(free, [_turned(item, turn) for item in obstacles], name, {**meta, "style": style})
    return within(plan, AREA_RANGE, VERTEX_RANGE)


def _turned(geometry: Any, degrees: float) -> Any:
    return shapely.affinity.rotate(geometry, degrees, origin=(0, 0))


def _point(radius: float, angle: float) -> tuple[float, float]:
    return radius * math.cos(angle), radius * math.sin(angle)


def _standing(rng: np.random.Generator, free: Any, obstacles: Sequence[Any]) -> list[Any]:
    """Columns and tables with a passage all round: rectangles at any angle and regular polygons."""
    x0, y0, x1, y1 = free.bounds
    room = free.difference(shapely.union_all(list(obstacles))) if obstacles else free
    items: list[Any] = []
    for _ in range(int(rng.integers(0, 4 + round(free.area * 1e-6 / 40)))):
        x, y = rng.uniform((x0, y0), (x1, y1))
        if rng.random() < 0.5:
            half = float(rng.integers(15, 35)) * 10
            count, phase = int(rng.integers(4, 9)), float(rng.uniform(0, math.pi))
            corners = [_point(half, phase + 2 * math.pi * k / count) for k in range(count)]
            item = shapely.Polygon(corners)
        else:
            width, depth = rng.integers(50, 180) * 10, rng.integers(50, 90) * 10
            item = _turned(shapely.box(-width / 2, -depth / 2, width / 2, depth / 2), float(rng.uniform(0, 90)))
        item = shapely.affinity.translate(item, x, y)
        if (
            room.contains(item)
            and room.boundary.distance(item) > _SPACE
            and all(item.distance(other) > _SPACE for other in items)
        ):
            items.append(item)
    return items


# Wings: bars with rooms on both sides of a corridor, around a polygonal hall.


def _wings(rng: np.random.Generator) -> tuple[Any, list[Any]] | None:
    count = int(rng.integers(2, 5))
    gaps = rng.dirichlet(np.full(count, 6.0)) * 2 * math.pi
    if gaps.min() < math.radians(40):
        return None
    thickness = 2 * int(rng.integers(60, 110))
    sides = int(rng.integers(5, 11))
    radius = float(rng.integers(350, 800)) * 10
    phase = float(rng.uniform(0, 2 * math.pi))
    hall = shapely.Polygon([_point(radius, phase + 2 * math.pi * k / sides) for k in range(sides)])
    parts, obstacles = [hall], []
    outlines: list[Any] = []
    for k, direction in enumerate(np.cumsum(gaps)):
        width = int(rng.integers(150, 240)) * 10
        up, down = int(rng.integers(320, 600)) * 10, int(rng.integers(320, 600)) * 10
        length = int(rng.integers(900, 2400)) * 10
        cells = [Cell((0, 0, length, width), "corridor")]
        for low, high in ((width, width + up), (-down, 0)):
            cells += [Cell((a, low, b, high)) for a, b in offices.room_row(rng, length, high - low)]
        built = offices.build(rng, cells, thickness)
        if built is None:
            return None
        wing, furniture = built
        # As near to the hall as the neighbouring wings allow.
        gap = min(gaps[k], gaps[(k + 1) % count], 0.8 * math.pi)
        offset = max(radius, (max(up, down) + width / 2) / math.tan(gap / 2)) + 2 * thickness
        link = shapely.box(0, thickness // 2, offset + thickness, width - thickness // 2)
        outline = shapely.box(
            offset - thickness, -down - thickness, offset + length + thickness, width + up + thickness
        )

        def placed(item: Any, shift: float, middle: float = width / 2, angle: float = float(direction)) -> Any:
            return _turned(shapely.affinity.translate(item, shift, -middle), math.degrees(angle))

        outline = placed(outline, 0)
        if any(outline.intersects(other) for other in [*outlines, hall]):
            return None
        outlines.append(outline)
        parts += [placed(wing, offset), placed(link, 0)]
        obstacles += [placed(item, offset) for item in furniture]
    return shapely.union_all(parts), obstacles


# Slanted: a convex outline cut again and again by slanted walls.


@dataclass(frozen=True, slots=True)
class _Region:
    """A convex room (n, 2), mm, counter-clockwise; `walls[k]` is the cut that edge k lies on, -1 outside."""

    points: np.ndarray
    walls: tuple[int, ...]

    @property
    def area(self) -> float:
        return shapely.Polygon(self.points).area


def _slanted(rng: np.random.Generator) -> tuple[Any, list[Any]] | None:
    area = float(np.clip(rng.lognormal(np.log(180), 0.7), 60, 900)) * 1e6
    outline = _outline(rng, area)
    thickness = 2.0 * int(rng.integers(50, 100))
    room_area = float(rng.uniform(9, 30) if area < 250e6 else rng.uniform(15, 40)) * 1e6
    axes: list[tuple[np.ndarray, np.ndarray]] = []
    # Most walls are parallel or perpendicular to one or two of the outer walls.
    edges = (np.roll(outline, -1, axis=0) - outline)[rng.permutation(len(outline))[: int(rng.integers(1, 3))]]
    edges /= np.hypot(edges[:, :1], edges[:, 1:])
    normals = np.concatenate([edges, np.stack([-edges[:, 1], edges[:, 0]], axis=1)])
    rooms = _cut(rng, _Region(outline, (-1,) * len(outline)), room_area, normals, axes)
    doors = _slanted_doors(rng, rooms, axes, thickness)
    if doors is None:
        return None
    inner = [shapely.Polygon(r.points).buffer(-thickness / 2, join_style="mitre") for r in rooms]
    return shapely.union_all([*inner, *doors]), []


def _outline(rng: np.random.Generator, area: float) -> np.ndarray:
    """A convex polygon of 4 to 8 corners on a stretched, jittered circle."""
    count = int(rng.integers(4, 8))
    angles = (np.arange(count) + rng.uniform(-0.22, 0.22, count)) * 2 * math.pi / count
    stretch = rng.uniform(1.0, 1.7)
    points = np.stack([np.cos(angles) * stretch, np.sin(angles)], axis=1)
    return points * math.sqrt(area / shapely.Polygon(points).area)


def _cut(
    rng: np.random.Generator,
    region: _Region,
    room_area: float,
    normals: np.ndarray,
    axes: list[tuple[np.ndarray, np.ndarray]],
) -> list[_Region]:
    """Rooms of about `room_area` by cuts across the longer extent: along a main direction, or up to 20 degrees askew.

    Each cut is appended to `axes` as a point and a direction.
    """
    if region.area < room_area * rng.uniform(0.8, 1.6):
        return [region]
    middle = region.points.mean(axis=0)
    centred = region.points - middle
    axis = np.linalg.eigh(centred.T @ centred)[1][:, 1]
    along = centred @ axis
    for _ in range(8):
        if rng.random() < 0.85:
            # The main direction nearest to straight across, now and then any.
            best = int(np.argmax(np.abs(normals @ axis))) if rng.random() < 0.8 else int(rng.integers(len(normals)))
            normal = normals[best]
        else:
            skew = float(np.clip(rng.normal(0, math.radians(12)), -math.radians(20), math.radians(20)))
            cos, sin = math.cos(skew), math.sin(skew)
            normal = np.array([axis[0] * cos - axis[1] * sin, axis[0] * sin + axis[1] * cos])
        origin = middle + (along.min() + rng.uniform(0.3, 0.7) * (along.max() - along.min())) * axis
        halves = [_half(region, origin, side * normal, len(axes)) for side in (1.0, -1.0)]
        if all(half is not None and _roomy(half) for half in halves):
            axes.append((origin, np.array([-normal[1], normal[0]])))
            return [room for half in halves if half for room in _cut(rng, half, room_area, normals, axes)]
    return [region]


def _half(region: _Region, origin: np.ndarray, normal: np.ndarray, cut: int) -> _Region | None:
    """The part of the region on the side that `normal` points to."""
    level = (region.points - origin) @ normal
    points, walls = [], []
    count = len(level)
    for k in range(count):
        a, b = level[k], level[(k + 1) % count]
        p, q = region.points[k], region.points[(k + 1) % count]
        if a >= 0:
            points.append(p)
            walls.append(region.walls[k])
        if (a >= 0) != (b >= 0):
            points.append(p + (q - p) * (a / (a - b)))
            # Leaving the half, the boundary goes on along the cut; entering it, along the old edge.
            walls.append(cut if a >= 0 else region.walls[k])
    return _Region(np.array(points), tuple(walls)) if len(points) >= 3 else None


def _roomy(region: _Region) -> bool:
    """Wide enough to be a room, and without an edge too short to see."""
    edges = np.roll(region.points, -1, axis=0) - region.points
    if np.hypot(edges[:, 0], edges[:, 1]).min() < 500:
        return False
    return not shapely.Polygon(region.points).buffer(-1100).is_empty


def _slanted_doors(
    rng: np.random.Generator, rooms: Sequence[_Region], axes: Sequence[tuple[np.ndarray, np.ndarray]], thickness: float
) -> list[Any] | None:
    """Door openings along a random spanning tree of the rooms and a few more; None if it does not span."""
    walls = []
    for a in range(len(rooms)):
        for b in range(a + 1, len(rooms)):
            for cut in sorted(set(rooms[a].walls) & set(rooms[b].walls) - {-1}):
                low, high = _common_span(rooms[a], rooms[b], cut, axes[cut])
                if high - low > 1500 + thickness:
                    walls.append((a, b, cut, low, high))
    group = list(range(len(rooms)))
    doors, joined = [], 0
    for k in rng.permutation(len(walls)):
        a, b, cut, low, high = walls[int(k)]
        loops = group[a] == group[b]
        if loops and rng.random() > 0.15:
            continue
        if not loops:
            joined += 1
            group = [group[a] if g == group[b] else g for g in group]
        room = high - low - 400 - thickness
        width = float(rng.integers(80, 111) * 10) if rng.random() < 0.85 else min(2600.0, room)
        middle = (low + high) / 2 + rng.uniform(-0.5, 0.5) * (room - width)
        origin, direction = axes[cut]
        doors.append(_crossing(origin + middle * direction, direction, width, thickness + 20))
    return doors if joined == len(rooms) - 1 else None


def _common_span(a: _Region, b: _Region, cut: int, axis: tuple[np.ndarray, np.ndarray]) -> tuple[float, float]:
    """The stretch of a cut that both rooms have as a wall, in its own coordinate."""
    spans = []
    for room in (a, b):
        k = room.walls.index(cut)
        ends = np.array([room.points[k], room.points[(k + 1) % len(room.points)]])
        spans.append(np.sort((ends - axis[0]) @ axis[1]))
    return float(max(spans[0][0], spans[1][0])), float(min(spans[0][1], spans[1][1]))


def _crossing(middle: np.ndarray, direction: np.ndarray, width: float, depth: float) -> Any:
    """A rectangle across a wall that runs in `direction`."""
    u, v = direction * width / 2, np.array([-direction[1], direction[0]]) * depth / 2
    return shapely.Polygon([middle - u - v, middle + u - v, middle + u + v, middle - u + v])


# Arc: rooms on one or both sides of a curved corridor.


def _arc(rng: np.random.Generator) -> tuple[Any, list[Any]] | None:
    thickness = 2.0 * int(rng.integers(60, 110))
    radius = float(rng.integers(700, 2200)) * 10
    width = float(rng.integers(150, 260)) * 10
    ring = rng.random() < 0.25
    # The arc is cut into equal steps on which all its walls have their vertices.
    steps = 60 if ring else int(rng.integers(10, 34))
    start = 0.0
    outer = float(rng.integers(350, 650)) * 10
    inner = min(float(rng.integers(350, 600)) * 10, radius - 2500) if rng.random() < 0.7 or ring else 0.0
    corridor = _sector(radius + thickness / 2, radius + width - thickness / 2, start, steps, ring)
    parts = [corridor]
    for low, high, at in ((radius + width, radius + width + outer, radius + width), (radius - inner, radius, radius)):
        if high - low < 2400:
            continue
        k = 0
        while k < steps:
            need = math.ceil(float(rng.uniform(2800, 7000)) / ((low + high) / 2 * _STEP))
            end = steps if steps - k - need < math.ceil(2800 / (low * _STEP)) else k + need
            if (end - k) * _STEP * low < 1900:
                return None
            room = _sector(low, high, start + k * _STEP, end - k, False)
            parts.append(room.buffer(-thickness / 2, join_style="mitre", mitre_limit=10.0))
            step = int(rng.integers(k, end))
            angle = start + (step + 0.5) * _STEP
            chord = 2 * at * math.sin(_STEP / 2)
            door = (
                min(float(rng.integers(80, 130) * 10), chord - 100)
                if end - k > 1
                else float(rng.integers(80, 110) * 10)
            )
            if door < 800:
                angle = start + (k + end) / 2 * _STEP
                door = float(rng.integers(80, 110) * 10)
            # The chord lies inside the circle by its sagitta.
            middle = np.array(_point(at * math.cos(_STEP / 2), angle))
            direction = np.array([-math.sin(angle), math.cos(angle)])
            depth = thickness + 2 * at * (1 - math.cos(_STEP / 2)) + 60
            parts.append(_crossing(middle, direction, door, depth))
            k = end
    if rng.random() < 0.6 and not ring:
        # A hall at the end of the corridor.
        size, sides = float(rng.integers(300, 600)) * 10, int(rng.integers(5, 9))
        x, y = _point(radius + width / 2, -0.9 * size / radius - 0.05)
        hall = shapely.Polygon(
            [(x + p, y + q) for p, q in (_point(size, 2 * math.pi * k / sides) for k in range(sides))]
        )
        rooms = shapely.union_all(parts[1:])
        hall = hall.difference(rooms.buffer(2 * thickness, join_style="mitre"))
        if hall.geom_type == "Polygon":
            parts.append(hall)
    return shapely.union_all(parts), []


def _sector(low: float, high: float, start: float, steps: int, closed: bool) -> Any:
    """Part of a ring between two radii, with a vertex every `_STEP`."""
    angles = [start + k * _STEP for k in range(steps + 1)]
    if closed:
        outer = shapely.Polygon([_point(high, a) for a in angles[:-1]])
        return outer.difference(shapely.Polygon([_point(low, a) for a in angles[:-1]]))
    return shapely.Polygon([*(_point(high, a) for a in angles), *(_point(low, a) for a in reversed(angles))])
