"""The command line `polyexplore`. Thin: it finds plans, calls the library and prints.

The library is imported by the command that needs it, so that `--help` is quick.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from polyexplore_gym.config import EnvConfig, PlanFileConfig, from_mapping, to_mapping
from polyexplore_gym.errors import (
    InvalidConfigError,
    InvalidFloorPlanError,
    InvalidLogError,
    MissingDependencyError,
    PolyExploreError,
)
from polyexplore_gym.presets import PresetName

if TYPE_CHECKING:
    from polyexplore_gym.config import MappingConfig, SensorConfig
    from polyexplore_gym.evaluation import EpisodeRecord, PolicySpec, Study, Summary
    from polyexplore_gym.floorplan import FloorPlan
    from polyexplore_gym.mapping import LaserLog, LogMap, Track
    from polyexplore_gym.snapshot import Snapshot

BENCH_PLANS = {"home-test": 16, "angled-test": 4, "office-test": 2}
"""What `polyexplore bench` runs on unless told otherwise: so many of the first plans of these suites.

With `COMPARED`, both placements and both ways to sense the episodes then take about two minutes on two cores.
"""
SCRIPTED = ("nearest", "largest", "ekman_ratio", "modified_sum", "utility", "distance_advantage", "random")
"""The criteria, which look at nodes one by one (`distance_advantage` at their distances)."""
COMPARED = ("nearest", "ekman_ratio", "modified_sum", "utility", "distance_advantage")
"""What `polyexplore bench` compares unless told otherwise: the others' ways are two to five times as long."""
LOOK_AHEAD = ("tour", "watchman", "rollout")
"""Planners that look at the way over all nodes."""

SHOWN = 10
"""So many broken parts of a log are named, the rest is counted."""

FOLDER_SUFFIXES = (".json", ".geojson", ".yaml", ".yml", ".dxf")
"""What is taken for a plan in a folder; .svg is not, since pictures are."""

