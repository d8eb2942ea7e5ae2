"""Floor plans on disk: the plan JSON, HouseExpo JSON, GeoJSON and ROS map_server maps.

Plan JSON: `{"name", "units": "m", "exterior": [[x, y], ...], "holes": [...], "meta": {...}}`.
HouseExpo (Li et al. 2019): `{"id", "verts": [[x, y], ...], ...}`, metres, no holes.
GeoJSON (RFC 7946): one Polygon, alone or in a Feature, MultiPolygon or collection; planar metres.
ROS maps: see `polyexplore_gym.floorplan.rosmap`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from polyexplore_gym.errors import InvalidFloorPlanError
from polyexplore_gym.floorplan.model import FloorPlan
from polyexplore_gym.floorplan.validation import shorten

MAX_FILE_BYTES = 64 * 1024 * 1024
"""Largest JSON file read."""
_IMAGES = {".pgm", ".png", ".pnm", ".pbm", ".ppm", ".bmp", ".jpg", ".jpeg", ".tif", ".tiff"}
_GEOJSON_TYPES = ("Feature", "FeatureCollection", "GeometryCollection", "Polygon", "MultiPolygon")
_GEOJSON_OTHERS = ("Point", "MultiPoint", "LineString", "MultiLineString")


def load_plan(
    path: str | Path,
    *,
    start: Sequence[float] | None = None,
    radius: float = 0.25,
    tolerance: float | None = None,
) -> FloorPlan:
    """Read a floor plan; the format is found by suffix and content.

    Args:
        path: a .json or .geojson file, or the .yaml of a ROS map.
        start: ROS map only: keep the free region around this x, y (m), not the largest.
        radius: ROS map only: drop what a disc of this radius (m) cannot reach; 0 keeps all that is connected.
        tolerance: ROS map only: greatest deviation by simplification, m; None: one pixel.

    Raises:
        InvalidFloorPlanError: naming the file, and ring, vertex and reason where it applies.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    try:
        if suffix in _IMAGES:
            raise InvalidFloorPlanError("is an image; give the path of the map's yaml file, which names it")
        if suffix in (".yaml", ".yml"):
            from polyexplore_gym.floorplan.rosmap import load_ros_map

            return load_ros_map(path, start=start, radius=radius, tolerance=tolerance)
        if suffix not in (".json", ".geojson"):
            raise InvalidFloorPlanError(f"unknown suffix {suffix!r}; known: .json, .geojson, .yaml, .yml")
        return from_mapping(_read_json(path), name=path.stem)
    except InvalidFloorPlanError as error:
        raise InvalidFloorPlanError(f"{path}: {error}") from error.__cause__
    except OSError as error:
        raise InvalidFloorPlanError(f"{path}: cannot be read: {error.strerror or error}") from error


def from_mapping(data: Any, name: str = "plan") -> FloorPlan:
    """A plan from parsed JSON of any of the three JSON formats; `name` unless the data give one.

    Raises:
        InvalidFloorPlanError: unknown format, missing fields or bad geometry.
    """
    if not isinstance(data, Mapping):
        raise InvalidFloorPlanError(f"expected a JSON object, got {type(data).__name__}")
    if "exterior" in data:
        return _from_plan_json(data, name)
    if "verts" in data:
        meta = {k: data[k] for k in ("room_num", "room_category") if k in data}
        return FloorPlan.create(data["verts"], name=_name(data.get("id"), name), meta={**meta, "format": "HouseExpo"})
    if data.get("type") in _GEOJSON_TYPES + _GEOJSON_OTHERS:
        return _from_geojson(data, name)
    raise InvalidFloorPlanError(
        "not a floor plan: expected the key 'exterior' (plan), 'verts' (HouseExpo) or a GeoJSON 'type'"
    )


