"""What a robot reaches of a plan: against the discs it can stand in, in all formats, and what is said."""

import json

import gymnasium as gym
import numpy as np
import pytest
import shapely
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from polyexplore_gym.errors import FloorPlanWarning, InvalidFloorPlanError
from polyexplore_gym.floorplan import FloorPlan, load_plan, save_plan
from polyexplore_gym.floorplan.model import PASSABLE, pockets, polygons
from polyexplore_gym.floorplan.reach import trim

POCKET = [[0, 0], [10, 0], [10, 6], [6, 6], [6, 6.1], [6.3, 6.1], [6.3, 7.6], [5, 7.6], [5, 6.1], [5.6, 6.1]]
POCKET += [[5.6, 6], [0, 6]]
"""A room of 60 m2 with a closet of 2 m2 behind a gap of 0.4 m."""
ROOMS = [[0, 0], [6, 0], [6, 2], [6.2, 2], [6.2, 0], [9, 0], [9, 4], [6.2, 4], [6.2, 2.5], [6, 2.5], [6, 4], [0, 4]]
"""Rooms of 24 and 11.2 m2 joined by a door of 0.5 m."""


@pytest.fixture(params=[".json", ".geojson", ".dxf", ".svg", ".yaml"])
def saved(request, tmp_path):
    """Writes a ring as a plan file of each format."""
    if request.param in (".dxf", ".svg"):
        pytest.importorskip("ezdxf")
        pytest.importorskip("svgpathtools")

    def save(ring):
        save_plan(FloorPlan.create(ring), tmp_path / f"plan{request.param}", resolution=0.02)
        return tmp_path / f"plan{request.param}"

    return save


def test_pockets_are_trimmed_alike_in_all_formats(saved):
    path = saved(ROOMS)
    with pytest.warns(
        FloorPlanWarning, match=r"radius 0.3 m reaches 68 % .*11\.\d m2 at .*a passage of 0\.50 m at \(6\."
    ):
        plan = load_plan(path, radius=0.3)
    assert plan.area == pytest.approx(24, abs=0.15)
    assert plan.polygon.covers(shapely.box(0.03, 0.03, 5.97, 3.97))
    plan.check_connected(0.3)
    with pytest.warns(FloorPlanWarning, match=r"32 %|33 %"):
        other = load_plan(path, radius=0.3, start=(8, 1))
    assert other.area == pytest.approx(11.2, abs=0.15)
    with pytest.raises(InvalidFloorPlanError, match="strict"):
        load_plan(path, radius=0.3, strict=True)
    with pytest.raises(InvalidFloorPlanError, match=r"start .*(wall|not free|outside)"):
        load_plan(path, radius=0.3, start=(6.1, 1.0))
    for bad in ((np.nan, 1), "x", (1,), 3):
        with pytest.raises(InvalidFloorPlanError, match="start"):
            load_plan(path, radius=0.3, start=bad)
    for radius in (-0.1, np.nan, np.inf):
        with pytest.raises(InvalidFloorPlanError, match="radius"):
            load_plan(path, radius=radius)


def test_a_small_pocket_is_told_of_and_what_would_reach_it(tmp_path):
    save_plan(FloorPlan.create(POCKET), tmp_path / "plan.json")
    with pytest.warns(FloorPlanWarning, match=r"97 % .*2\.0 m2 at .*0\.40 m at .*a radius of 0\.19\d m would reach it"):
        plan = load_plan(tmp_path / "plan.json", radius=0.25)
    assert plan.area == pytest.approx(60, abs=0.05)
    assert plan.meta["kept"] == pytest.approx(60 / 62, abs=0.01)
    # As it stands without a radius, and for a robot that fits.
    assert load_plan(tmp_path / "plan.json") == FloorPlan.create(POCKET)
    assert load_plan(tmp_path / "plan.json", radius=0.19) == FloorPlan.create(POCKET)


