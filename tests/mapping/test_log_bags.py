import math
import shutil

import numpy as np
import pytest
from line_scenes import distance

pytest.importorskip("rosbags")

from bags import BEAMS, MOUNT, ROOM, START, Bag, drive, laser, measured, odometry, robot

from polyexplore_gym.errors import InvalidLogError, MissingDependencyError
from polyexplore_gym.mapping import map_log, read_log
from polyexplore_gym.mapping.logs import deskewed
from polyexplore_gym.mapping.logs.poses import between, compose

KINDS = ["bag", "db3", "mcap"]
TIMES = 0.2 * np.arange(20)


def assert_poses(got, expected, atol=2e-3):
    off = between(expected, got)
    assert np.abs(off).max() < atol, np.abs(off).max(axis=0)


def ends(angles, ranges, pose):
    hit = np.isfinite(ranges)
    turned = angles[hit] + pose[2]
    return pose[:2] + ranges[hit, None] * np.c_[np.cos(turned), np.sin(turned)]


@pytest.mark.parametrize("kind", KINDS)
def test_scans_and_both_poses_are_read(tmp_path, kind):
    path = drive(tmp_path / "a", kind)
    seen = []
    log = read_log(path, watch=seen.append)
    assert seen == sorted(seen)
    assert log.read == "/scan"
    assert not log.broken
    assert not log.notes
    assert log.poses_are == "corrected"
    assert log.max_range == 12.0
    np.testing.assert_allclose(log.times - START, TIMES, atol=1e-6)
    np.testing.assert_allclose(log.mount, MOUNT, atol=1e-9)
    assert_poses(log.poses, laser(TIMES))
    assert_poses(log.odometry, compose(odometry(TIMES), MOUNT))
    assert_poses(log.track.at(log.times + 0.05), compose(odometry(TIMES + 0.05), MOUNT))
    np.testing.assert_allclose(log.ranges[3], measured(0.6), atol=1e-5)
    np.testing.assert_allclose(log.angles[3], -math.pi + 2 * math.pi / BEAMS * np.arange(BEAMS), atol=1e-6)
    assert log.beam_times[3][-1] == pytest.approx(5e-4 * (BEAMS - 1))


