"""Drawings (DXF, SVG) as a floor, and plans as drawings.

A drawing is strokes: open or closed lines, each with the names of its layer and colour. What they mean is said by
`PlanFileConfig.walls`:

- outline: closed lines are the outline of the floor, of obstacles in it, of floor in those, and so on; lines whose
  ends meet within `snap` make closed lines.
- areas: closed lines are the outline of walls, of what they enclose, of obstacles in that; where two overlap, the
  smaller is a wall. The floor is what the walls enclose.
- lines: all lines are walls of a thickness, whatever their ends do. The floor is what they enclose.

Doors are drawn as symbols over or beside the wall. Each is opened by the smallest rectangle round it, which is made
deeper by the wall's thickness unless the symbol is itself a closed rectangle.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import shapely.affinity
import shapely.ops

from polyexplore_gym.config import PlanFileConfig
from polyexplore_gym.errors import FloorPlanWarning, InvalidFloorPlanError
from polyexplore_gym.floorplan.model import FloorPlan, polygons
from polyexplore_gym.floorplan.units import guess, offset, offset_text
from polyexplore_gym.floorplan.validation import MAX_COORDINATE, MAX_EXTENT, to_array

MAX_STROKES = 100_000
"""Most lines of a drawing."""
MAX_POINTS = 1_000_000
"""Most points of all lines together."""
CURVE_TOLERANCE = 0.01
"""Greatest deviation of the polygons that stand for curves, m."""
WALL_THICKNESS = 0.1
"""Thickness of walls drawn as lines, m, unless told."""
# Openings up to this width, m, are looked for where walls do not enclose a floor.
_WIDEST_GAP = 2.0
# Less than this share of what the walls enclose with the gaps closed is not taken for the floor.
_ENCLOSED = 0.45
# Smallest room that counts in that, m2.
_ROOM = 1.0
# A closed rectangle fills so much of the smallest rectangle round it.
_FILLED = 0.9


@dataclass(frozen=True, slots=True)
class Stroke:
    """A line of a drawing."""

    points: np.ndarray
    """(n, 2) its points, m."""
    closed: bool
    """Whether the last point is joined to the first."""
    names: frozenset[str]
    """Layer and colour, in lower case."""


@dataclass(frozen=True, slots=True)
class Drawing:
    """What a file holds."""

    strokes: list[Stroke]
    """Its lines."""
    names: frozenset[str]
    """All layers and colours, for messages."""


def load_drawing(path: Path, options: PlanFileConfig) -> tuple[list[shapely.Polygon], dict[str, Any]]:
    """The rooms of a drawing, apart from each other, m, and the plan's meta.

    Raises:
        InvalidFloorPlanError: damaged, no units, nothing on these layers, or lines that do not close, with the place.
        MissingDependencyError: the extra `drawings` is not installed.
    """
    if path.suffix.lower() == ".dxf":
        from polyexplore_gym.floorplan import dxf

        drawing = dxf.read(path, options.units, options.tolerance or CURVE_TOLERANCE)
    else:
        from polyexplore_gym.floorplan import svg

        drawing = svg.read(path, options.units, options.tolerance or CURVE_TOLERANCE)
    drawing, taken = _near(drawing)
    meta: dict[str, Any] = {"format": path.suffix[1:].upper()}
    if taken.any():
        warnings.warn(f"{path}: {offset_text(taken)}", FloorPlanWarning, stacklevel=4)
        meta["offset"] = taken.tolist()
    return rooms_of(drawing, options), meta


def save_drawing(plan: FloorPlan, path: Path) -> None:
    """Write a plan as .dxf (metres, layers OUTLINE and OBSTACLES) or .svg (a user unit is a metre)."""
    if path.suffix.lower() == ".dxf":
        from polyexplore_gym.floorplan import dxf

        dxf.write(plan, path)
    else:
        from polyexplore_gym.floorplan import svg

        svg.write(plan, path)


def _near(drawing: Drawing) -> tuple[Drawing, np.ndarray]:
    """The drawing near the origin, and what was taken off its coordinates (2,), m."""
    if not drawing.strokes:
        return drawing, np.zeros(2)
    points = to_array(np.concatenate([stroke.points for stroke in drawing.strokes]), "the drawing")
    taken = offset(points.min(axis=0), points.max(axis=0))
    if not taken.any():
        return drawing, taken
    return replace(
        drawing, strokes=[replace(stroke, points=stroke.points - taken) for stroke in drawing.strokes]
    ), taken


def rooms_of(drawing: Drawing, options: PlanFileConfig) -> list[shapely.Polygon]:
    """The floor of a drawing's strokes; see `load_drawing`."""
    doors = _chosen(drawing, options.doors, "doors")
    walls = _chosen(drawing, options.layers, "layers") if options.layers else list(drawing.strokes)
    ids = {id(stroke) for stroke in doors}
    walls = [stroke for stroke in walls if id(stroke) not in ids]
    if not walls:
        raise InvalidFloorPlanError(f"the drawing has no lines for walls; layers and colours: {_listed(drawing.names)}")
    _check_size(walls)
    thickness = WALL_THICKNESS if options.wall_thickness is None else options.wall_thickness
    openings = [opening for symbol in _symbols(doors, options.snap) if (opening := _opening(symbol, thickness))]
    if options.walls == "outline":
        rooms = _outlined(_rings(walls, options.snap))
        if openings:
            rooms = list(polygons(shapely.union_all([*rooms, *openings])))
        return rooms
    if options.walls == "areas":
        solid = _solid(_rings(walls, options.snap))
    else:
        if thickness <= 0:
            raise InvalidFloorPlanError("wall_thickness 0: lines that are walls need a thickness (--wall-thickness)")
        lines = [_line(stroke) for stroke in walls]
        solid = shapely.union_all(
            [line.buffer(thickness / 2, cap_style="square", join_style="mitre") for line in lines]
        )
    if openings:
        solid = solid.difference(shapely.union_all(openings))
    return _enclosed(solid)


