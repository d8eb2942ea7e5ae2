"""The model: every kind of bad input, the normal form, and the geometry against shapely."""

import copy
import math
import pickle

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from polyexplore_gym.errors import InvalidFloorPlanError
from polyexplore_gym.floorplan import FloorPlan, generate
from polyexplore_gym.floorplan.validation import MAX_VERTICES

SQUARE = [[0, 0], [4, 0], [4, 4], [0, 4]]
TRIANGLE = [[1, 1], [3, 1], [2, 3]]
NAN, INF = math.nan, math.inf

BAD = {
    "bow-tie": ([[0, 0], [2, 2], [2, 0], [0, 2]], [], r"exterior, vertex 0: .* vertex 2: the ring crosses itself"),
    "lopsided bow-tie": ([[0, 0], [5, 2], [5, 0], [0, 4]], [], r"exterior, vertex 0: .* crosses itself"),
    "hole bow-tie": (SQUARE, [[[1, 1], [2, 2], [2, 1], [1, 2]]], r"hole 0, vertex 0: .* crosses itself"),
    "pinched": ([[0, 0], [2, 2], [4, 0], [4, 4], [2, 2], [0, 4]], [], r"exterior, vertex 0: .* touches itself"),
    "spike": ([[0, 0], [4, 0], [4, 4], [4, 6], [4, 4], [0, 4]], [], r"exterior, vertex 3: .* back over itself"),
    "folded edge": ([[0, 0], [4, 0], [4, 6], [4, 4], [0, 4]], [], r"exterior, vertex 2: .* back over itself"),
    "no point": ([], [], "exterior: .* at least 3 different points, got 0"),
    "two points": ([[0, 0], [1, 1]], [], "exterior: .* at least 3 different points, got 2"),
    "two points repeated": ([[0, 0], [1, 1], [1, 1], [0, 0]], [], "exterior: .* got 2"),
    "hole of two points": (SQUARE, [TRIANGLE, [[1, 1], [2, 2]]], "hole 1: .* got 2"),
    "collinear": ([[0, 0], [1, 1], [2, 2]], [], "exterior, vertex 2: .* collinear"),
    "collinear, at an angle": ([[0.1, 0.3], [1.1, 3.3], [2.1, 6.3], [0.6, 1.8]], [], "exterior, vertex 2: .*collinear"),
    "NaN": ([[0, 0], [1, NAN], [2, 2]], [], "exterior, vertex 1: .* NaN"),
    "NaN in a hole": (SQUARE, [np.array([[1, 1], [2, 1], [NAN, 2]])], "hole 0, vertex 2: .* NaN"),
    "infinity": ([[0, 0], [4, 0], [2, -INF]], [], "exterior, vertex 2: .* infinite"),
    "beyond 10 km": ([[0, 0], [1, 1e5], [2, 2]], [], "exterior, vertex 1: .* beyond 10 km"),
    "beyond any float": ([[0, 0], [1, 10**400], [2, 2]], [], "exterior, vertex 1: .* beyond 10 km"),
    "hole outside": (SQUARE, [[[10, 10], [11, 10], [11, 11]]], "hole 0, vertex .: .* outside the exterior"),
    "hole around": (TRIANGLE, [SQUARE], "hole 0, vertex .: .* outside the exterior"),
    "hole across": (SQUARE, [[[3, 3], [5, 3], [3, 3.5]]], "hole 0, vertex 0: .* crosses the edge of exterior"),
    "hole on the exterior": (SQUARE, [SQUARE], "hole 0, vertex 0: .* runs along the edge of exterior"),
    "hole along an edge": (SQUARE, [[[0, 1], [1, 1], [1, 2], [0, 2]]], "hole 0, vertex 3: .* runs along"),
    "hole beyond a corner": (
        [[0, 0], [4, 0], [2, 2], [4, 4], [0, 4]],
        [[[1, 1.9], [2, 2], [3, 2], [1, 2.1]]],
        "hole 0, vertex .: ",
    ),
    "hole in a hole": (SQUARE, [TRIANGLE, [[1.8, 1.5], [2.2, 1.5], [2, 2]]], "hole 1, vertex .: .* inside hole 0"),
    "hole around a hole": (SQUARE, [[[1.8, 1.5], [2.2, 1.5], [2, 2]], TRIANGLE], "hole 0, vertex .: .* inside hole 1"),
    "holes crossing": (
        SQUARE,
        [TRIANGLE, [[1, 2], [3, 2], [2, 1.5]]],
        "hole 1, vertex .: .* crosses the edge of hole 0",
    ),
    "the same hole twice": (SQUARE, [TRIANGLE, TRIANGLE], "hole 1, vertex 0: .* runs along the edge of hole 0"),
    "cut apart": (SQUARE, [[[0, 2], [2, 1], [4, 2], [2, 3]]], "hole 0: .* cut the free space apart"),
    "text": ("abc", [], "exterior: expected a list of points, got str"),
    "nothing": (None, [], "exterior: expected a list of points, got NoneType"),
    "a mapping": ({}, [], "exterior: expected a list of points, got dict"),
    "flat list": ([0, 1, 2], [], "exterior, vertex 0: expected two numbers"),
    "text as number": ([[0, 0], [1, "1"], [2, 2]], [], "exterior, vertex 1: expected a number, got '1'"),
    "boolean": ([[0, True], [1, 0], [2, 2]], [], "exterior, vertex 0: expected a number, got True"),
    "complex array": (np.zeros((4, 2), complex), [], r"exterior: expected an \(n, 2\) array of numbers"),
    "three coordinates": (np.zeros((3, 3)), [], r"exterior: expected an \(n, 2\) array"),
    "holes not a list": (SQUARE, 5, "holes: expected a list of rings, got int"),
    "too many": (np.zeros((MAX_VERTICES + 1, 2)), [], "exterior: too many vertices"),
    "too many together": (SQUARE, [np.zeros((MAX_VERTICES - 3, 2))], "hole 0: too many vertices"),
}


