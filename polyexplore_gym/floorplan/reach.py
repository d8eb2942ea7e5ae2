"""Which part of a floor a robot reaches, and what is said of the rest: the same rule for all file formats.

The part with the start, else the largest, is kept. What is cut off for the robot's disc (`model.PASSABLE` times its
radius) is left out with a warning when it is not negligible (`model.pockets`), and refused when less than `LEAST`
would stay, unless a start says which part is meant.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import shapely
import shapely.ops

from polyexplore_gym.errors import FloorPlanWarning, InvalidFloorPlanError
from polyexplore_gym.floorplan.model import PASSABLE, pockets, polygons
from polyexplore_gym.floorplan.validation import MIN_AREA

LEAST = 0.45
"""Less than this share of the floor is not taken for the plan. A half stays of two equal rooms with a narrow door."""
_GOOD = 0.95
"""The remedy that is named is the radius that keeps this share."""
STEPS = 64
"""The radius is divided so finely in the search for passages."""
# Corners of the reached area that are lost to its coarse arcs, as a share of the radius.
_SLACK = 1.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Loss:
    """What a plan lost because the robot cannot reach it."""

    kept: float
    """Share of the floor that stays, 0 to 1."""
    area: float
    """Area that stays, m2."""
    largest: float
    """Area of the largest part left out, m2; 0 when nothing is lost."""
    at: tuple[float, float]
    """A point in that part, m."""
    passage: float
    """Width of the narrowest passage on the widest way to it, m; 0: there is none."""
    passage_at: tuple[float, float]
    """Where the robot would be stopped on the way to it, m."""
    radius: float
    """The largest radius of a robot that would keep 95 %, m; 0: none would."""

    def text(self, radius: float) -> str:
        """What was lost for a robot of that radius, m, as the end of a message."""
        x, y = self.at
        lost = f"the largest part left out, {self.largest:.1f} m2 at ({x:.2f}, {y:.2f}), "
        if self.passage > 0:
            lost += f"lies behind a passage of {self.passage:.2f} m at ({self.passage_at[0]:.2f}, "
            lost += f"{self.passage_at[1]:.2f})"
        else:
            lost += "is not connected with it"
        enough = self.kept >= _GOOD
        # Rounded down, so that the radius named does what is promised.
        best = math.floor(1000 * (self.passage / (2 * PASSABLE) if enough else self.radius)) / 1000
        remedy = f"a radius of {best:g} m would " + ("reach it" if enough else f"keep {100 * _GOOD:.0f} %")
        remedy = remedy if best > 0 else "no radius would keep it"
        return (
            f"a robot of radius {radius:g} m reaches {100 * self.kept:.0f} % of the floor ({self.area:.1f} m2); "
            f"{lost}; {remedy}"
        )


def tell(loss: Loss, radius: float, *, where: str, chosen: bool, strict: bool) -> None:
    """Warn of a loss, or raise if it is too large.

    Args:
        loss: what the plan lost.
        radius: the robot's, m.
        where: the file, for the warning.
        chosen: a start says that this part is meant.
        strict: raise whatever was lost.

    Raises:
        InvalidFloorPlanError: strict, or less than `LEAST` of the floor is kept and nobody chose it.
    """
    text = loss.text(radius)
    if strict:
        raise InvalidFloorPlanError(f"{text} (strict: nothing may be left out)")
    if loss.kept < LEAST and not chosen:
        raise InvalidFloorPlanError(f"{text}. A start in the part that is meant (--start) chooses it")
    warnings.warn(f"{where}: {text}", FloorPlanWarning, stacklevel=2)


def trim(
    floor: Sequence[shapely.Polygon], radius: float, start: tuple[float, float] | None = None
) -> tuple[shapely.Polygon, Loss | None]:
    """The part of a floor that a robot reaches, and what was lost; None when nothing was but negligible pockets.

    Args:
        floor: valid polygons that do not overlap, m: one in most plans, several for rooms without a door.
        radius: of the robot, m; 0 keeps the polygon with the start, or the largest, as it is.
        start: a point of the part to keep.

    Raises:
        InvalidFloorPlanError: no room for the robot.
    """
    disc = PASSABLE * radius
    floor = [_without_specks(polygon) for polygon in floor]
    parts = _stands(floor, disc)
    if not parts:
        raise InvalidFloorPlanError(f"no room for a robot of radius {radius:g} m")
    main = parts[0]
    if start is not None:
        point = shapely.Point(start)
        main = min(parts, key=lambda part: (part.distance(point), -part.area))
        parts.remove(main)
        parts.insert(0, main)
    own = next(polygon for polygon in floor if polygon.intersects(main))
    lost = pockets(parts)
    if not lost:
        return own, None
    kept = _without_pockets(own, main, disc, [part for part in parts[1:] if own.intersects(part)])
    return kept, _loss(floor, kept, main, lost, disc)


def _stands(floor: Sequence[shapely.Polygon], disc: float, segments: int = 16) -> list[shapely.Polygon]:
    """Where the disc's centre may be, in parts, the largest first."""
    parts = [p for polygon in floor for p in polygons(polygon.buffer(-disc, quad_segs=segments) if disc else polygon)]
    return sorted(parts, key=lambda part: -part.area)