def _chosen(drawing: Drawing, names: Sequence[str], field: str) -> list[Stroke]:
    wanted = {name.lower() for name in names}
    unknown = sorted(wanted - drawing.names)
    if unknown:
        raise InvalidFloorPlanError(f"{field} {unknown[0]!r}: the drawing has {_listed(drawing.names)}")
    return [stroke for stroke in drawing.strokes if wanted & stroke.names]


def _listed(names: frozenset[str]) -> str:
    shown = sorted(names)[:20]
    return ", ".join(repr(name[:40]) for name in shown) + (", ..." if len(names) > len(shown) else "") or "nothing"


def _check_size(strokes: Sequence[Stroke]) -> None:
    points = np.concatenate([stroke.points for stroke in strokes])
    points = to_array(points, "the drawing")
    width, height = np.ptp(points, axis=0).tolist()
    if np.abs(points).max() > MAX_COORDINATE or width * height > MAX_EXTENT:
        raise InvalidFloorPlanError(
            f"the drawing spans {width:g} x {height:g} m to ({points[:, 0].max():g}, {points[:, 1].max():g}), too "
            f"large to hold (1 km2, 10 km from the origin){guess(width, height)}"
        )


def _line(stroke: Stroke) -> shapely.LineString:
    points = np.concatenate([stroke.points, stroke.points[:1]]) if stroke.closed else stroke.points
    return shapely.LineString(points)


def _rings(strokes: Sequence[Stroke], snap: float) -> list[shapely.Polygon]:
    """The closed lines as polygons: those that are closed, and chains of open ones."""
    rings = [stroke.points for stroke in strokes if stroke.closed]
    opened = [stroke.points for stroke in strokes if not stroke.closed]
    rings += _chains(opened, snap) if opened else []
    found = []
    for ring in rings:
        try:
            found.append(FloorPlan.create(ring).polygon)
        except InvalidFloorPlanError as error:
            x, y = ring[0]
            reason = str(error).removeprefix("exterior").lstrip(", :")
            raise InvalidFloorPlanError(f"the closed line that begins at ({x:.3f}, {y:.3f}): {reason}") from error
    # Lines that were drawn twice count once.
    return list({shapely.normalize(ring).wkb: ring for ring in found}.values())


