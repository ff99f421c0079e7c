"""A photo of nothing in particular."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    """40 x 30 px, brown, half transparent."""
    path = tmp_path / "photos" / "chair.png"
    path.parent.mkdir()
    Image.new("RGBA", (40, 30), (120, 80, 40, 128)).save(path)
    return path
