"""Pictures of an exploration: draws a snapshot as a frame, a figure, or on axes of the user's own.

Frames become films and a live window in `polyexplore_gym.animation`, whose names are found here too.
Matplotlib is imported when first needed: `pip install "polyexplore-gym[plots]"`.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from polyexplore_gym.animation import Window, motion, save_animation
from polyexplore_gym.errors import RenderingError
from polyexplore_gym.optional import require
from polyexplore_gym.snapshot import Polygon, Snapshot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.path import Path as Outline

__all__ = ["Polygon", "Snapshot", "Window", "draw", "frame", "motion", "save_animation", "save_figure"]

# Okabe and Ito's colours (told apart by the colour-blind and in grey print), with tints of them for areas.
_UNSEEN = "#e6e6e6"
_OUTLINE = "#b0b0b0"
_EXPLORED = "#e4f0f9"
_FAN = "#56b4e9"
_WALL = "#1f1f1f"
_FRAGMENT = "#7d7d7d"
_JUMP = "#d55e00"
_GLOW = "#f5c73d"
_WAY = "#0072b2"
_ROBOT = "#009e73"
_MASKED = "#9a9a9a"
_INK = "#333333"

# Figure layout in points (1/72 inch): room above, below and beside the map, height of a legend row.
_TOP, _BOTTOM, _SIDE, _ROW = 22.0, 20.0, 8.0, 13.0
_BADGE = 5.6
"""Radius of the circle that carries a node's number, points (about: it varies a little with the scale)."""
_MIN_INCHES = 8.0
"""Figures of 800 pixels or more are this wide and only gain resolution; smaller ones get smaller."""


