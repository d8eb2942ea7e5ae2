"""One laser scan, as the robot knows it: beams and the estimated pose. Nothing of the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Scan:
    """Ranges of one measurement and where the robot believes it stood.

    A range of `inf` is a beam without a return: free space up to the maximum range, never a
    point on a wall.
    """

    angles: np.ndarray
    """(n,) nominal beam angles in the robot frame, rad, strictly increasing."""
    ranges: np.ndarray
    """(n,) measured ranges, m; inf where nothing returned."""
    pose: np.ndarray
    """(3,) estimated x, y (m) and heading (rad) in the map frame."""
    covariance: np.ndarray
    """(3, 3) covariance of the pose, m2, m rad, rad2; zero when the pose is exact."""
    full_circle: bool = False
    """Whether the beams go all the way round, so that the last neighbours the first."""
