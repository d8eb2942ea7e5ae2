"""Scans that were taken on the move, as if each had been taken at once: `deskewed`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from polyexplore_gym.mapping.extract import increasing
from polyexplore_gym.mapping.logs.poses import between, compose
from polyexplore_gym.mapping.logs.record import LaserLog, Track
from polyexplore_gym.mapping.logs.trajectory import covered


def deskewed(log: LaserLog) -> LaserLog:
    """The log with every beam as it would have been measured at the time and from the pose of its scan.

    The way during a scan is that of the odometry between the scans (`log.track`), or on a straight line between the
    poses of the scans before and after. A scan stays as it is where neither tells the way, and a log without times of
    its beams altogether.
    """
    if log.beam_times is None or log.times is None:
        return log
    track = log.track
    if track is None and log.poses is not None:
        track = Track.sorted(log.times, log.poses)
    if track is None or track.times.size < 2:
        return replace(log, beam_times=None)
    angles, ranges = [], []
    for k, after in enumerate(log.beam_times):
        one = log.angles[k], log.ranges[k]
        if after.any() and covered(track, log.times[k] + np.array([after.min(), after.max()])).all():
            one = _at_once(*one, log.times[k], after, track)
        angles.append(one[0])
        ranges.append(one[1])
    return replace(log, angles=angles, ranges=ranges, beam_times=None)


def _at_once(
    angles: np.ndarray, ranges: np.ndarray, time: float, after: np.ndarray, track: Track
) -> tuple[np.ndarray, np.ndarray]:
    """Angles and ranges (b,) of beams measured so long `after` (b,) the time of their scan, seen from its pose."""
    moved = between(track.at(np.array([time])), track.at(time + after))
    turned = angles + moved[:, 2]
    hit = np.isfinite(ranges)
    r, a = ranges[hit], angles[hit]
    ends = compose(moved[hit], np.stack([r * np.cos(a), r * np.sin(a), np.zeros(r.size)], axis=1))
    out = ranges.copy()
    out[hit] = np.hypot(ends[:, 0], ends[:, 1])
    bearing = np.arctan2(ends[:, 1], ends[:, 0])
    turned[hit] += (bearing - turned[hit] + np.pi) % (2.0 * np.pi) - np.pi
    if (np.diff(turned) >= 0.0).all():
        return turned, out
    order, turned = increasing(turned)
    return turned, out[order]
