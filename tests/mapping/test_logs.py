import gzip
import io
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from polyexplore_gym.errors import InvalidLogError
from polyexplore_gym.mapping import read_log, sensor_of
from polyexplore_gym.mapping.logs import carmen
from polyexplore_gym.mapping.logs.poses import between, compose

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
            st.lists(st.floats(0.01, 90.0), min_size=b, max_size=b),
            st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(-10, 10)),
        ),
        min_size=1,
        max_size=5,
    )
)
JUNK = st.sampled_from(
    [
        b"\xff\xfe\x00\x80garbage", b"12 nonsense", b"FLASER", b"FLASER x 1 2", b"FLASER -3", b"FLASER 0 1 2 3 4 5 6",
        b"FLASER 3 1 2 3 nan 0 0 0 0 0 1 h 1", b"FLASER 3 1 2 3 0 0",
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
    for got, (expected, _) in zip(log.ranges, written, strict=True):
        np.testing.assert_array_equal(got, expected)
    np.testing.assert_array_equal(log.poses, [pose for _, pose in written])
    n = len(written[0][0])
    if kind.startswith("flaser"):
        assert log.max_range is None
        assert log.angles[0][0] == pytest.approx(-math.pi / 2)
        assert np.diff(log.angles[0]) == pytest.approx(math.pi / (n - 1 if n % 2 else n))
    else:
        assert log.max_range == 50.0
        np.testing.assert_allclose(log.angles[0], -1.0 + 0.01 * np.arange(n), atol=1e-12)
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
        (GOOD.replace("2.0", "2,0"), "range 2 is '2,0', not a number"),
        (GOOD.replace("-0.5", "nan"), "the pose is 0.5, nan"),
        (GOOD.replace("-0.5", "1e30"), "the pose is"),
        (robotlaser(*SCAN)[:60], "fields do not fit"),
        (robotlaser(*SCAN).replace("ROBOTLASER1 0", "ROBOTLASER1 "), "number of ranges is '1.0'"),
        (robotlaser(*SCAN, step=0.0), "angular resolution 0.0"),
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


def test_beams_without_a_return_and_unknown_ones(write):
    log = read_log(write(flaser([1.0, 0.0, -1.0, math.inf], SCAN[1])))
    np.testing.assert_array_equal(log.ranges, [[1.0, math.nan, math.nan, math.inf]])
    log = read_log(write(flaser([1.0, 1e-300, math.nan, 1e-6], SCAN[1])))
    np.testing.assert_array_equal(log.ranges, [[1.0, math.nan, math.nan, 1e-6]])
    assert not log.broken


def test_flaser_goes_before_robotlaser(write):
    log = read_log(write(robotlaser([9.0] * 4, SCAN[1]), GOOD, robotlaser([9.0] * 4, SCAN[1])))
    np.testing.assert_array_equal(log.ranges, [SCAN[0]])
    assert log.unread == {"ROBOTLASER1": 2}
    assert not log.broken


def test_beams_of_robotlaser_may_vary_and_those_of_flaser_may_not(write):
    """How the beams of FLASER lie is not in the message, so most scans decide."""
    few, many = robotlaser([1.0] * 4, SCAN[1], start=-0.5), robotlaser([2.0] * 5, SCAN[1])
    log = read_log(write(few, many, many))
    assert [len(r) for r in log.ranges] == [4, 5, 5]
    assert [a[0] for a in log.angles] == [-0.5, -1.0, -1.0]
    assert log.angles[1] is log.angles[2]
    log = read_log(write(flaser([1.0] * 5, SCAN[1]), GOOD, GOOD))
    assert [len(r) for r in log.ranges] == [4, 4]
    assert [str(part)[:7] for part in log.broken] == ["line 1:"]


def test_the_field_of_view_of_flaser(write):
    path = write(GOOD)
    np.testing.assert_allclose(np.degrees(read_log(path).angles[0]), [-90, -45, 0, 45])
    angles = read_log(path, field_of_view=math.radians(120)).angles[0]
    np.testing.assert_allclose(np.degrees(angles), [-60, -20, 20, 60])
    log = read_log(write(flaser([1.0, 2.0, 3.0], SCAN[1])))
    np.testing.assert_allclose(np.degrees(log.angles[0]), [-90, 0, 90], atol=1e-12)


def test_a_guessed_field_of_view_is_told_of(write):
    for size, told in ((180, 0), (181, 0), (361, 0), (541, 1), (1081, 1)):
        path = write(flaser([2.0] * size, SCAN[1]))
        assert len(read_log(path).notes) == told
        assert not read_log(path, field_of_view=4.7).notes
    assert "541 beams" in read_log(write(flaser([2.0] * 541, SCAN[1]))).notes[0]


def test_a_laser_that_turns_clockwise(write):
    log = read_log(write(robotlaser([1.0, 2.0, 3.0, 4.0], SCAN[1], start=1.0, step=-0.5)))
    np.testing.assert_allclose(log.angles[0], [-0.5, 0.0, 0.5, 1.0])
    np.testing.assert_array_equal(log.ranges[0], [4.0, 3.0, 2.0, 1.0])


@pytest.mark.parametrize("size", [361, 451, 721, 1081, 1441, 2401])
def test_a_full_turn_with_a_step_of_six_decimals(write, size):
    step = 2 * math.pi / (size - 1)
    for closed, written in ((True, f"{step:.6f}"), (False, f"{2 * math.pi / size:.6f}")):
        line = robotlaser([1.0] * size, SCAN[1], start=-3.141593).replace("3.14 0.01", f"6.283185 {written}")
        log = read_log(write(line))
        assert not log.broken
        span = np.ptp(log.angles[0])
        assert span == pytest.approx(2 * math.pi - (0 if closed else 2 * math.pi / size), abs=2e-6)
        assert sensor_of(log).full_circle


def odom(x, y, heading, time=None):
    return f"ODOM {x} {y} {heading} 0 0 0 " + ("0 h 0" if time is None else f"{time} h 0")


def raw(ranges, time=None, remissions=True):
    message = f"RAWLASER1 0 -1.0 3.14 0.5 50.0 0.01 0 {len(ranges)} {numbers(ranges)}" + (" 0" if remissions else "")
    return message + (f" {time} h 0" if time is not None else "")


def posed(pose, robot, time=None):
    return f"FLASER 4 1 2 3 4 {numbers(pose)} {numbers(robot)}" + (f" {time} h {time}" if time is not None else "")


WAY = np.array([[0.5 * k, 0.1 * k, 0.05 * k] for k in range(20)])
TRUE = np.array([[0.48 * k, -0.02 * k * k, 0.01 * k] for k in range(20)])


def test_poses_that_differ_from_the_odometry_are_corrected(write):
    log = read_log(write(*[posed(p, o) for p, o in zip(TRUE, WAY, strict=True)]))
    assert log.poses_are == "corrected"
    np.testing.assert_allclose(log.poses, TRUE)
    np.testing.assert_allclose(log.odometry, WAY)
    # the offset of a laser on the robot is no correction
    mount = np.array([0.2, -0.05, 0.1])
    log = read_log(write(*[posed(compose(o, mount), o) for o in WAY]))
    assert log.poses_are == "unknown"
    assert "no ODOM lines to tell by" in log.why
    np.testing.assert_allclose(log.mount, mount, atol=1e-9)
    lines = [line for k, o in enumerate(WAY) for line in (odom(*o, k + 1), posed(compose(o, mount), o, k + 1))]
    log = read_log(write(*lines))
    assert log.poses_are == "odometry"
    np.testing.assert_allclose(log.odometry, log.poses)
    np.testing.assert_allclose(log.track.poses, compose(WAY, mount), atol=1e-9)


@pytest.mark.parametrize("stamped", [False, True])
def test_poses_equal_to_the_odometry_are_raw_if_the_odom_lines_say_the_same(write, stamped):
    time = (lambda k: 100.0 + k) if stamped else (lambda k: None)
    lines = [line for k, o in enumerate(WAY) for line in (odom(*o, time(k)), posed(o, o, time(k)))]
    log = read_log(write(*lines))
    assert log.poses_are == "odometry"
    np.testing.assert_array_equal(log.poses, WAY)
    np.testing.assert_array_equal(log.odometry, WAY)
    if stamped:
        np.testing.assert_array_equal(log.track.times, 100.0 + np.arange(20))
        np.testing.assert_array_equal(log.times, log.track.times)
    else:
        assert log.track is None
        assert log.times is None
    lines = [line for k in range(20) for line in (odom(*WAY[k], time(k)), posed(TRUE[k], TRUE[k], time(k)))]
    log = read_log(write(*lines))
    assert log.poses_are == "corrected"
    assert "not with the ODOM lines" in log.why
    np.testing.assert_allclose(log.odometry, WAY)


@pytest.mark.parametrize("neff", [False, True])
def test_odometry_that_goes_on_from_corrected_poses_is_put_together_again(write, neff):
    """As GMapping writes logs: after each scan an ODOM line with its corrected pose, and the odometry from there on."""
    lines, step = [], between(WAY[:-1], WAY[1:])
    for k in range(20):
        if k:
            lines += [
                odom(*compose(TRUE[k - 1], 0.5 * step[k - 1]), k + 0.5),
                odom(*compose(TRUE[k - 1], step[k - 1]), k + 1),
            ]
        lines += [posed(TRUE[k], TRUE[k], k + 1), odom(*TRUE[k])]
    log = read_log(write(*lines, *(["NEFF 17.2"] if neff else [])))
    assert log.poses_are == "corrected"
    assert ("NEFF" if neff else "jump") in log.why
    np.testing.assert_allclose(log.poses, TRUE)
    np.testing.assert_allclose(between(log.odometry[:-1], log.odometry[1:]), step, atol=1e-9)
    assert log.track.times.size == 38
    np.testing.assert_allclose(log.track.poses[1::2], log.odometry[1:], atol=1e-9)


def test_rawlaser_gets_its_poses_from_odom_lines(write):
    lines = ["PARAM robot_frontlaser_offset 0.3 0 h 0"]
    for k, o in enumerate(WAY):
        lines += [odom(*o, 10.0 + k), raw([1.0, 2.0, 3.0, 0.0], 10.5 + k if k < 19 else 29.0, remissions=k % 2 == 0)]
    log = read_log(write(*lines))
    assert log.read == "RAWLASER1"
    assert log.poses_are == "odometry"
    np.testing.assert_allclose(log.poses[:-1], compose(0.5 * (WAY[:-1] + WAY[1:]), np.array([0.3, 0, 0])), atol=1e-9)
    np.testing.assert_allclose(log.mount, [0.3, 0, 0])
    assert log.max_range == 50.0
    log = read_log(write(*lines[2::2]))
    assert log.poses is None
    assert "no ODOM lines" in log.why
    log = read_log(write(*[raw([1.0, 2.0, 3.0, 4.0]), odom(*WAY[1]), raw([1.0, 2.0, 3.0, 4.0])]))
    np.testing.assert_allclose(log.poses, [WAY[1], WAY[1]])


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("ODOM 1 2", "truncated ODOM"),
        ("ODOM 1 x 0 0 0 0 1 h 1", "field 2 is 'x'"),
        ("ODOM 1 nan 0 0 0 0 1 h 1", "the pose is 1.0, nan"),
        ("PARAM robot_frontlaser_offset far", "robot_frontlaser_offset, field 1 is 'far'"),
        (raw([1.0, 2.0, 3.0]) + " 1", "do not fit a RAWLASER1 message"),
    ],
)
def test_other_lines_that_are_broken_are_named(write, line, reason):
    (broken,) = read_log(write(GOOD, line)).broken
    assert broken.where == "line 2"
    assert reason in broken.reason


