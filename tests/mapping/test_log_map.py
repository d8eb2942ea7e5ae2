import json
import math
import os
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from line_scenes import HALF, box, cast, distance, measure

from polyexplore_gym.config import MappingConfig, SensorConfig
from polyexplore_gym.errors import InvalidConfigError, InvalidLogError, MissingDependencyError, RenderingError
from polyexplore_gym.floorplan import load_plan
from polyexplore_gym.mapping import (
    MAP_SUFFIXES,
    LaserLog,
    LineMap,
    beams_of_log,
    map_log,
    read_log,
    save_map,
    sensor_of,
    walls_of_log,
)
from polyexplore_gym.mapping.evidence import BIN, BINS, OBLIQUE, Counts, confirmed, count, pieces_of
from polyexplore_gym.mapping.export import occupancy
from polyexplore_gym.mapping.log_map import MISFIT
from polyexplore_gym.mapping.logs.poses import between, compose

DATA = Path(os.environ.get("POLYEXPLORE_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")
LOGS = sorted((DATA / "laser_logs").glob("*.log.gz")) if (DATA / "laser_logs").is_dir() else []

ROOM = box(0.0, 0.0, 6.0, 4.0)
# The wall between two rooms, with a door of 1 m.
DOOR = [*box(0.0, 0.0, 8.0, 4.0), [4.0, 0.0, 4.0, 1.5], [4.0, 2.5, 4.0, 4.0]]


SENSOR = SensorConfig(max_range=20.0)


def drive(walls, poses, rng, extra=()) -> LaserLog:
    """A log of scans from poses; in scan `extra[0]` the walls `extra[1]` stand there as well."""
    ranges = [
        measure([*walls, *(extra[1] if extra and k == extra[0] else ())], pose, SENSOR, rng)
        for k, pose in enumerate(poses)
    ]
    return LaserLog(HALF, np.array(ranges), np.array(poses, float), max_range=SENSOR.max_range)


def circle(x, y, n):
    return [(x, y, 2 * math.pi * k / n) for k in range(n)]


def test_a_room_is_mapped():
    log = drive(ROOM, circle(2.0, 2.0, 8) + circle(4.0, 2.5, 8), np.random.default_rng(0))
    made = map_log(log)
    assert made.rho.size == 4
    assert len(made.segments) == 4
    assert len(made.path) == 16
    assert len(made.points) == np.isfinite(log.ranges).sum()
    assert made.compression == pytest.approx(1 - 4 / len(made.points))
    assert 0.002 < made.median_distance < 0.02
    ends = made.segments.reshape(-1, 2)
    corners = np.array([[0, 0], [6, 0], [6, 4], [0, 4]])
    assert np.hypot(*(ends[:, None] - corners).T).min(axis=0).max() < 0.05
    # Distances are those to the nearest segment, worked out plainly.
    np.testing.assert_allclose(made.distances, distance(made.points, made.segments), atol=1e-9)
    # Every segment lies on its line.
    for segment, i in zip(made.segments, made.segment_line, strict=True):
        offset = segment.reshape(2, 2) @ [math.cos(made.alpha[i]), math.sin(made.alpha[i])] - made.rho[i]
        assert np.abs(offset).max() < 0.005


def test_the_walls_and_beams_of_a_log():
    """Those of the map, and of the scans used; of beams without a return nothing is known."""
    log = drive(DOOR[:3], circle(2.0, 2.0, 6) + circle(6.0, 2.0, 6), np.random.default_rng(1))
    made = map_log(log, every=2)
    walls, beams = walls_of_log(made), list(beams_of_log(log, made, 20.0))
    np.testing.assert_array_equal(made.used, np.arange(0, 12, 2))
    np.testing.assert_array_equal(walls.segments, made.segments)
    normals = np.stack((np.cos(walls.alpha), np.sin(walls.alpha)), axis=1)[walls.line]
    assert np.abs((walls.segments[:, :2] * normals).sum(axis=1) - walls.rho[walls.line]).max() < 0.01
    assert len(beams) == 6
    assert not all((log.ranges[k] < 20.0).all() for k in made.used)
    for k, beam in zip(made.used, beams, strict=True):
        np.testing.assert_array_equal(beam.pose, log.poses[k])
        returned = log.ranges[k] < 20.0
        np.testing.assert_array_equal(np.isfinite(beam.ranges), returned)
        np.testing.assert_array_equal(beam.ranges[returned], log.ranges[k][returned])


def test_it_is_the_line_map_of_the_scans_where_nothing_is_cut():
    log = drive(DOOR, circle(2.0, 2.0, 6) + circle(6.0, 2.0, 6), np.random.default_rng(1))
    made = map_log(log, ratio=0)
    line_map, covariance = LineMap(MappingConfig(range_floor=0.01), sensor_of(log)), np.diag([0.02, 0.02, 0.3]) ** 2
    covariance[2, 2] = math.radians(0.3) ** 2
    from polyexplore_gym.mapping import extract_lines

    for ranges, pose in zip(log.ranges, log.poses, strict=True):
        line_map.insert(extract_lines(HALF, ranges, sensor_of(log), line_map.config), pose, covariance)
    on = line_map.alive & (line_map.line >= 0)
    np.testing.assert_array_equal(made.segments, line_map.segments[on])
    np.testing.assert_array_equal(made.rho, line_map.rho[line_map.line_alive])
    np.testing.assert_array_equal(made.covariance, line_map.covariance[line_map.line_alive])


def crossing(made, x):
    """Length of walls that cross the door at this x, m."""
    s = made.segments
    on = (np.abs(s[:, [0, 2]] - x) < 0.1).all(axis=1)
    low, high = np.minimum(s[on, 1], s[on, 3]), np.maximum(s[on, 1], s[on, 3])
    return float(np.clip(np.minimum(high, 2.4) - np.maximum(low, 1.6), 0, None).sum())


def test_a_door_that_opens_is_open_and_the_wall_beside_it_stays():
    shut = [[4.0, 1.5, 4.0, 2.5]]
    log = drive(DOOR, circle(2.0, 2.0, 8) + circle(6.0, 2.0, 8), np.random.default_rng(2), extra=(0, shut))
    kept, cut = map_log(log, ratio=0), map_log(log)
    assert crossing(kept, 4.0) > 0.7
    assert crossing(cut, 4.0) == 0.0
    assert cut.contradicted >= 1
    assert cut.segments.shape[0] >= 6
    for y in (0.7, 3.2):  # wall on both sides of the door
        assert distance([[4.0, y]], cut.segments)[0] < 0.03
    # Shut all the time, it stays.
    always = map_log(drive([*DOOR, *shut], circle(2.0, 2.0, 8) + circle(6.0, 2.0, 8), np.random.default_rng(2)))
    assert crossing(always, 4.0) > 0.7


@pytest.mark.parametrize("value", [0.0, math.nan, math.inf])
def test_a_wall_too_dark_to_be_seen_from_afar_stays(value):
    """16 scans lose the wall at y = 4, x from 2 to 4, from more than 1.5 m; 4 scans near by see it."""
    poses = circle(3.0, 1.5, 8) + circle(2.5, 1.0, 8) + circle(3.0, 3.0, 4)
    log = drive(ROOM, poses, np.random.default_rng(8))
    ranges = []
    for (x, y, turn), r in zip(poses, log.ranges, strict=True):
        end_x, end_y = x + r * np.cos(HALF + turn), y + r * np.sin(HALF + turn)
        dark = (np.abs(end_y - 4.0) < 0.1) & (np.abs(end_x - 3.0) < 1.0) & (r > 1.5)
        ranges.append(np.where(dark, value, r))
    made = map_log(LaserLog(HALF, ranges, log.poses, max_range=20.0))
    wall = np.abs(made.segments[:, [1, 3]] - 4.0).max(axis=1) < 0.05
    covered = distance(np.c_[np.linspace(0.2, 5.8, 50), np.full(50, 4.0)], made.segments[wall])
    assert covered.max() < 0.05


def test_nothing_is_cut_where_nothing_moved():
    rng = np.random.default_rng(3)
    for walls, places in ((ROOM, [(2.0, 2.0), (4.0, 1.0)]), (DOOR, [(2.0, 2.0), (3.0, 1.0), (6.0, 3.0)])):
        made = map_log(drive(walls, [p for x, y in places for p in circle(x, y, 12)], rng))
        assert made.contradicted == 0


def counts_plainly(segments, angles, ranges, max_range, pose, covariance, var_range, var_angle):
    """The slow twin of `count`: every beam against every segment as lines in the plane."""
    begin = pieces_of(segments)
    out = Counts.zero(begin[-1])
    var_xy = 0.5 * (covariance[0, 0] + covariance[1, 1])
    for i, (ax, ay, bx, by) in enumerate(segments):
        wall = np.array([bx - ax, by - ay])
        for angle, r in zip(angles, ranges, strict=True):
            ray = np.array([math.cos(angle + pose[2]), math.sin(angle + pose[2])])
            try:
                d, t = np.linalg.solve(np.stack([ray, -wall], axis=1), [ax - pose[0], ay - pose[1]])
            except np.linalg.LinAlgError:
                continue
            across = abs(ray @ [wall[1], -wall[0]]) / np.hypot(*wall)
            if not (d > 0 and 0 <= t <= 1 and across >= OBLIQUE) or d * across > max_range or not r > 0:
                continue
            sigma2 = var_range * across**2 + var_xy + (var_angle + covariance[2, 2]) * d**2 * (1 - across**2)
            beyond = (min(r, max_range) - d) * across
            q = begin[i] + min(int(t * (begin[i + 1] - begin[i])), begin[i + 1] - begin[i] - 1)
            tolerance = 0.05 + 3 * math.sqrt(sigma2)
            if beyond > tolerance and r < max_range:
                out.passed[q] += 1
            elif beyond > tolerance and d < BIN * BINS:
                out.blank[q, int(d / BIN)] += 1
            elif beyond > -tolerance and r < max_range:
                out.stopped[q] += 1
                out.seen_from[q] = max(out.seen_from[q], d)
    return out


@pytest.mark.parametrize("full", [False, True])
def test_beams_are_counted_as_the_plain_twin_does(full):
    rng = np.random.default_rng(4)
    angles = np.linspace(-math.pi, math.pi, 90, endpoint=False) if full else np.linspace(-1.6, 1.6, 61)
    total = 0
    for _ in range(25):
        segments = np.concatenate([rng.uniform(-5, 5, (12, 4)), [[1.0, 1.0, 1.0, 1.0]]])
        pose = np.array([*rng.uniform(-3, 3, 2), rng.uniform(-7, 7)])
        near = cast(segments[:12], pose, angles, 9.0)
        ranges = np.where(rng.random(angles.size) < 0.5, near + rng.normal(0, 0.1, angles.size), rng.uniform(0.1, 12))
        ranges[rng.random(angles.size) < 0.1] = np.inf
        ranges = np.maximum(ranges, 0.01)
        ranges[rng.random(angles.size) < 0.1] = np.nan
        ranges[rng.random(angles.size) < 0.1] = 0.0
        half = rng.normal(0, 0.03, (3, 3))
        arguments = (angles, ranges, 9.0, pose, half @ half.T, 1e-4, 1e-5)
        begin, counts, walls = pieces_of(segments), Counts.zero(pieces_of(segments)[-1]), rng.random(13) < 0.5
        stopped, passed = count(segments, begin, walls, *arguments, counts)
        plain = counts_plainly(segments[:12], *arguments)
        for got, expected in zip(counts, plain, strict=True):
            np.testing.assert_allclose(got[:-1], expected, atol=1e-9)
        of_wall = np.repeat(walls, np.diff(begin))
        assert (stopped, passed) == (counts.stopped[of_wall].sum(), counts.passed[of_wall].sum())
        total += counts.stopped.sum() + counts.passed.sum()
    assert total > 1000


def test_a_beam_that_met_nothing_counts_only_from_where_others_saw_the_wall():
    counts = Counts.zero(3)
    counts.passed[:] = 1
    counts.seen_from[:] = [0.0, 1.9, 40.0]
    counts.blank[:, [0, 2, 3, 50]] = 10
    assert counts.through.tolist() == [1, 21, 41]


def test_what_is_confirmed():
    wall = np.array([[0.0, 0.0, 2.0, 0.0], [5.0, 5.0, 5.0, 5.1], [0.0, 1.0, 0.03, 1.0]])
    begin = pieces_of(wall)
    assert begin.tolist() == [0, 40, 42, 43]
    stopped, passed = np.full(43, 10), np.zeros(43, int)
    parts, of = confirmed(wall, begin, stopped, passed, 3.0)
    np.testing.assert_array_equal(parts, wall)
    assert of.tolist() == [0, 1, 2]
    passed[:] = 30  # three for each: not more
    np.testing.assert_array_equal(confirmed(wall, begin, stopped, passed, 3.0)[0], wall)
    # A stretch of 0.8 m that nothing ended on, and a short wall that much passed through.
    passed[:] = 2
    stopped[12:28], passed[12:28], passed[40:42] = 0, 30, 31
    parts, of = confirmed(wall, begin, stopped, passed, 3.0)
    assert of.tolist() == [0, 0, 2]
    assert parts[0, 2] == pytest.approx(0.6, abs=0.1)
    assert parts[1, 0] == pytest.approx(1.4, abs=0.1)
    np.testing.assert_array_equal(parts[:, [1, 3]], [[0, 0], [0, 0], [1, 1]])
    # A few beams prove nothing.
    assert len(confirmed(wall, begin, np.zeros(43, int), np.eye(43, dtype=int)[5] * 4, 3.0)[0]) == 3
    assert confirmed(np.empty((0, 4)), pieces_of(np.empty((0, 4))), stopped[:0], passed[:0], 3.0)[0].shape == (0, 4)


def test_scans_are_chosen():
    poses = [(0.3 * k, 2.0, 0.0) for k in range(10)] + [(2.7, 2.0, 0.2 * k) for k in range(1, 6)]
    log = drive(ROOM, poses, np.random.default_rng(5))
    assert map_log(log).misfit < 0.02
    np.testing.assert_array_equal(map_log(log, every=4).path, log.poses[[0, 4, 8, 12]])
    np.testing.assert_array_equal(map_log(log, min_travel=1.0).path, log.poses[[0, 4, 8, 12]])
    seen = []
    map_log(log, every=4, track=lambda scans, what: seen.append((what, len(list(scans)))) or scans)
    assert seen == [("lines", 4), ("check", 4), ("distances", 4)]


def test_the_sensor_of_a_log():
    log = LaserLog(HALF, np.ones((1, 361)), np.zeros((1, 3)))
    assert sensor_of(log) == SensorConfig(max_range=30.0)
    assert sensor_of(LaserLog(HALF, log.ranges, log.poses, max_range=8.0)).max_range == 8.0
    assert sensor_of(LaserLog(HALF, log.ranges, log.poses, max_range=8.0), 5.0).max_range == 5.0
    for angles in (np.linspace(-math.pi, math.pi, 360, endpoint=False), np.linspace(0, 2 * math.pi, 361)):
        assert sensor_of(LaserLog(angles, np.ones((1, angles.size)), log.poses)).full_circle
    assert not sensor_of(LaserLog(np.linspace(-2.35, 2.35, 1081), np.ones((1, 1081)), log.poses)).full_circle
    with pytest.raises(InvalidConfigError, match="max_range"):
        sensor_of(log, 0.0)


@pytest.mark.parametrize("change", [{"every": 0}, {"min_travel": -1}, {"ratio": math.nan}, {"sigma_xy": -0.1}])
def test_numbers_out_of_range_are_refused(change):
    log = LaserLog(HALF, np.ones((1, 361)), np.zeros((1, 3)))
    with pytest.raises(InvalidConfigError, match=next(iter(change))):
        map_log(log, **change)


def test_a_covariance_in_the_log_is_used():
    poses = circle(2.0, 2.0, 6)
    log = drive(ROOM, poses, np.random.default_rng(6))
    given = LaserLog(log.angles, log.ranges, log.poses, np.broadcast_to(np.diag([0.1, 0.1, 0.01]) ** 2, (6, 3, 3)))
    same = map_log(log, sigma_xy=0.1, sigma_heading=0.01)
    np.testing.assert_array_equal(map_log(given).covariance, same.covariance)
    assert map_log(given).covariance[0, 1, 1] > 4 * map_log(log).covariance[0, 1, 1]


@pytest.fixture(scope="module")
def made():
    return map_log(drive(DOOR, circle(2.0, 2.0, 6) + circle(6.0, 2.0, 6), np.random.default_rng(7)))


def test_json_holds_the_map(made, tmp_path):
    save_map(made, tmp_path / "a.json", name="rooms")
    data = json.loads((tmp_path / "a.json").read_text())
    assert data["name"] == "rooms"
    assert (data["scans"], data["points"]) == (12, len(made.points))
    np.testing.assert_array_equal([line["rho"] for line in data["lines"]], made.rho)
    np.testing.assert_array_equal([line["covariance"] for line in data["lines"]], made.covariance)
    owner = [i for i, line in enumerate(data["lines"]) for _ in line["segments"]]
    segments = [segment for line in data["lines"] for segment in line["segments"]]
    np.testing.assert_allclose(segments, made.segments[np.argsort(made.segment_line, kind="stable")], atol=6e-5)
    assert owner == sorted(made.segment_line)
    np.testing.assert_allclose(np.reshape(data["fragments"], (-1, 4)), made.fragments, atol=6e-5)


def test_geojson_is_read_by_shapely(made, tmp_path):
    save_map(made, tmp_path / "a.geojson")
    text = (tmp_path / "a.geojson").read_text()
    features = json.loads(text)["features"]
    lines = [shapely.from_geojson(json.dumps(feature["geometry"])) for feature in features]
    assert all(line.is_valid and line.length > 0 for line in lines)
    walls = [line for line, f in zip(lines, features, strict=True) if f["properties"]["kind"] == "wall"]
    np.testing.assert_allclose([np.ravel(line.coords) for line in walls], made.segments, atol=6e-5)
    assert [f["properties"]["line"] for f in features[: len(walls)]] == made.segment_line.tolist()
    assert len(lines) - len(walls) == len(made.fragments)


def test_pictures_show_the_walls(made, tmp_path):
    from PIL import Image

    for suffix in (".png", ".svg"):
        save_map(made, tmp_path / f"a{suffix}", name="rooms", width=500)
        save_map(made, tmp_path / f"b{suffix}", name="rooms", width=500)
        assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()
    with Image.open(tmp_path / "a.png") as image:
        assert image.width == 500
        pixels = np.asarray(image.convert("L")).astype(int)
    dark = (pixels < 90).mean(axis=0)
    assert np.sort(dark)[-3] > 0.5  # the outer walls, and the one between
    svg = (tmp_path / "a.svg").read_text()
    assert "rooms" in svg
    assert f"{made.rho.size} lines" in svg


def test_a_robot_map_shows_walls_and_what_beams_passed(made, tmp_path):
    save_map(made, tmp_path / "a.yaml", name="rooms")
    plan = load_plan(tmp_path / "a.yaml", radius=0.25)
    assert plan.name == "a"
    # Walls are a pixel of 5 cm thick, and beams fan out: a little is missing along the walls.
    rooms = shapely.box(0.0, 0.0, 8.0, 4.0)
    assert plan.polygon.difference(rooms.buffer(0.06)).area < 0.01
    assert plan.area > 0.93 * rooms.area
    for y in (0.3, 0.8, 1.3, 2.7, 3.5):
        assert not plan.polygon.contains(shapely.LineString([[3.8, y], [4.2, y]]))
    assert plan.polygon.contains(shapely.LineString([[3.5, 2.0], [4.5, 2.0]]))


def test_the_pixels_of_a_robot_map_by_a_plain_twin(made):
    image, corner = occupancy(made, 0.1)

    def pixel(point):
        column, up = np.floor((point - corner) / 0.1).astype(int)
        return image.shape[0] - 1 - up, column

    walls = np.concatenate([made.segments, made.fragments]).reshape(-1, 2, 2)
    assert all(image[pixel(end)] == 0 for ends in walls for end in ends)
    # Off the walls every beam is free all along.
    rng = np.random.default_rng(0)
    for i in rng.integers(0, len(made.points), 200):
        a, b = made.path[made.point_scan[i], :2], made.points[i]
        for share in (0.0, 0.3, 0.6, 0.9):
            point = a + share * (b - a)
            if distance(point[None], walls.reshape(-1, 4)).min() > 0.25:
                row, column = pixel(point)
                assert (image[row - 1 : row + 2, column - 1 : column + 2] == 254).any()
    # And what no beam came near is unknown.
    assert (image[[0, -1]] == 205).all()
    assert (image[:, [0, -1]] == 205).all()


def test_a_log_without_walls_gives_an_empty_map(tmp_path):
    made = map_log(LaserLog(HALF, np.full((2, 361), np.inf), np.array([[0, 0, 0], [1.0, 0, 0]])))
    assert (made.rho.size, len(made.points), len(made.segments), len(made.fragments)) == (0, 0, 0, 0)
    assert made.median_distance == math.inf
    for suffix in MAP_SUFFIXES:
        save_map(made, tmp_path / f"a{suffix}", width=200)
    assert json.loads((tmp_path / "a.json").read_text())["lines"] == []


def test_what_cannot_be_saved_is_told(made, tmp_path, monkeypatch):
    with pytest.raises(RenderingError, match=r"\.bmp: a line map is saved as"):
        save_map(made, tmp_path / "a.bmp")
    for suffix in MAP_SUFFIXES:
        with pytest.raises(RenderingError, match="cannot be written"):
            save_map(made, tmp_path / "missing" / f"a{suffix}", width=200)
    monkeypatch.setitem(__import__("sys").modules, "matplotlib.figure", None)
    with pytest.raises(MissingDependencyError, match=r"polyexplore-gym\[plots\]"):
        save_map(made, tmp_path / "a.png")


def drifting(poses, rng, sigma_xy, sigma_heading):
    """Poses with an error that grows from each to the next."""
    steps = between(poses[:-1], poses[1:])
    steps += rng.normal(0, 1, steps.shape) * [sigma_xy, sigma_xy, sigma_heading]
    out = [poses[0]]
    for step in steps:
        out.append(compose(out[-1], step))
    return np.array(out)


def test_walls_that_do_not_fit_when_seen_again_are_told_of():
    rng = np.random.default_rng(9)
    poses = [(2.0 + 2.0 * math.cos(0.2 * k), 2.0 + 1.5 * math.sin(0.2 * k), 0.2 * k + 1.57) for k in range(90)]
    log = drive(box(-0.5, 0.0, 6.0, 4.0), poses, rng)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        good = map_log(log)
        some = map_log(replace(log, poses=compose(log.poses, rng.normal(0, 1, log.poses.shape) * [0.02, 0.02, 0.005])))
    assert good.misfit < 0.01
    assert some.misfit < 0.1
    assert good.misfits.shape == (90,)
    drifted = replace(log, poses=drifting(log.poses, rng, 0.05, 0.02), poses_are="odometry", why="of ODOM lines")
    with pytest.warns(UserWarning, match=r"do not fit.* % of the beams.*raw odometry \(of ODOM lines\)"):
        assert map_log(drifted).misfit > MISFIT
    with pytest.warns(UserWarning, match="do not fit"):
        map_log(drifted, ratio=0)


def test_what_cannot_be_mapped_is_an_error():
    ranges, poses = np.full((2, 361), 5.0), np.zeros((2, 3))
    with pytest.raises(InvalidLogError, match="no poses to map with: only scans"):
        map_log(LaserLog(HALF, ranges, None, why="only scans"))
    for nothing in (0.0, math.nan, -1.0):
        with pytest.raises(InvalidLogError, match="no reading in 2 scans"):
            map_log(LaserLog(HALF, np.full((2, 361), nothing), poses))
    with pytest.raises(InvalidLogError, match="all readings of 2 scans are 30 m, the maximum range, or more"):
        map_log(LaserLog(HALF, np.full((2, 361), 81.91), poses))


def test_beams_that_vary_and_parts_of_a_turn():
    """Scans of other beams, in any order, and one that is half a turn only."""
    rng = np.random.default_rng(10)
    angles, ranges, poses = [], [], []
    for k in range(12):
        beams = np.linspace(-math.pi, math.pi, 351 + k, endpoint=False)
        if k == 5:
            beams = beams[beams > 0.0]
        pose = (2.0 + 0.2 * k, 2.0, 0.3 * k)
        order = slice(None, None, -1 if k % 3 == 0 else 1)
        angles.append(beams[order])
        ranges.append(measure(ROOM, pose, SENSOR, rng, beams[order]))
        poses.append(pose)
    made = map_log(LaserLog(angles, ranges, np.array(poses)))
    assert len(made.segments) == 4
    assert made.misfit < 0.01


@pytest.mark.skipif(not LOGS, reason="no laser logs beside the checkout or in POLYEXPLORE_DATA")
@pytest.mark.parametrize("path", LOGS, ids=lambda path: path.name.partition(".")[0])
def test_real_logs(path):
    log = read_log(path)
    assert not log.broken
    if path.name.startswith("intel-raw"):
        assert log.poses_are == "odometry"
        with pytest.warns(UserWarning, match="do not fit"):
            assert map_log(log, every=2).misfit > 0.5
        return
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made = map_log(log)
    assert log.poses_are == "corrected"
    assert made.compression >= 0.99
    assert made.median_distance < 0.02
    assert made.on_line.mean() > 0.65
    assert made.misfit < 0.5 * MISFIT


CASES = DATA.parent / "cases" / "reports"


@pytest.mark.skipif(not CASES.is_dir(), reason="no reports of cases beside the checkout")
@pytest.mark.parametrize(
    ("name", "scans", "walls"),
    [
        ("l07b_reversed.log", 11, 5), ("l08a_nan.npz", 11, 5), ("l09_good.npz", 20, 6), ("l09_zero.npz", 20, 6),
        ("l10_varying_beams.log", 11, 6), ("l11_closed_721.log", 3, 6),
    ],
)  # fmt: skip
def test_logs_that_fell_short(name, scans, walls):
    log = read_log(CASES / name)
    made = map_log(log)
    assert not log.broken
    assert (len(log), made.rho.size) == (scans, walls)
    # the long wall of the room, part of it dark in l09
    wall = np.abs(made.segments[:, [1, 3]] - 5.0).max(axis=1) < 0.05
    assert distance(np.c_[np.linspace(1.1, 11.0, 50), np.full(50, 5.0)], made.segments[wall]).max() < 0.05
