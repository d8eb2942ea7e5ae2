"""Did an exploration end because nothing was left? The exact check of one episode, with the floor plan known.

    python benchmarks/exact.py PLAN.json [--config FILE] [--policy nearest] [--placement in_front] [--seed 0]
                               [--drive kinematic] [--set sensor.max_range=20 ...] [--sampled] [--picture out.png]

`left_over` is the library behind it, for other scripts and for tests. An exploration is complete when no place that
the robot's disc can reach would show more floor that none of its scans saw than `limit`: 8 radius^2 (0.5 m2 for a
robot of 0.25 m), so that the measure scales with the robot.

How exact is it? Floor seen: the union of the visibility polygons of all scans, from their true poses, within field of
view and range: exact but for circles, which are drawn from outside (by at most 2 % of the radius). What a place would
show: its visibility polygon, all headings, less that union, circles drawn from inside; so that both errors speak for
the robot. Places: the part of the free space, eroded by the radius, that holds the start; a grid of one radius (coarser
where there would be more than `MOST_PLACES`), all its reflex corners (the disc in contact with a wall's corner: where
doorways open up), and finer ones round the best. Which places are looked at exactly is decided by samples of the unseen
floor of half a radius (or `MOST_SAMPLES` of them); if all the unseen floor is less than the limit none is.

Geometric visibility ignores that beams are apart: a sensor of 31 beams "sees" all that no wall hides. `sampled` asks
for more: floor counts as seen from where neighbouring beams are at most the robot's diameter apart, no farther; and a
place shows no more than that either.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numba import njit

from baselines.oracle.space import sights
from polyexplore_gym.config import EnvConfig, SensorConfig, from_mapping, to_mapping
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.evaluation.policy import load_policy
from polyexplore_gym.floorplan import FloorPlan, load_plan
from polyexplore_gym.sim.laser import cast_rays

MOST_PLACES = 20_000
"""Places of the grid; a larger part of the plan gets a coarser grid."""
MOST_SAMPLES = 2_000
"""Samples of the unseen floor by which places are ranked."""
LOOKED_AT = 12
"""Places looked at exactly, those that promise most."""
_BESIDE = 1e-9
"""Rays pass a wall's end at this angle on either side, rad."""
_ARC = 0.02
"""A chord of the range's circle is off by at most this share of the robot's radius."""
_GRID = 1e-5
"""Polygons are overlaid on a grid of this share of the robot's radius."""
_UNLIKELY = 0.6
"""A place whose samples make less than this share of the limit is not looked at."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LeftOver:
    """What an exploration left unseen that could have been seen."""

    limit: float
    """Most that a place may show, m2."""
    place: np.ndarray | None
    """(2,) the place within reach that would show most, m; None if none was worth a look."""
    area: float
    """What it would show that no scan saw, m2."""
    shown: Any
    """That floor, a shapely geometry."""
    drivable: float
    """How much of it the robot's disc could drive over, m2: what is left lies behind slits or in niches."""
    unseen: Any
    """All floor that no scan saw, a shapely geometry."""
    share: float
    """Of the floor that can be seen from within reach, the share that was seen, 0 to 1."""
    spacing: float
    """Of the grid of places, m."""

    @property
    def complete(self) -> bool:
        """Whether nothing is left."""
        return self.area <= self.limit


@njit  # not cached: tests load this file under another name
def _bearings(walls, x, y, reach):  # type: ignore[no-untyped-def]
    """Bearings (n,) at which the nearest wall may change: walls' ends, and where walls leave the range."""
    out, n = np.empty(4 * walls.shape[0]), 0
    for k in range(walls.shape[0]):
        ax, ay, bx, by = walls[k, 0] - x, walls[k, 1] - y, walls[k, 2] - x, walls[k, 3] - y
        if min(ax, bx) > reach or max(ax, bx) < -reach or min(ay, by) > reach or max(ay, by) < -reach:
            continue
        if math.hypot(ax, ay) <= reach:
            out[n] = math.atan2(ay, ax)
            n += 1
        if math.hypot(bx, by) <= reach:
            out[n] = math.atan2(by, bx)
            n += 1
        ex, ey = bx - ax, by - ay
        a, b, c = ex * ex + ey * ey, ax * ex + ay * ey, ax * ax + ay * ay - reach * reach
        root = b * b - a * c
        if root > 0.0:
            for sign in (-1.0, 1.0):
                t = (-b + sign * math.sqrt(root)) / a
                if 0.0 <= t <= 1.0:
                    out[n] = math.atan2(ay + t * ey, ax + t * ex)
                    n += 1
    return out[:n]


