"""Configuration: frozen dataclasses, one per subject. The same docstrings make the CLI's help."""

from __future__ import annotations

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

from polyexplore_gym.errors import InvalidConfigError
from polyexplore_gym.presets import PRESETS

LONGEST = 1e5
"""Bound of every range, and of every position and length in the observation, m."""
MOST_BEAMS = 20_000
"""The finest scanners have 0.02 degrees. Every scan is kept, at 32 bytes a beam: 2,000 scans then take 1.3 GB."""
LARGEST_ARRAY = 2**26
"""Bytes of an array in the observation, which is copied at every step."""
NARROWEST_VIEW = 10.0
"""Least field of view to explore with, degrees: looking around takes 36 turns and scans then."""
WIDEST_STEP = 15.0
"""Largest angle between two beams to explore with, degrees: at four of its diameters the robot fits between them."""


def _require(ok: bool, owner: object, name: str, reason: str) -> None:
    if not ok:
        value = getattr(owner, name)
        raise InvalidConfigError(f"{type(owner).__name__}.{name} = {value!r}: {reason}")


def _check_types(owner: object) -> None:
    """Fields get their own types (numpy's numbers become Python's); others, and numbers that are not finite, raise."""
    for name, hint in _hints(type(owner)).items():  # type: ignore[arg-type]
        value = _coerce(hint, getattr(owner, name), f"{type(owner).__name__}.{name}")
        object.__setattr__(owner, name, value)
        _require(not isinstance(value, float) or math.isfinite(value), owner, name, "must be finite")


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
        _check_types(self)
        _require(3 <= self.beams <= MOST_BEAMS, self, "beams", f"must lie in 3 to {MOST_BEAMS}")
        _require(0 < self.field_of_view <= 2 * math.pi + 1e-9, self, "field_of_view", "must lie in (0, 2 pi]")
        _require(0 < self.max_range <= LONGEST, self, "max_range", f"must lie in (0, {LONGEST:g}] m")
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
    mass: float = 9.0
    """Mass, kg (data sheet), 0.001 to 1,000,000: of the body that pymunk holds off the walls. The impulses of a contact
    are in proportion to it; the way is not, since wheels do not slip and walls are fixed and neither rub nor bounce."""

    def __post_init__(self) -> None:
        _check_types(self)
        for f in dataclasses.fields(self):
            _require(getattr(self, f.name) > 0, self, f.name, "must be positive")
        _require(1e-3 <= self.mass <= 1e6, self, "mass", "must lie in [0.001, 1e6] kg")


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
        _check_types(self)
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
        _check_types(self)
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
    min_length: float | None = None
    """Shortest line, m; None: half a door's width."""
    merge_gate: float = 9.21
    """Chi-square gate (2 degrees of freedom) of the merge test; the paper's 3 keeps only 78 % of true pairs."""
    door_width: float | None = None
    """A gap along a line that is wider is not bridged, m; None: the robot's diameter, without a robot 0.5. Lengths that
    decide in the map (what covers, joins, is too short) are shares of it."""
    range_floor: float = 0.0
    """Smallest standard deviation of range assumed in the fit, m (real logs: 0.005 to 0.01)."""
    straightness: float = 0.0
    """Smallest standard deviation of a wall about its line that the map reports, m; what scans show to be more uneven
    is found by itself. A drawing in whole millimetres, seen in hundreds of scans, wants 0.0003."""

    def __post_init__(self) -> None:
        _check_types(self)
        _require(self.start in ("endpoint", "hough"), self, "start", "must be 'endpoint' or 'hough'")
        _require(self.min_points >= 3, self, "min_points", "must be at least 3")
        _require(self.merge_gate > 0, self, "merge_gate", "must be positive")
        for name in ("min_length", "door_width"):
            value = getattr(self, name)
            _require(value is None or value > 0, self, name, "must be positive or None")
        _require(self.range_floor >= 0, self, "range_floor", "must not be negative")
        _require(self.straightness >= 0, self, "straightness", "must not be negative")

    def resolved(self, radius: float = 0.25) -> MappingConfig:
        """The same with numbers for all that is None, for a robot of `radius` m."""
        if self.door_width is not None and self.min_length is not None:
            return self
        door = 2.0 * radius if self.door_width is None else self.door_width
        return dataclasses.replace(
            self, door_width=door, min_length=0.5 * door if self.min_length is None else self.min_length
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ExplorationConfig:
    """Jump edges, nodes, paths and the end of an exploration."""

    placement: Literal["midpoint", "in_front"] = "midpoint"
    """Node on the middle of the jump edge (the paper), or in front of it on its known side (Ekman)."""
    front_distance: float | None = None
    """in_front: distance of the node from the jump edge, m, less where the sampling condition asks for it, and half the
    sensor's range at most; None: four radii of the robot."""
    samples: int = 6
    """in_front: fewest beams that must fall on the jump edge (Ekman: 2 without noise, 6 with)."""
    gain: Literal["whole", "visible"] = "whole"
    """Angle of another jump edge that counts for a node's gain: the whole of it if its middle is visible (the paper),
    or that of its visible parts."""
    min_gap: float | None = None
    """Shortest jump edge of interest, m; None: the robot's diameter."""
    look_around: bool = True
    """Measure all round at the start by turning on the spot (a 180 degree sensor scans twice)."""
    scan_every: float = 0.0
    """Also measure every so many metres of the way, m, without stopping, and while turning as often as the field of
    view asks for; 0: at nodes only (the paper)."""
    decide: Literal["arrival", "settled", "interval"] = "arrival"
    """When the next node is chosen. `arrival`: at the node (the paper). `settled`: also on the way, as soon as a scan
    has shown what the node was for. `interval`: also every `decide_every` metres. But for `arrival` the robot drives no
    faster than lets it halt within `scan_every`: what it has learnt then comes in time. It slows down and looks again
    where its disc would enter what no scan has shown."""
    decide_every: float = 1.0
    """interval: the node is chosen anew every so many metres of the way, m, at the next scan."""
    max_visits: int = 2
    """A jump edge measured or attempted in vain this often is given up."""

    def __post_init__(self) -> None:
        _check_types(self)
        _require(self.placement in ("midpoint", "in_front"), self, "placement", "must be 'midpoint' or 'in_front'")
        _require(self.gain in ("whole", "visible"), self, "gain", "must be 'whole' or 'visible'")
        ok = self.front_distance is None or self.front_distance > 0
        _require(ok, self, "front_distance", "must be positive or None")
        _require(self.samples >= 1, self, "samples", "must be at least 1")
        _require(self.min_gap is None or self.min_gap > 0, self, "min_gap", "must be positive or None")
        _require(self.scan_every == 0 or self.scan_every >= 0.01, self, "scan_every", "must be 0 or at least 0.01")
        known = ("arrival", "settled", "interval")
        _require(self.decide in known, self, "decide", "must be 'arrival', 'settled' or 'interval'")
        needs = f"{self.decide!r} needs scans on the way: give scan_every, such as 0.5"
        _require(self.decide == "arrival" or self.scan_every > 0, self, "decide", needs)
        _require(self.decide_every > 0, self, "decide_every", "must be positive")
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
        _check_types(self)
        for name, most, what in (
            ("max_nodes", math.isqrt(LARGEST_ARRAY // 4), "the matrix of path lengths"),
            ("max_lines", LARGEST_ARRAY // (4 * 9), "the lines"),
        ):
            _require(getattr(self, name) >= 1, self, name, "must be at least 1")
            reason = f"must be at most {most}: {what} would take more than {LARGEST_ARRAY >> 20} MB"
            _require(getattr(self, name) <= most, self, name, reason)


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
        _check_types(self)


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
        _check_types(self)
        _require(self.max_decisions >= 1, self, "max_decisions", "must be at least 1")
        self._check_sight()

    def _check_sight(self) -> None:
        """A sensor by itself, as that of a log, may be narrow or short-sighted; one to explore with may not."""
        sensor, least, most = self.sensor, 1.5 * self.robot.radius, 0.1 * self.sensor.max_range
        view, step = math.degrees(sensor.field_of_view), math.degrees(sensor.resolution)
        for name, ok, reason in (
            ("field_of_view", view > NARROWEST_VIEW - 1e-6,
             f"must be at least {NARROWEST_VIEW:g} degrees; looking around would take {360 / view:.0f} turns"),
            ("beams", step < WIDEST_STEP + 1e-6,
             f"lie {step:.3g} degrees apart, must be at most {WIDEST_STEP:g}, or the robot fits between two of them"),
            ("max_range", sensor.max_range >= least,
             f"must be at least {least:.3g} m, 1.5 times robot.radius: beside its body the robot must see where to go"),
            ("sigma_range", sensor.sigma_range <= most, f"must be at most {most:.3g} m, a tenth of max_range"),
            ("sigma_angle", sensor.sigma_angle <= 0.1,
             "must be at most 0.1 rad (5.7 degrees): the fit of lines takes it as small"),
        ):  # fmt: skip
            if not ok:
                raise InvalidConfigError(f"EnvConfig.sensor.{name} = {getattr(sensor, name)!r}: {reason}")


T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanFileConfig:
    """How a file of a floor plan is read."""

    units: str | None = None
    """Units of a .json, .geojson, .dxf or .svg: m, cm, mm, in, ft, a number (metres a unit), or deg (GeoJSON only);
    instead of what the file says."""
    tolerance: float | None = None
    """Greatest deviation by simplification of a robot map, m (default: a pixel), and of a drawing's curves (0.01)."""
    walls: Literal["outline", "areas", "lines"] = "outline"
    """Drawings: closed lines are the outline of the floor and of obstacles, or of walls, or lines are walls."""
    wall_thickness: float | None = None
    """Thickness of lines that are walls, m: of GeoJSON (0: they and points are left out), of drawings (default 0.1)."""
    layers: tuple[str, ...] = ()
    """Drawings: only what is on these layers or in these colours (names, DXF colour numbers, #rrggbb)."""
    doors: tuple[str, ...] = ()
    """Drawings: layers or colours of doors, which are opened."""
    snap: float = 0.01
    """Drawings: ends of lines closer than this meet, m."""
    strict: bool = False
    """Refuse a plan of which a part must be left out since the robot cannot reach it."""

    def __post_init__(self) -> None:
        _require(self.walls in ("outline", "areas", "lines"), self, "walls", "must be outline, areas or lines")
        for name, least in (("tolerance", 0.0), ("wall_thickness", 0.0), ("snap", 0.0)):
            value = getattr(self, name)
            ok = value is None or (isinstance(value, (int, float)) and math.isfinite(value) and least <= value <= 10.0)
            _require(ok, self, name, "must be a finite number of metres in 0 to 10")


def from_mapping(cls: type[T], values: Mapping[str, Any], path: str = "config") -> T:
    """Build a config dataclass from nested mappings; unknown keys and wrong types raise.

    That of an `EnvConfig` may hold `"preset": name` (see `preset`); its other fields go before those of the preset.

    Raises `InvalidConfigError` naming the full path of the offending field.
    """
    if not isinstance(values, Mapping):
        raise InvalidConfigError(f"{path}: expected a mapping, got {type(values).__name__}")
    hints = _hints(cls)  # type: ignore[arg-type]
    if cls is EnvConfig and "preset" in values:
        values = _with_preset(values, path)
    unknown = sorted(str(k) for k in values if k not in hints)
    if unknown:
        raise InvalidConfigError(f"{path}: unknown field {unknown[0]!r}; known: {', '.join(sorted(hints))}")
    kwargs = {key: _built(hints[key], value, f"{path}.{key}") for key, value in values.items()}
    return cls(**kwargs)


def preset(name: str) -> EnvConfig:
    """The configuration of a robot and its sensor by name: see `polyexplore_gym.presets`.

    Raises `InvalidConfigError` listing the names if there is none of this one.
    """
    return from_mapping(EnvConfig, {"preset": name})


def _with_preset(values: Mapping[str, Any], path: str) -> dict[str, Any]:
    """The mapping with the fields of its preset filled in where it says nothing itself."""
    rest = dict(values)
    name = rest.pop("preset")
    if not isinstance(name, str) or name not in PRESETS:
        raise InvalidConfigError(f"{path}.preset = {name!r}: unknown; known: {', '.join(PRESETS)}")
    for part, fields in PRESETS[name].items():  # type: ignore[index]
        given = rest.get(part, {})
        rest[part] = {**fields, **given} if isinstance(given, Mapping) else given
    return rest


@functools.cache
def _hints(cls: type) -> dict[str, Any]:
    """The types of a class's fields by name."""
    return typing.get_type_hints(cls)


def _built(hint: Any, value: Any, path: str) -> Any:
    """The value of a field; a config within one may be a mapping."""
    if dataclasses.is_dataclass(hint) and not isinstance(value, hint):  # type: ignore[arg-type]
        return from_mapping(hint, value, path)  # type: ignore[arg-type]
    return _coerce(hint, value, path)


def _coerce(hint: Any, value: Any, path: str) -> Any:
    """The value as the field's type says; numpy's scalars are numbers like any other."""
    if dataclasses.is_dataclass(hint) and isinstance(value, hint):  # type: ignore[arg-type]
        return value
    if hasattr(value, "dtype") and getattr(value, "shape", None) == ():
        value = value.item()
    options = typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)
    if typing.get_origin(hint) is Literal:
        options = (str,)
    if value is None and type(None) in options:
        return None
    for option in options:
        if option is float and isinstance(value, (int, float)) and not isinstance(value, bool):
            return _float(value)
        if option in (int, str, bool) and type(value) is option:
            return value
    names = " or ".join(getattr(o, "__name__", str(o)) for o in options)
    raise InvalidConfigError(f"{path} = {value!r}: expected {names}")


def _float(value: float) -> float:
    try:
        return float(value)
    except OverflowError:  # a whole number of more than 308 digits
        return math.inf


def to_mapping(config: Any) -> dict[str, Any]:
    """The config as nested plain dictionaries, fit for JSON."""
    return dataclasses.asdict(config)
