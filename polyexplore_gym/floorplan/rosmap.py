"""ROS map_server maps (yaml + pgm/png): from the occupancy raster to a polygon with holes, and back.

Meaning of the yaml as in map_server: a pixel of brightness v (0 to 255) has occupancy p = (255 - v) / 255,
or v / 255 with `negate`; it is free if p < free_thresh, occupied if p > occupied_thresh, unknown between. With
`mode: raw` v itself is the occupancy in percent, above 100 unknown. Only free pixels become free space. `origin` is
the pose x, y (m), yaw (rad) of the raster's lower left corner; `resolution` is the pixel's side, m.

One thing is not taken to the letter: grey 205 is what map savers write for unknown, and today's write `free_thresh:
0.25` beside it, by which it would be free. In a trinary map it is unknown, in the mode scale where it fills a plain.

Specks, by one rule before rooms are chosen: see `without_specks`.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
import shapely

from polyexplore_gym import robot_map
from polyexplore_gym.errors import FloorPlanWarning, InvalidFloorPlanError
from polyexplore_gym.floorplan.images import read_image
from polyexplore_gym.floorplan.model import PASSABLE, FloorPlan, pockets, polygons
from polyexplore_gym.floorplan.reach import STEPS, Loss, keeps_most, last_true, tell, trim
from polyexplore_gym.floorplan.validation import MAX_VERTICES, check_keys, shorten

MODES = ("trinary", "scale", "raw")
"""How pixels are read."""
RADIUS = 0.25
"""Radius of the robot for which a map is read unless told, m: cracks that it cannot pass are closed."""
SPECK_PIXELS = 4
"""Obstacles of so many pixels are specks, if they are no larger than `SPECK_AREA`."""
SPECK_AREA = 0.02
"""Largest area of a speck, m2: a disc of 16 cm."""
DOTTED_LENGTH = 0.5
"""Specks in a straight row of this length, m, with gaps of two pixels at most, are a wall seen from afar."""
WARN_KEPT = 0.9
"""Below this share of the free floor kept a warning is given."""
WARN_LOST = 5.0
"""Likewise when a part left out is larger, m2: a room."""
MAX_BORDER = 1.0
"""A plan may run along the image's border so far without a word, m."""
MAX_YAML = 1_000_000
"""Largest yaml read, bytes."""
# A plain of one grey: so much of the image, and so many times its neighbours'.
_PLAIN = (0.02, 10.0)
# One grey that is neither free nor wall may fill so much of a plan without a word.
_GREY = 0.1
# Brightness from which on nobody doubts that a pixel is free.
_WHITE = 240
# Up to so many pixels the disc is moved on a grid of half a pixel.
_FINE = 4_000_000
# map_server's defaults and the usual values of maps written by map_saver.
_DEFAULTS = {"negate": 0, "occupied_thresh": 0.65, "free_thresh": 0.196}


def load_ros_map(
    path: Path,
    *,
    start: Sequence[float] | None = None,
    radius: float | None = None,
    tolerance: float | None = None,
    strict: bool = False,
) -> FloorPlan:
    """Read the map whose yaml is at `path`; the arguments are those of `formats.load_plan`.

    Raises:
        InvalidFloorPlanError: bad yaml or image, no free space, a start outside of it, or too much of it out of reach.
        OSError: the yaml cannot be read.
    """
    fields = _read_yaml(path)
    resolution, origin = fields["resolution"], fields["origin"]
    radius = RADIUS if radius is None else radius
    tolerance = resolution if tolerance is None else tolerance
    brightness, opaque = read_image(_image_path(path, fields["image"]))
    grey = brightness if brightness.dtype == np.uint8 else np.rint(brightness).astype(np.uint8)
    grey = np.ascontiguousarray(grey)
    free = _free(brightness, grey, opaque, fields, path)
    grid = _Grid(resolution, origin, free.shape)
    seed = None if start is None else grid.pixel(start)
    region, loss = _region(free, radius, seed, grid)
    _doubt(region, grey, fields, path, grid)
    plan, narrowed = _outline(region, radius, tolerance, grid)
    area = float(free.sum()) * resolution**2
    if narrowed is not None:
        loss = replace(narrowed, kept=plan.area / area)
    if loss is not None:
        tell(loss, radius, where=str(path), chosen=start is not None, strict=strict)
    meta = {"format": "ROS map", "resolution": resolution, "origin": list(origin), "image": fields["image"]}
    return plan.named(path.stem, {**meta, "radius": radius, "kept": round(min(plan.area / area, 1.0), 3)})


