"""Do generated floor plans resemble real ones? One table, measured by the same code on both.

    python benchmarks/plan_statistics.py [--plans FOLDER] [--count N] [--plot FILE]

FOLDER holds plan JSON files with `meta.kind`; default: `floorplans` under $POLYEXPLORE_DATA, or
../shared/data/floorplans beside the checkout. Without it, only generated plans are shown.

No labels are used. A plan is rastered at 5 cm; rooms are the basins of its distance transform (flooded from
the widest places down, as in a watershed): two basins stay apart if the neck between them is narrower than
both by a factor of 1.25, otherwise they are one room. Necks of 0.6 to 1.8 m are doors. Rooms and necks form a
graph: rooms with a single neck are dead ends, and its independent cycles are loops; holes of at least 4 m2 are
counted as well, since a loop that a robot drives needs one.
"""

from __future__ import annotations

import argparse
import math
import os
from pathlib import Path

import cv2
import numba
import numpy as np

from polyexplore_gym.floorplan import FAMILIES, FloorPlan, generate, load_plan

RESOLUTION = 0.05
CONTRAST = 1.25
MIN_PROMINENCE = 0.1
MIN_ROOM = 1.0
DOOR_WIDTHS = (0.6, 1.8)
LOOP_HOLE = 4.0
SUITES = {"home-test": 24, "angled-test": 12, "office-test": 12}
"""What studies of generated plans run on: so many of the first plans of these suites."""
GROUPS = {
    "home": ("home", "home-arena"),
    "office and lab": ("office", "lab"),
    "campus": ("campus", "carehome", "stage"),
    "school": ("school",),
}


def raster(plan: FloorPlan) -> np.ndarray:
    """Free pixels (h, w) of `RESOLUTION`, with a blocked border."""
    x0, y0, x1, y1 = plan.bounds
    shape = math.ceil((y1 - y0) / RESOLUTION) + 4, math.ceil((x1 - x0) / RESOLUTION) + 4
    image = np.zeros(shape, np.uint8)
    # OpenCV's integer coordinates are pixel centres; 8 fractional bits.
    rings = [np.rint(((ring - (x0, y0)) / RESOLUTION + 1.5) * 256).astype(np.int32) for ring in plan.rings]
    cv2.fillPoly(image, rings, 1, lineType=cv2.LINE_8, shift=8)
    # fillPoly also sets the outline's pixels: half of each lies in the wall.
    cv2.polylines(image, rings, True, 0, 1, cv2.LINE_8, shift=8)
    return image


