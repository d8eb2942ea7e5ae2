"""Policies x settings x plans x seeds, in parallel, kept on disk and resumed after a stop."""

from __future__ import annotations

import functools
import importlib.metadata
import platform
import signal
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import gymnasium

import polyexplore_gym
from polyexplore_gym.config import EnvConfig, to_mapping
from polyexplore_gym.errors import InvalidConfigError, ResultsError
from polyexplore_gym.evaluation.episode import building, run_episode
from polyexplore_gym.evaluation.policy import Policy, PolicySpec, load_policy, policy_label
from polyexplore_gym.evaluation.records import EpisodeRecord, Key
from polyexplore_gym.evaluation.results import FORMAT, ResultsFile, open_folder
from polyexplore_gym.evaluation.setting import Setting

MakeEnv = Callable[[EnvConfig], gymnasium.Env]
Backend = Literal["loky", "ray"]
"""Where episodes run: in processes of this machine, or on a Ray cluster."""


def make_env(config: EnvConfig) -> gymnasium.Env:
    """The environment of this package, without its own plans: every reset names one."""
    from polyexplore_gym.env import PolyExploreEnv  # on demand: reading results needs no simulator

    return PolyExploreEnv(config=config)


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """What is compared on what. All policies and settings meet the same plans, starts and noise."""

    policies: Mapping[str, PolicySpec]
    """Policies by the name under which their results are kept."""
    plans: Sequence[Any]
    """`FloorPlan`s, no two of the same geometry."""
    placements: Sequence[str] = ("midpoint",)
    """Node placements, each one a run of its own (`EnvConfig.exploration.placement` is replaced)."""
    sensing: Sequence[str] = ("stops",)
    """When the robot measures and decides, each one a run of its own at every placement: `setting.SENSING`.
    (`EnvConfig.exploration.scan_every` and `decide` are replaced, or kept where they fit: see `Setting.configured`.)"""
    seeds: Sequence[int] = (0,)
    """Seeds of the environment; each is one start and one stream of noise on every plan."""
    config: EnvConfig = field(default_factory=EnvConfig)
    """The environment."""

    def __post_init__(self) -> None:
        for name in ("policies", "plans", "placements", "sensing", "seeds"):
            if len(getattr(self, name)) == 0:
                raise InvalidConfigError(f"study.{name}: is empty")
        for name in ("placements", "sensing", "seeds"):
            values = list(getattr(self, name))
            if len(set(values)) != len(values):
                raise InvalidConfigError(f"study.{name} = {values}: one is there twice")
        for seed in self.seeds:
            if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
                raise InvalidConfigError(f"study.seeds: {seed!r} is not a whole number from 0 on")
        hashes = [plan.content_hash for plan in self.plans]
        if len(set(hashes)) != len(hashes):
            twice = next(plan.name for i, plan in enumerate(self.plans) if plan.content_hash in hashes[:i])
            raise InvalidConfigError(f"study.plans: {twice!r} has the geometry of another plan and would count twice")
        for setting in self.settings:
            setting.configured(self.config)

    @property
    def settings(self) -> list[Setting]:
        """All placements with the first way to sense, then with the next."""
        return [Setting(placement, sensing) for sensing in self.sensing for placement in self.placements]

    def config_for(self, placement: str, sensing: str = "stops") -> EnvConfig:
        """The environment's configuration in a setting."""
        return Setting(placement, sensing).configured(self.config)

    def tasks(self) -> Iterator[Task]:
        """The episodes, plan by plan, so that a worker meets a plan in one go."""
        for plan in self.plans:
            for seed in self.seeds:
                for setting in self.settings:
                    config = setting.configured(self.config)
                    for label, policy in self.policies.items():
                        yield Task(policy, label, plan, seed, config)

    def manifest(self) -> dict[str, Any]:
        """The study and the versions that matter to its results, fit for JSON."""
        config = to_mapping(self.config)
        config["exploration"].pop("placement")
        return {
            "format": FORMAT,
            "study": {
                "policies": {label: _described(spec) for label, spec in self.policies.items()},
                "placements": list(self.placements),
                "sensing": list(self.sensing),
                "seeds": list(self.seeds),
                "config": config,
                "plans": [{"name": p.name, "hash": p.content_hash, "group": building(p)} for p in self.plans],
            },
            "versions": versions(),
        }


