"""The reward: named pure terms of what one step did, times their scales."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from polyexplore_gym.config import RewardConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class StepOutcome:
    """What a step did, in the units of the reward's terms (one field a term)."""

    distance: float = 0.0
    """Driven, m."""
    coverage: float = 0.0
    """Share of the free area newly seen."""
    measurement: float = 0.0
    """Measurements taken."""
    collision: float = 0.0
    """Bumps."""
    completion: float = 0.0
    """1 when nothing is left to explore."""
    invalid_action: float = 0.0
    """1 when a masked action was chosen."""


def rewards(outcome: StepOutcome, scales: RewardConfig) -> dict[str, float]:
    """Each term of the reward, scaled; the reward is their sum."""
    return {f.name: float(getattr(scales, f.name) * getattr(outcome, f.name)) for f in dataclasses.fields(StepOutcome)}
