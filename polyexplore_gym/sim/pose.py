"""What the robot believes of its pose: exact, an external localiser, or drifting odometry.

The environment calls `moved` after each drive and `measured` before each scan; `to_true` takes a
path planned in the estimated frame to where the robot will really go.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from polyexplore_gym.config import PoseConfig
from polyexplore_gym.errors import InvalidMotionError

_STEP_LENGTH = 0.1
_STEP_TURN = 0.1
"""odometry: longer motions are cut into pieces of at most this (m, rad), so that heading drift bends the way. The
length does not follow from the robot: drift is given per metre, whoever drives it."""


def wrap(angle: float) -> float:
    """The angle in (-pi, pi], rad."""
    wrapped = math.remainder(angle, 2.0 * math.pi)
    return wrapped if wrapped > -math.pi else math.pi


@njit(cache=True)
def _pieces(trajectory):  # type: ignore[no-untyped-def]
    """Into how many pieces each motion of the trajectory (m, 3) is cut: (m - 1,)."""
    out = np.zeros(max(trajectory.shape[0] - 1, 0), dtype=np.int64)
    for i in range(out.size):
        dx, dy = trajectory[i + 1, 0] - trajectory[i, 0], trajectory[i + 1, 1] - trajectory[i, 1]
        turn = abs((trajectory[i + 1, 2] - trajectory[i, 2] + math.pi) % (2.0 * math.pi) - math.pi)
        length = math.hypot(dx, dy)
        if length > 0.0 or turn > 0.0:
            out[i] = max(1, math.ceil(length / _STEP_LENGTH), math.ceil(turn / _STEP_TURN))
    return out


@njit(cache=True)
def _dead_reckon(trajectory, pieces, noise, estimate, covariance, k_xy, k_distance, k_turn):  # type: ignore[no-untyped-def]
    """Advance estimate (3,) and covariance (3, 3) in place; noise (sum of pieces, 3) standard normals.

    For a piece of length l and turn a: position noise of variance k_xy^2 l in x and in y, heading noise of
    variance k_distance^2 l + k_turn^2 |a|. First order: P <- F P F' + Q, F = d(new pose) / d(pose).
    """
    row = 0
    for i in range(pieces.size):
        n = pieces[i]
        if n == 0:
            continue
        dx = (trajectory[i + 1, 0] - trajectory[i, 0]) / n
        dy = (trajectory[i + 1, 1] - trajectory[i, 1]) / n
        turn = ((trajectory[i + 1, 2] - trajectory[i, 2] + math.pi) % (2.0 * math.pi) - math.pi) / n
        length = math.hypot(dx, dy)
        var_xy = k_xy * k_xy * length
        var_heading = k_distance * k_distance * length + k_turn * k_turn * abs(turn)
        for j in range(n):
            error = estimate[2] - (trajectory[i, 2] + j * turn)  # turns the motion into the estimated frame
            c, s = math.cos(error), math.sin(error)
            mx = c * dx - s * dy + math.sqrt(var_xy) * noise[row, 0]
            my = s * dx + c * dy + math.sqrt(var_xy) * noise[row, 1]
            estimate[0] += mx
            estimate[1] += my
            estimate[2] += turn + math.sqrt(var_heading) * noise[row, 2]
            row += 1
            # F = [[1, 0, -my], [0, 1, mx], [0, 0, 1]]: by the estimated way, all that a robot knows of it; so the F of
            # many pieces is that of their sum, which a filter can tell from the estimates alone
            for k in range(3):
                covariance[0, k] -= my * covariance[2, k]
                covariance[1, k] += mx * covariance[2, k]
            for k in range(3):
                covariance[k, 0] -= my * covariance[k, 2]
                covariance[k, 1] += mx * covariance[k, 2]
            covariance[0, 0] += var_xy
            covariance[1, 1] += var_xy
            covariance[2, 2] += var_heading
    estimate[2] = math.pi - (math.pi - estimate[2]) % (2.0 * math.pi)


class PoseModel:
    """The estimated pose beside the true one.

    The map frame is that of the true start pose, so the estimate begins exact. Modes (`PoseConfig.mode`):
    `exact`; `gaussian`: every measurement has an independent error N(0, diag(sigma_xy^2, sigma_xy^2,
    sigma_heading^2)), between measurements the last error is carried along rigidly; `odometry`: the true
    motion, perturbed, is summed up, and the error never shrinks; `slam`: the same, but for `correct`.
    """

    def __init__(self, config: PoseConfig, pose: np.ndarray, rng: np.random.Generator) -> None:
        """pose (3,): the true start pose; rng: the only source of this model's noise.

        Raises `InvalidMotionError` for a pose that is not three finite numbers.
        """
        self.config = config
        self._rng = rng
        self._true = _checked_pose(pose)
        self._estimate = self._true.copy()
        self._covariance = np.zeros((3, 3))

    @property
    def estimate(self) -> np.ndarray:
        """(3,) estimated x, y (m) and heading (rad), a copy."""
        return self._estimate.copy()

    @property
    def covariance(self) -> np.ndarray:
        """(3, 3) covariance of the estimate, a copy; zero when exact."""
        return self._covariance.copy()

    def moved(self, trajectory: np.ndarray) -> None:
        """Advance the estimate along a drive. trajectory (m, 3): true poses, the first being the current one."""
        trajectory = np.ascontiguousarray(trajectory, dtype=np.float64)
        if trajectory.ndim != 2 or trajectory.shape[1:] != (3,) or not np.isfinite(trajectory).all():
            raise InvalidMotionError(f"trajectory of shape {trajectory.shape}: expected finite (m, 3)")
        if len(trajectory) == 0:
            return
        if self.config.mode in ("odometry", "slam"):
            pieces = _pieces(trajectory)
            noise = self._rng.standard_normal((int(pieces.sum()), 3))
            c = self.config
            _dead_reckon(
                trajectory,
                pieces,
                noise,
                self._estimate,
                self._covariance,
                c.drift_distance,
                c.drift_heading,
                c.drift_turn,
            )
        else:  # the error stays as it was, seen from the robot
            self._estimate = self.to_estimated(trajectory[-1:])[0]
        self._true = _checked_pose(trajectory[-1])

    def measured(self, true_pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Estimate (3,) and covariance (3, 3) for a measurement taken at the true pose (3,)."""
        true_pose = _checked_pose(true_pose)
        if self.config.mode == "exact":
            self._estimate = true_pose.copy()
        elif self.config.mode == "gaussian":
            sigma = np.array([self.config.sigma_xy, self.config.sigma_xy, self.config.sigma_heading])
            self._estimate = true_pose + sigma * self._rng.standard_normal(3)
            self._estimate[2] = wrap(self._estimate[2])
            self._covariance = np.diag(sigma**2)
        self._true = true_pose
        return self.estimate, self.covariance

    def correct(self, estimate: np.ndarray, covariance: np.ndarray) -> None:
        """Take over an estimate (3,) and its covariance (3, 3) that a filter made of the last measurement."""
        self._estimate = _checked_pose(estimate)
        self._covariance = np.array(covariance, dtype=np.float64)

    def to_true(self, points: np.ndarray) -> np.ndarray:
        """Points (k, 2) or poses (k, 3) of the estimated frame in the true frame, by the current error.

        The rigid motion that takes the estimated pose to the true one: what the robot believes to lie 2 m ahead
        lies 2 m ahead of where it really stands.
        """
        return _rigid(points, self._estimate, self._true)

    def to_estimated(self, points: np.ndarray) -> np.ndarray:
        """The inverse of `to_true`."""
        return _rigid(points, self._true, self._estimate)


