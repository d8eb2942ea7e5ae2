"""ROS map_server maps (yaml + pgm/png): from the occupancy raster to a polygon with holes.

Meaning of the yaml as in map_server: a pixel of brightness v (0 to 255) has occupancy p = (255 - v) / 255,
or v / 255 with `negate`; it is free if p < free_thresh, occupied if p > occupied_thresh, unknown
between. Only free pixels become free space. `origin` is the pose x, y (m), yaw (rad) of the raster's lower left
corner; `resolution` is the pixel's side, m.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from polyexplore_gym.errors import InvalidFloorPlanError
from polyexplore_gym.floorplan.model import FloorPlan
from polyexplore_gym.floorplan.validation import shorten

MAX_PIXELS = 100_000_000
"""Largest image read."""
# map_server's defaults and the usual values of maps written by map_saver.
_DEFAULTS = {"negate": 0, "occupied_thresh": 0.65, "free_thresh": 0.196}


def load_ros_map(
    path: Path, *, start: Sequence[float] | None = None, radius: float = 0.25, tolerance: float | None = None
) -> FloorPlan:
    """Read the map whose yaml is at `path`; the arguments are those of `formats.load_plan`.

    Raises:
        InvalidFloorPlanError: bad yaml or image, no free space, or a start outside of it.
        OSError: the yaml cannot be read.
    """
    fields = _read_yaml(path)
    resolution, origin = fields["resolution"], fields["origin"]
    for name, value in (("radius", radius), ("tolerance", resolution if tolerance is None else tolerance)):
        if not (math.isfinite(value) and value >= 0):
            raise InvalidFloorPlanError(f"{name} {value!r}: must be a finite number of metres, not negative")
    brightness, opaque = _read_image(path.parent / fields["image"])
    occupancy = brightness / 255.0 if fields["negate"] else (255.0 - brightness) / 255.0
    free = (occupancy < fields["free_thresh"]) & (occupancy <= fields["occupied_thresh"]) & opaque
    seed = None if start is None else _pixel_of(start, free.shape, resolution, origin)
    tolerance_px = 1.0 if tolerance is None else tolerance / resolution
    cos, sin = math.cos(origin[2]), math.sin(origin[2])
    to_metres = np.array([[cos, -sin], [sin, cos]]) * resolution

    def place(ring: Any) -> np.ndarray:
        return np.asarray(ring.coords)[:-1] @ to_metres.T + origin[:2]

    def build(reach: float) -> FloorPlan:
        polygon = _simplify(vectorise(select_region(free, reach, seed)), tolerance_px)
        meta = {"format": "ROS map", "resolution": resolution, "origin": list(origin), "image": fields["image"]}
        holes = [place(ring) for ring in polygon.interiors]
        return FloorPlan.create(place(polygon.exterior), holes, name=path.stem, meta=meta)

    plan = build(radius / resolution)
    try:
        if radius > 0:
            plan.check_connected(radius)
        return plan
    except InvalidFloorPlanError:
        # The simplification narrowed a passage; ask for that much more room beforehand.
        return build(radius / resolution + tolerance_px)


def select_region(free: np.ndarray, radius: float, seed: tuple[int, int] | None = None) -> np.ndarray:
    """The part of the free pixels that a disc can reach, as a mask (h, w) whose boundary never touches itself.

    The disc's centre moves over the largest 4-connected set of pixels with at least `radius` (pixels)
    clearance, or the set nearest to the seed. The region is what the disc sweeps, and from there half a radius
    further into corners and niches, so that corners stay sharp and cracks in the walls end.

    Args:
        free: (h, w) bool.
        radius: of the disc, pixels; 0 takes the connected region as it is.
        seed: row, column of a pixel to keep.

    Raises:
        InvalidFloorPlanError: nothing is left, or the seed is not in free space.
    """
    import cv2

    if not free.any():
        raise InvalidFloorPlanError("the map has no free pixel; check negate, free_thresh and occupied_thresh")
    if seed is not None and not free[seed]:
        raise InvalidFloorPlanError(f"the start lies on pixel (row {seed[0]}, column {seed[1]}), which is not free")
    padded = np.pad(_without_pinches(free), 1).astype(np.uint8)
    if radius > 0:
        # Distance from a pixel's centre to the nearest blocked pixel's edge, to about half a pixel.
        distance = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) - 0.5
        centres = _component((distance >= radius).astype(np.uint8), seed)
        if centres is None:
            raise InvalidFloorPlanError(f"no room for a disc of {radius:.1f} pixels in the free space")
        swept = cv2.distanceTransform((~centres).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= radius + 0.5
        region = swept & (padded > 0)
        cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
        for _ in range(math.ceil(radius / 2)):
            region = (cv2.dilate(region.astype(np.uint8), cross) > 0) & (padded > 0)
        padded = region.astype(np.uint8)
    kept = _component(np.pad(_without_pinches(padded[1:-1, 1:-1] > 0), 1).astype(np.uint8), seed)
    if kept is None:
        raise InvalidFloorPlanError("the map has no connected free space")
    return kept[1:-1, 1:-1]


def _component(mask: np.ndarray, seed: tuple[int, int] | None) -> np.ndarray | None:
    """Largest 4-connected component of a padded mask, or the one nearest to the seed (unpadded row, column)."""
    import cv2

    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    if count <= 1:
        return None
    if seed is None:
        best = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    else:
        rows, cols = np.nonzero(labels)
        nearest = int(np.argmin((rows - seed[0] - 1) ** 2 + (cols - seed[1] - 1) ** 2))
        best = int(labels[rows[nearest], cols[nearest]])
    return labels == best


def _without_pinches(mask: np.ndarray) -> np.ndarray:
    """The mask with pixels cleared until no two of its pixels meet in a corner only."""
    mask = mask.copy()
    while True:
        a, b, c, d = mask[:-1, :-1], mask[:-1, 1:], mask[1:, :-1], mask[1:, 1:]
        falling, rising = a & d & ~b & ~c, b & c & ~a & ~d
        if not (falling.any() or rising.any()):
            return mask
        mask[1:, 1:][falling] = False
        mask[1:, :-1][rising] = False


def vectorise(region: np.ndarray) -> shapely.Polygon:
    """The exact outline of a connected mask (h, w) along the pixels' edges.

    Coordinates are pixels, x to the right and y up from the lower left corner. OpenCV's contours run
    through pixel centres; on a lattice of twice the resolution, on which every pixel covers 3 x 3 points,
    these are the pixels' corners and edges.
    """
    import cv2

    h, w = region.shape
    lattice = np.zeros((2 * h + 1, 2 * w + 1), np.uint8)
    for dy in range(3):
        for dx in range(3):
            lattice[dy : dy + 2 * h : 2, dx : dx + 2 * w : 2] |= region
    # A border, since OpenCV treats the image's edge as blocked.
    contours, hierarchy = cv2.findContours(np.pad(lattice, 1), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    outer, holes = None, []
    for contour, links in zip(contours, hierarchy.reshape(-1, 4), strict=True):
        ring = _corners(contour.reshape(-1, 2) - 1, lattice) / 2.0
        ring[:, 1] = h - ring[:, 1]
        if links[3] < 0:
            outer = ring
        else:
            holes.append(ring)
    return shapely.Polygon(outer, holes)


def _corners(points: np.ndarray, lattice: np.ndarray) -> np.ndarray:
    """The corner points of a contour: diagonal steps go round by the set lattice point, straight runs are dropped."""
    follower = np.roll(points, -1, axis=0)
    diagonal = np.abs(follower - points).sum(axis=1) == 2
    by_column = np.stack([points[:, 0], follower[:, 1]], axis=1)
    by_row = np.stack([follower[:, 0], points[:, 1]], axis=1)
    inner = np.where((lattice[by_column[:, 1], by_column[:, 0]] > 0)[:, None], by_column, by_row)
    order = np.concatenate([np.arange(len(points)), np.flatnonzero(diagonal) + 0.5])
    ring = np.concatenate([points, inner[diagonal]])[np.argsort(order, kind="stable")]
    turn = (np.roll(ring, -1, axis=0) - ring) != (ring - np.roll(ring, 1, axis=0))
    return ring[turn.any(axis=1)]


def _simplify(polygon: shapely.Polygon, tolerance: float) -> shapely.Polygon:
    """Douglas-Peucker that keeps the rings apart; specks smaller than the tolerance are dropped (pixels)."""
    if tolerance == 0:
        return polygon
    # A small factor over a whole pixel: a staircase of single pixels becomes a straight line.
    simple = shapely.simplify(polygon, 1.001 * tolerance, preserve_topology=True)
    holes = [ring for ring in simple.interiors if shapely.Polygon(ring).area > 2 * tolerance**2]
    return shapely.Polygon(simple.exterior, holes)


def _pixel_of(
    start: Sequence[float], shape: tuple[int, ...], resolution: float, origin: tuple[float, float, float]
) -> tuple[int, int]:
    try:
        x, y = float(start[0]), float(start[1])
    except (TypeError, ValueError, IndexError) as error:
        raise InvalidFloorPlanError(f"start {shorten(start)}: expected numbers x, y") from error
    if not (math.isfinite(x) and math.isfinite(y)):
        raise InvalidFloorPlanError(f"start {shorten(start)}: must be finite")
    cos, sin = math.cos(origin[2]), math.sin(origin[2])
    dx, dy = x - origin[0], y - origin[1]
    column = math.floor((cos * dx + sin * dy) / resolution)
    row = shape[0] - 1 - math.floor((cos * dy - sin * dx) / resolution)
    if not (0 <= row < shape[0] and 0 <= column < shape[1]):
        raise InvalidFloorPlanError(f"start ({x:g}, {y:g}) lies outside the map")
    return row, column


def _read_yaml(path: Path) -> dict[str, Any]:
    """The yaml's fields, checked."""
    import yaml

    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8-sig"))
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError) as error:
        raise InvalidFloorPlanError(f"not valid yaml: {' '.join(str(error).split())[:200]}") from error
    if not isinstance(data, Mapping):
        raise InvalidFloorPlanError("not a ROS map: expected the fields image, resolution, origin")
    for key in ("image", "resolution", "origin"):
        if key not in data:
            raise InvalidFloorPlanError(f"{key}: the field is missing")
    if not isinstance(data["image"], str) or not data["image"]:
        raise InvalidFloorPlanError(f"image {shorten(data['image'])}: expected a file name")
    if data.get("mode", "trinary") not in ("trinary", "scale"):
        raise InvalidFloorPlanError(f"mode {shorten(data['mode'])}: only trinary and scale are known")
    values = {**_DEFAULTS, **data}
    fields: dict[str, Any] = {"image": data["image"]}
    for key in ("resolution", "negate", "occupied_thresh", "free_thresh"):
        fields[key] = _number(values[key], key)
    if not 0 < fields["resolution"] <= 10:
        raise InvalidFloorPlanError(f"resolution {fields['resolution']!r}: must lie in (0, 10] m")
    if fields["negate"] not in (0, 1):
        raise InvalidFloorPlanError(f"negate {shorten(values['negate'])}: must be 0 or 1")
    for key in ("occupied_thresh", "free_thresh"):
        if not 0 <= fields[key] <= 1:
            raise InvalidFloorPlanError(f"{key} {fields[key]!r}: must lie in 0 to 1")
    if fields["free_thresh"] > fields["occupied_thresh"]:
        raise InvalidFloorPlanError(
            f"free_thresh {fields['free_thresh']!r} must not exceed occupied_thresh {fields['occupied_thresh']!r}"
        )
    origin = data["origin"]
    if not isinstance(origin, list) or len(origin) not in (2, 3):
        raise InvalidFloorPlanError(f"origin {shorten(origin)}: expected [x, y, yaw]")
    fields["origin"] = (*(_number(v, "origin") for v in origin), 0.0)[:3]
    return fields


