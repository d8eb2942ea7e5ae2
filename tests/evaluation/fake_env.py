"""A stand-in for the environment: points to visit in the open, with the contract's observation and info.

It is quick, so that studies of hundreds of episodes can be killed and repeated, and it can be made to
fail, never to end or to end with points left by the plan's meta data.
"""

from __future__ import annotations

import time

import gymnasium
import numpy as np

from polyexplore_gym.config import EnvConfig
from polyexplore_gym.floorplan import FloorPlan

SLOTS = 8


def plan(number: int, **meta: object) -> FloorPlan:
    """A square of its own size."""
    side = 5.0 + 0.25 * number
    return FloorPlan.create([[0, 0], [side, 0], [side, side], [0, side]], name=f"square {number}", meta=meta)


class FakeEnv(gymnasium.Env):
    """Visits points; the one chosen is reached on a straight line and disappears."""

    def __init__(self, config: EnvConfig) -> None:
        self.config = config
        self.observation_space = gymnasium.spaces.Dict()
        self.action_space = gymnasium.spaces.Discrete(SLOTS)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.plan = options["plan"]
        self.position = np.array([1.0, 1.0])
        self.nodes = self.np_random.uniform(0.0, self.plan.bounds[2], size=(SLOTS, 2))
        if self.config.exploration.placement == "in_front":
            self.nodes *= 0.9
        self.moving = self.config.exploration.decide != "arrival"
        if self.moving:
            self.nodes *= 0.7
        self.edges = self.np_random.uniform(0.5, 3.0, size=SLOTS)
        self.open = np.ones(SLOTS, dtype=np.int8)
        self.distance, self.steps, self.bad = 0.0, 0, False
        if self.plan.meta.get("seen_at_once"):
            self.open[:] = 0
        return self._observation(), self._info(truncated=False)

    def step(self, action):
        meta = self.plan.meta
        time.sleep(meta.get("pause", 0.0))
        if not isinstance(action, (int, np.integer)) or not 0 <= action < SLOTS:
            raise ValueError(f"action {action!r} is not in 0..{SLOTS - 1}")
        self.steps += 1
        self.bad = not self.open[action]
        if not self.bad:
            self.distance += float(np.hypot(*(self.nodes[action] - self.position)))
            self.position = self.nodes[action].copy()
            self.open[action] = 0
        terminated = not self.open.any()
        truncated = not terminated and self.steps >= meta.get("budget", 100)
        return self._observation(), -1.0, terminated, truncated, self._info(truncated)

    def _observation(self):
        gaps = np.hypot(*(self.nodes[:, None] - self.nodes[None]).T).T
        return {
            "pose": np.array([*self.position, 0.0], dtype=np.float32),
            "max_range": np.array([8.0], dtype=np.float32),
            "node_position": self.nodes.astype(np.float32),
            "node_path_length": np.hypot(*(self.nodes - self.position).T).astype(np.float32),
            "node_edge_length": self.edges.astype(np.float32),
            "node_gain": (self.edges[::-1] * 1.3).astype(np.float32),
            "node_mask": self.open.copy(),
            "action_mask": self.open.copy(),
            "path_lengths": gaps.astype(np.float32),
        }

    def _info(self, truncated):
        left = self.plan.meta.get("left", 0)
        status = "budget" if truncated else "running" if self.open.any() else "unreached" if left else "complete"
        seen = 1.0 - 0.6 * self.open.mean()
        return {
            "action_mask": self.open.copy(),
            "distance": self.distance,
            "coverage": float(seen),
            "measurements": self.steps + 2,
            "sim_time": 2.0 * self.distance,
            "collisions": 0,
            "invalid_action": self.bad,
            "ended": "invalid" if self.bad else "settled" if self.moving else "arrived" if self.steps else "start",
            "outcome": {
                "status": status,
                "unreached": left,
                "unreached_length": 1.25 * left,
                "given_up": int(left > 1),
                "given_up_length": 0.5 * (left > 1),
            },
            "cut": {"nodes": 0, "lines": 0},
        }


class Fussy:
    """A policy that raises on plans whose number is odd."""

    name = "fussy"

    def act(self, observation, info, rng):
        if observation["node_position"].max() > 6.2:
            raise RuntimeError("too large for me")
        return int(np.flatnonzero(observation["action_mask"])[0])


class Stubborn:
    """Always the first node, even when it is gone."""

    name = "stubborn"

    def act(self, observation, info, rng):
        return 0


class Rememberer:
    """Depends on how often it was called since `reset`."""

    name = "rememberer"

    def __init__(self) -> None:
        self.calls = 0

    def reset(self) -> None:
        self.calls = 0

    def act(self, observation, info, rng):
        self.calls += 1
        nodes = np.flatnonzero(observation["action_mask"])
        return int(nodes[(self.calls * 7) % len(nodes)])
