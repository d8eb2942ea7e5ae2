"""What grouping and merging do for the line map: the tables and figures 8 to 11 of the source paper.

Three data sets: a whole exploration of a generated office with noise and an uncertain pose, recorded once, and two
real CARMEN logs. The same scans, in the same order, go to every variant: without grouping and merging, with either,
with both; beside these both with the paper's gate of 3, and with the default start instead of the Hough transform.
Without merging every line of every scan stays. The variants take turns scan by scan, so that their times compare.

    python benchmarks/line_ablation.py [--data FOLDER] [--out FOLDER] [--plan office-test/6] [--seed 0]

FOLDER (`--data`) holds `laser_logs`; default: $POLYEXPLORE_DATA, or ../shared/data beside the checkout. Logs that are
not there are left out. `--out` also draws a figure of each data set.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numba import njit
from real_logs import read
from scipy.spatial import cKDTree

import polyexplore_gym.env as environment
from baselines import make_policy
from polyexplore_gym.config import DriveConfig, EnvConfig, MappingConfig, PoseConfig, SensorConfig
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.evaluation.tables import format_table
from polyexplore_gym.floorplan import suite
from polyexplore_gym.mapping import LineMap, ScanLines, extract_lines
from polyexplore_gym.scan import Scan

LOGS = ("csail", "intel")
LOG_POSE = np.diag([0.02, 0.02, math.radians(0.3)]) ** 2
"""Covariance assumed of the logs' corrected poses, m2 and rad2 (the logs give none)."""
LOG_FLOOR = 0.01
"""Standard deviation of range assumed on real logs, m."""
RIGHT_OFFSET, RIGHT_TURN = 0.05, math.radians(3.0)
"""A segment whose middle lies within this of a true wall, and whose direction agrees so well, is right, m and rad."""
SEEN, FOUND = 0.05, 0.1
"""A piece of true wall was seen with a return within the one, and is found with a segment within the other, m."""
STEP = 0.05
"""Segments and true walls are compared every so many metres."""
REACH, FACING = 0.3, math.radians(30.0)
"""A return belongs to the nearest segment of the map within this (m) that faces like its line in the scan (rad)."""


@dataclass(frozen=True)
class Variant:
    name: str
    merging: bool
    config: MappingConfig
    paper: str = "-"
    """Lines in the paper, of about 11,000 points."""


HOUGH = MappingConfig(start="hough")
APART = MappingConfig(start="hough", grouping=False)
VARIANTS = (
    Variant("neither", False, APART, "886 (100 %)"),
    Variant("grouping only", False, HOUGH, "416 (47 %)"),
    Variant("merging only", True, APART, "545 (62 %)"),
    Variant("both", True, HOUGH, "324 (37 %)"),
)
"""The paper's four."""
ASIDE = (
    Variant("both, gate 3", True, MappingConfig(start="hough", merge_gate=3.0)),
    Variant("both, end-point start", True, MappingConfig(start="endpoint")),
)


@dataclass(frozen=True)
class Recording:
    """Scans (n beams) and where they were taken, as far as the robot knows."""

    name: str
    sensor: SensorConfig
    floor: float
    angles: np.ndarray
    ranges: np.ndarray
    """(S, n)"""
    poses: np.ndarray
    """(S, 3)"""
    covariances: np.ndarray
    """(S, 3, 3)"""
    walls: np.ndarray | None = None
    """(M, 4) true walls, where they are known."""


@dataclass
class Built:
    """What a variant made of a recording."""

    found: list[ScanLines]
    segments: np.ndarray
    """(K, 4) in the map frame."""
    segment_line: np.ndarray
    """(K,) line of each segment."""
    seconds: float
    """Median of a scan."""

    @property
    def lines(self) -> int:
        return np.unique(self.segment_line).size


def explored(plan: str, seed: int) -> Recording:
    """All scans of one exploration with the default laser and a Gaussian pose error."""
    family, _, number = plan.partition("/")
    floor_plan = suite(family).plan(int(number))
    config = EnvConfig(drive=DriveConfig(mode="kinematic"), pose=PoseConfig(mode="gaussian"))
    env, policy, rng = PolyExploreEnv(floor_plan, config=config), make_policy("nearest"), np.random.default_rng(seed)
    scans: list[Scan] = []

    def recorded(*arguments: Any) -> Scan:
        scans.append(Scan(*arguments))
        return scans[-1]

    with mock.patch.object(environment, "Scan", recorded):
        observed, info = env.reset(seed=seed)
        over = not info["action_mask"].any()
        while not over:
            observed, _, terminated, truncated, info = env.step(policy.act(observed, info, rng))
            over = terminated or truncated
    print(f"{plan}: {info['distance']:.0f} m driven, {100 * info['coverage']:.1f} % seen, {len(scans)} scans")
    return Recording(
        name=plan,
        sensor=config.sensor,
        floor=0.0,
        angles=scans[0].angles,
        ranges=np.array([s.ranges for s in scans]),
        poses=np.array([s.pose for s in scans]),
        covariances=np.array([s.covariance for s in scans]),
        walls=floor_plan.segments,
    )


