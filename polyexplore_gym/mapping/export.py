"""The line map of a log on disk: JSON, GeoJSON and pictures. Matplotlib is imported when first needed.

JSON:

    {"name", "units": "m", "scans", "points", "compression", "median_distance",
     "lines": [{"rho", "alpha", "covariance": [[aa, ar], [ar, rr]], "segments": [[x1, y1, x2, y2], ...]}, ...],
     "fragments": [[x1, y1, x2, y2], ...]}

rho and alpha (m, rad) as in x cos(alpha) + y sin(alpha) = rho, the covariance in the order (alpha, rho). The free space
lies to the left of a segment, seen from its first point. GeoJSON (RFC 7946, but planar metres): a LineString a segment,
with the properties `kind` (wall or fragment), and of a wall `line` (index), `rho`, `alpha` and `sigma` (m, across it).
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from polyexplore_gym import robot_map
from polyexplore_gym.errors import MissingDependencyError, RenderingError
from polyexplore_gym.mapping.log_map import LogMap

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAP_SUFFIXES = (".json", ".geojson", ".svg", ".png", ".yaml")
"""What `save_map` writes; a .yaml, for ROS map_server, with a .pgm beside it."""
_WALL, _FRAGMENT, _POINT, _PATH, _INK = "#1f1f1f", "#d55e00", "#c4c4c4", "#0072b2", "#333333"
_MOST_POINTS = 200_000
"""Of more returns than these only some are drawn."""


def save_map(log_map: LogMap, path: str | Path, *, name: str = "line map", width: int = 1600) -> None:
    """Write a line map; the suffix decides the format (.json, .geojson, .svg, .png, or .yaml with a .pgm beside it).

    Args:
        log_map: of `map_log`.
        path: file to write.
        name: of the map, in the file.
        width: of a .png, pixels.

    Raises:
        MissingDependencyError: a picture, and matplotlib is not installed.
        RenderingError: the suffix is none of these, the map is too large for an image, or the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in MAP_SUFFIXES:
        raise RenderingError(f"{path}: a line map is saved as {', '.join(MAP_SUFFIXES)}")
    try:
        if suffix in (".json", ".geojson"):
            content = to_mapping(log_map, name) if suffix == ".json" else to_geojson(log_map, name)
            path.write_text(json.dumps(content, allow_nan=False) + "\n", encoding="utf-8")
            return
        if suffix == ".yaml":
            image, corner = occupancy(log_map, robot_map.RESOLUTION)
            robot_map.write(path, image, robot_map.RESOLUTION, corner, name)
            return
        figure = map_figure(log_map, name, width)
        import matplotlib

        # Text as text and no date, so that the same map gives the same file.
        with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "polyexplore"}):
            figure.savefig(path, dpi=figure.dpi, metadata={"Date": None} if suffix == ".svg" else {})
    except OSError as error:
        raise RenderingError(f"{path}: cannot be written: {error.strerror or error}") from error


def occupancy(log_map: LogMap, resolution: float) -> tuple[np.ndarray, tuple[float, float]]:
    """The line map as an image of a robot map (h, w), uint8, and its lower left corner, m.

    Occupied is where a wall or fragment runs, free what a beam passed through on its way to a return, the rest unknown.

    Raises:
        RenderingError: the image would be too large.
    """
    import cv2

    ends = np.concatenate([log_map.segments, log_map.fragments])
    corners = np.concatenate([log_map.points, log_map.path[:, :2], ends.reshape(-1, 2)])
    try:
        height, width, corner = robot_map.raster(corners.min(axis=0), corners.max(axis=0), resolution)
    except ValueError as error:
        raise RenderingError(str(error)) from error
    image = np.full((height, width), robot_map.UNKNOWN, np.uint8)

    def pixels(points: np.ndarray) -> np.ndarray:
        """Columns and rows (n, 2)."""
        across = np.floor((points - corner) / resolution).astype(np.int32)
        return np.column_stack([across[:, 0], height - 1 - across[:, 1]])

    beams = np.stack([pixels(log_map.path[:, :2])[log_map.point_scan], pixels(log_map.points)], axis=1)
    walls = np.stack([pixels(ends[:, :2]), pixels(ends[:, 2:])], axis=1)
    cv2.polylines(image, list(np.unique(beams, axis=0)), False, robot_map.FREE)
    cv2.polylines(image, list(walls), False, robot_map.OCCUPIED)
    return image, corner


def to_mapping(log_map: LogMap, name: str) -> dict[str, Any]:
    """The JSON's content; ends are rounded to 0.1 mm."""
    lines = [
        {
            "rho": float(log_map.rho[i]),
            "alpha": float(log_map.alpha[i]),
            "covariance": log_map.covariance[i].tolist(),
            "segments": log_map.segments[log_map.segment_line == i].round(4).tolist(),
        }
        for i in range(log_map.rho.size)
    ]
    median = log_map.median_distance
    return {
        "name": name,
        "units": "m",
        "scans": len(log_map.path),
        "points": len(log_map.points),
        "compression": log_map.compression,
        "median_distance": median if math.isfinite(median) else None,
        "lines": lines,
        "fragments": log_map.fragments.round(4).tolist(),
    }


