"""The policy `learned`: the node with the best score of a trained network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import baselines.learned
from baselines.choice import NOTHING

baselines.learned.require("torch", "safetensors")

import torch  # noqa: E402

from baselines.learned import model_files  # noqa: E402
from baselines.learned.features import features  # noqa: E402
from baselines.learned.network import Network, collate  # noqa: E402


class Learned:
    """Takes the reachable node whose score is the highest.

    Args:
        model: path of the weights (.safetensors, with its card beside it); the shipped model if left out.
        network: a network to use as it is, instead of a file.
    """

    name = "learned"

    def __init__(self, model: str | Path | None = None, network: Network | None = None) -> None:
        if network is None:
            network, self.card = model_files.load_model(model_files.SHIPPED if model is None else model)
            self.fingerprint = self.card["sha256"]
        self.network = network

    def act(self, observation: Mapping[str, np.ndarray], info: Mapping[str, Any], rng: np.random.Generator) -> int:
        """The reachable node with the highest score; ties go to the lower index."""
        return self.choose([observation])[0]

    def choose(self, observations: Sequence[Mapping[str, np.ndarray]]) -> list[int]:
        """The node chosen in each of several observations."""
        found = [NOTHING] * len(observations)
        rows = [i for i, o in enumerate(observations) if np.any(o["action_mask"])]
        seen = [features(observations[i]) for i in rows]
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # others would wait for each other longer than they work
        try:
            with torch.inference_mode():
                for start in range(0, len(seen), 16):
                    some = seen[start : start + 16]
                    scores, _ = self.network(collate(some))
                    for i, f, node in zip(rows[start:], some, scores.argmax(dim=1).tolist(), strict=False):
                        found[i] = int(f.slots[node])
        finally:
            torch.set_num_threads(threads)
        return found
