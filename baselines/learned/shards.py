"""Examples on disk: a folder of .npz files, each gathered on its own, so that many processes can."""

from __future__ import annotations

import itertools
import math
import os
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from baselines.learned.features import NODE, PAIR, WHOLE, Features
from baselines.learned.imitation import Example, examples
from baselines.learned.network import Network
from baselines.learned.rollouts import states
from baselines.learned.selector import Learned
from baselines.learned.settings import Stage, TrainConfig
from polyexplore_gym.errors import ResultsError
from polyexplore_gym.floorplan import suite


def plans(stage: Stage, rng: np.random.Generator) -> Iterator[Any]:
    """Plans of a stage without end: a suite is drawn, then a plan of it."""
    suites = [suite(name) for name in stage.names]
    while True:
        of = suites[int(rng.integers(len(suites)))]
        plan = of.plan(int(rng.integers(len(of))))
        if plan.area <= stage.largest:
            yield plan


def gather(config: TrainConfig, stage: int, network: Network, folder: Path, workers: int) -> Iterator[int]:
    """Gather what is missing of a stage; yields the number of states in each file as it gets there.

    Args:
        config: of the training.
        stage: index of the stage.
        network: the policy, in the episodes and in the roll-outs.
        folder: of the files.
        workers: processes; what is gathered does not depend on it.
    """
    from joblib import Parallel, delayed

    folder.mkdir(parents=True, exist_ok=True)
    size, total = config.rollouts.shard, config.stages[stage].states
    wanted = [(i, min(size, total - i * size)) for i in range(math.ceil(total / size))]
    missing = []
    for i, count in wanted:
        if shard_path(folder, stage, i).exists():
            yield count
        else:
            missing.append((i, count))
    if workers == 1:
        for i, count in missing:
            yield gather_shard(config, stage, i, count, network, folder)
    elif missing:
        parallel = Parallel(n_jobs=workers, return_as="generator_unordered", batch_size=1, pre_dispatch="2 * n_jobs")
        yield from parallel(delayed(gather_shard)(config, stage, i, n, network, folder) for i, n in missing)


def shard_path(folder: Path, stage: int, shard: int) -> Path:
    """Where a file is."""
    return folder / f"{stage}-{shard:05d}.npz"


def gather_shard(config: TrainConfig, stage: int, shard: int, count: int, network: Network, folder: Path) -> int:
    """Gather the states of one file and write it; returns their number."""
    import torch

    torch.set_num_threads(1)  # the processes have the cores among them
    rng = np.random.default_rng([config.seed, stage, shard])
    r = config.rollouts
    found = states(
        plans(config.stages[stage], rng),
        config.env,
        rng,
        base=Learned(network=network).choose,
        pairwise=True,
        tried=r.tried,
        per_episode=r.per_episode,
        wander=r.wander,
    )
    write_examples(shard_path(folder, stage, shard), examples(list(itertools.islice(found, count))))
    return count


def write_examples(path: Path, many: Sequence[Example]) -> None:
    """Write examples; the file is there whole or not at all."""
    sizes = np.array([len(e.features.slots) for e in many], np.int64)
    arrays = {
        "sizes": sizes,
        "tried": np.array([len(e.rows) for e in many], np.int64),
        "node": np.concatenate([e.features.node for e in many]),
        "pair": np.concatenate([e.features.pair.reshape(-1, PAIR) for e in many]),
        "whole": np.stack([e.features.whole for e in many]),
        "slots": np.concatenate([e.features.slots for e in many]),
        "rows": np.concatenate([e.rows for e in many]),
        "cost": np.concatenate([e.cost for e in many]),
        "group": np.array([e.group for e in many]),
    }
    fresh = path.with_name(f"{path.name}.{os.getpid()}.new")
    with fresh.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    os.replace(fresh, path)


def read_examples(path: Path) -> list[Example]:
    """The examples in a file.

    Raises:
        ResultsError: it cannot be read, is damaged or of another kind.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            a = {key: file[key] for key in file.files}
        sizes, tried = a["sizes"], a["tried"]
        if a["node"].shape[1] != NODE or a["pair"].shape[1] != PAIR or a["whole"].shape[1] != WHOLE:
            raise ValueError("made with other features")
        n, p, t = (np.concatenate(([0], np.cumsum(s))) for s in (sizes, sizes**2, tried))
        found = []
        for i, k in enumerate(sizes.tolist()):
            pair = a["pair"][p[i] : p[i + 1]].reshape(k, k, PAIR)
            seen = Features(a["node"][n[i] : n[i + 1]], pair, a["whole"][i], a["slots"][n[i] : n[i + 1]])
            rows, cost = a["rows"][t[i] : t[i + 1]], a["cost"][t[i] : t[i + 1]]
            found.append(Example(seen, rows, cost, str(a["group"][i])))
    except (OSError, ValueError, KeyError, IndexError, EOFError, zipfile.BadZipFile) as error:
        raise ResultsError(f"{path}: damaged, or not the examples of this version ({error}); delete it") from error
    return found