def _number(value: Any, key: str) -> float:
    # YAML 1.1 reads 5e-2 as a string and `no` as a boolean.
    try:
        number = float(value) if isinstance(value, (int, float, str)) else math.nan
    except (ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise InvalidFloorPlanError(f"{key} {shorten(value)}: expected a finite number")
    return number


def _read_image(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Brightness (h, w) in 0 to 255, colours averaged, and which pixels are opaque."""
    import cv2

    try:
        data = path.read_bytes()
    except OSError as error:
        raise InvalidFloorPlanError(f"image {path}: cannot be read: {error.strerror or error}") from error
    _check_complete(data, path)
    if data[:2] in (b"P1", b"P2", b"P3"):
        data += b"\n"  # OpenCV wants white space after the last number, too.
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except cv2.error:
        image = None
    if image is None or image.size == 0:
        raise InvalidFloorPlanError(f"image {path}: not an image, or damaged")
    if image.shape[0] * image.shape[1] > MAX_PIXELS:
        raise InvalidFloorPlanError(f"image {path}: more than {MAX_PIXELS} pixels")
    full = {"uint8": 255.0, "uint16": 65535.0}.get(str(image.dtype), 1.0)
    values = image.astype(np.float64) * (255.0 / full)
    if values.ndim == 2:
        return values, np.ones(values.shape, dtype=bool)
    alpha = values.shape[2] in (2, 4)
    colours = values[:, :, :-1] if alpha else values
    opaque = values[:, :, -1] > 127.0 if alpha else np.ones(values.shape[:2], dtype=bool)
    return colours.mean(axis=2), opaque


def _check_complete(data: bytes, path: Path) -> None:
    """OpenCV fills a truncated file's missing rows without a word: look for the end."""
    truncated = False
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        truncated = b"IEND\xaeB`\x82" not in data
    elif data[:2] in (b"P5", b"P6"):
        header: list[int] = []
        position = 2
        while len(header) < 3 and position < len(data):
            if data[position : position + 1].isspace():
                position += 1
            elif data[position : position + 1] == b"#":
                end = data.find(b"\n", position)
                position = len(data) if end < 0 else end + 1
            else:
                end = position
                while end < len(data) and not data[end : end + 1].isspace():
                    end += 1
                word = data[position:end]
                if not word.isdigit() or len(word) > 9:
                    raise InvalidFloorPlanError(f"image {path}: damaged PNM header")
                header.append(int(word))
                position = end
        channels = 3 if data[:2] == b"P6" else 1
        size = header[0] * header[1] * channels * (2 if header[2] > 255 else 1) if len(header) == 3 else math.inf
        truncated = len(data) - position - 1 < size
    if truncated:
        raise InvalidFloorPlanError(f"image {path}: the file is truncated")