@pytest.mark.parametrize(
    ("ranges", "reason"),
    [
        ([0.0] * 4, "FLASER: no reading in 2 scans"),
        ([math.nan, 0.0, -1.0, 0.0], "FLASER: no reading in 2 scans"),
        (
            [3000.0, 3100.0, 2500.0, 8000.0],
            "median range is 3000: ranges must be in metres, these look like millimetres",
        ),
        ([300.0, 310.0, 250.0, 800.0], "look like centimetres or millimetres"),
    ],
)
def test_readings_that_make_no_sense_are_an_error(write, ranges, reason):
    with pytest.raises(InvalidLogError, match=reason):
        read_log(write(flaser(ranges, SCAN[1]), flaser(ranges, SCAN[1])))
    lines = [robotlaser(np.multiply(1000.0, SCAN[0]), SCAN[1], max_range=8.0)]
    with pytest.raises(InvalidLogError, match=r"ROBOTLASER1: the median range is 2500.*millimetres"):
        read_log(write(*lines))
    # codes for no return are no millimetres
    assert len(
        read_log(write(flaser([1.0, 2.0, 81.91, 81.91], SCAN[1]), flaser([1.0, 5000.0, 5000.0, 5000.0], SCAN[1])))
    )


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
    monkeypatch.setattr(carmen, "MAX_LINE", 1000)
    log = read_log(write(GOOD, b"\0" * 3500, GOOD))
    assert len(log.ranges) == 2
    assert [part.where for part in log.broken] == ["line 2"]
    with pytest.raises(InvalidLogError, match="line 1: longer than"):
        read_log(write(b"\0" * 3500, GOOD))


