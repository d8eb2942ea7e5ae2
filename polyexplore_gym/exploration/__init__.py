"""What has been seen, where it is open, where to stand next, and how to get there."""

from polyexplore_gym.exploration.map import Chains, ExplorationMap

__all__ = ["Chains", "ExplorationMap"]
