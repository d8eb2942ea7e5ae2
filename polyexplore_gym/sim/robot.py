"""The robot's disc body among walls: where it touches, how it slides, and its motion along a path without dynamics.

Kernels on arrays: walls (M, 4), points in metres. The distance from a point that moves straight to a wall
segment is convex in time, so a disc that starts clear of a wall meets it at most once, and one that
touches it and does not move closer never meets it again.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from polyexplore_gym.disc import enters, first_contact

STANDOFF = 0.004
"""How far from a wall a kinematic robot stops that would bump into it, in radii (1 mm at a radius of 0.25 m)."""
SKIN = 1e-7
"""A disc that slides keeps this far from walls, in radii, so that no rounding lets it overlap; nearer than twice as
far it touches."""
_ARC = 0.05
"""Round the end of a wall a disc slides in pieces of this length, in radii; it strays outwards by half its square."""
_STRAIGHT_ON = 0.02
"""A robot that glides at speed takes up a leg that turns by no more than this (rad) without braking."""
_ROUNDING = 1e-9
"""A leg whose end lies no farther than this (radii) from the straight line ahead needs no turn."""
ARRIVED, CUT, BUMP, TIME, LOST = range(5)
"""Why a drive ended."""
_PARALLEL = 1e-10
"""Sine of the angle to a wall below which a motion is along it: rounding, for walls up to 10 km from the origin."""


@njit(cache=True)
def nearest_wall(segments, x, y):  # type: ignore[no-untyped-def]
    """Distance from a point to the nearest wall, and the nearest point on it: (distance, px, py); inf without walls."""
    best, px, py = np.inf, x, y
    for k in range(segments.shape[0]):
        ax, ay = segments[k, 0], segments[k, 1]
        ex, ey = segments[k, 2] - ax, segments[k, 3] - ay
        length2 = ex * ex + ey * ey
        t = 0.0
        if length2 > 0.0:
            t = min(1.0, max(0.0, ((x - ax) * ex + (y - ay) * ey) / length2))
        qx, qy = ax + t * ex, ay + t * ey
        d2 = (qx - x) ** 2 + (qy - y) ** 2
        if d2 < best:
            best, px, py = d2, qx, qy
    return math.sqrt(best), px, py


@njit(cache=True)
def walls_near(segments, x_min, y_min, x_max, y_max):  # type: ignore[no-untyped-def]
    """Indices of the walls whose bounding box meets the given box."""
    out, n = np.empty(segments.shape[0], np.int64), 0
    for k in range(segments.shape[0]):
        x1, y1, x2, y2 = segments[k]
        if max(x1, x2) >= x_min and min(x1, x2) <= x_max and max(y1, y2) >= y_min and min(y1, y2) <= y_max:
            out[n] = k
            n += 1
    return out[:n]


@njit(cache=True)
def walls_around(segments, path, pose, margin):  # type: ignore[no-untyped-def]
    """A box (x, y min, x, y max) around a path (k, 2) and a pose, margin m, and the walls (W, 4) that meet the box."""
    x_min = x_max = pose[0]
    y_min = y_max = pose[1]
    for k in range(path.shape[0]):
        x_min, x_max = min(x_min, path[k, 0]), max(x_max, path[k, 0])
        y_min, y_max = min(y_min, path[k, 1]), max(y_max, path[k, 1])
    box = (x_min - margin, y_min - margin, x_max + margin, y_max + margin)
    return box, segments[walls_near(segments, *box)]


@njit(cache=True)
def apart(points, shortest):  # type: ignore[no-untyped-def]
    """The points (k, 2) that are no nearer than this (m) to the one kept before, and their indices; none if any
    coordinate is not finite."""
    out, keep, n = np.empty_like(points), np.empty(points.shape[0], np.int64), 0
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        if not (math.isfinite(x) and math.isfinite(y)):
            return out[:0], keep[:0]
        if n == 0 or math.hypot(x - out[n - 1, 0], y - out[n - 1, 1]) >= shortest:
            out[n, 0], out[n, 1], keep[n] = x, y, i
            n += 1
    return out[:n], keep[:n]


@njit(cache=True)
def way_length(trajectory):  # type: ignore[no-untyped-def]
    """Length (m) of the way of the centre along a trajectory (m, 2 or more)."""
    total = 0.0
    for i in range(1, trajectory.shape[0]):
        total += math.hypot(trajectory[i, 0] - trajectory[i - 1, 0], trajectory[i, 1] - trajectory[i - 1, 1])
    return total


@njit(cache=True)
def wrap_headings(trajectory):  # type: ignore[no-untyped-def]
    """Wrap the headings (rad) of a trajectory (m, 3) to (-pi, pi], in place."""
    for i in range(trajectory.shape[0]):
        trajectory[i, 2] = math.pi - (math.pi - trajectory[i, 2]) % (2.0 * math.pi)


@njit(cache=True)
def _touching(segments, x, y, radius):  # type: ignore[no-untyped-def]
    """Walls that a disc touches: index, normal (towards the disc) and place of the contact along the wall (0 to 1)."""
    out = np.empty((segments.shape[0], 4))
    n, reach = 0, radius * (1.0 + 2.0 * SKIN)
    for k in range(segments.shape[0]):
        x1, y1, x2, y2 = segments[k]
        if max(x1, x2) < x - reach or min(x1, x2) > x + reach or max(y1, y2) < y - reach or min(y1, y2) > y + reach:
            continue
        ex, ey = x2 - x1, y2 - y1
        length2 = ex * ex + ey * ey
        t = 0.0
        if length2 > 0.0:
            t = min(1.0, max(0.0, ((x - x1) * ex + (y - y1) * ey) / length2))
        nx, ny = x - x1 - t * ex, y - y1 - t * ey
        distance = math.hypot(nx, ny)
        if distance <= reach:
            if distance > 0.0:
                nx, ny = nx / distance, ny / distance
            out[n, 0], out[n, 1], out[n, 2], out[n, 3] = k, nx, ny, t
            n += 1
    return out[:n]


@njit(cache=True)
def _into_none(touched, dx, dy, depth):  # type: ignore[no-untyped-def]
    """Whether a motion leads into none of the walls touched, or no deeper."""
    deepest = 0.0
    for i in range(touched.shape[0]):
        deepest = max(deepest, -(dx * touched[i, 1] + dy * touched[i, 2]))
    return deepest <= depth


@njit(cache=True)
def _allowed(touched, dx, dy):  # type: ignore[no-untyped-def]
    """What the walls touched leave of a motion without friction: the nearest that leads into none of them.

    That is the whole, that along one of them, or none.
    """
    depth = _PARALLEL * math.hypot(dx, dy)
    if _into_none(touched, dx, dy, depth):
        return dx, dy
    for i in range(touched.shape[0]):
        nx, ny = touched[i, 1], touched[i, 2]
        into = dx * nx + dy * ny
        vx, vy = dx - into * nx, dy - into * ny
        if into < 0.0 and _into_none(touched, vx, vy, depth):
            return vx, vy
    return 0.0, 0.0


@njit(cache=True)
def _straight(segments, touched, row, vx, vy, radius):  # type: ignore[no-untyped-def]
    """How long (share of the motion) a disc slides straight: to a little past the end of the wall it slides along."""
    x1, y1, x2, y2 = segments[int(touched[row, 0])]
    length = math.hypot(x2 - x1, y2 - y1)
    left = 0.0
    if 0.0 < touched[row, 3] < 1.0:
        forward = vx * (x2 - x1) + vy * (y2 - y1) > 0.0
        left = length * ((1.0 - touched[row, 3]) if forward else touched[row, 3])
    return (left + _ARC * radius) / math.hypot(vx, vy)


@njit(cache=True)
def _sweep(segments, touched, x, y, dx, dy, radius):  # type: ignore[no-untyped-def]
    """How much (share) of a motion that leads into no wall touched a disc makes before it touches another: 1 if all."""
    reach = radius * (1.0 + SKIN)
    x_min, x_max = x + min(0.0, dx) - reach, x + max(0.0, dx) + reach
    y_min, y_max = y + min(0.0, dy) - reach, y + max(0.0, dy) + reach
    free, i = 1.0, 0
    for k in range(segments.shape[0]):
        if i < touched.shape[0] and touched[i, 0] == k:  # not moved closer to
            i += 1
            continue
        x1, y1, x2, y2 = segments[k]
        if max(x1, x2) < x_min or min(x1, x2) > x_max or max(y1, y2) < y_min or min(y1, y2) > y_max:
            continue
        free = min(free, enters(x1 - x, y1 - y, x2 - x, y2 - y, dx, dy, reach))
    return free


@njit(cache=True)
def is_free(segments, x, y, dx, dy, radius):  # type: ignore[no-untyped-def]
    """Whether no wall takes anything of a disc's motion (dx, dy); along a wall, or away from it, it is free."""
    touched = _touching(segments, x, y, radius)
    if not _into_none(touched, dx, dy, _PARALLEL * math.hypot(dx, dy)):
        return False
    return _sweep(segments, touched, x, y, dx, dy, radius) == 1.0