@pytest.mark.parametrize(("exterior", "holes", "message"), BAD.values(), ids=BAD.keys())
def test_bad_rings_are_named(exterior, holes, message):
    with pytest.raises(InvalidFloorPlanError, match=message):
        FloorPlan.create(exterior, holes)


def test_tiny_ring_has_zero_area():
    with pytest.raises(InvalidFloorPlanError, match="hole 0: the ring has zero area"):
        FloorPlan.create(SQUARE, [[[1, 1], [1.0005, 1], [1, 1.0005]]])


@pytest.mark.parametrize(("name", "meta"), [(3, {}), ("plan", [1])])
def test_name_and_meta_are_checked(name, meta):
    with pytest.raises(InvalidFloorPlanError, match="expected a"):
        FloorPlan(name, SQUARE, (), meta)


def test_ring_of_random_points_is_refused_without_a_hang():
    points = np.random.default_rng(0).uniform(size=(MAX_VERTICES, 2))
    # Listing all of its 10^8 crossings would take minutes and gigabytes.
    with pytest.raises(InvalidFloorPlanError, match="crosses itself"):
        FloorPlan.create(points)


def test_no_warning_for_nan(recwarn):
    with pytest.raises(InvalidFloorPlanError):
        FloorPlan.create([[0, 0], [1, NAN], [2, 2]])
    assert not recwarn.list


def test_rings_may_touch_in_a_point():
    plan = FloorPlan.create(SQUARE, [[[0, 1], [1, 1], [1, 2]], [[1, 2], [1.5, 2], [1.2, 3]]])
    assert plan.polygon.is_valid
    assert plan.area == pytest.approx(16 - 0.5 - 0.25)


