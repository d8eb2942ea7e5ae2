"""The page of a small real study: read as a browser would, with an HTML parser."""

import base64
import csv
import io
import json
import shutil
import sys
from html.parser import HTMLParser
from pathlib import Path

import fake_env
import numpy as np
import pytest
from PIL import Image

from polyexplore_gym.cli import main
from polyexplore_gym.config import DriveConfig, EnvConfig, ExplorationConfig, SensorConfig
from polyexplore_gym.errors import MissingDependencyError, ResultsError
from polyexplore_gym.evaluation import Setting, Study, evaluate, name_policies, read_records, summarize, write_tables
from polyexplore_gym.evaluation.report import render_report, write_report
from polyexplore_gym.evaluation.results import EPISODES, MANIFEST, read_plan
from polyexplore_gym.evaluation.tables import summary_tables
from polyexplore_gym.floorplan import FloorPlan

SETTINGS = ["midpoint", "midpoint, moving"]
ROOMS = np.array([[0, 0], [9, 0], [9, 4], [5, 4], [5, 6], [9, 6], [9, 9], [0, 9], [0, 5], [3, 5], [3, 4], [0, 4]])


class Broken:
    """Fails on large plans."""

    def act(self, observation, info, rng):
        if observation["node_position"].max() > 9.5:
            raise KeyError("<script>alert('weights & biases')</script>")
        return int(np.flatnonzero(observation["action_mask"])[0])


class Page(HTMLParser):
    """What is on a page: text, tables as rows of cells by section, images, and everything that points elsewhere."""

    VOID = ("meta", "link", "img", "br")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.section = ""
        self.text = ""
        self.tables: dict[str, list[list[list[str]]]] = {}
        self.images: list[dict[str, str]] = []
        self.links: list[str] = []
        self.ids: list[str] = []
        self.tags: set[str] = set()
        self.style = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.tags.add(tag)
        if tag not in self.VOID:
            self.open.append(tag)
        self.ids += [values["id"]] if "id" in values else []
        if tag in ("section", "header"):
            self.section = values.get("id", "")
        if tag == "table":
            self.tables.setdefault(self.section, []).append([])
        if tag == "tr":
            self.tables[self.section][-1].append([])
        if tag in ("td", "th"):
            self.tables[self.section][-1][-1].append("")
        if tag == "img":
            self.images.append(values)
        self.links += [values[name] for name in ("src", "href", "srcset", "data", "action") if name in values]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, f"</{tag}> closes another element"

    def handle_data(self, data):
        if "style" in self.open:
            self.style += data
            return
        self.text += data
        if self.open and self.open[-1] in ("td", "th"):
            self.tables[self.section][-1][-1][-1] += data


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("results") / "my study"
    kinds = {1.2: "large", 1.0: "small", 0.8: "small", 0.7: "small"}
    plans = [
        FloorPlan.create(ROOMS * scale, name=f"rooms <{scale}>", meta={"kind": kind}) for scale, kind in kinds.items()
    ]
    study = Study(
        policies=name_policies(["random", "nearest", "modified_sum", f"{__name__}:Broken"]),
        plans=plans,
        sensing=("stops", "moving"),
        seeds=(0, 5),
        config=EnvConfig(
            drive=DriveConfig(mode="kinematic"),
            sensor=SensorConfig(beams=181),
            exploration=ExplorationConfig(scan_every=0.25),
        ),
    )
    records = evaluate(study, out=folder, progress=False)
    write_tables(summarize(records, np.random.default_rng(0)), folder)
    return folder


@pytest.fixture(scope="module")
def page(results) -> Page:
    return Page(write_report(results, runs=2).read_text(encoding="utf-8"))


def test_the_page_stands_on_its_own(page):
    assert not page.open
    assert not page.tags & {"script", "iframe", "object", "embed"}
    assert len(page.ids) == len(set(page.ids))
    for link in page.links:
        assert link.startswith(("data:", "#")), link[:80]
        assert not link.startswith("#") or link[1:] in page.ids
    assert "url(" not in page.style
    assert "@import" not in page.style


def test_every_picture_decodes_and_has_a_text(page):
    # Profiles, curves, ratios and probabilities: one a setting, and those between the settings; two runs of two.
    assert len(page.images) >= 2 + 2 + 3 + 3 + 4
    for image in page.images:
        assert len(image["alt"]) > 5
        head, _, data = image["src"].partition(",")
        assert head == "data:image/png;base64"
        with Image.open(io.BytesIO(base64.b64decode(data, validate=True))) as picture:
            picture.load()
            assert picture.width // 2 == int(image["width"])
            assert np.asarray(picture).std() > 5


