"""The open boundary: clipping against shapely's difference, chains against their definition."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import shapely
from exploration_scenes import star

from polyexplore_gym.exploration import jump_edges as je
from polyexplore_gym.exploration import scan_polygon as sp

NO_WALLS = np.zeros((0, 4))


def scans(rng, count, fov, n=80, spread=3.0):
    """Random scan polygons in the layout of the exploration map, and as shapely polygons."""
    apexes, headings = rng.uniform(-spread, spread, (count, 2)), rng.uniform(-math.pi, math.pi, count)
    points, rays = np.empty((count, n, 2)), np.empty((count, n, 2))
    areas = []
    for s in range(count):
        angles, ranges, full = star(rng, n, fov)
        points[s], rays[s] = sp.corner_points(angles, ranges, headings[s], 8.0)
        corners = apexes[s] + (points[s] if full else np.vstack([[0.0, 0.0], points[s]]))
        areas.append(shapely.Polygon(corners))
    return apexes, headings, points, rays, angles, full, areas


def random_pieces(rng, m, half=6.0):
    start = rng.uniform(-half, half, (m, 2))
    t = rng.uniform(0, 2 * math.pi, m)
    return np.hstack([start, start + rng.uniform(0.05, 2.0, (m, 1)) * np.stack((np.cos(t), np.sin(t)), axis=1)])


def aside(piece, nudge):
    """The piece moved to its right, into the unknown."""
    d = piece[2:] - piece[:2]
    n = nudge * np.array([d[1], -d[0]]) / np.hypot(*d)
    return piece + np.tile(n, 2)


def strip(wall, margin):
    """Where a wall covers: a rectangle around it."""
    return shapely.LineString(wall.reshape(2, 2)).buffer(margin, cap_style="square")


@pytest.mark.parametrize("fov", [1.5, math.pi, 2 * math.pi])
@pytest.mark.parametrize("nudge", [0.0, 0.05])
def test_clip_is_the_difference_from_the_union_of_scan_polygons(fov, nudge):
    rng = np.random.default_rng([1, int(10 * fov), int(100 * nudge)])
    for _ in range(25):
        apexes, headings, points, rays, angles, full, areas = scans(rng, 6, fov)
        pieces = random_pieces(rng, 60)
        first, last = sorted(rng.integers(0, 7, 2))
        got, origin, changed = je.clip(
            pieces, apexes, headings, points, rays, first, last, angles, full, 8.2, nudge, NO_WALLS, 0.04, 1e-9
        )
        union = shapely.union_all(areas[first:last])
        inner = union.buffer(-1e-6)
        for i, piece in enumerate(pieces):
            wanted = shapely.LineString(aside(piece, nudge).reshape(2, 2)).difference(union)
            mine = got[origin == i]
            length = np.hypot(*(mine[:, 2:] - mine[:, :2]).T).sum()
            assert length == pytest.approx(wanted.length, abs=1e-5)
            whole = np.hypot(*(piece[2:] - piece[:2]))
            assert changed[i] == (length < whole - 1e-7) or abs(length - whole) < 1e-5
            for part in mine:
                d = (piece[2:] - piece[:2]) / whole
                assert (part[2:] - part[:2]) @ d > 0  # the unknown stays on the right
                moved = aside(part, nudge)
                assert not inner.contains(shapely.Point(0.5 * (moved[:2] + moved[2:])))
        assert (np.diff(origin) >= 0).all()


def test_clip_by_walls_along_them_only():
    rng = np.random.default_rng(2)
    apexes, headings, points, rays, angles, full, _ = scans(rng, 1, math.pi)
    covered = spared = 0
    for _ in range(40):
        pieces = random_pieces(rng, 20, 2.0)
        walls = random_pieces(rng, 8, 2.0)
        for k in range(0, 8, 2):  # some run along pieces
            walls[k] = pieces[k] + rng.normal(0, 0.02, 4)
        got, origin, _ = je.clip(
            pieces, apexes, headings, points, rays, 0, 0, angles, full, 8.2, 0.05, walls, 0.06, 1e-9
        )
        w = walls[:, 2:] - walls[:, :2]
        for i, piece in enumerate(pieces):
            d = piece[2:] - piece[:2]
            sine = np.abs(w[:, 0] * d[1] - w[:, 1] * d[0]) / np.hypot(*d) / np.hypot(*w.T)
            if (np.abs(sine - 0.5) < 1e-6).any():
                continue
            along = walls[sine < 0.5]
            shade = shapely.union_all([strip(q, 0.06) for q in along])
            wanted = shapely.LineString(piece.reshape(2, 2)).difference(shade).length
            mine = got[origin == i]
            assert np.hypot(*(mine[:, 2:] - mine[:, :2]).T).sum() == pytest.approx(wanted, abs=1e-6)
            covered += wanted < np.hypot(*d) - 1e-6
            spared += len(along) < len(walls) and wanted > 0.05
    assert covered > 100
    assert spared > 100


def test_clip_known_keeps_what_faces_another_way():
    rng = np.random.default_rng(3)
    cut = 0
    for _ in range(60):
        pieces = random_pieces(rng, 15, 2.0)
        known = random_pieces(rng, 8, 2.0)
        known[:4] = pieces[:4] + rng.normal(0, 0.02, (4, 4))
        known[1] = known[1, [2, 3, 0, 1]]
        got, origin = je.clip_known(pieces, known, 0.05, 0.02)
        k = known[:, 2:] - known[:, :2]
        for i, piece in enumerate(pieces):
            d = piece[2:] - piece[:2]
            sine = np.abs(k[:, 0] * d[1] - k[:, 1] * d[0]) / np.hypot(*d) / np.hypot(*k.T)
            same = known[(sine < 0.5) & (k @ d > 0)]
            rest = shapely.LineString(piece.reshape(2, 2)).difference(shapely.union_all([strip(q, 0.05) for q in same]))
            wanted = sum(p.length for p in shapely.get_parts(rest) if p.length >= 0.02)
            if any(abs(p.length - 0.02) < 1e-6 for p in shapely.get_parts(rest)):
                continue
            mine = got[origin == i]
            assert np.hypot(*(mine[:, 2:] - mine[:, :2]).T).sum() == pytest.approx(wanted, abs=1e-6)
            cut += wanted < np.hypot(*d) - 1e-6
    assert cut > 50


# Chains -------------------------------------------------------------------------------------------


def wandering(rng, start, parts, turn):
    """A chain of pieces, one after another."""
    heading = rng.uniform(-math.pi, math.pi)
    p = np.asarray(start, float)
    rows = []
    for _ in range(parts):
        heading += rng.uniform(-turn, turn)
        q = p + rng.uniform(0.05, 1.0) * np.array([math.cos(heading), math.sin(heading)])
        rows.append([*p, *q])
        p = q
    return rows


def test_link_covers_every_piece_once_in_touching_order():
    rng = np.random.default_rng(4)
    for _ in range(200):
        rows, group = [], []
        for g in range(int(rng.integers(1, 6))):
            part = wandering(rng, (30.0 * g, 0.0), int(rng.integers(1, 12)), 0.8)
            rows += part
            group += [g] * len(part)
        shuffle = rng.permutation(len(rows))
        pieces, group = np.array(rows)[shuffle], np.array(group)[shuffle]
        pieces += rng.normal(0, 0.003, pieces.shape)
        shortest, longest = 0.5, rng.choice([2.0, 8.0])
        order, offsets = je.link(pieces, 0.05, shortest, longest)
        assert sorted(order) == list(range(len(pieces)))
        assert offsets[0] == 0
        assert offsets[-1] == len(pieces)
        assert (np.diff(offsets) > 0).all()
        size = np.hypot(*(pieces[:, 2:] - pieces[:, :2]).T)
        for a, b in itertools.pairwise(offsets):
            chain = order[a:b]
            assert len(set(group[chain])) == 1
            gaps = np.hypot(*(pieces[chain[1:], :2] - pieces[chain[:-1], 2:]).T)
            assert (gaps < 0.05).all()
            total = size[group == group[chain[0]]].sum()
            length = size[chain].sum()
            if length < total - 1e-9:  # cut: no part too short, nor much too long
                assert length >= shortest - 1e-9
            assert length <= longest + shortest + 1.0
            first = pieces[chain[0], 2:] - pieces[chain[0], :2]
            for e in range(1, len(chain)):
                d = pieces[chain[e], 2:] - pieces[chain[e], :2]
                turn = abs(math.atan2(first[0] * d[1] - first[1] * d[0], first @ d))
                before, after = size[chain[:e]].sum(), size[order[a + e : b]].sum()
                # A turn stays uncut only where a part would have become too short.
                if turn > 1.3:
                    rest_of_group = total - size[order[: a + e]][group[order[: a + e]] == group[chain[0]]].sum()
                    assert before < shortest + 1e-9 or rest_of_group < shortest + 1e-9 or after < 0


def test_link_of_a_closed_ring():
    t = np.linspace(0, 2 * math.pi, 25)
    p = 2.0 * np.stack((np.cos(t), np.sin(t)), axis=1)
    pieces = np.hstack([p[:-1], p[1:]])[np.random.default_rng(5).permutation(24)]
    order, offsets = je.link(pieces, 0.05, 0.5, 8.0)
    assert sorted(order) == list(range(24))
    lengths = [np.hypot(*(pieces[order[a:b], 2:] - pieces[order[a:b], :2]).T).sum() for a, b in
               itertools.pairwise(offsets)]  # fmt: skip
    # Four quarters and a bit, each facing its own way.
    assert 4 <= len(lengths) <= 6
    assert min(lengths) >= 0.5


def test_link_prefers_the_nearest_end_and_leaves_the_rest():
    pieces = np.array([[0, 0, 1, 0], [1.03, 0, 2, 0], [1.01, 0, 1, 2], [0, 0.2, 1, 0.2]], float)
    order, offsets = je.link(pieces, 0.05, 0.1, 8.0)
    chains = sorted(tuple(order[a:b].tolist()) for a, b in itertools.pairwise(offsets))
    assert chains == [(0,), (1,), (2,), (3,)] or chains == [(0, 2), (1,), (3,)]
    order, offsets = je.link(pieces[[0, 1, 3]], 0.05, 0.1, 8.0)
    chains = sorted(tuple(order[a:b].tolist()) for a, b in itertools.pairwise(offsets))
    assert chains == [(0, 1), (2,)]


def test_summarise():
    rng = np.random.default_rng(7)
    for _ in range(100):
        pieces = np.array(wandering(rng, (1.0, 2.0), int(rng.integers(1, 10)), 0.3))
        m = len(pieces)
        kinds, visits = rng.integers(1, 4, m).astype(np.int8), rng.integers(0, 3, m)
        data, ends, kind, visit = je.summarise(pieces, kinds, visits, np.arange(m), np.array([0, m]))
        way = shapely.LineString([pieces[0, :2], *pieces[:, 2:]])
        assert data[0, 0] == pytest.approx(way.length)
        middle = shapely.get_coordinates(way.interpolate(0.5, normalized=True))[0]
        np.testing.assert_allclose(data[0, 1:3], middle, atol=1e-9)
        np.testing.assert_allclose(ends[0], [*pieces[0, :2], *pieces[-1, 2:]])
        size = np.hypot(*(pieces[:, 2:] - pieces[:, :2]).T)
        assert kind[0] == np.argmax([size[kinds == k].sum() for k in range(4)])
        assert visit[0] == visits.max()
        chord = ends[0, 2:] - ends[0, :2]
        np.testing.assert_allclose(np.hypot(*data[0, 3:5]), 1.0)
        if np.hypot(*chord) > 0.31 * way.length:
            assert abs(data[0, 3:5] @ chord) < 1e-9
            assert chord[0] * data[0, 4] - chord[1] * data[0, 3] < 0  # into the unknown, on the right
