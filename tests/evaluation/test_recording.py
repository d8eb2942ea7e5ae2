"""Data sets: what is loaded back is what the environment said, whoever plays it, and broken ones do not come about."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from polyexplore_gym import cli
from polyexplore_gym.config import EnvConfig, from_mapping
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.errors import InvalidConfigError, ResultsError
from polyexplore_gym.evaluation import load_policy
from polyexplore_gym.evaluation.episode import policy_rng
from polyexplore_gym.evaluation.recording import OBSERVATIONS, Recording, play, record
from polyexplore_gym.floorplan import FloorPlan, generate

minari = pytest.importorskip("minari")
pytest.importorskip("h5py")

CONFIG = from_mapping(EnvConfig, {
    "drive": {"mode": "kinematic"}, "observation": {"max_nodes": 8, "max_lines": 32, "relative": True},
})  # fmt: skip
PLANS = [generate("home", 2), generate("home", 3)]


def test_what_is_loaded_back_is_what_happened(tmp_path, monkeypatch):
    place = record(Recording(policy="random", plans=PLANS, seeds=(4, 5), config=CONFIG), tmp_path, "test/random-v0")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    loaded = minari.load_dataset("test/random-v0")
    assert loaded.total_episodes == minari.MinariDataset(place).total_episodes == 4
    env = PolyExploreEnv(config=CONFIG)
    assert loaded.observation_space == env.observation_space
    assert loaded.action_space == env.action_space
    told = list(loaded.storage.get_episode_metadata(range(4)))
    for k, episode in enumerate(loaded.iterate_episodes()):
        plan, seed = PLANS[k // 2], (4, 5)[k % 2]
        assert (told[k]["plan"], told[k]["plan_hash"], told[k]["seed"]) == (plan.name, plan.content_hash, seed)
        assert (told[k]["policy"], told[k]["status"]) == ("random", "complete")
        policy, rng = load_policy("random"), policy_rng(seed, plan.content_hash)
        seen, info = env.reset(seed=seed, options={"plan": plan})
        for t in range(len(episode)):
            assert all(np.array_equal(episode.observations[key][t], seen[key]) for key in seen)
            assert episode.infos["distance"][t] == info["distance"]
            assert np.array_equal(episode.infos["action_mask"][t], info["action_mask"])
            assert policy.act(seen, info, rng) == episode.actions[t]
            seen, reward, terminated, truncated, info = env.step(int(episode.actions[t]))
            assert (episode.rewards[t], episode.terminations[t], episode.truncations[t]) == (
                reward, terminated, truncated,
            )  # fmt: skip
        assert terminated
        assert all(np.array_equal(episode.observations[key][-1], seen[key]) for key in seen)
        assert episode.infos["coverage"][-1] == info["coverage"]
    assert sum(len(e) for e in loaded.iterate_episodes()) == loaded.total_steps > 20
    again = loaded.recover_environment().unwrapped
    assert again.config == CONFIG


@pytest.mark.parametrize("observation", OBSERVATIONS)
def test_every_observation_can_be_kept(observation, tmp_path):
    recording = Recording(policy="nearest", plans=PLANS[:1], config=CONFIG, observation=observation)
    loaded = minari.MinariDataset(record(recording, tmp_path, "one-v0"))
    episode, played = loaded[0], play(recording, PLANS[0], 0)
    views = played["observations"]
    if isinstance(views, dict):
        assert all(np.array_equal(episode.observations[key], views[key]) for key in views)
        view = {key: values[3] for key, values in episode.observations.items()}
    else:
        assert np.array_equal(episode.observations, views)
        view = episode.observations[3]
    assert loaded.observation_space.contains(view)
    assert loaded.storage.metadata["polyexplore_observation"] == observation


def test_the_number_of_workers_makes_no_difference(tmp_path):
    recording = Recording(policy="random", plans=PLANS, config=CONFIG, observation="flat")
    one, two = (minari.MinariDataset(record(recording, tmp_path, f"w{n}-v0", workers=n)) for n in (1, 2))
    for a, b in zip(one.iterate_episodes(), two.iterate_episodes(), strict=True):
        assert np.array_equal(a.observations, b.observations)
        assert np.array_equal(a.actions, b.actions)


class Broken:
    """Fails in its third decision."""

    def __init__(self) -> None:
        self.acts = 0

    def act(self, observation, info, rng):
        self.acts += 1
        if self.acts == 3:
            raise RuntimeError("out of ideas")
        return int(observation["action_mask"].argmax())


def test_nothing_half_done_is_left(tmp_path):
    with pytest.raises(RuntimeError, match="out of ideas"):
        record(Recording(policy=Broken(), plans=PLANS, config=CONFIG), tmp_path, "broken-v0")
    assert not any((tmp_path / "broken-v0").rglob("*"))
    room = FloorPlan.create([[0, 0], [3, 0], [3, 3], [0, 3]])
    with pytest.raises(ResultsError, match="no episode has a step"):
        record(Recording(policy="nearest", plans=[room], config=CONFIG), tmp_path, "room-v0")
    recording = Recording(policy="nearest", plans=[room, *PLANS[:1]], config=CONFIG, observation="flat")
    record(recording, tmp_path, "room-v0")
    with pytest.raises(ResultsError, match="this data set exists"):
        record(recording, tmp_path, "room-v0")
    for name in ("room", "room-v", "a b-v0", "/room-v0", "../room-v0"):
        with pytest.raises(InvalidConfigError, match=f"name '{re.escape(name)}'"):
            record(recording, tmp_path, name)
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultsError, match="cannot be written"):
        record(recording, tmp_path / "file", "room-v0")
    with pytest.raises(InvalidConfigError, match="observation = 'all'"):
        dataclasses.replace(recording, observation="all")
    with pytest.raises(InvalidConfigError, match=r"recording\.plans"):
        dataclasses.replace(recording, plans=[])


def test_the_command(tmp_path, capsys):
    out = str(tmp_path / "sets")
    words = ["record", "--suite", "home-validation", "--first", "2", "--policy", "nearest", "--seeds", "2"]
    words += ["--observation", "flat", "--drive", "kinematic", "--out", out, "--workers", "1"]
    assert cli.main([*words, "--name", "home-v0"]) == 0
    told = capsys.readouterr().out
    assert re.search(r"home-v0: 4 episodes, \d+ decisions, [\d.]+ MB", told)
    loaded = minari.MinariDataset(Path(out) / "home-v0" / "data")
    assert loaded.total_episodes == 4
    assert cli.main([*words, "--name", "home-v0"]) == 2
    assert "this data set exists" in capsys.readouterr().err
