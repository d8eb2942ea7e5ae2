"""Configuration: frozen dataclasses, one per subject. The same docstrings make the CLI's help."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

from polyexplore_gym.errors import InvalidConfigError


def _require(ok: bool, owner: object, name: str, reason: str) -> None:
    if not ok:
        value = getattr(owner, name)
        raise InvalidConfigError(f"{type(owner).__name__}.{name} = {value!r}: {reason}")


def _require_finite(owner: object) -> None:
    for f in dataclasses.fields(owner):  # type: ignore[arg-type]
        value = getattr(owner, f.name)
        if isinstance(value, float):
            _require(math.isfinite(value), owner, f.name, "must be finite")


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorConfig:
    """The 2D laser. Defaults: SICK LMS 200 in its 8 m mode."""

    beams: int = 361
    """Number of beams in a scan."""
    field_of_view: float = math.pi
    """Angle between the first and the last beam, rad, up to 2 pi (then the last neighbours the first)."""
    max_range: float = 8.0
    """Range beyond which a beam has no return, m."""
    sigma_range: float = 0.01
    """Standard deviation of the range noise, m."""
    sigma_angle: float = math.radians(0.1)
    """Standard deviation of the beam angle noise, rad."""

    def __post_init__(self) -> None:
        _require_finite(self)
        _require(3 <= self.beams <= 100_000, self, "beams", "must lie in 3 to 100000")
        _require(0 < self.field_of_view <= 2 * math.pi + 1e-9, self, "field_of_view", "must lie in (0, 2 pi]")
        _require(self.max_range > 0, self, "max_range", "must be positive")
        _require(self.sigma_range >= 0, self, "sigma_range", "must not be negative")
        _require(self.sigma_angle >= 0, self, "sigma_angle", "must not be negative")

    @property
    def full_circle(self) -> bool:
        """Whether the field of view closes, so that the last beam neighbours the first."""
        return self.field_of_view >= 2 * math.pi - 1e-9

    @property
    def resolution(self) -> float:
        """Angle between neighbouring beams, rad."""
        return self.field_of_view / (self.beams if self.full_circle else self.beams - 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotConfig:
    """The robot's body and drive. Defaults: Pioneer 3-DX (MobileRobots data sheet and firmware)."""

    radius: float = 0.25
    """Radius of the disc body, m."""
    track: float = 0.331
    """Distance between the wheels, m."""
    max_speed: float = 1.2
    """Largest forward speed, m/s (data sheet)."""
    max_turn_rate: float = math.radians(180.0)
    """Largest turn rate, rad/s (data sheet: 300 degrees/s; a laser on top wants less)."""
    max_acceleration: float = 0.6
    """Largest forward acceleration and deceleration, m/s2."""
    max_turn_acceleration: float = math.radians(300.0)
    """Largest angular acceleration, rad/s2."""

    def __post_init__(self) -> None:
        _require_finite(self)
        for f in dataclasses.fields(self):
            _require(getattr(self, f.name) > 0, self, f.name, "must be positive")


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveConfig:
    """How the robot gets to a node."""

    mode: Literal["physics", "kinematic"] = "physics"
    """`physics`: wheels and contact with walls; `kinematic`: along the path, without dynamics, for training."""
    time_step: float = 0.04
    """Fixed step of the physics, s."""
    time_limit: float = 600.0
    """A drive that takes longer (s of simulated time) is given up where it stands."""

    def __post_init__(self) -> None:
        _require_finite(self)
        _require(self.mode in ("physics", "kinematic"), self, "mode", "must be 'physics' or 'kinematic'")
        _require(0 < self.time_step <= 0.2, self, "time_step", "must lie in (0, 0.2]")
        _require(self.time_limit > 0, self, "time_limit", "must be positive")


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseConfig:
    """What the robot knows of its own pose."""

    mode: Literal["exact", "gaussian", "odometry", "slam"] = "exact"
    """`exact`; `gaussian`: an external localiser with an error per measurement; `odometry`: drift along the path;
    `slam`: the same drift, corrected before every measurement by the walls known already."""
    sigma_xy: float = 0.02
    """gaussian: standard deviation of x and of y, m."""
    sigma_heading: float = math.radians(0.5)
    """gaussian: standard deviation of the heading, rad."""
    drift_distance: float = 0.02
    """odometry, slam: standard deviation of the position drift per metre driven, m at 1 m (grows with the root)."""
    drift_heading: float = math.radians(1.0)
    """odometry, slam: standard deviation of the heading drift per metre driven, rad at 1 m (grows with the root)."""
    drift_turn: float = 0.01
    """odometry, slam: standard deviation of the heading drift per radian turned, rad at 1 rad (grows with the root)."""

    correct_every: float = 0.5
    """slam: also correct the pose by a scan every so many metres of the way, or radians turned; these scans go into no
    map. 0: only by the measurements themselves."""

    def __post_init__(self) -> None:
        _require_finite(self)
        modes = ("exact", "gaussian", "odometry", "slam")
        _require(self.mode in modes, self, "mode", "must be exact, gaussian, odometry or slam")
        for name in ("sigma_xy", "sigma_heading", "drift_distance", "drift_heading", "drift_turn"):
            _require(getattr(self, name) >= 0, self, name, "must not be negative")
        ok = self.correct_every == 0 or self.correct_every >= 0.1
        _require(ok, self, "correct_every", "must be 0 or at least 0.1")


