"""The line map: scan -> lines (`extract_lines`) -> map across scans (`LineMap`)."""

from polyexplore_gym.mapping.extract import ScanLines, extract_lines
from polyexplore_gym.mapping.line_map import LineMap

__all__ = ["LineMap", "ScanLines", "extract_lines"]