def to_geojson(log_map: LogMap, name: str) -> dict[str, Any]:
    """The GeoJSON's content; ends are rounded to 0.1 mm."""

    def feature(ends: np.ndarray, properties: dict[str, Any]) -> dict[str, Any]:
        geometry = {"type": "LineString", "coordinates": ends.reshape(2, 2).round(4).tolist()}
        return {"type": "Feature", "properties": properties, "geometry": geometry}

    walls = [
        feature(
            ends,
            {
                "kind": "wall",
                "line": int(i),
                "rho": float(log_map.rho[i]),
                "alpha": float(log_map.alpha[i]),
                "sigma": float(sigma),
            },
        )
        for ends, i, sigma in zip(log_map.segments, log_map.segment_line, log_map.segment_sigma, strict=True)
    ]
    fragments = [feature(ends, {"kind": "fragment"}) for ends in log_map.fragments]
    return {"type": "FeatureCollection", "name": name, "units": "m", "features": walls + fragments}


def map_figure(log_map: LogMap, name: str, width: int = 1600) -> Figure:
    """Walls, fragments, returns and the way of the laser, true to scale.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    try:
        from matplotlib.collections import LineCollection
        from matplotlib.figure import Figure
    except ImportError as error:
        hint = 'pip install "polyexplore-gym[plots]"'
        raise MissingDependencyError(f"this needs matplotlib, which is not installed: {hint}") from error

    # What is far outside the walls and the way, a few stray returns, is left out of the frame.
    ends = np.concatenate([log_map.segments.reshape(-1, 2), log_map.path[:, :2]])
    low, high = ends.min(axis=0), ends.max(axis=0)
    margin = 0.02 * float(max(high - low)) + 0.3
    low, high = low - margin, high + margin
    inches, below = 10.0, 0.55
    size = high - low
    shape = float(np.clip(size[1] / size[0], 0.3, 1.6))
    figure = Figure(figsize=(inches, inches * shape + below), dpi=max(width, 100) / inches, facecolor="white")
    ax = figure.add_axes((0.0, below / (inches * shape + below), 1.0, inches * shape / (inches * shape + below)))
    scale = max(size[0] / inches, size[1] / (inches * shape))  # metres an inch
    centre = (low + high) / 2
    ax.set_axis_off()
    ax.set_xlim(centre[0] - scale * inches / 2, centre[0] + scale * inches / 2)
    ax.set_ylim(centre[1] - scale * inches * shape / 2, centre[1] + scale * inches * shape / 2)

    thin = max(1, -(-len(log_map.points) // _MOST_POINTS))
    dots: dict[str, Any] = {"linestyle": "", "marker": ".", "markeredgewidth": 0, "rasterized": True}
    ax.plot(*log_map.points[::thin].T, color=_POINT, markersize=1.5, zorder=1, **dots)
    ax.plot(*log_map.path[:, :2].T, color=_PATH, markersize=3.5, zorder=2, **dots)
    for pieces, color, thick in ((log_map.fragments, _FRAGMENT, 0.8), (log_map.segments, _WALL, 1.3)):
        thick = max(thick, 1.2 * 72.0 / figure.dpi)  # at least a pixel, or it turns grey
        ax.add_collection(LineCollection(list(pieces.reshape(-1, 2, 2)), colors=color, linewidths=thick, zorder=3))

    def note(x: float, text: str, color: str = _INK, **style: Any) -> None:
        figure.text(x, 0.5 * below / (inches * shape + below), text, color=color, va="center", **style)

    note(0.015, name if len(name) <= 40 else name[:39] + "…", size=10, weight="bold")
    note(0.40, f"{log_map.rho.size} lines", _WALL, size=9)
    note(0.50, f"{len(log_map.fragments)} fragments", _FRAGMENT, size=9)
    note(0.64, f"{len(log_map.path)} scans", _PATH, size=9)
    note(0.74, f"{len(log_map.points)} points", "#7d7d7d", size=9)
    length = 10 ** math.floor(math.log10(0.2 * scale * inches))
    length *= max(f for f in (1, 2, 5) if f * length <= 0.2 * scale * inches)
    bar = length / (scale * inches)
    y = 0.3 * below / (inches * shape + below)
    from matplotlib.lines import Line2D

    figure.add_artist(Line2D([0.985 - bar, 0.985], [y, y], color=_INK, linewidth=1.5))
    figure.text(0.985 - bar / 2, 1.25 * y, f"{length:g} m", color=_INK, size=8, ha="center", va="bottom")
    return figure
