"""ROS maps: the outline against a union of pixels, the yaml's fields, and bad files."""

import cv2
import numpy as np
import pytest
import shapely
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from polyexplore_gym.errors import FloorPlanWarning, InvalidFloorPlanError
from polyexplore_gym.floorplan import generate, load_plan
from polyexplore_gym.floorplan.rosmap import Reached, vectorise


def pixels(region):
    """The slow exact twin: the union of the mask's pixels."""
    height = len(region)
    return shapely.union_all([shapely.box(c, height - r - 1, c + 1, height - r) for r, c in np.argwhere(region)])


def write_map(folder, pixels, suffix=".pgm", /, **fields):
    cv2.imwrite(str(folder / f"map{suffix}"), pixels)
    data = {"image": f"map{suffix}", "resolution": 0.05, "origin": [0.0, 0.0, 0.0], "negate": 0}
    data |= {"occupied_thresh": 0.65, "free_thresh": 0.196} | fields
    data = {k: v for k, v in data.items() if v is not ...}
    (folder / "map.yaml").write_text(yaml.safe_dump(data))
    return folder / "map.yaml"


def room(height=40, width=60, free=254):
    """A room of 50 x 30 pixels, unknown outside, with occupied walls."""
    image = np.full((height, width), 205, np.uint8)
    image[4:36, 4:56] = 0
    image[5:35, 5:55] = free
    return image


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.6, 1.0, 2.0]))
@settings(max_examples=60, deadline=None)
def test_outline_is_exactly_that_of_the_pixels(seed, blur):
    noise = np.random.default_rng(seed).uniform(size=(25, 30))
    mask = cv2.GaussianBlur(noise, (0, 0), blur) > 0.5
    region = Reached(mask, 0).region
    polygon = vectorise(region)
    assert polygon.is_valid
    assert polygon.equals(pixels(region))
    # Nothing but corners.
    assert len(polygon.exterior.simplify(0).coords) == len(polygon.exterior.coords)
    assert not (region & ~mask).any()


def test_largest_region_or_that_with_the_start(tmp_path):
    image = np.zeros((40, 100), np.uint8)
    image[5:35, 5:65] = 254
    image[5:35, 70:95] = 254
    path = write_map(tmp_path, image)
    with pytest.warns(
        FloorPlanWarning, match=r"reaches 71 % of the floor \(4.5 m2\); the largest part left out, 1.9 m2"
    ):
        assert load_plan(path).area == pytest.approx(60 * 30 * 0.05**2)
    with pytest.warns(FloorPlanWarning, match="reaches 29 % .*is not connected with it"):
        assert load_plan(path, start=(4.0, 1.0)).area == pytest.approx(25 * 30 * 0.05**2)
    for start, message in [((3.4, 1.0), "not free"), ((9.0, 1.0), "outside the map"), ((np.nan, 1.0), "finite")]:
        with pytest.raises(InvalidFloorPlanError, match=rf"map\.yaml: .*{message}"):
            load_plan(path, start=start)
    with pytest.raises(InvalidFloorPlanError, match="expected numbers"):
        load_plan(path, start=["a"])


def test_cracks_that_the_robot_cannot_pass_are_closed(tmp_path):
    image = np.zeros((40, 130), np.uint8)
    image[5:35, 5:65] = 254
    image[5:35, 70:125] = 254
    image[20:24, 60:75] = 254
    path = write_map(tmp_path, image)
    with pytest.warns(FloorPlanWarning, match=r"a passage of 0\.20 m at .* a radius of 0\.09\d? m would keep 95 %"):
        plan = load_plan(path, radius=0.25)
    plan.check_connected(0.25)
    assert 60 * 30 * 0.05**2 <= plan.area < 60 * 30 * 0.05**2 + 0.1
    both = load_plan(path, radius=0.0)
    assert both.area == pytest.approx((60 * 30 + 55 * 30 + 4 * 5) * 0.05**2)
    with pytest.raises(InvalidFloorPlanError, match="not connected"):
        both.check_connected(0.25)
    with pytest.raises(InvalidFloorPlanError, match="no room for a disc"):
        load_plan(path, radius=2.0)


