"""Refusals of the readers of datasets: what is no file, no dataset, no mask of an image."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from dataset_builders import save_image

from gsopt.data import colmap, colmap_files, files, images, masks, numpy_files, pointcloud, posed_images
from gsopt.errors import InputError
from gsopt.training.checkpoint import read_checkpoint

READERS: dict[str, Callable[[Path], object]] = {
    "a.json": files.read_json,
    "a.npy": lambda path: numpy_files.read_table(path, 3),
    "a.ply": pointcloud.read_points_ply,
    "a.png": images.read_pixels,
}
KINDS: dict[str, Callable[[Path], object]] = {
    "nothing": lambda path: None,
    "a folder": Path.mkdir,
    "a pipe": lambda path: os.mkfifo(path),
}


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pipes in folders")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", READERS)
def test_what_is_no_regular_file_is_refused_and_a_pipe_is_not_waited_for(name: str, kind: str, tmp_path: Path) -> None:
    path = tmp_path / name
    KINDS[kind](path)
    with pytest.raises(InputError, match=name):
        READERS[name](path)


@pytest.mark.parametrize("kind", ["nothing", "a folder"])
@pytest.mark.parametrize("read", [lambda path: list(files.read_lines(path)), colmap_files.read_cameras])
def test_text_and_models_that_cannot_be_opened_are_named(
    read: Callable[[Path], object], kind: str, tmp_path: Path
) -> None:
    for name in ("cameras.bin", "cameras.txt"):
        KINDS[kind](tmp_path / name)
        with pytest.raises(InputError, match=f"Cannot read .*{name}"):
            read(tmp_path / name)


def test_a_colmap_folder_wants_a_model_and_images(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no sparse/0/cameras\.bin"):
        colmap.read_colmap(tmp_path)
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        (tmp_path / "sparse" / "0" / name).write_bytes(bytes(8))
    with pytest.raises(InputError, match="no folder images/"):
        colmap.read_colmap(tmp_path)


def test_a_folder_without_images_has_none_in_order(tmp_path: Path) -> None:
    for folder in (tmp_path / "absent", tmp_path):
        with pytest.raises(InputError, match="holds no images"):
            posed_images.images_in_order(folder)
    save_image(tmp_path / "a.png", np.zeros((2, 2, 3), np.uint8))
    assert posed_images.images_in_order(tmp_path) == [tmp_path / "a.png"]


@pytest.mark.parametrize(("rows", "columns"), [(2, 4), (3, 3), (4, 3)])
def test_a_mask_has_the_rows_and_columns_of_its_image(rows: int, columns: int) -> None:
    pixels = torch.zeros(3, 4, 3, dtype=torch.uint8)
    with pytest.raises(InputError, match=rf"m\.png has \({rows}, {columns}\) rows and columns, its image \(3, 4\)"):
        masks.apply_mask(pixels, torch.ones(rows, columns, dtype=torch.uint8), Path("m.png"))
    assert masks.apply_mask(pixels, torch.ones(3, 4, dtype=torch.uint8), Path("m.png")).shape == (3, 4, 4)


def test_a_checkpoint_whose_header_holds_no_number_is_refused(tmp_path: Path) -> None:
    """JSON knows neither NaN nor infinity; Python's reader takes both."""
    from safetensors.torch import save_file

    path = tmp_path / "step_000001.safetensors"
    for word in ("NaN", "Infinity", "-Infinity"):
        save_file({"a": torch.zeros(1)}, path, metadata={"gsopt": f'{{"version": 1, "seconds": {word}}}'})
        with pytest.raises(InputError, match=f"{word} in its header"):
            read_checkpoint(path)
