"""The environment from outside: conformance, what it promises, and what it refuses."""

from __future__ import annotations

import itertools
import math
import pickle
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
import shapely
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

import polyexplore_gym  # noqa: F401  (registers the environments)
from polyexplore_gym import env as env_module
from polyexplore_gym.config import EnvConfig, to_mapping
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.errors import InvalidActionError, InvalidConfigError, InvalidFloorPlanError
from polyexplore_gym.floorplan import FloorPlan, generate, save_plan
from polyexplore_gym.floorplan import suite as named_suite

KINEMATIC = {"drive": {"mode": "kinematic"}}
SMALL = {**KINEMATIC, "observation": {"max_nodes": 16, "max_lines": 64}, "max_decisions": 25}
REGISTERED = sorted(name for name in gym.registry if name.startswith("PolyExplore-"))
INFO = {
    "action_mask", "distance", "coverage", "measurements", "sim_time", "collisions", "path", "rewards",
    "invalid_action", "cut", "outcome", "ended",
}  # fmt: skip
REWARDS = {"distance", "coverage", "measurement", "collision", "completion", "invalid_action"}
HOUSE = FloorPlan.create(
    [[0, 0], [9, 0], [9, 4], [5, 4], [5, 6], [9, 6], [9, 9], [0, 9], [0, 5], [3, 5], [3, 4], [0, 4]],
    holes=[[[6, 7], [6, 8], [7, 8], [7, 7]]],
    name="house",
)
ROOM = FloorPlan.create([[0, 0], [4, 0], [4, 4], [0, 4]], name="room")


