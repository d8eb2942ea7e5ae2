"""Pictures: what is drawn changes the right pixels, sizes hold, films read back, and nothing heavy is imported."""

from __future__ import annotations

import dataclasses
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from polyexplore_gym import animation, rendering
from polyexplore_gym.errors import MissingDependencyError, PolyExploreError, RenderingError
from polyexplore_gym.rendering import Snapshot

EXTERIOR = np.array([[0.0, 0.0], [12.0, 0.0], [12.0, 8.0], [0.0, 8.0]])
HOLE = np.array([[5.0, 3.0], [5.0, 5.0], [7.0, 5.0], [7.0, 3.0]])
ROOM = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 8.0], [0.0, 8.0]])


def bare() -> Snapshot:
    """The start of an exploration: a plan and a robot, nothing else."""
    return Snapshot(exterior=EXTERIOR, holes=(HOLE,), pose=np.array([2.0, 2.0, 0.5]))


def busy(**changes: object) -> Snapshot:
    angles = np.linspace(-np.pi / 2, np.pi / 2, 61)
    full = Snapshot(
        exterior=EXTERIOR,
        holes=(HOLE,),
        walls=np.array([[0.0, 0.0, 4.0, 0.0], [0.0, 0.0, 0.0, 8.0], [0.0, 8.0, 4.0, 8.0], [5.0, 3.0, 5.0, 5.0]]),
        wall_fitted=np.array([True, True, True, False]),
        explored=((ROOM, ()),),
        jump_edges=(np.array([[4.0, 0.0], [4.0, 3.0]]), np.array([[4.0, 5.0], [4.2, 6.0], [4.0, 8.0]])),
        node_positions=np.array([[4.0, 1.5], [4.1, 6.5], [9.0, 6.5]]),
        node_headings=np.array([0.0, 0.0, 1.0]),
        node_mask=np.array([True, True, False]),
        chosen=1,
        trajectory=np.array([[1.0, 1.0], [2.0, 1.5], [2.0, 2.0]]),
        measured_at=np.array([[1.0, 1.0, 0.0]]),
        path=np.array([[2.0, 2.0], [3.0, 5.0], [4.1, 6.5]]),
        scan=np.stack([2.0 + 2.0 * np.cos(angles), 2.0 + 2.0 * np.sin(angles)], axis=1),
        scan_pose=np.array([2.0, 2.0, 0.0]),
        pose=np.array([2.0, 2.0, 0.5]),
        estimate=np.array([2.05, 2.02, 0.55]),
        distance=12.34,
        coverage=0.4,
        measurements=7,
        title="two rooms",
    )
    return dataclasses.replace(full, **changes)  # type: ignore[arg-type]


def near(picture: np.ndarray, color: str) -> np.ndarray:
    """(h, w) bool: pixels of about that colour."""
    rgb = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)])
    return (np.abs(picture.astype(int) - rgb) <= 6).all(axis=2)


def extent(picture: np.ndarray) -> tuple[int, int, int, int]:
    """First and last row, first and last column of the plan's own grey (text has a few such pixels too)."""
    grey = near(picture, rendering._UNSEEN)
    by_row, by_column = grey.sum(axis=1), grey.sum(axis=0)
    rows, columns = np.flatnonzero(by_row > 0.4 * by_row.max()), np.flatnonzero(by_column > 0.4 * by_column.max())
    return rows[0], rows[-1], columns[0], columns[-1]


def to_pixel(picture: np.ndarray, x: float, y: float) -> tuple[int, int]:
    """Row and column of a point of the plan."""
    top, bottom, left, right = extent(rendering.frame(bare(), picture.shape[1]))
    return round(bottom - y / 8.0 * (bottom - top)), round(left + x / 12.0 * (right - left))


@pytest.mark.parametrize(("width", "height"), [(800, None), (333, None), (640, 480), (401, 301), (1234, None)])
def test_frame_size_and_dtype(width: int, height: int | None) -> None:
    pictures = [
        rendering.frame(s, width, height)
        for s in (bare(), busy(), busy(title="", walls=np.zeros((0, 4))[:0], wall_fitted=np.zeros(0, bool)))
    ]
    for picture in pictures:
        assert picture.dtype == np.uint8
        assert picture.flags.c_contiguous
        assert picture.shape == pictures[0].shape
        assert picture.shape[1] == width + width % 2
        assert picture.shape[0] % 2 == 0
        if height is not None:
            assert picture.shape[0] == height + height % 2


