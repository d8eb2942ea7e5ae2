"""Do walls hold, whatever the robot? Drives into, along and through walls over the whole range of legal robots.

    python benchmarks/wall_contacts.py [--drives 10000] [--seed 0]

Robots are drawn evenly in the logarithm: radius 0.02 to 2 m, speed 0.05 to 50 m/s, time step 1 to 200 ms (the longest
that is legal), acceleration 0.2 to 200 times the speed in a second, turn rate 0.3 to 30 rad/s, reached in 5 ms to 2 s.
So a step may be a thousandth of the radius or hundreds of radii. The scenes are drawn in radii, turned and moved: a
wall met at any angle; a wall driven along, at a grazing angle; corners from outside and from inside; a door a little
wider or narrower than the disc; and walls strewn at random. In every scene the robot drives eight times, each time from
where it is: a quarter of these drives goes on as before, against what stopped it. Half of them are cut short at random,
so that the next begins at speed: along the rest of the path, or a new one that leads through the place where the robot
can halt, or anywhere.

One row a mode: drives that passed through a wall (the centre of the disc met one), the deepest overlap of disc and
wall anywhere on the way and where the robot stood in the end, and the greatest jump: way between two poses beyond speed
times step (physics) or the way of a drive beyond speed times its duration (kinematic). Overlaps and jumps are in
millionths of the radius; shapely measures them on the whole way, also between the poses. Exit code 1 if a wall did not
hold.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import shapely

from polyexplore_gym.config import DriveConfig, RobotConfig, SensorConfig
from polyexplore_gym.evaluation.tables import format_table
from polyexplore_gym.sim.world import DriveResult, World

DRIVES_A_SCENE = 8
MODES = ("physics", "kinematic")
ALLOWED = 1e-5
"""Overlap and jump, in radii, that count as rounding."""

Scene = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Walls (M, 4), start (2,) and goal (2,), in radii."""


def towards(rng: np.random.Generator) -> Scene:
    """A long wall ahead, met at any angle, from any distance."""
    x, drift = rng.uniform(1.001, 30.0), rng.uniform(-1.0, 1.0)
    beyond = rng.uniform(0.1, 60.0)
    return np.array([[0.0, -200.0, 0.0, 200.0]]), np.array([x, 0.0]), np.array([-beyond, drift * (x + beyond) * 2.0])


def along(rng: np.random.Generator) -> Scene:
    """A wall of some length beside the way, which leads into it a little."""
    gap, into, end = 1.0 + 10.0 ** rng.uniform(-4, -0.5), rng.uniform(-0.5, 1.0), rng.uniform(2.0, 60.0)
    walls = np.array([[-5.0, 0.0, end, 0.0], [end, 0.0, end + rng.uniform(-3.0, 3.0), rng.uniform(-5.0, 0.5)]])
    return walls, np.array([0.0, gap]), np.array([rng.uniform(5.0, 80.0), gap - into])


def corner(rng: np.random.Generator) -> Scene:
    """Two walls that meet at any angle, from any side."""
    first, second = rng.uniform(-math.pi, math.pi, 2)
    walls = np.array([[0.0, 0.0, r * math.cos(a), r * math.sin(a)] for r, a in ((50.0, first), (50.0, second))])
    return walls, *apart(rng, walls, 12.0)


def door(rng: np.random.Generator) -> Scene:
    """A wall with a door, somewhat wider or narrower than the disc, and a second wall behind it."""
    half, thick = 1.0 + rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-4.0, -0.3), 10.0 ** rng.uniform(-3.0, 0.5)
    sides = [(s, x) for s in (-1.0, 1.0) for x in (-thick / 2.0, thick / 2.0)]
    walls = [[x, s * half, x, s * 100.0] for s, x in sides]
    walls += [[-thick / 2.0, s * half, thick / 2.0, s * half] for s in (-1.0, 1.0)]
    start = np.array([rng.uniform(2.0, 20.0) + thick, rng.normal(0.0, 1.0)])
    return np.array(walls), start, np.array([-rng.uniform(2.0, 40.0), rng.normal(0.0, 1.0)])


def strewn(rng: np.random.Generator) -> Scene:
    """Walls of all lengths at random, every second joined to the one before."""
    count = int(rng.integers(5, 40))
    start = rng.uniform(-30.0, 30.0, (count, 2))
    length, angle = 10.0 ** rng.uniform(-2.0, 1.5, count), rng.uniform(-math.pi, math.pi, count)
    walls = np.hstack([start, start + length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)])
    walls[1::2, :2] = walls[:-1:2, 2:] if count % 2 == 0 else walls[: count - 1 : 2, 2:]
    return walls, *apart(rng, walls, 30.0)


def apart(rng: np.random.Generator, walls: np.ndarray, half: float) -> tuple[np.ndarray, np.ndarray]:
    """A start where the disc stands clear of the walls, and a goal anywhere."""
    lines = shapely.multilinestrings(walls.reshape(-1, 2, 2))
    while True:
        start = rng.uniform(-half, half, 2)
        if shapely.distance(lines, shapely.points(start)) > 1.0001:
            return start, rng.uniform(-half, half, 2)


