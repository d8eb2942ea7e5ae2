"""Random scenes for the exploration tests, and exact references for them (shapely, scipy)."""

from __future__ import annotations

import itertools
import math

import numpy as np
import shapely
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from polyexplore_gym.config import ExplorationConfig, SensorConfig
from polyexplore_gym.exploration.tolerances import Tolerances, tolerances


def tol_of(sensor: SensorConfig | None = None, radius: float = 0.25, **changes: float) -> Tolerances:
    """The tolerances of a robot with the default exploration, some of them changed."""
    return tolerances(ExplorationConfig(), sensor or SensorConfig(), radius)._replace(**changes)


# Scenes ------------------------------------------------------------------------------------------


def ring(points) -> np.ndarray:
    """The walls (n, 4) of a closed ring of corners (n, 2)."""
    p = np.asarray(points, float)
    return np.hstack([p, np.roll(p, -1, axis=0)])


def box(x0, y0, x1, y1, angle=0.0) -> np.ndarray:
    """A rectangle, turned about its middle."""
    p = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], float)
    m = p.mean(axis=0)
    c, s = math.cos(angle), math.sin(angle)
    return ring((p - m) @ np.array([[c, s], [-s, c]]) + m)


def turned(walls: np.ndarray, angle: float) -> np.ndarray:
    """The walls turned about the origin."""
    c, s = math.cos(angle), math.sin(angle)
    return (walls.reshape(-1, 2) @ np.array([[c, s], [-s, c]])).reshape(-1, 4)


def strewn(rng: np.random.Generator, count: int, half: float = 5.0) -> np.ndarray:
    """A square room with free-standing thin walls."""
    start = rng.uniform(-half, half, (count, 2))
    way = rng.normal(0.0, 1.3, (count, 2))
    way[::3, 0] = 0.0
    end = np.clip(start + way, -half, half)
    return np.vstack([box(-half, -half, half, half), np.hstack([start, end])])


def furnished(rng: np.random.Generator, count: int, half: float = 5.0) -> np.ndarray:
    """A square room with turned boxes, some of them slim."""
    walls = [box(-half, -half, half, half)]
    for _ in range(count):
        x, y = rng.uniform(-half + 0.3, half - 0.3, 2)
        w, h = rng.uniform(0.05, 1.6, 2)
        walls.append(box(x - w / 2, y - h / 2, x + w / 2, y + h / 2, rng.choice([0.0, rng.uniform(0, math.pi)])))
    return np.vstack(walls)


def rooms(rng: np.random.Generator, thickness: float, half: float = 5.0, narrow: float = 0.6) -> np.ndarray:
    """A square cut into four rooms or more by walls (thin, or boxes) with a door each, `narrow` to 1.2 m wide."""
    walls = [box(-half, -half, half, half)]
    cells = [(-half, -half, half, half)]
    for _ in range(int(rng.integers(3, 6))):
        i = int(np.argmax([(c[2] - c[0]) * (c[3] - c[1]) for c in cells]))
        x0, y0, x1, y1 = cells.pop(i)
        upright = x1 - x0 > y1 - y0
        if not upright:
            x0, y0, x1, y1 = y0, x0, y1, x1
        at = rng.uniform(x0 + 1.3, x1 - 1.3) if x1 - x0 > 2.7 else 0.5 * (x0 + x1)
        door = rng.uniform(narrow, 1.2)
        low = rng.choice([y0, y0 + 0.05, y1 - door, rng.uniform(y0, y1 - door)])
        for a, b in ((y0, low), (low + door, y1)):
            if b - a <= 1e-6:
                continue
            if thickness > 0:
                wall = [(at - thickness / 2, a, at + thickness / 2, b)]
                wall = [(p[1], p[0], p[3], p[2]) if not upright else p for p in wall]
                walls.append(box(*wall[0]))
            else:
                wall = (at, a, at, b) if upright else (a, at, b, at)
                walls.append(np.array([wall]))
        parts = [(x0, y0, at - thickness / 2, y1), (at + thickness / 2, y0, x1, y1)]
        cells += [(p[1], p[0], p[3], p[2]) if not upright else p for p in parts]
    return np.vstack(walls)


