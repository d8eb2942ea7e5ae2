"""Outlines of what was seen, from scans of walls that are known exactly."""

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from polyexplore_gym.config import MappingConfig, SensorConfig
from polyexplore_gym.errors import InvalidFloorPlanError
from polyexplore_gym.floorplan import FloorPlan, load_plan, save_plan
from polyexplore_gym.mapping import Beams, LineMap, Walls, extract_lines, walls_of
from polyexplore_gym.outline import floor_plan, trace, views_of
from polyexplore_gym.outline.polygon import crossings, straightened
from polyexplore_gym.outline.sides import Side, crossing
from polyexplore_gym.outline.views import CLEARANCE, INSIDE, OBLIQUE, SPARE, snap
from polyexplore_gym.sim.laser import cast_rays

ROUND = SensorConfig(beams=720, field_of_view=2 * math.pi, max_range=20.0)
HALF = SensorConfig(beams=361, field_of_view=math.pi, max_range=20.0)


def walls(*rings):
    """(M, 4) of closed rings."""
    parts = [np.array(ring, float) for ring in rings]
    return np.concatenate([np.hstack((ring, np.roll(ring, -1, axis=0))) for ring in parts])


def box(x0, y0, x1, y1):
    return [[x0, y0], [x1, y0], [x1, y1], [x0, y1]]


def scanned(segments, pose, sensor, rng):
    """A noisy scan; without a generator there is no noise."""
    full = sensor.field_of_view >= 2 * math.pi
    angles = np.linspace(-0.5, 0.5, sensor.beams, endpoint=not full) * sensor.field_of_view
    off = np.zeros((2, sensor.beams)) if rng is None else rng.normal(size=(2, sensor.beams))
    ranges = cast_rays(segments, pose[0], pose[1], angles + pose[2] + sensor.sigma_angle * off[1], sensor.max_range)
    return Beams(angles, ranges + sensor.sigma_range * off[0], np.array(pose, float), np.zeros((3, 3)))


def mapped(scans, sensor, ratio=3.0):
    """The walls that are left of the line map of some scans."""
    line_map = LineMap(MappingConfig(), sensor)
    for scan in scans:
        found = extract_lines(scan.angles, scan.ranges, sensor, line_map.config)
        line_map.insert(found, scan.pose, scan.covariance)
    return walls_of(line_map, scans, sensor, ratio)


def outlined(segments, poses, sensor=ROUND, seed=0):
    rng = None if seed is None else np.random.default_rng(seed)
    scans = [scanned(segments, pose, sensor, rng) for pose in poses]
    return trace(views_of(scans, sensor.max_range), mapped(scans, sensor), sensor)


def area(outline):
    polygon = shapely.Polygon(outline.exterior, outline.holes)
    assert polygon.is_valid
    return polygon


def off(points, corners):
    """Distance of each corner from the nearest point, m."""
    points = np.asarray(points)
    return np.array([np.hypot(*(points - corner).T).min() for corner in np.asarray(corners, float)])


def test_a_room_without_noise_is_exact():
    outline = outlined(walls(box(0, 0, 6, 4)), [(2, 2, 0), (4, 1, 0)], seed=None)
    assert len(outline.exterior) == 4
    assert outline.holes == ()
    assert off(outline.exterior, box(0, 0, 6, 4)).max() < 1e-3
    assert outline.unknown.shape == (0, 4)
    assert outline.unknown_share == 0.0
    assert outline.perimeter == pytest.approx(20.0, abs=0.01)
    assert outline.left_out == pytest.approx(0.0, abs=1e-9)


def test_corners_are_those_of_the_fitted_lines():
    """An L-shaped room with a slanted wall and noise of 1 cm: corners to millimetres, none too many."""
    ring = [[0, 0], [6, 0], [6, 3], [4, 5], [0, 5]]
    outline = outlined(walls(ring), [(2, 2, 0), (4, 1, 0), (1, 4, 1), (3, 3, 2), (5, 2, 0), (2, 4, 0)])
    assert len(outline.exterior) == 5
    assert off(outline.exterior, ring).max() < 0.01
    assert area(outline).area == pytest.approx(28.0, abs=0.1)


