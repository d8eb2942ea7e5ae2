"""A person in the place of a policy: shown what the robot knows, asked for a node, and kept as any other record."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from polyexplore_gym.config import EnvConfig
from polyexplore_gym.evaluation.records import EpisodeRecord
from polyexplore_gym.evaluation.runner import Study, evaluate
from polyexplore_gym.evaluation.runner import make_env as plain_env
from polyexplore_gym.evaluation.setting import Setting
from polyexplore_gym.optional import require
from polyexplore_gym.snapshot import Snapshot

Ask = Callable[[Snapshot], int]
"""Shows a scene and returns the node that was chosen; raises KeyboardInterrupt if whoever is asked has left."""
_MARGIN = 1.0
"""Room about what is known in the picture, m."""
_REACH = 0.05
"""A click chooses a node no farther away than this share of the picture's diagonal."""


class Person:
    """A policy that asks."""

    def __init__(self, ask: Ask, name: str = "person") -> None:
        self.name, self.fingerprint = name, name
        self.asked = 0
        """Decisions so far."""
        self._ask = ask
        self._env: Any = None

    def make_env(self, config: EnvConfig) -> gymnasium.Env:
        """The environment of the episode: a person sees a picture of it instead of arrays."""
        self._env = plain_env(config)
        return self._env

    def act(self, observation: Mapping[str, np.ndarray], info: Mapping[str, Any], rng: np.random.Generator) -> int:
        """The node that the person chose; asked again until it is one that can be reached."""
        while True:
            self.asked += 1
            action = self._ask(known(self._env.snapshot()))
            if 0 <= action < len(info["action_mask"]) and info["action_mask"][action]:
                return action


def known(scene: Snapshot) -> Snapshot:
    """The scene without the truth: a frame about what has been seen instead of the plan, the pose as it is believed.

    The way driven is the true one: it is shown only where the robot knows it exactly.
    """
    rings = [ring for ring, _ in scene.explored]
    points = np.concatenate([*rings, scene.walls.reshape(-1, 2), scene.node_positions, scene.pose[None, :2]])
    (x0, y0), (x1, y1) = points.min(axis=0) - _MARGIN, points.max(axis=0) + _MARGIN
    exact = scene.estimate is None or np.array_equal(scene.estimate, scene.pose)
    way: dict[str, Any] = {} if exact else {"trajectory": np.zeros((0, 2)), "measured_at": np.zeros((0, 2))}
    return dataclasses.replace(
        scene,
        **way,
        exterior=np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]),
        holes=(),
        pose=scene.pose if scene.estimate is None else scene.estimate,
        estimate=None,
        coverage=None,
    )


def pointed_at(scene: Snapshot, x: float, y: float) -> int | None:
    """The node (that can be reached) nearest to a click at (x, y), m; None if there is none near."""
    if not scene.node_mask.any():
        return None
    off = np.hypot(*(scene.node_positions - (x, y)).T)
    off[~scene.node_mask] = np.inf
    reach = _REACH * np.hypot(*np.ptp(scene.exterior, axis=0))
    return int(off.argmin()) if off.min() <= reach else None


class Board:
    """A window: a click on a node chooses it, and so does its number followed by enter. Closing it ends the game."""

    def __init__(self) -> None:
        """Raises `MissingDependencyError` without matplotlib."""
        require("matplotlib", "plots")
        import matplotlib.pyplot as plt

        self._plt = plt
        self.figure = plt.figure("polyexplore", figsize=(9.0, 8.0))
        self._scene: Snapshot | None = None
        self._typed, self._chosen, self._closed = "", -1, False
        canvas = self.figure.canvas
        canvas.mpl_connect("button_press_event", self._click)
        canvas.mpl_connect("key_press_event", self._key)
        canvas.mpl_connect("close_event", self._close)

    def ask(self, scene: Snapshot) -> int:
        """Show the scene until a node is chosen."""
        from polyexplore_gym import rendering

        self._scene, self._typed, self._chosen = scene, "", -1
        self.figure.clear()
        axes = self.figure.add_axes((0.0, 0.04, 1.0, 0.92))
        rendering.draw(scene, axes, text=False, truth=False)
        self._tell()
        self._plt.show(block=False)
        while self._chosen < 0:
            if self._closed:
                raise KeyboardInterrupt
            self.figure.canvas.start_event_loop(0)
        return self._chosen

    def _tell(self) -> None:
        assert self._scene is not None
        text = f"{self._scene.distance:.1f} m. Click on a node, or type its number and enter: {self._typed}"
        self.figure.suptitle(text, fontsize=10)
        self.figure.canvas.draw_idle()

    def _choose(self, node: int | None) -> None:
        if node is not None:
            self._chosen = node
            self.figure.canvas.stop_event_loop()

    def _click(self, event: Any) -> None:
        if self._scene is not None and event.inaxes is not None:
            self._choose(pointed_at(self._scene, event.xdata, event.ydata))

    def _key(self, event: Any) -> None:
        key = event.key or ""
        if self._scene is None:
            return
        if key == "enter":
            node = int(self._typed) if self._typed else -1
            self._typed = ""
            self._choose(node if 0 <= node < len(self._scene.node_mask) and self._scene.node_mask[node] else None)
        elif key == "backspace":
            self._typed = self._typed[:-1]
        elif key.isdigit():
            self._typed = (self._typed + key)[-4:]
        self._tell()

    def _close(self, event: Any) -> None:
        self._closed = True
        self.figure.canvas.stop_event_loop()


def play(
    plan: Any, config: EnvConfig, out: Path, person: Person, *, seed: int = 0, reference: str = "nearest"
) -> tuple[EpisodeRecord, EpisodeRecord]:
    """A game on a plan: the records of the person and of the policy `reference` from the same start, kept in `out`.

    A game that is there already is not played again: `person.asked` is 0 then.

    Raises:
        ResultsError: `out` belongs to another game.
        KeyboardInterrupt: the person has left; nothing of the game is kept.
    """
    setting = Setting.of(config)
    study = Study(
        policies={reference: reference, person.name: person},
        plans=[plan],
        placements=(setting.placement,),
        sensing=(setting.sensing,),
        seeds=(seed,),
        config=config,
    )
    other, own = evaluate(study, out=out, workers=1, progress=False, make_env=person.make_env)
    return own, other
