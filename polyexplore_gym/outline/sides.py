"""The boundary of the seen area as sides: stretches along one straight line each, as few as the measurements allow."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from polyexplore_gym.mapping import Walls
from polyexplore_gym.outline.views import CLEARANCE, SPARE

ON_LINE = 5e-4
"""What was moved onto a line lies within this of it, m: closing cracks moves the boundary by 1 % of their width."""
PARALLEL = math.sin(math.radians(8.0))
"""Sides that meet at a smaller angle, or a larger one than 180 degrees less this, have no corner of their own."""
PARALLEL_LINES = math.sin(math.radians(3.0))
"""The same of two sides on lines of the map, whose directions are known better."""
CRACK = 0.03
"""An opening that is narrower is noise, m."""
OPEN = 0.1
"""Greatest deviation of a side of which nothing was seen, m."""
LONGEST_RUN = 3
"""So many sides in a row, of which nothing was seen, go together."""
STEADY = 0.1
"""Returns tell the direction of a side only so well or better, rad; else it is that of the boundary."""


@dataclass(slots=True)
class Side:
    """A stretch of a ring along a line."""

    start: int
    """Index of the ring's vertex where it begins."""
    stop: int
    """... and ends, more than `start`; beyond the ring's size it has passed the first vertex."""
    point: np.ndarray
    """(2,) on the line, m."""
    direction: np.ndarray
    """(2,) unit vector; the free space lies on its left."""
    line: int
    """Of the map; -1: none."""
    support: float
    """Length along which walls or returns stand for it, m."""
    held: int = 0
    """1: it goes from and to the boundary's own vertices; 2: and by all of those between."""


def labels(ring: np.ndarray, walls: Walls, tree: Any) -> np.ndarray:
    """(n,) the line that each edge of a ring (n, 2) runs along, -1: none. `tree`: an STRtree of the walls."""
    out = np.full(len(ring), -1)
    if not len(walls.segments):
        return out
    after = np.roll(ring, -1, axis=0)
    middles = shapely.points((ring + after) / 2)
    edge, near = tree.query(middles, predicate="dwithin", distance=SPARE + 0.02)
    line = walls.line[near]
    normal = np.stack([np.cos(walls.alpha[line]), np.sin(walls.alpha[line])], axis=1)
    rho = walls.rho[line]
    off = np.maximum(np.abs((ring[edge] * normal).sum(1) - rho), np.abs((after[edge] * normal).sum(1) - rho))
    on = off < ON_LINE
    along = walls.segments[near, 2:] - walls.segments[near, :2]
    on &= ((after[edge] - ring[edge]) * along).sum(1) >= 0.0
    nearest_last = np.flatnonzero(on)[np.argsort(-off[on], kind="stable")]
    out[edge[nearest_last]] = line[nearest_last]
    return out


def sides_of(ring: np.ndarray, label: np.ndarray, walls: Walls, loose: Any, tolerance: float) -> list[Side]:
    """The sides of a ring (n, 2), in order: stretches on a line of the map, and between them as few as will do.

    Args:
        ring: the boundary, free space on its left; not closed.
        label: of `labels`.
        walls: those of the map.
        loose: an STRtree of the returns on no wall.
        tolerance: greatest deviation of the boundary from a side that is on no line of the map, m.
    """
    n = len(ring)
    change = np.flatnonzero(label != np.roll(label, 1))
    if not change.size:
        change = np.array([0])
    out = []
    for a, b in zip(change.tolist(), [*change[1:].tolist(), int(change[0]) + n], strict=True):
        line = int(label[a])
        if line >= 0:
            along = ring[b % n] - ring[a]
            out.append(_on_wall(a, b, ring, walls, line, float(np.hypot(*along))))
            continue
        stretch = ring[np.arange(a, b + 1) % n]
        cuts = _simplified(stretch, tolerance)
        out += [_free(a + int(i), a + int(j), stretch[i], stretch[j], loose) for i, j in itertools.pairwise(cuts)]
    return out


def _on_wall(start: int, stop: int, ring: np.ndarray, walls: Walls, line: int, length: float) -> Side:
    alpha, rho = walls.alpha[line], walls.rho[line]
    normal = np.array([math.cos(alpha), math.sin(alpha)])
    direction = np.array([-normal[1], normal[0]])
    n = len(ring)
    if (ring[stop % n] - ring[start]) @ direction < 0:
        direction = -direction
    point = ring[start] - (ring[start] @ normal - rho) * normal
    return Side(start, stop, point, direction, line, length)


