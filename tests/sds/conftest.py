"""The tiny pipelines, built once."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import tiny_sd21


@pytest.fixture(scope="session")
def sd21(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Stable Diffusion 2.1's layout, tiny and random. Do not write into it: `sd21_copy`."""
    pytest.importorskip("diffusers", reason="needs the extra gsopt[sds]")
    return tiny_sd21.build(tmp_path_factory.mktemp("models") / "tiny-sd21")


@pytest.fixture
def sd21_copy(sd21: Path, tmp_path: Path) -> Path:
    """One to break."""
    return Path(shutil.copytree(sd21, tmp_path / "sd21"))


@pytest.fixture(scope="session")
def unclip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """SD 2.1-unCLIP's layout: an image encoder, and a U-Net with a projected class embedding."""
    pytest.importorskip("diffusers", reason="needs the extra gsopt[sds]")
    changes = {"class_embed_type": "projection", "projection_class_embeddings_input_dim": 2 * tiny_sd21.WIDTH}
    folder = tmp_path_factory.mktemp("models") / "tiny-unclip"
    return tiny_sd21.build(folder, unet=changes, image_width=tiny_sd21.WIDTH)


@pytest.fixture(scope="session")
def clip_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("transformers", reason="needs the extra gsopt[sds]")
    return tiny_sd21.build_clip(tmp_path_factory.mktemp("models") / "tiny-clip")
