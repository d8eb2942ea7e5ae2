"""Files: round trips of every format and what is said of bad ones."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from polyexplore_gym.errors import InvalidFloorPlanError
from polyexplore_gym.floorplan import FAMILIES, FloorPlan, generate, load_plan, save_plan, to_geojson

RING = [[0, 0], [4, 0], [4, 4], [0, 4]]
HOLE = [[1, 1], [1, 2], [2, 2]]


def write(path, data):
    path.write_text(data if isinstance(data, str) else json.dumps(data), encoding="utf-8")
    return path


def geometry(coordinates, kind="Polygon"):
    return {"type": kind, "coordinates": coordinates}


def closed(ring):
    return [*ring, ring[0]]


@pytest.mark.parametrize("suffix", [".json", ".geojson"])
@pytest.mark.parametrize("family", FAMILIES)
def test_round_trip(tmp_path, family, suffix):
    plan = generate(family, 11)
    save_plan(plan, tmp_path / f"plan{suffix}")
    again = load_plan(tmp_path / f"plan{suffix}")
    assert again == plan
    assert again.name == plan.name
    assert dict(again.meta) == dict(plan.meta)
    for ring, other in zip(plan.rings, again.rings, strict=True):
        np.testing.assert_array_equal(ring, other)


@pytest.mark.parametrize("suffix", [".json", ".geojson", ".svg", ".yaml"])
def test_a_plan_is_written_whole_or_not_at_all(tmp_path, monkeypatch, suffix):
    plan, path = FloorPlan.create([[0, 0], [4, 0], [4, 3], [0, 3]]), tmp_path / f"a{suffix}"
    save_plan(plan, path)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    written = Path.write_text

    def torn(self, text, **options):
        written(self, text[: len(text) // 2], **options)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", torn)
    other = FloorPlan.create([[0, 0], [5, 0], [5, 3], [0, 3]])
    with pytest.raises(OSError, match="No space left"):
        save_plan(other, path)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_saved_by_string_path_and_any_case(tmp_path):
    plan = FloorPlan.create(RING)
    save_plan(plan, str(tmp_path / "a.GeoJSON"))
    assert load_plan(str(tmp_path / "a.GeoJSON")) == plan
    with pytest.raises(InvalidFloorPlanError, match=r"unknown suffix '.yml'"):
        save_plan(plan, tmp_path / "a.yml")


def test_geojson_is_what_the_standard_asks_for():
    data = to_geojson(FloorPlan.create(RING, [HOLE], name="a"))
    rings = data["geometry"]["coordinates"]
    assert data["type"] == "Feature"
    assert all(ring[0] == ring[-1] for ring in rings)
    areas = [sum(p[0] * q[1] - q[0] * p[1] for p, q in pairwise(r)) / 2 for r in rings]
    assert areas == [16, -0.5]
    assert data["properties"]["name"] == "a"


@pytest.mark.parametrize(
    "data",
    [
        geometry([closed(RING), closed(HOLE)]),
        geometry([[closed(RING), closed(HOLE)]], "MultiPolygon"),
        {"type": "Feature", "properties": None, "geometry": geometry([closed(RING), closed(HOLE)])},
        {
            "type": "FeatureCollection",
            "features": [
                {"type": "Feature", "properties": {}, "geometry": geometry([closed(RING), closed(HOLE)])},
                {"type": "Feature", "properties": {}, "geometry": None},
            ],
        },
        {"type": "GeometryCollection", "geometries": [geometry([closed(RING), closed(HOLE)])]},
        geometry([[[x, y, 7.0] for x, y in closed(RING)], closed(HOLE)]),
    ],
)
@pytest.mark.parametrize("suffix", [".json", ".geojson"])
def test_geojson_in_all_its_wrappings(tmp_path, data, suffix):
    plan = load_plan(write(tmp_path / f"room{suffix}", data))
    assert plan.content_hash == FloorPlan.create(RING, [HOLE]).content_hash
    assert plan.name == "room"


def test_houseexpo(tmp_path):
    data = {"id": "h1", "verts": closed(RING), "room_num": 1, "room_category": {"Kitchen": [[0, 0, 4, 4]]}}
    data["bbox"] = {"min": [0, 0], "max": [4, 4]}
    plan = load_plan(write(tmp_path / "house.json", data))
    assert plan.name == "h1"
    assert plan.area == 16
    assert plan.meta["room_num"] == 1


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"exterior": [[0, 0], [2, 2], [2, 0], [0, 2]]}, "exterior, vertex 0: .* crosses itself"),
        ({"exterior": RING, "holes": [[[9, 9], [9, 10], [10, 10]]]}, "hole 0, vertex .: .* outside"),
        ('{"exterior": [[0, 0], [NaN, 1], [2, 2]]}', "exterior, vertex 1: .* NaN"),
        ('{"exterior": [[0, 0], [Infinity, 1], [2, 2]]}', "exterior, vertex 1: .* infinite"),
        ('{"exterior": [[0, 0], [1e999, 1], [2, 2]]}', "exterior, vertex 1: .* infinite"),
        ('{"exterior": [[0, 0], [%s, 1], [2, 2]]}' % ("9" * 400), "exterior, vertex 1: .* 10 km"),
        ('{"exterior": [[0, 0], [%s, 1], [2, 2]]}' % ("9" * 5000), "not valid JSON"),
        ({"exterior": None}, "exterior: expected a list"),
        ({"exterior": RING, "holes": None}, "holes: expected a list"),
        ({"exterior": RING, "units": "yards"}, "units 'yards'"),
        ({"exterior": RING, "meta": 3}, "meta: expected an object"),
        ({"verts": [[0, 0], [1, 1]]}, "at least 3 different points"),
        ({"verts": [[0, 0], [1, "a"], [2, 0]]}, "exterior, vertex 1: expected a number"),
        ({"rooms": []}, "not a floor plan"),
        ([1, 2], "expected a JSON object, got list"),
        ("", "truncated perhaps"),
        ('{"exterior": [[0, 0], [1', "truncated perhaps: .* line 1, column"),
        ("[" * 100_000, "not valid JSON"),
        (geometry([]), "list of rings"),
        (geometry(None), "'coordinates' must be a list"),
        (
            geometry([[closed(RING)], [closed(RING)]], "MultiPolygon"),
            "MultiPolygon 1 covers the same floor as MultiPolygon 0",
        ),
        (geometry([0, 0], "Point"), "no polygon"),
        ({"type": []}, "not a floor plan"),
        ({"type": "Feature", "geometry": {"type": [[]]}}, "unknown type"),
        ({"exterior": RING, "units": [["m"]]}, "units .*expected one of m, "),
        ({"exterior": [[[[0]] * 500, 1], [1, 0], [0, 0]]}, "exterior, vertex 0: expected a number"),
        ({"type": "FeatureCollection"}, "list of its members"),
        ({"type": "Feature", "geometry": {"type": "Circle"}}, "unknown type 'Circle'"),
        ({"type": "Feature", "geometry": geometry([5])}, "exterior: expected a list"),
    ],
)
def test_bad_files_are_named_with_ring_and_reason(tmp_path, data, message):
    path = write(tmp_path / "bad.json", data)
    with pytest.raises(InvalidFloorPlanError, match=message) as caught:
        load_plan(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_truncation_of_a_file_is_refused(tmp_path):
    save_plan(FloorPlan.create(RING, [HOLE]), tmp_path / "plan.json")
    text = (tmp_path / "plan.json").read_text().rstrip()
    for end in range(len(text)):
        with pytest.raises(InvalidFloorPlanError, match=r"cut\.json: not valid JSON"):
            load_plan(write(tmp_path / "cut.json", text[:end]))


def test_bytes_that_are_no_text(tmp_path):
    (tmp_path / "a.json").write_bytes(bytes(range(256)))
    with pytest.raises(InvalidFloorPlanError, match="not valid JSON"):
        load_plan(tmp_path / "a.json")


def test_missing_file_folder_and_unknown_suffix(tmp_path):
    with pytest.raises(InvalidFloorPlanError, match=r"none\.json: cannot be read"):
        load_plan(tmp_path / "none.json")
    (tmp_path / "folder.json").mkdir()
    with pytest.raises(InvalidFloorPlanError, match="cannot be read"):
        load_plan(tmp_path / "folder.json")
    with pytest.raises(InvalidFloorPlanError, match=r"unknown suffix '\.dwg'"):
        load_plan(tmp_path / "a.dwg")


def test_too_large_a_file(tmp_path, monkeypatch):
    monkeypatch.setattr("polyexplore_gym.floorplan.formats.MAX_FILE_BYTES", 10)
    with pytest.raises(InvalidFloorPlanError, match="larger than"):
        load_plan(write(tmp_path / "a.json", {"exterior": RING}))
