"""The walls of a map that its own scans do not contradict: what is left to draw a floor plan from."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from polyexplore_gym.config import SensorConfig
from polyexplore_gym.mapping.evidence import RATIO, Beams, held_against
from polyexplore_gym.mapping.extract import check_scan
from polyexplore_gym.mapping.line_map import LineMap
from polyexplore_gym.mapping.log_map import LogMap
from polyexplore_gym.mapping.logs import LaserLog, deskewed


class Walls(NamedTuple):
    """K segments of wall on L lines."""

    segments: np.ndarray
    """(K, 4) x1, y1, x2, y2, m; the free space lies on the left"""
    line: np.ndarray
    """(K,) the line of each"""
    rho: np.ndarray
    """(L,) x cos(alpha) + y sin(alpha) = rho, m"""
    alpha: np.ndarray
    """(L,) rad"""
    sigma: np.ndarray
    """(K,) standard deviation across each segment, m"""


def walls_of(line_map: LineMap, scans: Iterable[Beams], sensor: SensorConfig, ratio: float = RATIO) -> Walls:
    """The walls of a line map, less what the beams of its scans passed through (see `evidence.held_against`)."""
    noise = max(sensor.sigma_range, 1e-3) ** 2, sensor.sigma_angle**2
    rows, parts, of, _ = held_against(line_map, scans, sensor.max_range, *noise, ratio)
    line = line_map.line[rows][of]
    kept, index = np.unique(line[line >= 0], return_inverse=True)
    sigma = line_map.sigma[rows][of][line >= 0]
    return Walls(parts[line >= 0], index, line_map.rho[kept].copy(), line_map.alpha[kept].copy(), sigma)


def walls_of_log(made: LogMap) -> Walls:
    """The walls of a log's map, from which contradicted ones are gone already."""
    return Walls(made.segments, made.segment_line, made.rho, made.alpha, made.segment_sigma)


def beams_of_log(log: LaserLog, made: LogMap, max_range: float) -> Iterator[Beams]:
    """The scans that a log's map was made of, their poses taken as they are.

    Of beams without a return (max_range, m, or more) nothing is taken to be known: lasers miss dark walls and glass.
    """
    straight = deskewed(log)
    for k, pose in zip(made.used.tolist(), made.path, strict=True):
        _, angles, ranges = check_scan(straight.angles[k], straight.ranges[k])
        yield Beams(angles, np.where(ranges < max_range, ranges, np.nan), pose, np.zeros((3, 3)))
