"""What odometry tells, and what is wrong with it: `way_of`, `calibrate`, `filled`.

A robot's odometry errs in ways that stay the same: how far a turn of the wheels leads, how much one wheel leads beside
the other, and where the laser sits on the robot. Held against the poses that scans gave they can be told (after Censi
et al., "Simultaneous calibration of odometry and sensor parameters for mobile robots", T-RO 2013).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter1d
from scipy.optimize import least_squares

from polyexplore_gym.errors import InvalidLogError
from polyexplore_gym.mapping.logs.poses import between, wrap
from polyexplore_gym.mapping.logs.record import LaserLog, Way

STAMP = 1e-4, 0.01
"""Stamps are rounded to so much at least, and at most, s: equal ones in a row stand for times within that."""
AROUND = 200
"""What stamps are rounded to is told by so many around."""
LEAST_STEPS = 30
"""Fewest steps to calibrate with."""
LEAST_WAY = 10.0, 2.0 * np.pi
"""They lead so far altogether, and turn so much, m and rad."""
USUAL = 0.03, 0.02
"""Errors that count as the rule, not as outliers, m and rad."""
ALONG = 0.05
"""An error of the odometry grows by a metre of way as by so many rad of turn."""


class Calibration(NamedTuple):
    """How odometry becomes the way of the laser."""

    x: float = 0.0
    """Where the laser sits before the point that the odometry follows, m; what the log says of it included."""
    y: float = 0.0
    """Beside it, to the left, m."""
    along: float = 1.0
    """Length of a step, by that of the odometry."""
    turn: float = 1.0
    """A turn, by that of the odometry."""
    veer: float = 0.0
    """And what a step turns beside, rad/m."""


class Error(NamedTuple):
    """What calibration leaves of the error of a step, standard deviations."""

    xy: float
    """m"""
    heading: float
    """rad"""


def way_of(log: LaserLog) -> Way:
    """The odometry of a log, with the scans in it.

    Raises:
        InvalidLogError: the log gives none.
    """
    if log.way is not None:
        return log.way
    if log.track is not None and log.times is not None:
        stamps = np.union1d(log.track.times, log.times)
        return Way(stamps, log.track.at(stamps), np.searchsorted(stamps, log.times))
    odometry = log.poses if log.odometry is None and log.poses_are != "corrected" else log.odometry
    if odometry is None:
        raise InvalidLogError(f"no odometry to go by: {log.why or 'the log gives none'}; the scans alone may do: none")
    stamps = np.full(len(log), np.nan) if log.times is None else log.times
    return Way(stamps, odometry, np.arange(len(log)))


def calibrated(poses: np.ndarray, calibration: Calibration) -> np.ndarray:
    """(m, 3) odometry (m, 3) with errors taken out, and of the laser; from the origin."""
    step = between(poses[:-1], poses[1:])
    turn = np.concatenate([[0.0], np.cumsum(calibration.turn * step[:, 2] + calibration.veer * step[:, 0])])
    c, s = np.cos(turn), np.sin(turn)
    dx, dy = calibration.along * step[:, :2].T
    x = np.concatenate([[0.0], np.cumsum(c[:-1] * dx - s[:-1] * dy)])
    y = np.concatenate([[0.0], np.cumsum(s[:-1] * dx + c[:-1] * dy)])
    at = calibration.x, calibration.y
    return np.stack([x + c * at[0] - s * at[1], y + s * at[0] + c * at[1], turn], axis=1)


def calibrate(way: Way, scans: np.ndarray, poses: np.ndarray) -> tuple[Calibration, Error]:
    """What is wrong with odometry, from the poses that scans gave.

    Args:
        way: odometry.
        scans: (k,) some of the scans.
        poses: (k, 3) theirs.

    Returns:
        The calibration, and what error it leaves from one of these scans to the next. Without ways and turns that
        would tell, nothing is calibrated.
    """
    at, told = way.scans[scans], between(poses[:-1], poses[1:])

    def off(values: np.ndarray) -> np.ndarray:
        corrected = calibrated(way.poses, Calibration(*values))[at]
        return between(between(corrected[:-1], corrected[1:]), told)

    values = np.array(Calibration())
    long_enough = np.hypot(told[:, 0], told[:, 1]).sum() > LEAST_WAY[0] and np.abs(told[:, 2]).sum() > LEAST_WAY[1]
    if len(told) >= LEAST_STEPS and long_enough:
        scale = np.array([USUAL[0], USUAL[0], USUAL[1]])
        begin = values + np.array([0.01, 0.01, 0.0, 0.0, 0.01])  # off zero, for the differences
        values = least_squares(lambda v: (off(v) / scale).ravel(), begin, loss="soft_l1").x
    left = np.abs(off(values)) / 0.6745  # median absolute deviation of a Gaussian
    xy = float(np.hypot(*np.median(left[:, :2], axis=0)) / np.sqrt(2.0)) if len(left) else 0.0
    heading = float(np.median(left[:, 2])) if len(left) else 0.0
    return Calibration(*values.tolist()), Error(max(xy, 0.5 * USUAL[0]), max(heading, 0.25 * USUAL[1]))


def filled(odometry: np.ndarray, at: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """(m, 3) poses all along a way, of which some are known.

    Between two known poses the odometry leads from one to the other: first its headings, what they miss by spread over
    the turns, then with these its steps, what they miss by spread over their lengths. Before the first known pose and
    behind the last the odometry leads on.

    Args:
        odometry: (m, 3) the way by odometry.
        at: (k,) where on it poses are known; increasing.
        poses: (k, 3) these.
    """
    step = between(odometry[:-1], odometry[1:])
    length = np.hypot(step[:, 0], step[:, 1])
    heading = _through(_sums(step[:, 2]), _sums(np.abs(step[:, 2]) + ALONG * length), at, np.unwrap(poses[:, 2]))
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    gone = _sums(length)
    x = _through(_sums(c * step[:, 0] - s * step[:, 1]), gone, at, poses[:, 0])
    y = _through(_sums(s * step[:, 0] + c * step[:, 1]), gone, at, poses[:, 1])
    return np.stack([x, y, wrap(heading)], axis=1)


def _through(values: np.ndarray, grown: np.ndarray, at: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(m,) values moved to go through known ones (k,) at (k,); between, what is missing grows with `grown` (m,)."""
    before = np.clip(np.searchsorted(at, np.arange(len(values)), side="right") - 1, 0, len(at) - 1)
    after = np.minimum(before + 1, len(at) - 1)
    begin, end = grown[at[before]], grown[at[after]]
    share = np.clip((grown - begin) / np.where(end > begin, end - begin, 1.0), 0.0, 1.0)
    missing = known - values[at]
    return values + missing[before] + share * (missing[after] - missing[before])


