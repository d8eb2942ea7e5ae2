"""Accuracy at equal numbers of vertices, beside the six methods that Schaefer et al. compared (IROS 2018).

The data hold 240 real scans of twelve buildings, 160 simulated ones, and per scan what the authors published for VVL,
PLE, PLE+, IEF, SAM and VB at 10 to 50 vertices (VB: whatever it finds). A beam is explained if it meets an edge, RMSE
is that of the range of a scan's explained beams; neither means anything without the other. `both` is the RMSE with
0.5 m, PLE's own price, for each beam left out. An edge counts two vertices, one that it shares with the next counts
once. All figures are means and medians over scans; times are of one core. Ours:

- `lines`, `lines hough`: `extract_lines` with either start; of the segments of a scan, those with most returns, as
  many as the vertices allow. It is not made for this: what the noise does not explain as a wall is left out.
- `fine lines`: the same with the default start for any three returns on 5 cm, the noise of range taken as 3 cm.
- `polylines`: `extract_polylines` with so many vertices, edges over gaps of up to 1 m on real scans and over all on
  simulated ones, where every return is explained: as the authors ran PLE. Its one number of choice on real scans, the
  price of a return left out, keeps its default, which was chosen on these scans; the last table shows others.

Rays are cut with edges as in the authors' evaluation (0.001 rad beyond an edge still meet it, a later edge covers an
earlier one); `--tolerance 1e-9` lets beams meet edges only. The metric is checked first: our own iterative end-point
fit must reproduce the published one scan by scan, our own greedy removal the published PLE but for ties.

    python benchmarks/line_accuracy.py [--data FOLDER] [--out FILE.png] [--every 1] [--tolerance 1e-3]

FOLDER holds `laser_logs/ple_bench_dev.npz`; default: $POLYEXPLORE_DATA, or ../shared/data beside the checkout.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numba import njit

from polyexplore_gym.config import MappingConfig, SensorConfig
from polyexplore_gym.mapping import extract_lines, extract_polylines
from polyexplore_gym.mapping.borders import thin

BUDGETS = (10, 20, 30, 40, 50)
PRICE = 0.5
"""A beam left out counts like an error of so much in `both`, m."""
GAP = {"real": 1.0, "simulated": math.inf}
"""No edge joins neighbouring returns farther apart, m: as the authors set it."""
NOISE = {"real": (0.01, math.radians(0.1)), "simulated": (0.03, math.radians(0.2))}
"""Assumed (real) and true (simulated) standard deviations of range and angle, m and rad."""
ALL = 10.0
"""Price of a return that leaves none out of the simulated scans, m."""
PRICES = (0.1, 0.15, 0.2, 0.25, 0.3, 0.36, 0.42, 0.5, 0.7, 1.0)
FINE = MappingConfig(min_points=3, min_length=0.05, door_width=1.0, range_floor=0.03)


@dataclass
class Sample:
    """Scans of one kind: angles, ranges (inf without a return), building; what was published (scans, 6, budgets)."""

    kind: str
    scans: list[tuple[np.ndarray, np.ndarray]]
    building: np.ndarray
    rmse: np.ndarray
    share: np.ndarray


def load(file: Path, every: int) -> tuple[list[Sample], list[str]]:
    """The real and the simulated scans, and the names of the published methods."""
    with np.load(file) as data:
        d = dict(data)
    real = []
    for i in range(d["real_dataset"].size):
        rows = slice(d["real_offset"][i], d["real_offset"][i + 1])
        low, high = d["real_rlim"][i]
        ranges = d["real_range"][rows]
        real.append((d["real_azimuth"][rows], np.where((ranges >= low) & (ranges <= high), ranges, np.inf)))
    simulated = [(d["sim_azimuth"], ranges) for ranges in d["sim_range"]]
    samples = [
        Sample("real", real, d["real_dataset"], d["pub_real_rmse"], d["pub_real_f"]),
        Sample("simulated", simulated, np.full(len(simulated), ""), d["pub_sim_rmse"], d["pub_sim_f"]),
    ]
    for sample in samples:
        sample.scans = sample.scans[::every]
        sample.building = sample.building[::every]
        sample.rmse, sample.share = sample.rmse[::every], sample.share[::every]
    return samples, [str(name) for name in d["pub_methods"]]


@njit(cache=True)
def hit(segments: np.ndarray, angles: np.ndarray, tolerance: float) -> np.ndarray:
    """(n,) range at which each beam meets a segment, inf if none: the authors' evaluation (see above)."""
    out = np.full(angles.size, np.inf)
    for ax, ay, bx, by in segments:
        start = math.atan2(ay, ax)
        width = (math.atan2(by, bx) - start + math.pi) % (2 * math.pi) - math.pi
        sign = -1.0 if width < 0 else 1.0
        for k in range(angles.size):
            along = sign * ((angles[k] - start + math.pi) % (2 * math.pi) - math.pi)
            if -tolerance <= along <= abs(width) + tolerance:
                c, s = math.cos(angles[k]), math.sin(angles[k])
                across = c * (by - ay) - s * (bx - ax)
                r = (ax * (by - ay) - ay * (bx - ax)) / across if across != 0.0 else np.inf
                if 0.0 < r < np.inf:
                    out[k] = r
    return out


