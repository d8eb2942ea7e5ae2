"""Compare policies on the same plans, starts and noise, at stops and on the way; results are kept and gone on with.

python examples/06_evaluate.py
"""

from pathlib import Path

import numpy as np

from polyexplore_gym.config import EnvConfig, from_mapping
from polyexplore_gym.evaluation import Study, evaluate, name_policies, summarize, summary_text, write_tables
from polyexplore_gym.floorplan import suite

OUT = Path("results/example")

if __name__ == "__main__":
    study = Study(
        policies=name_policies(["nearest", "modified_sum", "utility:rate=0.1"]),
        plans=[suite("home-validation").plan(i) for i in range(3)],
        placements=("in_front",),
        sensing=("stops", "moving"),
        config=from_mapping(EnvConfig, {"drive": {"mode": "kinematic"}}),
    )
    records = evaluate(study, out=OUT, workers=1)  # again: only what is missing is played
    summary = summarize(records, np.random.default_rng(0), reference="nearest")
    print(summary_text(summary))
    print("written:", ", ".join(path.name for path in write_tables(summary, OUT)))
    longest = max(records, key=lambda record: record.distance)
    print(f"longest: {longest.plan}, {longest.policy}, {longest.distance:.1f} m, drives ended {dict(longest.ends)}")