def ragged(rng: np.random.Generator, walls: np.ndarray) -> np.ndarray:
    """As a line map has them: ends that miss each other, walls in overlapping parts, doubled walls."""
    out = []
    for x1, y1, x2, y2 in walls:
        p, q = np.array([x1, y1]), np.array([x2, y2])
        size = np.linalg.norm(q - p)
        if size < 1e-9:
            continue
        d = (q - p) / size
        n = np.array([-d[1], d[0]])
        p, q = p + d * rng.uniform(-0.03, 0.06), q - d * rng.uniform(-0.03, 0.06)
        if size > 1.5 and rng.random() < 0.4:
            f = rng.uniform(0.3, 0.7)
            m = p + f * (q - p)
            lap = rng.uniform(-0.04, 0.2)
            out.append([*(p + n * rng.normal(0, 0.01)), *(m + n * rng.normal(0, 0.01) + d * lap)])
            out.append([*(m + n * rng.normal(0, 0.01)), *(q + n * rng.normal(0, 0.01))])
        else:
            out.append([*(p + n * rng.normal(0, 0.01)), *(q + n * rng.normal(0, 0.01))])
        if rng.random() < 0.15:
            a, b = np.sort(rng.uniform(0, 1, 2))
            shift = n * rng.normal(0, 0.03)
            out.append([*(p + a * (q - p) + shift), *(p + b * (q - p) + shift)])
    return np.array(out)


FAMILIES = ("strewn", "furnished", "rooms", "thick rooms", "ragged rooms", "ragged thick rooms", "ragged furniture")


def scene(family: str, seed: int) -> np.ndarray:
    """Walls (m, 4) of one random scene; every other one is turned by a random angle."""
    rng = np.random.default_rng([FAMILIES.index(family), seed])
    if family == "strewn":
        walls = strewn(rng, int(rng.integers(5, 22)))
    elif "furni" in family:
        walls = furnished(rng, int(rng.integers(3, 8)))
    else:
        walls = rooms(rng, float(rng.uniform(0.08, 0.3)) if "thick" in family else 0.0)
    if seed % 2:
        walls = turned(walls, rng.uniform(0, math.pi))
    return ragged(rng, walls) if "ragged" in family else walls


def lines_of(walls: np.ndarray) -> shapely.Geometry:
    return shapely.multilinestrings(np.asarray(walls).reshape(-1, 2, 2))


def free_space(walls: np.ndarray, radius: float, quad_segs: int = 6) -> shapely.Geometry:
    """Where the centre of a disc may be, inside the hull of the walls; a little too large (inscribed arcs)."""
    lines = lines_of(walls)
    return lines.convex_hull.difference(lines.buffer(radius, quad_segs=quad_segs))


def clear_points(rng: np.random.Generator, walls: np.ndarray, clearance: float, count: int) -> np.ndarray:
    """Random points inside the hull at least `clearance` from all walls."""
    area = free_space(walls, clearance, quad_segs=16)
    x0, y0, x1, y1 = area.bounds
    found: list[np.ndarray] = []
    shapely.prepare(area)
    while len(found) < count:
        p = rng.uniform((x0, y0), (x1, y1), (256, 2))
        found += list(p[shapely.contains_xy(area, p)])
    return np.array(found[:count])


# The exact shortest path --------------------------------------------------------------------------


