"""One self-contained HTML page of a results folder: tables, figures, runs drawn on their plans, failures, set-up.

A folder of a run that was killed, or goes on, gives a page of what is there. Needs jinja2 and matplotlib:
`pip install "polyexplore-gym[plots]"`.
"""

from __future__ import annotations

import base64
import dataclasses
import io
import itertools
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from polyexplore_gym.config import EnvConfig, from_mapping, to_mapping
from polyexplore_gym.errors import MissingDependencyError, PolyExploreError, ResultsError
from polyexplore_gym.evaluation import plots
from polyexplore_gym.evaluation.bounds import Bounds, Pair, read_bounds
from polyexplore_gym.evaluation.policy import load_policy
from polyexplore_gym.evaluation.records import EpisodeRecord
from polyexplore_gym.evaluation.results import EPISODES, MANIFEST, read_manifest, read_plan, read_records
from polyexplore_gym.evaluation.runner import MakeEnv, make_env
from polyexplore_gym.evaluation.setting import FIELDS, Setting
from polyexplore_gym.evaluation.summary import Comparison, Summary, compare, finished, summarize
from polyexplore_gym.evaluation.tables import interval_text, legend, summary_tables

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from polyexplore_gym.floorplan import FloorPlan

_DPI = 200
_SIZES = (0.0, 100.0, 500.0, 1000.0, 2000.0, float("inf"))
"""Classes of the plans' free area, m2."""
_LISTED = 200
"""So many failures are listed, the rest is counted."""


@dataclasses.dataclass(frozen=True, slots=True)
class Image:
    """A picture within the page."""

    source: str
    """Data URI."""
    text: str
    """What it shows, for those who do not see it."""
    width: int
    """Pixels of the page (half of those of the picture)."""
    height: int
    caption: str = ""


def write_report(
    folder: Path,
    out: Path | None = None,
    *,
    reference: str = "nearest",
    runs: int = 3,
    make_env: MakeEnv = make_env,
) -> Path:
    """Write the page of a results folder and return its path.

    Args:
        folder: results of `evaluate` or `polyexplore bench`.
        out: the file; None: `report.html` in the folder.
        reference: policy to compare with; when it was not run, the first one.
        runs: so many of the best and of the worst runs are run again and drawn.
        make_env: makes the environment for that.

    Raises:
        MissingDependencyError: jinja2 or matplotlib is not installed.
        ResultsError: the folder holds no results, is damaged, or the page cannot be written.
    """
    out = Path(folder) / "report.html" if out is None else Path(out)
    page = render_report(folder, reference=reference, runs=runs, make_env=make_env)
    try:
        out.write_text(page, encoding="utf-8")
    except OSError as error:
        raise ResultsError(f"{out}: cannot be written: {error.strerror}") from error
    return out


