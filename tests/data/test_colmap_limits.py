"""Cameras of COLMAP against formulas of their own, and the limits of what is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hamilton import POINTS, QUATERNIONS, turned
from hypothesis import given

from gsopt.data import colmap
from gsopt.data.colmap_files import CAMERA_MODELS, CameraRecord
from gsopt.data.lens import Lens
from gsopt.errors import InputError


@given(QUATERNIONS, POINTS)
def test_a_quaternion_turns_a_point_as_hamiltons_product_does(quaternion: list[float], point: list[float]) -> None:
    w, x, y, z = quaternion
    assert np.allclose(colmap._rotation((w, x, y, z), "a").numpy() @ point, turned(quaternion, point), atol=1e-9)


@pytest.mark.parametrize(("norm", "fine"), [(1.01e-6, True), (0.99e-6, False), (0.99e6, True), (1.01e6, False)])
def test_a_quaternion_has_a_usable_length(norm: float, fine: bool) -> None:
    if fine:
        assert torch.equal(colmap._rotation((norm, 0, 0, 0), "a"), torch.eye(3, dtype=torch.float64))
    else:
        with pytest.raises(InputError, match="its quaternion is"):
            colmap._rotation((norm, 0, 0, 0), "a")


SIMPLE, FULL = ([50.0, 50.0, 7.0, 8.0], 3), ([50.0, 60.0, 7.0, 8.0], 4)


@pytest.mark.parametrize(
    ("model", "head", "lens"),
    [
        ("SIMPLE_PINHOLE", SIMPLE, Lens()),
        ("PINHOLE", FULL, Lens()),
        ("SIMPLE_RADIAL", SIMPLE, Lens(radial=(1,))),
        ("RADIAL", SIMPLE, Lens(radial=(1, 2))),
        ("OPENCV", FULL, Lens(radial=(1, 2), tangential=(3, 4))),
        ("OPENCV_FISHEYE", FULL, Lens(radial=(1, 2, 3, 4), fisheye=True)),
        ("FULL_OPENCV", FULL, Lens(radial=(1, 2, 5), tangential=(3, 4), divisor=(6, 7, 8))),
        ("SIMPLE_RADIAL_FISHEYE", SIMPLE, Lens(radial=(1,), fisheye=True)),
        ("RADIAL_FISHEYE", SIMPLE, Lens(radial=(1, 2), fisheye=True)),
        ("THIN_PRISM_FISHEYE", FULL, Lens(radial=(1, 2, 5, 6), tangential=(3, 4), prism=(7, 8), fisheye=True)),
    ],
)
def test_the_parameters_of_a_colmap_camera_are_its_lens(model: str, head: tuple[list[float], int], lens: Lens) -> None:
    """Parameters after focal lengths and center are 1, 2, ..., in the order of COLMAP's models."""
    (fx, fy, cx, cy), first = head
    given_head = (fx, cx, cy) if first == 3 else (fx, fy, cx, cy)
    count = dict(CAMERA_MODELS)[model]
    camera = CameraRecord(1, model, 20, 10, (*given_head, *map(float, range(1, count - first + 1))))
    K, found = colmap._camera_model(camera, "a")
    assert K.tolist() == [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    assert found == lens


@pytest.mark.parametrize("size", [(1, 1), (0, 5), (5, 0)])
def test_a_colmap_camera_has_a_pixel_at_least(size: tuple[int, int]) -> None:
    camera = CameraRecord(1, "PINHOLE", *size, (5.0, 5.0, 0.5, 0.5))
    if min(size) > 0:
        assert colmap._camera_model(camera, "a")[1] == Lens()
    else:
        with pytest.raises(InputError, match="all must be positive"):
            colmap._camera_model(camera, "a")


def test_names_of_held_out_images_are_lines(tmp_path: Path) -> None:
    frames: Any = [type("Frame", (), {"name": f"images/{name}"})() for name in ("a.png", "b c.png", "d.png")]
    (tmp_path / "test.txt").write_text("  b c.png \n\n")
    test, rest = colmap._held_out(tmp_path / "test.txt", frames)
    assert [frame.name for frame in test or []] == ["images/b c.png"]
    assert [frame.name for frame in rest] == ["images/a.png", "images/d.png"]
    assert colmap._held_out(tmp_path / "absent", frames) == (None, frames)
    (tmp_path / "test.txt").write_text("x.png\n")
    with pytest.raises(InputError, match="names no image of the model"):
        colmap._held_out(tmp_path / "test.txt", frames)
