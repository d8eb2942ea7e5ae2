"""The open boundary: clipping against shapely's difference, chains against their definition."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import shapely
from exploration_scenes import room_of, star, tol_of, width_of

from polyexplore_gym.config import SensorConfig
from polyexplore_gym.exploration import jump_edges as je
from polyexplore_gym.exploration import scan_polygon as sp

pytestmark = pytest.mark.bounds

NO_WALLS = np.zeros((0, 4))
EXACT = tol_of(SensorConfig(sigma_range=0.0, sigma_angle=0.0), max_range=8.0)
"""A map without noise, so that what is asked for is what counts."""


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
    boxes = np.array([sp.box_of(p, *a) for p, a in zip(points, apexes, strict=True)])
    blocks = np.array([sp.block_distances(p) for p in points])
    return sp.Scans(apexes, headings, boxes, points, rays, blocks, angles, full, 8.0), areas


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
    tol = EXACT._replace(nudge=nudge, crumb=1e-9)
    for _ in range(25):
        looks, areas = scans(rng, 6, fov)
        pieces = random_pieces(rng, 60)
        first, last = sorted(rng.integers(0, 7, 2))
        got, origin, changed = je.clip(pieces, np.zeros(60), looks, first, last, NO_WALLS, tol)
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
    looks, _ = scans(rng, 1, math.pi)
    tol = EXACT._replace(cover=0.06, crumb=1e-9)
    covered = spared = 0
    for _ in range(40):
        pieces = random_pieces(rng, 20, 2.0)
        walls = random_pieces(rng, 8, 2.0)
        for k in range(0, 8, 2):  # some run along pieces
            walls[k] = pieces[k] + rng.normal(0, 0.02, 4)
        got, origin, _ = je.clip(pieces, np.zeros(20), looks, 0, 0, walls, tol)
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
        tol = EXACT._replace(join=0.05, gap=shortest, max_range=longest)
        order, offsets = je.link(pieces, np.zeros(len(pieces)), NO_WALLS, tol)
        assert sorted(order) == list(range(len(pieces)))
        assert offsets[0] == 0
        assert offsets[-1] == len(pieces)
        assert (np.diff(offsets) > 0).all()
        size = np.hypot(*(pieces[:, 2:] - pieces[:, :2]).T)
        for a, b in itertools.pairwise(offsets):
            chain = order[a:b]
            assert len(set(group[chain])) == 1
            gaps = np.hypot(*(pieces[chain[1:], :2] - pieces[chain[:-1], 2:]).T)
            # One that ends near its beginning is a ring, which may be cut anywhere else.
            assert (gaps < shortest).all()
            assert (gaps >= 0.05).sum() <= 1
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
    order, offsets = je.link(pieces, np.zeros(24), NO_WALLS, EXACT._replace(join=0.05, gap=0.5))
    assert sorted(order) == list(range(24))
    lengths = [np.hypot(*(pieces[order[a:b], 2:] - pieces[order[a:b], :2]).T).sum() for a, b in
               itertools.pairwise(offsets)]  # fmt: skip
    # Four quarters and a bit, each facing its own way.
    assert 4 <= len(lengths) <= 6
    assert min(lengths) >= 0.5


def test_link_prefers_the_nearest_end_and_leaves_the_rest():
    pieces = np.array([[0, 0, 1, 0], [1.03, 0, 2, 0], [1.01, 0, 1, 2], [0, 0.2, 1, 0.2]], float)
    tol = EXACT._replace(join=0.05, gap=0.1)
    order, offsets = je.link(pieces, np.zeros(4), NO_WALLS, tol)
    chains = sorted(tuple(order[a:b].tolist()) for a, b in itertools.pairwise(offsets))
    assert chains == [(0,), (1,), (2,), (3,)]  # 0 goes on in 2, round a corner
    order, offsets = je.link(pieces[[0, 1, 3]], np.zeros(3), NO_WALLS, tol)
    chains = sorted(tuple(order[a:b].tolist()) for a, b in itertools.pairwise(offsets))
    assert chains == [(0, 1), (2,)]


def gapped(rng, start, parts):
    """A chain of pieces with small gaps between some of them."""
    pieces = np.array(wandering(rng, start, parts, 0.3)) * rng.choice([0.2, 1.0])
    for k in range(1, len(pieces)):
        if rng.random() < 0.4:
            t = rng.uniform(0.0, 2.0 * math.pi)
            pieces[k:] += np.tile(rng.uniform(0.0, 0.4) * np.array([math.cos(t), math.sin(t)]), 2)
    return pieces


def test_summarise():
    rng = np.random.default_rng(7)
    tol, narrow, tight = EXACT, 0, 0
    for _ in range(200):
        chains = [gapped(rng, (9.0 * k, 2.0), int(rng.integers(1, 10))) for k in range(3)]
        pieces = np.concatenate(chains)
        walls = random_pieces(rng, 5)
        walls[:3, :2] = [c[-1, 2:] + rng.normal(0.0, 0.05, 2) for c in chains]
        m, offsets = len(pieces), np.concatenate(([0], np.cumsum([len(c) for c in chains])))
        kinds, visits = rng.integers(1, 4, m).astype(np.int8), rng.integers(0, 3, m)
        shuffle = rng.permutation(m)
        order = np.argsort(shuffle)
        got = je.summarise(pieces[shuffle], kinds[shuffle], visits[shuffle], order, offsets, walls, 70, tol)
        np.testing.assert_array_equal(got.id, [70, 71, 72])
        for q, chain in enumerate(chains):
            mine = slice(offsets[q], offsets[q + 1])
            size = np.hypot(*(chain[:, 2:] - chain[:, :2]).T)
            assert got.length[q] == pytest.approx(size.sum())
            assert got.width[q] == pytest.approx(width_of(chain, walls, tol))
            most = room_of(chain, walls, tol) if got.width[q] >= tol.gap else 0.0
            assert most - 0.1 * tol.gap <= got.room[q] <= most + 1e-9
            tight += got.room[q] < tol.gap
            narrow += got.width[q] < tol.gap
            way = shapely.multilinestrings(chain.reshape(-1, 2, 2))
            middle = shapely.get_coordinates(way.interpolate(0.5, normalized=True))[0]
            np.testing.assert_allclose(got.middle[q], middle, atol=1e-9)
            np.testing.assert_allclose(got.ends[q], [*chain[0, :2], *chain[-1, 2:]])
            assert got.kind[q] == np.argmax([size[kinds[mine] == k].sum() for k in range(4)])
            assert got.visits[q] == visits[mine].max()
            chord = got.ends[q, 2:] - got.ends[q, :2]
            np.testing.assert_allclose(np.hypot(*got.normal[q]), 1.0)
            if np.hypot(*chord) > 0.31 * way.length:
                assert abs(got.normal[q] @ chord) < 1e-9
                assert chord[0] * got.normal[q, 1] - chord[1] * got.normal[q, 0] < 0  # into the unknown, on the right
    assert narrow > 30
    assert tight > 5


def width(pieces, walls=NO_WALLS, tol=EXACT):
    """The width that one chain gets."""
    m = len(pieces)
    chain = np.array(pieces, float)
    new = je.summarise(chain, np.ones(m, np.int8), np.zeros(m, np.int64), np.arange(m), np.array([0, m]), walls, 0, tol)
    return float(new.width[0])


def test_width_of_an_opening():
    # (The gap of interest is 0.5 m.) Two parts of a doorway: the gap between them is part of the opening.
    assert width([[0, 0, 0.15, 0], [0.3, 0, 0.45, 0]]) == pytest.approx(0.45)
    # A ring round the tip of a shadow is long, but not wide.
    t = np.linspace(0, 2 * math.pi, 13)
    p = 0.1 * np.stack((np.cos(t), np.sin(t)), axis=1)
    assert width(np.hstack([p[:-1], p[1:]])) == pytest.approx(0.2 * math.sqrt(2.0))
    # It goes on to the walls at its ends, as far as walls cover open edges and open edges touch, no farther.
    walls = np.array([[-0.05, 0, -0.05, 3], [0.44, -1, 0.44, 1], [0.0, 0.6, 0.5, 0.6]], float)
    assert width([[0, 0, 0.4, 0]], walls) == pytest.approx(0.49)
    far = EXACT.cover + EXACT.join + 0.001
    assert width([[0, 0, 0.4, 0]], np.array([[-far, 0, -far, 3]])) == pytest.approx(0.4)
    # Crumbs far apart are no opening.
    assert width([[0, 0, 0.03, 0], [0.4, 0, 0.43, 0]]) == pytest.approx(2.5 * 0.06)
    # What is wide enough is left alone.
    assert width([[0, 0, 0.6, 0]], walls) == pytest.approx(0.6)


def successors(pieces, sigma, walls, tol):
    """Slow twin: mutually nearest ends, first those that touch, then across gaps without a wall."""
    n = len(pieces)
    lines = shapely.multilinestrings(walls.reshape(-1, 2, 2))
    after, taken = [-1] * n, [False] * n
    for wide in (False, True):
        near = {}
        for i, j in itertools.permutations(range(n), 2):
            d = math.dist(pieces[i, 2:], pieces[j, :2])
            limit = tol.gap if wide else tol.join + 2.0 * max(sigma[i], sigma[j])
            middle = shapely.Point(0.5 * (pieces[i, 2:] + pieces[j, :2]))
            if after[i] >= 0 or taken[j] or d >= limit or (wide and lines.distance(middle) <= tol.cover):
                continue
            near[i, j] = d
        for (i, j), d in near.items():
            if d == min(e for (a, b), e in near.items() if a == i or b == j):
                after[i], taken[j] = j, True
    return after


def test_successors_bridge_gaps_only_where_no_wall_stands():
    rng = np.random.default_rng(8)
    bridged = walled = 0
    for _ in range(150):
        m = int(rng.integers(2, 25))
        pieces = random_pieces(rng, m, 1.5)
        for k in range(1, m, 2):  # every other one begins near the end of another
            pieces[k] += np.tile(pieces[k - 1, 2:] + rng.normal(0.0, rng.choice([0.02, 0.25]), 2) - pieces[k, :2], 2)
        walls = random_pieces(rng, int(rng.integers(1, 6)), 1.5)
        inside = 0.5 * (pieces[:-1:2, 2:] + pieces[1::2, :2])[: len(walls)]  # of such gaps
        walls[: len(inside), :2] = inside + rng.normal(0.0, 0.05, inside.shape)
        sigma = rng.choice([0.0, 0.01, 0.05], m)
        got = je._successors(pieces, sigma, walls, EXACT)
        assert got.tolist() == successors(pieces, sigma, walls, EXACT)
        free = je._successors(pieces, sigma, NO_WALLS, EXACT)
        bridged += sum(math.dist(pieces[i, 2:], pieces[j, :2]) > 0.25 for i, j in enumerate(got) if j >= 0)
        walled += (free != got).sum()
    assert bridged > 50
    assert walled > 50


# What a look shows --------------------------------------------------------------------------------


def test_a_look_counts_only_if_it_could_have_shown_what_is_behind():
    """From the known side, square enough, dense enough, within range, and not hidden: at three points of an edge."""
    rng = np.random.default_rng(9)
    counts, reasons = [0, 0], np.zeros(5, np.int64)
    for fov, beams in itertools.product((1.5, 2 * math.pi), (30, 90, 400) * 20):
        looks, areas = scans(rng, 1, fov, beams, 0.5)
        apex = looks.apexes[0]
        sensor = SensorConfig(beams=beams, max_range=5.0, sigma_range=0.01, sigma_angle=0.002)
        tol = tol_of(sensor, step=float(looks.angles[1] - looks.angles[0]))
        pieces, sigma = random_pieces(rng, 80, 6.0), rng.choice([0.0, 0.02], 80)
        pieces[::2, 2:] = pieces[::2, :2] + 0.3 * (pieces[::2, 2:] - pieces[::2, :2])
        d = pieces[:, 2:] - pieces[:, :2]
        normal = np.stack((d[:, 1], -d[:, 0]), axis=1) / np.hypot(*d.T)[:, None]  # into the unknown
        walls = random_pieces(rng, 8)
        standing = shapely.multilinestrings(walls.reshape(-1, 2, 2))
        bad, close_call = np.zeros((80, 5), np.bool_), np.zeros(80, np.bool_)
        for share in (0.1, 0.5, 0.9):
            point = pieces[:, :2] + share * d
            away = np.hypot(*(point - apex).T)
            cosine = ((point - apex) * normal).sum(axis=1) / away  # of the incidence; negative from the unknown side
            across = tol.gap * cosine / (away * tol.step)  # beams across a gap of interest
            noise = np.maximum(sigma, np.hypot(tol.sigma_range, tol.sigma_angle * away))
            before = shapely.points(point - (tol.nudge + 2.0 * noise)[:, None] * normal)
            limits = away - (5.0 - tol.gap), 0.26 - cosine, 2.0 - across
            # A wall before the line of the edge, on the way to what lies behind it.
            behind = point + (tol.nudge + 2.0 * noise)[:, None] * normal - apex
            share_of_way = away * cosine / (away * cosine + tol.nudge + 2.0 * noise)
            share_of_way = np.minimum(share_of_way + 2.0 * tol.sigma_range / np.hypot(*behind.T), 1.0)
            sight = np.stack((np.tile(apex, (80, 1)), apex + share_of_way[:, None] * behind), axis=1)
            walled = shapely.intersects(shapely.linestrings(sight), standing) & (cosine > 0.0)
            bad |= np.stack((*(x > 0.0 for x in limits), ~shapely.covers(areas[0], before), walled), axis=1)
            close_call |= np.min(np.abs((*limits, shapely.distance(areas[0].boundary, before))), axis=0) < 1e-9
        got = je.shown(pieces, sigma, looks, 0, walls, tol)
        sure = ~close_call
        assert (got == ~bad.any(axis=1))[sure].all()
        counts[0] += (~got).sum()
        counts[1] += got.sum()
        reasons += bad[bad.sum(axis=1) == 1].sum(axis=0)
    assert min(counts) > 100
    assert (reasons > 10).all()  # each of the conditions has turned pieces down alone


def test_a_look_along_a_wall_shows_nothing_in_its_doorway():
    """A doorway of 0.7 m in a wall of 0.3 m, looked at from 4.5 m along the wall: all that is seen is a jamb."""
    jambs = np.array([[0.0, 0.0, 0.0, 8.0], [0.0, 0.0, -0.3, 0.0], [-0.3, -0.7, 0.0, -0.7], [0.0, -0.7, 0.0, -3.0]])
    sensor = SensorConfig(beams=721, field_of_view=math.pi, max_range=8.0)
    tol = tol_of(sensor)
    edge = np.array([[-0.05, -0.05, -0.05, -0.3]])  # what another scan left open: its unknown side is at x < 0
    for apex, counts in (((1.2, 4.5), False), ((1.2, 0.6), True)):
        angles = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 721)
        far = [shapely.LineString([apex, (apex[0] - 8 * math.cos(a), apex[1] - 8 * math.sin(a))]) for a in angles]
        lines = shapely.multilinestrings(jambs.reshape(-1, 2, 2))
        behind = shapely.LineString([(-0.12, 0.0), (-0.12, -0.7)])  # there is a wall in the doorway
        ranges = [shapely.Point(apex).distance(shapely.union(lines, behind).intersection(line)) for line in far]
        points, rays = sp.corner_points(angles, np.minimum(np.nan_to_num(ranges, nan=8.0), 8.0), math.pi, 8.0)
        box = sp.box_of(points, *apex)[None]
        blocks = sp.block_distances(points)[None]
        look = sp.Scans(
            np.array([apex]), np.array([math.pi]), box, points[None], rays[None], blocks, angles, False, 8.0
        )
        assert je.shown(edge, np.zeros(1), look, 0, jambs, tol).tolist() == [counts]


def test_what_is_left_of_a_jump_edge_is_still_that_one():
    """Against the definition: most of what the new chain had an owner, and it is most of what that had."""
    rng = np.random.default_rng(12)
    kept = lost = 0
    for _ in range(300):
        m = int(rng.integers(2, 12))
        x = np.concatenate(([0.0], np.cumsum(rng.uniform(0.1, 0.8, m))))
        segments = np.stack((x[:-1], np.zeros(m), x[1:], np.zeros(m)), axis=1)
        owner = np.sort(rng.integers(0, 3, m))
        old = je.Pieces.none()._replace(
            segments=segments, kind=np.ones(m, np.int8), sigma=np.zeros(m), visits=np.zeros(m, np.int64),
            settled=np.zeros(m, np.bool_), retried=np.zeros(m, np.bool_), owner=owner,
        )  # fmt: skip
        stays = rng.random(m) < 0.7
        local = np.arange(m)
        left = je.Pieces(*(column[stays] for column in old))._replace(owner=local[stays])
        size = x[1:] - x[:-1]
        _, new, left_of = je.rechain(old, np.ones(m, np.bool_), local, left, je.Pieces.none(), NO_WALLS, 4, 3, EXACT)
        for q in range(len(new.id)):
            mine = [i for i in np.flatnonzero(stays) if new.ends[q, 0] <= x[i] and x[i + 1] <= new.ends[q, 2]]
            whole = sum(size[i] for i in mine)
            wanted = -1
            for k in range(3):
                share = sum(size[i] for i in mine if owner[i] == k)
                if 2 * share > whole and 2 * share > size[owner == k].sum():
                    wanted = k
            assert left_of[q] == wanted
            kept += wanted >= 0
            lost += wanted < 0
    assert min(kept, lost) > 50


def test_splinters_beside_each_other_are_one_opening():
    tol = EXACT._replace(gap=0.5, join=0.05, cover=0.04)
    # Up along x = 0, each a little aside of the last and partly beside it: none alone is as wide as the gap.
    low = np.array([0.0, 0.25, 0.5, 0.75])
    up = np.stack([0.03 * np.arange(4) % 0.06, low, 0.03 * np.arange(4) % 0.06, low + 0.35], axis=1)
    back = np.array([[0.1, 0.6, 0.1, 0.3]])  # the other side of a sliver faces the other way
    pieces = np.concatenate([up[[2, 0, 3, 1]], back])

    def openings(walls):
        order, offsets = np.arange(5), np.arange(6)
        kinds, visits = np.ones(5, np.int8), np.zeros(5, np.int64)
        new = je.summarise(pieces, kinds, visits, order, offsets, walls, 0, tol)
        order, offsets, joined, other = je.join(pieces, order, offsets, new, walls, tol)
        assert sorted(order.tolist()) == [0, 1, 2, 3, 4]
        new = je.summarise(pieces, kinds, visits, order, offsets, walls, 0, tol)
        parts = [order[a:b].tolist() for a, b in itertools.pairwise(offsets)]
        return parts, new.width, joined.tolist(), other

    parts, width, joined, other = openings(NO_WALLS)
    assert other
    assert parts == [[1, 3, 0, 2], [4]]
    assert width[0] == pytest.approx(1.1, abs=0.01)
    assert joined == [True, False]
    pieces = pieces[:4] + np.array([0.0, 1.0, 0.0, 1.0]) * np.array([[0.4], [0.0], [0.4], [0.0]])
    pieces = np.concatenate([pieces, back])
    across = np.array([[-0.3, 0.75, 0.3, 0.75]])  # a wall between the lower two and the upper two
    assert openings(NO_WALLS)[0] == [[1, 3, 0, 2], [4]]
    assert openings(across)[0] == [[0, 2], [1, 3], [4]]
