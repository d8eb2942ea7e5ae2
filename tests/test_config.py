"""Configurations: their types and bounds, whether built directly or from mappings."""

import dataclasses
import json
import math
import typing

import gymnasium as gym
import numpy as np
import pytest

from polyexplore_gym import config as module
from polyexplore_gym.config import (
    DriveConfig,
    EnvConfig,
    ExplorationConfig,
    MappingConfig,
    ObservationConfig,
    PoseConfig,
    RewardConfig,
    RobotConfig,
    SensorConfig,
    from_mapping,
    preset,
    to_mapping,
)
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.errors import InvalidConfigError
from polyexplore_gym.floorplan import FloorPlan, generate
from polyexplore_gym.presets import PRESETS, PresetName

PARTS = [
    SensorConfig, RobotConfig, DriveConfig, PoseConfig, MappingConfig, ExplorationConfig, ObservationConfig,
    RewardConfig, EnvConfig,
]  # fmt: skip


@pytest.mark.parametrize("part", PARTS)
def test_constructors_check_types(part):
    for name in (f.name for f in dataclasses.fields(part)):
        for value in ([1], {"a": 1}, (), b"x", object(), np.zeros(2), 1j, np.datetime64("2020-01-01")):
            with pytest.raises(InvalidConfigError, match=rf"{part.__name__}\.{name} = .*: expected"):
                part(**{name: value})
        check_own_types(part, name)


def check_own_types(part, name):
    kind = typing.get_type_hints(part)[name]
    default = getattr(part(), name)
    if kind in (int, float, bool) or kind == float | None:
        wrong = {int: (True, 1.5, "1", None), float: (True, "1", None), bool: (1, "True", None)}
        for value in wrong.get(kind, (True, "1")):
            with pytest.raises(InvalidConfigError, match=rf"{part.__name__}\.{name} = .*: expected"):
                part(**{name: value})
    else:
        with pytest.raises(InvalidConfigError, match=rf"{part.__name__}\.{name} = 1: expected"):
            part(**{name: 1})
    if kind is float:
        for value in (math.nan, math.inf, -math.inf, 10**400):
            with pytest.raises(InvalidConfigError, match=rf"{part.__name__}\.{name} = .*: must be finite"):
                part(**{name: value})
    assert part(**{name: default}) == part()


def test_numbers_of_numpy_are_numbers():
    values = {
        "sensor": {"beams": np.int64(181), "max_range": np.float32(8.5), "field_of_view": np.array(3.0)},
        "robot": {"radius": np.int32(1), "mass": np.float64(9)},
        "exploration": {"min_gap": np.float64(0.7), "look_around": np.bool_(False), "placement": np.str_("in_front")},
        "observation": {"max_nodes": np.uint8(200)},
    }
    mapped = from_mapping(EnvConfig, values)
    direct = EnvConfig(
        sensor=SensorConfig(**values["sensor"]),
        robot=RobotConfig(**values["robot"]),
        exploration=ExplorationConfig(**values["exploration"]),
        observation=ObservationConfig(**values["observation"]),
    )
    assert mapped == direct
    assert from_mapping(EnvConfig, json.loads(json.dumps(to_mapping(direct)))) == direct
    for part in (direct.sensor, direct.robot, direct.exploration, direct.observation):
        for f in dataclasses.fields(part):
            assert type(getattr(part, f.name)) in (int, float, bool, str, type(None)), f.name
    assert type(direct.robot.radius) is float
    for value in (np.float64(181), np.bool_(True), np.array([181])):
        with pytest.raises(InvalidConfigError, match=r"config\.sensor\.beams = .*: expected int"):
            from_mapping(EnvConfig, {"sensor": {"beams": value}})


@pytest.mark.parametrize(
    ("part", "values", "message"),
    [
        (SensorConfig, {"beams": 2}, r"SensorConfig\.beams = 2: must lie in 3 to 20000"),
        (SensorConfig, {"beams": 20_001}, r"SensorConfig\.beams = 20001"),
        (SensorConfig, {"field_of_view": 0.0}, r"SensorConfig\.field_of_view = 0\.0"),
        (SensorConfig, {"field_of_view": 6.3}, r"SensorConfig\.field_of_view = 6\.3"),
        (SensorConfig, {"max_range": 1.1e5}, r"SensorConfig\.max_range = 110000\.0: must lie in \(0, 100000\] m"),
        (SensorConfig, {"sigma_range": -0.01}, r"SensorConfig\.sigma_range = -0\.01"),
        (SensorConfig, {"sigma_angle": -0.01}, r"SensorConfig\.sigma_angle = -0\.01"),
        (ObservationConfig, {"max_nodes": 4097},
         r"max_nodes = 4097: must be at most 4096: the matrix of path lengths would take more than 64 MB"),
        (ObservationConfig, {"max_lines": 2_000_000},
         r"max_lines = 2000000: must be at most 1864135: the lines .* 64 MB"),
        (ObservationConfig, {"max_lines": 0}, r"max_lines = 0: must be at least 1"),
        (RobotConfig, {"radius": 0}, r"RobotConfig\.radius = 0\.0: must be positive"),
        (EnvConfig, {"sensor": SensorConfig(field_of_view=0.001)},
         r"EnvConfig\.sensor\.field_of_view = 0\.001: must be at least 10 degrees; .* would take 6283 turns"),
        (EnvConfig, {"sensor": SensorConfig(field_of_view=5e-324)}, r"EnvConfig\.sensor\.field_of_view = 5e-324"),
        (EnvConfig, {"sensor": SensorConfig(beams=12)}, r"EnvConfig\.sensor\.beams = 12: lie 16\.4 degrees apart"),
        (EnvConfig, {"sensor": SensorConfig(max_range=0.01)},
         r"EnvConfig\.sensor\.max_range = 0\.01: must be at least 0\.375 m, 1\.5 times robot\.radius"),
        (EnvConfig, {"sensor": SensorConfig(sigma_range=0.81)},
         r"EnvConfig\.sensor\.sigma_range = 0\.81: must be at most 0\.8 m, a tenth of max_range"),
        (EnvConfig, {"sensor": SensorConfig(sigma_angle=0.11)}, r"EnvConfig\.sensor\.sigma_angle = 0\.11: .* 0\.1 rad"),
        (EnvConfig, {"robot": RobotConfig(radius=6.0)}, r"EnvConfig\.sensor\.max_range = 8\.0: must be at least 9 m"),
        (EnvConfig, {"sensor": {"beams": 3}}, r"EnvConfig\.sensor = \{'beams': 3\}: expected SensorConfig"),
    ],
)  # fmt: skip
def test_bounds(part, values, message):
    with pytest.raises(InvalidConfigError, match=message):
        part(**values)


