"""Episodes of a policy as a Minari data set, for offline learning: what was seen, chosen and earned at each decision.

Format: https://minari.farama.org (HDF5, one group an episode). Written episode by episode beside its place and moved
there when it is whole.
"""

from __future__ import annotations

import itertools
import os
import re
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium import spaces

import polyexplore_gym
from polyexplore_gym.config import EnvConfig, to_mapping
from polyexplore_gym.errors import InvalidConfigError, ResultsError
from polyexplore_gym.evaluation.episode import policy_rng
from polyexplore_gym.evaluation.policy import PolicySpec, load_policy, policy_label
from polyexplore_gym.optional import require

OBSERVATIONS = ("dict", "scaled", "flat", "graph", "grid")
"""What is kept of what was seen: the environment's own observation, or that of one of `polyexplore_gym.wrappers`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """What is recorded: one policy on every plan from every seed."""

    policy: PolicySpec
    """Who chooses, from the environment's own observation."""
    plans: Sequence[Any]
    """`FloorPlan`s."""
    seeds: Sequence[int] = (0,)
    """Seeds of the environment: each is one start and one stream of noise on every plan."""
    config: EnvConfig = field(default_factory=EnvConfig)
    """The environment; all but "dict" need `observation.relative`."""
    observation: str = "dict"
    """One of `OBSERVATIONS`."""

    def __post_init__(self) -> None:
        if self.observation not in OBSERVATIONS:
            raise InvalidConfigError(f"observation = {self.observation!r}: must be one of {', '.join(OBSERVATIONS)}")
        for name in ("plans", "seeds"):
            if len(getattr(self, name)) == 0:
                raise InvalidConfigError(f"recording.{name}: is empty")


def make_env(recording: Recording) -> gymnasium.Env:
    """The environment that is recorded; every reset names its plan."""
    from polyexplore_gym import wrappers

    name = next(name for name in gymnasium.registry if name.startswith("PolyExplore-Plan-"))
    env = gymnasium.make(name, config=to_mapping(recording.config), disable_env_checker=True)
    kinds = {"scaled": wrappers.Scaled, "flat": wrappers.Flat, "graph": wrappers.Graph, "grid": wrappers.GridImage}
    return env if recording.observation == "dict" else kinds[recording.observation](env)


def play(recording: Recording, plan: Any, seed: int) -> dict[str, Any]:
    """One episode of T decisions.

    Returns `observations` (T + 1 of them), `actions`, `rewards`, `terminations`, `truncations` (T) and `infos` (T + 1:
    `distance` in m, `coverage`, `action_mask`) as Minari wants them, and `about`: plan, hash, seed, policy and status.
    """
    env, policy = make_env(recording), load_policy(recording.policy)
    rng, forget = policy_rng(seed, plan.content_hash), getattr(policy, "reset", None)
    if callable(forget):
        forget()
    seen, info = env.reset(seed=seed, options={"plan": plan})
    kept: dict[str, list[Any]] = {"actions": [], "rewards": [], "terminations": [], "truncations": []}
    views, infos, over = [seen], [info], not info["action_mask"].any()
    while not over:
        # Policies know the map frame, whatever is kept.
        known = env.unwrapped.explorer.observation(relative=False)  # type: ignore[attr-defined]
        action = int(policy.act(known, info, rng))
        seen, reward, terminated, truncated, info = env.step(action)
        for name, value in zip(kept, (action, reward, terminated, truncated), strict=True):
            kept[name].append(value)
        views.append(seen)
        infos.append(info)
        over = terminated or truncated
    env.close()
    is_dict = isinstance(env.observation_space, spaces.Dict)
    return {
        **kept,
        "observations": {key: [view[key] for view in views] for key in views[0]} if is_dict else views,
        "infos": {key: [told[key] for told in infos] for key in ("distance", "coverage", "action_mask")},
        "about": {
            "plan": plan.name,
            "plan_hash": plan.content_hash,
            "seed": seed,
            "policy": policy_label(recording.policy),
            "status": info["outcome"]["status"],
        },
    }


def record(
    recording: Recording,
    root: str | Path,
    name: str,
    *,
    workers: int = 1,
    description: str = "",
    track: Callable[[Iterable[Any], int], Iterable[Any]] = lambda episodes, total: episodes,
) -> Path:
    """Play, and write the data set `name` under the folder `root`; the same for any number of workers.

    A plan that is seen whole from the start gives no episode: Minari knows none without a step.

    Args:
        recording: what to play.
        root: folder of data sets, Minari's MINARI_DATASETS_PATH.
        name: identity, as in "polyexplore/home-nearest-v0".
        workers: processes.
        description: for the metadata.
        track: wraps the episodes (their number given), to show progress.

    Returns:
        The folder of the data: `minari.MinariDataset(folder)` reads it, and so does `minari.load_dataset(name)`.

    Raises:
        MissingDependencyError: without the extra "datasets".
        InvalidConfigError: the name is not of the form [namespace/]name-v0.
        ResultsError: there is such a data set already, or the folder cannot be written, or no episode has a step.
    """
    minari = require("minari", "datasets")
    require("h5py", "datasets")
    if not re.fullmatch(r"([\w-]+/)*[\w.-]+-v\d+", name):
        raise InvalidConfigError(f"name {name!r}: must be of the form [namespace/]name-v0")
    place = Path(root).resolve() / name / "data"  # Minari does not write to relative ones
    if place.exists():
        raise ResultsError(f"{place.parent}: this data set exists; raise the version or remove it")
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        part = place.with_name(f".part-{os.getpid()}")
        part.mkdir()
    except OSError as error:
        raise ResultsError(f"{place.parent}: cannot be written: {error.strerror or error}") from error
    try:
        _write(minari, part, recording, name, workers, description, track)
        os.replace(part, place)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    return place


def _write(
    minari: Any, part: Path, recording: Recording, name: str, workers: int, description: str, track: Callable[..., Any]
) -> None:
    """Write data and metadata into the folder `part`."""
    from joblib import Parallel, delayed
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    env = make_env(recording)
    storage = MinariStorage.new(
        part, env.observation_space, env.action_space, env.unwrapped.spec, "hdf5", jpeg_encoding=False
    )
    tasks = list(itertools.product(recording.plans, recording.seeds))
    played = Parallel(workers, return_as="generator")(delayed(play)(recording, *task) for task in tasks)
    kept, about = 0, []
    for episode in track(played, len(tasks)):
        about_it = episode.pop("about")
        if episode["actions"]:
            storage.update_episodes([EpisodeBuffer(id=kept, seed=about_it["seed"], **episode)])
            about.append({key: value for key, value in about_it.items() if key != "seed"})
            kept += 1
    if not kept:
        raise ResultsError(f"{name}: no episode has a step, all plans were seen whole from the start")
    storage.update_episode_metadata(about)
    storage.update_metadata(
        {
            "dataset_id": name,
            "minari_version": minari.__version__,
            "algorithm_name": policy_label(recording.policy),
            "description": description or f"Episodes of {policy_label(recording.policy)} in polyexplore_gym",
            "requirements": [f"polyexplore-gym=={polyexplore_gym.__version__}"],
            "polyexplore_observation": recording.observation,
        }
    )
