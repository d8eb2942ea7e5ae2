"""What is read from a laser log: `LaserLog`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

LEAST_BEAMS = 3
"""Fewest beams of a scan."""
MOST_BEAMS = 100_000
"""Most beams of a scan."""
WIDEST = 2.0 * np.pi + 0.1
"""Widest field of view, rad: a full turn, and what a step that was rounded, or beams at the seam, may add."""
LONGEST_RANGE = 1e4
"""No laser measures farther, m."""
FARTHEST = 1e8
"""A pose farther from the origin is garbage, m."""


class Broken(NamedTuple):
    """A part of a log that could not be used."""

    where: str
    reason: str

    def __str__(self) -> str:
        return f"{self.where}: {self.reason}"


class Track(NamedTuple):
    """Poses over time."""

    times: np.ndarray
    """(m,) s, increasing strictly."""
    poses: np.ndarray
    """(m, 3) x, y (m) and heading (rad)."""

    @classmethod
    def sorted(cls, times: np.ndarray, poses: np.ndarray) -> Track:
        """The track of poses (m, 3) at times (m,) in any order; the first of several at one time."""
        times, first = np.unique(times, return_index=True)
        return cls(times, poses[first])

    def at(self, times: np.ndarray) -> np.ndarray:
        """(k, 3) poses at these times (k,), between neighbours on a straight way; the ends hold outside."""
        heading = np.unwrap(self.poses[:, 2])
        return np.stack([np.interp(times, self.times, c) for c in (*self.poses[:, :2].T, heading)], axis=1)


class Way(NamedTuple):
    """Odometry between the scans, in the order in which it was written: stamps may repeat or go back."""

    stamps: np.ndarray
    """(m,) s; NaN: none."""
    poses: np.ndarray
    """(m, 3) x, y (m) and heading (rad) of the laser by odometry alone."""
    scans: np.ndarray
    """(n,) which of them each scan was taken at."""


@dataclass(frozen=True, slots=True)
class LaserLog:
    """The scans of a log: n scans, the k-th of b_k beams. All poses are those of the laser, mounting applied."""

    angles: Sequence[np.ndarray] | np.ndarray
    """n arrays (b_k,) of beam angles in the laser's frame, rad, increasing. Scans whose beams are alike share one
    array; a single array (b,) stands for all scans."""
    ranges: Sequence[np.ndarray] | np.ndarray
    """n arrays (b_k,), m; an array (n, b) does as well. inf, or `max_range` and more: nothing as far as the maximum
    range. NaN: nothing is known about that beam."""
    poses: np.ndarray | None
    """(n, 3) x, y (m) and heading (rad) in the map frame as the log gives them; `poses_are` says what they are."""
    pose_covariance: np.ndarray | None = None
    """(n, 3, 3) covariance of the poses, m2, m rad, rad2, if the log gives it."""
    max_range: float | None = None
    """Range from which on a beam has no return, m, if the log gives it."""
    poses_are: Literal["corrected", "odometry", "unknown", "matched"] = "unknown"
    """corrected by a SLAM program or a localiser; raw odometry, then equal to `odometry`; the log does not say; or
    matched: found from the scans by `correct_poses`."""
    why: str = ""
    """How that is known, for the user: a clause."""
    odometry: np.ndarray | None = None
    """(n, 3) pose by odometry alone when the scan was taken, in the odometry frame, if the log gives it."""
    track: Track | None = None
    """Odometry between the scans, in the odometry frame, if the log gives it with times."""
    way: Way | None = None
    """The same in the order of the file, with the scans in it, if the log gives it."""
    times: np.ndarray | None = None
    """(n,) when the pose of each scan holds, s, not always increasing, if the log gives it."""
    beam_times: Sequence[np.ndarray] | None = None
    """n arrays (b_k,): when each beam was measured, s after `times`; None where a scan is taken at once."""
    mount: np.ndarray | None = None
    """(3,) x, y (m) and heading (rad) of the laser on the robot, if the log gives it. Applied already."""
    broken: tuple[Broken, ...] = ()
    """What was left out, in the order of the file."""
    unread: dict[str, int] = field(default_factory=dict)
    """Scans in messages of another kind than the one read, by message or topic."""
    read: str = ""
    """The message or topic that was read."""
    notes: tuple[str, ...] = ()
    """What the user should know about how the log was read."""

    def __post_init__(self) -> None:
        if isinstance(self.angles, np.ndarray) and self.angles.ndim == 1:
            object.__setattr__(self, "angles", (self.angles,) * len(self.ranges))
        for name in ("angles", "ranges", "beam_times"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, tuple(value))

    def __len__(self) -> int:
        """Number of scans."""
        return len(self.ranges)
