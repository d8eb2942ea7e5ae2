import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from polyexplore_gym.cli import BENCH_PLANS, COMPARED, LOOK_AHEAD, SCRIPTED, main
from polyexplore_gym.evaluation import read_manifest, read_records
from polyexplore_gym.floorplan import FloorPlan, load_plan, save_plan

ROOMS = [[0, 0], [9, 0], [9, 4], [5, 4], [5, 6], [9, 6], [9, 9], [0, 9], [0, 5], [3, 5], [3, 4], [0, 4]]


class Broken:
    """A policy of a user's own, with a fault."""

    def act(self, observation, info, rng):
        raise KeyError("weights")


@pytest.fixture
def folder(tmp_path) -> Path:
    """Two plans, one of them twice, a broken one and what is no plan at all."""
    plans = tmp_path / "plans"
    plans.mkdir()
    save_plan(FloorPlan.create(ROOMS, name="rooms"), plans / "rooms.json")
    save_plan(FloorPlan.create(ROOMS, name="again"), plans / "zz_again.json")
    save_plan(FloorPlan.create(np.array(ROOMS) * 0.8, name="small"), plans / "small.geojson")
    (plans / "bow_tie.json").write_text(json.dumps({"exterior": [[0, 0], [2, 2], [2, 0], [0, 2]]}))
    (plans / "half.json").write_text('{"exterior": [[0, 0], [')
    (plans / "README.md").write_text("no plan")
    return plans


def bench(*arguments: object) -> int:
    return main(["bench", "--drive", "kinematic", "--workers", "1", *map(str, arguments)])


def test_help_is_light():
    code = (
        "import sys, polyexplore_gym.cli\n"
        "heavy = {'torch', 'matplotlib', 'numba', 'shapely', 'cv2', 'scipy', 'pygame', 'pymunk', 'joblib'}\n"
        "sys.exit(' '.join(heavy & set(sys.modules)) or 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    result = subprocess.run(
        [sys.executable, "-m", "polyexplore_gym.cli", "bench", "--help"], capture_output=True, text=True
    )
    assert result.returncode == 0
    assert "--placements" in result.stdout


