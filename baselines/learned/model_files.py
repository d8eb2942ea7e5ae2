"""Models on disk: weights in safetensors, and a JSON card beside them that says what they are.

Neither can run code when it is read. The card holds the SHA-256 of the weights; a file that is damaged,
cut short, of another kind or for another environment is refused with the reason.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors

from baselines.learned import features
from baselines.learned.network import Network, NetworkConfig
from polyexplore_gym import observation
from polyexplore_gym.config import ObservationConfig, from_mapping
from polyexplore_gym.errors import InvalidConfigError, InvalidModelError

FORMAT = 1
"""Raised when the files' layout changes."""
ENVIRONMENT = "v0"
"""The version of the environment that models are trained for."""
SHIPPED = Path(__file__).parent / "models" / "selector.safetensors"
"""The model that comes with the package."""
_LARGEST = 256 * 2**20
_UNREAD = frozenset({"node_pursued"})
"""Keys of the observation that the features do not look at: models know nothing of them."""


def space_hash() -> str:
    """What a model's input depends on: the observation's keys, shapes per node and types, and the features."""
    spaces = observation.space(ObservationConfig(max_nodes=1, max_lines=1)).spaces
    keys = [(key, list(box.shape or ()), str(box.dtype)) for key, box in sorted(spaces.items()) if key not in _UNREAD]
    sizes = [features.SCALARS, features.VECTORS, features.RAYS, features.REACH, features.PAIR, features.WHOLE]
    return hashlib.sha256(json.dumps([keys, sizes]).encode()).hexdigest()


def card_path(path: Path) -> Path:
    """Where the card of the weights at `path` is."""
    return path.with_suffix(".json")


def save_model(path: Path | str, network: Network, about: dict[str, Any]) -> None:
    """Write weights and card.

    Args:
        path: of the weights, ending in .safetensors; the card gets the same name and .json.
        network: what to write.
        about: of the card: algorithm, suite, seed, training cost, results; anything fit for JSON.

    Raises:
        InvalidModelError: the name has another ending, or the files cannot be written.
    """
    path = _named(path)
    weights = save_tensors({name: value.detach().contiguous() for name, value in network.state_dict().items()})
    card = {
        "format": FORMAT,
        "environment": ENVIRONMENT,
        "space": space_hash(),
        "network": dataclasses.asdict(network.config),
        "sha256": hashlib.sha256(weights).hexdigest(),
        **about,
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for file, data in ((path, weights), (card_path(path), (json.dumps(card, indent=2) + "\n").encode())):
            fresh = file.with_name(file.name + ".new")
            fresh.write_bytes(data)
            os.replace(fresh, file)
    except OSError as error:
        raise InvalidModelError(f"{path}: cannot be written: {error.strerror}") from error


def read_card(path: Path | str) -> dict[str, Any]:
    """The card of the weights at `path`.

    Raises:
        InvalidModelError: it cannot be read, or is not that of a model for this environment.
    """
    path = card_path(_named(path))
    try:
        card = json.loads(path.read_bytes().decode("utf-8"))
    except OSError as error:
        raise InvalidModelError(f"{path}: the model's card cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise InvalidModelError(f"{path}: damaged, not the card of a model: {error}") from error
    if not isinstance(card, dict) or not {"format", "environment", "space", "network", "sha256"} <= set(card):
        raise InvalidModelError(f"{path}: not the card of a model")
    for key, ours in (("format", FORMAT), ("environment", ENVIRONMENT), ("space", space_hash())):
        if card[key] != ours:
            raise InvalidModelError(f"{path}: made for another {key}: {card[key]!r}, not {ours!r}; train it anew")
    return card


def load_model(path: Path | str) -> tuple[Network, dict[str, Any]]:
    """The network at `path`, ready to score, and its card.

    Raises:
        InvalidModelError: a file is missing, damaged, cut short, of another kind or for other spaces.
    """
    path = _named(path)
    card = read_card(path)
    try:
        if path.stat().st_size > _LARGEST:
            raise InvalidModelError(f"{path}: larger than any model of this package")
        weights = path.read_bytes()
    except OSError as error:
        raise InvalidModelError(f"{path}: cannot be read: {error.strerror}") from error
    if hashlib.sha256(weights).hexdigest() != card["sha256"]:
        raise InvalidModelError(f"{path}: damaged or cut short: its SHA-256 is not the one in {card_path(path).name}")
    try:
        config = from_mapping(NetworkConfig, card["network"], path="network")
        network = Network(config)
        network.load_state_dict(load_tensors(weights))
    except (SafetensorError, InvalidConfigError, RuntimeError) as error:
        raise InvalidModelError(f"{path}: not the weights of such a network: {str(error).splitlines()[0]}") from error
    if not all(bool(torch.isfinite(value).all()) for value in network.state_dict().values()):
        raise InvalidModelError(f"{path}: holds weights that are not numbers")
    network.eval()
    return network, card


def _named(path: Path | str) -> Path:
    path = Path(path)
    if path.suffix != ".safetensors":
        raise InvalidModelError(f"{path}: the name of a model ends in .safetensors")
    return path
