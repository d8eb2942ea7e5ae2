"""References that know the plan: how long the best possible exploration is, from below and from above."""

from baselines.oracle.reference import Reference, Tour, reference, start_of
from baselines.oracle.replay import Replay, distance_to_see, replay

__all__ = ["Reference", "Replay", "Tour", "distance_to_see", "reference", "replay", "start_of"]
