"""benchmarks/fuzz.py: its cases are legal, come back the same, and scale."""

import importlib.util
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from polyexplore_gym.config import EnvConfig, from_mapping

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def fuzz():
    sys.path.insert(0, str(FOLDER))  # it imports exact.py beside it
    try:
        spec = importlib.util.spec_from_file_location("fuzz_cases", FOLDER / "fuzz.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(FOLDER))
    return module


@pytest.mark.parametrize("first", range(0, 60, 20))
def test_cases_are_legal_and_come_back(fuzz, first):
    for number in range(first, first + 20):
        case, again = fuzz.case_of(number), fuzz.case_of(number)
        assert again.values == case.values
        assert again.plan == case.plan
        config = from_mapping(EnvConfig, case.values)
        case.plan.check_connected(config.robot.radius)
        if case.start is not None:
            case.plan.check_start(case.start, config.robot.radius)


def test_decisions_on_the_way_are_drawn_apart_from_all_else(fuzz, monkeypatch):
    cases = [fuzz.case_of(number) for number in range(40)]
    drawn = [case.values["exploration"] for case in cases]
    counts = Counter((e["decide"], e["scan_every"] > 0.0) for e in drawn)
    assert counts.keys() == {("arrival", False), ("arrival", True), ("settled", True), ("interval", True)}
    assert min(counts.values()) >= 4
    monkeypatch.setattr(fuzz, "_on_the_way", lambda rng, radius, every: {"decide": "arrival"})
    for case in cases:
        without = fuzz.case_of(case.number)
        assert (without.plan, without.criterion, without.start) == (case.plan, case.criterion, case.start)
        every = without.values["exploration"].pop("scan_every")
        assert every in (0.0, case.values["exploration"]["scan_every"])
        for section in ("sensor", "robot", "drive", "pose"):
            assert without.values[section] == case.values[section]
        assert without.values["exploration"] | case.values["exploration"] == case.values["exploration"]


def test_every_family_of_plans_is_drawn(fuzz):
    for family in fuzz.PLANS:
        plan = fuzz.plan_of(family, np.random.default_rng(5), 0.2, 5.0, family)
        assert plan.area > 20 * 0.2**2, family


def test_a_case_ends_and_is_judged(fuzz):
    number = next(n for n in range(200) if fuzz.case_of(n).size < 400 and fuzz.case_of(n).family == "pillars")
    case = fuzz.case_of(number)
    case.values["pose"]["mode"] = "exact"
    env, found, result = fuzz.run(case)
    assert result["case"] == number
    assert result["kind"] == ("complete" if found.complete else result["kind"])
    assert result["left"] == pytest.approx(found.area / found.limit, abs=1e-3)
    assert result["decisions"] <= env.config.max_decisions


def test_an_end_before_the_first_decision_is_a_finding(fuzz):
    case = next(c for c in map(fuzz.case_of, range(200)) if c.family == "rooms" and c.size > 600)
    env = fuzz.PolyExploreEnv(plan=case.plan, config={"robot": {"radius": case.values["robot"]["radius"]}})
    env.reset(seed=0)
    found = fuzz.exact.check(env)
    assert not found.complete
    assert fuzz._verdict(env, found, 0, {}).startswith("over at reset")
    assert fuzz._verdict(env, found, 1, {}).startswith("jump edge")


def test_a_scaled_case_is_the_same_case(fuzz):
    case = fuzz.case_of(3)
    large = fuzz.scaled(case, 4.0)
    assert large.size == pytest.approx(case.size)
    assert large.plan.area == pytest.approx(16.0 * case.plan.area)
    for section, name, power in (("sensor", "max_range", 1), ("sensor", "sigma_range", 1), ("robot", "max_speed", 1)):
        assert large.values[section][name] == 4.0**power * case.values[section][name]
    assert large.values["sensor"]["beams"] == case.values["sensor"]["beams"]
    back = fuzz.scaled(large, 0.25)
    np.testing.assert_array_equal(back.plan.exterior, case.plan.exterior)


@pytest.mark.parametrize("number", [1001, 1687])
def test_scans_on_the_way_do_not_whittle_an_opening_away(fuzz, number):
    """Past a corner each scan cuts a splinter off the opening behind it: 75 and 66 % were seen of these."""
    _, _, result = fuzz.run(fuzz.case_of(number))
    assert result["kind"] == "complete"
    assert result["seen"] > 99.0


def test_the_way_back_round_a_wall_end_is_found(fuzz):
    """With beams far apart the map has no way out of the doorway by which the robot came: only the way driven."""
    _, _, result = fuzz.run(fuzz.case_of(1615))
    assert result["kind"] == "complete"
    assert result["seen"] > 99.0


def test_crumbs_of_a_doorway_are_a_doorway(fuzz):
    """Scans on the way left four crumbs of it, half of its width: the room behind was lost, 74 % seen, complete."""
    _, _, result = fuzz.run(fuzz.case_of(2645))
    assert result["kind"] == "complete"
    assert result["seen"] > 98.0


def test_single_returns_do_not_close_a_doorway(fuzz):
    """Beams far apart see jambs as specks, as wide as they stand in the map by convention: 72 % were seen."""
    _, _, result = fuzz.run(fuzz.case_of(793))
    assert result["seen"] > 99.0
    assert result["left"] <= 1.0
