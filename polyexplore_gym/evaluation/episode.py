"""One episode: a policy in an environment, from reset to the end, as a record."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np

from polyexplore_gym.config import EnvConfig
from polyexplore_gym.evaluation.policy import Policy
from polyexplore_gym.evaluation.records import THRESHOLDS, EpisodeRecord
from polyexplore_gym.evaluation.setting import Setting

_POLICY_STREAM = 0x706F6C69637900
"""Keeps the policy's random numbers apart from those of the environment, which has the same seed."""

Observer = Callable[[gymnasium.Env, Mapping[str, Any], int | None, bool], None]
"""Called after the reset and every step: environment, info, the action taken, whether the episode is over."""


def policy_rng(seed: int, plan_hash: str) -> np.random.Generator:
    """The generator that a policy gets for an episode: the same for all policies and settings."""
    return np.random.default_rng([_POLICY_STREAM, seed, int(plan_hash[:16] or "0", 16)])


def run_episode(
    env: gymnasium.Env,
    policy: Policy,
    plan: Any,
    seed: int,
    *,
    label: str,
    options: Mapping[str, Any] | None = None,
    observer: Observer | None = None,
) -> EpisodeRecord:
    """Explore `plan` once and say how it went; an exception on the way makes a failed record.

    Args:
        env: an environment of this package; it is reset with `seed` and `options["plan"] = plan`.
        policy: who decides.
        plan: the `FloorPlan`.
        seed: of the environment; start and noise follow from it.
        label: the policy's name in the record.
        options: more options of the reset, such as `start`.
        observer: called after the reset and after every step.
    """
    config: EnvConfig = env.unwrapped.config  # type: ignore[attr-defined]
    log = _Log()
    status, error = "failed", None
    began = time.perf_counter()
    try:
        status = _play(env, policy, plan, seed, dict(options or {}), log, observer)
    except Exception as exception:
        error = f"{type(exception).__name__}: {exception}"[:2000]
    coverage = log.coverage[-1] if log.coverage else 0.0
    outcome = log.info.get("outcome", {})
    reached = dict(zip(THRESHOLDS, log.distances_to_coverage(), strict=True))
    return EpisodeRecord(
        policy=label,
        **Setting.of(config)._asdict(),
        plan=str(plan.name),
        plan_hash=plan.content_hash,
        group=building(plan),
        stratum=str(plan.meta.get("kind") or plan.meta.get("family") or ""),
        seed=seed,
        drive=config.drive.mode,
        status=status,
        error=error,
        distance=round(log.distance[-1], 6) if log.distance else 0.0,
        coverage=round(coverage, 6),
        unreached=int(outcome.get("unreached", 0)),
        unreached_length=round(float(outcome.get("unreached_length", 0.0)), 6),
        given_up=int(outcome.get("given_up", 0)),
        given_up_length=round(float(outcome.get("given_up_length", 0.0)), 6),
        distance_90=reached[90],
        distance_95=reached[95],
        distance_99=reached[99],
        curve_distance=tuple(round(d, 4) for d in log.distance),
        curve_coverage=tuple(round(c, 6) for c in log.coverage),
        decisions=len(log.latency),
        ends=dict(sorted(log.ends.items())),
        measurements=int(log.info.get("measurements", 0)),
        sim_time=round(float(log.info.get("sim_time", 0.0)), 6),
        collisions=int(log.info.get("collisions", 0)),
        invalid_actions=log.invalid_actions,
        cut_nodes=log.cut["nodes"],
        cut_lines=log.cut["lines"],
        reward=round(log.reward, 6),
        timing={**log.latencies(), "episode": round(time.perf_counter() - began, 6)},
    )


def building(plan: Any) -> str:
    """The building that a plan belongs to; a plan that names none is a building of its own."""
    group = plan.meta.get("group")
    return str(group) if group not in (None, "") else f"{plan.name} {plan.content_hash[:8]}"


def _play(
    env: gymnasium.Env,
    policy: Policy,
    plan: Any,
    seed: int,
    options: dict[str, Any],
    log: _Log,
    observer: Observer | None,
) -> str:
    rng = policy_rng(seed, plan.content_hash)
    forget = getattr(policy, "reset", None)
    if callable(forget):
        forget()
    observation, info = env.reset(seed=seed, options={**options, "plan": plan})
    log.add(info)
    action = None
    terminated = truncated = not np.any(info["action_mask"])  # all was seen from the start
    while True:
        if observer is not None:
            observer(env, info, action, terminated or truncated)
        if terminated or truncated:
            return _status(info) if terminated else "truncated"
        began = time.perf_counter()
        action = policy.act(observation, info, rng)
        log.latency.append(time.perf_counter() - began)
        observation, reward, terminated, truncated, info = env.step(action)
        log.reward += float(reward)
        log.ends[str(info["ended"])] += 1
        log.add(info)


def _status(info: Mapping[str, Any]) -> str:
    """How an episode that ended by itself ended, by the environment's word."""
    status = info["outcome"]["status"]
    if status not in ("complete", "unreached"):
        raise ValueError(f"the episode has ended, but info['outcome'] says {status!r}")
    return str(status)


class _Log:
    """What accumulates while an episode runs, so that a failure half way still leaves its part."""

    def __init__(self) -> None:
        self.distance: list[float] = []
        self.coverage: list[float] = []
        self.latency: list[float] = []
        self.ends: Counter[str] = Counter()
        self.invalid_actions = 0
        self.cut = {"nodes": 0, "lines": 0}
        self.reward = 0.0
        self.info: Mapping[str, Any] = {}

    def add(self, info: Mapping[str, Any]) -> None:
        self.info = info
        self.distance.append(float(info["distance"]))
        self.coverage.append(float(info["coverage"]))
        self.invalid_actions += bool(info.get("invalid_action", False))
        for name in self.cut:
            self.cut[name] = max(self.cut[name], int(info.get("cut", {}).get(name, 0)))

    def distances_to_coverage(self) -> list[float | None]:
        # Coverage is known at measurements only: no interpolation on the way between them.
        hits = ((d for d, c in zip(self.distance, self.coverage, strict=True) if c >= p / 100) for p in THRESHOLDS)
        return [None if d is None else round(d, 6) for d in (next(h, None) for h in hits)]

    def latencies(self) -> dict[str, float]:
        if not self.latency:
            return {}
        values = np.array(self.latency)
        figures = {"act_mean": values.mean(), "act_median": np.median(values), "act_max": values.max()}
        return {name: round(float(value), 9) for name, value in figures.items()}
