"""pymunk, the engine of contact: it resolves what walls leave of a step that meets them."""

from __future__ import annotations

import math

import numpy as np
import pymunk

from polyexplore_gym.config import RobotConfig
from polyexplore_gym.sim.robot import SKIN, bounded, walls_near

_PIECES = 256
"""Steps of the engine that one time step takes at most; what is left then is lost to the walls."""
_ITERATIONS = 100
"""Passes of pymunk's solver over the contacts. In a corner of 20 degrees they leave a millionth of the speed."""
_OFF = 1e-9
"""pymunk must put the body where its velocity leads, give or take this, radii."""


class Engine:
    """A pymunk space with the robot's body, of its mass, and as static segments the walls that it came near.

    A time step is broken into steps of the engine, each from one contact to the next. In each of them pymunk moves the
    body, finds the walls it touches, and lets the wheels' force and the walls' impulses act: the wheels would give it
    the commanded velocity, without slip, and walls take what leads into them, without friction or bounce. How far the
    body may go with that velocity is bounded by a sweep (`bounded`), and where pymunk's answer is not within bounds the
    swept one is taken. So the disc overlaps no wall and passes none, whatever its speed, and nothing is left to push
    out of a wall: that is switched off, for its velocity would throw the robot.

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

    def step(self, state: np.ndarray, step: float) -> np.ndarray:
        """One time step (s) from a state (5,): pose, commanded speed (m/s) and turn rate (rad/s).

        Returns the poses (n, 3) on the way where it bends, n >= 1, the last the end of the step.
        """
        x, y, heading, speed, rate = map(float, state)
        wish = speed * math.cos(heading) * step, speed * math.sin(heading) * step
        walls = self._near(x, y, speed * step)
        self.body.position, self.body.angle = (x, y), heading
        self._advance(x, y, (0.0, 0.0), 0.0, wish, step)  # on the spot: the walls that it touches already
        rows, left, pieces = [], 1.0, 0
        while left > 0.0:
            vx, vy = self.body.velocity
            mx, my, share = bounded(walls, x, y, *wish, vx * step, vy * step, left, self._radius)
            pieces += 1
            if pieces == _PIECES:
                mx, my, share = 0.0, 0.0, left
            x, y = self._advance(x, y, (mx, my), share * rate, wish, step)
            left -= share
            if not rows or (mx, my) != (0.0, 0.0):
                rows.append((x, y, heading))
        rows[-1] = x, y, self.body.angle
        return np.array(rows)

    def _near(self, x: float, y: float, moved: float) -> np.ndarray:
        """Walls (W, 4) in reach of a step of so many metres; they are in the space from now on."""
        reach = moved + self._radius * (1.0 + 4.0 * SKIN)
        near = walls_near(self._walls, x - reach, y - reach, x + reach, y + reach)
        for k in near.tolist():
            if k not in self._known:
                x1, y1, x2, y2 = self._walls[k].tolist()
                wall = pymunk.Segment(self.space.static_body, (x1, y1), (x2, y2), 0.0)
                wall.friction = wall.elasticity = 0.0
                self.space.add(wall)
                self._known.add(k)
        return self._walls[near]

    def _advance(
        self, x: float, y: float, motion: tuple[float, float], rate: float, wish: tuple[float, float], step: float
    ) -> tuple[float, float]:
        """One step of the engine from (x, y) by a motion (m), turning at a rate (rad/s); returns the end.

        The body's velocity is then what the walls at the end leave of the wish (m).
        """
        body = self.body
        end = x + motion[0], y + motion[1]
        push = body.mass / (step * step)
        body.velocity, body.angular_velocity = (motion[0] / step, motion[1] / step), rate
        body.force = (wish[0] - motion[0]) * push, (wish[1] - motion[1]) * push  # the wheels
        self.space.step(step)
        got_x, got_y = body.position
        if not max(abs(got_x - end[0]), abs(got_y - end[1])) <= _OFF * self._radius:
            body.position = end
            return end
        return got_x, got_y