def score(segments: np.ndarray, angles: np.ndarray, ranges: np.ndarray, tolerance: float) -> tuple[float, float]:
    """RMSE of the explained beams, m (NaN if none), and their share of the beams with a return."""
    returned = np.isfinite(ranges)
    predicted = hit(np.ascontiguousarray(segments, np.float64), angles[returned], tolerance)
    explained = np.isfinite(predicted)
    if not explained.any():
        return math.nan, 0.0
    return float(np.sqrt(np.mean((ranges[returned] - predicted)[explained] ** 2))), float(explained.mean())


def both(rmse: np.ndarray, share: np.ndarray) -> np.ndarray:
    """RMSE over all returns with a fixed error for those left out, m."""
    return np.sqrt(share * np.nan_to_num(rmse) ** 2 + (1 - share) * PRICE**2)


def end_point_fit(angles: np.ndarray, ranges: np.ndarray, kind: str, budget: int) -> np.ndarray:
    """(E, 4) edges of IEF: all returns on one chord, split at the return farthest from its chord."""
    returned = np.isfinite(ranges)
    p = (ranges[returned] * np.array([np.cos(angles), np.sin(angles)])[:, returned]).T

    def farthest(a: int, b: int) -> tuple[float, int]:
        if b - a < 2:
            return -1.0, a
        u, d = p[b] - p[a], p[a + 1 : b] - p[a]
        length = math.hypot(*u)
        off = np.abs(d @ np.array([-u[1], u[0]])) / length if length > 0 else np.hypot(*d.T)
        return float(off.max()), a + 1 + int(off.argmax())

    chords = {(0, len(p) - 1): farthest(0, len(p) - 1)}
    while len(chords) + 1 < budget:
        (a, b), (off, k) = max(chords.items(), key=lambda item: item[1][0])
        if off < 0:
            break
        del chords[a, b]
        chords[a, k], chords[k, b] = farthest(a, k), farthest(k, b)
    at = np.array(sorted(chords))
    return np.hstack([p[at[:, 0]], p[at[:, 1]]])


def greedy_removal(angles: np.ndarray, ranges: np.ndarray, kind: str, budget: int) -> np.ndarray:
    """(E, 4) edges of PLE on a scan that does not close: returns taken out one by one, the least error first."""
    at = np.flatnonzero(np.isfinite(ranges))
    r = ranges[at]
    x, y = r * np.cos(angles[at]), r * np.sin(angles[at])
    run = np.r_[0, np.cumsum((np.diff(at) > 1) | (np.hypot(np.diff(x), np.diff(y)) > GAP[kind]))]
    kept = np.flatnonzero(thin(x, y, r, run, budget, budget, PRICE**2)[0])
    joined = run[kept[1:]] == run[kept[:-1]]
    a, b = kept[:-1][joined], kept[1:][joined]
    return np.c_[x[a], y[a], x[b], y[b]]


