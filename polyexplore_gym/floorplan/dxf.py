"""DXF by ezdxf (the extra `drawings`): the lines of the model space, blocks taken apart."""

from __future__ import annotations

import logging
import os
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from polyexplore_gym.errors import FloorPlanWarning, InvalidFloorPlanError
from polyexplore_gym.floorplan.drawing import MAX_POINTS, MAX_STROKES, Drawing, Stroke
from polyexplore_gym.floorplan.model import FloorPlan
from polyexplore_gym.floorplan.units import metres
from polyexplore_gym.floorplan.validation import shorten
from polyexplore_gym.optional import require

# $INSUNITS: metres a unit.
_INSUNITS = {1: 0.0254, 2: 0.3048, 4: 0.001, 5: 0.01, 6: 1.0, 7: 1000.0, 10: 0.9144, 14: 0.1, 15: 10.0, 16: 100.0}
_LINES = {"LINE", "LWPOLYLINE", "POLYLINE", "ARC", "CIRCLE", "ELLIPSE", "SPLINE"}
# What is no wall and not worth a word.
_NO_WALLS = {"TEXT", "MTEXT", "DIMENSION", "ARC_DIMENSION", "LEADER", "MULTILEADER", "TOLERANCE", "ATTDEF", "ATTRIB",
             "POINT", "HATCH", "MPOLYGON", "VIEWPORT", "IMAGE", "WIPEOUT", "XLINE", "RAY", "ACAD_TABLE"}  # fmt: skip
_BY_LAYER, _BY_BLOCK = 256, 0


def read(path: Path, units: str | None, tolerance: float) -> Drawing:
    """The lines of a drawing, m, with layer and colour number.

    Args:
        path: of the file.
        units: instead of what the drawing says.
        tolerance: greatest deviation of curves, m.

    Raises:
        InvalidFloorPlanError: not a DXF file, damaged, too large, or without units.
        MissingDependencyError: ezdxf is not installed.
    """
    ezdxf = require("ezdxf", "drawings")
    with path.open("rb") as file:
        file.seek(-min(64, path.stat().st_size), os.SEEK_END)
        if b"EOF" not in file.read():
            raise InvalidFloorPlanError("not a DXF drawing, or truncated: it does not end with EOF")
    said: list[str] = []
    try:
        with _listening(said):
            document = ezdxf.readfile(path)
            factor = _factor(document, units)
            strokes, names, others = _strokes(document, factor, tolerance)
    except InvalidFloorPlanError:
        raise
    except Exception as error:  # ezdxf lets through what damaged files make Python's own calls raise
        reason = " ".join(str(error).split())[:200]
        raise InvalidFloorPlanError(f"not a DXF drawing, or damaged: {reason or type(error).__name__}") from error
    if said:
        more = f" and {len(said) - 3} more" if len(said) > 3 else ""
        warnings.warn(f"{path}: damaged in part: {'; '.join(said[:3])}{more}", FloorPlanWarning, stacklevel=2)
    if others:
        shown = ", ".join(f"{count} {kind[:40]}" for kind, count in sorted(others.items())[:8])
        warnings.warn(f"{path}: not read: {shown}", FloorPlanWarning, stacklevel=2)
    return Drawing(strokes, frozenset(names))


