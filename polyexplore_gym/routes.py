"""Routes, polylines (k, 2) in metres: how long, what is left, and where to cut them."""

from __future__ import annotations

import numpy as np


def length(path: np.ndarray) -> float:
    """Of a path (k, 2), m."""
    return float(np.hypot(*np.diff(path, axis=0).T).sum())


def rest_of(route: np.ndarray, here: np.ndarray) -> np.ndarray:
    """What is left of a route (k, 2) for a robot near it: its place (1, 2), and the vertices that it has not passed."""
    legs = np.diff(route, axis=0)
    if not len(legs):
        return here
    square = np.maximum((legs**2).sum(axis=1), 1e-300)
    along = np.clip(((here - route[:-1]) * legs).sum(axis=1) / square, 0.0, 1.0)
    off = np.hypot(*(route[:-1] + along[:, None] * legs - here).T)
    return np.concatenate((here, route[int(off.argmin()) + 1 :]))


def cut_off(path: np.ndarray, way: float) -> tuple[np.ndarray, bool]:
    """The first so many metres of a path (k, 2), and whether that is all of it."""
    run = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))))
    if way >= run[-1]:
        return path, True
    k = int(np.searchsorted(run, way))
    share = (way - run[k - 1]) / (run[k] - run[k - 1])
    return np.concatenate((path[:k], path[k - 1 : k] + share * (path[k] - path[k - 1]))), False
