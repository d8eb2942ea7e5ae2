"""The evaluation with the real environment: the fake one of the other tests keeps the same contract."""

import numpy as np
import pytest
from fake_env import FakeEnv, plan

from polyexplore_gym.config import DriveConfig, EnvConfig
from polyexplore_gym.evaluation import Study, evaluate, load_policy, name_policies
from polyexplore_gym.evaluation.plots import replay, trajectory_figure
from polyexplore_gym.evaluation.runner import make_env
from polyexplore_gym.floorplan import FloorPlan

ROOMS = [[0, 0], [9, 0], [9, 4], [5, 4], [5, 6], [9, 6], [9, 9], [0, 9], [0, 5], [3, 5], [3, 4], [0, 4]]


@pytest.fixture(scope="module")
def study() -> Study:
    return Study(
        policies=name_policies(["nearest", "random", "distance_advantage"]),
        plans=[FloorPlan.create(np.array(ROOMS) * scale, name=f"rooms {scale}") for scale in (1.0, 0.7)],
        placements=("midpoint", "in_front"),
        sensing=("stops", "moving"),
        seeds=(0, 5),
        config=EnvConfig(drive=DriveConfig(mode="kinematic")),
    )


@pytest.fixture(scope="module")
def records(study):
    return evaluate(study, progress=False)


def test_records_do_not_depend_on_workers_or_order(study, records, tmp_path):
    assert evaluate(study, out=tmp_path, workers=2, progress=False) == records
    assert all(r.ended for r in records)
    for r in records:
        assert (np.diff(r.curve_distance) >= 0).all()
        assert (np.diff(r.curve_coverage) >= 0).all()
        assert len(r.curve_distance) == r.decisions + 1
        assert sum(r.ends.values()) == r.decisions
        assert r.ends.get("settled", 0) == 0 or r.sensing == "moving"
        assert r.reward == pytest.approx(-r.distance, abs=1e-3)


def test_an_episode_can_be_seen_again(study, records):
    for task, record in zip(study.tasks(), records, strict=True):
        if task.plan is study.plans[0]:
            env = make_env(task.config)
            snapshot, again = replay(env, load_policy(task.policy), task.plan, task.seed, label=task.label)
            assert again == record
            assert snapshot.distance == pytest.approx(record.distance, abs=1e-6)


def test_moving_is_moving(records):
    ways = {s: [r.distance for r in records if r.policy == "nearest" and r.sensing == s] for s in ("stops", "moving")}
    assert sum(ways["moving"]) < 0.95 * sum(ways["stops"])
    assert sum(r.ends.get("settled", 0) for r in records) > 10


def test_trajectories_show_every_policy(study):
    figure = trajectory_figure(study.policies, study.plans[0], 0, study.config_for("in_front"))
    titles = [panel.get_title() for panel in figure.axes]
    assert [title.split(":")[0] for title in titles] == list(study.policies)


def test_the_fake_environment_keeps_the_contract():
    real, fake = make_env(EnvConfig(drive=DriveConfig(mode="kinematic"))), FakeEnv(EnvConfig())
    for env in (real, fake):
        observation, info = env.reset(seed=0, options={"plan": plan(3)})
        if env is real:
            known = {key: value.dtype for key, value in observation.items()}, set(info)
    for key, value in observation.items():
        assert known[0][key] == value.dtype
    assert set(info) <= known[1]
