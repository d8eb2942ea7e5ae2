"""The front end: each scan against those before it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from polyexplore_gym.mapping.logs.poses import compose
from polyexplore_gym.mapping.slam.align import align, target_of
from polyexplore_gym.mapping.slam.correlative import Window, field_of, search
from polyexplore_gym.mapping.slam.surface import Surface, merged

RECENT = 12
"""A scan is held against so many key scans before it."""
RETURNS = 240
"""So many returns of a scan are looked at in a search, evenly spread."""
PENALTY = 0.05
"""What a pose costs that is off the guess by a standard deviation, in terms of the mean likelihood of the returns."""
LEAST_SHARE = 0.3
"""A pose holds if so many of the points on lines have a counterpart ..."""
LEAST_MATCHED = 15
"""... and so many altogether."""


class Guess(NamedTuple):
    """Where the laser went from one scan to the next, before the scans are looked at."""

    step: np.ndarray
    """(3,) x, y (m), heading (rad) seen from the scan before."""
    reach: float
    """Standard deviation of x and y, m."""
    turn: float
    """Standard deviation of the heading, rad."""


class Matched(NamedTuple):
    """A scan in the map so far."""

    pose: np.ndarray
    """(3,) x, y (m), heading (rad)."""
    information: np.ndarray
    """(3, 3) of the pose in the frame of the map, from the walls alone; zero where they tell nothing."""
    holds: bool
    """Whether the scan was recognised; else the pose is the guess."""


def match(surface: Surface, before: list[Surface], poses: np.ndarray, last: np.ndarray, guess: Guess) -> Matched:
    """The pose of a scan, from the key scans before it.

    Args:
        surface: of the scan.
        before: surfaces of the key scans before it.
        poses: (k, 3) their poses.
        last: (3,) pose of the scan before it.
        guess: of the way from there.
    """
    predicted = compose(last, guess.step)
    prior = np.diag([guess.reach**-2, guess.reach**-2, guess.turn**-2])
    known = merged(before, poses)
    if not len(surface.points) or not len(known.points):
        return Matched(predicted, np.zeros((3, 3)), False)
    window = Window(
        predicted,
        3.0 * guess.reach,
        min(3.0 * guess.turn, math.pi),
        (0.5 * PENALTY * guess.reach**-2, 0.5 * PENALTY * guess.turn**-2),
    )
    found = search(field_of(known.points), thinned(surface.points, RETURNS), window)
    fitted = align(surface, target_of(known), found.pose, prior)
    if fitted.matched < LEAST_MATCHED or fitted.share < LEAST_SHARE:
        return Matched(predicted, np.zeros((3, 3)), False)
    return Matched(fitted.pose, fitted.information, True)


def thinned(points: np.ndarray, most: int) -> np.ndarray:
    """(at most `most`, 2) of the points, evenly spread."""
    return points[:: math.ceil(len(points) / most)] if len(points) > most else points
