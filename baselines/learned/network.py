"""The network: a transformer over the reachable nodes, with what lies between two of them as attention bias.

A node's score does not depend on the order of the nodes, and there may be any number of them. Besides the scores
there is a value of the whole, which reinforcement learning needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from baselines.learned.features import NODE, PAIR, RAYS, SCALARS, VECTORS, WHOLE, Features
from polyexplore_gym.errors import InvalidConfigError

_VECTORS = slice(len(SCALARS), len(SCALARS) + 2 * len(VECTORS))
RULE = {"tour_over_best": 1.0, "path": 0.3}
"""An untrained network follows this rule: a short tour over the nodes, near ones first; learning starts from there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkConfig:
    """Sizes of the network."""

    width: int = 64
    """Numbers per token."""
    layers: int = 2
    """Attention layers."""
    heads: int = 4
    """Attention heads."""
    pair_width: int = 16
    """Hidden numbers per pair of nodes."""
    dropout: float = 0.0
    """Share of hidden numbers dropped in training."""

    def __post_init__(self) -> None:
        for name in ("width", "layers", "heads", "pair_width"):
            if getattr(self, name) < 1:
                raise InvalidConfigError(f"NetworkConfig.{name} = {getattr(self, name)}: must be at least 1")
        if self.width % self.heads:
            raise InvalidConfigError(f"NetworkConfig.heads = {self.heads}: must divide the width, {self.width}")
        if not 0.0 <= self.dropout < 1.0:
            raise InvalidConfigError(f"NetworkConfig.dropout = {self.dropout}: must lie in [0, 1)")


@dataclass(frozen=True, slots=True)
class Batch:
    """Features of b observations, padded to the most nodes among them."""

    node: Tensor
    """(b, k, NODE)."""
    pair: Tensor
    """(b, k, k, PAIR)."""
    whole: Tensor
    """(b, WHOLE)."""
    mask: Tensor
    """(b, k) bool: the node exists."""


def collate(many: Sequence[Features]) -> Batch:
    """Features of several observations as one batch."""
    k = max(len(f.slots) for f in many)
    node = np.zeros((len(many), k, NODE), np.float32)
    pair = np.zeros((len(many), k, k, PAIR), np.float32)
    mask = np.zeros((len(many), k), np.bool_)
    for i, f in enumerate(many):
        n = len(f.slots)
        node[i, :n], pair[i, :n, :n], mask[i, :n] = f.node, f.pair, True
    whole = np.stack([f.whole for f in many])
    return Batch(*(torch.from_numpy(a) for a in (node, pair, whole, mask)))


def augmented(batch: Batch, generator: torch.Generator) -> Batch:
    """The batch with every scene turned by a random angle, and mirrored in half of the cases."""
    b = len(batch.node)
    angle = torch.rand(b, generator=generator) * 2.0 * torch.pi
    mirror = torch.where(torch.rand(b, generator=generator) < 0.5, -1.0, 1.0)
    return turned(batch, angle, mirror)


def turned(batch: Batch, angle: Tensor, mirror: Tensor) -> Batch:
    """The batch with scene i turned by `angle` (b,) after its y axis was multiplied with `mirror` (b,), 1 or -1."""
    node = batch.node.clone()
    c, s = torch.cos(angle)[:, None, None], torch.sin(angle)[:, None, None]
    vectors = node[..., _VECTORS].unflatten(-1, (-1, 2))
    x, y = vectors[..., 0], vectors[..., 1] * mirror[:, None, None]
    node[..., _VECTORS] = torch.stack((c * x - s * y, s * x + c * y), dim=-1).flatten(-2)
    rays = node[..., _VECTORS.stop :].unflatten(-1, (3, RAYS))
    node[..., _VECTORS.stop :] = torch.where(mirror[:, None, None, None] < 0, rays.flip(-1), rays).flatten(-2)
    return Batch(node, batch.pair, batch.whole, batch.mask)


class Network(nn.Module):
    """Scores of nodes and the value of the whole."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        w = config.width
        self.config = config
        self.node = nn.Sequential(nn.Linear(NODE + WHOLE, w), nn.GELU(), nn.Linear(w, w))
        self.whole = nn.Sequential(nn.Linear(WHOLE, w), nn.GELU(), nn.Linear(w, w))
        self.pair = nn.Sequential(nn.Linear(PAIR, config.pair_width), nn.GELU())
        self.layers = nn.ModuleList(_Layer(config) for _ in range(config.layers))
        self.norm = nn.LayerNorm(w)
        self.score = nn.Sequential(nn.Linear(2 * w, w), nn.GELU(), nn.Linear(w, 1))
        self.value = nn.Sequential(nn.Linear(w, w), nn.GELU(), nn.Linear(w, 1))
        self.direct = nn.Linear(NODE, 1, bias=False)
        nn.init.zeros_(self.direct.weight)
        with torch.no_grad():  # a score is minus a cost in laser ranges
            for name, weight in RULE.items():
                self.direct.weight[0, SCALARS.index(name)] = -weight
        nn.init.zeros_(self.score[2].weight)  # type: ignore[arg-type]
        nn.init.zeros_(self.score[2].bias)  # type: ignore[arg-type]

    def forward(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Scores (b, k), -inf where there is no node, and values (b,)."""
        k = batch.mask.shape[1]
        nodes = self.node(torch.cat((batch.node, batch.whole[:, None].expand(-1, k, -1)), dim=-1))
        # The token of the whole comes first.
        x = torch.cat((self.whole(batch.whole)[:, None], nodes), dim=1)
        pair = self.pair(batch.pair)
        there = nn.functional.pad(batch.mask, (1, 0), value=True)
        closed = torch.zeros(there.shape, dtype=x.dtype).masked_fill(~there, float("-inf"))[:, None, None]
        for layer in self.layers:
            x = layer(x, pair, closed)
        x = self.norm(x)
        context = x[:, :1].expand(-1, k, -1)
        score = self.score(torch.cat((x[:, 1:], context), dim=-1)) + self.direct(batch.node)
        return score[..., 0].masked_fill(~batch.mask, float("-inf")), self.value(x[:, 0])[..., 0]


class _Layer(nn.Module):
    """Attention with a bias from the pairs, then a perceptron; both on normalised tokens and added."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        w = config.width
        self.heads = config.heads
        self.before = nn.LayerNorm(w)
        self.take = nn.Linear(w, 3 * w)
        self.bias = nn.Linear(config.pair_width, config.heads)
        self.give = nn.Linear(w, w)
        self.between = nn.LayerNorm(w)
        self.think = nn.Sequential(nn.Linear(w, 2 * w), nn.GELU(), nn.Dropout(config.dropout), nn.Linear(2 * w, w))

    def forward(self, x: Tensor, pair: Tensor, closed: Tensor) -> Tensor:
        b, n, w = x.shape
        q, k, v = self.take(self.before(x)).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        bias = nn.functional.pad(self.bias(pair).permute(0, 3, 1, 2), (1, 0, 1, 0)) + closed
        mixed = nn.functional.scaled_dot_product_attention(q, k, v, attn_mask=bias)
        x = x + self.give(mixed.transpose(1, 2).reshape(b, n, w))
        return x + self.think(self.between(x))