def draw(
    snapshot: Snapshot,
    ax: Axes,
    *,
    legend: bool = False,
    scale_bar: bool = True,
    text: bool = True,
    truth: bool = True,
) -> None:
    """Draw on matplotlib axes of your own, as for a figure with several panels.

    The limits are set to the true plan and the frame of the axes is taken away. Line widths and
    numbers are in points, so size the axes first, then draw.

    Args:
        snapshot: what to draw.
        ax: axes to draw on.
        legend: explain the colours below the map.
        scale_bar: a bar of a round length below the map.
        text: the title above the map, and the figures of the run below it.
        truth: the true plan behind what the robot knows.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    require("matplotlib", "plots")
    from matplotlib.colors import to_rgba
    from matplotlib.lines import Line2D
    from matplotlib.patches import PathPatch

    point = _set_limits(snapshot, ax)
    # Widths grow slowly with the scale: full on a flat, finer on a campus.
    thick = float(np.clip((0.05 / point) ** 0.3, 0.6, 1.15))

    if truth:
        plan = _outline([(snapshot.exterior, snapshot.holes)])
        ax.add_artist(PathPatch(plan, facecolor=_UNSEEN, edgecolor=_OUTLINE, linewidth=0.7 * thick, zorder=1))
    if snapshot.explored:
        ax.add_artist(PathPatch(_outline(snapshot.explored), facecolor=_EXPLORED, linewidth=0, zorder=2))
    if snapshot.scan is not None and len(snapshot.scan) >= 2:
        fan = _outline([(_fan(snapshot.scan, snapshot.scan_pose), ())])
        edge, face = to_rgba(_FAN, 0.7), to_rgba(_FAN, 0.26)
        ax.add_artist(PathPatch(fan, facecolor=face, edgecolor=edge, linewidth=0.5 * thick, zorder=3))

    def lines(pieces: Iterable[np.ndarray], color: str, width: float, zorder: float) -> None:
        drawn = PathPatch(_open(pieces), fill=False, edgecolor=color, linewidth=width * thick, zorder=zorder)
        drawn.set(capstyle="round", joinstyle="round")
        ax.add_artist(drawn)

    fitted = snapshot.wall_fitted.astype(bool)
    walls = snapshot.walls.reshape(-1, 2, 2)
    lines(walls[~fitted], _FRAGMENT, 1.2, 4.0)
    lines(walls[fitted], _WALL, 1.9, 4.1)
    lines([snapshot.trajectory[:, :2]], "white", 2.6, 5.0)
    lines([snapshot.trajectory[:, :2]], _WAY, 1.5, 5.1)
    if len(snapshot.path) >= 2:
        dashes: dict[str, Any] = {"linewidth": 1.3 * thick, "linestyle": (0, (2.5, 1.8))}
        ax.add_artist(Line2D(*snapshot.path[:, :2].T, color=_JUMP, zorder=4.9, **dashes))
    spots: dict[str, Any] = {"marker": "o", "markersize": 4.4 * thick, "markeredgewidth": 0.7 * thick}
    ax.add_artist(
        Line2D(*snapshot.measured_at[:, :2].T, linestyle="", color=_WAY, markeredgecolor="white", zorder=5.3, **spots)
    )
    lines(snapshot.jump_edges, _JUMP, 2.6, 6.0)
    _draw_robot(snapshot, ax, point)
    _draw_nodes(snapshot, ax, point, thick)
    if text:
        _draw_text(snapshot, ax)
    if scale_bar:
        _draw_scale_bar(ax)
    if legend:
        _draw_legend(ax)


def frame(
    snapshot: Snapshot,
    width: int = 800,
    height: int | None = None,
    *,
    legend: bool = False,
    truth: bool = True,
) -> np.ndarray:
    """The snapshot as a picture for the screen or a video.

    All snapshots of one plan give pictures of one size, even in both directions as video codecs
    want it. Touches no global state of matplotlib.

    Args:
        snapshot: what to draw.
        width: pixels, at least 64; odd numbers are rounded up.
        height: pixels; None: what the plan's shape asks for.
        legend: explain the colours below the map.
        truth: the true plan behind what the robot knows.

    Returns:
        (h, w, 3) uint8, red, green, blue.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        RenderingError: the size is too small.
    """
    figure = _figure(snapshot, width, height, legend=legend, truth=truth)
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())  # type: ignore[attr-defined]
    return np.ascontiguousarray(pixels[:, :, :3])


def save_figure(
    snapshot: Snapshot, path: str | Path, *, width: int = 1600, legend: bool = True, truth: bool = True
) -> None:
    """Save one picture; the suffix decides the format (.png, .pdf, .svg).

    Vector formats are 8 inches wide and keep their text as text; `width` is that of a PNG, pixels.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        RenderingError: the suffix is none of these.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (".png", ".pdf", ".svg"):
        raise RenderingError(f"{path}: a figure is saved as .png, .pdf or .svg")
    figure = _figure(snapshot, width, None, legend=legend, truth=truth)
    import matplotlib

    # Editable text and no date, so that the same snapshot gives the same file.
    stamp = {".png": {}, ".pdf": {"CreationDate": None}, ".svg": {"Date": None}}[kind]
    with matplotlib.rc_context({"pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "polyexplore"}):
        figure.savefig(path, dpi=figure.dpi, metadata=stamp)


def _figure(snapshot: Snapshot, width: int, height: int | None, *, legend: bool, truth: bool) -> Figure:
    require("matplotlib", "plots")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if width < 64 or (height is not None and height < 64):
        raise RenderingError(f"a picture of {width} x {height} pixels is too small: 64 at least")
    dpi = max(100.0, width / _MIN_INCHES)
    points = width * 72.0 / dpi
    below = _BOTTOM + (_ROW * _legend_shape(points - 2 * _SIDE)[0] + 4.0 if legend else 0.0)
    if height is None:
        x0, y0, x1, y1 = _bounds(snapshot)
        shape = float(np.clip((y1 - y0) / (x1 - x0), 0.2, 1.25))
        height = round(((points - 2 * _SIDE) * shape + _TOP + below) * dpi / 72.0)
    pixels = (width + width % 2, height + height % 2)
    # A hair more than whole pixels: matplotlib cuts the fraction off.
    figure = Figure(figsize=((pixels[0] + 1e-3) / dpi, (pixels[1] + 1e-3) / dpi), dpi=dpi, facecolor="white")
    FigureCanvasAgg(figure)
    w, h = pixels[0] * 72.0 / dpi, pixels[1] * 72.0 / dpi
    inner = max(h - _TOP - below, 1.0)
    ax = figure.add_axes((_SIDE / w, below / h, 1.0 - 2.0 * _SIDE / w, inner / h))
    draw(snapshot, ax, legend=legend, truth=truth)
    return figure


def _bounds(snapshot: Snapshot) -> tuple[float, float, float, float]:
    """The true plan's extent with a margin, from nothing that changes during an exploration."""
    low, high = snapshot.exterior.min(axis=0), snapshot.exterior.max(axis=0)
    margin = 0.015 * float(max(high - low)) + 0.05
    return float(low[0] - margin), float(low[1] - margin), float(high[0] + margin), float(high[1] + margin)


def _set_limits(snapshot: Snapshot, ax: Axes) -> float:
    """Fit the map into the axes at equal scales. Returns the metres that a point (1/72 inch) covers."""
    x0, y0, x1, y1 = _bounds(snapshot)
    box = ax.bbox
    point_pixels = _root(ax).dpi / 72.0
    scale = max((x1 - x0) / max(box.width, 1.0), (y1 - y0) / max(box.height, 1.0))  # metres a pixel
    x, y = (x0 + x1) / 2, (y0 + y1) / 2
    ax.set_axis_off()
    ax.set_xlim(x - scale * box.width / 2, x + scale * box.width / 2, auto=False)
    ax.set_ylim(y - scale * box.height / 2, y + scale * box.height / 2, auto=False)
    ax.update_datalim([(x0, y0), (x1, y1)])
    ax.set_aspect("equal", adjustable="datalim")  # stays true when the axes are resized later
    return scale * point_pixels


def _root(ax: Axes) -> Figure:
    figure = ax.get_figure(root=True)
    assert figure is not None
    return figure


def _outline(polygons: Iterable[Polygon]) -> Outline:
    """One path of all rings, exteriors counter-clockwise and holes clockwise, as the winding rule needs."""
    from matplotlib.path import Path as Outline

    vertices, codes = [], []
    for exterior, holes in polygons:
        for ring, sign in ((exterior, 1.0), *((hole, -1.0) for hole in holes)):
            if len(ring) < 3:
                continue
            x, y = ring[:, 0], ring[:, 1]
            area = float(x @ np.roll(y, -1) - y @ np.roll(x, -1))
            ring = ring if area * sign > 0 else ring[::-1]
            vertices += [ring, ring[:1]]
            codes += [[Outline.MOVETO], [Outline.LINETO] * (len(ring) - 1), [Outline.CLOSEPOLY]]
    if not vertices:
        return Outline(np.zeros((0, 2)))
    return Outline(np.concatenate(vertices), np.concatenate(codes).astype(Outline.code_type))


def _open(pieces: Iterable[np.ndarray]) -> Outline:
    """One path of all polylines, each (k, 2): much faster to draw than an artist or a segment each."""
    from matplotlib.path import Path as Outline

    kept = [piece for piece in pieces if len(piece) >= 2]
    if not kept:
        return Outline(np.zeros((0, 2)))
    codes = np.full(sum(map(len, kept)), Outline.LINETO, dtype=Outline.code_type)
    codes[np.cumsum([0, *map(len, kept[:-1])])] = Outline.MOVETO
    return Outline(np.concatenate(kept), codes)


def _fan(scan: np.ndarray, pose: np.ndarray | None) -> np.ndarray:
    """The scan's outline: through the robot, unless the beams go all the way round it."""
    if pose is None:
        return scan
    first, last = scan[0] - pose[:2], scan[-1] - pose[:2]
    between = (np.arctan2(first[1], first[0]) - np.arctan2(last[1], last[0])) % (2 * np.pi)
    return scan if between < 3 * 2 * np.pi / len(scan) else np.concatenate([pose[None, :2], scan])


def _robot_radius(snapshot: Snapshot, point: float) -> float:
    """True to scale, but never so small that it is lost on a large plan, m."""
    return max(snapshot.radius, 4.2 * point)


def _draw_robot(snapshot: Snapshot, ax: Axes, point: float) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Circle

    radius = _robot_radius(snapshot, point)
    x, y, heading = (float(value) for value in snapshot.pose)
    if snapshot.estimate is not None and not np.allclose(snapshot.estimate, snapshot.pose, atol=0.005):
        u, v, believed = (float(value) for value in snapshot.estimate)
        ghost = Circle((u, v), radius, fill=False, edgecolor=_INK, linewidth=0.9, linestyle=(0, (2, 1.5)), zorder=7)
        ax.add_artist(ghost)
        tip = (u + radius * np.cos(believed), v + radius * np.sin(believed))
        ax.add_artist(Line2D([u, tip[0]], [v, tip[1]], color=_INK, linewidth=0.9, zorder=7))
    ax.add_artist(Circle((x, y), radius, facecolor=_ROBOT, edgecolor="white", linewidth=0.9, zorder=7.1))
    tip = (x + radius * np.cos(heading), y + radius * np.sin(heading))
    ax.add_artist(Line2D([x, tip[0]], [y, tip[1]], color="white", linewidth=1.6, solid_capstyle="butt", zorder=7.2))


def _draw_nodes(snapshot: Snapshot, ax: Axes, point: float, thick: float) -> None:
    """Numbered badges that point in the node's heading; in a crowd they step aside and keep a thread to the node."""
    from matplotlib.collections import LineCollection, PathCollection
    from matplotlib.path import Path as Outline
    from matplotlib.transforms import Affine2D

    positions = snapshot.node_positions
    if not len(positions):
        return
    ids = np.arange(len(positions))
    free = snapshot.node_mask.astype(bool)
    lit = ids == (-1 if snapshot.chosen is None else snapshot.chosen)
    size = float(np.clip(1.25 * thick, 0.95, 1.3))
    radius = _BADGE * size
    robot = _robot_radius(snapshot, point) / point
    badges = _apart(positions / point, 2 * radius + 1.0, snapshot.pose[:2] / point, robot + radius + 1.0) * point
    moved = np.hypot(*(badges - positions).T) > 0.5 * point
    color = np.where(lit | free, _JUMP, _MASKED)
    threads = np.stack([positions, badges], axis=1)[moved]
    ax.add_collection(LineCollection(threads, colors=color[moved], linewidths=0.7, zorder=8), autolim=False)

    in_points = Affine2D().scale(size / 72.0) + _root(ax).dpi_scale_trans

    def stamp(shapes: list[Outline], rows: np.ndarray, zorder: float, **style: Any) -> None:
        at = badges[rows]
        stamps = PathCollection(shapes, offsets=at, offset_transform=ax.transData, zorder=zorder, **style)
        stamps.set_transform(in_points)
        ax.add_collection(stamps, autolim=False)

    circle = Outline.unit_circle().transformed(Affine2D().scale(_BADGE))
    tip = np.array([[0.8, 0.56], [1.7, 0.0], [0.8, -0.56], [0.8, 0.56]]) * _BADGE
    looks = (
        (~free & ~lit, {"facecolors": "#f4f4f4", "edgecolors": _MASKED, "linewidths": 0.9}, _MASKED, _MASKED),
        (free & ~lit, {"facecolors": "white", "edgecolors": _JUMP, "linewidths": 1.2}, _JUMP, _INK),
        (lit, {"facecolors": _JUMP, "edgecolors": "white", "linewidths": 1.0}, _JUMP, "white"),
    )
    for rank, (rows, style, pointer, ink) in enumerate(looks):
        if not rows.any():
            continue
        z = 8.1 + 0.1 * rank
        if rows is lit:
            glow = Outline.unit_circle().transformed(Affine2D().scale(1.6 * _BADGE))
            stamp([glow], rows, z, facecolors=_GLOW, alpha=0.85, linewidths=0)
        tips = [Outline(tip).transformed(Affine2D().rotate(heading)) for heading in snapshot.node_headings[rows]]
        stamp(tips, rows, z + 0.01, facecolors=pointer, linewidths=0)
        stamp([circle], rows, z + 0.02, **style)
        stamp([_number(int(i), bool(lit[i])) for i in ids[rows]], rows, z + 0.03, facecolors=ink, linewidths=0)


@cache
def _number(number: int, bold: bool) -> Outline:
    """A node's number as an outline in points, centred: drawn many times faster than text."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.path import Path as Outline
    from matplotlib.textpath import TextPath

    size = 7.0 if number < 100 else 5.2
    glyphs = TextPath((0, 0), str(number), size=size, prop=FontProperties(weight="bold" if bold else "normal"))
    low, high = glyphs.vertices.min(axis=0), glyphs.vertices.max(axis=0)
    return Outline(glyphs.vertices - (low + high) / 2, glyphs.codes)


def _apart(centres: np.ndarray, distance: float, keep_off: np.ndarray, keep_off_distance: float) -> np.ndarray:
    """Push points apart until neighbours are `distance` from each other, or nearly so in a crowd.

    None stays within `keep_off_distance` of the point `keep_off` (2,), the robot.
    """
    placed = centres.astype(np.float64).copy()
    turn = np.arange(len(placed)) * 2.399963  # golden angle: points on one spot leave in different directions
    placed += 1e-3 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    for _ in range(60):
        away = placed[:, None] - placed[None]
        gap = np.hypot(away[..., 0], away[..., 1])
        np.fill_diagonal(gap, np.inf)
        gap = np.maximum(gap, 1e-9)
        from_robot = placed - keep_off
        far = np.maximum(np.hypot(from_robot[:, 0], from_robot[:, 1]), 1e-9)
        if gap.min() >= distance - 0.05 and far.min() >= keep_off_distance - 0.05:
            break
        push = np.clip(distance - gap, 0.0, None) / (2.0 * gap)
        placed += (push[..., None] * away).sum(axis=1)
        placed += (np.clip(keep_off_distance - far, 0.0, None) / far)[:, None] * from_robot
    return placed


def _draw_text(snapshot: Snapshot, ax: Axes) -> None:
    below = [
        f"{snapshot.distance:.1f} m driven",
        f"{snapshot.measurements} scan{'s' * (snapshot.measurements != 1)}",
    ]
    if snapshot.coverage is not None:
        below.append(f"{100 * snapshot.coverage:.0f} % seen")
    if len(snapshot.node_positions):
        below.append(f"{int(snapshot.node_mask.sum())} of {len(snapshot.node_positions)} nodes in reach")
    style = {"xycoords": "axes fraction", "textcoords": "offset points", "color": _INK, "annotation_clip": False}
    ax.annotate(snapshot.title, (0, 1), (1, 6), size=9, weight="bold", va="bottom", **style)  # type: ignore[arg-type]
    ax.annotate("  ·  ".join(below), (0, 0), (1, -5), size=8, va="top", **style)  # type: ignore[arg-type]


def _draw_scale_bar(ax: Axes) -> None:
    (x0, x1), transform = ax.get_xlim(), ax.get_xaxis_transform()
    from matplotlib.lines import Line2D
    from matplotlib.transforms import ScaledTranslation

    inches = _root(ax).dpi_scale_trans
    down = transform + ScaledTranslation(0, -10 / 72.0, inches)
    lengths = np.array([1, 2, 5, 10, 20, 50, 100])
    length = lengths[np.searchsorted(lengths, 0.18 * (x1 - x0), side="right") - 1] if x1 - x0 > 6 else 1
    end = x1 - 0.004 * (x1 - x0)
    bar: dict[str, Any] = {"color": _INK, "transform": down, "clip_on": False, "zorder": 9}
    ax.add_artist(
        Line2D([end - length, end], [0, 0], linewidth=1.4, marker="|", markersize=5, markeredgewidth=1.2, **bar)
    )
    gap = ScaledTranslation(-5 / 72.0, 0, inches)
    ax.text(
        end - length, 0, f"{length} m", size=8, color=_INK, ha="right", va="center", transform=down + gap, clip_on=False
    )


_ENTRIES = 12
"""In the legend."""


def _legend_shape(points: float) -> tuple[int, int]:
    """Rows and columns of the legend for a map so many points wide; rows as even as can be."""
    rows = -(-_ENTRIES // max(int(points // 78.0), 1))
    return rows, -(-_ENTRIES // rows)


def _draw_legend(ax: Axes) -> None:
    from matplotlib.colors import to_rgba
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    def node(face: str, edge: str) -> Line2D:
        return Line2D([], [], linestyle="", marker="o", markersize=7.5, markerfacecolor=face, markeredgecolor=edge)

    marks = {
        "unseen": Patch(facecolor=_UNSEEN, edgecolor=_OUTLINE, linewidth=0.7),
        "seen": Patch(facecolor=_EXPLORED, edgecolor=_OUTLINE, linewidth=0.3),
        "wall": Line2D([], [], color=_WALL, linewidth=1.9),
        "fragment": Line2D([], [], color=_FRAGMENT, linewidth=1.2),
        "jump edge": Line2D([], [], color=_JUMP, linewidth=2.6),
        "node": node("white", _JUMP),
        "chosen": node(_JUMP, _GLOW),
        "out of reach": node("#f4f4f4", _MASKED),
        "driven": Line2D([], [], color=_WAY, linewidth=1.5, marker="o", markersize=3.6),
        "planned": Line2D([], [], color=_JUMP, linewidth=1.3, linestyle=(0, (2.5, 1.8))),
        "last scan": Patch(facecolor=to_rgba(_FAN, 0.4), edgecolor=_FAN, linewidth=0.5),
        "robot": node(_ROBOT, "white"),
    }
    assert len(marks) == _ENTRIES
    points = _root(ax).dpi / 72.0
    _, columns = _legend_shape(ax.bbox.width / points)
    # Matplotlib fills column by column; a reader goes row by row.
    order = [i for c in range(columns) for i in range(c, _ENTRIES, columns)]
    names = list(marks)
    ax.legend(
        [marks[names[i]] for i in order],
        [names[i] for i in order],
        ncols=columns,
        loc="upper left",
        bbox_to_anchor=(0.0, -_BOTTOM * points / ax.bbox.height),
        borderaxespad=0.0,
        borderpad=0.0,
        fontsize=7.5,
        labelcolor=_INK,
        frameon=False,
        handlelength=1.9,
        columnspacing=1.6,
        labelspacing=0.55,
    )
