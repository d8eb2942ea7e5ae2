"""Procedural offices: blocks of rooms between corridors, whose crossings form loops and dead ends."""

from __future__ import annotations

from itertools import pairwise
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

AREA_RANGE = (250.0, 3600.0)
"""Free area of an office, m2."""
VERTEX_RANGE = (120, 1000)
"""Vertices of an office."""
_DOORS = (850, 900, 900, 950, 1000)
_DOUBLE_DOORS = (1200, 1400, 1600)


def draw_office(rng: np.random.Generator, name: str, meta: dict[str, Any]) -> FloorPlan | None:
    """One office floor, or None if the draw failed."""
    thickness = 2 * int(rng.integers(50, 110))
    cells = _floor(rng)
    built = build(rng, cells, thickness)
    if built is None:
        return None
    free, obstacles = built
    plan = finish(free, obstacles, name, meta)
    return within(plan, AREA_RANGE, VERTEX_RANGE)


def build(rng: np.random.Generator, cells: list[Cell], thickness: int) -> tuple[Any, list[Any]] | None:
    """Free space and obstacles (shapely, mm) of corridors and rooms; None if some room cannot be reached."""
    openings = _openings(rng, cells, thickness)
    if openings is None:
        return None
    cells, doors, merged = openings
    rooms = [inner_box(c, thickness) for c in cells]
    furnished = rng.random() < 0.5
    obstacles = _obstacles(rng, cells, rooms, doors, merged, furnished)
    return union_of([*rooms, *doors, *merged]), obstacles