@dataclass(frozen=True, slots=True)
class Task:
    """One episode to run."""

    policy: PolicySpec
    label: str
    plan: Any
    seed: int
    config: EnvConfig

    @property
    def key(self) -> Key:
        """The key of its record."""
        return self.label, *Setting.of(self.config), self.plan.content_hash, self.seed


def name_policies(specs: Iterable[PolicySpec]) -> dict[str, PolicySpec]:
    """Policies by their own names; raises `InvalidConfigError` when two have the same."""
    named: dict[str, PolicySpec] = {}
    for spec in specs:
        label = policy_label(spec)
        if label in named:
            raise InvalidConfigError(f"two policies are called {label!r}: give them names in a mapping")
        named[label] = spec
    return named


def evaluate(
    study: Study,
    *,
    out: Path | str | None = None,
    workers: int = 1,
    backend: Backend = "loky",
    address: str | None = None,
    progress: bool = True,
    make_env: MakeEnv = make_env,
) -> list[EpisodeRecord]:
    """Run what is missing of a study and return all its records, in the order of `Study.tasks`.

    Every record is on the disk (in `out`) before the next is waited for; after a kill, the same call
    goes on with the missing episodes and ends with the same records. An episode that raises is kept
    as a failed record and counts as run.

    Args:
        study: what to run.
        out: folder of the results; None: keep them in memory only.
        workers: processes; the records do not depend on it.
        backend: "loky", processes of this machine (1 runs in this one), or "ray".
        address: Ray only: a running cluster ("auto", "host:port"), all cores of which are used; None starts
            one of `workers` cores on this machine.
        progress: show a bar with the time left.
        make_env: makes the environment from its configuration; must be importable by the workers.

    Raises:
        InvalidConfigError: a policy cannot be made, or there is no cluster at the address.
        ResultsError: `out` belongs to another study or is damaged, cannot be written, a worker died, or a
            machine of the cluster has other versions.
    """
    if workers < 1:
        raise InvalidConfigError(f"workers = {workers}: must be at least 1")
    if backend not in get_args(Backend):
        raise InvalidConfigError(f"backend = {backend!r}: must be one of {', '.join(get_args(Backend))}")
    for spec in study.policies.values():
        load_policy(spec)  # a wrong name is an error now, not a failed record for every episode
    tasks = list(study.tasks())
    done: dict[Key, EpisodeRecord] = {}
    with ExitStack() as stack:
        append: Callable[[EpisodeRecord], None] = lambda record: done.__setitem__(record.key, record)  # noqa: E731
        if out is not None:
            open_folder(Path(out), study.manifest(), study.plans)
            file = stack.enter_context(ResultsFile(Path(out)))
            done, append = file.records, file.append
            known = {task.key for task in tasks}
            for stranger in (record for record in done.values() if record.key not in known):
                raise ResultsError(f"{file.path}: holds an episode that is not of this study: {stranger.key}")
        missing = [task for task in tasks if task.key not in done]
        bar = stack.enter_context(_bar(len(tasks), len(tasks) - len(missing), progress))
        failed = 0
        for record in _run(missing, workers, make_env, backend, address):
            append(record)
            failed += record.status == "failed"
            if failed:
                bar.set_postfix(failed=failed, refresh=False)
            bar.update()
        return [done[task.key] for task in tasks]


def _bar(total: int, done: int, progress: bool) -> Any:
    from tqdm import tqdm

    return tqdm(total=total, initial=done, unit="episode", disable=not progress, dynamic_ncols=True, smoothing=0.05)


