import csv
import dataclasses
import io

import numpy as np
import pytest
from fake_env import FakeEnv, Fussy, Stubborn, plan

from polyexplore_gym.errors import ResultsError
from polyexplore_gym.evaluation import (
    EpisodeRecord,
    Setting,
    Study,
    evaluate,
    name_policies,
    summarize,
    summary_text,
    write_tables,
)
from polyexplore_gym.evaluation.plots import coverage_figure, improvement_figure, profile_figure, ratio_figure, save
from polyexplore_gym.evaluation.summary import finished
from polyexplore_gym.evaluation.tables import format_table, summary_csv


def record(
    policy, number, distance, *, seed=0, placement="midpoint", sensing="stops", status="complete", group=None, **more
):
    return EpisodeRecord(
        policy=policy,
        placement=placement,
        sensing=sensing,
        plan=f"plan {number}",
        plan_hash=f"hash {number}",
        group=group or f"building {number}",
        stratum="",
        seed=seed,
        drive="physics",
        status=status,
        distance=distance,
        coverage=1.0,
        curve_distance=(0.0, distance / 2, distance),
        curve_coverage=(0.25, 0.5, 1.0),
        **{"sim_time": 2.0 * distance, **more},
    )


MIDPOINT, IN_FRONT = Setting("midpoint"), Setting("in_front")


def figures(records, **options):
    return summarize(records, np.random.default_rng(0), **{"resamples": 500, **options})


def test_means_and_ratios_by_hand():
    near, far = (10.0, 20.0, 40.0, 30.0), (20.0, 20.0, 20.0, 60.0)
    summary = figures(
        [record("far", i, d, distance_90=d / 2, measurements=4, timing={"act_mean": 0.002}) for i, d in enumerate(far)]
        + [record("nearest", i, d, distance_90=d if i else None, measurements=2) for i, d in enumerate(near)]
    )
    assert summary.reference == "nearest"
    assert [row.policy for row in summary.rows] == ["nearest", "far"]  # the shorter one first
    nearest, away = (row.metrics for row in summary.rows)
    assert nearest["distance"].mean.estimate == pytest.approx(25.0)
    assert nearest["distance"].iqm.estimate == pytest.approx(25.0)
    assert nearest["distance"].mean.low < 25.0 < nearest["distance"].mean.high
    assert away["distance"].mean.estimate == pytest.approx(30.0)
    assert away["distance"].iqm.estimate == pytest.approx(20.0)
    assert away["measurements"].mean.estimate == 4.0
    # Only three starts have the 90 % of both.
    assert (away["distance_90"].pairs, nearest["distance_90"].pairs) == (3, 3)
    assert away["distance_90"].mean.estimate == pytest.approx(50.0 / 3)
    # Horizons 20, 20, 40, 60; coverage 0.25 to the half, 0.5 to the end, then 1.
    areas = [(5 * 0.25 + 5 * 0.5 + 10) / 20, 0.375, 0.375, (15 * 0.25 + 15 * 0.5 + 30) / 60]
    assert nearest["auc"].mean.estimate == pytest.approx(np.mean(areas))
    (comparison,) = summary.against_reference
    assert (comparison.ours, comparison.theirs) == (("far", MIDPOINT), ("nearest", MIDPOINT))
    assert comparison.ratios == pytest.approx((2.0, 1.0, 0.5, 2.0))
    assert comparison.ratio.estimate == comparison.time.estimate == pytest.approx(2.0**0.25)
    assert comparison.improvement.estimate == pytest.approx((0 + 0.5 + 1 + 0) / 4)
    assert comparison.buildings == 4
    assert summary.between_settings == []


def test_only_starts_that_all_finished_are_compared():
    records = []
    for i in range(6):
        records += [
            record("nearest", i, 10.0),
            record("b", i, 20.0),
            record("broken", i, 1.0, status="failed", error="E"),
        ]
    records[0] = record("nearest", 0, 0.5, status="truncated")
    records[4] = record("b", 1, 0.5, status="failed", error="ValueError: no\nmore")
    summary = figures(records)
    rows = {row.policy: row for row in summary.rows}
    assert (rows["nearest"].complete, rows["nearest"].truncated, rows["nearest"].failed) == (5, 1, 0)
    assert (rows["b"].complete, rows["b"].truncated, rows["b"].failed) == (5, 0, 1)
    assert rows["nearest"].metrics["distance"].mean.estimate == 10.0
    assert rows["b"].metrics["distance"].mean.estimate == 20.0
    assert rows["b"].metrics["distance"].pairs == 4
    assert (rows["broken"].failed, rows["broken"].metrics) == (6, {})
    assert summary.against_reference[0].pairs == 4
    notes = "\n".join(summary.notes)
    assert "midpoint: compared on 4 of 6 starts" in notes
    assert "left out of the comparison, as nothing was finished: broken" in notes
    assert "b failed on plan 1 (seed 0): ValueError: no" in notes
    text = summary_text(summary)
    assert "5/6 (1 cut off)" in text
    assert "0/6 (6 failed)" in text


