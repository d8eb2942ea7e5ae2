"""Kinematic and physics drive explore alike: the total ways on real plans. Run with -m slow; prints the figures."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from polyexplore_gym.config import DriveConfig, EnvConfig
from polyexplore_gym.evaluation import EpisodeRecord, Study, evaluate
from polyexplore_gym.floorplan import load_plan

DATA = Path(os.environ.get("POLYEXPLORE_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
NAMES = (
    "amrl_ase4",
    "apartments_mlstruct_966",
    "home_giraff_ex1",
    "home_rrce_4",
    "house_he_65043d7a",
    "house_vimantic_23",
    "ipa_office_b_furn",
    "office_chewlane",
)
PATHS = [path for name in NAMES if (path := DATA / "floorplans" / f"{name}.json").exists()]
BAND = (0.9, 1.1)
"""Kinematic over physics. A bump stops the modes at different points, after which their ways part."""


def explore(mode: str) -> list[EpisodeRecord]:
    config = EnvConfig(drive=DriveConfig(mode=mode))
    plans = [load_plan(path) for path in PATHS]
    return evaluate(
        Study(policies={"nearest": "nearest"}, plans=plans, seeds=(0, 1), config=config), workers=1, progress=False
    )


@pytest.mark.slow
@pytest.mark.skipif(not PATHS, reason="no shared floor plans beside the checkout or in POLYEXPLORE_DATA")
def test_kinematic_against_physics(capsys):
    kinematic, physics = explore("kinematic"), explore("physics")
    assert all(record.ended for record in (*kinematic, *physics))
    lines = ["", "plan, seed: kinematic, physics (m), ratio; bumps; coverage %"]
    for k, p in zip(kinematic, physics, strict=True):
        lines.append(
            f"{k.plan}, {k.seed}: {k.distance:.1f}, {p.distance:.1f}, {k.distance / p.distance:.3f}; "
            f"{k.collisions}, {p.collisions}; {100 * k.coverage:.2f}, {100 * p.coverage:.2f}"
        )
    total = [sum(record.distance for record in records) for records in (kinematic, physics)]
    lines.append(f"{len(PATHS)} plans, {len(kinematic)} episodes: {total[0]:.0f}, {total[1]:.0f}, "
                 f"{total[0] / total[1]:.3f}")  # fmt: skip
    with capsys.disabled():
        print("\n".join(lines))
    assert BAND[0] < total[0] / total[1] < BAND[1]
    for k, p in zip(kinematic, physics, strict=True):
        assert k.coverage == pytest.approx(p.coverage, abs=0.02)
