"""What a training run is told: its method, its curriculum, and the settings of each part."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from baselines.learned.imitation import FitConfig
from baselines.learned.network import NetworkConfig
from polyexplore_gym.config import EnvConfig, from_mapping
from polyexplore_gym.errors import InvalidConfigError
from polyexplore_gym.floorplan import list_suites

Method = Literal["imitation", "reinforcement", "both"]


def _check(fine: bool, config: Any, name: str, message: str) -> None:
    if not fine:
        raise InvalidConfigError(f"{type(config).__name__}.{name} = {getattr(config, name)!r}: {message}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """A stage of the curriculum: where plans come from and how much is learned on them."""

    suites: str = "home-train"
    """Names of suites, separated by spaces; every episode draws one of them, then a plan of it."""
    largest: float = 1000.0
    """Plans of a larger area are left out, m2."""
    states: int = 2000
    """Imitation: states whose nodes are tried."""
    steps: int = 65_536
    """Reinforcement: decisions; rounded up to whole blocks."""

    def __post_init__(self) -> None:
        _check(bool(self.names), self, "suites", "names no suite")
        for name in self.names:
            _check(name in list_suites(), self, "suites", f"unknown suite {name!r}")
            _check(not name.endswith("-test"), self, "suites", "test suites are not for training")
        _check(self.largest >= 50, self, "largest", "must be at least 50 m2")
        _check(self.states >= 1, self, "states", "must be at least 1")
        _check(self.steps >= 1, self, "steps", "must be at least 1")

    @property
    def names(self) -> tuple[str, ...]:
        """The suites' names."""
        return tuple(self.suites.split())


