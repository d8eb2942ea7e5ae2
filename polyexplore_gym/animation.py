"""Films and the live window: pictures in, moving pictures out.

Pillow, imageio and pygame are imported when first needed: `pip install "polyexplore-gym[plots]"`
for films, `[window]` for the window.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from polyexplore_gym.errors import RenderingError
from polyexplore_gym.optional import require

if TYPE_CHECKING:
    from polyexplore_gym.snapshot import Snapshot


def motion(before: Snapshot, after: Snapshot, chosen: int | None = None, step: float = 0.25) -> Iterator[Snapshot]:
    """One decision as an animation that flows, from the snapshots before and after `env.step(chosen)`.

    Yields `before` with the chosen node lit and the planned path, then the robot at every `step`
    metres along what `after.trajectory` adds, while the map waits; `after` itself is not yielded.
    """
    before = replace(before, chosen=before.chosen if chosen is None else chosen, path=after.path)
    yield before
    new = after.trajectory[max(len(before.trajectory) - 1, 0) :]
    if len(new) < 2:
        return
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(new[:, :2], axis=0).T))])
    for at in np.arange(step, lengths[-1], step):
        k = int(np.searchsorted(lengths, at, side="right"))  # new[k - 1] is passed, new[k] lies ahead
        a, b = new[k - 1, :2], new[k, :2]
        here = a + (b - a) * (at - lengths[k - 1]) / (lengths[k] - lengths[k - 1])
        heading = float(new[k, 2]) if new.shape[1] > 2 else float(np.arctan2(b[1] - a[1], b[0] - a[0]))
        driven = np.concatenate([before.trajectory[:, :2], new[1:k, :2], here[None]])
        yield replace(
            before,
            pose=np.array([*here, heading]),
            estimate=None,
            trajectory=driven,
            scan=None,
            distance=before.distance + float(at),
        )


def save_animation(frames: Iterable[np.ndarray], path: str | Path, fps: float = 10.0, hold: float = 1.5) -> None:
    """Save pictures as .gif or .mp4; the last one stays for `hold` more seconds.

    The frames may come from a generator: they are kept compressed, or go straight to the encoder.

    Raises:
        MissingDependencyError: Pillow, imageio or imageio-ffmpeg is not installed.
        RenderingError: the suffix is neither, there are no frames, or they differ in size.
    """
    path = Path(path)
    writers = {".gif": _save_gif, ".mp4": _save_mp4}
    if path.suffix.lower() not in writers:
        raise RenderingError(f"{path}: an animation is saved as .gif or .mp4")
    if not 0.1 <= fps <= 100:
        raise RenderingError(f"fps = {fps!r}: must lie in 0.1 to 100")
    part = path.with_name(f".{path.stem}.part{path.suffix}")  # whoever watches the folder sees whole files only
    try:
        writers[path.suffix.lower()](_checked(frames), part, fps, hold)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


class Window:
    """A window on the screen that shows frames as they come (pygame, imported when first shown).

    The first `show` raises `MissingDependencyError` if pygame is not installed, `RenderingError` if
    there is no screen.
    """

    def __init__(self, title: str = "polyexplore", fps: float | None = None) -> None:
        self.title = title
        self.fps = fps
        """At most so many frames a second; None: as they come."""
        self.closed = False
        """Whether the window was closed, by the user or by `close`."""
        self._screen: Any = None
        self._clock: Any = None

    def show(self, picture: np.ndarray) -> bool:
        """Show an (h, w, 3) uint8 picture. False once the window was closed: nothing is shown then."""
        if self.closed:
            return False
        pygame = require("pygame", "window")
        size = (picture.shape[1], picture.shape[0])
        if self._screen is None or self._screen.get_size() != size:
            try:
                pygame.display.init()
                self._screen = pygame.display.set_mode(size)
            except pygame.error as error:
                raise RenderingError(f"no screen for a window ({error}): use rgb_array, or save a film") from error
            pygame.display.set_caption(self.title)
            self._clock = pygame.time.Clock()
        self._screen.blit(pygame.image.frombuffer(np.ascontiguousarray(picture).tobytes(), size, "RGB"), (0, 0))
        pygame.display.flip()
        if any(event.type == pygame.QUIT for event in pygame.event.get()):
            self.close()
            return False
        if self.fps is not None:
            self._clock.tick(self.fps)
        return True

    def close(self) -> None:
        """Close the window; more than once does no harm."""
        if self._screen is not None:
            require("pygame", "window").display.quit()
            self._screen = None
        self.closed = True


def _checked(frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """The frames as contiguous arrays with even sides; raises if they are no pictures of one size."""
    shape = None
    for picture in frames:
        if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
            raise RenderingError(f"a frame must be (h, w, 3) uint8, not {picture.shape} {picture.dtype}")
        if shape is not None and picture.shape != shape:
            raise RenderingError(f"frames differ in size: {shape} and then {picture.shape}")
        shape = picture.shape
        odd = (shape[0] % 2, shape[1] % 2)
        padded = np.pad(picture, ((0, odd[0]), (0, odd[1]), (0, 0)), mode="edge") if any(odd) else picture
        yield np.ascontiguousarray(padded)
    if shape is None:
        raise RenderingError("no frames to save")


def _save_mp4(frames: Iterator[np.ndarray], path: Path, fps: float, hold: float) -> None:
    imageio = require("imageio", "plots")
    require("imageio_ffmpeg", "plots")
    picture = next(frames)  # nothing is written unless there is a first frame
    settings = {"codec": "libx264", "pixelformat": "yuv420p", "macro_block_size": 2, "output_params": ["-crf", "20"]}
    with imageio.get_writer(path, format="FFMPEG", mode="I", fps=fps, quality=None, **settings) as writer:
        writer.append_data(picture)
        for picture in frames:
            writer.append_data(picture)
        for _ in range(round(hold * fps)):
            writer.append_data(picture)


def _save_gif(frames: Iterator[np.ndarray], path: Path, fps: float, hold: float) -> None:
    require("PIL", "plots")
    from PIL import Image
    from scipy.spatial import cKDTree

    kept, shape = [], (0, 0, 3)
    for picture in frames:
        shape = picture.shape
        kept.append(zlib.compress(picture.tobytes(), 1))

    def picture_at(i: int) -> np.ndarray:
        return np.frombuffer(zlib.decompress(kept[i]), dtype=np.uint8).reshape(shape)

    # One palette for all frames, or areas at rest would flicker and nothing could be left out between frames.
    sample = np.unique(np.linspace(0, len(kept) - 1, 8).round().astype(int))
    palette = _palette(np.concatenate([picture_at(i).reshape(-1, 3) for i in sample]))
    nearest = cKDTree(palette)
    index = np.full(1 << 24, -1, dtype=np.int16)  # of every colour met so far

    def indexed(picture: np.ndarray) -> Image.Image:
        packed = _packed(picture)
        new = np.unique(packed[index[packed] < 0])
        index[new] = nearest.query(_unpacked(new))[1]
        image = Image.fromarray(index[packed].astype(np.uint8))
        image.putpalette(palette.tobytes())
        return image

    images = (indexed(picture_at(i)) for i in range(len(kept)))
    first = next(images)
    durations = [1000.0 / fps] * len(kept)
    durations[-1] += 1000.0 * hold
    first.save(path, save_all=True, append_images=images, duration=durations, loop=0, optimize=True)


def _palette(pixels: np.ndarray) -> np.ndarray:
    """(k, 3) uint8, at most 255: the commonest colours of pixels (n, 3) exactly, the rest by median cut.

    Median cut alone shifts flat areas: a white page turns grey.
    """
    from PIL import Image

    colors, counts = np.unique(_packed(pixels), return_counts=True)
    colors = colors[np.argsort(-counts, kind="stable")]
    if len(colors) <= 255:
        return _unpacked(colors)
    rest = Image.fromarray(_unpacked(colors[96:])[None]).quantize(159, dither=Image.Dither.NONE)
    mixed = np.array(rest.getpalette(), dtype=np.uint8).reshape(-1, 3)
    return np.concatenate([_unpacked(colors[:96]), mixed])


def _packed(pixels: np.ndarray) -> np.ndarray:
    red, green, blue = np.moveaxis(pixels.astype(np.int32), -1, 0)
    return red << 16 | green << 8 | blue


def _unpacked(colors: np.ndarray) -> np.ndarray:
    return np.stack([colors >> 16, colors >> 8 & 255, colors & 255], axis=1).astype(np.uint8)
