"""Merging a scan into the line map: association, fusion, intervals of wall on a line, fragments."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from polyexplore_gym.mapping.fit import (
    by_pose,
    difference,
    distance2,
    distance2_shared,
    fuse,
    lever,
    product,
    to_map,
    wrap,
)
from polyexplore_gym.mapping.grid import Grid, grid_query
from polyexplore_gym.mapping.slots import (
    MEMORY,
    Lines,
    Rows,
    Slots,
    carry,
    facing,
    feed,
    free_line,
    free_row,
    new_row,
    oriented,
    oriented_shared,
    publish,
    store,
    told_apart,
    unlink,
)

MAX_TURN = 0.5  # rad; lines that differ more in direction are not compared
STANDS_FOR = 0.5  # rad; a segment facing farther away does not stand for another: short walls at corners stay
# Shares of a door's width:
COVER = 0.08  # what lies within this + 3 sigma of a known segment is known
BRIDGE = 0.2  # pieces of one line are joined across this + 3 sigma, at most half a door
LEAST_PIECE = 0.02  # shorter pieces on a line are widened to this
LEAST_END = 0.01  # smallest standard deviation kept for a segment's end along its line
CLOSE_LOOK = 0.1  # how densely it is looked at what of a segment is known


@njit(cache=True)
def within(px: float, py: float, s: np.ndarray, reach: float) -> bool:
    """Whether a point lies so near to segment s, or nearer."""
    dx, dy = s[2] - s[0], s[3] - s[1]
    q = dx * dx + dy * dy
    t = 0.0 if q == 0.0 else min(max(((px - s[0]) * dx + (py - s[1]) * dy) / q, 0.0), 1.0)
    ex, ey = px - s[0] - t * dx, py - s[1] - t * dy
    return ex * ex + ey * ey <= reach * reach


@njit(cache=True)
def across(alpha: float, p: np.ndarray, s: np.ndarray) -> float:
    """Standard deviation of the line across its direction at the middle of segment s, m."""
    h = 0.5 * ((s[0] + s[2]) * math.sin(alpha) - (s[1] + s[3]) * math.cos(alpha))
    return math.sqrt(max(p[1, 1] + 2.0 * h * p[0, 1] + h * h * p[0, 0], 0.0))


@njit(cache=True)
def clip(s: np.ndarray, a: float, b: float) -> None:
    """Keep the part of segment s from share a to share b of its length."""
    x, y, dx, dy = s[0], s[1], s[2] - s[0], s[3] - s[1]
    s[0], s[1], s[2], s[3] = x + a * dx, y + a * dy, x + b * dx, y + b * dy


@njit(cache=True)
def interval_gap(s: np.ndarray, r: np.ndarray, ux: float, uy: float) -> float:
    """Gap between two segments along the direction u, m; negative where they overlap."""
    a, b = s[0] * ux + s[1] * uy, s[2] * ux + s[3] * uy
    c, d = r[0] * ux + r[1] * uy, r[2] * ux + r[3] * uy
    return max(min(c, d) - max(a, b), min(a, b) - max(c, d))


@njit(cache=True)
def box_query(grid: Grid, s: np.ndarray, margin: float, out: np.ndarray) -> int:
    return grid_query(
        grid,
        min(s[0], s[2]) - margin,
        min(s[1], s[3]) - margin,
        max(s[0], s[2]) + margin,
        max(s[1], s[3]) + margin,
        out,
    )


@njit(cache=True)
def candidates(
    rho: float,
    alpha: float,
    p: np.ndarray,
    segments: np.ndarray,
    of: np.ndarray,
    i: int,
    rows: Rows,
    lines: Lines,
    grid: Grid,
    gate: float,
    door: float,
    stamp: int,
    own: int,
    seen_by: np.ndarray,
    drifting: bool,
    found: np.ndarray,
    out: np.ndarray,
) -> tuple[int, bool]:
    """Map lines that pass the merge test with new line i (map frame): the best first.

    seen_by (2, 3): K of the new line; with `drifting` lines may share an error with the pose that it was seen from.
    Each row of `out` is line slot, d2, x, y of the middle between the pieces compared. What another line of the
    scan feeds (in insert `stamp`) is left out, but for `own`. Returns their number, and whether it is clear which
    one it is: not so if a scan told the best and another one apart.
    """
    ux, uy = -math.sin(alpha), math.cos(alpha)
    count = 0
    for k in range(of.size):
        if of[k] != i:
            continue
        s = segments[k]
        for q in range(box_query(grid, s, door, found)):
            row = found[q]
            j = rows.line[row]
            if j < 0 or (lines.fed[j, stamp % MEMORY] == stamp and j != own):
                continue
            r = rows.segments[row]
            if abs(wrap(alpha - facing(lines, j))) > MAX_TURN or interval_gap(s, r, ux, uy) >= door:
                continue
            known = False
            for c in range(count):
                known = known or out[c, 0] == j
            if known or count == out.shape[0]:
                continue
            rho_j, alpha_j, p_j = oriented(lines, j)
            x, y = 0.25 * (s[0] + s[2] + r[0] + r[2]), 0.25 * (s[1] + s[3] + r[1] + r[3])
            if drifting:
                common = product(seen_by, oriented_shared(lines, j).T)
                d2 = distance2_shared(rho, alpha, p, rho_j, alpha_j, p_j, common, x, y)
            else:
                d2 = distance2(rho, alpha, p, rho_j, alpha_j, p_j, x, y)
            if d2 < gate:
                at = count
                while at > 0 and (out[at - 1, 1] > d2 or (out[at - 1, 1] == d2 and out[at - 1, 0] > j)):
                    out[at] = out[at - 1]
                    at -= 1
                out[at, 0], out[at, 1], out[at, 2], out[at, 3] = j, d2, x, y
                count += 1
    clear = True
    for c in range(1, count):
        clear = clear and not told_apart(lines, int(out[0, 0]), int(out[c, 0]))
    return count, clear


@njit(cache=True)
def fused_end(old: float, v_old: float, new: float, v_new: float, outward: float, door: float) -> tuple[float, float]:
    """End of a segment from two sightings: their mean where they agree, else the outer one.

    The mere maximum would grow by noise with every scan and close doorways.
    """
    if (new - old) ** 2 <= 9.0 * (v_old + v_new):
        v = v_old * v_new / (v_old + v_new)
        return (old * v_new + new * v_old) / (v_old + v_new), max(v, (LEAST_END * door) ** 2)
    if (new - old) * outward > 0.0:
        return new, v_new
    return old, v_old


@njit(cache=True)
def lay(
    line: int,
    fresh: np.ndarray,
    n_fresh: int,
    rows: Rows,
    lines: Lines,
    grid: Grid,
    slots: Slots,
    door: float,
) -> None:
    """Lay the rows of a line, and fresh pieces (x1, y1, x2, y2, var1, var2), on the line; join what overlaps."""
    rho, alpha, p = oriented(lines, line)
    ca, sa = math.cos(alpha), math.sin(alpha)
    total = n_fresh
    row = lines.first[line]
    while row >= 0:
        total += 1
        row = rows.next[row]
    # low, high, var low, var high, row (-1 fresh, -2 absorbed)
    span = np.empty((total, 5))
    n = 0
    row = lines.first[line]
    while row >= 0:
        e = rows.ends[row]
        span[n, 0], span[n, 1] = e[1] * ca - e[0] * sa, e[3] * ca - e[2] * sa
        span[n, 2], span[n, 3], span[n, 4] = rows.end_variance[row, 0], rows.end_variance[row, 1], row
        n += 1
        row = rows.next[row]
    for k in range(n_fresh):
        f = fresh[k]
        low, high, v_low, v_high = f[1] * ca - f[0] * sa, f[3] * ca - f[2] * sa, f[4], f[5]
        keep, keep_at = -1, -1
        # pieces it meets, joined from the lowest row up
        met = True
        while met:
            met = False
            best = -1
            for q in range(n):
                if span[q, 4] == -2:
                    continue
                gap = max(span[q, 0] - high, low - span[q, 1])
                v = span[q, 2] + v_high if span[q, 0] > high else span[q, 3] + v_low
                if gap <= min(BRIDGE * door + 3.0 * math.sqrt(v), 0.5 * door) and (
                    best < 0 or span[q, 0] < span[best, 0]
                ):
                    best = q
            if best >= 0:
                met = True
                least, most = min(low, span[best, 0]), max(high, span[best, 1])
                low, v_low = fused_end(span[best, 0], span[best, 2], low, v_low, -1.0, door)
                high, v_high = fused_end(span[best, 1], span[best, 3], high, v_high, 1.0, door)
                if high <= low:  # apart, and their ends known so differently that the means cross
                    low, high = least, most
                if span[best, 4] >= 0:
                    if keep < 0:
                        keep = int(span[best, 4])
                    else:
                        free_row(rows, grid, slots, int(span[best, 4]))
                span[best, 4] = -2
                keep_at = best
        at = keep_at if keep_at >= 0 else n
        n = max(n, at + 1)
        span[at, 0], span[at, 1], span[at, 2], span[at, 3] = low, high, v_low, v_high
        span[at, 4] = keep
    lines.first[line] = -1
    for q in range(n - 1, -1, -1):
        if span[q, 4] == -2:
            continue
        row = int(span[q, 4])
        if row < 0:
            row = new_row(rows, slots)
        rows.line[row] = line
        rows.side[row] = lines.side[line]
        rows.next[row] = lines.first[line]
        lines.first[line] = row
        low, high = span[q, 0], span[q, 1]
        short = LEAST_PIECE * door - (high - low)
        if short > 0.0:
            low, high = low - 0.5 * short, high + 0.5 * short
        e = rows.ends[row]
        e[0], e[1] = rho * ca - low * sa, rho * sa + low * ca
        e[2], e[3] = rho * ca - high * sa, rho * sa + high * ca
        rows.end_variance[row, 0], rows.end_variance[row, 1] = span[q, 2], span[q, 3]
        rows.sigma[row] = across(alpha, p, e)
        publish(rows, grid, slots, row, door)


@njit(cache=True)
def clear_covered(
    line: int, rows: Rows, lines: Lines, grid: Grid, slots: Slots, sigma_range: float, door: float, found: np.ndarray
) -> None:
    """Remove fragments, and shorter segments that face the same way, that the line's changed rows cover."""
    alpha = facing(lines, line)
    row = lines.first[line]
    while row >= 0:
        w = rows.segments[row]
        fresh = rows.touched[row] == slots.counts[2]
        length = math.hypot(w[2] - w[0], w[3] - w[1])
        for q in range(box_query(grid, w, door, found) if fresh else 0):
            f = found[q]
            g = rows.segments[f]
            tolerance = COVER * door + 3.0 * rows.sigma[f]
            if rows.line[f] >= 0:
                if rows.line[f] == line or math.hypot(g[2] - g[0], g[3] - g[1]) > length:
                    continue
                if abs(wrap(alpha - facing(lines, rows.line[f]))) > STANDS_FOR:
                    continue
                tolerance = COVER * door + sigma_range + 3.0 * math.hypot(rows.sigma[f], rows.sigma[row])
            if within(g[0], g[1], w, tolerance) and within(g[2], g[3], w, tolerance):
                if rows.line[f] >= 0:
                    unlink(rows, lines, slots, f)
                free_row(rows, grid, slots, f)
        row = rows.next[row]


