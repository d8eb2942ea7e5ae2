"""Robot maps as ROS map_server reads them: a yaml and a .pgm beside it, free 254, occupied 0, unknown 205."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

FREE, OCCUPIED, UNKNOWN = 254, 0, 205
"""Brightness of pixels, as map savers write them."""
RESOLUTION = 0.05
"""Side of a pixel, m, unless told."""
MAX_PIXELS = 100_000_000
"""Largest image read or written."""
# By these a pixel of UNKNOWN, occupancy 0.196, is neither.
_THRESHOLDS = {"occupied_thresh": 0.65, "free_thresh": 0.196}


def raster(low: np.ndarray, high: np.ndarray, resolution: float) -> tuple[int, int, tuple[float, float]]:
    """Height, width and lower left corner (m) of the image of a box, with two pixels to spare on each side.

    Raises:
        ValueError: the resolution is no length, or the image has more than `MAX_PIXELS`.
    """
    if not (math.isfinite(resolution) and 0 < resolution <= 10):
        raise ValueError(f"resolution {resolution!r}: must lie in (0, 10] m")
    width, height = (math.ceil(round(float(side) / resolution, 6)) + 4 for side in high - low)
    if width * height > MAX_PIXELS:
        raise ValueError(
            f"{width} x {height} pixels of {resolution:g} m, more than {MAX_PIXELS}: take a larger resolution"
        )
    return height, width, (float(low[0]) - 2 * resolution, float(low[1]) - 2 * resolution)


def write(path: Path, image: np.ndarray, resolution: float, corner: tuple[float, float], name: str) -> None:
    """Write the yaml at `path` and the image (h, w), uint8, beside it; `corner`: its lower left corner, m."""
    height, width = image.shape
    pgm = path.with_suffix(".pgm")
    pgm.write_bytes(b"P5\n%d %d\n255\n" % (width, height) + image.tobytes())
    comment = "".join(character if character.isprintable() else " " for character in name)
    thresholds = "".join(f"{key}: {value}\n" for key, value in _THRESHOLDS.items())
    text = (
        f"# {comment}\nimage: {json.dumps(pgm.name)}\nmode: trinary\nresolution: {resolution!r}\n"
        f"origin: [{corner[0]!r}, {corner[1]!r}, 0.0]\nnegate: 0\n{thresholds}"
    )
    path.write_text(text, encoding="utf-8")
