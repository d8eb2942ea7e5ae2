import math
from dataclasses import replace

import numpy as np
import pytest
from line_scenes import HALF

from polyexplore_gym.errors import InvalidLogError, ResultsError
from polyexplore_gym.mapping import LaserLog
from polyexplore_gym.mapping.logs import Track, deskewed, read_trajectory, save_trajectory, with_trajectory
from polyexplore_gym.mapping.logs.poses import between, compose, wrap
from polyexplore_gym.mapping.logs.trajectory import chosen, covered


def matrix(pose):
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0, 0, 1]])


def test_poses_are_put_together_as_matrices_are():
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-4, 4, (2, 50, 3))
    for x, y, both, seen in zip(a, b, compose(a, b), between(a, b), strict=True):
        np.testing.assert_allclose(matrix(both), matrix(x) @ matrix(y), atol=1e-12)
        np.testing.assert_allclose(matrix(seen), np.linalg.inv(matrix(x)) @ matrix(y), atol=1e-12)
    np.testing.assert_allclose(between(a, compose(a, b))[:, :2], b[:, :2], atol=1e-12)
    np.testing.assert_allclose(compose(a[0], b), [compose(a[0], y) for y in b])
    assert (np.abs(wrap(np.linspace(-20, 20, 100))) <= math.pi).all()


def test_a_track_turns_the_short_way():
    track = Track.sorted(
        np.array([2.0, 0.0, 1.0, 1.0]), np.array([[4, 0, -3.0], [0, 0, 2.0], [2, 2, 3.0], [9, 9, 9.0]])
    )
    np.testing.assert_array_equal(track.times, [0.0, 1.0, 2.0])
    got = track.at(np.array([-1.0, 0.5, 1.5, 3.0]))
    np.testing.assert_allclose(got[:, :2], [[0, 0], [1, 1], [3, 1], [4, 0]])
    np.testing.assert_allclose(wrap(got[:, 2] - [2.0, 2.5, math.pi, -3.0]), 0.0, atol=1e-9)


def test_what_a_track_covers():
    track = Track(
        np.array([0.0, 0.5, 3.0, 6.0, 6.5]), np.array([[0, 0, 0], [1, 0, 0], [1.01, 0, 0], [4, 0, 0], [5, 0, 0.0]])
    )
    times = np.array([-0.005, -0.1, 0.2, 2.0, 4.0, 3.005, 6.2, 6.6])
    assert covered(track, times).tolist() == [True, False, True, True, False, True, True, False]
    assert covered(Track(np.array([1.0]), np.zeros((1, 3))), np.array([1.0, 1.2])).tolist() == [True, False]


def test_poses_are_read_as_they_were_written(tmp_path):
    rng = np.random.default_rng(2)
    times = 976052857.337484 + np.cumsum(rng.uniform(0.001, 0.5, 200))
    track = Track(np.round(times, 6), np.c_[rng.uniform(-50, 50, (200, 2)), rng.uniform(-math.pi, math.pi, 200)])
    save_trajectory(track, tmp_path / "poses.txt")
    back = read_trajectory(tmp_path / "poses.txt")
    np.testing.assert_allclose(back.times, track.times, rtol=0, atol=1e-6)
    np.testing.assert_allclose(back.poses[:, :2], track.poses[:, :2], atol=1e-6)
    np.testing.assert_allclose(wrap(back.poses[:, 2] - track.poses[:, 2]), 0.0, atol=1e-8)
    assert [path.name for path in tmp_path.iterdir()] == ["poses.txt"]
    with pytest.raises(ResultsError, match="cannot be written"):
        save_trajectory(track, tmp_path / "nowhere" / "poses.txt")