def test_settings_are_compared_apart():
    records = []
    for i in range(5):
        records += [record("nearest", i, 10.0 + i), record("b", i, 12.0 + i)]
        records += [record("nearest", i, 5.0 + i / 2, placement="in_front"), record("b", i, 24.0, placement="in_front")]
    summary = figures(records)
    assert [(c.ours, c.theirs) for c in summary.against_reference] == [
        (("b", MIDPOINT), ("nearest", MIDPOINT)),
        (("b", IN_FRONT), ("nearest", IN_FRONT)),
    ]
    between = {c.ours[0]: c for c in summary.between_settings}
    assert between["nearest"].ratio.estimate == pytest.approx(0.5)
    assert between["nearest"].theirs == ("nearest", MIDPOINT)
    assert between["b"].ratio.estimate > 1.5
    assert between["nearest"].improvement.estimate == 1.0


def test_settings_that_differ_in_one_factor_are_compared():
    length = {("midpoint", "stops"): 10.0, ("in_front", "stops"): 9.0, ("midpoint", "moving"): 7.0,
              ("in_front", "moving"): 5.4}  # fmt: skip
    records = [
        record("nearest", i, d + i, placement=placement, sensing=sensing, sim_time=3.0 * d * (sensing == "stops") + d)
        for i in range(4)
        for (placement, sensing), d in length.items()
    ]
    summary = figures(records)
    found = {(c.ours[1], c.theirs[1]): c for c in summary.between_settings}
    moving, in_front_moving = MIDPOINT._replace(sensing="moving"), IN_FRONT._replace(sensing="moving")
    assert list(found) == [
        (IN_FRONT, MIDPOINT),
        (in_front_moving, moving),
        (moving, MIDPOINT),
        (in_front_moving, IN_FRONT),
    ]
    by_hand = [(7.0 + i) / (10.0 + i) for i in range(4)]
    assert found[moving, MIDPOINT].ratios == pytest.approx(by_hand)
    assert found[moving, MIDPOINT].ratio.estimate == pytest.approx(np.exp(np.mean(np.log(by_hand))))
    assert found[moving, MIDPOINT].time.estimate == pytest.approx(0.7 / 4)
    assert found[in_front_moving, IN_FRONT].time.estimate == pytest.approx(0.6 / 4)
    assert [row.setting for row in summary.rows] == [MIDPOINT, IN_FRONT, moving, in_front_moving]
    text = summary_text(summary).splitlines()
    (line,) = [line for line in text if line.split("  ")[0] == "midpoint, moving" and "0.17 [" in line]
    assert line.split()[:5] == ["midpoint,", "moving", "nearest", "midpoint", "4"]
    assert "midpoint, moving: compared on 4 of 4 starts, those finished by all 1 policies" in text
    # A setting that is not there is not compared with.
    some = figures([r for r in records if r.setting in (MIDPOINT, in_front_moving)])
    assert some.between_settings == []
    assert [panel.get_title() for panel in coverage_figure(records).axes] == [
        "midpoint (4 starts)", "in_front (4 starts)", "midpoint, moving (4 starts)", "in_front, moving (4 starts)",
    ]  # fmt: skip
    labels = [tick.get_text() for tick in ratio_figure(summary).axes[0].get_yticklabels()]
    assert labels[2] == "nearest\nmidpoint, moving / midpoint"


def test_one_building_has_no_interval_and_no_test():
    summary = figures([record(p, i, d, group="b") for i in range(3) for p, d in (("nearest", 3.0), ("b", 4.0))])
    (comparison,) = summary.against_reference
    assert comparison.buildings == 1
    assert np.isnan(comparison.ratio.low)
    assert np.isnan(comparison.p)
    assert np.isnan(comparison.p_holm)
    assert "1.333" in summary_text(summary)


