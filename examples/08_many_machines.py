"""The same study on a Ray cluster. Needs the extra "ray" on every machine; the records are those of one machine.

python examples/08_many_machines.py [ADDRESS]      ("auto", or host:port; without one Ray is started here)
"""

import sys

import numpy as np

from polyexplore_gym.evaluation import Study, evaluate, name_policies, summarize, summary_text
from polyexplore_gym.floorplan import suite

if __name__ == "__main__":
    study = Study(
        policies=name_policies(["nearest", "ekman_ratio"]),
        plans=[suite("home-validation").plan(i) for i in range(4)],
    )
    address = sys.argv[1] if len(sys.argv) > 1 else None
    # Policies travel by pickle: one of your own needs a module that all machines have.
    records = evaluate(study, out="results/cluster", workers=2, backend="ray", address=address)
    print(summary_text(summarize(records, np.random.default_rng(0))))
