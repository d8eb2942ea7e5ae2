"""Same seed, same trajectory, to the last bit: again, in other processes, on one worker or four."""

from __future__ import annotations

import copy
import json
import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
import trajectories
from trajectories import CONFIGS, GOLDEN, GOLDEN_TASKS, TASKS, run

from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.floorplan import suite

SCRIPT = Path(trajectories.__file__)


def start(workers: int, hash_seed: str) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, str(SCRIPT), "--exact", str(workers)],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONHASHSEED": hash_seed},
        text=True,
    )


def result(process: subprocess.Popen) -> list[str]:
    out, _ = process.communicate()
    assert process.returncode == 0
    return json.loads(out)


@pytest.fixture(scope="module")
def exact() -> list[str]:
    """The hashes from this process, one environment an episode."""
    return [run(task).exact.hexdigest() for task in TASKS]


def test_the_hashes_tell_trajectories_apart(exact):
    assert len(exact) == len(set(exact)) == 60


def test_same_process_one_environment_for_all_in_reverse_order(exact):
    envs = {mode: PolyExploreEnv(config=config) for mode, config in CONFIGS.items()}
    again = [run(task, envs[task[3]]).exact.hexdigest() for task in reversed(TASKS)]
    assert again[::-1] == exact


def test_fresh_process_with_one_worker(exact):
    assert result(start(1, "1")) == exact


def test_fresh_process_with_four_workers(exact):
    assert result(start(4, "2")) == exact


def test_a_copy_goes_on_as_the_original():
    for config in CONFIGS.values():
        env = PolyExploreEnv(config=config)
        _, info = env.reset(seed=2, options={"plan": suite("home-validation").plan(1)})
        *_, info = env.step(int(info["action_mask"].argmax()))
        others = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
        digests = [trajectories.Digest() for _ in range(3)]
        for one, digest in zip((env, *others), digests, strict=True):
            mask = info["action_mask"]
            for _ in range(3):
                action = int(mask.argmax())
                observation, _, _, _, after = one.step(action)
                digest.add(action, observation, after, one.true_pose)
                mask = after["action_mask"]
            one.reset(options={"plan": suite("home-validation").plan(0)})
            digest.add(0, *one.reset(options={"plan": suite("home-validation").plan(0)}), one.true_pose)
        assert len({digest.exact.hexdigest() for digest in digests}) == 1


@pytest.mark.parametrize("task", GOLDEN_TASKS, ids=lambda task: "-".join(map(str, task)))
def test_golden_trajectories(task):
    """If this fails on purpose: raise the version suffix of the environments, then renew the file (it says how)."""
    stored = json.loads(GOLDEN.read_text())["trajectories"][" ".join(map(str, task))]
    assert run(task).golden() == stored


def test_golden_trajectories_are_of_this_version():
    stored = json.loads(GOLDEN.read_text())
    assert stored["version"] == trajectories.version()
    assert list(stored["trajectories"]) == [" ".join(map(str, task)) for task in GOLDEN_TASKS]