def _without_pockets(
    own: shapely.Polygon, main: shapely.Polygon, disc: float, cut_off: list[shapely.Polygon]
) -> shapely.Polygon:
    """The polygon without what lies beyond the main part's reach and holds parts that are cut off."""
    reach = main.buffer(_SLACK * disc, quad_segs=4)
    beyond = [part for part in polygons(own.difference(reach)) if any(part.intersects(other) for other in cut_off)]
    kept = _around(own.difference(shapely.union_all(beyond)) if beyond else own, main)
    if pockets(_main_first(_stands([kept], disc), main)):
        # The pockets lie within the reach of the main part: the mouths are all that is in between.
        kept = _around(own.intersection(main.buffer(disc)), main)
    return kept


def _around(geometry: shapely.Geometry, main: shapely.Polygon) -> shapely.Polygon:
    """The polygon of the geometry that holds the main part."""
    return _without_specks(max(polygons(geometry), key=lambda part: part.intersection(main).area))


def _without_specks(polygon: shapely.Polygon) -> shapely.Polygon:
    """Without the holes that are too small for a plan: unions and differences leave some where edges almost meet."""
    holes = [ring for ring in polygon.interiors if shapely.Polygon(ring).area >= MIN_AREA]
    return polygon if len(holes) == len(polygon.interiors) else shapely.Polygon(polygon.exterior, holes)


def _main_first(parts: list[shapely.Polygon], main: shapely.Polygon) -> list[shapely.Polygon]:
    point = main.representative_point()
    return sorted(parts, key=lambda part: (not part.contains(point), -part.area))


def _loss(
    floor: Sequence[shapely.Polygon],
    kept: shapely.Polygon,
    main: shapely.Polygon,
    lost: Sequence[shapely.Polygon],
    disc: float,
) -> Loss:
    rest = [part for polygon in floor for part in polygons(polygon.difference(kept))]
    largest = max(rest, key=lambda part: part.area)
    inside = [part for part in lost if part.intersects(largest)] or [lost[0]]
    home, away = main.representative_point(), max(inside, key=lambda part: part.area)
    target = away.representative_point()

    @cache
    def stands(step: int) -> list[shapely.Polygon]:
        return _main_first(_stands(floor, step / STEPS * disc, segments=4), main)

    def reaches(step: int) -> bool:
        return any(part.contains(home) and part.contains(target) for part in stands(step))

    def keeps(step: int) -> bool:
        return keeps_most([part.area for part in stands(step)])

    near, far = shapely.ops.nearest_points(main, away)
    step = last_true(reaches)
    return Loss(
        kept=kept.area / sum(polygon.area for polygon in floor),
        area=kept.area,
        largest=largest.area,
        at=(target.x, target.y),
        passage=2 * (step + 0.5) / STEPS * disc if step else 0.0,
        passage_at=((near.x + far.x) / 2, (near.y + far.y) / 2),
        radius=last_true(keeps) / STEPS * disc / PASSABLE,
    )


def keeps_most(areas: Sequence[float]) -> bool:
    """Whether the first of the areas is most of them."""
    return bool(areas[0] >= _GOOD * sum(areas))


def last_true(holds: Callable[[int], bool], steps: int = STEPS) -> int:
    """The largest step from 1 to `steps` - 1 at which something holds that holds at all smaller ones; 0 if at none."""
    low, high = 0, steps
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low
