"""The line map: scan -> lines (`extract_lines`) -> map across scans (`LineMap`); `read_log` and `map_log` for logs."""

from polyexplore_gym.mapping.evidence import Beams
from polyexplore_gym.mapping.export import MAP_SUFFIXES, save_map
from polyexplore_gym.mapping.extract import ScanLines, extract_lines
from polyexplore_gym.mapping.line_map import LineMap
from polyexplore_gym.mapping.localize import Correction, Localizer
from polyexplore_gym.mapping.log_map import LogMap, map_log, sensor_of
from polyexplore_gym.mapping.logs import LaserLog, Track, read_log, save_trajectory
from polyexplore_gym.mapping.polylines import ScanPolylines, extract_polylines
from polyexplore_gym.mapping.slam import Corrected, correct_poses, corrected_log
from polyexplore_gym.mapping.walls import Walls, beams_of_log, walls_of, walls_of_log

__all__ = [
    "MAP_SUFFIXES",
    "Beams",
    "Corrected",
    "Correction",
    "LaserLog",
    "LineMap",
    "Localizer",
    "LogMap",
    "ScanLines",
    "ScanPolylines",
    "Track",
    "Walls",
    "beams_of_log",
    "correct_poses",
    "corrected_log",
    "extract_lines",
    "extract_polylines",
    "map_log",
    "read_log",
    "save_map",
    "save_trajectory",
    "sensor_of",
    "walls_of",
    "walls_of_log",
]
