"""One scan to lines: `extract_lines`."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import njit

from polyexplore_gym.config import MappingConfig, SensorConfig
from polyexplore_gym.mapping.endpoint import endpoint_labels
from polyexplore_gym.mapping.fragments import fragment_chains
from polyexplore_gym.mapping.grouping import UNDECIDED, attach, cut, fit_labels, group_collinear
from polyexplore_gym.mapping.hough import hough_labels

COLLINEAR_GATE = 9.21  # chi-square, 2 degrees of freedom, 99 %
LEAST_RANGE_NOISE = 2e-3  # of a door's width; a noise-free sensor is fitted with these, so that weights stay finite
LEAST_ANGLE_NOISE = 1e-4  # rad
LEAST_RANGE = 1e-6  # m; the square of a much smaller one would be 0


@dataclass(frozen=True, slots=True)
class ScanLines:
    """The lines of one scan, in the robot frame. L lines carry K segments; n beams; F fragments."""

    rho: np.ndarray
    """(L,) distance of the line from the robot, m, >= 0: x cos(alpha) + y sin(alpha) = rho."""
    alpha: np.ndarray
    """(L,) direction of the normal, away from the robot, rad in (-pi, pi]."""
    covariance: np.ndarray
    """(L, 2, 2) covariance in the order (alpha, rho): rad2, rad m, m2."""
    segments: np.ndarray
    """(K, 4) end points x1, y1, x2, y2 of the pieces of wall on the lines, m."""
    segment_line: np.ndarray
    """(K,) index of the line of each segment."""
    point_segment: np.ndarray
    """(n,) index of the segment the return of each beam lies on, -1 for none; beams in the order given."""
    fragments: np.ndarray
    """(F, 4) short pieces joining neighbouring leftover returns, m: obstacles without a trusted covariance."""
    smoothed: np.ndarray
    """(n,) ranges, m, inf without a return, NaN where nothing is known; on a line, where the nominal beam meets it (raw
    above 80 degrees)."""
    lone: np.ndarray | None = None
    """(F,) which fragments stand for a lone return, that in their middle; None: none."""


def extract_lines(
    angles: np.ndarray,
    ranges: np.ndarray,
    sensor: SensorConfig | None = None,
    config: MappingConfig | None = None,
) -> ScanLines:
    """Fit lines with covariances to one scan.

    A first guess (`config.start`) labels the returns; weighted fits, grouping of collinear lines,
    attachment of free returns within 3 sigma and cutting at doorways follow. The equations and
    their sources stand in `fit` and `grouping`.

    Args:
        angles: (n,) nominal beam angles in the robot frame, rad, in any order; the lines do not depend on it.
        ranges: (n,) measured ranges, m; inf, or anything from the sensor's maximum range on, is a beam
            without a return: free. NaN and less than 1e-6 m (and an angle that is not finite) say nothing about
            that beam: neither wall nor free, as if it had not been measured.
        sensor: noise, maximum range, and whether the field of view closes.
        config: numbers and limits of the fit.

    Raises:
        ValueError: the arrays are not one-dimensional, differ in length, or do not hold real numbers.

    Example:
        >>> import numpy as np
        >>> from polyexplore_gym.config import SensorConfig
        >>> from polyexplore_gym.mapping import extract_lines
        >>> angles = np.linspace(-0.5, 0.5, 101)
        >>> lines = extract_lines(angles, 2.0 / np.cos(angles), SensorConfig(sigma_range=0.01))
        >>> lines.rho.round(3), lines.alpha.round(3) + 0.0, lines.segments.shape
        (array([2.]), array([0.]), (1, 4))
    """
    sensor = SensorConfig() if sensor is None else sensor
    config = (MappingConfig() if config is None else config).resolved()
    assert config.door_width is not None
    assert config.min_length is not None
    known, angles, ranges = check_scan(angles, ranges)
    sigma_range = max(sensor.sigma_range, config.range_floor, LEAST_RANGE_NOISE * config.door_width)
    sigma_angle = max(sensor.sigma_angle, LEAST_ANGLE_NOISE)
    start, points = turned_returns(angles, ranges, sensor.max_range, sensor.full_circle)
    resolution = _resolution(angles, known) if angles.size > 1 else sensor.resolution
    x, y, beam_of, reach_of, cos_t, sin_t = points
    noise = sigma_range**2, sigma_angle**2
    limits = config.min_points, config.min_length
    if config.start == "hough":
        label, count = hough_labels(x, y, *noise, *limits, config.door_width, config.grouping)
    else:
        label, count = endpoint_labels(x, y, beam_of, resolution, *noise, *limits)
    if sensor.full_circle and count > 0:
        start = _reseam(x, y, beam_of, reach_of, cos_t, sin_t, label, start)
    lines = ScanLines(
        *_assemble(
            x, y, beam_of, reach_of, cos_t, sin_t, start, sensor.max_range, resolution, label, count,
            sigma_range, sigma_angle, config.door_width, config.min_points, config.min_length, config.grouping,
        )
    )  # fmt: skip
    if known is None:
        return lines
    at = {"point_segment": known.spread(lines.point_segment, -1), "smoothed": known.spread(lines.smoothed, math.nan)}
    return replace(lines, **at)


class Known(NamedTuple):
    """Which beams of a scan are known, in the order of their angles."""

    beams: np.ndarray
    """(k,) their indices."""
    size: int
    """Beams of the scan."""

    def spread(self, values: np.ndarray, unknown: float) -> np.ndarray:
        """(size,) the values (k,) of the known beams at their places, `unknown` at the others."""
        out = np.full(self.size, unknown, values.dtype)
        out[self.beams] = values
        return out


def check_scan(angles: np.ndarray, ranges: np.ndarray) -> tuple[Known | None, np.ndarray, np.ndarray]:
    """The known beams (None: all, in the order given), their angles, increasing, and ranges as float64 arrays.

    Raises ValueError for what is no scan (see `extract_lines`).
    """
    angles, ranges = _real(angles, "angles"), _real(ranges, "ranges")
    if angles.size != ranges.size:
        raise ValueError(f"angles and ranges differ in length: {angles.size} and {ranges.size}")
    sound, beams = _known(angles, ranges)
    if sound:
        return None, angles, ranges
    if (np.diff(angles[beams]) >= 0.0).all():
        return Known(beams, ranges.size), angles[beams], ranges[beams]
    order, turned = increasing(angles[beams])
    beams = beams[order]
    return Known(beams, ranges.size), turned, ranges[beams]


def increasing(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The order (n,) in which finite beam angles (n,) increase, and the angles in it, some by full turns more or less.

    Angles may decrease (a laser that turns clockwise, or hangs upside down) or jump by a full turn somewhere (from pi
    to -pi). The field of view begins behind the widest gap only where they are mixed.
    """
    order = np.arange(angles.size)
    step = np.diff(angles)
    if (step >= 0.0).all():
        return order, angles
    if (step <= 0.0).all():
        return order[::-1], np.ascontiguousarray(angles[::-1])
    turned = np.unwrap(angles)
    step = np.diff(turned)
    if (step >= 0.0).all():
        return order, turned
    if (step <= 0.0).all():
        return order[::-1], np.ascontiguousarray(turned[::-1])
    turned = angles % (2.0 * math.pi)
    order = np.argsort(turned, kind="stable")
    turned = turned[order]
    first = int(np.argmax(np.diff(turned, prepend=turned[-1] - 2.0 * math.pi)))
    return np.roll(order, -first), np.concatenate([turned[first:] - 2.0 * math.pi, turned[:first]])


