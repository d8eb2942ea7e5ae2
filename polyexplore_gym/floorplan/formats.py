"""Floor plans on disk: the plan JSON, HouseExpo JSON, GeoJSON, ROS map_server maps and drawings.

Plan JSON: `{"name", "units": "m", "exterior": [[x, y], ...], "holes": [...], "meta": {...}}`; other keys are told of.
HouseExpo (Li et al. 2019): `{"id", "verts": [[x, y], ...], ...}`, metres, no holes.
GeoJSON (RFC 7946): see `polyexplore_gym.floorplan.geojson`; planar, or degrees with units "deg".
ROS maps: see `polyexplore_gym.floorplan.rosmap`. DXF and SVG: see `polyexplore_gym.floorplan.drawing`.
"""

from __future__ import annotations

import json
import math
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import shapely

from polyexplore_gym.config import PlanFileConfig
from polyexplore_gym.errors import FloorPlanWarning, InvalidFloorPlanError
from polyexplore_gym.floorplan import geojson
from polyexplore_gym.floorplan.model import FloorPlan
from polyexplore_gym.floorplan.reach import tell, trim
from polyexplore_gym.floorplan.units import LARGE_AREA, guess, metres, offset_text
from polyexplore_gym.floorplan.validation import check_keys, shorten, to_array

MAX_FILE_BYTES = 64 * 1024 * 1024
"""Largest JSON file or drawing read."""
PLAN_SUFFIXES = (".json", ".geojson", ".yaml", ".yml", ".dxf", ".svg")
"""What `load_plan` reads and `save_plan` writes (.yml apart)."""
_IMAGES = {".pgm", ".png", ".pnm", ".pbm", ".ppm", ".bmp", ".jpg", ".jpeg", ".tif", ".tiff"}
_PLAN_KEYS = ("name", "units", "exterior", "holes", "meta", "source")
_HOUSEEXPO_KEYS = ("id", "verts", "units", "room_num", "room_category", "bbox")


