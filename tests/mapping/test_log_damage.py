"""Damaged and odd logs of every format: our error, which names the file, or a sound log and a sound map; never another
exception, and never a wrong log without a word."""

import gzip
import io
import math
import shutil
import warnings

import numpy as np
import pytest
from line_scenes import HALF, box, cast

from polyexplore_gym.errors import InvalidLogError, PolyExploreError
from polyexplore_gym.mapping import map_log, read_log

FAST = 40
"""Seeds of each format in the usual run; the others are slow."""
SEEDS = [pytest.param(0, FAST, id="fast"), pytest.param(FAST, 240, id="rest", marks=pytest.mark.slow)]
ROOM = box(0.0, 0.0, 6.0, 4.0)
POSES = np.array([[2.0 + 0.1 * k, 2.0, 0.3 * k] for k in range(6)])
ODD = [math.nan, math.inf, -math.inf, 0.0, -1.0, 1e-300, 1e30, -1e30, 1e308, 65535.0, 81.91, 1e9]


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Bytes changed, lost, added or overwritten, or the end cut off."""
    out = bytearray(data)
    at = int(rng.integers(len(out)))
    match int(rng.integers(5)):
        case 0:
            for _ in range(int(rng.integers(1, 8))):
                out[int(rng.integers(len(out)))] = int(rng.integers(256))
        case 1:
            del out[at:]
        case 2:
            del out[at : at + int(rng.integers(1, 200))]
        case 3:
            out[at:at] = rng.bytes(int(rng.integers(1, 200)))
        case _:
            length = min(int(rng.integers(4, 64)), len(out) - at)
            out[at : at + length] = bytes([int(rng.choice([0, 127, 128, 255]))]) * length
    return bytes(out)


def assert_sound(log):
    n = len(log)
    assert n > 0
    assert len(log.angles) == n
    for angles, ranges in zip(log.angles, log.ranges, strict=True):
        assert angles.shape == ranges.shape
        assert np.isfinite(angles).all()
        assert (np.diff(angles) >= 0).all()
        assert (np.isnan(ranges) | (ranges > 0)).all()
    for poses in (log.poses, log.odometry):
        assert poses is None or (poses.shape == (n, 3) and np.isfinite(poses).all())
    assert log.times is None or (log.times.shape == (n,) and np.isfinite(log.times).all())
    assert log.track is None or (np.diff(log.track.times) > 0).all()


def read(path, **options):
    """The log, which has a sound map if any; None with an error of ours, which names the file."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        warnings.simplefilter("ignore", UserWarning)
        try:
            log, why = read_log(path, **options), ""
        except InvalidLogError as error:
            log, why = None, str(error)
        if log is None:
            names = {str(path), str(options.get("trajectory", path))}
            assert any(why.startswith(name) and len(why) > len(name) + 8 for name in names), why
            return None
        assert_sound(log)
        try:
            made = map_log(log)
        except PolyExploreError:
            return log
    assert np.isfinite(made.segments).all()
    assert np.isfinite(made.covariance).all()
    return log


def same_scans(log, true, atol=1e-4) -> bool:
    """Whether every scan is one of the true ones, but for a tenth of its beams, at its pose."""
    for k in range(len(log)):
        at = int(np.hypot(*(true.poses[:, :2] - log.poses[k, :2]).T).argmin()) if log.poses is not None else k
        if log.ranges[k].size != true.ranges[at].size:
            return False
        other = ~np.isclose(log.ranges[k], true.ranges[at], atol=atol, equal_nan=True)
        turned = np.abs(np.remainder(log.angles[k] - true.angles[at] + 1.0, 2 * math.pi) - 1.0) > atol
        if (other | turned).mean() > 0.1:
            return False
        if log.poses is not None and np.abs(log.poses[k] - true.poses[at]).max() > 0.01:
            return False
    return True


def tell(log) -> bool:
    return bool(log.broken or log.notes or log.unread)


RANGES = [cast(ROOM, pose, HALF[::2], 20.0) for pose in POSES]


def carmen(stamps=True) -> str:
    lines = ["# a log", "PARAM robot_frontlaser_offset 0.1 0 h 0"]
    for k, (pose, r) in enumerate(zip(POSES, RANGES, strict=True)):
        tail = f" {100 + k} host {100 + k}" if stamps else ""
        x, y, turn = pose.tolist()
        values = " ".join(f"{v:.3f}" for v in r)
        lines.append(f"ODOM {x} {y} {turn} 0 0 0{tail}")
        lines.append(f"FLASER {r.size} {values} {x} {y} {turn} {x} {y} {turn}{tail}")
    return "\n".join(lines) + "\n"


