"""Learned selectors."""

import importlib.util

from polyexplore_gym.errors import MissingDependencyError


def require(*modules: str) -> None:
    """Raise `MissingDependencyError` if a package is not there."""
    for module in modules:
        if importlib.util.find_spec(module) is None:
            raise MissingDependencyError(f"a learned selector needs {module}: pip install 'polyexplore-gym[train]'")
