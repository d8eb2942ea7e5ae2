"""Settings: their labels, and the configurations they stand for."""

import itertools
from typing import get_args

import pytest

from polyexplore_gym import cli
from polyexplore_gym.config import EnvConfig, ExplorationConfig
from polyexplore_gym.errors import InvalidConfigError
from polyexplore_gym.evaluation.setting import FIELDS, SENSING, Setting

SETTINGS = [Setting(*pair) for pair in itertools.product(("midpoint", "in_front"), SENSING)]


def exploration(**fields) -> EnvConfig:
    return EnvConfig(exploration=ExplorationConfig(**fields))


@pytest.mark.parametrize("setting", SETTINGS, ids=str)
@pytest.mark.parametrize(
    "config",
    [exploration(), exploration(scan_every=0.2), exploration(scan_every=1.0, decide="interval", decide_every=3.0)],
)
def test_a_configuration_is_in_the_setting_that_made_it(setting, config):
    made = setting.configured(config)
    assert Setting.of(made) == setting
    assert setting.configured(made) == made
    fields = {name: getattr(made.exploration, name) for name in FIELDS}
    assert made == EnvConfig(exploration=ExplorationConfig(decide_every=config.exploration.decide_every, **fields))


def test_what_the_configuration_says_of_the_way_is_kept():
    moving, passing = Setting("midpoint", "moving"), Setting("midpoint", "passing")
    for setting, config, every, decide in (
        (moving, exploration(), 0.5, "settled"),
        (moving, exploration(scan_every=0.2), 0.2, "settled"),
        (moving, exploration(scan_every=0.2, decide="interval"), 0.2, "interval"),
        (passing, exploration(), 0.5, "arrival"),
        (passing, exploration(scan_every=0.2, decide="settled"), 0.2, "arrival"),
        (Setting("midpoint"), exploration(scan_every=0.2, decide="settled"), 0.0, "arrival"),
    ):
        made = setting.configured(config).exploration
        assert (made.scan_every, made.decide) == (every, decide)


def test_labels():
    assert [str(setting) for setting in SETTINGS] == [
        "midpoint", "midpoint, passing", "midpoint, moving", "in_front", "in_front, passing", "in_front, moving",
    ]  # fmt: skip
    assert f"{Setting('in_front', 'moving')}" == "in_front, moving"


def test_the_command_knows_the_same_names():
    assert get_args(cli.Sensing) == SENSING


def test_unknown_names_are_told():
    with pytest.raises(InvalidConfigError, match="sensing = 'fast': must be one of stops, passing, moving"):
        Setting("midpoint", "fast").configured(EnvConfig())
    with pytest.raises(InvalidConfigError, match="placement = 'behind'"):
        Setting("behind").configured(EnvConfig())