@pytest.fixture(scope="module")
def house_path(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("plans") / "house.json"
    save_plan(HOUSE, path)
    return str(path)


def arguments(name: str, path: str) -> dict[str, Any]:
    return {"plan": path} if name == "PolyExplore-Plan-v2" else {}


def check_observation(env: PolyExploreEnv, observation: dict[str, np.ndarray], info: dict[str, Any]) -> None:
    """An observation lies in the space, is free of NaN, padded with 0, and its masks agree."""
    assert set(observation) == set(env.observation_space.spaces)
    for key, space in env.observation_space.spaces.items():
        assert observation[key].dtype == space.dtype
        assert space.contains(observation[key]), key
        assert not np.isnan(observation[key]).any(), key
    mask, valid = observation["node_mask"].astype(bool), observation["action_mask"].astype(bool)
    n = int(mask.sum())
    assert mask[:n].all()
    assert not (valid & ~mask).any()
    assert not observation["lines"][~observation["line_mask"].astype(bool)].any()
    for key, value in observation.items():
        if key.startswith("node_") or key in ("edges", "path_lengths"):
            assert not value[n:].any(), key
    assert not observation["path_lengths"][:, n:].any()
    assert (observation["node_path_length"][:n][valid[:n]] < 1e4).all()
    assert (observation["node_path_length"][:n][~valid[:n]] == np.float32(1e5)).all()
    assert (observation["node_edge_length"][:n] > 0).all()
    assert set(info) == INFO
    assert info["action_mask"].dtype == np.int8
    assert (info["action_mask"] == observation["action_mask"]).all()
    assert (env.action_masks() == valid).all()
    assert env.action_masks().dtype == bool
    assert info["cut"]["nodes"] >= 0 <= info["cut"]["lines"]
    assert 0 <= info["coverage"] <= 1


def play(
    env: PolyExploreEnv, seed: int = 0, limit: int = 10_000, **options: Any
) -> Iterator[tuple[int, dict[str, np.ndarray], float, dict[str, Any], dict[str, Any]]]:
    """Yields (action, observation, reward, info, info before) while random valid actions are taken; checks all."""
    rng = np.random.default_rng(seed)
    observation, info = env.reset(seed=seed, options=options)
    check_observation(env, observation, info)
    assert set(info["rewards"]) == REWARDS
    assert not any(info["rewards"].values())
    assert (info["distance"], info["collisions"]) == (0.0, 0)
    for decision in range(1, limit + 1):
        valid = np.flatnonzero(info["action_mask"])
        if not len(valid):
            return
        before, action = info, rng.choice(valid)
        observation, reward, terminated, truncated, info = env.step(action)
        check_observation(env, observation, info)
        assert type(reward) is float
        assert type(terminated) is type(truncated) is bool
        assert set(info["rewards"]) == REWARDS
        assert reward == pytest.approx(sum(info["rewards"].values()), abs=1e-12)
        assert not info["invalid_action"]
        assert terminated == (not info["action_mask"].any())
        assert truncated == (not terminated and decision >= env.config.max_decisions)
        check_outcome(info["outcome"], terminated, truncated)
        for key in ("distance", "coverage", "measurements", "sim_time", "collisions"):
            assert info[key] >= before[key], key
        yield int(action), observation, reward, info, before
        if terminated or truncated:
            return
    return


def check_outcome(outcome: dict[str, Any], terminated: bool, truncated: bool) -> None:
    left = [outcome[name] for name in ("unreached", "unreached_length", "given_up", "given_up_length")]
    assert [type(value) for value in left] == [int, float, int, float]
    assert min(left) >= 0
    if terminated:
        assert outcome["status"] == ("unreached" if outcome["unreached"] or outcome["given_up"] else "complete")
    else:
        assert outcome["status"] == ("budget" if truncated else "running")


# Conformance -------------------------------------------------------------------------------------


def test_the_registry():
    assert {"PolyExplore-Home-v2", "PolyExplore-Office-v2", "PolyExplore-Mixed-v2", "PolyExplore-Plan-v2"} <= set(
        REGISTERED
    )


@pytest.mark.parametrize("name", REGISTERED)
def test_gymnasium_checker(name, house_path, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr(env_module, "WINDOW_FPS", None)
    env = gym.make(name, config=SMALL, **arguments(name, house_path))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=name != "PolyExplore-Plan-v2")
    env.close()


@pytest.mark.parametrize("name", REGISTERED)
def test_stable_baselines_checker(name, house_path):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    env = gym.make(name, config=SMALL, **arguments(name, house_path))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        checker.check_env(env)
    assert [str(w.message) for w in caught if "unconventional shape" not in str(w.message)] == []


@pytest.mark.parametrize("name", REGISTERED)
def test_every_registered_environment_plays(name, house_path):
    env = gym.make(name, config=KINEMATIC, **arguments(name, house_path))
    assert len(list(play(env.unwrapped, seed=1, limit=6))) >= 2


def masked(mask: np.ndarray) -> list[int]:
    return [int(row.argmax()) for row in mask]


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_gymnasium_vector_environments(mode, house_path):
    kwargs = {"config": SMALL, "plan": house_path}
    envs = gym.make_vec("PolyExplore-Plan-v2", num_envs=2, vectorization_mode=mode, **kwargs)
    observation, info = envs.reset(seed=[3, 4])
    single = gym.make("PolyExplore-Plan-v2", **kwargs)
    alone, alone_info = single.reset(seed=4)
    lengths = set()
    for _ in range(12):
        for key in alone:
            assert (observation[key][1] == alone[key]).all()
        assert info["distance"][1] == alone_info["distance"]
        assert info["cut"]["lines"][1] == alone_info["cut"]["lines"]
        assert info["path"][1] == alone_info["path"]
        lengths.add(tuple(map(len, info["path"])))
        actions = masked(observation["action_mask"])
        observation, rewards, terminated, _, info = envs.step(np.array(actions))
        alone, reward, over, _, alone_info = single.step(actions[1])
        assert (rewards[1], terminated[1]) == (reward, over)
        if terminated.any():
            break
    assert any(a != b for a, b in lengths)  # the infos of both fit together although their paths differ
    envs.close()


@pytest.mark.parametrize("kind", ["DummyVecEnv", "SubprocVecEnv"])
def test_stable_baselines_vector_environments(kind, house_path):
    vec = pytest.importorskip("stable_baselines3.common.vec_env")

    def make(rank: int):
        return lambda: gym.make("polyexplore_gym:PolyExplore-Plan-v2", plan=house_path, config=SMALL)

    envs = getattr(vec, kind)([make(i) for i in range(2)])
    envs.seed(5)
    observation = envs.reset()
    dones = 0
    for _ in range(40):
        masks = np.stack(envs.env_method("action_masks"))
        assert (masks == observation["action_mask"]).all()
        observation, _, done, infos = envs.step(np.array(masked(masks)))
        assert not any(i["invalid_action"] for i in infos)
        for i in np.flatnonzero(done):
            dones += 1
            assert not infos[i]["terminal_observation"]["action_mask"].any() or infos[i]["TimeLimit.truncated"]
    assert dones >= 2
    envs.close()


def test_maskable_ppo_learns_through_make():
    """No ActionMasker: `action_masks()` is found through Gymnasium's wrappers."""
    contrib = pytest.importorskip("sb3_contrib")
    callbacks = pytest.importorskip("stable_baselines3.common.callbacks")

    class Watch(callbacks.BaseCallback):
        def __init__(self) -> None:
            super().__init__()
            self.steps = self.invalid = self.episodes = 0

        def _on_step(self) -> bool:
            self.steps += 1
            self.invalid += sum(i["invalid_action"] for i in self.locals["infos"])
            self.episodes += int(self.locals["dones"].sum())
            return True

    watch = Watch()
    env = gym.make("PolyExplore-Home-v2", config=SMALL)
    model = contrib.MaskablePPO("MultiInputPolicy", env, n_steps=64, batch_size=32, n_epochs=2, seed=0)
    start = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(256, callback=watch)
    assert watch.steps == 256
    assert watch.invalid == 0
    assert watch.episodes >= 5
    assert any((a != b).any() for a, b in zip(start, model.policy.parameters(), strict=True))
    observation, info = env.reset(seed=0)
    action, _ = model.predict(observation, action_masks=info["action_mask"])
    assert env.unwrapped.action_masks()[action]
    env.step(action)


def test_make_in_a_fresh_process(house_path):
    code = (
        "import sys, gymnasium as gym\n"
        "env = gym.make('polyexplore_gym:PolyExplore-Plan-v2', plan=sys.argv[1])\n"
        "observation, info = env.reset(seed=3)\n"
        "*_, info = env.step(int(info['action_mask'].argmax()))\n"
        "print(env.unwrapped.plan.name, repr(info['distance']))\n"
    )
    out = subprocess.run([sys.executable, "-c", code, house_path], capture_output=True, text=True, check=True).stdout
    env = PolyExploreEnv(HOUSE)
    _, info = env.reset(seed=3)
    *_, info = env.step(int(info["action_mask"].argmax()))
    assert out.split() == ["house", repr(info["distance"])]


@pytest.mark.parametrize("dumps", [pickle.dumps, cloudpickle.dumps])
def test_pickling_a_made_environment(dumps, house_path):
    env = gym.make("PolyExplore-Plan-v2", plan=house_path, config=SMALL)
    copies = [pickle.loads(dumps(env))]
    env.reset(seed=0)
    copies[0].reset(seed=0)
    copies.append(pickle.loads(dumps(env)))
    action = int(env.unwrapped.action_masks().argmax())
    expected, reward, *_ = env.step(action)
    for other in copies:
        observation, same, *_ = other.step(action)
        assert same == reward
        assert all((observation[key] == expected[key]).all() for key in expected)


# Configuration and arguments ---------------------------------------------------------------------


def test_spec_goes_to_json_and_back(house_path):
    config = EnvConfig(**{**to_parts(SMALL), "max_decisions": 7})
    env = gym.make("PolyExplore-Plan-v2", plan=house_path, config=config)
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.config == env.unwrapped.config == config
    first, _ = env.reset(seed=1)
    second, _ = again.reset(seed=1)
    assert all((first[key] == second[key]).all() for key in first)


def to_parts(mapping: dict[str, Any]) -> dict[str, Any]:
    """The fields of the `EnvConfig` that a mapping describes."""
    config = PolyExploreEnv(config=mapping).config
    return {name: getattr(config, name) for name in to_mapping(config)}


def test_config_as_object_mapping_or_none():
    assert PolyExploreEnv().config == PolyExploreEnv(config={}).config == EnvConfig()
    for part, field, value in [("sensor", "beams", 181), ("exploration", "min_gap", None), ("robot", "radius", 1)]:
        config = PolyExploreEnv(config={part: {field: value}}).config
        assert getattr(getattr(config, part), field) == value
        assert PolyExploreEnv(config=config).config is config
        assert PolyExploreEnv(config=to_mapping(config)).config == config
        mixed = PolyExploreEnv(config={part: getattr(config, part), "max_decisions": 3}).config
        assert (getattr(mixed, part), mixed.max_decisions) == (getattr(config, part), 3)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"sensr": {}}, r"config: unknown field 'sensr'; known: .*sensor"),
        ({"sensor": {"beam": 3}}, r"config\.sensor: unknown field 'beam'; known: .*beams"),
        ({"sensor": {"beams": "many"}}, r"config\.sensor\.beams = 'many': expected int"),
        ({"sensor": {"beams": 180.5}}, r"config\.sensor\.beams"),
        ({"sensor": {"beams": True}}, r"config\.sensor\.beams"),
        ({"sensor": {"max_range": None}}, r"config\.sensor\.max_range"),
        ({"sensor": {"max_range": math.nan}}, r"SensorConfig\.max_range = nan: must be finite"),
        ({"sensor": {"max_range": math.inf}}, r"SensorConfig\.max_range = inf"),
        ({"sensor": {"max_range": -1.0}}, r"SensorConfig\.max_range"),
        ({"sensor": {"beams": 2}}, r"SensorConfig\.beams = 2"),
        ({"exploration": {"min_gap": math.nan}}, r"ExplorationConfig\.min_gap"),
        ({"exploration": {"placement": "behind"}}, r"ExplorationConfig\.placement = 'behind'"),
        ({"exploration": {"look_around": 1}}, r"config\.exploration\.look_around"),
        ({"drive": {"mode": "fly"}}, r"DriveConfig\.mode"),
        ({"drive": None}, r"config\.drive: expected a mapping, got NoneType"),
        ({"sensor": [3]}, r"config\.sensor: expected a mapping, got list"),
        ({"reward": {"distance": math.nan}}, r"RewardConfig\.distance"),
        ({"max_decisions": 0}, r"EnvConfig\.max_decisions = 0"),
        ({"max_decisions": 2.0}, r"config\.max_decisions = 2\.0: expected int"),
        ({"observation": {"max_nodes": 0}}, r"ObservationConfig\.max_nodes"),
        ({3: 4}, r"unknown field '3'"),
        ([], r"config: expected a mapping, got list"),
        ("fast", r"config: expected a mapping, got str"),
        (False, r"config: expected a mapping, got bool"),
    ],
)
def test_bad_configurations(config, message):
    with pytest.raises(InvalidConfigError, match=message):
        gym.make("PolyExplore-Plan-v2", config=config)


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ({"render_mode": "ascii"}, InvalidConfigError, "render_mode 'ascii'"),
        ({"suite": "castle-train"}, InvalidConfigError, "unknown suite 'castle-train'; known: .*home-train"),
        ({"suite": "home-train", "plan": ROOM}, InvalidConfigError, "give one"),
        ({"plan": 5}, InvalidFloorPlanError, "expected a FloorPlan or a path, got int"),
        ({"plan": "no/such/plan.json"}, InvalidFloorPlanError, r"plan\.json: cannot be read"),
        ({"plan": Path("plan.txt")}, InvalidFloorPlanError, "unknown suffix '.txt'"),
        ({"plan": ROOM, "config": {"robot": {"radius": 3.0}}}, InvalidFloorPlanError, "no room for a robot"),
    ],
)
def test_bad_arguments(given, error, message):
    with pytest.raises(error, match=message):
        PolyExploreEnv(**given)


