"""Decisions a second on one core, where their time goes, the seconds of a 25-room episode, and memory.

    python benchmarks/speed.py [--repetitions 3] [--only rate phases rooms memory] [--plans FOLDER] [--sensing moving]
                               [--scan-every 0.5]

Whole episodes with the policy `nearest` and, but for `--sensing`, the default configuration, from `reset()` on: plan
and start, physics (or the kinematic drive), laser, maps, graph, observation, policy and coverage are all in the figure.
A few decisions are played first, so that compiled kernels and the plan's own caches are warm. The process binds itself
to one core. "wall" counts by the clock, "CPU" by the processor time used: the two differ when other programs want the
core too.

FOLDER holds plan JSON files; default: `floorplans` under $POLYEXPLORE_DATA, or ../shared/data/floorplans beside the
checkout. Without it, generated plans take their place; the largest of those have about 900 walls.
"""

from __future__ import annotations

import argparse
import functools
import os
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import sensing
from plan_statistics import default_folder, measure

import polyexplore_gym.env as environment
from baselines import make_policy
from polyexplore_gym import observation
from polyexplore_gym.config import DriveConfig, EnvConfig
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.evaluation.tables import format_table
from polyexplore_gym.exploration import ExplorationMap
from polyexplore_gym.floorplan import FloorPlan, load_plan, suite
from polyexplore_gym.mapping import LineMap
from polyexplore_gym.sim.coverage import Coverage
from polyexplore_gym.sim.laser import Laser
from polyexplore_gym.sim.world import World

# Shared plans of about 300 and of about 3,000 walls, and generated ones instead (none of those is so large).
SIZES = (
    (
        ("amrl_ase4", "ipa_office_b_furn", "office_chewlane", "campus_mit_basement"),
        ("office-test/7", "office-test/8", "office-test/23", "office-test/24"),
    ),
    (
        ("kth_50015847", "shop_brain_big_retail", "kth_50015848"),
        ("office-test/20", "office-test/30", "office-test/41"),
    ),
)
MODES = ("kinematic", "physics")
PHASES: dict[str, tuple[Any, str]] = {
    "drive": (World, "drive"),
    "laser": (Laser, "measure"),
    "extract lines": (environment, "extract_lines"),
    "line map": (LineMap, "insert"),
    "exploration map": (ExplorationMap, "insert"),
    "nodes and paths": (ExplorationMap, "plan"),
    "coverage": (Coverage, "add"),
    "observation": (observation, "observe"),
}
"""What is timed apart, and where it is called from; the remainder is "everything else"."""
ROOMS = 25
MEMORY_PLANS = [f"{family}-test/{i}" for family in ("home", "angled", "office") for i in range(3)]


@dataclass
class Played:
    """One episode."""

    decisions: int = 0
    wall: float = 0.0
    cpu: float = 0.0
    phases: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    info: dict[str, Any] = field(default_factory=dict)
    complete: bool = False


