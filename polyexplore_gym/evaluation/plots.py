"""Pictures of a study. Matplotlib is imported when first needed: `pip install "polyexplore-gym[plots]"`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from polyexplore_gym.config import EnvConfig
from polyexplore_gym.errors import MissingDependencyError, ResultsError
from polyexplore_gym.evaluation.episode import run_episode
from polyexplore_gym.evaluation.policy import Policy, PolicySpec, load_policy
from polyexplore_gym.evaluation.records import EpisodeRecord
from polyexplore_gym.evaluation.runner import MakeEnv, make_env
from polyexplore_gym.evaluation.setting import Setting
from polyexplore_gym.evaluation.statistics import Interval, coverage_at, mean_band, proportion_band
from polyexplore_gym.evaluation.summary import Comparison, Summary, finished

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's colours, and dashes beside them: told apart by the colour-blind and in grey print.
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#999999")
_DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1, 1.2)), (0, (4, 1.5, 1, 1.5)))
_INK = "#333333"
BANDS = 4
"""So many bands can be told apart in one panel."""


def coverage_figure(
    records: Sequence[EpisodeRecord],
    *,
    reference: str = "nearest",
) -> Figure:
    """Coverage against the distance driven: mean over the starts, with its 95 % interval over buildings.

    Distances are divided by what the reference policy drove on the same plan and start and in the same setting to
    the end, so that small and large plans can be averaged. Only starts that all policies
    finished in a setting are in it (as in `summarize`); one panel a setting. Of many policies only the
    reference has its interval.
    """
    policies = list(dict.fromkeys(r.policy for r in records))
    grid = np.linspace(0.0, 1.6, 161)
    done = finished(records)
    figure, panels = _panels(records)
    for setting, panel in panels.items():
        found = {(r.policy, *r.pair): r for r in done if r.setting == setting}
        compared = [p for p in policies if any(key[0] == p for key in found)]
        base = reference if reference in compared else next(iter(compared), "")
        pairs = [
            key[1:]
            for key, r in found.items()
            if key[0] == base and r.distance > 0 and all((p, *key[1:]) in found for p in compared)
        ]
        for policy in compared if pairs else ():
            runs = [found[(policy, *pair)] for pair in pairs]
            scale = [found[(base, *pair)].distance for pair in pairs]
            curves = np.array(
                [
                    coverage_at(np.array(r.curve_distance), np.array(r.curve_coverage), grid * s)
                    for r, s in zip(runs, scale, strict=True)
                ]
            )
            color, dash = _style(policies.index(policy))
            mean, low, high = 100 * mean_band(curves, [r.group for r in runs], [r.stratum for r in runs])
            panel.plot(grid, mean, color=color, linestyle=dash, linewidth=1.6, label=policy)
            if policy in (compared if len(compared) <= BANDS else [base]):
                panel.fill_between(grid, low.clip(0, 100), high.clip(0, 100), color=color, alpha=0.12, linewidth=0)
        panel.set_title(f"{setting} ({len(pairs)} starts)", fontsize=10, color=_INK)
        panel.set_xlabel(f"distance / that of {base} until the end" if base else "distance", fontsize=9)
        panel.set_xlim(0.0, grid[-1])
        _plain(panel)
    _finish(panels, "area seen, %")
    return figure


def profile_figure(records: Sequence[EpisodeRecord], *, reference: str = "nearest") -> Figure:
    """Performance profiles (Dolan and More 2002): how often a policy is how much longer than the best one.

    The share of starts on which its distance is at most so many times the shortest of all policies in that
    setting, with its 95 % interval. What was not finished is infinitely long. Starts that all policies
    ran and one finished are in it; one panel a setting. Of many policies only the reference has its interval.
    """
    policies = list(dict.fromkeys(r.policy for r in records))
    done = {r.key for r in finished(records)}
    figure, panels = _panels(records)
    for setting, panel in panels.items():
        found = {(r.policy, *r.pair): r for r in records if r.setting == setting}
        ran = [p for p in policies if any(key[0] == p for key in found)]
        starts = [key[1:] for key in found if key[0] == ran[0] and all((p, *key[1:]) in found for p in ran)]
        runs = np.array([[found[(p, *start)] for p in ran] for start in starts], dtype=object).reshape(-1, len(ran))
        distance = np.array([[r.distance if r.key in done else np.inf for r in row] for row in runs])
        kept = np.isfinite(distance).any(axis=1) if len(runs) else np.zeros(0, dtype=bool)
        runs, distance = runs[kept], distance.reshape(-1, len(ran))[kept]
        if len(runs):
            best = distance.min(axis=1, keepdims=True)
            ratio = np.where(best > 0, distance / np.where(best > 0, best, 1.0), np.where(distance > 0, np.inf, 1.0))
            last = float(np.clip(np.quantile(ratio[np.isfinite(ratio)], 0.95), 1.2, 10.0))
            grid = np.geomspace(1.0, last, 201)
            for i, policy in enumerate(ran):
                within = (ratio[:, i, None] <= grid * (1 + 1e-9)).astype(np.float64)
                share, low, high = 100 * proportion_band(within, [r.group for r in runs[:, i]])
                color, dash = _style(policies.index(policy))
                panel.plot(grid, share, color=color, linestyle=dash, linewidth=1.6, label=policy)
                if policy in (ran if len(ran) <= BANDS else [reference]):
                    panel.fill_between(grid, low, high, color=color, alpha=0.12, linewidth=0)
            panel.set_xscale("log")
            panel.set_xlim(1.0, last)
            _ratio_ticks(panel, 1.0, last)
        panel.set_title(f"{setting} ({len(runs)} starts)", fontsize=10, color=_INK)
        panel.set_xlabel("distance / the shortest on that start, at most", fontsize=9)
        panel.set_ylim(0, 103)
        _plain(panel)
    _finish(panels, "starts, %")
    return figure


def ratio_figure(summary: Summary) -> Figure:
    """Ratios of the distances: every start a dot, the geometric mean with its interval above it.

    To the left policies against the reference in the same setting, to the right settings with the same policy.
    """
    sides = [some for some in (summary.against_reference, summary.between_settings) if any(c.pairs for c in some)]
    most = max((sum(c.pairs > 0 for c in some) for some in sides), default=1)
    figure = _figure(7.0 * max(len(sides), 1), 1.3 + 0.42 * most)
    for panel, some in zip(np.atleast_1d(figure.subplots(1, max(len(sides), 1))), sides or [[]], strict=True):
        _compared(panel, [(c, _versus(c)) for c in some if c.pairs], most)
    return figure


def comparison_figure(comparisons: Sequence[Comparison], labels: Sequence[str], *, width: float = 7.0) -> Figure:
    """As `ratio_figure`, for some comparisons with names of one's own; `width` in inches."""
    rows = [(c, label) for c, label in zip(comparisons, labels, strict=True) if c.pairs]
    figure = _figure(width, 1.3 + 0.42 * max(len(rows), 1))
    _compared(figure.subplots(), rows, len(rows))
    return figure


