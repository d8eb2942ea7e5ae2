"""Damaged and odd plan files of each format: a clear error that names the file, or a plan; never another exception.

What is certainly damaged is never a plan. A few of each in every run of the tests, 200 of each with `-m slow`.
"""

import copy
import json
import re
import warnings

import cv2
import numpy as np
import pytest
import yaml

from polyexplore_gym.errors import InvalidFloorPlanError
from polyexplore_gym.floorplan import FloorPlan, generate, load_plan, save_plan, to_geojson
from polyexplore_gym.floorplan.formats import to_mapping

PLAN = generate("home", 11)
ODD_NUMBERS = [
    b"nan",
    b"-inf",
    b"1e999",
    b"-1e300",
    b"1e-320",
    b"9" * 400,
    b"0x10",
    b"",
    b"--1",
    b"1.2.3",
    b"99999999",
    b"-1",
]
ODD_VALUES = [None, True, -1, 0, 1e308, float("nan"), float("inf"), 10**400, "", "x", "1.0", {}, {"a": 1}]
ODD_VALUES += [[], [[]], [1], [[1]], [[1, 2]]]
ODD_VALUES += [
    [[0, 0]] * 5,
    [[0, 0], [1, 0], [1]],
    "é\u2028",
    ["x"] * 3,
    [None] * 4,
    [[[[[[[[0]]]]]]]],
    {"type": "Polygon"},
]


def truncated(rng, data):
    """Certainly damaged: at least one character that is no white space is missing."""
    return data[: int(rng.integers(0, len(data.rstrip())))]


def flipped(rng, data):
    data = bytearray(data)
    for i in rng.integers(0, len(data), int(rng.integers(1, 8))):
        data[i] = int(rng.integers(0, 256))
    return bytes(data)


def cut_out(rng, data):
    a, b = sorted(rng.integers(0, len(data), 2).tolist())
    return data[:a] + data[min(b, a + 500) :]


def doubled(rng, data):
    a, b = sorted(rng.integers(0, len(data), 2).tolist())
    return data[:a] + data[a : min(b, a + 500)] * 2 + data[b:]


def odd_number(rng, data):
    numbers = list(re.finditer(rb"-?\d+\.?\d*", data))
    found = numbers[int(rng.integers(len(numbers)))]
    return data[: found.start()] + ODD_NUMBERS[int(rng.integers(len(ODD_NUMBERS)))] + data[found.end() :]


def noise(rng, data):
    """Certainly no plan."""
    return rng.bytes(int(rng.integers(0, 3000)))


ANY = (truncated, flipped, cut_out, doubled, odd_number, noise)
CERTAIN = (truncated, noise)


def odd_value(rng, data):
    """One value of JSON, or one field of yaml, replaced, renamed or dropped."""
    data = copy.deepcopy(data)
    places = []

    def walk(node):
        for key in list(node) if isinstance(node, dict) else range(len(node)):
            places.append((node, key))
            if isinstance(node[key], (dict, list)):
                walk(node[key])

    walk(data)
    # The outermost places, which are few, as often as the others.
    node, key = (
        places[int(rng.integers(len(places)))]
        if rng.random() < 0.5
        else (data, list(data)[int(rng.integers(len(data)))])
    )
    choice = rng.integers(4)
    if choice == 0:
        del node[key]
    elif choice == 1 and isinstance(node, dict):
        node[str(key)[:-1]] = node.pop(key)
    else:
        node[key] = ODD_VALUES[int(rng.integers(len(ODD_VALUES)))]
    return data


def check(path, certain, **options):
    plan = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            plan = load_plan(path, **options)
        except InvalidFloorPlanError as error:
            message = str(error)
    if plan is None:
        assert str(path) in message
        assert "\n" not in message
        assert 5 < len(message.replace(str(path), "")) < 1500
        return
    assert not certain, f"{path} was taken for a plan"
    assert isinstance(plan, FloorPlan)
    assert plan.polygon.is_valid
    assert plan.area > 0


def as_text(data):
    return json.dumps(data).encode()