@pytest.mark.parametrize("shape", [(100.0, 3.0), (3.0, 100.0)])
def test_extreme_plans_keep_a_sane_shape_and_scale(shape: tuple[float, float]) -> None:
    ring = np.array([[0.0, 0.0], [shape[0], 0.0], shape, [0.0, shape[1]]])
    picture = rendering.frame(Snapshot(exterior=ring, pose=np.array([1.0, 1.0, 0.0])), 600)
    assert 0.15 < picture.shape[0] / picture.shape[1] < 1.6
    top, bottom, left, right = extent(picture)
    tall, wide = bottom - top + 1, right - left + 1
    assert tall / wide == pytest.approx(shape[1] / shape[0], rel=0.2)  # equal scales in x and y


def test_truth_is_faint_and_can_be_left_out() -> None:
    with_truth, without = rendering.frame(bare()), rendering.frame(bare(), truth=False)
    row, column = to_pixel(with_truth, 10.0, 4.0)
    assert near(with_truth, rendering._UNSEEN)[row, column]
    assert (without[row, column] == 255).all()
    row, column = to_pixel(with_truth, 6.0, 4.0)  # inside the obstacle
    assert (with_truth[row, column] == 255).all()


@pytest.mark.parametrize("reverse", [False, True])
def test_holes_stay_open_whatever_the_order_of_their_vertices(reverse: bool) -> None:
    hole = HOLE[::-1] if reverse else HOLE
    picture = rendering.frame(dataclasses.replace(bare(), holes=(hole,), explored=((EXTERIOR[::-1], (hole,)),)))
    row, column = to_pixel(picture, 6.0, 4.0)
    assert (picture[row, column] == 255).all()
    row, column = to_pixel(picture, 10.0, 4.0)
    assert near(picture, rendering._EXPLORED)[row, column]


def test_overlapping_explored_polygons_are_filled_once() -> None:
    shifted = ROOM + np.array([1.0, 0.0])
    picture = rendering.frame(dataclasses.replace(bare(), explored=((ROOM, ()), (shifted[::-1], ()))))
    for x in (0.5, 3.0, 4.5):
        row, column = to_pixel(picture, x, 6.0)
        assert near(picture, rendering._EXPLORED)[row, column]


NONE = {
    "explored": ((), (1.0, 7.0)),
    "walls": (np.zeros((0, 4)), (2.0, 8.0)),
    "jump_edges": ((), (4.0, 2.7)),
    "scan": (None, (3.5, 2.0)),
    "trajectory": (np.zeros((0, 2)), (1.5, 1.25)),
    "path": (np.zeros((0, 2)), (3.0, 5.0)),
    "measured_at": (np.zeros((0, 3)), (1.0, 1.0)),
}


@pytest.mark.parametrize("name", NONE)
def test_each_element_is_drawn_where_it_is(name: str) -> None:
    nothing, (x, y) = NONE[name]
    changes: dict[str, object] = {name: nothing}
    if name == "walls":
        changes["wall_fitted"] = np.zeros(0, dtype=bool)
    before, after = rendering.frame(busy(**changes)), rendering.frame(busy())
    differs = (before != after).any(axis=2)
    row, column = to_pixel(after, x, y)
    assert differs[row - 4 : row + 5, column - 4 : column + 5].any()
    assert differs.mean() < 0.4


def test_fitted_walls_differ_from_fragments() -> None:
    fitted = rendering.frame(busy(wall_fitted=np.ones(4, dtype=bool)))
    fragments = rendering.frame(busy(wall_fitted=np.zeros(4, dtype=bool)))
    row, column = to_pixel(fitted, 3.0, 8.0)
    assert fitted[row - 3 : row + 4, column].min() < 60
    assert 90 < fragments[row - 3 : row + 4, column].min() < 180


def test_chosen_node_is_lit_and_only_it() -> None:
    plain, lit = rendering.frame(busy(chosen=None)), rendering.frame(busy(chosen=1))
    differs = (plain != lit).any(axis=2)
    row, column = to_pixel(lit, 4.1, 6.5)
    rows, columns = np.nonzero(differs)
    assert len(rows) > 200
    assert np.hypot(rows - row, columns - column).max() < 30
    assert near(lit, rendering._JUMP)[differs].sum() > near(plain, rendering._JUMP)[differs].sum() + 50
    other = rendering.frame(busy(chosen=0))
    assert not np.array_equal(lit, other)