@njit(cache=True)
def covered(
    s: np.ndarray, sigma: float, side_alpha: float, any_side: bool, rows: Rows, lines: Lines, grid: Grid, stamp: int,
    sigma_range: float, door: float, found: np.ndarray,
) -> tuple[float, float]:  # fmt: skip
    """The part of segment s not within `COVER` + 3 sigma of known segments, from share a to share b; a >= b if none.

    It is looked at every tenth of a door or less; a part seen at one place only reaches half way to the next.
    Rows touched first in insert `stamp` that are fragments do not count: they come from the same scan.
    With any_side False only rows that face the same way (normal direction side_alpha) count.
    """
    tolerance = COVER * door + 3.0 * sigma
    n = 0
    for q in range(box_query(grid, s, tolerance + door, found)):
        row = found[q]
        j = rows.line[row]
        if any_side:
            counts = j >= 0 or rows.touched[row] != stamp
        else:
            counts = j >= 0 and abs(wrap(facing(lines, j) - side_alpha)) <= STANDS_FOR
        if counts:
            found[n] = row
            n += 1
    length = math.hypot(s[2] - s[0], s[3] - s[1])
    steps = max(1, math.ceil(length / (CLOSE_LOOK * door)))
    first, last = 2.0, -1.0
    for i in range(steps + 1):
        t = i / steps
        px, py = s[0] + t * (s[2] - s[0]), s[1] + t * (s[3] - s[1])
        hit = False
        for q in range(n):
            row = found[q]
            reach = tolerance if any_side else COVER * door + sigma_range + 3.0 * math.hypot(sigma, rows.sigma[row])
            if within(px, py, rows.segments[row], reach):
                hit = True
                break
        if not hit:
            first, last = min(first, t), max(last, t)
    if first == last:
        first, last = max(first - 0.5 / steps, 0.0), min(last + 0.5 / steps, 1.0)
    return first, last