@contextmanager
def timed(seconds: dict[str, float]) -> Iterator[None]:
    """Add up the time in each phase while this lasts (about 1 us a call of its own)."""

    def wrap(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(call)
        def timing(*args: Any, **kwargs: Any) -> Any:
            began = time.perf_counter()
            try:
                return call(*args, **kwargs)
            finally:
                seconds[name] += time.perf_counter() - began

        return timing

    originals = {name: getattr(owner, attribute) for name, (owner, attribute) in PHASES.items()}
    try:
        for name, (owner, attribute) in PHASES.items():
            setattr(owner, attribute, wrap(name, originals[name]))
        yield
    finally:
        for name, (owner, attribute) in PHASES.items():
            setattr(owner, attribute, originals[name])


def play(config: EnvConfig, plan: FloorPlan, seed: int, limit: int | None = None) -> Played:
    """One episode with `nearest`, everything included."""
    env = PolyExploreEnv(config=config)
    policy, rng = make_policy("nearest"), np.random.default_rng(seed)
    played = Played()
    with timed(played.phases):
        wall, cpu = time.perf_counter(), time.process_time()
        observed, info = env.reset(seed=seed, options={"plan": plan})
        over = not info["action_mask"].any()
        while not over and played.decisions != limit:
            observed, _, terminated, truncated, info = env.step(policy.act(observed, info, rng))
            played.decisions += 1
            over = terminated or truncated
        played.wall, played.cpu = time.perf_counter() - wall, time.process_time() - cpu
    played.info, played.complete = info, info["outcome"]["status"] == "complete"
    return played


def plan_named(name: str) -> FloorPlan:
    """Plan 7 of a suite for "office-test/7"."""
    family, _, number = name.partition("/")
    return suite(family).plan(int(number))


def plans_of(shared: tuple[str, ...], generated: tuple[str, ...], folder: Path) -> list[FloorPlan]:
    """The shared plans that are there, or the generated ones."""
    found = [load_plan(path) for name in shared if (path := folder / f"{name}.json").exists()]
    return found or [plan_named(name) for name in generated]


def rates(configs: dict[str, EnvConfig], repetitions: int, folder: Path) -> dict[tuple[str, str], list[Played]]:
    """Print decisions a second for every plan; returns the episodes by size and mode."""
    rows: list[list[str]] = []
    episodes: dict[tuple[str, str], list[Played]] = defaultdict(list)
    for shared, generated in SIZES:
        plans = plans_of(shared, generated, folder)
        size = f"{statistics.mean(len(plan.segments) for plan in plans):.0f} walls"
        for plan in plans:
            for mode, config in configs.items():
                play(config, plan, seed=0, limit=10)
                runs = [play(config, plan, seed) for seed in range(repetitions)]
                episodes[size, mode] += runs
                wall = [run.decisions / run.wall for run in runs]
                cpu = [run.decisions / run.cpu for run in runs]
                count = statistics.median(run.decisions for run in runs)
                scans = statistics.median(run.info["measurements"] for run in runs)
                rows.append([plan.name, f"{len(plan.segments)}", mode, f"{count:g}", f"{scans:g}",
                             f"{statistics.median(wall):.0f}", f"{statistics.median(cpu):.0f}",
                             f"{1e3 / statistics.median(wall):.1f}"])  # fmt: skip
    print(f"Decisions a second on one core, everything included (median of {repetitions} episodes):\n")
    header = (
        "plan",
        "walls",
        "drive",
        "decisions",
        "scans",
        "decisions/s (wall)",
        "decisions/s (CPU)",
        "ms a decision",
    )
    print(format_table(header, rows, "markdown"), end="\n\n")
    return episodes


def phases(episodes: dict[tuple[str, str], list[Played]]) -> None:
    """Print where the time goes."""
    columns = []
    for runs in episodes.values():
        decisions, wall = sum(run.decisions for run in runs), sum(run.wall for run in runs)
        spent = {name: sum(run.phases[name] for run in runs) for name in PHASES}
        spent["everything else"] = wall - sum(spent.values())
        spent["all"] = wall
        columns.append({name: f"{1e3 * s / decisions:.2f} ({100 * s / wall:.0f} %)" for name, s in spent.items()})
    print("Where the time goes, ms a decision (share):\n")
    header = ("phase", *(f"{size}, {mode}" for size, mode in episodes))
    print(format_table(header, [[name, *(c[name] for c in columns)] for name in columns[0]], "markdown"), end="\n\n")


def rooms(configs: dict[str, EnvConfig], repetitions: int) -> None:
    """Print the seconds of an episode on a generated office of 25 rooms."""
    some = suite("office-test")
    plan = next(plan for plan in some.plans() if measure(plan)["rooms"] == ROOMS)
    rows = []
    for mode, config in configs.items():
        play(config, plan, seed=0, limit=10)
        runs = [play(config, plan, seed) for seed in range(repetitions)]
        rows.append([mode, f"{statistics.median(run.wall for run in runs):.2f}",
                     f"{statistics.median(run.cpu for run in runs):.2f}",
                     f"{statistics.median(run.decisions for run in runs):g}",
                     f"{statistics.median(run.info['distance'] for run in runs):.0f}",
                     f"{statistics.median(run.info['sim_time'] for run in runs):.0f}",
                     f"{sum(run.complete for run in runs)}/{len(runs)}"])  # fmt: skip
    print(f"One episode on {plan.name}: {plan.area:.0f} m2, {ROOMS} rooms, {len(plan.segments)} walls:\n")
    header = ("drive", "s (wall)", "s (CPU)", "decisions", "driven, m", "simulated, s", "complete")
    print(format_table(header, rows, "markdown"), end="\n\n")


def resident() -> float:
    """Memory of this process in RAM, MB."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        raise SystemExit("memory: needs /proc (Linux)") from None
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def memory(config: EnvConfig, decisions: int) -> None:
    """Print the memory over many decisions in one environment, episode after episode on nine plans."""
    plans = [plan_named(name) for name in MEMORY_PLANS]
    env = PolyExploreEnv(config=config)
    policy, rng = make_policy("nearest"), np.random.default_rng(0)
    samples, done, episode = [], 0, 0
    every = max(decisions // 10, 1)
    while done < decisions:
        observed, info = env.reset(seed=episode, options={"plan": plans[episode % len(plans)]})
        over = not info["action_mask"].any()
        episode += 1
        while not over and done < decisions:
            observed, _, terminated, truncated, info = env.step(policy.act(observed, info, rng))
            over = terminated or truncated
            done += 1
            if done % every == 0:
                samples.append((done, episode, resident()))
    print(f"Memory over {decisions} decisions in one environment ({episode} episodes, {len(plans)} plans in turn):\n")
    rows = [[f"{n}", f"{e}", f"{mb:.1f}"] for n, e, mb in samples]
    print(format_table(("decisions", "episodes", "resident, MB"), rows, "markdown"))
    half = samples[len(samples) // 2 - 1 :]
    print(f"\ngrowth: {samples[-1][2] - samples[0][2]:+.1f} MB since the first sample, "
          f"{half[-1][2] - half[0][2]:+.1f} MB in the second half\n")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = ("rate", "phases", "rooms", "memory")
    parser.add_argument("--only", nargs="+", choices=parts, default=parts, help="tables to print")
    parser.add_argument("--repetitions", type=int, default=3, help="episodes of each plan and drive")
    parser.add_argument("--decisions", type=int, default=10_000, help="of the memory check")
    parser.add_argument("--plans", type=Path, default=default_folder(), help="folder of plan JSON files")
    sensing.add_options(parser)
    arguments = parser.parse_args()
    configs = {
        mode: sensing.sensing_so(
            EnvConfig(drive=DriveConfig(mode=mode)),  # type: ignore[arg-type]
            arguments.sensing,
            arguments.scan_every,
        )
        for mode in MODES
    }
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    if {"rate", "phases"} & set(arguments.only):
        episodes = rates(configs, arguments.repetitions, arguments.plans)
        phases(episodes)
    if "rooms" in arguments.only:
        rooms(configs, arguments.repetitions)
    if "memory" in arguments.only:
        memory(configs["kinematic"], arguments.decisions)


if __name__ == "__main__":
    main()
