"""Other observations for other learners, made of what the robot knows; all keep the environment's actions and masks."""

from polyexplore_gym.wrappers.flat import FEATURES, Flat
from polyexplore_gym.wrappers.graph import Graph
from polyexplore_gym.wrappers.grid import GridImage
from polyexplore_gym.wrappers.scaled import Scaled

__all__ = ["FEATURES", "Flat", "Graph", "GridImage", "Scaled"]
