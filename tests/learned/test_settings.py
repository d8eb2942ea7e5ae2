import dataclasses
import json

import pytest

pytest.importorskip("torch")

from baselines.learned.settings import TrainConfig, read_train_config, train_config
from polyexplore_gym.errors import InvalidConfigError


def test_a_configuration_comes_back_from_json(tmp_path):
    config = train_config({"method": "both", "stages": [{"suites": "home-train office-train", "states": 7}]})
    path = tmp_path / "train.json"
    path.write_text(json.dumps(dataclasses.asdict(config)))
    assert read_train_config(path) == config
    assert config.stages[0].names == ("home-train", "office-train")
    assert train_config({}) == TrainConfig()


def test_fields_of_the_environment_that_are_left_out_stay():
    config = train_config({"env": {"sensor": {"max_range": 30.0}}})
    assert config.env.sensor.max_range == 30.0
    assert config.env.drive.mode == "kinematic"
    assert config.env.exploration.placement == "in_front"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"methods": "both"}, "methods"),
        ({"method": "magic"}, "method"),
        ({"seed": -1}, "seed"),
        ({"stages": []}, "at least one"),
        ({"stages": {}}, "a list"),
        ({"stages": [{"suites": "home-tset"}]}, "home-tset"),
        ({"stages": [{"suites": "home-test"}]}, "not for training"),
        ({"stages": [{"suites": ""}]}, "no suite"),
        ({"stages": [{"largest": 1}]}, "largest"),
        ({"rollouts": {"tried": 1}}, "tried"),
        ({"fit": {"epochs": 0}}, "epochs"),
        ({"ppo": {"gamma": 0}}, "gamma"),
        ({"ppo": {"horizon": 1}}, "horizon"),
        ({"validation": {"suites": "home-test"}}, "for the end"),
        ({"validation": {"first": 31}}, "first"),
        ({"network": {"width": "wide"}}, "width"),
        ({"network": {"width": 10, "heads": 4}}, "heads"),
        ({"env": {"observation": {"pairwise": False}}}, "pairwise"),
        ({"env": {"observation": {"relative": True}}}, "relative"),
        ({"env": 3}, "mapping"),
        ([], "mapping"),
    ],
)
def test_what_is_wrong_is_named(values, message):
    with pytest.raises(InvalidConfigError, match=message):
        train_config(values)


def test_files_that_cannot_be_read(tmp_path):
    for text in ("{", "[1]"):
        (tmp_path / "bad.json").write_text(text)
        with pytest.raises(InvalidConfigError, match=r"bad\.json"):
            read_train_config(tmp_path / "bad.json")
    with pytest.raises(InvalidConfigError, match="cannot be read"):
        read_train_config(tmp_path / "nowhere.json")
