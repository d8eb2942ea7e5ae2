"""Where does the environment crash, hang or end too early? Random configurations and plans, each from one integer.

    python benchmarks/fuzz.py [--first 0] [--count 200] [--seconds 600] [--largest 10000] [--pose exact]
                              [--out results/fuzz]
    python benchmarks/fuzz.py --case 17 [--picture x.png]
    python benchmarks/fuzz.py --scaled [--first 0] [--count 50]

A case draws a robot of 0.05 to 1 m, a sensor (1 to 200 m, 20 to 2,000 beams, 30 to 360 degrees, up to ten times the
noise), both placements and drives, all pose modes, scans and decisions on the way or not, looking around or not, a
criterion, and a plan in units of the robot: generated ones scaled so that their doors fit, and degenerate ones
(`PLANS`). It is played in a child process, which is started anew after a crash, with a limit of CPU time.

Findings: a crash (the process died), an exception, a hang (a decision that reaches the CPU limit), a truncated episode,
and an episode that ended although a place within reach would show more floor that no scan saw than `exact.py` allows.
With the pose from odometry, `slam` or a localiser with an error the map is off, so only the other checks count. How an
end is wrong:

    jump edge masked    a jump edge borders what is left: the map knows of it but finds no place or path
    jump edge lost      none does: the map takes what is left for seen, or for wall
    over at reset       one of these, and no decision was made
    behind a slit       what is left is mostly floor that the disc cannot drive over
    between beams       complete but for floor that only beams far apart could have seen (`exact.py`, sampled)

`--scaled` plays each case twice, the second time with the plan and all configured lengths and speeds times a power of
four (so that roots of it are exact too): decisions and ways must be the same, scaled, to 1e-6. A run that was stopped
goes on where it was; results are lines of `cases.jsonl` in the folder given with `--out`.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import json
import math
import os
import resource
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import exact
import numpy as np
import shapely
import shapely.affinity

from polyexplore_gym.config import EnvConfig, from_mapping
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.errors import InvalidConfigError, InvalidFloorPlanError
from polyexplore_gym.evaluation.policy import load_policy
from polyexplore_gym.evaluation.tables import format_table
from polyexplore_gym.exploration import shapes
from polyexplore_gym.floorplan import FAMILIES, FloorPlan, generate

CPU_LIMIT, PATIENCE = 60.0, 180.0
"""CPU time, s, of a decision (the first has a second more for every 200 squares of the radius) and of an episode."""
DECISIONS = 2000
"""Decisions of a case, or one for every 20 squares of the radius: then it is truncated, a finding."""
ON_THE_WAY = 5
"""So many times as many where they are made on the way."""
CRITERIA = ("nearest", "nearest", "nearest", "largest", "ekman_ratio", "modified_sum", "utility", "random")
DOOR_OF_GENERATED = 0.3
"""Generated plans are connected for a disc of this radius, m."""
_ATTEMPTS = 50
_SAME = 1e-6
_FIRST = 36
_MARK = "fuzz:"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Case:
    """One configuration and plan."""

    number: int
    """The integer it comes from; also the seed of the episode."""
    family: str
    """Of the plan."""
    plan: FloorPlan
    values: dict[str, Any]
    """Nested mapping of the configuration."""
    criterion: str
    start: list[float] | None
    """Start pose, m and rad; None: drawn by the environment."""

    @property
    def size(self) -> float:
        """Area of the plan in squares of the robot's radius."""
        return float(self.plan.area) / self.values["robot"]["radius"] ** 2


# Plans in units of the robot's radius -------------------------------------------------------------


def _boxes(*boxes: tuple[float, float, float, float]) -> shapely.Geometry:
    return shapely.union_all([shapely.box(*b) for b in boxes])


def _corridor(points: Any, width: float) -> shapely.Geometry:
    return shapely.LineString(points).buffer(0.5 * width, cap_style="square", join_style="mitre")


def _hall(rng: np.random.Generator, reach: float) -> shapely.Geometry:
    """A hall up to five times as wide as the range, perhaps with pillars."""
    w, h = np.clip(reach * rng.uniform(0.3, 5.0, 2), 8.0, 400.0)
    hall = shapely.box(0, 0, w, h)
    for _ in range(int(rng.integers(0, 4))):
        x, y, size = rng.uniform(0.1 * w, 0.9 * w), rng.uniform(0.1 * h, 0.9 * h), rng.uniform(0.2, 3.0)
        hall = hall.difference(shapely.Point(x, y).buffer(size, quad_segs=int(rng.integers(1, 4))))
    return hall