@numba.njit
def flood(
    distance: np.ndarray, order: np.ndarray, contrast: float, prominence: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Basins of a distance map (h, w) flooded in `order` (flat indices, widest first).

    Returns labels (h, w), -1 where blocked; the basin each label was merged into (k,); and contacts
    (m, 3): two labels and the distance where they met.
    """
    h, w = distance.shape
    labels = np.full((h, w), -1, np.int64)
    parent = np.empty(len(order), np.int64)
    peak = np.empty(len(order), np.float64)
    count = 0
    contacts = []
    for flat in order:
        r, c = flat // w, flat % w
        d = distance[r, c]
        best = -1
        for dr in range(-1, 2):
            for dc in range(-1, 2):
                label = labels[r + dr, c + dc]
                if label < 0:
                    continue
                while parent[label] != label:
                    parent[label] = parent[parent[label]]
                    label = parent[label]
                if best < 0 or label == best:
                    best = label
                    continue
                low, high = (label, best) if peak[label] < peak[best] else (best, label)
                if peak[low] < contrast * d or peak[low] < d + prominence:
                    parent[low] = high
                    best = high
                else:
                    contacts.append((float(best), float(label), d))
        if best < 0:
            parent[count] = count
            peak[count] = d
            best = count
            count += 1
        labels[r, c] = best
    pairs = np.empty((len(contacts), 3))
    for i in range(len(contacts)):
        pairs[i, 0], pairs[i, 1], pairs[i, 2] = contacts[i]
    return labels, parent[:count], pairs


def rooms_and_necks(plan: FloorPlan) -> tuple[np.ndarray, np.ndarray]:
    """Areas of the rooms (k,), m2, and the necks between them (m, 3): two rooms and the width, m."""
    free = raster(plan)
    # From a pixel's centre to the nearest blocked pixel's edge.
    distance = (cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) - 0.5).clip(0) * RESOLUTION
    inside = np.flatnonzero(free)
    order = inside[np.argsort(-distance.ravel()[inside], kind="stable")]
    labels, parent, contacts = flood(distance.astype(np.float64), order, CONTRAST, MIN_PROMINENCE)
    root = parent.copy()
    while not np.array_equal(root, root[root]):
        root = root[root]
    names, areas = np.unique(root[labels[labels >= 0]], return_counts=True)
    areas = areas * RESOLUTION**2
    is_room = areas >= MIN_ROOM
    number = np.full(len(parent), -1)
    number[names[is_room]] = np.arange(is_room.sum())
    widest: dict[tuple[int, int], float] = {}
    for a, b, half in contacts:
        i, j = sorted((number[root[int(a)]], number[root[int(b)]]))
        if 0 <= i < j:
            widest[i, j] = max(widest.get((i, j), 0.0), 2 * half)
    necks = np.array([(i, j, width) for (i, j), width in sorted(widest.items())]).reshape(-1, 3)
    return areas[is_room], necks


def measure(plan: FloorPlan) -> dict[str, float]:
    """All statistics of one plan."""
    walls = plan.segments
    lengths = np.hypot(walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1])
    turns = []
    for ring in plan.rings:
        edge = np.roll(ring, -1, axis=0) - ring
        heading = np.arctan2(edge[:, 1], edge[:, 0])
        turns.append(np.abs(np.angle(np.exp(1j * (np.roll(heading, -1) - heading)))))
    turn = np.concatenate(turns)
    hole_areas = np.array([cv2.contourArea(hole.astype(np.float32)) for hole in plan.holes])
    areas, necks = rooms_and_necks(plan)
    doors = necks[(necks[:, 2] >= DOOR_WIDTHS[0]) & (necks[:, 2] <= DOOR_WIDTHS[1]), 2]
    degree = np.bincount(necks[:, :2].astype(int).ravel(), minlength=len(areas))
    return {
        "area, m2": plan.area,
        "vertices": plan.n_vertices,
        "vertices per 100 m2": 100 * plan.n_vertices / plan.area,
        "walls per area, m/m2": float(lengths.sum()) / plan.area,
        "right angles, share": float(np.mean(np.abs(turn - math.pi / 2) < math.radians(3))),
        "holes": len(plan.holes),
        f"holes >= {LOOP_HOLE:g} m2": int((hole_areas >= LOOP_HOLE).sum()),
        "rooms": len(areas),
        "area per room, m2": plan.area / max(len(areas), 1),
        "doors": len(doors),
        "door width, m": float(np.median(doors)) if len(doors) else math.nan,
        "dead ends per room": float(np.mean(degree <= 1)) if len(areas) else math.nan,
        "loops of the room graph": len(necks) - len(areas) + 1,
    }


def table(groups: dict[str, list[dict[str, float]]]) -> str:
    """Markdown: a row for each statistic, a column for each group; median (10 to 90 %)."""
    lines = ["| | " + " | ".join(f"{name} ({len(rows)})" for name, rows in groups.items()) + " |"]
    lines.append("|---" * (len(groups) + 1) + "|")
    for key in next(iter(groups.values()))[0]:
        cells = []
        for rows in groups.values():
            low, middle, high = np.nanpercentile([row[key] for row in rows], [10, 50, 90])
            cells.append(f"{_short(middle)} ({_short(low)} to {_short(high)})")
        lines.append(f"| {key} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _short(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 20 else f"{value:.2g}"


def default_folder() -> Path:
    """Where the shared plans lie, if they do."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    return Path(os.environ.get("POLYEXPLORE_DATA") or beside) / "floorplans"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plans", type=Path, default=default_folder(), help="folder of plan JSON files")
    parser.add_argument("--count", type=int, default=50, help="generated plans of each family")
    parser.add_argument("--plot", type=Path, help="also draw the empirical distributions into this file")
    arguments = parser.parse_args()
    shared = [load_plan(path) for path in sorted(arguments.plans.glob("*.json"))]
    groups: dict[str, list[dict[str, float]]] = {}
    for name, kinds in GROUPS.items():
        rows = [measure(plan) for plan in shared if plan.meta.get("kind") in kinds]
        if rows:
            groups[name] = rows
    for family in FAMILIES:
        groups[f"generated {family}"] = [measure(generate(family, seed)) for seed in range(arguments.count)]
    print(table(groups))
    if arguments.plot:
        plot(groups, arguments.plot)


def plot(groups: dict[str, list[dict[str, float]]], path: Path) -> None:
    """Empirical distribution functions, one panel for each statistic."""
    import matplotlib.pyplot as plt

    keys = list(next(iter(groups.values()))[0])
    figure, axes = plt.subplots(math.ceil(len(keys) / 4), 4, figsize=(16, 3 * math.ceil(len(keys) / 4)))
    for key, axis in zip(keys, axes.ravel(), strict=False):
        for name, rows in groups.items():
            values = np.sort([row[key] for row in rows if math.isfinite(row[key])])
            style = "-" if name.startswith("generated") else "--"
            axis.step(values, (np.arange(len(values)) + 1) / len(values), style, where="post", label=name)
        axis.set_xlabel(key)
    axes.ravel()[0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    main()
