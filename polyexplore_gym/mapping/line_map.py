"""The line map: walls seen in many scans, fused, in stable slots."""

from __future__ import annotations

import numpy as np

from polyexplore_gym.config import MappingConfig, SensorConfig
from polyexplore_gym.mapping.extract import LEAST_ANGLE_NOISE, LEAST_RANGE_NOISE, ScanLines
from polyexplore_gym.mapping.grid import Grid, empty_grid, grid_put
from polyexplore_gym.mapping.merge import insert
from polyexplore_gym.mapping.slots import MEMORY, Lines, Rows, Slots


class LineMap:
    """Lines with covariances, and the segments of wall on them, in the map frame.

    Everything known lies in rows: a row is a segment on a line, or a fragment (an obstacle without
    a line). A row keeps its slot while it lives; a freed slot may be used again. Lines have slots
    of their own. All arrays are views: copy what must outlive the next insert.

    Lines merge across scans if they were seen from the same side, overlap (or leave a gap below
    `config.door_width`) and pass dL' (P1 + P2)^-1 dL < `config.merge_gate` in a frame at the
    middle of the pair. The two faces of a thin wall never merge. What a drifting pose did to both is taken out: each
    line keeps its covariance with the pose, which is considered, not estimated (S. F. Schmidt, 1966), so that a hundred
    scans average out the noise of the laser but not the error of the way.

    Example:
        >>> import numpy as np
        >>> from polyexplore_gym.config import SensorConfig
        >>> from polyexplore_gym.mapping import LineMap, extract_lines
        >>> angles = np.linspace(-0.5, 0.5, 101)
        >>> lines = extract_lines(angles, 2.0 / np.cos(angles), SensorConfig())
        >>> line_map = LineMap()
        >>> line_map.insert(lines, np.array([1.0, 0.0, 0.0]), np.zeros((3, 3)))
        array([0])
        >>> line_map.segments[line_map.alive].round(2) + 0.0, line_map.rho.round(2)
        (array([[ 3.  , -1.09,  3.  ,  1.09]]), array([3.]))
    """

    def __init__(self, config: MappingConfig | None = None, sensor: SensorConfig | None = None) -> None:
        self.config = (MappingConfig() if config is None else config).resolved()
        assert self.config.door_width is not None
        self._door = self.config.door_width
        self.sensor = SensorConfig() if sensor is None else sensor
        self._var_range = max(self.sensor.sigma_range, self.config.range_floor, LEAST_RANGE_NOISE * self._door) ** 2
        self._var_angle = max(self.sensor.sigma_angle, LEAST_ANGLE_NOISE) ** 2
        self._row_count = self._line_count = 0
        self._pose = np.zeros(3)
        self._rows, self._lines = _rows(256), _lines(128)
        self._grid = empty_grid(256, 2.0 * self._door)
        self._slots = Slots(
            np.empty(256, np.int64),
            np.empty(128, np.int64),
            np.zeros(4, np.int64),
            np.empty(256, np.int64),
            np.empty(256, np.int64),
        )
        self._release(0, 256, 0, 128)

    def insert(
        self, lines: ScanLines, pose: np.ndarray, covariance: np.ndarray, *, drifting: bool = False
    ) -> np.ndarray:
        """Insert the lines and fragments of one scan.

        Args:
            lines: of `extract_lines`.
            pose: (3,) estimated x, y (m), heading (rad) of the scan in the map frame.
            covariance: (3, 3) covariance of the pose, m2, m rad, rad2.
            drifting: whether the pose was reckoned from that of the insert before, so that its error is the error of
                that one and what the way added. Otherwise the errors of two poses have nothing in common.

        Returns:
            Rows added, changed (an end moved by 0.4 % of a door's width or more) or removed, ascending.

        Raises:
            ValueError: pose or covariance has the wrong shape or is not finite; or `lines.lone` is not of one entry a
                fragment.
        """
        pose = np.ascontiguousarray(pose, np.float64)
        covariance = np.ascontiguousarray(covariance, np.float64)
        if pose.shape != (3,) or covariance.shape != (3, 3):
            raise ValueError(f"pose and covariance must be (3,) and (3, 3), got {pose.shape} and {covariance.shape}")
        if not (np.isfinite(pose).all() and np.isfinite(covariance).all()):
            raise ValueError(f"pose and covariance must be finite, got {pose} and {covariance}")
        lone = np.zeros(len(lines.fragments), np.bool_) if lines.lone is None else lines.lone
        if lone.shape != (len(lines.fragments),):
            raise ValueError(f"lone must be of shape ({len(lines.fragments)},), got {lone.shape}")
        self._reserve(lines.segments.shape[0] + lines.fragments.shape[0], lines.rho.size)
        slots = self._slots
        if not drifting:
            self._lines.shared[: self._line_count] = 0.0
        information = np.linalg.pinv(covariance, hermitian=True) if drifting else np.zeros((3, 3))
        insert(
            lines.rho, lines.alpha, lines.covariance, lines.segments, lines.segment_line, lines.fragments,
            lone, pose, covariance, self._var_range, self._var_angle, self.config.merge_gate, self._door,
            self.config.straightness, self.config.grouping, drifting, pose[:2] - self._pose[:2], information,
            self._rows, self._lines, self._grid, slots,
        )  # fmt: skip
        self._pose = pose.copy()
        touched = np.sort(slots.touched[: slots.counts[3]])
        if touched.size:
            self._row_count = max(self._row_count, int(touched[-1]) + 1)
        used = np.flatnonzero(self._lines.alive[self._line_count : self._line_count + lines.rho.size + 1])
        if used.size:
            self._line_count += int(used[-1]) + 1
        return touched

    @property
    def door(self) -> float:
        """Width of a door, m: the unit of lengths that decide in the map."""
        return self._door

    @property
    def segments(self) -> np.ndarray:
        """(M, 4) end points of all rows, m; the free space lies on the left. Stale where not alive."""
        return self._rows.segments[: self._row_count]

    @property
    def alive(self) -> np.ndarray:
        """(M,) whether a row is in use."""
        return self._rows.alive[: self._row_count]

    @property
    def line(self) -> np.ndarray:
        """(M,) line slot of a row, -1 for fragments."""
        return self._rows.line[: self._row_count]

    @property
    def side(self) -> np.ndarray:
        """(M,) 1: seen from the side of the line on which the map's origin lies, -1: from beyond; 0 for fragments."""
        return self._rows.side[: self._row_count]

    @property
    def sigma(self) -> np.ndarray:
        """(M,) standard deviation of a row across its direction, m."""
        return self._rows.sigma[: self._row_count]

    @property
    def lone(self) -> np.ndarray:
        """(M,) of a fragment about a lone return, which is as wide as its beam: where on it the return lies, as a share
        of its length, outside 0 to 1 if that part was known already; NaN for all other rows."""
        return self._rows.lone[: self._row_count]

    @property
    def rho(self) -> np.ndarray:
        """(N,) distance of each line from the map's origin, m."""
        return self._lines.rho[: self._line_count]

    @property
    def alpha(self) -> np.ndarray:
        """(N,) direction of each line's normal, rad."""
        return self._lines.alpha[: self._line_count]

    @property
    def covariance(self) -> np.ndarray:
        """(N, 2, 2) covariance of each line in the order (alpha, rho): of the line, and of its walls about it."""
        return self._lines.covariance[: self._line_count] + self._lines.spread[: self._line_count]

    @property
    def line_alive(self) -> np.ndarray:
        """(N,) whether a line slot is in use."""
        return self._lines.alive[: self._line_count]

    @property
    def line_side(self) -> np.ndarray:
        """(N,) like `side`, by line."""
        return self._lines.side[: self._line_count]

    @property
    def tables(self) -> tuple[Rows, Lines, Grid, np.ndarray]:
        """Rows, lines, the spatial index of the rows, and scratch for its answers: for kernels of this package."""
        return self._rows, self._lines, self._grid, self._slots.found

    def _reserve(self, rows: int, lines: int) -> None:
        """Make room for so many more rows and lines."""
        old_rows, old_lines = self._rows.alive.size, self._lines.alive.size
        new_rows, new_lines = old_rows, old_lines
        while self._slots.counts[0] + new_rows - old_rows < rows + 1:
            new_rows *= 2
        while self._slots.counts[1] + new_lines - old_lines < lines + 1:
            new_lines *= 2
        if new_rows == old_rows and new_lines == old_lines:
            return
        self._rows = Rows(*(_grown(old, new) for old, new in zip(self._rows, _rows(new_rows), strict=True)))
        self._lines = Lines(*(_grown(old, new) for old, new in zip(self._lines, _lines(new_lines), strict=True)))
        s = self._slots
        self._slots = Slots(
            _grown(s.rows, np.empty(new_rows, np.int64)),
            _grown(s.lines, np.empty(new_lines, np.int64)),
            s.counts,
            np.empty(new_rows, np.int64),
            np.empty(new_rows, np.int64),
        )
        self._release(old_rows, new_rows, old_lines, new_lines)
        if new_rows > old_rows:
            self._grid = empty_grid(new_rows, 2.0 * self._door)
            for row in np.flatnonzero(self._rows.alive).tolist():
                grid_put(self._grid, row, *self._rows.segments[row])

    def _release(self, row0: int, row1: int, line0: int, line1: int) -> None:
        """Put new slots under the free ones, so that low slots are used first."""
        s = self._slots
        for stack, which, new in (
            (s.rows, 0, range(row1 - 1, row0 - 1, -1)),
            (s.lines, 1, range(line1 - 1, line0 - 1, -1)),
        ):
            n = int(s.counts[which])
            stack[len(new) : len(new) + n] = stack[:n].copy()
            stack[: len(new)] = new
            s.counts[which] = n + len(new)


def _grown(old: np.ndarray, new: np.ndarray) -> np.ndarray:
    new[: old.shape[0]] = old
    return new


def _rows(n: int) -> Rows:
    return Rows(
        np.zeros((n, 4)),
        np.zeros((n, 4)),
        np.zeros((n, 2)),
        np.zeros(n, np.bool_),
        np.full(n, -1, np.int64),
        np.zeros(n, np.int8),
        np.zeros(n),
        np.full(n, -1, np.int64),
        np.zeros(n, np.int64),
        np.full(n, np.nan),
    )


def _lines(n: int) -> Lines:
    return Lines(
        np.zeros(n),
        np.zeros(n),
        np.zeros((n, 2, 2)),
        np.zeros(n, np.bool_),
        np.zeros(n, np.int8),
        np.full(n, -1, np.int64),
        np.zeros((n, MEMORY), np.int64),
        np.zeros(n, np.int64),
        np.zeros((n, 2, 3)),
        np.zeros((n, 3)),
        np.zeros((n, 2, 2)),
    )