def _real(values: np.ndarray, name: str) -> np.ndarray:
    array = np.asarray(values)
    if array.ndim != 1:
        raise ValueError(f"{name} must be one-dimensional, got shape {array.shape}")
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name} must be real numbers, got {array.dtype}")
    return np.ascontiguousarray(array, np.float64)


def _resolution(angles: np.ndarray, known: Known | None) -> float:
    """Angle between neighbouring beams, rad; where beams are missing that of most."""
    if known is None or known.beams.size == known.size:
        return (angles[-1] - angles[0]) / (angles.size - 1)
    return float(np.median(np.diff(angles)))


@njit(cache=True)
def _known(angles: np.ndarray, ranges: np.ndarray) -> tuple[bool, np.ndarray]:
    """Whether all beams are known and their angles increase; if not, the known ones."""
    n, before, sound = angles.size, -math.inf, True
    for k in range(n):
        if not (ranges[k] >= LEAST_RANGE and -math.inf < angles[k] < math.inf and angles[k] >= before):
            sound = False
            break
        before = angles[k]
    beams = np.empty(0 if sound else n, np.int64)
    count = 0
    if not sound:
        for k in range(n):
            if ranges[k] >= LEAST_RANGE and -math.inf < angles[k] < math.inf:
                beams[count] = k
                count += 1
    return sound, beams[:count]


