"""Training runs: a folder each, and the same command goes on where the last one stopped.

Everything is made of parts that depend on the configuration and on parts before them, and on nothing else: files of
examples, epochs of a regression, blocks of reinforcement learning, validations. Each is on the disk when it is done.
A run that was killed does the part again that it was in, and ends with the weights that it would have ended with.

In the folder: config.json, progress.jsonl (a line for each validation), examples/, tensorboard/, checkpoint.pt (weights
and optimizer of the part at work), stage-N.safetensors (after the regression of stage N) and model.safetensors, the
network that was best on the validation plans.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import pickle
import time
import zipfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tqdm import tqdm

from baselines.learned import model_files
from baselines.learned.imitation import Example, Fit
from baselines.learned.network import Network
from baselines.learned.rollouts import Choose, nearest
from baselines.learned.selector import Learned
from baselines.learned.settings import TrainConfig
from baselines.learned.shards import gather, read_examples, shard_path
from polyexplore_gym.config import EnvConfig, to_mapping
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.errors import InvalidConfigError, ResultsError
from polyexplore_gym.floorplan import suite

if TYPE_CHECKING:
    from baselines.learned.ppo import Reinforcement

BEST = "model.safetensors"
"""The network that was best on the validation plans, in the folder of a run."""


def train(config: TrainConfig, out: Path, *, workers: int = 1, progress: bool = True) -> Path:
    """Run, or go on with, a training; returns the path of the best model.

    Args:
        config: what to do.
        out: folder of the run.
        workers: processes that play; the result does not depend on it.
        progress: show bars.

    Raises:
        InvalidConfigError: the folder belongs to another run.
        ResultsError: something in the folder is damaged.
    """
    if workers < 1:
        raise InvalidConfigError(f"workers = {workers}: must be at least 1")
    run = _Run(config, out, workers, progress)
    try:
        network = run.untrained()
        if config.method != "reinforcement":
            network = run.imitate(network)
        if config.method != "imitation":
            run.reinforce(network)
    finally:
        run.close()
    return out / BEST


def distances(choose: Choose, config: EnvConfig, name: str, index: int) -> float:
    """Metres driven on a plan of a suite, from the start with seed 0."""
    torch.set_num_threads(1)
    env = PolyExploreEnv(config=config)
    seen, info = env.reset(seed=0, options={"plan": suite(name).plan(index)})
    over = not seen["action_mask"].any()
    while not over:
        seen, _, terminated, truncated, info = env.step(choose([seen])[0])
        over = terminated or truncated
    return float(info["distance"])


class _Run:
    """A run and its folder."""

    def __init__(self, config: TrainConfig, out: Path, workers: int, progress: bool) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self.config, self.out, self.workers, self.progress = config, out, workers, progress
        self.states = 0
        self._open()
        self.lines = _read_lines(out / "progress.jsonl")
        self.spent = max((line["seconds"] for line in self.lines), default=0.0)
        self.checkpoint = self._read_checkpoint()
        self.spent = max(self.spent, self.checkpoint.get("seconds", 0.0))
        self.since = time.monotonic()
        self.board = SummaryWriter(str(out / "tensorboard"))

    def untrained(self) -> Network:
        """The network to start from."""
        torch.manual_seed(self.config.seed)
        network = Network(self.config.network).eval()
        self.validate("start", network, 0)
        return network

    def imitate(self, network: Network) -> Network:
        """Stage by stage: gather with the network so far, fit a new one to all there is."""
        many: list[Example] = []
        for stage, of in enumerate(self.config.stages):
            path = self.out / f"stage-{stage}.safetensors"
            folder = self.out / "examples"
            with self._bar(of.states, f"stage {stage + 1}: states", "state") as bar:
                for count in gather(self.config, stage, network, folder, self.workers):
                    bar.update(count)
            for i in range(math.ceil(of.states / self.config.rollouts.shard)):
                many += read_examples(shard_path(folder, stage, i))
            self.states += of.states
            if path.exists():
                network, _ = model_files.load_model(path)
            else:
                network = self._fit(stage, many)
                model_files.save_model(path, network, self._about())
            self.validate(f"stage {stage + 1}", network, 0)
        return network

    def reinforce(self, network: Network) -> None:
        """Stage by stage: blocks of MaskablePPO."""
        from baselines.learned.ppo import Reinforcement

        c = self.config.ppo
        learner = Reinforcement(self.config, network, self.workers)
        try:
            wanted = [of for of in self.config.stages for _ in range(math.ceil(of.steps / c.block))]
            if self.checkpoint.get("part") == "blocks":
                done = self.checkpoint["state"]["blocks"]
                learner.restore(self.checkpoint["state"], wanted[min(done, len(wanted) - 1)])
                self._validate_block(learner, len(wanted))  # which it may have been killed in
            with self._bar(len(wanted) * c.block, "reinforcement", "decision", learner.steps) as bar:
                for block in range(learner.blocks, len(wanted)):
                    figures = learner.block(wanted[block], partial(_move, bar, learner.steps))
                    for name, value in figures.items():
                        self.board.add_scalar(name.replace("train/", "reinforcement/"), value, learner.steps)
                    self._save_checkpoint("blocks", learner.state())
                    self._validate_block(learner, len(wanted))
        finally:
            learner.close()

    def _validate_block(self, learner: Reinforcement, last: int) -> None:
        done = learner.blocks
        if done % self.config.validation.blocks == 0 or done == last:
            self.validate(f"block {done}", learner.network, learner.steps)

    def validate(self, part: str, network: Network, steps: int) -> None:
        """Try the network on the validation plans, unless it was; keep it if it is the best so far."""
        if any(line["part"] == part for line in self.lines):
            return
        before = self._seconds()  # watching is not training
        ours = self._distances(part, Learned(network=network).choose)
        theirs = np.array(self._nearest())
        ratio = float(np.exp(np.mean(np.log(ours / theirs))))
        line = {
            "part": part,
            "states": self.states,
            "steps": steps,
            "seconds": before,
            "ratio": ratio,
            "distance": float(ours.mean()),
        }
        best = min((line["ratio"] for line in self.lines), default=math.inf)
        if ratio < best:
            model_files.save_model(self.out / BEST, network.eval(), self._about(line))
        with (self.out / "progress.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
        self.lines.append(line)
        self.since, self.spent = time.monotonic(), before
        for name in ("ratio", "distance"):
            self.board.add_scalar(f"validation/{name}", line[name], self.states + steps)
        self.board.flush()
        tqdm.write(f"{part}: {ratio:.3f} times the distance of nearest on the validation plans")

    def close(self) -> None:
        """Close what is open."""
        self.board.close()

    def _fit(self, stage: int, many: Sequence[Example]) -> Network:
        config = self.config.fit
        torch.manual_seed(self.config.seed)
        network = Network(self.config.network)
        entropy = int(np.random.SeedSequence([self.config.seed, 0, stage]).generate_state(1)[0])
        fit = Fit(network, many, config, entropy)
        if self.checkpoint.get("part") == f"fit {stage}":
            fit.restore(self.checkpoint["state"])
        with self._bar(config.epochs, f"stage {stage + 1}: regression", "epoch", fit.done) as bar:
            while fit.done < config.epochs:
                loss = fit.epoch()
                self.board.add_scalar(f"imitation/loss of stage {stage + 1}", loss, fit.done)
                self._save_checkpoint(f"fit {stage}", fit.state())
                bar.set_postfix(loss=f"{loss:.4f}", refresh=False)
                bar.update()
        return network.eval()

    def _distances(self, part: str, choose: Choose) -> np.ndarray:
        from joblib import Parallel, delayed

        v = self.config.validation
        tasks = [(name, i) for name in v.names for i in range(v.first)]
        found = Parallel(n_jobs=self.workers, return_as="generator", batch_size=1)(
            delayed(distances)(choose, self.config.env, name, i) for name, i in tasks
        )
        with self._bar(len(tasks), f"{part}: validation", "plan") as bar:
            values = []
            for value in found:
                values.append(value)
                bar.update()
        return np.array(values)

    def _nearest(self) -> list[float]:
        path = self.out / "nearest.json"
        if not path.exists():
            _write(path, json.dumps(self._distances("nearest", nearest).tolist()).encode())
        try:
            return [float(value) for value in json.loads(path.read_text(encoding="utf-8"))]
        except (OSError, ValueError, TypeError) as error:
            raise ResultsError(f"{path}: damaged ({error}); delete it") from error

    def _about(self, line: dict[str, Any] | None = None) -> dict[str, Any]:
        return {
            "algorithm": {
                "imitation": "regression on roll-outs",
                "reinforcement": "MaskablePPO",
                "both": "regression on roll-outs, then MaskablePPO",
            }[self.config.method],
            "suites": sorted({name for stage in self.config.stages for name in stage.names}),
            "seed": self.config.seed,
            "training": {"states": self.states, "seconds": round(self._seconds(), 1), "workers": self.workers},
            "results": {} if line is None else {"validation": self.config.validation.suites, **line},
        }

    def _seconds(self) -> float:
        return self.spent + time.monotonic() - self.since

    def _bar(self, total: int, text: str, unit: str, done: int = 0) -> Any:
        return tqdm(total=total, initial=done, desc=text, unit=unit, disable=not self.progress, dynamic_ncols=True)

    def _open(self) -> None:
        """Make the folder, or see that it is of the same run."""
        path = self.out / "config.json"
        # A tuple comes back as a list.
        ours = json.loads(json.dumps(to_mapping(self.config)))
        try:
            self.out.mkdir(parents=True, exist_ok=True)
            if not path.exists():
                if any(self.out.iterdir()):
                    raise InvalidConfigError(f"{self.out}: not empty, and not the folder of a training")
                _write(path, (json.dumps(ours, indent=2) + "\n").encode())
                return
            theirs = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            if isinstance(error, InvalidConfigError):
                raise
            raise ResultsError(f"{path}: cannot be used: {error}") from error
        if theirs != ours:
            field = next(f.name for f in dataclasses.fields(TrainConfig) if theirs.get(f.name) != ours[f.name])
            raise InvalidConfigError(f"{self.out}: holds a training with another {field}; choose another folder")

    def _save_checkpoint(self, part: str, state: dict[str, Any]) -> None:
        self.checkpoint = {"part": part, "state": state, "seconds": self._seconds()}
        fresh = self.out / "checkpoint.pt.new"
        torch.save(self.checkpoint, fresh)
        os.replace(fresh, self.out / "checkpoint.pt")

    def _read_checkpoint(self) -> dict[str, Any]:
        path = self.out / "checkpoint.pt"
        if not path.exists():
            return {}
        try:
            found = torch.load(path, weights_only=True)  # which runs no code
        except (OSError, RuntimeError, EOFError, pickle.UnpicklingError, zipfile.BadZipFile, ValueError) as error:
            raise ResultsError(f"{path}: damaged ({str(error).splitlines()[0]}); delete it") from error
        if not isinstance(found, dict) or not {"part", "state", "seconds"} <= set(found):
            raise ResultsError(f"{path}: not a checkpoint; delete it")
        return found


def _read_lines(path: Path) -> list[dict[str, Any]]:
    """The validations so far; a last line that was not finished is cut off."""
    if not path.exists():
        return []
    text = path.read_bytes()
    whole = text[: text.rfind(b"\n") + 1]
    if whole != text:
        _write(path, whole)
    try:
        lines = [json.loads(line) for line in whole.decode("utf-8").splitlines()]
        return [{**line, "part": str(line["part"]), "ratio": float(line["ratio"])} for line in lines]
    except (ValueError, KeyError, TypeError) as error:
        raise ResultsError(f"{path}: damaged ({error})") from error


def _move(bar: Any, before: int, played: int) -> None:
    bar.update(before + played - bar.n)


def _write(path: Path, data: bytes) -> None:
    fresh = path.with_name(path.name + ".new")
    fresh.write_bytes(data)
    os.replace(fresh, path)