def _corridors(rng: np.random.Generator, reach: float) -> shapely.Geometry:
    """A corridor hardly wider than the robot, with bends."""
    length, at, heading, points = min(reach, 60.0), np.zeros(2), 0.0, [np.zeros(2)]
    for _ in range(int(rng.integers(1, 6))):
        at = at + rng.uniform(6.0, 6.0 + 2.0 * length) * np.array([math.cos(heading), math.sin(heading)])
        points.append(at)
        heading += rng.choice([-1.0, 1.0]) * rng.choice([0.5 * math.pi, rng.uniform(0.3, 1.8)])
    return _corridor(points, rng.uniform(2.1, 4.5))


def _comb(rng: np.random.Generator, reach: float) -> shapely.Geometry:
    """A corridor with dead ends to one side or both, some of them wide inside."""
    tooth, gap, count = rng.uniform(2.1, 5.0), rng.uniform(0.1, 3.0), int(rng.integers(2, 10))
    length, spine = rng.uniform(3.0, min(1.5 * reach, 40.0)), rng.uniform(2.2, 6.0)
    boxes = [(0.0, 0.0, count * (tooth + gap) + gap, spine)]
    for i in range(count):
        x = gap + i * (tooth + gap)
        boxes.append((x, 0.5 * spine, x + tooth, spine + length))
        if rng.random() < 0.4:
            boxes.append((x, -length, x + tooth, 0.5 * spine))
    return _boxes(*boxes)


def _maze(rng: np.random.Generator, reach: float) -> shapely.Geometry:
    """A maze of square cells with thin or thick walls, and a few loops."""
    columns, rows = (int(n) for n in rng.integers(2, 8, 2))
    passage, wall = rng.uniform(2.2, 6.0), rng.choice([0.02, 0.2, 1.0])
    pitch = passage + wall
    seen, stack, doors = {(0, 0)}, [(0, 0)], set()
    while stack:
        c, r = stack[-1]
        free = [(c + a, r + b) for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))
                if 0 <= c + a < columns and 0 <= r + b < rows and (c + a, r + b) not in seen]  # fmt: skip
        if not free:
            stack.pop()
            continue
        nxt = free[int(rng.integers(len(free)))]
        doors.add(tuple(sorted(((c, r), nxt))))
        seen.add(nxt)
        stack.append(nxt)
    for c in range(columns - 1):
        for r in range(rows):
            if rng.random() < 0.08:
                doors.add(((c, r), (c + 1, r)))
    boxes = [(c * pitch, r * pitch, c * pitch + passage, r * pitch + passage) for c in range(columns)
             for r in range(rows)]  # fmt: skip
    boxes += [(a * pitch, b * pitch, c * pitch + passage, d * pitch + passage) for (a, b), (c, d) in sorted(doors)]
    return _boxes(*boxes)


def _rooms(rng: np.random.Generator, door: Callable[[], float], slit: Callable[[], float] | None) -> shapely.Geometry:
    """A grid of rooms joined by doors along a tree, other walls perhaps with a slit that no robot fits through."""
    columns, rows = (int(n) for n in rng.integers(1, 4, 2))
    columns += rows == columns == 1
    wall = rng.choice([0.01, 0.1, 0.6, 2.0])
    xs = np.concatenate(([0.0], np.cumsum(rng.uniform(5.0, 22.0, columns) + wall)))
    ys = np.concatenate(([0.0], np.cumsum(rng.uniform(5.0, 22.0, rows) + wall)))
    boxes = [(xs[c], ys[r], xs[c + 1] - wall, ys[r + 1] - wall) for c in range(columns) for r in range(rows)]
    joined = {(0, 0)}
    pairs = [((c, r), (c + 1, r)) for c in range(columns - 1) for r in range(rows)]
    pairs += [((c, r), (c, r + 1)) for c in range(columns) for r in range(rows - 1)]
    todo = [pairs[i] for i in rng.permutation(len(pairs))]
    while len(joined) < columns * rows:
        a, b = next((a, b) for a, b in todo if (a in joined) != (b in joined))
        todo.remove((a, b))
        joined |= {a, b}
        boxes.append(_opening(rng, xs, ys, wall, a, b, door()))
    for a, b in todo:
        if slit is not None and rng.random() < 0.7:
            boxes.append(_opening(rng, xs, ys, wall, a, b, slit()))
        elif rng.random() < 0.2:
            boxes.append(_opening(rng, xs, ys, wall, a, b, door()))
    return _boxes(*boxes)