def load_plan(
    path: str | Path,
    *,
    start: Sequence[float] | None = None,
    radius: float | None = None,
    tolerance: float | None = None,
    units: str | float | None = None,
    walls: str = "outline",
    wall_thickness: float | None = None,
    layers: Sequence[str] = (),
    doors: Sequence[str] = (),
    snap: float = 0.01,
    strict: bool = False,
) -> FloorPlan:
    """Read a floor plan; the format is found by suffix and content.

    With a radius the plan is what a robot of this size reaches: larger parts that are cut off are left out with a
    `FloorPlanWarning`, which names their area and place, the narrow passage and the radius that would do. The
    environment and the commands give the robot's radius and the start.

    Args:
        path: a .json, .geojson, .dxf or .svg file, or the .yaml of a ROS map.
        start: keep the part of the floor around this x, y (m), not the largest.
        radius: of the robot, m; 0 keeps all that is connected. None: what the file says, as it is; of a ROS map
            what a robot of 0.25 m reaches, since its cracks must be closed.
        tolerance: greatest deviation, m, by simplification of a ROS map (None: one pixel) and in the curves of a
            drawing (None: 0.01).
        units, walls, wall_thickness, layers, doors, snap, strict: as in `PlanFileConfig`.

    Raises:
        InvalidFloorPlanError: naming the file, and ring, vertex and reason where it applies; also when less than 45 %
            of the floor can be reached and no start chooses it.
        InvalidConfigError: an option that is none.
        MissingDependencyError: a drawing, and the extra `drawings` is not installed.
    """
    options = PlanFileConfig(
        tolerance=tolerance,
        units=None if units is None else str(units),
        walls=walls,  # type: ignore[arg-type]
        wall_thickness=wall_thickness,
        layers=tuple(layers),
        doors=tuple(doors),
        snap=snap,
        strict=strict,
    )
    path = Path(path)
    try:
        if radius is not None and not (math.isfinite(radius) and radius >= 0):
            raise InvalidFloorPlanError(f"radius {radius!r}: must be a finite number of metres, not negative")
        return _load(path, start, radius, options)
    except InvalidFloorPlanError as error:
        raise InvalidFloorPlanError(f"{path}: {error}") from error.__cause__
    except OSError as error:
        raise InvalidFloorPlanError(f"{path}: cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise InvalidFloorPlanError(f"{path}: too large for the memory of this machine") from error


def _load(path: Path, start: Sequence[float] | None, radius: float | None, options: PlanFileConfig) -> FloorPlan:
    suffix = path.suffix.lower()
    if suffix in _IMAGES:
        raise InvalidFloorPlanError("is an image; give the path of the map's yaml file, which names it")
    if suffix not in PLAN_SUFFIXES:
        raise InvalidFloorPlanError(f"unknown suffix {path.suffix!r}; known: {', '.join(PLAN_SUFFIXES)}")
    if suffix in (".yaml", ".yml"):
        from polyexplore_gym.floorplan.rosmap import load_ros_map

        return load_ros_map(path, start=start, radius=radius, tolerance=options.tolerance, strict=options.strict)
    if path.stat().st_size > MAX_FILE_BYTES:
        raise InvalidFloorPlanError(f"larger than {MAX_FILE_BYTES // 2**20} MiB, not a floor plan")
    if suffix in (".dxf", ".svg"):
        from polyexplore_gym.floorplan.drawing import load_drawing

        return _reached(*load_drawing(path, options), path.stem, path, start, radius, options)
    data = _read_json(path)
    if not isinstance(data, Mapping):
        raise InvalidFloorPlanError(f"expected a JSON object, got {type(data).__name__}")
    if "exterior" in data or "verts" in data:
        plan, stated = _from_plan_json(data, path, options.units)
        rooms, name, meta = [plan.polygon], plan.name, plan.meta
    elif isinstance(data.get("type"), str) and data["type"] in geojson.TYPES:
        floor = geojson.read(data, units=options.units, wall_thickness=options.wall_thickness)
        rooms, name, meta, stated = floor.polygons, floor.name or path.stem, floor.meta, floor.units
        if floor.offset.any():
            warnings.warn(f"{path}: {offset_text(floor.offset)}", FloorPlanWarning, stacklevel=3)
            meta = {**meta, "offset": floor.offset.tolist()}
    else:
        raise InvalidFloorPlanError(
            "not a floor plan: expected the key 'exterior' (plan), 'verts' (HouseExpo) or a GeoJSON 'type'"
        )
    plan = _reached(rooms, meta, name, path, start, radius, options)
    x0, y0, x1, y1 = plan.bounds
    if plan.area > LARGE_AREA and not stated:
        hint = guess(x1 - x0, y1 - y0) or "; units (--units) takes a number, metres a unit"
        warnings.warn(
            f"{path}: the plan spans {x1 - x0:.4g} x {y1 - y0:.4g} m, more than buildings do{hint}; if it is metres, "
            "say units='m' (--units m)",
            FloorPlanWarning,
            stacklevel=3,
        )
    return plan


def _reached(
    rooms: Sequence[shapely.Polygon],
    meta: Mapping[str, Any],
    name: str,
    path: Path,
    start: Sequence[float] | None,
    radius: float | None,
    options: PlanFileConfig,
) -> FloorPlan:
    """The plan of what a robot reaches of the rooms; they are checked, as every plan is."""
    point = None if start is None else _start(start, rooms)
    kept, loss = rooms[0], None
    if radius is not None or len(rooms) > 1:
        kept, loss = trim(rooms, radius or 0.0, point)
    plan = FloorPlan.create(kept.exterior.coords[:-1], [ring.coords[:-1] for ring in kept.interiors])
    if loss is not None:
        tell(loss, radius or 0.0, where=str(path), chosen=start is not None, strict=options.strict)
        meta = {**meta, "radius": radius or 0.0, "kept": round(loss.kept, 3)}
    return plan.named(name, meta)


def _start(start: Sequence[float], rooms: Sequence[shapely.Polygon]) -> tuple[float, float]:
    try:
        x, y = float(start[0]), float(start[1])
    except (TypeError, ValueError, IndexError) as error:
        raise InvalidFloorPlanError(f"start {shorten(start)}: expected finite numbers x, y") from error
    if not (math.isfinite(x) and math.isfinite(y)):
        raise InvalidFloorPlanError(f"start {shorten(start)}: expected finite numbers x, y")
    if not any(room.covers(shapely.Point(x, y)) for room in rooms):
        raise InvalidFloorPlanError(f"start ({x:g}, {y:g}) lies in a wall or outside the plan")
    return x, y


def save_plan(plan: FloorPlan, path: str | Path, *, resolution: float = 0.05) -> None:
    """Write a plan; the suffix decides the format.

    Plan JSON (.json), GeoJSON (.geojson), DXF and SVG keep the geometry as it is, and reading them back gives it.
    A ROS map (.yaml, with a .pgm beside it) is a raster: walls may be off by a pixel.

    Args:
        plan: to write.
        path: .json, .geojson, .dxf, .svg or .yaml.
        resolution: of a ROS map, m a pixel.

    Raises:
        InvalidFloorPlanError: another suffix, or a raster too large.
        MissingDependencyError: a .dxf, and the extra `drawings` is not installed.
    """
    path = Path(path)
    if path.suffix.lower() not in PLAN_SUFFIXES or path.suffix.lower() == ".yml":
        known = ", ".join(suffix for suffix in PLAN_SUFFIXES if suffix != ".yml")
        raise InvalidFloorPlanError(f"{path}: unknown suffix {path.suffix!r}; plans are written as {known}")
    # Whole or not at all; of a ROS map the image before the yaml that names it.
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".plan-") as folder:
        try:
            _write(plan, Path(folder) / path.name, resolution)
        except InvalidFloorPlanError as error:
            raise InvalidFloorPlanError(f"{path}: {error}") from error
        for part in sorted(Path(folder).iterdir()):
            part.replace(path.with_name(part.name))


