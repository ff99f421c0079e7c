"""Library files: a round trip, and files that lie."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from pretend_gpu import pretend_gpu
from safetensors.numpy import load_file, save_file
from simt_runtime import SimtRuntime, simt_backend

from gsopt.errors import InputError
from gsopt.raster.device.backend import DeviceBackend
from gsopt.shape_library.entry import COLOR_SIDE, SIDE, Entry, Shape
from gsopt.shape_library.library_file import FORMAT, SHAPE_BYTES, ShapeLibrary, packed, write_library
from gsopt.shape_library.pictures import picture


def random_shape(seed: int) -> Shape:
    draw = np.random.default_rng(seed)
    colors = draw.integers(0, 256, (COLOR_SIDE,) * 3 + (3,), dtype=np.uint8)
    return Shape(draw.random((SIDE,) * 3) < 0.3, colors, np.array([1.0, 0.5, 0.25], np.float32))


def test_shapes_and_texts_survive(tmp_path: Path) -> None:
    shapes = [random_shape(seed) for seed in range(3)]
    entries = [Entry(f"id{i}", "椅子", "furniture", "seat", "CC0-1.0", "A. Person") for i in range(3)]
    write_library(tmp_path / "l", entries, [packed(shape) for shape in shapes], [shape.sizes for shape in shapes])
    library = ShapeLibrary(tmp_path / "l")
    assert list(library.entries) == entries
    for index, shape in enumerate(shapes):
        back = library.shape(index)
        assert (back.occupied == shape.occupied).all()
        assert (back.colors == shape.colors).all()
        assert (back.sizes == shape.sizes).all()


def test_a_picture_drawn_on_a_gpu_comes_back() -> None:
    shape = random_shape(0)
    expected = picture(shape, simt_backend())
    with pretend_gpu():
        drawn = picture(shape, DeviceBackend(SimtRuntime(device="cuda:0")))
        assert torch.equal(drawn, expected)
    assert 10 < float(drawn.float().mean()) < 250


def test_every_cut_of_a_file_is_an_error_and_no_crash(library_copy: Path) -> None:
    data = library_copy.read_bytes()
    for size in [0, 1, 7, 8, 9, 100, len(data) // 2, len(data) - 1]:
        library_copy.write_bytes(data[:size])
        with pytest.raises(InputError, match="Cannot read the shape library"):
            ShapeLibrary(library_copy)


def rewritten(path: Path, head: object = None, **tensors: np.ndarray) -> Path:
    """The library with some tensors, or what its metadata says, replaced."""
    old = load_file(path)
    library = ShapeLibrary(path)
    said = {"format": FORMAT, "entries": [entry.__dict__ for entry in library.entries]} if head is None else head
    save_file({**old, **tensors}, path, {"library": said if isinstance(said, str) else json.dumps(said)})
    return path


@pytest.mark.parametrize(
    "head",
    [
        "[" * 100_000,
        "null",
        {"format": "other", "entries": []},
        {"format": FORMAT, "entries": []},
        {"format": FORMAT, "entries": [{"id": "a", "run": "rm"}] * 3},
        {"format": FORMAT, "entries": [{"id": 3}] * 3},
        {"format": FORMAT, "entries": [{"id": "x" * 500}] * 3},
        {"format": FORMAT, "entries": [{"id": "one too few"}] * 2},
    ],
)
def test_metadata_that_lie_are_refused(library_copy: Path, head: object) -> None:
    with pytest.raises(InputError, match="Cannot read the shape library"):
        ShapeLibrary(rewritten(library_copy, head))


@pytest.mark.parametrize(
    "tensors",
    [
        {"offsets": np.array([0, 10, 5, 20], np.int64)},
        {"offsets": np.array([0, 1, 2, 1 << 60], np.int64)},
        {"offsets": np.array([-5, 1, 2, 3], np.int64)},
        {"offsets": np.zeros(4, np.int32)},
        {"sizes": np.full((3, 3), np.nan, np.float32)},
        {"sizes": np.zeros((3, 3), np.float32)},
        {"sizes": np.ones((1, 3), np.float32)},
        {"shapes": np.zeros((2, 2), np.uint8)},
    ],
)
def test_tensors_that_lie_are_refused(library_copy: Path, tensors: dict[str, np.ndarray]) -> None:
    with pytest.raises(InputError, match="Cannot read the shape library"):
        ShapeLibrary(rewritten(library_copy, **tensors))


def test_a_stream_is_not_inflated_beyond_a_shape(library_copy: Path) -> None:
    bomb = np.frombuffer(zlib.compress(bytes(1 << 28), 9), np.uint8)
    offsets = np.array([0, len(bomb), len(bomb), len(bomb)], np.int64)
    library = ShapeLibrary(rewritten(library_copy, shapes=bomb, offsets=offsets))
    with pytest.raises(InputError, match=f"holds {SHAPE_BYTES + 1} bytes or more"):
        library.shape(0)
    with pytest.raises(InputError, match="holds 0 bytes"):
        library.shape(1)


def test_a_damaged_stream_names_its_entry(library_copy: Path) -> None:
    noise = np.frombuffer(b"no zlib stream", np.uint8)
    library = ShapeLibrary(rewritten(library_copy, shapes=noise, offsets=np.array([0, 14, 14, 14], np.int64)))
    with pytest.raises(InputError, match="entry 0 is damaged"):
        library.shape(0)


def test_a_header_that_announces_more_than_there_is_takes_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "huge"
    path.write_bytes(struct.pack("<Q", 1 << 60) + b"{}")
    with pytest.raises(InputError, match="Cannot read the shape library"):
        ShapeLibrary(path)


def test_texts_cannot_steer_a_terminal(tmp_path: Path) -> None:
    shape = random_shape(0)
    write_library(tmp_path / "l", [Entry("a", "\x1b[2Jchair\nred")], [packed(shape)], [shape.sizes])
    assert ShapeLibrary(tmp_path / "l").entries[0].name == "[2Jchair red"