def _rigid(points: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise InvalidMotionError(f"points of shape {points.shape}: expected (k, 2) or (k, 3)")
    if np.array_equal(source, target):
        return points.copy()
    turn = target[2] - source[2]
    c, s = math.cos(turn), math.sin(turn)
    out = points.copy()
    x, y = points[:, 0] - source[0], points[:, 1] - source[1]
    out[:, 0] = c * x - s * y + target[0]
    out[:, 1] = s * x + c * y + target[1]
    if points.shape[1] == 3:
        out[:, 2] = math.pi - (math.pi - (points[:, 2] + turn)) % (2.0 * math.pi)
    return out


def _checked_pose(pose: np.ndarray) -> np.ndarray:
    out = np.array(pose, dtype=np.float64)
    if out.shape != (3,) or not np.isfinite(out).all():
        raise InvalidMotionError(f"pose {pose!r}: expected three finite numbers")
    out[2] = wrap(out[2])
    return out


def with_stops(way: np.ndarray, every: float) -> tuple[np.ndarray, list[int]]:
    """A trajectory (m, 3) with a pose at every so many metres put in, and the rows of those; none near the end.

    A radian turned counts as a metre.
    """
    run = np.hypot(*np.diff(way[:, :2], axis=0).T)
    run += np.abs(np.remainder(np.diff(way[:, 2]) + math.pi, 2.0 * math.pi) - math.pi)
    driven = np.concatenate(([0.0], np.cumsum(run)))
    marks = np.arange(every, driven[-1] - 0.5 * every, every)
    if not len(marks):
        return way, []
    nxt = np.searchsorted(driven, marks)
    share = ((marks - driven[nxt - 1]) / (driven[nxt] - driven[nxt - 1]))[:, None]
    step = way[nxt] - way[nxt - 1]
    step[:, 2] = np.remainder(step[:, 2] + math.pi, 2.0 * math.pi) - math.pi
    return np.insert(way, nxt, way[nxt - 1] + share * step, axis=0), (nxt + np.arange(len(marks))).tolist()