def cases(count):
    """(number, format) of so many damaged files of each format."""
    numbers = range(count)
    return [
        pytest.param(i, kind, id=f"{kind}-{i}")
        for kind in ("json", "geojson", "dxf", "svg", "map", "pgm", "png")
        for i in numbers
    ]


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    folder = tmp_path_factory.mktemp("originals")
    for suffix in (".json", ".geojson", ".svg", ".yaml"):
        save_plan(PLAN, folder / f"plan{suffix}")
    image = cv2.imread(str(folder / "plan.pgm"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(folder / "plan.png"), image)
    try:
        save_plan(PLAN, folder / "plan.dxf")
    except ImportError:
        (folder / "plan.dxf").write_bytes(b"")
    return {path.suffix: path.read_bytes() for path in folder.iterdir()}


def run(number, kind, originals, folder):
    rng = np.random.default_rng([number, sum(kind.encode())])
    if kind in ("dxf", "svg"):
        pytest.importorskip("ezdxf")
        pytest.importorskip("svgpathtools")
    path = folder / f"plan.{'yaml' if kind in ('map', 'pgm', 'png') else kind}"
    damage = ANY[int(rng.integers(len(ANY)))]
    certain = damage in CERTAIN
    if kind in ("json", "geojson") and rng.random() < 0.5:
        data = to_mapping(PLAN) if kind == "json" else to_geojson(PLAN)
        path.write_bytes(as_text(odd_value(rng, data)))
        certain = False
    elif kind in ("json", "geojson", "dxf", "svg"):
        path.write_bytes(damage(rng, originals[f".{kind}"]))
    elif kind == "map":
        (folder / "plan.pgm").write_bytes(originals[".pgm"])
        if rng.random() < 0.6:
            fields = odd_value(rng, yaml.safe_load(originals[".yaml"]))
            path.write_text(yaml.safe_dump(fields, allow_unicode=True), encoding="utf-8")
        else:
            path.write_bytes(damage(rng, originals[".yaml"]))
        certain = False  # a yaml may end anywhere behind its origin
    else:
        fields = yaml.safe_load(originals[".yaml"]) | {"image": f"plan.{kind}"}
        path.write_text(yaml.safe_dump(fields))
        data = originals[f".{kind}"]
        if kind == "pgm":  # the header is small: hit it as often as the body
            end = data.index(b"255\n") + 4
            data = damage(rng, data[:end]) + data[end:] if rng.random() < 0.5 else damage(rng, data)
            certain = damage is noise and not data.startswith(b"P")
        else:
            data = damage(rng, data)
            certain = data != originals[".png"]
        (folder / f"plan.{kind}").write_bytes(data)
    check(path, certain)


@pytest.mark.parametrize(("number", "kind"), cases(12))
def test_some_damaged_files(number, kind, originals, tmp_path):
    run(number, kind, originals, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(("number", "kind"), cases(200))
def test_many_damaged_files(number, kind, originals, tmp_path):
    run(number + 1000, kind, originals, tmp_path)


@pytest.mark.parametrize(
    "head",
    [b"P5 60000 60000 255\n", b"P5 1 1 99999\n", b"P5 0 5 255\n", b"P6 20000 20000 65535\n", b"P2 9999999 9999999 1\n"],
)
def test_headers_of_huge_images_take_no_memory(tmp_path, head):
    (tmp_path / "a.pgm").write_bytes(head)
    (tmp_path / "a.yaml").write_text("image: a.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n")
    with pytest.raises(InvalidFloorPlanError, match=r"a\.yaml: image .*a\.pgm: "):
        load_plan(tmp_path / "a.yaml")


def test_a_png_that_unfolds_to_gigabytes_is_refused_unread(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((20_000, 6_000), np.uint8))
    (tmp_path / "a.yaml").write_text("image: a.png\nresolution: 0.05\norigin: [0, 0, 0]\n")
    with pytest.raises(InvalidFloorPlanError, match=r"6000 x 20000 pixels, more than 100000000"):
        load_plan(tmp_path / "a.yaml")


def test_a_damaged_image_of_a_map_is_no_plan(tmp_path, originals):
    """Every byte of a png is under a checksum."""
    data = originals[".png"]
    (tmp_path / "a.yaml").write_text("image: a.png\nresolution: 0.05\norigin: [0, 0, 0]\n")
    for i in range(8, len(data), 97):
        (tmp_path / "a.png").write_bytes(data[:i] + bytes([data[i] ^ 16]) + data[i + 1 :])
        with pytest.raises(InvalidFloorPlanError, match="image"):
            load_plan(tmp_path / "a.yaml")