@pytest.mark.parametrize("thickness", [0.06, 0.12])
def test_a_thin_wall_has_two_faces(thickness):
    """Two rooms, a wall between them with a door of 1 m: both faces stay, so far apart as they are."""
    a, b = 4.0, 4.0 + thickness
    ring = [[0, 0], [a, 0], [a, 1.5], [b, 1.5], [b, 0], [8, 0], [8, 4], [b, 4], [b, 2.5], [a, 2.5], [a, 4], [0, 4]]
    poses = [(1, 1, 0), (2, 3, 0), (3, 2, 0), (4.05, 2, 0), (5, 1, 0), (6, 3, 0), (7, 2, 0)]
    outline = outlined(walls(ring), poses)
    assert len(outline.exterior) == 12
    assert off(outline.exterior, ring).max() < 0.03
    across = area(outline).intersection(shapely.LineString([(0, 0.7), (8, 0.7)]))
    gap = sorted(part.bounds for part in shapely.get_parts(across))
    assert gap[1][0] - gap[0][2] == pytest.approx(thickness, abs=0.008)


def test_what_is_seen_all_round_is_a_hole():
    pillar = box(2.5, 1.6, 3.1, 2.2)
    poses = [(1, 1, 0), (5, 3, 0), (1, 3, 0), (5, 1, 0), (3, 3.5, 0), (3, 0.5, 0)]
    outline = outlined(walls(box(0, 0, 6, 4), pillar[::-1]), poses)
    assert [len(hole) for hole in outline.holes] == [4]
    assert off(outline.holes[0], pillar).max() < 0.015
    assert area(outline).area == pytest.approx(24 - 0.36, abs=0.05)


def test_the_unknown_is_closed_and_marked():
    """One look along a corridor with a niche, most of which stays unknown."""
    ring = [[0, 0], [5, 0], [5, 1.5], [4, 1.5], [4, 4], [3, 4], [3, 1.5], [0, 1.5]]
    outline = outlined(walls(ring), [(0.5, 0.75, 0.0)], sensor=HALF)
    assert outline.unknown_share == pytest.approx(outline.unknown_length / outline.perimeter)
    # What bounds the view: half a turn behind the laser, 1.5 m; and from one side of the niche to the other, where the
    # ray past its nearer corner ends.
    behind = outline.unknown[outline.unknown[:, [0, 2]].max(axis=1) < 0.6]
    niche = outline.unknown[outline.unknown[:, [0, 2]].min(axis=1) > 2.9]
    assert len(behind) + len(niche) == len(outline.unknown)
    assert np.hypot(*(behind[:, 2:] - behind[:, :2]).T).sum() == pytest.approx(1.5, abs=0.25)
    assert np.hypot(*(niche[:, 2:] - niche[:, :2]).T).sum() == pytest.approx(math.hypot(1.0, 0.3), abs=0.25)
    seen = area(outline)
    assert seen.difference(shapely.Polygon(ring).buffer(0.02)).area < 0.02
    assert seen.area == pytest.approx(4.5 * 1.5 + 0.5 * 0.3, abs=0.1)


def test_a_wall_that_is_seen_through_is_gone():
    """Somebody stood in the way in one of many scans."""
    rng = np.random.default_rng(0)
    room, poses = walls(box(0, 0, 8, 4)), [(1 + 0.3 * k, 1 + (k % 3), 0.0) for k in range(12)]
    scans = [scanned(room, pose, ROUND, rng) for pose in poses]
    ghost = np.concatenate((room, [[6.5, 1.0, 6.5, 3.0]]))
    scans.insert(3, scanned(ghost, (4, 2, 0.0), ROUND, rng))
    with_all, without = mapped(scans, ROUND, ratio=0.0), mapped(scans, ROUND)
    middle = np.abs(with_all.segments.reshape(-1, 2, 2).mean(axis=1) - (6.5, 2.0)).max(axis=1) < 0.3
    assert middle.any()
    assert not (np.abs(without.segments.reshape(-1, 2, 2).mean(axis=1) - (6.5, 2.0)).max(axis=1) < 0.5).any()
    outline = trace(views_of(scans, ROUND.max_range), without, ROUND)
    assert len(outline.exterior) == 4
    assert outline.holes == ()
    assert off(outline.exterior, box(0, 0, 8, 4)).max() < 0.01