def logged(path: Path) -> Recording:
    angles, ranges, poses = read(path)
    sensor = SensorConfig(max_range=30.0, sigma_range=0.01, sigma_angle=math.radians(0.1))
    covariances = np.broadcast_to(LOG_POSE, (len(poses), 3, 3))
    return Recording(path.name.split("-")[0], sensor, LOG_FLOOR, angles, ranges, poses, covariances)


def build(recording: Recording, variants: tuple[Variant, ...]) -> list[Built]:
    """The line map of every variant."""
    configs = [replace(v.config, range_floor=recording.floor) for v in variants]
    maps = [LineMap(config, recording.sensor) for config in configs]
    found: list[list[ScanLines]] = [[] for _ in variants]
    seconds: list[list[float]] = [[] for _ in variants]
    for k in range(len(recording.poses)):
        for variant, config, line_map, scans, times in zip(variants, configs, maps, found, seconds, strict=True):
            began = time.perf_counter()
            scans.append(extract_lines(recording.angles, recording.ranges[k], recording.sensor, config))
            if variant.merging:
                line_map.insert(scans[-1], recording.poses[k], recording.covariances[k])
            times.append(time.perf_counter() - began)
    out = []
    for variant, line_map, scans, times in zip(variants, maps, found, seconds, strict=True):
        if variant.merging:
            rows = line_map.alive & (line_map.line >= 0)
            segments, of = line_map.segments[rows], line_map.line[rows]
        else:
            first = np.cumsum([0, *(s.rho.size for s in scans[:-1])])
            segments = np.vstack([placed(s.segments, p) for s, p in zip(scans, recording.poses, strict=True)])
            of = np.concatenate([s.segment_line + n for s, n in zip(scans, first, strict=True)])
        out.append(Built(scans, segments, of, float(np.median(times))))
    return out