def test_bad_plan_files(tmp_path):
    for name, text in {
        "broken.json": "{",
        "list.json": "[]",
        "bow.json": '{"exterior": [[0, 0], [4, 4], [4, 0], [0, 4]]}',
        "nan.json": '{"exterior": [[0, 0], [4, 0], [4, NaN], [0, 4]]}',
        "two.json": '{"exterior": [[0, 0], [4, 0]]}',
    }.items():
        (tmp_path / name).write_text(text)
        for make in (PolyExploreEnv, lambda path: PolyExploreEnv(ROOM).reset(options={"plan": path})):
            with pytest.raises(InvalidFloorPlanError, match=name):
                make(str(tmp_path / name))
    with pytest.raises(InvalidFloorPlanError, match="cannot be read"):
        PolyExploreEnv(tmp_path / "missing.json")


# Reset -------------------------------------------------------------------------------------------


def test_reset_takes_a_plan_and_a_start(house_path):
    env = PolyExploreEnv(ROOM, config=KINEMATIC)
    starts = (1.0, 2.0, 0.5), np.array([1, 2, 0.5])
    for plan, start in itertools.product((HOUSE, house_path, Path(house_path)), starts):
        env.reset(seed=0, options={"plan": plan, "start": start})
        assert env.plan == HOUSE
        np.testing.assert_allclose(env.snapshot().trajectory[0], start)
    env.reset(seed=0, options={"start": (1.0, 2.0)})
    assert env.plan == ROOM  # the option held for one episode
    np.testing.assert_allclose(env.snapshot().trajectory[0], (1.0, 2.0, 0.0))
    env.reset(seed=0, options={"start": (1.0, 2.0, 10.0)})
    np.testing.assert_allclose(env.snapshot().trajectory[0], (1.0, 2.0, 10.0 - 4 * np.pi))


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ((20.0, 1.0, 0.0), "outside"),
        ((6.5, 7.5, 0.0), "in a wall"),
        ((0.1, 1.0, 0.0), "clearance"),
        ((1.0, math.nan, 0.0), "finite"),
        ((1.0, 1.0, math.inf), "finite"),
        ((1.0,), "expected"),
        ("here", "expected"),
        (1.0, "expected"),
        ((1.0, 1.0, None), "expected"),
    ],
)
def test_bad_starts(start, message):
    env = PolyExploreEnv(HOUSE)
    with pytest.raises(InvalidFloorPlanError, match=message):
        env.reset(options={"start": start})


