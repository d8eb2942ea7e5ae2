"""The figures of a study as text, Markdown and CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

from polyexplore_gym.errors import ResultsError
from polyexplore_gym.evaluation.bounds import RATIOS
from polyexplore_gym.evaluation.setting import Setting
from polyexplore_gym.evaluation.statistics import Interval
from polyexplore_gym.evaluation.summary import METRICS, Comparison, Row, Summary

_FIGURES = ("distance", "IQM", "seen%", "90%", "95%", "99%", "AUC", "steps", "scans", "time", "bumps", "ms")
_HEADER = ("setting", "policy", "complete", *_FIGURES)
_BOUNDS = {"/stops": "over_stops", "/sensing": "over_sensing", "/lower": "over_lower"}
_COMPARISON_HEADER = ("setting", "policy", "against", "pairs", "ratio", "time ratio", "P(shorter)", "p", "p Holm")
LEGEND = """\
setting: where nodes are placed; moving: scans and decisions on the way, passing: scans on the way but decisions at
nodes, neither: both at nodes, where the robot stops. complete: episodes that left nothing, of all; unreached: those
that ended by themselves, but with jump edges that could not be reached or were given up; short: those that saw less of
the plan than others. All figures are over the complete and the unreached ones. distance: mean driven until no reachable
jump edge was left, m, with its 95 % interval; IQM: its interquartile mean; seen%: mean share of the free area seen by
then; 90%, 95%, 99%: mean driven until so much was seen, m; AUC: mean coverage over the longest distance compared on the
plan; steps (decisions), scans, time (simulated, s), bumps: means an episode; ms: mean decision. ratio: geometric mean
of the distances' ratios, below 1 is shorter; time ratio: that of the simulated times; P(shorter): probability of the
shorter way on the same plan and start; p: Wilcoxon signed-rank test. A figure in brackets: so many starts only."""
LEGEND_BOUNDS = """\
/stops, /sensing, /lower: mean of the distance over that of the best known tour which knows the plan and scans at
stops, over that of the best known one which knows it and senses all round all the way, and over the proven lower bound
on every way that sees all that can be seen (a run that leaves out the last corners may fall below them)."""


Table = tuple[str, tuple[str, ...], list[list[str]]]
"""What it shows (empty: the results themselves), the heads of its columns, its rows."""


def summary_tables(summary: Summary) -> list[Table]:
    """All tables of a summary, the results first."""
    header = (*_HEADER, *_BOUNDS) if summary.bounds else _HEADER
    tables: list[Table] = [("", header, [_row(row, bool(summary.bounds)) for row in summary.rows])]
    if summary.against_reference:
        lines = [_comparison(c, c.theirs[0]) for c in summary.against_reference]
        tables.append(("Policies, in the same setting:", _COMPARISON_HEADER, lines))
    if summary.between_settings:
        lines = [_comparison(c, str(c.theirs[1])) for c in summary.between_settings]
        tables.append(("Settings, with the same policy:", _COMPARISON_HEADER, lines))
    return tables


def summary_text(summary: Summary, style: str = "text") -> str:
    """All tables of a summary, `style` "text" (aligned columns) or "markdown"."""
    parts: list[str] = []
    for title, header, rows in summary_tables(summary):
        parts += [*filter(None, [title]), format_table(header, rows, style)]
    bullet = "- " if style == "markdown" else ""
    parts.append("\n".join(bullet + note for note in summary.notes))
    parts.append(legend(summary))
    return "\n\n".join(parts) + "\n"


def legend(summary: Summary) -> str:
    """What the columns mean."""
    return f"{LEGEND}\n{LEGEND_BOUNDS}" if summary.bounds else LEGEND


def write_tables(summary: Summary, folder: Path) -> list[Path]:
    """Write `summary.txt`, `summary.md`, `summary.csv` and `comparisons.csv`; returns their paths."""
    files = {
        "summary.txt": summary_text(summary),
        "summary.md": summary_text(summary, "markdown"),
        "summary.csv": summary_csv(summary),
        "comparisons.csv": comparisons_csv(summary),
    }
    try:
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise ResultsError(f"{folder}: tables cannot be written: {error.strerror}") from error
    return [folder / name for name in files]


def summary_csv(summary: Summary) -> str:
    """Every figure of every row, with its interval, one row a policy and setting."""
    names = [*METRICS, "auc", *(RATIOS if summary.bounds else ())]
    header = ["policy", *Setting._fields, "episodes", "complete", "unreached", "short", "truncated", "failed"]
    for name in names:
        header += [
            f"{name}_{part}" for part in ("pairs", "mean", "mean_low", "mean_high", "iqm", "iqm_low", "iqm_high")
        ]
    lines: list[list[object]] = []
    for row in summary.rows:
        line: list[object] = [row.policy, *row.setting, row.episodes, row.complete]
        line += [row.unreached, row.short, row.truncated, row.failed]
        for name in names:
            metric = row.metrics.get(name)
            line += [metric.pairs, *_cells(metric.mean), *_cells(metric.iqm)] if metric else [0] + [""] * 6
        lines.append(line)
    return _csv(header, lines)


def comparisons_csv(summary: Summary) -> str:
    """Every comparison, one a row."""
    side = ("policy", *Setting._fields)
    header = [*side, *(f"against_{name}" for name in side), "pairs", "buildings"]
    header += [f"{name}{end}" for name in ("ratio", "time", "p_shorter") for end in ("", "_low", "_high")]
    header += ["p", "p_holm"]
    lines: list[list[object]] = []
    for c in [*summary.against_reference, *summary.between_settings]:
        (ours, here), (theirs, there) = c.ours, c.theirs
        line: list[object] = [ours, *here, theirs, *there, c.pairs, c.buildings]
        line += [*_cells(c.ratio), *_cells(c.time), *_cells(c.improvement), _cell(c.p), _cell(c.p_holm)]
        lines.append(line)
    return _csv(header, lines)


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]], style: str = "text") -> str:
    """Columns as wide as their widest cell; text to the left, figures (any column but text) to the right."""
    cells = [list(map(str, row)) for row in rows]
    widths = [max(len(row[i]) for row in [list(header), *cells]) for i in range(len(header))]
    left = [all(not _figure(row[i]) for row in cells) for i in range(len(header))]
    aligned = [
        [cell.ljust(w) if to_left else cell.rjust(w) for cell, w, to_left in zip(row, widths, left, strict=True)]
        for row in [list(header), *cells]
    ]
    if style == "markdown":
        rule = ["-" * w if to_left else "-" * (w - 1) + ":" for w, to_left in zip(widths, left, strict=True)]
        return "\n".join(f"| {' | '.join(row)} |" for row in [aligned[0], rule, *aligned[1:]])
    rule = ["-" * w for w in widths]
    return "\n".join("  ".join(row).rstrip() for row in [aligned[0], rule, *aligned[1:]])


def _row(row: Row, bounds: bool) -> list[str]:
    def mean(name: str, digits: int, factor: float = 1.0) -> str:
        metric = row.metrics.get(name)
        if metric is None or metric.pairs == 0:
            return "-"
        text = _number(metric.mean.estimate * factor, digits)
        return text if metric.pairs == compared else f"{text} ({metric.pairs})"

    distance = row.metrics.get("distance")
    compared = distance.pairs if distance else 0
    return [
        str(row.setting),
        row.policy,
        _counts(row),
        interval_text(distance.mean, 1) if distance and compared else "-",
        _number(distance.iqm.estimate, 1) if distance and compared else "-",
        mean("coverage", 1, 100.0),
        mean("distance_90", 1),
        mean("distance_95", 1),
        mean("distance_99", 1),
        mean("auc", 3),
        mean("decisions", 1),
        mean("measurements", 1),
        mean("sim_time", 0),
        mean("collisions", 2),
        mean("latency", 2, 1000.0),
        *(mean(name, 2) for name in (_BOUNDS.values() if bounds else ())),
    ]


def _counts(row: Row) -> str:
    text = f"{row.complete}/{row.episodes}"
    counts = {"unreached": row.unreached, "short": row.short, "cut off": row.truncated, "failed": row.failed}
    extra = [f"{n} {word}" for word, n in counts.items() if n]
    return f"{text} ({', '.join(extra)})" if extra else text


def _comparison(c: Comparison, against: str) -> list[str]:
    return [
        str(c.ours[1]),
        c.ours[0],
        against,
        str(c.pairs),
        interval_text(c.ratio, 3) if c.pairs else "-",
        interval_text(c.time, 2) if c.pairs else "-",
        interval_text(c.improvement, 2) if c.pairs else "-",
        _p(c.p),
        _p(c.p_holm),
    ]


def interval_text(value: Interval, digits: int) -> str:
    """As in 1.04 [0.99, 1.08]; the estimate alone where there is no interval."""
    if math.isnan(value.low):
        return _number(value.estimate, digits)
    return f"{value.estimate:.{digits}f} [{value.low:.{digits}f}, {value.high:.{digits}f}]"


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _p(value: float) -> str:
    return "-" if math.isnan(value) else ("<0.001" if value < 0.001 else f"{value:.3f}")


def _figure(cell: str) -> bool:
    return cell[:1].isdigit() or cell[:1] in "<-"


def _cells(value: Interval) -> list[str]:
    return [_cell(value.estimate), _cell(value.low), _cell(value.high)]


def _cell(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.6g}"


def _csv(header: Sequence[str], lines: Sequence[Sequence[object]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(lines)
    return text.getvalue()
