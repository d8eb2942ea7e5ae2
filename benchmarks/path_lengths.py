"""Are the path lengths c_n of nodes shortest paths? Beside exact ones through the space that the robot knows.

    python benchmarks/path_lengths.py [--states 40] [--generated 6] [--plans FOLDER] [--shared 4] [--placement ...]
                                      [--set sensor.max_range=20 ...]

`nearest` explores each plan (kinematic, exact pose); at each decision the length of the path to every node is compared
with two shortest paths of the disc through the union of the scan polygons less the walls of the line map, inflated.
The lower one is the shortest that any robot could drive: the disc's radius, and all that is doubtful known (0.2 radii
beyond the scans). The upper one is what the code promises: walls keep the spare distance too but in passages that are
narrower, and nothing is known that lies within 0.15 radii of the border of the known. Both may cross an open edge near
the robot and near the node, as the code does. Right is 0.99 lower <= c_n <= 1.02 upper.

One row a plan and placement: states and nodes looked at, share of the nodes with c_n more than 2 % above the upper
reference, the worst ratios to both, nodes below the lower one, nodes without a path although there is one, and jump
edges without a node although the disc could stand in front of it. Nodes nearer than two radii are left out, and states
in which the robot stands in contact (its path begins with a way out).
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import exact
import numpy as np
import shapely
from plan_statistics import default_folder
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from baselines.oracle.space import sights
from polyexplore_gym.config import EnvConfig, from_mapping, to_mapping
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.evaluation.policy import load_policy
from polyexplore_gym.evaluation.tables import format_table
from polyexplore_gym.exploration import ExplorationMap
from polyexplore_gym.exploration.shapes import scan_polygon
from polyexplore_gym.floorplan import FAMILIES, FloorPlan, generate, load_plan

MOST = 1.02
"""c_n may exceed the upper reference by this factor."""
LEAST = 0.99
"""And fall below the lower one by this."""
_DOUBT = 0.2
_SHY = 0.15
_ARC = 4
_CHORD = math.cos(math.pi / (4 * _ARC))
"""A buffer's arcs are chords: this share of its distance in their middles."""
_EPSILON = 1e-3
"""Paths may touch the border of their area: what blocks them lies this share of the radius outside."""
_NEAR = 2.0
"""Nodes nearer than so many radii are left out: centimetres decide there."""


def _ring_walls(area: Any) -> np.ndarray:
    """Borders of an area as segments (m, 4)."""
    rings = [shapely.get_coordinates(r) for part in shapely.get_parts(area) if part.geom_type == "Polygon"
             for r in (part.exterior, *part.interiors)]  # fmt: skip
    if not rings:
        return np.zeros((0, 4))
    return np.ascontiguousarray(np.concatenate([np.hstack((p[:-1], p[1:])) for p in rings]))


def _corners(area: Any) -> np.ndarray:
    """Where shortest paths in an area turn (k, 2): its reflex corners."""
    found = []
    for part in shapely.get_parts(area):
        if part.geom_type != "Polygon" or part.is_empty:
            continue
        part = shapely.geometry.polygon.orient(part)
        for ring in (part.exterior, *part.interiors):
            p = shapely.get_coordinates(ring)[:-1]
            a, b = p - np.roll(p, 1, axis=0), np.roll(p, -1, axis=0) - p
            found.append(p[a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] < 0.0])
    return np.concatenate(found) if found else np.zeros((0, 2))


def shortest(area: Any, near_goal: list[Any], start: np.ndarray, goals: np.ndarray, radius: float) -> np.ndarray:
    """(k,) m: shortest paths in an area from start (2,) to goals (k, 2); the last leg may also use `near_goal`.

    area: a shapely geometry; near_goal: for each goal, more area that only its own path may use. inf: no path.
    """
    outside = _EPSILON * radius
    corners = _corners(area)
    blocking = _ring_walls(area.buffer(outside, join_style="mitre"))
    reach = float(np.ptp(np.vstack((blocking[:, :2], [start], goals)), axis=0).sum()) + 1.0
    points = np.vstack(([start], corners))
    indptr, indices = sights(blocking, points, points, reach)
    length = np.hypot(*(points[indices] - np.repeat(points, np.diff(indptr), axis=0)).T)
    graph = csr_array((np.maximum(length, 1e-12), indices, indptr), shape=(len(points),) * 2)
    from_start = dijkstra(graph, directed=False, indices=0)
    out = np.full(len(goals), np.inf)
    for k, (goal, more) in enumerate(zip(goals, near_goal, strict=True)):
        walls = _ring_walls(shapely.union(area, more).buffer(outside, join_style="mitre"))
        seen = sights(walls, goal[None], points, reach)[1]
        if len(seen):
            out[k] = np.min(from_start[seen] + np.hypot(*(points[seen] - goal).T))
    return out


