"""A study on a local Ray cluster of two workers: the records are those of a run without it."""

import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
from fake_env import FakeEnv, plan

from polyexplore_gym.config import DriveConfig, EnvConfig
from polyexplore_gym.errors import InvalidConfigError, MissingDependencyError, ResultsError
from polyexplore_gym.evaluation import Study, evaluate, load_policy, name_policies, read_records
from polyexplore_gym.evaluation import runner as runner_module
from polyexplore_gym.floorplan import FloorPlan, suite

ROOMS = [[0, 0], [9, 0], [9, 4], [5, 4], [5, 6], [9, 6], [9, 9], [0, 9], [0, 5], [3, 5], [3, 4], [0, 4]]


class Mortal:
    """`nearest`; in its third decision on one plan it kills its own process, so often as it is told."""

    name = "mortal"

    def __init__(self, folder: Path, deaths: int) -> None:
        self.folder, self.deaths, self.calls = folder, deaths, 0

    def reset(self) -> None:
        self.calls = 0

    def act(self, observation, info, rng):
        self.calls += 1
        dead = len(list(self.folder.iterdir()))
        if self.calls == 3 and dead < self.deaths:
            (self.folder / str(dead)).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return load_policy("nearest").act(observation, info, rng)


def test_without_ray_the_error_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    study = Study(policies=name_policies(["nearest"]), plans=[plan(0)])
    with pytest.raises(MissingDependencyError, match=r"polyexplore-gym\[ray\]"):
        evaluate(study, progress=False, backend="ray", make_env=FakeEnv)
    with pytest.raises(InvalidConfigError, match="backend = 'dask'"):
        evaluate(study, progress=False, backend="dask", make_env=FakeEnv)


@pytest.fixture
def ray(monkeypatch):
    """Ray, whose workers find the modules of these tests."""
    found = pytest.importorskip("ray")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]))
    yield found
    found.shutdown()


@pytest.mark.slow
def test_a_worker_that_dies_in_mid_run_changes_no_record(ray, tmp_path):
    deaths = tmp_path / "deaths"
    deaths.mkdir()
    plans = [FloorPlan.create(np.array(ROOMS) * scale, name=f"rooms {scale}") for scale in (1.0, 0.7)]
    plans.append(suite("home-test").plan(0))

    def study(times: int) -> Study:
        return Study(
            policies=name_policies(["nearest", "random", Mortal(deaths, times)]),
            plans=plans,
            placements=("midpoint", "in_front"),
            seeds=(0, 1),
            config=EnvConfig(drive=DriveConfig(mode="kinematic")),
        )

    embedded = evaluate(study(0), out=tmp_path / "embedded", progress=False)
    assert all(r.ended for r in embedded)
    remote = evaluate(study(2), out=tmp_path / "ray", workers=2, backend="ray", progress=False)
    assert len(list(deaths.iterdir())) == 2
    assert remote == embedded
    assert read_records(tmp_path / "ray") == read_records(tmp_path / "embedded")
    assert not ray.is_initialized()


@pytest.mark.slow
def test_what_goes_wrong_on_ray_is_told(ray, tmp_path, monkeypatch):
    def study(*policies) -> Study:
        return Study(policies=name_policies(policies), plans=[plan(i) for i in range(4)])

    ray.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    deaths = tmp_path / "deaths"
    deaths.mkdir()
    arguments = {"out": tmp_path / "ray", "workers": 2, "backend": "ray", "progress": False, "make_env": FakeEnv}
    with pytest.raises(ResultsError, match="worker process died"):
        evaluate(study("nearest", Mortal(deaths, 1000)), **arguments)
    # What ended before is kept, and the next start goes on from it.
    assert evaluate(study("nearest", Mortal(deaths, 0)), **arguments) == evaluate(
        study("nearest", Mortal(deaths, 0)), progress=False, make_env=FakeEnv
    )
    assert ray.is_initialized()  # it was there before
    monkeypatch.setattr(runner_module, "versions", lambda: {**runner_module._versions(), "numba": "0.1"})
    with pytest.raises(ResultsError, match=r"numba .*, not 0\.1"):
        evaluate(study("random"), workers=2, backend="ray", progress=False, make_env=FakeEnv)
    ray.shutdown()
    with pytest.raises(InvalidConfigError, match=r"no Ray cluster at 127\.0\.0\.1:1"):
        evaluate(study("random"), backend="ray", address="127.0.0.1:1", progress=False, make_env=FakeEnv)