def view(
    walls: np.ndarray, pose: np.ndarray, reach: float, field_of_view: float, error: float, *, outer: bool
) -> shapely.Geometry:
    """What is visible from a pose (3,), or from a place (2,) all round, within reach m, as a valid geometry.

    walls (M, 4) m. Between neighbouring bearings of `_bearings` one wall, or none, is the nearest: the polygon is
    exact but for the circle, whose chords lie outside (`outer`) or inside of it by at most `error` m.
    """
    x, y = float(pose[0]), float(pose[1])
    half = 0.5 * field_of_view
    round_about = len(pose) < 3 or half >= math.pi - 1e-9
    heading = 0.0 if round_about else float(pose[2])
    half = math.pi if round_about else half
    step = min(math.radians(3.0), 2.0 * math.sqrt(2.0 * error / reach))
    circle = np.linspace(-half, half, math.ceil(2.0 * half / step) + 1)
    found = np.remainder(_bearings(walls, x, y, reach) - heading + math.pi, 2.0 * math.pi) - math.pi
    angles = np.sort(np.concatenate((circle, found[np.abs(found) < half])))
    left, right = angles[:-1] + _BESIDE, angles[1:] - _BESIDE
    wide = right > left
    rays = np.stack((left[wide], right[wide]), axis=1) + heading
    near = walls[_within(walls, x, y, reach)]
    ranges = cast_rays(near, x, y, rays.ravel(), reach).reshape(-1, 2)
    beyond = reach / (np.cos(0.5 * (rays[:, 1] - rays[:, 0]) + _BESIDE) if outer else np.ones(len(rays)))
    ranges = np.where(np.isfinite(ranges).all(axis=1)[:, None], ranges, beyond[:, None])
    ring = np.array([x, y]) + ranges.reshape(-1, 1) * np.stack((np.cos(rays.ravel()), np.sin(rays.ravel())), axis=1)
    if not round_about:
        ring = np.vstack((ring, [[x, y]]))
    polygon = shapely.Polygon(ring)
    return polygon if polygon.is_valid else polygon.buffer(0.0)


def _within(walls: np.ndarray, x: float, y: float, reach: float) -> np.ndarray:
    low = np.minimum(walls[:, :2], walls[:, 2:]) - (x, y)
    high = np.maximum(walls[:, :2], walls[:, 2:]) - (x, y)
    return np.all((low <= reach) & (high >= -reach), axis=1)


def _without(floor: shapely.Polygon, views: list[shapely.Geometry], grid: float) -> shapely.Geometry:
    """What of the floor is in none of the views.

    One view after the other, the largest first: unlike the union of all, whose borders run along the same walls,
    what is left soon is small. Crumbs of the overlay's grid are dropped.
    """
    parts = np.array([floor])
    for seen in sorted(views, key=lambda v: -v.area):
        hit = shapely.intersects(seen, parts)
        cut = shapely.get_parts(shapely.difference(parts[hit], seen, grid_size=grid))
        cut = cut[(shapely.get_type_id(cut) == shapely.GeometryType.POLYGON) & (shapely.area(cut) > 1e4 * grid**2)]
        parts = np.concatenate((parts[~hit], cut))
    return shapely.multipolygons(parts)


def reach_of(sensor: SensorConfig, radius: float, *, sampled: bool) -> float:
    """How far floor is seen, m: the range; `sampled`: at most to where beams are the robot's diameter apart."""
    return min(sensor.max_range, 2.0 * radius / sensor.resolution) if sampled else sensor.max_range


def reachable(plan: FloorPlan, start: np.ndarray, radius: float) -> shapely.Polygon:
    """Where the centre of the disc can get from start (2,): the eroded free space's part that holds it, prepared."""
    parts = [p for p in shapely.get_parts(plan.free_space(radius)) if p.geom_type == "Polygon" and not p.is_empty]
    if not parts:
        return shapely.Point(start[:2])
    point = shapely.Point(start[:2])
    part = min(parts, key=lambda p: (p.distance(point), -p.area))
    shapely.prepare(part)
    return part


def places_in(area: shapely.Geometry, spacing: float) -> np.ndarray:
    """Places (k, 2) of a reachable area: a square grid, and the corners round which it turns."""
    x0, y0, x1, y1 = area.bounds
    x, y = np.meshgrid(np.arange(x0 + 0.5 * spacing, x1, spacing), np.arange(y0 + 0.5 * spacing, y1, spacing))
    grid = np.stack((x.ravel(), y.ravel()), axis=1)
    found = [grid[shapely.contains_xy(area, grid)]]
    for part in shapely.get_parts(area):
        if part.geom_type != "Polygon":
            found.append(shapely.get_coordinates(part))
            continue
        for ring in shapely.get_rings(shapely.simplify(part, 0.02 * spacing)):
            p = shapely.get_coordinates(ring)[:-1]
            p = p if shapely.is_ccw(ring) else p[::-1]
            a, b = p - np.roll(p, 1, axis=0), np.roll(p, -1, axis=0) - p
            turn = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
            inwards = turn < 0.0 if ring.equals(shapely.get_exterior_ring(part)) else turn > 0.0
            found.append(p[inwards])
    return np.concatenate(found)