def test_runs_that_drove_nothing_are_ties():
    summary = figures([record(p, i, 0.0) for i in range(3) for p in ("nearest", "b")])
    assert summary.against_reference[0].ratio.estimate == 1.0
    assert summary.against_reference[0].p == 1.0


def test_no_records_and_no_reference():
    with pytest.raises(ResultsError, match="no records"):
        figures([])
    assert figures([record("mine", 0, 1.0), record("other", 0, 2.0)]).reference == "mine"


def test_a_reference_that_completed_nothing():
    records = [record("nearest", i, 1.0, status="truncated") for i in range(3)] + [
        record("b", i, 2.0) for i in range(3)
    ]
    summary = figures(records)
    assert summary.against_reference == []
    assert {row.policy: row.complete for row in summary.rows} == {"b": 3, "nearest": 0}
    summary_text(summary)
    coverage_figure(records)
    ratio_figure(summary)


@pytest.fixture(scope="module")
def records():
    study = Study(
        policies=name_policies(["nearest", "random", "largest", Fussy(), Stubborn()]),
        plans=[plan(i) for i in range(8)],
        placements=("midpoint", "in_front"),
        seeds=(0, 1),
    )
    return evaluate(study, progress=False, make_env=FakeEnv)


def test_tables_are_written_and_agree(records, tmp_path):
    summary = figures(records)
    paths = write_tables(summary, tmp_path)
    assert sorted(p.name for p in paths) == ["comparisons.csv", "summary.csv", "summary.md", "summary.txt"]
    rows = list(csv.DictReader(io.StringIO((tmp_path / "summary.csv").read_text())))
    assert len(rows) == 10
    for row, expected in zip(rows, summary.rows, strict=True):
        assert (row["policy"], row["placement"], row["sensing"]) == (expected.policy, *expected.setting)
        if expected.metrics:
            metric = expected.metrics["distance"]
            assert float(row["distance_mean"]) == pytest.approx(metric.mean.estimate, rel=1e-5)
            assert float(row["distance_iqm_low"]) == pytest.approx(metric.iqm.low, rel=1e-5)
    comparisons = list(csv.DictReader(io.StringIO((tmp_path / "comparisons.csv").read_text())))
    assert len(comparisons) == len(summary.against_reference) + len(summary.between_settings)
    for row, expected in zip(comparisons, [*summary.against_reference, *summary.between_settings], strict=True):
        assert (row["placement"], row["sensing"]) == expected.ours[1]
        assert (row["against_placement"], row["against_sensing"]) == expected.theirs[1]
        assert float(row["time_high"]) == pytest.approx(expected.time.high, rel=1e-5)
    with pytest.raises(ResultsError, match="cannot be written"):
        write_tables(summary, tmp_path / "nowhere")


def test_columns_line_up():
    text = format_table(["name", "n"], [["a", "1.5"], ["longer", "10.25"]])
    assert text == "name        n\n------  -----\na         1.5\nlonger  10.25"
    markdown = format_table(["name", "n"], [["a", "1.5"]], "markdown")
    assert markdown == "| name |   n |\n| ---- | --: |\n| a    | 1.5 |"


def test_the_summary_repeats(records):
    assert summary_text(figures(records)) == summary_text(figures(records))


def test_figures_show_all_policies(records, tmp_path):
    import matplotlib.image

    figure = coverage_figure(records)
    panel = figure.axes[0]
    lines = {line.get_label(): line for line in panel.get_lines()}
    assert set(lines) == {"nearest", "random", "largest", "fussy"}
    # At the reference's own distance it has seen everything.
    x, y = lines["nearest"].get_data()
    assert y[np.searchsorted(x, 1.0 + 1e-3)] == pytest.approx(100.0)
    assert (np.diff(y) >= -1e-9).all()
    summary = figures(records)
    forest = ratio_figure(summary)
    left, right = ([tick.get_text() for tick in panel.get_yticklabels()] for panel in forest.axes)
    assert (len(left), len(right)) == (len(summary.against_reference), len(summary.between_settings))
    for name, drawn in (("coverage.png", figure), ("ratios.png", forest)):
        picture = matplotlib.image.imread(save(drawn, tmp_path / name))
        assert picture.std() > 0.01
    with pytest.raises(ResultsError, match="cannot be written"):
        save(figure, tmp_path / "nowhere" / "x.png")


