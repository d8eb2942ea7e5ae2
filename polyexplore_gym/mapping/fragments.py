"""Obstacles without a trusted line: short pieces that join neighbouring leftover returns."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from polyexplore_gym.mapping.fit import normal_variance
from polyexplore_gym.mapping.grouping import ATTACH

OBLIQUE = 1.0 / math.cos(math.radians(70.0))  # neighbouring leftover returns are joined up to this incidence
# Shares of a door's width:
COARSEST = 0.4  # largest simplification tolerance
LEAST = 0.02  # least length of a piece
WIDEST = 0.2  # greatest length of the piece about a lone return: what lies between far beams is not known


@njit(cache=True)
def lone(x: float, y: float, resolution: float, door: float, out: np.ndarray, count: int) -> int:
    """Append a piece about the return (x, y), across its beam and as wide, to out. Returns the new count."""
    half = 0.5 * min(max(resolution, LEAST * door / math.hypot(x, y)), WIDEST * door / math.hypot(x, y))
    out[count, 0], out[count, 1], out[count, 2], out[count, 3] = x + half * y, y - half * x, x - half * y, y + half * x
    return count + 1


@njit(cache=True)
def beside(
    x: float, y: float, resolution: float, fits: np.ndarray, var_range: float, var_angle: float, door: float,
    out: np.ndarray, count: int,
) -> int:  # fmt: skip
    """As `lone`, but along the line on which the return lies (within 3 sigma), if there is one: far off on an oblique
    wall a piece across the beam would stick out of it."""
    d = math.hypot(x, y)
    best, least, half = -1, ATTACH, 0.5 * min(max(resolution, LEAST * door / d), WIDEST * door / d)
    for i in range(fits.shape[0]):
        if fits[i, 8] == 0:
            continue
        ca, sa = math.cos(fits[i, 1]), math.sin(fits[i, 1])
        e = x * ca + y * sa - fits[i, 0]
        variance = normal_variance(x, y, ca, sa, var_range, var_angle)
        if e * e < least * variance:
            best, least = i, e * e / variance
    if best < 0:
        return lone(x, y, resolution, door, out, count)
    half *= d
    ux, uy = -half * math.sin(fits[best, 1]), half * math.cos(fits[best, 1])
    out[count, 0], out[count, 1], out[count, 2], out[count, 3] = x - ux, y - uy, x + ux, y + uy
    return count + 1


@njit(cache=True)
def simplify(
    x: np.ndarray,
    y: np.ndarray,
    lo: int,
    hi: int,
    var_range: float,
    var_angle: float,
    door: float,
    out: np.ndarray,
    count: int,
) -> int:
    """Append the pieces of the chain lo..hi to out, simplified (Douglas-Peucker) to 3 sigma. Returns the new count."""
    stack = [(lo, hi)]
    while len(stack) > 0:
        a, b = stack.pop()
        ux, uy = x[b] - x[a], y[b] - y[a]
        length = math.hypot(ux, uy)
        best, far = -1, 1.0
        for k in range(a + 1, b):
            dx, dy = x[k] - x[a], y[k] - y[a]
            t = 0.0 if length == 0.0 else min(max((dx * ux + dy * uy) / (length * length), 0.0), 1.0)
            off = math.hypot(dx - t * ux, dy - t * uy)
            tolerance = min(3.0 * math.sqrt(var_range + var_angle * (x[k] * x[k] + y[k] * y[k])), COARSEST * door)
            if off / tolerance > far:
                best, far = k, off / tolerance
        if best >= 0:
            stack.append((best, b))
            stack.append((a, best))
        elif length < LEAST * door:  # very near the robot
            count = lone(x[a], y[a], 0.0, door, out, count)
        else:
            out[count, 0], out[count, 1], out[count, 2], out[count, 3] = x[a], y[a], x[b], y[b]
            count += 1
    return count


@njit(cache=True)
def fragment_chains(
    x: np.ndarray,
    y: np.ndarray,
    beam: np.ndarray,
    where: np.ndarray,
    resolution: float,
    fits: np.ndarray,
    var_range: float,
    var_angle: float,
    door: float,
) -> tuple[np.ndarray, np.ndarray]:
    """(F, 4) pieces covering the returns with where < 0; a lone return gives a piece of its beam's width, `WIDEST` at
    most, about it: second, (F,) which these are. Returns a door's width apart are not joined.

    fits: (count, 9) of `grouping.fit_labels`. What lies on one of these lines, where returns are too far apart to be
    its wall, gives a piece along it.
    """
    m = x.size
    out = np.empty((m, 4))
    alone = np.zeros(m, np.bool_)
    count = 0
    noise = 3.0 * math.sqrt(2.0 * var_range)
    k = 0
    while k < m:
        if where[k] >= 0:
            k += 1
            continue
        stop = k
        while stop + 1 < m and where[stop + 1] < 0 and beam[stop + 1] == beam[stop] + 1:
            d = min(math.hypot(x[stop], y[stop]), math.hypot(x[stop + 1], y[stop + 1]))
            if math.hypot(x[stop + 1] - x[stop], y[stop + 1] - y[stop]) > min(OBLIQUE * resolution * d + noise, door):
                break
            stop += 1
        if stop == k:
            alone[count] = True
            count = beside(x[k], y[k], resolution, fits, var_range, var_angle, door, out, count)
        else:
            count = simplify(x, y, k, stop, var_range, var_angle, door, out, count)
        k = stop + 1
    return out[:count].copy(), alone[:count].copy()