@pytest.mark.parametrize(("width", "holes"), [(0.2, 0), (1.0, 1)])
def test_islands_that_nothing_was_measured_of(width, holes):
    """No beam that would cross the middle says anything: where a robot would fit there is a hole, all of it unknown."""
    poses = [(1, 1, 0), (5, 3, 0), (1, 3, 0), (5, 1, 0), (3, 3.7, 0), (3, 0.3, 0)]
    rng, island = np.random.default_rng(0), shapely.box(3 - width / 2, 2 - width / 2, 3 + width / 2, 2 + width / 2)
    scans = []
    for pose in poses:
        scan = scanned(walls(box(0, 0, 6, 4)), pose, ROUND, rng)
        ends = scan.pose[:2] + 9.0 * np.stack((np.cos(scan.angles), np.sin(scan.angles)), axis=1)
        blind = shapely.intersects(shapely.linestrings([[pose[:2], end] for end in ends]), island)
        scans.append(scan._replace(ranges=np.where(blind, np.nan, scan.ranges)))
    outline = trace(views_of(scans, ROUND.max_range), mapped(scans, ROUND), ROUND)
    assert len(outline.exterior) == 4
    assert len(outline.holes) == holes
    assert outline.unknown_length == pytest.approx(4.0 * width * holes, rel=0.4)
    for hole in outline.holes:
        assert shapely.Polygon(hole).contains(island.buffer(-0.1))


def test_the_part_with_most_scans_is_kept():
    """Two rooms without a door between them, two scans in one, one in the other."""
    segments = walls(box(0, 0, 3, 4), box(5, 0, 9, 4))
    outline = outlined(segments, [(1, 1, 0), (2, 3, 0), (7, 2, 0)])
    assert area(outline).area == pytest.approx(12.0, abs=0.05)
    assert outline.left_out == pytest.approx(16.0, abs=0.05)


def test_no_area_is_an_error():
    nothing = Beams(np.linspace(-1, 1, 9), np.full(9, np.nan), np.zeros(3), np.zeros((3, 3)))
    none = Walls(np.zeros((0, 4)), np.zeros(0, np.int64), np.zeros(0), np.zeros(0), np.zeros(0))
    for scans in ([], [nothing], [nothing._replace(ranges=np.full(9, 1e-7))]):
        with pytest.raises(InvalidFloorPlanError, match="the scans saw no area"):
            trace(views_of(scans, 8.0), none, HALF)


def test_a_floor_plan_is_saved_with_what_is_unknown(tmp_path):
    outline = outlined(walls(box(0, 0, 6, 4)), [(2, 2, 0)], sensor=HALF)
    plan = floor_plan(outline, "room")
    assert plan.meta["unknown_length"] > 1.0
    for name in ("a.json", "a.geojson"):
        save_plan(plan, tmp_path / name)
        again = load_plan(tmp_path / name)
        assert again == plan
        assert again.meta["unknown"] == plan.meta["unknown"]
        assert again.meta["unknown_share"] == round(outline.unknown_share, 6)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_any_scans_give_a_valid_plan(seed):
    """Scans of garbage, walls of garbage: a valid plan."""
    rng = np.random.default_rng(seed)
    scans = []
    for _ in range(rng.integers(1, 6)):
        n = int(rng.integers(3, 60))
        angles = np.sort(rng.uniform(-math.pi, math.pi, n))
        ranges = rng.choice([0.05, 0.5, 2.0, 4.0]) * (1 + rng.choice([0.0, 0.01, 0.3]) * rng.normal(size=n))
        ranges[rng.random(n) < 0.1] = np.nan
        scans.append(
            Beams(angles, np.abs(ranges), np.append(rng.uniform(-2, 2, 2), rng.uniform(-3, 3)), np.zeros((3, 3)))
        )
    m = int(rng.integers(0, 6))
    ends = rng.uniform(-4, 4, (m, 4))
    alpha = np.arctan2(ends[:, 0] - ends[:, 2], ends[:, 3] - ends[:, 1])
    rho = ends[:, 0] * np.cos(alpha) + ends[:, 1] * np.sin(alpha)
    some = Walls(ends, np.arange(m), rho, alpha, np.full(m, 0.01))
    views = views_of(scans, 3.0)
    if not len(views.apexes):
        return
    outline = trace(views, some, HALF)
    plan = floor_plan(outline, "garbage")  # checks what a plan must be
    assert plan.area == pytest.approx(area(outline).area)


def slow_snap(segments, sigma, apex, points, hits, var_range, var_angle):
    """Beam by beam and wall by wall."""
    out, on = points.copy(), np.full(len(points), -1)
    for k, end in enumerate(points):
        reach = math.dist(apex, end)
        ray = (end - apex) / reach
        best, at_best = math.inf, reach
        for i, (a, b) in enumerate(segments.reshape(-1, 2, 2)):
            length = math.dist(a, b)
            along = (b - a) / length
            normal = np.array([along[1], -along[0]])  # away from the free space
            distance, across = (a - apex) @ normal, ray @ normal
            if distance <= 0 or across < OBLIQUE:
                continue
            at = distance / across
            foot = (apex + at * ray - a) @ along
            if not -SPARE <= foot <= length + SPARE:
                continue
            beyond = (reach - at) * across
            noise = var_range * across**2 + var_angle * at**2 * (1 - across**2) + sigma[i] ** 2
            if hits[k] and abs(beyond) <= CLEARANCE + 3 * math.sqrt(noise):
                if abs(beyond) < best:
                    best, at_best, on[k] = abs(beyond), at, i
            elif beyond > 0 and INSIDE <= foot <= length - INSIDE and at < at_best:
                best, at_best, on[k] = 0.0, at, i
        out[k] = apex + at_best * ray
    return out, on