def save_ros_map(plan: FloorPlan, path: Path, resolution: float) -> None:
    """Write a plan as a map for map_server: the yaml at `path` and a .pgm beside it.

    A pixel is free if its centre lies in the plan, occupied next to free ones and where a wall is thinner than a
    pixel, else unknown.

    Raises:
        InvalidFloorPlanError: the image would have too many pixels, or the resolution is no length.
    """
    bounds = np.array(plan.bounds)
    try:
        height, width, corner = robot_map.raster(bounds[:2], bounds[2:], resolution)
    except ValueError as error:
        raise InvalidFloorPlanError(str(error)) from error
    image = _drawn(plan, np.array(corner), resolution, (height, width))
    robot_map.write(path, image, resolution, corner, plan.name)


def _drawn(plan: FloorPlan, corner: np.ndarray, resolution: float, shape: tuple[int, int]) -> np.ndarray:
    import cv2

    height, width = shape
    x = corner[0] + (np.arange(width) + 0.5) * resolution
    y = corner[1] + (height - np.arange(height) - 0.5) * resolution
    free = np.empty(shape, bool)
    for row in range(height):
        free[row] = shapely.contains_xy(plan.polygon, x, y[row])
    # Walls that a pixel's centre may miss.
    outside = shapely.box(*plan.polygon.buffer(4 * resolution).bounds).difference(plan.polygon)
    thick = outside.buffer(-0.75 * resolution, join_style="mitre").buffer(0.76 * resolution, join_style="mitre")
    thin = np.zeros(shape, np.uint8)
    for part in polygons(outside.difference(thick)):
        if part.area > 1e-3 * resolution**2:
            # OpenCV draws the pixels that the outline runs through as well; 8 bits are after the point.
            ring = (np.asarray(part.exterior.coords) - corner) / resolution
            points = np.column_stack([ring[:, 0] - 0.5, height - 0.5 - ring[:, 1]])
            cv2.fillPoly(thin, [np.rint(points * 256).astype(np.int32)], 1, shift=8)
    free &= thin == 0
    beside = cv2.dilate(free.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return np.where(free, robot_map.FREE, np.where(beside | (thin > 0), robot_map.OCCUPIED, robot_map.UNKNOWN)).astype(
        np.uint8
    )


@dataclass(frozen=True, slots=True)
class _Grid:
    """Where the pixels lie."""

    resolution: float
    origin: tuple[float, float, float]
    shape: tuple[int, ...]

    def place(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 2) in pixels, y up from the lower left corner, in metres."""
        cos, sin = math.cos(self.origin[2]), math.sin(self.origin[2])
        to_metres = np.array([[cos, -sin], [sin, cos]]) * self.resolution
        return points @ to_metres.T + self.origin[:2]

    def centre(self, pixel: tuple[int, int]) -> tuple[float, float]:
        """The middle of a pixel (row, column), m."""
        x, y = self.place(np.array([[pixel[1] + 0.5, self.shape[0] - pixel[0] - 0.5]]))[0]
        return float(x), float(y)

    def pixel(self, start: Sequence[float]) -> tuple[int, int]:
        """Row and column of the pixel at x, y, m."""
        try:
            x, y = float(start[0]), float(start[1])
        except (TypeError, ValueError, IndexError) as error:
            raise InvalidFloorPlanError(f"start {shorten(start)}: expected numbers x, y") from error
        if not (math.isfinite(x) and math.isfinite(y)):
            raise InvalidFloorPlanError(f"start {shorten(start)}: must be finite")
        cos, sin = math.cos(self.origin[2]), math.sin(self.origin[2])
        dx, dy = x - self.origin[0], y - self.origin[1]
        column = math.floor((cos * dx + sin * dy) / self.resolution)
        row = self.shape[0] - 1 - math.floor((cos * dy - sin * dx) / self.resolution)
        if not (0 <= row < self.shape[0] and 0 <= column < self.shape[1]):
            raise InvalidFloorPlanError(f"start ({x:g}, {y:g}) lies outside the map")
        return row, column


def _image_path(path: Path, name: str) -> Path:
    """The image that a yaml names: as it says, else beside the yaml, since yamls name paths of other machines."""
    try:
        given = Path(name).expanduser()
    except RuntimeError:  # a user that this machine does not know
        given = Path(name)
    given = path.parent / given
    try:
        if given.is_file():
            return given
        for beside in (path.parent / given.name, path.parent / PureWindowsPath(name).name):
            if beside.is_file():
                return beside
    except (OSError, ValueError):
        pass
    return given


def _free(
    brightness: np.ndarray, grey: np.ndarray, opaque: np.ndarray | None, fields: Mapping[str, Any], path: Path
) -> np.ndarray:
    """The free pixels (h, w), specks taken for free."""
    import cv2

    levels = np.arange(256.0)
    occupancy = _occupancy(levels, fields)
    free, occupied = _free_and_occupied(occupancy, fields)
    if brightness.dtype == np.uint8 or fields["mode"] == "raw":
        is_free, is_occupied = (cv2.LUT(grey, table.astype(np.uint8)) > 0 for table in (free, occupied))
    else:
        is_free, is_occupied = _free_and_occupied(_occupancy(brightness, fields), fields)
    if opaque is not None:
        is_free &= opaque
        is_occupied &= opaque
    if fields["mode"] != "raw":
        # A jpg smears its greys, and other maxvals than 255 round them.
        smeared = 3 if fields["image"].lower().endswith((".jpg", ".jpeg")) else int(brightness.dtype != np.uint8)
        unknown = np.abs(levels - robot_map.UNKNOWN) <= smeared
        counts = _histogram(grey)
        would_be_free = bool((free & unknown & (counts > 0)).any())
        if would_be_free and (fields["mode"] == "trinary" or _is_plain(counts)):
            is_free &= cv2.LUT(grey, unknown.astype(np.uint8)) == 0
            warnings.warn(
                f"{path}: grey {robot_map.UNKNOWN} is taken for unknown, for which map savers write it, though by "
                f"free_thresh {fields['free_thresh']:g} it would be free",
                FloorPlanWarning,
                stacklevel=2,
            )
    if not is_free.any():
        raise InvalidFloorPlanError(
            "the map has no free pixel; check negate, free_thresh and occupied_thresh"
            + (f" (grey {robot_map.UNKNOWN} is taken for unknown)" if (grey == robot_map.UNKNOWN).any() else "")
        )
    return without_specks(is_free, is_occupied, fields["resolution"])


def _occupancy(brightness: np.ndarray, fields: Mapping[str, Any]) -> np.ndarray:
    """Of each brightness, 0 to 1; NaN for unknown."""
    raw = fields["mode"] == "raw"
    value = 255.0 - brightness if bool(fields["negate"]) == raw else brightness
    return np.where(value < 100.5, value / 100.0, np.nan) if raw else value / 255.0


def _free_and_occupied(occupancy: np.ndarray, fields: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    occupied = occupancy > fields["occupied_thresh"]
    return (occupancy < fields["free_thresh"]) & ~occupied, occupied


def _histogram(grey: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    import cv2

    where = None if mask is None else mask.view(np.uint8)
    return cv2.calcHist([grey], [0], where, [256], [0, 256]).ravel()


def _is_plain(counts: np.ndarray) -> bool:
    """Whether the grey of map savers stands out among the shades of a scale."""
    around = max(counts[robot_map.UNKNOWN - 1], counts[robot_map.UNKNOWN + 1])
    return bool(counts[robot_map.UNKNOWN] > max(_PLAIN[0] * counts.sum(), _PLAIN[1] * around))


def without_specks(free: np.ndarray, occupied: np.ndarray, resolution: float) -> np.ndarray:
    """The free pixels and those of specks, which are noise: (h, w) bool.

    A speck is an obstacle in the midst of free pixels (8-connected) of at most `SPECK_PIXELS` pixels and `SPECK_AREA`.
    It is free, unless it belongs to a dotted wall: specks with occupied pixels that lie in a straight row.
    """
    import cv2

    # A border, so that what touches the image's edge is no speck.
    blocked = np.pad((~free).astype(np.uint8), 1, constant_values=1)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(blocked, connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA]
    small = (area <= SPECK_PIXELS) & (area * resolution**2 <= SPECK_AREA + 1e-9)
    small[0] = False
    if not small.any():
        return free
    specks = small[labels][1:-1, 1:-1]
    return free | (specks & ~_dotted(specks & occupied, specks, resolution))


def _dotted(solid: np.ndarray, specks: np.ndarray, resolution: float) -> np.ndarray:
    """The pixels of specks that stand in a straight row."""
    import cv2

    # Dilated by one pixel, specks with gaps of up to two touch.
    joined = cv2.dilate(solid.astype(np.uint8), np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(joined, connectivity=8)
    length = np.hypot(stats[:, cv2.CC_STAT_WIDTH] - 2, stats[:, cv2.CC_STAT_HEIGHT] - 2) * resolution
    if not (length[1:] >= DOTTED_LENGTH).any():
        return np.zeros_like(specks)
    rows, columns = np.nonzero(solid)
    owner = labels[rows, columns]
    n = np.maximum(np.bincount(owner, minlength=count), 1)
    x, y = (np.bincount(owner, values, count) / n for values in (columns, rows))
    dx, dy = columns - x[owner], rows - y[owner]
    xx, yy, xy = (np.bincount(owner, values, count) / n for values in (dx * dx, dy * dy, dx * dy))
    across = (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    # A straight row of single pixels is off its line by 0.3 pixels, one of two pixels' width by 0.6.
    wall = (length >= DOTTED_LENGTH) & (across < 0.6**2)
    wall[0] = False
    return specks & wall[labels]


def _region(
    free: np.ndarray, radius: float, seed: tuple[int, int] | None, grid: _Grid
) -> tuple[np.ndarray, Loss | None]:
    """What a robot of `radius` (m) reaches of the free pixels, and what is lost if it is worth telling."""
    if seed is not None and not free[seed]:
        raise InvalidFloorPlanError(f"the start lies on pixel (row {seed[0]}, column {seed[1]}), which is not free")
    top, bottom, left, right = _box(free)
    part = free[top:bottom, left:right]
    fine = 2 if part.size <= _FINE else 1
    disc = PASSABLE * radius / grid.resolution
    inner = None if seed is None else (seed[0] - top, seed[1] - left)
    try:
        reached = Reached(part, disc, inner, fine)
    except InvalidFloorPlanError as error:
        reason = f"{error} (a robot of radius {radius:g} m, pixels of {grid.resolution:g} m)"
        raise InvalidFloorPlanError(reason) from error
    region = np.zeros_like(free)
    region[top:bottom, left:right] = reached.region
    kept, total = int(reached.region.sum()), int(part.sum())
    pixels = reached.lost(total // 10, int(WARN_LOST / grid.resolution**2))
    if pixels is None:
        return region, None
    at, passage_at = (grid.centre((row + top, column + left)) for row, column in (pixels.at, pixels.passage_at))
    return region, Loss(
        kept=kept / total,
        area=kept * grid.resolution**2,
        largest=pixels.largest * grid.resolution**2,
        at=at,
        passage=2 * pixels.passage * grid.resolution,
        passage_at=passage_at,
        radius=pixels.radius / PASSABLE * grid.resolution,
    )


def _box(mask: np.ndarray) -> tuple[int, int, int, int]:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1


@dataclass(frozen=True, slots=True)
class _LostPixels:
    """As `Loss`, in pixels."""

    largest: int
    at: tuple[int, int]
    passage: float
    passage_at: tuple[int, int]
    radius: float


class Reached:
    """The part of the free pixels that a disc reaches.

    The disc's centre moves over the largest 4-connected set of pixels with at least `disc` clearance, or the
    set nearest to the seed. The region is what the disc sweeps, and from there half a radius further into corners and
    niches, so that corners stay sharp and cracks in the walls end.

    Args:
        free: (h, w) bool, at least one pixel.
        disc: radius, pixels; 0 takes the connected region as it is.
        seed: row, column of a free pixel to keep.
        fine: pixels are divided by this along each side to measure clearances.

    Raises:
        InvalidFloorPlanError: nothing is left.
    """

    region: np.ndarray
    """The part as a mask (h, w) whose boundary never touches itself."""

    def __init__(self, free: np.ndarray, disc: float, seed: tuple[int, int] | None = None, fine: int = 1) -> None:
        import cv2

        self._free, self._disc, self._seed, self._fine = free, disc, seed, fine
        clean = _without_pinches(free)
        region = clean
        if disc > 0:
            padded = np.pad(np.kron(clean, np.ones((fine, fine), bool)) if fine > 1 else clean, 1).astype(np.uint8)
            # From a pixel's centre to the nearest blocked pixel's edge. Halves of pixels make every straight passage
            # an even number wide, whose middle is half of one off: there this gives the passage its true width, and a
            # little too much elsewhere, where the outline decides.
            edge = 0.5 if fine == 1 else 0.0
            self._distance = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) - edge
            centres = self._main(self._distance >= disc * fine)
            if centres is None:
                raise InvalidFloorPlanError(f"no room for a disc of {disc:.1f} pixels in the free space")
            self._centres = centres
            off = cv2.distanceTransform((~centres).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            swept = (off <= disc * fine + 0.5)[1:-1, 1:-1]
            if fine > 1:
                swept = np.asarray(swept.reshape(free.shape[0], fine, free.shape[1], fine).any(axis=(1, 3)))
            region = swept & clean
            cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
            for _ in range(math.ceil(disc / 2)):
                region = (cv2.dilate(region.astype(np.uint8), cross) > 0) & clean
        kept = component(_without_pinches(region), seed)
        if kept is None:
            raise InvalidFloorPlanError("the map has no connected free space")
        self.region = kept

    def _main(self, mask: np.ndarray) -> np.ndarray | None:
        seed = None if self._seed is None else (self._seed[0] * self._fine + 1, self._seed[1] * self._fine + 1)
        return component(mask, seed)

    def lost(self, total: int, largest: int) -> _LostPixels | None:
        """What was lost; None if it was at most so many pixels in all, and in one part."""
        import cv2

        rest = (self._free & ~self.region).astype(np.uint8)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(rest, connectivity=4)
        areas = stats[1:, cv2.CC_STAT_AREA]
        if areas.sum() <= total and areas.max(initial=0) <= largest:
            return None
        best = 1 + int(np.argmax(areas))
        largest = int(areas[best - 1])
        if self._disc <= 0:
            at = divmod(int((labels == best).argmax()), labels.shape[1])
            return _LostPixels(largest, at, 0.0, at, 0.0)
        fine = self._fine
        inside = labels == best
        coarse = self._distance[1:-1, 1:-1][::fine, ::fine]
        # The deepest pixel of the part stands for it.
        at = divmod(int(np.where(inside, coarse, -1.0).argmax()), inside.shape[1])
        row, column = at[0] * fine + 1, at[1] * fine + 1
        home = divmod(int(np.where(self._centres, self._distance, -1.0).argmax()), self._centres.shape[1])
        steps = STEPS if self._free.size <= _FINE else STEPS // 4

        @cache
        def shares(step: int) -> tuple[bool, bool]:
            """Whether a disc of that size gets to the lost part, and whether it keeps most."""
            mask = (self._distance >= step / steps * self._disc * fine).astype(np.uint8)
            _, found, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
            areas = stats[:, cv2.CC_STAT_AREA].astype(np.int64)
            main = found[home]
            reaches = bool(mask[row, column]) and found[row, column] == main
            return reaches, keeps_most([areas[main], *np.delete(areas, [0, main])])

        step = last_true(lambda step: shares(step)[0], steps)
        return _LostPixels(
            largest,
            at,
            (step + 0.5) / steps * self._disc if step else 0.0,
            self._stopped(home, (row, column), (step + 1) / steps * self._disc) if step else at,
            last_true(lambda step: shares(step)[1], steps) / steps * self._disc,
        )

    def _stopped(self, home: tuple[int, int], target: tuple[int, int], disc: float) -> tuple[int, int]:
        """The pixel on the target's side that is nearest to where a disc gets that is just too large to pass."""
        import cv2

        mask = (self._distance >= disc * self._fine).astype(np.uint8)
        mask[target] = 1
        _, found = cv2.connectedComponents(mask, connectivity=4)
        top, bottom, left, right = _box(found == found[target])
        margin = int(4 * self._disc * self._fine) + 4
        top, left = max(top - margin, 0), max(left - margin, 0)
        part = found[top : bottom + margin, left : right + margin]
        off = cv2.distanceTransform((part != found[home]).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        row, column = np.unravel_index(np.where(part == found[target], off, np.inf).argmin(), part.shape)
        return (int(row) + top - 1) // self._fine, (int(column) + left - 1) // self._fine


def component(mask: np.ndarray, seed: tuple[int, int] | None) -> np.ndarray | None:
    """Largest 4-connected component of a mask, or the one nearest to the seed (row, column); None if it is empty."""
    import cv2

    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    if count <= 1:
        return None
    if seed is None:
        best = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    else:
        rows, columns = np.nonzero(labels)
        nearest = int(np.argmin((rows - seed[0]) ** 2 + (columns - seed[1]) ** 2))
        best = int(labels[rows[nearest], columns[nearest]])
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


def _doubt(region: np.ndarray, grey: np.ndarray, fields: Mapping[str, Any], path: Path, grid: _Grid) -> None:
    """Warn of a plan that is probably not the inside of a building."""
    doubts = []
    border = int(region[[0, -1]].sum() + region[1:-1, [0, -1]].sum()) * grid.resolution
    if border > MAX_BORDER:
        doubts.append(
            f"the plan runs along {border:.1f} m of the image's border: it is cut off there, or the outside of a "
            "building (a start in the part that is meant, --start, chooses that)"
        )
    counts = _histogram(grey, region)
    white = 255 - np.arange(256) if fields["negate"] else np.arange(256)
    level = int(np.where(white < _WHITE, counts, 0).argmax())
    share = counts[level] / counts.sum()
    if fields["mode"] == "trinary" and white[level] < _WHITE and share > _GREY:
        doubts.append(
            f"{100 * share:.0f} % of the plan is of the one grey {level}, which is neither white nor black: if it is "
            f"what was not seen, lower free_thresh, {fields['free_thresh']:g}"
        )
    for doubt in doubts:
        warnings.warn(f"{path}: {doubt}", FloorPlanWarning, stacklevel=2)


def _outline(region: np.ndarray, radius: float, tolerance: float, grid: _Grid) -> tuple[FloorPlan, Loss | None]:
    """The region's outline within the tolerance (m); and what had to be left out so that the robot gets everywhere."""
    outline = vectorise(region)
    first: FloorPlan | None = None
    for share in (1.0, 0.75, 0.0) if tolerance > 0 else (1.0,):
        simple = _simplify(outline, share * tolerance / grid.resolution)
        count = shapely.get_num_coordinates(simple) - 1 - len(simple.interiors)
        if count > MAX_VERTICES:
            if first is None:
                raise InvalidFloorPlanError(_too_many(outline, count, tolerance, grid.resolution))
            break
        plan = FloorPlan.create(
            grid.place(np.asarray(simple.exterior.coords)[:-1]),
            [grid.place(np.asarray(ring.coords)[:-1]) for ring in simple.interiors],
        )
        parts = sorted(polygons(plan.free_space(PASSABLE * radius)), key=lambda part: -part.area)
        if parts and not pockets(parts):
            return plan, None
        # The simplification narrowed a passage: follow the pixels more closely.
        first = first or plan
    assert first is not None
    kept, loss = trim([first.polygon], radius, _deepest(region, grid))
    return FloorPlan.create(kept.exterior.coords[:-1], [ring.coords[:-1] for ring in kept.interiors]), loss


def _deepest(region: np.ndarray, grid: _Grid) -> tuple[float, float]:
    """The middle of the pixel farthest from the region's boundary, m."""
    import cv2

    distance = cv2.distanceTransform(np.pad(region, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    row, column = np.unravel_index(distance.argmax(), distance.shape)
    return grid.centre((int(row) - 1, int(column) - 1))


def _simplify(polygon: shapely.Polygon, tolerance: float) -> shapely.Polygon:
    """Douglas-Peucker that keeps the rings apart, and all of them, small obstacles as they are; pixels."""
    if not tolerance:
        return polygon
    # A small factor over a whole pixel: a staircase of single pixels becomes a straight line.
    simple = shapely.simplify(polygon, 1.001 * tolerance, preserve_topology=True)
    x0, y0, x1, y1 = shapely.bounds(shapely.get_rings(polygon)[1:]).T
    small = np.maximum(x1 - x0, y1 - y0) <= 3 * tolerance
    if small.any() and len(simple.interiors) == len(small):
        rings = zip(small, polygon.interiors, simple.interiors, strict=True)
        whole = shapely.Polygon(simple.exterior, [before if keep else after for keep, before, after in rings])
        return whole if whole.is_valid else simple
    return simple


def _too_many(outline: shapely.Polygon, count: int, tolerance: float, resolution: float) -> str:
    text = f"too many vertices: {count}, more than {MAX_VERTICES}, with a tolerance of {tolerance:g} m"
    for factor in (1.5, 2, 3, 4, 6, 8):
        more = factor * max(tolerance, resolution)
        left = shapely.get_num_coordinates(_simplify(outline, more / resolution))
        if left <= MAX_VERTICES:
            return f"{text}; tolerance={more:g} (--tolerance) leaves {left}"
    return f"{text}; no tolerance helps: the map is too rough"


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


def _read_yaml(path: Path) -> dict[str, Any]:
    """The yaml's fields, checked."""
    import yaml

    raw = path.read_bytes()
    if len(raw) > MAX_YAML:
        raise InvalidFloorPlanError(f"larger than {MAX_YAML // 10**6} MB, not the yaml of a ROS map")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")  # comments of older editors
    try:
        data = yaml.safe_load(text)
    except Exception as error:  # yaml's constructors raise what int() and datetime do
        raise InvalidFloorPlanError(f"not valid yaml: {' '.join(str(error).split())[:200]}") from error
    if not isinstance(data, Mapping):
        raise InvalidFloorPlanError("not a ROS map: expected the fields image, resolution, origin")
    for key in ("image", "resolution", "origin"):
        if key not in data:
            raise InvalidFloorPlanError(f"{key}: the field is missing")
    if not isinstance(data["image"], str) or not data["image"]:
        raise InvalidFloorPlanError(f"image {shorten(data['image'])}: expected a file name")
    mode = data.get("mode", "trinary")
    if mode not in MODES:
        raise InvalidFloorPlanError(f"mode {shorten(mode)}: known are {', '.join(MODES)}")
    check_keys(data, ("image", "resolution", "origin", "mode", *_DEFAULTS), str(path))
    values = {**_DEFAULTS, **data}
    fields: dict[str, Any] = {"image": data["image"], "mode": mode}
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
    x, y, yaw = (*(_number(v, "origin") for v in origin), 0.0)[:3]
    if abs(yaw) > 2 * math.pi:
        raise InvalidFloorPlanError(f"origin {shorten(origin)}: the yaw is in radians, so at most 2 pi")
    fields["origin"] = (x, y, yaw)
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