def test_a_folder_is_compared(folder, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ("--plans", folder, "--policies", "nearest", "random", "--seeds", 2, "--out", out)
    assert bench(*arguments) == 0
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert any(line.startswith("left out:") and "bow_tie.json" in line for line in lines)
    assert any(line.startswith("left out:") and "half.json" in line for line in lines)
    assert any(line.startswith("left out:") and "zz_again.json: the same geometry as" in line for line in lines)
    assert "README" not in captured.err
    assert "2 plans x 2 starts x 4 settings x 2 policies = 32 episodes" in captured.err
    records = read_records(out)
    assert len(records) == 32
    assert all(r.ended for r in records)
    assert {r.drive for r in records} == {"kinematic"}
    assert {r.plan for r in records} == {"rooms", "small"}
    assert {p["name"] for p in read_manifest(out)["study"]["plans"]} == {"rooms", "small"}
    assert min(r.coverage for r in records) > 0.97
    ways = [f"trajectories-{placement}{end}" for placement in ("midpoint", "in_front") for end in ("", "-moving")]
    for name in ("coverage", "ratios", *ways):
        assert (out / f"{name}.png").stat().st_size > 5000
    # What is printed is what the records say.
    nearest = [r.distance for r in records if (r.policy, str(r.setting)) == ("nearest", "midpoint")]
    row = next(line.split() for line in captured.out.splitlines() if line.split()[:2] == ["midpoint", "nearest"])
    assert float(row[3]) == pytest.approx(np.mean(nearest), abs=0.051)
    assert "midpoint, moving: compared on 4 of 4 starts" in captured.out
    # The same start for all: coverage is the same before the first decision.
    starts = {(r.plan, r.seed, r.curve_coverage[0]) for r in records}
    assert len(starts) == 4
    # Once more: nothing is left to run, and the tables are the same but for nothing.
    assert bench(*arguments, "--no-plots") == 0
    assert capsys.readouterr().out == captured.out
    # Another study does not get in.
    assert bench(*arguments[:-3], 3, "--out", out) == 2
    assert "study.seeds" in capsys.readouterr().err


def test_no_usable_plan_is_an_error(folder, tmp_path, capsys):
    for bad in (folder / "bow_tie.json", folder / "README.md", tmp_path / "missing.json"):
        assert bench("--plans", bad, "--out", tmp_path / "out") == 2
        error = capsys.readouterr().err
        assert f"left out: {bad}" in error
        assert error.splitlines()[-1].startswith("error: no usable floor plan")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["bench", "--suite", "home-tset"], "home-tset"),
        (["bench", "--suite", "home-test", "--plans", "x.json"], "either"),
        (["bench", "--seeds", "0"], "--seeds 0"),
        (["bench", "--first", "0"], "--first 0"),
        (["bench", "--policies", "neerest"], "neerest"),
        (["bench", "--policies", "nearest", "nearest"], "two policies"),
        (["bench", "--config", "nowhere.json"], "nowhere.json"),
        (["run", "home-test/50"], "0 to 49"),
        (["run", "nowhere.json"], "nowhere.json"),
        (["run", "home-test/0", "--policy", "no.module:x"], "no.module"),
        (["run", "home-test/0", "--gif", "film.mov"], "film.mov"),
        (["run", "home-test/0", "--png", "nowhere/x.png"], "nowhere"),
        (["run", "home-test/0", "--start", "-50", "0", "0"], "start"),
        (["run", "home-test/0", "--step", "-1"], "--step"),
        (["run", "home-test/0", "--seed", "-1"], "seed"),
        (["linemap", "nowhere.log"], "nowhere.log: does not exist"),
        (["linemap", "."], "is a folder"),
        (["linemap", "x.log", "--out", "map.bmp"], "map.bmp"),
        (["linemap", "x.log", "--out", "nowhere/map.json"], "nowhere"),
        (["linemap", "x.log", "--width", "10"], "--width 10"),
        (["linemap", "x.log", "--field-of-view", "400"], "--field-of-view 400"),
        (["linemap", "x.log", "--merge-gate", "0"], "merge_gate"),
    ],
)
def test_bad_input_is_one_line(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("error: ")
    assert message in last


def test_a_configuration_file(folder, tmp_path, capsys):
    config = tmp_path / "config.json"
    config.write_text(json.dumps({"sensor": {"beams": 181}, "drive": {"mode": "kinematic"}}))
    arguments = [
        "--plans",
        str(folder / "rooms.json"),
        "--policies",
        "nearest",
        "--placements",
        "in_front",
        "--no-plots",
    ]
    out = tmp_path / "out"
    assert main(["bench", *arguments, "--config", str(config), "--workers", "1", "--out", str(out)]) == 0
    assert read_manifest(out)["study"]["config"]["sensor"]["beams"] == 181
    assert {(r.placement, r.drive) for r in read_records(out)} == {("in_front", "kinematic")}
    out = tmp_path / "preset"
    command = ["bench", *arguments, "--preset", "turtlebot4", "--config", str(config), "--workers", "1"]
    assert main([*command, "--out", str(out)]) == 0
    kept = read_manifest(out)["study"]["config"]
    assert (kept["sensor"]["beams"], kept["sensor"]["max_range"], kept["robot"]["radius"]) == (181, 12.0, 0.17)
    config.write_text(json.dumps({"sensor": {"beems": 181}}))
    assert main(["bench", *arguments, "--config", str(config)]) == 2
    error = capsys.readouterr().err
    assert "beems" in error
    assert "config.json.sensor" in error


def test_what_is_left_is_told(folder, capsys, monkeypatch):
    from polyexplore_gym.explorer import Explorer

    left = {"status": "unreached", "unreached": 3, "unreached_length": 2.5, "given_up": 1, "given_up_length": 0.75}
    monkeypatch.setattr(Explorer, "outcome", lambda self, budget=False: left)
    assert main(["run", str(folder / "rooms.json"), "--drive", "kinematic"]) == 0
    told = capsys.readouterr().out.splitlines()[0]
    assert told.endswith("kinematic: unreached, 3 jump edges (2.5 m) out of reach, 1 jump edges (0.8 m) given up")


def test_a_robot_that_senses_on_the_way(folder, tmp_path, capsys):
    command = ["run", str(folder / "rooms.json"), "--drive", "kinematic"]
    told = {}
    for sensing in ("stops", "passing", "moving"):
        assert main([*command, "--sensing", sensing]) == 0
        told[sensing] = capsys.readouterr().out
    assert "nearest, midpoint, kinematic: complete" in told["stops"]
    assert "nearest, midpoint, passing, kinematic: complete" in told["passing"]
    assert "settled" in told["moving"]
    assert "settled" not in told["stops"] + told["passing"]
    scans = [int(text.split("measurements")[1].split()[0]) for text in told.values()]
    assert scans[0] < min(scans[1:])
    # What the configuration says is kept, and the command goes before it.
    config = tmp_path / "config.json"
    config.write_text(json.dumps({"exploration": {"scan_every": 0.25, "decide": "interval", "decide_every": 0.25}}))
    assert main([*command, "--config", str(config)]) == 0
    often = capsys.readouterr().out
    assert "nearest, midpoint, moving, kinematic: complete" in often
    assert "interval" in often
    assert main([*command, "--config", str(config), "--sensing", "stops"]) == 0
    assert capsys.readouterr().out == told["stops"]


def test_a_robot_by_name(folder, capsys):
    assert main(["run", str(folder / "rooms.json"), "--preset", "turtlebot3", "--drive", "kinematic"]) == 0
    slow = capsys.readouterr().out
    assert main(["run", str(folder / "rooms.json"), "--drive", "kinematic"]) == 0
    assert slow != capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["run", str(folder / "rooms.json"), "--preset", "r2d2"])
    assert "turtlebot4" in capsys.readouterr().err


