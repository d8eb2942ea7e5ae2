"""SLAM on laser logs: drives whose truth is known, real logs, interruptions."""

import importlib.util
import math
import os
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from line_scenes import box, distance
from slam_scenes import BUILDING, SENSOR, drifted, drive, rounds

from polyexplore_gym.errors import InvalidConfigError, InvalidLogError, ResultsError
from polyexplore_gym.mapping import LaserLog, correct_poses, corrected_log, map_log, read_log, sensor_of
from polyexplore_gym.mapping.logs.poses import between, compose, wrap
from polyexplore_gym.mapping.slam import loops
from polyexplore_gym.mapping.slam.loops import Loop, agreeing, candidate, close
from polyexplore_gym.mapping.slam.state import State, fingerprint, load, save
from polyexplore_gym.mapping.slam.surface import surface_of

DATA = Path(os.environ.get("POLYEXPLORE_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")
LOGS = DATA / "laser_logs"


def off(poses, true):
    """(n, 3) errors, both seen from the first pose."""
    out = between(true[0], true) - between(poses[0], poses)
    out[:, 2] = wrap(out[:, 2])
    return out


@pytest.fixture(scope="module")
def twice_round():
    """Two rounds, the odometry of which ends 10 m and 100 degrees off."""
    return drive(np.random.default_rng(1))


@pytest.fixture(scope="module")
def found(twice_round):
    return correct_poses(twice_round[0], SENSOR)


@pytest.fixture(scope="module")
def once_round():
    return drive(np.random.default_rng(0), count=1)


def test_odometry_that_drifts_is_corrected(twice_round, found):
    log, true = twice_round
    wrong, error = off(log.poses, true), off(found.poses, true)
    assert np.hypot(*wrong[-1, :2]) > 5.0
    assert np.hypot(*error[:, :2].T).max() < 0.03
    assert np.abs(error[:, 2]).max() < math.radians(0.3)
    assert found.loops >= 3
    assert found.lost == 0
    np.testing.assert_array_equal(found.poses[0], log.poses[0])
    # The covariances are about right: walls are taken to be less straight than these are.
    c, s = math.cos(found.poses[0, 2]), math.sin(found.poses[0, 2])
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    sigma = turn @ found.covariance @ turn.T
    nees = [float(e @ np.linalg.solve(p, e)) for e, p in zip(error[1:], sigma[1:], strict=True)]
    assert 0.1 < np.mean(nees) < 4.0
    # What is the same in neighbouring poses is not in the local covariance.
    assert np.median(found.local_covariance[:, 0, 0]) < np.median(found.covariance[1:, 0, 0])


def test_the_map_made_on_them_fits(twice_round, found):
    log, true = twice_round
    with pytest.warns(UserWarning, match=r"do not fit: .*--poses odometry finds better ones"):
        wrong = map_log(log, SENSOR)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made = map_log(corrected_log(log, found), SENSOR)
    assert made.misfit < 0.02 < 0.2 < wrong.misfit
    there = compose(true[0], np.c_[between(found.poses[0], np.c_[made.segments[:, :2], np.zeros(len(made.segments))])])
    assert distance(there[:, :2], np.array(BUILDING)).max() < 0.05
    assert made.rho.size < 60 < wrong.rho.size


def test_the_scans_alone_do_where_they_show_enough(twice_round):
    log, true = twice_round
    alone = LaserLog(log.angles, log.ranges, None, max_range=log.max_range, times=log.times)
    made = correct_poses(alone, SENSOR, source="none")
    assert np.hypot(*off(made.poses, true)[:, :2].T).max() < 0.03
    np.testing.assert_array_equal(made.poses[0], 0.0)
    assert made.calibration is None
    np.testing.assert_array_equal(made.track.poses, made.poses)


def test_poses_between_the_scans(once_round):
    """Odometry five times as often as scans, stamps to 10 ms with some alike: the track leads through the scans."""
    rng = np.random.default_rng(5)
    log, _ = once_round
    true = rounds(1, 0.1)
    at = np.arange(0, len(true), 5)
    full, _ = drive(rng, count=1, step=0.1)
    odometry = drifted(true, rng, noise=(0.004, 0.008))
    stamps = np.floor(np.arange(len(true)) / 3) * 0.02  # three lines a stamp
    from polyexplore_gym.mapping.logs.record import Way

    log = replace(
        full, ranges=[full.ranges[k] for k in at], angles=[full.angles[k] for k in at], poses=odometry[at],
        odometry=odometry[at], times=stamps[at], way=Way(stamps, odometry, at),
    )  # fmt: skip
    made = correct_poses(log, SENSOR)
    assert np.hypot(*off(made.way.poses, true)[:, :2].T).max() < 0.06
    np.testing.assert_allclose(made.way.poses[at], made.poses, atol=1e-12)
    track = made.track
    assert (np.diff(track.times) > 0).all()
    assert len(track.times) == len(true)
    first = np.unique(stamps[at], return_index=True)[1]  # of two scans with one stamp one keeps it
    np.testing.assert_allclose(between(track.at(stamps[at][first]), made.poses[first]), 0.0, atol=1e-9)


def stopped_after(count):
    """A tracker that is interrupted in the first pass; it counts the scans."""
    done = []

    def track(scans, what):
        for n, k in enumerate(scans):
            if what == "match":
                if n == count:
                    raise KeyboardInterrupt
                done.append(k)
            yield k

    return track, done


def test_an_interrupted_run_goes_on_and_ends_the_same(once_round, tmp_path):
    log, _ = once_round
    whole = correct_poses(log, SENSOR)
    path = tmp_path / "run.npz"
    track, done = stopped_after(60)
    with pytest.raises(KeyboardInterrupt):
        correct_poses(log, SENSOR, state=path, track=track)
    assert done == list(range(60))
    assert [p.name for p in tmp_path.iterdir()] == ["run.npz"]
    work = []
    import polyexplore_gym.mapping.slam.mapper as mapper

    insert = mapper._insert
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mapper, "_insert", lambda *a: (work.append(1), insert(*a))[1])
        again = correct_poses(log, SENSOR, state=path)
    assert len(work) == len(log) - 60
    for name in ("poses", "covariance", "local_covariance", "keys"):
        np.testing.assert_array_equal(getattr(again, name), getattr(whole, name))
    assert (again.loops, again.lost) == (whole.loops, whole.lost)