def _opening(
    rng: np.random.Generator, xs: np.ndarray, ys: np.ndarray, wall: float, a: Any, b: Any, width: float
) -> tuple[float, float, float, float]:
    """The box of an opening in the wall between two neighbouring rooms."""
    along = ys if a[1] == b[1] else xs
    i = a[1] if a[1] == b[1] else a[0]
    room = along[i + 1] - wall - along[i]
    width = min(width, room)
    low = along[i] + rng.choice([0.0, room - width, rng.uniform(0.0, room - width)])
    if a[1] == b[1]:
        return xs[b[0]] - 2.0 * wall, low, xs[b[0]] + wall, low + width
    return low, ys[b[1]] - 2.0 * wall, low + width, ys[b[1]] + wall


def _doors(rng: np.random.Generator, reach: float) -> shapely.Geometry:
    """Rooms with doors hardly wider than the robot."""
    return _rooms(rng, lambda: rng.uniform(2.05, 2.3), None)


def _slits(rng: np.random.Generator, reach: float) -> shapely.Geometry:
    """Rooms with doors, and slits narrower than the robot."""
    return _rooms(rng, lambda: rng.uniform(2.4, 6.0), lambda: rng.uniform(0.1, 1.9))


def _open_rooms(rng: np.random.Generator, reach: float) -> shapely.Geometry:
    """Rooms with doors of any width."""
    return _rooms(rng, lambda: rng.uniform(2.2, 15.0), None)


def _pillars(rng: np.random.Generator, reach: float) -> shapely.Geometry:
    """A room with pillars, some slim, some as thin as a pole."""
    w, h = rng.uniform(10.0, 40.0, 2)
    room = shapely.box(0, 0, w, h)
    for _ in range(int(rng.integers(1, 8))):
        x, y = rng.uniform(0.0, w), rng.uniform(0.0, h)
        a, b = rng.choice([0.05, 0.4, 2.0, 6.0], 2)
        box = shapely.affinity.rotate(shapely.box(x, y, x + a, y + b), rng.choice([0.0, rng.uniform(0, 180.0)]))
        room = room.difference(box)
    return room