def test_tables_hold_the_figures_of_the_summary(page, results):
    header, *rows = page.tables["results"][0]
    expected = list(csv.DictReader(io.StringIO((results / "summary.csv").read_text())))
    assert len(rows) == len(expected) == 8
    for row, figures in zip(rows, expected, strict=True):
        cells = dict(zip(header, row, strict=True))
        setting = Setting(figures["placement"], figures["sensing"])
        assert (cells["setting"], cells["policy"]) == (str(setting), figures["policy"])
        assert cells["complete"].split()[0] == f"{figures['complete']}/{figures['episodes']}"
        if figures["distance_mean"]:
            mean, low, high = (float(part.strip("[],")) for part in cells["distance"].split())
            for found, name in ((mean, "mean"), (low, "mean_low"), (high, "mean_high")):
                assert found == pytest.approx(float(figures[f"distance_{name}"]), abs=0.0501)
    records = sorted(read_records(results), key=lambda r: r.key)
    ratios = {(row[0], row[1], row[2]): row for table in page.tables["results"][1:] for row in table[1:]}
    done = {(r.policy, str(r.setting), *r.pair): r.distance for r in records if r.ended}
    common = {(h, s) for p, where, h, s in done if where == "midpoint"}
    common = {pair for pair in common if all((p, "midpoint", *pair) in done for p in ("nearest", f"{__name__}:Broken"))}
    logs = [np.log(done["random", "midpoint", *k] / done["nearest", "midpoint", *k]) for k in common]
    found = float(ratios["midpoint", "random", "nearest"][4].split()[0])
    assert found == pytest.approx(np.exp(np.mean(logs)), abs=0.00051)
    # All cells are those of the terminal's tables, in their order.
    order = [p["hash"] for p in json.loads((results / MANIFEST).read_text())["study"]["plans"]]
    policies = ["random", "nearest", "modified_sum", f"{__name__}:Broken"]
    records.sort(
        key=lambda r: (order.index(r.plan_hash), r.seed, SETTINGS.index(str(r.setting)), policies.index(r.policy))
    )
    tables = summary_tables(summarize(records, np.random.default_rng(0)))
    assert [[list(header), *rows] for _, header, rows in tables] == page.tables["results"]


def test_failures_parts_and_set_up_are_told(page, results):
    failed = [r for r in read_records(results) if r.status == "failed"]
    assert failed
    rows = page.tables["failures"][0][1:]
    assert sum(row[4] == "failed" for row in rows) == len(failed)
    assert {row[-1] for row in rows if row[4] == "failed"} == {r.error for r in failed}  # as text, not as a script
    assert "rooms <1.2>" in page.text
    for table, setting in zip(page.tables["breakdown"], SETTINGS, strict=True):
        assert table[0] == ["plans", "starts", "random", "modified_sum", f"{__name__}:Broken"]
        starts = {row[0]: int(row[1]) for row in table[1:]}
        assert starts.keys() == {"large", "small", "up to 100 m²", "100 to 500 m²"}
        assert starts["small"] == starts["up to 100 m²"]
        assert starts["small"] <= 6, setting
    versions = dict(page.tables["set-up"][0][1:])
    assert versions["numpy"] == np.__version__
    configuration = {row[0]: row[1:] for row in page.tables["set-up"][1][1:]}
    assert configuration["sensor.beams"] == ["181", "361"]
    assert configuration["drive.mode"] == ["kinematic", "physics"]
    assert "2 changed from the default" in page.text
    assert len(page.tables["set-up"][-1]) == 5
    assert "32 of 32" not in page.text
    assert "64 of 64" in page.text
    assert "missing" not in page.ids


def test_jump_edges_that_are_left_are_told(tmp_path):
    plans = [fake_env.plan(0, left=2), fake_env.plan(1), fake_env.plan(2)]
    study = Study(policies=name_policies(["nearest", "random"]), plans=plans)
    evaluate(study, out=tmp_path, progress=False, make_env=fake_env.FakeEnv)
    page = Page(render_report(tmp_path, runs=0, make_env=fake_env.FakeEnv))
    header, *rows = page.tables["failures"][0]
    assert [dict(zip(header, row, strict=True)) for row in rows] == [
        {"policy": policy, "setting": "midpoint", "plan": "square 0", "seed": "0", "what": "unreached", "m": row[5],
         "seen %": "100.0", "edges left": "3, 3.0 m", "error": ""}
        for policy, row in zip(("nearest", "random"), rows, strict=True)
    ]  # fmt: skip
    assert "2 episodes that are compared left jump edges: 4 (5.0 m) out of reach, 2 (1.0 m) given up" in page.text
    header, *rows = page.tables["results"][0]
    assert {dict(zip(header, row, strict=True))["complete"] for row in rows} == {"2/3 (1 unreached)"}


