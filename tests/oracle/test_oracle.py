"""References: every part against a slow exact twin, and the bounds against what was driven."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import shapely

from polyexplore_gym.config import DriveConfig, EnvConfig, SensorConfig
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.errors import InvalidFloorPlanError
from polyexplore_gym.floorplan import FloorPlan, suite

pytest.importorskip("pyvrp")
pytest.importorskip("highspy")

from baselines import make_policy
from baselines.oracle import distance_to_see, reference, replay, start_of
from baselines.oracle.exact import shortest_tour
from baselines.oracle.gates import Gates
from baselines.oracle.lower import lower_bound
from baselines.oracle.sight import Checkpoints, visibility_ring, windows
from baselines.oracle.space import Space, sights
from baselines.oracle.upper import LOOK, Planner, open_tour
from baselines.oracle.witnesses import Cuts, Tour

RADIUS = 0.25
FULL = SensorConfig(max_range=8.0, field_of_view=2.0 * math.pi, beams=720)
SHORT = replace(FULL, max_range=3.0)


def corridor() -> FloorPlan:
    """Two rooms and a niche off a corridor, with a pillar in it."""
    outline = [(0, 0), (12, 0), (12, 2), (9, 2), (9, 2.2), (11, 2.2), (11, 6), (7, 6), (7, 2.2), (8, 2.2), (8, 2),
               (4, 2), (4, 2.2), (5, 2.2), (5, 5), (1, 5), (1, 2.2), (3, 2.2), (3, 2), (0, 2)]  # fmt: skip
    return FloorPlan.create(outline, [[(6.2, 0.8), (6.2, 1.2), (6.8, 1.2), (6.8, 0.8)]], name="corridor")


PLANS = {"corridor": corridor(), "home": suite("home-test").plan(1), "angled": suite("angled-test").plan(0)}
STARTS = {"corridor": np.array([1.0, 1.0]), **{n: start_of(PLANS[n], 0)[:2] for n in ("home", "angled")}}


@pytest.fixture(params=PLANS)
def scene(request):
    return PLANS[request.param], STARTS[request.param]


def true_distance(plan: FloorPlan, radius: float, a: np.ndarray, b: np.ndarray) -> float:
    """Slow twin: Dijkstra over all vertices of a finely drawn free space, edges tested by shapely."""
    area = plan.polygon.buffer(-radius, quad_segs=8)
    points = np.vstack([a, b, *(np.asarray(r.coords)[:-1] for p in shapely.get_parts(area)
                                for r in (p.exterior, *p.interiors))])  # fmt: skip
    roomy = area.buffer(1e-6)
    shapely.prepare(roomy)
    lines = shapely.linestrings(np.array(list(itertools.combinations(points, 2))))
    ok = shapely.covers(roomy, lines)
    n = len(points)
    matrix = np.full((n, n), np.inf)
    for (i, j), line, free in zip(itertools.combinations(range(n), 2), lines, ok, strict=True):
        if free:
            matrix[i, j] = matrix[j, i] = line.length
    done, far = np.zeros(n, bool), np.full(n, np.inf)
    far[0] = 0.0
    while not done[1]:
        i = int(np.argmin(np.where(done, np.inf, far)))
        done[i] = True
        far = np.minimum(far, far[i] + matrix[i])
    return float(far[1])


def random_places(plan: FloorPlan, count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.array([plan.sample_start(rng, RADIUS)[:2] for _ in range(count)])


@pytest.mark.parametrize("seed", range(3))
def test_ways_enclose_the_true_distance(seed):
    plan = PLANS["corridor"]
    a, b = random_places(plan, 2, seed)
    true = true_distance(plan, RADIUS, a, b)
    below, above = (
        float(space.distances(a, b[None], space.sees(b[None]))[0])
        for space in (Space.outer(plan, RADIUS, a), Space.inner(plan, RADIUS, a))
    )
    # The twin's chords cut its arcs by up to 0.5 mm each.
    assert below <= true + 1e-9
    assert true <= above + 5e-3
    assert above - below < 0.2


def test_inner_paths_keep_clear_of_the_walls(scene):
    plan, start = scene
    space = Space.inner(plan, RADIUS, start)
    for point in random_places(plan, 20, 1):
        rows = space.sees(point[None])
        distance = float(space.distances(start, point[None], rows)[0])
        way = np.vstack([start, space.nodes[space.path(start, point)], point])
        assert np.hypot(*np.diff(way, axis=0).T).sum() == pytest.approx(distance, abs=1e-9)
        line = shapely.LineString(way)
        assert shapely.distance(line, plan.polygon.boundary) >= RADIUS


def test_sights_agree_with_shapely(scene):
    plan, _ = scene
    points, targets = random_places(plan, 15, 2), random_places(plan, 15, 3)
    indptr, indices = sights(plan.segments, points, targets, 5.0)
    for i, point in enumerate(points):
        seen = set(indices[indptr[i] : indptr[i + 1]].tolist())
        for j, target in enumerate(targets):
            line = shapely.LineString([point, target])
            assert (j in seen) == (line.length <= 5.0 and plan.polygon.covers(line))


def test_seen_along_is_what_its_samples_see(scene):
    plan, start = scene
    space = Space.inner(plan, RADIUS, start)
    sight = Checkpoints(plan, space, start, 3.0, 0.6)
    for a, b in zip(random_places(plan, 5, 4), random_places(plan, 5, 5), strict=True):
        count = math.ceil(math.hypot(*(b - a)) / 0.3)
        samples = a + (b - a) * (np.arange(count + 1) / count)[:, None]
        np.testing.assert_array_equal(sight.seen_along(a, b, 0.3), sight.seen_from(samples))


def test_viewer_region_holds_all_viewers(scene):
    plan, start = scene
    space = Space.outer(plan, RADIUS, start)
    for point in random_places(plan, 4, 6):
        region = shapely.Polygon(visibility_ring(plan.segments, point, 3.0)).buffer(1e-7)
        places = random_places(plan, 300, 7)
        indptr, _ = sights(plan.segments, places, point[None], 3.0)
        viewers = np.diff(indptr) == 1
        inside = shapely.contains_xy(region, places)
        assert not (viewers & ~inside).any()
        # and little else: the circle is drawn from outside, 3 mm at most
        near = np.abs(np.hypot(*(places - point).T) - 3.0) < 4e-3
        assert not (inside & ~viewers & ~near).any()
        # Every way from outside to a viewer meets a window.
        gates = shapely.union_all(
            [shapely.LineString(w) for w in windows(plan.segments, point, 3.0, space.area, start)]
        )
        own = len(sights(plan.segments, start[None], point[None], 3.0)[1]) == 1
        assert own == gates.is_empty
        inner = Space.inner(plan, RADIUS, start)
        for place in places[viewers][:5] if not own else ():
            way = np.vstack([start, inner.nodes[inner.path(start, place)], place])
            assert shapely.distance(gates, shapely.LineString(way)) < 1e-6


def test_gate_distances_are_below_all_ways(scene):
    plan, start = scene
    space = Space.outer(plan, RADIUS, start)
    sight = Checkpoints(plan, Space.inner(plan, RADIUS, start), start, 3.0, 0.6)
    rng = np.random.default_rng(8)
    gates = Gates(space, start)
    chosen = rng.choice(len(sight.points), 6, replace=False)
    gates.add([windows(plan.segments, sight.points[c], 3.0, space.area, start) for c in chosen])
    gates.split(rng.choice(len(gates.owner), len(gates.owner) // 2, replace=False))
    assert (gates.between == gates.between.T).all()
    for _ in range(60):
        g, f = rng.choice(len(gates.owner), 2)
        a, b = (gates.samples[rng.integers(gates.low[k], gates.high[k])] for k in (g, f))
        way = float(space.distances(a, b[None], space.sees(b[None]))[0])
        assert gates.between[g, f] <= way + 1e-9
        assert gates.first[g] <= float(space.distances(start, a[None], space.sees(a[None]))[0]) + 1e-9


def random_tours(seed: int, witnesses: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    owner = np.repeat(np.arange(witnesses), rng.integers(1, 4, witnesses))
    points = rng.uniform(0.0, 10.0, (len(owner), 2)) if seed % 2 else rng.uniform(0, 10, (witnesses, 2))[owner]
    points = points + rng.normal(0.0, 0.5, points.shape)
    between = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))
    return np.hypot(*points.T), between, owner


def brute_force(first: np.ndarray, between: np.ndarray, owner: np.ndarray) -> float:
    groups = [np.flatnonzero(owner == w) for w in range(owner.max() + 1)]
    best = math.inf
    for order in itertools.permutations(range(len(groups))):
        ends = first[groups[order[0]]]
        for a, b in itertools.pairwise(order):
            ends = (ends[:, None] + between[np.ix_(groups[a], groups[b])]).min(axis=0)
        best = min(best, float(ends.min()))
    return best


@pytest.mark.parametrize("seed", range(8))
def test_exact_tour_agrees_with_brute_force(seed):
    first, between, owner = random_tours(seed, 1 + seed % 6)
    length, order = shortest_tour(first, between, owner)
    assert length == pytest.approx(brute_force(first, between, owner), abs=1e-9)
    assert sorted(owner[order]) == list(range(owner.max() + 1))
    assert first[order[0]] + sum(between[a, b] for a, b in itertools.pairwise(order)) == pytest.approx(length)


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("rounds", [0, 1, 40])
def test_relaxed_tour_is_never_above_the_exact_one(seed, rounds):
    first, between, owner = random_tours(seed, 3 + seed % 7)
    exact, _ = shortest_tour(first, between, owner)
    none = np.zeros((0, 2), np.int64)
    solution = Tour(owner, first, between, Cuts.none(len(owner)), none).solve(rounds, math.inf)
    assert solution.bound <= exact + 1e-6
    if rounds == 40:
        assert solution.bound >= 0.85 * exact
        # Cuts stay valid when gates are split and witnesses come.
        parent = np.repeat(np.arange(len(owner)), 2)
        fine = between[np.ix_(parent, parent)]
        cuts = solution.cuts.regrouped(parent, fine)
        again = Tour(owner[parent], first[parent], fine, cuts, none).solve(rounds, math.inf)
        assert again.bound <= exact + 1e-6
        fewer = owner < owner.max()
        old = np.cumsum(fewer) - 1
        less = Tour(owner[fewer], first[fewer], between[np.ix_(fewer, fewer)], Cuts.none(int(fewer.sum())), none)
        cuts = less.solve(rounds, math.inf).cuts.regrouped(np.where(fewer, old, -1), between)
        assert Tour(owner, first, between, cuts, none).solve(0, math.inf).bound <= exact + 1e-6


def test_open_tour_is_short():
    rng = np.random.default_rng(0)
    points = rng.uniform(0.0, 10.0, (8, 2))
    between = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))
    order = open_tour(between)
    assert order[0] == 0
    assert sorted(order) == list(range(8))
    best = min(
        sum(between[a, b] for a, b in itertools.pairwise((0, *rest))) for rest in itertools.permutations(range(1, 8))
    )
    assert sum(between[a, b] for a, b in itertools.pairwise(order)) <= 1.1 * best
    assert open_tour(between[:1, :1]) == [0]
    assert open_tour(between[:2, :2]) == [0, 1]


@pytest.mark.parametrize("sensor", [FULL, SHORT, SensorConfig(max_range=4.0)], ids=["8 m", "3 m", "180 degrees"])
def test_bounds_are_in_order_and_the_tours_see_all(scene, sensor):
    plan, start = scene
    found = reference(plan, start, sensor, iterations=20, effort=1e7)
    points = found.checkpoints(plan)
    assert found.lower <= found.upper_sensing <= found.upper_stop_and_scan
    assert found.gap < 1.6
    seen = distance_to_see(plan, points, found.tour_sensing.way, sensor, step=LOOK)
    assert seen is not None
    assert found.lower <= seen <= found.upper_sensing + 1e-9
    for mode in ("kinematic", "physics"):
        config = EnvConfig(sensor=sensor, drive=DriveConfig(mode=mode))
        driven = replay(plan, start, found.tour_stop_and_scan, points, config)
        assert driven.scans == found.tour_stop_and_scan.scans
        assert driven.collisions == 0
        assert driven.distance >= found.lower
        if mode == "kinematic":
            assert driven.distance == pytest.approx(found.upper_stop_and_scan, abs=1e-3)
            assert driven.coverage == 1.0
        else:
            assert driven.distance == pytest.approx(found.upper_stop_and_scan, rel=0.02)
            assert driven.coverage > 0.999


@pytest.mark.parametrize("drive", ["kinematic", "physics"])
@pytest.mark.parametrize("policy", ["nearest", "random", "largest"])
def test_no_exploration_falls_below_the_lower_bound(scene, policy, drive):
    plan, _ = scene
    config = EnvConfig(sensor=FULL, drive=DriveConfig(mode=drive))
    env = PolyExploreEnv(plan=plan, config=config)
    observation, info = env.reset(seed=0)
    start = env.true_pose
    np.testing.assert_array_equal(start, start_of(plan, 0))
    act, rng = make_policy(policy), np.random.default_rng(0)
    while info["action_mask"].any():
        observation, _, _, _, info = env.step(act.act(observation, info, rng))
    found = reference(plan, start, FULL, iterations=0, effort=5e6)
    points = found.checkpoints(plan)
    trajectory = env.snapshot().trajectory
    completed = distance_to_see(plan, points, trajectory, FULL)
    if completed is None:  # It left a corner: then the bound is of what it did see.
        seen = Checkpoints(plan, Space.inner(plan, RADIUS, start[:2]), start[:2], FULL.max_range, 0.6)
        assert distance_to_see(plan, points, trajectory, FULL, share=0.99) is not None
        kept = np.unique(
            np.concatenate([seen.seen_from(trajectory[k : k + 1, :2]) for k in range(0, len(trajectory), 3)])
        )
        bound = bound_of(plan, start[:2], seen, kept)
        completed = float(info["distance"])
    else:
        bound = found.lower
    assert 0.0 < bound <= completed <= info["distance"] + 1e-6


def bound_of(plan: FloorPlan, start: np.ndarray, sight: Checkpoints, kept: np.ndarray) -> float:
    """The lower bound for seeing some of the checkpoints (indices) only."""
    part = Checkpoints.__new__(Checkpoints)
    part.__dict__.update(sight.__dict__)
    part.points = np.ascontiguousarray(sight.points[kept])
    rows = [sight.viewers_of(c) for c in kept]
    part.viewers = np.concatenate(rows)
    part.viewer_starts = np.concatenate([[0], np.cumsum([len(r) for r in rows])])
    return lower_bound(Space.outer(plan, RADIUS, start), part, start, 5e6).length


def test_all_seen_from_the_start():
    plan = FloorPlan.create([(0, 0), (4, 0), (4, 3), (0, 3)], name="room")
    found = reference(plan, (2.0, 1.5), FULL)
    assert (found.lower, found.upper_sensing, found.upper_stop_and_scan, found.gap) == (0.0, 0.0, 0.0, 1.0)
    driven = replay(plan, (2.0, 1.5), found.tour_stop_and_scan, found.checkpoints(plan), EnvConfig(sensor=FULL))
    assert (driven.coverage, driven.scans) == (1.0, 1)
    assert math.isnan(found.ratios(1.0)["lower"])


def test_cache(tmp_path):
    plan, start = PLANS["corridor"], STARTS["corridor"]
    kwargs = {"cache": tmp_path, "iterations": 5, "effort": 2e6}
    found = reference(plan, start, SHORT, **kwargs)
    (file,) = tmp_path.glob("*.json")
    text = file.read_text()

    def same(other):
        for name in ("lower", "upper_sensing", "upper_stop_and_scan", "start", "plan_hash", "seconds"):
            assert getattr(other, name) == getattr(found, name)
        np.testing.assert_array_equal(other.witnesses, found.witnesses)
        np.testing.assert_array_equal(other.tour_sensing.way, found.tour_sensing.way)
        assert other.tour_stop_and_scan.headings == found.tour_stop_and_scan.headings
        np.testing.assert_array_equal(other.checkpoints(plan), found.checkpoints(plan))

    same(reference(plan, start, SHORT, **kwargs))
    # Believed as it is while whole; computed anew when not.
    for damaged in (text[: len(text) // 2], "", "[]", text.replace('"lower"', '"higher"', 1), json.dumps({"a": 1})):
        file.write_text(damaged)
        again = reference(plan, start, SHORT, **kwargs)
        assert (again.lower, again.upper_sensing) == (found.lower, found.upper_sensing)
        assert json.loads(file.read_text())["reference"]["lower"] == found.lower
    reference(plan, start + 0.1, SHORT, **kwargs)
    reference(plan, start, replace(SHORT, max_range=4.0), **kwargs)
    assert len(list(tmp_path.glob("*"))) == 3
    with pytest.raises(ValueError, match="another plan"):
        found.checkpoints(PLANS["home"])


def test_there_are_ways_between_all_places():
    # In this home a place of the grid lies on the border of the free space, where it can be seen but sees nothing.
    plan = suite("home-test").plan(7)
    start = start_of(plan, 0)[:2]
    space = Space.inner(plan, RADIUS, start)
    sight = Checkpoints(plan, space, start, 8.0, 0.3)
    rng = np.random.default_rng(0)
    for place in sight.places[rng.integers(len(sight.places), size=30)]:
        assert np.isfinite(space.distances(place, sight.places, sight.rows)).all()
        assert np.isfinite(space.field(place)).any()


def test_unusable_start():
    with pytest.raises(InvalidFloorPlanError):
        reference(PLANS["corridor"], (-5.0, 0.0))


def test_search_depends_on_its_generator_alone():
    plan, start = PLANS["home"], STARTS["home"]
    space = Space.inner(plan, RADIUS, start)
    sight = Checkpoints(plan, space, start, 3.0, 0.3)
    lengths = [Planner(space, sight, along=True).search(np.random.default_rng(1), 15).length for _ in range(2)]
    assert lengths[0] == lengths[1]
    bounds = [lower_bound(Space.outer(plan, RADIUS, start), sight, start, 5e6).length for _ in range(2)]
    assert bounds[0] == bounds[1]
