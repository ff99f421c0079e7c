"""A photo of nothing in particular and tiny models."""

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


@pytest.fixture(scope="session")
def sd21(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Stable Diffusion 2.1's layout, tiny and random."""
    pytest.importorskip("diffusers", reason="needs the extra gsopt[sds]")
    import tiny_sd21

    return tiny_sd21.build(tmp_path_factory.mktemp("models") / "tiny-sd21")


@pytest.fixture(scope="session")
def clip_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole CLIP, tiny and random."""
    pytest.importorskip("transformers", reason="needs the extra gsopt[sds]")
    import tiny_sd21

    return tiny_sd21.build_clip(tmp_path_factory.mktemp("models") / "tiny-clip")