@njit(cache=True)
def turned_returns(
    angles: np.ndarray, ranges: np.ndarray, max_range: float, full_circle: bool
) -> tuple[int, tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """First beam of a turned scan, and x, y, beam of its returns, and ranges, cos, sin of its beams.

    A full circle is turned to start behind a missing return, else at the farthest one: that is the
    end of a wall, so no wall runs over the seam but for a beam or two (see `_reseam`).
    """
    n = angles.size
    start = 0
    if full_circle:
        far = -1.0
        for k in range(n):
            d = math.inf if ranges[k - 1] >= max_range and ranges[k] < max_range else ranges[k]
            if d > far and ranges[k] < max_range:
                start, far = k, d
    turned, cos_t, sin_t = np.empty(n), np.empty(n), np.empty(n)
    x, y, beam = np.empty(n), np.empty(n), np.empty(n, np.int64)
    m = 0
    for q in range(n):
        k = (start + q) % n
        c, s = math.cos(angles[k]), math.sin(angles[k])
        d = ranges[k] if ranges[k] < max_range else math.inf
        turned[q], cos_t[q], sin_t[q] = d, c, s
        if d < math.inf:
            x[m], y[m], beam[m] = d * c, d * s, q
            m += 1
    return start, (x[:m].copy(), y[:m].copy(), beam[:m].copy(), turned, cos_t, sin_t)


@njit(cache=True)
def _reseam(
    x: np.ndarray,
    y: np.ndarray,
    beam: np.ndarray,
    ranges: np.ndarray,
    cos_t: np.ndarray,
    sin_t: np.ndarray,
    label: np.ndarray,
    start: int,
) -> int:
    """Turn a full circle again, in place, to start between two labels; returns the new first beam."""
    n, m = ranges.size, x.size
    best, widest = 0, -1.0
    for k in range(1, m):
        gap = (x[k] - x[k - 1]) ** 2 + (y[k] - y[k - 1]) ** 2
        if label[k] != label[k - 1] and gap > widest:
            best, widest = k, gap
    by = beam[best]
    x[:], y[:], label[:] = np.roll(x, -best), np.roll(y, -best), np.roll(label, -best)
    beam[:] = (np.roll(beam, -best) - by) % n
    ranges[:], cos_t[:], sin_t[:] = np.roll(ranges, -by), np.roll(cos_t, -by), np.roll(sin_t, -by)
    return (start + by) % n


@njit(cache=True)
def _assemble(
    x: np.ndarray,
    y: np.ndarray,
    beam: np.ndarray,
    ranges: np.ndarray,
    cos_t: np.ndarray,
    sin_t: np.ndarray,
    start: int,
    max_range: float,
    resolution: float,
    label: np.ndarray,
    count: int,
    sigma_range: float,
    sigma_angle: float,
    reach: float,
    min_points: int,
    min_length: float,
    grouping: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Labelled returns to the fields of `ScanLines`."""
    var_range, var_angle = sigma_range * sigma_range, sigma_angle * sigma_angle
    fits = fit_labels(x, y, label, count, var_range, var_angle)
    if grouping:
        group_collinear(x, y, label, fits, var_range, var_angle, COLLINEAR_GATE)
        attach(x, y, label, fits, var_range, var_angle, reach)
        fits = fit_labels(x, y, label, count, var_range, var_angle)
    where, segments, owner = cut(
        x, y, beam, ranges, cos_t, sin_t, max_range, resolution, label, fits,
        sigma_range, sigma_angle, reach, min_points, min_length,
    )  # fmt: skip
    fragments, alone = fragment_chains(x, y, beam, where, resolution, fits, var_range, var_angle, reach)

    number = np.full(count, -1, np.int64)
    lines = 0
    for i in range(count):
        if fits[i, 8] >= min_points:
            number[i] = lines
            lines += 1
    rho, alpha, covariance = np.empty(lines), np.empty(lines), np.empty((lines, 2, 2))
    for i in range(count):
        q = number[i]
        if q >= 0:
            rho[q], alpha[q] = fits[i, 0], fits[i, 1]
            covariance[q, 0, 0] = fits[i, 2]
            covariance[q, 0, 1] = covariance[q, 1, 0] = fits[i, 3]
            covariance[q, 1, 1] = fits[i, 4]
    n = ranges.size
    point_segment = np.full(n, -1, np.int64)
    smoothed = np.empty(n)
    for q in range(n):
        smoothed[(start + q) % n] = ranges[q]
    for k in range(x.size):
        if where[k] < 0:
            continue
        q = beam[k]
        at = (start + q) % n
        point_segment[at] = where[k]
        i = owner[where[k]]
        c = cos_t[q] * math.cos(fits[i, 1]) + sin_t[q] * math.sin(fits[i, 1])
        if c > UNDECIDED:
            smoothed[at] = fits[i, 0] / c
    segment_line = np.empty(owner.size, np.int64)
    for k in range(owner.size):
        segment_line[k] = number[owner[k]]
    return rho, alpha, covariance, segments, segment_line, point_segment, fragments, smoothed, alone
