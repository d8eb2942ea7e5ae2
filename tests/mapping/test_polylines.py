"""extract_polylines and its kernels, against slow exact twins."""

import itertools
import math
from functools import cache

import numpy as np
import pytest
from line_scenes import HALF, box, cast, distance, ends_on, measure
from scipy.optimize import least_squares

from polyexplore_gym.config import SensorConfig
from polyexplore_gym.mapping import borders, extract_polylines
from polyexplore_gym.mapping.borders import NEVER, bend, choose, chord_error, thin
from polyexplore_gym.mapping.polylines import misfit, settle, solve

SENSOR = SensorConfig()
FULL = np.linspace(-math.pi, math.pi, 360, endpoint=False)
ROUND = SensorConfig(beams=360, field_of_view=2 * math.pi)
ROBOT = np.zeros(3)
MISS2 = 0.36**2


def ragged(rng, m, jumps=0.2):
    """Bearings, ranges and runs of a few returns on walls with corners, jumps and breaks."""
    t = np.cumsum(rng.uniform(0.02, 0.06, m))
    level = np.cumsum(rng.normal(0, 0.05, m) + rng.normal(0, 0.5, m) * (rng.random(m) < jumps))
    r = np.maximum(3.0 + level, 0.5)
    return t, r, np.cumsum(rng.random(m) < 0.1)


def hit(segments, angles):
    """Ranges of beams at the edges, which are a hair longer so that beams at their ends meet them."""
    hair = 1e-9 * (segments[:, 2:] - segments[:, :2])
    return cast(segments + np.hstack([-hair, hair]), ROBOT, angles, 100.0)


def measured(t, r, run, starts, bound=1e17):
    return borders.measure(np.cos(t), np.sin(t), r, run, starts, MISS2, bound)