@dataclass(slots=True)
class Known:
    """The union of the scan polygons of an exploration that goes on."""

    area: Any = field(default_factory=shapely.Polygon)
    scans: int = 0

    def update(self, exploration: ExplorationMap) -> None:
        """Take in the scans that came since."""
        grid = 1e-4 * exploration.tol.radius
        new = [scan_polygon(exploration, s) for s in range(self.scans, exploration.n_scans)]
        self.area = shapely.union_all([self.area, *new], grid_size=grid)
        self.scans = exploration.n_scans


@dataclass(frozen=True, slots=True)
class References:
    """Areas of the lower and the upper reference, and what may be added near a goal, for a state."""

    lower: Any
    upper: Any
    narrow: Any
    """All places that the disc could be in, known or not: as `upper`, hardly larger than the disc."""
    wide: Any
    """The same for the disc of the lower reference."""


def areas(exploration: ExplorationMap, known: Any, start: np.ndarray) -> References:
    """The areas for a state in which the robot stands at start (2,)."""
    tol = exploration.tol
    r, graph = tol.radius, exploration.graph
    lines = shapely.multilinestrings(graph._segments[graph._alive].reshape(-1, 2, 2))
    x0, y0, x1, y1 = known.bounds
    room = shapely.box(x0 - 4 * r, y0 - 4 * r, x1 + 4 * r, y1 + 4 * r)
    here = shapely.Point(start)
    wide = room.difference(lines.buffer(0.999 * r, quad_segs=_ARC))
    narrow = room.difference(lines.buffer(tol.need / _CHORD, quad_segs=_ARC))
    spare = room.difference(lines.buffer((r + tol.spare) / _CHORD, quad_segs=_ARC))
    # The spare distance is kept where there is room: in passages with less, and near the robot, it is not.
    margin = r + tol.spare - tol.need
    passages = narrow.difference(spare.buffer(1.3 * margin, quad_segs=_ARC)).buffer(2.6 * margin, quad_segs=_ARC)
    driven = spare.union(narrow.intersection(shapely.union(passages, here.buffer(tol.slack))))
    near = here.buffer(tol.slack)
    simple = 0.01 * r
    lower = known.buffer(_DOUBT * r, quad_segs=2).union(near).intersection(wide)
    upper = known.buffer(-_SHY * r, quad_segs=2).union(near).intersection(driven).simplify(simple)
    return References(lower.simplify(simple), upper, narrow, wide)


@dataclass(slots=True)
class Tally:
    """What was found on one plan."""

    states: int = 0
    contact: int = 0
    nodes: int = 0
    long: int = 0
    """c_n more than 2 % above the upper reference"""
    worst: float = 0.0
    worst_at: str = ""
    short: int = 0
    least: float = math.inf
    least_at: str = ""
    masked: int = 0
    """a node, but no path, though the upper reference has one"""
    unplaced: int = 0
    """no node, though the disc could stand in front of the jump edge and get there"""

    def row(self) -> list[str]:
        """Its figures as a row of the table."""
        share = 100.0 * self.long / max(self.nodes, 1)
        return [f"{self.states} ({self.contact})", f"{self.nodes}", f"{share:.2f}", f"{self.worst:.3f} {self.worst_at}",
                f"{self.short}", f"{self.least:.3f} {self.least_at}", f"{self.masked}", f"{self.unplaced}"]  # fmt: skip