def test_normal_form():
    exterior = [[0, 4], [0, 4], [4, 4], [4, 0], [4, 0], [0, 0], [0, 4]]
    plan = FloorPlan.create(exterior, [TRIANGLE])
    assert len(plan.exterior) == 4
    assert shapely.LinearRing(plan.exterior).is_ccw
    assert not shapely.LinearRing(plan.holes[0]).is_ccw
    assert plan.content_hash == FloorPlan.create(SQUARE, [TRIANGLE[::-1]]).content_hash


@st.composite
def star(draw):
    """A star-shaped ring around (50, 50) with 3 to 20 vertices."""
    n = draw(st.integers(3, 20))
    radii = draw(st.lists(st.floats(1, 30), min_size=n, max_size=n))
    angles = 2 * np.pi * (np.arange(n) + 0.1) / n
    return np.stack([50 + np.array(radii) * np.cos(angles), 50 + np.array(radii) * np.sin(angles)], axis=1)


@given(star(), st.data())
@settings(max_examples=60, deadline=None)
def test_same_plan_however_the_ring_is_written(ring, data):
    reference = FloorPlan.create(ring)
    written = np.roll(ring, data.draw(st.integers(0, len(ring))), axis=0)
    if data.draw(st.booleans()):
        written = written[::-1]
    repeats = data.draw(st.lists(st.integers(1, 3), min_size=len(ring), max_size=len(ring)))
    written = np.repeat(written, repeats, axis=0)
    if data.draw(st.booleans()):
        written = np.concatenate([written, written[:1]])
    plan = FloorPlan.create(written.tolist())
    assert plan.content_hash == reference.content_hash
    assert plan.area == pytest.approx(shapely.Polygon(ring).area)
    assert shapely.LinearRing(plan.exterior).is_ccw
    # Normalising what is normal changes nothing.
    again = FloorPlan.create(plan.exterior, plan.holes)
    np.testing.assert_array_equal(again.exterior, plan.exterior)


@given(st.lists(st.tuples(st.floats(-9, 9), st.floats(-9, 9)), min_size=3, max_size=9))
@settings(max_examples=200, deadline=None)
def test_agrees_with_shapely_on_any_ring(points):
    """Accepted rings are valid for shapely; what shapely finds invalid is refused with our error."""
    try:
        plan = FloorPlan.create(points)
    except InvalidFloorPlanError:
        ring = shapely.Polygon(points)
        # Refused although shapely accepts it: only thinner or smaller than we allow.
        assert not ring.is_valid or ring.buffer(-1e-5).is_empty or ring.minimum_clearance <= 1e-5
    else:
        assert plan.polygon.is_valid
        assert plan.area > 0


def test_immutable():
    plan = FloorPlan.create(SQUARE, [TRIANGLE], meta={"kind": "test"})
    for array in (plan.exterior, plan.holes[0], plan.segments):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1.0
    with pytest.raises(AttributeError):
        plan.name = "other"
    with pytest.raises(TypeError):
        plan.meta["kind"] = "other"


def test_input_arrays_are_copied():
    ring, meta = np.array(SQUARE, float), {"list": [1]}
    plan = FloorPlan.create(ring, meta=meta)
    ring[0] = -1.0
    meta["list"].append(2)
    assert plan.exterior[0].tolist() == [0, 0]
    assert plan.meta["list"] == [1]


@pytest.mark.parametrize("clone", [copy.copy, copy.deepcopy, lambda p: pickle.loads(pickle.dumps(p))])
def test_copies_are_equal_and_read_only(clone):
    plan = FloorPlan.create(SQUARE, [TRIANGLE], name="a", meta={"kind": "test"})
    plan.sample_start(np.random.default_rng(0), 0.25)
    twin = clone(plan)
    assert twin == plan
    assert hash(twin) == hash(plan)
    assert dict(twin.meta) == {"kind": "test"}
    assert not twin.exterior.flags.writeable
    assert not twin.holes[0].flags.writeable
    assert twin != FloorPlan.create(SQUARE, [TRIANGLE], name="b")


