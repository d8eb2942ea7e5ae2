import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from fake_env import FakeEnv, Fussy, Rememberer, Stubborn, plan

from polyexplore_gym.config import EnvConfig, SensorConfig
from polyexplore_gym.errors import InvalidConfigError, ResultsError
from polyexplore_gym.evaluation import Study, evaluate, load_policy, name_policies, read_records
from polyexplore_gym.evaluation.episode import run_episode
from polyexplore_gym.evaluation.results import EPISODES, FORMAT, MANIFEST


def study(
    policies=("nearest", "random"),
    plans=3,
    seeds=(0, 1),
    placements=("midpoint", "in_front"),
    sensing=("stops",),
    **meta,
) -> Study:
    return Study(
        policies=name_policies(policies),
        plans=[plan(i, **meta) for i in range(plans)],
        seeds=seeds,
        placements=placements,
        sensing=sensing,
    )


def run(a_study, out=None, **options):
    return evaluate(a_study, out=out, progress=False, make_env=FakeEnv, **options)


def test_a_record_says_what_happened():
    (record,) = run(study(["nearest"], plans=1, seeds=(3,), placements=("midpoint",), group="b7", kind="home"))
    # The same by hand: nearest neighbour on the points that the environment draws.
    env = FakeEnv(EnvConfig())
    env.reset(seed=3, options={"plan": plan(0)})
    here, left, driven = np.array([1.0, 1.0]), list(range(8)), [0.0]
    while left:
        gaps = [float(np.hypot(*(env.nodes[i] - here))) for i in left]
        driven.append(driven[-1] + min(gaps))
        here = env.nodes[left.pop(int(np.argmin(gaps)))]
    coverage = [0.4 + 0.6 * i / 8 for i in range(9)]
    assert record.status == "complete"
    assert (record.group, record.stratum, record.drive) == ("b7", "home", "physics")
    assert (record.placement, record.sensing, record.ends) == ("midpoint", "stops", {"arrived": 8})
    np.testing.assert_allclose(record.curve_distance, driven, atol=1e-4)
    np.testing.assert_allclose(record.curve_coverage, coverage, atol=1e-6)
    assert record.distance == pytest.approx(driven[-1], abs=1e-6)
    # 90 % are first known after the seventh decision (0.925), 95 and 99 % after the last: no interpolation.
    assert record.distance_90 == pytest.approx(driven[7], abs=1e-6)
    assert record.distance_95 == record.distance_99 == record.distance
    assert (record.decisions, record.measurements, record.reward) == (8, 10, -8.0)
    assert record.sim_time == pytest.approx(2 * driven[-1], abs=1e-5)
    assert set(record.timing) == {"act_mean", "act_median", "act_max", "episode"}


def test_all_policies_meet_the_same_points_in_every_setting():
    seen = {}

    class Spy(FakeEnv):
        def reset(self, **kwargs):
            result = super().reset(**kwargs)
            c = self.config.exploration
            where = c.placement, c.scan_every, c.decide
            seen.setdefault((self.plan.name, kwargs["seed"]), []).append((where, self.nodes.tobytes()))
            return result

    a_study = study(["nearest", "largest", "random"], sensing=("stops", "moving"))
    records = evaluate(a_study, progress=False, make_env=Spy)
    settings = [("midpoint", 0.0, "arrival"), ("in_front", 0.0, "arrival"), ("midpoint", 0.5, "settled"),
                ("in_front", 0.5, "settled")]  # fmt: skip
    assert len(seen) == 6
    for starts in seen.values():
        assert [where for where, _ in starts] == [where for where in settings for _ in range(3)]
        assert len(set(starts)) == 4
    assert len({nodes for starts in seen.values() for _, nodes in starts}) == 24
    assert [str(setting) for setting in a_study.settings] == ["midpoint", "in_front", "midpoint, moving",
                                                              "in_front, moving"]  # fmt: skip
    assert [r.key for r in records] == [task.key for task in a_study.tasks()]
    assert {(r.sensing, *r.ends) for r in records} == {("stops", "arrived"), ("moving", "settled")}
    assert len({r.key for r in records}) == len(records) == 72


@pytest.mark.parametrize("policies", [("nearest", "random", "utility:rate=0.5"), None])
def test_records_do_not_depend_on_workers(policies, tmp_path):
    chosen = policies or [Rememberer(), "random"]
    one = run(study(chosen), tmp_path / "one", workers=1)
    two = run(study(chosen), tmp_path / "two", workers=2)
    assert one == two
    assert one[0].timing != two[0].timing or one[1].timing != two[1].timing
    assert read_records(tmp_path / "one") == read_records(tmp_path / "two") == sorted(one, key=lambda r: r.key)


