"""Learning from roll-outs: predict how much farther one drives after each choice, by regression.

What is compared are the nodes of one state, so their mean is taken out of costs and scores alike. The
loss is the squared error, not that of a classifier: its minimum is the mean cost given what was seen,
however noisy single outcomes are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from baselines.learned.features import Features, features
from baselines.learned.network import Network, augmented, collate
from baselines.learned.rollouts import State
from polyexplore_gym.errors import InvalidConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class FitConfig:
    """How the regression goes."""

    epochs: int = 30
    """Passes over the states."""
    batch: int = 64
    """States in a step."""
    learning_rate: float = 1e-3
    """The highest; it rises over the first 5 % of the steps and falls to 0 as a cosine."""
    weight_decay: float = 0.05
    """Of AdamW."""

    def __post_init__(self) -> None:
        for name, least in (("epochs", 1), ("batch", 1), ("learning_rate", 0.0), ("weight_decay", 0.0)):
            if not getattr(self, name) >= least:
                raise InvalidConfigError(f"FitConfig.{name} = {getattr(self, name)!r}: must be at least {least}")


@dataclass(frozen=True, slots=True)
class Example:
    """A state as the network sees it."""

    features: Features
    rows: np.ndarray
    """(c,) rows of the nodes tried."""
    cost: np.ndarray
    """(c,) their costs, m."""
    group: str
    """Name of the plan: examples of one plan stay together when a part is held out."""


def examples(states: Sequence[State]) -> list[Example]:
    """The states as the network sees them, those without a choice left out."""
    found = []
    for state in states:
        if len(state.nodes) < 2:
            continue
        seen = features(state.seen)
        rows = np.searchsorted(seen.slots, state.nodes)
        found.append(Example(seen, rows, state.cost.astype(np.float64), state.plan))
    return found


def loss(scores: Tensor, many: Sequence[Example]) -> Tensor:
    """The weighted squared error of `scores` (b, k) about their mean over the nodes tried."""
    c = max(len(e.rows) for e in many)
    rows, target, tried = (
        np.zeros((len(many), c), np.int64),
        np.zeros((len(many), c), np.float32),
        np.zeros((len(many), c), np.float32),
    )
    weight = np.zeros(len(many), np.float32)
    for i, e in enumerate(many):
        n = len(e.rows)
        rows[i, :n], tried[i, :n] = e.rows, 1.0
        target[i, :n] = (e.cost.mean() - e.cost) / UNIT
        weight[i] = 1.0 / noise(float(e.cost.mean())) ** 2
    on = torch.from_numpy(tried)
    score = torch.where(on > 0, scores.gather(1, torch.from_numpy(rows)), 0.0)
    score = score - score.sum(1, keepdim=True) / on.sum(1, keepdim=True)
    error = (score - torch.from_numpy(target)) ** 2 * on
    error = error.sum(1) / (on.sum(1) - 1.0)
    w = torch.from_numpy(weight)
    return (error * w).sum() / w.sum()


UNIT = 8.0
"""Metres in one of score."""


def noise(cost: float) -> float:
    """About how much outcomes of one choice differ, m, when so much is left to drive: the weight of a state."""
    return 0.5 + 0.5 * max(cost, 0.0) ** 0.62


class Fit:
    """A regression, epoch by epoch. The same seed ends with the same weights, also when it is taken up again.

    Args:
        network: as it is to start from; changed in place.
        many: what to learn from.
        config: how.
        seed: of the order and the augmentation.
    """

    def __init__(self, network: Network, many: Sequence[Example], config: FitConfig, seed: int) -> None:
        self.network = network
        self.many = many
        self.config = config
        self.seed = seed
        self.done = 0
        self.optimizer = torch.optim.AdamW(
            network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )

    def state(self) -> dict[str, Any]:
        """What `restore` needs to go on from here."""
        return {"done": self.done, "network": self.network.state_dict(), "optimizer": self.optimizer.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from the state of an equal regression."""
        self.network.load_state_dict(state["network"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.done = state["done"]

    def epoch(self) -> float:
        """Pass over the examples once; returns the mean loss."""
        config, many = self.config, self.many
        # Each epoch has a stream of its own, so that one can go on after any of them.
        entropy = np.random.SeedSequence([self.seed, self.done]).generate_state(1, np.uint64)[0]
        generator = torch.Generator().manual_seed(int(entropy >> 1))
        batches = self._batches(generator)
        step, steps = self.done * len(batches), config.epochs * len(batches)
        total = 0.0
        self.network.train()
        for i in torch.randperm(len(batches), generator=generator).tolist():
            some = [many[j] for j in batches[i]]
            share = step / steps
            for group in self.optimizer.param_groups:
                group["lr"] = config.learning_rate * min(1.0, 20.0 * share) * 0.5 * (1.0 + math.cos(math.pi * share))
            scores, _ = self.network(augmented(collate([e.features for e in some]), generator))
            value = loss(scores, some)
            self.optimizer.zero_grad(set_to_none=True)
            value.backward()
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
            self.optimizer.step()
            total += float(value.detach()) * len(some)
            step += 1
        self.network.eval()
        self.done += 1
        return total / len(many)

    def _batches(self, generator: torch.Generator) -> list[list[int]]:
        """Which examples go together: some of about as many nodes, as padding is work."""
        size = self.config.batch
        order = torch.randperm(len(self.many), generator=generator).tolist()
        batches = []
        for start in range(0, len(order), 16 * size):
            chunk = sorted(order[start : start + 16 * size], key=lambda i: len(self.many[i].features.slots))
            batches += [chunk[i : i + size] for i in range(0, len(chunk), size)]
        return batches


@torch.inference_mode()
def scores(network: Network, many: Sequence[Features], batch: int = 128) -> list[np.ndarray]:
    """Scores (k,) of each."""
    found = []
    for i in range(0, len(many), batch):
        some = many[i : i + batch]
        out, _ = network(collate(some))
        found += [row[: len(f.slots)].numpy() for row, f in zip(out, some, strict=True)]
    return found


def gains(network: Network, many: Sequence[Example]) -> np.ndarray:
    """(n,) metres saved against the nearest node tried by taking the best of the nodes tried."""
    found = np.zeros(len(many))
    for i, (e, score) in enumerate(zip(many, scores(network, [e.features for e in many]), strict=True)):
        nearest = e.features.node[e.rows, 0].argmin()
        found[i] = e.cost[nearest] - e.cost[score[e.rows].argmax()]
    return found
