"""The record of one episode: what is kept of it, and its form as a line of JSON."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from polyexplore_gym.evaluation.setting import SENSING, Setting

THRESHOLDS = (90, 95, 99)
"""Percentages of coverage for which the distance is kept."""
STATUSES = ("complete", "unreached", "truncated", "failed")
_ACCEPTED: dict[type, tuple[type, ...]] = {float: (float, int), int: (int,), str: (str,)}

Key = tuple[str, str, str, str, int]
"""Policy, placement, sensing, plan hash, seed: what tells an episode from the others of its study."""
Pair = tuple[str, int]
"""Plan hash and seed: one start on one plan."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeRecord:
    """One episode. Records are equal when all but `timing` is equal."""

    policy: str
    """Name of the policy."""
    placement: str
    """Where nodes were placed: `midpoint` or `in_front`."""
    sensing: str
    """When the robot measured and decided: `stops`, `passing` or `moving` (`evaluation.setting.SENSING`)."""
    plan: str
    """Name of the floor plan."""
    plan_hash: str
    """Its `content_hash`."""
    group: str
    """Its building (`meta["group"]`, else the name and the hash): plans of one building are not independent."""
    stratum: str
    """Its kind or family (`meta["kind"]`, `meta["family"]`), within which buildings are resampled; may be empty."""
    seed: int
    """Seed of the environment's reset."""
    drive: str
    """`physics` or `kinematic`."""
    status: str
    """`complete` (nothing is left), `unreached` (ended by itself, but jump edges stayed out of reach or were given up),
    `truncated` (budget used up) or `failed` (an exception)."""
    error: str | None = None
    """The exception's type and text if failed."""
    distance: float = 0.0
    """Driven until the end, m."""
    coverage: float = 0.0
    """Share of the free area seen at the end, 0 to 1."""
    unreached: int = 0
    """Jump edges that could not be reached at the end."""
    unreached_length: float = 0.0
    """Their length, m."""
    given_up: int = 0
    """Jump edges measured or attempted in vain so often that they were given up."""
    given_up_length: float = 0.0
    """Their length, m."""
    distance_90: float | None = None
    """Driven at the first decision's end at which 90 % had been seen, m; None: never."""
    distance_95: float | None = None
    """As above, 95 %."""
    distance_99: float | None = None
    """As above, 99 %."""
    curve_distance: tuple[float, ...] = ()
    """Driven at the start and after each decision, m, to 0.1 mm."""
    curve_coverage: tuple[float, ...] = ()
    """Coverage there, to 1e-6."""
    decisions: int = 0
    """Actions taken."""
    ends: Mapping[str, int] = field(default_factory=dict, hash=False)
    """How many of their drives ended for which reason (`info["ended"]`), sorted by name."""
    measurements: int = 0
    """Scans taken."""
    sim_time: float = 0.0
    """Simulated time, s."""
    collisions: int = 0
    """Contacts with walls."""
    invalid_actions: int = 0
    """Masked nodes chosen."""
    cut_nodes: int = 0
    """Most nodes in one decision that did not fit into the observation."""
    cut_lines: int = 0
    """Most lines in one decision that did not fit into the observation."""
    reward: float = 0.0
    """Sum of the rewards."""
    timing: Mapping[str, float] = field(default_factory=dict, compare=False)
    """Wall clock, s: mean, median and maximum of `act`, and the whole episode. Differs from run to run."""

    @property
    def key(self) -> Key:
        """What tells the episode from the others of its study."""
        return self.policy, *self.setting, *self.pair

    @property
    def setting(self) -> Setting:
        """Placement and sensing."""
        return Setting(self.placement, self.sensing)

    @property
    def pair(self) -> Pair:
        """The start: what is paired when policies or settings are compared."""
        return self.plan_hash, self.seed

    @property
    def complete(self) -> bool:
        """Whether nothing is left."""
        return self.status == "complete"

    @property
    def ended(self) -> bool:
        """Whether the episode ended by itself, complete or not: only then does the distance mean anything."""
        return self.status in ("complete", "unreached")

    def to_json(self) -> str:
        """One line, without the line break."""
        return json.dumps(dataclasses.asdict(self), allow_nan=False, separators=(",", ":"))

    @classmethod
    def from_json(cls, text: str) -> EpisodeRecord:
        """The record of a line; raises ValueError saying what is wrong with it."""
        values = json.loads(text)
        if not isinstance(values, dict):
            raise ValueError("not a JSON object")
        names = {f.name for f in dataclasses.fields(cls)}
        if values.keys() != names:
            different = sorted(values.keys() ^ names)
            raise ValueError(f"field {different[0]!r} is {'missing' if different[0] in names else 'unknown'}")
        for name in ("curve_distance", "curve_coverage"):
            values[name] = tuple(_checked(name, v, float) for v in values[name])
        for f in dataclasses.fields(cls):
            kind = _KINDS.get(str(f.type))
            if kind is not None:
                values[f.name] = _checked(f.name, values[f.name], *kind)
        if not isinstance(values["ends"], dict):
            raise ValueError(f"field 'ends' is {values['ends']!r}, not an object")
        values["ends"] = {name: _checked("ends", count, int) for name, count in values["ends"].items()}
        for name, known in (("status", STATUSES), ("sensing", SENSING)):
            if values[name] not in known:
                raise ValueError(f"{name} is {values[name]!r}, not one of {', '.join(known)}")
        if len(values["curve_distance"]) != len(values["curve_coverage"]):
            raise ValueError("curve_distance and curve_coverage differ in length")
        if values["status"] in ("complete", "unreached") and not values["curve_distance"]:
            raise ValueError("curve_distance is empty though the episode ended by itself")
        return cls(**values)


_KINDS: dict[str, tuple[type, bool]] = {
    "str": (str, False),
    "int": (int, False),
    "float": (float, False),
    "str | None": (str, True),
    "float | None": (float, True),
}


def _checked(name: str, value: Any, kind: type, optional: bool = False) -> Any:
    if value is None and optional:
        return None
    if isinstance(value, bool) or not isinstance(value, _ACCEPTED[kind]):
        raise ValueError(f"field {name!r} is {value!r}, not of type {kind.__name__}")
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"field {name!r} is not finite")
    return kind(value)