@njit(cache=True)
def bounded(segments, x, y, dx, dy, vx, vy, left, radius):  # type: ignore[no-untyped-def]
    """How far a disc may follow what an engine leaves of its motion, until it touches another wall.

    (dx, dy) is the whole motion that is wanted, (vx, vy) what the engine leaves of it where the disc stands, left the
    share of it that is still to be made. An answer that leads into a wall that the disc touches, goes farther in its
    direction than is wanted, or is no number gives way to the nearest motion that leads into none. Round the end of a
    wall it is a short piece.
    Returns (mx, my, share): the motion, and which share it is; (0, 0, left) where walls hold the disc.
    """
    touched = _touching(segments, x, y, radius)
    wanted = math.hypot(dx, dy)
    depth = _PARALLEL * wanted
    given = vx * (dx - vx) + vy * (dy - vy)  # by walls that push; those that only hold give nothing
    if not (given >= -depth * min(math.hypot(vx, vy), wanted) and _into_none(touched, vx, vy, depth)):
        vx, vy = _allowed(touched, dx, dy)
    if math.hypot(vx, vy) <= depth:
        return 0.0, 0.0, left
    row, held = -1, np.inf  # the wall it slides along
    for i in range(touched.shape[0]):
        nx, ny = touched[i, 1], touched[i, 2]
        leaves = vx * nx + vy * ny
        if dx * nx + dy * ny < -depth and leaves < held:
            row, held = i, leaves
    share = left if row < 0 else min(left, _straight(segments, touched, row, vx, vy, radius))
    mx, my = vx * share, vy * share
    free = _sweep(segments, touched, x, y, mx, my, radius)
    return mx * free, my * free, share * free