def test_negligible_pockets_leave_the_plan_as_it_is(tmp_path):
    ring = [[0, 0], [10, 0], [10, 10], [0, 10], [0, 6], [-0.1, 6], [-0.1, 6.2], [-0.8, 6.2], [-0.8, 5.4]]
    ring += [[-0.1, 5.4], [-0.1, 5.6], [0, 5.6]]
    save_plan(FloorPlan.create(ring), tmp_path / "plan.json")
    assert load_plan(tmp_path / "plan.json", radius=0.25) == FloorPlan.create(ring)


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 0.6))
@example(98664, 0.5)
@example(1927581953, 0.1474443362671489)
@settings(max_examples=80, deadline=None)
def test_the_trimmed_floor_is_what_the_disc_sweeps_and_its_corners(seed, radius):
    rng = np.random.default_rng(seed)
    boxes = []
    for x, y in rng.uniform(0, 8, (6, 2)):
        width, height = rng.uniform(0.3, 4, 2)
        boxes.append(shapely.affinity.rotate(shapely.box(x, y, x + width, y + height), rng.choice([0, 0, 30])))
    floor = sorted(polygons(shapely.union_all(boxes)), key=lambda part: -part.area)
    floor = [shapely.Polygon(part.exterior, part.interiors) for part in floor]
    stands = [p for part in floor for p in polygons(part.buffer(-PASSABLE * radius, quad_segs=16))]
    assume(stands)
    kept, loss = trim(floor, radius)
    plan = FloorPlan.create(kept.exterior.coords[:-1], [ring.coords[:-1] for ring in kept.interiors])
    plan.check_connected(radius)
    main = max(stands, key=lambda part: part.area)
    swept = main.buffer(PASSABLE * radius * 0.99)
    assert swept.difference(kept).area < 1e-6
    # (Holes too small for a plan are filled.)
    assert kept.difference(shapely.union_all(floor)).area < 1e-6
    left_out = pockets(sorted(stands, key=lambda part: -part.area))
    assert (loss is not None) == bool(left_out)
    if loss is None:
        # But for holes that are too small for a plan.
        assert any(kept.symmetric_difference(part).area < 1e-6 for part in floor)
        return
    total = sum(part.area for part in floor)
    assert loss.kept == pytest.approx(kept.area / total)
    for part in left_out:
        # (But for a corner that the disc does not sweep.)
        assert part.difference(swept).intersection(kept).area < 0.02 * part.area + 1e-3 + 0.03 * radius**2
    if loss.passage:
        # A disc that is a little smaller gets there, one a little larger does not.
        home, target = main.representative_point(), shapely.Point(loss.at)

        def gets_there(width):
            parts = [p for part in floor for p in polygons(part.buffer(-width / 2, quad_segs=16))]
            return any(p.contains(home) and p.contains(target) for p in parts)

        assert gets_there(loss.passage - 0.05 * radius)
        assert not gets_there(loss.passage + 0.05 * radius)


def test_the_environment_gives_radius_and_start_to_the_loader(tmp_path):
    save_plan(FloorPlan.create(ROOMS), tmp_path / "plan.json")
    name = "polyexplore_gym:PolyExplore-Plan-v2"

    def make(plan, radius):
        return gym.make(name, plan=plan, config={"robot": {"radius": radius}, "drive": {"mode": "kinematic"}})

    assert make(tmp_path / "plan.json", 0.2).unwrapped._plan.area == pytest.approx(35.3)
    with pytest.warns(FloorPlanWarning, match="68 %"):
        env = make(tmp_path / "plan.json", 0.3)
    env.reset(seed=0)
    assert env.unwrapped.plan.area == pytest.approx(24, abs=0.1)
    with pytest.warns(FloorPlanWarning, match="32 %"):
        env.reset(seed=0, options={"start": (8.0, 1.0, 0.0)})
    assert env.unwrapped.plan.area == pytest.approx(11.2, abs=0.1)
    env.reset(seed=0, options={"start": (1.0, 1.0, 0.0)})
    assert env.unwrapped.plan.area == pytest.approx(24, abs=0.1)
    with pytest.warns(FloorPlanWarning, match="32 %"):
        env.reset(seed=0, options={"plan": str(tmp_path / "plan.json"), "start": (8.0, 1.0, 0.0)})
    with pytest.raises(InvalidFloorPlanError, match="in a wall or outside"):
        env.reset(seed=0, options={"start": (20.0, 1.0, 0.0)})
    # A plan that was given as such is not changed behind anybody's back.
    with pytest.raises(InvalidFloorPlanError, match=r"not connected .*load_plan with radius=0.3"):
        make(FloorPlan.create(ROOMS), 0.3)


