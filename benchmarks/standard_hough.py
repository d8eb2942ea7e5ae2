"""The standard Hough transform as a start of the lines, for comparison: the source paper argues against it.

It votes for whole lines in a grid of directions and offsets. All cells with enough votes that are
higher than their four neighbours are candidates, so one wall gives a sheaf of them. A candidate
has no ends: the pixels beside it are sorted along it and parted at gaps. After that everything is
as with the probabilistic transform (`polyexplore_gym/mapping/hough.py`): this module only takes
the place of OpenCV's `HoughLinesP`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import cv2
import numpy as np
from numba import njit

PROBABILISTIC = cv2.HoughLinesP
BESIDE = 1.0  # pixels; those nearer to a candidate are on it


def standard_hough(
    image: np.ndarray,
    rho: float,
    theta: float,
    threshold: int,
    minLineLength: float,
    maxLineGap: float,
    *,
    votes: int,
    count: list[int],
) -> np.ndarray | None:
    """(K, 4) segments as of `HoughLinesP`, pixels; `votes` instead of its threshold. Adds the candidates to `count`."""
    lines = cv2.HoughLines(image, rho, theta, votes)
    count.append(0 if lines is None else len(lines))
    if lines is None:
        return None
    pixels = cv2.findNonZero(image).reshape(-1, 2).astype(np.float64)
    return pieces(pixels, lines.reshape(-1, 2).astype(np.float64), minLineLength, maxLineGap)


@njit(cache=True)
def pieces(pixels: np.ndarray, lines: np.ndarray, least: float, gap: float) -> np.ndarray:
    """(K, 4) ends of the runs of pixels (m, 2) beside each line (n, 2) of rho, theta: no gap wider, none shorter."""
    longest = math.hypot(pixels[:, 0].max() - pixels[:, 0].min(), pixels[:, 1].max() - pixels[:, 1].min()) + 4.0
    out = np.empty((lines.shape[0] * (int(longest / (least + gap)) + 1), 4))
    along = np.empty(pixels.shape[0])
    total = 0
    for rho, theta in lines:
        c, s = math.cos(theta), math.sin(theta)
        n = 0
        for x, y in pixels:
            if abs(x * c + y * s - rho) <= BESIDE:
                along[n] = y * c - x * s
                n += 1
        t = np.sort(along[:n])
        first = 0
        for q in range(n):
            if q + 1 < n and t[q + 1] - t[q] <= gap:
                continue
            if t[q] - t[first] >= least:
                out[total, 0], out[total, 1] = rho * c - t[first] * s, rho * s + t[first] * c
                out[total, 2], out[total, 3] = rho * c - t[q] * s, rho * s + t[q] * c
                total += 1
            first = q + 1
    return out[:total].copy()


@contextmanager
def candidates_counted(standard_votes: int | None = None) -> Iterator[list[int]]:
    """While this lasts, the start "hough" adds the number of candidate lines of each search to the list given.

    With `standard_votes` it searches with the standard transform instead of the probabilistic one.
    """
    count: list[int] = []

    def counted(*arguments: Any, **options: Any) -> np.ndarray | None:
        lines = PROBABILISTIC(*arguments, **options)
        count.append(0 if lines is None else len(lines))
        return lines

    search = counted if standard_votes is None else functools.partial(standard_hough, votes=standard_votes, count=count)
    with mock.patch.object(cv2, "HoughLinesP", search):
        yield count
