"""Generated plans and suites: valid, connected, plausible, and the same everywhere."""

import os
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
import shapely

from polyexplore_gym.floorplan import FAMILIES, building, generate, homes, list_suites, offices, suite, suites
from polyexplore_gym.floorplan.suites import CONTENT_HASHES, TEST_SEEDS, TRAIN_SEEDS, VALIDATION_SEEDS

LIMITS = {"home": ((30, 320), (24, 260)), "office": ((250, 3600), (120, 1000)), "angled": ((40, 2500), (30, 900))}
"""Free area, m2, and vertices."""


@pytest.mark.parametrize("family", FAMILIES)
def test_a_hundred_seeds_are_valid_and_connected(family):
    (least, most), (fewest, greatest) = LIMITS[family]
    hashes = set()
    for seed in range(100):
        plan = generate(family, seed)
        polygon = shapely.Polygon(plan.exterior, plan.holes)
        assert polygon.is_valid
        eroded = polygon.buffer(-0.30, quad_segs=32)
        assert eroded.geom_type == "Polygon", plan.name
        assert least <= plan.area <= most, plan.name
        assert fewest <= plan.n_vertices <= greatest, plan.name
        # Whole millimetres, from (1, 1) on.
        vertices = np.concatenate(plan.rings) * 1000
        np.testing.assert_allclose(vertices, np.rint(vertices), atol=1e-6)
        assert plan.bounds[:2] == (1.0, 1.0)
        plan.check_connected(0.25)
        plan.check_start(plan.sample_start(np.random.default_rng(seed), 0.25), 0.25)
        hashes.add(plan.content_hash)
    assert len(hashes) == 100


@pytest.mark.parametrize(("family", "module"), [("home", homes), ("office", offices)])
def test_doors_have_their_widths_and_stay_open(family, module, monkeypatch):
    """Every door is 0.8 to 1.6 m wide (a home's living area may open wider), and no obstacle stands in it."""
    widths, boxes, checked = [], [], []
    draw = suites._DRAW[family]

    def spied_draw(rng, name, meta):
        boxes.clear()
        return draw(rng, name, meta)

    def spied_door(rng, wall, width, thickness, *rest):
        box = building.place_door(rng, wall, width, thickness, *rest)
        low, high = (box[1], box[3]) if wall.vertical else (box[0], box[2])
        assert high - low == width
        assert wall.low < low
        assert high < wall.high
        widths.append(width)
        boxes.append(box)
        return box

    def spied_finish(free, obstacles, name, meta):
        plan = building.finish(free, obstacles, name, meta)
        if plan is not None:
            # From the builder's frame (mm) to the plan's, whose corner is (1, 1).
            doors = np.array(boxes) / 1000.0 + np.tile(1.0 - np.array(free.bounds[:2]) / 1000.0, 2)
            inside = plan.polygon.buffer(1e-6)
            assert shapely.covers(inside, shapely.box(*doors.T)).all(), name
            checked.append(name)
        return plan

    monkeypatch.setitem(suites._DRAW, family, spied_draw)
    monkeypatch.setattr(module, "place_door", spied_door)
    monkeypatch.setattr(module, "finish", spied_finish)
    generate.cache_clear()
    names = [generate(family, seed).name for seed in range(40)]
    generate.cache_clear()
    assert set(names) <= set(checked)
    assert len(widths) > 100
    assert min(widths) >= 800
    assert max(widths) <= (2800 if family == "home" else 1600)


@pytest.mark.parametrize("family", FAMILIES)
def test_same_in_another_process_with_another_hash_seed(family):
    code = "import sys; from polyexplore_gym.floorplan import generate\n"
    code += "for seed in range(5): print(generate(sys.argv[1], seed).content_hash)"
    expected = [generate(family, seed).content_hash for seed in range(5)]
    for hash_seed in ("0", "12345"):
        result = subprocess.run(
            [sys.executable, "-c", code, family],
            env={**os.environ, "PYTHONHASHSEED": hash_seed},
            capture_output=True,
            text=True,
            check=True,
        )
        assert result.stdout.split() == expected


def test_global_random_state_is_neither_read_nor_changed():
    np.random.seed(1)  # noqa: NPY002
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    first = generate("home", 77).content_hash
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002
    np.random.seed(2)  # noqa: NPY002
    generate.cache_clear()
    assert generate("home", 77).content_hash == first


@pytest.mark.parametrize(
    ("family", "seed"), [("castle", 0), ("home", -1), ("home", 1.0), ("home", "1"), ("home", True)]
)
def test_bad_family_or_seed(family, seed):
    with pytest.raises(ValueError, match=r"unknown family|must be an integer"):
        generate(family, seed)


def test_meta_tells_family_and_seed():
    plan = generate("angled", 8)
    assert (plan.name, plan.meta["family"], plan.meta["seed"]) == ("angled-8", "angled", 8)
    assert plan.meta["style"] in ("wings", "slanted", "arc")
    assert {generate("angled", seed).meta["style"] for seed in range(30)} == {"wings", "slanted", "arc"}


def test_angled_plans_are_not_rectilinear():
    for seed in range(20):
        ring = generate("angled", seed).exterior
        edge = np.roll(ring, -1, axis=0) - ring
        heading = np.degrees(np.arctan2(edge[:, 1], edge[:, 0])) % 90
        assert np.ptp(heading) > 5


def test_suites_and_their_sizes():
    assert set(list_suites()) == {
        f"{family}-{split}"
        for family in ("home", "office", "angled", "mixed")
        for split in ("train", "validation", "test")
    }
    sizes = {"train": 1000, "validation": 30, "test": 50}
    for name in list_suites():
        family, split = name.split("-")
        plans = suite(name)
        assert plans.name == name
        assert len(set(plans.plan_ids)) == len(plans)
        if family != "mixed":
            assert len(plans) == sizes[split]
        else:
            counts = {f: sum(i.startswith(f) for i in plans.plan_ids) for f in FAMILIES}
            assert len(set(counts.values())) == 1
            assert set(plans.plan_ids) <= {i for f in FAMILIES for i in suite(f"{f}-{split}").plan_ids}
    for name in ("home", "castle-test", "home-tests", ""):
        with pytest.raises(ValueError, match="unknown suite"):
            suite(name)


def test_splits_share_no_seed():
    ranges = {"train": TRAIN_SEEDS, "validation": VALIDATION_SEEDS, "test": TEST_SEEDS}
    edges = sorted((r.start, r.stop) for r in ranges.values())
    assert all(a[1] <= b[0] for a, b in pairwise(edges))
    for name in list_suites():
        seeds = [int(i.rsplit("-", 1)[1]) for i in suite(name).plan_ids]
        assert all(seed in ranges[name.split("-")[1]] for seed in seeds)


def test_suite_is_lazy_and_indexed():
    plans = suite("mixed-test")
    assert "content_hash" not in vars(plans)
    iterator = plans.plans()
    first = next(iterator)
    assert first == plans.plan(0)
    assert first.name == plans.plan_ids[0] == "home-2000000000"
    assert plans.plan(-1).name == plans.plan_ids[-1]
    with pytest.raises(IndexError):
        plans.plan(len(plans))


def _golden(names):
    return [n for n in list_suites() if n.endswith(names)]


@pytest.mark.parametrize("name", _golden(("-validation", "-test")))
def test_suites_are_the_published_ones(name):
    assert suite(name).content_hash == CONTENT_HASHES[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", _golden(("-train",)))
def test_training_suites_are_the_published_ones(name):
    assert suite(name).content_hash == CONTENT_HASHES[name]
