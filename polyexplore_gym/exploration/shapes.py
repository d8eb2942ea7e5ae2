"""The exploration as shapely polygons and GeoJSON. Off the hot path: nothing here is part of a decision."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from polyexplore_gym.exploration.map import ExplorationMap
from polyexplore_gym.scan import Scan

if TYPE_CHECKING:
    import shapely


def scan_points(scan: Scan, max_range: float) -> np.ndarray:
    """End points (n, 2) of the beams in the map frame, those without a return at the maximum range."""
    r = np.minimum(scan.ranges, max_range)
    a = scan.pose[2] + scan.angles
    return scan.pose[:2] + np.stack((r * np.cos(a), r * np.sin(a)), axis=1)


def scan_polygon(exploration: ExplorationMap, index: int) -> shapely.Polygon:
    """The polygon of one scan, valid (noise may fold it at the end of a range discontinuity)."""
    import shapely

    scans = exploration.scans
    corners = scans.points[index] + scans.apexes[index]
    if not scans.full:
        corners = np.concatenate((scans.apexes[index][None], corners))
    return shapely.Polygon(corners).buffer(0)


def exploration_polygon(exploration: ExplorationMap) -> Any:
    """The union of all scan polygons: a Polygon, or a MultiPolygon."""
    import shapely

    return shapely.union_all([scan_polygon(exploration, s) for s in range(exploration.n_scans)])


def extended_polygon(exploration: ExplorationMap) -> Any:
    """The exploration polygon extended by its jump edges: each open stretch closed by one straight edge.

    The area between a jump edge and the straight line through its two ends is added.
    """
    import shapely

    pockets = [shapely.Polygon(line).buffer(0) for line in jump_edges(exploration) if len(line) >= 3]
    return shapely.union_all([exploration_polygon(exploration), *pockets])


def faithful_polygon(exploration: ExplorationMap, walls: np.ndarray, reach: float | None = None) -> Any:
    """The explored area bounded by the fitted walls (m, 4): noisy boundary points are moved onto them.

    A boundary point within `reach` (default: the distance at which walls cover open edges) of a wall
    is projected onto it; what then lies on one line is one edge.
    """
    import shapely

    reach = exploration.tol.cover if reach is None else reach
    area = exploration_polygon(exploration)
    if not len(walls):
        return area
    lines = shapely.linestrings(walls.reshape(-1, 2, 2))
    tree = shapely.STRtree(lines)

    def onto(xy: np.ndarray) -> np.ndarray:
        points = shapely.points(xy)
        out = xy.copy()
        which, near = tree.query_nearest(points, max_distance=reach, all_matches=False)
        moved = shapely.line_interpolate_point(lines[near], shapely.line_locate_point(lines[near], points[which]))
        out[which] = shapely.get_coordinates(moved)
        return out

    return shapely.simplify(shapely.transform(area, onto).buffer(0), 0.25 * reach)


def jump_edges(exploration: ExplorationMap) -> tuple[np.ndarray, ...]:
    """The jump edges as polylines (k, 2)."""
    lines = []
    for chain in exploration.chains.id:
        pieces = exploration.pieces.segments[exploration.pieces.owner == chain]
        points = [pieces[0, :2]]
        for piece in pieces:
            if math.hypot(*(piece[:2] - points[-1])) > 1e-9:
                points.append(piece[:2])
            points.append(piece[2:])
        lines.append(np.array(points))
    return tuple(lines)


def rings(area: Any) -> tuple[tuple[np.ndarray, tuple[np.ndarray, ...]], ...]:
    """A shapely area as (exterior, holes) arrays; rings not closed."""
    import shapely

    return tuple(
        (np.array(p.exterior.coords)[:-1], tuple(np.array(h.coords)[:-1] for h in p.interiors))
        for p in shapely.get_parts(area)
        if p.geom_type == "Polygon" and not p.is_empty
    )


def to_geojson(exploration: ExplorationMap, walls: np.ndarray) -> dict[str, Any]:
    """Exploration, extended and faithful polygon, jump edges and nodes as a GeoJSON FeatureCollection (m)."""
    import shapely

    features = [
        _feature(shapely.geometry.mapping(shape), {"kind": kind})
        for kind, shape in (
            ("exploration_polygon", exploration_polygon(exploration)),
            ("extended_polygon", extended_polygon(exploration)),
            ("faithful_polygon", faithful_polygon(exploration, walls)),
        )
    ]
    c = exploration.chains
    for i, line in enumerate(jump_edges(exploration)):
        features.append(
            _feature(
                {"type": "LineString", "coordinates": line.tolist()},
                {
                    "kind": "jump_edge",
                    "length": float(c.length[i]),
                    "node": c.node[i].tolist() if c.vertex[i] >= 0 else None,
                    "reachable": bool(np.isfinite(c.path_length[i])),
                },
            )
        )
    return {"type": "FeatureCollection", "features": features}


def _feature(geometry: dict[str, Any], properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry, "properties": properties}