def robotlaser() -> str:
    lines = []
    for pose, r in zip(POSES, RANGES, strict=True):
        values, at = " ".join(f"{v:.3f}" for v in r), " ".join(map(str, pose.tolist()))
        lines.append(
            f"ROBOTLASER1 0 -1.570796 3.141593 0.017453 30.0 0.01 0 {r.size} {values} 0 {at} {at} 0 0 0 0 0 1 h 1"
        )
        lines.append(f"RAWLASER1 0 -1.570796 3.141593 0.017453 30.0 0.01 0 {r.size} {values} 0 1 h 1")
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(("first", "last"), SEEDS)
@pytest.mark.parametrize("kind", ["flaser", "flaser bare", "robotlaser", "gz"])
def test_damaged_carmen_logs(tmp_path, kind, first, last):
    text = (robotlaser() if kind == "robotlaser" else carmen(kind != "flaser bare")).encode()
    good, path = tmp_path / "good", tmp_path / "damaged.log"
    good.write_bytes(text)
    true, told = read_log(good), 0
    for seed in range(first, last):
        data = gzip.compress(text, mtime=0) if kind == "gz" else text
        path.write_bytes(damaged(data, np.random.default_rng(seed)))
        log = read(path)
        told += log is None or tell(log)
        assert log is None or tell(log) or same_scans(log, true, 0.5)
    assert told > (last - first) // 4


@pytest.mark.parametrize(("first", "last"), SEEDS)
def test_carmen_logs_with_odd_numbers(tmp_path, first, last):
    """A field replaced by another number, or a line by part of another."""
    path = tmp_path / "odd.log"
    for seed in range(first, last):
        rng = np.random.default_rng(seed)
        lines = [line.split() for line in (carmen() if seed % 2 else robotlaser()).splitlines()]
        for _ in range(int(rng.integers(1, 4))):
            line = lines[int(rng.integers(len(lines)))]
            at = int(rng.integers(len(line) + 1))
            match int(rng.integers(4)):
                case 0:
                    line[at : at + 1] = [str(rng.choice([*ODD, 3, 99999999, -7]))]
                case 1:
                    del line[at:]
                case 2:
                    line.insert(at, str(rng.choice(ODD)))
                case _:
                    other = lines[int(rng.integers(len(lines)))]
                    line[at:] = other[int(rng.integers(len(other) + 1)) :]
        path.write_text("\n".join(map(" ".join, lines)))
        read(path)


def arrays():
    return {"angles": HALF[::2], "ranges": np.array(RANGES), "poses": POSES, "max_range": np.array(20.0),
            "pose_covariance": 1e-4 * np.eye(3), "times": np.arange(6.0), "odometry": POSES + 0.5,
            "time_increment": np.array(1e-4)}  # fmt: skip


@pytest.mark.parametrize(("first", "last"), SEEDS)
def test_damaged_npz_logs(tmp_path, first, last):
    path = tmp_path / "damaged.npz"
    for seed in range(first, last):
        rng = np.random.default_rng(seed)
        file = io.BytesIO()
        (np.savez if seed % 2 else np.savez_compressed)(file, **arrays())
        path.write_bytes(damaged(file.getvalue(), rng))
        log = read(path)
        # every entry has a checksum: what is read is right, or an optional array is gone
        assert log is None or np.allclose(np.array(log.ranges), RANGES)


@pytest.mark.parametrize(("first", "last"), SEEDS)
def test_npz_logs_with_odd_arrays(tmp_path, first, last):
    path = tmp_path / "odd.npz"
    for seed in range(first, last):
        rng = np.random.default_rng(seed)
        made = arrays()
        for _ in range(int(rng.integers(1, 3))):
            key = str(rng.choice(list(made)))
            value = np.array(made[key])
            match int(rng.integers(7)):
                case 0:
                    value.flat[int(rng.integers(max(value.size, 1))) if value.size else slice(0)] = rng.choice(ODD)
                case 1:
                    value = (
                        value[..., None] if rng.random() < 0.5 else value.ravel()[: int(rng.integers(value.size + 1))]
                    )
                case 2:
                    with np.errstate(invalid="ignore"):
                        value = value.astype(rng.choice(["f2", "i2", "u1", "S4", "?", "c8", "U8"]))
                case 3:
                    value = value * rng.choice([1000.0, 0.0, -1.0, 57.3])
                case 4:
                    value = np.full(value.shape, rng.choice(ODD))
                case 5:
                    value = np.flip(value)
                case _:
                    del made[key]
                    continue
            made[key] = value
        np.savez(path, **made)
        read(path)