def test_one_plan_is_explored_and_filmed(folder, tmp_path, capsys):
    from PIL import Image

    arguments = ["run", str(folder / "rooms.json"), "--drive", "kinematic", "--start", "1", "1", "90"]
    assert main(arguments) == 0
    plain = capsys.readouterr().out
    assert "rooms" in plain
    assert "complete" in plain
    files = {kind: tmp_path / f"film.{kind}" for kind in ("gif", "mp4", "png")}
    options = [text for kind, path in files.items() for text in (f"--{kind}", str(path))]
    assert main([*arguments, *options, "--width", "240", "--step", "0"]) == 0
    out = capsys.readouterr().out
    assert out.startswith(plain)
    decisions = int(plain.split(" decisions")[0].split()[-1])
    with Image.open(files["gif"]) as film:
        assert film.n_frames >= decisions
        first = np.asarray(film.convert("RGB")).astype(int)
        film.seek(film.n_frames - 1)
        assert np.abs(np.asarray(film.convert("RGB")).astype(int) - first).max() > 50
    assert files["mp4"].stat().st_size > 2000
    with Image.open(files["png"]) as picture:
        assert picture.size[0] == 240


def test_a_plan_is_read_and_written(tmp_path, capsys):
    drawn = [
        [0, 0],
        [600, 0],
        [600, 200],
        [620, 200],
        [620, 0],
        [900, 0],
        [900, 400],
        [620, 400],
        [620, 250],
        [600, 250],
    ]
    (tmp_path / "a.json").write_text(json.dumps({"exterior": [*drawn, [600, 400], [0, 400]]}))
    out = [str(tmp_path / name) for name in ("b.json", "b.yaml", "b.geojson")]
    assert main(["plan", str(tmp_path / "a.json"), "--units", "cm", "--radius", "0.2", "--out", *out]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    assert "a: 35.3 m2, 9.00 x 4.00 m, 12 vertices, 0 holes" in captured.out
    assert (tmp_path / "b.pgm").exists()
    assert main(["plan", str(tmp_path / "b.yaml"), "--radius", "0.3", "--start", "8", "1"]) == 0
    captured = capsys.readouterr()
    assert "warning: " in captured.err
    assert "reaches 32 % of the floor" in captured.err
    assert captured.out.startswith("b: 11.")
    assert main(["plan", str(tmp_path / "b.json"), "--radius", "0.3", "--strict"]) == 2
    assert "strict: nothing may be left out" in capsys.readouterr().err
    assert main(["plan", str(tmp_path / "b.json"), "--out", str(tmp_path / "b.bmp")]) == 2
    assert "the name must end in" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main(["plan", str(tmp_path / "b.json"), "--snap", "nan"])
    assert "snap = nan: must be a finite number of metres" in " ".join(capsys.readouterr().err.split())


def test_the_robot_of_the_configuration_decides_what_is_kept(tmp_path, capsys):
    ring = [[0, 0], [6, 0], [6, 2], [6.2, 2], [6.2, 0], [9, 0], [9, 4], [6.2, 4], [6.2, 2.5], [6, 2.5], [6, 4], [0, 4]]
    save_plan(FloorPlan.create(ring, name="a"), tmp_path / "a.json")
    (tmp_path / "big.json").write_text(json.dumps({"robot": {"radius": 0.3}, "drive": {"mode": "kinematic"}}))
    run = ["run", str(tmp_path / "a.json"), "--config", str(tmp_path / "big.json")]
    assert main(run) == 0
    captured = capsys.readouterr()
    assert "a (24 m2)" in captured.out
    assert "reaches 68 % of the floor" in captured.err
    assert main([*run, "--start", "8", "1", "0"]) == 0
    assert "a (11 m2)" in capsys.readouterr().out


def carmen(path: Path, *junk: str) -> Path:
    """A log of a laser that turns in the middle of a square room of 4 m, with broken lines at its end."""
    angles = np.radians(np.arange(-90, 91))
    lines = []
    for heading in np.linspace(0, 2 * np.pi, 8, endpoint=False):
        ranges = 2.0 / np.maximum(np.abs(np.cos(angles + heading)), np.abs(np.sin(angles + heading)))
        lines.append(f"FLASER 181 {' '.join(f'{r:.2f}' for r in ranges)} 1 2 {heading} 0 0 0 0.5 host 0.5")
    path.write_text("\n".join([*lines, *junk]) + "\n")
    return path


def test_a_log_becomes_a_map(tmp_path, capsys):
    log, out = carmen(tmp_path / "room.log", "FLASER 181 1.0 2.0", "1 2 3"), tmp_path / "maps"
    assert main(["linemap", str(log), "--out", str(out), str(tmp_path / "b.json")]) == 0
    captured = capsys.readouterr()
    suffixes = ("geojson", "json", "pgm", "png", "svg", "yaml")
    assert sorted(path.name for path in out.iterdir()) == [f"room.{suffix}" for suffix in suffixes]
    assert (out / "room.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    assert "left out: line 9: 4 fields do not fit a FLASER message of 181 ranges" in captured.err
    assert "left out: line 10: not a CARMEN message" in captured.err
    assert "8 scans of 181 beams, 8 used, 2 broken" in captured.out
    data = json.loads((tmp_path / "b.json").read_text())
    assert len(data["lines"]) == 4
    assert f"points        {data['points']} (" in captured.out
    assert f"compression   {100 * (1 - 4 / data['points']):.2f} %" in captured.out
    ends = np.array([segment for line in data["lines"] for segment in line["segments"]])
    assert np.abs(ends).max() == pytest.approx(4.0, abs=0.02)  # the room goes from -1 to 3 and from 0 to 4
    # Progress with the time left, both when reading and for the scans.
    assert "8/8" in captured.err
    # Options reach the library.
    assert main(["linemap", str(log), "--out", str(tmp_path / "c.json"), "--every", "4", "--max-range", "2.5"]) == 0
    fewer = json.loads((tmp_path / "c.json").read_text())
    assert fewer["scans"] == 2
    assert 0 < fewer["points"] < data["points"] / 4


def test_a_log_becomes_a_floor_plan(tmp_path, capsys):
    log = carmen(tmp_path / "room.log")
    plans = [tmp_path / f"plan{suffix}" for suffix in (".json", ".geojson", ".svg", ".yaml")]
    command = ["linemap", str(log), "--out", str(tmp_path / "map.json"), "--plan"]
    assert main([*command, *map(str, plans)]) == 0
    captured = capsys.readouterr()
    assert "floor plan    16.0 m2, 4 vertices, 0 holes; unknown: 0.0 m of the walls (0.0 %) in 0 places" in captured.out
    assert "outline" in captured.err  # progress
    for path in plans:
        plan = load_plan(path)
        off = np.abs(np.array(plan.bounds) - (-1.0, 0.0, 3.0, 4.0))
        assert off.max() < (0.06 if path.suffix == ".yaml" else 0.01)
    assert load_plan(plans[0]).meta["unknown"] == []
    # What is told of, is told before the work.
    for bad, message in (("plan.bmp", "the name must end in .json"), ("no/plan.json", "does not exist")):
        assert main([*command, str(tmp_path / bad)]) == 2
        captured = capsys.readouterr()
        assert message in captured.err
        assert "scan/s" not in captured.err


def test_what_a_log_is_and_that_its_walls_do_not_fit_is_told(tmp_path, capsys):
    """The room again and again, but the poses say that the robot went on: no warning without a reason."""
    log = carmen(tmp_path / "room.log")
    assert main(["linemap", str(log), "--out", str(tmp_path / "a.json")]) == 0
    captured = capsys.readouterr()
    assert "poses         unknown: odom_x odom_y odom_theta do not move" in captured.out
    assert "misfit        0.0 %" in captured.out
    assert "warning" not in captured.err
    lines = []
    for k, line in enumerate(log.read_text().splitlines() * 3):
        fields = line.split()
        x, y, heading = 1 + 0.2 * k, 2 + 0.3 * (-1) ** k, float(fields[185]) + 0.3 * (-1) ** k
        fields[183:189] = map(str, (x, y, heading, x, y, heading))
        lines += [f"ODOM {x} {y} {heading} 0 0 0 {k + 1} h {k + 1}", " ".join([*fields[:189], str(k + 1), "h", "0"])]
    log.write_text("\n".join(lines))
    assert main(["linemap", str(log), "--out", str(tmp_path / "a.json")]) == 0
    captured = capsys.readouterr()
    assert "poses         odometry: x y theta go with odom_x odom_y odom_theta and the ODOM lines" in captured.out
    assert "warning: walls that were seen again do not fit: in half of the scans" in captured.err
    assert "raw odometry" in captured.err
    # a trajectory beside it that is right
    rows = [(k + 1, 1, 2, 0, 0, 0, np.sin(0.125 * np.pi * k), np.cos(0.125 * np.pi * k)) for k in range(24)]
    np.savetxt(tmp_path / "poses.txt", rows)
    assert (
        main(["linemap", str(log), "--trajectory-in", str(tmp_path / "poses.txt"), "--out", str(tmp_path / "b.json")])
        == 0
    )
    captured = capsys.readouterr()
    assert "warning" not in captured.err
    assert f"poses         corrected: poses of {tmp_path / 'poses.txt'}" in captured.out
    assert len(json.loads((tmp_path / "b.json").read_text())["lines"]) == 4


def test_a_bag_becomes_a_map(tmp_path, capsys):
    pytest.importorskip("rosbags")
    sys.path.insert(0, str(Path(__file__).parent / "mapping"))
    from bags import drive

    for kind in ("bag", "mcap"):
        path = drive(tmp_path / "round", kind)
        assert main(["linemap", str(path), "--topic", "/scan", "--out", str(tmp_path / "a.json")]) == 0
        captured = capsys.readouterr()
        assert "20 scans of 180 beams, 20 used, 0 broken" in captured.out
        assert "poses         corrected: /tf corrects the frame odom in map" in captured.out
        assert len(json.loads((tmp_path / "a.json").read_text())["lines"]) == 4
    assert main(["linemap", str(path), "--topic", "/scans", "--out", str(tmp_path / "b.json")]) == 2
    assert "topic /scans: not one of laser scans; those are: /scan" in capsys.readouterr().err
    assert not (tmp_path / "b.json").exists()


@pytest.fixture(scope="module")
def raw_log(tmp_path_factory) -> tuple[Path, np.ndarray]:
    """A CARMEN log of a drive round a block with raw odometry, and the true poses."""
    sys.path.insert(0, str(Path(__file__).parent / "mapping"))
    from slam_scenes import drive

    log, true = drive(np.random.default_rng(0), count=1)
    lines = []
    for ranges, pose, time in zip(log.ranges, log.poses, log.times, strict=True):
        x, y, heading = (f"{value:.6f}" for value in pose)
        lines.append(f"ODOM {x} {y} {heading} 0 0 0 {time:.6f} host {time:.6f}")
        readings = " ".join(f"{min(r, 81.83):.3f}" for r in ranges)
        lines.append(f"FLASER {ranges.size} {readings} {x} {y} {heading} {x} {y} {heading} {time:.6f} host {time:.6f}")
    path = tmp_path_factory.mktemp("raw") / "round.log"
    path.write_text("\n".join(lines) + "\n")
    return path, true


def test_raw_odometry_is_corrected(raw_log, tmp_path, capsys):
    from polyexplore_gym.mapping.logs import read_trajectory
    from polyexplore_gym.mapping.logs.poses import between

    log, true = raw_log
    a, b, c = (tmp_path / name for name in ("a.json", "b.json", "c.json"))
    assert main(["linemap", str(log), "--max-range", "12", "--out", str(a)]) == 0
    told = capsys.readouterr().err
    assert "warning: walls that were seen again do not fit" in told
    assert "--poses odometry finds better ones" in told
    poses = tmp_path / "poses.txt"
    corrected = ["linemap", str(log), "--max-range", "12", "--poses", "odometry", "--trajectory", str(poses)]
    assert main([*corrected, "--out", str(b)]) == 0
    captured = capsys.readouterr()
    assert "warning" not in captured.err
    assert "poses         matched: scans matched, " in captured.out
    assert f"written: {poses}" in captured.out
    for step in ("match", "pairs 1", "pairs 3", "lines"):  # progress
        assert f"{step}: 100%" in captured.err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.json", "b.json", "poses.txt"]
    track = read_trajectory(poses)
    assert len(track.times) == len(true)
    off = between(between(true[0], true), between(track.poses[0], track.poses))
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.05
    # the trajectory beside the log gives that map again, with covariances of its own
    again = ["linemap", str(log), "--max-range", "12", "--trajectory-in", str(poses), "--out", str(c)]
    assert main([*again, "--sigma-xy", "0.005", "--sigma-heading", "0.1"]) == 0
    assert "warning" not in capsys.readouterr().err
    maps = [json.loads(path.read_text()) for path in (a, b, c)]
    assert len(maps[0]["lines"]) > 1.3 * len(maps[1]["lines"])
    assert abs(len(maps[1]["lines"]) - len(maps[2]["lines"])) <= 5
    assert maps[1]["median_distance"] < 0.012


def test_a_stopped_correction_goes_on(raw_log, tmp_path, capsys, monkeypatch):
    import polyexplore_gym.mapping.slam.mapper as mapper

    log, true = raw_log
    call = ["linemap", str(log), "--max-range", "12", "--poses", "odometry", "--out", str(tmp_path / "a.json")]
    insert, work = mapper._insert, []

    def stopping(*args):
        work.append(1)
        if len(work) == 30:
            raise KeyboardInterrupt
        insert(*args)

    monkeypatch.setattr(mapper, "_insert", stopping)
    assert main(call) == 130
    assert f"what is matched is in {tmp_path / 'round.slam.npz'}" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["round.slam.npz"]
    assert main(call) == 0
    assert len(work) == len(true) + 1
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_poses_of_a_log_without_times(tmp_path, capsys):
    """They are found; times are of use to --trajectory alone."""
    angles = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    ranges = np.tile(2.0 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles))), (3, 1))
    np.savez(tmp_path / "still.npz", angles=angles, ranges=ranges, odometry=np.zeros((3, 3)))
    for source in ("odometry", "none"):
        out = tmp_path / f"{source}.json"
        assert main(["linemap", str(tmp_path / "still.npz"), "--poses", source, "--out", str(out)]) == 0
        assert len(json.loads(out.read_text())["lines"]) == 4
    out = str(tmp_path / "a.json")
    assert main(["linemap", str(tmp_path / "still.npz"), "--out", out, "--plan", out]) == 2
    assert "named by --out and by --plan" in capsys.readouterr().err
    assert main(["linemap", str(tmp_path / "still.npz"), "--out"]) == 2
    assert "--out: name a file or a folder" in capsys.readouterr().err