def sensor_of(kind: str, angles: np.ndarray) -> SensorConfig:
    """The sensor of a scan; readings beyond its range are inf already."""
    sigma_range, sigma_angle = NOISE[kind]
    view = 2 * math.pi if kind == "simulated" else math.pi
    return SensorConfig(
        beams=angles.size, field_of_view=view, max_range=1e3, sigma_range=sigma_range, sigma_angle=sigma_angle
    )


def lines_of(config: MappingConfig) -> Callable:
    """Method: of the segments of `extract_lines` those with most returns, for every number of vertices."""

    def method(angles: np.ndarray, ranges: np.ndarray, kind: str) -> tuple[list[np.ndarray], list[float]]:
        begin = time.thread_time()
        lines = extract_lines(angles, ranges, sensor_of(kind, angles), config)
        cost = time.thread_time() - begin
        returns = np.bincount(lines.point_segment[lines.point_segment >= 0], minlength=len(lines.segments))
        order = np.argsort(-returns, kind="stable")
        return [lines.segments[order[: budget // 2]] for budget in BUDGETS], [cost] * len(BUDGETS)

    return method


def polylines_of(price: float | None = None) -> Callable:
    """Method: `extract_polylines` for every number of vertices; a price of its own for returns of real scans."""

    def method(angles: np.ndarray, ranges: np.ndarray, kind: str) -> tuple[list[np.ndarray], list[float]]:
        sensor, found, costs = sensor_of(kind, angles), [], []
        options = {"miss": ALL} if kind == "simulated" else {} if price is None else {"miss": price}
        for budget in BUDGETS:
            begin = time.thread_time()
            lines = extract_polylines(angles, ranges, budget, sensor, max_gap=GAP[kind], **options)
            costs.append(time.thread_time() - begin)
            assert len(lines.vertices) <= budget
            found.append(lines.segments())
        return found, costs

    return method


def run(sample: Sample, method: Callable, tolerance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(scans, budgets) RMSE, share and seconds of one of our methods."""
    rmse, share, cost = (np.empty((len(sample.scans), len(BUDGETS))) for _ in range(3))
    for warm in (True, False):
        for i, (angles, ranges) in enumerate(sample.scans[: 1 if warm else None]):
            # the last simulated beam looks where the first does
            whole = slice(None, -1) if sample.kind == "simulated" else slice(None)
            found, cost[i] = method(angles[whole], ranges[whole], sample.kind)
            for j, segments in enumerate(found):
                rmse[i, j], share[i, j] = score(segments, angles, ranges, tolerance)
    return rmse, share, cost


def check(sample: Sample, names: list[str], tolerance: float) -> None:
    """Print how well methods of our own, in the metric of this script, reproduce what was published."""
    closes = sample.kind == "simulated"
    for name, method in ({"IEF": end_point_fit} | ({} if closes else {"PLE": greedy_removal})).items():
        m = names.index(name)
        ours = np.array([[score(method(*s, sample.kind, b), *s, tolerance) for b in BUDGETS] for s in sample.scans])
        off, miss = np.abs(ours[..., 0] - sample.rmse[:, m]), np.abs(ours[..., 1] - sample.share[:, m])
        print(
            f"  {name}: RMSE within 1 mm of the published on {100 * np.mean(off < 1e-3):.1f} % of scans and budgets "
            f"(mean {np.mean(off):.1e} m, largest {off.max():.1e}), share equal on {100 * np.mean(miss < 1e-9):.1f} %"
        )


def table(sample: Sample, names: list[str], ours: dict) -> None:
    """Print mean and median of RMSE, share and both, for every method and number of vertices."""
    rows = {name: (sample.rmse[:, m], sample.share[:, m], None) for m, name in enumerate(names)} | ours
    print(f"\n{len(sample.scans)} {sample.kind} scans, mean / median; {', '.join(map(str, BUDGETS))} vertices")
    for j, budget in enumerate(BUDGETS):
        print(f"  {budget} vertices{'':6s}RMSE, m            share explained    both, m            ms a scan")
        for name, (rmse, share, cost) in rows.items():
            figures = (rmse[:, j], share[:, j], both(rmse[:, j], share[:, j]))
            shown = "    ".join(f"{np.nanmean(f):6.4f} / {np.nanmedian(f):6.4f}" for f in figures)
            ms = "" if cost is None else f"{1e3 * cost[:, j].mean():.2f} / {1e3 * np.median(cost[:, j]):.2f}"
            print(f"    {name:14s}{shown}    {ms}")


def duel(sample: Sample, names: list[str], ours: tuple, other: str = "PLE+") -> None:
    """Print on how many scans, and in which buildings, `polylines` or the other is better in RMSE and share."""
    m = names.index(other)
    print(f"\npolylines against {other}, {sample.kind} scans; better: at least as good in RMSE and in share")
    for j, budget in enumerate(BUDGETS):
        rmse, share = ours[0][:, j], ours[1][:, j]
        theirs, explained = sample.rmse[:, m, j], sample.share[:, m, j]
        better = (rmse <= theirs) & (share >= explained - 1e-9)
        worse = (theirs <= rmse) & (explained >= share - 1e-9) & ~better
        buildings = [sample.building == name for name in np.unique(sample.building)]
        means = [(rmse[b].mean() <= theirs[b].mean(), share[b].mean() >= explained[b].mean()) for b in buildings]
        note = ""
        if len(means) > 1:
            note = f"; by its means better in {sum(map(all, means))} of {len(means)} buildings, "
            note += f"worse in {sum(not any(pair) for pair in means)}"
        print(
            f"  {budget} vertices: polylines better on {better.mean():.3f} of the scans, {other} {worse.mean():.3f}; "
            f"polylines as good in `both` on {np.mean(both(rmse, share) <= both(theirs, explained)):.3f}{note}"
        )
        for i in np.flatnonzero(worse)[np.argsort((theirs / rmse)[worse])][:2]:
            name = f"{i} {sample.building[i]}".strip()
            print(
                f"    {other} furthest ahead: scan {name}, RMSE {theirs[i]:.4f} to {rmse[i]:.4f} m, "
                f"share {explained[i]:.3f} to {share[i]:.3f}"
            )


def sweep(sample: Sample, names: list[str], tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """(prices, budgets) mean RMSE and share of `polylines` by price; prints them, and RMSE at the share of PLE+."""
    runs = [run(sample, polylines_of(price), tolerance) for price in PRICES]
    rmse, share = np.array([np.nanmean(r, 0) for r, _, _ in runs]), np.array([s.mean(0) for _, s, _ in runs])
    m = names.index("PLE+")
    theirs, explained = sample.rmse[:, m].mean(0), sample.share[:, m].mean(0)
    print("\nreal scans, `polylines` by the price of a return left out (`miss`, m): mean RMSE, m, at mean share")
    for label, errors, shares in [
        *zip(map("{:.2f}".format, PRICES), rmse, share, strict=True),
        ("PLE+", theirs, explained),
    ]:
        print(f"  {label}  " + "   ".join(f"{e:.4f} at {f:.3f}" for e, f in zip(errors, shares, strict=True)))
    equal = [np.interp(explained[j], share[:, j], rmse[:, j]) for j in range(len(BUDGETS))]
    shown = ", ".join(f"{e:.4f} ({e / t - 1:+.1%})" for e, t in zip(equal, theirs, strict=True))
    print(f"  ours at the mean share of PLE+, interpolated, and beside its RMSE: {shown}")
    return rmse, share


def draw(samples: list[Sample], names: list[str], ours: dict, prices: tuple, path: Path) -> None:
    """RMSE and share against vertices, real and simulated, and both against each other at equal vertices."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 3, figsize=(15, 8.5))
    colour = {name: f"C{i}" for i, name in enumerate(("polylines", "PLE+", "PLE", "VVL", "IEF", "SAM", "VB"))}
    colour |= {"lines": "0.2", "lines hough": "0.45", "fine lines": "0.65"}
    plane, key = axes[0, 2], axes[1, 2]
    for row, sample in enumerate(samples):
        curves = {n: (sample.rmse[:, m], sample.share[:, m]) for m, n in enumerate(names)}
        curves |= {n: figures[:2] for n, figures in ours[sample.kind].items()}
        for name in colour:
            rmse, share = np.nanmean(curves[name][0], 0), curves[name][1].mean(0)
            style = {"color": colour[name], "marker": "o", "ms": 4, "label": name, "lw": 1.2}
            if name not in names:
                style |= {"marker": "s", "lw": 2.5, "zorder": 5} if name == "polylines" else {"marker": "s", "ls": "--"}
            axes[row, 0].plot(BUDGETS, rmse, **style)
            axes[row, 1].plot(BUDGETS, share, **style)
            if row == 0 and name != "polylines":
                plane.plot(share[1::2], rmse[1::2], marker=style["marker"], color=colour[name], ls=":", lw=0.8)
        axes[row, 0].set(yscale="log", ylabel=f"mean RMSE along the beams, m\n{sample.kind} scans")
        axes[row, 1].set(ylabel="mean share of returns explained")
        for axis in axes[row, :2]:
            axis.set(xlabel="vertices", xticks=BUDGETS)
            axis.grid(alpha=0.3, which="both")
    for j, mark in ((1, "20 vertices"), (3, "40 vertices")):
        plane.plot(prices[1][:, j], prices[0][:, j], "-", color="C0", lw=2.5)
        plane.annotate(
            mark, (prices[1][0, j], prices[0][0, j]), xytext=(-4, -12), textcoords="offset points", ha="right"
        )
    plane.set(
        yscale="log",
        ylim=(0.015, 2.5),
        xlim=(0.58, 1.02),
        xlabel="mean share of returns explained",
        ylabel="mean RMSE along the beams, m",
    )
    plane.set_title("real scans: 20 and 40 vertices; polylines by price", fontsize=10)
    plane.grid(alpha=0.3, which="both")
    key.axis("off")
    key.legend(*axes[1, 0].get_legend_handles_labels(), loc="center", fontsize=11)
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("POLYEXPLORE_DATA") or beside))
    parser.add_argument("--out", type=Path, help="draw the figures to this file")
    parser.add_argument("--every", type=int, default=1, help="use every so many scans")
    parser.add_argument("--tolerance", type=float, default=1e-3, help="a beam so near beside an edge meets it, rad")
    options = parser.parse_args()
    file = options.data / "laser_logs" / "ple_bench_dev.npz"
    if not file.is_file():
        print(f"skipped: no {file.name} in {file.parent}; name the data folder by --data or $POLYEXPLORE_DATA")
        return
    samples, names = load(file, options.every)
    print("The metric on methods of our own that were published:")
    for sample in samples:
        print(f" {sample.kind} scans")
        check(sample, names, options.tolerance)
    ours: dict = {}
    for sample in samples:
        floor = MappingConfig(range_floor=NOISE[sample.kind][0])
        hough = MappingConfig(range_floor=NOISE[sample.kind][0], start="hough")
        methods = {"lines": lines_of(floor), "lines hough": lines_of(hough), "fine lines": lines_of(FINE)}
        methods["polylines"] = polylines_of()
        ours[sample.kind] = {name: run(sample, method, options.tolerance) for name, method in methods.items()}
        table(sample, names, ours[sample.kind])
    for sample in samples:
        duel(sample, names, ours[sample.kind]["polylines"])
    prices = sweep(samples[0], names, options.tolerance)
    if options.out:
        draw(samples, names, ours, prices, options.out)
        print(f"\nfigures: {options.out}")


if __name__ == "__main__":
    main()