Placement = Literal["midpoint", "in_front"]
Sensing = Literal["stops", "passing", "moving"]
Drive = Literal["physics", "kinematic"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """Compare policies on the same plans, starts and noise; prints tables, keeps results and plots.

    A run that was stopped goes on where it was when it is started again with the same arguments.
    """

    suite: tuple[str, ...] = ()
    """Suites of generated plans, such as home-test or office-validation (default: a mix that takes minutes)."""
    plans: tuple[Path, ...] = ()
    """Plan files, or folders of them, instead of suites."""
    first: int | None = None
    """Only the first so many plans, of each suite."""
    policies: tuple[str, ...] = COMPARED
    """Names of baselines, with parameters as in utility:rate=0.1, or module:attribute for an own policy."""
    placements: tuple[Placement, ...] = ("midpoint", "in_front")
    """Where nodes are placed."""
    sensing: tuple[Sensing, ...] = ("stops", "moving")
    """When the robot measures and decides: at nodes, where it stops; also measures in passing, but decides at nodes; or
    both on the way. Scans on the way lie 0.5 m apart unless the configuration names another exploration.scan_every."""
    seeds: int = 1
    """Starts (and streams of noise) on each plan."""
    workers: int = 0
    """Processes; 0: one a core."""
    backend: Literal["loky", "ray"] = "loky"
    """Where episodes run: in processes of this machine, or on a Ray cluster."""
    address: str | None = None
    """Address of a running Ray cluster (auto, or host:port), all cores of which are used; else one is started here."""
    out: Path = Path("results/bench")
    """Folder of the results."""
    drive: Drive | None = None
    """How the robot drives, instead of what the configuration says."""
    preset: PresetName | None = None
    """Robot and sensor by name; fields of --config go before those of the preset."""
    config: Path | None = None
    """JSON file with fields of the environment's configuration, as in {"sensor": {"max_range": 30}}."""
    reference: str = "nearest"
    """Policy that the others are compared with."""
    bounds: Path | None = None
    """Folder of references that know the plans (those missing are computed, a minute each): adds ratios to them."""
    plots: bool = True
    """Draw the plots."""
    reading: tyro.conf.OmitArgPrefixes[PlanFileConfig] = field(default_factory=PlanFileConfig)


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """Explore one plan with one policy; prints a summary, and films it if asked to."""

    plan: tyro.conf.Positional[str]
    """A plan file, or a plan of a suite: home-test/3."""
    policy: str = "nearest"
    """Name of a baseline, or module:attribute for an own policy."""
    seed: int = 0
    """Seed of the start and the noise."""
    start: tuple[float, float, float] | None = None
    """Start: x and y in m, heading in degrees; drawn from the seed if left out."""
    placement: Placement | None = None
    """Where nodes are placed, instead of what the configuration says."""
    sensing: Sensing | None = None
    """When the robot measures and decides (see bench), instead of what the configuration says."""
    drive: Drive | None = None
    """How the robot drives, instead of what the configuration says."""
    preset: PresetName | None = None
    """Robot and sensor by name; fields of --config go before those of the preset."""
    config: Path | None = None
    """JSON file with fields of the environment's configuration."""
    gif: Path | None = None
    """Film the exploration to this .gif file."""
    mp4: Path | None = None
    """Film the exploration to this .mp4 file."""
    png: Path | None = None
    """Draw the end of it to this .png, .pdf or .svg file."""
    width: int = 800
    """Width of the pictures, pixels."""
    step: float = 0.5
    """Film: a frame every so many metres as well; 0: decisions only."""
    fps: float = 10.0
    """Film: frames a second."""
    reading: tyro.conf.OmitArgPrefixes[PlanFileConfig] = field(default_factory=PlanFileConfig)


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Read a floor plan file, say what a robot can reach of it, and write it in other formats."""

    plan: tyro.conf.Positional[str]
    """A plan file, or a plan of a suite: home-test/3."""
    out: tuple[Path, ...] = ()
    """Files to write: .json, .geojson, .dxf, .svg, or .yaml for a map of ROS map_server with its .pgm."""
    radius: float = 0.25
    """Radius of the robot, m; 0: everything that is connected."""
    start: tuple[float, float] | None = None
    """A point x, y in the part that is meant, m; the largest part if left out."""
    resolution: float = 0.05
    """Side of a pixel of the maps written, m."""
    reading: tyro.conf.OmitArgPrefixes[PlanFileConfig] = field(default_factory=PlanFileConfig)


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """Make one HTML page of the results of `bench`, also while they are not complete."""

    results: tyro.conf.Positional[Path]
    """Folder of the results."""
    out: Path | None = None
    """The page (default: report.html in that folder)."""
    reference: str = "nearest"
    """Policy that the others are compared with."""
    runs: int = 3
    """So many of the best and of the worst runs are run again and drawn."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Train:
    """Train a selector; a run that was stopped goes on where it was when the same command is given again.

    The folder gets model.safetensors and its card, the network that was best on the validation plans, progress.jsonl
    with a line for every validation, and logs for TensorBoard.
    """

    config: Path | None = None
    """JSON file with fields of the training's configuration, as in {"method": "both", "fit": {"epochs": 20}}."""
    method: Literal["imitation", "reinforcement", "both"] | None = None
    """How it learns, instead of what the configuration says."""
    seed: int | None = None
    """Seed, instead of that of the configuration."""
    out: Path = Path("results/train")
    """Folder of the run."""
    workers: int = 0
    """Processes that play; 0: one a core. The result does not depend on it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Eval:
    """Compare a trained selector with scripted policies on the same plans, starts and noise."""

    model: tyro.conf.Positional[Path]
    """The model, a .safetensors file with its card beside it."""
    suite: tuple[str, ...] = ()
    """Suites of generated plans, such as home-test or office-validation (default: a mix that takes minutes)."""
    plans: tuple[Path, ...] = ()
    """Plan files, or folders of them, instead of suites."""
    first: int | None = None
    """Only the first so many plans, of each suite."""
    against: tuple[str, ...] = ("nearest",)
    """Policies to compare with; the first is the reference."""
    sensing: tuple[Sensing, ...] = ("stops",)
    """When the robot measures and decides: see bench."""
    seeds: int = 1
    """Starts (and streams of noise) on each plan."""
    workers: int = 0
    """Processes; 0: one a core."""
    out: Path = Path("results/eval")
    """Folder of the results."""
    drive: Drive | None = None
    """How the robot drives, instead of what the configuration says."""
    preset: PresetName | None = None
    """Robot and sensor by name; fields of --config go before those of the preset."""
    config: Path | None = None
    """JSON file with fields of the environment's configuration."""
    plots: bool = True
    """Draw the plots."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Play:
    """Explore a plan yourself, in a window that shows what the robot knows, against a policy from the same start.

    A click on a node chooses it, and so does its number and enter. The result is kept as a policy's is.
    """

    plan: tyro.conf.Positional[str]
    """A plan file, or a plan of a suite: home-test/3."""
    player: str = "person"
    """Your name: the results are kept under it."""
    against: str = "nearest"
    """Name of a baseline, or module:attribute for an own policy."""
    seed: int = 0
    """Seed of the start and the noise."""
    placement: Placement = "in_front"
    """Where nodes are placed."""
    sensing: Sensing = "moving"
    """When the robot measures and decides (see bench)."""
    drive: Drive | None = None
    """How the robot drives, instead of what the configuration says."""
    preset: PresetName | None = None
    """Robot and sensor by name; fields of --config go before those of the preset."""
    config: Path | None = None
    """JSON file with fields of the environment's configuration."""
    out: Path = Path("results/play")
    """Folder of the games: each gets a folder of its own, by plan, seed and player."""
    reading: tyro.conf.OmitArgPrefixes[PlanFileConfig] = field(default_factory=PlanFileConfig)


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """Record episodes of a policy as a Minari data set, for offline learning."""

    suite: tuple[str, ...] = ("home-train",)
    """Suites of generated plans."""
    plans: tuple[Path, ...] = ()
    """Plan files, or folders of them, instead of suites."""
    first: int | None = None
    """Only the first so many plans, of each suite."""
    policy: str = "nearest"
    """Name of a baseline, or module:attribute for an own policy."""
    seeds: int = 1
    """Starts (and streams of noise) on each plan."""
    observation: Literal["dict", "scaled", "flat", "graph", "grid"] = "dict"
    """What is kept of what was seen: the environment's own arrays, or those of a wrapper."""
    name: str = "polyexplore/nearest-v0"
    """Name of the data set."""
    out: Path = Path("results/datasets")
    """Folder of data sets, which Minari finds by the variable MINARI_DATASETS_PATH."""
    workers: int = 0
    """Processes; 0: one a core."""
    placement: Placement | None = None
    """Where nodes are placed, instead of what the configuration says."""
    sensing: Sensing | None = None
    """When the robot measures and decides (see bench), instead of what the configuration says."""
    drive: Drive | None = None
    """How the robot drives, instead of what the configuration says."""
    preset: PresetName | None = None
    """Robot and sensor by name; fields of --config go before those of the preset."""
    config: Path | None = None
    """JSON file with fields of the environment's configuration."""
    reading: tyro.conf.OmitArgPrefixes[PlanFileConfig] = field(default_factory=PlanFileConfig)


@dataclass(frozen=True, slots=True, kw_only=True)
class Linemap:
    """Make the line map of a laser log; prints a summary and writes the map.

    Logs are ROS 1 bags, ROS 2 bags (the folder, or a .db3 or .mcap file; both need the extra "logs"), CARMEN (FLASER,
    ROBOTLASER1 or RAWLASER1 messages, plain or .gz), or .npz with the arrays angles (b,), ranges (n, b) and poses
    (n, 3), in rad and m, and optionally max_range, pose_covariance, odometry, times and time_increment.
    """

    log: tyro.conf.Positional[Path]
    """The log."""
    out: tuple[Path, ...] = (Path("results/linemap"),)
    """Files to write, .json, .geojson, .svg, .png or .yaml (for ROS map_server, with a .pgm), or folders, which get
    one of each, named after the log."""
    plan: tuple[Path, ...] = ()
    """Files for the floor plan: one valid polygon of the map's lines that the environment explores; .json, .geojson,
    .dxf, .svg or .yaml (for ROS map_server, with a .pgm)."""
    max_range: float | None = None
    """Range from which on a beam has no return, m (default: what the log says, else 30)."""
    sigma_range: float = 0.01
    """Standard deviation of the range noise, m."""
    sigma_angle: float = 0.1
    """Standard deviation of the beam angle noise, degrees."""
    range_floor: float = 0.01
    """Smallest standard deviation of range assumed in the fit, m."""
    topic: str | None = None
    """Topic of the scans in a bag (default: the one with the most scans)."""
    trajectory_in: Path | None = None
    """File of poses of the laser, in the TUM format, to be used instead of those in the log."""
    poses: Literal["log", "odometry", "none"] = "log"
    """Poses of the scans: those of the log; or found from the scans, with its raw odometry as a hint, or with none. A
    run that was stopped goes on where it was."""
    trajectory: Path | None = None
    """File to write the poses of the laser to, in the TUM format; with --poses odometry those between scans too."""
    field_of_view: float | None = None
    """FLASER only: angle between the first and the last beam, degrees (default: 180, less a step if beams are even)."""
    sigma_xy: float = 0.02
    """Standard deviation of the poses' x and y, m, unless the log or --poses gives covariances."""
    sigma_heading: float = 0.3
    """Standard deviation of the poses' heading, degrees, unless the log or --poses gives covariances."""
    every: int = 1
    """Use only every so many-th scan."""
    min_travel: float = 0.0
    """Use only scans at least so far from the last one used, m, or turned against it by half a radian."""
    start: Literal["endpoint", "hough"] = "endpoint"
    """First guess of a scan's lines: iterative end-point fit, or probabilistic Hough transform."""
    merge_gate: float = 9.21
    """Chi-square gate (2 degrees of freedom) of the merge test."""
    door_width: float = 0.5
    """A gap along a line that is wider is not bridged, m."""
    ratio: float = 3.0
    """Cut walls where more than so many beams passed through for each that ended there; 0: never."""
    width: int = 1600
    """Width of a .png, pixels."""


def bench(options: Bench) -> int:
    """Run, or go on with, a comparison."""
    from polyexplore_gym.evaluation import name_policies

    return _compare(options, name_policies(options.policies))


def train(options: Train) -> int:
    """Run, or go on with, a training."""
    import baselines.learned

    baselines.learned.require("torch", "safetensors", "tensorboard", "stable_baselines3", "sb3_contrib")
    from baselines.learned import settings, training

    config = settings.TrainConfig() if options.config is None else settings.read_train_config(options.config)
    given: dict[str, Any] = {"method": options.method, "seed": options.seed}
    config = replace(config, **{name: value for name, value in given.items() if value is not None})
    try:
        path = training.train(config, options.out, workers=options.workers or os.cpu_count() or 1)
    except KeyboardInterrupt:
        _say(f"\nstopped; what is done is in {options.out}: the same command goes on from there")
        return 130
    print(f"written: {path}")
    return 0


def evaluate_model(options: Eval) -> int:
    """Run, or go on with, the comparison of a model."""
    from baselines import make_policy
    from polyexplore_gym.evaluation import name_policies

    policies = name_policies(options.against)
    if not policies or "learned" in policies:
        raise InvalidConfigError(
            "--against: names of policies, of which none is 'learned': so the model is called here"
        )
    policies["learned"] = make_policy("learned", model=options.model)
    same = ("suite", "plans", "first", "sensing", "seeds", "workers", "out", "drive", "preset", "config", "plots")
    fields = {name: getattr(options, name) for name in same}
    return _compare(Bench(placements=("in_front",), reference=options.against[0], **fields), policies)


def _compare(options: Bench, policies: dict[str, PolicySpec]) -> int:
    """Run a comparison of these policies; those that the options name are not looked at."""
    import numpy as np

    from polyexplore_gym.evaluation import Study, evaluate, summarize, summary_text, write_tables
    from polyexplore_gym.evaluation.bounds import find_bounds, write_bounds

    if options.seeds < 1:
        raise InvalidConfigError(f"--seeds {options.seeds}: must be at least 1")
    config = _config(options.config, options.preset, options.drive)
    study = Study(
        policies=policies,
        plans=list(_bench_plans(options, config)),
        placements=options.placements,
        sensing=options.sensing,
        seeds=range(options.seeds),
        config=config,
    )
    total = len(study.policies) * len(study.settings) * len(study.plans) * len(study.seeds)
    _say(f"{len(study.plans)} plans x {len(study.seeds)} starts x {len(study.settings)} settings x "
         f"{len(study.policies)} policies = {total} episodes -> {options.out}")  # fmt: skip
    workers = options.workers or os.cpu_count() or 1
    bounds = {}
    try:
        if options.bounds is not None:
            bounds = find_bounds(study.plans, study.seeds, config, cache=options.bounds, workers=workers)
        records = evaluate(
            study,
            out=options.out,
            workers=workers,
            backend=options.backend,
            address=options.address,
        )
    except KeyboardInterrupt:
        _say(f"\nstopped; the results so far are in {options.out}: the same command goes on from there")
        return 130
    written = [write_bounds(options.out, bounds)] if bounds else []
    summary = summarize(records, np.random.default_rng(0), reference=options.reference, bounds=bounds)
    written += write_tables(summary, options.out)
    print(summary_text(summary))
    if options.plots:
        try:
            written += _bench_plots(study, records, summary, options)
        except MissingDependencyError as error:
            _say(f"no plots: {error}")
    _say(f"written to {options.out}: {', '.join(path.name for path in written)}")
    return 0


def report(options: Report) -> int:
    """Write the page of a results folder."""
    from polyexplore_gym.evaluation.report import write_report

    print(f"written: {write_report(options.results, options.out, reference=options.reference, runs=options.runs)}")
    return 0


def run(options: Run) -> int:
    """Explore one plan."""
    import math

    from tqdm import tqdm

    from polyexplore_gym.evaluation import load_policy, run_episode
    from polyexplore_gym.evaluation.runner import make_env

    _check_run(options)
    config = _config(options.config, options.preset, options.drive, options.placement, options.sensing)
    plan = _plan(options.plan, config.robot.radius, options.start, options.reading)
    policy = load_policy(options.policy)
    env = make_env(config)
    start = {}
    if options.start is not None:
        start["start"] = (*options.start[:2], math.radians(options.start[2]))
        plan.check_start(start["start"], config.robot.radius)
    plan.check_connected(config.robot.radius)
    films = [path for path in (options.gif, options.mp4) if path is not None]
    moments: list[tuple[int | None, Snapshot]] = []

    with tqdm(total=100.0, bar_format="{desc} |{bar}| {n:.1f} % seen [{elapsed}]", desc=plan.name) as bar:

        def watch(env: Any, info: Any, action: int | None, over: bool) -> None:
            text = f"{plan.name} {info['distance']:.1f} m, {info['measurements']} scans"
            bar.set_description_str(text, refresh=False)
            bar.update(100.0 * info["coverage"] - bar.n)
            if films or (options.png and over):
                moments.append((action, env.unwrapped.snapshot()))

        record = run_episode(env, policy, plan, options.seed, label=options.policy, options=start, observer=watch)
    print(_run_text(record, plan))
    if moments:
        _film(moments, films, options)
    env.close()
    return 0 if record.status != "failed" else 1


def plan(options: Plan) -> int:
    """Read a plan and write it."""
    _check_plan_files(options.out)
    found = _plan(options.plan, options.radius, options.start, options.reading)
    x0, y0, x1, y1 = found.bounds
    print(f"{found.name}: {found.area:.1f} m2, {x1 - x0:.2f} x {y1 - y0:.2f} m, {found.n_vertices} vertices, "
          f"{len(found.holes)} holes")  # fmt: skip
    _save_plan(found, options.out, options.resolution)
    return 0


def linemap(options: Linemap) -> int:
    """Make the line map of a log."""
    import math

    from tqdm import tqdm

    from polyexplore_gym.config import MappingConfig
    from polyexplore_gym.mapping import map_log, read_log, save_map, save_trajectory, sensor_of

    if options.trajectory is not None and not options.trajectory.parent.is_dir():
        raise InvalidConfigError(f"{options.trajectory}: the folder {options.trajectory.parent} does not exist")
    files = _map_files(options)
    _check_plan_files(options.plan)
    if both := {path.resolve() for path in files} & {path.resolve() for path in options.plan}:
        raise InvalidConfigError(f"{min(both)}: named by --out and by --plan")
    fov = options.field_of_view
    if fov is not None and not 0 < fov <= 360:
        raise InvalidConfigError(f"--field-of-view {fov}: must lie in (0, 360]")
    config = MappingConfig(
        start=options.start,
        merge_gate=options.merge_gate,
        door_width=options.door_width,
        range_floor=options.range_floor,
    )
    size = os.path.getsize(options.log) if os.path.isfile(options.log) else None
    with tqdm(total=size, desc="read", unit="B", unit_scale=True, dynamic_ncols=True) as bar:
        log = read_log(
            options.log,
            topic=options.topic,
            trajectory=options.trajectory_in,
            field_of_view=None if fov is None else math.radians(fov),
            watch=lambda done: bar.update(done - bar.n),
        )
    if options.trajectory is not None and log.times is None:
        raise InvalidLogError(f"{options.log}: the scans have no times: --trajectory cannot be written")
    for path in files:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InvalidConfigError(f"{path.parent}: the folder cannot be made: {error.strerror}") from error
    for part in log.broken[:SHOWN]:
        _say(f"left out: {part}")
    if len(log.broken) > SHOWN:
        _say(f"left out: {len(log.broken) - SHOWN} more")
    for message, number in log.unread.items():
        _say(f"left out: {number} {message} scans; the {log.read} scans are read")
    for note in log.notes:
        _say(f"note: {note}")
    sensor = sensor_of(log, options.max_range, options.sigma_range, math.radians(options.sigma_angle))

    def track(scans: Iterable[int], what: str) -> Iterable[int]:
        return tqdm(scans, desc=what, unit="scan", dynamic_ncols=True)

    state = files[0].parent / f"{_stem(options.log)}.slam.npz"
    log, poses = _posed(options, log, sensor, config, state, track)
    result = map_log(
        log,
        sensor,
        config,
        sigma_xy=options.sigma_xy,
        sigma_heading=math.radians(options.sigma_heading),
        every=options.every,
        min_travel=options.min_travel,
        ratio=options.ratio,
        track=track,
    )
    print(_linemap_text(options.log.name, log, result))
    for path in files:
        try:
            save_map(result, path, name=_stem(options.log), width=options.width)
        except MissingDependencyError as error:
            _say(f"no {path.name}: {error}")
        else:
            print(f"written: {path}")
    if options.trajectory is not None and poses is not None:
        save_trajectory(poses, options.trajectory)
        print(f"written: {options.trajectory}")
    if options.plan:
        from polyexplore_gym.mapping import beams_of_log, walls_of_log
        from polyexplore_gym.outline import floor_plan, trace, views_of

        views = views_of(beams_of_log(log, result, sensor.max_range), sensor.max_range)
        outline = trace(views, walls_of_log(result), sensor, door=options.door_width, track=track)
        found = floor_plan(outline, _stem(options.log))
        print(_floor_plan_text(found))
        _save_plan(found, options.plan)
    state.unlink(missing_ok=True)
    return 0


def _posed(
    options: Linemap, log: LaserLog, sensor: SensorConfig, config: MappingConfig, state: Path, track: Any
) -> tuple[LaserLog, Track | None]:
    """The log with the poses asked for, and these by time."""
    from polyexplore_gym.mapping import Track, correct_poses, corrected_log

    if options.poses == "log":
        timed = log.times is not None and log.poses is not None
        return log, Track.sorted(log.times, log.poses) if timed else None  # type: ignore[arg-type]
    try:
        found = correct_poses(log, sensor, config, source=options.poses, state=state, track=track)
    except KeyboardInterrupt:
        _say(f"\nstopped; what is matched is in {state}: the same command goes on from there")
        raise
    return corrected_log(log, found), None if options.trajectory is None else found.track


def play(options: Play) -> int:
    """Let a person explore a plan."""
    from polyexplore_gym.evaluation.play import Board, Person
    from polyexplore_gym.evaluation.play import play as game

    if options.seed < 0:
        raise InvalidConfigError(f"--seed {options.seed}: must not be negative")
    if not options.player or options.player == options.against:
        raise InvalidConfigError(f"--player {options.player!r}: must be a name of your own")
    config = _config(options.config, options.preset, options.drive, options.placement, options.sensing)
    plan = _plan(options.plan, config.robot.radius, None, options.reading)
    plan.check_connected(config.robot.radius)
    boards: list[Board] = []

    def ask(scene: Snapshot) -> int:
        boards[:] = boards or [Board()]  # no window for a game that was played already
        return boards[0].ask(scene)

    person = Person(ask, options.player)
    folder = options.out / re.sub(r"[^\w.-]+", "-", f"{plan.name}-{options.seed}-{options.player}")
    own, other = game(plan, config, folder, person, seed=options.seed, reference=options.against)
    if not person.asked:
        print(f"played before: {folder}; give another --player or --out to play again")
    print(_run_text(own, plan), _run_text(other, plan), sep="\n")
    if own.ended and other.ended and other.distance > 0.0:
        print(f"{own.policy} / {other.policy}: {own.distance / other.distance:.2f} of the distance; kept in {folder}")
    return 0 if own.status != "failed" else 1


def record(options: Record) -> int:
    """Record a data set."""
    from tqdm import tqdm

    from polyexplore_gym.evaluation.recording import Recording
    from polyexplore_gym.evaluation.recording import record as write
    from polyexplore_gym.optional import require

    minari = require("minari", "datasets")
    if options.seeds < 1:
        raise InvalidConfigError(f"--seeds {options.seeds}: must be at least 1")
    config = _config(options.config, options.preset, options.drive, options.placement, options.sensing)
    if options.observation != "dict":
        config = replace(config, observation=replace(config.observation, relative=True))
    suites = () if options.plans else options.suite
    recording = Recording(
        policy=options.policy,
        plans=list(_bench_plans(replace(options, suite=suites), config)),
        seeds=range(options.seeds),
        config=config,
        observation=options.observation,
    )
    place = write(
        recording,
        options.out,
        options.name,
        workers=options.workers or os.cpu_count() or 1,
        track=lambda episodes, total: tqdm(episodes, total=total, unit="episode", dynamic_ncols=True),
    )
    made = minari.MinariDataset(place)
    size = sum(path.stat().st_size for path in place.iterdir()) / 1e6
    print(
        f"{options.name}: {made.total_episodes} episodes, {made.total_steps} decisions, {size:.1f} MB\nwritten: {place}"
    )
    return 0


_COMMANDS: dict[str, tuple[type, Callable[[Any], int]]] = {
    "bench": (Bench, bench),
    "run": (Run, run),
    "train": (Train, train),
    "eval": (Eval, evaluate_model),
    "report": (Report, report),
    "plan": (Plan, plan),
    "linemap": (Linemap, linemap),
    "record": (Record, record),
    "play": (Play, play),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code: 0, 1 (the episode failed), 2 (bad input) or 130 (Ctrl-C)."""
    kinds: dict[str, Callable[..., Any]] = {name: kind for name, (kind, _) in _COMMANDS.items()}
    options: Any = tyro.extras.subcommand_cli_from_dict(
        kinds, prog="polyexplore", description="Exploration of unknown polygonal floor plans.", args=arguments
    )
    call = next(call for kind, call in _COMMANDS.values() if isinstance(options, kind))
    with warnings.catch_warnings():
        warnings.simplefilter("default", UserWarning)
        warnings.showwarning = lambda message, *_, **__: _say(f"warning: {message}")
        try:
            return call(options)
        except PolyExploreError as error:
            _say(f"error: {error}")
            return 2
        except KeyboardInterrupt:
            _say("\nstopped")
            return 130


def _config(
    path: Path | None,
    preset: str | None,
    drive: str | None,
    placement: str | None = None,
    sensing: str | None = None,
) -> EnvConfig:
    values: Any = {}
    if path is not None:
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InvalidConfigError(f"{path}: cannot be read: {error}") from error
    if preset is not None and isinstance(values, dict):
        values = {**values, "preset": preset}
    config = from_mapping(EnvConfig, values, path=str(path or "config"))
    if drive is not None:
        config = replace(config, drive=replace(config.drive, mode=drive))  # type: ignore[arg-type]
    if placement is None and sensing is None:
        return config
    from polyexplore_gym.evaluation import Setting

    setting = Setting.of(config)
    return Setting(placement or setting.placement, sensing or setting.sensing).configured(config)


def _plan(name: str, radius: float, start: Sequence[float] | None, reading: PlanFileConfig) -> FloorPlan:
    """A plan by path, or by suite and number; what exists as a file is a path."""
    from polyexplore_gym.floorplan import load_plan

    suite_name, slash, number = name.rpartition("/")
    if slash and number.isdigit() and not Path(name).exists():
        suite = _suite(suite_name)
        if int(number) >= len(suite):
            raise InvalidFloorPlanError(f"{name}: {suite_name} has the plans 0 to {len(suite) - 1}")
        return suite.plan(int(number))
    return load_plan(name, radius=radius, start=start, **to_mapping(reading))


def _suite(name: str) -> Any:
    from polyexplore_gym.floorplan import suite

    try:
        return suite(name)
    except ValueError as error:
        raise InvalidConfigError(str(error)) from error


def _bench_plans(options: Bench | Record, config: EnvConfig) -> Iterator[FloorPlan]:
    """The plans to run on. A bad file is named and left out; raises when no plan is left."""
    if options.suite and options.plans:
        raise InvalidConfigError("give either --suite or --plans")
    first = options.first
    if first is not None and first < 1:
        raise InvalidConfigError(f"--first {first}: must be at least 1")
    if not options.plans:
        for name in options.suite or BENCH_PLANS:
            suite = _suite(name)
            some = first if options.suite else min(first or len(suite), BENCH_PLANS[name])
            yield from (suite.plan(i) for i in range(len(suite))[:some])
        return
    from polyexplore_gym.floorplan import load_plan

    known: dict[str, Path] = {}
    for path in _plan_files(options.plans):
        if len(known) == first:
            break
        try:
            plan = load_plan(path, radius=config.robot.radius, **to_mapping(options.reading))
            plan.check_connected(config.robot.radius)
        except InvalidFloorPlanError as error:
            text = str(error)
            _say(f"left out: {text if str(path) in text else f'{path}: {text}'}")
            continue
        if plan.content_hash in known:
            _say(f"left out: {path}: the same geometry as {known[plan.content_hash]}")
            continue
        known[plan.content_hash] = path
        yield plan
    if not known:
        raise InvalidFloorPlanError("no usable floor plan in " + ", ".join(map(str, options.plans)))


def _plan_files(paths: Iterable[Path]) -> Iterator[Path]:
    for path in paths:
        if path.is_dir():
            yield from sorted(p for p in path.iterdir() if p.suffix.lower() in FOLDER_SUFFIXES and p.is_file())
        else:
            yield path


def _bench_plots(study: Study, records: list[EpisodeRecord], summary: Summary, options: Bench) -> list[Path]:
    from polyexplore_gym.evaluation import plots

    figure = plots.coverage_figure(records, reference=options.reference)
    written = [plots.save(figure, options.out / "coverage.png")]
    written.append(plots.save(plots.ratio_figure(summary), options.out / "ratios.png"))
    # One plan of middle size, seen with every policy.
    plan = sorted(study.plans, key=lambda p: p.area)[len(study.plans) // 2]
    seed = study.seeds[0]
    for setting in study.settings:
        pair = plan.content_hash, seed
        ran = {r.policy for r in records if (r.setting, r.pair) == (setting, pair) and r.status != "failed"}
        policies = {label: spec for label, spec in study.policies.items() if label in ran}
        if policies:
            figure = plots.trajectory_figure(policies, plan, seed, setting.configured(study.config))
            name = f"trajectories-{setting}.png".replace(", ", "-")
            written.append(plots.save(figure, options.out / name))
    return written


def _check_run(options: Run) -> None:
    """Reject what cannot work, such as a file that cannot be written, before the exploration and not after it."""
    for path, suffixes in ((options.gif, (".gif",)), (options.mp4, (".mp4",)), (options.png, (".png", ".pdf", ".svg"))):
        if path is None:
            continue
        if path.suffix.lower() not in suffixes:
            raise InvalidConfigError(f"{path}: the name must end in {' or '.join(suffixes)}")
        if not path.parent.is_dir():
            raise InvalidConfigError(f"{path}: the folder {path.parent} does not exist")
    if options.seed < 0:
        raise InvalidConfigError(f"--seed {options.seed}: must not be negative")
    if options.step < 0 or 0 < options.step < 0.02:
        raise InvalidConfigError(f"--step {options.step}: must be 0 or at least 0.02")
    if not 0.1 <= options.fps <= 100:
        raise InvalidConfigError(f"--fps {options.fps}: must lie in 0.1 to 100")
    if any((options.gif, options.mp4, options.png)):
        from polyexplore_gym.optional import require

        for module in ("matplotlib", *(["PIL"] if options.gif else []), *(["imageio_ffmpeg"] if options.mp4 else [])):
            require(module, "plots")


def _film(moments: list[tuple[int | None, Snapshot]], films: list[Path], options: Run) -> None:
    """Draw the snapshots, each with the action that led to it."""
    from tqdm import tqdm

    from polyexplore_gym import rendering
    from polyexplore_gym.animation import motion, save_animation

    last = moments[-1][1]
    scenes: list[Snapshot] = []
    for (_, before), (action, after) in itertools.pairwise(moments) if films else ():
        scenes += motion(before, after, action, options.step or max(after.distance, 1.0))
    for path in films:
        bar = tqdm([*scenes, last], desc=path.name, unit="frame")
        save_animation((rendering.frame(s, options.width) for s in bar), path, fps=options.fps)
        print(f"written: {path}")
    if options.png:
        rendering.save_figure(last, options.png, width=options.width)
        print(f"written: {options.png}")


def _run_text(record: EpisodeRecord, plan: FloorPlan) -> str:
    reached = [
        f"{percent} % after " + (f"{d:.1f} m" if d is not None else "- (never)")
        for percent, d in ((90, record.distance_90), (95, record.distance_95), (99, record.distance_99))
    ]
    left = (
        ("out of reach", record.unreached, record.unreached_length),
        ("given up", record.given_up, record.given_up_length),
    )
    told = [f"{n} jump edges ({length:.1f} m) {what}" for what, n, length in left if n]
    status = ", ".join([record.status if record.error is None else f"failed: {record.error}", *told])
    return (
        f"{record.plan} ({plan.area:.0f} m2), {record.policy}, {record.setting}, {record.drive}: {status}\n"
        f"  distance      {record.distance:.1f} m in {record.decisions} decisions, {record.sim_time:.0f} s simulated\n"
        f"  drives        {', '.join(f'{count} {end}' for end, count in record.ends.items()) or 'none'}\n"
        f"  seen          {100 * record.coverage:.1f} % ({', '.join(reached)})\n"
        f"  measurements  {record.measurements}\n"
        f"  collisions    {record.collisions}"
    )


def _stem(log: Path) -> str:
    """The log's name without .log.gz and the like."""
    return Path(log.name.removesuffix(".gz")).stem


def _map_files(options: Linemap) -> list[Path]:
    """The files to write; rejects what cannot be written before the work and not after it."""
    from polyexplore_gym.mapping import MAP_SUFFIXES
    from polyexplore_gym.optional import require

    if not 100 <= options.width <= 20_000:
        raise InvalidConfigError(f"--width {options.width}: must lie in 100 to 20000")
    if not options.out:
        raise InvalidConfigError("--out: name a file or a folder")
    files = []
    for path in options.out:
        if path.is_dir() or not path.suffix:
            if path.exists() and not path.is_dir():
                raise InvalidConfigError(f"{path}: is a file, not a folder")
            files += [path / (_stem(options.log) + suffix) for suffix in MAP_SUFFIXES]
            continue
        if path.suffix.lower() not in MAP_SUFFIXES:
            raise InvalidConfigError(
                f"{path}: the name must end in {' or '.join(MAP_SUFFIXES)}, or be that of a folder"
            )
        if not path.parent.is_dir():
            raise InvalidConfigError(f"{path}: the folder {path.parent} does not exist")
        if path.suffix.lower() in (".svg", ".png"):
            require("matplotlib", "plots")
        files.append(path)
    return files


def _check_plan_files(paths: Iterable[Path]) -> None:
    """Reject what a floor plan cannot be written to, before the work and not after it."""
    from polyexplore_gym.floorplan import PLAN_SUFFIXES
    from polyexplore_gym.optional import require

    for path in paths:
        if path.suffix.lower() not in PLAN_SUFFIXES:
            raise InvalidConfigError(f"{path}: the name must end in {', '.join(PLAN_SUFFIXES)}")
        if not path.parent.is_dir():
            raise InvalidConfigError(f"{path}: the folder {path.parent} does not exist")
        if path.suffix.lower() == ".dxf":
            require("ezdxf", "drawings")


def _save_plan(plan: FloorPlan, paths: Iterable[Path], resolution: float = 0.05) -> None:
    from polyexplore_gym.floorplan import save_plan

    for path in paths:
        try:
            save_plan(plan, path, resolution=resolution)
        except OSError as error:
            raise InvalidConfigError(f"{path}: cannot be written: {error.strerror or error}") from error
        print(f"written: {path}")


def _floor_plan_text(plan: FloorPlan) -> str:
    meta = plan.meta
    return (
        f"  floor plan    {plan.area:.1f} m2, {plan.n_vertices} vertices, {len(plan.holes)} holes; unknown: "
        f"{meta['unknown_length']:.1f} m of the walls ({100 * meta['unknown_share']:.1f} %) in {len(meta['unknown'])} "
        f"places; seen but not connected: {meta['left_out']:.1f} m2"
    )


def _linemap_text(name: str, log: LaserLog, made: LogMap) -> str:
    points, lines = len(made.points), made.rho.size
    on_lines = f"{100 * made.on_line.mean():.1f} % on lines" if points else "none on lines"
    fewest, most = (limit(angles.size for angles in log.angles) for limit in (min, max))
    beams = str(most) if fewest == most else f"{fewest} to {most}"
    return (
        f"{name}: {len(log)} scans of {beams} beams, {len(made.path)} used, {len(log.broken)} broken\n"
        f"  poses         {log.poses_are}{f': {log.why}' if log.why else ''}\n"
        f"  points        {points} ({on_lines})\n"
        f"  lines         {lines} with {len(made.segments)} segments (single scans: {made.lines_of_scans}); "
        f"{len(made.fragments)} fragments\n"
        f"  compression   {f'{100 * made.compression:.2f} % (lines to points)' if lines else '-'}\n"
        f"  distance      {f'{1e3 * made.median_distance:.1f} mm' if lines else '-'} "
        "(median, from the points on lines to the nearest segment)\n"
        f"  seen through  {made.contradicted} segments and {made.fragments_contradicted} fragments, dropped or cut\n"
        f"  misfit        {100 * made.misfit:.1f} % (median over the scans of the beams that pass through walls)"
    )


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
