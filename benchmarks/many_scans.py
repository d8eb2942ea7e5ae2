"""Does a wall seen a hundred times keep an honest covariance? And does a scan cost the same after ten thousand?

    python benchmarks/many_scans.py [--plans FOLDER] [--every 0.25] [--seeds 2] [--modes exact gaussian odometry slam]
    python benchmarks/many_scans.py --long 10000 [--modes exact slam]

Each plan is explored once with the exact pose (nearest node, in front, kinematic); the poses on the way, one every so
many metres, are then scanned anew under each pose model with its default errors, and the scans taken into a line map.
So all models see the same walls from the same places. A line is held against the wall that it was born of, by the true
pose, or one beside it that is nearer by its covariance.

- NEES of (rho, alpha) of the map's lines that are of one wall, mean and median (2 and 1.39 are right), and the share
  beyond 13.8 (0.1 % is right), by the number of scans that a line was fed by; for all lines and those of 2 m and more.
- RMSE: root of the mean squared offset (mm) and angle (mrad) at the middle of a line's longest segment.
- Of the pose in the mode slam: NEES (3 is right).
- Lines and segments left; share of the wall length within 5 cm of a segment that faces the same way (recall) and of the
  segments' length within 5 cm of a wall (precision); the same of end points within 10 cm (precision against corners of
  the plan). "nodes": the same exploration with scans at nodes only.

With `--long` the way through one plan is driven to and fro: ms a scan (extraction; insertion with all that
belongs to it) and what the map holds, every tenth of the way.

FOLDER (`--plans`) holds plan JSON files; default: `floorplans` under $POLYEXPLORE_DATA, or ../shared/data/floorplans
beside the checkout; without them only generated plans are used.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from plan_statistics import default_folder
from tqdm import tqdm

from baselines import make_policy
from polyexplore_gym.config import EnvConfig, MappingConfig, PoseConfig, SensorConfig, from_mapping
from polyexplore_gym.env import PolyExploreEnv, _with_stops
from polyexplore_gym.evaluation.tables import format_table
from polyexplore_gym.floorplan import FloorPlan, load_plan, suite
from polyexplore_gym.mapping import LineMap, Localizer, ScanLines, extract_lines
from polyexplore_gym.mapping.fit import shift, wrap
from polyexplore_gym.sim.laser import Laser
from polyexplore_gym.sim.pose import PoseModel

GENERATED = (("home-test", (1, 4)), ("office-test", (0, 3)), ("angled-test", (0, 5)))
SHARED = ("house_he_2deaa98e", "house_vimantic_23", "home_giraff_ex3", "lab_uma_236_237", "apartments_mlstruct_966")
CLASSES = ((1, 5), (6, 20), (21, 100), (101, 10**9))
LONG = 2.0
RADIUS = 0.25
NEAR = 0.05
"""A line whose segment lay farther off any wall (mean, m) when it was born is of no one wall: it cuts a corner."""


def way(plan: FloorPlan, every: float, seed: int) -> list[np.ndarray]:
    """True poses: a list of (m, 3), each the way to the next scan, from an exploration that scans at nodes only or on
    the way as well."""
    config = from_mapping(EnvConfig, {
        "drive": {"mode": "kinematic"}, "exploration": {"placement": "in_front", "scan_every": every},
        "observation": {"pairwise": False}, "max_decisions": 600,
    })  # fmt: skip
    env = PolyExploreEnv(plan=plan, config=config)
    policy, rng = make_policy("nearest"), np.random.default_rng(seed)
    seen, info = env.reset(seed=seed)
    ended = not info["action_mask"].any()
    while not ended:
        seen, _, terminated, truncated, info = env.step(policy.act(seen, info, rng))
        ended = terminated or truncated
    moment = env.snapshot()
    out, at = [], 0
    for pose in moment.measured_at:
        same = np.flatnonzero((moment.trajectory[at:] == pose).all(axis=1))
        to = at + int(same[0])
        out.append(moment.trajectory[at : to + 1])
        at = to
    return out


@dataclass
class Mapped:
    """A line map made along a way, and what is known of how true it is."""

    line_map: LineMap
    localizer: Localizer | None
    wall: dict[int, tuple[int, int]] = field(default_factory=dict)
    """Line slot: insert that it was born in, wall."""
    scans: dict[int, int] = field(default_factory=dict)
    pose_nees: list[float] = field(default_factory=list)


def follow(plan: FloorPlan, poses: list[np.ndarray], mode: str, seed: int) -> Mapped:
    """Scan along a way under a pose model."""
    sensor = SensorConfig()
    laser, model_rng, rng = Laser(sensor), np.random.default_rng([seed, 1]), np.random.default_rng([seed, 2])
    model = PoseModel(PoseConfig(mode=mode), poses[0][0], model_rng)  # type: ignore[arg-type]
    mapping = MappingConfig().resolved(RADIUS)
    out = Mapped(LineMap(mapping, sensor), Localizer() if mode == "slam" else None)
    for trajectory in poses:
        true = trajectory[-1]
        drive(out, plan, laser, model, trajectory, rng)
        ranges = laser.measure(plan.segments, true, rng)
        lines = extract_lines(laser.angles, ranges, sensor, mapping)
        insert(out, lines, model, true, mode)
        note(out, plan, true, model.estimate)
    return out


def drive(
    mapped: Mapped, plan: FloorPlan, laser: Laser, model: PoseModel, trajectory: np.ndarray, rng: np.random.Generator
) -> None:
    """Move on; in the mode slam the pose is also corrected in turns, as the environment does."""
    done = 0
    if mapped.localizer is not None:
        trajectory, stops = _with_stops(trajectory, model.config.correct_every, turns=True)
        for stop in stops:
            model.moved(trajectory[done : stop + 1])
            ranges = laser.measure(plan.segments, trajectory[stop], rng)
            lines = extract_lines(laser.angles, ranges, laser.config, mapped.line_map.config)
            fix = mapped.localizer.correct(lines, mapped.line_map, *model.measured(trajectory[stop]))
            model.correct(fix.pose, fix.covariance)
            done = stop
    model.moved(trajectory[done:])


def insert(mapped: Mapped, lines: ScanLines, model: PoseModel, true: np.ndarray, mode: str) -> None:
    """Take a scan into the map, as the environment does."""
    estimate, covariance = model.measured(true)
    if mapped.localizer is None:
        mapped.line_map.insert(lines, estimate, covariance, drifting=mode == "odometry")
        return
    fix = mapped.localizer.correct(lines, mapped.line_map, estimate, covariance)
    model.correct(fix.pose, fix.covariance)
    mapped.line_map.insert(lines, fix.pose, fix.relative)
    mapped.localizer.learn(mapped.line_map)
    if np.linalg.det(fix.covariance) > 0.0:
        e = true - fix.pose
        e[2] = wrap(e[2])
        mapped.pose_nees.append(float(e @ np.linalg.solve(fix.covariance, e)))


def note(mapped: Mapped, plan: FloorPlan, true: np.ndarray, estimate: np.ndarray) -> None:
    """Which lines the last scan fed, and which walls new lines are."""
    line_map = mapped.line_map
    table = line_map.tables[1]
    stamp = int(line_map._slots.counts[2])
    n = line_map.rho.size
    for j in np.flatnonzero(table.alive[:n] & (table.fed[:n] == stamp).any(axis=1)).tolist():
        if mapped.wall.get(j, (0, 0))[0] != table.born[j]:
            turn = true[2] - estimate[2]
            c, s = math.cos(turn), math.sin(turn)
            row = longest(line_map, j).reshape(2, 2) - estimate[:2]
            points = row @ np.array([[c, s], [-s, c]]) + true[:2]
            mapped.wall[j] = int(table.born[j]), nearest_wall(plan.segments, points)
            mapped.scans[j] = 0
        mapped.scans[j] += 1


def longest(line_map: LineMap, j: int) -> np.ndarray:
    """The longest segment (4,) of line j."""
    rows = line_map.segments[line_map.alive & (line_map.line == j)]
    return rows[np.argmax(np.hypot(rows[:, 2] - rows[:, 0], rows[:, 3] - rows[:, 1]))]


def nearest_wall(walls: np.ndarray, points: np.ndarray) -> int:
    """The wall nearest to a segment (2, 2) that faces the same way, -1 if there is none so near that it could be it."""
    t = np.linspace(0.1, 0.9, 9)[:, None]
    along = points[1] - points[0]
    off = np.array([distances(points[0] + t * along, wall).mean() for wall in walls])
    off[facing(walls, along) > 0.3] = math.inf
    return int(np.argmin(off)) if off.min() < NEAR else -1


def facing(walls: np.ndarray, along: np.ndarray) -> np.ndarray:
    """(M,) angle between walls and a direction, rad."""
    turn = np.arctan2(walls[:, 3] - walls[:, 1], walls[:, 2] - walls[:, 0]) - math.atan2(along[1], along[0])
    return np.abs(np.remainder(turn + math.pi, 2.0 * math.pi) - math.pi)


def distances(points: np.ndarray, wall: np.ndarray) -> np.ndarray:
    """(k,) distance of points (k, 2) from one wall (4,), m."""
    d = wall[2:] - wall[:2]
    t = np.clip((points - wall[:2]) @ d / max(float(d @ d), 1e-18), 0.0, 1.0)
    return np.hypot(*(points - wall[:2] - t[:, None] * d).T)


def errors(line: tuple[float, float, np.ndarray], wall: np.ndarray, at: np.ndarray) -> tuple[float, float, float]:
    """NEES of a line, its angle's and its offset's error, in a frame shifted to `at`."""
    rho, alpha, p = line
    true_alpha = math.atan2(wall[0] - wall[2], wall[3] - wall[1])
    true_rho = wall[0] * math.cos(true_alpha) + wall[1] * math.sin(true_alpha)
    if abs(wrap(alpha - true_alpha)) > 0.5 * math.pi:
        true_rho, true_alpha = -true_rho, true_alpha + math.pi
    offset, cov, var = shift(rho, alpha, p[0, 0], p[0, 1], p[1, 1], at[0], at[1])
    e = np.array([wrap(alpha - true_alpha), offset - (true_rho - at @ [math.cos(true_alpha), math.sin(true_alpha)])])
    return float(e @ np.linalg.solve(np.array([[p[0, 0], cov], [cov, var]]), e)), float(e[0]), float(e[1])


def judged(mapped: Mapped, plan: FloorPlan) -> np.ndarray:
    """(lines, 5) of walls: scans, length of the longest segment (m), NEES, error of angle (rad) and offset (m)."""
    line_map, out = mapped.line_map, []
    covariance = line_map.covariance if mapped.localizer is None else mapped.localizer.covariance(line_map)
    for j in np.flatnonzero(line_map.line_alive).tolist():
        if mapped.wall[j][1] < 0:
            continue
        row = longest(line_map, j)
        at, length = 0.5 * (row[:2] + row[2:]), math.dist(row[:2], row[2:])
        own = plan.segments[mapped.wall[j][1]]
        middle = 0.5 * (own[:2] + own[2:])
        # walls beside it: a scan may have taken its line half from one and half from the other
        along = own[2:] - own[:2]
        reach = 0.5 * math.hypot(*along) + 0.3
        beside = [
            w for w in plan.segments
            if facing(w[None], along)[0] < 0.2 and distances(own.reshape(2, 2), w).min() < 0.3
            and distances(middle[None], w)[0] < reach
        ]  # fmt: skip
        line = float(line_map.rho[j]), float(line_map.alpha[j]), covariance[j]
        out.append((mapped.scans[j], length, *min(errors(line, w, at) for w in beside)))
    return np.array(out).reshape(-1, 5)


def shape(mapped: Mapped, plan: FloorPlan) -> tuple[int, int, int, float, float, float]:
    """Lines, those of no one wall, segments; recall and precision of walls, precision of end points."""
    line_map = mapped.line_map
    rows = line_map.segments[line_map.alive & (line_map.line >= 0)]
    walls = plan.segments

    def covered(these: np.ndarray, those: np.ndarray) -> float:
        hit = total = 0.0
        for a in these:
            length = math.dist(a[:2], a[2:])
            t = np.linspace(0.0, 1.0, max(2, math.ceil(length / 0.05)))[:, None]
            points = a[:2] + t * (a[2:] - a[:2])
            like = those[facing(those, a[2:] - a[:2]) < 0.3]
            off = np.min([distances(points, b) for b in like], axis=0) if len(like) else np.full(len(t), 9.0)
            hit, total = hit + length * float((off < 0.05).mean()), total + length
        return hit / total

    ends = rows.reshape(-1, 2)
    corners = walls[:, :2]
    off = np.min(np.hypot(*(ends[:, None] - corners[None]).transpose(2, 0, 1)), axis=1)
    lines = np.flatnonzero(line_map.line_alive).tolist()
    none = sum(mapped.wall[j][1] < 0 for j in lines)
    return len(lines), none, len(rows), covered(walls, rows), covered(rows, walls), float((off < 0.1).mean())


def table(rows: np.ndarray) -> list[list[str]]:
    """Figures by class of scans."""
    out = []
    for low, high in CLASSES:
        of = rows[(rows[:, 0] >= low) & (rows[:, 0] <= high)]
        name = f"{low}-{high}" if high < 10**9 else f"{low} or more"
        if len(of):
            value = of[:, 2]
            out.append([
                name, str(len(of)), f"{value.mean():.2f} +- {value.std() / math.sqrt(len(of)):.2f}",
                f"{np.median(value):.2f}", f"{100 * (value > 13.8).mean():.1f}",
                f"{1e3 * math.sqrt((of[:, 4] ** 2).mean()):.2f}", f"{1e3 * np.median(np.abs(of[:, 4])):.2f}",
                f"{1e3 * math.sqrt((of[:, 3] ** 2).mean()):.2f}",
            ])  # fmt: skip
    return out


HEADER = ("scans", "lines", "NEES", "median", "> 13.8 %", "offset RMSE mm", "median mm", "angle RMSE mrad")


def study(plans: list[FloorPlan], every: float, seeds: int, modes: list[str]) -> None:
    """Print the tables of the NEES."""
    ways = {(p.name, e): way(p, e, 0) for p in tqdm(plans, desc="explorations", leave=False) for e in (every, 0.0)}
    for mode in modes:
        rows, shapes, nodes, pose = [], [], [], []
        for plan in tqdm(plans, desc=mode, leave=False):
            for seed in range(seeds):
                mapped = follow(plan, ways[plan.name, every], mode, seed)
                rows.append(judged(mapped, plan))
                pose.extend(mapped.pose_nees)
                shapes.append(shape(mapped, plan))
                nodes.append(shape(follow(plan, ways[plan.name, 0.0], mode, seed), plan))
        every_row = np.concatenate(rows)
        print(f"\n{mode}: all lines")
        print(format_table(HEADER, table(every_row)))
        print(f"\n{mode}: lines of {LONG:g} m and more")
        print(format_table(HEADER, table(every_row[every_row[:, 1] >= LONG])))
        if pose:
            print(f"pose NEES {np.mean(pose):.2f}, median {np.median(pose):.2f}")
        for name, of in ((f"every {every:g} m", shapes), ("nodes", nodes)):
            a = np.array(of)
            print(
                f"{name:14s} lines {a[:, 0].mean():.1f} ({a[:, 1].mean():.1f} of no one wall), segments "
                f"{a[:, 2].mean():.1f}, wall recall {a[:, 3].mean():.4f}, precision {a[:, 4].mean():.4f}, "
                f"end points at corners {a[:, 5].mean():.3f}"
            )


def long_run(plan: FloorPlan, every: float, scans: int, mode: str) -> None:
    """Print time and size over many scans along one way, to and fro."""
    sensor, mapping, rng = SensorConfig(), MappingConfig().resolved(RADIUS), np.random.default_rng(2)
    laser, forth = Laser(sensor), way(plan, every, 0)
    back = [trajectory[::-1] for trajectory in forth[::-1]]
    poses = itertools.islice(itertools.cycle(forth + back), scans)
    model = PoseModel(PoseConfig(mode=mode), forth[0][0], np.random.default_rng(1))  # type: ignore[arg-type]
    mapped = Mapped(LineMap(mapping, sensor), Localizer() if mode == "slam" else None)
    rows, spent, before = [], np.zeros(2), 0
    for k, trajectory in enumerate(poses):
        drive(mapped, plan, laser, model, trajectory, rng)
        ranges = laser.measure(plan.segments, trajectory[-1], rng)
        begin = time.thread_time()
        lines = extract_lines(laser.angles, ranges, sensor, mapping)
        middle = time.thread_time()
        insert(mapped, lines, model, trajectory[-1], mode)
        if k >= 10:
            spent += middle - begin, time.thread_time() - middle
        if (k + 1) % max(scans // 10, 1) == 0:
            n, alive = k + 1 - max(before, 10), mapped.line_map.alive
            kinds = (
                mapped.line_map.line_alive,
                alive & (mapped.line_map.line >= 0),
                alive & (mapped.line_map.line < 0),
            )
            size = sum(array.nbytes for part in mapped.line_map.tables[:3] for array in part if np.ndim(array))
            if mapped.localizer is not None:
                size += sum(a.nbytes for a in vars(mapped.localizer).values() if isinstance(a, np.ndarray))
            rows.append([
                str(k + 1), *(f"{1e3 * s / n:.3f}" for s in spent), *(str(int(kind.sum())) for kind in kinds),
                str(alive.size), f"{size / 1e3:.0f}",
            ])  # fmt: skip
            spent[:], before = 0.0, k + 1
    print(f"\n{plan.name}, {mode}")
    print(format_table(("scans", "extract ms", "insert ms", "lines", "segments", "fragments", "rows", "kB"), rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plans", type=Path, default=default_folder(), help="folder of plan JSON files")
    parser.add_argument("--every", type=float, default=0.25, help="way between scans, m")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first", type=int, default=None, help="only so many plans")
    parser.add_argument("--modes", nargs="+", default=["exact", "gaussian", "odometry", "slam"])
    parser.add_argument("--long", type=int, default=0, help="instead: so many scans of one plan")
    options = parser.parse_args()
    plans = [suite(name).plan(i) for name, which in GENERATED for i in which]
    files = [Path(options.plans) / f"{name}.json" for name in SHARED] if options.plans else []
    plans += [load_plan(file, radius=RADIUS) for file in files if file.is_file()]
    if options.long:
        for plan in (suite("office-test").plan(0), plans[-1]):
            for mode in options.modes:
                long_run(plan, options.every, options.long, mode)
    else:
        study(plans[: options.first], options.every, options.seeds, options.modes)


if __name__ == "__main__":
    main()
