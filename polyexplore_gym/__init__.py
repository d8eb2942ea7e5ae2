"""Exploration of unknown polygonal floor plans by a robot with a noisy 2D laser."""

__version__ = "0.1.0"