@contextmanager
def _listening(said: list[str]) -> Iterator[None]:
    """Collect what ezdxf logs of entities that it leaves out, instead of printing it."""

    class Ear(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            said.append(" ".join(record.getMessage().split())[:120])

    logger = logging.getLogger("ezdxf")
    ear, passed_on = Ear(logging.WARNING), logger.propagate
    logger.addHandler(ear)
    logger.propagate = False
    try:
        yield
    finally:
        logger.removeHandler(ear)
        logger.propagate = passed_on


def _factor(document: Any, units: str | None) -> float:
    if units is not None:
        return metres(units)
    code = document.header.get("$INSUNITS", 0)
    if code not in _INSUNITS:
        raise InvalidFloorPlanError(
            f"$INSUNITS {shorten(code)}: the drawing does not say its units: say units='mm' or the like (--units mm)"
        )
    return _INSUNITS[code]


def _strokes(document: Any, factor: float, tolerance: float) -> tuple[list[Stroke], set[str], Counter[str]]:
    strokes: list[Stroke] = []
    names: set[str] = set()
    points = 0
    others: Counter[str] = Counter()
    for kind, entity, layer, colour in _entities(document):
        if kind not in _LINES:
            others[kind] += 1
            continue
        tags = frozenset({layer.lower(), str(colour)})
        names |= tags
        line, closed = _points(kind, entity, tolerance / factor)
        if len(line) < 2:
            continue
        points += len(line)
        if len(strokes) >= MAX_STROKES or points > MAX_POINTS:
            raise InvalidFloorPlanError(f"too large: more than {MAX_STROKES} lines or {MAX_POINTS} points")
        strokes.append(Stroke(line * factor, closed, tags))
    return strokes, names, others


def _entities(document: Any) -> Iterator[tuple[str, Any, str, int]]:
    """Kind, entity, layer and colour of the lines that are shown; layer 0 and colours of blocks are the insert's."""

    def walk(entities: Any, outer: tuple[str, int] | None, depth: int) -> Iterator[tuple[str, Any, str, int]]:
        for entity in entities:
            kind = entity.dxftype()
            if kind in _NO_WALLS:
                continue
            if entity.dxf.get("invisible", 0):
                continue
            layer, colour = entity.dxf.get("layer", "0"), entity.dxf.get("color", _BY_LAYER)
            if outer is not None and layer == "0":
                layer = outer[0]
            style = document.layers.get(layer) if layer in document.layers else None
            if style is not None and (style.is_off() or style.is_frozen()):
                continue
            if colour == _BY_BLOCK and outer is not None:
                colour = outer[1]
            if colour == _BY_LAYER:
                colour = abs(style.dxf.get("color", 7)) if style is not None else 7
            if kind != "INSERT":
                yield kind, entity, layer, colour
            elif depth < 16:
                yield from walk(entity.virtual_entities(), (layer, colour), depth + 1)

    yield from walk(document.modelspace(), None, 0)


def _points(kind: str, entity: Any, tolerance: float) -> tuple[np.ndarray, bool]:
    """The points (n, 2) of an entity, units of the file, and whether the last is joined to the first."""
    from ezdxf.path import make_path

    closed = kind == "CIRCLE" or bool(getattr(entity, "closed", False) or getattr(entity, "is_closed", False))
    if kind == "LWPOLYLINE" and not entity.has_arc:
        line = np.array([point[:2] for point in entity.get_points("xy")], dtype=np.float64).reshape(-1, 2)
    elif kind == "LINE":
        line = np.array([(point.x, point.y) for point in (entity.dxf.start, entity.dxf.end)], dtype=np.float64)
    else:
        path = make_path(entity)
        flat = path.flattening(max(tolerance, 1e-9)) if len(path) else []
        line = np.array([(point.x, point.y) for point in flat], dtype=np.float64).reshape(-1, 2)
    if len(line) > 2 and np.array_equal(line[0], line[-1]):
        line, closed = line[:-1], True
    if len(line) == 2 and np.array_equal(line[0], line[1]):
        line = line[:1]
    return line, closed and len(line) > 2


def write(plan: FloorPlan, path: Path) -> None:
    """Write a plan: closed polylines in metres, the outline on the layer OUTLINE, holes on OBSTACLES.

    Raises:
        MissingDependencyError: ezdxf is not installed.
    """
    ezdxf = require("ezdxf", "drawings")
    document = ezdxf.new("R2010", units=6)
    document.header["$MEASUREMENT"] = 1
    for layer, colour in (("OUTLINE", 7), ("OBSTACLES", 1)):
        document.layers.add(layer, color=colour)
    space = document.modelspace()
    for i, ring in enumerate(plan.rings):
        layer = "OBSTACLES" if i else "OUTLINE"
        space.add_lwpolyline(ring.tolist(), format="xy", close=True, dxfattribs={"layer": layer})
    document.saveas(path)
