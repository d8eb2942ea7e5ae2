import gzip
import io
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from polyexplore_gym.errors import InvalidLogError
from polyexplore_gym.mapping import logs, read_log

STAMPS = "1134863807.65 host 12.5"
HEAD = "# message formats defined: PARAM FLASER\nPARAM robot_length 0.54 1.6 b21 1.6\nODOM 0 0 0 0 0 0 0.1 host 0.1\n"


def numbers(values):
    return " ".join(repr(float(v)) for v in values)


def flaser(ranges, pose, stamps=True):
    return f"FLASER {len(ranges)} {numbers(ranges)} {numbers(pose)} 9 9 9" + (f" {STAMPS}" if stamps else "")


def robotlaser(ranges, pose, start=-1.0, step=0.01, max_range=50.0, remissions=0, stamps=True):
    """remissions: how many, None for the older format without them."""
    settings = f"0 {start!r} 3.14 {step!r} {max_range!r} 0.01 0"
    tail = "9 9 9 0.5 0.1 0 0" + ("" if remissions is None else " 0")
    between = "" if remissions is None else f"{remissions} " + "7 " * remissions
    scan = f"ROBOTLASER1 {settings} {len(ranges)} {numbers(ranges)} {between}{numbers(pose)} {tail}"
    return scan + (f" {STAMPS}" if stamps else "")


@pytest.fixture
def write(tmp_path):
    def write(*lines, name="some.log"):
        path = tmp_path / name
        data = b"".join((line if isinstance(line, bytes) else line.encode()) + b"\n" for line in lines)
        path.write_bytes(gzip.compress(data) if name.endswith(".gz") else data)
        return path

    return write


SCAN = ([1.0, 2.0, 3.0, 4.0], [0.5, -0.5, 0.25])
GOOD = flaser(*SCAN)

scans = st.integers(3, 8).flatmap(
    lambda b: st.lists(
        st.tuples(
            st.lists(st.floats(0.01, 200.0), min_size=b, max_size=b),
            st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(-10, 10)),
        ),
        min_size=1,
        max_size=5,
    )
)
JUNK = st.sampled_from(
    [
        b"\xff\xfe\x00\x80garbage", b"12 nonsense", b"FLASER", b"FLASER x 1 2", b"FLASER -3", b"FLASER 0 1 2 3 4 5 6",
        b"FLASER 3 1 2 nan 0 0 0 0 0 0 1 h 1", b"FLASER 3 1 2 3 nan 0 0 0 0 0 1 h 1", b"FLASER 3 1 2 3 0 0",
        b"FLASER 3 1 2 x 0 0 0 0 0 0 1 h 1", b"FLASER 99999999999 1", b"ROBOTLASER1 0 0 0",
        b"FLASER 3 1 2 3 0 inf 0 0 0 0",
    ]
)  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(
    scans,
    st.sampled_from(["flaser", "flaser bare", "new", "new bare", "remissions", "old", "old bare"]),
    st.booleans(),
    st.lists(st.tuples(st.integers(0, 5), JUNK), max_size=4),
)
def test_what_was_written_is_read(tmp_path_factory, written, kind, compressed, junk):
    """Also with broken lines between, which are all named."""
    stamps = "bare" not in kind
    lines = []
    for ranges, pose in written:
        if kind.startswith("flaser"):
            lines.append(flaser(ranges, pose, stamps).encode())
        else:
            remissions = {"n": 0, "r": 4, "o": None}[kind[0]]
            lines.append(robotlaser(ranges, pose, remissions=remissions, stamps=stamps).encode())
    for at, line in junk:
        lines.insert(at, line)
    data = HEAD.encode() + b"\n".join(lines) + b"\n"
    path = tmp_path_factory.mktemp("log") / "a.log"
    path.write_bytes(gzip.compress(data) if compressed else data)
    log = read_log(path)
    np.testing.assert_array_equal(log.ranges, [ranges for ranges, _ in written])
    np.testing.assert_array_equal(log.poses, [pose for _, pose in written])
    n = len(written[0][0])
    if kind.startswith("flaser"):
        assert log.max_range is None
        assert log.angles[0] == pytest.approx(-math.pi / 2)
        assert np.diff(log.angles) == pytest.approx(math.pi / (n - 1 if n % 2 else n))
    else:
        assert log.max_range == 50.0
        np.testing.assert_allclose(log.angles, -1.0 + 0.01 * np.arange(n), atol=1e-12)
    junk_lines = [f"line {k}" for k, line in enumerate(lines, start=4) if line in {j for _, j in junk}]
    assert [part.where for part in log.broken] == junk_lines


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (GOOD[:20], "fields do not fit"),
        (GOOD[:9], "fields do not fit"),
        ("FLASER", "truncated"),
        (GOOD.replace("FLASER 4", "FLASER 3"), "15 fields do not fit a FLASER message of 3 ranges"),
        (GOOD.replace("FLASER 4", "FLASER 5"), "fields do not fit"),
        (GOOD.replace("FLASER 4", "FLASER 1"), "1 ranges"),
        (GOOD.replace("FLASER 4", "FLASER 4.0"), "'4.0'"),
        (GOOD.replace("2.0", "nan"), "range 2 is NaN"),
        (GOOD.replace("2.0", "2,0"), "range 2 is '2,0', not a number"),
        (GOOD.replace("-0.5", "nan"), "the pose is 0.5, nan"),
        (GOOD.replace("-0.5", "1e30"), "the pose is"),
        (robotlaser(*SCAN)[:60], "fields do not fit"),
        (robotlaser(*SCAN).replace("ROBOTLASER1 0", "ROBOTLASER1 "), "number of ranges is '1.0'"),
        (robotlaser(*SCAN, step=-0.1), "angular resolution -0.1"),
        (robotlaser(*SCAN, step=3.0), "angular resolution 3.0"),
        (robotlaser(*SCAN, start=float("nan")), "start angle nan"),
        (robotlaser(*SCAN).replace(" 0 0.5", f" {'9' * 5000} 0.5"), "fields do not fit"),
        (b"\x00\x01\xff\xfe" * 20, "not text"),
        (b"\x00\x01\x02", "not a CARMEN message"),
        ("2.5 3.5 4.5", "not a CARMEN message"),
        (GOOD.replace("9 9 9", "9 x 9"), "'x', not a number"),
        (flaser([1.0, 2.0, 3.0], SCAN[1]), "unlike most scans of the log: 3 beams"),
        (flaser(*SCAN, stamps=False), "6 fields behind"),
    ],
)
def test_a_broken_line_is_named_and_left_out(write, line, reason):
    log = read_log(write(GOOD, "", line, GOOD))
    np.testing.assert_array_equal(log.ranges, [SCAN[0]] * 2)
    (broken,) = log.broken
    assert broken.where == "line 3"
    assert reason in broken.reason