def test_resolution_origin_and_yaw(tmp_path):
    path = write_map(tmp_path, room(), resolution=0.1, origin=[-3.0, 2.0, 0.0])
    plan = load_plan(path)
    # Columns 5 to 55 and, from below, rows 5 to 35.
    np.testing.assert_allclose(plan.bounds, (-2.5, 2.5, 2.5, 5.5))
    turned = load_plan(write_map(tmp_path, room(), resolution=0.1, origin=[-3.0, 2.0, np.pi / 2]))
    # A point (a, b) of the raster's frame lies at (-3 - b, 2 + a).
    np.testing.assert_allclose(turned.bounds, (-6.5, 2.5, -3.5, 7.5))
    assert turned.area == pytest.approx(plan.area)
    # The start is in the map's frame, the yaw included.
    assert load_plan(tmp_path / "map.yaml", start=(-5.0, 4.0)) == turned
    with pytest.raises(InvalidFloorPlanError, match="outside the map"):
        load_plan(tmp_path / "map.yaml", start=(-2.0, 4.0))


def test_negate_and_thresholds(tmp_path):
    plain = load_plan(write_map(tmp_path, room()))
    assert load_plan(write_map(tmp_path, 255 - room(), negate=1)).content_hash == plain.content_hash
    # Occupancy (255 - 200) / 255 = 0.216: unknown at 0.196, free at 0.25.
    grey = room(free=200)
    with pytest.raises(InvalidFloorPlanError, match="no free pixel"):
        load_plan(write_map(tmp_path, grey))
    with pytest.warns(FloorPlanWarning, match="100 % of the plan is of the one grey 200"):
        again = load_plan(write_map(tmp_path, grey, free_thresh=0.25))
    assert again.content_hash == plain.content_hash
    # Unknown is an obstacle, and grey 205 is unknown even if the threshold makes it free.
    unknown = room()
    unknown[unknown == 0] = 205
    assert load_plan(write_map(tmp_path, unknown)).content_hash == plain.content_hash
    with pytest.warns(FloorPlanWarning, match="grey 205 is taken for unknown"):
        again = load_plan(write_map(tmp_path, unknown, free_thresh=0.25))
    assert again.content_hash == plain.content_hash


@pytest.mark.parametrize("suffix", [".png", ".pgm", ".bmp"])
def test_image_formats(tmp_path, suffix):
    expected = load_plan(write_map(tmp_path, room())).content_hash
    assert load_plan(write_map(tmp_path, room(), suffix)).content_hash == expected


def test_colour_alpha_and_16_bits(tmp_path):
    expected = load_plan(write_map(tmp_path, room())).content_hash
    colour = cv2.cvtColor(room(), cv2.COLOR_GRAY2BGR)
    assert load_plan(write_map(tmp_path, colour, ".png")).content_hash == expected
    alpha = np.dstack([np.full_like(colour, 254), np.where(room() == 254, 255, 0).astype(np.uint8)])
    assert load_plan(write_map(tmp_path, alpha, ".png")).content_hash == expected
    assert load_plan(write_map(tmp_path, room().astype(np.uint16) * 257, ".png")).content_hash == expected


def test_ascii_and_commented_pgm(tmp_path):
    expected = load_plan(write_map(tmp_path, room())).content_hash
    body = (tmp_path / "map.pgm").read_bytes()[-room().size :]
    (tmp_path / "map.pgm").write_bytes(b"P5\n# made by hand\n60 40\n255\n" + body)
    assert load_plan(tmp_path / "map.yaml").content_hash == expected
    numbers = " ".join(map(str, room().ravel()))
    (tmp_path / "map.pgm").write_text(f"P2\n60 40\n255\n{numbers}")
    assert load_plan(tmp_path / "map.yaml").content_hash == expected


def test_numbers_that_yaml_reads_as_text(tmp_path):
    expected = load_plan(write_map(tmp_path, room()))
    text = (tmp_path / "map.yaml").read_text().replace("resolution: 0.05", "resolution: 5e-2")
    (tmp_path / "map.yaml").write_text(text)
    assert load_plan(tmp_path / "map.yaml").content_hash == expected.content_hash


@pytest.mark.parametrize("family", ["home", "office", "angled"])
def test_a_rastered_plan_comes_back(tmp_path, family):
    """Drawn at 2.5 cm and read again, a plan keeps its shape to about a pixel along its walls."""
    plan = generate(family, 21)
    resolution = 0.025
    x1, y1 = plan.bounds[2:]
    height, width = int(y1 / resolution) + 40, int(x1 / resolution) + 40
    image = np.zeros((height, width), np.uint8)
    x, y = np.meshgrid((np.arange(width) + 0.5) * resolution, (height - np.arange(height) - 0.5) * resolution)
    image[shapely.contains_xy(plan.polygon, x, y)] = 254
    again = load_plan(write_map(tmp_path, image, resolution=resolution))
    again.check_connected(0.25)
    difference = again.polygon.symmetric_difference(plan.polygon).area
    assert difference < resolution * plan.polygon.length
    assert again.area == pytest.approx(plan.area, rel=0.02)