def test_unreachable_node_is_grey() -> None:
    masked = rendering.frame(busy())
    free = rendering.frame(busy(node_mask=np.ones(3, dtype=bool)))
    row, column = to_pixel(masked, 9.0, 6.5)
    around = np.s_[row - 14 : row + 15, column - 14 : column + 15]
    assert near(masked[around], rendering._MASKED).any()
    assert not near(masked[around], rendering._JUMP).any()
    assert near(free[around], rendering._JUMP).any()


def test_robot_and_its_estimate() -> None:
    here, there = rendering.frame(busy()), rendering.frame(busy(pose=np.array([10.0, 2.0, 0.0])))
    row, column = to_pixel(here, 10.0, 1.9)
    assert not near(here, rendering._ROBOT)[row, column]
    assert near(there, rendering._ROBOT)[row, column]
    assert np.array_equal(rendering.frame(busy(estimate=None)), rendering.frame(busy(estimate=busy().pose)))
    assert not np.array_equal(here, rendering.frame(busy(estimate=None)))


def test_full_circle_fan_has_no_slit() -> None:
    turn = np.linspace(-np.pi, np.pi, 90, endpoint=False)
    ends = np.stack([9.0 + 1.5 * np.cos(turn), 6.0 + 1.5 * np.sin(turn)], axis=1)
    pose = np.array([9.0, 6.0, 0.0])
    assert len(rendering._fan(ends, pose)) == 90
    assert len(rendering._fan(ends[:45], pose)) == 46  # half of it: a fan through the robot


def test_crowded_numbers_step_aside() -> None:
    rng = np.random.default_rng(5)
    crowd = np.concatenate([rng.uniform(0, 60, (12, 2)), np.full((3, 2), 30.0), [[200.0, 200.0]]])
    placed = rendering._apart(crowd, 10.0, np.array([30.0, 30.0]), 12.0)
    gap = np.hypot(*(placed[:, None] - placed[None]).transpose(2, 0, 1)) + np.diag(np.full(len(placed), np.inf))
    assert gap.min() > 9.0
    assert np.hypot(*(placed - 30.0).T).min() > 11.0
    assert np.allclose(placed[-1], crowd[-1], atol=0.01)  # who has room stays
    assert np.isfinite(placed).all()


def test_many_nodes_on_one_spot() -> None:
    n = 130
    positions = np.full((n, 2), 9.0)
    s = busy(node_positions=positions, node_headings=np.zeros(n), node_mask=np.ones(n, dtype=bool), chosen=129)
    assert rendering.frame(s).shape == rendering.frame(bare()).shape


def test_same_snapshot_same_picture() -> None:
    assert np.array_equal(rendering.frame(busy()), rendering.frame(busy()))


def test_draw_on_axes_of_the_users_own() -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3))
    left, right = figure.subplots(1, 2)
    rendering.draw(busy(), left, legend=True)
    rendering.draw(bare(), right, scale_bar=False, text=False)
    assert left.get_legend() is not None
    assert right.get_legend() is None
    assert not right.texts
    assert any(t.get_text().endswith(" m") for t in left.texts)
    assert any("12.3 m driven" in t.get_text() and "40 % seen" in t.get_text() for t in left.texts)
    figure.canvas.draw()
    x, y = left.transData.transform([[0, 0], [1, 1]]).T
    assert x[1] - x[0] == pytest.approx(y[1] - y[0])


