"""The baselines by name. A class is imported when it is first asked for, so that torch stays out."""

from __future__ import annotations

import importlib
from typing import Any

from polyexplore_gym.errors import InvalidConfigError, PolyExploreError
from polyexplore_gym.evaluation.policy import Policy

_CLASSES = {
    "nearest": "baselines.nearest:Nearest",
    "largest": "baselines.largest:Largest",
    "ekman_ratio": "baselines.ekman_ratio:EkmanRatio",
    "modified_sum": "baselines.modified_sum:ModifiedSum",
    "utility": "baselines.utility:Utility",
    "distance_advantage": "baselines.distance_advantage:DistanceAdvantage",
    "random": "baselines.uniform:Uniform",
    "tour": "baselines.tour:Tour",
    "watchman": "baselines.watchman:Watchman",
    "rollout": "baselines.rollout:Rollout",
    "learned": "baselines.learned.selector:Learned",
}


def policy_names() -> tuple[str, ...]:
    """The names that `make_policy` knows."""
    return tuple(_CLASSES)


def make_policy(name: str, **parameters: Any) -> Policy:
    """The baseline called `name`, with its parameters if it has any.

    Raises:
        InvalidConfigError: no baseline has this name, or it has no such parameter or value.
        InvalidModelError: the model of a learned one cannot be used.
        MissingDependencyError: an optional package is needed.
    """
    if name not in _CLASSES:
        raise InvalidConfigError(
            f"unknown policy {name!r}; known: {', '.join(_CLASSES)}, or 'module:attribute' for a policy of your own"
        )
    module, attribute = _CLASSES[name].split(":")
    try:
        return getattr(importlib.import_module(module), attribute)(**parameters)
    except PolyExploreError:
        raise
    except (TypeError, ValueError) as error:
        raise InvalidConfigError(f"policy {name!r}: {error}") from error
