"""Units of length of plan files, and guesses where none are given."""

from __future__ import annotations

import math
import reprlib

import numpy as np

from polyexplore_gym.errors import InvalidFloorPlanError

UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Metres a unit."""
DEGREES = "deg"
"""Longitude and latitude: GeoJSON only."""
LARGE_AREA = 30_000.0
"""Above this area a file that states no units is doubted, m2: 3 m2 in centimetres, 19 m2 in inches."""
FAR = 10_000.0
"""Coordinates beyond this, m, are those of a survey if the plan itself is smaller."""
SMALL_SPAN = 0.02
"""A plan no larger than this is no building in metres, but may be one in degrees (2 km)."""
# What a floor may measure, m2, and how long it may be, m.
_FLOOR, _LONGEST = (3.0, 20_000.0), 400.0


def metres(units: object) -> float:
    """Metres a unit: of a name in `UNITS`, or of a positive number (also as text).

    Raises:
        InvalidFloorPlanError: neither.
    """
    if isinstance(units, str) and units in UNITS:
        return UNITS[units]
    try:
        factor = math.nan if isinstance(units, bool) else float(units)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        factor = math.nan
    if not (math.isfinite(factor) and 1e-9 < factor < 1e9):
        raise InvalidFloorPlanError(
            f"units {reprlib.repr(units)}: expected one of {', '.join(UNITS)}, or a number, metres a unit"
        )
    return factor


def offset(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """What is taken off coordinates (2,) of a survey, which lie far from the origin, whole metres; else zeros."""
    far = max(np.abs(low).max(), np.abs(high).max()) > FAR and (high - low).max() < FAR
    return np.floor(low) if far else np.zeros(2)


def offset_text(taken: np.ndarray) -> str:
    """What is said of it, as the end of a message."""
    return f"coordinates are those of a survey: ({taken[0]:g}, {taken[1]:g}) m is taken off all of them (meta 'offset')"


def guess(width: float, height: float) -> str:
    """What a plan of this size, m, would be in other units, as the end of a message; empty when none fits."""
    fits = [
        f"{name}: {width * UNITS[name]:.3g} x {height * UNITS[name]:.3g} m"
        for name in ("mm", "cm", "in", "ft")
        if _FLOOR[0] <= width * height * UNITS[name] ** 2 <= _FLOOR[1] and max(width, height) * UNITS[name] <= _LONGEST
    ]
    return f" (in {', in '.join(fits)}: say so with units, --units)" if fits else ""