@pytest.mark.parametrize(("size", "hint"), [((8000, 6000), "in mm: 8 x 6 m"), ((2000, 1500), "in cm: 20 x 15 m")])
def test_a_plan_too_large_to_hold_is_refused_with_a_guess(tmp_path, size, hint):
    width, height = size
    ring = [[0, 0], [width, 0], [width, height], [0, height]]
    with pytest.raises(InvalidFloorPlanError, match=rf"exterior: spans {width} x {height} m, more than 1 km2.*{hint}"):
        FloorPlan.create(ring)
    (tmp_path / "a.json").write_text(json.dumps({"exterior": ring}))
    with pytest.raises(InvalidFloorPlanError, match="--units"):
        load_plan(tmp_path / "a.json")
    unit = hint.split()[1].rstrip(":")
    assert load_plan(tmp_path / "a.json", units=unit).area == pytest.approx(
        width * height * {"mm": 1e-6, "cm": 1e-4}[unit]
    )


def test_units(tmp_path):
    ring = [[0, 0], [1000, 0], [1000, 600], [0, 600]]
    hole = [[100, 100], [100, 200], [200, 200]]
    (tmp_path / "a.json").write_text(json.dumps({"exterior": ring, "holes": [hole]}))
    with pytest.warns(
        FloorPlanWarning, match=r"spans 1000 x 600 m, more than buildings do \(in cm: 10 x 6 m.*--units m"
    ):
        load_plan(tmp_path / "a.json")
    for units in ("cm", 0.01, "0.01"):
        assert load_plan(tmp_path / "a.json", units=units).area == pytest.approx(59.5)
    assert load_plan(tmp_path / "a.json", units="m").area == 595_000
    (tmp_path / "a.json").write_text(json.dumps({"exterior": ring, "holes": [hole], "units": "cm"}))
    assert load_plan(tmp_path / "a.json").area == pytest.approx(59.5)
    assert load_plan(tmp_path / "a.json", units="dm").area == pytest.approx(5950)
    for bad in ("furlong", "nan", "-1", "0", "inf"):
        with pytest.raises(InvalidFloorPlanError, match=r"units .*expected one of"):
            load_plan(tmp_path / "a.json", units=bad)


def test_keys_that_nobody_reads(tmp_path):
    path = tmp_path / "a.json"
    data = {"exterior": [[0, 0], [4, 0], [4, 4], [0, 4]]}
    hole = [[[1, 1], [1, 2], [2, 2]]]
    for key in ("hole", "Holes", "holse", "hols"):
        path.write_text(json.dumps({**data, key: hole}))
        with pytest.raises(InvalidFloorPlanError, match=rf"'{key}': unknown key; is 'holes' meant"):
            load_plan(path)
    path.write_text(json.dumps({**data, "rooms": 3, "floor": "2nd"}))
    with pytest.warns(FloorPlanWarning, match=r"a\.json: not read: 'rooms', 'floor'; known: name, units"):
        load_plan(path)
    path.write_text(json.dumps({"verts": data["exterior"], "vert": 3}))
    with pytest.warns(FloorPlanWarning, match="not read: 'vert'"):
        load_plan(path)