def test_bad_resets():
    with pytest.raises(InvalidConfigError, match="no floor plan"):
        PolyExploreEnv().reset()
    with pytest.raises(InvalidConfigError, match=r"unknown option 'strat'; known: plan, start"):
        PolyExploreEnv(ROOM).reset(options={"strat": (1, 1, 0)})
    env = PolyExploreEnv(HOUSE, config=KINEMATIC)
    env.reset(seed=0)
    for options in ({"plan": "missing.json"}, {"plan": 3}, {"start": (50, 50, 0)}):
        with pytest.raises(InvalidFloorPlanError):
            env.reset(options=options)
    env.step(int(env.action_masks().argmax()))  # a reset that was refused leaves the episode as it was


def test_seeds():
    env = PolyExploreEnv(suite="mixed-train", config=KINEMATIC)
    first, _ = env.reset(seed=11)
    name = env.plan.name
    others = [env.reset()[0] for _ in range(3)]
    assert any((first["pose"] != other["pose"]).any() for other in others)
    again, _ = env.reset(seed=11)
    assert env.plan.name == name
    assert all((first[key] == again[key]).all() for key in first)
    for other in others:
        repeated, _ = env.reset()
        assert all((other[key] == repeated[key]).all() for key in other)
    assert len({env.reset(seed=seed) and env.plan.name for seed in range(8)}) >= 6


def test_streams_do_not_shift_each_other():
    """A plan or a start that is given does not change the noise of laser and pose."""
    config = {**KINEMATIC, "pose": {"mode": "gaussian"}}
    env = PolyExploreEnv(HOUSE, config=config)
    first, _ = env.reset(seed=4)
    start = env.snapshot().trajectory[0]
    other = PolyExploreEnv(suite="home-train", config=config)
    second, _ = other.reset(seed=4, options={"plan": HOUSE, "start": start})
    assert all((first[key] == second[key]).all() for key in first)


def test_look_around():
    for degrees, full, expected in ((180, True, 2), (180, False, 1), (90, True, 4), (270, True, 2), (360, True, 1)):
        config = {"sensor": {"field_of_view": math.radians(degrees)}, "exploration": {"look_around": full}}
        env = PolyExploreEnv(HOUSE, config=config)
        _, info = env.reset(seed=1)
        assert info["measurements"] == expected
        # All round: everything that can be seen from there.
        if full:
            x, y, heading = env.snapshot().trajectory[0]
            turned = PolyExploreEnv(HOUSE, config=config)
            _, other = turned.reset(options={"start": (x, y, heading + 2.0)})
            assert info["coverage"] == pytest.approx(other["coverage"], abs=0.01)


# Step --------------------------------------------------------------------------------------------


REFUSED = [-1, 64, 10**9, 1.0, 0.5, math.nan, "0", None, True, np.bool_(True), [0], (0,), np.array([0]), np.float32(1)]


@pytest.mark.parametrize("action", REFUSED, ids=repr)
def test_actions_that_are_refused(action):
    env = PolyExploreEnv(HOUSE, config=KINEMATIC)
    _, info = env.reset(seed=0)
    with pytest.raises(InvalidActionError, match="action"):
        env.step(action)
    assert env.true_pose[0] == env.snapshot().trajectory[-1][0]
    *_, after = env.step(int(info["action_mask"].argmax()))  # nothing happened to the episode
    assert after["measurements"] == info["measurements"] + 1


@pytest.mark.parametrize("kind", [int, np.int64, np.int32, np.uint8, np.array])
def test_actions_of_any_integer_type(kind):
    env = PolyExploreEnv(HOUSE, config=KINEMATIC)
    _, info = env.reset(seed=0)
    *_, info = env.step(kind(int(info["action_mask"].argmax())))
    assert not info["invalid_action"]
    assert info["distance"] > 0


