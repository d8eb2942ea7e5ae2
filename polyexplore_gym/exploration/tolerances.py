"""The lengths that decide in exploration and paths, each with what it follows from.

Scaled together, robot, sensor and plan give the same exploration, scaled: there is no length here but multiples of the
robot's radius, the sensor's range and the noise. The multiples were chosen on trial with a radius of 0.25 m.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from numba import njit

from polyexplore_gym.config import ExplorationConfig, SensorConfig


class Tolerances(NamedTuple):
    """Lengths in metres."""

    radius: float
    """of the robot's disc"""
    max_range: float
    """of the sensor"""
    sigma_range: float
    sigma_angle: float
    """noise of range (m) and beam angle (rad)"""
    step: float
    """angle between neighbouring beams, rad"""
    gap: float
    """smallest gap of interest: the disc's diameter"""

    nudge: float
    """an open edge is resolved where something deeper than this (and the noise) is seen behind it"""
    cover: float
    """a wall covers open edges along it up to this far: two scans put one wall at two places. Less than a robot fits
    through, whatever the noise"""
    join: float
    """ends of open edges nearer than this (and the noise) touch"""
    crumb: float
    """what is left of a clipped open edge below this length is dropped: the joins close over it"""
    trifle: float
    """an opening narrower than this is forgotten: noise leaves some with every scan"""
    piece: float
    """open edges are cut into pieces of at most this length: some to a robot's surroundings, some to a range"""
    sagitta: float
    """how far a chord that stands for an arc at the maximum range may lie inside it"""
    surface: float
    """two returns whose ranges differ by less (and the noise) lie on one surface"""

    spare: float
    """paths round corners keep so much more than the radius where there is room"""
    need: float
    """clearance of a way point: lets the disc through passages of 1.016 diameters"""
    sweep: float
    """clearance of the straight legs between them: a leg cuts the arc round a corner"""
    stand: float
    """clearance of a node: the robot turns there, and the map is only good to millimetres"""
    still: float
    """a wall whose ends moved less since it was looked at has not moved, and cuts no edge: else paths flicker"""
    reach: float
    """no clearance beyond it is ever asked for, nothing farther is looked for across a narrow passage"""
    cell: float
    """side of a cell of the spatial index: speed only"""
    slack: float
    """paths may cross an open edge this near to the node or robot at their end"""
    neighbourhood: float
    """radius of the circle on which a corner is judged: raggedness smaller than the robot is no corner"""
    same_vertex: float
    """vertices nearer to each other are one"""
    same_corner: float
    """wall ends nearer to each other are one seen twice (and the noise)"""
    short_leg: float
    """legs up to this length need not be taut: the vertices of a corner need not stand just where they should"""
    leg: float
    """longest edges of the path graph between its own vertices: more than is seen at once"""
    last_leg: float
    """... and to where paths end"""
    way_point: float
    """a scan's place becomes a vertex where no other such place is nearer"""
    corner_near: float
    """... and no corner"""

    aside: float
    """distance from a jump edge, on its known side, of the point that must be visible"""
    sight: float
    """a line of sight may end so near to its target's own walls"""
    same_place: float
    """scans nearer (in x and in y) were made at the same place: another there shows no more"""
    at_node: float
    """a jump edge counts as measured from its node only so near to where that should be"""
    on_edge: float
    """a look from nearer than this to the middle of an edge need not be square to it"""

    trail_step: float
    """spacing of the places on a way driven"""
    trail_edge: float
    """longest edges from the way driven to anything else"""
    anchor: float
    """greatest distance (in x and in y) of a place on the way driven from the corner that stands for it"""
    back: float
    """in contact with walls on both sides the robot goes back so far at most before paths begin"""
    same_point: float
    """points of the way driven so near are one"""
    front: float
    """distance of a node in front of its jump edge at most: beyond it the sensor must still see"""
    samples: int
    """fewest beams that must fall on a jump edge seen from in front of it"""


def squeezed(tol: Tolerances) -> Tolerances:
    """For passages that the noise of the map closes: walls may stand so much farther off than they seem.

    Contact tells; what is felt is known to a hair.
    """
    less = min(3.0 * tol.sigma_range, 0.15 * tol.radius)
    return tol._replace(need=tol.need - less, sweep=tol.sweep - less)


def tolerances(config: ExplorationConfig, sensor: SensorConfig, radius: float) -> Tolerances:
    """All tolerances for a robot's disc of `radius` m with this sensor."""
    r, reach = radius, sensor.max_range
    front = 4.0 * r if config.front_distance is None else config.front_distance
    return Tolerances(
        radius=r,
        max_range=reach,
        sigma_range=sensor.sigma_range,
        sigma_angle=sensor.sigma_angle,
        step=sensor.resolution,
        gap=2.0 * r if config.min_gap is None else config.min_gap,
        nudge=0.12 * r,
        cover=0.16 * r + min(3.0 * sensor.sigma_range, 0.3 * r),
        join=0.2 * r,
        crumb=0.08 * r,
        trifle=0.24 * r,
        piece=max(8.0 * r, reach / 15.0),
        sagitta=0.12 * r,
        surface=0.2 * r,
        spare=0.2 * r,
        need=1.016 * r,
        sweep=1.0096 * r,
        stand=1.048 * r,
        still=0.008 * r,
        reach=2.4 * r,
        cell=max(4.0 * r, reach / 32.0),
        slack=1.2 * r,
        neighbourhood=r,
        same_vertex=0.4 * r,
        same_corner=0.12 * r,
        short_leg=2.8 * r,
        leg=max(2.0 * reach, 40.0 * r),
        last_leg=max(4.0 * reach, 60.0 * r),
        way_point=16.0 * r,
        corner_near=6.0 * r,
        aside=0.6 * r,
        sight=0.2 * r,
        same_place=1.6 * r,
        at_node=3.0 * r,
        on_edge=1.6 * r,
        trail_step=1.2 * r,
        trail_edge=2.4 * r,
        anchor=12.0 * r,
        back=4.0 * r,
        same_point=0.004 * r,
        front=min(front, 0.5 * reach),
        samples=config.samples,
    )


@njit(cache=True, inline="always")
def noise_at(distance, tol):
    """Standard deviation (m) of the end point of a beam at a distance (m): range, and angle across the beam."""
    return math.sqrt(tol.sigma_range * tol.sigma_range + (tol.sigma_angle * distance) ** 2)


@njit(cache=True, inline="always")
def end_noise(tol):
    """How much longer (m) than it is a wall may seem at either end: seen at a slant, several sigma."""
    return min(6.0 * tol.sigma_range, 0.25 * tol.radius)