@pytest.mark.parametrize(("first", "last"), SEEDS)
def test_damaged_trajectories(tmp_path, first, last):
    log, path = tmp_path / "a.npz", tmp_path / "poses.txt"
    np.savez(log, **{key: value for key, value in arrays().items() if key != "poses"})
    half = 0.5 * POSES[:, 2]
    rows = np.c_[np.arange(6.0), POSES[:, :2], np.zeros((6, 3)), np.sin(half), np.cos(half)]
    np.savetxt(path, rows, fmt="%.6f", header="time x y z qx qy qz qw")
    text = path.read_bytes()
    for seed in range(first, last):
        rng = np.random.default_rng(seed)
        if seed % 2:
            path.write_bytes(damaged(text, rng))
        else:
            lines = [line.split() for line in text.decode().splitlines()]
            line = lines[int(rng.integers(1, 7))]
            line[int(rng.integers(len(line)))] = str(rng.choice([*ODD, "x", "#"]))
            path.write_text("\n".join(map(" ".join, lines)))
        read(log, trajectory=path)


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    pytest.importorskip("rosbags")
    from bags import drive

    folder = tmp_path_factory.mktemp("bags")
    return {kind: drive(folder / kind, kind, scans=3) for kind in ("bag", "db3", "mcap")}


@pytest.mark.parametrize(("first", "last"), SEEDS)
@pytest.mark.parametrize("kind", ["bag", "db3", "mcap", "db3 folder", "mcap folder", "metadata"])
def test_damaged_bags(bags, tmp_path, kind, first, last):
    given = bags[kind.split()[0] if kind != "metadata" else "mcap"]
    true = read_log(given)
    read_, told = 0, 0
    for seed in range(first, last):
        rng = np.random.default_rng(seed)
        path = tmp_path / str(seed)
        if kind == "bag":
            path.write_bytes(damaged(given.read_bytes(), rng))
        else:
            shutil.copytree(given, path)
            (file,) = path.glob("*.yaml" if kind == "metadata" else f"{given.name}*.{given.name}")
            file.write_bytes(damaged(file.read_bytes(), rng))
            path = file if kind in ("db3", "mcap") else path
        log = read(path)
        read_, told = read_ + (log is not None), told + (log is None or tell(log))
        assert log is None or tell(log) or (len(log) == 3 and same_scans(log, true)), seed
    assert told > (last - first) // 8
    assert read_ > 0 or kind == "metadata"


FIELDS = ("start", "step", "pause", "limits", "stamp", "end", "ranges", "frame")


@pytest.mark.parametrize(("first", "last"), SEEDS)
@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_bags_with_odd_messages(tmp_path, kind, first, last):
    pytest.importorskip("rosbags")
    from bags import BEAMS, MOUNT, Bag, drift, measured, odometry

    for seed in range(first, last):
        rng = np.random.default_rng(seed)

        def odd(value, rng=rng):
            return float(rng.choice(ODD)) if rng.random() < 0.04 else value

        def name(value, rng=rng):
            return str(rng.choice(["", "laser", "odom", "map", "base_link", "/"])) if rng.random() < 0.02 else value

        with Bag(tmp_path / str(seed), kind) as bag:
            bag.tf(0, bag.transform(0, name("base_link"), name("laser"), [odd(v) for v in MOUNT]), topic="/tf_static")
            for time in np.arange(0.0, 1.0, 0.1):
                pose = [odd(v) for v in odometry(time)]
                moved = bag.transform(time, name("odom"), name("base_link"), pose)
                moved.transform.rotation.w = odd(moved.transform.rotation.w)
                bag.tf(time, moved, bag.transform(time, name("map"), name("odom"), drift(time)))
                bag.odometry(time, pose, child=name("base_link"))
                with np.errstate(over="ignore"):
                    ranges = np.where(rng.random(BEAMS) < 0.02, rng.choice(ODD), measured(time)).astype(np.float32)
                size = int(rng.choice([0, 1, 3, 100, BEAMS])) if rng.random() < 0.1 else BEAMS
                single = [
                    v if abs(v) < 1e38 or not math.isfinite(v) else 1e38
                    for v in map(odd, (-math.pi, 0.0349, 5e-4, 0.1, 12.0))
                ]
                bag.scan(time, ranges[:size], start=single[0], step=single[1], pause=min(single[2], 1e30),
                         limits=single[3:], frame=name("laser"), end=0.0)  # fmt: skip
        read(bag.path)