@pytest.mark.parametrize("seed", range(8))
def test_thin_equals_removal_from_lists(seed):
    rng = np.random.default_rng(seed)
    t, r, run = ragged(rng, 30)
    x, y = r * np.cos(t), r * np.sin(t)
    chains = [list(np.flatnonzero(run == i)) for i in np.unique(run)]

    def cost(chains):
        """Squared error of the chords, and of all returns that no chord stands for."""
        total, held = 0.0, 0
        for chain in chains:
            for a, b in itertools.pairwise(chain):
                k = np.arange(a + 1, b)
                f = (x[a] * y[b] - y[a] * x[b]) / (np.cos(t[k]) * (y[b] - y[a]) - np.sin(t[k]) * (x[b] - x[a]))
                total += np.sum((f - r[k]) ** 2)
            held += chain[-1] - chain[0] + 1 if len(chain) > 1 else 0
        return total + MISS2 * (r.size - held)

    left = {r.size: (cost(chains), sorted(itertools.chain(*chains)))}
    while sum(map(len, chains)) > 4:
        trials = []
        for i, chain in enumerate(chains):
            for k in chain:
                less = [q for q in chain if q != k]
                trials.append((cost(chains[:i] + ([less] if less else []) + chains[i + 1 :]), k, i))
        least = min(trial[0] for trial in trials)
        _, k, i = min((trial for trial in trials if trial[0] < least + 1e-12), key=lambda trial: trial[1])
        chains[i] = [q for q in chains[i] if q != k]
        chains = [chain for chain in chains if chain]
        left[sum(map(len, chains))] = least, sorted(itertools.chain(*chains))
    for keep, budget in ((20, 12), (12, 5), (30, 8)):
        stays, total = thin(x, y, r, run, keep, budget, MISS2)
        assert list(np.flatnonzero(stays)) == left[keep][1]
        assert total == pytest.approx(left[budget][0], abs=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_measured_lines_equal_lstsq(seed):
    rng = np.random.default_rng(seed)
    t, r, run = ragged(rng, 24, jumps=0.3 if seed % 2 else 0.05)
    starts = np.unique(np.r_[0, np.flatnonzero(np.diff(run)) + 1, rng.choice(24, 8), 24])
    fits = measured(t, r, run, starts)
    fine = coarse = 0
    for i, j in itertools.combinations(range(starts.size), 2):
        k = np.arange(starts[i], starts[j])
        if run[k[0]] != run[k[-1]] or k.size < 2:
            assert fits[i, j, 0] == NEVER
            continue
        direction = np.c_[np.cos(t[k]), np.sin(t[k])]

        def fit(weight, target, rows=direction):
            return np.linalg.lstsq(rows * weight[:, None], target * weight, rcond=None)[0]

        line = fit(r[k] ** 2, 1 / r[k])
        error = np.sum((r[k] ** 2 * (direction @ line - 1 / r[k])) ** 2)
        if error > borders.COARSE**2 * np.sum(r[k] ** 2):
            weight = np.sqrt(r[k] / (direction @ line) ** 3)
            line = fit(weight, 1 / r[k])
            error = np.sum((r[k] - 1 / (direction @ line)) ** 2)
            coarse += 1
        else:
            fine += 1
        if error > MISS2 * k.size:
            assert fits[i, j, 0] == NEVER
            continue
        inverse = np.linalg.inv((direction * r[k, None] ** 4).T @ direction)
        np.testing.assert_allclose(fits[i, j, 0], error, atol=1e-9)
        np.testing.assert_allclose(fits[i, j, 1:3], line, rtol=1e-6)
        np.testing.assert_allclose(fits[i, j, 3:], inverse[[0, 0, 1], [0, 1, 1]], rtol=1e-5)
    assert coarse if seed % 2 else fine


def costs(t, run, starts, fits):
    """Cost functions of the twins: of an edge over atoms i to j - 1, and of one that shares with the edge before."""
    c, s = np.cos(t), np.sin(t)

    def single(i, j):
        return starts[j] - starts[i] == 1

    def shared(h, i, j):
        """Added cost of edge i, j sharing with edge h, i; NEVER if it must not."""
        if run[starts[i]] != run[starts[i] - 1]:
            return NEVER
        if single(i, j):
            return 0.0
        return NEVER if single(h, i) else bend(fits[h, i], fits[i, j], c, s, starts[i] - 1, starts[i])[0]

    return single, shared


def least_cost(t, run, starts, fits, budget):
    """The least cost of all choices of edges, by trying them all."""
    single, shared = costs(t, run, starts, fits)
    atoms = starts.size - 1

    @cache
    def rest(i, before, left):
        """Cost of atoms i and on; `before` is the first atom of the edge that ends at i, -1 for none."""
        if i == atoms:
            return 0.0
        least = MISS2 * (starts[i + 1] - starts[i]) + rest(i + 1, -1, left)
        for j in range(i + 1, atoms + 1):
            error = 0.0 if single(i, j) else fits[i, j, 0]
            if error >= NEVER:
                continue
            if left >= 2 and not single(i, j):
                least = min(least, error + rest(j, i, left - 2))
            if left >= 1 and before >= 0 and shared(before, i, j) < NEVER:
                least = min(least, error + shared(before, i, j) + rest(j, i, left - 1))
        return least

    return rest(0, -1, budget)


def step_by_step(t, run, starts, fits, budget):
    """The rule of `choose` in plain Python: of the edges that end at an atom, the best for each number of vertices."""
    single, shared = costs(t, run, starts, fits)
    atoms = starts.size - 1
    ends, lone, best = {}, {}, {(0, 0): 0.0}
    for j in range(1, atoms + 1):
        for v in range(budget + 1):
            options = []
            for i in range(j):
                if single(i, j) or fits[i, j, 0] >= NEVER:
                    continue
                options.append((best.get((i, v - 2), NEVER) + fits[i, j, 0], i))
                cost, h = ends.get((i, v - 1), (NEVER, -1))
                if cost < NEVER:
                    options.append((cost + fits[i, j, 0] + shared(h, i, j), i))
            if options and min(options)[0] < NEVER:
                ends[j, v] = min(options)
            if single(j - 1, j) and j > 1 and run[starts[j - 1]] == run[starts[j - 1] - 1]:
                lone[j, v] = min(ends.get((j - 1, v - 1), (NEVER, 0))[0], lone.get((j - 1, v - 1), NEVER))
            left_out = best.get((j - 1, v), NEVER) + MISS2 * (starts[j] - starts[j - 1])
            best[j, v] = min(left_out, ends.get((j, v), (NEVER, 0))[0], lone.get((j, v), NEVER))
    return min(best[atoms, v] for v in range(budget + 1))


def cost_of(edges, t, run, starts, fits):
    """Cost and number of vertices of chosen edges."""
    single, shared = costs(t, run, starts, fits)
    total, vertices = MISS2 * (t.size - np.sum(edges[:, 1] - edges[:, 0])), 0
    for q, (first, end, shares, i, j) in enumerate(edges):
        assert (first, end) == (starts[i], starts[j])
        total += 0.0 if single(i, j) else fits[i, j, 0]
        if shares:
            assert edges[q - 1, 4] == i
            total += shared(edges[q - 1, 3], i, j)
        vertices += 2 - shares
    return total, vertices


def test_chosen_edges_are_the_best():
    """Equal to the same rule in plain Python, and hardly ever worse than the best of all choices."""
    rng = np.random.default_rng(0)
    optimal = cases = 0
    for _ in range(60):
        t, r, run = ragged(rng, 14, jumps=0.3)
        starts = np.unique(np.r_[0, np.flatnonzero(np.diff(run)) + 1, rng.choice(14, 10), 14])
        fits = measured(t, r, run, starts)
        for budget in (2, 3, 5, 8):
            edges, closes = choose(np.cos(t), np.sin(t), run, starts, fits, budget, MISS2, 1e17, False)
            assert not closes
            total, vertices = cost_of(edges, t, run, starts, fits)
            assert vertices <= budget
            assert total == pytest.approx(step_by_step(t, run, starts, fits, budget), abs=1e-9)
            least = least_cost(t, run, starts, fits, budget)
            assert total > least - 1e-9
            optimal, cases = optimal + (total < least + 1e-9), cases + 1
            # a bound that the best keeps changes nothing
            same, _ = choose(np.cos(t), np.sin(t), run, starts, fits, budget, MISS2, total + 1e-9, False)
            np.testing.assert_array_equal(edges, same)
    assert optimal > 0.95 * cases


def test_chord_error_equals_intersection():
    t, r, _ = ragged(np.random.default_rng(3), 9)
    x, y = r * np.cos(t), r * np.sin(t)
    ranges = cast([[x[1], y[1], x[7], y[7]]], ROBOT, t, 100.0)
    assert chord_error(x, y, r, 1, 7) == pytest.approx(np.sum((ranges - r)[2:7] ** 2))


@pytest.mark.parametrize("closed", [False, True])
def test_solve_equals_numpy(closed):
    rng = np.random.default_rng(0)
    n = 12
    root = np.zeros((n, n))
    for i in range(0, n, 2):
        root[i : i + 4, i : i + 2] = rng.normal(size=(min(4, n - i), 2))
    if closed:
        root[:2, n - 2 :] = rng.normal(size=(2, 2))
    normal, gradient = root @ root.T, rng.normal(size=n)
    begin = np.maximum((np.arange(n) // 2 - 1) * 2, 0)
    if closed:
        begin[n - 2 :] = 0
    out = np.empty(n)
    solve(normal, gradient, 0.1, begin, np.zeros((n, n)), out)
    np.testing.assert_allclose((normal + np.diag(0.1 * np.diag(normal) + 1e-9)) @ out, gradient, atol=1e-9)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_vertices_settle_where_least_squares_does(closed, seed):
    rng = np.random.default_rng(seed)
    walls = np.array(box(-2, -3, 4, 2.5))
    t = FULL if closed else np.linspace(-1.2, 1.2, 200)
    r = cast(walls, ROBOT, t, 100.0) + rng.normal(0, 0.02, t.size)
    corners = np.array([[-2, -3], [4, -3], [4, 2.5], [-2, 2.5]])
    bearing, radius = np.arctan2(corners[:, 1], corners[:, 0]), np.hypot(*corners.T)
    if not closed:
        bearing, radius = np.r_[t[0], bearing[1:3], t[-1]], np.r_[r[0], radius[1:3], r[-1]]
    bearing = bearing + rng.normal(0, 0.01, 4) * np.array([closed, True, True, closed])
    radius = radius + rng.normal(0, 0.1, 4)
    free = slice(None) if closed else slice(1, -1)

    def residuals(p):
        b, d = bearing0.copy(), p[-4:]
        b[free] = p[:-4]
        v = np.c_[d * np.cos(b), d * np.sin(b)]
        edges = np.hstack([v, np.roll(v, -1, 0)]) if closed else np.hstack([v[:-1], v[1:]])
        out = hit(edges, t) - r
        return np.where(np.isfinite(out), out, 10.0)

    bearing0 = bearing.copy()
    twin = least_squares(residuals, np.r_[bearing[free], radius], x_scale="jac", xtol=1e-12, ftol=1e-12)
    c, s = np.cos(t), np.sin(t)
    error = settle(c, s, t, r, 0, t.size, closed, bearing, radius)
    np.testing.assert_array_equal(bearing[[0, -1]] == bearing0[[0, -1]], not closed)
    assert error == pytest.approx(np.sum(residuals(np.r_[bearing[free], radius]) ** 2), rel=1e-6)
    assert error < 1.002 * 2 * twin.cost
    edge = np.empty(t.size, np.int64)
    borders_of(t, bearing, closed, edge)
    assert misfit(c, s, r, 0, t.size, edge, bearing, radius) == pytest.approx(error)


def borders_of(t, bearing, closed, edge):
    """The edge of each return, one by one."""
    for k, angle in enumerate(t):
        turns = np.array([-2 * math.pi, 0.0, 2 * math.pi]) if closed else np.zeros(1)
        for i in range(bearing.size if closed else bearing.size - 1):
            a, b = bearing[i], bearing[(i + 1) % bearing.size] + (2 * math.pi if i + 1 == bearing.size else 0)
            if ((angle + turns >= a) & (angle + turns <= b)).any():
                edge[k] = i
                break


def error_of(lines, angles, ranges):
    """Root mean square error of range of the explained returns, by casting rays at the edges."""
    predicted = hit(lines.segments(), angles)
    return math.sqrt(np.mean((predicted - ranges)[lines.explained] ** 2))


def test_a_corner_is_found_between_two_beams():
    walls = box(-1, -2, 3, 2.5)
    ranges = cast(walls, ROBOT, HALF)
    lines = extract_polylines(HALF, ranges, 4)
    assert lines.explained.all()
    assert not lines.closed
    np.testing.assert_allclose(lines.vertices, [[0, -2], [3, -2], [3, 2.5], [0, 2.5]], atol=1e-6)
    np.testing.assert_array_equal(lines.polyline, 0)
    assert error_of(lines, HALF, ranges) < 1e-6


def test_a_room_seen_all_round_is_closed():
    rng = np.random.default_rng(0)
    ranges = measure(box(-2, -3, 4, 2.5), ROBOT, ROUND, rng, FULL)
    lines = extract_polylines(FULL, ranges, 4, ROUND, miss=5.0)
    assert lines.closed
    assert len(lines.vertices) == len(lines.segments()) == 4
    corners = np.array([[-2, -3], [4, -3], [4, 2.5], [-2, 2.5]])
    assert distance(corners, lines.segments()).max() < 0.03
    assert error_of(lines, FULL, ranges) < 0.012


def test_the_seam_of_a_full_circle_may_lie_within_a_polyline():
    """With one wall out of sight the others join over the seam."""
    walls = box(-2, -3, 4, 2.5)[:1] + box(-2, -3, 4, 2.5)[2:]
    ranges = cast(walls, ROBOT, FULL)
    assert np.isinf(ranges).any()
    lines = extract_polylines(FULL, ranges, 4, ROUND)
    assert not lines.closed
    np.testing.assert_array_equal(lines.polyline, 0)
    np.testing.assert_array_equal(lines.explained, np.isfinite(ranges))


@pytest.mark.parametrize("seed", range(5))
def test_more_vertices_explain_more(seed):
    rng = np.random.default_rng(seed)
    rooms = np.vstack([box(-3, -3, 3, 3), box(1, 0.5, 1.6, 1.4), box(1.5, -1.8, 2.5, -1.2), box(-1, 2, 0.5, 2.4)])
    ranges = measure(rooms, ROBOT, SENSOR, rng)
    costs = []
    for budget in (2, 4, 8, 16, 32):
        lines = extract_polylines(HALF, ranges, budget, SENSOR)
        assert len(lines.vertices) <= budget
        again = extract_polylines(HALF, ranges, budget, SENSOR)
        np.testing.assert_array_equal(lines.vertices, again.vertices)
        predicted = hit(lines.segments(), HALF)
        assert np.isfinite(predicted[lines.explained]).all()
        costs.append(np.sum((predicted - ranges)[lines.explained] ** 2) + 0.36**2 * np.sum(~lines.explained))
    assert (np.diff(costs) < 1e-6).all()
    assert costs[-1] < 361 * 0.012**2


def test_no_edge_over_a_missing_return_or_a_wide_gap():
    wall = [[2.0, -3.0, 2.0, 3.0]]
    ranges = cast(wall, ROBOT, HALF)
    ranges[180] = np.inf
    lines = extract_polylines(HALF, ranges, 4)
    assert lines.polyline.tolist() == [0, 0, 1, 1]
    assert np.isinf(cast(lines.segments(), ROBOT, HALF[180:181])).all()
    step = cast([[2, -2, 2, 0], [2.6, 0, 2.6, 2]], ROBOT, HALF)
    assert extract_polylines(HALF, step, 4, max_gap=0.3).polyline.tolist() == [0, 0, 1, 1]
    assert extract_polylines(HALF, step, 4, max_gap=1.0).polyline.tolist() == [0, 0, 0, 0]


def test_miss_weighs_returns_against_accuracy():
    rng = np.random.default_rng(1)
    ranges = measure(np.vstack([box(-3, -3, 3, 3), box(1, 0.5, 1.6, 1.4)]), ROBOT, SENSOR, rng)
    little, much = (extract_polylines(HALF, ranges, 4, miss=miss) for miss in (0.05, 5.0))
    assert little.explained.sum() < much.explained.sum()
    assert error_of(little, HALF, ranges) < error_of(much, HALF, ranges)


def test_few_or_no_returns():
    for count in range(4):
        ranges = np.full(361, np.inf)
        ranges[100 : 100 + count] = 2.0
        lines = extract_polylines(HALF, ranges, 10)
        assert lines.explained.sum() == (count if count > 1 else 0)
        assert lines.segments().shape == (len(lines.vertices) - 1 if count > 1 else 0, 4)
        if count > 1:
            assert distance(ends_on(HALF, ranges), lines.segments()).max() < 1e-3
    assert extract_polylines(np.zeros(0), np.zeros(0), 2).vertices.shape == (0, 2)
    assert extract_polylines(np.zeros(1), np.ones(1), 2).vertices.shape == (0, 2)


@pytest.mark.parametrize("seed", range(200))
def test_odd_scans_keep_the_promises(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 60))
    turn = math.pi if rng.random() < 0.5 else 1.5
    angles = np.unique(rng.uniform(-turn, turn, n)) if seed % 3 == 0 else np.linspace(-turn, turn, n, endpoint=False)
    ranges = [rng.uniform(0.01, 30, angles.size), 2 / np.maximum(np.cos(angles), 0.05)][seed % 2]
    ranges[rng.random(angles.size) < 0.1 * (seed % 4)] = np.inf
    sensor = SensorConfig(max_range=100.0, field_of_view=2 * turn)
    budget = int(rng.integers(2, 25))
    lines = extract_polylines(angles, ranges, budget, sensor, miss=rng.choice([0.05, 0.4, 10.0]))
    assert len(lines.vertices) == len(lines.polyline) <= budget
    assert np.isfinite(lines.vertices).all()
    assert not lines.explained[~np.isfinite(ranges)].any()
    if lines.explained.any():
        to = np.c_[np.cos(angles), np.sin(angles)][lines.explained] * 1e4
        assert distance_of_rays(to, lines.segments()).max() < 1e-6


def distance_of_rays(ends, segments):
    """(k,) distance of each ray from the origin to the nearest segment, rays as long as to `ends`."""
    from shapely import LineString, MultiLineString

    lines = MultiLineString(list(segments.reshape(-1, 2, 2)))
    return np.array([LineString([(0, 0), end]).distance(lines) for end in ends])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"max_vertices": 1}, "two ends"),
        ({"miss": 0.0}, "miss"),
        ({"miss": math.inf}, "miss"),
        ({"max_gap": -1.0}, "max_gap"),
        ({"max_gap": math.nan}, "max_gap"),
        ({"ranges": np.ones(3)}, "length"),
        ({"angles": np.array(["a", "b"])}, "real numbers"),
    ],
)
def test_errors(change, message):
    arguments = {"angles": np.array([0.0, 0.1]), "ranges": np.ones(2), "max_vertices": 4} | change
    with pytest.raises(ValueError, match=message):
        extract_polylines(**arguments)


def test_unknown_beams_are_left_out_in_any_order():
    angles = np.linspace(-0.8, 0.8, 161)
    ranges = np.minimum(2.0 / np.cos(angles - 0.7), 2.0 / np.cos(angles + 0.7))
    gone = np.random.default_rng(0).random(161) < 0.2
    expected = extract_polylines(angles[~gone], ranges[~gone], 3)
    for values in (np.where(gone, np.nan, ranges), np.where(gone, 0.0, ranges)):
        made = extract_polylines(angles[::-1], values[::-1], 3)
        np.testing.assert_array_equal(made.vertices, expected.vertices)
        np.testing.assert_array_equal(made.explained[::-1][~gone], expected.explained)
        assert not made.explained[::-1][gone].any()