def test_a_range_missing_or_too_many_never_shifts_the_pose(write):
    """Every count of ranges but the right one is found out."""
    for good in (GOOD, flaser(*SCAN, stamps=False), robotlaser(*SCAN), robotlaser(*SCAN, remissions=None)):
        fields = good.split()
        first = fields.index("1.0")
        for drop in range(1, 6):
            for edited in (fields[:first] + fields[first + drop :], fields[:first] + ["1.5"] * drop + fields[first:]):
                log = read_log(write(good, " ".join(edited)))
                assert log.poses.tolist() == [SCAN[1]], edited
                assert len(log.broken) == 1


def test_beams_without_a_return(write):
    log = read_log(write(flaser([1.0, 0.0, -1.0, math.inf], SCAN[1])))
    np.testing.assert_array_equal(log.ranges, [[1.0, math.inf, math.inf, math.inf]])
    log = read_log(write(flaser([1.0, 1e-300, 1e-7, 1e-6], SCAN[1])))
    np.testing.assert_array_equal(log.ranges, [[1.0, math.inf, math.inf, 1e-6]])
    assert not log.broken


def test_flaser_goes_before_robotlaser(write):
    log = read_log(write(robotlaser([9.0] * 4, SCAN[1]), GOOD, robotlaser([9.0] * 4, SCAN[1])))
    np.testing.assert_array_equal(log.ranges, [SCAN[0]])
    assert log.unread == {"ROBOTLASER1": 2}
    assert not log.broken


def test_most_scans_decide_how_the_beams_lie(write):
    few, many = robotlaser([1.0] * 4, SCAN[1], start=-0.5), robotlaser([2.0] * 4, SCAN[1])
    log = read_log(write(few, many, many))
    assert log.ranges.tolist() == [[2.0] * 4] * 2
    assert [str(part)[:7] for part in log.broken] == ["line 1:"]


def test_the_field_of_view_of_flaser(write):
    path = write(GOOD)
    np.testing.assert_allclose(np.degrees(read_log(path).angles), [-90, -45, 0, 45])
    angles = read_log(path, field_of_view=math.radians(120)).angles
    np.testing.assert_allclose(np.degrees(angles), [-60, -20, 20, 60])
    log = read_log(write(flaser([1.0, 2.0, 3.0], SCAN[1])))
    np.testing.assert_allclose(np.degrees(log.angles), [-90, 0, 90], atol=1e-12)


