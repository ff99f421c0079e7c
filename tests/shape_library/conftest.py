from __future__ import annotations

from pathlib import Path

import pytest
from meshes import library_folder

from gsopt.shape_library.library_file import ShapeLibrary
from gsopt.shape_library.meshes.build import build_library

pytest.importorskip("trimesh")


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> ShapeLibrary:
    """The shapes of `library_folder`."""
    folder = tmp_path_factory.mktemp("library")
    out = folder / "shapes.safetensors"
    build_library(library_folder(folder / "meshes"), out, 1, lambda line: None)
    return ShapeLibrary(out)


@pytest.fixture
def library_copy(library: ShapeLibrary, tmp_path: Path) -> Path:
    """A copy to break."""
    path = tmp_path / "copy.safetensors"
    path.write_bytes(library.path.read_bytes())
    return path
