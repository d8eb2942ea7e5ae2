"""How good the best possible exploration of each start is, kept beside the results.

    bounds.json    one entry a plan and seed: the bounds of `baselines.oracle`, m

They are found by references that know the plan (`baselines.oracle`), which say what is proven and what is best known.
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from polyexplore_gym.config import EnvConfig
from polyexplore_gym.errors import MissingDependencyError, ResultsError
from polyexplore_gym.evaluation.records import EpisodeRecord, Pair

BOUNDS = "bounds.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class Bounds:
    """Ways (m) on which all that can be seen of a plan from a start is seen: lower <= optimum <= sensing <= stops."""

    lower: float
    """Proven: no way is shorter, for a sensor of this range that looks all round all the time or for any lesser one."""
    sensing: float
    """The best known tour of such a sensor, which knows the plan."""
    stops: float
    """The best known tour that knows the plan and sees only in scans at stops, with the field of view at hand."""

    @property
    def gap(self) -> float:
        """sensing / lower; 1 where all is seen from the start."""
        return self.sensing / self.lower if self.lower > 0 else (1.0 if self.sensing == 0 else math.inf)


RATIOS: dict[str, Callable[[Bounds], float]] = {
    "over_lower": lambda b: b.lower,
    "over_sensing": lambda b: b.sensing,
    "over_stops": lambda b: b.stops,
}
"""A record's figures that need bounds: its distance over them."""


def over(record: EpisodeRecord, bounds: Mapping[Pair, Bounds], name: str) -> float | None:
    """The distance over one of the bounds (`RATIOS`); None where there is none, or all is seen from the start."""
    found = bounds.get(record.pair)
    way = RATIOS[name](found) if found is not None else 0.0
    return record.distance / way if way > 0 else None


def find_bounds(
    plans: Sequence[Any],
    seeds: Sequence[int],
    config: EnvConfig,
    *,
    cache: Path,
    workers: int = 1,
    progress: bool = True,
) -> dict[Pair, Bounds]:
    """The bounds for all plans and seeds: computed where `cache` does not hold them, up to a minute each.

    Args:
        plans: `FloorPlan`s.
        seeds: of the environment: they say where it starts.
        config: its sensor and robot count.
        cache: folder where references are kept, by content hash.
        workers: processes.
        progress: show a bar with the time left.

    Raises:
        MissingDependencyError: the solvers are not installed.
    """
    from joblib import Parallel, delayed
    from tqdm import tqdm

    missing = [name for name in ("pyvrp", "highspy") if importlib.util.find_spec(name) is None]
    if missing:
        raise MissingDependencyError(f'references need {missing[0]}: pip install "polyexplore-gym[oracle]"')
    pairs = [(plan, seed) for plan in plans for seed in seeds]
    parallel = Parallel(n_jobs=min(workers, len(pairs)), return_as="generator", batch_size=1)
    found = parallel(delayed(_bounds)(plan, seed, config, cache) for plan, seed in pairs)
    bar = tqdm(found, total=len(pairs), unit="reference", disable=not progress, dynamic_ncols=True)
    return {(plan.content_hash, seed): bounds for (plan, seed), bounds in zip(pairs, bar, strict=True)}


def _bounds(plan: Any, seed: int, config: EnvConfig, cache: Path) -> Bounds:
    from baselines.oracle import reference, start_of

    found = reference(plan, start_of(plan, seed, config.robot), config.sensor, config.robot, cache=cache)
    return Bounds(lower=found.lower, sensing=found.upper_sensing, stops=found.upper_stop_and_scan)


def write_bounds(folder: Path, bounds: Mapping[Pair, Bounds]) -> Path:
    """Keep bounds in a results folder; raises `ResultsError` when they cannot be written."""
    path = Path(folder) / BOUNDS
    entries = [{"plan_hash": plan, "seed": seed, **asdict(b)} for (plan, seed), b in bounds.items()]
    temporary = path.with_suffix(".tmp")
    try:
        temporary.write_text(json.dumps(entries, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        os.replace(temporary, path)
    except OSError as error:
        raise ResultsError(f"{path}: cannot be written: {error.strerror}") from error
    return path


def read_bounds(folder: Path) -> dict[Pair, Bounds]:
    """The bounds in a results folder; empty when there are none.

    Raises:
        ResultsError: the file is damaged; it can be deleted and is made anew.
    """
    path = Path(folder) / BOUNDS
    if not path.exists():
        return {}
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        return {
            (str(e["plan_hash"]), int(e["seed"])): Bounds(**{n: float(e[n]) for n in ("lower", "sensing", "stops")})
            for e in entries
        }
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ResultsError(f"{path}: cannot be read ({error!r}): delete it, and it is made anew") from error