def _floor(rng: np.random.Generator) -> list[Cell]:
    """Corridors along x and y; the blocks between them hold rooms, open plans, courtyards, or are left out."""
    along = int(rng.choice([1, 2, 2, 2, 3]))
    across = int(rng.choice([0, 1, 2])) if along == 1 else int(rng.choice([1, 2, 2, 3, 3]))
    depths = _bands(rng, along, (380, 700), (700, 1600))
    # With one corridor only, the building is a bar; cross corridors at the ends keep a row of rooms beyond.
    widths = _bands(rng, across, (450, 1400), (1000, 2600)) if across else [int(rng.integers(2000, 7000)) * 10]
    xs, ys = np.concatenate([[0], np.cumsum(widths)]), np.concatenate([[0], np.cumsum(depths)])
    dropped = _dropped(rng, len(xs) // 2, len(ys) // 2)
    cells: list[Cell] = []
    for i in range(len(widths)):
        for j in range(len(depths)):
            box = int(xs[i]), int(ys[j]), int(xs[i + 1]), int(ys[j + 1])
            if i % 2 or j % 2:
                if _serves(i, j, len(widths), len(depths), dropped):
                    cells.append(Cell(box, "corridor"))
            elif (i // 2, j // 2) not in dropped:
                inner = 0 < i < len(widths) - 1 and 0 < j < len(depths) - 1
                sides = i > 0, j > 0, i < len(widths) - 1, j < len(depths) - 1
                cells += _block(rng, box, sides, inner)
    return cells


def _bands(rng: np.random.Generator, corridors: int, outer: tuple[int, int], inner: tuple[int, int]) -> list[int]:
    """Alternating depths of blocks and corridors, mm; ranges in cm."""
    bands = []
    for k in range(2 * corridors + 1):
        if k % 2:
            bands.append(int(rng.integers(150, 260)) * 10)
        else:
            bands.append(int(rng.integers(*(outer if k in (0, 2 * corridors) else inner))) * 10)
    return bands


def _dropped(rng: np.random.Generator, columns: int, rows: int) -> set[tuple[int, int]]:
    """Corner blocks that are left out, so that the outline is not a rectangle."""
    if columns < 1 or rows < 1:
        return set()
    corners = [(0, 0), (columns, 0), (0, rows), (columns, rows)]
    count = int(rng.choice([0, 0, 1, 1, 2]))
    return {corners[int(k)] for k in rng.permutation(4)[:count]}


def _serves(i: int, j: int, columns: int, rows: int, dropped: set[tuple[int, int]]) -> bool:
    """Whether a corridor piece has a block beside it or joins other pieces."""
    if i % 2 and j % 2:
        return True
    sides = [(i, j - 1), (i, j + 1)] if j % 2 else [(i - 1, j), (i + 1, j)]
    return any((a // 2, b // 2) not in dropped for a, b in sides if 0 <= a < columns and 0 <= b < rows)


def _block(rng: np.random.Generator, box: Box, sides: tuple[bool, bool, bool, bool], inner: bool) -> list[Cell]:
    """The rooms of a block; `sides` says where a corridor runs: left, below, right, above."""
    x0, y0, x1, y1 = _set_back(rng, box, sides)
    box = x0, y0, x1, y1
    width, depth = x1 - x0, y1 - y0
    use = rng.random()
    if inner and width * depth > 60e6 and use < 0.2:
        return []  # A courtyard or a core of shafts.
    if width * depth > 90e6 and use < 0.35:
        return [Cell(box, "open")]
    # Rooms stand in a row along a corridor; a deep block has two rows, back to back.
    along_x = (sides[1] or sides[3]) and (width >= depth or not (sides[0] or sides[2]))
    both = (sides[1] and sides[3]) if along_x else (sides[0] and sides[2])
    across = depth if along_x else width
    length = width if along_x else depth
    cuts = [0, across]
    if across > 7600 and (both or across > 9500):
        cuts.insert(1, int(across * rng.uniform(0.4, 0.6)))
    cells = []
    for low, high in pairwise(cuts):
        for start, end in room_row(rng, length, high - low):
            for a, b in _in_depth(rng, start, end, low, high):
                part = (start, a, end, b) if along_x else (a, start, b, end)
                cells.append(Cell((x0 + part[0], y0 + part[1], x0 + part[2], y0 + part[3])))
    return cells


def _set_back(rng: np.random.Generator, box: Box, sides: tuple[bool, bool, bool, bool]) -> Box:
    """Move an outer wall of the block inwards now and then, so that the outline has steps."""
    bounds = list(box)
    for k in range(4):
        extent = bounds[2 + k % 2] - bounds[k % 2]
        if not sides[k] and extent > 4200 and rng.random() < 0.35:
            step = int(extent * rng.uniform(0.05, 0.2)) // 10 * 10
            bounds[k] += step if k < 2 else -step
    return bounds[0], bounds[1], bounds[2], bounds[3]


def room_row(rng: np.random.Generator, length: int, depth: int) -> list[tuple[int, int]]:
    """Cut a row of rooms: cell offices of one width, mixed widths, or large rooms."""
    style = rng.random()
    module = int(rng.integers(260, 400)) * 10
    parts, x = [], 0
    while x < length:
        if style < 0.35:
            step = module * int(rng.choice([1, 1, 1, 2]))
        elif style < 0.7:
            step = int(np.clip(rng.lognormal(np.log(4600), 0.4), 2400, 11000))
        else:
            step = int(rng.integers(600, 1100)) * 10
        end = length if length - x - step < 2400 else x + step
        parts.append((x, end))
        x = end
    return parts


def _in_depth(rng: np.random.Generator, start: int, end: int, low: int, high: int) -> list[tuple[int, int]]:
    """Sometimes a room has another one behind it: an anteroom, a store, a bath."""
    if high - low > 5200 and end - start < 6000 and rng.random() < 0.2:
        cut = low + int((high - low) * rng.uniform(0.4, 0.6))
        return [(low, cut), (cut, high)]
    return [(low, high)]


def _openings(
    rng: np.random.Generator, cells: list[Cell], thickness: int
) -> tuple[list[Cell], list[Box], list[Box]] | None:
    """The cells that can be reached, their doors, and open passages; the other rooms stay solid.

    None if the corridors are not connected.
    """
    walls = shared_walls(cells, thickness + 1050)
    hub = next(i for i, c in enumerate(cells) if c.kind == "corridor")
    corridor_walls = [w for w in walls if cells[w.a].kind == cells[w.b].kind == "corridor"]
    doors: list[Box] = []
    merged: list[Box] = []
    for wall in corridor_walls:
        # Now and then a fire door.
        if rng.random() < 0.1:
            doors.append(_centred(wall, min(1600, (wall.length - thickness - 200) // 10 * 10), thickness))
        else:
            merged.append(open_wall(wall, thickness))

    def cost(a: Cell, b: Cell) -> float:
        if a.kind == b.kind == "corridor":
            return -2.0
        return 0.0 if a.kind == "corridor" else 1.0 if a.kind == "open" else 2.0

    tree = [w for w in spanning_walls(rng, cells, walls, hub, cost) if w not in corridor_walls]
    reached = {hub, *(k for w in (*tree, *corridor_walls) for k in (w.a, w.b))}
    if any(c.kind == "corridor" and i not in reached for i, c in enumerate(cells)):
        return None
    for wall in tree:
        doors.append(_door(rng, wall, cells, thickness))
    for wall in walls:
        if wall in tree or wall in corridor_walls or wall.a not in reached:
            continue
        kinds = cells[wall.a].kind, cells[wall.b].kind
        large = max(cells[wall.a].area, cells[wall.b].area) > 45
        chance = (0.7 if large else 0.05) if "corridor" in kinds else 0.05
        if rng.random() < chance:
            doors.append(_door(rng, wall, cells, thickness))
    return [c for i, c in enumerate(cells) if i in reached], doors, merged


def _door(rng: np.random.Generator, wall: Wall, cells: list[Cell], thickness: int) -> Box:
    large = max(c.area for c in (cells[wall.a], cells[wall.b]) if c.kind != "corridor") > 35
    double = large and wall.length > 2600 and rng.random() < 0.6
    width = int(rng.choice(_DOUBLE_DOORS if double else _DOORS))
    return place_door(rng, wall, width, thickness)


def _centred(wall: Wall, width: int, thickness: int) -> Box:
    start = (wall.low + wall.high - width) // 2
    near, far = wall.position - thickness // 2, wall.position + thickness // 2
    return (near, start, far, start + width) if wall.vertical else (start, near, start + width, far)


def _obstacles(
    rng: np.random.Generator,
    cells: list[Cell],
    rooms: list[Box],
    doors: list[Box],
    merged: list[Box],
    furnished: bool,
) -> list[Any]:
    """Columns in large rooms, pilasters on their walls, desks and cupboards."""
    keep_out = [furniture.grow(b, 700) for b in (*doors, *merged)]
    column = int(rng.integers(25, 60)) * 10
    pitch = int(rng.integers(400, 700)) * 10
    pilasters = rng.random() < 0.35
    bevelled = float(rng.choice([0.0, 0.2, 0.5]))
    items: list[Any] = []
    for cell, room in zip(cells, rooms, strict=True):
        near = [k for k in keep_out if furniture.overlap(k, room)]
        if cell.kind == "corridor":
            if min(room[2] - room[0], room[3] - room[1]) > 1900 and rng.random() < 0.25:
                lockers = furniture.along_walls(rng, room, [(int(rng.integers(8, 24)) * 100, 400)], near)
                items += [shapely.box(*b) for b in lockers]
            continue
        placed: list[Box] = []
        if cell.kind == "open" or cell.area > 70:
            if furnished and rng.random() < 0.6:
                placed = furniture.grid(room, 1600, int(rng.choice([1600, 3200])), 1600, 1500, near)
            else:
                placed = furniture.grid(room, column, column, pitch, pitch, near)
        elif furnished and cell.area > 20 and rng.random() < 0.4:
            table = (int(rng.integers(16, 40)) * 100, int(rng.integers(9, 14)) * 100)
            width, depth = table if cell.width > cell.depth else table[::-1]
            box = furniture.free_standing(rng, room, width, depth, near, centred=True)
            placed = [] if box is None else [box]
        if furnished and rng.random() < 0.7:
            sizes = [((1600, 800), (1800, 900), (1000, 450), (800, 400))[int(k)] for k in rng.integers(4, size=2)]
            placed += furniture.along_walls(rng, room, sizes, [*near, *(furniture.grow(p, 750) for p in placed)])
        elif pilasters and cell.area > 12:
            blocked = [*near, *(furniture.grow(p, 750) for p in placed)]
            placed += furniture.along_walls(rng, room, [(column, 200)] * 2, blocked, tries=2)
        items += [furniture.outline(rng, b, room, bevelled) for b in placed]
    return items
