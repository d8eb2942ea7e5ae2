"""What a policy is, and how one is named: an own object, a baseline's name or an import string."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np

from polyexplore_gym.errors import InvalidConfigError


@runtime_checkable
class Policy(Protocol):
    """Chooses the next node from what the robot knows.

    A policy with a memory also has a method `reset()`, called before every episode; it must leave
    nothing behind of the episode before, or results depend on the order of episodes.
    """

    def act(self, observation: Mapping[str, np.ndarray], info: Mapping[str, Any], rng: np.random.Generator) -> int:
        """The node to drive to next: an index with `observation["action_mask"]` set; where none is, any index.

        Args:
            observation: as returned by the environment.
            info: as returned by the environment; the truth in it (coverage) is not for policies.
            rng: the only source of randomness, seeded for the episode.
        """
        ...


PolicySpec = str | Policy
"""A policy, or how to make one: see `load_policy`."""


def load_policy(spec: PolicySpec) -> Policy:
    """The policy that `spec` stands for.

    Args:
        spec: a policy (returned as it is), or a string: the name of a baseline (`"nearest"`), one
            with parameters (`"utility:rate=0.1"`, separated by commas), or where to import an own
            policy or a callable that makes one (`"package.module:attribute"`).

    Raises:
        InvalidConfigError: the string names nothing, or what it names is not a policy.
    """
    if not isinstance(spec, str):
        return _checked(spec, repr(spec))
    name, _, rest = spec.partition(":")
    if rest and "=" not in rest:
        return _imported(spec, name, rest)
    from baselines import make_policy  # on demand: baselines sit beside this package, not below it

    return _checked(make_policy(name, **_parameters(spec, rest)), spec)


def policy_label(spec: PolicySpec) -> str:
    """The name under which the policy's results are kept: the string, or the object's `name` or class."""
    return spec if isinstance(spec, str) else str(getattr(spec, "name", type(spec).__name__))


def _parameters(spec: str, text: str) -> dict[str, Any]:
    parameters: dict[str, Any] = {}
    for part in filter(None, text.split(",")):
        key, equals, value = part.partition("=")
        if not (equals and key.strip().isidentifier()):
            raise InvalidConfigError(f"policy {spec!r}: {part!r} is not of the form name=value")
        parameters[key.strip()] = _number(value.strip())
    return parameters


def _number(text: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text


def _imported(spec: str, module: str, attribute: str) -> Policy:
    try:
        found: Any = importlib.import_module(module)
        for name in attribute.split("."):
            found = getattr(found, name)
    except (ImportError, AttributeError) as error:
        raise InvalidConfigError(f"policy {spec!r} cannot be imported: {error}") from error
    if isinstance(found, type) or not hasattr(found, "act"):
        if not callable(found):
            raise InvalidConfigError(f"policy {spec!r}: neither a policy nor a callable that makes one")
        found = found()
    return _checked(found, spec)


def _checked(policy: Any, spec: str) -> Policy:
    if not callable(getattr(policy, "act", None)):
        raise InvalidConfigError(f"policy {spec}: has no method act(observation, info, rng)")
    return policy
