"""Bounds beside the results: their ratios by hand, on disk, and from the command to the tables and the page."""

import csv
import json

import numpy as np
import pytest

from polyexplore_gym.cli import main
from polyexplore_gym.errors import MissingDependencyError, ResultsError
from polyexplore_gym.evaluation import EpisodeRecord, read_records, summarize, summary_text
from polyexplore_gym.evaluation.bounds import BOUNDS, Bounds, find_bounds, over, read_bounds, write_bounds
from polyexplore_gym.floorplan import FloorPlan, save_plan


def record(policy: str, number: int, distance: float) -> EpisodeRecord:
    return EpisodeRecord(
        policy=policy,
        placement="midpoint",
        sensing="stops",
        plan=f"plan {number}",
        plan_hash=f"hash {number}",
        group=f"building {number}",
        stratum="",
        seed=0,
        drive="physics",
        status="complete",
        distance=distance,
        coverage=1.0,
        curve_distance=(0.0, distance),
        curve_coverage=(0.5, 1.0),
    )


@pytest.fixture
def bounds():
    found = {(f"hash {i}", 0): Bounds(lower=8.0 + i, sensing=10.0 + i, stops=12.0 + i) for i in range(4)}
    found["hash 4", 0] = Bounds(lower=0.0, sensing=0.0, stops=0.0)
    return found


def test_ratios_by_hand(bounds):
    records = [record("nearest", i, 20.0 + i) for i in range(5)] + [record("far", i, 30.0) for i in range(6)]
    assert over(records[0], bounds, "over_lower") == pytest.approx(2.5)
    assert over(records[4], bounds, "over_stops") is None  # all is seen from the start
    assert over(records[-1], bounds, "over_stops") is None  # no bound is known
    assert bounds["hash 0", 0].gap == pytest.approx(1.25)
    assert bounds["hash 4", 0].gap == 1.0
    summary = summarize(records, np.random.default_rng(0), bounds=bounds, resamples=200)
    nearest = next(row.metrics for row in summary.rows if row.policy == "nearest")
    assert nearest["over_stops"].pairs == 4
    assert nearest["over_stops"].mean.estimate == pytest.approx(np.mean([(20 + i) / (12 + i) for i in range(4)]))
    assert nearest["over_sensing"].mean.estimate == pytest.approx(np.mean([(20 + i) / (10 + i) for i in range(4)]))
    text = summary_text(summary)
    assert all(word in text for word in ("/stops", "/sensing", "/lower", "proven"))
    assert "/stops" not in summary_text(summarize(records, np.random.default_rng(0), resamples=200))


def test_on_disk(bounds, tmp_path):
    assert read_bounds(tmp_path) == {}
    path = write_bounds(tmp_path, bounds)
    assert read_bounds(tmp_path) == bounds
    text = path.read_text()
    for damaged in (text[:-20], "{}!", json.dumps([{"plan_hash": "x", "seed": 0}])):
        path.write_text(damaged)
        with pytest.raises(ResultsError, match=BOUNDS):
            read_bounds(tmp_path)
    with pytest.raises(ResultsError, match="cannot be written"):
        write_bounds(tmp_path / "nowhere", bounds)


def test_missing_solvers_are_told(monkeypatch, tmp_path):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingDependencyError, match=r"pip install .*oracle"):
        find_bounds([], [0], None, cache=tmp_path)


def test_from_the_command_to_the_page(tmp_path, capsys):
    pytest.importorskip("pyvrp")
    pytest.importorskip("highspy")
    outline = [(0, 0), (9, 0), (9, 4), (5, 4), (5, 5), (9, 5), (9, 9), (0, 9), (0, 5), (4, 5), (4, 4), (0, 4)]
    plan = FloorPlan.create(outline, name="two rooms")
    save_plan(plan, tmp_path / "plan.json")
    command = ["bench", "--plans", str(tmp_path / "plan.json"), "--policies", "nearest", "random", "--seeds", "2"]
    command += ["--drive", "kinematic", "--workers", "1", "--no-plots", "--out", str(tmp_path / "out")]
    command += ["--sensing", "stops", "--bounds", str(tmp_path / "references")]
    assert main(command) == 0
    printed = capsys.readouterr().out
    found = read_bounds(tmp_path / "out")
    assert set(found) == {(plan.content_hash, 0), (plan.content_hash, 1)}
    assert all(0.0 < b.lower <= b.sensing <= b.stops for b in found.values())
    records = read_records(tmp_path / "out")
    assert all(r.distance >= found[r.plan_hash, r.seed].lower for r in records if r.coverage == 1.0)
    with (tmp_path / "out" / "summary.csv").open() as file:
        rows = {(r["policy"], r["placement"]): r for r in csv.DictReader(file)}
    mean = np.mean(
        [
            r.distance / found[r.plan_hash, r.seed].stops
            for r in records
            if (r.policy, r.placement) == ("nearest", "midpoint")
        ]
    )
    assert float(rows["nearest", "midpoint"]["over_stops_mean"]) == pytest.approx(mean, rel=1e-5)
    assert f"{mean:.2f}" in printed
    assert main(["report", str(tmp_path / "out"), "--runs", "0"]) == 0
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Best possible" in page
    assert f"{found[plan.content_hash, 1].lower:.1f}" in page
