"""Exploration of unknown polygonal floor plans by a robot with a noisy 2D laser."""

from gymnasium.envs.registration import register

__version__ = "0.1.0"

_ENTRY = "polyexplore_gym.env:PolyExploreEnv"
register("PolyExplore-Home-v2", _ENTRY, kwargs={"suite": "home-train"})
register("PolyExplore-Office-v2", _ENTRY, kwargs={"suite": "office-train"})
register("PolyExplore-Mixed-v2", _ENTRY, kwargs={"suite": "mixed-train"})
register("PolyExplore-Plan-v2", _ENTRY)
