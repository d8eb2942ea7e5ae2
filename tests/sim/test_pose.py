import itertools
import math

import numpy as np
import pytest

from polyexplore_gym.config import PoseConfig
from polyexplore_gym.errors import InvalidConfigError, InvalidMotionError
from polyexplore_gym.sim.pose import PoseModel, wrap

DRIVE = np.array([[0, 0, 0.0], [2, 0, 0.0], [2, 0, 1.5], [2.1, 1.5, 1.5], [2.1, 1.5, -2.5], [1.0, 0.7, -2.5]])


def error(estimate: np.ndarray, true: np.ndarray) -> np.ndarray:
    out = estimate - true
    out[2] = wrap(out[2])
    return out


def nees(model: PoseModel, true: np.ndarray) -> float:
    e = error(model.estimate, true)
    return float(e @ np.linalg.solve(model.covariance, e))


def test_exact_follows_the_truth() -> None:
    model = PoseModel(PoseConfig(), DRIVE[0], np.random.default_rng(0))
    model.moved(DRIVE)
    np.testing.assert_array_equal(model.estimate, DRIVE[-1])
    estimate, covariance = model.measured(DRIVE[-1])
    np.testing.assert_array_equal(estimate, DRIVE[-1])
    np.testing.assert_array_equal(covariance, np.zeros((3, 3)))
    np.testing.assert_array_equal(model.to_true(DRIVE), DRIVE)


def test_gaussian_errors_are_independent_with_the_reported_covariance() -> None:
    config = PoseConfig(mode="gaussian", sigma_xy=0.05, sigma_heading=0.02)
    model = PoseModel(config, DRIVE[0], np.random.default_rng(1))
    true = np.array([3.0, 4.0, math.pi - 0.01])  # errors cross the seam
    errors, values = [], []
    for _ in range(4000):
        estimate, covariance = model.measured(true)
        assert -math.pi < estimate[2] <= math.pi
        errors.append(error(estimate, true))
        values.append(nees(model, true))
    np.testing.assert_allclose(covariance, np.diag([0.05**2, 0.05**2, 0.02**2]))
    np.testing.assert_allclose(np.cov(np.array(errors).T) / covariance.max(), covariance / covariance.max(), atol=0.06)
    lag = np.array(errors)[1:, 0] * np.array(errors)[:-1, 0]
    assert abs(lag.mean()) < 4 * 0.05**2 / math.sqrt(len(lag))
    assert np.mean(values) == pytest.approx(3.0, abs=0.2)


@pytest.mark.parametrize("dense", [False, True])
def test_odometry_covariance_is_consistent(dense: bool) -> None:
    drive = DRIVE
    if dense:  # the same drive in small steps, as the physics reports it
        drive = np.concatenate([np.linspace(a, b, 40, endpoint=False) for a, b in itertools.pairwise(DRIVE)])
        drive = np.vstack([drive, DRIVE[-1]])
    rng = np.random.default_rng(2)
    config = PoseConfig(mode="odometry", drift_distance=0.02, drift_heading=0.02, drift_turn=0.01)
    errors, values = [], []
    for _ in range(3000):
        model = PoseModel(config, drive[0], rng)
        model.moved(drive)
        errors.append(error(model.estimate, drive[-1]))
        values.append(nees(model, drive[-1]))
    assert np.mean(values) == pytest.approx(3.0, abs=0.2)
    spread = np.sqrt(np.diag(model.covariance))
    scatter = np.cov(np.array(errors).T)
    np.testing.assert_allclose(
        scatter / np.outer(spread, spread), model.covariance / np.outer(spread, spread), atol=0.12
    )


def test_odometry_variances_grow_as_stated() -> None:
    config = PoseConfig(mode="odometry", drift_distance=0.03, drift_heading=0.02, drift_turn=0.05)
    turn = PoseModel(config, np.zeros(3), np.random.default_rng(0))
    turn.moved(np.array([[0, 0, 0.0], [0, 0, 2.0]]))
    np.testing.assert_allclose(turn.covariance, np.diag([0.0, 0.0, 0.05**2 * 2.0]), atol=1e-15)
    drive = PoseModel(config, np.zeros(3), np.random.default_rng(0))
    drive.moved(np.array([[0, 0, 0.0], [5.0, 0, 0.0]]))
    variance = np.diag(drive.covariance)
    assert variance[0] == pytest.approx(0.03**2 * 5, rel=0.05)
    assert variance[2] == pytest.approx(0.02**2 * 5)
    assert variance[1] == pytest.approx(
        0.03**2 * 5 + 0.02**2 * 5**3 / 3, rel=0.1
    )  # drift bends the way, as it was felt
    before = drive.covariance
    drive.measured(np.array([5.0, 0, 0.0]))  # nothing corrects odometry
    np.testing.assert_array_equal(drive.covariance, before)
    # standing still adds nothing
    drive.moved(np.array([[5.0, 0, 0.0], [5.0, 0, 0.0]]))
    np.testing.assert_array_equal(drive.covariance, before)


