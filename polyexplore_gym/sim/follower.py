"""The path follower: from the robot's state to its wheels' command, once per time step.

Pure pursuit with a look-ahead that shrinks with the speed. Sharp corners are driven to, turned at on
the spot, and left; gentle ones are passed at a speed low enough that the cut stays near 1.5 cm:
planned paths leave but a few centimetres to the walls. All ramps are braking parabolas in discrete
time, so that the robot comes to rest where it should without overshoot.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from polyexplore_gym.sim.robot import nearest_wall

X, Y, HEADING, SPEED, RATE, LEG, PHASE, DEFICIT = range(8)
"""The state, float64 (8,): pose (m, rad), speed (m/s) and turn rate (rad/s) of the body, leg of the path, phase, and
motion lost to a wall (m, see `forget`)."""
FOLLOW, ALIGN, FINAL, DONE, LOST = range(5)
"""The phases: drive along the leg, turn on the spot towards it, turn to the final heading, arrived, off the path."""

_CUT = 0.012
_SHARP = math.radians(45.0)
_GOAL_TOLERANCE = 0.004
_HEADING_TOLERANCE = math.radians(0.2)
_LOST = 0.5
_LOOK_MIN, _LOOK_MAX, _LOOK_TIME = 0.08, 0.35, 0.3
_TURN_SHARE = 0.4
_MARGIN, _BACKWARD = 0.9, 0.8
"""Shares of the acceleration limits planned with when braking, and between corners; the rest is for corrections."""
_GRAZING = math.tan(math.radians(15.0)) ** 2
_LAST_LEG = 0.5
"""A last leg shorter than this (m) leaves no room to settle on it: the robot stops and turns before it."""


@njit(cache=True)
def _wrap(angle):  # type: ignore[no-untyped-def]
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@njit(cache=True)
def vertex_speeds(path, limits):  # type: ignore[no-untyped-def]
    """Highest speed (k,) at each vertex of a path (k, 2): 0 at sharp corners and at the end.

    A corner of angle a turned over a length l is cut by about l a / 8 in its middle; turning by a takes at least
    2 sqrt(a / turn acceleration), and 2 a / turn rate. Hence l = 8 cut / a, no longer than the legs, and speed
    l / time. A backward pass makes every later limit reachable by braking. limits as in `command`.
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
            elif turn < (0.005 if k == n - 2 and ahead < _LAST_LEG else _SHARP):
                length = min(8.0 * _CUT / turn, ahead, behind)
                out[k] = min(
                    max_speed,
                    length * min(0.5 * math.sqrt(_TURN_SHARE * turn_acceleration / turn), 0.5 * max_rate / turn),
                )
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
def command(state, path, speeds, heading, final_turn, limits, track, step):  # type: ignore[no-untyped-def]
    """Set the speed and turn rate of the state for the next step, and advance its leg and phase.

    path (k, 2) without repeated points, speeds (k,) from `vertex_speeds`; heading of the end, used if final_turn;
    limits: wheel speed, turn rate, acceleration, turn acceleration; track m; step s. Both wheels, at
    speed -+ rate * track / 2, keep within the wheel speed.
    """
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
        if abs(aside) > _LOST:
            state[PHASE] = LOST
            return
        if state[PHASE] == ALIGN:
            # towards the end of the leg from here; too close to it, along the leg
            aim = math.atan2(dy, dx) if left < 0.03 else math.atan2(path[leg + 1, 1] - y, path[leg + 1, 0] - x)
            if not _rotate(state, _wrap(aim - phi), limits, step):
                return
            state[PHASE] = FOLLOW
        stops = speeds[leg + 1] <= 0.0
        if left <= (_GOAL_TOLERANCE if stops else 0.0) and (not stops or state[SPEED] <= acceleration * step):
            state[LEG] += 1
            if stops:
                state[PHASE] = FINAL if leg == last_leg else ALIGN
            continue
        if abs(_wrap(math.atan2(dy, dx) - phi)) > 1.5 * _SHARP and left > 0.02:
            state[PHASE] = ALIGN
            continue
        look = min(max(_LOOK_TIME * state[SPEED], _LOOK_MIN), _LOOK_MAX)
        tx, ty = _look_ahead(path, speeds, leg, max(along, 0.0), look)
        off = _wrap(math.atan2(ty - y, tx - x) - phi)
        curvature = 2.0 * math.sin(off) / max(math.hypot(tx - x, ty - y), 0.5 * look)
        wish = min(max_speed, _braking(left, speeds[leg + 1], _MARGIN * acceleration, step))
        if curvature != 0.0:
            wish = min(wish, max_rate / abs(curvature))
        wish = min(wish, max_speed / (1.0 + 0.5 * track * abs(curvature)))
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
def run_free(state, path, speeds, heading, final_turn, limits, track, step, walls, radius, trajectory):  # type: ignore[no-untyped-def]
    """Follow the path as long as no wall is in reach: what a physics engine without contacts would integrate.

    walls (W, 4): those near the path. Fills trajectory (n, 3) and returns (rows filled, contact): with contact
    True the command for the next step is set but not executed, for that step would run into a wall.
    Motion along a wall or away from it is free even while the disc touches it.
    """
    clear = nearest_wall(walls, state[X], state[Y])[0] - radius  # at least so far to the nearest wall
    for row in range(trajectory.shape[0]):
        command(state, path, speeds, heading, final_turn, limits, track, step)
        if state[PHASE] >= DONE:
            return row, False
        # position first, then angle, each from the velocities at the start of the step, as Chipmunk does
        x = state[X] + state[SPEED] * math.cos(state[HEADING]) * step
        y = state[Y] + state[SPEED] * math.sin(state[HEADING]) * step
        moved = state[SPEED] * step
        if moved <= clear:
            clear -= moved
        else:
            clear = nearest_wall(walls, x, y)[0] - radius
            if clear < 0.0 and clear < nearest_wall(walls, state[X], state[Y])[0] - radius - 1e-9:
                return row, True
        state[X], state[Y] = x, y
        state[HEADING] = _wrap(state[HEADING] + state[RATE] * step)
        forget(state, moved)
        trajectory[row, 0], trajectory[row, 1], trajectory[row, 2] = x, y, state[HEADING]
    return trajectory.shape[0], False
