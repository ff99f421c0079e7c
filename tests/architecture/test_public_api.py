"""The public names: few, pinned, loadable and documented."""

from __future__ import annotations

import inspect
import tomllib
from pathlib import Path

import pytest

import gsopt

PUBLIC = {
    "Cameras",
    "DataConfig",
    "Gaussians",
    "GsoptError",
    "RasterSettings",
    "Scene",
    "TrainConfig",
    "clean",
    "evaluate",
    "extract_mesh",
    "load_scene",
    "load_splats",
    "measure",
    "merge",
    "rasterize",
    "reconstruct",
    "save_run_page",
    "save_splats",
    "train",
}


def test_the_surface_is_what_was_agreed_and_small() -> None:
    assert set(gsopt.__all__) == PUBLIC == set(dir(gsopt))
    assert len(PUBLIC) <= 19


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_a_public_name_loads_and_says_what_it_is(name: str) -> None:
    thing = getattr(gsopt, name)
    assert thing.__name__ == name
    assert inspect.getdoc(thing)


def test_another_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'rasterise'"):
        gsopt.rasterise  # noqa: B018 - the access is the test


@pytest.mark.parametrize(
    ("file", "table"), [("pyproject.toml", "project"), ("blender_addon/blender_manifest.toml", "")]
)
def test_every_file_that_states_the_version_states_the_same(root: Path, file: str, table: str) -> None:
    document = tomllib.loads((root / file).read_text(encoding="utf-8"))
    assert (document[table] if table else document)["version"] == gsopt.__version__