def _spiral(rng: np.random.Generator, reach: float) -> shapely.Geometry:
    """A corridor wound up."""
    width, wall = rng.uniform(2.1, 5.0), rng.choice([0.02, 0.5])
    pitch, at, points = width + wall, np.zeros(2), [np.zeros(2)]
    for k in range(int(rng.integers(4, 12))):
        at = at + (k // 2 + 1) * pitch * np.array([(1, 0), (0, 1), (-1, 0), (0, -1)][k % 4], float)
        points.append(at)
    return _corridor(points, width)


def _thin(rng: np.random.Generator, reach: float) -> shapely.Geometry:
    """A room with free-standing walls as thin as paper."""
    w, h = rng.uniform(12.0, 40.0, 2)
    room = shapely.box(0, 0, w, h)
    for _ in range(int(rng.integers(1, 7))):
        start, heading = rng.uniform((0, 0), (w, h)), rng.choice([0.0, 0.5 * math.pi, rng.uniform(0, math.pi)])
        end = start + rng.uniform(2.0, 15.0) * np.array([math.cos(heading), math.sin(heading)])
        room = room.difference(_corridor([start, end], float(rng.choice([0.002, 0.01, 0.1]))))
    return room


def _staircase(rng: np.random.Generator, reach: float) -> shapely.Geometry:
    """A room whose walls are staircases, as plans traced from pixels have them."""
    step, n = rng.choice([0.05, 0.3, 1.0, 3.0]), int(rng.integers(8, 60))
    slope, height = rng.uniform(0.2, 2.0), rng.uniform(4.0, 12.0)
    points = [(0.0, 0.0)]
    for k in range(n):
        points += [((k + 1) * step, k * step * slope), ((k + 1) * step, (k + 1) * step * slope)]
    upper = [(x - 0.3 * height, y + height) for x, y in points]
    shape = shapely.Polygon(points + upper[::-1])
    room = shapely.box(-0.3 * height - 8.0, -4.0, 2.0, height + 4.0)
    return shapely.union_all([shape, room])


def _star(rng: np.random.Generator, reach: float) -> shapely.Geometry:
    """A star: acute corners into which no robot fits."""
    n = int(rng.integers(3, 12))
    angles = np.sort(rng.uniform(0, 2.0 * math.pi, 2 * n))
    radii = np.where(np.arange(2 * n) % 2, rng.uniform(6.0, 40.0, 2 * n), rng.uniform(3.0, 10.0, 2 * n))
    return shapely.Polygon(np.stack((radii * np.cos(angles), radii * np.sin(angles)), axis=1))


PLANS: dict[str, Callable[[np.random.Generator, float], shapely.Geometry]] = {
    "hall": _hall, "corridors": _corridors, "comb": _comb, "maze": _maze, "doors": _doors, "slits": _slits,
    "rooms": _open_rooms, "pillars": _pillars, "spiral": _spiral, "thin walls": _thin, "staircase": _staircase,
    "star": _star,
}  # fmt: skip
"""Degenerate plans: a shape in units of the robot's radius from a random generator and the range in such units."""


def plan_of(family: str, rng: np.random.Generator, radius: float, reach: float, name: str) -> FloorPlan:
    """A plan of a family for a robot of `radius` m that sees `reach` m, which the disc can explore."""
    turn = rng.choice([0.0, rng.uniform(0.0, 360.0)])
    for _ in range(_ATTEMPTS):
        if family in FAMILIES:
            shape = generate(family, int(rng.integers(10_000))).polygon
            factor = radius / DOOR_OF_GENERATED * rng.choice([1.0, rng.uniform(1.0, 2.5)])
        else:
            shape, factor = PLANS[family](rng, reach / radius), radius
        shape = max(shapely.get_parts(shape), key=lambda p: p.area)
        shape = shapely.affinity.rotate(shapely.affinity.scale(shape, factor, factor, origin=(0, 0)), turn)
        try:
            plan = FloorPlan.create(
                np.array(shape.exterior.coords), [np.array(r.coords) for r in shape.interiors], name=name
            )
            plan.check_connected(radius)
        except InvalidFloorPlanError:
            continue
        return plan
    raise RuntimeError(f"{name}: no {family} in {_ATTEMPTS} attempts")


def case_of(number: int) -> Case:
    """The case with a number, always the same."""
    rng = np.random.default_rng([17, number])
    later = rng.spawn(1)[0]  # of its own, so that what came to be drawn later leaves the cases as they were
    radius = float(np.exp(rng.uniform(math.log(0.05), 0.0)))
    reach = float(np.clip(np.exp(rng.uniform(math.log(4.0), math.log(200.0))) * radius, max(1.0, 4.0 * radius), 200.0))
    family = str(rng.choice([*FAMILIES, *FAMILIES, *PLANS]))
    view = float(rng.choice([360.0, 360.0, 180.0, 180.0, 270.0, rng.uniform(30.0, 360.0), rng.uniform(30.0, 360.0)]))
    noise = float(rng.choice([0.0, 1.0, 1.0, 2.0, rng.uniform(0.0, 10.0)]))
    scale = radius / 0.25
    with_robot = bool(rng.random() < 0.5)  # all lengths and speeds scaled with the robot, or left at their defaults
    size = scale if with_robot else 1.0
    values: dict[str, Any] = {
        "sensor": {
            "beams": max(int(np.exp(rng.uniform(math.log(20.0), math.log(2000.0)))), math.ceil(view / 15.0) + 1),
            "field_of_view": math.radians(view),
            "max_range": reach,
            "sigma_range": 0.01 * noise * min(scale, 1.0 if not with_robot else scale),
            "sigma_angle": math.radians(0.1) * noise,
        },
        "robot": {"radius": radius, "track": 1.324 * radius, "max_speed": 1.2 * size, "max_acceleration": 0.6 * size},
        "drive": {"mode": str(rng.choice(["kinematic", "kinematic", "physics"]))},
        "pose": {"mode": str(rng.choice(["exact"] * 7 + ["gaussian", "odometry", "slam"]))},
        "exploration": {
            "placement": str(rng.choice(["in_front", "midpoint"])),
            "front_distance": None if with_robot else 1.0,
            "look_around": bool(rng.random() < 0.7),
            "scan_every": float(rng.choice([0.0, max(0.1, rng.uniform(0.5, 8.0) * radius)], p=[0.65, 0.35])),
        },
    }
    plan = plan_of(family, rng, radius, reach, f"case-{number}-{family.replace(' ', '-')}")
    values["max_decisions"] = max(DECISIONS, int(plan.area / radius**2 / 20.0))
    start = _against_a_wall(rng, plan, radius) if rng.random() < 0.1 else None
    values["exploration"] |= _on_the_way(later, radius, values["exploration"]["scan_every"])
    if values["exploration"]["decide"] != "arrival":
        values["max_decisions"] *= ON_THE_WAY
    return Case(number=number, family=family, plan=plan, values=values, criterion=str(rng.choice(CRITERIA)),
                start=start)  # fmt: skip


def _on_the_way(rng: np.random.Generator, radius: float, every: float) -> dict[str, Any]:
    """When the next node is chosen, in every other case on the way; that takes scans there."""
    decide = str(rng.choice(["arrival", "arrival", "settled", "interval"]))
    scans = max(0.01, float(np.exp(rng.uniform(math.log(0.3), math.log(8.0)))) * radius)
    interval = float(np.exp(rng.uniform(0.0, math.log(20.0)))) * radius
    return {"decide": decide, "decide_every": interval, "scan_every": every or (scans if decide != "arrival" else 0.0)}


def _against_a_wall(rng: np.random.Generator, plan: FloorPlan, radius: float) -> list[float] | None:
    """A start pose that touches a wall, nearly."""
    ring = plan.largest_part(1.02 * radius).exterior
    if ring.is_empty:
        return None
    point = ring.interpolate(rng.uniform(0.0, 1.0), normalized=True)
    return [point.x, point.y, rng.uniform(-math.pi, math.pi)]


# One case ---------------------------------------------------------------------------------------


class _SlowError(Exception):
    """An episode goes on, but there is no more time for it."""


class _Watched(PolyExploreEnv):
    """Each decision has `CPU_LIMIT`, all of them together `PATIENCE`."""

    def step(self, action: int) -> Any:
        _allow(CPU_LIMIT)
        result = super().step(action)
        if _hard_limit is not None and time.process_time() - _began > PATIENCE:
            raise _SlowError(f"{result[4]['measurements']} scans")
        return result


_hard_limit: int | None = None
_began = 0.0


def _allow(seconds: float) -> None:
    """Let a child process go on for so much CPU time."""
    if _hard_limit is not None:
        resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(time.process_time() + seconds), _hard_limit))