def test_drawing_leaves_pyplot_alone() -> None:
    code = (
        "import sys, numpy as np; from polyexplore_gym.rendering import Snapshot, frame;"
        "frame(Snapshot(exterior=np.array([[0.,0.],[4.,0.],[4.,4.]]), pose=np.array([2.,1.,0.])));"
        "assert 'matplotlib' in sys.modules and 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_nothing_heavy_is_imported_with_the_module() -> None:
    code = (
        "import sys, polyexplore_gym.rendering;"
        "print(sorted({'matplotlib', 'pygame', 'PIL', 'imageio', 'imageio_ffmpeg'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("suffix", [".png", ".pdf", ".svg"])
def test_save_figure(tmp_path: Path, suffix: str) -> None:
    first, again = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    rendering.save_figure(busy(), first, width=640)
    rendering.save_figure(busy(), again, width=640)
    head = {".png": b"\x89PNG", ".pdf": b"%PDF", ".svg": b"<?xml"}[suffix]
    assert first.read_bytes().startswith(head)
    assert first.read_bytes() == again.read_bytes()
    if suffix == ".svg":
        assert "12.3 m driven" in first.read_text()
    if suffix == ".png":
        import imageio.v3 as iio

        assert iio.imread(first).shape[1] == 640


def test_save_figure_refuses_other_formats(tmp_path: Path) -> None:
    with pytest.raises(RenderingError, match=r"\.png, \.pdf or \.svg"):
        rendering.save_figure(busy(), tmp_path / "a.bmp")


def test_tiny_pictures_are_refused() -> None:
    with pytest.raises(RenderingError, match="too small"):
        rendering.frame(bare(), 20)


def walk(n: int) -> list[np.ndarray]:
    return [rendering.frame(busy(pose=np.array([1.0 + 0.5 * k, 2.0, 0.0]), estimate=None), 320) for k in range(n)]


@pytest.mark.parametrize(("suffix", "tolerance"), [(".gif", 1.5), (".mp4", 4.0)])
def test_animation_reads_back(tmp_path: Path, suffix: str, tolerance: float) -> None:
    import imageio.v3 as iio

    frames = walk(6)
    path = tmp_path / f"film{suffix}"
    rendering.save_animation(iter(frames), path, fps=5, hold=0)
    back = iio.imread(path)
    assert back.shape == (6, *frames[0].shape)
    for got, sent in zip(back, frames, strict=True):
        assert np.abs(got.astype(int) - sent).mean() < tolerance
    assert list(tmp_path.iterdir()) == [path]


def test_last_picture_is_held(tmp_path: Path) -> None:
    import imageio.v3 as iio
    from PIL import Image, ImageSequence

    rendering.save_animation(walk(3), tmp_path / "a.gif", fps=10, hold=2.0)
    with Image.open(tmp_path / "a.gif") as film:
        durations = []
        for page in ImageSequence.Iterator(film):
            durations.append(page.info["duration"])
        assert film.info["loop"] == 0
    assert durations == [100, 100, 2100]
    rendering.save_animation(walk(3), tmp_path / "a.mp4", fps=10, hold=2.0)
    assert len(iio.imread(tmp_path / "a.mp4")) == 23


def test_odd_frames_are_padded(tmp_path: Path) -> None:
    import imageio.v3 as iio

    frames = [np.full((65, 71, 3), 40 * k, dtype=np.uint8) for k in range(3)]
    rendering.save_animation(frames, tmp_path / "a.mp4", fps=5, hold=0)
    assert iio.imread(tmp_path / "a.mp4").shape == (3, 66, 72, 3)


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_bad_frames_are_refused_and_leave_no_file(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    good = np.zeros((64, 64, 3), dtype=np.uint8)
    for frames, message in (
        ([], "no frames"),
        ([good, good[:32]], "differ in size"),
        ([good.astype(float)], "uint8"),
        ([good[..., 0]], r"\(h, w, 3\)"),
    ):
        with pytest.raises(RenderingError, match=message):
            rendering.save_animation(frames, path)
    with pytest.raises(RenderingError, match="fps"):
        rendering.save_animation([good], path, fps=0)
    assert list(tmp_path.iterdir()) == []


def test_animation_refuses_other_formats(tmp_path: Path) -> None:
    with pytest.raises(RenderingError, match=r"\.gif or \.mp4"):
        rendering.save_animation(walk(1), tmp_path / "film.avi")


def test_motion_lights_the_choice_and_follows_the_new_part_of_the_way() -> None:
    before = busy(chosen=None)
    way = np.array([[1.0, 1.0], [2.0, 1.5], [2.0, 2.0], [2.0, 4.0], [5.0, 4.0]])
    after = busy(trajectory=way, path=way[2:], distance=17.34)
    first, *between = rendering.motion(before, after, chosen=1, step=0.5)
    assert np.array_equal(first.pose, before.pose)
    assert first.scan is not None
    assert all(s.chosen == 1 and s.path is after.path for s in (first, *between))
    assert len(between) == 9  # 5 m of way without its two ends
    positions = np.array([s.pose[:2] for s in between])
    assert np.allclose(positions[:3], [[2.0, 2.5], [2.0, 3.0], [2.0, 3.5]])
    assert np.allclose(positions[-1], [4.5, 4.0])
    assert between[0].pose[2] == pytest.approx(np.pi / 2)
    assert between[-1].pose[2] == pytest.approx(0.0)
    assert between[-1].distance == pytest.approx(12.34 + 4.5)
    assert np.allclose(between[-1].trajectory[-2:], [[2.0, 4.0], [4.5, 4.0]])


def test_motion_takes_given_headings_and_standing_still() -> None:
    before = busy(trajectory=np.array([[1.0, 1.0, 0.0]]))
    turn = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 1.0], [2.0, 1.0, 0.3]])
    _, *between = rendering.motion(before, busy(trajectory=turn), step=0.25)
    assert [s.pose[2] for s in between] == pytest.approx([0.3] * 3)
    assert all(np.isfinite(s.pose).all() for s in between)
    assert len(list(rendering.motion(before, before))) == 1


