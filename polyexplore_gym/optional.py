"""Extras: optional packages, imported when first needed."""

from __future__ import annotations

import importlib
import os
from types import ModuleType

from polyexplore_gym.errors import MissingDependencyError


def require(module: str, extra: str) -> ModuleType:
    """Import an optional module; raises `MissingDependencyError` with the extra that brings it."""
    if module == "pygame":
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        return importlib.import_module(module)
    except ImportError as error:
        hint = f'pip install "polyexplore-gym[{extra}]"'
        raise MissingDependencyError(f"this needs {module}, which is not installed: {hint}") from error