def test_codes_of_a_sick_laser_are_beyond_the_maximum_range(write):
    assert read_log(write(robotlaser(*SCAN, max_range=81.92))).max_range == 80.0
    assert read_log(write(robotlaser(*SCAN, max_range=8.0))).max_range == 8.0
    assert read_log(write(robotlaser(*SCAN, max_range=0.0))).max_range is None


def test_progress_reaches_the_end_of_the_file(write):
    for name in ("a.log", "a.log.gz"):
        path, seen = write(*[GOOD] * 300, name=name), []
        read_log(path, watch=seen.append)
        assert seen == sorted(seen)
        assert seen[-1] == path.stat().st_size


def test_a_cut_off_gz_gives_what_it_holds(tmp_path):
    rng = np.random.default_rng(0)
    written = rng.uniform(1, 9, (200, 30))
    data = gzip.compress("\n".join(flaser(r, (0, 0, 0)) for r in written).encode())
    path = tmp_path / "a.log.gz"
    path.write_bytes(data[: len(data) // 2])
    log = read_log(path)
    assert 50 < len(log.ranges) < 150
    np.testing.assert_array_equal(log.ranges, written[: len(log.ranges)])
    assert "damaged or cut off" in log.broken[-1].reason
    path.write_bytes(data[:15])
    with pytest.raises(InvalidLogError, match="cut off"):
        read_log(path)


def test_an_endless_line_is_one_broken_line(write, monkeypatch):
    monkeypatch.setattr(logs, "MAX_LINE", 1000)
    log = read_log(write(GOOD, b"\0" * 3500, GOOD))
    assert len(log.ranges) == 2
    assert [part.where for part in log.broken] == ["line 2"]
    with pytest.raises(InvalidLogError, match="line 1: longer than"):
        read_log(write(b"\0" * 3500, GOOD))


def test_a_foreign_file_is_given_up_early(write, monkeypatch):
    monkeypatch.setattr(logs, "GIVE_UP", 20)
    with pytest.raises(InvalidLogError, match="in 20 lines; line 1: not a CARMEN message"):
        read_log(write(*["3 4 5"] * 100, GOOD))


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "is empty"),
        (b"\n\n", "no usable FLASER or ROBOTLASER1 message in 2 lines"),
        (HEAD.encode(), "no usable"),
        (b"\x89PNG\r\n\x1a\n" + bytes(range(256)), "no usable"),
        (b"PK\x03\x04 half a zip", "not a readable .npz"),
        (b"\x1f\x8b", "cut off"),
        (b"\x1f\x8bnot gzip at all", "no usable"),
        (b'{"exterior": [[0, 0]]}', "not a CARMEN message"),
        (GOOD[:30].encode(), "line 1"),
        (GOOD.encode("utf-16"), "no usable"),
    ],
)
def test_what_is_no_log_is_a_clear_error(tmp_path, data, reason):
    path = tmp_path / "x.log"
    path.write_bytes(data)
    with pytest.raises(InvalidLogError, match=r"x\.log: ") as error:
        read_log(path)
    assert reason in str(error.value)


def test_no_file_and_a_folder(tmp_path):
    with pytest.raises(InvalidLogError, match=r"missing\.log: does not exist"):
        read_log(tmp_path / "missing.log")
    with pytest.raises(InvalidLogError, match="is a folder"):
        read_log(tmp_path)
    with pytest.raises(InvalidLogError, match="regular file"):
        read_log("/dev/null")


ARRAYS = {
    "angles": np.array([-0.5, 0.0, 0.5, 1.0]),
    "ranges": np.array([[1.0, 2.0, 3.0, 0.0], [4.0, 5.0, np.inf, 7.0]]),
    "poses": np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]),
}


def test_an_npz_is_read(tmp_path):
    path = tmp_path / "scans.data"  # found by content
    with path.open("wb") as file:
        np.savez_compressed(file, **ARRAYS, max_range=6.0, pose_covariance=np.diag([1.0, 2.0, 3.0]))
    log = read_log(path)
    for key in ("angles", "poses"):
        np.testing.assert_array_equal(getattr(log, key), ARRAYS[key])
    np.testing.assert_array_equal(log.ranges, [[1, 2, 3, np.inf], [4, 5, np.inf, 7]])
    assert log.max_range == 6.0
    np.testing.assert_array_equal(log.pose_covariance, [np.diag([1.0, 2.0, 3.0])] * 2)
    np.savez(tmp_path / "b.npz", **{key: value.astype(np.float32) for key, value in ARRAYS.items()})
    log = read_log(tmp_path / "b.npz")
    assert log.pose_covariance is None
    assert log.max_range is None
    assert log.ranges.dtype == np.float64


