"""First guess of a scan's lines: the probabilistic Hough transform, and grouping of its lines.

Matas, Galambos, Kittler, "Robust detection of lines using the progressive probabilistic Hough
transform" (2000), as in OpenCV, on a raster of the returns. It yields doubled, overlapping and
crossing lines. As in the source paper, the dominant line takes the points of all lines impossible
beside it and all points within 3 sigma of it; what is left is searched again.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from polyexplore_gym.mapping.fit import fit, normal_variance, wrap

RASTER = 0.05  # a pixel, of a door's width
ANGLE_STEP = math.radians(1.0)
VOTES = 5
LEAST_LENGTH = 0.5  # of a line on the raster, of a door's width
MOST_PIXELS = 4096  # on a side, for memory
ROUNDS = 4  # searches of a scan, each on what is left
NEAR = 3.0**2
PARALLEL = math.radians(15.0)  # a line this near in direction and overlapping is impossible beside a dominant one


def hough_labels(
    x: np.ndarray,
    y: np.ndarray,
    var_range: float,
    var_angle: float,
    min_points: int,
    min_length: float,
    reach: float,
    grouping: bool = True,
) -> tuple[np.ndarray, int]:
    """(m,) label of the line each return lies on (-1 none) and the number of lines.

    Without grouping each line of the transform keeps the returns whose pixels it passed.
    """
    from cv2 import HoughLinesP  # heavy, and needed by this start alone

    label = np.full(x.size, -1, np.int64)
    count = 0
    if x.size < min_points:
        return label, 0
    x0, y0 = float(x.min()), float(y.min())
    pixel = max(RASTER * reach, (float(x.max()) - x0) / MOST_PIXELS, (float(y.max()) - y0) / MOST_PIXELS)
    column = ((x - x0) / pixel).astype(np.int64)
    row = ((y - y0) / pixel).astype(np.int64)
    image = np.zeros((int(row.max()) + 1, int(column.max()) + 1), np.uint8)
    for _ in range(ROUNDS):
        free = label < 0
        if int(free.sum()) < min_points:
            break
        image[:] = 0
        image[row[free], column[free]] = 255
        found = HoughLinesP(
            image, 1, ANGLE_STEP, VOTES, minLineLength=LEAST_LENGTH * reach / pixel, maxLineGap=reach / pixel
        )
        if found is None:
            break
        ends = (found.reshape(-1, 4) + 0.5) * pixel + np.array([x0, y0, x0, y0])
        if not grouping:
            return label, take_each(x, y, ends, label, min_points, pixel)
        before = count
        count = take_dominant(x, y, ends, label, count, var_range, var_angle, min_points, min_length, reach, pixel)
        if count == before:
            break
    settle(x, y, label, count, var_range, var_angle, reach)
    return label, count


@njit(cache=True)
def beside(
    x: np.ndarray,
    y: np.ndarray,
    label: np.ndarray,
    end: np.ndarray,
    var_range: float,
    var_angle: float,
    pixel: float,
) -> np.ndarray:
    """Free returns within 3 sigma and a pixel of the segment `end`."""
    dx, dy = end[2] - end[0], end[3] - end[1]
    length = math.hypot(dx, dy)
    ca, sa = -dy / length, dx / length
    out = np.empty(x.size, np.int64)
    n = 0
    for k in range(x.size):
        if label[k] >= 0:
            continue
        px, py = x[k] - end[0], y[k] - end[1]
        t = (px * dx + py * dy) / length
        off = abs(px * ca + py * sa)
        if -pixel <= t <= length + pixel:
            spread = NEAR * normal_variance(x[k], y[k], ca, sa, var_range, var_angle)
            if off <= pixel + math.sqrt(spread):
                out[n] = k
                n += 1
    return out[:n]


@njit(cache=True)
def take_each(x: np.ndarray, y: np.ndarray, ends: np.ndarray, label: np.ndarray, min_points: int, pixel: float) -> int:
    """Label the free returns within a pixel of each line, in the order found; returns the number of labels."""
    count = 0
    for i in range(ends.shape[0]):
        index = beside(x, y, label, ends[i], 0.0, 0.0, pixel)
        if index.size >= min_points:
            label[index] = count
            count += 1
    return count


@njit(cache=True)
def take_dominant(
    x: np.ndarray,
    y: np.ndarray,
    ends: np.ndarray,
    label: np.ndarray,
    count: int,
    var_range: float,
    var_angle: float,
    min_points: int,
    min_length: float,
    reach: float,
    pixel: float,
) -> int:
    """Label the returns of the lines, the dominant line first; returns the new number of labels."""
    lines = ends.shape[0]
    votes = np.empty(lines, np.int64)
    for i in range(lines):
        votes[i] = beside(x, y, label, ends[i], var_range, var_angle, pixel).size
    while True:
        i = int(np.argmax(votes)) if lines > 0 else -1
        if i < 0 or votes[i] < min_points:
            return count
        index = beside(x, y, label, ends[i], var_range, var_angle, pixel)
        votes[i] = 0
        if index.size < min_points:
            continue
        rho, alpha, _, _, _, _ = fit(x, y, index, var_range, var_angle)
        # points of lines impossible beside it, then all points within 3 sigma, as far as they hang together
        for _ in range(2):
            ca, sa = math.cos(alpha), math.sin(alpha)
            low, high = math.inf, -math.inf
            for k in index:
                t = y[k] * ca - x[k] * sa
                low, high = min(low, t), max(high, t)
            for j in range(lines):
                if votes[j] == 0:
                    continue
                other = math.atan2(ends[j, 2] - ends[j, 0], ends[j, 1] - ends[j, 3])
                turn = abs(wrap(other - alpha))
                if min(turn, math.pi - turn) > PARALLEL:
                    continue
                a, b = ends[j, 1] * ca - ends[j, 0] * sa, ends[j, 3] * ca - ends[j, 2] * sa
                mx, my = 0.5 * (ends[j, 0] + ends[j, 2]), 0.5 * (ends[j, 1] + ends[j, 3])
                spread = NEAR * normal_variance(mx, my, ca, sa, var_range, var_angle)
                off = abs(mx * ca + my * sa - rho)
                if off <= pixel + math.sqrt(spread) and max(a, b) > low - reach and min(a, b) < high + reach:
                    low, high = min(low, a, b), max(high, a, b)
            index = np.empty(x.size, np.int64)
            n = 0
            for k in range(x.size):
                t = y[k] * ca - x[k] * sa
                e = x[k] * ca + y[k] * sa - rho
                if label[k] >= 0 or not low - pixel <= t <= high + pixel:
                    continue
                if e * e <= NEAR * normal_variance(x[k], y[k], ca, sa, var_range, var_angle):
                    index[n] = k
                    n += 1
            index = index[:n]
            if n < min_points:
                break
            rho, alpha, _, _, _, _ = fit(x, y, index, var_range, var_angle)
        if index.size < min_points or high - low < min_length:
            continue
        for k in index:
            label[k] = count
        count += 1
        for j in range(lines):
            if votes[j] > 0:
                votes[j] = beside(x, y, label, ends[j], var_range, var_angle, pixel).size


@njit(cache=True)
def settle(
    x: np.ndarray, y: np.ndarray, label: np.ndarray, count: int, var_range: float, var_angle: float, reach: float
) -> None:
    """Give returns near a crossing to the line they fit best, among those with returns close by."""
    rho, ca, sa = np.zeros(count), np.zeros(count), np.zeros(count)
    low, high = np.zeros(count), np.zeros(count)
    for i in range(count):
        index = np.nonzero(label == i)[0]
        rho[i], alpha, _, _, _, _ = fit(x, y, index, var_range, var_angle)
        ca[i], sa[i] = math.cos(alpha), math.sin(alpha)
        low[i], high[i] = math.inf, -math.inf
        for q in index:
            t = y[q] * ca[i] - x[q] * sa[i]
            low[i], high[i] = min(low[i], t), max(high[i], t)
    for k in range(x.size):
        if label[k] < 0:
            continue
        best, least = -1, math.inf
        for j in range(count):
            t = y[k] * ca[j] - x[k] * sa[j]
            if not low[j] - 0.3 * reach <= t <= high[j] + 0.3 * reach:
                continue
            e = x[k] * ca[j] + y[k] * sa[j] - rho[j]
            z2 = e * e / normal_variance(x[k], y[k], ca[j], sa[j], var_range, var_angle)
            if z2 < least:
                best, least = j, z2
        if best >= 0:
            label[k] = best
