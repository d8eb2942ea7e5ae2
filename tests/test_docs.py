"""What the documents say is true: their code runs, their commands parse, their tables are complete."""

from __future__ import annotations

import importlib.util
import math
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from polyexplore_gym import __version__, cli
from polyexplore_gym.config import EnvConfig, RewardConfig, preset, to_mapping
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.floorplan import suite
from polyexplore_gym.presets import PRESETS

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BENCHMARKS = (ROOT / "benchmarks" / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    """The README's fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)


PYTHON = blocks("python")
COMMANDS = [line for block in blocks("sh") for line in block.splitlines() if "polyexplore " in line]


def arguments(command: str) -> list[str]:
    """Of a `polyexplore` command line, which may set variables first."""
    words = shlex.split(command)
    return words[words.index("polyexplore") + 1 :]


def rows(head: str, text: str = README) -> list[list[str]]:
    """The cells of the table whose first column has this head."""
    table = re.search(rf"^\| {re.escape(head)} \|.*\n\|[-|: ]+\|\n((?:\|.*\n)+)", text, re.MULTILINE)
    assert table is not None, head
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in table[1].splitlines()]


def names(head: str, text: str = README) -> list[str]:
    return [row[0].strip("| `") for row in rows(head, text)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where a reader would be: the README's own modules and plans, and docs/ beside them."""
    folder = tmp_path_factory.mktemp("reader")
    shutil.copytree(ROOT / "docs", folder / "docs")
    for code in PYTHON:
        if name := re.match(r"# (\w+\.py)\n", code):
            (folder / name[1]).write_text(code, encoding="utf-8")
    return folder


@pytest.fixture
def reader(folder, monkeypatch) -> Path:
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    return folder


@pytest.mark.parametrize("code", PYTHON, ids=lambda code: re.sub(r"\W+", "-", code[-40:]).strip("-"))
def test_python_runs(code, reader, tmp_path):
    if "sb3_contrib" in code:
        pytest.importorskip("sb3_contrib")
        # Spinning threads take many times longer when tests run side by side.
        pytest.importorskip("torch").set_num_threads(1)
    script = tmp_path / "block.py"
    script.write_text(code, encoding="utf-8")
    assert runpy.run_path(str(script))


def test_the_first_loop_is_short_and_ends():
    loop = PYTHON[0].strip().splitlines()
    assert len(loop) <= 12
    assert "action_mask" in PYTHON[0]
    assert "node_path_length" in PYTHON[0]


def test_the_first_loop_works_on_a_plan_seen_whole_from_the_start(tmp_path, monkeypatch, capsys):
    import gymnasium

    from polyexplore_gym.floorplan import FloorPlan

    room = FloorPlan.create([[0, 0], [3, 0], [3, 3], [0, 3]])
    config = {"sensor": {"field_of_view": 2 * math.pi, "beams": 720}}
    monkeypatch.setattr(gymnasium, "make", lambda *_, **__: PolyExploreEnv(room, config=config))
    exec(compile(PYTHON[0], "README", "exec"), {})
    assert capsys.readouterr().out == "0.0 m driven, 100.0 % seen\n"


def test_there_is_something_to_test():
    assert len(PYTHON) >= 6
    assert {arguments(command)[0] for command in COMMANDS} == set(cli._COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_parse(command, monkeypatch):
    parsed = []
    monkeypatch.setattr(cli, "_COMMANDS", {name: (kind, parsed.append) for name, (kind, _) in cli._COMMANDS.items()})
    cli.main(arguments(command))
    assert len(parsed) == 1


def test_commands_run_in_order(reader, capsys):
    """All but the default comparison and training, which take long."""
    for code in PYTHON:
        if "save_plan(" in code or "np.savez(" in code:
            exec(compile(code, "README", "exec"), {})
    ran = 0
    for command in COMMANDS:
        words = arguments(command)
        if words[0] == "bench" and not {"--suite", "--plans"} & set(words):
            continue
        if (
            "intel" in command
        ):  # a log that is not part of the repository: tests/mapping and tests/outline have their own
            continue
        if words[0] in ("train", "eval", "play"):  # hours, minutes, a person: tests/learned, tests/evaluation run them
            continue
        if words[0] == "record" and not (importlib.util.find_spec("minari") and importlib.util.find_spec("h5py")):
            continue
        extra = ["--workers", "1", "--no-plots", "--drive", "kinematic"] if words[0] == "bench" else []
        if "--gif" in words:  # as long as the exploration
            words[1] = "home-test/7"
        if "--bounds" in words:  # seconds a plan
            words[words.index("--first") + 1] = "1"
        capsys.readouterr()
        assert cli.main([*words, *extra]) == 0, command
        told = {"run": "distance", "bench": "IQM", "linemap": "compression", "report": "written", "plan": "written",
                "record": "episodes"}  # fmt: skip
        assert told[words[0]] in capsys.readouterr().out
        for option in ("--png", "--gif", "--out"):
            if option in words:
                assert Path(words[words.index(option) + 1]).exists()
        ran += 1
    assert ran >= 4


def test_a_policy_in_the_working_folder_is_found(folder):
    """With the variable that the README sets, by the command as installed."""
    command = next(c for c in COMMANDS if c.startswith("PYTHONPATH=. polyexplore run"))
    words = arguments(command)
    policy = words[words.index("--policy") + 1]
    code = f"from polyexplore_gym.evaluation import load_policy; load_policy({policy!r})"
    env = {**os.environ, "PYTHONPATH": ".", "PYTHONSAFEPATH": "1"}
    subprocess.run([sys.executable, "-c", code], cwd=folder, env=env, check=True)


def test_the_tables_name_every_key():
    env = PolyExploreEnv(plan=suite("home-validation").plan(0), config={"drive": {"mode": "kinematic"}})
    _, info = env.reset(seed=0)
    shapes = {row[0].strip("| `"): row[1] for row in rows("key")}
    assert shapes == {key: str(box.shape) for key, box in env.observation_space.spaces.items()}
    assert sorted(names("`info` key")) == sorted(info)
    assert sorted(names("reward term")) == sorted(info["rewards"])
    scales = {row[0].strip("| `"): float(row[1]) for row in rows("reward term")}
    assert scales == to_mapping(RewardConfig())
    assert f"`Discrete({env.action_space.n})`" in README
    assert f"`max_decisions` ({EnvConfig().max_decisions})" in README
    assert set(names("criterion")) == set(cli.SCRIPTED)
    assert set(names("planner")) == set(cli.LOOK_AHEAD)


def test_the_presets_are_listed():
    told = {row[0].strip("| `"): [float(cell.strip(" |")) for cell in row[2:6]] for row in rows("preset")}
    assert told.keys() == PRESETS.keys()
    for name, figures in told.items():
        c = preset(name)
        known = [c.sensor.beams, math.degrees(c.sensor.field_of_view), c.sensor.max_range, c.robot.radius]
        assert figures == pytest.approx(known), name


def test_environments_are_listed():
    import gymnasium

    registered = {name for name in gymnasium.registry if name.startswith("PolyExplore-")}
    assert set(names("environment")) == registered


def test_named_files_and_targets_exist():
    for path in re.findall(r"\]\(([^)#]+)\)", README) + re.findall(r"`((?:\w+/)+[\w.]+\.\w+)`", README):
        assert (ROOT / path).exists() or path.startswith("results/"), path
    for script in re.findall(r"python (\w+/\w+\.py)", README):
        assert (ROOT / script).exists(), script
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert set(re.findall(r"`make (\w+)`", README)) <= set(targets)
    assert (ROOT / "docs" / "exploration.gif").stat().st_size < 2_000_000


def test_the_benchmarks_are_listed():
    listed = names("script", BENCHMARKS)
    scripts = [path.name for path in (ROOT / "benchmarks").glob("*.py") if "__main__" in path.read_text()]
    assert sorted(listed) == sorted(scripts)
    for row in rows("script", BENCHMARKS):
        assert f"python benchmarks/{row[0].strip('| `')}" in row[2]


def test_the_changelog_has_this_version():
    assert re.search(rf"^## {re.escape(__version__)}\b", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
