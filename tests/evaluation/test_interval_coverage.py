"""The simulation of benchmarks/interval_coverage.py, shortened."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

PATH = Path(__file__).resolve().parents[2] / "benchmarks" / "interval_coverage.py"


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("interval_coverage", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules["interval_coverage"] = module
    spec.loader.exec_module(module)
    return module


def test_the_truth_is_that_of_many_plans(script):
    design = [([1] * 1200, 3.0, 0.5), ([1] * 600, 4.0, 0.5)]
    experiment = script.Simulated(design, np.random.default_rng(0)).draw(np.random.default_rng(1))
    for figure in script.FIGURES:
        interval = script.interval(experiment, figure, np.random.default_rng(2))
        assert interval.estimate == pytest.approx(experiment.truth[figure], rel=0.06)


def test_percentiles_are_those_of_scipy(script):
    values = np.random.default_rng(0).lognormal(size=30)
    names = [str(i) for i in range(30)]
    ours = script.percentiles(values, names, [""] * 30, np.random.default_rng(1), np.mean, resamples=4000)
    theirs = scipy.stats.bootstrap(
        (values,), np.mean, n_resamples=4000, method="percentile", rng=np.random.default_rng(2)
    ).confidence_interval
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high), abs=0.05 * (theirs.high - theirs.low))


@pytest.mark.slow
@pytest.mark.parametrize("design", ["18", "18, 3 starts", "10"])
def test_95_percent_intervals_hold_the_truth(script, design):
    world = script.Simulated(script.DESIGNS[design], np.random.default_rng(0))
    for figure in script.FIGURES:
        found = script.coverage(world, figure, 600, np.random.default_rng(1))
        # 93 to 97 %, and three standard deviations of 600 experiments.
        assert 0.93 - 0.027 <= found["held"] <= 0.97 + 0.027, figure
