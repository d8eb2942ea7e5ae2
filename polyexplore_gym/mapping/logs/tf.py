"""Where a laser was, from the transforms of a bag: frames are a tree, whose edges are fixed or change with time."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from polyexplore_gym.errors import InvalidLogError
from polyexplore_gym.mapping.logs.poses import between
from polyexplore_gym.mapping.logs.record import FARTHEST, Track
from polyexplore_gym.mapping.logs.trajectory import UNIT, covered

MOST_TILT = math.radians(20.0)
"""A laser that is tilted more does not scan a floor plan, rad."""
SAME = 0.02, math.radians(1.0)
"""A transform that never changes by more is fixed, m and rad."""
MOST_FRAMES = 1000
"""A chain of more frames is none."""


@dataclass(slots=True)
class Edge:
    """The transforms from a frame to its parent."""

    parent: str
    fixed: bool
    """Published once for all times."""
    times: list[float] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)
    """x, y, z, qx, qy, qz, qw."""
    changes: bool | None = None
    """Worked out when it is asked for, and all are there."""

    def sorted(self) -> tuple[np.ndarray, np.ndarray]:
        """Times (m,), increasing, and transforms (m, 7) whose quaternions do not change sign."""
        times, first = np.unique(self.times, return_index=True)
        values = np.array(self.values, np.float64)[first]
        turned = (values[1:, 3:] * values[:-1, 3:]).sum(axis=1) < 0
        values[1:, 3:] *= np.where(np.cumsum(turned) % 2 == 1, -1.0, 1.0)[:, None]
        return times, values

    def plane(self) -> Track:
        """The transforms in the plane."""
        times, values = self.sorted()
        turn = _rotations(values[:, 3:])
        return Track(times, np.column_stack([values[:, :2], np.arctan2(turn[:, 1, 0], turn[:, 0, 0])]))

    def moves(self) -> bool:
        """Whether the transform changes at all."""
        if self.changes is None:
            poses = self.plane().poses
            off = between(poses[0], poses)
            self.changes = bool((np.hypot(off[:, 0], off[:, 1]) > SAME[0]).any() or (np.abs(off[:, 2]) > SAME[1]).any())
        return self.changes and not self.fixed


class Frames:
    """The frames of a bag."""

    def __init__(self) -> None:
        self.edges: dict[str, Edge] = {}
        """By the frame below."""
        self.others: Counter[str] = Counter()
        """Transforms left out as the frame has another parent, by frame."""

    def add(self, parent: str, child: str, time: float, value: Sequence[float], fixed: bool) -> str:
        """Add a transform; says what is wrong with it, or nothing."""
        if not all(map(math.isfinite, value)) or max(map(abs, value[:3])) > FARTHEST or not math.isfinite(time):
            return "a transform is not finite"
        if abs(math.hypot(*value[3:]) - 1.0) > UNIT:
            return f"a quaternion has the length {math.hypot(*value[3:]):g}, not 1"
        if not parent or not child or parent == child:
            return f"a transform leads from {child!r} to {parent!r}"
        edge = self.edges.setdefault(child, Edge(parent, fixed))
        if edge.parent != parent:
            self.others[child] += 1
            return ""
        edge.fixed &= fixed
        edge.times.append(time)
        edge.values.append(tuple(value))
        return ""

    def above(self, frame: str) -> list[str]:
        """The frame and all above it, to the root."""
        chain = [frame]
        while chain[-1] in self.edges:
            chain.append(self.edges[chain[-1]].parent)
            if chain[-1] in chain[:-1] or len(chain) > MOST_FRAMES:
                raise InvalidLogError(f"/tf: the frames above {frame} run in a circle: {', '.join(chain[:5])} ...")
        return chain

    def lowest(self, chain: list[str]) -> int:
        """Number of the edge, up a chain, above which the robot moves; where it never does, that below odometry.

        The length of the chain less one if there is none.
        """
        edges = [self.edges[name] for name in chain[:-1]]
        moving = [k for k, edge in enumerate(edges) if edge.moves()]
        told = [k for k, edge in enumerate(edges) if not edge.fixed and "odom" in edge.parent.lower()]
        return (moving or told or [len(edges)])[0]

    def known(self, chain: list[str], times: np.ndarray) -> np.ndarray:
        """(n,) whether the transforms up a chain are told at these times (n,)."""
        sound = np.ones(times.size, bool)
        for frame in chain[:-1]:
            if self.edges[frame].moves():
                sound &= covered(self.edges[frame].plane(), times)
        return sound

    def pose(self, chain: list[str], times: np.ndarray) -> tuple[np.ndarray, bool]:
        """(n, 3) the first frame of a chain in the last one, in the plane, and whether it lies upside down there."""
        rotation, offset = np.broadcast_to(np.eye(3), (times.size, 3, 3)), np.zeros((times.size, 3))
        for frame in chain[:-1]:
            at, values = self.edges[frame].sorted()
            value = np.stack([np.interp(times, at, column) for column in values.T], axis=1)
            turn = _rotations(value[:, 3:])
            offset = np.einsum("nij,nj->ni", turn, offset) + value[:, :3]
            rotation = turn @ rotation
        upright = float(np.median(rotation[:, 2, 2])) if times.size else 1.0
        if abs(upright) < math.cos(MOST_TILT):
            tilt = math.degrees(math.acos(min(abs(upright), 1.0)))
            raise InvalidLogError(f"/tf: the laser frame {chain[0]} is tilted by {tilt:.0f} degrees in {chain[-1]}")
        turn = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
        return np.column_stack([offset[:, :2], turn]), upright < 0.0


def _rotations(quaternions: np.ndarray) -> np.ndarray:
    """(n, 3, 3) of quaternions x, y, z, w (n, 4), of any length."""
    x, y, z, w = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)