def compare(exploration: ExplorationMap, known: Any, tally: Tally, name: str) -> None:
    """Compare all path lengths of one state."""
    c, tol = exploration.chains, exploration.tol
    if not len(c.id):
        return
    if len(exploration._start) > 1:
        tally.contact += 1
        return
    tally.states += 1
    start = np.array(exploration._start[-1])
    found = areas(exploration, known, start)
    goals = c.node[:, :2].copy()
    unplaced = c.vertex < 0
    goals[unplaced] = c.middle[unplaced] - (exploration._front + tol.aside) * c.normal[unplaced]
    discs = shapely.buffer(shapely.points(goals), tol.slack)
    upper = shortest(found.upper, list(shapely.intersection(discs, found.narrow)), start, goals, tol.radius)
    lower = shortest(found.lower, list(shapely.intersection(discs, found.wide)), start, goals, tol.radius)
    for i in range(len(c.id)):
        at = f"({name}, jump edge {c.id[i]})"
        if unplaced[i]:
            stands = shapely.contains_xy(found.upper, *goals[i]) and np.isfinite(upper[i])
            tally.unplaced += bool(stands)
            continue
        length = c.path_length[i]
        if not np.isfinite(length):
            tally.masked += bool(np.isfinite(upper[i]))
            continue
        if length < _NEAR * tol.radius:
            continue
        tally.nodes += 1
        if np.isfinite(upper[i]) and length > tally.worst * upper[i]:
            tally.worst, tally.worst_at = length / upper[i], at
        tally.long += bool(length > MOST * upper[i])
        if not np.isfinite(lower[i]) or length < tally.least * lower[i]:
            tally.least, tally.least_at = (length / lower[i] if np.isfinite(lower[i]) else 0.0), at
        tally.short += bool(length < LEAST * lower[i])


def states(plan: FloorPlan, config: EnvConfig, count: int) -> Iterator[tuple[PolyExploreEnv, Any, str]]:
    """Decisions of `nearest` from one start after the other, with the known area and a name for each."""
    policy, made = load_policy("nearest"), 0
    for seed in range(count):
        env = PolyExploreEnv(plan=plan, config=config)
        observation, info = env.reset(seed=seed)
        rng, known, step = np.random.default_rng(seed), Known(), 0
        while True:
            known.update(env.exploration)
            yield env, known.area, f"seed {seed}, decision {step}"
            made += 1
            if made == count:
                return
            if not info["action_mask"].any() or step >= count:
                break
            observation, _, _, _, info = env.step(policy.act(observation, info, rng))
            step += 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, default=40, help="decisions on each plan")
    parser.add_argument("--generated", type=int, default=6, help="generated plans, all families in turn")
    parser.add_argument("--shared", type=int, default=4, help="shared plans, the first by name")
    parser.add_argument("--plans", type=Path, default=default_folder(), help="folder of plan JSON files")
    parser.add_argument("--placement", nargs="+", choices=("midpoint", "in_front"), default=["midpoint", "in_front"])
    parser.add_argument("--set", action="append", default=[], metavar="FIELD=VALUE", help="change a field")
    options = parser.parse_args()
    plans = [generate(FAMILIES[i % len(FAMILIES)], i // len(FAMILIES)) for i in range(options.generated)]
    if options.shared and options.plans.is_dir():
        plans += [load_plan(path) for path in sorted(options.plans.glob("*.json"))[: options.shared]]
    values = to_mapping(exact.configured(None, ["drive.mode=kinematic", *options.set]))
    rows = []
    for placement in options.placement:
        values["exploration"]["placement"] = placement
        config = from_mapping(EnvConfig, values)
        for plan in plans:
            tally = Tally()
            for env, known, name in states(plan, config, options.states):
                compare(env.exploration, known, tally, name)
            rows.append([placement, plan.name, *tally.row()])
            print(*rows[-1], flush=True)
    header = ("placement", "plan", "states (in contact)", "nodes", "c_n > 1.02 upper, %", "worst c_n / upper",
              "c_n < 0.99 lower", "least c_n / lower", "masked, but a path", "no node, but room")  # fmt: skip
    print("\n" + format_table(header, rows, "markdown"))


if __name__ == "__main__":
    main()
