"""Learning from roll-outs: predict how much farther one drives after each choice, by regression.

What is compared are the nodes of one state, so their mean is taken out of costs and scores alike. The
loss is the squared error, not that of a classifier: its minimum is the mean cost given what was seen,
however noisy single outcomes are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from baselines.learned.features import Features, features
from baselines.learned.network import Network, augmented, collate
from baselines.learned.rollouts import State


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


def fit(
    network: Network,
    many: Sequence[Example],
    config: FitConfig,
    seed: int,
    *,
    report: Callable[[int, float], None] | None = None,
) -> None:
    """Fit the network to the examples, in place; the same seed ends with the same weights.

    Args:
        network: as it is to start from.
        many: what to learn from.
        config: how.
        seed: of the order and the augmentation.
        report: called after every epoch with its number and mean loss.
    """
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    steps = config.epochs * math.ceil(len(many) / config.batch)
    step = 0
    network.train()
    for epoch in range(config.epochs):
        order = torch.randperm(len(many), generator=generator).tolist()
        # States of about as many nodes go together: padding is work.
        chunks = [order[i : i + 16 * config.batch] for i in range(0, len(order), 16 * config.batch)]
        batches = []
        for chunk in chunks:
            chunk.sort(key=lambda i: len(many[i].features.slots))
            batches += [chunk[i : i + config.batch] for i in range(0, len(chunk), config.batch)]
        total = 0.0
        for i in torch.randperm(len(batches), generator=generator).tolist():
            some = [many[j] for j in batches[i]]
            share = step / steps
            rate = config.learning_rate * min(1.0, 20.0 * share) * 0.5 * (1.0 + math.cos(math.pi * share))
            for group in optimizer.param_groups:
                group["lr"] = rate
            scores, _ = network(augmented(collate([e.features for e in some]), generator))
            value = loss(scores, some)
            optimizer.zero_grad(set_to_none=True)
            value.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
            total += float(value.detach()) * len(some)
            step += 1
        if report is not None:
            report(epoch, total / len(many))
    network.eval()


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