def test_failures_and_truncations_are_recorded(tmp_path):
    records = run(study([Fussy(), Stubborn(), "nearest"], plans=8, seeds=(0,), budget=12), tmp_path)
    status = {name: {r.status for r in records if r.policy == name} for name in ("fussy", "stubborn", "nearest")}
    assert status == {"fussy": {"failed", "complete"}, "stubborn": {"truncated"}, "nearest": {"complete"}}
    failed = [r for r in records if r.status == "failed"]
    assert {r.error for r in failed} == {"RuntimeError: too large for me"}
    assert all(r.error is None for r in records if r.status != "failed")
    stubborn = next(r for r in records if r.policy == "stubborn")
    assert (stubborn.invalid_actions, stubborn.decisions) == (11, 12)
    assert stubborn.ends == {"arrived": 1, "invalid": 11}
    assert stubborn.distance_90 is None
    assert run(study([Fussy(), Stubborn(), "nearest"], plans=8, seeds=(0,), budget=12), tmp_path) == records


def test_jump_edges_that_are_left_are_recorded(tmp_path):
    (record,) = run(study(["nearest"], plans=1, seeds=(0,), placements=("midpoint",), left=2), tmp_path)
    assert (record.status, record.complete, record.ended) == ("unreached", False, True)
    left = record.unreached, record.unreached_length, record.given_up, record.given_up_length
    assert left == (2, 2.5, 1, 0.5)
    assert read_records(tmp_path) == [record]
    (cut,) = run(study([Stubborn()], plans=1, seeds=(0,), placements=("midpoint",), left=2, budget=3))
    assert (cut.status, cut.ended, cut.unreached) == ("truncated", False, 2)
    (seen,) = run(study(["nearest"], plans=1, seeds=(0,), placements=("midpoint",), seen_at_once=True, left=1))
    assert (seen.status, seen.decisions, seen.unreached, seen.given_up) == ("unreached", 0, 1, 0)


def test_an_end_without_a_word_is_no_result():
    class Silent(FakeEnv):
        def _info(self, truncated):
            info = super()._info(truncated)
            info["outcome"]["status"] = "running"
            return info

    record = run_episode(Silent(EnvConfig()), load_policy("nearest"), plan(0), 0, label="nearest")
    assert record.status == "failed"
    assert "info['outcome'] says 'running'" in record.error


def test_an_action_that_is_none_fails_the_episode_only():
    class Mute:
        def act(self, observation, info, rng):
            return None

    record = run_episode(FakeEnv(EnvConfig()), Mute(), plan(0), 0, label="mute")
    assert record.status == "failed"
    assert "None" in record.error
    assert record.curve_distance == (0.0,)


def test_a_plan_seen_from_the_start_is_complete():
    (record,) = run(study(["nearest"], plans=1, seeds=(0,), placements=("midpoint",), seen_at_once=True))
    assert (record.status, record.distance, record.decisions, record.distance_99) == ("complete", 0.0, 0, 0.0)


def test_resuming_runs_only_what_is_missing(tmp_path):
    whole = run(study(), tmp_path)
    path = tmp_path / EPISODES
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:5]))
    ran = []

    class Counting(FakeEnv):
        def reset(self, **kwargs):
            ran.append(kwargs["seed"])
            return super().reset(**kwargs)

    assert evaluate(study(), out=tmp_path, progress=False, make_env=Counting) == whole
    assert len(ran) == len(whole) - 5
    assert path.read_bytes().splitlines()[:5] == [line.rstrip(b"\n") for line in lines[:5]]