@pytest.mark.parametrize(
    ("kind", "compression"),
    [("bag", "BZ2"), ("bag", "LZ4"), ("db3", "FILE"), ("db3", "MESSAGE"), ("mcap", "FILE"), ("mcap", "MESSAGE")],
)
def test_compressed_bags(tmp_path, kind, compression):
    path = drive(tmp_path / "a", kind, scans=3, compression=compression)
    whole = read_log(drive(tmp_path / "b", kind, scans=3))
    log = read_log(path)
    np.testing.assert_array_equal(log.ranges, whole.ranges)
    np.testing.assert_allclose(log.poses, whole.poses, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_scans_taken_on_the_move_are_straightened(tmp_path, kind):
    log = read_log(drive(tmp_path / "a", kind))
    walls = np.array(ROOM, float)
    straight = deskewed(log)
    assert straight.beam_times is None
    for k in range(20):
        before = distance(ends(log.angles[k], log.ranges[k], log.poses[k]), walls)
        after = distance(ends(straight.angles[k], straight.ranges[k], straight.poses[k]), walls)
        assert before.max() > 0.03
        assert after.max() < 0.004
        assert (np.diff(straight.angles[k]) >= 0).all()
    made = map_log(log)
    assert len(made.segments) == 4
    assert made.misfit < 0.01
    assert distance(made.segments.reshape(-1, 2), walls).max() < 0.01


def test_without_odometry_between_the_scans_their_own_poses_tell_the_way(tmp_path):
    from dataclasses import replace

    log = read_log(drive(tmp_path / "a", "mcap"))
    straight = deskewed(replace(log, track=None))
    worst = [
        distance(ends(straight.angles[k], straight.ranges[k], log.poses[k]), np.array(ROOM, float)).max()
        for k in range(19)
    ]
    assert max(worst) < 0.01
    # the last scan has no pose behind it, and stays as it is
    np.testing.assert_array_equal(straight.ranges[19], log.ranges[19])
    assert deskewed(replace(log, beam_times=None)).ranges is log.ranges


@pytest.mark.parametrize("kind", ["bag", "mcap"])
@pytest.mark.parametrize("upside_down", [False, True])
def test_a_laser_upside_down(tmp_path, kind, upside_down):
    log = deskewed(read_log(drive(tmp_path / "a", kind, upside_down=upside_down)))
    assert_poses(log.poses, laser(TIMES))
    for k in range(20):
        assert distance(ends(log.angles[k], log.ranges[k], log.poses[k]), np.array(ROOM, float)).max() < 0.004
        assert (np.diff(log.angles[k]) >= 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_odometry_alone(tmp_path, kind):
    for name, given in (("tf", {}), ("both", {"with_odom": True}), ("odom", {"with_tf": False})):
        given = {"corrected": False, "with_odom": False} | given
        if name == "odom":
            given["with_odom"] = True
        log = read_log(drive(tmp_path / name, kind, **given))
        assert log.poses_are == "odometry", log.why
        mount = np.zeros(3) if name == "odom" else MOUNT
        assert_poses(log.odometry, compose(odometry(TIMES), mount))
        np.testing.assert_array_equal(log.poses, log.odometry)
        assert len(log.notes) == (name == "odom")
    assert "does not say where the laser laser is on base_link" in log.notes[0]


def test_names_of_frames_with_a_slash_are_the_same(tmp_path):
    assert_poses(read_log(drive(tmp_path / "a", "bag", slash="/")).poses, laser(TIMES))


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_without_poses_gives_scans(tmp_path, kind):
    path = drive(tmp_path / "a", kind, with_tf=False, with_odom=False)
    log = read_log(path)
    assert log.poses is None
    assert log.odometry is None
    with pytest.raises(InvalidLogError, match="no poses to map with: the bag has neither /tf nor odometry"):
        map_log(log)
    # a trajectory beside it
    times = np.arange(0.0, 4.5, 0.05)
    half = 0.5 * laser(times)[:, 2]
    rows = np.c_[START + times, laser(times)[:, :2], 0 * times, 0 * times, 0 * times, np.sin(half), np.cos(half)]
    np.savetxt(tmp_path / "poses.txt", rows, fmt="%.6f", header="time x y z qx qy qz qw")
    log = read_log(path, trajectory=tmp_path / "poses.txt")
    assert log.poses_are == "corrected"
    assert_poses(log.poses, laser(TIMES))


def test_a_fixed_frame_map_is_no_correction(tmp_path):
    with Bag(tmp_path / "a", "mcap") as bag:
        bag.tf(
            0,
            bag.transform(0, "base_link", "laser", MOUNT),
            bag.transform(0, "map", "odom", (1, 2, 0)),
            topic="/tf_static",
        )
        for time in np.arange(0, 3, 0.1):
            bag.tf(time, bag.transform(time, "odom", "base_link", odometry(time)))
            bag.scan(time, measured(time))
    log = read_log(bag.path)
    assert log.poses_are == "odometry"
    np.testing.assert_array_equal(log.poses, log.odometry)


def test_without_a_frame_called_odom_the_poses_are_of_unknown_origin(tmp_path):
    with Bag(tmp_path / "a", "db3") as bag:
        bag.tf(0, bag.transform(0, "base", "laser", MOUNT), topic="/tf_static")
        for time in np.arange(0, 3, 0.1):
            bag.tf(time, bag.transform(time, "world", "base", robot(time)))
            bag.scan(time, measured(time))
    log = read_log(bag.path)
    assert log.poses_are == "unknown"
    assert "in the frame world" in log.why
    assert_poses(log.poses, laser(0.1 * np.arange(30)))


def test_odometry_beside_a_pose_from_tf(tmp_path):
    with Bag(tmp_path / "a", "bag") as bag:
        bag.tf(0, bag.transform(0, "base_link", "laser", MOUNT), topic="/tf_static")
        for time in np.arange(0, 3, 0.1):
            bag.tf(time, bag.transform(time, "map", "base_link", robot(time)))
            bag.odometry(time, odometry(time))
            bag.scan(time, measured(time))
    log = read_log(bag.path)
    assert_poses(log.poses, laser(0.1 * np.arange(30)))
    assert_poses(log.odometry, compose(odometry(0.1 * np.arange(30)), MOUNT))
    assert_poses(log.track.poses, log.odometry)


def test_a_mounting_that_is_published_again_and_again_and_a_robot_that_stands_still(tmp_path):
    for moving in (True, False):
        with Bag(tmp_path / str(moving), "mcap") as bag:
            for time in np.arange(0, 3, 0.1):
                if 1.0 < time < 2.0:
                    bag.tf(time, bag.transform(time, "base_link", "laser", MOUNT))
                bag.tf(time, bag.transform(time, "odom", "base_link", odometry(time if moving else 0.0)))
                bag.scan(time, measured(time))
        log = read_log(bag.path)
        assert len(log) == 30
        assert log.poses_are == "odometry"
        np.testing.assert_allclose(log.mount, MOUNT, atol=1e-6)
        assert_poses(log.poses, compose(odometry((0.1 if moving else 0.0) * np.arange(30)), MOUNT))


def test_scans_without_a_transform_at_their_time_are_left_out(tmp_path):
    with Bag(tmp_path / "a", "bag") as bag:
        bag.tf(0, bag.transform(0, "base_link", "laser", MOUNT), topic="/tf_static")
        for time in np.arange(0, 6, 0.1):
            if time < 2.0 or time > 4.0:
                bag.tf(time, bag.transform(time, "odom", "base_link", odometry(time)))
            bag.scan(time + 0.5, measured(time + 0.5))
    log = read_log(bag.path)
    assert all(part.reason.startswith("/tf has no pose of laser at") for part in log.broken)
    away = (log.times - START > 2.0) & (log.times - START < 4.0)
    assert not away.any()
    assert len(log) + len(log.broken) == 60
    with Bag(tmp_path / "b", "bag") as bag:
        for time in np.arange(0, 3, 0.1):
            bag.tf(time, bag.transform(time, "odom", "laser", odometry(time)))
            bag.scan(time, measured(time), stamp=100 + time)
    with pytest.raises(
        InvalidLogError, match=r"topic /scan: /tf has no pose of laser at the time of any scan, from 17"
    ):
        read_log(bag.path)
    log = read_log(tmp_path / "a.bag")
    assert_poses(log.poses, compose(odometry(log.times - START), MOUNT))


def test_a_frame_of_two_parents_is_told_of(tmp_path):
    with Bag(tmp_path / "a", "mcap") as bag:
        bag.tf(0, bag.transform(0, "base_link", "laser", MOUNT), topic="/tf_static")
        for time in np.arange(0, 1, 0.1):
            bag.tf(time, bag.transform(time, "odom", "base_link", odometry(time)))
            bag.tf(time, bag.transform(time, "other", "base_link", (0, 0, 0)))
            bag.scan(time, measured(time))
    log = read_log(bag.path)
    assert log.notes == ("/tf gives base_link several parents: odom is used",)
    assert_poses(log.poses, compose(odometry(0.1 * np.arange(10)), MOUNT))


def test_the_topic_is_found_or_named(tmp_path):
    with Bag(tmp_path / "a", "mcap") as bag:
        for time in np.arange(0, 3, 0.1):
            bag.odometry(time, odometry(time))
            bag.scan(time, measured(time), topic="/front")
            if time > 1:
                bag.scan(time, np.full(BEAMS, 2.0), topic="/rear", frame="rear")
    log = read_log(bag.path)
    assert (log.read, log.unread) == ("/front", {"/rear": 19})
    log = read_log(bag.path, topic="/rear")
    assert (log.read, log.unread) == ("/rear", {"/front": 30})
    assert len(log) == 19
    with pytest.raises(InvalidLogError, match="topic /odom: not one of laser scans; those are: /front, /rear"):
        read_log(bag.path, topic="/odom")
    with Bag(tmp_path / "b", "mcap") as bag:
        bag.odometry(0, (0, 0, 0))
    with pytest.raises(
        InvalidLogError, match=r"no topic of laser scans; the topics are: /odom \(nav_msgs/msg/Odometry\)"
    ):
        read_log(bag.path)


@pytest.mark.parametrize("kind", KINDS)
def test_what_readings_mean(tmp_path, kind):
    """inf and range_max: free; NaN, -inf, 0 and what lies outside the limits: unknown."""
    ranges = [1.0, np.inf, 12.0, np.nan, -np.inf, 0.0, 0.05, 12.5, 0.1, 11.9]
    with Bag(tmp_path / "a", kind) as bag:
        bag.scan(0.0, ranges, step=0.1)
    expected = [1.0, np.inf, np.inf, *[np.nan] * 5, 0.1, 11.9]
    np.testing.assert_allclose(read_log(bag.path).ranges[0], expected, rtol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("start", "step", "first"),
    [(math.pi, -0.02, 3.0), (0.0, 2 * math.pi / 314, 2.0), (-1.0, 0.005, 2.0), (-math.pi, 2 * math.pi / 313, 2.0)],
)
def test_reversed_and_wrapped_angles(tmp_path, kind, start, step, first):
    with Bag(tmp_path / "a", kind) as bag:
        bag.scan(0.0, np.linspace(2.0, 3.0, 314), start=start, step=step)
        bag.scan(0.1, np.linspace(2.0, 3.0, 200), start=start, step=step)
    log = read_log(bag.path)
    assert [a.size for a in log.angles] == [314, 200]
    for angles, ranges in zip(log.angles, log.ranges, strict=True):
        assert (np.diff(angles) > 0).all()
        assert ranges[0] == pytest.approx(first)
        given = start + step * np.arange(angles.size)
        np.testing.assert_allclose(np.sort(given), angles, atol=1e-5)
    assert log.beam_times[0][0] == pytest.approx(0.0 if step > 0 else 313 * 5e-4)


def one_bad(bag, k):
    """Write a scan that is broken in one way; what is told of it."""
    good = {"ranges": np.full(BEAMS, 2.0)}
    ways = [
        ({"ranges": np.full(2, 2.0)}, "2 ranges"),
        ({"step": 0.0}, "angle_increment 0"),
        ({"step": math.nan}, "angle_increment nan"),
        ({"step": 1.0}, "angle_increment 1"),
        ({"start": math.inf}, "angle_min inf"),
        ({"frame": "other"}, "frame 'other', not 'laser'"),
    ]
    change, reason = ways[k]
    bag.scan(0.5, **(good | change))
    return reason


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("k", range(6))
def test_a_broken_scan_is_named_and_left_out(tmp_path, kind, k):
    with Bag(tmp_path / "a", kind) as bag:
        for time in (0.0, 0.1):
            bag.scan(time, measured(time))
        reason = one_bad(bag, k)
    log = read_log(bag.path)
    assert len(log) == 2
    (broken,) = log.broken
    assert broken.where == "/scan, message 3"
    assert reason in broken.reason


def test_odd_fields_are_told_of(tmp_path):
    with Bag(tmp_path / "a", "mcap") as bag:
        for time in (0.0, 0.1, 0.2):
            bag.scan(time, measured(time), pause=0.5, stamp=0.0, end=0.0)
    notes = " ".join(read_log(bag.path).notes)
    assert "time_increment 0.5 s makes no sense" in notes
    assert "angle_max does not fit" in notes
    assert "times of recording are used" in notes


def test_a_tilted_laser_and_frames_in_a_circle_are_errors(tmp_path):
    with Bag(tmp_path / "a", "bag") as bag:
        lying = bag.transform(0, "base_link", "laser", MOUNT)
        lying.transform.rotation = bag.make("geometry_msgs/msg/Quaternion", math.sin(0.6), 0.0, 0.0, math.cos(0.6))
        bag.tf(0, lying, topic="/tf_static")
        bag.scan(0, measured(0))
    with pytest.raises(InvalidLogError, match=r"/tf: the laser frame laser is tilted by 69 degrees in base_link"):
        read_log(bag.path)
    with Bag(tmp_path / "b", "bag") as bag:
        pair = bag.transform(0, "a", "laser", MOUNT), bag.transform(0, "laser", "a", MOUNT)
        bag.tf(0, *pair)
        bag.scan(0, measured(0))
    with pytest.raises(InvalidLogError, match="/tf: the frames above laser run in a circle"):
        read_log(bag.path)


def test_transforms_that_are_none_are_named(tmp_path):
    with Bag(tmp_path / "a", "mcap") as bag:
        bag.scan(0, measured(0))
        for pose, scale in (((math.nan, 0, 0), 1.0), ((0, 0, 0), 3.0)):
            bad = bag.transform(0, "odom", "base_link", pose)
            bad.transform.rotation.w *= scale
            bag.tf(0, bad)
        bag.tf(0, bag.transform(0, "", "laser", MOUNT))
    reasons = [part.reason for part in read_log(bag.path).broken]
    assert reasons == [
        "a transform is not finite",
        "a quaternion has the length 3, not 1",
        "a transform leads from 'laser' to ''",
    ]


@pytest.mark.parametrize(
    ("scale", "limits", "reason"),
    [(1000.0, (0.0, 0.0), "millimetres"), (1000.0, (0.1, 12.0), "outside range_min"), (0.0, (0.1, 12.0), "no reading")],
)
def test_readings_that_make_no_sense_are_an_error(tmp_path, scale, limits, reason):
    with Bag(tmp_path / "a", "db3") as bag:
        for time in (0.0, 0.1):
            bag.scan(time, scale * measured(time), limits=limits)
    with pytest.raises(InvalidLogError, match=f"/scan: .*{reason}"):
        read_log(bag.path)


def test_a_multi_echo_laser_gives_its_first_echoes(tmp_path):
    with Bag(tmp_path / "a", "bag") as bag:
        echoes = [[2.0, 3.0], [], [4.0], [np.inf]]
        made = [bag.make("sensor_msgs/msg/LaserEcho", np.array(e, np.float32)) for e in echoes]
        scan = bag.make(
            "sensor_msgs/msg/MultiEchoLaserScan", bag.header(0, "laser"), 0.0, 0.3, 0.1, 0.0, 0.0, 0.1, 30.0, made, []
        )
        bag.write("/echoes", 0, scan)
    np.testing.assert_array_equal(read_log(bag.path).ranges[0], [2.0, np.nan, 4.0, np.inf])


def test_files_and_folders(tmp_path):
    folder = drive(tmp_path / "a", "mcap", scans=3)
    (file,) = folder.glob("*.mcap")
    whole = read_log(folder)
    np.testing.assert_array_equal(read_log(file).poses, whole.poses)
    (folder / "metadata.yaml").rename(tmp_path / "metadata.yaml")
    np.testing.assert_array_equal(read_log(folder).poses, whole.poses)
    shutil.copy(file, folder / "b.mcap")
    with pytest.raises(InvalidLogError, match=r"a: is a folder of 2 parts of a bag without metadata\.yaml"):
        read_log(folder)
    shutil.copy(file, tmp_path / "x.db3")
    with pytest.raises(InvalidLogError, match=r"x\.db3: is a ROS 2 bag of the kind \.mcap; its name has to end so"):
        read_log(tmp_path / "x.db3")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InvalidLogError, match="empty: is a folder without a ROS 2 bag"):
        read_log(tmp_path / "empty")
    bag = drive(tmp_path / "b", "bag", scans=3)
    np.testing.assert_allclose(read_log(bag.rename(tmp_path / "noname")).poses, whole.poses, atol=1e-9)
    (tmp_path / "a.log").write_text("FLASER 3 1 2 3 0 0 0 0 0 0\n")
    with pytest.raises(InvalidLogError, match="has no topic /scan: it is no bag"):
        read_log(tmp_path / "a.log", topic="/scan")


def test_without_rosbags_the_error_says_how_to_install_it(tmp_path, monkeypatch):
    path = drive(tmp_path / "a", "bag", scans=1)
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    with pytest.raises(MissingDependencyError, match=r"polyexplore-gym\[logs\]"):
        read_log(path)
