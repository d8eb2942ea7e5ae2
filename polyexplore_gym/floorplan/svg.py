"""SVG: shapes and paths with their transforms; curves and transforms are svgpathtools' (the extra `drawings`)."""

from __future__ import annotations

import math
import re
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np

from polyexplore_gym.errors import FloorPlanWarning, InvalidFloorPlanError
from polyexplore_gym.floorplan.drawing import MAX_POINTS, MAX_STROKES, Drawing, Stroke
from polyexplore_gym.floorplan.model import FloorPlan
from polyexplore_gym.floorplan.units import guess, metres
from polyexplore_gym.floorplan.validation import shorten
from polyexplore_gym.optional import require

_SVG = "{http://www.w3.org/2000/svg}"
_LABEL = "{http://www.inkscape.org/namespaces/inkscape}label"
_HREF = "{http://www.w3.org/1999/xlink}href"
_UNITS = "data-units"
"""Attribute of the root by which our own files say metres a user unit."""
_NOT_DRAWN = {"defs", "clipPath", "mask", "marker", "pattern", "symbol"}
# What is no wall and not worth a word.
_NO_WALLS = {"text", "tspan", "image", "foreignObject", "style", "script", "title", "desc", "metadata", "view"}
_GROUPS = {"svg", "g", "a", "switch"}
_DEPTH = 50
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_MOST_ON_CURVE = 200


def read(path: Path, units: str | None, tolerance: float) -> Drawing:
    """The lines of a drawing, m, y up, with the labels, ids and classes of their groups and their colours.

    Args:
        path: of the file.
        units: of a user unit; needed, since an SVG is as large as the paper, unless `write` wrote the file.
        tolerance: greatest deviation of curves, m.

    Raises:
        InvalidFloorPlanError: not an SVG file, damaged, too large, or without units.
        MissingDependencyError: svgpathtools is not installed.
    """
    require("svgpathtools", "drawings")
    data = path.read_bytes()
    if b"<!ENTITY" in data:
        raise InvalidFloorPlanError("not read: the XML defines entities")
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError, RecursionError) as error:
        raise InvalidFloorPlanError(f"not an SVG drawing, truncated perhaps: {error}") from error
    if _tag(root) != "svg":
        raise InvalidFloorPlanError(f"not an SVG drawing: the root is {shorten(_tag(root))}")
    stated = root.get(_UNITS) if units is None else units
    factor = 1.0 if stated is None else metres(stated)
    strokes: list[Stroke] = []
    names: set[str] = set()
    points = 0
    others: Counter[str] = Counter()
    for element, matrix, tags, where in _shapes(root, others):
        try:
            lines = list(_lines(element, matrix, tolerance / factor))
        except InvalidFloorPlanError:
            raise
        except Exception as error:  # the parsers of paths let through what damaged data make Python's own calls raise
            raise InvalidFloorPlanError(f"{where}: damaged: {shorten(str(error))}") from error
        names |= tags
        for line, closed in lines:
            points += len(line)
            if len(strokes) >= MAX_STROKES or points > MAX_POINTS:
                raise InvalidFloorPlanError(f"too large: more than {MAX_STROKES} lines or {MAX_POINTS} points")
            strokes.append(Stroke(line * (factor, -factor), closed, tags))
    if stated is None:
        raise InvalidFloorPlanError(_no_units(strokes))
    if others:
        shown = ", ".join(f"{count} {kind[:40]}" for kind, count in sorted(others.items())[:8])
        warnings.warn(f"{path}: not read: {shown}", FloorPlanWarning, stacklevel=2)
    return Drawing(strokes, frozenset(names))


def _no_units(strokes: list[Stroke]) -> str:
    text = (
        "an SVG does not say how large a building is: say metres a user unit, as units=0.01 or units='cm' (--units cm)"
    )
    if not strokes:
        return text
    points = np.concatenate([stroke.points for stroke in strokes])
    width, height = np.ptp(points, axis=0).tolist()
    return f"{text}; it spans {width:.4g} x {height:.4g} user units{guess(width, height)}"


def _tag(element: ElementTree.Element) -> str:
    return element.tag.rsplit("}", 1)[-1] if isinstance(element.tag, str) else ""


_Shape = tuple[ElementTree.Element, np.ndarray, frozenset[str], str]


