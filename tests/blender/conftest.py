"""The extension as a package, splats to try it on, and Blender's module where it is installed."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from made_splats import random_splats  # noqa: E402

from blender_addon.core.splats import Splats  # noqa: E402


@pytest.fixture
def some_splats() -> Splats:
    return random_splats(300)


@pytest.fixture
def odd_folder(tmp_path: Path) -> Path:
    """A folder whose name has spaces, letters of other scripts and what shells stumble over."""
    folder = tmp_path / "мой проект 春 $(x) 'q'"
    folder.mkdir()
    return folder