def run(case: Case) -> tuple[PolyExploreEnv | None, exact.LeftOver | None, dict[str, Any]]:
    """Play a case; the environment, what is left (for an exact pose), and the result as plain values."""
    began = time.process_time()
    result = describe(case)
    try:
        config = from_mapping(EnvConfig, case.values)
        env = _Watched(plan=case.plan, config=config)
        options = None if case.start is None else {"start": tuple(case.start)}
        outcome, decisions, info = exact.play(env, load_policy(case.criterion), case.number, options)
    except (InvalidConfigError, InvalidFloorPlanError) as error:
        return None, None, {**result, "kind": "refused", "error": f"{type(error).__name__}: {error}"}
    except _SlowError as slow:
        return None, None, {**result, "kind": "slow", "error": str(slow)}
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno} {where.name})"
        return None, None, {**result, "kind": "exception", "error": text[:400]}
    result |= {"decisions": decisions, "scans": info["measurements"], "distance": round(info["distance"], 3),
               "seconds": round(time.process_time() - began, 2), "kind": outcome}  # fmt: skip
    if outcome == "ended":
        result["outcome"] = info["outcome"]["status"]
    if config.pose.mode != "exact":
        return env, None, result
    _allow(CPU_LIMIT)
    found = exact.check(env)
    result |= {"seen": round(100.0 * found.share, 2), "left": round(found.area / found.limit, 3),
               "drivable": round(found.drivable / found.limit, 3), "open edges": len(env.exploration.chains.id),
               "place": None if found.place is None else [round(float(v), 3) for v in found.place]}  # fmt: skip
    if outcome == "ended":
        result["kind"] = _verdict(env, found, decisions, result)
    result["check seconds"] = round(time.process_time() - began - result["seconds"], 2)
    return env, found, result