def test_a_damaged_last_line_is_run_again(tmp_path):
    whole = run(study(), tmp_path)
    path = tmp_path / EPISODES
    data = path.read_bytes()
    last = data.splitlines(keepends=True)[-1]
    for damage in (
        last[: len(last) // 2],
        last[:-1],
        b"\0" * 300,
        b"\0" * 30 + b"\n",
        b'{"policy": 1}\n',
        b"\xff\xfe\n",
    ):
        path.write_bytes(data[: -len(last)] + damage)
        with pytest.warns(UserWarning, match=rf"{EPISODES}:{len(whole)}: damaged last line"):
            assert len(read_records(tmp_path)) == len(whole) - 1
        with pytest.warns(UserWarning, match="damaged last line"):
            assert run(study(), tmp_path) == whole
        assert len(path.read_bytes().splitlines()) == len(whole)
        assert run(study(), tmp_path) == whole


def test_a_damaged_middle_line_stops_with_its_number(tmp_path):
    run(study(), tmp_path)
    path = tmp_path / EPISODES
    lines = path.read_bytes().splitlines(keepends=True)
    for damage in (lines[2][:40] + b"\n", b"\n", lines[2].replace(b'"seed":', b'"sed":'), lines[1]):
        path.write_bytes(b"".join([*lines[:2], damage, *lines[3:]]))
        for read in (lambda: run(study(), tmp_path), lambda: read_records(tmp_path)):
            with pytest.raises(ResultsError, match=rf"{EPISODES}:3: damaged line"):
                read()
    value = json.loads(lines[2])
    wrongs = [("status", "odd"), ("distance", "far"), ("seed", 1.5), ("policy", None), ("coverage", None)]
    wrongs += [("sensing", "odd"), ("ends", 3), ("ends", {"arrived": "often"}), ("ends", {"arrived": True})]
    wrongs += [("curve_distance", [0.0]), ("curve_distance", 3), ("curve_coverage", ["x"])]
    for field, wrong in wrongs:
        path.write_bytes(b"".join([*lines[:2], json.dumps({**value, field: wrong}).encode() + b"\n", *lines[3:]]))
        with pytest.raises(ResultsError, match=rf"{EPISODES}:3: damaged") as caught:
            run(study(), tmp_path)
        assert field in str(caught.value) or wrong == 3


def test_a_folder_of_another_study_is_refused(tmp_path):
    run(study(), tmp_path)
    others = {
        r"study\.seeds has 2 entries there, 3 here": study(seeds=(0, 1, 2)),
        r"study\.seeds\[1\] is 1 there, 4 here": study(seeds=(0, 4)),
        r"study\.policies\.largest": study(["nearest", "random", "largest"]),
        r"study\.placements": study(placements=("midpoint",)),
        r"study\.sensing\[0\] is 'stops' there, 'moving' here": study(sensing=("moving",)),
        r"study\.config\.sensor\.beams is 361 there, 181 here": Study(
            policies=name_policies(["nearest", "random"]),
            plans=study().plans,
            seeds=(0, 1),
            placements=("midpoint", "in_front"),
            config=EnvConfig(sensor=SensorConfig(beams=181)),
        ),
        r"study\.plans\[0\]\.name": Study(
            policies=name_policies(["nearest", "random"]),
            plans=[plan(7), *study().plans[1:]],
            seeds=(0, 1),
            placements=("midpoint", "in_front"),
        ),
    }
    for message, other in others.items():
        with pytest.raises(ResultsError, match=message):
            run(other, tmp_path)
    manifest = json.loads((tmp_path / MANIFEST).read_text())
    assert set(manifest["versions"]) >= {
        "polyexplore-gym",
        "python",
        "numpy",
        "numba",
        "pymunk",
        "shapely",
        "gymnasium",
    }
    manifest["versions"]["numba"] = "0.1"
    (tmp_path / MANIFEST).write_text(json.dumps(manifest))
    with pytest.warns(UserWarning, match=r"numba 0\.1 then"):
        run(study(), tmp_path)
    manifest["versions"]["polyexplore-gym"] = "0.0.1"
    (tmp_path / MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(ResultsError, match=r"0\.0\.1"):
        run(study(), tmp_path)
    (tmp_path / MANIFEST).write_text("{")
    with pytest.raises(ResultsError, match=MANIFEST):
        run(study(), tmp_path)
    (tmp_path / MANIFEST).unlink()
    with pytest.raises(ResultsError, match="no manifest"):
        run(study(), tmp_path)


def test_a_folder_of_an_older_version_is_refused(tmp_path):
    run(study(), tmp_path)
    manifest = json.loads((tmp_path / MANIFEST).read_text())
    (tmp_path / MANIFEST).write_text(json.dumps({**manifest, "format": FORMAT - 1}))
    for read in (lambda: run(study(), tmp_path), lambda: read_records(tmp_path)):
        with pytest.raises(
            ResultsError, match=f"results in format {FORMAT - 1}, this version .* {FORMAT}: choose another"
        ):
            read()


def test_folders_that_cannot_be_used(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(ResultsError, match="cannot be used"):
        run(study(), blocked)
    with pytest.raises(ResultsError, match="cannot be read"):
        read_records(tmp_path / "nothing")


def test_two_runs_do_not_write_into_one_folder(tmp_path):
    from polyexplore_gym.evaluation.results import ResultsFile

    pytest.importorskip("fcntl")
    run(study(), tmp_path)
    with ResultsFile(tmp_path), pytest.raises(ResultsError, match="another run"):
        run(study(), tmp_path)
    run(study(), tmp_path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"policies": []}, "policies"),
        ({"seeds": ()}, "seeds"),
        ({"seeds": (1, 1)}, "twice"),
        ({"seeds": (-1,)}, "seeds"),
        ({"placements": ("middle",)}, "placement"),
        ({"sensing": ("fast",)}, "sensing = 'fast': must be one of stops, passing, moving"),
        ({"sensing": ("stops", "stops")}, r"study\.sensing.*twice"),
        ({"sensing": ()}, r"study\.sensing: is empty"),
        ({"plans": 0}, "plans"),
        ({"policies": ["nearest", "nearest"]}, "two policies"),
    ],
)
def test_bad_studies(arguments, message):
    with pytest.raises(InvalidConfigError, match=message):
        study(**arguments)


