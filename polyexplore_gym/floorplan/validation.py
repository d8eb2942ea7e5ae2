"""Checks and normal form of a floor plan's rings.

Every failure is an `InvalidFloorPlanError` that names the ring, the vertex (index in the input) and
the reason. Nothing is repaired but what has one meaning only: a closing vertex, repeated vertices
and the ring's direction.
"""

from __future__ import annotations

import difflib
import math
import reprlib
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
import shapely

from polyexplore_gym.errors import FloorPlanWarning, InvalidFloorPlanError
from polyexplore_gym.floorplan.units import FAR, guess

MAX_VERTICES = 20_000
"""Most vertices of a plan, all rings together."""
MAX_COORDINATE = FAR
"""Largest absolute coordinate, m."""
MAX_EXTENT = 1_000_000.0
"""Largest bounding box, m2 (1 km2): its sample points for the share seen, 25 a square metre, take 1.4 GB."""
MERGE_DISTANCE = 1e-6
"""Neighbouring vertices closer than this are one repeated vertex, m."""
MIN_AREA = 1e-6
"""Smallest area of a ring, m2."""
# Edges per query of the crossing search: bounds the memory when every edge crosses every other.
_BLOCK = 64
_REPR = reprlib.Repr()
_REPR.maxlevel = 2


def fail(ring: str, vertex: int | None, reason: str) -> NoReturn:
    """Raise `InvalidFloorPlanError` for a ring, at a vertex if one is to blame."""
    where = ring if vertex is None else f"{ring}, vertex {vertex}"
    raise InvalidFloorPlanError(f"{where}: {reason}")