def test_poses_that_cannot_be_had_are_told(raw_log, tmp_path, capsys):
    log, _ = raw_log
    nowhere = str(tmp_path / "nowhere" / "t.txt")
    assert main(["linemap", str(log), "--trajectory", nowhere]) == 2
    assert f"error: {nowhere}: the folder {tmp_path / 'nowhere'} does not exist" in capsys.readouterr().err
    # no odometry in it, no times in it
    np.savez(tmp_path / "bare.npz", angles=np.linspace(-1, 1, 91), ranges=np.full((3, 91), 2.0))
    bare = ["linemap", str(tmp_path / "bare.npz"), "--out", str(tmp_path / "x.json")]
    assert main(bare) == 2
    assert "no poses to map with: the .npz has no poses; --poses none finds better ones" in capsys.readouterr().err
    assert main([*bare, "--poses", "odometry"]) == 2
    assert "no odometry to go by: the .npz has no poses" in capsys.readouterr().err
    assert main([*bare, "--poses", "none", "--trajectory", str(tmp_path / "t.txt")]) == 2
    assert "the scans have no times: --trajectory cannot be written" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.json")) + list(tmp_path.glob("*.txt"))


def test_many_broken_lines_are_counted(tmp_path, capsys):
    log = carmen(tmp_path / "room.log", *["FLASER 181 1.0"] * 25)
    assert main(["linemap", str(log), "--out", str(tmp_path / "a.json")]) == 0
    captured = capsys.readouterr()
    assert captured.err.count("left out: line") == 10
    assert "left out: 15 more" in captured.err
    assert "25 broken" in captured.out


