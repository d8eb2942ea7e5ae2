"""What a choice leads to, found by trying: copies of the environment that go on to the end, one for each node.

From a state, every candidate node is chosen in a copy of its own, which then follows a base policy
until nothing is left; the metres driven from there on are the node's cost. The base policy does not
know the plan, so the mean of these costs given the observation is that of a policy that could be
followed: whoever predicts it and takes the best node improves on the base policy (policy iteration by
roll-outs: Bertsekas, Tsitsiklis, Wu, "Rollout algorithms for combinatorial optimization", 1997).
Imitating the choices of whoever knows the plan has no such promise. All copies of a state share its
streams of noise.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from polyexplore_gym.config import EnvConfig
from polyexplore_gym.env import PolyExploreEnv

NODE_KEYS = (
    "edges", "node_position", "node_heading", "node_path_length", "node_edge_length", "node_gain", "node_kind",
    "node_visits", "action_mask",
)  # fmt: skip
"""The parts of an observation with a row per node."""

Choose = Callable[[Sequence[Mapping[str, np.ndarray]]], list[int]]
"""A policy for many observations at once: the node chosen in each."""


@dataclass(frozen=True, slots=True)
class State:
    """A state met, and the costs of some of its nodes."""

    seen: dict[str, np.ndarray]
    """The observation without its padding: `NODE_KEYS`, pose, max_range, path_lengths (k, k), lines (m, 4)."""
    nodes: np.ndarray
    """(c,) the nodes tried, int16."""
    cost: np.ndarray
    """(c,) metres driven from here to the end after choosing them, float32."""
    plan: str
    """The plan's name."""


def shorn(seen: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """An observation without its padding, what selectors do not use left out."""
    k, m = int(seen["node_mask"].sum()), int(seen["line_mask"].sum())
    parts = {key: seen[key][:k].copy() for key in NODE_KEYS}
    parts |= {"pose": seen["pose"].copy(), "max_range": seen["max_range"].copy()}
    parts["path_lengths"] = seen["path_lengths"][:k, :k].copy()
    parts["lines"] = seen["lines"][:m, :4].copy()
    return parts


def nearest(observations: Sequence[Mapping[str, np.ndarray]]) -> list[int]:
    """The base policy to begin with: the shortest path."""
    return [int(np.where(seen["action_mask"] > 0, seen["node_path_length"], np.inf).argmin()) for seen in observations]


def candidates(seen: Mapping[str, np.ndarray], chosen: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """(c,) the `chosen` node and up to `count` - 1 other reachable ones, drawn, near ones more often."""
    reachable = np.flatnonzero(seen["action_mask"])
    order = reachable[np.argsort(seen["node_path_length"][reachable], kind="stable")]
    others = order[order != chosen]
    weight = 1.0 / np.arange(1, len(others) + 1)
    size = min(count - 1, len(others))
    drawn = rng.choice(others, size=size, replace=False, p=weight / weight.sum()) if size else others
    return np.sort(np.append(drawn, chosen))


def costs(env: PolyExploreEnv, nodes: np.ndarray, base: Choose, *, pairwise: bool) -> np.ndarray:
    """(c,) metres from here to the end after choosing each of `nodes`, then following `base`.

    Args:
        env: in the middle of an episode; it is left as it is.
        nodes: (c,) reachable nodes.
        base: the policy that the copies follow.
        pairwise: whether it needs the path lengths between nodes.
    """
    twins = [branch(env, pairwise=pairwise) for _ in nodes]
    driven = np.zeros(len(nodes))
    going = []
    for i, (twin, node) in enumerate(zip(twins, nodes, strict=True)):
        seen, _, terminated, truncated, info = twin.step(int(node))
        driven[i] = info["distance"]
        if not (terminated or truncated):
            going.append((i, twin, seen))
    while going:
        actions = base([seen for *_, seen in going])
        still = []
        for (i, twin, _), action in zip(going, actions, strict=True):
            seen, _, terminated, truncated, info = twin.step(action)
            driven[i] = info["distance"]
            if not (terminated or truncated):
                still.append((i, twin, seen))
        going = still
    return driven - env._distance


def branch(env: PolyExploreEnv, *, pairwise: bool) -> PolyExploreEnv:
    """A copy that goes on from here, with the same noise to come."""
    # The plan is immutable and the largest part.
    twin = copy.deepcopy(env, {id(env.plan): env.plan, id(env.config): env.config})
    if env.config.observation.pairwise != pairwise:
        sizes = dataclasses.replace(env.config.observation, pairwise=pairwise)
        twin.config = dataclasses.replace(env.config, observation=sizes)
    return twin


def states(
    plans: Iterator[Any],
    config: EnvConfig,
    rng: np.random.Generator,
    *,
    base: Choose,
    pairwise: bool,
    tried: int = 4,
    per_episode: int = 8,
    wander: float = 0.15,
) -> Iterator[State]:
    """States of episodes that follow `base`, but wander off to another near node now and then.

    Args:
        plans: to explore, one an episode.
        config: of the environment.
        rng: the only source of randomness.
        base: the policy, in the episodes and in the roll-outs.
        pairwise: whether it needs the path lengths between nodes.
        tried: most nodes tried in a state.
        per_episode: states taken of an episode, about.
        wander: probability of a step to another node, near ones more often.
    """
    env = PolyExploreEnv(config=config)
    for plan in plans:
        seen, _ = env.reset(seed=int(rng.integers(2**31)), options={"plan": plan})
        # An episode of a plan takes about so many decisions.
        chance = min(1.0, per_episode / max(4.0, plan.area / 9.0))
        over = not seen["action_mask"].any()
        while not over:
            action = base([seen])[0]
            others = int(seen["action_mask"].sum()) - 1
            if others and rng.random() < chance:
                nodes = candidates(seen, action, tried, rng)
                found = costs(env, nodes, base, pairwise=pairwise)
                yield State(shorn(seen), nodes.astype(np.int16), found.astype(np.float32), plan.name)
            if others and rng.random() < wander:
                action = int(rng.choice(candidates(seen, action, 4, rng)))
            seen, _, terminated, truncated, _ = env.step(action)
            over = terminated or truncated