def _compared(panel: Any, rows: Sequence[tuple[Comparison, str]], room: int) -> None:
    """Ratios with their names, in a panel with room for so many."""
    span = [1.0]
    for row, (c, _) in enumerate(rows):
        ratios = np.array(c.ratios)
        span += [float(np.quantile(ratios, 0.02)), float(np.quantile(ratios, 0.98)), c.ratio.low, c.ratio.high]
        # A fixed ripple keeps dots apart; it means nothing.
        ripple = 0.11 * np.sin(2.4 * np.arange(len(ratios)))
        panel.scatter(ratios, row + 0.2 + ripple, s=7, color="#8a8a8a", alpha=0.5, linewidths=0)
        _whisker(panel, c, c.ratio, row - 0.12)
    panel.axvline(1.0, color=_INK, linewidth=0.8, zorder=0)
    _rows(panel, [label for _, label in rows], room)
    panel.set_xscale("log")
    low, high = np.nanmin(span) / 1.05, np.nanmax(span) * 1.05
    panel.set_xlim(low, high)
    _ratio_ticks(panel, low, high)
    panel.set_xlabel("ratio of the distances (below 1: shorter)", fontsize=9)
    _plain(panel)


def improvement_figure(comparisons: Sequence[Comparison], labels: Sequence[str], *, width: float = 7.0) -> Figure:
    """The probability that ours is the shorter way on a start, with its interval; `width` in inches."""
    rows = [(c, label) for c, label in zip(comparisons, labels, strict=True) if c.pairs]
    figure = _figure(width, 1.1 + 0.3 * max(len(rows), 1))
    panel = figure.subplots()
    for row, (c, _) in enumerate(rows):
        _whisker(panel, c, c.improvement, row)
    panel.axvline(0.5, color=_INK, linewidth=0.8, zorder=0)
    _rows(panel, [label for _, label in rows], len(rows))
    panel.set_xlim(-0.02, 1.02)
    panel.set_xlabel("probability of the shorter way (above 0.5: better)", fontsize=9)
    _plain(panel)
    return figure