def save_plan(plan: FloorPlan, path: str | Path) -> None:
    """Write a plan as plan JSON (.json) or GeoJSON (.geojson); reading it back gives the same plan.

    Raises:
        InvalidFloorPlanError: another suffix.
    """
    path = Path(path)
    writers = {".json": to_mapping, ".geojson": to_geojson}
    if path.suffix.lower() not in writers:
        raise InvalidFloorPlanError(f"{path}: unknown suffix {path.suffix!r}; plans are written as .json or .geojson")
    text = json.dumps(writers[path.suffix.lower()](plan), allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def to_mapping(plan: FloorPlan) -> dict[str, Any]:
    """The plan JSON's content."""
    return {
        "name": plan.name,
        "units": "m",
        "exterior": plan.exterior.tolist(),
        "holes": [hole.tolist() for hole in plan.holes],
        "meta": dict(plan.meta),
    }


def to_geojson(plan: FloorPlan) -> dict[str, Any]:
    """The plan as a GeoJSON Feature, in planar metres; rings closed, exterior counter-clockwise."""
    rings = [[*ring.tolist(), ring[0].tolist()] for ring in plan.rings]
    return {
        "type": "Feature",
        "properties": {"name": plan.name, "units": "m", "meta": dict(plan.meta)},
        "geometry": {"type": "Polygon", "coordinates": rings},
    }


def _read_json(path: Path) -> Any:
    if path.stat().st_size > MAX_FILE_BYTES:
        raise InvalidFloorPlanError(f"larger than {MAX_FILE_BYTES // 2**20} MiB, not a floor plan")
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except json.JSONDecodeError as error:
        raise InvalidFloorPlanError(
            f"not valid JSON, truncated perhaps: {error.msg} at line {error.lineno}, column {error.colno}"
        ) from error
    except (UnicodeDecodeError, RecursionError, ValueError) as error:
        raise InvalidFloorPlanError(f"not valid JSON: {type(error).__name__}") from error


def _name(value: Any, default: str) -> str:
    return value if isinstance(value, str) and value else default


def _from_plan_json(data: Mapping[str, Any], name: str) -> FloorPlan:
    if data.get("units", "m") != "m":
        raise InvalidFloorPlanError(f"units {shorten(data['units'])}: only 'm' is known")
    meta = data.get("meta", {})
    if not isinstance(meta, Mapping):
        raise InvalidFloorPlanError(f"meta: expected an object, got {type(meta).__name__}")
    if "source" in data and "source" not in meta:
        meta = {**meta, "source": data["source"]}
    return FloorPlan.create(data["exterior"], data.get("holes", []), name=_name(data.get("name"), name), meta=meta)


def _from_geojson(data: Mapping[str, Any], name: str) -> FloorPlan:
    polygons = list(_geojson_polygons(data, {}))
    if len(polygons) != 1:
        raise InvalidFloorPlanError(f"GeoJSON: expected exactly one polygon, found {len(polygons)}")
    coordinates, properties = polygons[0]
    if not isinstance(coordinates, list) or not coordinates:
        raise InvalidFloorPlanError("GeoJSON: a Polygon's 'coordinates' must be a list of rings, the exterior first")
    if properties.get("units", "m") != "m":
        raise InvalidFloorPlanError(f"units {shorten(properties['units'])}: only 'm' is known")
    meta = properties.get("meta", {k: v for k, v in properties.items() if k not in ("name", "units")})
    exterior, *holes = (_without_altitude(ring) for ring in coordinates)
    if not isinstance(meta, Mapping):
        raise InvalidFloorPlanError(f"meta: expected an object, got {type(meta).__name__}")
    return FloorPlan.create(exterior, holes, name=_name(properties.get("name"), name), meta=meta)


def _geojson_polygons(data: Any, properties: Mapping[str, Any]) -> list[tuple[Any, Mapping[str, Any]]]:
    """All polygons' coordinates with the properties of their Feature."""
    if not isinstance(data, Mapping):
        raise InvalidFloorPlanError(f"GeoJSON: expected an object, got {type(data).__name__}")
    kind = data.get("type")
    if kind == "Polygon":
        return [(data.get("coordinates"), properties)]
    if kind == "MultiPolygon":
        coordinates = data.get("coordinates")
        if not isinstance(coordinates, list):
            raise InvalidFloorPlanError("GeoJSON: a MultiPolygon's 'coordinates' must be a list")
        return [(polygon, properties) for polygon in coordinates]
    if kind == "Feature":
        own = data.get("properties")
        if data.get("geometry") is None:
            return []
        return _geojson_polygons(data["geometry"], own if isinstance(own, Mapping) else {})
    if kind in ("FeatureCollection", "GeometryCollection"):
        members = data.get("features" if kind == "FeatureCollection" else "geometries")
        if not isinstance(members, list):
            raise InvalidFloorPlanError(f"GeoJSON: a {kind} needs a list of its members")
        return [polygon for member in members for polygon in _geojson_polygons(member, properties)]
    if kind in _GEOJSON_OTHERS:
        return []
    raise InvalidFloorPlanError(f"GeoJSON: unknown type {shorten(kind)}")


def _without_altitude(ring: Any) -> Any:
    """GeoJSON positions may carry an altitude, which is dropped; anything else is left to the validation."""
    if not isinstance(ring, list):
        return ring
    return [point[:2] if isinstance(point, list) and len(point) == 3 else point for point in ring]