@njit(cache=True)
def profile_time(distance, speed, acceleration):  # type: ignore[no-untyped-def]
    """Time to cover a distance from rest to rest: a trapezoid of speed, or a triangle if it is short."""
    if distance >= speed * speed / acceleration:
        return distance / speed + speed / acceleration
    return 2.0 * math.sqrt(distance / acceleration)


@njit(cache=True)
def profile_distance(time, distance, speed, acceleration):  # type: ignore[no-untyped-def]
    """How much of the distance is covered after a time, on the same profile."""
    total = profile_time(distance, speed, acceleration)
    if time >= total:
        return distance
    ramp = min(speed / acceleration, 0.5 * total)
    if time <= ramp:
        return 0.5 * acceleration * time * time
    if time >= total - ramp:
        return distance - 0.5 * acceleration * (total - time) ** 2
    return 0.5 * acceleration * ramp * ramp + acceleration * ramp * (time - ramp)


@njit(cache=True)
def profile_moment(covered, distance, speed, acceleration):  # type: ignore[no-untyped-def]
    """When so much of the distance is covered on the same profile, and the speed then: (time, speed)."""
    top = min(speed, math.sqrt(distance * acceleration))
    ramp = 0.5 * top * top / acceleration
    if covered <= ramp:
        now = min(top, math.sqrt(2.0 * acceleration * covered))
        return now / acceleration, now
    if covered < distance - ramp:
        return top / acceleration + (covered - ramp) / top, top
    now = min(top, math.sqrt(2.0 * acceleration * max(distance - covered, 0.0)))
    return profile_time(distance, speed, acceleration) - now / acceleration, now


@njit(cache=True)
def advance(distance, initial, allowed, time, speed, acceleration):  # type: ignore[no-untyped-def]
    """Cover a distance from an initial speed to rest, as far as a distance allowed and a time let it.

    That is the end of a profile from rest to rest. Where the distance is too short to brake, the rest of the braking
    takes its time on the spot at the end. Returns (covered, time, speed then, ended): ended is `ARRIVED`, `CUT` or
    `TIME`.
    """
    before = 0.5 * initial * initial / acceleration  # way and time of that profile that lie behind
    if before > distance:
        now = math.sqrt(max(initial * initial - 2.0 * acceleration * min(allowed, distance), 0.0))
        spent = initial / acceleration if allowed >= distance else (initial - now) / acceleration
        if spent > time:
            return min(distance, time * (initial - 0.5 * acceleration * time)), time, 0.0, TIME
        return (allowed, spent, now, CUT) if allowed < distance else (distance, spent, 0.0, ARRIVED)
    whole, began = distance + before, initial / acceleration
    total = profile_time(whole, speed, acceleration)
    covered = distance
    if time + began < total:
        covered = min(distance, max(0.0, profile_distance(time + began, whole, speed, acceleration) - before))
    if allowed < covered:
        spent, now = profile_moment(allowed + before, whole, speed, acceleration)
        return allowed, max(0.0, spent - began), now, CUT
    if covered < distance:
        return covered, time, 0.0, TIME
    return distance, max(0.0, total - began), 0.0, ARRIVED