SCENES: tuple[Callable[[np.random.Generator], Scene], ...] = (towards, along, corner, door, strewn)


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def robot_and_step(rng: np.random.Generator) -> tuple[RobotConfig, float]:
    """Any legal robot, and a time step."""
    radius, speed, rate = log_uniform(rng, 0.02, 2.0), log_uniform(rng, 0.05, 50.0), log_uniform(rng, 0.3, 30.0)
    robot = RobotConfig(
        radius=radius,
        track=radius * rng.uniform(0.5, 2.0),
        max_speed=speed,
        max_acceleration=speed * log_uniform(rng, 0.2, 200.0),
        max_turn_rate=rate,
        max_turn_acceleration=rate * log_uniform(rng, 0.5, 200.0),
    )
    return robot, log_uniform(rng, 0.001, 0.2)


@dataclass
class Tally:
    """What the drives of one mode came to; overlaps and jumps in radii."""

    drives: int = 0
    bumps: int = 0
    arrived: int = 0
    cut: int = 0
    moving: int = 0
    passed: int = 0
    way: float = -math.inf
    standing: float = -math.inf
    jump: float = -math.inf
    longest: float = 0.0
    seconds: float = 0.0

    def add(self, world: World, lines: shapely.Geometry, result: DriveResult) -> None:
        robot, points = world.robot, result.trajectory[:, :2]
        way = shapely.linestrings(points) if len(points) > 1 else shapely.points(points[0])
        nearest = shapely.distance(way, lines)
        if world.config.mode == "physics":
            steps = np.hypot(*np.diff(points, axis=0).T)
            jump = steps.max(initial=0.0) - robot.max_speed * world.config.time_step
        else:
            jump = result.distance - robot.max_speed * result.duration
        stands = shapely.distance(shapely.points(points[-1]), lines)
        self.drives += 1
        self.bumps += result.collided
        self.arrived += result.arrived
        self.cut += result.ended == "cut"
        self.moving += world.velocity[0] > 0.0
        self.passed += bool(nearest <= 1e-9 * robot.radius)
        self.way = max(self.way, 1.0 - nearest / robot.radius)
        self.standing = max(self.standing, 1.0 - stands / robot.radius)
        self.jump = max(self.jump, jump / robot.radius)
        self.longest = max(self.longest, robot.max_speed * world.config.time_step / robot.radius)

    def row(self) -> list[str]:
        micro = [f"{1e6 * max(value, 0.0):.3f}" for value in (self.way, self.standing, self.jump)]
        spent = f"{1e3 * self.seconds / self.drives:.2f}"
        counts = (self.drives, self.bumps, self.arrived, self.cut, self.moving, self.passed)
        return [*map(str, counts), *micro, f"{self.longest:.0f}", spent]


def play(rng: np.random.Generator, scene: Callable[[np.random.Generator], Scene], mode: str, tally: Tally) -> None:
    """Drive several times in a new scene."""
    walls, start, goal = scene(rng)
    robot, step = robot_and_step(rng)
    turn, shift = rng.uniform(-math.pi, math.pi), rng.uniform(-50.0, 50.0, 2)
    c, s = math.cos(turn), math.sin(turn)
    rotation = np.array([[c, s], [-s, c]])
    walls = ((walls.reshape(-1, 2) @ rotation) * robot.radius + shift).reshape(-1, 4)
    start, goal = ((p @ rotation) * robot.radius + shift for p in (start, goal))
    config = DriveConfig(mode=mode, time_step=step, time_limit=100.0)  # type: ignore[arg-type]
    world = World(walls, robot, SensorConfig(), config, np.array([*start, rng.uniform(-math.pi, math.pi)]))
    lines = shapely.multilinestrings(walls.reshape(-1, 2, 2))
    way = np.array([start, goal])
    for _ in range(DRIVES_A_SCENE):
        cut = {}
        if rng.random() < 0.5:
            way_cut, turn_cut = robot.radius * log_uniform(rng, 0.01, 20.0), log_uniform(rng, 0.01, 10.0)
            cut = {"distance": way_cut} if rng.random() < 0.7 else {"distance": way_cut, "turn": turn_cut}
        began = time.perf_counter()
        result = world.drive(way, rng.uniform(-3.0, 3.0) if rng.random() < 0.5 else None, **cut)
        tally.seconds += time.perf_counter() - began
        tally.add(world, lines, result)
        way = next_way(rng, world, way[result.next_vertex :], goal)


def next_way(rng: np.random.Generator, world: World, rest: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """A path from where the robot is: a quarter leads on to where it was going, half first to where it can halt."""
    here, radius = world.pose[:2], world.robot.radius
    if rng.random() < 0.25:
        return np.vstack([here, rest if len(rest) else goal])
    way = [here, world.halt] if rng.random() < 0.5 else [here]
    if rng.random() < 0.3:
        way.append(here + rng.normal(0.0, 5.0, 2) * radius)
    return np.array([*way, here + rng.normal(0.0, 15.0, 2) * radius])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=10_000, help="in each mode")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    tallies = {mode: Tally() for mode in MODES}
    for mode, tally in tallies.items():
        rng = np.random.default_rng(options.seed)
        play(np.random.default_rng(0), towards, mode, Tally())  # compiles the kernels
        for k in range(math.ceil(options.drives / DRIVES_A_SCENE)):
            play(rng, SCENES[k % len(SCENES)], mode, tally)
    counts = ["mode", "drives", "bumps", "arrived", "cut", "at speed", "passed"]
    head = [*counts, "deepest", "standing", "jump", "longest step", "ms a drive"]
    print(format_table(head, [[mode, *tally.row()] for mode, tally in tallies.items()]))
    print("deepest, standing and jump in millionths of the radius; longest step in radii")
    held = all(t.passed == 0 and max(t.way, t.standing, t.jump) < ALLOWED for t in tallies.values())
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())
