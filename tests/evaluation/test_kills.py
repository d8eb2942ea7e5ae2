"""benchmarks/kills.py with the real command: its twenty kills, and a disk that is full."""

import dataclasses
import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from polyexplore_gym.evaluation import read_records
from polyexplore_gym.evaluation.results import EPISODES

PATH = Path(__file__).resolve().parents[2] / "benchmarks" / "kills.py"
ARGUMENTS = ["--suite", "home-test", "--first", "2", "--drive", "kinematic", "--workers", "2", "--no-plots"]


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("kills", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def whole(script, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("kills") / "whole"
    code, said = script.finish(ARGUMENTS, out)
    assert code == 0, said
    return out


@pytest.mark.slow
def test_twenty_kills_change_no_record(script, whole, tmp_path):
    assert script.kills(ARGUMENTS, read_records(whole), tmp_path, 20, seed=1) == 0


@pytest.mark.slow
def test_a_full_disk_changes_no_record(script, whole, tmp_path):
    wrong = script.full_disk(ARGUMENTS, read_records(whole), tmp_path, (whole / EPISODES).stat().st_size)
    if wrong is None:
        pytest.skip("no tmpfs can be mounted here")
    assert wrong == 0


@pytest.mark.slow
def test_differences_are_found(script, whole, tmp_path):
    expected = read_records(whole)
    path = tmp_path / EPISODES
    path.write_bytes((whole / EPISODES).read_bytes())
    assert script.differences(tmp_path, expected) == []
    assert script.differences(tmp_path, [dataclasses.replace(r, timing={}) for r in expected]) == []
    lines = path.read_text().splitlines()
    lines[0] = json.dumps({**json.loads(lines[0]), "distance": 1.0})
    path.write_text("\n".join(lines[:-1]) + "\n")
    found = script.differences(tmp_path, expected[1:])
    assert {text.split(":")[0] for text in found} <= {"missing", "too many", "differs"}
    assert len(script.differences(tmp_path, expected)) == 2
    # What is cut off the end is less than a line.
    rng = np.random.default_rng(0)
    for _ in range(20):
        path.write_bytes((whole / EPISODES).read_bytes())
        said = script.damage(tmp_path, rng)
        assert script.lines(tmp_path) == len(expected) - ("cut" in said)
