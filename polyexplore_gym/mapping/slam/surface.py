"""What a scan shows of walls, for matching: its returns, with the normals of the lines they lie on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from polyexplore_gym.config import MappingConfig, SensorConfig
from polyexplore_gym.mapping.extract import LEAST_RANGE, extract_lines
from polyexplore_gym.mapping.logs.poses import compose

SIGMA = 0.02
"""Least standard deviation of a return against the same wall in another scan, m: range noise, and walls that are not
quite straight."""


class Surface(NamedTuple):
    """The returns of one scan or of several, in one frame; m on lines, n altogether."""

    points: np.ndarray
    """(n, 2) m; those on lines come first."""
    feet: np.ndarray
    """(m, 2) where the first m points should be: on their line, m."""
    normals: np.ndarray
    """(m, 2) of the lines, pointing away from where they were seen."""


def surface_of(angles: np.ndarray, ranges: np.ndarray, sensor: SensorConfig, config: MappingConfig) -> Surface:
    """The surface of a scan, in its own frame.

    Args:
        angles, ranges: (b,) as for `extract_lines`.
        sensor, config: likewise.
    """
    lines = extract_lines(angles, ranges, sensor, config)
    hit = (ranges >= LEAST_RANGE) & (ranges < sensor.max_range)  # not NaN
    on = hit & (lines.point_segment >= 0)
    ray = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = np.concatenate([ranges[on, None] * ray[on], ranges[hit & ~on, None] * ray[hit & ~on]])
    line = lines.segment_line[lines.point_segment[on]]
    normals = np.stack([np.cos(lines.alpha[line]), np.sin(lines.alpha[line])], axis=1)
    off = (points[: len(line)] * normals).sum(axis=1) - lines.rho[line]
    return Surface(points, points[: len(line)] - off[:, None] * normals, normals)


def placed(surface: Surface, pose: np.ndarray) -> Surface:
    """The surface of a scan taken from a pose (3,), in the frame of that pose."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[c, s], [-s, c]])
    return Surface(surface.points @ turn + pose[:2], surface.feet @ turn + pose[:2], surface.normals @ turn)


def merged(surfaces: list[Surface], poses: np.ndarray, origin: np.ndarray | None = None) -> Surface:
    """Surfaces of scans taken from poses (k, 3) as one, in the frame of the poses, or in that of the pose `origin`."""
    if origin is not None:
        c, s = np.cos(origin[2]), np.sin(origin[2])
        x, y = origin[:2]
        poses = compose(np.array([-c * x - s * y, s * x - c * y, -origin[2]]), poses)
    parts = [placed(surface, pose) for surface, pose in zip(surfaces, poses, strict=True)]
    on = [part.points[: len(part.feet)] for part in parts]
    off = [part.points[len(part.feet) :] for part in parts]
    return Surface(
        np.concatenate(on + off), np.concatenate([p.feet for p in parts]), np.concatenate([p.normals for p in parts])
    )
