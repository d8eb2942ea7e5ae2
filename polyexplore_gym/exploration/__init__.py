"""What has been seen, where it is open, where to stand next, and how to get there."""

from polyexplore_gym.exploration.map import ExplorationMap, JumpEdges, Remains

__all__ = ["ExplorationMap", "JumpEdges", "Remains"]