def _run(
    tasks: list[Task], workers: int, make_env: MakeEnv, backend: Backend, address: str | None
) -> Iterator[EpisodeRecord]:
    """Records in the order in which the episodes end."""
    if backend == "ray" and tasks:
        from polyexplore_gym.evaluation.cluster import RayBackend, cluster

        with cluster(address, workers) as cores:
            run = functools.partial(_run_task_elsewhere, ours=versions())
            yield from _parallel(tasks, cores, make_env, RayBackend(), run)
    elif workers == 1 or len(tasks) <= 1:
        yield from (_run_task(task, make_env) for task in tasks)
    else:
        yield from _parallel(tasks, workers, make_env, "loky", _run_task)


def _parallel(
    tasks: list[Task], workers: int, make_env: MakeEnv, backend: Any, run: Callable[..., EpisodeRecord]
) -> Iterator[EpisodeRecord]:
    from joblib import Parallel, delayed
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    # Two tasks ahead a worker: enough to keep all busy, and little is lost when the run is killed.
    parallel = Parallel(
        n_jobs=workers,
        backend=backend,
        return_as="generator_unordered",
        batch_size=1,
        pre_dispatch="2 * n_jobs",
    )
    with _interrupts_held():
        results = parallel(delayed(run)(task, make_env) for task in tasks)
    try:
        yield from results
    except TerminatedWorkerError as error:
        raise ResultsError(
            "a worker process died (out of memory, or killed); the episodes that had ended are safe: "
            "start again with the same folder to go on, perhaps with fewer workers"
        ) from error
    finally:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # joblib tells of the tasks that a stop leaves behind
            results.close()


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Hold back Ctrl-C. Processes started meanwhile inherit that for good: it is for this process to end them."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _run_task_elsewhere(task: Task, make_env: MakeEnv, ours: dict[str, str]) -> EpisodeRecord:
    theirs = _versions()
    different = [f"{name} {theirs[name]}, not {ours[name]}" for name in ours if theirs[name] != ours[name]]
    if different:
        raise ResultsError(f"{platform.node()} has {'; '.join(different)}: its results would not be comparable")
    return _run_task(task, make_env)


def _run_task(task: Task, make_env: MakeEnv) -> EpisodeRecord:
    record = run_episode(
        _env(make_env, task.config),
        _policy(task.policy) if isinstance(task.policy, str) else task.policy,
        _same_plan(task.plan),
        task.seed,
        label=task.label,
    )
    if record.status == "failed":
        _env.cache_clear()  # whatever state it was left in
    return record


@functools.lru_cache(maxsize=8)
def _env(make_env: MakeEnv, config: EnvConfig) -> gymnasium.Env:
    """A worker's environment for a configuration, kept between its episodes."""
    return make_env(config)


@functools.lru_cache(maxsize=32)
def _policy(spec: str) -> Policy:
    """A worker's policy, kept between its episodes: learned ones take long to load."""
    return load_policy(spec)


_plans: dict[str, Any] = {}


def _same_plan(plan: Any) -> Any:
    """The object first met of this plan, with all that it has cached, instead of a fresh copy of it."""
    known = _plans.get(plan.content_hash)
    if known is None or (known.name, known.meta) != (plan.name, plan.meta):
        while len(_plans) >= 8:
            del _plans[next(iter(_plans))]
        known = _plans[plan.content_hash] = plan
    return known


def _described(spec: PolicySpec) -> str:
    """A policy in the manifest: its string, or its class and, if it tells one, its `fingerprint`."""
    if isinstance(spec, str):
        return spec
    kind = type(spec)
    fingerprint = getattr(spec, "fingerprint", None)
    return f"{kind.__module__}.{kind.__qualname__}" + (f" {fingerprint}" if fingerprint else "")


def versions() -> dict[str, str]:
    """Versions of this package, Python and the libraries that results depend on."""
    names = ("numpy", "numba", "scipy", "pymunk", "shapely", "gymnasium", "opencv-python-headless")
    found = {"polyexplore-gym": polyexplore_gym.__version__, "python": platform.python_version()}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "unknown"
    return found


_versions = functools.cache(versions)
"""Once in a worker."""