def shortest_lengths(area: shapely.Geometry, points: np.ndarray) -> np.ndarray:
    """Lengths (k, k) of the shortest paths between points inside a polygonal area (visibility graph)."""
    vertices, before, after = [], [], []
    area = shapely.remove_repeated_points(area, 1e-7)
    for part in shapely.get_parts(area):
        for r in (part.exterior, *part.interiors):
            p = shapely.get_coordinates(r)[:-1]
            if shapely.is_ccw(r) != r.equals(part.exterior):
                p = p[::-1]
            b, a = np.roll(p, 1, axis=0), np.roll(p, -1, axis=0)
            turn = (p[:, 0] - b[:, 0]) * (a[:, 1] - p[:, 1]) - (p[:, 1] - b[:, 1]) * (a[:, 0] - p[:, 0])
            reflex = turn < -1e-12
            vertices.append(p[reflex])
            before.append(b[reflex])
            after.append(a[reflex])
    k = len(points)
    v = np.concatenate([points, *vertices])
    b = np.concatenate([points, *before])
    a = np.concatenate([points, *after])
    i, j = np.triu_indices(len(v), 1)
    d = v[j] - v[i]

    def tangent(at):
        c1 = d[:, 0] * (b[at] - v[at])[:, 1] - d[:, 1] * (b[at] - v[at])[:, 0]
        c2 = d[:, 0] * (a[at] - v[at])[:, 1] - d[:, 1] * (a[at] - v[at])[:, 0]
        return (at < k) | (c1 * c2 >= -1e-12)

    keep = tangent(i) & tangent(j)
    i, j = i[keep], j[keep]
    wide = area.buffer(1e-7)
    shapely.prepare(wide)
    seen = shapely.covers(wide, shapely.linestrings(np.stack((v[i], v[j]), axis=1)))
    i, j = i[seen], j[seen]
    length = np.hypot(*(v[i] - v[j]).T)
    graph = csr_matrix((np.maximum(length, 1e-12), (i, j)), shape=(len(v), len(v)))
    return dijkstra(graph, directed=False, indices=np.arange(k))[:, :k]


# Openings -----------------------------------------------------------------------------------------


def width_of(chain: np.ndarray, walls: np.ndarray, tol: Tolerances) -> float:
    """Width of the opening behind a chain of open edges (m, 4) in order: the gaps in it and on to the walls count.

    What runs round the tip of a shadow is as wide as its bounding box at most, crumbs as 2.5 times their length.
    """
    edges = shapely.linestrings(chain.reshape(-1, 2, 2))
    total = shapely.length(edges).sum()
    gaps = sum(math.dist(a[2:], b[:2]) for a, b in itertools.pairwise(chain))
    x0, y0, x1, y1 = shapely.total_bounds(edges)
    width = min(total + gaps, math.hypot(x1 - x0, y1 - y0))
    for end in (chain[0, :2], chain[-1, 2:]) if width < tol.gap else ():
        away = lines_of(walls).distance(shapely.Point(end)) if len(walls) else math.inf
        width += away if away < tol.cover + tol.join else 0.0
    return float(min(width, 2.5 * total))


def room_of(chain: np.ndarray, walls: np.ndarray, tol: Tolerances) -> float:
    """How wide a disc that goes through a chain of open edges (m, 4), gaps included, may be: `tol.gap` at most."""
    along = shapely.LineString(chain.reshape(-1, 2)).segmentize(0.01 * tol.gap)
    less = min(6.0 * tol.sigma_range, 0.25 * tol.radius)  # noise may have made walls longer
    way = walls[:, 2:] - walls[:, :2]
    length = np.hypot(*way.T)
    share = np.where(length > 3.0 * less, less / length, 0.0)[:, None]
    walls = np.concatenate((walls[:, :2] + share * way, walls[:, 2:] - share * way), axis=1)
    away = shapely.distance(lines_of(walls), shapely.points(shapely.get_coordinates(along))) if len(walls) else math.inf
    return float(min(2.0 * np.max(away), tol.gap))


# Star polygons ------------------------------------------------------------------------------------


def star(rng: np.random.Generator, n: int, fov: float, rough: float = 1.0) -> tuple[np.ndarray, np.ndarray, bool]:
    """Angles and ranges (n,) of a random scan, and whether it goes all the way round."""
    full = fov >= 2 * math.pi - 1e-9
    angles = -math.pi + np.arange(n) * 2 * math.pi / n if full else np.linspace(-fov / 2, fov / 2, n)
    steps = rng.integers(0, n, 5)
    ranges = 3.0 + np.cumsum(rng.normal(0, 0.2, n)) * 0.3 + rough * rng.uniform(-1, 1, n)
    for s in steps:
        ranges[s:] += rng.normal(0, 1.0)
    return angles, np.clip(ranges, 0.4, 7.5), full