def _samples(area: shapely.Geometry, spacing: float) -> np.ndarray:
    """Points (k, 2) of a square grid in an area that may be in many parts."""
    found = []
    for part in shapely.get_parts(area):
        if part.geom_type != "Polygon":
            continue
        x0, y0, x1, y1 = np.array(part.bounds) / spacing
        x, y = np.meshgrid((np.arange(math.floor(x0), math.ceil(x1)) + 0.5) * spacing,
                           (np.arange(math.floor(y0), math.ceil(y1)) + 0.5) * spacing)  # fmt: skip
        grid = np.stack((x.ravel(), y.ravel()), axis=1)
        shapely.prepare(part)
        found.append(grid[shapely.contains_xy(part, grid)])
    return np.concatenate(found) if found else np.zeros((0, 2))


def left_over(
    plan: FloorPlan, scans: np.ndarray, sensor: SensorConfig, radius: float, *, sampled: bool = False
) -> LeftOver:
    """What the place within reach that would show most would show, after scans from true poses (n, 3).

    The first scan is from the start. `sampled`: see above.
    """
    walls, reach, error, grid = plan.segments, reach_of(sensor, radius, sampled=sampled), _ARC * radius, _GRID * radius
    limit = 8.0 * radius**2
    unique = np.unique(np.asarray(scans, np.float64), axis=0)
    views = [view(walls, pose, reach, sensor.field_of_view, error, outer=True) for pose in unique]
    floor = shapely.Polygon(plan.exterior, plan.holes)
    unseen = _without(floor, views, grid)
    area = reachable(plan, scans[0, :2], radius)
    spacing = max(radius, math.sqrt(area.area / MOST_PLACES))
    total, rest = floor.area, unseen.area
    if rest <= limit:
        # What of it can be seen does not matter for the verdict; it counts as if it could.
        return LeftOver(limit=limit, place=None, area=0.0, shown=shapely.Polygon(), drivable=0.0, unseen=unseen,
                        share=1.0 - rest / total, spacing=spacing)  # fmt: skip
    step = max(0.5 * radius, math.sqrt(rest / MOST_SAMPLES))
    samples = _samples(unseen, step)
    places = places_in(area, spacing)
    places = places[shapely.dwithin(unseen, shapely.points(places), reach)]
    indptr, indices = sights(walls, places, samples, reach)
    count = np.diff(indptr)
    visible = np.zeros(len(samples), np.bool_)
    visible[indices] = True
    share = (total - rest) / (total - rest + visible.mean() * rest) if len(samples) else 1.0 - rest / total
    unit = rest / max(len(samples), 1)
    best = _best(places, count * unit, _UNLIKELY * limit, spacing)
    finer = [p + 0.5 * spacing * np.array([a, b]) for p in best[:4] for a in (-1, 0, 1) for b in (-1, 0, 1) if a or b]
    finer = [p for p in finer if shapely.contains_xy(area, *p)]
    shapely.prepare(unseen)
    place, most, shown = None, 0.0, shapely.Polygon()
    for p in (*best, *finer):
        new = shapely.intersection(view(walls, p, reach, 2.0 * math.pi, error, outer=False), unseen, grid_size=grid)
        if new.area > most:
            place, most, shown = p, new.area, new
    swept = area.buffer(radius)
    return LeftOver(limit=limit, place=place, area=most, shown=shown, drivable=shapely.intersection(shown, swept).area,
                    unseen=unseen, share=share, spacing=spacing)  # fmt: skip


def _best(places: np.ndarray, promise: np.ndarray, least: float, apart: float) -> np.ndarray:
    """The places (k, 2) that promise most, not all of them neighbours of each other."""
    chosen: list[np.ndarray] = []
    for i in np.argsort(-promise, kind="stable"):
        if promise[i] < least or len(chosen) == LOOKED_AT:
            break
        if all(math.dist(places[i], p) >= 1.5 * apart for p in chosen):
            chosen.append(places[i])
    return np.array(chosen).reshape(-1, 2)


def check(env: PolyExploreEnv, *, sampled: bool = False) -> LeftOver:
    """`left_over` of the episode that an environment has played."""
    base: PolyExploreEnv = env.unwrapped  # type: ignore[assignment]
    scans = np.array(base._measured_at)  # as `snapshot().measured_at`, which also unites the scans' polygons: slow
    return left_over(base.plan, scans, base.config.sensor, base.config.robot.radius, sampled=sampled)