def _sums(steps: np.ndarray) -> np.ndarray:
    return np.concatenate([[0.0], np.cumsum(steps)])


def spread(stamps: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    """(m,) stamps; of equal ones in a row each gets its own time, evenly within what they were rounded to.

    Args:
        stamps: (m,) s, as written: rounded, more coarsely perhaps as a log goes on.
        fixed: (f,) those that keep theirs, increasing.
    """
    first = np.flatnonzero(np.concatenate([[True], np.diff(stamps) != 0.0]))
    count = np.diff(np.append(first, len(stamps)))
    which = np.repeat(np.arange(len(first)), count)
    gaps = np.abs(np.diff(stamps[first]))
    # what they were rounded to: the least step around
    rounded = minimum_filter1d(np.append(gaps, np.inf), AROUND, mode="nearest")[which]
    rounded = np.clip(np.where(np.isfinite(rounded), rounded, 0.0), *STAMP)
    rank = (np.arange(len(stamps)) - first[which] + 0.5) / count[which] - 0.5
    kept = np.full(len(first), np.nan)
    kept[which[fixed][::-1]] = rank[fixed][::-1]  # the first of a row
    around = np.nan_to_num(kept)[which]
    room = np.where(rank < around, 0.5 + around, 0.5 - around)  # to that end of what they were rounded to
    return stamps + rounded * np.where(count[which] > 1, 0.5 * (rank - around) / room, 0.0)
