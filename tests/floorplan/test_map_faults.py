"""Maps as people's tools and robots write them: each fault in a small map, with the right plan."""

import warnings

import cv2
import numpy as np
import pytest
import shapely
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from polyexplore_gym.errors import FloorPlanWarning, InvalidFloorPlanError
from polyexplore_gym.floorplan import FloorPlan, generate, load_plan, save_plan
from polyexplore_gym.floorplan.rosmap import without_specks

PIXEL = 0.05


def flat(door=18, border=60):
    """Two rooms of 100 x 80 pixels (20 m2 each) with a door, walls of 3 pixels, unknown round them."""
    image = np.full((86 + 2 * border, 209 + 2 * border), 205, np.uint8)
    inner = image[border:-border, border:-border]
    inner[:] = 0
    inner[3:83, 3:103] = inner[3:83, 106:206] = 254
    inner[30 : 30 + door, 103:106] = 254
    return image


def write(folder, image, suffix=".pgm", /, **fields):
    if isinstance(image, bytes):
        (folder / f"map{suffix}").write_bytes(image)
    else:
        cv2.imwrite(str(folder / f"map{suffix}"), image)
    data = {"image": f"map{suffix}", "resolution": PIXEL, "origin": [0.0, 0.0, 0.0], "negate": 0}
    data |= {"occupied_thresh": 0.65, "free_thresh": 0.196} | fields
    (folder / "map.yaml").write_text(yaml.safe_dump(data))
    return folder / "map.yaml"


