"""The path follower: from the robot's state to its wheels' command, once per time step.

Pure pursuit with a look-ahead that shrinks with the speed. Sharp corners are driven to, turned at on
the spot, and left; gentle ones are passed at a speed low enough that the cut stays near 6 % of the
radius: planned paths leave but little more to the walls. All ramps are braking parabolas in discrete
time, so that the robot comes to rest where it should without overshoot. A robot that moves already follows a path
that leads on from where it is going at once; from any other it first brakes straight ahead.

Lengths follow from the robot: robot, path and walls made larger together give the same drive, larger.
Those in radii were tuned on a robot of 0.25 m.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from polyexplore_gym.sim.robot import SKIN, is_free, nearest_wall

X, Y, HEADING, SPEED, RATE, LEG, PHASE, DEFICIT, MET = range(9)
"""The state, float64 (9,): pose (m, rad), speed (m/s) and turn rate (rad/s) of the body, leg of the path, phase,
motion lost to a wall (m, see `forget`), and whether (0, 1) a wall has taken anything."""
FOLLOW, ALIGN, FINAL, DONE, LOST, BUMP = range(6)
"""The phases: drive along the leg, turn on the spot towards it, turn to the final heading; then the drive has ended:
arrived, off the path, held by a wall."""

_CUT = 0.048
"""How much of a gentle corner may be cut, radii."""
_SHARP = math.radians(45.0)
_GOAL_TOLERANCE = 0.016
"""The robot stops when it is so near to the end of a leg, radii."""
_HEADING_TOLERANCE = math.radians(0.2)
_LOST = 2.0
"""Farther from its leg (radii) the robot is lost: a diameter, as far as a wall can push it and still let it return."""
_LOOK_MIN, _LOOK_MAX, _LOOK_TIME = 0.32, 1.4, 0.3
"""Look-ahead, shortest and longest in radii, and the way driven in so many seconds between."""
_LOOK_STEPS = 2.0
"""No nearer than so many steps: an error of heading then decays fastest; from one step on it would grow."""
_STRAIGHT = 0.02
"""Where the way turns by more than this (rad) a step is no longer than half the look-ahead, or half the turn."""
_TURN_SHARE = 0.4
_MARGIN, _BACKWARD = 0.9, 0.8
"""Shares of the acceleration limits planned with when braking, and between corners; the rest is for corrections."""
_GRAZING = math.tan(math.radians(15.0)) ** 2
_LAST_LEG = 2.0
"""A last leg shorter than this (radii) leaves no room to settle on it: the robot stops and turns before it."""
_AIM, _TURN_BACK = 0.12, 0.08
"""Nearer to the end of a leg (radii) the bearing of that end says little: the robot aligns with the leg instead, and
does not stop to turn any more."""
_OVERSHOOT = 1.0
"""A robot that moves does not take up a path whose first stop it would overshoot by more than this, radii."""
_BUMP = 0.08
"""A drive ends when a wall has taken this much of the commanded motion, radii (2 cm at 0.25 m)."""
_STALL = 0.04
"""Wheels that a wall holds turn on with what they reach from rest in this time (s) or in a step, if that is longer:
a short step makes a bump no later."""
_ROUNDING = 1e-9
"""Share of a motion; walls that take less have taken nothing."""


@njit(cache=True)
def _wrap(angle):  # type: ignore[no-untyped-def]
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@njit(cache=True)
def vertex_speeds(path, limits, radius, step):  # type: ignore[no-untyped-def]
    """Highest speed (k,) at each vertex of a path (k, 2): 0 at sharp corners and at the end.

    A corner of angle a turned over a length l is cut by about l a / 8 in its middle; turning by a takes at least
    2 sqrt(a / turn acceleration), and 2 a / turn rate. Hence l = 8 cut / a, no longer than the legs, and speed
    l / time, in two time steps at least. A backward pass makes every later limit reachable by braking. Arguments as in
    `command`.
    """
    max_speed, max_rate, acceleration, turn_acceleration = limits
    n = path.shape[0]
    out = np.zeros(n)
    for k in range(n - 2, -1, -1):
        ahead = math.hypot(path[k + 1, 0] - path[k, 0], path[k + 1, 1] - path[k, 1])
        if k > 0:
            behind = math.hypot(path[k, 0] - path[k - 1, 0], path[k, 1] - path[k - 1, 1])
            turn = abs(
                _wrap(
                    math.atan2(path[k + 1, 1] - path[k, 1], path[k + 1, 0] - path[k, 0])
                    - math.atan2(path[k, 1] - path[k - 1, 1], path[k, 0] - path[k - 1, 0])
                )
            )
            if turn < 1e-6:
                out[k] = max_speed
            elif turn < (0.005 if k == n - 2 and ahead < _LAST_LEG * radius else _SHARP):
                length = min(8.0 * (_CUT * radius) / turn, ahead, behind)
                out[k] = min(
                    max_speed,
                    length * min(0.5 * math.sqrt(_TURN_SHARE * turn_acceleration / turn), 0.5 * max_rate / turn),
                )
                if turn > _STRAIGHT:
                    out[k] = min(out[k], length / (_LOOK_STEPS * step))
        out[k] = min(out[k], math.sqrt(out[k + 1] ** 2 + 2.0 * _BACKWARD * acceleration * ahead))
    return out


@njit(cache=True)
def _braking(left, final, acceleration, step):  # type: ignore[no-untyped-def]
    """Highest speed now from which `final` is reached by braking within the way left, in discrete steps."""
    if left <= 0.0:
        return final
    half = 0.5 * acceleration * step
    speed = -half + math.sqrt(half * half + 2.0 * acceleration * left + final * final)
    return max(final, min(speed, left / step)) if final > 0.0 else min(speed, left / step)


@njit(cache=True)
def stopping_distance(speed, limits, step):  # type: ignore[no-untyped-def]
    """Shortest way (m) to rest from a speed: the inverse of how `command` brakes for a stop. step s; 0: continuous."""
    if step == 0.0:
        return speed * speed / (2.0 * limits[2])
    return max(speed * speed / (2.0 * _MARGIN * limits[2]) + 0.5 * speed * step, speed * step)


@njit(cache=True)
def can_stop(state, path, speeds, limits, radius):  # type: ignore[no-untyped-def]
    """Whether a robot on the first leg of a path comes to rest by its first stop, or little later. As in `command`."""
    x, y, stop = state[X], state[Y], 0.0
    for k in range(1, path.shape[0]):
        stop += math.hypot(path[k, 0] - x, path[k, 1] - y)
        x, y = path[k, 0], path[k, 1]
        if speeds[k] <= 0.0:
            break
    return state[SPEED] ** 2 / (2.0 * limits[2]) <= stop + _OVERSHOOT * radius


@njit(cache=True)
def leads_on(state, path, speeds, limits, radius):  # type: ignore[no-untyped-def]
    """Whether a robot that moves can take up a path without a wide swing: it leads on within 45 degrees, and does not
    stop long before the robot can. Arguments as in `command`."""
    if path.shape[0] == 1:
        return False
    course = math.atan2(path[1, 1] - path[0, 1], path[1, 0] - path[0, 0])
    return abs(_wrap(course - state[HEADING])) <= _SHARP and can_stop(state, path, speeds, limits, radius)


@njit(cache=True)
def _towards(value, target, change):  # type: ignore[no-untyped-def]
    return min(max(target, value - change), value + change)


@njit(cache=True)
def _rotate(state, error, limits, step):  # type: ignore[no-untyped-def]
    """Turn on the spot: brake, then turn by error. Returns whether it is done."""
    rate, acceleration, turn_acceleration = limits[1], limits[2], limits[3]
    state[SPEED] = _towards(state[SPEED], 0.0, acceleration * step)
    if abs(error) <= _HEADING_TOLERANCE and abs(state[RATE]) <= turn_acceleration * step and state[SPEED] == 0.0:
        return True
    wish = min(rate, _braking(abs(error), 0.0, _MARGIN * turn_acceleration, step))
    state[RATE] = _towards(state[RATE], math.copysign(wish, error), turn_acceleration * step)
    return False


@njit(cache=True)
def _look_ahead(path, speeds, leg, along, look):  # type: ignore[no-untyped-def]
    """The point `look` metres farther along the path; past a stop the leg is prolonged straight."""
    k = leg
    at = along + look
    while True:
        dx, dy = path[k + 1, 0] - path[k, 0], path[k + 1, 1] - path[k, 1]
        length = math.hypot(dx, dy)
        if at <= length or k + 2 >= path.shape[0] or speeds[k + 1] <= 0.0:
            return path[k, 0] + dx * at / length, path[k, 1] + dy * at / length
        at -= length
        k += 1


@njit(cache=True)
def command(state, path, speeds, heading, final_turn, limits, body, step):  # type: ignore[no-untyped-def]
    """Set the speed and turn rate of the state for the next step, and advance its leg and phase.

    path (k, 2) without repeated points, speeds (k,) from `vertex_speeds`; heading of the end, used if final_turn;
    limits: wheel speed, turn rate, acceleration, turn acceleration; body: radius and track (m); step s. Both wheels,
    at speed -+ rate * track / 2, keep within the wheel speed.
    """
    radius, track = body
    max_speed, max_rate, acceleration, turn_acceleration = limits
    x, y, phi = state[X], state[Y], state[HEADING]
    last_leg = path.shape[0] - 2
    for _ in range(2 * path.shape[0] + 4):
        if state[PHASE] == FINAL:
            error = _wrap(heading - phi) if final_turn else 0.0
            if _rotate(state, error, limits, step):
                state[PHASE] = DONE
            return
        leg = int(state[LEG])
        if leg > last_leg:
            state[PHASE] = FINAL
            continue
        px, py = path[leg, 0], path[leg, 1]
        dx, dy = path[leg + 1, 0] - px, path[leg + 1, 1] - py
        length = math.hypot(dx, dy)
        dx, dy = dx / length, dy / length
        along = (x - px) * dx + (y - py) * dy
        aside = (y - py) * dx - (x - px) * dy
        left = length - along
        if abs(aside) > _LOST * radius:
            state[PHASE] = LOST
            return
        if state[PHASE] == ALIGN:
            # towards the end of the leg from here; too close to it, along the leg
            aim = math.atan2(dy, dx) if left < _AIM * radius else math.atan2(path[leg + 1, 1] - y, path[leg + 1, 0] - x)
            if not _rotate(state, _wrap(aim - phi), limits, step):
                return
            state[PHASE] = FOLLOW
        stops = speeds[leg + 1] <= 0.0
        if left <= (_GOAL_TOLERANCE * radius if stops else 0.0) and (not stops or state[SPEED] <= acceleration * step):
            state[LEG] += 1
            if stops:
                state[PHASE] = FINAL if leg == last_leg else ALIGN
            continue
        if abs(_wrap(math.atan2(dy, dx) - phi)) > 1.5 * _SHARP and left > _TURN_BACK * radius:
            state[PHASE] = ALIGN
            continue
        look = min(max(_LOOK_TIME * state[SPEED], _LOOK_MIN * radius), _LOOK_MAX * radius)
        look = max(look, _LOOK_STEPS * state[SPEED] * step)
        tx, ty = _look_ahead(path, speeds, leg, max(along, 0.0), look)
        off = _wrap(math.atan2(ty - y, tx - x) - phi)
        curvature = 2.0 * math.sin(off) / max(math.hypot(tx - x, ty - y), 0.5 * look)
        wish = min(max_speed, _braking(left, speeds[leg + 1], _MARGIN * acceleration, step))
        if curvature != 0.0:
            wish = min(wish, max_rate / abs(curvature))
        wish = min(wish, max_speed / (1.0 + 0.5 * track * abs(curvature)))
        if abs(aside) > _CUT * radius or abs(off) > _STRAIGHT:  # back to the leg in several steps
            wish = min(wish, _LOOK_MAX * radius / (_LOOK_STEPS * step))
        # slow enough to turn towards the point before it is reached, as at the vertices
        wish = min(wish, 0.5 * look * math.sqrt(_TURN_SHARE * turn_acceleration / max(abs(off), 1e-6)))
        state[SPEED] = max(0.0, _towards(state[SPEED], wish, acceleration * step))
        bound = min(max_rate, 2.0 * max(max_speed - state[SPEED], 0.0) / track)
        rate = min(max(curvature * state[SPEED], -bound), bound)
        state[RATE] = _towards(state[RATE], rate, turn_acceleration * step)
        return
    state[PHASE] = LOST


@njit(cache=True)
def forget(state, progress):  # type: ignore[no-untyped-def]
    """Reduce the motion lost to a wall by a share of the progress (m) made.

    Sliding along a wall at the angle a loses tan(a)^2 of the progress, so that grazing below about 15 degrees never
    adds up to a bump, at any speed.
    """
    state[DEFICIT] = max(0.0, state[DEFICIT] - _GRAZING * max(progress, 0.0))


@njit(cache=True)
def feel(state, x, y, acceleration, step, radius):  # type: ignore[no-untyped-def]
    """Take over where a step among walls ended, and what they took of the motion commanded.

    acceleration m/s2 is what the wheels go on with where a wall holds them.
    """
    c, s = math.cos(state[HEADING]), math.sin(state[HEADING])
    moved = state[SPEED] * step
    progress = (x - state[X]) * c + (y - state[Y]) * s
    lost = moved - progress
    if lost > _ROUNDING * moved:
        state[DEFICIT] += lost
        state[MET] = 1.0
        state[SPEED] = max(progress / step, min(state[SPEED], acceleration * max(_STALL - step, 0.0)))
    forget(state, progress)
    state[X], state[Y], state[HEADING] = x, y, _wrap(state[HEADING] + state[RATE] * step)
    if state[DEFICIT] > _BUMP * radius:
        state[PHASE] = BUMP


@njit(cache=True)
def follow(state, path, speeds, heading, final_turn, limits, body, step, steps, left, walls, box, trajectory):  # type: ignore[no-untyped-def]
    """Follow the path for at most so many steps, as long as no wall takes anything of the motion.

    That is what a physics engine without contacts integrates. body: radius and track (m). left (2,): way (m) and turn
    (rad) that may still be made, counted down. walls (W, 4): all those that meet the box (x, y min, x, y max). Fills
    trajectory (n, 3) with the pose after every step. Returns (steps done, contact). With contact True the command for
    the next step is set but not executed: a wall takes some of it. Else it ends when the phase is `DONE` or later, when
    either of left is used up, when the trajectory is full, and before a step that might leave the box.
    """
    radius = body[0]
    clear = 0.0  # at least so far to the nearest wall
    for done in range(min(steps, trajectory.shape[0])):
        x, y = state[X], state[Y]
        far = (1.0 + SKIN) * radius + min(state[SPEED] + limits[2] * step, limits[0]) * step
        if x - far < box[0] or y - far < box[1] or x + far > box[2] or y + far > box[3]:
            return done, False
        command(state, path, speeds, heading, final_turn, limits, body, step)
        if state[PHASE] >= DONE:
            return done, False
        # position first, then angle, each from the velocities at the start of the step, as Chipmunk does
        moved = state[SPEED] * step
        dx, dy = state[SPEED] * math.cos(state[HEADING]) * step, state[SPEED] * math.sin(state[HEADING]) * step
        if moved > clear:
            clear = nearest_wall(walls, x, y)[0] - (1.0 + 2.0 * SKIN) * radius
            if moved > clear and not is_free(walls, x, y, dx, dy, radius):
                return done, True
        clear -= moved
        state[X], state[Y] = x + dx, y + dy
        state[HEADING] = _wrap(state[HEADING] + state[RATE] * step)
        forget(state, moved)
        trajectory[done, 0], trajectory[done, 1], trajectory[done, 2] = state[X], state[Y], state[HEADING]
        left[0] -= moved
        left[1] -= abs(state[RATE]) * step
        if left[0] <= 0.0 or left[1] <= 0.0:
            return done + 1, False
    return min(steps, trajectory.shape[0]), False
