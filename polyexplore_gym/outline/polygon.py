"""From the sides to one valid polygon: corners where neighbouring sides meet."""

from __future__ import annotations

import math

import numpy as np
import shapely

from polyexplore_gym.outline.sides import Side, crossing, projected


def corners(sides: list[Side], ring: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """The corners (k, 2) of a ring, and the side (k,) that leads on from each; -1: a step between two sides.

    Neighbours meet where their lines do. Where that is farther than `reach` (m) from where the boundary changes from
    one to the other, and where they are parallel, each ends there, and a step leads from one to the other.
    """
    n = len(ring)
    points: list[np.ndarray] = []
    owner: list[int] = []
    for k, q in enumerate(sides):
        p = sides[k - 1]
        if p.held and q.held:
            points.append(ring[q.start % n])
            owner.append(k)
        else:
            ends = ring[p.stop % n], ring[q.start % n]
            corner = None if p.held or q.held else crossing(p, q)
            if corner is not None and min(math.hypot(*(corner - end)) for end in ends) <= reach:
                points.append(corner)
                owner.append(k)
            else:
                a = ends[0] if p.held else projected(ends[0], p)
                b = ends[1] if q.held else projected(ends[1], q)
                if math.hypot(*(b - a)) > 1e-3:
                    points.append(a)
                    owner.append(-1)
                points.append(b)
                owner.append(k)
        if q.held == 2:
            between = ring[np.arange(q.start + 1, q.stop) % n]
            points += list(between)
            owner += [k] * len(between)
    return np.array(points), np.array(owner)


def straightened(points: np.ndarray, owner: np.ndarray, least: float = 1e-3) -> tuple[np.ndarray, np.ndarray]:
    """The ring without vertices that lie on the straight line of their neighbours or on one of them, to `least` m."""
    changed = True
    while changed and len(points) > 3:
        before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
        along = after - before
        length = np.maximum(np.hypot(*along.T), 1e-12)
        off = np.abs(along[:, 0] * (points - before)[:, 1] - along[:, 1] * (points - before)[:, 0]) / length
        forward = ((points - before) * (after - points)).sum(1) > 0
        drop = (off < least) & forward | (np.hypot(*(points - before).T) < least)
        first = np.flatnonzero(drop)
        changed = first.size > 0
        if changed:
            keep = np.ones(len(points), bool)
            last = -2
            for k in first.tolist():
                if k - last > 1 and (len(points) - (~keep).sum()) > 3 and not (k == len(points) - 1 and not keep[0]):
                    keep[k] = False
                    last = k
            changed = not keep.all()
            points, owner = points[keep], owner[keep]
    return points, owner


def crossings(rings: list[np.ndarray]) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Pairs of edges, each by its ring and number, that meet without being neighbours, or where one runs back along
    the other."""
    ring = np.repeat(np.arange(len(rings)), [len(r) for r in rings])
    edge = np.concatenate([np.arange(len(r)) for r in rings])
    size = np.array([len(r) for r in rings])[ring]
    ends = np.concatenate([np.stack([r, np.roll(r, -1, axis=0)], axis=1) for r in rings])
    lines = shapely.linestrings(ends)
    i, j = shapely.STRtree(lines).query(lines, predicate="intersects")
    ahead = (edge[j] - edge[i]) % size[i]
    apart = (i < j) & ((ring[i] != ring[j]) | ((ahead > 1) & (size[i] - ahead > 1)))
    u, v = ends[i, 1] - ends[i, 0], ends[j, 1] - ends[j, 0]
    fold = (ring[i] == ring[j]) & (ahead == 1) & ((u * v).sum(1) < 0.0)
    fold &= np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) <= 1e-9 * np.hypot(*u.T) * np.hypot(*v.T)
    pairs = np.stack((i, j), axis=1)[apart | fold]
    return sorted(((int(ring[a]), int(edge[a])), (int(ring[b]), int(edge[b]))) for a, b in pairs)
