"""One moment of an exploration, as plain arrays: what the environment hands to whoever draws it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from polyexplore_gym.errors import RenderingError

Polygon = tuple[np.ndarray, tuple[np.ndarray, ...]]
"""Exterior (n, 2) and holes, each (k, 2); rings are not closed."""


def _empty(*shape: int, dtype: type = np.float64) -> np.ndarray:
    return np.zeros(shape, dtype=dtype)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Snapshot:
    """One moment of an exploration as plain arrays and numbers: all that a picture needs.

    Metres and radians throughout. Whoever takes a snapshot hands over arrays that do not change
    afterwards (copies), since an animation may keep many of them.

    Raises `RenderingError` if arrays that belong together differ in length, or `chosen` is no row.
    """

    exterior: np.ndarray
    """(n, 2) outer ring of the true floor plan."""
    holes: tuple[np.ndarray, ...] = ()
    """Obstacles of the true floor plan, each (k, 2)."""
    walls: np.ndarray = field(default_factory=lambda: _empty(0, 4))
    """(M, 4) wall segments of the line map: x1, y1, x2, y2 in the map frame."""
    wall_fitted: np.ndarray = field(default_factory=lambda: _empty(0, dtype=bool))
    """(M,) bool: a fitted line (True), or a fragment without a trusted covariance."""
    explored: tuple[Polygon, ...] = ()
    """Area seen so far, in the map frame."""
    jump_edges: tuple[np.ndarray, ...] = ()
    """Polylines, each (k, 2): where something unseen may lie beyond."""
    node_positions: np.ndarray = field(default_factory=lambda: _empty(0, 2))
    """(N, 2) candidate measurement positions; a node's number is its row, the action that chooses it."""
    node_headings: np.ndarray = field(default_factory=lambda: _empty(0))
    """(N,) heading in which the robot would measure there."""
    node_mask: np.ndarray = field(default_factory=lambda: _empty(0, dtype=bool))
    """(N,) bool: the node can be reached."""
    chosen: int | None = None
    """Row of the node that was chosen among those shown here."""
    trajectory: np.ndarray = field(default_factory=lambda: _empty(0, 2))
    """(m, 2) or (m, 3): the way driven so far, true positions."""
    measured_at: np.ndarray = field(default_factory=lambda: _empty(0, 2))
    """(k, 2) or (k, 3): where measurements were taken, true positions."""
    path: np.ndarray = field(default_factory=lambda: _empty(0, 2))
    """(k, 2) path planned by the last decision, in the map frame."""
    scan: np.ndarray | None = None
    """(n, 2) end points of the last scan in the map frame, in the order of the beams."""
    scan_pose: np.ndarray | None = None
    """(3,) pose from which that scan was taken, in the map frame."""
    pose: np.ndarray
    """(3,) true pose of the robot."""
    estimate: np.ndarray | None = None
    """(3,) where the robot believes it is; None: the same as `pose`."""
    radius: float = 0.25
    """Radius of the robot's disc."""
    distance: float = 0.0
    """Driven so far, m."""
    coverage: float | None = None
    """Share of the free area seen, 0 to 1; None: not known."""
    measurements: int = 0
    """Measurements taken so far."""
    title: str = ""
    """Shown above the map, such as the plan's name."""

    def __post_init__(self) -> None:
        rows = len(self.node_positions)
        for name, length in (("wall_fitted", len(self.walls)), ("node_headings", rows), ("node_mask", rows)):
            if len(getattr(self, name)) != length:
                raise RenderingError(f"Snapshot.{name} has {len(getattr(self, name))} rows, expected {length}")
        if self.chosen is not None and not 0 <= self.chosen < rows:
            raise RenderingError(f"Snapshot.chosen = {self.chosen}: there are {rows} nodes")
        if self.exterior.ndim != 2 or self.exterior.shape[1] != 2 or len(self.exterior) < 3:
            raise RenderingError(f"Snapshot.exterior has shape {self.exterior.shape}, expected (n, 2) with n >= 3")