def _write(plan: FloorPlan, path: Path, resolution: float) -> None:
    suffix = path.suffix.lower()
    if suffix in (".json", ".geojson"):
        content = to_mapping(plan) if suffix == ".json" else to_geojson(plan)
        path.write_text(json.dumps(content, allow_nan=False) + "\n", encoding="utf-8")
    elif suffix == ".yaml":
        from polyexplore_gym.floorplan.rosmap import save_ros_map

        save_ros_map(plan, path, resolution)
    else:
        from polyexplore_gym.floorplan.drawing import save_drawing

        save_drawing(plan, path)


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
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except json.JSONDecodeError as error:
        raise InvalidFloorPlanError(
            f"not valid JSON, truncated perhaps: {error.msg} at line {error.lineno}, column {error.colno}"
        ) from error
    except (UnicodeDecodeError, RecursionError, ValueError) as error:
        raise InvalidFloorPlanError(f"not valid JSON: {type(error).__name__}") from error


def _from_plan_json(data: Mapping[str, Any], path: Path, units: str | None) -> tuple[FloorPlan, bool]:
    """The plan of plan JSON or HouseExpo, and whether its units are known."""
    house = "exterior" not in data
    check_keys(data, _HOUSEEXPO_KEYS if house else _PLAN_KEYS, str(path))
    stated = data.get("units") if units is None else units
    factor = metres("m" if stated is None else stated)
    meta = data.get("meta", {})
    if not isinstance(meta, Mapping):
        raise InvalidFloorPlanError(f"meta: expected an object, got {type(meta).__name__}")
    if house:
        meta = {**{k: data[k] for k in ("room_num", "room_category") if k in data}, "format": "HouseExpo"}
    elif "source" in data and "source" not in meta:
        meta = {**meta, "source": data["source"]}
    exterior, holes = data["verts" if house else "exterior"], [] if house else data.get("holes", [])
    if factor != 1.0:
        exterior = to_array(exterior, "exterior") * factor
        if isinstance(holes, list):
            holes = [to_array(hole, f"hole {i}") * factor for i, hole in enumerate(holes)]
    name = data.get("id" if house else "name")
    name = name if isinstance(name, str) and name else path.stem
    return FloorPlan.create(exterior, holes, name=name, meta=meta), stated is not None
