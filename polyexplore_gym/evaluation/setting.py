"""A setting: where nodes are placed and when the robot senses. What is compared beside policies, and grouped by."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

from polyexplore_gym.config import EnvConfig
from polyexplore_gym.errors import InvalidConfigError

SENSING = ("stops", "passing", "moving")
"""When the robot measures and decides: at nodes, where it stops; also measures in passing, but decides at nodes; both
on the way, `settled` unless the configuration says `interval` (`ExplorationConfig.scan_every` and `decide`)."""
FIELDS = ("placement", "scan_every", "decide")
"""Of `ExplorationConfig`: what a setting says."""
SCAN_EVERY = 0.5
"""Way between scans when the configuration names none, m."""


class Setting(NamedTuple):
    """One placement and one way to sense."""

    placement: str
    """`midpoint` or `in_front`."""
    sensing: str = "stops"
    """One of `SENSING`."""

    @classmethod
    def of(cls, config: EnvConfig) -> Setting:
        """The setting of an environment's configuration."""
        e = config.exploration
        sensing = "stops" if e.scan_every == 0 else "passing" if e.decide == "arrival" else "moving"
        return cls(e.placement, sensing)

    def configured(self, config: EnvConfig) -> EnvConfig:
        """The configuration in this setting; raises `InvalidConfigError` when there is none of its name."""
        if self.sensing not in SENSING:
            raise InvalidConfigError(f"sensing = {self.sensing!r}: must be one of {', '.join(SENSING)}")
        e = config.exploration
        decide = ("settled" if e.decide == "arrival" else e.decide) if self.sensing == "moving" else "arrival"
        every = 0.0 if self.sensing == "stops" else e.scan_every or SCAN_EVERY
        exploration = dataclasses.replace(e, placement=self.placement, scan_every=every, decide=decide)  # type: ignore[arg-type]
        return dataclasses.replace(config, exploration=exploration)

    def __str__(self) -> str:
        """The label: as in `midpoint`, or `midpoint, moving`; stops are not named."""
        return self.placement if self.sensing == "stops" else f"{self.placement}, {self.sensing}"