def test_performance_profiles_by_hand():
    records = []
    for i, (near, far) in enumerate(((10.0, 20.0), (30.0, 20.0), (10.0, 10.0), (10.0, 15.0))):
        records += [record("nearest", i, near), record("far", i, far)]
    records[7] = record("far", 3, 15.0, status="truncated")
    records.append(record("nearest", 4, 3.0))  # the other has not run there yet
    records += [record(p, 5, 3.0, status="failed", error="E") for p in ("nearest", "far")]
    (panel,) = profile_figure(records).axes
    assert panel.get_title() == "midpoint (4 starts)"
    lines = {line.get_label(): line.get_data() for line in panel.get_lines()}
    for policy, ratios in (("nearest", (1.0, 1.5, 1.0, 1.0)), ("far", (2.0, 1.0, 1.0, np.inf))):
        x, y = lines[policy]
        share = [100 * np.mean([r <= tau for r in ratios]) for tau in x]
        off = np.abs(np.array(share) - y) > 1e-9
        assert not off[np.abs(x[:, None] - [1.0, 1.5, 2.0]).min(axis=1) > 1e-6].any()
        assert y[0] == {"nearest": 75.0, "far": 50.0}[policy]
    # Nothing that can be compared.
    assert profile_figure([record("a", 0, 1.0, status="failed", error="E")]).axes[0].get_lines()[:] == []


def test_improvement_shows_every_comparison():
    records = [record(p, i, d + i) for i in range(4) for p, d in (("nearest", 5.0), ("b", 4.0), ("c", 6.0))]
    found = figures(records).against_reference
    (panel,) = improvement_figure(found, [c.ours[0] for c in found]).axes
    dots = {float(x[0]) for x, _ in (line.get_data() for line in panel.get_lines()) if len(x) == 1}
    assert dots == {0.0, 1.0}
    assert [tick.get_text() for tick in panel.get_yticklabels()] == ["b", "c"]


def test_ways_that_leave_jump_edges_are_compared_and_told():
    records = [record("nearest", i, 10.0) for i in range(4)] + [record("b", i, 20.0) for i in range(4)]
    left = {"unreached": 2, "unreached_length": 1.5, "given_up": 1, "given_up_length": 0.25}
    records[5] = record("b", 1, 20.0, status="unreached", **left)
    records[6] = record("b", 2, 40.0, status="unreached", unreached=1, unreached_length=1.0)
    short = dataclasses.replace(record("b", 3, 1.0, status="unreached", **left), coverage=0.9)
    records[7] = short
    assert finished(records) == [r for r in records if r is not short]
    summary = figures(records)
    row = next(row for row in summary.rows if row.policy == "b")
    assert (row.episodes, row.complete, row.unreached, row.short, row.truncated, row.failed) == (4, 1, 2, 1, 0, 0)
    assert summary.against_reference[0].ratios == pytest.approx((2.0, 2.0, 4.0))
    assert "2 episodes that are compared left jump edges: 3 (2.5 m) out of reach, 1 (0.2 m) given up" in "\n".join(
        summary.notes
    )
    assert "1/4 (2 unreached, 1 short)" in summary_text(summary)
    (_, line) = sorted(csv.DictReader(io.StringIO(summary_csv(summary))), key=lambda line: -float(line["complete"]))
    assert (line["complete"], line["unreached"], line["short"]) == ("1", "2", "1")
    # Curves and profiles are of what is compared.
    assert {line.get_label() for line in profile_figure(records).axes[0].get_lines()} == {"nearest", "b"}
    assert coverage_figure(records).axes[0].get_title() == "midpoint (3 starts)"


def test_giving_up_early_does_not_win():
    records = [record("nearest", i, 10.0) for i in range(4)] + [record("b", i, 20.0) for i in range(4)]
    early = dataclasses.replace(record("b", 1, 1.0), coverage=0.97)
    nearly = dataclasses.replace(record("b", 2, 20.0), coverage=0.985)
    records[5], records[6] = early, nearly
    assert finished(records) == [r for r in records if r is not early]
    summary = figures(records)
    rows = {row.policy: row for row in summary.rows}
    assert (rows["b"].complete, rows["b"].short, rows["nearest"].short) == (3, 1, 0)
    assert rows["b"].metrics["distance"].mean.estimate == 20.0
    assert rows["b"].metrics["coverage"].mean.estimate == pytest.approx((2 + 0.985) / 3)
    assert summary.against_reference[0].ratio.estimate == pytest.approx(2.0)
    assert "1 episodes ended having seen over 2 % less" in "\n".join(summary.notes)
    assert "3/4 (1 short)" in summary_text(summary)
