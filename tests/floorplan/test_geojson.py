"""GeoJSON of other tools: lines and points, furniture, rooms, degrees."""

import json

import numpy as np
import pytest
import shapely

from polyexplore_gym.errors import FloorPlanWarning, InvalidFloorPlanError
from polyexplore_gym.floorplan import load_plan

HALL = [[0, 0], [10, 0], [10, 6], [0, 6], [0, 0]]


def feature(kind, coordinates, /, **properties):
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}


@pytest.fixture
def write(tmp_path):
    def save(*features, **members):
        path = tmp_path / "plan.geojson"
        path.write_text(json.dumps({"type": "FeatureCollection", "features": list(features), **members}))
        return path

    return save


def box(x, y, width, height):
    return [[[x, y], [x + width, y], [x + width, y + height], [x, y + height], [x, y]]]


def test_lines_and_points_are_walls_by_option_or_an_error(write):
    walls = [feature("LineString", [[5, 0], [5, 2.4]]), feature("MultiLineString", [[[5, 3.4], [5, 6]]])]
    path = write(feature("Polygon", [HALL], name="hall"), *walls, feature("Point", [2, 3]))
    with pytest.raises(
        InvalidFloorPlanError, match=r"features\[1\] LineString: 2 lines and 1 points .*--wall-thickness"
    ):
        load_plan(path)
    assert load_plan(path, wall_thickness=0).area == 60
    plan = load_plan(path, wall_thickness=0.2)
    # Square ends reach half the thickness farther.
    expected = shapely.Polygon(HALL).difference(
        shapely.union_all(
            [shapely.box(4.9, 0, 5.1, 2.5), shapely.box(4.9, 3.3, 5.1, 6), shapely.box(1.9, 2.9, 2.1, 3.1)]
        )
    )
    assert plan.polygon.symmetric_difference(expected).area < 1e-9
    assert plan.name == "hall"
    with pytest.warns(FloorPlanWarning, match="reaches 50 %"):
        load_plan(path, wall_thickness=0.2, radius=0.45)


def test_lines_and_points_in_a_geometry_collection(tmp_path):
    members = [{"type": "Polygon", "coordinates": [HALL]}, {"type": "LineString", "coordinates": [[5, 0], [5, 2]]}]
    (tmp_path / "a.json").write_text(json.dumps({"type": "GeometryCollection", "geometries": members}))
    with pytest.raises(InvalidFloorPlanError, match=r"geometries\[1\] LineString: 1 lines"):
        load_plan(tmp_path / "a.json")
    assert load_plan(tmp_path / "a.json", wall_thickness=0.1).area == pytest.approx(60 - 0.1 * 2.05)


def test_polygons_within_the_outline_are_furniture(write):
    table, shelf = feature("Polygon", box(2, 2, 1, 1), kind="table"), feature("Polygon", box(9.4, 2, 1, 0.4))
    plan = load_plan(write(table, feature("Polygon", [HALL], name="hall", floor=2), shelf))
    assert plan.area == pytest.approx(60 - 1 - 0.6 * 0.4)
    assert len(plan.holes) == 1
    assert plan.name == "hall"
    assert plan.meta["floor"] == 2


def test_rooms_beside_each_other(write):
    small, large = feature("Polygon", box(11, 0, 4, 6), name="small"), feature("Polygon", [HALL], name="large")
    with pytest.warns(FloorPlanWarning, match=r"reaches 71 % .*24.0 m2 at .*is not connected with it"):
        plan = load_plan(write(small, large))
    assert plan.area == 60
    with pytest.warns(FloorPlanWarning, match="29 %"):
        assert load_plan(write(small, large), start=(12, 3)).area == 24


@pytest.mark.parametrize(
    ("features", "message"),
    [
        ([feature("Polygon", [HALL]), feature("Polygon", [HALL])], r"features\[1\] Polygon covers the same floor"),
        ([feature("Polygon", [HALL]), feature("Polygon", box(8, 0, 6, 6))], r"features\[1\] Polygon overlaps features"),
        (
            [feature("Polygon", [HALL]), feature("Polygon", [[[1, 1], [2, 2], [2, 1], [1, 2]]])],
            r"features\[1\] .*crosses",
        ),
        ([feature("Point", [1, 1])], "no polygon"),
        ([feature("Polygon", [HALL], units="rod")], "units 'rod'"),
        ([feature("Polygon", [HALL], meta=3)], "meta: expected an object"),
        ([feature("Polygon", [[]])], "at least 3"),
        ([feature("Polygon", [HALL]), feature("LineString", [[1, 1]])], r"features\[1\]"),
        ([feature("Polygon", [HALL]), feature("Curve", [[1, 1]])], r"features\[1\]: unknown type 'Curve'"),
        ([feature("Polygon", [HALL]), 7], r"features\[1\]: expected an object"),
    ],
)
def test_bad_members_are_named(write, features, message):
    with pytest.raises(InvalidFloorPlanError, match=message):
        load_plan(write(*features))
    with pytest.raises(InvalidFloorPlanError):
        load_plan(write(*features), wall_thickness=0.1)


def test_degrees_are_noticed_and_read(write):
    """A hall of 10 x 6 m at 45 degrees north."""
    metre = 180 / (np.pi * 6_371_008.8)
    ring = [[15.97 + x * metre / np.cos(np.pi / 4), 45.0 + y * metre] for x, y in HALL]
    x = ring[0][0]
    table = [[x + 3e-5, 45.00002], [x + 4e-5, 45.00002], [x + 4e-5, 45.00003]]
    path = write(feature("Polygon", [ring]), feature("Polygon", [table]))
    with pytest.raises(InvalidFloorPlanError, match=r"is no building; .*longitude and latitude.*--units deg"):
        load_plan(path)
    plan = load_plan(path, units="deg")
    assert plan.polygon.convex_hull.area == pytest.approx(60, rel=1e-4)
    assert len(plan.holes) == 1
    with pytest.raises(InvalidFloorPlanError, match="no longitudes and latitudes"):
        load_plan(write(feature("Polygon", box(0, 0, 200, 5))), units="deg")


def test_units_of_lines_too(write):
    path = write(
        feature("Polygon", [[[100 * x, 100 * y] for x, y in HALL]]), feature("LineString", [[500, 0], [500, 300]])
    )
    assert load_plan(path, units="cm", wall_thickness=0.1).area == pytest.approx(60 - 0.1 * 3.05)
    with pytest.warns(FloorPlanWarning, match="in cm: 10 x 6 m"):
        load_plan(path, wall_thickness=0.1)


def test_coordinates_of_a_survey(write):
    far = [[431_200.25 + x, 5_073_100.5 + y] for x, y in HALL]
    path = write(feature("Polygon", [far], name="hall"), feature("Point", far[0]))
    with pytest.warns(FloorPlanWarning, match=r"\(431200, 5.0731e\+06\) m is taken off all of them"):
        plan = load_plan(path, wall_thickness=0.2)
    assert plan.bounds == pytest.approx((0.25, 0.5, 10.25, 6.5))
    assert plan.area == pytest.approx(60 - 0.01)
    assert plan.meta["offset"] == [431_200.0, 5_073_100.0]