def test_a_foreign_file_is_given_up_early(write, monkeypatch):
    monkeypatch.setattr(carmen, "GIVE_UP", 20)
    with pytest.raises(InvalidLogError, match="in 20 lines; line 1: not a CARMEN message"):
        read_log(write(*["3 4 5"] * 100, GOOD))


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "is empty"),
        (b"\n\n", "no usable FLASER, ROBOTLASER1 or RAWLASER1 message in 2 lines"),
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
    np.testing.assert_array_equal(log.poses, ARRAYS["poses"])
    np.testing.assert_array_equal(log.angles, [ARRAYS["angles"]] * 2)
    np.testing.assert_array_equal(log.ranges, [[1, 2, 3, np.nan], [4, 5, np.inf, 7]])
    assert log.max_range == 6.0
    np.testing.assert_array_equal(log.pose_covariance, [np.diag([1.0, 2.0, 3.0])] * 2)
    np.savez(tmp_path / "b.npz", **{key: value.astype(np.float32) for key, value in ARRAYS.items()})
    log = read_log(tmp_path / "b.npz")
    assert log.pose_covariance is None
    assert log.max_range is None
    assert log.ranges[0].dtype == np.float64


def test_what_an_npz_may_hold_besides(tmp_path):
    more = {"odometry": ARRAYS["poses"] + 1.0, "times": np.array([5.0, 6.0]), "time_increment": 0.01}
    back = {"angles": ARRAYS["angles"][::-1], "ranges": ARRAYS["ranges"][:, ::-1]}
    np.savez(tmp_path / "a.npz", **{**ARRAYS, **back, **more})
    log = read_log(tmp_path / "a.npz")
    np.testing.assert_array_equal(log.angles[0], ARRAYS["angles"])
    np.testing.assert_array_equal(log.ranges[0], [1, 2, 3, np.nan])
    np.testing.assert_allclose(log.beam_times[0], [0.03, 0.02, 0.01, 0.0])
    np.testing.assert_array_equal(log.times, [5.0, 6.0])
    np.testing.assert_array_equal(log.odometry, ARRAYS["poses"] + 1.0)
    assert log.poses_are == "unknown"
    del back["angles"], more["time_increment"]
    wrapped = np.array([3.0, 3.1, -3.1, -3.0])
    np.savez(tmp_path / "a.npz", angles=wrapped, ranges=ARRAYS["ranges"], **more)
    log = read_log(tmp_path / "a.npz")
    np.testing.assert_allclose(log.angles[0], [3.0, 3.1, 2 * math.pi - 3.1, 2 * math.pi - 3.0])
    assert log.poses_are == "odometry"
    np.savez(tmp_path / "a.npz", angles=wrapped, ranges=ARRAYS["ranges"])
    assert read_log(tmp_path / "a.npz").poses is None