def _simplified(stretch: np.ndarray, tolerance: float) -> np.ndarray:
    """Rows (k,) of a stretch (n, 2) that are left by Douglas and Peucker, 1973; a closed one keeps three and more."""
    n = len(stretch)
    keep = np.zeros(n, bool)
    keep[[0, -1]] = True
    stack = [(0, n - 1)]
    if np.array_equal(stretch[0], stretch[-1]) and n > 3:
        far = int(np.argmax(((stretch - stretch[0]) ** 2).sum(1)))
        keep[far] = True
        stack = [(0, far), (far, n - 1)]
    while stack:
        a, b = stack.pop()
        if b - a < 2:
            continue
        off = distance_to(stretch[a + 1 : b], stretch[a], stretch[b])
        k = int(np.argmax(off))
        if off[k] > tolerance:
            keep[a + 1 + k] = True
            stack += [(a, a + 1 + k), (a + 1 + k, b)]
    return np.flatnonzero(keep)


def distance_to(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n,) distances of points (n, 2) from the segment a to b, m."""
    along = b - a
    length2 = max(float(along @ along), 1e-18)
    at = np.clip((points - a) @ along / length2, 0.0, 1.0)
    return np.hypot(*(points - a - at[:, None] * along).T)


def _from_chain(point: np.ndarray, chain: np.ndarray) -> float:
    """Distance of a point (2,) from a chain (n, 2), m."""
    along = np.diff(chain, axis=0)
    at = ((point - chain[:-1]) * along).sum(1) / np.maximum((along**2).sum(1), 1e-18)
    off = point - chain[:-1] - np.clip(at, 0.0, 1.0)[:, None] * along
    return float(np.sqrt((off**2).sum(1).min()))


def _free(start: int, stop: int, a: np.ndarray, b: np.ndarray, loose: Any) -> Side:
    """A side on no line of the map, through the returns near to it if there are any."""
    along = b - a
    length = max(float(np.hypot(*along)), 1e-12)
    direction = along / length
    side = Side(start, stop, (a + b) / 2, direction, -1, 0.0)
    near = (
        loose.query(shapely.linestrings([a, b]), predicate="dwithin", distance=CLEARANCE) if loose is not None else []
    )
    if not len(near):
        return side
    points = shapely.get_coordinates(loose.geometries[near])
    at = (points - a) @ direction
    within = (at > min(0.02, 0.2 * length)) & (at < length - min(0.02, 0.2 * length))
    points, at = points[within], at[within]
    if len(points) < 2:
        return side
    gaps = np.diff(np.sort(np.concatenate(([0.0], at, [length]))))
    side.support = float(length - gaps[gaps > 2 * CLEARANCE].sum())
    centre = points.mean(axis=0)
    spread, axes = np.linalg.eigh((points - centre).T @ (points - centre))
    axis = axes[:, 1] if axes[:, 1] @ direction > 0 else -axes[:, 1]
    # The direction's error: that across, over the spread along.
    error = math.sqrt(max(spread[0], 0.0) / max(len(points) - 2, 1) / max(spread[1], 1e-12))
    side.point = centre
    if len(points) >= 4 and error < STEADY and axis @ direction > 0.8:
        side.direction = axis
    return side


def crossing(p: Side, q: Side) -> np.ndarray | None:
    """Where the lines of two sides meet, None if they are (nearly) parallel."""
    sine = p.direction[0] * q.direction[1] - p.direction[1] * q.direction[0]
    if abs(sine) < (PARALLEL_LINES if p.line >= 0 and q.line >= 0 else PARALLEL):
        return None
    d = q.point - p.point
    return p.point + (d[0] * q.direction[1] - d[1] * q.direction[0]) / sine * p.direction


def projected(point: np.ndarray, side: Side) -> np.ndarray:
    """The nearest point of a side's line."""
    return side.point + ((point - side.point) @ side.direction) * side.direction