def _verdict(env: PolyExploreEnv, found: exact.LeftOver, decisions: int, result: dict[str, Any]) -> str:
    """In which way an end is wrong, if it is."""
    if not found.complete:
        if found.drivable <= 0.5 * found.area:
            return "behind a slit"
        parts = shapely.get_parts(found.unseen)
        left = shapely.union_all(parts[shapely.intersects(parts, found.shown.buffer(-1e-3 * env.config.robot.radius))])
        edges = [shapely.LineString(line) for line in shapes.jump_edges(env.exploration)]
        near = min((float(left.distance(edge)) for edge in edges), default=math.inf)
        kind = "jump edge masked" if near < env.config.robot.radius else "jump edge lost"
        return kind if decisions else f"over at reset, {kind}"
    sampled = exact.check(env, sampled=True)
    result["left, sampled"] = round(sampled.area / sampled.limit, 3)
    return "complete" if sampled.complete else "between beams"


def describe(case: Case) -> dict[str, Any]:
    """What the case is, in units of the robot's radius and as multiples of the default noise."""
    sensor, robot = case.values["sensor"], case.values["robot"]
    exploration = case.values["exploration"]
    radius = robot["radius"]
    return {
        "case": case.number, "family": case.family, "size": round(case.size, 1), "radius": round(radius, 4),
        "range/r": round(sensor["max_range"] / radius, 1), "beams": sensor["beams"],
        "fov": round(math.degrees(sensor["field_of_view"]), 1),
        "noise": round(sensor["sigma_angle"] / math.radians(0.1), 2), "drive": case.values["drive"]["mode"],
        "pose": case.values["pose"]["mode"], "placement": exploration["placement"],
        "front/r": round((exploration["front_distance"] or 4.0 * radius) / radius, 1),
        "look_around": exploration["look_around"],
        "every/r": round(exploration["scan_every"] / radius, 2), "decide": exploration["decide"],
        "interval/r": round(exploration["decide_every"] / radius, 2), "criterion": case.criterion,
        "start": "wall" if case.start else "",
    }  # fmt: skip


# The same, scaled -------------------------------------------------------------------------------

LENGTHS = {
    ("sensor", "max_range"): 1.0, ("sensor", "sigma_range"): 1.0, ("robot", "radius"): 1.0, ("robot", "track"): 1.0,
    ("robot", "max_speed"): 1.0, ("robot", "max_acceleration"): 1.0, ("pose", "sigma_xy"): 1.0,
    ("pose", "drift_distance"): 0.5, ("pose", "drift_heading"): -0.5, ("pose", "correct_every"): 1.0,
    ("mapping", "min_length"): 1.0, ("mapping", "door_width"): 1.0, ("mapping", "range_floor"): 1.0,
    ("exploration", "front_distance"): 1.0, ("exploration", "min_gap"): 1.0, ("exploration", "scan_every"): 1.0,
    ("exploration", "decide_every"): 1.0,
}  # fmt: skip
"""Configured values that hold a length, and its power."""


def scaled(case: Case, factor: float) -> Case:
    """The case with everything of a length times a factor."""
    values: dict[str, Any] = json.loads(json.dumps(case.values))
    defaults = EnvConfig()
    for (section, name), power in LENGTHS.items():
        value = values.setdefault(section, {}).get(name, getattr(getattr(defaults, section), name))
        if value is not None:
            values[section][name] = value * factor**power
    plan = FloorPlan.create(
        case.plan.exterior * factor, [hole * factor for hole in case.plan.holes], name=f"{case.plan.name}x{factor:g}"
    )
    start = None if case.start is None else [case.start[0] * factor, case.start[1] * factor, case.start[2]]
    return Case(number=case.number, family=case.family, plan=plan, values=values, criterion=case.criterion, start=start)