@njit(cache=True)
def extent(segments: np.ndarray, of: np.ndarray, i: int, alpha: float) -> tuple[float, float]:
    """Where the pieces of line i begin and end along the line of normal alpha, m."""
    ca, sa = math.cos(alpha), math.sin(alpha)
    low, high = math.inf, -math.inf
    for k in range(of.size):
        if of[k] == i:
            for e in range(0, 4, 2):
                t = segments[k, e + 1] * ca - segments[k, e] * sa
                low, high = min(low, t), max(high, t)
    return low, high


@njit(cache=True)
def sensitivity(s: np.ndarray, length: float) -> float:
    """By how much an unevenness of 1 m2 makes the expected chi-square of a difference with covariance s larger."""
    return (12.0 / (length * length) * s[1, 1] + s[0, 0]) / (s[0, 0] * s[1, 1] - s[0, 1] * s[0, 1])


@njit(cache=True)
def unevenness(misfit: np.ndarray, gate: float, least: float) -> float:
    """Variance of walls about the line that they were fused to, m2: that of `least` m, unless the scans disagree by
    more.

    A random-effects model: what a scan shows of a line of length l is off it by tau across and by tau sqrt(12) / l in
    direction, anew for every wall or place, beside the noise. Estimated by moments from the chi-squares Q of the n
    fusions, as DerSimonian and Laird do (Controlled Clinical Trials 7, 1986). Of those only what passed the gate is
    there, which lowers the mean of 2 by g q / (1 - q), q = exp(-g / 2).
    """
    q = math.exp(-0.5 * gate)
    excess = misfit[1] - misfit[0] * (2.0 - gate * q / (1.0 - q))
    return max(excess / misfit[2], least * least) if misfit[2] > 0.0 else least * least


