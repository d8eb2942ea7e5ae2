"""GeoJSON (RFC 7946, but in planar units) as a floor: polygons, furniture, and lines and points as walls."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely

from polyexplore_gym.errors import InvalidFloorPlanError
from polyexplore_gym.floorplan.model import FloorPlan, polygons
from polyexplore_gym.floorplan.units import DEGREES, SMALL_SPAN, metres, offset
from polyexplore_gym.floorplan.validation import shorten, to_array

POLYGONS = ("Polygon", "MultiPolygon")
LINES = ("LineString", "MultiLineString")
POINTS = ("Point", "MultiPoint")
COLLECTIONS = ("FeatureCollection", "GeometryCollection")
TYPES = ("Feature", *COLLECTIONS, *POLYGONS, *LINES, *POINTS)
_EARTH = 6_371_008.8
# A piece of furniture that reaches into a wall still stands in the room with more than this share of its area.
_INSIDE = 0.5


@dataclass(slots=True)
class _Found:
    """What the file holds, in its own units, with the properties of the Feature around it."""

    polygons: list[tuple[str, Any, Mapping[str, Any]]] = field(default_factory=list)
    lines: list[tuple[str, Any]] = field(default_factory=list)
    points: list[tuple[str, Any]] = field(default_factory=list)


@dataclass(frozen=True, slots=True, kw_only=True)
class Floor:
    """The free floor of a file, m."""

    polygons: list[shapely.Polygon]
    """One a room that is apart from the others; none overlap."""
    name: str | None
    """Name in the file."""
    meta: Mapping[str, Any]
    """Its properties."""
    units: bool
    """Whether units were given."""
    offset: np.ndarray
    """(2,) what was taken off the coordinates, m."""


def read(data: Mapping[str, Any], *, units: object = None, wall_thickness: float | None = None) -> Floor:
    """The floor of parsed GeoJSON.

    Polygons within another are furniture, polygons beside each other rooms without a door.

    Args:
        data: the file's content.
        units: of the coordinates, as in `units.metres` or "deg"; None: what the file says, else metres.
        wall_thickness: of lines, m, and width of points, which are columns; 0: they are left out; None: an error.

    Raises:
        InvalidFloorPlanError: naming the member and the reason.
    """
    found = _Found()
    _collect(data, {}, "", found)
    if not found.polygons:
        raise InvalidFloorPlanError("GeoJSON: no polygon, which the outline of the floor must be")
    others = len(found.lines) + len(found.points)
    if others and wall_thickness is None:
        where = (found.lines or found.points)[0][0]
        raise InvalidFloorPlanError(
            f"GeoJSON: {where}: {len(found.lines)} lines and {len(found.points)} points beside the polygons: say what "
            "they are with wall_thickness (--wall-thickness), in m: walls and columns of this thickness, or 0 to leave "
            "them out"
        )
    stated = next((p["units"] for _, _, p in found.polygons if "units" in p), None)
    given = stated if units is None else units
    shapes = [(where, _rings(rings, where), properties) for where, rings, properties in found.polygons]
    place, shift = _placing(given, np.concatenate([ring for _, rings, _ in shapes for ring in rings]))
    areas = []
    for where, rings, properties in shapes:
        exterior, *holes = (place(ring) for ring in rings)
        areas.append((_polygon(exterior, holes, where if len(shapes) > 1 else ""), properties))
    outlines, furniture = _nested(areas, [where for where, _, _ in found.polygons])
    obstacles = [shape for shape, _ in furniture]
    if others and wall_thickness:
        for where, line in found.lines:
            obstacles.append(_line(place(to_array(_flat(line), where)), wall_thickness, where))
        for where, point in found.points:
            obstacles.append(_column(place(to_array(_flat([point]), where)), wall_thickness))
    free = [polygon for polygon, _ in outlines]
    if obstacles:
        taken = shapely.union_all(obstacles)
        free = [part for polygon in free for part in polygons(polygon.difference(taken))]
        if not free:
            raise InvalidFloorPlanError("GeoJSON: nothing is left of the floor: polygons and walls cover all of it")
    properties = max(outlines, key=lambda outline: outline[0].area)[1]
    meta = properties.get("meta", {k: v for k, v in properties.items() if k not in ("name", "units")})
    if not isinstance(meta, Mapping):
        raise InvalidFloorPlanError(f"meta: expected an object, got {type(meta).__name__}")
    name = properties.get("name")
    return Floor(
        polygons=free, name=name if isinstance(name, str) else None, meta=meta, units=given is not None, offset=shift
    )


def _collect(data: Any, properties: Mapping[str, Any], where: str, found: _Found) -> None:
    """Add the geometries of a GeoJSON object to what was found."""
    if not isinstance(data, Mapping):
        raise InvalidFloorPlanError(f"GeoJSON: {where or 'the file'}: expected an object, got {type(data).__name__}")
    kind = data.get("type")
    if not isinstance(kind, str) or kind not in TYPES:
        raise InvalidFloorPlanError(f"GeoJSON: {where}{': ' if where else ''}unknown type {shorten(kind)}")
    if kind == "Feature":
        own = data.get("properties")
        if data.get("geometry") is not None:
            _collect(data["geometry"], own if isinstance(own, Mapping) else {}, where, found)
        return
    key = {"FeatureCollection": "features", "GeometryCollection": "geometries"}.get(kind, "coordinates")
    members = data.get(key)
    if not isinstance(members, list):
        reason = "needs a list of its members" if kind in COLLECTIONS else f"'{key}' must be a list"
        raise InvalidFloorPlanError(f"GeoJSON: {where}{': ' if where else ''}a {kind}: {reason} ({key})")
    where = f"{where} {kind}".strip()
    if kind in COLLECTIONS:
        for i, member in enumerate(members):
            _collect(member, properties, f"{key}[{i}]", found)
    elif kind == "MultiPolygon":
        found.polygons += [(f"{where} {i}", member, properties) for i, member in enumerate(members)]
    elif kind == "Polygon":
        found.polygons.append((where, members, properties))
    elif kind in LINES:
        found.lines += [(where, line) for line in (members if kind == "MultiLineString" else [members])]
    else:
        found.points += [(where, point) for point in (members if kind == "MultiPoint" else [members])]


def _rings(coordinates: Any, where: str) -> list[np.ndarray]:
    if not isinstance(coordinates, list) or not coordinates:
        raise InvalidFloorPlanError(f"GeoJSON: {where}: 'coordinates' must be a list of rings, the exterior first")
    names = ["exterior", *(f"hole {i}" for i in range(len(coordinates) - 1))]
    return [to_array(_flat(ring), name) for ring, name in zip(coordinates, names, strict=True)]


def _flat(points: Any) -> Any:
    """Positions may carry an altitude, which is dropped; anything else is left to the validation."""
    if not isinstance(points, list):
        return points
    return [point[:2] if isinstance(point, list) and len(point) == 3 else point for point in points]


def _placing(units: object, points: np.ndarray) -> tuple[Callable[[np.ndarray], np.ndarray], np.ndarray]:
    """The function that brings coordinates (n, 2) of the file to metres, and what it takes off them, m."""
    if not len(points):
        points = np.zeros((1, 2))
    low, high = points.min(axis=0), points.max(axis=0)
    if units != DEGREES:
        factor = metres(1.0 if units is None else units)
        degrees = bool((np.abs(points) <= (180.0, 90.0)).all())
        if units is None and degrees and 0 < float((high - low).max()) < SMALL_SPAN:
            raise InvalidFloorPlanError(
                f"GeoJSON: the plan spans {high[0] - low[0]:.3g} x {high[1] - low[1]:.3g} m, which is no building; if "
                "the coordinates are longitude and latitude, say units='deg' (--units deg)"
            )
        taken = offset(factor * low, factor * high)
        return lambda ring: ring * factor - taken, taken
    if (np.abs(points) > (180.0, 90.0)).any():
        raise InvalidFloorPlanError("units 'deg': the coordinates are no longitudes and latitudes")
    middle = (low + high) / 2
    scale = math.radians(1.0) * _EARTH * np.array([math.cos(math.radians(middle[1])), 1.0])
    return lambda ring: (ring - middle) * scale, np.zeros(2)


def _polygon(exterior: np.ndarray, holes: Sequence[np.ndarray], where: str) -> shapely.Polygon:
    try:
        return FloorPlan.create(exterior, holes).polygon
    except InvalidFloorPlanError as error:
        raise InvalidFloorPlanError(f"GeoJSON: {where}: {error}" if where else str(error)) from error


_Area = tuple[shapely.Polygon, Mapping[str, Any]]


def _nested(areas: list[_Area], where: Sequence[str]) -> tuple[list[_Area], list[_Area]]:
    """Outlines and the furniture within them; polygons that overlap otherwise are an error."""
    order = sorted(range(len(areas)), key=lambda i: (-areas[i][0].area, i))
    outlines: list[int] = []
    furniture: list[int] = []
    for i in order:
        shape = areas[i][0]
        inside = False
        for j in outlines:
            share = shape.intersection(areas[j][0]).area / shape.area
            if share > 1 - 1e-9 and shape.area > (1 - 1e-9) * areas[j][0].area:
                raise InvalidFloorPlanError(f"GeoJSON: {where[i]} covers the same floor as {where[j]}")
            inside = inside or share > _INSIDE
            if 1e-6 < share <= _INSIDE:
                raise InvalidFloorPlanError(
                    f"GeoJSON: {where[i]} overlaps {where[j]}: polygons within the outline are furniture, polygons "
                    "beside it rooms; a plan is one polygon of floor with holes"
                )
        (furniture if inside else outlines).append(i)
    return [areas[i] for i in outlines], [areas[i] for i in furniture]


def _line(points: np.ndarray, thickness: float, where: str) -> shapely.Geometry:
    if len(points) < 2:
        raise InvalidFloorPlanError(f"GeoJSON: {where}: a line needs at least 2 points, got {len(points)}")
    # Square ends, so that walls that should meet do.
    return shapely.LineString(points).buffer(thickness / 2, cap_style="square", join_style="mitre")


def _column(point: np.ndarray, width: float) -> shapely.Geometry:
    return shapely.Point(point[0]).buffer(width / 2, cap_style="square")