@dataclass(frozen=True, slots=True, kw_only=True)
class MappingConfig:
    """From scans to lines (see `polyexplore_gym.mapping`)."""

    start: Literal["endpoint", "hough"] = "endpoint"
    """Initial guess of the lines: iterative end-point fit, or the probabilistic Hough transform."""
    grouping: bool = True
    """Make one of the lines of a scan that lie on one wall; False: keep all that the start finds (for comparison)."""
    min_points: int = 6
    """Fewest returns on a line."""
    min_length: float = 0.25
    """Shortest line, m."""
    merge_gate: float = 9.21
    """Chi-square gate (2 degrees of freedom) of the merge test; the paper's 3 keeps only 78 % of true pairs."""
    door_width: float = 0.5
    """A gap along a line that is wider is not bridged, m."""
    range_floor: float = 0.0
    """Smallest standard deviation of range assumed in the fit, m (real logs: 0.005 to 0.01)."""

    def __post_init__(self) -> None:
        _require_finite(self)
        _require(self.start in ("endpoint", "hough"), self, "start", "must be 'endpoint' or 'hough'")
        _require(self.min_points >= 3, self, "min_points", "must be at least 3")
        for name in ("min_length", "merge_gate", "door_width"):
            _require(getattr(self, name) > 0, self, name, "must be positive")
        _require(self.range_floor >= 0, self, "range_floor", "must not be negative")


