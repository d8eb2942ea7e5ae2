"""Laser logs on disk: `read_log` reads CARMEN text, numpy archives and ROS bags into a `LaserLog`."""

from polyexplore_gym.mapping.logs.deskew import deskewed
from polyexplore_gym.mapping.logs.read import read_log
from polyexplore_gym.mapping.logs.record import Broken, LaserLog, Track
from polyexplore_gym.mapping.logs.trajectory import read_trajectory, save_trajectory, with_trajectory

__all__ = [
    "Broken",
    "LaserLog",
    "Track",
    "deskewed",
    "read_log",
    "read_trajectory",
    "save_trajectory",
    "with_trajectory",
]
