"""All real plans at hand load and suit the robot. Skipped where the data are absent."""

import math
import os
from pathlib import Path

import numpy as np
import pytest
import shapely

from polyexplore_gym.floorplan import load_plan, save_plan

DATA = Path(os.environ.get("POLYEXPLORE_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")
PLANS = sorted((DATA / "floorplans").glob("*.json"))
pytestmark = pytest.mark.skipif(not PLANS, reason="no shared floor plans beside the checkout or in POLYEXPLORE_DATA")


@pytest.mark.parametrize("path", PLANS, ids=lambda p: p.stem)
def test_real_plan(path, tmp_path):
    plan = load_plan(path)
    assert plan.area == pytest.approx(plan.meta["area_free"], rel=0.01)
    assert plan.n_vertices == plan.meta["n_vertices"]
    assert len(plan.holes) == plan.meta["n_holes"]
    assert plan.free_space(0.25).area == pytest.approx(plan.meta["area_eroded_025"], rel=0.01, abs=0.1)
    plan.check_connected(0.25)
    plan.check_connected(0.295)
    start = plan.sample_start(np.random.default_rng(0), 0.25)
    plan.check_start(start, 0.25)
    assert shapely.Polygon(plan.exterior, plan.holes).boundary.distance(shapely.Point(start[:2])) >= 0.25
    assert math.isfinite(start[2])
    for suffix in (".json", ".geojson"):
        save_plan(plan, tmp_path / f"copy{suffix}")
        assert load_plan(tmp_path / f"copy{suffix}") == plan
