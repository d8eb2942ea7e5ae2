"""The examples run from top to bottom, in an empty folder, and say what they should."""

from __future__ import annotations

import importlib.util
import re
import runpy
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
# Arguments, what is needed, and what is told.
RUNS = {
    "01_first_loop": ([], (), r"^[\d.]+ m driven in \d+ scans, (9[5-9]|100)\.\d % seen$"),
    "02_own_policy": ([], (), r"frugal 0\.2"),
    "03_own_plan": ([], (), r"studio[\s\S]*^complete: [\d.]+ m, (9[5-9]|100)\.\d % seen$"),
    "04_laser_log": ([], (), r"^3 scans, \d+ points, 1 lines\n.* = 4\.0\d\d m, \+- 0\.00"),
    "05_train": (["--steps", "64"], ("sb3_contrib",), r"^(complete|unreached|budget): [\d.]+ m driven$"),
    "06_evaluate": ([], (), r"modified_sum[\s\S]*^longest: home"),
    "07_vector_environment": ([], (), r"^[1-9]\d* episodes ended, \d+ m driven in 120 decisions$"),
    "08_many_machines": ([], ("ray",), r"ekman_ratio"),
    "09_real_robot": ([], (), r"^complete \d+ scans, \d+ lines$"),
    "11_record_and_clone": (["--episodes", "6"], ("minari", "h5py", "torch"), r"^clone: [\d.]+ m, nearest: [\d.]+ m$"),
}


def test_all_are_numbered_short_and_run_here():
    names = [path.stem for path in EXAMPLES]
    assert [int(name[:2]) for name in names] == list(range(1, len(names) + 1))
    assert set(names) == {*RUNS, "10_ros2_node"}  # that has a test of its own
    for path in EXAMPLES:
        text = path.read_text(encoding="utf-8")
        assert f"python examples/{path.name}" in text
        most = 90 if path.stem == "10_ros2_node" else 60  # messages have many fields
        assert len(text.splitlines()) <= most, path.name


@pytest.mark.parametrize("name", RUNS)
def test_it_runs(name, tmp_path, monkeypatch, capsys):
    arguments, needs, told = RUNS[name]
    for module in needs:
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"needs {module}")
    if "torch" in needs or "sb3_contrib" in needs:
        __import__("torch").set_num_threads(1)
    monkeypatch.chdir(tmp_path)
    path = ROOT / "examples" / f"{name}.py"
    monkeypatch.setattr(sys, "argv", [str(path), *arguments])
    runpy.run_path(str(path), run_name="__main__")
    out = capsys.readouterr().out
    assert re.search(told, out, re.MULTILINE), out