@njit(cache=True)
def spread_out(line: int, variance: float, rows: Rows, lines: Lines) -> None:
    """Write `spread` of a line whose walls are uneven by variance, m2, about the middle of what is known of it."""
    alpha = lines.alpha[line]
    ca, sa = math.cos(alpha), math.sin(alpha)
    low, high = math.inf, -math.inf
    row = lines.first[line]
    while row >= 0:
        e = rows.ends[row]
        a, b = e[1] * ca - e[0] * sa, e[3] * ca - e[2] * sa
        low, high = min(low, a, b), max(high, a, b)
        row = rows.next[row]
    middle = 0.5 * (low + high)
    t = lever(alpha, middle * sa, -middle * ca)  # from the middle back to the origin
    local = np.zeros((2, 2))
    local[0, 0], local[1, 1] = 12.0 * variance / (high - low) ** 2, variance
    lines.spread[line] = product(product(t, local), t.T)


@njit(cache=True)
def fused_in_scan(
    i: int, j: int, segments: np.ndarray, of: np.ndarray, rho: np.ndarray, alpha: np.ndarray, covariance: np.ndarray,
    gate: float,
) -> bool:  # fmt: skip
    """Make line i of a scan of lines i and j, in the scan's frame, if they pass the merge test; whether they did."""
    x, y, pieces = 0.0, 0.0, 0
    for k in range(of.size):
        if of[k] == i or of[k] == j:
            x += 0.5 * (segments[k, 0] + segments[k, 2])
            y += 0.5 * (segments[k, 1] + segments[k, 3])
            pieces += 1
    x, y = x / pieces, y / pieces
    if distance2(rho[i], alpha[i], covariance[i], rho[j], alpha[j], covariance[j], x, y) >= gate:
        return False
    rho[i], alpha[i], covariance[i], _, _ = fuse(
        rho[i], alpha[i], covariance[i], rho[j], alpha[j], covariance[j], np.zeros((2, 2)), x, y
    )
    of[of == j] = i
    return True