def _shapes(root: ElementTree.Element, others: Counter[str]) -> Iterator[_Shape]:
    """Each shape that is shown, with its matrix (3, 3), its names, and what it is called in messages.

    Elements of SVG that are not known are counted in `others`.
    """
    from svgpathtools.parser import parse_transform

    by_id = {element.get("id"): element for element in root.iter() if element.get("id")}

    def walk(
        element: ElementTree.Element, matrix: np.ndarray, tags: frozenset[str], style: Mapping[str, str], depth: int
    ) -> Iterator[_Shape]:
        tag = _tag(element)
        if not tag or tag in _NOT_DRAWN or tag in _NO_WALLS or depth > _DEPTH:
            return
        style = {**style, **_style(element)}
        if style.get("display") == "none":
            return
        where = f"{tag} {element.get('id')!r}" if element.get("id") else tag
        if element.get("transform"):
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error")  # svgpathtools only warns of transforms that it does not know
                    matrix = matrix @ np.asarray(parse_transform(element.get("transform")), dtype=np.float64)
            except Exception as error:
                raise InvalidFloorPlanError(f"{where}: transform {shorten(element.get('transform'))}") from error
        own = {element.get(key) for key in (_LABEL, "id")} | set(element.get("class", "").split())
        tags = tags | frozenset(name.lower() for name in own if name)
        if tag in _GROUPS:
            for child in element:
                yield from walk(child, matrix, tags, style, depth + 1)
        elif tag == "use":
            target = by_id.get((element.get("href") or element.get(_HREF) or "").removeprefix("#"))
            if target is not None:
                offset = np.eye(3)
                offset[:2, 2] = _value(element, "x"), _value(element, "y")
                yield from walk(target, matrix @ offset, tags, style, depth + 1)
        elif tag in _POINTS and style.get("visibility") not in ("hidden", "collapse"):
            colours = {_colour(style[key]) for key in ("stroke", "fill") if style.get(key, "none") != "none"}
            yield element, matrix, tags | colours, where
        elif tag not in _POINTS and element.tag.startswith((_SVG, tag)):
            others[tag] += 1

    return walk(root, np.eye(3), frozenset(), {}, 0)


def _style(element: ElementTree.Element) -> dict[str, str]:
    """The presentation that counts here; `style` goes before attributes."""
    keys = ("stroke", "fill", "display", "visibility")
    found = {key: element.get(key, "").strip() for key in keys if element.get(key)}
    for part in element.get("style", "").split(";"):
        key, _, value = part.partition(":")
        if key.strip() in keys:
            found[key.strip()] = value.strip()
    return found


def _colour(text: str) -> str:
    """#rrggbb where it is written in one of the usual ways, else as it is, in lower case."""
    text = text.lower()
    if re.fullmatch(r"#[0-9a-f]{3}", text):
        return "#" + "".join(2 * digit for digit in text[1:])
    match = re.fullmatch(r"rgb\(\s*(\d{1,3})\s*,\s*(\d{1,3})\s*,\s*(\d{1,3})\s*\)", text)
    return "#" + "".join(f"{min(int(value), 255):02x}" for value in match.groups()) if match else text


def _value(element: ElementTree.Element, key: str) -> float:
    """A length in user units; lengths with a unit or in percent are an error, being paper's."""
    text = element.get(key, "0").strip().removesuffix("px")
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{key} {text}")
    return value


def _lines(element: ElementTree.Element, matrix: np.ndarray, tolerance: float) -> Iterator[tuple[np.ndarray, bool]]:
    """The lines of a shape, user units of the root, and whether they are closed."""
    for points, closed in _POINTS[_tag(element)](element, tolerance / _scale(matrix)):
        line = points @ matrix[:2, :2].T + matrix[:2, 2]
        if not np.isfinite(line).all():
            raise ValueError("a coordinate that is not finite")
        keep = np.ones(len(line), bool)
        keep[1:] = (np.diff(line, axis=0) != 0).any(axis=1)
        line = line[keep]
        if len(line) > 2 and np.array_equal(line[0], line[-1]):
            line, closed = line[:-1], True
        if len(line) > 1:
            yield line, closed and len(line) > 2


def _scale(matrix: np.ndarray) -> float:
    return max(float(np.linalg.norm(matrix[:2, :2], 2)), 1e-12)


_Lines = Iterator[tuple[np.ndarray, bool]]


def _polyline(element: ElementTree.Element, tolerance: float) -> _Lines:
    text = element.get("points", "")
    if re.sub(r"[\s,]", "", _NUMBER.sub("", text)):
        raise ValueError(f"points {text[:40]}")
    values = [float(number) for number in _NUMBER.findall(text)]
    if len(values) % 2:
        raise ValueError("points: an odd number of coordinates")
    yield np.array(values).reshape(-1, 2), _tag(element) == "polygon"


def _segment(element: ElementTree.Element, tolerance: float) -> _Lines:
    yield (
        np.array([[_value(element, "x1"), _value(element, "y1")], [_value(element, "x2"), _value(element, "y2")]]),
        False,
    )


