"""Optional packages: imported when used, and an error with the pip line when absent."""

from __future__ import annotations

import importlib
from types import ModuleType

from gsopt.errors import MissingDependency


def require(module: str, extra: str, purpose: str) -> ModuleType:
    """Import `module`, or raise MissingDependency naming the extra of gsopt that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingDependency(
            f"{purpose} needs the package `{module}`, which is not installed ({error}). "
            f"Install it with: pip install 'gsopt[{extra}]'"
        ) from error