def normalise(exterior: Any, holes: Any) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Rings in normal form: float64 (n, 2), open, without repeats, exterior CCW, holes CW.

    Args:
        exterior: n points x, y in metres, an array or nested sequences, closed or not.
        holes: a sequence of such rings.

    Raises:
        InvalidFloorPlanError: naming ring, vertex and reason.
    """
    if isinstance(holes, (str, bytes)) or not isinstance(holes, (Sequence, np.ndarray)):
        fail("holes", None, f"expected a list of rings, got {type(holes).__name__}")
    names = ["exterior", *(f"hole {i}" for i in range(len(holes)))]
    rings, indices, total = [], [], 0
    for name, points in zip(names, [exterior, *holes], strict=True):
        total += _length(points, name)
        if total > MAX_VERTICES:
            fail(name, None, f"too many vertices: more than {MAX_VERTICES} in all")
        array = to_array(points, name)
        _check_limits(array, name)
        ring, index = _without_repeats(array, name)
        _check_not_collinear(ring, index, name)
        rings.append(ring)
        indices.append(index)
    _check_folds(rings, indices, names)
    _check_crossings(rings, indices, names)
    for k, (name, ring) in enumerate(zip(names, rings, strict=True)):
        area = signed_area(ring)
        if abs(area) < MIN_AREA:
            fail(name, None, "the ring has zero area")
        if (area > 0) != (k == 0):
            rings[k] = ring[::-1].copy()
            indices[k] = indices[k][::-1]
    _check_nesting(rings, indices, names)
    for ring in rings:
        ring.setflags(write=False)
    return rings[0], tuple(rings[1:])


def shorten(value: Any) -> str:
    """A value as text for a message, short and quick to make whatever its size and nesting."""
    text = _REPR.repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def check_keys(data: Mapping[Any, Any], known: Sequence[str], where: str) -> None:
    """What a file says and nobody reads: an error if it looks like a slip of the pen, else a warning.

    Raises:
        InvalidFloorPlanError: naming the key and the one that is meant.
    """
    others = []
    for key in data:
        if not isinstance(key, str) or key in known:
            continue
        near = difflib.get_close_matches(key.lower()[:60], known, n=1, cutoff=0.75)
        if near and near[0] not in data:
            raise InvalidFloorPlanError(f"{shorten(key)}: unknown key; is {near[0]!r} meant?")
        others.append(key)
    if others:
        names = ", ".join(shorten(key) for key in others[:5]) + (", ..." if len(others) > 5 else "")
        warnings.warn(f"{where}: not read: {names}; known: {', '.join(known)}", FloorPlanWarning, stacklevel=2)


def signed_area(ring: np.ndarray) -> float:
    """Area of a ring (n, 2), m2; positive when counter-clockwise."""
    p = ring - ring[0]
    q = np.roll(p, -1, axis=0)
    return 0.5 * float(np.sum(p[:, 0] * q[:, 1] - q[:, 0] * p[:, 1]))


def _length(points: Any, name: str) -> int:
    if isinstance(points, (str, bytes)) or not isinstance(points, (Sequence, np.ndarray)):
        fail(name, None, f"expected a list of points, got {type(points).__name__}")
    if isinstance(points, np.ndarray) and (points.ndim != 2 or points.shape[1] != 2 or points.dtype.kind not in "iuf"):
        fail(name, None, f"expected an (n, 2) array of numbers, got shape {points.shape} of {points.dtype}")
    return len(points)


def to_array(points: Any, name: str) -> np.ndarray:
    """(n, 2) finite coordinates, or an error naming the first bad vertex."""
    _length(points, name)
    if not isinstance(points, np.ndarray):
        points = [_to_point(point, name, i) for i, point in enumerate(points)]
    ring = np.array(points, dtype=np.float64).reshape(-1, 2)
    bad = ~np.isfinite(ring).all(axis=1)
    if bad.any():
        i = int(np.argmax(bad))
        value = "NaN" if np.isnan(ring[i]).any() else "infinite"
        fail(name, i, f"the coordinate is {value}")
    return ring


def _check_limits(ring: np.ndarray, name: str) -> None:
    """No coordinate and no ring may be larger than a plan that can be held."""
    bad = (np.abs(ring) > MAX_COORDINATE).any(axis=1)
    width, height = np.ptp(ring, axis=0).tolist() if len(ring) else (0.0, 0.0)
    if bad.any():
        i = int(np.argmax(bad))
        where = f"({ring[i, 0]:g}, {ring[i, 1]:g}) lies beyond {MAX_COORDINATE / 1000:g} km"
        fail(name, i, f"{where}; units are metres{guess(width, height)}")
    if width * height > MAX_EXTENT:
        fail(
            name,
            None,
            f"spans {width:g} x {height:g} m, more than {MAX_EXTENT / 1e6:g} km2, which is too large to hold; units "
            f"are metres{guess(width, height)}",
        )


def _to_point(point: Any, name: str, i: int) -> tuple[float, float]:
    if isinstance(point, (str, bytes)) or not isinstance(point, (Sequence, np.ndarray)) or len(point) != 2:
        fail(name, i, f"expected two numbers x, y, got {shorten(point)}")
    for value in point:
        if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating)):
            fail(name, i, f"expected a number, got {shorten(value)}")
    try:
        return float(point[0]), float(point[1])
    except OverflowError:
        fail(name, i, f"the coordinate lies beyond {MAX_COORDINATE / 1000:g} km; units are metres")


def _without_repeats(ring: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """The ring without repeated neighbours and closing vertex, and the kept input indices."""
    kept: list[int] = []
    points = ring.tolist()
    for i, point in enumerate(points):
        if not kept or math.dist(point, points[kept[-1]]) > MERGE_DISTANCE:
            kept.append(i)
    while len(kept) > 1 and math.dist(points[kept[0]], points[kept[-1]]) <= MERGE_DISTANCE:
        kept.pop()
    if len(kept) < 3:
        fail(name, None, f"a ring needs at least 3 different points, got {len(kept)}")
    index = np.array(kept)
    return ring[index], index


def _check_not_collinear(ring: np.ndarray, index: np.ndarray, name: str) -> None:
    offset = ring - ring[0]
    distance = np.hypot(offset[:, 0], offset[:, 1])
    far = int(np.argmax(distance))
    off_line = np.abs(offset[:, 0] * offset[far, 1] - offset[:, 1] * offset[far, 0]) / distance[far]
    if off_line.max() <= MERGE_DISTANCE:
        fail(name, int(index[far]), "all points are collinear, so the ring has zero area")


def _check_folds(rings: list[np.ndarray], indices: list[np.ndarray], names: list[str]) -> None:
    """No edge may run back over the edge before it."""
    for ring, index, name in zip(rings, indices, names, strict=True):
        before, after = np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0)
        arriving = shapely.linestrings(np.stack([before, ring], axis=1))
        leaving = np.roll(arriving, -1)
        folded = shapely.intersects(arriving, shapely.points(after)) | shapely.intersects(
            leaving, shapely.points(before)
        )
        if folded.any():
            fail(name, int(index[np.argmax(folded)]), "the ring runs back over itself")


def _check_crossings(rings: list[np.ndarray], indices: list[np.ndarray], names: list[str]) -> None:
    """No ring may cross or touch itself; two rings may touch in points, not cross or share a stretch."""
    sizes = [len(ring) for ring in rings]
    first = np.repeat(np.cumsum([0, *sizes[:-1]]), sizes)
    owner = np.repeat(np.arange(len(rings)), sizes)
    number = np.arange(len(owner))
    follower = first + (number - first + 1) % np.repeat(sizes, sizes)
    index = np.concatenate(indices)
    vertices = np.concatenate(rings)
    edges = shapely.linestrings(np.stack([vertices, vertices[follower]], axis=1))
    tree = shapely.STRtree(edges)
    for block in range(0, len(edges), _BLOCK):
        i, j = tree.query(edges[block : block + _BLOCK], predicate="intersects")
        i = i + block
        keep = (i < j) & (follower[i] != j) & (follower[j] != i)
        i, j = i[keep], j[keep]
        if not i.size:
            continue
        # The lowest pair of edges, so that the message does not depend on the order of the tree.
        order = np.lexsort((j, i))
        i, j = i[order], j[order]
        itself = np.flatnonzero(owner[i] == owner[j])
        if itself.size:
            a, b = i[itself[0]], j[itself[0]]
            verb = _relation(edges[a], edges[b]) or "touches"
            reason = f"the edge after it {verb} the edge after vertex {index[b]}: the ring {verb} itself"
            fail(names[owner[a]], int(index[a]), reason)
        for a, b in zip(i, j, strict=True):
            if how := _relation(edges[a], edges[b]):
                reason = f"the edge after it {how} the edge of {names[owner[a]]} after its vertex {index[a]}"
                fail(names[owner[b]], int(index[b]), reason)


def _relation(edge: shapely.LineString, other: shapely.LineString) -> str | None:
    """How two edges that meet do so; None when an end point merely touches."""
    if shapely.relate_pattern(edge, other, "0********"):
        return "crosses"
    return "runs along" if shapely.relate_pattern(edge, other, "1********") else None


def _check_nesting(rings: list[np.ndarray], indices: list[np.ndarray], names: list[str]) -> None:
    """Holes lie within the exterior, apart from each other, and leave the free space in one piece."""
    outer = shapely.Polygon(rings[0])
    if len(rings) > 1:
        shapely.prepare(outer)
        holes = np.array([shapely.Polygon(ring) for ring in rings[1:]])
        for k in np.flatnonzero(~shapely.covers(outer, holes)):
            outside = ~shapely.covers(outer, shapely.points(rings[k + 1]))
            vertex = int(indices[k + 1][np.argmax(outside)]) if outside.any() else None
            reason = "the hole lies outside the exterior" if outside.all() else "the hole reaches beyond the exterior"
            fail(names[k + 1], vertex, reason)
        i, j = shapely.STRtree(holes).query(holes, predicate="intersects")
        i, j = i[i < j], j[i < j]
        overlap = ~shapely.touches(holes[i], holes[j])
        if overlap.any():
            pairs = np.stack([i[overlap], j[overlap]], axis=1)
            a, b = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))[0]]
            if shapely.contains(holes[b], holes[a]):
                a, b = b, a
            relation = "lies inside" if shapely.contains(holes[a], holes[b]) else "overlaps"
            fail(names[b + 1], int(indices[b + 1][0]), f"the hole {relation} {names[a + 1]}")
    if not shapely.is_valid(shapely.Polygon(rings[0], rings[1:])):
        # Everything else is excluded above: rings that touch each other in several points.
        fail(names[-1], None, "holes touching each other or the exterior cut the free space apart")