@pytest.mark.parametrize("seed", range(20))
def test_snap_is_its_slow_twin(seed):
    rng = np.random.default_rng(seed)
    n, full = 90, seed % 2 == 0
    bearing = np.sort(rng.uniform(0, 2 * math.pi if full else 2.5, n)) + rng.uniform(-7, 7)
    apex = rng.uniform(-1, 1, 2)
    points = apex + rng.uniform(1, 5, n)[:, None] * np.stack((np.cos(bearing), np.sin(bearing)), axis=1)
    segments = rng.uniform(-5, 5, (12, 4))
    segments[:3] = np.hstack((points[:60:20], points[5:65:20]))[:3]  # along which some beams end
    sigma, hits = rng.uniform(0, 0.01, 12), rng.random(n) < 0.8
    args = segments, sigma, apex, points, hits, 1e-4, 1e-5
    fast, on = snap(*args)
    slow, slow_on = slow_snap(*args)
    assert (on >= 0).sum() > 5
    np.testing.assert_array_equal(on, slow_on)
    np.testing.assert_allclose(fast, slow, atol=1e-9)


def test_crossings_are_those_of_shapely():
    rng = np.random.default_rng(1)
    valid = 0
    for _ in range(200):
        ring = rng.uniform(0, 1, (int(rng.integers(3, 7)), 2))
        simple = shapely.Polygon(ring).is_valid
        assert (not crossings([ring])) == simple
        valid += simple
    assert 20 < valid < 180
    bow = np.array([[0, 0], [1, 1], [1, 0], [0, 1.0]])
    assert crossings([bow]) == [((0, 0), (0, 2))]
    spike = np.array([[0, 0], [2, 0], [1, 0], [1, 1.0]])
    assert ((0, 0), (0, 1)) in crossings([spike])


def test_needless_vertices_go():
    ring = np.array([[0, 0], [1, 0], [2, 0.0], [2, 0.0004], [2, 2], [1, 2], [0, 2]])
    points, owner = straightened(ring, np.arange(7))
    np.testing.assert_allclose(points, [[0, 0], [2, 0], [2, 2], [0, 2]], atol=1e-3)
    assert len(owner) == 4


def test_where_sides_meet():
    def side(x, y, angle, line=-1):
        return Side(0, 1, np.array([x, y]), np.array([math.cos(angle), math.sin(angle)]), line, 1.0)

    np.testing.assert_allclose(crossing(side(0, 1, 0), side(2, 0, math.pi / 2)), [2, 1], atol=1e-12)
    nearly = math.radians(5)
    assert crossing(side(0, 0, 0), side(1, 0, nearly)) is None
    np.testing.assert_allclose(crossing(side(0, 0, 0, 3), side(1, 0, nearly, 4)), [1, 0], atol=1e-12)


def test_beams_far_apart_leave_out_what_lies_between():
    """A full turn with a gap of unknown beams in it."""
    angles = np.radians(np.arange(-180.0, 180.0))
    ranges = np.full(360, 2.0)
    ranges[170:191] = np.nan
    views = views_of([Beams(angles, ranges, np.array([1.0, 0, 0]), np.zeros((3, 3)))], 8.0)
    none = Walls(np.zeros((0, 4)), np.zeros(0, np.int64), np.zeros(0), np.zeros(0), np.zeros(0))
    polygon = area(trace(views, none, HALF))
    # 338 steps, and half a step at both ends, of 1 degree.
    assert polygon.area == pytest.approx(339 * math.radians(1) * 2.0**2 / 2, rel=0.005)
    assert not polygon.contains(shapely.Point(2.0, 0.0))
    assert polygon.contains(shapely.Point(1.7, 1.2))


def test_a_plan_without_name_is_none():
    outline = outlined(walls(box(0, 0, 6, 4)), [(2, 2, 0)])
    plan = floor_plan(outline, "a room")
    assert isinstance(plan, FloorPlan)
    assert plan.name == "a room"