def test_a_log_that_cannot_be_read_leaves_nothing_behind(tmp_path, capsys):
    (tmp_path / "empty.log").touch()
    (tmp_path / "film.log").write_bytes(bytes(range(256)) * 50)
    for name, reason in (("empty.log", "is empty"), ("film.log", "no usable FLASER, ROBOTLASER1 or RAWLASER1")):
        assert main(["linemap", str(tmp_path / name), "--out", str(tmp_path / "maps")]) == 2
        last = capsys.readouterr().err.splitlines()[-1]
        assert last.startswith(f"error: {tmp_path / name}: {reason}")
    assert not (tmp_path / "maps").exists()


def test_without_matplotlib_there_are_maps(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    monkeypatch.setitem(sys.modules, "matplotlib.collections", None)
    log = str(carmen(tmp_path / "room.log"))
    assert main(["linemap", log, "--out", str(tmp_path / "maps")]) == 0
    assert "no room.png: this needs matplotlib" in capsys.readouterr().err
    assert sorted(path.name for path in (tmp_path / "maps").iterdir()) == [
        "room.geojson", "room.json", "room.pgm", "room.yaml",
    ]  # fmt: skip
    assert main(["linemap", log, "--out", str(tmp_path / "a.png")]) == 2
    assert "polyexplore-gym[plots]" in capsys.readouterr().err


def test_an_own_policy_that_fails_is_told(folder, capsys):
    assert main(["run", str(folder / "rooms.json"), "--policy", f"{__name__}:Broken", "--drive", "kinematic"]) == 1
    assert "failed: KeyError: 'weights'" in capsys.readouterr().out


def test_without_matplotlib_there_are_tables(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    out = tmp_path / "out"
    assert bench("--plans", folder / "rooms.json", "--policies", "nearest", "--out", out) == 0
    captured = capsys.readouterr()
    assert "polyexplore-gym[plots]" in captured.err
    assert "nearest" in captured.out
    assert (out / "summary.csv").exists()


def test_control_c_says_how_to_go_on(folder, tmp_path):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "polyexplore_gym.cli", "bench", "--plans", str(folder), "--seeds", "400"]
    command += ["--drive", "kinematic"]
    process = subprocess.Popen(
        [*command, "--out", str(out), "--workers", "2"],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # A shell starts what it puts into the background deaf to Ctrl-C, and children of it stay so.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    while process.poll() is None and not (out / "episodes.jsonl").exists():
        os.sched_yield()
    while process.poll() is None and (out / "episodes.jsonl").stat().st_size == 0:
        os.sched_yield()
    os.killpg(process.pid, signal.SIGINT)
    _, error = process.communicate(timeout=120)
    assert process.returncode == 130, error
    assert "the same command goes on from there" in error
    assert "Traceback" not in error
    assert read_records(out)


def test_the_default_bench_exists():
    from baselines import policy_names
    from polyexplore_gym.floorplan import suite

    # The learned one needs torch, which the core does without.
    assert set(SCRIPTED) == set(policy_names()) - {"learned", *LOOK_AHEAD}
    assert set(COMPARED) < set(SCRIPTED)
    assert all(0 < count <= len(suite(name)) for name, count in BENCH_PLANS.items())
