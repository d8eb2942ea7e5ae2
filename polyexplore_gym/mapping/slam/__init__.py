"""SLAM for laser logs: the poses of the scans from the scans themselves, with odometry or without: `correct_poses`.

Scan by scan: `surface` (returns and the lines they lie on), `correlative` (where in a window does a scan fit), `align`
(points to lines, from near by), `front` (these two against the scans before), `loops` (places seen again), `graph` (all
poses together); `odometry` (what is wrong with it), `refine` (pairs of scans), `state` (a file to go on from), `mapper`
(the whole).
"""

from polyexplore_gym.mapping.slam.mapper import Corrected, correct_poses, corrected_log

__all__ = ["Corrected", "correct_poses", "corrected_log"]
