"""Scans on the way and decisions there: when a drive ends, that it goes on at speed, and that nothing is lost."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest

from polyexplore_gym.config import EnvConfig, from_mapping
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.errors import InvalidConfigError
from polyexplore_gym.floorplan import FloorPlan, generate

ENDS = {"arrived", "settled", "interval", "blocked", "bump", "time", "lost"}
HALL = FloorPlan.create(
    [[0, 0], [20, 0], [20, 3], [12, 3], [12, 8], [20, 8], [20, 11], [0, 11], [0, 8], [8, 8], [8, 3], [0, 3]],
    name="hall",
)


def config(mode: str = "kinematic", **exploration: Any) -> dict[str, Any]:
    return {"drive": {"mode": mode}, "exploration": {"scan_every": 0.5, "decide": "settled", **exploration}}


def nearest(observation: dict[str, np.ndarray]) -> int:
    valid = np.flatnonzero(observation["action_mask"])
    return int(valid[observation["node_path_length"][valid].argmin()])


def play(env: PolyExploreEnv, seed: int = 0, options: dict[str, Any] | None = None) -> list[dict[str, Any]]:
    """The infos of an episode of `nearest`, the first from reset, each with its observation."""
    observation, info = env.reset(seed=seed, options=options)
    infos, over = [{**info, "observation": observation}], not info["action_mask"].any()
    while not over:
        observation, _, terminated, truncated, info = env.step(nearest(observation))
        infos.append({**info, "observation": observation})
        over = terminated or truncated
    return infos


def test_decisions_on_the_way_need_scans_on_the_way():
    for decide in ("settled", "interval"):
        with pytest.raises(InvalidConfigError, match=f"'{decide}' needs scans on the way"):
            from_mapping(EnvConfig, {"exploration": {"decide": decide}})
    with pytest.raises(InvalidConfigError, match="decide"):
        from_mapping(EnvConfig, {"exploration": {"decide": "now", "scan_every": 1.0}})
    with pytest.raises(InvalidConfigError, match="decide_every"):
        from_mapping(EnvConfig, {"exploration": {"decide": "interval", "scan_every": 1.0, "decide_every": 0.0}})


@pytest.mark.parametrize("mode", ["kinematic", "physics"])
def test_a_drive_ends_when_its_jump_edge_is_settled(mode):
    env = PolyExploreEnv(generate("home", 3), config=config(mode))
    infos = play(env)
    assert {info["ended"] for info in infos[1:]} <= ENDS
    assert infos[0]["ended"] == "start"
    settled = short = 0
    for before, after in itertools.pairwise(infos):
        driven = after["distance"] - before["distance"]
        if after["ended"] == "settled":
            settled += 1
            short += driven < np.hypot(*np.diff(np.array(after["path"]), axis=0).T).sum() - 0.1
            assert after["measurements"] > before["measurements"]  # it was a scan that settled it
    assert settled > 3
    assert short >= 0.8 * settled
    assert infos[-1]["outcome"]["status"] == "complete"
    assert infos[-1]["coverage"] > 0.98


def test_moving_is_shorter_than_stopping():
    ratio = []
    for seed in range(4):
        plan = generate("home", 10 + seed)
        moving = play(PolyExploreEnv(plan, config=config()))[-1]
        stops = play(PolyExploreEnv(plan, config={"drive": {"mode": "kinematic"}}))[-1]
        assert moving["coverage"] > 0.98
        ratio.append(moving["distance"] / stops["distance"])
    assert np.mean(ratio) < 0.9


@pytest.mark.parametrize(("family", "seed"), [("home", 32), ("angled", 20), ("angled", 22), ("office", 21)])
def test_a_robot_that_looks_before_it_enters_the_unknown_does_not_bump(family, seed):
    """With the node on the jump edge half the disc stands in what nobody has seen: 1 to 4 bumps each without."""
    info = play(PolyExploreEnv(generate(family, seed), config=config("physics", placement="midpoint")))[-1]
    assert info["outcome"]["status"] == "complete"
    assert info["collisions"] == 0


def test_arrival_drives_to_the_end():
    env = PolyExploreEnv(generate("home", 3), config=config(decide="arrival"))
    infos = play(env)
    assert {info["ended"] for info in infos[1:]} <= {"arrived", "bump", "time", "lost"}
    assert any(after["measurements"] > before["measurements"] + 1 for before, after in itertools.pairwise(infos))


def test_an_interval_ends_drives_too_and_the_pursued_node_is_marked():
    env = PolyExploreEnv(HALL, config=config(decide="interval", decide_every=1.0))
    infos = play(env, options={"start": (1.0, 1.5)})
    kept = 0
    for before, after in itertools.pairwise(infos):
        assert after["distance"] - before["distance"] < 1.5 + 0.5 + 1e-6
        pursued = after["observation"]["node_pursued"]
        assert pursued.sum() <= 1
        assert not (pursued & ~after["observation"]["node_mask"].astype(bool)).any()
        kept += after["ended"] == "interval" and pursued.any()
        assert after["ended"] != "settled" or not pursued.any()
    assert kept > 0
    assert not infos[0]["observation"]["node_pursued"].any()


def test_a_policy_that_keeps_to_the_pursued_node_arrives():
    env = PolyExploreEnv(HALL, config=config(decide="interval", decide_every=0.5))
    observation, info = env.reset(seed=0, options={"start": (1.0, 1.5)})
    over, arrived = not info["action_mask"].any(), 0
    while not over:
        kept = np.flatnonzero(observation["node_pursued"] & observation["action_mask"])
        observation, _, terminated, truncated, info = env.step(int(kept[0]) if len(kept) else nearest(observation))
        arrived += info["ended"] in ("arrived", "settled")
        over = terminated or truncated
    assert arrived > 0
    assert info["outcome"]["status"] == "complete"


def test_the_robot_goes_on_at_speed():
    env = PolyExploreEnv(HALL, config=config("physics", decide="interval", decide_every=0.5))
    observation, info = env.reset(seed=0, options={"start": (1.0, 1.5)})
    fast, over = 0, False
    step, most = env.config.drive.time_step, env.config.robot.max_acceleration
    while not over:
        observation, _, terminated, truncated, info = env.step(nearest(observation))
        over = terminated or truncated
        speed = env._world.velocity[0]
        fast += speed > 0.3
        assert info["ended"] not in ("arrived", "bump", "time", "lost") or speed == 0.0
    assert fast > 5
    way = env.snapshot().trajectory
    moved = np.hypot(*np.diff(way[:, :2], axis=0).T) / step
    moved = moved[moved > 0]
    # No jump in speed but at contact, where a step has several points: what the motors give.
    assert (np.abs(np.diff(moved)) > most * step + 1e-6).mean() < 0.03


@pytest.mark.parametrize("pose", ["exact", "gaussian", "slam"])
@pytest.mark.parametrize("placement", ["midpoint", "in_front"])
def test_moving_explorations_end_with_all_seen(placement, pose):
    for mode, decide in (("physics", "settled"), ("kinematic", "interval")):
        plan = generate("home", 5)
        env = PolyExploreEnv(plan, config={**config(mode, placement=placement, decide=decide), "pose": {"mode": pose}})
        info = play(env, seed=1)[-1]
        assert info["outcome"]["status"] in ("complete", "unreached")
        assert info["coverage"] > 0.97


def test_narrow_sensors_scan_while_they_turn():
    narrow = {"field_of_view": math.radians(90), "beams": 91}
    env = PolyExploreEnv(generate("home", 2), config={**config(), "sensor": narrow})
    play(env)
    scene = env.snapshot()
    turned = np.abs(np.remainder(np.diff(scene.measured_at[:, 2]) + math.pi, 2 * math.pi) - math.pi)
    where = np.hypot(*np.diff(scene.measured_at[:, :2], axis=0).T)
    on_the_spot = turned[where < 1e-6]
    assert len(on_the_spot) > 3
    # (A bumped robot looks where it wanted to in one turn.)
    assert (on_the_spot[4:] <= 0.5 * math.radians(90) + 1e-6).mean() > 0.9


def test_episodes_repeat():
    for mode in ("kinematic", "physics"):
        runs = [play(PolyExploreEnv(generate("home", 4), config=config(mode)), seed=3) for _ in range(2)]
        assert [i["distance"] for i in runs[0]] == [i["distance"] for i in runs[1]]
        assert [i["ended"] for i in runs[0]] == [i["ended"] for i in runs[1]]