def trajectory_figure(
    policies: Mapping[str, PolicySpec],
    plan: Any,
    seed: int,
    config: EnvConfig,
    *,
    make_env: MakeEnv = make_env,
) -> Figure:
    """The way of every policy on one plan from one start: the episodes are run again, as they were.

    Raises:
        ResultsError: an episode fails before it can be drawn.
    """
    from polyexplore_gym.rendering import draw

    shape = _shape(plan)
    columns = min(len(policies), 4 if shape > 0.6 else 3 if shape > 0.4 else 2)
    rows = -(-len(policies) // columns)
    width = 14.0 / max(columns, 3)
    height = width * shape + 0.35  # inches, with the line above the map
    figure = _figure(width * columns, height * rows)
    figure.set_layout_engine("none")
    env = make_env(config)
    for i, (label, spec) in enumerate(policies.items()):
        left, top = (i % columns) / columns, 1.0 - (i // columns) / rows
        box = (left + 0.02 / columns, top - 0.99 / rows, 0.96 / columns, (0.98 - 0.35 / height) / rows)
        panel = figure.add_axes(box)
        snapshot, record = replay(env, load_policy(spec), plan, seed, label=label)
        draw(snapshot, panel, scale_bar=False, text=False)
        ended = "" if record.complete else f", {record.status}"
        panel.set_title(f"{label}: {record.distance:.0f} m, {record.measurements} scans{ended}", fontsize=9, color=_INK)
    env.close()
    return figure


def run_figure(
    env: Any, policy: Policy, plan: Any, seed: int, *, label: str, width: float = 5.2
) -> tuple[Figure, EpisodeRecord]:
    """The way of one policy on one plan from the ring to the robot, run again, and its record; raises as `replay`."""
    from polyexplore_gym.rendering import draw

    snapshot, record = replay(env, policy, plan, seed, label=label)
    width = min(width, 5.0 / _shape(plan))
    height = width * _shape(plan) + 0.3  # inches, with the scale bar below the map
    figure = _figure(width, height)
    figure.set_layout_engine("none")
    panel = figure.add_axes((0.01, 0.3 / height, 0.98, 1.0 - 0.32 / height))
    draw(dataclasses.replace(snapshot, scan=None, path=np.zeros((0, 2))), panel, text=False)
    start: dict[str, Any] = {
        "marker": "o",
        "markersize": 8,
        "markerfacecolor": "none",
        "markeredgewidth": 1.8,
        "zorder": 6,
    }
    panel.plot(*snapshot.trajectory[0, :2], color=_COLORS[1], **start)
    return figure, record


def replay(env: Any, policy: Policy, plan: Any, seed: int, *, label: str) -> tuple[Any, EpisodeRecord]:
    """The last snapshot of an episode that is run again, and its record; raises `ResultsError` if it fails."""
    last: list[Any] = []

    def observe(env: Any, info: Any, action: int | None, over: bool) -> None:
        if over:
            last.append(env.unwrapped.snapshot())

    record = run_episode(env, policy, plan, seed, label=label, observer=observe)
    if not last:
        raise ResultsError(f"{label} on {plan.name} (seed {seed}): {record.error}")
    return last[0], record


def save(figure: Figure, path: Path) -> Path:
    """Write a figure to a file of the format that the suffix names."""
    try:
        figure.savefig(path, dpi=150)
    except OSError as error:
        raise ResultsError(f"{path}: cannot be written: {error.strerror}") from error
    return path


def _figure(width: float, height: float) -> Figure:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingDependencyError('plots need matplotlib: pip install "polyexplore-gym[plots]"') from error
    return Figure(figsize=(width, height), layout="constrained")


def _panels(records: Sequence[EpisodeRecord]) -> tuple[Figure, dict[Setting, Any]]:
    """A figure with a panel a setting, two beside each other."""
    settings = list(dict.fromkeys(r.setting for r in records))
    columns = min(len(settings), 2)
    rows = -(-len(settings) // columns)
    figure = _figure(4.6 * columns + 0.4, 3.9 * rows)
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False).ravel()
    for panel in grid[len(settings) :]:
        panel.remove()
    return figure, dict(zip(settings, grid, strict=False))


def _finish(panels: Mapping[Setting, Any], what: str) -> None:
    """Name the vertical axes and put the legend into the last panel."""
    every = list(panels.values())
    for panel in every:
        if panel.get_subplotspec().is_first_col():
            panel.set_ylabel(what, fontsize=9)
    handles, labels = every[0].get_legend_handles_labels()
    if handles:
        every[-1].legend(handles, labels, fontsize=8, frameon=False, loc="lower right")


def _whisker(panel: Any, c: Comparison, value: Interval, height: float) -> None:
    color = _COLORS[0] if c.ours[1] == c.theirs[1] else _COLORS[1]
    panel.plot([value.low, value.high], [height] * 2, color=color, linewidth=2.4, solid_capstyle="round")
    panel.plot([value.estimate], [height], "o", color=color, markersize=5.5)


def _rows(panel: Any, labels: Sequence[str], room: int) -> None:
    panel.set_yticks(range(len(labels)), labels, fontsize=8)
    panel.set_ylim(room - 0.4, -0.6)


def _ratio_ticks(panel: Any, low: float, high: float) -> None:
    """Round ratios on a logarithmic axis, the roundest first, as many as there is room for."""
    ticks: list[float] = []
    for mark in (1, 2, 0.5, 1.5, 4, 0.7, 3, 10, 1.25, 0.8, 1.1, 6, 0.3, 0.9, 0.6, 1.05, 1.2):
        apart = [abs(np.log(mark / tick)) for tick in ticks]
        if low <= mark <= high and min(apart, default=np.inf) > 0.07 * np.log(high / low):
            ticks.append(mark)
    panel.set_xticks(sorted(ticks), [f"{t:g}" for t in sorted(ticks)])
    panel.minorticks_off()


def _plain(panel: Any) -> None:
    panel.grid(axis="x", color="#e3e3e3", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.tick_params(labelsize=8, colors=_INK, length=2.5)
    for side in ("top", "right"):
        panel.spines[side].set_visible(False)


def _style(index: int) -> tuple[str, Any]:
    return _COLORS[index % len(_COLORS)], _DASHES[index % len(_DASHES)]


def _versus(c: Comparison) -> str:
    if c.ours[1] == c.theirs[1]:
        return f"{c.ours[0]} / {c.theirs[0]}\n{c.ours[1]}"
    return f"{c.ours[0]}\n{c.ours[1]} / {c.theirs[1]}"


def _shape(plan: Any) -> float:
    """Height over width of a plan's picture."""
    x0, y0, x1, y1 = plan.bounds
    return float(np.clip((y1 - y0) / (x1 - x0), 0.2, 1.5))
