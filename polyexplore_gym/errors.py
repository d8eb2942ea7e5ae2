"""The exceptions a user may meet; all derive from `PolyExploreError`."""


class PolyExploreError(Exception):
    """Base of every error this package raises on purpose."""


class InvalidFloorPlanError(PolyExploreError, ValueError):
    """A floor plan is unusable; the message names the ring, the vertex and the reason."""


class FloorPlanWarning(UserWarning):
    """A floor plan file was read, but not all of it was taken as it stands; the message says what and why."""


class InvalidConfigError(PolyExploreError, ValueError):
    """A configuration field is unknown or out of range; the message names it."""


class InvalidActionError(PolyExploreError, ValueError):
    """An action is not an integer or lies outside the action space."""


class InvalidScanError(PolyExploreError, ValueError):
    """A scan, its pose or its covariance is unusable; the message says which and why."""


class InvalidMotionError(PolyExploreError, ValueError):
    """A pose, path or wall array handed to the simulated world is unusable; the message says which and why."""


class InvalidLogError(PolyExploreError, ValueError):
    """A laser log cannot be read; the message names the file and the reason."""


class ResultsError(PolyExploreError):
    """Results on disk cannot be read, or do not belong to this run."""


class InvalidModelError(PolyExploreError, ValueError):
    """A model file is damaged, cut short, of another kind or for another environment; the message says which."""


class MissingDependencyError(PolyExploreError, ImportError):
    """An optional package is needed; the message says how to install it."""


class RenderingError(PolyExploreError, ValueError):
    """A picture or animation cannot be made; the message says why."""