def reduced(sides: list[Side], ring: np.ndarray, tolerance: float, reach: float) -> list[Side]:
    """The sides without those that nothing speaks for: their neighbours meet instead.

    A side goes where the measured boundary deviates by no more than `tolerance` (m) from its neighbours, led on to
    where they meet; and sides of which nothing was seen, up to `LONGEST_RUN` in a row, where no more than `reach` (m)
    is closed by that. A side on no line of the map joins a neighbour from whose line it deviates no more.
    """
    sides = list(sides)
    while True:
        order = sorted(range(len(sides)), key=lambda k: (sides[k].support, sides[k].stop - sides[k].start))
        gone: set[int] = set()
        touched: set[int] = set()
        m = len(sides)
        for k in order:
            for run in range(1, LONGEST_RUN + 1):
                some = [(k + i) % m for i in range(-1, run + 1)]
                if m - len(gone) < run + 3 or touched.intersection(some):
                    break
                if run > 1 and any(sides[i].support > 0.0 for i in some[1:-1]):
                    break
                joined = _without(sides[some[0]], sides[k], sides[some[-1]], ring, tolerance, reach)
                if joined is None:
                    continue
                if len(joined) == 1:
                    if m - len(gone) < run + 4:
                        break
                    gone.add(some[-1])
                    sides[some[0]] = joined[0]
                touched.update(some)
                gone.update(some[1:-1])
                break
            if k not in touched:
                for other in ((k - 1) % m, (k + 1) % m):
                    if m - len(gone) > 3 and other not in touched and _joins(sides[k], sides[other], ring, tolerance):
                        first, second = (other, k) if other == (k - 1) % m else (k, other)
                        sides[other] = _led_on(sides[first], sides[second], sides[other], len(ring))
                        touched.update((k, other))
                        gone.add(k)
                        break
        if not gone:
            return sides
        sides = [side for k, side in enumerate(sides) if k not in gone]


def _joins(side: Side, lead: Side, ring: np.ndarray, tolerance: float) -> bool:
    """Whether a side may as well run along the line of its neighbour."""
    if (side.line >= 0, side.support) > (lead.line >= 0, lead.support) or side.direction @ lead.direction < 0.5:
        return False
    stretch = ring[np.arange(side.start, side.stop + 1) % len(ring)]
    # Two lines of the map are two walls, unless they are one that was seen in two ways.
    allowed = 0.5 * tolerance if side.line >= 0 else OPEN if lead.support == 0.0 else tolerance
    return bool(np.abs(_left_of(lead, stretch)).max() <= allowed)


def _left_of(side: Side, points: np.ndarray) -> np.ndarray:
    """(n,) how far points (n, 2) lie on the left of a side's line, m."""
    return (points - side.point) @ np.array([-side.direction[1], side.direction[0]])


def _led_on(p: Side, q: Side, lead: Side, n: int) -> Side:
    """One side from the beginning of p to the end of q, which follows it, along the line of one of them."""
    stop = q.stop + n * math.ceil((p.stop - q.start) / n)
    return Side(p.start, stop, lead.point, lead.direction, lead.line, p.support + q.support)


def _without(p: Side, s: Side, q: Side, ring: np.ndarray, tolerance: float, reach: float) -> tuple[Side, ...] | None:
    """The neighbours p and q of a side s that goes: two, or one if they lie on one line; None if s has to stay."""
    n = len(ring)
    first, last = p.stop, q.start + n * math.ceil((p.stop - q.start) / n)
    stretch = ring[np.arange(first, last + 1) % n]
    a, b = stretch[0], stretch[-1]
    width = math.hypot(*(b - a))
    corner = crossing(p, q)
    if corner is None:
        if p.direction @ q.direction < 0:
            return None
        lead = p if (p.line >= 0, p.support) >= (q.line >= 0, q.support) else q
        other = q if lead is p else p
        ends = ring[[other.start % n, other.stop % n]]
        if not p.line == q.line >= 0 and np.abs(_left_of(lead, ends)).max() > tolerance:
            return None
        left = _left_of(lead, stretch)
        closed = s.support == 0.0 and width <= reach and left.min() >= -tolerance
        if np.abs(left).max() > tolerance and width > CRACK and not closed:
            return None
        return (_led_on(p, q, lead, n),)
    ahead = (corner - ring[p.start % n]) @ p.direction
    behind = (ring[q.stop % n] - corner) @ q.direction
    if ahead < 0 or behind < 0:
        return None
    off = np.minimum(distance_to(stretch, a, corner), distance_to(stretch, corner, b)).max()
    far = max(math.hypot(*(corner - a)), math.hypot(*(corner - b)))
    outside = (corner[0] - a[0]) * (b[1] - a[1]) - (corner[1] - a[1]) * (b[0] - a[0]) > 0  # right of a to b: unseen
    if s.support > 0.0:
        near = off <= tolerance and far <= reach and _from_chain(corner, stretch) <= 1.5 * tolerance
        return (p, q) if near else None
    return (p, q) if far <= reach and (off <= OPEN or (outside and width <= reach)) else None