def test_hash_is_of_the_geometry_alone():
    plan = FloorPlan.create(SQUARE, [TRIANGLE, [[3, 3], [3.5, 3], [3, 3.5]]], name="a")
    same = FloorPlan.create(
        np.roll(SQUARE, 2, axis=0), [[[3, 3], [3.5, 3], [3, 3.5]], TRIANGLE], name="b", meta={"x": 1}
    )
    assert plan.content_hash == same.content_hash
    moved = FloorPlan.create(SQUARE, [TRIANGLE, [[3, 3], [3.5, 3], [3, 3.501]]])
    assert plan.content_hash != moved.content_hash
    # The same rings with other roles are another plan.
    assert FloorPlan.create(SQUARE).content_hash != plan.content_hash


@pytest.mark.parametrize("family", ["home", "office", "angled"])
def test_free_space_is_left_of_every_segment(family):
    plan = generate(family, 3)
    start, end = plan.segments[:, :2], plan.segments[:, 2:]
    along = (end - start) / np.hypot(*(end - start).T)[:, None]
    left = (start + end) / 2 + 1e-4 * np.stack([-along[:, 1], along[:, 0]], axis=1)
    right = (start + end) / 2 - 1e-4 * np.stack([-along[:, 1], along[:, 0]], axis=1)
    assert (plan.clearance(left) > 0).all()
    assert (plan.clearance(right) < 0).all()
    assert len(plan.segments) == plan.n_vertices


@pytest.mark.parametrize("family", ["home", "office", "angled"])
def test_measures_agree_with_shapely(family):
    plan = generate(family, 5)
    polygon = shapely.Polygon(plan.exterior, plan.holes)
    assert plan.area == pytest.approx(polygon.area, rel=1e-12)
    assert plan.bounds == polygon.bounds
    x0, y0, x1, y1 = plan.bounds
    points = np.random.default_rng(0).uniform((x0 - 1, y0 - 1), (x1 + 1, y1 + 1), (300, 2))
    expected = [polygon.boundary.distance(p) * (1 if polygon.contains(p) else -1) for p in map(shapely.Point, points)]
    np.testing.assert_allclose(plan.clearance(points), expected, atol=1e-9)
    with pytest.raises(ValueError, match="finite"):
        plan.clearance([[0, NAN]])


def test_free_space_keeps_the_radius():
    plan = generate("office", 1)
    free = plan.free_space(0.25)
    points = shapely.get_coordinates(free)
    # The arcs' polygons cut less than 1 mm.
    assert plan.clearance(points).min() > 0.249
    assert plan.free_space(0.0).equals(plan.polygon)
    assert plan.free_space(1000.0).is_empty
    for radius in (-0.1, NAN, INF):
        with pytest.raises(ValueError, match="radius"):
            plan.free_space(radius)


def dumbbell(width: float, size: float = 4.0) -> FloorPlan:
    """Two square rooms joined by a passage 1 m long."""
    low, high, end = 2 - width / 2, 2 + width / 2, 5 + size
    return FloorPlan.create(
        [
            *([0, 0], [4, 0], [4, low], [5, low], [5, 2 - size / 2], [end, 2 - size / 2]),
            *([end, 2 + size / 2], [5, 2 + size / 2], [5, high], [4, high], [4, 4], [0, 4]),
        ],
        name="dumbbell",
    )


def test_connected_for_the_robot():
    dumbbell(0.7).check_connected(0.3)
    # The planner keeps a little off the walls: a passage as wide as the robot is none.
    dumbbell(2 * 0.3 * 1.021).check_connected(0.3)
    with pytest.raises(InvalidFloorPlanError, match="not connected"):
        dumbbell(2 * 0.3 * 1.015).check_connected(0.3)
    with pytest.raises(InvalidFloorPlanError, match=r"dumbbell: exterior, vertex \d+: .* not connected .* 0.3 m"):
        dumbbell(0.59).check_connected(0.3)
    with pytest.raises(InvalidFloorPlanError, match="no room for a robot"):
        dumbbell(0.7).check_connected(3.0)