def run_scaled(number: int) -> dict[str, Any]:
    """Play a case and its scaled twin decision by decision until they differ."""
    case = case_of(number)
    rng = np.random.default_rng([18, number])
    factor = float(4.0 ** rng.choice([-2, -1, 1, 2]))
    absolute = {"slam": "slam looks every so many metres or radians", "odometry": "drift is drawn every so many metres",
                "utility": "the rate of utility is per metre"}  # fmt: skip
    for name in (case.values["pose"]["mode"], case.criterion):
        if name in absolute:
            return describe(case) | {"kind": "refused", "error": absolute[name]}
    if case.start is None:
        case = _with_start(case, rng)
    result = describe(case) | {"factor": factor}
    try:
        pairs = [(case, 1.0), (scaled(case, factor), factor)]
        envs = [PolyExploreEnv(plan=c.plan, config=from_mapping(EnvConfig, c.values)) for c, _ in pairs]
        states = [env.reset(seed=number, options={"start": tuple(c.start or ())})
                  for env, (c, _) in zip(envs, pairs, strict=True)]  # fmt: skip
    except (InvalidConfigError, InvalidFloorPlanError) as error:
        return result | {"kind": "refused", "error": f"{type(error).__name__}: {error}"}
    policies = [load_policy(case.criterion) for _ in pairs]
    streams = [np.random.default_rng(number) for _ in pairs]
    decisions, kind = 0, "same"
    try:
        while decisions < 200:
            nodes = [(e.exploration.chains.node[:, :2] / f, e.exploration.reachable)
                     for e, (_, f) in zip(envs, pairs, strict=True)]  # fmt: skip
            size = float(np.ptp(case.plan.exterior, axis=0).max())
            if len(nodes[0][0]) != len(nodes[1][0]):
                kind = "number of jump edges differs"
            elif not np.array_equal(nodes[0][1], nodes[1][1]):
                kind = "reachable nodes differ"
            elif len(nodes[0][0]) and np.abs(nodes[0][0] - nodes[1][0]).max() > _SAME * size:
                kind = "nodes differ"
            if kind != "same" or not states[0][1]["action_mask"].any():
                break
            actions = [p.act(*s, r) for p, s, r in zip(policies, states, streams, strict=True)]
            if actions[0] != actions[1]:
                kind = "choices differ"
                break
            steps = [env.step(a) for env, a in zip(envs, actions, strict=True)]
            states = [(s[0], s[4]) for s in steps]
            decisions += 1
            way = [s[4]["distance"] / f for s, (_, f) in zip(steps, pairs, strict=True)]
            if abs(way[0] - way[1]) > _SAME * max(size, way[0]):
                kind = "ways differ"
                break
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno} {where.name})"
        return result | {"kind": "exception", "error": text[:400], "decisions": decisions}
    return result | {"kind": kind, "decisions": decisions}


def _with_start(case: Case, rng: np.random.Generator) -> Case:
    """The case with a start of its own: the margin of a drawn one does not scale."""
    radius = case.values["robot"]["radius"]
    start = case.plan.sample_start(rng, radius, margin=0.2 * radius).tolist()
    return Case(number=case.number, family=case.family, plan=case.plan, values=case.values, criterion=case.criterion,
                start=start)  # fmt: skip


# The child process ------------------------------------------------------------------------------


def serve(scale: bool) -> None:
    """Play the cases whose numbers come line by line, one line of JSON each, under a limit of CPU time."""
    faulthandler.enable()
    faulthandler.register(signal.SIGXCPU, chain=True)  # where it hangs, then the process ends
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    global _hard_limit, _began
    run(case_of(_FIRST))  # compiles the kernels
    _hard_limit = resource.getrlimit(resource.RLIMIT_CPU)[1]
    for line in sys.stdin:
        number, _began = int(line), time.process_time()
        try:
            case = case_of(number)
            _allow(CPU_LIMIT + case.size / 200.0)
            result = run_scaled(number) if scale else run(case)[2]
        except Exception as error:  # of the fuzzer or of the check
            result = {"case": number, "kind": "fuzzer failed", "error": traceback.format_exc()[-600:] or str(error)}
        print(_MARK + json.dumps(result), flush=True)