@njit(cache=True)
def insert(
    rho: np.ndarray,
    alpha: np.ndarray,
    covariance: np.ndarray,
    segments: np.ndarray,
    segment_line: np.ndarray,
    fragments: np.ndarray,
    lone: np.ndarray,
    pose: np.ndarray,
    pose_covariance: np.ndarray,
    var_range: float,
    var_angle: float,
    gate: float,
    door: float,
    straightness: float,
    grouping: bool,
    drifting: bool,
    moved: np.ndarray,
    pose_information: np.ndarray,
    rows: Rows,
    lines: Lines,
    grid: Grid,
    slots: Slots,
) -> None:
    """Insert one scan's lines and fragments; the touched rows are left in `slots`.

    Without grouping the lines are taken one by one, as if each came from a scan of its own.
    With `drifting` the pose's error is that of the last insert, carried along the way `moved` (2,), and what the way
    added; pose_information (3, 3) is the (pseudo-)inverse of its covariance.
    """
    if drifting:
        carry(lines, moved[0], moved[1])
    slots.counts[2] += 1
    slots.counts[3] = 0
    stamp = slots.counts[2]
    sigma_range = math.sqrt(var_range)
    n = rho.size
    found = slots.found
    match = np.empty((32, 4))
    rho, alpha, covariance, of = rho.copy(), alpha.copy(), covariance.copy(), segment_line.copy()

    # ends in the map frame, with their variance along the line
    c, s = math.cos(pose[2]), math.sin(pose[2])
    placed = np.empty((segments.shape[0], 6))
    var_xy = 0.5 * (pose_covariance[0, 0] + pose_covariance[1, 1])
    for k in range(segments.shape[0]):
        ca, sa = math.cos(alpha[of[k]]), math.sin(alpha[of[k]])
        for e in range(2):
            x, y = segments[k, 2 * e], segments[k, 2 * e + 1]
            placed[k, 2 * e], placed[k, 2 * e + 1] = pose[0] + c * x - s * y, pose[1] + s * x + c * y
            d2 = x * x + y * y
            dc, psi = x * ca + y * sa, x * sa - y * ca
            v_normal = var_range * dc * dc / d2 + var_angle * psi * psi
            v = var_range * var_angle * d2 / v_normal + var_xy + pose_covariance[2, 2] * d2
            placed[k, 4 + e] = max(v, (LEAST_END * door) ** 2)

    # Lines of one scan share its pose error: those that meet one map line merge in the scan's own frame; of those that
    # the scan tells apart the nearest has it, the others take the next that they pass with.
    best = np.full(n, -1 if grouping else 0, np.int64)
    score = np.full(n, math.inf)
    for first in range(n if grouping else 0):
        i = first
        while i >= 0:
            r0, a0, p0 = to_map(rho[i], alpha[i], covariance[i], pose, pose_covariance)
            count, clear = candidates(
                r0, a0, p0, placed, of, i, rows, lines, grid, gate, door, stamp, -1, by_pose(a0, pose), drifting,
                found, match,
            )  # fmt: skip
            looking, i = i, -1
            for q in range(count if clear else 0):
                j, d2 = int(match[q, 0]), match[q, 1]
                holder = -1
                for k in range(n):
                    if best[k] == j:
                        holder = k
                if holder >= 0 and fused_in_scan(holder, looking, segments, of, rho, alpha, covariance, gate):
                    best[looking] = -2
                    break
                if holder < 0 or d2 < score[holder]:
                    best[looking], score[looking] = j, d2
                    if holder >= 0:
                        best[holder], i = -1, holder
                    break
    for i in range(n if grouping else 0):
        if best[i] >= 0:
            feed(lines, best[i], stamp)

    fresh = np.empty((segments.shape[0], 6))
    for i in range(n):
        if best[i] == -2:
            continue
        r0, a0, p0 = to_map(rho[i], alpha[i], covariance[i], pose, pose_covariance)
        seen_by = by_pose(a0, pose)
        c0 = product(seen_by, pose_covariance) if drifting else np.zeros((2, 3))
        low, high = extent(placed[:, :4], of, i, a0)
        middle = 0.5 * (low + high)
        own_x, own_y = r0 * math.cos(a0) - middle * math.sin(a0), r0 * math.sin(a0) + middle * math.cos(a0)
        misfit = np.zeros(3)
        target, count = -1, 0
        if best[i] >= 0:
            count, _ = candidates(
                r0, a0, p0, placed, of, i, rows, lines, grid, gate, door, stamp, best[i], seen_by, drifting,
                found, match,
            )  # fmt: skip
        for q in range(count):
            j = int(match[q, 0])
            rho_j, alpha_j, p_j = oriented(lines, j)
            c_j = oriented_shared(lines, j)
            x, y = match[q, 2], match[q, 3]
            if target < 0:
                common, d2 = product(seen_by, c_j.T), match[q, 1]
                target = j
            else:
                # what two lines of the map share they share by the pose, as far as is known
                common = product(product(c0, pose_information), c_j.T)
                d2 = distance2_shared(r0, a0, p0, rho_j, alpha_j, p_j, common, x, y)
                if told_apart(lines, target, j) or not d2 < gate:
                    continue
                lines.fed[target] = np.maximum(lines.fed[target], lines.fed[j])
            misfit += lines.misfit[j]
            misfit[0] += 1.0
            misfit[1] += d2
            misfit[2] += sensitivity(difference(a0, p0, alpha_j, p_j, common, own_x, own_y), high - low)
            r0, a0, p0, old, new = fuse(r0, a0, p0, rho_j, alpha_j, p_j, common, x, y)
            c0 = product(old, c0) + product(new, c_j)
            if j != target:
                free_line(lines, slots, j)
                # its rows become fresh pieces of the target below
                row = lines.first[j]
                while row >= 0:
                    after = rows.next[row]
                    rows.next[row] = lines.first[target]
                    lines.first[target] = row
                    row = after
                lines.first[j] = -1
        m = 0
        for k in range(of.size):
            if of[k] != i:
                continue
            fresh[m] = placed[k]
            if target < 0:
                # a wall known already, but not within the gate: only what is new of it
                sigma = across(a0, p0, placed[k])
                a, b = covered(placed[k, :4], sigma, a0, False, rows, lines, grid, stamp, sigma_range, door, found)
                if a >= b:
                    continue
                clip(fresh[m], a, b)
            m += 1
        if m == 0:
            continue
        if target < 0:
            slots.counts[1] -= 1
            target = slots.lines[slots.counts[1]]
            lines.alive[target] = True
            lines.first[target] = -1
            lines.fed[target] = 0
            if grouping:
                feed(lines, target, stamp)
                for k in range(i + 1, n):  # a slot freed a moment ago
                    if best[k] == target:
                        best[k] = -1
            lines.born[target] = stamp
        store(lines, target, r0, a0, p0, c0)
        lay(target, fresh, m, rows, lines, grid, slots, door)
        lines.misfit[target] = misfit
        spread_out(target, unevenness(misfit, gate, straightness), rows, lines)
        clear_covered(target, rows, lines, grid, slots, sigma_range, door, found)

    piece = np.empty(4)
    for k in range(fragments.shape[0]):
        d2 = 0.0
        for e in range(2):
            x, y = fragments[k, 2 * e], fragments[k, 2 * e + 1]
            piece[2 * e], piece[2 * e + 1] = pose[0] + c * x - s * y, pose[1] + s * x + c * y
            d2 = max(d2, x * x + y * y)
        sigma = math.sqrt(var_range + var_xy + (var_angle + pose_covariance[2, 2]) * d2)
        a, b = covered(piece, sigma, 0.0, True, rows, lines, grid, stamp, sigma_range, door, found)
        if a >= b:
            continue
        row = new_row(rows, slots)
        rows.line[row], rows.side[row], rows.next[row], rows.sigma[row] = -1, 0, -1, sigma
        if lone[k]:
            rows.lone[row] = (0.5 - a) / (b - a)
        clip(piece, a, b)
        rows.ends[row] = piece
        rows.end_variance[row] = sigma * sigma
        publish(rows, grid, slots, row, door)
