"""Procedural homes: rooms by recursive subdivision, a corridor in larger ones, a living area, furniture."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely

from polyexplore_gym.floorplan import furniture
from polyexplore_gym.floorplan.building import (
    Box,
    Cell,
    Wall,
    finish,
    inner_box,
    open_wall,
    place_door,
    shared_walls,
    spanning_walls,
    union_of,
    within,
)
from polyexplore_gym.floorplan.model import FloorPlan

AREA_RANGE = (30.0, 320.0)
"""Free area of a home, m2."""
VERTEX_RANGE = (24, 260)
"""Vertices of a home."""
_DOORS = (800, 850, 900, 900, 950, 1000, 1200)
_MIN_SIDE = 1700


def draw_home(rng: np.random.Generator, name: str, meta: dict[str, Any]) -> FloorPlan | None:
    """One home, or None if the draw failed."""
    area = float(np.clip(rng.lognormal(np.log(110.0), 0.65), 45.0, 340.0))
    aspect = rng.uniform(1.05, 1.9)
    long_side = round(1000 * np.sqrt(area * aspect))
    short_side = round(1000 * np.sqrt(area / aspect))
    thickness = 2 * int(rng.integers(50, 90))
    box = (0, 0, long_side, short_side)
    cells = _with_corridor(rng, box) if area > 55 and rng.random() < 0.65 else _plain(rng, box)
    cells = _drop_corner_rooms(rng, cells)
    if rng.random() < 0.5:
        cells = [Cell((c.box[1], c.box[0], c.box[3], c.box[2]), c.kind) for c in cells]
    openings = _doors(rng, cells, thickness)
    if openings is None:
        return None
    doors, merged = openings
    rooms = [inner_box(c, thickness) for c in cells]
    free = union_of([*rooms, *doors, *merged])
    obstacles = _built_in(rng, rooms, doors, merged)
    if rng.random() < 0.6:
        bevelled = float(rng.choice([0.0, 0.2, 0.5]))
        obstacles += _furnish(rng, cells, rooms, doors + merged, bevelled)
    plan = finish(free, obstacles, name, meta)
    return within(plan, AREA_RANGE, VERTEX_RANGE)


def _split(rng: np.random.Generator, box: Box, limit: float, cells: list[Cell], kind: str = "room") -> None:
    """Halve the box across its longer side until the rooms are below a random share of `limit` (m2)."""
    x0, y0, x1, y1 = box
    width, depth = x1 - x0, y1 - y0
    enough = width * depth * 1e-6 < limit * rng.uniform(0.6, 1.4)
    across = width >= depth if rng.random() < 0.9 else width < depth
    side = width if across else depth
    if (enough and max(width, depth) < 2.6 * min(width, depth)) or side < 2 * _MIN_SIDE + 200:
        cells.append(Cell(box, kind))
        return
    cut = int(np.clip(round(side * rng.uniform(0.3, 0.7), -1), _MIN_SIDE, side - _MIN_SIDE))
    parts = (
        ((x0, y0, x0 + cut, y1), (x0 + cut, y0, x1, y1)) if across else ((x0, y0, x1, y0 + cut), (x0, y0 + cut, x1, y1))
    )
    for part in parts:
        _split(rng, part, limit, cells, kind)


def _plain(rng: np.random.Generator, box: Box) -> list[Cell]:
    cells: list[Cell] = []
    area = (box[2] - box[0]) * (box[3] - box[1]) * 1e-6
    _split(rng, box, float(np.clip(area / rng.uniform(3.5, 7.0), 8.0, 28.0)), cells)
    max(cells, key=lambda c: c.area).kind = "living"
    return cells


def _with_corridor(rng: np.random.Generator, box: Box) -> list[Cell]:
    """A living area at one end, and rooms on one or both sides of a corridor."""
    x0, y0, x1, y1 = box
    cells: list[Cell] = []
    living = x0 + int((x1 - x0) * rng.uniform(0.25, 0.45))
    _split(rng, (x0, y0, living, y1), float(rng.uniform(24, 48)), cells, "living")
    width = int(rng.integers(105, 150)) * 10
    depth = y1 - y0
    if depth < 2 * 2600 + width or rng.random() < 0.15:
        # Too shallow for rooms on both sides.
        low = y0 if rng.random() < 0.5 else y1 - width
    else:
        low = y0 + int((depth - width) * rng.uniform(0.4, 0.6))
    # The corridor may stop short, with a room across its end.
    end = x1 if rng.random() < 0.5 or x1 - living < 6000 else x1 - int(rng.integers(2600, 3600))
    cells.append(Cell((living, low, end, low + width), "corridor"))
    if end < x1:
        _split(rng, (end, y0, x1, y1), float(rng.uniform(12, 20)), cells)
    for bottom, top in ((y0, low), (low + width, y1)):
        x = living
        while x < end and top - bottom >= _MIN_SIDE:
            share = int(rng.integers(200, 520)) * 10
            nxt = end if end - x - share < 1900 else x + share
            _bedroom(rng, (x, bottom, nxt, top), cells)
            x = nxt
    return cells


def _bedroom(rng: np.random.Generator, box: Box, cells: list[Cell]) -> None:
    """A room, sometimes with a bath or closet of its own in its depth."""
    x0, y0, x1, y1 = box
    if y1 - y0 > 4400 and x1 - x0 > 2200 and rng.random() < 0.6:
        cut = y0 + int((y1 - y0) * rng.uniform(0.35, 0.65))
        cells += [Cell((x0, y0, x1, cut)), Cell((x0, cut, x1, y1))]
    else:
        cells.append(Cell(box))


def _drop_corner_rooms(rng: np.random.Generator, cells: list[Cell]) -> list[Cell]:
    """Make the outline an L, T or U by leaving out rooms at corners of the bounding box."""
    boxes = np.array([c.box for c in cells])
    bounds = (*boxes[:, :2].min(axis=0), *boxes[:, 2:].max(axis=0))
    total = sum(c.area for c in cells)
    for _ in range(int(rng.choice([0, 1, 1, 2, 2, 3]))):
        corners = [
            c
            for c in cells
            if c.kind == "room"
            and c.area < 0.16 * total
            and (c.box[0] == bounds[0] or c.box[2] == bounds[2])
            and (c.box[1] == bounds[1] or c.box[3] == bounds[3])
        ]
        if len(cells) > 4 and corners:
            dropped = corners[int(rng.integers(len(corners)))]
            cells = [c for c in cells if c is not dropped]
    return cells


def _doors(rng: np.random.Generator, cells: list[Cell], thickness: int) -> tuple[list[Box], list[Box]] | None:
    """Doors, and wide openings of living areas; None if some room cannot be reached."""
    walls = shared_walls(cells, thickness + 1050)
    hubs = [i for i, c in enumerate(cells) if c.kind == "corridor"] or [
        max(range(len(cells)), key=lambda i: cells[i].area)
    ]

    def cost(a: Cell, b: Cell) -> float:
        if "corridor" in (a.kind, b.kind):
            return 0.0
        # Baths and closets are ends, not ways through.
        return 0.3 if a.kind == "living" else 1.5 + (2.0 if a.area < 9 else 0.0)

    tree = spanning_walls(rng, cells, walls, hubs[0], cost)
    if len(tree) != len(cells) - 1:
        return None
    extra = [w for w in walls if w not in tree and min(cells[w.a].area, cells[w.b].area) > 6]
    chosen = [*tree, *(w for w in extra if rng.random() < 0.04)]
    doors: list[Box] = []
    merged: list[Box] = []
    for wall in chosen:
        kinds = {cells[wall.a].kind, cells[wall.b].kind}
        if (kinds in ({"living"}, {"living", "corridor"}) and rng.random() < 0.75) or rng.random() < 0.06:
            merged.append(_wide_opening(rng, wall, thickness))
        else:
            doors.append(place_door(rng, wall, int(rng.choice(_DOORS)), thickness))
    return doors, merged


def _wide_opening(rng: np.random.Generator, wall: Wall, thickness: int) -> Box:
    if wall.length < 2400 or rng.random() < 0.5:
        return open_wall(wall, thickness)
    return place_door(rng, wall, min(int(rng.integers(14, 28)) * 100, wall.length - thickness - 300), thickness)


def _built_in(rng: np.random.Generator, rooms: list[Box], doors: list[Box], merged: list[Box]) -> list[Any]:
    """Chimneys, shafts and pillars: small boxes in corners."""
    keep_out = [furniture.grow(d, 700) for d in (*doors, *merged)]
    items: list[Any] = []
    for room in rooms:
        if rng.random() < 0.25 and min(room[2] - room[0], room[3] - room[1]) > 2200:
            size = int(rng.integers(20, 60)) * 10, int(rng.integers(20, 60)) * 10
            items += [shapely.box(*b) for b in furniture.along_walls(rng, room, [size], keep_out, tries=2)]
    return items


def _furnish(
    rng: np.random.Generator, cells: list[Cell], rooms: list[Box], doors: list[Box], bevelled: float
) -> list[Any]:
    """Beds, wardrobes, sofas, kitchen units; tables stand free and some are round."""
    keep_out = [furniture.grow(d, 650) for d in doors]
    items: list[Any] = []
    for cell, room in zip(cells, rooms, strict=True):
        if cell.kind == "corridor" or min(room[2] - room[0], room[3] - room[1]) < 1600:
            continue
        sizes = _pieces(rng, cell)
        placed = furniture.along_walls(rng, room, sizes, keep_out)
        items += [furniture.outline(rng, b, room, bevelled) for b in placed]
        if cell.area > 11 and rng.random() < (0.7 if cell.kind == "living" else 0.25):
            width, depth = int(rng.integers(70, 180)) * 10, int(rng.integers(70, 100)) * 10
            table = furniture.free_standing(rng, room, width, depth, [*keep_out, *placed])
            if table is not None:
                items.append(_table(rng, table))
    return items


def _pieces(rng: np.random.Generator, cell: Cell) -> list[tuple[int, int]]:
    if cell.area < 7:
        choices = [(1600, 700), (600, 500), (900, 900), (600, 600)]
    elif cell.kind == "living":
        choices = [(2200, 900), (1800, 450), (2400, 600), (900, 900), (1200, 400), (800, 350)]
    else:
        choices = [(2000, 1600), (2000, 900), (1800, 600), (1200, 600), (1000, 400), (500, 450)]
    count = int(rng.integers(1, 2 + round(cell.area / 7)))
    return [choices[int(k)] for k in rng.integers(len(choices), size=min(count, 5))]


def _table(rng: np.random.Generator, box: Box) -> Any:
    x0, y0, x1, y1 = box
    if rng.random() < 0.7:
        return shapely.box(*box)
    cut = min(x1 - x0, y1 - y0) * 29 // 100
    corners = [(x0 + cut, y0), (x1 - cut, y0), (x1, y0 + cut), (x1, y1 - cut)]
    corners += [(x1 - cut, y1), (x0 + cut, y1), (x0, y1 - cut), (x0, y0 + cut)]
    return shapely.Polygon(corners)