def placed(segments: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Segments (K, 4) of the robot frame in the map frame."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return (segments.reshape(-1, 2) @ np.array([[c, s], [-s, c]]) + pose[:2]).reshape(-1, 4)


def placed_points(recording: Recording, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns (m, 2) of scan k in the map frame, and their beams."""
    beams = np.flatnonzero(recording.ranges[k] < recording.sensor.max_range)
    t, r, pose = recording.angles[beams] + recording.poses[k, 2], recording.ranges[k, beams], recording.poses[k]
    return np.c_[pose[0] + r * np.cos(t), pose[1] + r * np.sin(t)], beams


def all_points(recording: Recording) -> np.ndarray:
    """(returns, 2) in the map frame, m."""
    return np.vstack([placed_points(recording, k)[0] for k in range(len(recording.poses))])


def residuals(recording: Recording, built: Built, merging: bool) -> np.ndarray:
    """Distance of every return on a line of its scan to that line, or to the map's line in its place if any, m."""
    out = []
    for k, lines in enumerate(built.found):
        points, beams = placed_points(recording, k)
        on = lines.point_segment[beams]
        points, own = points[on >= 0], placed(lines.segments, recording.poses[k])[on[on >= 0]]
        out.append(distances(points, own, built.segments if merging else own, merging))
    off = np.concatenate(out)
    return off[np.isfinite(off)]


@njit(cache=True)
def distances(points: np.ndarray, own: np.ndarray, segments: np.ndarray, search: bool) -> np.ndarray:
    """(m,) distance of points from the line through own[k], or through the nearest of the segments facing like it.

    inf where none is within reach.
    """
    out = np.full(len(points), math.inf)
    for k in range(len(points)):
        px, py = points[k]
        u = math.atan2(own[k, 3] - own[k, 1], own[k, 2] - own[k, 0])
        nearest = REACH * REACH
        for j in range(len(segments) if search else 1):
            s = segments[j] if search else own[k]
            dx, dy = s[2] - s[0], s[3] - s[1]
            turn = math.atan2(dy, dx) - u
            if abs((turn + math.pi) % (2 * math.pi) - math.pi) > FACING:
                continue
            length = max(math.hypot(dx, dy), 1e-9)
            t = ((px - s[0]) * dx + (py - s[1]) * dy) / length
            beyond = max(-t, t - length, 0.0)
            off = abs((px - s[0]) * dy - (py - s[1]) * dx) / length
            if beyond * beyond + off * off < nearest:
                nearest, out[k] = beyond * beyond + off * off, off
    return out


def against_truth(segments: np.ndarray, walls: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Samples' distance from the true walls, m; shares of segments that are right, and of wall seen that is found."""
    off = from_segments(samples(segments)[0], walls).min(axis=1)
    turn = turned(segments, walls)
    near = from_segments(0.5 * (segments[:, :2] + segments[:, 2:]), walls) < RIGHT_OFFSET
    right = (near & (turn < RIGHT_TURN)).any(axis=1)
    on_walls, wall = samples(walls)
    near = from_segments(on_walls, segments) < FOUND
    found = (near & (turn.T[wall] < FACING)).any(axis=1)
    seen = cKDTree(points).query(on_walls)[0] < SEEN
    return off, float(right.mean()), float(found[seen].mean())


def samples(segments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(m, 2) points every 5 cm or less along the segments, and the segment of each."""
    count = np.maximum(np.ceil(np.hypot(*(segments[:, 2:] - segments[:, :2]).T) / STEP), 1).astype(int)
    of = np.repeat(np.arange(len(segments)), count)
    t = np.concatenate([(np.arange(n) + 0.5) / n for n in count])[:, None]
    return segments[of, :2] + t * (segments[of, 2:] - segments[of, :2]), of


def turned(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(K, M) angle between each pair of segments, whichever way they point, rad in [0, pi / 2]."""
    u, v = (np.arctan2(s[:, 3] - s[:, 1], s[:, 2] - s[:, 0]) for s in (a, b))
    return np.abs(np.remainder(u[:, None] - v + 0.5 * np.pi, np.pi) - 0.5 * np.pi)


def from_segments(points: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """(m, M) distance of each point from each segment, m."""
    along = segments[:, 2:] - segments[:, :2]
    t = ((points @ along.T) - (segments[:, :2] * along).sum(1)) / np.maximum((along**2).sum(1), 1e-18)
    foot = segments[:, :2] + np.clip(t, 0, 1)[..., None] * along
    return np.hypot(points[:, :1] - foot[..., 0], points[:, 1:] - foot[..., 1])


def report(recording: Recording, variants: tuple[Variant, ...], maps: list[Built]) -> str:
    points = int((recording.ranges < recording.sensor.max_range).sum())
    header = ["variant", "lines", "share %", "points a line", "compression %", "on lines %", "median mm", "RMS mm"]
    header += ["walls mm", "walls RMS", "right %", "found %"] if recording.walls is not None else []
    header += ["ms a scan", "times", "paper"]
    rows = []
    for variant, built in zip(variants, maps, strict=True):
        off = residuals(recording, built, variant.merging)
        row = [
            variant.name,
            f"{built.lines}",
            f"{100 * built.lines / maps[0].lines:.0f}",
            f"{off.size / built.lines:.0f}",
            f"{100 * (1 - built.lines / points):.2f}",
            f"{100 * off.size / points:.1f}",
            f"{1e3 * np.median(off):.1f}",
            f"{1e3 * np.sqrt(np.mean(off**2)):.1f}",
        ]
        if recording.walls is not None:
            error, right, found = against_truth(built.segments, recording.walls, all_points(recording))
            row += [f"{1e3 * error.mean():.1f}", f"{1e3 * np.sqrt(np.mean(error**2)):.1f}"]
            row += [f"{100 * right:.1f}", f"{100 * found:.1f}"]
        rows.append([*row, f"{1e3 * built.seconds:.2f}", f"{built.seconds / maps[3].seconds:.2f}", variant.paper])
    title = f"{recording.name}: {len(recording.poses)} scans, {points} points"
    return f"{title}\n{format_table(header, rows)}\n"


LEGEND = """\
share: of the lines with neither; compression: 1 - lines / points; on lines: returns with a line, of their scan or (with
merging) of the map; median, RMS: distance of those returns from it, with merging including the error of the pose;
walls: mean and RMS distance of the lines from the true walls; right: segments within 5 cm and 3 degrees of a true wall;
found: share of the length of wall seen that has a segment within 10 cm and 30 degrees; ms a scan: median; times: over
the cost of both; paper: lines of about 11,000 points, and their share. Fragments, short pieces without a fitted line,
count neither as lines nor as points on lines."""


INK, POINTS, WALLS, FRAME = "#1f1f1f", "#9ecae1", "#d9d9d9", "#d55e00"
# Okabe and Ito's colours, purple for the sky blue of the points
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#7b3294", "#1f1f1f")
DETAIL = 0.22
"""Side of the piece enlarged, over the size of the map."""


def draw(recording: Recording, maps: list[Built], path: Path) -> None:
    """A column for each of the paper's variants: the whole map, and a piece of it enlarged."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Rectangle

    points = all_points(recording)
    low, high = np.percentile(points, 0.2, axis=0) - 0.5, np.percentile(points, 99.8, axis=0) + 0.5
    side = DETAIL * float(np.sqrt(np.prod(high - low)))
    corner = busiest(maps[3].segments, side)
    # inches, from below: footer, details, gap, whole maps, titles
    panel, gap, footer, title = 3.5, 0.1, 0.35, 0.3
    tall = panel * (high - low)[1] / (high - low)[0]
    size = 4 * panel + 5 * gap, footer + panel + gap + tall + title
    figure = plt.figure(figsize=size, dpi=200)
    for i, (variant, built) in enumerate(zip(VARIANTS, maps[: len(VARIANTS)], strict=True)):
        left = (gap + i * (panel + gap)) / size[0]
        whole = figure.add_axes((left, (footer + panel + gap) / size[1], panel / size[0], tall / size[1]))
        detail = figure.add_axes((left, footer / size[1], panel / size[0], panel / size[1]))
        pieces = list(built.segments.reshape(-1, 2, 2))
        thin = max(1, len(points) // 20_000)
        whole.plot(*points[::thin].T, ".", color=POINTS, markersize=1.2, markeredgewidth=0, zorder=1)
        whole.add_collection(LineCollection(pieces, colors=INK, linewidths=0.6, capstyle="round", zorder=2))
        whole.add_patch(Rectangle(tuple(corner), side, side, fill=False, edgecolor=FRAME, linewidth=1.1, zorder=3))
        whole.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        if recording.walls is not None:
            walls = list(recording.walls.reshape(-1, 2, 2))
            detail.add_collection(LineCollection(walls, colors=WALLS, linewidths=5, capstyle="round", zorder=0))
        detail.plot(*points.T, ".", color=POINTS, markersize=1.8, markeredgewidth=0, zorder=1)
        colors = [COLORS[k % len(COLORS)] for k in np.unique(built.segment_line, return_inverse=True)[1]]
        detail.add_collection(LineCollection(pieces, colors=colors, linewidths=1.3, capstyle="round", zorder=2))
        detail.set(xlim=(corner[0], corner[0] + side), ylim=(corner[1], corner[1] + side))
        for axes, color in ((whole, "#cccccc"), (detail, FRAME)):
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set(color=color, linewidth=0.8)
        whole.set_title(f"({'abcd'[i]}) {variant.name}: {built.lines:,} lines", fontsize=11, color=INK, pad=5)
    walls = "" if recording.walls is None else ", over the true walls (grey)"
    note = (
        f"Lines over all returns (blue) of {len(recording.poses)} scans; the map is {high[0] - low[0]:.0f} m wide. "
        f"Below, {side:.1f} m of it: each line in a colour of its own{walls}."
    )
    figure.text(gap / size[0], 0.12 / size[1], note, fontsize=9, color=INK)
    figure.savefig(path)
    plt.close(figure)


def busiest(segments: np.ndarray, side: float) -> np.ndarray:
    """Lower left corner (2,) of a square of this side about a crowd: where the middles of most segments lie."""
    middle = 0.5 * (segments[:, :2] + segments[:, 2:])
    inside = (np.abs(middle[:, None] - middle) < 0.5 * side).all(axis=2)
    return middle[inside[np.argmax(inside.sum(axis=1))]].mean(axis=0) - 0.5 * side


def data_folder() -> Path:
    return Path(os.environ.get("POLYEXPLORE_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=data_folder(), help="folder with laser_logs")
    parser.add_argument("--out", type=Path, help="folder for a figure of each data set")
    parser.add_argument("--plan", default="office-test/6", help="generated plan to explore")
    parser.add_argument("--seed", type=int, default=0, help="of the start and the noise")
    arguments = parser.parse_args()
    recordings = [explored(arguments.plan, arguments.seed)]
    logs = [arguments.data / "laser_logs" / f"{name}-corrected.log.gz" for name in LOGS]
    recordings += [logged(path) for path in logs if path.exists()]
    build(recordings[0], (*VARIANTS, *ASIDE))  # compiles
    for recording in recordings:
        maps = build(recording, (*VARIANTS, *ASIDE))
        print(report(recording, (*VARIANTS, *ASIDE), maps))
        if arguments.out:
            arguments.out.mkdir(parents=True, exist_ok=True)
            draw(recording, maps, arguments.out / f"{recording.name.replace('/', '-')}.png")
    print(LEGEND)


if __name__ == "__main__":
    main()
