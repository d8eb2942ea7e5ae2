"""How far apart are the bounds on the best possible exploration, and what do they cost?

    python benchmarks/references.py [--plans FOLDER] [--largest 2000] [--first N] [--range 8] [--cache FOLDER]
                                    [--pictures FOLDER]

One row a plan, smallest first, one start each: the proven lower bound, the best known tour that senses along the way
(360 degrees) and the best known one that scans at stops only, the gap between the first two, the second tour driven
in the environment's world (kinematic): its way and the share of the checkpoints that its scans see, and CPU seconds.
Then medians by size. `--pictures` draws both tours, the witnesses and their viewer regions.

FOLDER (`--plans`) holds plan JSON files; default: `floorplans` under $POLYEXPLORE_DATA, or ../shared/data/floorplans
beside the checkout. With `--cache` references are kept, and a run that was stopped goes on where it was.
"""

from __future__ import annotations

import argparse
import itertools
import math
import statistics
from pathlib import Path

from plan_statistics import default_folder

from baselines.oracle import Reference, reference, replay, start_of
from baselines.oracle.sight import visibility_ring
from polyexplore_gym.config import DriveConfig, EnvConfig, SensorConfig
from polyexplore_gym.evaluation.tables import format_table
from polyexplore_gym.floorplan import FloorPlan, load_plan

SIZES = (0.0, 200.0, 1000.0, 2000.0, 4000.0, math.inf)
"""Groups of plans by area, m2."""


def draw(plan: FloorPlan, found: Reference, max_range: float, file: Path) -> None:
    """A picture: to the left the lower bound's witnesses and viewer regions, to the right both tours."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    x0, y0, x1, y1 = plan.bounds
    beside = (y1 - y0) > 0.8 * (x1 - x0)
    size = (13.0, 13.0 * (y1 - y0) / (2.0 * (x1 - x0)) + 0.8) if beside else (11.0, 22.0 * (y1 - y0) / (x1 - x0) + 1.0)
    figure, panels = plt.subplots(*((1, 2) if beside else (2, 1)), figsize=size, layout="constrained")
    for panel in panels:
        for ring in plan.rings:
            panel.fill(*ring.T, facecolor="white" if ring is plan.exterior else "0.85", edgecolor="0.35", linewidth=0.7)
        panel.plot(*found.start, marker="*", color="black", markersize=11, zorder=6)
        panel.set_aspect("equal")
        panel.axis("off")
        panel.margins(0.01)
    colours = plt.get_cmap("tab20").colors
    for k, witness in enumerate(found.witnesses):
        region = visibility_ring(plan.segments, witness, max_range)
        panels[0].fill(*region.T, color=colours[k % 20], alpha=0.3, linewidth=0)
        panels[0].plot(*witness, "o", color=colours[k % 20], markersize=4, markeredgecolor="black", markeredgewidth=0.4)
    panels[0].set_title(
        f"{plan.name}: {len(found.witnesses)} witnesses and from where each is seen: >= {found.lower:.1f} m"
    )
    scans = found.tour_stop_and_scan
    panels[1].plot(*scans.way.T, color="tab:orange", linewidth=2.4, alpha=0.8,
                   label=f"scans at stops, {found.upper_stop_and_scan:.1f} m")  # fmt: skip
    stops = [scans.legs[0][0], *(leg[-1] for leg in scans.legs)]
    panels[1].plot(*zip(*stops, strict=True), "o", color="tab:orange", markersize=4)
    panels[1].plot(*found.tour_sensing.way.T, color="tab:blue", linewidth=1.0,
                   label=f"sensing on the way, {found.upper_sensing:.1f} m")  # fmt: skip
    panels[1].set_title(f"best known tours: gap {found.gap:.2f}")
    panels[1].legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=2, fontsize=8, frameon=False)
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--largest", type=float, default=2000.0, help="only plans of at most so many m2")
    parser.add_argument("--first", type=int, help="only the first so many plans")
    parser.add_argument("--range", type=float, default=8.0, help="maximum range of the sensor, m")
    parser.add_argument("--plans", type=Path, default=default_folder(), help="folder of plan JSON files")
    parser.add_argument("--cache", type=Path, help="folder where references are kept")
    parser.add_argument("--pictures", type=Path, help="folder for a picture of each plan")
    options = parser.parse_args()
    plans = sorted((load_plan(path) for path in options.plans.glob("*.json")), key=lambda p: (p.area, p.name))
    plans = [p for p in plans if p.area <= options.largest][: options.first]
    if not plans:
        raise SystemExit(f"no plans in {options.plans}: name a folder with --plans")
    sensor = SensorConfig(max_range=options.range, field_of_view=2.0 * math.pi, beams=720)
    config = EnvConfig(sensor=sensor, drive=DriveConfig(mode="kinematic"))
    rows, figures = [], []
    for plan in plans:
        start = start_of(plan, 0)
        found = reference(plan, start, sensor, cache=options.cache)
        driven = replay(plan, start, found.tour_stop_and_scan, found.checkpoints(plan), config)
        seconds = sum(found.seconds.values())
        figures.append((plan.area, found.gap, seconds))
        rows.append([plan.name, f"{plan.area:.0f}", f"{found.lower:.2f}", f"{found.upper_sensing:.2f}",
                     f"{found.upper_stop_and_scan:.2f}", f"{found.gap:.3f}", f"{len(found.witnesses)}",
                     f"{driven.distance:.2f}", f"{100 * driven.coverage:.2f}", f"{seconds:.1f}"])  # fmt: skip
        print(*rows[-1], flush=True)
        if options.pictures is not None:
            draw(plan, found, options.range, options.pictures / f"{plan.name}.png")
    header = ("plan", "m2", "lower, m", "sensing, m", "stop and scan, m", "gap", "witnesses", "driven, m", "seen, %",
              "CPU, s")  # fmt: skip
    print(f"\n{format_table(header, rows, 'markdown')}\n")
    table = []
    for low, high in itertools.pairwise(SIZES):
        group = [f for f in figures if low < f[0] <= high]
        if group:
            gaps, seconds = [f[1] for f in group], [f[2] for f in group]
            table.append([f"{low:g} to {high:g}", f"{len(group)}", f"{statistics.median(gaps):.3f}",
                          f"{max(gaps):.3f}", f"{statistics.median(seconds):.1f}", f"{max(seconds):.1f}"])  # fmt: skip
    print(format_table(("m2", "plans", "gap, median", "largest", "CPU s, median", "largest"), table, "markdown"))


if __name__ == "__main__":
    main()