def test_a_masked_action_does_nothing_at_a_price():
    env = PolyExploreEnv(HOUSE, config={**KINEMATIC, "reward": {"invalid_action": -3.0}, "max_decisions": 3})
    observation, info = env.reset(seed=0)
    pose = env.true_pose
    after, reward, terminated, truncated, told = env.step(63)
    assert (reward, terminated, truncated) == (-3.0, False, False)
    assert told["invalid_action"]
    assert told["rewards"] == {**dict.fromkeys(REWARDS, 0.0), "invalid_action": -3.0}
    assert len(told["path"]) == 1
    assert (env.true_pose == pose).all()
    assert all((observation[key] == after[key]).all() for key in after)
    assert all(told[key] == info[key] for key in ("distance", "coverage", "measurements", "sim_time", "collisions"))
    assert not env.step(63)[3]
    assert env.step(63)[3]  # but it counts as a decision


def test_observations_belong_to_the_caller():
    env = PolyExploreEnv(HOUSE, config=KINEMATIC)
    observation, info = env.reset(seed=0)
    kept = {key: value.copy() for key, value in observation.items()}
    observation["action_mask"][:] = 1
    info["action_mask"][:] = 1
    *_, told = env.step(63)
    assert told["invalid_action"]
    again = env.step(63)[0]
    env.step(int(kept["action_mask"].argmax()))
    assert all((again[key] == kept[key]).all() for key in kept)


def test_steps_before_reset_and_after_the_end():
    env = PolyExploreEnv(HOUSE, config=KINEMATIC)
    for call in (lambda: env.step(0), env.action_masks):
        with pytest.raises(gym.error.ResetNeeded):
            call()
    with pytest.raises(gym.error.ResetNeeded):
        gym.make("PolyExplore-Plan-v2", plan=HOUSE).step(0)
    *_, (_, observation, _, info, _) = play(env, seed=2)
    pose = env.true_pose
    for _ in range(2):
        after, reward, terminated, truncated, told = env.step(0)
        assert (reward, terminated, truncated) == (0.0, True, False)
        assert told["invalid_action"]
        assert (env.true_pose == pose).all()
        assert told["distance"] == info["distance"]
        assert all((observation[key] == after[key]).all() for key in after)
    env.reset(seed=2)
    assert env.action_masks().any()


def test_a_plan_seen_from_the_start_ends_at_once():
    env = PolyExploreEnv(ROOM, config={"reward": {"completion": 5.0}, "sensor": {"field_of_view": 2 * math.pi}})
    _, info = env.reset(seed=0)
    assert info["coverage"] == 1.0
    assert not info["action_mask"].any()
    check_outcome(info["outcome"], terminated=True, truncated=False)
    _, reward, terminated, truncated, info = env.step(0)
    assert (reward, terminated, truncated) == (5.0, True, False)
    assert env.step(0)[1] == 0.0  # complete once


def test_truncation():
    env = PolyExploreEnv(generate("home", 3), config={**KINEMATIC, "max_decisions": 4})
    steps = list(play(env, seed=0))
    assert len(steps) == 4
    assert env.action_masks().any()


def test_rewards_are_what_happened():
    scales = {
        "distance": -2.0, "coverage": 100.0, "measurement": -0.5, "collision": -7.0, "completion": 50.0,
        "invalid_action": -9.0,
    }  # fmt: skip
    env = PolyExploreEnv(generate("home", 0), config={**KINEMATIC, "reward": scales})
    rest = []
    for _, _, _, info, before in play(env, seed=0):
        expected = {
            "distance": -2.0 * (info["distance"] - before["distance"]),
            "coverage": 100.0 * (info["coverage"] - before["coverage"]),
            "measurement": -0.5 * (info["measurements"] - before["measurements"]),
            "collision": -7.0 * (info["collisions"] - before["collisions"]),
            "completion": 0.0 if info["action_mask"].any() else 50.0,
            "invalid_action": 0.0,
        }
        assert info["rewards"] == pytest.approx(expected)
        rest.append(info["action_mask"].any())
    assert rest == [True] * (len(rest) - 1) + [False]
    env = PolyExploreEnv(generate("home", 0), config=KINEMATIC)
    steps = list(play(env, seed=0))
    assert sum(reward for _, _, reward, _, _ in steps) == pytest.approx(-steps[-1][3]["distance"])


def test_distance_and_path():
    """Metres are counted along the true way, and the planned path leads from the robot to the node."""
    for mode in ("kinematic", "physics"):
        env = PolyExploreEnv(generate("home", 1), config={"drive": {"mode": mode}})
        observation, _ = env.reset(seed=1)
        for action, after, _, info, before in play(env, seed=1):
            path = np.array(info["path"])
            np.testing.assert_allclose(path[0], observation["pose"][:2], atol=1e-4)
            np.testing.assert_allclose(path[-1], observation["node_position"][action], atol=1e-4)
            length = shapely.LineString(path).length if len(path) > 1 else 0.0
            assert length == pytest.approx(observation["node_path_length"][action], abs=1e-3)
            if info["collisions"] == before["collisions"] and mode == "kinematic":
                assert info["distance"] - before["distance"] == pytest.approx(length, abs=1e-3)
            observation = after
        way = env.snapshot().trajectory
        assert np.hypot(*np.diff(way[:, :2], axis=0).T).sum() == pytest.approx(info["distance"], abs=1e-6)


# Whole episodes ----------------------------------------------------------------------------------