def test_odometry_without_noise_and_in_parts_is_the_truth() -> None:
    config = PoseConfig(mode="odometry", drift_distance=0.0, drift_heading=0.0, drift_turn=0.0)
    model = PoseModel(config, DRIVE[0], np.random.default_rng(0))
    for a, b in itertools.pairwise(DRIVE):
        model.moved(np.array([a, b]))
        np.testing.assert_allclose(error(model.estimate, b), 0.0, atol=1e-12)


@pytest.mark.parametrize("mode", ["exact", "gaussian", "odometry", "slam"])
def test_paths_are_mapped_by_the_current_error(mode: str) -> None:
    config = PoseConfig(mode=mode, sigma_heading=0.3, sigma_xy=0.2, drift_heading=0.3)  # type: ignore[arg-type]
    model = PoseModel(config, DRIVE[0], np.random.default_rng(3))
    model.moved(DRIVE)
    model.measured(DRIVE[-1])
    estimate = model.estimate
    np.testing.assert_allclose(model.to_true(estimate[None])[0], DRIVE[-1], atol=1e-12)
    # two metres ahead as believed is two metres ahead in truth
    ahead = estimate[:2] + 2.0 * np.array([math.cos(estimate[2]), math.sin(estimate[2])])
    expected = DRIVE[-1, :2] + 2.0 * np.array([math.cos(DRIVE[-1, 2]), math.sin(DRIVE[-1, 2])])
    np.testing.assert_allclose(model.to_true(ahead[None])[0], expected, atol=1e-12)
    poses = np.random.default_rng(4).uniform(-3, 3, (20, 3))
    np.testing.assert_allclose(model.to_estimated(model.to_true(poses)), poses, atol=1e-12)


def test_gaussian_error_is_carried_along_rigidly() -> None:
    model = PoseModel(PoseConfig(mode="gaussian", sigma_heading=0.2), DRIVE[0], np.random.default_rng(5))
    model.measured(DRIVE[0])
    expected = model.to_estimated(DRIVE[-1:])[0]
    model.moved(DRIVE)
    np.testing.assert_allclose(model.estimate, expected, atol=1e-12)
    np.testing.assert_allclose(model.to_true(model.estimate[None])[0], DRIVE[-1], atol=1e-12)


def test_slam_drifts_as_odometry_until_it_is_corrected() -> None:
    models = [PoseModel(PoseConfig(mode=mode), DRIVE[0], np.random.default_rng(6)) for mode in ("odometry", "slam")]
    for model in models:
        model.moved(DRIVE)
        model.measured(DRIVE[-1])
    np.testing.assert_array_equal(models[0].estimate, models[1].estimate)
    np.testing.assert_array_equal(models[0].covariance, models[1].covariance)
    models[1].correct(np.array([1.0, 0.8, 4.0]), np.eye(3))
    np.testing.assert_allclose(models[1].estimate, [1.0, 0.8, 4.0 - 2 * math.pi])
    np.testing.assert_array_equal(models[1].covariance, np.eye(3))
    np.testing.assert_allclose(models[1].to_true(models[1].estimate[None])[0], DRIVE[-1], atol=1e-12)
    with pytest.raises(InvalidConfigError, match="correct_every"):
        PoseConfig(correct_every=0.05)


def test_wrap_and_bad_input() -> None:
    assert wrap(math.pi) == math.pi
    assert wrap(-math.pi) == math.pi
    assert wrap(7.0) == pytest.approx(7.0 - 2 * math.pi)
    with pytest.raises(InvalidMotionError, match="pose"):
        PoseModel(PoseConfig(), np.array([0, 0, np.inf]), np.random.default_rng(0))
    model = PoseModel(PoseConfig(), np.zeros(3), np.random.default_rng(0))
    with pytest.raises(InvalidMotionError, match="trajectory"):
        model.moved(np.zeros((3, 2)))
    with pytest.raises(InvalidMotionError, match="points"):
        model.to_true(np.zeros(3))
    model.moved(np.empty((0, 3)))
    np.testing.assert_array_equal(model.estimate, np.zeros(3))