@dataclass(frozen=True, slots=True, kw_only=True)
class ExplorationConfig:
    """Jump edges, nodes, paths and the end of an exploration."""

    placement: Literal["midpoint", "in_front"] = "midpoint"
    """Node on the middle of the jump edge (the paper), or in front of it on its known side (Ekman)."""
    front_distance: float = 1.0
    """in_front: distance of the node from the jump edge, m, less where the sampling condition asks for it."""
    samples: int = 6
    """in_front: fewest beams that must fall on the jump edge (DESIGN: 2 without noise, 6 with)."""
    min_gap: float | None = None
    """Shortest jump edge of interest, m; None: the robot's diameter."""
    look_around: bool = True
    """Measure all round at the start by turning on the spot (a 180 degree sensor scans twice)."""
    scan_every: float = 0.0
    """Also measure every so many metres of the way, m; 0: at nodes only (the paper)."""
    max_visits: int = 2
    """A jump edge measured or attempted in vain this often is given up."""

    def __post_init__(self) -> None:
        _require_finite(self)
        _require(self.placement in ("midpoint", "in_front"), self, "placement", "must be 'midpoint' or 'in_front'")
        _require(self.front_distance > 0, self, "front_distance", "must be positive")
        _require(self.samples >= 1, self, "samples", "must be at least 1")
        _require(self.min_gap is None or self.min_gap > 0, self, "min_gap", "must be positive or None")
        _require(self.scan_every == 0 or self.scan_every >= 0.1, self, "scan_every", "must be 0 or at least 0.1")
        _require(self.max_visits >= 1, self, "max_visits", "must be at least 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservationConfig:
    """Sizes of the padded observation arrays."""

    max_nodes: int = 64
    """Nodes (and so actions); what does not fit is cut, the farthest by path first."""
    max_lines: int = 512
    """Line segments; what does not fit is cut, the farthest from the robot first."""
    relative: bool = False
    """Give positions and headings in the robot's frame instead of the map frame."""
    pairwise: bool = True
    """Fill the matrix of path lengths between nodes (the scripted criteria do not need it)."""

    def __post_init__(self) -> None:
        _require(self.max_nodes >= 1, self, "max_nodes", "must be at least 1")
        _require(self.max_lines >= 1, self, "max_lines", "must be at least 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class RewardConfig:
    """Scales of the reward's terms; each term is reported in `info["rewards"]`."""

    distance: float = -1.0
    """Per metre driven."""
    coverage: float = 0.0
    """Per share of the free area newly seen (all of it: 1)."""
    measurement: float = 0.0
    """Per measurement."""
    collision: float = 0.0
    """Per bump."""
    completion: float = 0.0
    """Once, when nothing is left to explore."""
    invalid_action: float = -1.0
    """Per masked action chosen."""

    def __post_init__(self) -> None:
        _require_finite(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvConfig:
    """Everything that defines an environment beside its floor plans."""

    sensor: SensorConfig = field(default_factory=SensorConfig)
    """The laser."""
    robot: RobotConfig = field(default_factory=RobotConfig)
    """The robot."""
    drive: DriveConfig = field(default_factory=DriveConfig)
    """Physics or kinematic."""
    pose: PoseConfig = field(default_factory=PoseConfig)
    """Pose error."""
    mapping: MappingConfig = field(default_factory=MappingConfig)
    """Line map."""
    exploration: ExplorationConfig = field(default_factory=ExplorationConfig)
    """Jump edges and nodes."""
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    """Observation arrays."""
    reward: RewardConfig = field(default_factory=RewardConfig)
    """Reward scales."""
    max_decisions: int = 2000
    """Decisions after which an episode is truncated."""

    def __post_init__(self) -> None:
        _require(self.max_decisions >= 1, self, "max_decisions", "must be at least 1")


T = TypeVar("T")


def from_mapping(cls: type[T], values: Mapping[str, Any], path: str = "config") -> T:
    """Build a config dataclass from nested mappings; unknown keys and wrong types raise.

    Raises `InvalidConfigError` naming the full path of the offending field.
    """
    if not isinstance(values, Mapping):
        raise InvalidConfigError(f"{path}: expected a mapping, got {type(values).__name__}")
    hints = typing.get_type_hints(cls)
    unknown = sorted(str(k) for k in values if k not in hints)
    if unknown:
        raise InvalidConfigError(f"{path}: unknown field {unknown[0]!r}; known: {', '.join(sorted(hints))}")
    kwargs = {key: _coerce(hints[key], value, f"{path}.{key}") for key, value in values.items()}
    return cls(**kwargs)


def _coerce(hint: Any, value: Any, path: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return value if isinstance(value, hint) else from_mapping(hint, value, path)  # type: ignore[arg-type]
    options = typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)
    if typing.get_origin(hint) is Literal:
        options = (str,)
    if value is None and type(None) in options:
        return None
    for option in options:
        if option is float and isinstance(value, (int, float)) and not isinstance(value, bool):
            return float(value)
        if option in (int, str, bool) and type(value) is option:
            return value
    names = " or ".join(getattr(o, "__name__", str(o)) for o in options)
    raise InvalidConfigError(f"{path} = {value!r}: expected {names}")


def to_mapping(config: Any) -> dict[str, Any]:
    """The config as nested plain dictionaries, fit for JSON."""
    return dataclasses.asdict(config)