def test_a_file_of_poses_is_read(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text("# time x y z qx qy qz qw\n\n2 1 2 9 0 0 0 1\n1.5,3,4,0,0,0,0.6,0.8\n")
    track = read_trajectory(path)
    np.testing.assert_allclose(track.times, [1.5, 2.0])
    np.testing.assert_allclose(track.poses, [[3, 4, 2 * math.atan2(0.6, 0.8)], [1, 2, 0]])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("# nothing\n", "holds no pose"),
        ("1 2 3\n", "line 1: 3 fields; a pose is: time x y z qx qy qz qw"),
        ("# head\n1 2 x 0 0 0 0 1\n", "line 2: y is 'x', not a finite number"),
        ("1 2 3 0 0 0 nan 1\n", "line 1: qz is 'nan'"),
        ("1 2 3 0 0 0 0 0\n", "line 1: the quaternion has the length 0, not 1"),
        ("1 2e30 3 0 0 0 0 1\n", "line 1: the pose is 2e"),
    ],
)
def test_what_is_no_trajectory_is_an_error(tmp_path, text, reason):
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with pytest.raises(InvalidLogError, match=r"poses\.txt: ") as error:
        read_trajectory(path)
    assert reason in str(error.value)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(InvalidLogError, match="is not text: byte 0"):
        read_trajectory(path)
    with pytest.raises(InvalidLogError, match="cannot be read: No such file"):
        read_trajectory(tmp_path / "missing.txt")


def test_scans_without_a_pose_are_left_out():
    times = np.array([0.0, 0.5, 5.0, 1.0])
    log = LaserLog(HALF, np.full((4, 361), 2.0), None, times=times, odometry=np.arange(12.0).reshape(4, 3))
    track = Track(np.array([-1.0, 0.0, 1.0]), np.array([[0, 0, 0], [0, 0, 0], [1, 2, 0.2]]))
    made = with_trajectory(log, track, "poses.txt")
    np.testing.assert_allclose(made.poses, [[0, 0, 0], [0.5, 1, 0.1], [1, 2, 0.2]])
    np.testing.assert_array_equal(made.odometry, log.odometry[[0, 1, 3]])
    assert [str(part) for part in made.broken] == ["scan at 5.000 s: the trajectory has no pose within 1 s"]
    with pytest.raises(InvalidLogError, match=r"poses\.txt: cannot be used: the scans of the log have no times"):
        with_trajectory(replace(log, times=None), track, "poses.txt")
    with pytest.raises(
        InvalidLogError, match=r"times are -1\.000 to 1\.000 s, those of the scans 100\.000 to 105\.000 s"
    ):
        with_trajectory(replace(log, times=times + 100.0), track, "poses.txt")
    assert len(chosen(log, np.zeros(4, bool), [])) == 0


def test_a_beam_is_moved_as_the_laser_was():
    """The plain twin: the end of each beam by matrices."""
    rng = np.random.default_rng(1)
    angles, ranges = np.linspace(-3, 3, 40), rng.uniform(1, 5, 40)
    ranges[[3, 20]], ranges[7] = np.inf, np.nan
    after = np.linspace(0.4, 0.0, 40)  # it turns clockwise
    track = Track(np.array([0.0, 1.0]), np.array([[0, 0, 0], [0.8, -0.3, 0.5]]))
    log = LaserLog(angles, [ranges], np.zeros((1, 3)), times=np.array([0.2]), beam_times=(after,), track=track)
    made = deskewed(log)
    (got_angles,), (got_ranges,) = made.angles, made.ranges
    assert np.isinf(got_ranges).sum() == 2
    assert np.isnan(got_ranges).sum() == 1
    at = [np.array([0.8, -0.3, 0.5]) * (0.2 + t) for t in after]
    ends = []
    for angle, r, pose in zip(angles, ranges, at, strict=True):
        if np.isfinite(r):
            world = matrix(pose) @ [r * math.cos(angle), r * math.sin(angle), 1]
            ends.append((np.linalg.inv(matrix(track.at(np.array([0.2]))[0])) @ world)[:2])
    hit = np.isfinite(got_ranges)
    got = got_ranges[hit, None] * np.c_[np.cos(got_angles[hit]), np.sin(got_angles[hit])]
    order = np.lexsort(np.round(got, 6).T), np.lexsort(np.round(ends, 6).T)
    np.testing.assert_allclose(got[order[0]], np.array(ends)[order[1]], atol=1e-9)
    assert (np.diff(got_angles) >= 0).all()