VARIATIONS: dict[str, dict[str, Any]] = {
    "in_front": {**KINEMATIC, "exploration": {"placement": "in_front"}},
    "physics": {},
    "physics in_front odometry": {"exploration": {"placement": "in_front"}, "pose": {"mode": "odometry"}},
    "gaussian": {**KINEMATIC, "pose": {"mode": "gaussian"}},
    "slam": {**KINEMATIC, "pose": {"mode": "slam"}},
    "odometry relative": {**KINEMATIC, "pose": {"mode": "odometry"}, "observation": {"relative": True}},
    "relative": {**KINEMATIC, "observation": {"relative": True}},
    "scans on the way": {**KINEMATIC, "exploration": {"scan_every": 0.7}},
    "scans on the way physics gaussian": {"exploration": {"scan_every": 0.7}, "pose": {"mode": "gaussian"}},
    "full circle 30 m": {**KINEMATIC, "sensor": {"field_of_view": 2 * math.pi, "max_range": 30.0, "beams": 720}},
    "few beams": {**KINEMATIC, "sensor": {"beams": 31, "max_range": 4.0}, "max_decisions": 60},
    "no noise": {**KINEMATIC, "sensor": {"sigma_range": 0.0, "sigma_angle": 0.0}},
    "tiny observation": {**KINEMATIC, "observation": {"max_nodes": 2, "max_lines": 3}},
    "no look around": {**KINEMATIC, "exploration": {"look_around": False}},
    "hough": {**KINEMATIC, "mapping": {"start": "hough"}},
    "one at a time": {**KINEMATIC, "observation": {"max_nodes": 1, "max_lines": 1, "pairwise": False}},
}


@pytest.mark.parametrize("name", VARIATIONS)
def test_whole_episodes_of_every_kind(name):
    for seed, plan in enumerate((HOUSE, generate("home", 5))):
        env = PolyExploreEnv(plan, config=VARIATIONS[name])
        *_, (_, _, _, info, _) = play(env, seed=seed)
        if "max_decisions" not in VARIATIONS[name]:
            assert not env.action_masks().any()
            # Drift without correction distorts the map: parts of the plan are lost.
            assert info["coverage"] > (0.5 if "odometry" in name else 0.9)


@pytest.mark.parametrize("family", ["home", "office", "angled"])
def test_whole_episodes_of_every_family(family):
    env = PolyExploreEnv(generate(family, 0), config=KINEMATIC)
    *_, (_, _, _, info, _) = play(env, seed=0)
    assert not env.action_masks().any()
    assert info["coverage"] > 0.95


@pytest.mark.slow
@pytest.mark.parametrize("name", VARIATIONS)
@pytest.mark.parametrize("family", ["home", "office", "angled"])
def test_whole_episodes_of_every_kind_and_family(family, name):
    config = {"max_decisions": 60, **VARIATIONS[name]}
    for _ in play(PolyExploreEnv(generate(family, 20), config=config), seed=1):
        pass


def test_scans_on_the_way():
    for mode in ("kinematic", "physics"):
        sensor = {"field_of_view": 2 * math.pi, "beams": 720}  # (others also scan while they turn)
        config = {"drive": {"mode": mode}, "exploration": {"scan_every": 0.5}, "sensor": sensor}
        env = PolyExploreEnv(generate("home", 1), config=config)
        for _, _, _, info, before in play(env, seed=1):
            driven = info["distance"] - before["distance"]
            marks = len(np.arange(0.5, driven - 0.25, 0.5)) if driven > 0.75 else 0
            slack = 1 if abs(driven % 0.5 - 0.25) < 1e-6 else 0  # rounding decides on the last one
            slack += 0 if mode == "kinematic" else 1 + marks // 10  # they come with the next time step
            slack += info["ended"] != "arrived"  # a bump came soon after one
            assert abs(info["measurements"] - before["measurements"] - 1 - marks) <= slack
        scene = env.snapshot()
        way = shapely.LineString(scene.trajectory[:, :2])
        assert max(way.distance(shapely.Point(p)) for p in scene.measured_at[:, :2]) < 1e-9
        gaps = np.hypot(*np.diff(scene.measured_at[:, :2], axis=0).T)
        step = 0.0 if mode == "kinematic" else env.config.robot.max_speed * env.config.drive.time_step
        assert gaps.max() <= 0.75 + step + 1e-9
        assert (np.abs(gaps - 0.5) < 0.02 + step).mean() > 0.5


def test_exact_poses_are_the_truth_and_noisy_ones_are_near_it():
    for mode, bound in (("exact", 1e-6), ("gaussian", 0.12), ("odometry", 2.0)):
        env = PolyExploreEnv(generate("home", 2), config={**KINEMATIC, "pose": {"mode": mode}})
        errors = []
        for _, observation, *_ in play(env, seed=0):
            errors.append(np.hypot(*(observation["pose"][:2] - env.true_pose[:2])))
            spread = observation["pose_covariance"]
            assert (np.linalg.eigvalsh(spread.astype(float)) >= -1e-9).all()
            assert (spread == 0).all() == (mode == "exact")
        assert max(errors) < bound
        assert (max(errors) > 1e-4) == (mode != "exact")


# Observation -------------------------------------------------------------------------------------


