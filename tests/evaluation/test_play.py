"""A person's game: kept as that of a policy with the same choices; clicks and keys; no truth in the picture."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from polyexplore_gym import cli
from polyexplore_gym.config import EnvConfig, from_mapping
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.evaluation import load_policy, read_records, run_episode
from polyexplore_gym.evaluation.play import Board, Person, known, play, pointed_at
from polyexplore_gym.floorplan import generate

CONFIG = from_mapping(EnvConfig, {
    "drive": {"mode": "kinematic"}, "exploration": {"placement": "in_front", "scan_every": 0.5, "decide": "settled"},
})  # fmt: skip
PLAN = generate("home", 4)


class Noted:
    """A policy whose choices are noted."""

    def __init__(self, policy: Any) -> None:
        self.policy, self.choices = policy, []

    def act(self, observation, info, rng):
        self.choices.append(self.policy.act(observation, info, rng))
        return self.choices[-1]


def test_a_game_is_kept_as_a_policys_episode_is(tmp_path):
    noted = Noted(load_policy("ekman_ratio"))
    wanted = run_episode(PolyExploreEnv(config=CONFIG), noted, PLAN, 3, label="ann")
    choices, scenes = iter(noted.choices), []

    def ask(scene):
        scenes.append(scene)
        # What cannot be chosen is asked for again.
        return next(choices) if len(scenes) % 2 == 0 else len(scene.node_mask) + 5

    person = Person(ask, "ann")
    own, other = play(PLAN, CONFIG, tmp_path / "game", person, seed=3)
    assert own == wanted
    assert other == run_episode(PolyExploreEnv(config=CONFIG), load_policy("nearest"), PLAN, 3, label="nearest")
    assert person.asked == len(scenes) == 2 * len(noted.choices)
    assert set(read_records(tmp_path / "game")) == {own, other}
    again = Person(ask, "ann")
    assert play(PLAN, CONFIG, tmp_path / "game", again, seed=3) == (own, other)
    assert again.asked == 0


def test_who_leaves_leaves_nothing(tmp_path):
    def ask(scene):
        if scene.distance > 5.0:
            raise KeyboardInterrupt
        return int(scene.node_mask.argmax())

    with pytest.raises(KeyboardInterrupt):
        play(PLAN, CONFIG, tmp_path / "game", Person(ask))
    assert [record.policy for record in read_records(tmp_path / "game")] == ["nearest"]


def scene(pose: str = "exact") -> Any:
    env = PolyExploreEnv(PLAN, config=dataclasses.replace(CONFIG, pose=dataclasses.replace(CONFIG.pose, mode=pose)))
    _, info = env.reset(seed=3)
    for _ in range(2):
        *_, info = env.step(int(info["action_mask"].argmax()))
    return env.snapshot()


def test_the_truth_is_not_shown():
    for pose in ("exact", "gaussian"):
        whole = scene(pose)
        shown = known(whole)
        other = dataclasses.replace(  # another building, with the same seen of it
            whole,
            exterior=whole.exterior * 3.0,
            holes=(whole.exterior,),
            coverage=0.1,
            **({} if pose == "exact" else {"pose": whole.pose + 1.0, "trajectory": whole.trajectory + 1.0}),
        )
        again = known(other)
        for field in dataclasses.fields(shown):
            one, two = getattr(shown, field.name), getattr(again, field.name)
            if isinstance(one, np.ndarray) and field.name != "exterior":
                assert np.array_equal(one, two), field.name
        if pose == "exact":
            assert np.array_equal(shown.exterior, again.exterior)
            assert len(shown.trajectory) > 2
        else:
            assert not len(shown.trajectory)
        assert shown.coverage is None
        assert not shown.holes


def test_a_click_chooses_the_node_beside_it():
    shown = scene()
    for node in np.flatnonzero(shown.node_mask):
        x, y = shown.node_positions[node]
        assert pointed_at(shown, x + 0.05, y - 0.05) == node
    assert pointed_at(shown, 1e3, 0.0) is None
    nobody = dataclasses.replace(shown, node_mask=np.zeros(len(shown.node_mask), bool))
    assert pointed_at(nobody, *shown.node_positions[0]) is None
    first = dataclasses.replace(shown, node_mask=np.arange(len(shown.node_mask)) > 0)
    assert pointed_at(first, *shown.node_positions[0]) != 0


@pytest.fixture
def board(monkeypatch):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.backend_bases import CloseEvent, KeyEvent, MouseEvent

    board = Board()
    events: list[Any] = []

    def loop(timeout=0):
        assert events, "nobody does anything any more"
        canvas, event = board.figure.canvas, events.pop(0)
        if event is None:
            canvas.callbacks.process("close_event", CloseEvent("close_event", canvas))
        elif isinstance(event, str):
            canvas.callbacks.process("key_press_event", KeyEvent("key_press_event", canvas, event))
        else:
            at = board.figure.axes[0].transData.transform(event)
            canvas.callbacks.process("button_press_event", MouseEvent("button_press_event", canvas, *at, 1))

    monkeypatch.setattr(board.figure.canvas, "start_event_loop", loop)
    yield board, events
    plt.close("all")


def test_the_board_is_played_by_mouse_and_keys(board):
    board, events = board
    shown = known(scene())
    node = int(np.flatnonzero(shown.node_mask)[-1])
    x, y = shown.node_positions[node]
    events += [(x, y + 1e3), shown.exterior[0] + 0.01]  # beside the map, far from any node
    events += ["enter", "x", "9", "9", "9", "enter"]  # no such node
    events += [(x + 0.1, y)]
    assert board.ask(shown) == node
    assert not events
    events += ["7", "backspace", *str(node), "enter"]
    assert board.ask(shown) == node
    picture = np.asarray(board.figure.canvas.buffer_rgba())
    assert len(np.unique(picture.reshape(-1, 4), axis=0)) > 20
    events += [None]
    with pytest.raises(KeyboardInterrupt):
        board.ask(shown)


def test_the_command(tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    shown = []
    monkeypatch.setattr(Board, "__init__", lambda self: None)
    monkeypatch.setattr(Board, "ask", lambda self, scene: (shown.append(scene), int(scene.node_mask.argmax()))[1])
    words = ["play", "home-validation/2", "--player", "ann", "--drive", "kinematic", "--out", str(tmp_path)]
    assert cli.main(words) == 0
    told = capsys.readouterr().out
    assert "ann / nearest: " in told
    assert shown
    count = len(shown)
    assert cli.main(words) == 0
    assert "played before" in capsys.readouterr().out
    assert len(shown) == count
    assert cli.main([*words, "--player", "nearest"]) == 2
    assert cli.main([*words, "--seed", "-1"]) == 2