def quiet(path, **arguments):
    """The plan, read without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return load_plan(path, **arguments)


BOTH = 2 * 20.0 + 18 * 3 * PIXEL**2
"""Both rooms and the door, m2."""


@pytest.mark.parametrize("mode", ["trinary", "scale"])
def test_the_grey_of_map_savers_is_unknown_whatever_the_threshold(tmp_path, mode):
    path = write(tmp_path, flat(), free_thresh=0.25, mode=mode)
    with pytest.warns(FloorPlanWarning, match=r"map\.yaml: grey 205 is taken for unknown"):
        assert load_plan(path).area == pytest.approx(BOTH)
    assert quiet(write(tmp_path, flat())).area == pytest.approx(BOTH)


def test_shades_of_a_scale_are_free_by_the_threshold(tmp_path):
    """A free floor of all shades from 200 to 254: 205 is one of them."""
    image = flat()
    shades = np.random.default_rng(0).integers(200, 255, image.shape)
    image = np.where(image == 254, shades, 0).astype(np.uint8)
    assert quiet(write(tmp_path, image, free_thresh=0.25, mode="scale")).area == pytest.approx(BOTH)


def test_a_plan_along_the_images_border_is_told_of(tmp_path):
    drawing = np.where(flat() == 205, 254, flat()).astype(np.uint8)
    path = write(tmp_path, drawing)
    with pytest.warns(FloorPlanWarning) as told:
        load_plan(path)
    assert any("m of the image's border" in str(w.message) for w in told)
    with pytest.warns(FloorPlanWarning, match="reaches .* of the floor"):
        assert load_plan(path, start=(5.0, 5.0)).area == pytest.approx(BOTH)


def test_one_grey_that_is_neither_free_nor_wall_is_told_of(tmp_path):
    image = flat()
    image[63:143, 63:113] = 210
    with pytest.warns(FloorPlanWarning, match=r"25 % of the plan is of the one grey 210.* lower free_thresh"):
        load_plan(write(tmp_path, image))


@pytest.mark.parametrize("value", [205, 0])
def test_specks_neither_block_rooms_nor_leave_holes(tmp_path, value):
    image = flat()
    image[98, 164] = value  # in the middle of the door
    image[70:140:8, 70:160:8] = value
    image[70:140:8, 71:160:16] = value
    plan = quiet(write(tmp_path, image))
    assert plan.area == pytest.approx(BOTH)
    assert not plan.holes


def test_salt_of_one_per_cent_leaves_the_floor(tmp_path):
    image = flat()
    salt = np.random.default_rng(1).random(image.shape) < 0.01
    image[salt & (image == 254)] = 0
    plan = quiet(write(tmp_path, image))
    assert plan.area == pytest.approx(BOTH, rel=0.02)


def test_obstacles_stay_and_what_they_block_is_told_of(tmp_path):
    image = flat()
    image[95:101, 163:167] = 0  # 0.3 x 0.2 m in the door: 0.25 and 0.35 m are left
    with pytest.warns(FloorPlanWarning, match=r"reaches 50 % .*behind a passage of 0\.3\d m at \(8\.\d\d, 5\.\d\d\)"):
        assert load_plan(write(tmp_path, image)).area == pytest.approx(BOTH / 2, abs=0.2)
    small = quiet(tmp_path / "map.yaml", radius=0.12)
    assert len(small.holes) == 1
    assert small.area == pytest.approx(BOTH - 0.06)


def test_a_dotted_wall_stays_a_wall(tmp_path):
    """A wall seen from afar: single pixels with gaps of two, the rooms joined by a door elsewhere."""
    image = flat()
    image[63:143:3, 110] = 0
    image[100:130, 110] = 254
    plan = quiet(write(tmp_path, image))
    # Of 27, one touches the room's wall and ten were in the door.
    assert len(plan.holes) == 16
    assert plan.area == pytest.approx(BOTH - 16 * PIXEL**2)


def salted(seed, share):
    rng = np.random.default_rng(seed)
    blob = cv2.GaussianBlur(rng.uniform(size=(40, 50)), (0, 0), 4) > 0.48
    return blob & (rng.random(blob.shape) > share), rng.random(blob.shape) < 0.5


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.02, 0.1]), st.sampled_from([0.05, 0.1, 0.2]))
@settings(max_examples=60, deadline=None)
def test_specks_by_a_slow_flood(seed, share, resolution):
    free, occupied = salted(seed, share)
    occupied &= ~free
    cleaned = without_specks(free, occupied, resolution)
    assert not (free & ~cleaned).any()
    largest = min(4, int(0.02 / resolution**2 + 1e-9))
    height, width = free.shape
    seen = set()
    for first in map(tuple, np.argwhere(~free).tolist()):
        if first in seen:
            continue
        group, stack = set(), [first]
        while stack:
            row, column = stack.pop()
            if (row, column) in group or not (0 <= row < height and 0 <= column < width) or free[row, column]:
                continue
            group.add((row, column))
            stack += [(row + i, column + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        seen |= group
        inside = all(0 < row < height - 1 and 0 < column < width - 1 for row, column in group)
        freed = [bool(cleaned[pixel]) for pixel in group]
        if not inside or len(group) > largest:
            assert not any(freed)
        elif not any(occupied[pixel] for pixel in group):
            assert all(freed)  # what was never seen is no dotted wall


@pytest.mark.parametrize(("door", "radius", "rooms"), [(8, 0.105, 2), (8, 0.25, 1), (12, 0.25, 2), (12, 0.35, 1)])
def test_the_radius_decides_which_rooms_are_kept(tmp_path, door, radius, rooms):
    path = write(tmp_path, flat(door))
    if rooms == 2:
        plan = quiet(path, radius=radius)
    else:
        width = door * PIXEL
        with pytest.warns(
            FloorPlanWarning, match=rf"a passage of {width:.2f} m at .* a radius of (0\.\d+) m would keep"
        ):
            plan = load_plan(path, radius=radius)
        with pytest.raises(InvalidFloorPlanError, match=r"strict: nothing may be left out"):
            load_plan(path, radius=radius, strict=True)
    assert plan.area == pytest.approx(rooms * 20.0, rel=0.02)
    plan.check_connected(radius)


def test_the_radius_that_is_named_keeps_the_floor(tmp_path):
    path = write(tmp_path, flat(8))
    with pytest.warns(FloorPlanWarning) as told:
        load_plan(path, radius=0.25)
    named = float(str(told[0].message).split("a radius of ")[1].split()[0])
    assert 0.18 < named < 0.2
    assert quiet(path, radius=named).area == pytest.approx(40.0, rel=0.02)


def test_less_than_half_is_refused_unless_a_start_chooses_it(tmp_path):
    image = np.zeros((60, 260), np.uint8)
    for left in (5, 90, 175):
        image[5:55, left : left + 80] = 254
    path = write(tmp_path, image)
    with pytest.raises(InvalidFloorPlanError, match=r"map\.yaml: .* reaches 33 % of the floor .*A start .*--start"):
        load_plan(path)
    with pytest.warns(FloorPlanWarning, match="33 %"):
        assert load_plan(path, start=(10.0, 1.5)).bounds[0] == pytest.approx(175 * PIXEL)


def test_raw_mode(tmp_path):
    occupancy = {254: 0, 0: 100, 205: 255}
    image = np.vectorize(occupancy.get)(flat()).astype(np.uint8)
    assert quiet(write(tmp_path, image, mode="raw")).area == pytest.approx(BOTH)
    image[image == 0] = 30
    with pytest.raises(InvalidFloorPlanError, match="no free pixel"):
        load_plan(write(tmp_path, image, mode="raw"))
    assert quiet(write(tmp_path, image, mode="raw", free_thresh=0.4)).area == pytest.approx(BOTH)


@pytest.mark.parametrize("maxval", [1, 100, 254, 255, 1000, 65535])
@pytest.mark.parametrize("plain", [False, True])
def test_any_maxval(tmp_path, maxval, plain):
    image = flat()
    values = np.rint(np.where(image == 205, 0, image) / 254 * maxval).astype(int)
    head = f"{'P2' if plain else 'P5'}\n# a comment: é\n{image.shape[1]} {image.shape[0]}\n{maxval}\n".encode("latin-1")
    body = " ".join(map(str, values.ravel())).encode() if plain else values.astype(">u2" if maxval > 255 else "u1")
    assert quiet(write(tmp_path, head + (body if plain else body.tobytes()))).area == pytest.approx(BOTH)


def test_the_grey_of_map_savers_with_another_maxval(tmp_path):
    """205 of 254 is 206 of 255, by the letter free at 0.196."""
    image = flat()
    head = f"P5 {image.shape[1]} {image.shape[0]} 254\n".encode()
    with pytest.warns(FloorPlanWarning, match="grey 205 is taken for unknown"):
        assert load_plan(write(tmp_path, head + image.tobytes())).area == pytest.approx(BOTH)


def test_a_jpg_smears_its_greys(tmp_path):
    with pytest.warns(FloorPlanWarning, match="grey 205 is taken for unknown"):
        plan = load_plan(write(tmp_path, flat(), ".jpg", free_thresh=0.25))
    assert plan.area == pytest.approx(BOTH, rel=0.02)


@pytest.mark.parametrize("plain", [False, True])
def test_bitmaps(tmp_path, plain):
    """In a PBM 1 is black."""
    black = (flat() != 254).astype(np.uint8)
    head = f"{'P1' if plain else 'P4'} {black.shape[1]} {black.shape[0]}\n".encode()
    body = "".join(map(str, black.ravel())).encode() if plain else np.packbits(black, axis=1).tobytes()
    assert quiet(write(tmp_path, head + body)).area == pytest.approx(BOTH)


@pytest.mark.parametrize(
    "name", ["/home/somebody/maps/map.pgm", "C:\\Users\\somebody\\map.pgm", "../other/map.pgm", "~nobody-here/map.pgm"]
)
def test_an_image_path_of_another_machine(tmp_path, name):
    path = write(tmp_path, flat(), image=name)
    assert quiet(path).area == pytest.approx(BOTH)


def test_an_image_in_the_home_folder(tmp_path, monkeypatch):
    (tmp_path / "home").mkdir()
    write(tmp_path / "home", flat())
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "map.yaml").write_text("image: ~/map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n")
    assert quiet(tmp_path / "map.yaml").area == pytest.approx(BOTH)


def test_comments_in_latin_1(tmp_path):
    path = write(tmp_path, flat())
    path.write_bytes("# Küche und Flur\n".encode("latin-1") + path.read_bytes())
    assert quiet(path).area == pytest.approx(BOTH)


def test_a_larger_tolerance_is_offered(tmp_path, monkeypatch):
    monkeypatch.setattr("polyexplore_gym.floorplan.rosmap.MAX_VERTICES", 40)
    image = np.zeros((400, 400), np.uint8)
    cv2.circle(image, (200, 200), 190, 254, -1)
    path = write(tmp_path, image)
    with pytest.raises(
        InvalidFloorPlanError, match=r"too many vertices: .*; tolerance=(0\.\d+) \(--tolerance\)"
    ) as caught:
        load_plan(path)
    offered = float(str(caught.value).split("tolerance=")[1].split()[0])
    assert quiet(path, tolerance=offered).n_vertices <= 40


@pytest.mark.parametrize(("family", "resolution"), [("home", 0.05), ("home", 0.02), ("angled", 0.05)])
def test_a_plan_written_as_a_map_comes_back(tmp_path, family, resolution):
    plan = generate(family, 5)
    save_plan(plan, tmp_path / "plan.yaml", resolution=resolution)
    again = quiet(tmp_path / "plan.yaml")
    again.check_connected(0.25)
    off = again.polygon.symmetric_difference(plan.polygon).area
    assert off < 0.5 * resolution * plan.polygon.length
    fields = yaml.safe_load((tmp_path / "plan.yaml").read_text())
    assert set(fields) == {"image", "mode", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"}
    image = cv2.imread(str(tmp_path / fields["image"]), cv2.IMREAD_UNCHANGED)
    assert set(np.unique(image)) == {0, 205, 254}
    # Free is walled in: no free pixel beside an unknown one.
    beside = cv2.dilate((image == 254).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert not (beside & (image == 205)).any()


def test_walls_thinner_than_a_pixel_are_drawn(tmp_path):
    wall = [[3.0, 0.0], [3.0, 3.9], [3.008, 3.9], [3.008, 0.0]]
    room = shapely.box(0, 0, 6, 5).difference(shapely.Polygon(wall))
    save_plan(FloorPlan.create(room.exterior.coords[:-1]), tmp_path / "plan.yaml")
    again = quiet(tmp_path / "plan.yaml")
    assert not again.polygon.covers(shapely.LineString([[2.5, 1.0], [3.5, 1.0]]))
    assert not again.polygon.covers(shapely.LineString([[2.5, 3.8], [3.5, 3.8]]))
    assert again.polygon.covers(shapely.LineString([[2.5, 4.2], [3.5, 4.2]]))


def test_a_raster_too_large_is_refused(tmp_path):
    with pytest.raises(InvalidFloorPlanError, match="take a larger resolution"):
        save_plan(generate("home", 1), tmp_path / "a.yaml", resolution=1e-4)
    for resolution in (0.0, np.nan, 11.0):
        with pytest.raises(InvalidFloorPlanError, match="must lie in"):
            save_plan(generate("home", 1), tmp_path / "a.yaml", resolution=resolution)