def into_frame(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Points (..., 2) of the map frame in the frame of a pose, by complex numbers."""
    z = (points[..., 0] - pose[0] + 1j * (points[..., 1] - pose[1])) * np.exp(-1j * pose[2])
    return np.stack((z.real, z.imag), axis=-1)


def line_seen_from(alpha: float, rho: float, pose: np.ndarray) -> np.ndarray:
    """(alpha, rho) of a line in the frame of a pose, through two of its points; rho >= 0."""
    foot, along = rho * np.array([np.cos(alpha), np.sin(alpha)]), np.array([-np.sin(alpha), np.cos(alpha)])
    a, b = into_frame(np.array([foot - along, foot + along]), pose)
    normal = np.array([(b - a)[1], -(b - a)[0]]) / np.linalg.norm(b - a)
    distance = normal @ a
    if distance < 0:
        normal, distance = -normal, -distance
    return np.array([np.arctan2(normal[1], normal[0]), distance])


@pytest.mark.parametrize("mode", ["exact", "gaussian"])
def test_relative_observations_are_the_absolute_ones_transformed(mode):
    config = {**KINEMATIC, "pose": {"mode": mode}}
    plain = PolyExploreEnv(generate("angled", 1), config=config)
    relative = PolyExploreEnv(generate("angled", 1), config={**config, "observation": {"relative": True}})
    other, _ = relative.reset(seed=6)
    lines = 0
    for action, here, reward, info, _ in play(plain, seed=6, limit=8):
        other, same, _, _, told = relative.step(action)
        assert same == reward
        assert told["path"] == info["path"]
        for key in set(here) - {"lines", "edges", "node_position", "node_heading"}:
            assert (here[key] == other[key]).all(), key
        pose = here["pose"].astype(float)
        n, m = here["node_mask"].sum(), here["line_mask"].sum()
        for key in ("node_position", "edges"):
            ours, theirs = (o[key][:n].reshape(-1, 2).astype(float) for o in (here, other))
            np.testing.assert_allclose(theirs, into_frame(ours, pose), atol=1e-4)
        turn = other["node_heading"][:n] - (here["node_heading"][:n] - pose[2])
        np.testing.assert_allclose(np.exp(1j * turn), 1.0, atol=1e-5)
        for row, seen in zip(here["lines"][:m].astype(float), other["lines"][:m].astype(float), strict=True):
            np.testing.assert_allclose(seen[:4].reshape(2, 2), into_frame(row[:4].reshape(2, 2), pose), atol=1e-4)
            if not row[4:].any():
                assert not seen[4:].any()  # a fragment
                continue
            rho, alpha = row[4:6]
            expected = line_seen_from(alpha, rho, pose)
            assert seen[4] == pytest.approx(expected[1], abs=1e-4)
            assert abs(np.exp(1j * (seen[5] - expected[0])) - 1) < 1e-5
            # The line goes through its segment, in both frames.
            for values in (row, seen):
                ends = values[:4].reshape(2, 2) @ [np.cos(values[5]), np.sin(values[5])]
                np.testing.assert_allclose(ends, values[4], atol=0.02)
            if expected[1] < 1e-3:
                continue  # no derivative: the normal flips
            ahead, behind = (
                np.stack([line_seen_from(alpha + h, rho, pose), line_seen_from(alpha, rho + h, pose)], axis=1)
                for h in (1e-6, -1e-6)
            )
            difference = ahead - behind
            difference[0] = np.angle(np.exp(1j * difference[0]))
            jacobian = difference / 2e-6
            p = np.array([[row[6], row[7]], [row[7], row[8]]])
            q = jacobian @ p @ jacobian.T
            scale = 1e-5 * (p[1, 1] + p[0, 0] * (1 + (pose[:2] ** 2).sum()))  # float32 cancels
            np.testing.assert_allclose(seen[[6, 7, 8]], [q[0, 0], q[0, 1], q[1, 1]], rtol=1e-3, atol=scale)
            lines += 1
    assert lines > 100


def test_the_farthest_lines_are_cut_first():
    few = PolyExploreEnv(generate("home", 4), config={**KINEMATIC, "observation": {"max_lines": 9}})
    many = PolyExploreEnv(generate("home", 4), config=KINEMATIC)
    few.reset(seed=3)
    cut = 0
    for action, full, _, info, _ in play(many, seed=3):
        short, _, _, _, told = few.step(action)
        assert info["cut"] == {"nodes": 0, "lines": 0}
        rows = full["lines"][full["line_mask"].astype(bool)].astype(float)
        assert told["cut"] == {"nodes": 0, "lines": max(len(rows) - 9, 0)}
        robot = shapely.Point(full["pose"][:2])
        distance = shapely.distance(shapely.linestrings(rows[:, :4].reshape(-1, 2, 2)), robot)
        kept = {tuple(row) for row in short["lines"][short["line_mask"].astype(bool)].astype(float)}
        assert len(kept) == min(9, len(rows))
        inside = np.array([tuple(row) in kept for row in rows])
        assert inside.sum() == len(kept)
        if not inside.all():
            assert distance[inside].max() <= distance[~inside].min() + 1e-5
            cut += 1
    assert cut > 5


def test_the_farthest_nodes_are_cut_first():
    few = PolyExploreEnv(generate("office", 2), config={**KINEMATIC, "observation": {"max_nodes": 3}})
    many = PolyExploreEnv(generate("office", 2), config=KINEMATIC)
    full, _ = many.reset(seed=3)
    cut = 0
    for _, short, _, info, _ in play(few, seed=3, limit=15):
        place = few.snapshot().path[-1]
        row = int(np.hypot(*(full["node_position"] - place).T).argmin())
        full, _, _, _, told = many.step(row)
        n, k = int(full["node_mask"].sum()), int(short["node_mask"].sum())
        assert told["cut"]["nodes"] == 0
        assert (k, info["cut"]["nodes"]) == (min(n, 3), max(n - 3, 0))
        lengths = full["node_path_length"][:n]
        assert sorted(short["node_path_length"][:k]) == sorted(lengths)[:k]
        for i in range(k):
            (same,) = np.flatnonzero((full["edges"][:n] == short["edges"][i]).all(axis=1))
            for key in ("node_position", "node_heading", "node_gain", "node_kind", "node_edge_length", "node_visits"):
                assert (full[key][same] == short[key][i]).all()
        cut += n > 3
    assert cut > 3


def test_path_lengths_between_nodes():
    env = PolyExploreEnv(generate("office", 3), config=KINEMATIC)
    plain = PolyExploreEnv(generate("office", 3), config={**KINEMATIC, "observation": {"pairwise": False}})
    plain.reset(seed=3)
    for action, observation, *_ in play(env, seed=3, limit=10):
        without, *_ = plain.step(action)
        assert not without.pop("path_lengths").any()
        assert all((without[key] == observation[key]).all() for key in without)
        n = int(observation["node_mask"].sum())
        d, c = observation["path_lengths"][:n, :n].astype(float), observation["node_path_length"][:n].astype(float)
        assert not d.diagonal()[c < 1e4].any()
        np.testing.assert_allclose(d, d.T, atol=1e-3)
        near = c < 1e4
        straight = shapely.distance(
            shapely.points(observation["node_position"][:n])[:, None], shapely.points(observation["node_position"][:n])
        )
        assert (d[np.ix_(near, near)] >= straight[np.ix_(near, near)] - 1e-3).all()


# Pictures ----------------------------------------------------------------------------------------


def test_rgb_array(house_path):
    env = gym.make("PolyExplore-Plan-v2", plan=house_path, config=KINEMATIC, render_mode="rgb_array")
    _, info = env.reset(seed=0)
    first = env.render()
    env.step(int(info["action_mask"].argmax()))
    second = env.render()
    assert first.dtype == np.uint8
    assert first.ndim == 3
    assert first.shape == second.shape
    assert (first != second).any()
    silent = PolyExploreEnv(HOUSE)
    silent.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert silent.render() is None


def test_the_window_shows_the_drive(monkeypatch):
    pytest.importorskip("pygame")
    from polyexplore_gym import animation

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr(env_module, "WINDOW_FPS", None)
    shown: list[np.ndarray] = []
    show = animation.Window.show
    monkeypatch.setattr(animation.Window, "show", lambda self, picture: (shown.append(picture), show(self, picture))[1])
    env = PolyExploreEnv(HOUSE, config=KINEMATIC, render_mode="human")
    _, info = env.reset(seed=0)
    assert len(shown) == 1
    *_, told = env.step(int(info["action_mask"].argmax()))
    expected = 1 + 1 + math.ceil(told["distance"] / env_module.WINDOW_STEP)  # the choice, the way and the end
    assert len(shown) - 1 == pytest.approx(expected, abs=1)
    assert all((a != b).any() for a, b in itertools.pairwise(shown))
    assert env.render() is None
    env.close()
    env.close()
    env.reset(seed=0)  # opens a new one
    env._window.close()  # as the user does
    count = len(shown)
    env.step(int(info["action_mask"].argmax()))
    assert len(shown) == count + 1  # no more than an attempt
    env.close()


def test_snapshots_do_not_change_later():
    env = PolyExploreEnv(HOUSE, config=KINEMATIC)
    env.reset(seed=0)
    scene = env.snapshot()
    kept = pickle.dumps(scene)
    action = int(env.action_masks().argmax())
    for _ in range(3):
        env.step(action)
    assert pickle.dumps(scene) == kept
    assert scene.node_mask[action]


def test_slam_keeps_one_covariance_of_pose_and_walls():
    """The odometry moves the pose's covariance, the filter what the pose shares with the walls: both by one way."""
    env = PolyExploreEnv(named_suite("home-validation").plan(1), config=VARIATIONS["slam"])
    observation, info = env.reset(seed=3)
    for _ in range(12):
        reachable = np.flatnonzero(info["action_mask"])
        if not reachable.size:
            break
        action = reachable[observation["node_path_length"][reachable].argmin()]
        observation, _, _, _, info = env.step(int(action))
        walls = np.flatnonzero(env.line_map.tables[1].alive[: env.line_map.rho.size])
        at = np.stack((2 * walls, 2 * walls + 1), axis=1).ravel()
        shared = env.explorer.localizer._shared[:, at]
        own = env.explorer.localizer._lines[np.ix_(at, at)]
        joint = np.block([[env.explorer.localizer._covariance, shared], [shared.T, own]])
        scale = 1.0 / np.sqrt(np.diag(joint))
        assert np.linalg.eigvalsh(joint * np.outer(scale, scale)).min() > -1e-6
    assert env.explorer.localizer._covariance[0, 0] > 0.0


def test_slam_sees_what_an_exact_pose_sees_and_odometry_does_not():
    """Drift of 2 % of the distance and 1 degree a metre, the defaults; the same seeds for all three."""
    plans = [named_suite("home-validation").plan(i) for i in (5, 6)]
    coverage, error = {}, {}
    for mode in ("exact", "odometry", "slam"):
        coverage[mode], error[mode] = [], []
        for i, plan in enumerate(plans, 5):
            env = PolyExploreEnv(plan, config={**KINEMATIC, "pose": {"mode": mode}, "max_decisions": 400})
            observation, info = env.reset(seed=i)
            done = truncated = False
            while not (done or truncated):
                mask = info["action_mask"].astype(bool)
                action = int(np.argmin(np.where(mask, observation["node_path_length"], np.inf)))
                observation, _, done, truncated, info = env.step(action)
            assert done
            coverage[mode].append(info["coverage"])
            error[mode].append(np.hypot(*(observation["pose"][:2] - env.true_pose[:2])))
    assert sum(coverage["odometry"]) < sum(coverage["exact"]) - 0.05
    assert min(coverage["slam"]) > min(coverage["exact"]) - 0.02
    assert max(error["slam"]) < 0.15 < max(error["odometry"])
