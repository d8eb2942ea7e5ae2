"""Furniture and columns for the generators: boxes that leave doors free and the robot a way past."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from polyexplore_gym.floorplan.building import Box

PASSAGE = 750
"""Width kept free between furniture that does not touch, mm."""


def grow(box: Box, by: int) -> Box:
    """The box enlarged on all sides."""
    return box[0] - by, box[1] - by, box[2] + by, box[3] + by


def overlap(a: Box, b: Box) -> bool:
    """Whether two boxes share area."""
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def along_walls(
    rng: np.random.Generator, room: Box, sizes: Sequence[tuple[int, int]], keep_out: Sequence[Box], tries: int = 6
) -> list[Box]:
    """Pieces (length along the wall, depth) with their backs to the room's walls, often in corners."""
    placed: list[Box] = []
    for length, depth in sizes:
        for _ in range(tries):
            side = int(rng.integers(4))
            box = _against(rng, room, side, length, depth)
            if box is None or any(overlap(box, k) for k in keep_out):
                continue
            if any(overlap(grow(box, PASSAGE), p) for p in placed):
                continue
            placed.append(box)
            break
    return placed


def _against(rng: np.random.Generator, room: Box, side: int, length: int, depth: int) -> Box | None:
    x0, y0, x1, y1 = room
    along, across = (x1 - x0, y1 - y0) if side < 2 else (y1 - y0, x1 - x0)
    if along < length or across < depth + PASSAGE:
        return None
    spare = along - length
    offset = int(rng.integers(0, spare + 1))
    # No gap beside the piece that is too narrow to be of use.
    if offset < PASSAGE or rng.random() < 0.25:
        offset = 0
    elif spare - offset < PASSAGE:
        offset = spare
    if side == 0:
        return x0 + offset, y0, x0 + offset + length, y0 + depth
    if side == 1:
        return x0 + offset, y1 - depth, x0 + offset + length, y1
    if side == 2:
        return x0, y0 + offset, x0 + depth, y0 + offset + length
    return x1 - depth, y0 + offset, x1, y0 + offset + length


def free_standing(
    rng: np.random.Generator, room: Box, width: int, depth: int, keep_out: Sequence[Box], centred: bool = False
) -> Box | None:
    """A piece with a passage all round, in the room's middle if asked; None where there is no place."""
    x0, y0, x1, y1 = grow(room, -PASSAGE)
    if x1 - x0 < width or y1 - y0 < depth:
        return None
    for _ in range(1 if centred else 5):
        if centred:
            x, y = (x0 + x1 - width) // 2, (y0 + y1 - depth) // 2
        else:
            x, y = int(rng.integers(x0, x1 - width + 1)), int(rng.integers(y0, y1 - depth + 1))
        box = (x, y, x + width, y + depth)
        if not any(overlap(grow(box, PASSAGE), k) for k in keep_out):
            return box
    return None


def outline(rng: np.random.Generator, box: Box, room: Box, bevelled: float) -> shapely.Polygon:
    """The piece as a polygon; with probability `bevelled` a corner away from the room's walls is cut off."""
    x0, y0, x1, y1 = box
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    free = [k for k, (x, y) in enumerate(corners) if x not in (room[0], room[2]) and y not in (room[1], room[3])]
    if not free or rng.random() >= bevelled:
        return shapely.box(*box)
    k = free[int(rng.integers(len(free)))]
    dx, dy = (round(side * rng.uniform(0.3, 0.7)) for side in (x1 - x0, y1 - y0))
    x, y = corners[k]
    beside = x + dx if x == x0 else x - dx, y + dy if y == y0 else y - dy
    cut = [(x, beside[1]), (beside[0], y)] if k % 2 == 0 else [(beside[0], y), (x, beside[1])]
    return shapely.Polygon([*corners[:k], *cut, *corners[k + 1 :]])


def grid(room: Box, width: int, depth: int, aisle_x: int, aisle_y: int, keep_out: Sequence[Box]) -> list[Box]:
    """Equal pieces in rows and columns, centred in the room: desk islands, shelves or columns."""
    x0, y0, x1, y1 = grow(room, -max(PASSAGE, min(aisle_x, aisle_y) // 2))
    columns = (x1 - x0 + aisle_x) // (width + aisle_x)
    rows = (y1 - y0 + aisle_y) // (depth + aisle_y)
    if columns < 1 or rows < 1:
        return []
    left = (x0 + x1 - columns * width - (columns - 1) * aisle_x) // 2
    low = (y0 + y1 - rows * depth - (rows - 1) * aisle_y) // 2
    boxes = []
    for i in range(columns):
        for j in range(rows):
            x, y = left + i * (width + aisle_x), low + j * (depth + aisle_y)
            box = (x, y, x + width, y + depth)
            if not any(overlap(grow(box, PASSAGE), k) for k in keep_out):
                boxes.append(box)
    return boxes