def test_negligible_pockets_are_tolerated_but_never_started_in():
    plan = dumbbell(0.4, size=0.8)
    parts = shapely.get_parts(plan.free_space(0.25))
    assert len(parts) == 2
    assert min(p.area for p in parts) > 0.05
    plan.check_connected(0.25)
    rng = np.random.default_rng(0)
    starts = np.array([plan.sample_start(rng, 0.25, 0.0) for _ in range(100)])
    assert (starts[:, 0] < 4).all()
    plan.check_start([1, 1, 0], 0.25)
    with pytest.raises(InvalidFloorPlanError, match="cut off"):
        plan.check_start([5.4, 2, 0], 0.25)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ([-1, 1, 0], "lies in a wall or outside"),
        ([2, 1.5, 0], "lies in a wall"),
        ([0.1, 2, 0], "has 0.100 m clearance"),
        ([NAN, 2, 0], "finite"),
        ([1, INF], "finite"),
        ([1], "expected finite numbers"),
        (["a", 1], "expected finite numbers"),
        (None, "expected finite numbers"),
    ],
)
def test_bad_starts_are_refused(pose, message):
    plan = FloorPlan.create(SQUARE, [TRIANGLE])
    with pytest.raises(InvalidFloorPlanError, match=message):
        plan.check_start(pose, 0.25)
    plan.check_start([0.25, 2], 0.25)


def test_starts_repeat_with_the_generator():
    plan = generate("home", 2)
    draws = [[plan.sample_start(np.random.default_rng(7), 0.25) for _ in range(2)] for _ in range(2)]
    np.testing.assert_array_equal(draws[0], draws[1])
    np.testing.assert_array_equal(draws[0][0], draws[0][1])
    assert not np.array_equal(plan.sample_start(np.random.default_rng(8), 0.25), draws[0][0])


@pytest.mark.parametrize("family", ["home", "office", "angled"])
def test_starts_keep_their_distance(family):
    plan = generate(family, 4)
    rng = np.random.default_rng(0)
    starts = np.array([plan.sample_start(rng, 0.25, margin=0.15) for _ in range(100)])
    assert plan.clearance(starts[:, :2]).min() >= 0.4
    assert (np.abs(starts[:, 2]) <= np.pi).all()
    for start in starts:
        plan.check_start(start, 0.25)


def test_starts_are_uniform():
    """Counts in the quarters of an L agree with their areas (chi-square, 3 degrees of freedom, 99.9 %)."""
    plan = FloorPlan.create([[0, 0], [9, 0], [9, 3], [3, 3], [3, 7], [0, 7]])
    rng = np.random.default_rng(3)
    starts = np.array([plan.sample_start(rng, 0.5, margin=0.0) for _ in range(2000)])
    quarters = [shapely.box(0, 0, 3, 3), shapely.box(3, 0, 6, 3), shapely.box(6, 0, 9, 3), shapely.box(0, 3, 3, 7)]
    areas = np.array([plan.free_space(0.5).intersection(q).area for q in quarters])
    counts = np.array([shapely.contains_xy(q, starts[:, :2]).sum() for q in quarters])
    expected = 2000 * areas / areas.sum()
    assert ((counts - expected) ** 2 / expected).sum() < 16.3


def test_start_gives_up_the_margin_where_it_must():
    plan = FloorPlan.create([[0, 0], [5, 0], [5, 0.6], [0, 0.6]])
    start = plan.sample_start(np.random.default_rng(0), 0.25, margin=0.1)
    assert plan.clearance(start[:2])[0] >= 0.25
    with pytest.raises(InvalidFloorPlanError, match="no room"):
        plan.sample_start(np.random.default_rng(0), 0.31)


def test_start_in_a_thin_diagonal_plan():
    """The bounding box is nearly all outside; sampling still ends."""
    plan = FloorPlan.create([[0, 0], [0.8, 0], [990, 989.2], [990, 990]])
    start = plan.sample_start(np.random.default_rng(0), 0.25, margin=0.0)
    assert plan.clearance(start[:2])[0] >= 0.25