def test_broken_scans_of_an_npz_are_named(tmp_path):
    ranges, poses = np.ones((4, 4)), np.zeros((4, 3))
    ranges[1, 2], poses[3, 0] = np.nan, np.inf
    given = np.arange(4)[:, None, None] * np.eye(3)
    np.savez(tmp_path / "a.npz", angles=ARRAYS["angles"], ranges=ranges, poses=poses, pose_covariance=given)
    log = read_log(tmp_path / "a.npz")
    assert [str(part) for part in log.broken] == ["scan 1: a range is NaN", "scan 3: the pose is inf, 0.0, 0.0"]
    np.testing.assert_array_equal(log.pose_covariance, given[[0, 2]])
    ranges[:] = np.nan
    np.savez(tmp_path / "a.npz", angles=ARRAYS["angles"], ranges=ranges, poses=poses)
    with pytest.raises(InvalidLogError, match=r"no usable scan.*scan 0: a range is NaN"):
        read_log(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"angles": None}, "no array 'angles'"),
        ({"angles": np.array([0.0, 0.0, 1.0, 2.0])}, "angles"),
        ({"angles": np.array([0.0, 1.0, 2.0, np.nan])}, "angles"),
        ({"angles": np.linspace(0, 7, 4)}, "2 pi"),
        ({"angles": np.zeros((2, 2))}, r"got angles \(2, 2\)"),
        ({"ranges": np.ones((2, 3))}, "ranges"),
        ({"ranges": np.array(3.0)}, "ranges"),
        ({"ranges": np.ones((0, 4)), "poses": np.ones((0, 3))}, "no usable scan"),
        ({"ranges": np.array([["a"] * 4] * 2)}, "ranges: expected real numbers"),
        ({"ranges": np.array([[{}] * 4] * 2)}, "not a readable .npz"),
        ({"poses": np.ones((3, 3))}, "poses"),
        ({"poses": np.ones((2, 3)) * 1j}, "poses: expected real numbers"),
        ({"angles": np.zeros(2), "ranges": np.ones((2, 2))}, "2 beams"),
        ({"max_range": -1.0}, "max_range"),
        ({"max_range": np.ones(3)}, "max_range"),
        ({"pose_covariance": np.eye(2)}, "pose_covariance"),
        ({"pose_covariance": -np.eye(3)}, "pose_covariance"),
        ({"pose_covariance": np.full((3, 3), np.nan)}, "pose_covariance"),
    ],
)
def test_an_npz_of_other_arrays_is_refused(tmp_path, change, reason):
    arrays = {key: value for key, value in {**ARRAYS, **change}.items() if value is not None}
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(InvalidLogError, match=reason):
        read_log(tmp_path / "a.npz")


def damaged(data: bytes, seed: int) -> bytes:
    rng = np.random.default_rng(seed)
    out = bytearray(data)
    for _ in range(int(rng.integers(0, 6))):
        out[int(rng.integers(len(out)))] = int(rng.integers(256))
    return bytes(out[: int(rng.integers(4, len(out) + 1))])


@pytest.mark.parametrize("kind", ["text", "gz", "npz"])
def test_no_damage_makes_another_error(tmp_path, kind):
    """Whatever bytes are changed or lost: a log of sound arrays, or our error."""
    text = (HEAD + "\n".join([GOOD, robotlaser(*SCAN)] * 3)).encode()
    archive = io.BytesIO()
    np.savez(archive, **ARRAYS, max_range=6.0, pose_covariance=np.eye(3))
    data = {"text": text, "gz": gzip.compress(text), "npz": archive.getvalue()}[kind]
    path = tmp_path / "damaged"
    read = 0
    for seed in range(400):
        path.write_bytes(damaged(data, seed))
        try:
            log = read_log(path)
        except InvalidLogError:
            continue
        read += 1
        assert log.ranges.shape == (len(log.poses), log.angles.size)
        assert (log.ranges > 0).all()
        assert np.isfinite(log.poses).all()
    assert read > {"text": 100, "gz": 5, "npz": -1}[kind]  # every change of an .npz is noticed by its checksum
