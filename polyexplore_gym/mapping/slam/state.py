"""What the mapper knows after each scan, and its file, so that an interrupted run goes on: `State`."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from polyexplore_gym.errors import ResultsError
from polyexplore_gym.mapping.logs.record import LaserLog
from polyexplore_gym.mapping.slam.loops import Loop

FORMAT = 1
"""Raised whenever what a file holds is read differently."""


@dataclass(slots=True)
class State:
    """The map after some scans, as poses and what ties them; s scans, k of them key scans."""

    poses: list[np.ndarray] = field(default_factory=list)
    """s poses (3,): x, y (m), heading (rad), as the front end gave them, moved with the key scan before."""
    keys: list[int] = field(default_factory=list)
    """k indices of the key scans."""
    information: list[np.ndarray] = field(default_factory=list)
    """k arrays (3, 3): of each key pose seen from the one before, from the walls alone, in its own frame."""
    steps: list[np.ndarray] = field(default_factory=list)
    """k poses (3,) of each key scan seen from the one before, as the front end gave them."""
    way: list[float] = field(default_factory=list)
    """k lengths of the way to each key scan, m."""
    loops: list[Loop] = field(default_factory=list)
    """Places that were seen again; `old` and `new` count key scans."""
    pending: list[Loop] = field(default_factory=list)
    """Those that wait for a second opinion."""
    closed: float = 0.0
    """Way when a place was last seen again, m."""
    lost: int = 0
    """Scans that were not recognised."""
    since: int = 0
    """Scans since the last one that was."""


def fingerprint(log: LaserLog, settings: str) -> str:
    """Tells logs and settings apart."""
    digest = hashlib.sha256(f"{FORMAT} {settings}".encode())
    way = None if log.way is None else log.way.poses
    for arrays in (log.angles, log.ranges, [way, log.odometry, log.poses, log.times]):
        for array in arrays:
            digest.update(b"-" if array is None else np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def save(state: State, path: Path, log: str) -> None:
    """Write a state in one go; `log` is of `fingerprint`.

    Raises:
        ResultsError: the file cannot be written.
    """
    loops = [*state.loops, *state.pending]
    part = path.with_name(f".{path.name}.part")
    try:
        with part.open("wb") as file:
            np.savez(
                file,
                log=np.array(log),
                poses=np.array(state.poses),
                keys=np.array(state.keys),
                information=np.array(state.information),
                steps=np.array(state.steps),
                way=np.array(state.way),
                ends=np.array([(loop.old, loop.new) for loop in loops]).reshape(-1, 2),
                measured=np.array([loop.measured for loop in loops]).reshape(-1, 3),
                loop_information=np.array([loop.information for loop in loops]).reshape(-1, 3, 3),
                numbers=np.array([len(state.loops), state.closed, state.lost, state.since]),
            )
        os.replace(part, path)
    except OSError as error:
        raise ResultsError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)


def load(path: Path, log: str) -> State | None:
    """The state in a file, if there is one of this log and these settings."""
    try:
        with np.load(path, allow_pickle=False) as data:
            held = {key: data[key] for key in data.files}
        if held["log"].item() != log:
            return None
        ends = held["ends"].tolist()
        loops = [
            Loop(old, new, *rest)
            for (old, new), *rest in zip(ends, held["measured"], held["loop_information"], strict=True)
        ]
        count, closed, lost, since = held["numbers"].tolist()
        return State(
            poses=list(held["poses"]),
            keys=held["keys"].tolist(),
            information=list(held["information"]),
            steps=list(held["steps"]),
            way=held["way"].tolist(),
            loops=loops[: int(count)],
            pending=loops[int(count) :],
            closed=closed,
            lost=int(lost),
            since=int(since),
        )
    except FileNotFoundError:
        return None
    except Exception:  # a file that was cut off or is none of ours: begin again
        return None
