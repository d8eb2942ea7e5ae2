"""The lengths that decide: in a world scaled with its robot, sensor and noise nothing else changes."""

from __future__ import annotations

import dataclasses

import pytest
from exploration_scenes import tol_of

from polyexplore_gym.config import ExplorationConfig, SensorConfig
from polyexplore_gym.exploration.tolerances import Tolerances, noise_at, squeezed, tolerances

NO_LENGTHS = {"sigma_angle", "step", "samples"}


def scaled(sensor: SensorConfig, k: float) -> SensorConfig:
    return dataclasses.replace(sensor, max_range=k * sensor.max_range, sigma_range=k * sensor.sigma_range)


@pytest.mark.parametrize("k", [0.1, 3.0, 40.0])
@pytest.mark.parametrize(
    "config",
    [ExplorationConfig(), ExplorationConfig(min_gap=0.7, front_distance=1.3, samples=9)],
    ids=["auto", "given"],
)
@pytest.mark.parametrize("reach", [1.0, 8.0, 200.0])
def test_robot_sensor_and_configuration_times_k_give_all_lengths_times_k(k, config, reach):
    sensor = SensorConfig(max_range=reach, sigma_range=0.013, sigma_angle=0.003)
    bigger = dataclasses.replace(
        config,
        min_gap=None if config.min_gap is None else k * config.min_gap,
        front_distance=None if config.front_distance is None else k * config.front_distance,
    )
    for change in (lambda t: t, squeezed):
        small = change(tolerances(config, sensor, 0.22))
        large = change(tolerances(bigger, scaled(sensor, k), 0.22 * k))
        for name in Tolerances._fields:
            factor = 1.0 if name in NO_LENGTHS else k
            assert getattr(large, name) == pytest.approx(factor * getattr(small, name)), name


def test_clearances_are_in_order():
    """Legs may come nearer to walls than way points, these nearer than nodes; none nearer than the radius."""
    for radius in (0.02, 0.25, 2.0):
        tol = tol_of(radius=radius)
        assert radius < tol.sweep < tol.need < tol.stand < tol.radius + tol.spare < tol.reach
        tight = squeezed(tol)
        assert 0.8 * radius < tight.sweep < tight.need < tol.need


def test_a_node_in_front_stays_within_the_range():
    assert tolerances(ExplorationConfig(), SensorConfig(max_range=1.0), 0.25).front == 0.5
    assert tolerances(ExplorationConfig(), SensorConfig(max_range=8.0), 0.25).front == 1.0
    assert tolerances(ExplorationConfig(front_distance=4.0), SensorConfig(max_range=4.0), 0.25).front == 2.0


def test_noise_of_an_end_point_grows_with_its_distance():
    tol = tol_of(SensorConfig(sigma_range=0.03, sigma_angle=0.01))
    assert noise_at(0.0, tol) == pytest.approx(0.03)
    assert noise_at(4.0, tol) == pytest.approx(0.05)