def render_report(folder: Path, *, reference: str = "nearest", runs: int = 3, make_env: MakeEnv = make_env) -> str:
    """The page of `write_report` as text."""
    try:
        import jinja2
    except ImportError as error:
        raise MissingDependencyError('reports need jinja2: pip install "polyexplore-gym[plots]"') from error
    folder = Path(folder)
    manifest, records, warned = _read(folder)
    study = manifest["study"]
    config = from_mapping(EnvConfig, study["config"], path=MANIFEST)
    summary = summarize(records, np.random.default_rng(0), reference=reference, bounds=read_bounds(folder))
    plans = {r.plan_hash: read_plan(folder, r.plan_hash) for r in records}
    results, *comparisons = summary_tables(summary)
    missing = _missing(study, records)
    content = {
        "title": folder.resolve().name,
        "subtitle": _subtitle(study, config),
        "reference": summary.reference,
        "missing": missing,
        "warnings": warned,
        "tiles": _tiles(study, records, missing),
        "results": {"header": results[1], "rows": results[2]},
        "comparisons": [{"title": t.rstrip(":"), "header": header, "rows": rows} for t, header, rows in comparisons],
        "legend": legend(summary).replace("\n", " "),
        "notes": summary.notes,
        "bounds": _bounds(study, summary.bounds, plans),
        "figures": _figures(records, summary),
        "breakdown": _breakdown(records, summary.reference, plans),
        "ends": _ends(records),
        "runs": _runs(records, study, config, plans, summary.reference, runs, make_env),
        "failures": _failures(records),
        **_set_up(manifest, config, records, plans),
    }
    names = {
        "results": "Results",
        "figures": "Figures",
        "breakdown": "By family and size",
        "ends": "Ends of drives",
        "runs": "Best and worst runs",
        "bounds": "Best possible",
    }
    names |= {"failures": "Not complete", "set-up": "Set-up"}
    content["contents"] = [(anchor, name) for anchor, name in names.items() if content.get(anchor, True)]
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("polyexplore_gym.evaluation", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    environment.globals["is_numeric"] = _is_numeric
    return environment.get_template("report.html.j2").render(content)


def _read(folder: Path) -> tuple[dict[str, Any], list[EpisodeRecord], list[str]]:
    """The manifest, the records in the order of the study, and what was odd about the files."""
    if not (folder / MANIFEST).exists() or not (folder / EPISODES).exists():
        raise ResultsError(f"{folder}: holds no results of polyexplore bench ({MANIFEST} and {EPISODES})")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        manifest, records = read_manifest(folder), read_records(folder)
    if not records:
        raise ResultsError(f"{folder}: no episode has ended yet; the same command of polyexplore bench goes on")
    try:
        study = manifest["study"]
        place = {
            name: {value: i for i, value in enumerate(values)}
            for name, values in (
                ("plan", [p["hash"] for p in study["plans"]]),
                ("seed", study["seeds"]),
                ("setting", _settings(study)),
                ("policy", study["policies"]),
            )
        }
        records.sort(
            key=lambda r: (
                place["plan"][r.plan_hash],
                place["seed"][r.seed],
                place["setting"][r.setting],
                place["policy"][r.policy],
            )
        )
    except (KeyError, TypeError) as error:
        raise ResultsError(f"{folder}: {EPISODES} does not belong to {MANIFEST} ({error!r})") from error
    return manifest, records, [str(w.message) for w in caught]


def _settings(study: Mapping[str, Any]) -> list[Setting]:
    return [Setting(placement, sensing) for sensing in study["sensing"] for placement in study["placements"]]


def _subtitle(study: Mapping[str, Any], config: EnvConfig) -> str:
    seeds = len(study["seeds"])
    view = round(np.degrees(config.sensor.field_of_view))
    return (
        f"{len(study['policies'])} policies, nodes {' and '.join(study['placements'])}, sensing "
        f"{' and '.join(study['sensing'])}; {len(study['plans'])} floor plans, {seeds} start{'s' * (seeds != 1)} on "
        f"each; {config.drive.mode} drive, pose {config.pose.mode}, laser of {view:g} degrees and "
        f"{config.sensor.max_range:g} m"
    )


def _missing(study: Mapping[str, Any], records: Sequence[EpisodeRecord]) -> dict[str, Any] | None:
    each = len(study["plans"]) * len(study["seeds"])
    ran = Counter((r.setting, r.policy) for r in records)
    sides = list(itertools.product(_settings(study), study["policies"]))
    rows = [[*map(str, side), f"{each - ran[side]} of {each}"] for side in sides if ran[side] < each]
    total = each * len(sides)
    return {"count": total - len(records), "total": total, "rows": rows} if len(records) < total else None


def _tiles(
    study: Mapping[str, Any], records: Sequence[EpisodeRecord], missing: Mapping[str, Any] | None
) -> list[tuple[str, str]]:
    count = Counter(r.status for r in records)
    done = finished(records)
    short = sum(r.ended for r in records) - len(done)
    complete = sum(r.complete for r in done)
    seconds = float(np.mean([r.timing["episode"] for r in records]))
    total = missing["total"] if missing else len(records)
    tiles = [
        ("episodes", f"{len(records)} of {total}"),
        ("complete", str(complete)),
        *([("edges unreached", str(len(done) - complete))] if complete < len(done) else []),
        *([("stopped short", str(short))] if short else []),
        *([("cut off", str(count["truncated"]))] if count["truncated"] else []),
        ("failed", str(count["failed"])),
        ("plans, buildings", f"{len(study['plans'])}, {len({p['group'] for p in study['plans']})}"),
        ("driven in all", f"{sum(r.distance for r in records) / 1000:.1f} km"),
        ("an episode took", f"{seconds:.2f} s"),
        ("a million takes", f"{seconds * 1e6 / 3600:,.0f} core h"),
    ]
    return tiles


def _figures(records: Sequence[EpisodeRecord], summary: Summary) -> list[dict[str, Any]]:
    by_setting: dict[Setting, list[EpisodeRecord]] = {}
    for r in records:
        by_setting.setdefault(r.setting, []).append(r)
    profiles = [
        _image(plots.profile_figure(some, reference=summary.reference), f"Performance profiles, {setting}")
        for setting, some in by_setting.items()
    ]
    curves = [
        _image(plots.coverage_figure(some, reference=summary.reference), f"Coverage against distance, {setting}")
        for setting, some in by_setting.items()
    ]
    groups = [
        {
            "title": "Performance profiles",
            "text": "How often a policy's way is at most so many times the shortest of all policies on that start. "
            "Further up and to the left is better; what was not finished counts as infinitely long. "
            + _band_text(records),
            "images": profiles,
        },
        {
            "title": "Coverage and distance",
            "text": f"Mean share of the free area seen by the time a part of {summary.reference}'s distance on that "
            "start is driven; starts that all policies finished. " + _band_text(records),
            "images": curves,
        },
    ]
    sets: dict[str, list[Comparison]] = {}
    for c in (c for c in summary.against_reference if c.pairs):
        sets.setdefault(f"{c.ours[1]}: against {summary.reference}", []).append(c)
    for c in (c for c in summary.between_settings if c.pairs):
        sets.setdefault(f"{c.ours[1]}: against {c.theirs[1]}", []).append(c)
    if sets:
        ratios, shorter = [], []
        for name, found in sets.items():
            some = [c.ours[0] for c in found]
            ratios.append(
                _image(plots.comparison_figure(found, some, width=5.2), f"Ratios of the distances, {name}", name)
            )
            shorter.append(
                _image(plots.improvement_figure(found, some, width=5.2), f"Probability of improvement, {name}", name)
            )
        text = "Every start is a dot, beside the geometric mean with its 95 % interval."
        groups.append({"title": "Paired ratios", "text": text, "images": ratios})
        text = "On how many starts the way is shorter (ties count half), with the 95 % interval."
        groups.append({"title": "Probability of improvement", "text": text, "images": shorter})
    return groups


def _band_text(records: Sequence[EpisodeRecord]) -> str:
    many = len({r.policy for r in records}) > plots.BANDS
    return "The band is the 95 % interval" + (" of the policy compared with." if many else ".")


def _breakdown(
    records: Sequence[EpisodeRecord], reference: str, plans: Mapping[str, FloorPlan | None]
) -> list[dict[str, Any]]:
    """Tables of the ratios to the reference: rows are families and sizes, columns policies; one a setting."""
    policies = [p for p in dict.fromkeys(r.policy for r in records) if p != reference]
    if not policies:
        return []
    parts = _parts(records, lambda r: r.stratum or "other", None)
    sizes = [f"{_span(low, high)} m²" for low, high in itertools.pairwise(_SIZES)]
    areas = {key: plan.area for key, plan in plans.items() if plan is not None}

    def size(r: EpisodeRecord) -> str | None:
        area = areas.get(r.plan_hash)
        return None if area is None else sizes[int(np.searchsorted(_SIZES, area, side="left")) - 1]

    parts |= _parts(records, size, sizes)
    rng = np.random.default_rng(0)
    rows: dict[Setting, list[dict[str, Any]]] = {}
    for name, some in parts.items():
        found: dict[Setting, dict[str, Comparison]] = {}
        for c in compare(some, rng, reference=reference):
            found.setdefault(c.ours[1], {})[c.ours[0]] = c
        for setting, row in found.items():
            cells = [_cell(row.get(policy)) for policy in policies]
            starts = max((c.pairs for c in row.values()), default=0)
            rows.setdefault(setting, []).append({"name": name, "starts": starts, "cells": cells})
    return [
        {"title": str(setting), "header": ("plans", "starts", *policies), "rows": rows[setting]}
        for setting in dict.fromkeys(r.setting for r in records)
        if setting in rows
    ]


def _ends(records: Sequence[EpisodeRecord]) -> dict[str, Any]:
    """Why drives ended, of each policy in each setting."""
    ends: dict[tuple[str, str], Counter[str]] = {}
    for r in records:
        ends.setdefault((str(r.setting), r.policy), Counter()).update(r.ends)
    most = Counter[str]()
    for count in ends.values():
        most.update(count)
    names = [name for name, _ in most.most_common()]
    rows = []
    for side, count in ends.items():
        shares = [f"{100 * count[name] / count.total():.2f}" if count[name] else "-" for name in names]
        rows.append([*side, str(count.total()), *shares])
    return {"header": ("setting", "policy", "drives", *(f"{name} %" for name in names)), "rows": rows}


def _parts(
    records: Sequence[EpisodeRecord], part: Callable[[EpisodeRecord], str | None], order: Sequence[str] | None
) -> dict[str, list[EpisodeRecord]]:
    found: dict[str, list[EpisodeRecord]] = {name: [] for name in order or ()}
    for r in records:
        name = part(r)
        if name is not None:
            found.setdefault(name, []).append(r)
    return {name: some for name, some in found.items() if some}


def _span(low: float, high: float) -> str:
    if low == 0:
        return f"up to {high:g}"
    return f"over {low:g}" if np.isinf(high) else f"{low:g} to {high:g}"


def _cell(c: Comparison | None) -> dict[str, str]:
    if c is None or not c.pairs:
        return {"text": "-", "kind": ""}
    kind = "shorter" if c.ratio.high < 1 else "longer" if c.ratio.low > 1 else ""
    return {"text": interval_text(c.ratio, 2), "kind": kind}


def _runs(
    records: Sequence[EpisodeRecord],
    study: Mapping[str, Any],
    config: EnvConfig,
    plans: Mapping[str, FloorPlan | None],
    reference: str,
    count: int,
    make_env: MakeEnv,
) -> dict[str, Any]:
    """The runs that gained and lost most against the reference from the same start in the same setting, beside it."""
    text = (
        f"The runs that were shortest and longest in proportion to the way of {reference} from the same start, each "
        "beside it; no policy and no plan twice. They were run again for the picture, from the ring to "
        "the robot."
    )
    base = {(r.setting, *r.pair): r for r in finished(records) if r.policy == reference}
    pairs = [
        (r, base[key])
        for r in finished(records)
        if r.policy != reference and (key := (r.setting, *r.pair)) in base and base[key].distance > 0
    ]
    pairs.sort(key=lambda pair: pair[0].distance / pair[1].distance)
    drawable = [pair for pair in pairs if plans.get(pair[0].plan_hash) is not None]
    if not count or not pairs:
        return {"text": text, "note": "", "groups": []}
    if not drawable:
        return {"text": text, "note": "The folder does not hold the floor plans, so no run can be drawn.", "groups": []}
    groups = []
    for title, some in (
        ("Best", [p for p in drawable if p[0].distance < p[1].distance]),
        ("Worst", [p for p in reversed(drawable) if p[0].distance > p[1].distance]),
    ):
        runs = []
        for ours, theirs in _different(some, count):
            plan = plans[ours.plan_hash]
            images: list[Image] = []
            notes: list[str] = []
            for record in (ours, theirs):
                try:
                    image, same = _drawn(record, plan, study, config, make_env)
                except PolyExploreError as error:
                    notes.append(f"{record.policy} cannot be drawn: {error}")
                    continue
                images.append(image)
                if not same:
                    notes.append(f"{record.policy} goes another way now than when it was recorded (other versions?).")
            title_ = (
                f"{ours.policy}, {ours.setting}: {ours.distance / theirs.distance:.2f} times the way of "
                f"{theirs.policy} on {ours.plan}, seed {ours.seed}"
            )
            runs.append({"title": title_, "images": images, "note": " ".join(notes)})
        if runs:
            groups.append({"title": title, "runs": runs})
    return {"text": text, "note": "" if groups else "No run differs from the reference's.", "groups": groups}


def _different(
    pairs: Iterable[tuple[EpisodeRecord, EpisodeRecord]], count: int
) -> list[tuple[EpisodeRecord, EpisodeRecord]]:
    """The first few, no policy and no plan twice."""
    found: list[tuple[EpisodeRecord, EpisodeRecord]] = []
    for ours, theirs in pairs:
        if len(found) < count and all(ours.policy != o.policy and ours.plan_hash != o.plan_hash for o, _ in found):
            found.append((ours, theirs))
    return found


def _drawn(
    record: EpisodeRecord, plan: Any, study: Mapping[str, Any], config: EnvConfig, make_env: MakeEnv
) -> tuple[Image, bool]:
    """An episode that is run again, as a picture, and whether it went as recorded."""
    env = make_env(record.setting.configured(config))
    policy = load_policy(study["policies"][record.policy])
    figure, again = plots.run_figure(env, policy, plan, record.seed, label=record.policy)
    env.close()
    seen = f"{100 * record.coverage:.1f} % seen"
    caption = f"{record.policy}: {record.distance:.1f} m, {record.measurements} scans, {seen}"
    return _image(figure, f"Way of {record.policy} on {record.plan}", caption), again == record


def _failures(records: Sequence[EpisodeRecord]) -> dict[str, Any]:
    """The episodes that are not complete, the worst kind first."""
    done = {r.key for r in finished(records)}
    kinds = ("failed", "cut off", "stopped short", "unreached")

    def kind(r: EpisodeRecord) -> str:
        if r.ended:
            return "unreached" if r.key in done else "stopped short"
        return "failed" if r.status == "failed" else "cut off"

    bad = sorted((r for r in records if not (r.complete and r.key in done)), key=lambda r: kinds.index(kind(r)))
    rows = [
        [
            r.policy,
            str(r.setting),
            r.plan,
            str(r.seed),
            kind(r),
            f"{r.distance:.1f}",
            f"{100 * r.coverage:.1f}",
            f"{r.unreached + r.given_up}, {r.unreached_length + r.given_up_length:.1f} m",
            r.error or "",
        ]
        for r in bad[:_LISTED]
    ]
    text = (
        "Cut off: the budget of decisions was used up. Stopped short: ended having seen less of the plan than others. "
        "Unreached: ended by itself and is compared, but jump edges could not be reached or were given up."
    )
    if len(bad) > _LISTED:
        text += f" The first {_LISTED} of {len(bad)}."
    return {
        "text": text,
        "rows": rows,
        "header": ("policy", "setting", "plan", "seed", "what", "m", "seen %", "edges left", "error"),
    }


def _bounds(
    study: Mapping[str, Any], bounds: Mapping[Pair, Bounds], plans: Mapping[str, FloorPlan | None]
) -> dict[str, Any] | None:
    """A row a start: how long the best exploration is, from below and above."""
    rows = []
    for p in study["plans"]:
        plan = plans.get(p["hash"])
        for seed in study["seeds"]:
            b = bounds.get((p["hash"], seed))
            if b is not None:
                area = f"{plan.area:.0f}" if plan is not None else "-"
                rows.append([p["name"], area, str(seed), f"{b.lower:.1f}", f"{b.sensing:.1f}", f"{b.stops:.1f}",
                             f"{b.gap:.3f}"])  # fmt: skip
    if not rows:
        return None
    gaps = [b.gap for b in bounds.values()]
    return {
        "text": "Ways on which all that can be seen is seen, m: the proven lower bound (a sensor of this range that "
        "looks all round, all the time), the best known tour of such a sensor, and the best known one that scans at "
        f"stops. Gap: the second over the first; median {np.median(gaps):.3f}, largest {max(gaps):.3f}.",
        "header": ("plan", "m²", "seed", "lower", "sensing", "stops", "gap"),
        "rows": rows,
    }


def _set_up(
    manifest: Mapping[str, Any],
    config: EnvConfig,
    records: Sequence[EpisodeRecord],
    plans: Mapping[str, FloorPlan | None],
) -> dict[str, Any]:
    study = manifest["study"]
    values, default = dict(_flat(to_mapping(config))), dict(_flat(to_mapping(EnvConfig())))
    for name in FIELDS:
        values.pop(f"exploration.{name}")
    fields = [
        [name, f"{value}", "" if value == default[name] else f"{default[name]}"] for name, value in values.items()
    ]
    kinds = {r.plan_hash: r.stratum for r in records}
    rows = []
    for p in study["plans"]:
        plan = plans.get(p["hash"])
        area = f"{plan.area:.0f}" if plan is not None else "-"
        rows.append([p["name"], area, kinds.get(p["hash"], "-") or "-", p["group"], p["hash"][:12]])
    return {
        "versions": [[name, str(version)] for name, version in manifest.get("versions", {}).items()],
        "configuration": sorted(fields, key=lambda row: row[2] == ""),
        "changed": sum(row[2] != "" for row in fields),
        "settings": [
            [str(setting), *(str(getattr(setting.configured(config).exploration, name)) for name in FIELDS)]
            for setting in _settings(study)
        ],
        "settings_header": ("setting", *FIELDS),
        "policies": [[name, str(spec)] for name, spec in study["policies"].items()],
        "plans": rows,
        "plans_header": ("name", "m²", "family", "building", "hash"),
    }


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _is_numeric(rows: Sequence[Sequence[str]], column: int) -> bool:
    """Whether a column holds figures, to be aligned to the right."""
    return all(str(row[column])[:1].isdigit() or str(row[column])[:1] in "<-" for row in rows)


def _image(figure: Figure, text: str, caption: str = "") -> Image:
    from PIL import Image as Pillow

    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=_DPI)
    picture = Pillow.open(file).convert("RGB")  # all is opaque
    file = io.BytesIO()
    picture.save(file, "PNG", optimize=True)
    data = base64.b64encode(file.getvalue()).decode()
    return Image(f"data:image/png;base64,{data}", text, picture.width // 2, picture.height // 2, caption)
