"""The floor plan: one polygon with holes, in metres, immutable and valid."""

from __future__ import annotations

import copy
import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
import shapely
import shapely.ops

from polyexplore_gym.errors import InvalidFloorPlanError
from polyexplore_gym.floorplan.validation import normalise, shorten, signed_area

POCKET_AREA = 1.0
"""Largest pocket that the robot need not reach, m2; it must also be below `POCKET_SHARE`."""
POCKET_SHARE = 0.01
"""Largest pocket that the robot need not reach, as a share of where it can stand."""
PASSABLE = 1.02
"""Passages are those for a disc so many times as large as the robot: paths keep 1.6 % of the radius off the walls
(`exploration` plans them so), and the polygon that stands for a disc is up to 0.12 % too small."""
# Segments per quarter circle of the disc: its polygon is at most 0.12 % smaller than the disc.
_QUAD_SEGMENTS = 16
_HASH_UNIT = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class FloorPlan:
    """An immutable floor plan: the free space within `exterior` and outside of `holes`.

    The rings are validated and brought to normal form (see `validation.normalise`): float64, not
    closed, exterior counter-clockwise, holes clockwise. The arrays are read-only.

    Raises:
        InvalidFloorPlanError: naming ring, vertex and reason.
    """

    name: str
    """Identifier, for people and result files; not part of the geometry."""
    exterior: np.ndarray
    """(n, 2) boundary of the free space, m."""
    holes: tuple[np.ndarray, ...] = ()
    """Obstacles, (k, 2) each, m."""
    meta: Mapping[str, Any] = field(default_factory=dict)
    """What a file says about the plan, or the generator's family and seed; read-only."""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise InvalidFloorPlanError(f"name: expected a string, got {type(self.name).__name__}")
        if not isinstance(self.meta, Mapping):
            raise InvalidFloorPlanError(f"meta: expected a mapping, got {type(self.meta).__name__}")
        exterior, holes = normalise(self.exterior, self.holes)
        self.__setstate__((self.name, exterior, holes, copy.deepcopy(dict(self.meta))))

    @classmethod
    def create(
        cls,
        exterior: Sequence[Sequence[float]] | np.ndarray,
        holes: Sequence[Any] = (),
        *,
        name: str = "plan",
        meta: Mapping[str, Any] | None = None,
    ) -> FloorPlan:
        """A plan from rings in any of the accepted forms (nested sequences or arrays)."""
        return cls(name=name, exterior=exterior, holes=holes, meta=meta or {})  # type: ignore[arg-type]

    def named(self, name: str, meta: Mapping[str, Any]) -> FloorPlan:
        """The same geometry with another name and meta; it is not checked again."""
        plan = object.__new__(FloorPlan)
        plan.__setstate__((name, self.exterior, self.holes, copy.deepcopy(dict(meta))))
        return plan

    def __getstate__(self) -> tuple[Any, ...]:
        return self.name, self.exterior, self.holes, dict(self.meta)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        # Also after unpickling: a copy is as read-only as the original, and starts with empty caches.
        name, exterior, holes, meta = state
        for ring in (exterior, *holes):
            ring.setflags(write=False)
        for key, value in (("name", name), ("exterior", exterior), ("holes", holes), ("meta", MappingProxyType(meta))):
            object.__setattr__(self, key, value)

    def __repr__(self) -> str:
        return f"FloorPlan({self.name!r}, {self.area:.1f} m2, {self.n_vertices} vertices, {len(self.holes)} holes)"

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, FloorPlan):
            return NotImplemented
        return self.name == other.name and self.content_hash == other.content_hash

    def __hash__(self) -> int:
        return hash((self.name, self.content_hash))

    @property
    def rings(self) -> tuple[np.ndarray, ...]:
        """Exterior and holes."""
        return (self.exterior, *self.holes)

    @cached_property
    def segments(self) -> np.ndarray:
        """(M, 4) walls x1, y1, x2, y2, m; the free space is on the left of each."""
        walls = np.concatenate([np.hstack([ring, np.roll(ring, -1, axis=0)]) for ring in self.rings])
        walls.setflags(write=False)
        return walls

    @cached_property
    def polygon(self) -> shapely.Polygon:
        """The free space as a shapely polygon, prepared."""
        polygon = shapely.Polygon(self.exterior, self.holes)
        shapely.prepare(polygon)
        return polygon

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Smallest x and y, largest x and y, m."""
        (x0, y0), (x1, y1) = self.exterior.min(axis=0), self.exterior.max(axis=0)
        return float(x0), float(y0), float(x1), float(y1)

    @cached_property
    def area(self) -> float:
        """Area of the free space, m2."""
        return sum(signed_area(ring) for ring in self.rings)

    @property
    def n_vertices(self) -> int:
        """Number of vertices, all rings together."""
        return sum(len(ring) for ring in self.rings)

    @cached_property
    def content_hash(self) -> str:
        """sha256 of the geometry to 1 um, whatever the name, the rings' first vertices and the holes' order."""
        exterior, *holes = (_canonical_bytes(ring) for ring in self.rings)
        digest = hashlib.sha256(b"polyexplore floor plan 1")
        for ring in (exterior, *sorted(holes)):
            digest.update(len(ring).to_bytes(8, "little"))
            digest.update(ring)
        return digest.hexdigest()

    @cached_property
    def _free_spaces(self) -> dict[float, Any]:
        return {}

    def free_space(self, radius: float) -> Any:
        """Where the centre of a disc of `radius` (m) may be: a shapely geometry, perhaps empty or in parts."""
        radius = _checked_radius(radius)
        if radius not in self._free_spaces:
            eroded = self.polygon.buffer(-radius, quad_segs=_QUAD_SEGMENTS) if radius else self.polygon
            self._free_spaces[radius] = eroded
        return self._free_spaces[radius]

    @cached_property
    def _largest_parts(self) -> dict[float, shapely.Polygon]:
        return {}

    def largest_part(self, radius: float) -> shapely.Polygon:
        """The largest connected part of `free_space(radius)`, prepared; an empty polygon if there is none."""
        radius = _checked_radius(radius)
        if radius not in self._largest_parts:
            parts = list(polygons(self.free_space(radius)))
            part = max(parts, key=lambda p: p.area) if parts else shapely.Polygon()
            shapely.prepare(part)
            self._largest_parts[radius] = part
        return self._largest_parts[radius]

    @cached_property
    def _wall_tree(self) -> shapely.STRtree:
        return shapely.STRtree(shapely.linestrings(self.segments.reshape(-1, 2, 2)))

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance (k,) from points (k, 2) to the nearest wall, m; negative outside the free space."""
        points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        if not np.isfinite(points).all():
            raise ValueError("clearance: the points must be finite")
        _, distance = self._wall_tree.query_nearest(shapely.points(points), return_distance=True, all_matches=False)
        inside = shapely.contains_xy(self.polygon, points[:, 0], points[:, 1])
        return np.where(inside, distance, -distance)

    def covers(self, start: Any) -> bool:
        """Whether the point x, y (m) lies in the plan; also True of what is no point, which `check_start` tells of."""
        try:
            return bool(shapely.intersects_xy(self.polygon, float(start[0]), float(start[1])))
        except (TypeError, ValueError, IndexError, KeyError):
            return True

    def sample_start(self, rng: np.random.Generator, radius: float, margin: float = 0.1) -> np.ndarray:
        """A random start pose (3,): x, y (m), heading (rad).

        Uniform over the largest connected part of the space where a disc of `radius` keeps `margin`
        (m) to all walls; where there is none, the margin is halved, in the end given up.

        Raises:
            InvalidFloorPlanError: the disc fits nowhere.
        """
        _checked_radius(margin)
        for share in (1.0, 0.5, 0.25, 0.0):
            need = radius + share * margin
            part = self.largest_part(need)
            if not part.is_empty:
                x, y = self._sample_point(rng, part, need)
                return np.array([x, y, -rng.uniform(-math.pi, math.pi)])
        raise InvalidFloorPlanError(f"{self.name}: no room for a robot of radius {radius:g} m")

    def _sample_point(self, rng: np.random.Generator, part: shapely.Polygon, need: float) -> tuple[float, float]:
        x0, y0, x1, y1 = part.bounds
        for _ in range(2000):
            points = rng.uniform((x0, y0), (x1, y1), size=(64, 2))
            inside = np.flatnonzero(shapely.contains_xy(part, points[:, 0], points[:, 1]))
            # The buffer's arcs are polygons and a little too generous: the distance decides.
            for i in inside:
                if self.clearance(points[i])[0] >= need:
                    return float(points[i, 0]), float(points[i, 1])
        # A part so thin that 128,000 points of its bounding box missed it.
        point = part.representative_point()
        return point.x, point.y

    def check_start(self, pose: Sequence[float] | np.ndarray, radius: float) -> None:
        """Check that a disc of `radius` (m) can stand at `pose` (x, y and perhaps a heading) and leave it.

        Raises:
            InvalidFloorPlanError: in a wall, outside, too close to a wall, cut off, or not a pose.
        """
        _checked_radius(radius)
        try:
            values = np.asarray(pose, dtype=np.float64)
        except (TypeError, ValueError):
            values = np.empty(0)
        if values.shape not in ((2,), (3,)) or not np.isfinite(values).all():
            raise InvalidFloorPlanError(
                f"{self.name}: start {shorten(pose)}: expected finite numbers x, y and a heading"
            )
        where = f"{self.name}: start ({values[0]:g}, {values[1]:g})"
        clearance = float(self.clearance(values[:2])[0])
        if clearance < 0:
            raise InvalidFloorPlanError(
                f"{where} lies in a wall or outside the plan, {-clearance:.3f} m from free space"
            )
        # 1 um for a start computed to touch.
        if clearance < radius - 1e-6:
            raise InvalidFloorPlanError(f"{where} has {clearance:.3f} m clearance; the robot's radius is {radius:g} m")
        parts = list(polygons(self.free_space(radius)))
        if len(parts) > 1:
            point = shapely.Point(values[:2])
            own = min(parts, key=lambda p: (p.distance(point), -p.area))
            if own.area < max(p.area for p in parts):
                raise InvalidFloorPlanError(
                    f"{where} is cut off from most of the free space for a robot of radius {radius:g} m"
                )

    def check_connected(self, radius: float) -> None:
        """Check that a robot of `radius` (m) reaches all of the free space but negligible pockets.

        A passage counts from `PASSABLE` times the robot's width. A pocket is negligible below `POCKET_AREA` and
        `POCKET_SHARE` of where the disc's centre may be. `load_plan` trims larger ones, with a warning, when it is
        given a radius.

        Raises:
            InvalidFloorPlanError: naming the narrow place.
        """
        parts = sorted(polygons(self.free_space(PASSABLE * radius)), key=lambda p: -p.area)
        if not parts:
            x0, y0, x1, y1 = self.bounds
            raise InvalidFloorPlanError(
                f"{self.name}: no room for a robot of radius {radius:g} m in a plan of {x1 - x0:.3g} x {y1 - y0:.3g} m"
            )
        if pockets(parts):
            near, far = shapely.ops.nearest_points(parts[0], parts[1])
            x, y = (near.x + far.x) / 2, (near.y + far.y) / 2
            ring, vertex = self._nearest_vertex(x, y)
            raise InvalidFloorPlanError(
                f"{self.name}: {ring}, vertex {vertex}: the free space is not connected for a robot of radius "
                f"{radius:g} m; {parts[1].area:.2f} m2 are cut off at ({x:.2f}, {y:.2f}); load_plan with "
                f"radius={radius:g} leaves them out"
            )

    def _nearest_vertex(self, x: float, y: float) -> tuple[str, int]:
        vertices = np.concatenate(self.rings)
        k = int(np.argmin(np.hypot(vertices[:, 0] - x, vertices[:, 1] - y)))
        for i, ring in enumerate(self.rings):
            if k < len(ring):
                return ("exterior" if i == 0 else f"hole {i - 1}"), k
            k -= len(ring)
        raise AssertionError("unreachable")


def pockets(parts: Sequence[shapely.Polygon]) -> list[shapely.Polygon]:
    """Of the parts of a disc's free space, largest first, those that are cut off and not negligible."""
    limit = min(POCKET_AREA, POCKET_SHARE * sum(part.area for part in parts))
    return [part for part in parts[1:] if part.area >= limit]


def _checked_radius(radius: float) -> float:
    if not (math.isfinite(radius) and radius >= 0):
        raise ValueError(f"radius or margin {radius!r}: must be a finite number of metres, not negative")
    return float(radius)


def polygons(geometry: Any) -> Iterator[shapely.Polygon]:
    """The polygons of a geometry that are not empty."""
    for part in shapely.get_parts(geometry):
        if part.geom_type == "Polygon" and not part.is_empty:
            yield part


def _canonical_bytes(ring: np.ndarray) -> bytes:
    units = np.rint(ring / _HASH_UNIT).astype("<i8")
    first = int(np.lexsort((units[:, 1], units[:, 0]))[0])
    return np.roll(units, -first, axis=0).tobytes()
