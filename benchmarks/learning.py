"""Three ways to train a selector, each about half an hour of two cores or less, and what they reach.

    python benchmarks/learning.py [--methods imitation reinforcement both] [--seed 0] [--workers 2]
                                  [--out results/learning] [--figure FILE]

Trains the network of `learned` by regression on roll-outs, by MaskablePPO alone, and by the one and then the other
(half of each), over the same curriculum from homes to offices. The figure shows the distance
on 60 validation plans over that of `nearest`, after so many minutes of one core (watching not counted). The table says
what each method's best network reaches on the suites for tests, with 95 % intervals over buildings. A run that was
stopped goes on where it was.
"""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from look_ahead import plan_sets, rows

from baselines import make_policy
from baselines.learned.imitation import FitConfig
from baselines.learned.settings import CURRICULUM, Method, TrainConfig, ValidationConfig
from baselines.learned.training import train
from polyexplore_gym.config import DriveConfig, EnvConfig
from polyexplore_gym.evaluation import PolicySpec, Study, evaluate, name_policies
from polyexplore_gym.evaluation.tables import format_table

NAMES = {"imitation": "imitation of roll-outs", "reinforcement": "MaskablePPO", "both": "imitation, then MaskablePPO"}


def settings(method: Method, seed: int) -> TrainConfig:
    """The defaults, with half of each part where a method has two."""
    share = 2 if method == "both" else 1
    stages = tuple(replace(s, states=s.states // share, steps=s.steps // share) for s in CURRICULUM)
    validation = ValidationConfig(first=30)
    return TrainConfig(method=method, seed=seed, stages=stages, fit=FitConfig(epochs=15), validation=validation)


def curve(out: Path, method: str, workers: int) -> tuple[np.ndarray, np.ndarray]:
    """Minutes of one core (n,) and the ratio to `nearest` (n,) on the validation plans."""
    lines: list[dict[str, Any]] = [
        json.loads(line) for line in (out / method / "progress.jsonl").read_text().splitlines()
    ]
    return np.array([line["seconds"] for line in lines]) * workers / 60.0, np.array([line["ratio"] for line in lines])


def draw(curves: dict[str, tuple[np.ndarray, np.ndarray]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 3.6), layout="constrained")
    panel = figure.subplots()
    for (method, (minutes, ratio)), color, marker in zip(curves.items(), ("C0", "C1", "C2"), "o^s", strict=False):
        panel.plot(minutes, ratio, marker=marker, markersize=4, linewidth=1.6, color=color, label=NAMES[method])
    panel.axhline(1.0, color="0.5", linewidth=1.0)
    panel.axhline(0.95, color="0.5", linewidth=1.0, linestyle=":")
    panel.annotate("nearest", (1.0, 1.0), xycoords=("axes fraction", "data"), ha="right", va="bottom", color="0.4")
    panel.annotate("5 % shorter", (1.0, 0.95), xycoords=("axes fraction", "data"), ha="right", va="bottom", color="0.4")
    panel.set(xlabel="minutes of training, of one core", ylabel="distance / nearest\n(60 validation plans)")
    panel.set_xlim(left=0.0)
    figure.legend(loc="outside upper center", ncols=3, frameon=False)
    for side in ("top", "right"):
        panel.spines[side].set_visible(False)
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", nargs="+", choices=get_args(Method), default=list(get_args(Method)))
    parser.add_argument("--seed", type=int, default=0, help="of the training")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--out", type=Path, default=Path("results/learning"), help="folder of the results")
    parser.add_argument("--figure", type=Path, help="where to draw the curves (default: learning.png in the folder)")
    options = parser.parse_args()
    policies: dict[str, PolicySpec] = dict(name_policies(["nearest", "tour"]))
    for method in options.methods:
        best = train(settings(method, options.seed), options.out / method, workers=options.workers)
        policies[method] = make_policy("learned", model=best)
    draw(
        {m: curve(options.out, m, options.workers) for m in options.methods},
        options.figure or options.out / "learning.png",
    )
    table: list[list[str]] = []
    for name, plans in plan_sets(None, 0.0, None).items():
        print(f"{name}: {len(plans)} plans", flush=True)
        config = EnvConfig(drive=DriveConfig(mode="kinematic"))
        study = Study(policies=policies, plans=plans, placements=("in_front",), seeds=range(1), config=config)
        records = evaluate(study, out=options.out / "test" / name, workers=options.workers)
        table += [row[:6] for row in rows(name, records, np.random.default_rng(0))[0]]
    header = ("plans", "selector", "starts", "distance / nearest", "of the means", "P(shorter)")
    print(f"\n{format_table(header, table, 'markdown')}")


if __name__ == "__main__":
    main()