@njit(cache=True)
def glide(segments, pose, motion, path, heading, final_turn, radius, limits, time_limit, left):  # type: ignore[no-untyped-def]
    """Follow path (k, 2) exactly, turning on the spot at its vertices.

    motion: initial speed and turn rate, one of them 0. A leg straight ahead is driven on at that speed, a turn to the
    same side goes on at that rate; else coming to rest first takes its time, but no way: the mode is idealised.
    limits: speed, turn rate, acceleration, turn acceleration. left: way (m) and turn (rad) after which it is cut short.
    Returns (trajectory (m, 3), distance, time, ended, next vertex, speed, turn rate); ended is `ARRIVED`, `CUT`, `BUMP`
    (at the first contact) or `TIME`.
    """
    speed, rate, acceleration, turn_acceleration = limits
    now, turning = motion
    way_left, turn_left = left
    out, n = np.empty((2 * path.shape[0] + 2, 3)), 1
    out[0] = pose
    distance, time = 0.0, 0.0
    legs = path.shape[0] - 1
    for k in range(legs + 1):
        x, y, phi = out[n - 1]
        last = k == legs
        dx, dy = (0.0, 0.0) if last else (path[k + 1, 0] - x, path[k + 1, 1] - y)
        length = math.hypot(dx, dy)
        if not last and length == 0.0:
            continue
        turn = 0.0
        if not last or final_turn:
            turn = ((heading if last else math.atan2(dy, dx)) - phi + math.pi) % (2.0 * math.pi) - math.pi
        if now > 0.0:
            aside = length * abs(math.sin(turn)) if abs(turn) < 0.5 * math.pi else length
            if not last and aside <= _ROUNDING * radius:
                turn = 0.0
            elif not last and abs(turn) <= _STRAIGHT_ON:
                phi, turn_left, turn = phi + turn, turn_left - abs(turn), 0.0  # on the way
            else:
                time, now = time + now / acceleration, 0.0
        if turning * turn <= 0.0 and turning != 0.0:
            time, turning = time + abs(turning) / turn_acceleration, 0.0
        if time > time_limit:
            return out[:n], distance, time_limit, TIME, k + 1, 0.0, 0.0
        if turn != 0.0:
            turned, spent, turning, ended = advance(
                abs(turn),
                abs(turning),
                turn_left if way_left > 0.0 else 0.0,
                time_limit - time,
                rate,
                turn_acceleration,
            )
            turn_left -= turned
            phi += math.copysign(turned, turn)
            out[n] = x, y, phi
            n += 1
            if ended == TIME:
                return out[:n], distance, time_limit, TIME, k + 1, 0.0, 0.0
            time += spent
            if ended == CUT:
                return out[:n], distance, time, CUT, k + 1, 0.0, math.copysign(turning, turn)
        if last:
            break
        contact, stop = first_contact(segments, x, y, dx, dy, radius, STANDOFF * radius)
        if contact <= 1.0:
            dx, dy, length = dx * stop, dy * stop, length * stop
        allowed = way_left if turn_left > 0.0 else 0.0
        driven, spent, now, ended = advance(length, now, allowed, time_limit - time, speed, acceleration)
        way_left -= driven
        share = driven / length if length > 0.0 else 0.0
        distance += driven
        out[n] = x + dx * share, y + dy * share, phi
        n += 1
        if ended == TIME:
            return out[:n], distance, time_limit, TIME, k + 1, 0.0, 0.0
        time += spent
        if ended == CUT:
            return out[:n], distance, time, CUT, k + 1, now, 0.0
        if contact <= 1.0:
            return out[:n], distance, time, BUMP, k + 1, 0.0, 0.0
    return out[:n], distance, time, ARRIVED, legs + 1, 0.0, 0.0