def _chains(lines: Sequence[np.ndarray], snap: float) -> list[np.ndarray]:
    """Rings of lines whose ends meet; every end must meet exactly one other."""
    ends = np.array([end for line in lines for end in (line[0], line[-1])])
    place = _clusters(ends, snap)
    meeting: dict[int, list[int]] = {}
    for end, cluster in enumerate(place.tolist()):
        meeting.setdefault(cluster, []).append(end)
    alone = [cluster[0] for cluster in meeting.values() if len(cluster) == 1]
    if alone:
        raise InvalidFloorPlanError(_open_ends(ends, alone, snap))
    crowd = next((cluster for cluster in meeting.values() if len(cluster) > 2), None)
    if crowd is not None:
        x, y = ends[crowd[0]]
        raise InvalidFloorPlanError(
            f"{len(crowd)} lines meet at ({x:.3f}, {y:.3f}), so they are no outline; if lines are walls, say "
            "walls='lines' (--walls lines), and layers choose lines"
        )
    rings, used = [], set()
    for first in range(len(lines)):
        if first in used:
            continue
        ring, end = [], 2 * first
        while end // 2 not in used:
            used.add(end // 2)
            line = lines[end // 2]
            ring.append(line[:-1] if end % 2 == 0 else line[:0:-1])
            leaving = end ^ 1
            a, b = meeting[int(place[leaving])]
            end = b if a == leaving else a
        rings.append(np.concatenate(ring))
    return rings


def _clusters(points: np.ndarray, distance: float) -> np.ndarray:
    """Number of the cluster (n,) of each point; points within the distance are of one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = cKDTree(points).query_pairs(distance + 1e-9, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    return connected_components(graph, directed=False)[1]


def _open_ends(ends: np.ndarray, alone: Sequence[int], snap: float) -> str:
    """Where lines do not close, the narrowest gaps first."""
    gaps = []
    for i in alone[:1000]:
        distance = np.hypot(*(ends - ends[i]).T)
        distance[[i, i ^ 1]] = np.inf
        gaps.append((float(distance.min()) if len(ends) > 2 else math.inf, i))
    gaps.sort()
    shown = [
        f"({ends[i][0]:.3f}, {ends[i][1]:.3f})" + (f", {gap:.3g} m from the next end" if math.isfinite(gap) else "")
        for gap, i in gaps[:3]
    ]
    more = f" and {len(alone) - 3} more" if len(alone) > 3 else ""
    remedy = f"a larger snap (now {snap:g} m, --snap) closes small gaps; " if gaps[0][0] < 0.5 else ""
    return (
        f"lines do not close: ends at {'; at '.join(shown)}{more}; {remedy}if lines are walls, say walls='lines' "
        "(--walls lines)"
    )


def _outlined(rings: Sequence[shapely.Polygon]) -> list[shapely.Polygon]:
    """Areas within an odd number of rings, which may not cross."""
    a, b = shapely.STRtree(rings).query(rings, predicate="overlaps")
    if len(a):
        place = rings[int(a[0])].intersection(rings[int(b[0])]).representative_point()
        raise InvalidFloorPlanError(
            f"closed lines overlap at ({place.x:.3f}, {place.y:.3f}), so they are no outline; if they are walls, say "
            "walls='areas' (--walls areas)"
        )
    return _odd(rings)


def _solid(rings: Sequence[shapely.Polygon]) -> shapely.Geometry:
    """Walls: areas within an odd number of rings, and all of a ring that overlaps a larger one, such as a pillar."""
    order = sorted(rings, key=lambda ring: -ring.area)
    a, b = shapely.STRtree(order).query(order, predicate="overlaps")
    loose = set(a[a > b].tolist())
    return shapely.union_all([*_odd([r for i, r in enumerate(order) if i not in loose]), *(order[i] for i in loose)])


def _odd(rings: Sequence[shapely.Polygon]) -> list[shapely.Polygon]:
    """Areas within an odd number of rings, of which none overlaps another but by lying in it."""
    order = sorted(rings, key=lambda ring: -ring.area)
    inner, outer = shapely.STRtree(order).query(order, predicate="covered_by")
    depth = np.bincount(inner[inner != outer], minlength=len(order))
    areas: list[shapely.Polygon] = []
    for i in np.flatnonzero(depth % 2 == 0):
        children = [order[int(j)] for j in inner[(outer == i) & (inner != i)] if depth[j] == depth[i] + 1]
        area = order[i].difference(shapely.union_all(children)) if children else order[i]
        areas.extend(polygons(area))
    return areas


def _symbols(strokes: Sequence[Stroke], snap: float) -> list[shapely.Geometry]:
    """The lines of each door: those that touch."""
    if not strokes:
        return []
    lines = [_line(stroke) for stroke in strokes]
    groups = list(polygons(shapely.union_all([line.buffer(max(snap, 1e-3), quad_segs=2) for line in lines])))
    tree = shapely.STRtree(lines)
    return [shapely.union_all([lines[int(i)] for i in tree.query(group, predicate="intersects")]) for group in groups]


def _opening(symbol: shapely.Geometry, thickness: float) -> shapely.Geometry | None:
    """The area that a door opens; None for a symbol without any."""
    box = symbol.minimum_rotated_rectangle
    if box.geom_type == "Point" or symbol.length == 0:
        return None
    filled = shapely.union_all(list(polygons(shapely.polygonize(shapely.get_parts(symbol).tolist()))))
    closed = box.geom_type == "Polygon" and filled.area > _FILLED * box.area
    more = 1e-3 if closed else thickness
    # The symbol's own axes: along the longer side and across it.
    corners = np.asarray(box.coords if box.geom_type == "LineString" else box.exterior.coords)
    sides = np.diff(corners[:3], axis=0)
    along = sides[int(np.argmax(np.hypot(*sides.T)))]
    angle = math.degrees(math.atan2(along[1], along[0]))
    x0, y0, x1, y1 = shapely.affinity.rotate(box, -angle, origin=(0, 0)).bounds
    wide, deep = shapely.box(x0 - more, y0, x1 + more, y1), shapely.box(x0, y0 - more, x1, y1 + more)
    cross = shapely.union_all([part for part in (wide, deep) if part.area > 0])
    return shapely.affinity.rotate(cross, angle, origin=(0, 0))


def _enclosed(solid: shapely.Geometry) -> list[shapely.Polygon]:
    """What walls enclose, in parts; raises, with the place, if most of it is open to the outside."""
    inside, _ = _faces(solid, 0.0)
    area = sum(part.area for part in inside)
    gap = _gap(solid, area)
    if gap is not None:
        width, x, y = gap
        raise InvalidFloorPlanError(
            f"the walls do not close: there is an opening of about {width:.2f} m at ({x:.2f}, {y:.2f}). Close it in "
            "the drawing, or read the layer that closes it, too"
        )
    if not inside:
        raise InvalidFloorPlanError(
            f"the walls enclose nothing, not even with openings of {_WIDEST_GAP:g} m closed; layers choose lines, "
            "units their size"
        )
    return inside


def _faces(solid: shapely.Geometry, gap: float) -> tuple[list[shapely.Polygon], list[shapely.Polygon]]:
    """What walls enclose when openings up to a width are closed, and what is outside."""
    walls = solid.buffer(gap / 2, quad_segs=4) if gap else solid
    x0, y0, x1, y1 = walls.bounds
    frame = shapely.box(x0 - 1, y0 - 1, x1 + 1, y1 + 1)
    inside: list[shapely.Polygon] = []
    outside: list[shapely.Polygon] = []
    for part in polygons(frame.difference(walls)):
        (outside if part.intersects(frame.exterior) else inside).append(part)
    return inside, outside


def _gap(solid: shapely.Geometry, area: float) -> tuple[float, float, float] | None:
    """Width and place of the opening through which a floor much larger than `area` is open to the outside."""

    def closes(width: float) -> bool:
        # Each room is narrower by the closed width, so give back what a room of that outline lost.
        inside = [part.buffer(width / 2, join_style="mitre") for part in _faces(solid, width)[0]]
        rooms = sum(part.area for part in inside if part.area > _ROOM)
        return rooms > _ROOM and area < _ENCLOSED * rooms

    steps = [width for width in np.linspace(0.05, _WIDEST_GAP, 14).tolist() if closes(width)]
    if not steps:
        return None
    low, high = max(0.0, steps[0] - _WIDEST_GAP / 13), steps[0]
    for _ in range(8):
        middle = (low + high) / 2
        low, high = (low, middle) if closes(middle) else (middle, high)
    inside, outside = _faces(solid, high)
    near, far = shapely.ops.nearest_points(max(inside, key=lambda part: part.area), shapely.union_all(outside))
    return high, (near.x + far.x) / 2, (near.y + far.y) / 2
