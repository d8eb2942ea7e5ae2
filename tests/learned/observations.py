"""Observations met on the way, for the tests of learned selectors."""

from __future__ import annotations

import functools

import numpy as np

from baselines.learned.rollouts import nearest
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.floorplan import suite

CONFIG = {"drive": {"mode": "kinematic"}, "exploration": {"placement": "in_front"}}


def environment(plan: int = 3, decisions: int = 4, seed: int = 0) -> tuple[PolyExploreEnv, dict[str, np.ndarray]]:
    """An environment in the middle of an episode, and what is seen there."""
    env = PolyExploreEnv(plan=suite("home-validation").plan(plan), config=CONFIG)
    seen, _ = env.reset(seed=seed)
    for _ in range(decisions):
        seen, *_ = env.step(nearest([seen])[0])
    return env, seen


@functools.cache
def observation(plan: int = 3, decisions: int = 4) -> dict[str, np.ndarray]:
    """What is seen there, or as soon as there are three nodes or more to choose from."""
    env, seen = environment(plan, decisions)
    while seen["action_mask"].sum() < 3:
        seen, *_ = env.step(nearest([seen])[0])
    return seen


def permuted(seen: dict[str, np.ndarray], order: np.ndarray) -> dict[str, np.ndarray]:
    """The observation with slot i now holding what was in slot order[i]."""
    out = dict(seen)
    for key, value in seen.items():
        if key.startswith("node_") or key in ("edges", "action_mask"):
            out[key] = value[order]
    out["path_lengths"] = seen["path_lengths"][np.ix_(order, order)]
    return out


def moved(seen: dict[str, np.ndarray], angle: float, shift: tuple[float, float], mirror: bool) -> dict[str, np.ndarray]:
    """The same scene in another map frame: mirrored at the x axis if so wanted, turned, then shifted."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]]) @ np.diag([1.0, -1.0 if mirror else 1.0])

    def points(values):
        return (np.asarray(values, np.float64).reshape(-1, 2) @ turn.T + shift).reshape(np.shape(values))

    def headings(values):
        values = np.asarray(values, np.float64)
        return np.arctan2(*(np.stack((np.cos(values), np.sin(values)), -1) @ turn.T).T[::-1])

    out = dict(seen)
    out["pose"] = np.array([*points(seen["pose"][:2]), headings(seen["pose"][2:3])[0]])
    out["node_position"], out["edges"] = points(seen["node_position"]), points(seen["edges"])
    out["lines"] = points(seen["lines"][:, :4])
    out["node_heading"] = headings(seen["node_heading"])
    return out
