"""pymunk, the engine of contact: it resolves what walls leave of a step that meets them."""

from __future__ import annotations

import math

import numpy as np
import pymunk

from polyexplore_gym.config import RobotConfig
from polyexplore_gym.sim.robot import SKIN, bounded, walls_near

_PIECES = 256
"""Steps of the engine that one time step takes at most; what is left then is lost to the walls."""
_ITERATIONS = 20
"""Passes of pymunk's solver over the contacts: enough for two walls at 60 degrees or more; sharper corners take several
steps, or the swept answer."""
_OFF = 1e-9
"""pymunk must put the body where its velocity leads, give or take this, radii."""


class Engine:
    """A pymunk space with the robot's body, of its mass, and as static segments the walls that it came near.

    A time step is broken into steps of the engine, each from one contact to the next. In each of them pymunk moves the
    body, finds the walls it touches, and lets the wheels' force and the walls' impulses act: the wheels would give it
    the commanded velocity, without slip, and walls take what leads into them, without friction or bounce. How far the
    body may go with that velocity is bounded by a sweep (`bounded`), and where pymunk's answer is not within bounds the
    swept one is taken. So the disc overlaps no wall and passes none, whatever its speed, and nothing is left to push
    out of a wall: that is switched off, for its velocity would throw the robot. A disc that nothing rubs turns as its
    wheels turn it, so its heading needs no engine.

    Every engine step has the length of a time step, because pymunk begins with the impulses of the one before and
    scales them by their lengths; the velocity is that by which the body gets to the next contact in that time.
    """

    def __init__(self, robot: RobotConfig, walls: np.ndarray) -> None:
        """walls (M, 4) m."""
        self.space = pymunk.Space()
        self.space.collision_bias = 1.0  # the share of an overlap that is left after a second
        self.space.iterations = _ITERATIONS
        self.body = pymunk.Body(robot.mass, pymunk.moment_for_circle(robot.mass, 0.0, robot.radius))
        # the sweep holds it one skin off the walls, and it touches them up to two
        shape = pymunk.Circle(self.body, robot.radius * (1.0 + 2.0 * SKIN))
        shape.friction = shape.elasticity = 0.0
        self.space.add(self.body, shape)
        self._radius, self._walls = robot.radius, walls
        self._known: set[int] = set()
        self._x = self._y = self._half = -math.inf  # the square whose walls are at hand, by its middle and half a side
        self._near = walls

    def step(self, state: np.ndarray, step: float) -> list[tuple[float, float]]:
        """One time step (s) from a state (4 or more,): pose, and the speed commanded (m/s).

        Returns the points (m) at which the way bends, at least one, the last the end of the step.
        """
        x, y, heading, speed = state[:4].tolist()
        wish_x, wish_y = speed * math.cos(heading) * step, speed * math.sin(heading) * step
        self._look_around(x, y, speed * step + self._radius * (1.0 + 4.0 * SKIN))
        self.body.position = x, y
        self._advance(x, y, 0.0, 0.0, wish_x, wish_y, step)  # on the spot: the walls that it touches already
        way, left = [], 1.0
        for _ in range(_PIECES):
            vx, vy = self.body.velocity
            mx, my, share = bounded(self._near, x, y, wish_x, wish_y, vx * step, vy * step, left, self._radius)
            if mx == 0.0 and my == 0.0:
                break
            x, y = self._advance(x, y, mx, my, wish_x, wish_y, step)
            way.append((x, y))
            left -= share
            if left <= 0.0:
                break
        return way or [(x, y)]

    def _look_around(self, x: float, y: float, reach: float) -> None:
        """Have the walls at hand, and in the space, that lie within reach (m) of (x, y)."""
        if max(abs(x - self._x), abs(y - self._y)) + reach <= self._half:
            return
        self._x, self._y, self._half = x, y, reach + self._radius
        near = walls_near(self._walls, x - self._half, y - self._half, x + self._half, y + self._half)
        self._near = self._walls[near]
        for k in near.tolist():
            if k not in self._known:
                x1, y1, x2, y2 = self._walls[k].tolist()
                wall = pymunk.Segment(self.space.static_body, (x1, y1), (x2, y2), 0.0)
                wall.friction = wall.elasticity = 0.0
                self.space.add(wall)
                self._known.add(k)

    def _advance(
        self, x: float, y: float, mx: float, my: float, wish_x: float, wish_y: float, step: float
    ) -> tuple[float, float]:
        """One step of the engine from (x, y) by a motion (m); returns the end.

        The body's velocity is then what the walls at the end leave of the wish (m).
        """
        body, push = self.body, self.body.mass / (step * step)
        body.velocity = mx / step, my / step
        body.force = (wish_x - mx) * push, (wish_y - my) * push  # the wheels
        self.space.step(step)
        got_x, got_y = body.position
        end_x, end_y = x + mx, y + my
        if max(abs(got_x - end_x), abs(got_y - end_y)) <= _OFF * self._radius:
            return got_x, got_y
        body.position = end_x, end_y
        return end_x, end_y
