"""Trajectories as hashes, for the tests of reproducibility; renews `golden_trajectories.json`.

    python tests/trajectories.py            compare with the golden trajectories
    python tests/trajectories.py --write    renew them

Renewing is refused while the version suffix of the environments' names is the same: whoever changes
trajectories raises it. Before a version is first released, `--same-version` allows it.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import polyexplore_gym  # noqa: F401  (registers the environments)
from polyexplore_gym.config import DriveConfig, EnvConfig, ExplorationConfig, PoseConfig
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.floorplan import suite

GOLDEN = Path(__file__).with_name("golden_trajectories.json")
DECISIONS = 10
FAMILIES = ("home", "office", "angled")
CONFIGS = {
    "kinematic": EnvConfig(drive=DriveConfig(mode="kinematic")),
    "physics": EnvConfig(pose=PoseConfig(mode="gaussian"), exploration=ExplorationConfig(placement="in_front")),
    "moving": EnvConfig(exploration=ExplorationConfig(scan_every=0.5, decide="settled")),
}
# 12 plans x 5 seeds; all configurations on every plan.
TASKS = [
    (family, plan, seed, tuple(CONFIGS)[(plan + seed) % 3])
    for family in FAMILIES
    for plan in range(4)
    for seed in range(5)
]
GOLDEN_TASKS = [(family, 7, seed, mode) for family in FAMILIES for seed, mode in enumerate(CONFIGS)]

Task = tuple[str, int, int, str]


class Digest:
    """Hashes of one trajectory: to the last bit, and of what holds on any machine."""

    def __init__(self) -> None:
        self.exact, self.rounded = hashlib.sha256(), hashlib.sha256()
        self.actions: list[int] = []
        self.distance = 0.0

    def add(self, action: int, observation: dict[str, np.ndarray], info: dict[str, Any], pose: np.ndarray) -> None:
        for key in sorted(observation):
            self.exact.update(key.encode() + observation[key].tobytes())
        numbers = [info["distance"], info["sim_time"], info["coverage"], *pose.tolist()]
        self.exact.update(repr((action, numbers, info["collisions"], info["path"])).encode())
        # Distance and position to 1 mm: libm and SIMD differ between machines in the last bits.
        millimetres = np.rint(1e3 * np.array([info["distance"], *pose[:2]])).astype(np.int64)
        self.rounded.update(repr((action, millimetres.tolist(), info["measurements"])).encode())
        self.actions.append(action)
        self.distance = info["distance"]

    def golden(self) -> dict[str, Any]:
        return {
            "hash": self.rounded.hexdigest(),
            "actions": " ".join(map(str, self.actions[1:])),
            "distance": round(self.distance, 3),
        }


def run(task: Task, env: PolyExploreEnv | None = None) -> Digest:
    """Play the first decisions of a task, at random among what is reachable."""
    family, plan, seed, mode = task
    env = PolyExploreEnv(config=CONFIGS[mode]) if env is None else env
    rng = np.random.default_rng(seed)
    digest = Digest()
    observation, info = env.reset(seed=seed, options={"plan": suite(f"{family}-validation").plan(plan)})
    digest.add(-1, observation, info, env.true_pose)
    for _ in range(DECISIONS):
        valid = np.flatnonzero(info["action_mask"])
        if not len(valid):
            break
        action = int(rng.choice(valid))
        observation, _, _, _, info = env.step(action)
        digest.add(action, observation, info, env.true_pose)
    return digest


def run_exact(task: Task) -> str:
    """The hash to the last bit; for worker processes."""
    return run(task).exact.hexdigest()


def version() -> str:
    """The version suffix of the registered environments."""
    suffixes = {name.rsplit("-", 1)[1] for name in gymnasium.registry if name.startswith("PolyExplore-")}
    if len(suffixes) != 1:
        raise SystemExit(f"the environments have the versions {sorted(suffixes)}: they change together")
    return suffixes.pop()


def golden() -> dict[str, Any]:
    """What belongs into the file."""
    trajectories = {" ".join(map(str, task)): run(task).golden() for task in GOLDEN_TASKS}
    return {"renew with": "python tests/trajectories.py --write", "version": version(), "trajectories": trajectories}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="renew the file")
    parser.add_argument("--same-version", action="store_true", help="renew it under the same version")
    parser.add_argument("--exact", type=int, metavar="WORKERS", help="print hashes to the last bit as JSON")
    options = parser.parse_args()
    if options.exact is not None:
        from joblib import Parallel, delayed

        json.dump(list(Parallel(options.exact)(delayed(run_exact)(task) for task in TASKS)), sys.stdout)
        return
    new = golden()
    old = json.loads(GOLDEN.read_text()) if GOLDEN.exists() else None
    if old == new:
        print("unchanged")
    elif not options.write:
        raise SystemExit("trajectories have changed" if old else f"{GOLDEN.name} is missing")
    elif old and old["version"] == new["version"] and not options.same_version:
        raise SystemExit(f"trajectories have changed: raise the version suffix -{new['version']} of the environments")
    else:
        GOLDEN.write_text(json.dumps(new, indent=1) + "\n")
        print(f"wrote {GOLDEN.name}")


if __name__ == "__main__":
    main()