def test_window_shows_and_closes(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    import pygame

    window = rendering.Window("test", fps=1000)
    picture = rendering.frame(busy(), 320)
    assert window.show(picture)
    surface = pygame.display.get_surface()
    assert np.array_equal(pygame.surfarray.array3d(surface).swapaxes(0, 1), picture)
    assert window.show(picture[:64])  # another size
    assert pygame.display.get_surface().get_size() == (320, 64)
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    assert not window.show(picture)
    assert window.closed
    assert not window.show(picture)
    window.close()
    assert not pygame.display.get_init()


def test_window_without_a_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "none such")
    with pytest.raises(RenderingError, match="no screen"):
        rendering.Window().show(np.zeros((64, 64, 3), np.uint8))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"wall_fitted": np.ones(3, dtype=bool)}, "wall_fitted has 3 rows, expected 4"),
        ({"node_headings": np.zeros(2)}, "node_headings"),
        ({"node_mask": np.zeros(0, dtype=bool)}, "node_mask"),
        ({"chosen": 3}, "there are 3 nodes"),
        ({"chosen": -1}, "there are 3 nodes"),
        ({"exterior": EXTERIOR[:2]}, "exterior"),
    ],
)
def test_snapshot_refuses_what_does_not_fit(changes: dict[str, object], message: str) -> None:
    with pytest.raises(RenderingError, match=message):
        busy(**changes)


def test_snapshot_survives_pickling() -> None:
    again = pickle.loads(pickle.dumps(busy()))
    assert np.array_equal(rendering.frame(again), rendering.frame(busy()))


@pytest.mark.parametrize(
    ("module", "extra", "use"),
    [
        ("matplotlib", "plots", lambda p: rendering.frame(bare())),
        ("matplotlib", "plots", lambda p: rendering.save_figure(bare(), p / "a.png")),
        ("PIL", "plots", lambda p: rendering.save_animation([np.zeros((64, 64, 3), np.uint8)], p / "a.gif")),
        ("imageio", "plots", lambda p: rendering.save_animation([np.zeros((64, 64, 3), np.uint8)], p / "a.mp4")),
        ("imageio_ffmpeg", "plots", lambda p: rendering.save_animation([np.zeros((64, 64, 3), np.uint8)], p / "a.mp4")),
        ("pygame", "window", lambda p: rendering.Window().show(np.zeros((64, 64, 3), np.uint8))),
    ],
)
def test_missing_packages_come_with_a_hint(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, module: str, extra: str, use: Callable[[Path], object]
) -> None:
    monkeypatch.setitem(sys.modules, module, None)  # what makes an import fail
    with pytest.raises(MissingDependencyError, match=rf'{module}.*pip install "polyexplore-gym\[{extra}\]"') as caught:
        use(tmp_path)
    assert isinstance(caught.value, ImportError)
    assert isinstance(caught.value, PolyExploreError)
    assert list(tmp_path.iterdir()) == []


def test_names_are_found_in_one_place() -> None:
    assert rendering.motion is animation.motion
    assert all(hasattr(rendering, name) for name in rendering.__all__)