def test_both_ways_to_sense_stand_side_by_side(page, results):
    records = read_records(results)
    assert list(dict.fromkeys(row[0] for row in page.tables["results"][0][1:])) == SETTINGS
    assert {(row[0], row[2]) for row in page.tables["results"][2][1:]} == {(SETTINGS[1], SETTINGS[0])}
    header, *rows = page.tables["ends"][0]
    assert header[:3] == ["setting", "policy", "drives"]
    assert {"arrived %", "settled %"} <= set(header)
    assert [row[0] for row in rows] == [label for label in SETTINGS for _ in range(4)]
    for row in rows:
        own = [r.ends for r in records if [str(r.setting), r.policy] == row[:2]]
        drives = sum(sum(ends.values()) for ends in own)
        assert int(row[2]) == drives
        for name, share in zip(header[3:], row[3:], strict=True):
            count = sum(ends.get(name.removesuffix(" %"), 0) for ends in own)
            assert (share == "-") == (count == 0)
            assert share == "-" or float(share) == pytest.approx(100 * count / drives, abs=0.0051)
    (settings,) = (t for t in page.tables["set-up"] if t[0][0] == "setting")
    assert settings[1:] == [
        ["midpoint", "midpoint", "0.0", "arrival"],
        ["midpoint, moving", "midpoint", "0.25", "settled"],
    ]


def test_runs_are_drawn_as_they_were(page):
    assert "another way now" not in page.text
    assert "cannot be drawn" not in page.text
    titles = [image["alt"] for image in page.images if image["alt"].startswith("Way of")]
    assert len(titles) >= 4
    assert titles[1::2] == [f"Way of nearest{title[title.index(' on') :]}" for title in titles[::2]]


def test_plans_are_kept_with_the_results(results):
    for name, scale in (("rooms <1.2>", 1.2), ("rooms <0.7>", 0.7)):
        plan = FloorPlan.create(ROOMS * scale, name=name)
        kept = read_plan(results, plan.content_hash)
        assert kept == plan
        assert kept.meta["kind"] == ("large" if scale == 1.2 else "small")
    assert read_plan(results, "0" * 64) is None


def test_the_page_repeats(results):
    assert render_report(results, runs=1) == render_report(results, runs=1)


def test_a_killed_run_has_a_page_too(results, tmp_path):
    folder = tmp_path / "killed"
    shutil.copytree(results, folder)
    lines = (folder / EPISODES).read_bytes().splitlines(keepends=True)
    (folder / EPISODES).write_bytes(b"".join(lines[:21]) + lines[21][:100])
    shutil.rmtree(folder / "plans")  # as in a folder of an earlier version
    page = Page(render_report(folder))
    assert "43 of 64 episodes are missing" in page.text
    assert "damaged last line" in page.text
    assert "21 of 64" in page.text
    assert "does not hold the floor plans" in page.text
    counts = {tuple(row[:2]): row[2] for row in page.tables[""][0][1:]}
    found = [r for r in read_records(results) if (str(r.setting), r.policy) == ("midpoint", "nearest")]
    assert len(found) == 8
    assert counts["midpoint", "nearest"].endswith("of 8")
    assert sum(int(count.split()[0]) for count in counts.values()) == 43
    # A single episode is enough.
    (folder / EPISODES).write_bytes(lines[0])
    assert "63 of 64 episodes are missing" in Page(render_report(folder)).text


def test_folders_without_results_are_told(results, tmp_path, capsys, monkeypatch):
    assert main(["report", str(tmp_path / "nowhere")]) == 2
    assert "holds no results of polyexplore bench" in capsys.readouterr().err
    shutil.copy(results / MANIFEST, tmp_path)
    (tmp_path / EPISODES).write_bytes(b"")
    with pytest.raises(ResultsError, match="no episode has ended yet"):
        write_report(tmp_path)
    manifest = (tmp_path / MANIFEST).read_text()
    (tmp_path / MANIFEST).write_text(manifest.replace('"nearest"', '"other"'))
    shutil.copy(results / EPISODES, tmp_path)
    with pytest.raises(ResultsError, match="does not belong"):
        write_report(tmp_path)
    with pytest.raises(ResultsError, match="cannot be written"):
        write_report(results, tmp_path / "nowhere" / "page.html", runs=0)
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(MissingDependencyError, match=r"polyexplore-gym\[plots\]"):
        write_report(results)


def test_the_command_writes_the_page(results, tmp_path, capsys):
    out = tmp_path / "page.html"
    assert main(["report", str(results), "--out", str(out), "--runs", "0", "--reference", "random"]) == 0
    assert f"written: {out}" in capsys.readouterr().out
    page = Page(out.read_text(encoding="utf-8"))
    assert "runs" not in page.ids
    assert {row[2] for row in page.tables["results"][1][1:]} == {"random"}