def test_simplification_obeys_the_tolerance(tmp_path):
    image = np.zeros((200, 200), np.uint8)
    cv2.circle(image, (100, 100), 90, 254, -1)
    path = write_map(tmp_path, image)
    exact, default, coarse = (load_plan(path, tolerance=t) for t in (0.0, None, 0.2))
    assert exact.n_vertices > default.n_vertices > coarse.n_vertices
    assert exact.area == pytest.approx((image > 0).sum() * 0.05**2, rel=1e-9)
    for plan, tolerance in ((default, 0.05), (coarse, 0.2)):
        assert plan.polygon.exterior.hausdorff_distance(exact.polygon.exterior) <= 1.01 * tolerance


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"image": ...}, "image: the field is missing"),
        ({"resolution": ...}, "resolution: the field is missing"),
        ({"origin": ...}, "origin: the field is missing"),
        ({"image": 3}, "image 3: expected a file name"),
        ({"image": "none.pgm"}, r"image .*none\.pgm: cannot be read"),
        ({"resolution": 0}, r"resolution 0\.0: must lie in"),
        ({"resolution": -0.05}, "resolution .* must lie in"),
        ({"resolution": "nan"}, "resolution 'nan': expected a finite number"),
        ({"resolution": None}, "resolution None: expected"),
        ({"origin": [0, 0, 0, 0]}, "origin .* expected"),
        ({"origin": "here"}, "origin 'here': expected"),
        ({"origin": [0, float("inf"), 0]}, "origin inf: expected a finite number"),
        ({"origin": [0, 0, 90]}, r"origin \[0, 0, 90\]: the yaw is in radians"),
        ({"negate": 2}, "negate 2: must be 0 or 1"),
        ({"occupied_thresh": 1.5}, "occupied_thresh .* must lie in 0 to 1"),
        ({"occupied_thresh": 0.1}, "free_thresh .* must not exceed"),
        ({"mode": "rwa"}, "mode 'rwa': known are trinary, scale, raw"),
        ({"free_treshold": 0.2, "free_thresh": ...}, "'free_treshold': unknown key; is 'free_thresh' meant"),
    ],
)
def test_bad_yaml_fields(tmp_path, fields, message):
    path = write_map(tmp_path, room(), **fields)
    with pytest.raises(InvalidFloorPlanError, match=message) as caught:
        load_plan(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("text", ["", "just text", "a: [1, 2", "- 1\n- 2", "\x00"])
def test_bad_yaml(tmp_path, text):
    (tmp_path / "map.yaml").write_text(text)
    with pytest.raises(InvalidFloorPlanError, match=r"map\.yaml: not (valid yaml|a ROS map)"):
        load_plan(tmp_path / "map.yaml")


def test_yaml_bomb(tmp_path):
    """Aliases that unfold to 10^9 items end in a short message."""
    lines = ["a0: &a0 [0, 0]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 10)]
    (tmp_path / "map.yaml").write_text("\n".join([*lines, "image: a.pgm", "resolution: 0.05", "origin: *a9"]))
    with pytest.raises(InvalidFloorPlanError, match=r"origin .* expected") as caught:
        load_plan(tmp_path / "map.yaml")
    assert len(str(caught.value)) < 2000


@pytest.mark.parametrize("suffix", [".pgm", ".png"])
def test_truncated_or_damaged_image(tmp_path, suffix):
    path = write_map(tmp_path, room(), suffix)
    data = (tmp_path / f"map{suffix}").read_bytes()
    for end in [0, 1, 5, 9, 12, len(data) // 2, len(data) - 1]:
        (tmp_path / f"map{suffix}").write_bytes(data[:end])
        with pytest.raises(InvalidFloorPlanError, match=rf"image .*map{suffix}: .*(truncated|damaged)"):
            load_plan(path)
    (tmp_path / f"map{suffix}").write_bytes(b"no image at all")
    with pytest.raises(InvalidFloorPlanError, match="not an image"):
        load_plan(path)


def test_an_image_path_alone_is_refused(tmp_path):
    write_map(tmp_path, room())
    with pytest.raises(InvalidFloorPlanError, match=r"map\.pgm: is an image; give the path of the map's yaml"):
        load_plan(tmp_path / "map.pgm")


@pytest.mark.parametrize("arguments", [{"radius": -1.0}, {"radius": np.nan}])
def test_bad_arguments(tmp_path, arguments):
    with pytest.raises(InvalidFloorPlanError, match="must be a finite number of metres"):
        load_plan(write_map(tmp_path, room()), **arguments)