def test_plans_of_one_geometry_are_refused():
    with pytest.raises(InvalidConfigError, match="would count twice"):
        Study(policies=name_policies(["nearest"]), plans=[plan(1), plan(2), plan(1)])


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("nearst", "nearst.*nearest"),
        ("utility:rate=x", "rate"),
        ("utility:speed=1", "speed"),
        ("utility:rate=0.1,2=3", "name=value"),
        ("no.such.module:Thing", "no.such.module"),
        ("math:Thing", "Thing"),
        ("math:pi", "neither"),
        ("math:tau.real", "neither"),
        (object(), "act"),
    ],
)
def test_policies_that_cannot_be_made(spec, message):
    with pytest.raises(InvalidConfigError, match=message):
        load_policy(spec)


def test_own_policies_by_import_string():
    assert isinstance(load_policy("fake_env:Rememberer"), Rememberer)
    assert load_policy("utility:rate=0.5").rate == 0.5
    records = run(study(["fake_env:Rememberer", Rememberer()], plans=1))
    by_name = {name: [r for r in records if r.policy == name] for name in ("fake_env:Rememberer", "rememberer")}
    assert [r.distance for r in by_name["fake_env:Rememberer"]] == [r.distance for r in by_name["rememberer"]]


SCRIPT = """
import sys
sys.path.insert(0, {tests!r})
from test_runner import study, run
run(study(["nearest", "random", "largest"], plans=5, seeds=(0, 1), pause=0.004), {out!r}, workers={workers})
print("finished", flush=True)
"""


def heed_control_c() -> None:
    """A shell starts what it puts into the background deaf to Ctrl-C, and children of it stay so."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def start(out: Path, workers: int, **options) -> subprocess.Popen:
    script = SCRIPT.format(tests=str(Path(__file__).parent), out=str(out), workers=workers)
    return subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        **{"preexec_fn": heed_control_c, **options},
    )


@pytest.mark.parametrize("workers", [1, 2])
def test_killed_runs_end_with_the_same_records(tmp_path, workers):
    whole = run(study(["nearest", "random", "largest"], plans=5, seeds=(0, 1), pause=0.004))
    chance = random.Random(workers)
    path = tmp_path / EPISODES
    kills = 0
    for _ in range(40):
        before = path.stat().st_size if path.exists() else 0
        process = start(tmp_path, workers)
        # Wait until it writes, then kill it at a random moment: how fast the machine is does not matter.
        while process.poll() is None and (path.stat().st_size if path.exists() else 0) == before:
            time.sleep(0.005)
        time.sleep(chance.uniform(0.0, 0.5))
        if process.poll() is None and kills < 4:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            kills += 1
            if kills % 2 == 0:  # as if it had been hit in the middle of a write
                path.write_bytes(path.read_bytes()[:-50])
            continue
        out, err = process.communicate()
        assert process.returncode == 0, err.decode()
        assert b"finished" in out
        break
    assert kills >= 1
    assert read_records(tmp_path) == sorted(whole, key=lambda r: r.key)


@pytest.mark.parametrize("workers", [1, 2])
def test_control_c_stops_and_keeps_what_was_done(tmp_path, workers):
    process = start(tmp_path, workers)
    path = tmp_path / EPISODES
    while process.poll() is None and not (path.exists() and path.stat().st_size > 0):
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode != 0
    kept = read_records(tmp_path)
    assert kept
    whole = run(study(["nearest", "random", "largest"], plans=5, seeds=(0, 1), pause=0.004), tmp_path)
    assert {r.key for r in kept} <= {r.key for r in whole}
    assert len(whole) == 60


def test_a_full_disk_loses_nothing_that_was_written(tmp_path):
    resource = pytest.importorskip("resource")

    def limit() -> None:  # a write beyond it is cut short, as on a full disk
        resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))

    process = start(tmp_path, 1, preexec_fn=limit)
    _, err = process.communicate()
    assert process.returncode != 0
    assert "ResultsError" in err.decode()
    assert "are safe" in err.decode()
    kept = read_records(tmp_path)  # a partial line would warn, and warnings from here are errors below
    assert len(kept) >= 2
    whole = run(study(["nearest", "random", "largest"], plans=5, seeds=(0, 1), pause=0.004))
    assert all(record in whole for record in kept)


def test_a_dead_worker_is_told(tmp_path):
    class Deadly:
        name = "deadly"

        def act(self, observation, info, rng):
            os.kill(os.getpid(), signal.SIGKILL)

    with pytest.raises(ResultsError, match="worker process died"):
        run(study(["nearest", Deadly()]), tmp_path, workers=2)