def play(
    env: PolyExploreEnv, policy: Any, seed: int, options: dict[str, Any] | None = None
) -> tuple[str, int, dict[str, Any]]:
    """Play an episode: "ended" or "truncated", the number of decisions, and the last info."""
    observation, info = env.reset(seed=seed, options=options)
    rng = np.random.default_rng(seed)
    if hasattr(policy, "reset"):
        policy.reset()
    decisions, truncated = 0, False
    while info["action_mask"].any() and not truncated:
        observation, _, _, truncated, info = env.step(policy.act(observation, info, rng))
        decisions += 1
    return ("truncated" if truncated else "ended"), decisions, info


def draw(env: PolyExploreEnv, found: LeftOver, file: Path) -> None:
    """A picture: floor seen (white), unseen (red), what the worst place would show (dark red), scans, way, place."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plan, snapshot = env.plan, env.snapshot()
    x0, y0, x1, y1 = plan.bounds
    scale = 14.0 / max(x1 - x0, y1 - y0)
    figure, axes = plt.subplots(figsize=(max(4.0, scale * (x1 - x0)) + 1, max(4.0, scale * (y1 - y0)) + 1))
    for ring in plan.rings:
        axes.fill(*ring.T, facecolor="white" if ring is plan.exterior else "0.8", edgecolor="0.2", linewidth=0.8)
    for area, colour in ((found.unseen, "#f5b7b1"), (found.shown, "#c0392b")):
        for part in shapely.get_parts(area):
            if part.geom_type == "Polygon" and not part.is_empty:
                axes.fill(*np.array(part.exterior.coords).T, facecolor=colour, linewidth=0)
    for wall in snapshot.walls:
        axes.plot(wall[::2], wall[1::2], color="tab:blue", linewidth=1.2)
    for line in snapshot.jump_edges:
        axes.plot(*line.T, color="tab:orange", linewidth=2.5)
    axes.plot(*snapshot.trajectory[:, :2].T, color="0.55", linewidth=0.8)
    axes.plot(*snapshot.measured_at[:, :2].T, ".", color="0.3", markersize=4)
    if found.place is not None:
        axes.add_patch(plt.Circle(tuple(found.place), snapshot.radius, color="black", fill=False, linewidth=1.5))
    axes.set_title(f"{plan.name}: {100 * found.share:.2f} % seen, worst place shows {found.area:.2f} m2 "
                   f"({found.area / found.limit:.2f} of what it may)")  # fmt: skip
    axes.set_aspect("equal")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=90, bbox_inches="tight")
    plt.close(figure)


def configured(file: Path | None, changes: list[str]) -> EnvConfig:
    """The configuration of a JSON file with changes such as "sensor.max_range=20"."""
    values: dict[str, Any] = {} if file is None else json.loads(file.read_text(encoding="utf-8"))
    for change in changes:
        name, _, text = change.partition("=")
        *path, last = name.split(".")
        here = values
        for part in path:
            here = here.setdefault(part, {})
        try:
            here[last] = json.loads(text)
        except ValueError:
            here[last] = text
    return from_mapping(EnvConfig, values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plan", type=Path, nargs="+", help="plan files")
    parser.add_argument("--config", type=Path, help="JSON file of the environment's configuration")
    parser.add_argument("--set", action="append", default=[], metavar="FIELD=VALUE", help="change a field of it")
    parser.add_argument("--policy", default="nearest")
    parser.add_argument("--placement", choices=("in_front", "midpoint"), help="default: the configuration's")
    parser.add_argument("--drive", choices=("kinematic", "physics"), default="kinematic")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sampled", action="store_true", help="floor between beams far apart does not count as seen")
    parser.add_argument("--picture", type=Path, help="PNG file; with several plans, a folder")
    options = parser.parse_args()
    values = to_mapping(configured(options.config, options.set))
    values["drive"]["mode"] = options.drive
    if options.placement is not None:
        values["exploration"]["placement"] = options.placement
    config = from_mapping(EnvConfig, values)
    for file in options.plan:
        env = PolyExploreEnv(plan=load_plan(file), config=config)
        began = time.process_time()
        outcome, decisions, _ = play(env, load_policy(options.policy), options.seed)
        played = time.process_time() - began
        found = check(env, sampled=options.sampled)
        seconds = time.process_time() - began - played
        place = "-" if found.place is None else f"({found.place[0]:.2f}, {found.place[1]:.2f})"
        verdict = "complete" if found.complete else "NOT COMPLETE"
        print(f"{env.plan.name}: {outcome} after {decisions} decisions, {100 * found.share:.2f} % seen; {verdict}: "
              f"worst place {place} would show {found.area:.2f} m2 ({found.drivable:.2f} drivable) of "
              f"{found.limit:.2f}; {played:.1f} s + {seconds:.1f} s", flush=True)  # fmt: skip
        if options.picture is not None:
            many = len(options.plan) > 1
            draw(env, found, options.picture / f"{env.plan.name}.png" if many else options.picture)


if __name__ == "__main__":
    main()