def test_broken_scans_of_an_npz_are_named(tmp_path):
    ranges, poses = np.ones((4, 4)), np.zeros((4, 3))
    ranges[1, 2], poses[3, 0] = np.nan, np.inf
    given = np.arange(4)[:, None, None] * np.eye(3)
    np.savez(tmp_path / "a.npz", angles=ARRAYS["angles"], ranges=ranges, poses=poses, pose_covariance=given)
    log = read_log(tmp_path / "a.npz")
    assert [str(part) for part in log.broken] == ["scan 3: the pose is inf, 0.0, 0.0"]
    assert np.isnan(log.ranges[1][2])
    np.testing.assert_array_equal(log.pose_covariance, given[[0, 1, 2]])
    ranges[:] = np.nan
    np.savez(tmp_path / "a.npz", angles=ARRAYS["angles"], ranges=ranges, poses=poses)
    with pytest.raises(InvalidLogError, match=r"no reading in 3 scans"):
        read_log(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"angles": None}, "no array 'angles'"),
        ({"angles": np.array([0.0, 0.0, 1.0, 2.0])}, "angles"),
        ({"angles": np.array([0.0, 1.0, 2.0, np.nan])}, "angles"),
        ({"angles": np.linspace(-90, 90, 4)}, "are they degrees"),
        ({"angles": np.zeros((2, 2))}, r"got \(2, 2\)"),
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
        ({"odometry": np.ones((3, 3))}, "odometry"),
        ({"times": np.array([1.0, np.nan])}, "times"),
        ({"time_increment": 0.1}, "needs times"),
        ({"times": np.ones(2), "time_increment": 1.0}, "takes at most 2 s"),
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


def assert_sound(log):
    """A log that keeps its promises, whatever it was read from."""
    n = len(log)
    assert n > 0
    assert len(log.angles) == n
    for angles, ranges in zip(log.angles, log.ranges, strict=True):
        assert angles.shape == ranges.shape
        assert (np.diff(angles) > 0).all()
        assert (np.isnan(ranges) | (ranges > 0)).all()
    for poses in (log.poses, log.odometry):
        assert poses is None or (poses.shape == (n, 3) and np.isfinite(poses).all())
    assert log.track is None or (np.diff(log.track.times) > 0).all()


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
        assert_sound(log)
    assert read > {"text": 100, "gz": 5, "npz": -1}[kind]  # every change of an .npz is noticed by its checksum