def _rectangle(element: ElementTree.Element, tolerance: float) -> _Lines:
    x, y, width, height = (_value(element, key) for key in ("x", "y", "width", "height"))
    if width > 0 and height > 0:
        yield np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]]), True


def _ellipse(element: ElementTree.Element, tolerance: float) -> _Lines:
    radius = _value(element, "r") if _tag(element) == "circle" else 0.0
    rx, ry = (radius, radius) if radius else (_value(element, "rx"), _value(element, "ry"))
    if rx > 0 and ry > 0:
        count = _count(2 * math.pi * max(rx, ry), max(rx, ry), tolerance)
        angles = np.arange(count) * (2 * math.pi / count)
        yield (
            np.array([_value(element, "cx"), _value(element, "cy")])
            + np.column_stack([rx * np.cos(angles), ry * np.sin(angles)]),
            True,
        )


def _count(length: float, radius: float, tolerance: float) -> int:
    """So many chords follow an arc within the tolerance."""
    return int(np.clip(math.ceil(length / math.sqrt(8 * radius * max(tolerance, 1e-12))), 8, _MOST_ON_CURVE))


def _path(element: ElementTree.Element, tolerance: float) -> _Lines:
    from svgpathtools import Line, parse_path

    rest = re.sub(r"[\s,MmZzLlHhVvCcSsQqTtAa]", "", _NUMBER.sub("", element.get("d", "")))
    if rest:
        raise ValueError(f"d {rest[:40]}")
    points: list[complex] = []
    closing = re.sub(r"[^MmZz]", "", element.get("d", ""))
    subpaths = re.findall(r"[Mm]|[Zz]", closing)
    ends = [i + 1 < len(subpaths) and subpaths[i + 1] in "Zz" for i, kind in enumerate(subpaths) if kind in "Mm"]
    lines: list[list[complex]] = []
    for segment in parse_path(element.get("d", "")):
        if not points or abs(segment.start - points[-1]) > 1e-9 * max(1.0, abs(segment.start)):
            points = [segment.start]
            lines.append(points)
        if isinstance(segment, Line):
            points.append(segment.end)
        else:
            points += _on_curve(segment, tolerance)
    for i, line in enumerate(lines):
        ring = np.array([(point.real, point.imag) for point in line], dtype=np.float64)
        yield ring, len(lines) == len(ends) and ends[i]


def _on_curve(segment: Any, tolerance: float) -> list[complex]:
    """Points along a curve after its start, the end exact."""
    controls = [
        getattr(segment, name) for name in ("start", "control", "control1", "control2", "end") if hasattr(segment, name)
    ]
    if hasattr(segment, "radius"):
        size = max(segment.radius.real, segment.radius.imag)
        count = _count(abs(math.radians(segment.delta)) * size, size, tolerance)
    else:
        length = sum(abs(b - a) for a, b in pairwise(controls))
        count = _count(length, max(length, 1e-12), tolerance)
    values = [complex(segment.point(t)) for t in np.linspace(0.0, 1.0, count + 1)[1:-1]]
    return [*values, segment.end]


_POINTS = {
    "path": _path,
    "polyline": _polyline,
    "polygon": _polyline,
    "line": _segment,
    "rect": _rectangle,
    "circle": _ellipse,
    "ellipse": _ellipse,
}


def write(plan: FloorPlan, path: Path) -> None:
    """Write a plan: a user unit is a metre, y up by a transform; groups `outline` and `obstacles`."""
    x0, y0, x1, y1 = plan.bounds
    margin = 0.02 * max(x1 - x0, y1 - y0)
    box = f"{x0 - margin:g} {-y1 - margin:g} {x1 - x0 + 2 * margin:g} {y1 - y0 + 2 * margin:g}"
    groups = []
    for name, rings, fill in (("outline", plan.rings[:1], "#ffffff"), ("obstacles", plan.rings[1:], "#9a9a9a")):
        shapes = "\n".join(
            '      <polygon points="' + " ".join(f"{x!r},{y!r}" for x, y in ring.tolist()) + '"/>' for ring in rings
        )
        groups.append(f'    <g id="{name}" fill="{fill}">\n{shapes}\n    </g>')
    style = f'stroke="#1f1f1f" stroke-width="{max(0.05, margin / 10):g}" stroke-linejoin="miter"'
    text = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{box}" width="1000" {_UNITS}="m">\n'
        f"  <title>{quoteattr(plan.name)[1:-1]}</title>\n"
        f'  <g transform="scale(1 -1)" {style}>\n' + "\n".join(groups) + "\n  </g>\n</svg>\n"
    )
    path.write_text(text, encoding="utf-8")