def test_a_state_is_read_as_it_was_written(tmp_path):
    rng = np.random.default_rng(0)
    loop = Loop(1, 4, rng.normal(size=3), np.eye(3))
    state = State(
        list(rng.normal(size=(5, 3))), [0, 2, 4], list(rng.normal(size=(3, 3, 3))), list(rng.normal(size=(3, 3))),
        [0.0, 1.0, 2.5], [loop], [loop, loop._replace(new=3)], 1.5, 2, 1,
    )  # fmt: skip
    path = tmp_path / "state.npz"
    save(state, path, "mark")
    back = load(path, "mark")
    for name in State.__slots__:
        np.testing.assert_equal(getattr(back, name), getattr(state, name))
    # of another log, cut off, none of ours, absent
    assert load(path, "other") is None
    content = path.read_bytes()
    for damaged in (content[: len(content) // 2], b"", b"film"):
        path.write_bytes(damaged)
        assert load(path, "mark") is None
    assert load(tmp_path / "nothing.npz", "mark") is None
    with pytest.raises(ResultsError, match="cannot be written"):
        save(state, tmp_path / "nowhere" / "state.npz", "mark")


def test_logs_and_settings_are_told_apart(once_round):
    log, _ = once_round
    other = replace(log, ranges=[*log.ranges[:-1], log.ranges[-1] + 0.01])
    marks = {fingerprint(log, "a"), fingerprint(log, "b"), fingerprint(other, "a")}
    assert len(marks) == 3
    assert fingerprint(log, "a") in marks


def test_bad_input_is_told(once_round):
    log, _ = once_round
    with pytest.raises(InvalidConfigError, match="source = 'laser': must be odometry or none"):
        correct_poses(log, SENSOR, source="laser")
    with pytest.raises(InvalidLogError, match=r"no odometry to go by: none here; the scans alone may do: none"):
        correct_poses(replace(log, poses=None, odometry=None, poses_are="unknown", why="none here"), SENSOR)
    with pytest.raises(InvalidLogError, match=r"no poses to map with: .*--poses none"):
        map_log(replace(log, poses=None, odometry=None, poses_are="unknown"), SENSOR)


def test_small_and_empty_logs(once_round):
    """One scan, a robot that stands, a laser that sees nothing: the odometry stays."""
    log, _ = once_round

    def first(n, **changes):
        names = ("angles", "ranges", "poses", "odometry", "times")
        return replace(log, **{name: getattr(log, name)[:n] for name in names}, **changes)

    one = correct_poses(first(1), SENSOR)
    np.testing.assert_array_equal(one.poses, log.poses[:1])
    assert not one.covariance.any()
    ranges, pose = [log.ranges[0]] * 5, np.repeat(log.poses[:1], 5, axis=0)
    stands = correct_poses(replace(first(5), ranges=ranges, poses=pose, odometry=pose), SENSOR)
    assert stands.keys.tolist() == [0]
    assert np.abs(stands.poses - pose).max() < 0.01
    with pytest.warns(UserWarning, match="7 of 8 scans show too little"):
        blind = correct_poses(replace(first(8), ranges=[np.full(361, math.nan)] * 8), SENSOR)
    assert blind.lost == 7
    np.testing.assert_allclose(between(blind.poses, log.poses[:8]), 0.0, atol=0.02)
    np.testing.assert_array_equal(np.isfinite(blind.local_covariance), True)


def test_candidates_are_near_and_from_long_ago():
    poses = np.array([[0, 0, 0], [5, 0, 0], [10, 0, 0], [6, 1, 0], [0.5, 0.5, 0.0]])
    way = np.array([0.0, 5.0, 10.0, 14.2, 20.0])
    assert candidate(poses, way, 0.0) == 0
    assert candidate(poses[:4], way[:4], 14.2) == -1  # key scan 1 is near, but not 10 m of way ago
    poses[-1, 0] += 30.0
    assert candidate(poses, way, 0.0) == -1


def test_a_place_is_recognised_and_another_is_not():
    sensor = sensor_of(LaserLog(np.linspace(-1.57, 1.57, 361), np.ones((1, 361)), np.zeros((1, 3))))
    from line_scenes import HALF, measure

    from polyexplore_gym.config import MappingConfig

    rng = np.random.default_rng(0)

    def looks(walls, poses):
        config = MappingConfig(range_floor=0.01)
        return [surface_of(HALF, measure(walls, pose, SENSOR, rng), sensor, config) for pose in poses]

    line = np.c_[np.linspace(1, 3, 6), np.full(6, 1.7), np.zeros(6)]
    back = np.c_[np.linspace(1.5, 3.5, 6), np.full(6, 1.5), np.full(6, 0.1)]
    wrong = compose(np.array([0.6, -0.5, 0.15]), back)  # what the odometry says
    poses = np.concatenate([line, wrong])
    loop = close([*looks(BUILDING, line), *looks(BUILDING, back)], poses, 3, (1.5, 0.4))
    assert (loop.old, loop.new) == (3, 11)
    true = between(line[3], back[5])
    assert np.hypot(*(loop.measured - true)[:2]) < 0.02
    assert abs(loop.measured[2] - true[2]) < 0.005
    elsewhere = looks(box(-1.0, 0.0, 9.0, 2.6), back)
    assert close([*looks(BUILDING, line), *elsewhere], poses, 3, (1.5, 0.4)) is None


def test_two_loops_must_agree():
    poses = np.array([[0.5 * k, 0.0, 0.0] for k in range(20)])
    right, information = between(poses[2], poses[18]), np.eye(3)
    one = Loop(2, 18, right, information)
    before = Loop(1, 16, between(poses[1], poses[16]), information)
    assert agreeing([before, one], poses)
    assert not agreeing([one], poses)
    assert not agreeing([before._replace(measured=before.measured + np.array([0.3, 0, 0])), one], poses)
    assert not agreeing([before._replace(measured=before.measured + np.array([0, 0, 0.1])), one], poses)
    old = Loop(1, 18 - loops.WITHIN - 1, between(poses[1], poses[18 - loops.WITHIN - 1]), information)
    assert not agreeing([old, one], poses)


@pytest.mark.slow
@pytest.mark.skipif(not (LOGS / "intel-raw.log.gz").is_file(), reason="no laser logs")
def test_the_intel_log_fits_relations_checked_by_hand():
    path = Path(__file__).resolve().parents[2] / "benchmarks" / "log_slam.py"
    spec = importlib.util.spec_from_file_location("log_slam", path)
    benchmark = sys.modules["log_slam"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(benchmark)
    log, filtered = read_log(LOGS / "intel-raw.log.gz"), read_log(LOGS / "intel-corrected.log.gz")
    made = correct_poses(log, sensor_of(log))
    given = benchmark.relations(LOGS / "intel.relations.gz")
    translation, rotation = benchmark.relation_errors(made.way.stamps, made.way.poses, *given)
    assert len(translation) == 2984
    assert translation.mean() <= 0.031
    assert rotation.mean() <= 1.3
    assert benchmark.thickness(log, made.poses) < 0.8 * benchmark.thickness(filtered, filtered.poses)
