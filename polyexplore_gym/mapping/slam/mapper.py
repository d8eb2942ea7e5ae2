"""Simultaneous localisation and mapping: the poses of a log's scans from the scans, `correct_poses`."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from polyexplore_gym.config import MappingConfig, SensorConfig
from polyexplore_gym.errors import InvalidConfigError
from polyexplore_gym.mapping.logs.deskew import deskewed
from polyexplore_gym.mapping.logs.poses import between, compose
from polyexplore_gym.mapping.logs.record import LaserLog, Track, Way
from polyexplore_gym.mapping.slam import loops
from polyexplore_gym.mapping.slam.front import RECENT, Guess, match
from polyexplore_gym.mapping.slam.graph import Edges, covariances, local_covariances, solve
from polyexplore_gym.mapping.slam.odometry import Calibration, Error, calibrate, calibrated, filled, spread, way_of
from polyexplore_gym.mapping.slam.refine import pair_edges, pairs
from polyexplore_gym.mapping.slam.state import State, fingerprint, load, save
from polyexplore_gym.mapping.slam.surface import Surface, surface_of

Sources = Literal["odometry", "none"]
Tracker = Callable[[Iterable[int], str], Iterable[int]]
"""Wraps the scans of a pass, to show progress; the second argument names the pass."""

STRIDE = 0.3, math.radians(15.0)
"""A scan is a key scan if it was taken so far from the last one, m, or turned against it so much, rad."""
RAW = (0.03, 0.05, 0.03), (math.radians(2.0), 0.05, 0.15)
"""Raw odometry errs by so much, by so much a metre and by so much a radian of turn: standard deviations, m and rad."""
FASTEST = (0.05, 0.45), (math.radians(2.0), math.radians(17.0))
"""Without odometry a robot goes, or turns, by this at least and at most from scan to scan (standard deviations), ..."""
SPEED = 0.5, math.radians(30.0)
"""... or by so much a second, m/s and rad/s."""
SEARCH_EVERY = 1.5
"""A way of so much after a place was seen again the next one is looked for, m."""
BENT = 0.1, math.radians(1.0)
"""The map is bent by the first loop that is off by more, m and rad."""
ROUNDS = 3
"""Times that all pairs of scans are aligned and all poses solved."""
MOST_LOST = 0.05
"""If a larger share of the scans is not recognised, a warning says so."""
SAVE_EVERY = 10.0
"""Seconds between two writings of the state."""


class Corrected(NamedTuple):
    """Poses of the n scans of a log, k of them key scans."""

    poses: np.ndarray
    """(n, 3) x, y (m) and heading (rad) of the laser; the first is that of the odometry, or zero without."""
    covariance: np.ndarray
    """(n, 3, 3) given the first pose: m2, m rad, rad2."""
    local_covariance: np.ndarray
    """(n, 3, 3) given the scans around: how well a scan fits the walls that it sees."""
    way: Way
    """The same and, of a log with odometry between its scans, the poses there, in the order of the log."""
    keys: np.ndarray
    """(k,) the key scans."""
    loops: int
    """Places seen again."""
    lost: int
    """Scans that were not recognised in those before them."""
    calibration: Calibration | None
    """What was wrong with the odometry."""

    @property
    def track(self) -> Track:
        """`way` by time, without what has none."""
        stamps, poses = self.way.stamps, self.way.poses
        scan = np.zeros(len(stamps), bool)
        scan[self.way.scans] = True
        kept = np.isfinite(stamps)
        # an ODOM line of the very scan that follows it
        moved = (np.diff(stamps) != 0.0) | (np.abs(np.diff(poses, axis=0)) > 1e-9).any(axis=1)
        kept[:-1] &= scan[:-1] | ~scan[1:] | moved
        at = np.flatnonzero(scan[kept])
        times, poses = spread(stamps[kept], at), poses[kept]
        first = np.concatenate([at, np.delete(np.arange(len(times)), at)])  # at one time a scan goes before others
        return Track.sorted(times[first], poses[first])


def correct_poses(
    log: LaserLog,
    sensor: SensorConfig,
    config: MappingConfig | None = None,
    *,
    source: Sources = "odometry",
    state: Path | None = None,
    track: Tracker = lambda scans, what: scans,
) -> Corrected:
    """The poses of a log's scans, from the scans and, if there is any, odometry.

    Each scan is searched for in the last ones before it and aligned with their lines; places seen again bend the map
    back; then what is wrong with the odometry is told, and all scans that see the same walls are aligned in pairs and
    solved for together, some rounds. A UserWarning says so if many scans were not recognised.

    Args:
        log: of `read_log`.
        sensor: of `sensor_of`.
        config: numbers and limits of the fit of lines.
        source: "odometry": that of the log says where to look; "none": the scans alone do.
        state: file to go on from and to write to as the scans are matched, so that an interrupted run loses nothing;
            of no use to another log.
        track: shows progress.

    Raises:
        InvalidConfigError: the source has another name.
        InvalidLogError: odometry is asked for and the log gives none.
    """
    if source not in ("odometry", "none"):
        raise InvalidConfigError(f"source = {source!r}: must be odometry or none")
    config = MappingConfig(range_floor=0.01) if config is None else config
    log = deskewed(log)
    way = way_of(log) if source == "odometry" else None
    known, surfaces = _track(log, way, sensor, config, state, track)
    if known.lost > MOST_LOST * len(log):
        warnings.warn(
            f"{known.lost} of {len(log)} scans show too little of what those before them show: poses there are guesses",
            stacklevel=2,
        )
    return _solved(log, way, known, surfaces, track)


def corrected_log(log: LaserLog, corrected: Corrected) -> LaserLog:
    """The log with corrected poses, for `map_log`.

    Their covariances are those against the scans around: what all walls of a place share is left out, as a line map
    takes the errors of two poses for independent.
    """
    return replace(
        log,
        poses=corrected.poses,
        pose_covariance=corrected.local_covariance,
        poses_are="matched",
        why=f"scans matched, {corrected.loops} places seen again, {corrected.lost} scans not recognised",
    )


def _track(
    log: LaserLog, way: Way | None, sensor: SensorConfig, config: MappingConfig, path: Path | None, track: Tracker
) -> tuple[State, list[Surface]]:  # fmt: skip
    """All scans, one after the other, and the surfaces of the key scans."""
    mark = fingerprint(log, f"{sensor} {config} {way is None}") if path is not None else ""
    known = (load(path, mark) if path is not None else None) or State()
    surfaces = [surface_of(log.angles[k], log.ranges[k], sensor, config) for k in known.keys]
    written = time.monotonic()
    try:
        for k in track(range(len(log)), "match"):
            if k < len(known.poses):
                continue
            _insert(known, surfaces, surface_of(log.angles[k], log.ranges[k], sensor, config), _guess(log, way, known))
            if path is not None and time.monotonic() - written > SAVE_EVERY:
                save(known, path, mark)
                written = time.monotonic()
    except KeyboardInterrupt:
        if path is not None:
            save(known, path, mark)
        raise
    if path is not None:
        save(known, path, mark)
    return known, surfaces


def _guess(log: LaserLog, way: Way | None, known: State) -> Guess:
    """Of the way to the next scan."""
    k = len(known.poses)
    if k == 0:
        return Guess(np.zeros(3) if way is None else way.poses[way.scans[0]], 1.0, 1.0)
    if way is None:
        seconds = math.inf if log.times is None else max(float(log.times[k] - log.times[k - 1]), 0.0)
        seconds *= 1 + known.since
        reach, turn = (min(low + rate * seconds, high) for (low, high), rate in zip(FASTEST, SPEED, strict=True))
        return Guess(np.zeros(3), reach, turn)
    step = between(way.poses[way.scans[k - 1]], way.poses[way.scans[k]])
    size = np.array([1.0, math.hypot(step[0], step[1]), abs(step[2])])
    wider = math.sqrt(1 + known.since)
    return Guess(step, wider * float(np.dot(RAW[0], size)), wider * float(np.dot(RAW[1], size)))


def _insert(known: State, surfaces: list[Surface], surface: Surface, guess: Guess) -> None:
    """Add the next scan: its pose, and if it is a key scan what ties it to the others."""
    k = len(known.poses)
    if k == 0:
        known.poses.append(guess.step)
        _add_key(known, surfaces, surface, np.zeros(3), np.zeros((3, 3)))
        return
    recent = known.keys[-RECENT:]
    found = match(surface, surfaces[-RECENT:], np.array([known.poses[i] for i in recent]), known.poses[-1], guess)
    known.poses.append(found.pose)
    known.lost += not found.holds
    known.since = 0 if found.holds else known.since + 1
    step = between(known.poses[known.keys[-1]], found.pose)
    if math.hypot(step[0], step[1]) < STRIDE[0] and abs(step[2]) < STRIDE[1]:
        return
    _add_key(known, surfaces, surface, step, loops.in_own_frame(found.information, found.pose[2]))
    if found.holds:
        _look_back(known, surfaces)


def _add_key(known: State, surfaces: list[Surface], surface: Surface, step: np.ndarray, held: np.ndarray) -> None:
    known.keys.append(len(known.poses) - 1)
    surfaces.append(surface)
    known.steps.append(step)
    known.information.append(held)
    known.way.append((known.way[-1] if known.way else 0.0) + math.hypot(step[0], step[1]))


def _look_back(known: State, surfaces: list[Surface]) -> None:
    """Close a loop if the last key scan sees a place again."""
    new = len(known.keys) - 1
    awaited = bool(known.pending) and new - known.pending[-1].new <= loops.WITHIN
    if known.loops and known.way[-1] - known.closed < SEARCH_EVERY and not awaited:
        return
    poses, way = np.array([known.poses[k] for k in known.keys]), np.array(known.way)
    old = loops.candidate(poses, way, known.closed)
    if old < 0:
        return
    loop = loops.close(surfaces, poses, old, loops.uncertain(way[-1] - known.closed))
    if loop is None:
        return
    known.pending = [one for one in known.pending if new - one.new <= loops.WITHIN] + [loop]
    if not loops.agreeing(known.pending, poses):
        return
    known.pending = []
    known.closed = known.way[-1]
    known.loops.append(loop)
    off = between(poses[new], compose(poses[old], loop.measured))
    if math.hypot(off[0], off[1]) > BENT[0] or abs(off[2]) > BENT[1]:
        _move(known, solve(poses, _edges(known)))


def _edges(known: State) -> Edges:
    """The chain of key scans, and the loops. What walls do not hold the front end does, weakly."""
    rows = []
    for k in range(1, len(known.keys)):
        rows.append((k - 1, k, known.steps[k], known.information[k] + _weak(known.steps[k]), False))
    rows += [(*loop, True) for loop in known.loops]
    return Edges.of(rows)


def _weak(step: np.ndarray) -> np.ndarray:
    """(3, 3) information of a step by raw odometry."""
    size = np.array([1.0, math.hypot(step[0], step[1]), abs(step[2])])
    xy, heading = float(np.dot(RAW[0], size)), float(np.dot(RAW[1], size))
    return np.diag([xy**-2, xy**-2, heading**-2])


def _move(known: State, keys: np.ndarray) -> None:
    """Give the key scans new poses; the others go along with the key scan before them."""
    at = np.searchsorted(known.keys, np.arange(len(known.poses)), side="right") - 1
    before = np.array(known.poses)
    moved = compose(keys[at], between(before[known.keys][at], before))
    moved[known.keys] = keys
    known.poses = list(moved)


def _solved(log: LaserLog, way: Way | None, known: State, surfaces: list[Surface], track: Tracker) -> Corrected:
    """All poses together."""
    keys, poses = np.array(known.keys), np.array([known.poses[k] for k in known.keys])
    calibration = None
    edges = _edges(known)
    for n in range(ROUNDS if len(keys) > 1 else 0):
        ends = pairs(poses)
        aligned = pair_edges(surfaces, poses, ends, partial(_numbered, track, n + 1))
        if way is not None:
            calibration, error = calibrate(way, keys, poses)
            held = _odometry_edges(way, keys, calibration, error)
        else:
            held = Edges.of([(k - 1, k, known.steps[k], _weak(known.steps[k]), True) for k in range(1, len(keys))])
        # what is wrong with a scan is wrong in all of its pairs: together they count as two
        shared = max(len(aligned.ends) / len(keys), 1.0)
        aligned = aligned._replace(information=aligned.information / shared)
        edges = Edges(*(np.concatenate(both) for both in zip(aligned, held, strict=True)))
        poses = solve(poses, edges)
    at = np.maximum(np.searchsorted(keys, np.arange(len(log)), side="right") - 1, 0)
    everywhere = filled(np.array(known.poses), keys, poses)
    absolute, local = covariances(poses, edges)[at], local_covariances(poses, edges)[at]
    return Corrected(
        poses=everywhere,
        covariance=absolute,
        local_covariance=local,
        way=_along(log, way, calibration, everywhere),
        keys=keys,
        loops=len(known.loops),
        lost=known.lost,
        calibration=calibration,
    )


def _numbered(track: Tracker, number: int, scans: Iterable[int], what: str) -> Iterable[int]:
    return track(scans, f"{what} {number}")


def _odometry_edges(way: Way, keys: np.ndarray, calibration: Calibration, error: Error) -> Edges:
    odometry = calibrated(way.poses, calibration)[way.scans[keys]]
    step = between(odometry[:-1], odometry[1:])
    information = np.diag([error.xy**-2, error.xy**-2, error.heading**-2])
    return Edges.of([(k - 1, k, step[k - 1], information, True) for k in range(1, len(keys))])


def _along(log: LaserLog, way: Way | None, calibration: Calibration | None, poses: np.ndarray) -> Way:
    """The scans, and the odometry between them made to fit."""
    if way is None or calibration is None:
        stamps = np.full(len(log), np.nan) if log.times is None else log.times
        return Way(stamps, poses, np.arange(len(log)))
    return way._replace(poses=filled(calibrated(way.poses, calibration), way.scans, poses))