def test_what_lies_within_the_bounds_works():
    """The extremes are explored with, not only built."""
    room = FloorPlan.create([[0, 0], [6, 0], [6, 3], [4, 3], [4, 5], [0, 5]])
    for values in (
        {"sensor": {"field_of_view": math.radians(module.NARROWEST_VIEW), "beams": 3}},
        {"sensor": {"field_of_view": 2 * math.pi, "beams": 24}},
        {"sensor": {"beams": module.MOST_BEAMS}},
        {"sensor": {"max_range": 0.375}},
        {"sensor": {"max_range": module.LONGEST}},
        {"sensor": {"sigma_range": 0.8, "sigma_angle": 0.1}},
        {"observation": {"max_nodes": 4096, "max_lines": 200_000}},
    ):
        env = PolyExploreEnv(room, config={**values, "drive": {"mode": "kinematic"}})
        observation, info = env.reset(seed=0)
        assert env.observation_space.contains(observation)
        for _ in range(3):
            if info["action_mask"].any():
                observation, *_, info = env.step(int(np.flatnonzero(info["action_mask"])[0]))
                assert env.observation_space.contains(observation)


def test_a_sensor_by_itself_may_be_any():
    """Logs come from all kinds of sensors; only to explore with, there must be something to see."""
    for values in ({"field_of_view": 0.01}, {"max_range": 0.05}, {"beams": 3}, {"sigma_angle": 0.3}):
        SensorConfig(**values)


# Presets -------------------------------------------------------------------------------------------


def test_presets_by_name_in_a_mapping_and_through_make():
    assert typing.get_args(PresetName) == tuple(PRESETS)
    assert preset("pioneer3dx") == EnvConfig()
    burger = preset("turtlebot3")
    assert (burger.sensor.beams, burger.sensor.max_range, burger.robot.radius) == (360, 3.5, 0.105)
    mapped = from_mapping(
        EnvConfig,
        {"preset": "turtlebot3", "sensor": {"max_range": np.float32(3.0)}, "drive": DriveConfig(mode="kinematic")},
    )
    sensor = dataclasses.replace(burger.sensor, max_range=3.0)
    assert mapped == dataclasses.replace(burger, sensor=sensor, drive=DriveConfig(mode="kinematic"))
    whole = from_mapping(EnvConfig, {"preset": "turtlebot3", "sensor": SensorConfig()})
    assert (whole.sensor, whole.robot) == (SensorConfig(), burger.robot)
    for config in (burger, {"preset": "turtlebot3"}):
        env = gym.make("polyexplore_gym:PolyExplore-Home-v2", config=config)
        assert env.unwrapped.config == burger
        assert gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json())).unwrapped.config == burger
    for name in ("r2d2", 3, None):
        with pytest.raises(InvalidConfigError, match=rf"config\.preset = {name!r}: unknown; known: pioneer3dx, turtle"):
            from_mapping(EnvConfig, {"preset": name})
    with pytest.raises(InvalidConfigError, match=r"config\.sensor: unknown field 'preset'"):
        from_mapping(EnvConfig, {"sensor": {"preset": "turtlebot3"}})
    with pytest.raises(InvalidConfigError, match=r"config\.sensor: expected a mapping"):
        from_mapping(EnvConfig, {"preset": "turtlebot3", "sensor": 3})


@pytest.mark.parametrize("name", PRESETS)
def test_presets_explore(name):
    for mode in ("physics", "kinematic"):
        env = PolyExploreEnv(generate("home", 0), config={"preset": name, "drive": {"mode": mode}})
        observation, info = env.reset(seed=0)
        seen = info["coverage"]
        for _ in range(4):
            valid = np.flatnonzero(info["action_mask"])
            if len(valid):
                observation, *_, info = env.step(int(valid[observation["node_path_length"][valid].argmin()]))
        assert info["coverage"] > seen
        assert info["distance"] > 0
        assert info["sim_time"] > info["distance"] / env.config.robot.max_speed - 1e-6