@dataclass(frozen=True, slots=True, kw_only=True)
class RolloutConfig:
    """How states and the costs of their nodes are gathered."""

    tried: int = 4
    """Most nodes tried in a state."""
    per_episode: int = 8
    """States taken of an episode, about."""
    wander: float = 0.15
    """Probability of a step to another node, near ones more often."""
    shard: int = 50
    """States in a file; files are gathered in parallel."""

    def __post_init__(self) -> None:
        _check(self.tried >= 2, self, "tried", "must be at least 2")
        _check(self.per_episode >= 1, self, "per_episode", "must be at least 1")
        _check(0 <= self.wander <= 1, self, "wander", "must lie in 0 to 1")
        _check(self.shard >= 1, self, "shard", "must be at least 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class PPOConfig:
    """Settings of MaskablePPO. Rewards are metres in units of 8 m, negative."""

    environments: int = 8
    """Environments played at once."""
    horizon: int = 128
    """Decisions in each between two updates."""
    updates: int = 4
    """Updates in a block. Blocks start with new episodes and end with a checkpoint."""
    batch: int = 256
    """Decisions in a gradient step."""
    epochs: int = 4
    """Passes over the decisions of an update."""
    learning_rate: float = 3e-4
    """Of Adam."""
    gamma: float = 0.98
    """Discount of a decision."""
    gae_lambda: float = 0.95
    """Of the generalised advantage estimate."""
    clip: float = 0.2
    """Range in which the ratio of probabilities is rewarded."""
    entropy: float = 0.0
    """Scale of the entropy bonus."""
    sharpness: float = 10.0
    """Log-odds of two nodes for each unit of score between them."""
    most: int = 32
    """Reachable nodes offered, the nearest by path; the policy that results takes all."""
    warm_up: int = 1
    """First blocks of the method "both" in which only the value is learned, as imitation gives none."""

    def __post_init__(self) -> None:
        for name in ("environments", "updates", "batch", "epochs", "most"):
            _check(getattr(self, name) >= 1, self, name, "must be at least 1")
        _check(self.horizon >= 2, self, "horizon", "must be at least 2")
        _check(self.learning_rate > 0, self, "learning_rate", "must be positive")
        for name in ("gamma", "gae_lambda"):
            _check(0 < getattr(self, name) <= 1, self, name, "must lie in (0, 1]")
        _check(self.clip > 0, self, "clip", "must be positive")
        _check(self.entropy >= 0, self, "entropy", "must not be negative")
        _check(self.sharpness > 0, self, "sharpness", "must be positive")
        _check(self.warm_up >= 0, self, "warm_up", "must not be negative")

    @property
    def block(self) -> int:
        """Decisions in a block."""
        return self.environments * self.horizon * self.updates


@dataclass(frozen=True, slots=True, kw_only=True)
class ValidationConfig:
    """What the network is tried on while it trains: distances there, as a ratio to those of `nearest`."""

    suites: str = "home-validation angled-validation"
    """Names of suites, separated by spaces."""
    first: int = 10
    """So many plans of each."""
    blocks: int = 4
    """Reinforcement: validate after every so many blocks."""

    def __post_init__(self) -> None:
        _check(bool(self.names), self, "suites", "names no suite")
        for name in self.names:
            _check(name in list_suites(), self, "suites", f"unknown suite {name!r}")
            _check(not name.endswith("-test"), self, "suites", "test suites are for the end")
        _check(1 <= self.first <= 30, self, "first", "must lie in 1 to 30")
        _check(self.blocks >= 1, self, "blocks", "must be at least 1")

    @property
    def names(self) -> tuple[str, ...]:
        """The suites' names."""
        return tuple(self.suites.split())


_ENVIRONMENT: dict[str, dict[str, Any]] = {"drive": {"mode": "kinematic"}, "exploration": {"placement": "in_front"}}


def _environment() -> EnvConfig:
    return from_mapping(EnvConfig, _ENVIRONMENT)


CURRICULUM = (
    Stage(suites="home-train", states=3000, steps=131_072),
    Stage(suites="home-train angled-train", states=3000, steps=131_072),
    Stage(suites="home-train angled-train office-train", states=2000, steps=131_072),
)
"""From homes to offices."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """A training run; its result depends on this and on nothing else."""

    method: Method = "imitation"
    """Regression on roll-outs, MaskablePPO, or the one and then the other."""
    seed: int = 0
    """Of everything."""
    stages: tuple[Stage, ...] = CURRICULUM
    """The curriculum; each method runs through it in this order."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    """Sizes of the network."""
    rollouts: RolloutConfig = field(default_factory=RolloutConfig)
    """Imitation: how states are gathered."""
    fit: FitConfig = field(default_factory=FitConfig)
    """Imitation: how the regression goes."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Reinforcement."""
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    """What is watched meanwhile."""
    env: EnvConfig = field(default_factory=_environment)
    """The environment; kinematic unless said otherwise."""

    def __post_init__(self) -> None:
        _check(self.method in get_args(Method), self, "method", f"must be one of {', '.join(get_args(Method))}")
        _check(self.seed >= 0, self, "seed", "must not be negative")
        _check(len(self.stages) > 0, self, "stages", "there must be at least one")
        _check(self.env.observation.pairwise, self.env.observation, "pairwise", "the network needs the path lengths")
        _check(not self.env.observation.relative, self.env.observation, "relative", "must be False")


def train_config(values: Mapping[str, Any], path: str = "config") -> TrainConfig:
    """The configuration in nested mappings; `stages` is a list of them, and fields of `env` left out stay as they are.

    Raises:
        InvalidConfigError: a field is unknown, of the wrong type or out of range.
    """
    if not isinstance(values, Mapping):
        raise InvalidConfigError(f"{path}: expected a mapping, got {type(values).__name__}")
    values = dict(values)
    stages = values.pop("stages", None)
    base: dict[str, Any] = dict(_ENVIRONMENT)
    env = values.pop("env", {})
    if not isinstance(env, Mapping):
        raise InvalidConfigError(f"{path}.env: expected a mapping, got {type(env).__name__}")
    for key, value in env.items():
        inner = base.get(key)
        base[key] = {**inner, **value} if isinstance(inner, dict) and isinstance(value, Mapping) else value
    values["env"] = base
    config = from_mapping(TrainConfig, values, path)
    if stages is None:
        return config
    if not isinstance(stages, (list, tuple)):
        raise InvalidConfigError(f"{path}.stages: expected a list, got {type(stages).__name__}")
    found = tuple(from_mapping(Stage, stage, f"{path}.stages[{i}]") for i, stage in enumerate(stages))
    return dataclasses.replace(config, stages=found)


def read_train_config(path: Path) -> TrainConfig:
    """The configuration in a JSON file.

    Raises:
        InvalidConfigError: it cannot be read, or something in it is wrong.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidConfigError(f"{path}: cannot be read: {error}") from error
    return train_config(values, str(path))