class Child:
    """A process that plays cases, started anew when it has died."""

    def __init__(self, scale: bool, log: Path) -> None:
        self._command = [sys.executable, __file__, "--serve", *(["--scaled"] if scale else [])]
        self._log = log
        self._process: subprocess.Popen[str] | None = None
        self._errors: IO[str] | None = None

    def play(self, number: int) -> dict[str, Any]:
        """The result of a case."""
        if self._process is None or self._process.poll() is not None:
            self._errors = self._log.open("a", encoding="utf-8")
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, text=True
            )
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(f"{number}\n")
        process.stdin.flush()
        for line in process.stdout:
            if line.startswith(_MARK):
                found: dict[str, Any] = json.loads(line[len(_MARK) :])
                return found
        code = process.wait()
        said = self._log.read_text(encoding="utf-8").splitlines()[-40:]
        trace = [*said[-1:], *(line.strip() for line in said if line.startswith("  File"))]
        kind = "hang" if code == -signal.SIGXCPU else "crash"
        name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        case: dict[str, Any] = {"case": number}
        with contextlib.suppress(RuntimeError):
            case = describe(case_of(number))
        return case | {"kind": kind, "error": f"{name}; {' < '.join(t[:90] for t in trace[:4])}"}

    def close(self) -> None:
        """End the process."""
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
            self._process.wait()


GOOD = ("complete", "ended", "refused", "same")
"""Kinds of results that are no findings."""


def table(results: list[dict[str, Any]]) -> str:
    """Findings by kind, with the smallest cases of each."""
    rows = []
    for kind in sorted({r["kind"] for r in results}, key=lambda k: (k in GOOD, k)):
        group = sorted((r for r in results if r["kind"] == kind), key=lambda r: r.get("size", math.inf))
        smallest = "; ".join(_short(r) for r in group[: 1 if kind in GOOD else 6])
        rows.append([kind, f"{len(group)}", smallest])
    return format_table(("kind", "cases", "the smallest"), rows, "markdown")


def _short(r: dict[str, Any]) -> str:
    left = f" left {r['left']:g} seen {r['seen']:g} %" if "left" in r else ""
    text = f"{r['case']} ({r.get('family')}, {r.get('size', 0):.0f} r2{left})"
    return f"{text} {r['error'][:160]}" if "error" in r and r["kind"] != "refused" else text


def read(file: Path) -> dict[int, dict[str, Any]]:
    """Results so far by case; a torn last line does not count."""
    found: dict[int, dict[str, Any]] = {}
    for line in file.read_text(encoding="utf-8").splitlines() if file.exists() else ():
        with contextlib.suppress(ValueError):
            result = json.loads(line)
            found[result["case"]] = result
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--cases", type=int, nargs="+", help="these instead, also those played already")
    parser.add_argument("--seconds", type=float, default=math.inf, help="stop after so many")
    parser.add_argument("--largest", type=float, default=math.inf, help="leave out plans of more squares of the radius")
    parser.add_argument("--pose", help="only cases of this pose mode")
    parser.add_argument("--case", type=int, help="play this one here and print all about it")
    parser.add_argument("--picture", type=Path, help="of --case")
    parser.add_argument("--scaled", action="store_true", help="the same exploration in another size")
    parser.add_argument("--out", type=Path, default=Path("results/fuzz"), help="folder of the results")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(options.scaled)
    elif options.case is not None:
        case = case_of(options.case)
        if options.scaled:
            print(json.dumps(run_scaled(options.case), indent=1))
            return
        print(json.dumps(case.values, indent=1))
        env, found, result = run(case)
        print(json.dumps(result, indent=1))
        if options.picture is not None and env is not None and found is not None:
            exact.draw(env, found, options.picture)
    else:
        _study(options)


def _study(options: argparse.Namespace) -> None:
    options.out.mkdir(parents=True, exist_ok=True)
    file = options.out / ("scaled.jsonl" if options.scaled else "cases.jsonl")
    known = read(file)
    todo = options.cases or [n for n in range(options.first, options.first + options.count) if n not in known]
    child = Child(options.scaled, options.out / f"child-{os.getpid()}.log")
    began = time.monotonic()
    with file.open("a", encoding="utf-8") as out:
        for number in todo:
            if time.monotonic() - began > options.seconds:
                break
            case = case_of(number)
            if case.size > options.largest or options.pose not in (None, case.values["pose"]["mode"]):
                continue
            result = known[number] = child.play(number)
            out.write(json.dumps(result) + "\n")
            out.flush()
            if result["kind"] not in GOOD:
                print(f"{result['kind']}: {_short(result)}", flush=True)
    child.close()
    wanted = options.cases or range(options.first, options.first + options.count)
    print("\n" + table([known[n] for n in wanted if n in known]))


if __name__ == "__main__":
    main()
