"""What a scene does at the very edge of its limits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from dataset_builders import colmap, frames_of, nerf_synthetic, nerfstudio, read_document, save_image, write_json

from gsopt.config.train import DataConfig
from gsopt.data.scene import FARTHEST_POINT, MAX_COORDINATE, load_scene
from gsopt.errors import InputError, UsageError
from gsopt.geometry.cameras import look_at

UP = torch.tensor([0.0, 0, 1], dtype=torch.float64)


def spread(root: Path, center: list[float], apart: float) -> Path:
    """Ten cameras on a line through `center`, `apart` units from its middle at most."""
    eyes = torch.tensor(center, dtype=torch.float64).repeat(10, 1)
    eyes[:, 0] += torch.linspace(-apart, apart, 10, dtype=torch.float64)
    viewmats = look_at(eyes, eyes + torch.tensor([0.1, 1, 0], dtype=torch.float64), UP)
    document = read_document(nerfstudio(root))
    document["frames"] = frames_of(viewmats, [f"images/{i:03d}.png" for i in range(10)])
    write_json(root, document)
    return root


@pytest.mark.parametrize(("farther", "moved"), [(0.999, False), (1.001, True)])
@pytest.mark.parametrize("apart", [3.0, 0.5, 0.0])
def test_a_scene_is_moved_when_it_lies_a_thousand_times_its_extent_away(
    tmp_path: Path, farther: float, moved: bool, apart: float
) -> None:
    away = 1e3 * farther * (1.1 * apart or 1.0)
    scene = load_scene(spread(tmp_path, [0.0, away, 0.0], apart))
    assert (scene.origin != (0, 0, 0)) == moved
    if moved:
        expected = round(away) if 1.1 * apart > 1 else away
        assert scene.origin == pytest.approx((0, expected, 0), rel=1e-12, abs=1e-9)


def test_the_extent_of_cameras_in_one_place_is_the_mean_distance_of_the_points(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever that place is."""
    eye = torch.tensor([8.0, -4, 2], dtype=torch.float64)
    viewmats = look_at(eye[None], eye[None] + torch.tensor([1.0, 0, 0], dtype=torch.float64), UP).repeat(10, 1, 1)
    monkeypatch.setattr("dataset_builders.ring", lambda count: viewmats[:count])
    points = [([8.0, -4, 2 + d], [9, 9, 9], 0) for d in (1.0, 2.0, 6.0)]
    monkeypatch.setattr("dataset_builders.POINTS", points)
    assert load_scene(colmap(tmp_path)).extent == pytest.approx(3.0, rel=1e-5)


@pytest.mark.parametrize(("size", "factor", "fine"), [(64, 4, True), (64, 5, False), (63, 4, True), (68, 5, False)])
def test_a_resolution_that_leaves_less_than_16_pixels_of_a_real_photo_is_refused(
    tmp_path: Path, size: int, factor: int, fine: bool
) -> None:
    """Of photos of at least 64 pixels: smaller ones are toys of tests."""
    nerfstudio(tmp_path, size=(size, size + 9))
    config = DataConfig(path=str(tmp_path), downscale=factor)
    if fine:
        assert load_scene(config).train[0].camera.width == pytest.approx(size / factor, abs=0.51)
    else:
        with pytest.raises(UsageError, match=rf"`--resolution` divides width and height: {factor} leaves"):
            load_scene(config)


@pytest.mark.parametrize(
    ("size", "divisor", "working"),
    [
        ((1600, 40), None, (1600, 40)),
        ((1601, 40), None, (1600, 40)),
        ((40, 4000), None, (16, 1600)),
        ((40, 4000), 1, (40, 4000)),
        ((4000, 90), 2, (2000, 45)),
    ],
)
def test_large_photos_are_learned_at_1600_pixels_unless_a_divisor_is_given(
    tmp_path: Path, size: tuple[int, int], divisor: int | None, working: tuple[int, int]
) -> None:
    nerfstudio(tmp_path, size=size)
    scene = load_scene(DataConfig(path=str(tmp_path), downscale=divisor))
    view = scene.train[0]
    assert (view.camera.width, view.camera.height) == working
    assert view.pixels().shape == (working[1], working[0], 3)
    reduced = divisor is None and max(size) > 1600
    said = [f"Photos of up to {max(size):,} px are learned at 1,600 px: `--resolution 1` keeps all pixels."]
    assert [warning for warning in scene.warnings if "are learned at" in warning] == (said if reduced else [])
    whole = load_scene(DataConfig(path=str(tmp_path), downscale=1)).train[0].camera
    ratio = torch.tensor([working[0] / size[0], working[1] / size[1]])
    assert torch.allclose(view.camera.Ks[0, :2], whole.Ks[0, :2] * ratio[:, None])


@pytest.mark.parametrize(("width", "fine"), [(5, True), (6, True), (7, False), (4, False)])
def test_a_published_smaller_image_may_be_rounded_either_way(tmp_path: Path, width: int, fine: bool) -> None:
    """A third of 16 is 5.33: both 5 and 6 occur, and nothing farther."""
    colmap(tmp_path)
    save_image(tmp_path / "images_3" / "im 000.png", np.zeros((5, width, 3), np.uint8))
    config = DataConfig(path=str(tmp_path), downscale=3)
    if fine:
        views = {view.name: view for view in (*load_scene(config).train, *load_scene(config).test)}
        view = next(view for name, view in views.items() if "im 000" in name)
        assert (view.camera.width, view.camera.height) == (width, 5)
        assert float(view.camera.Ks[0, 0, 0] / views[min(views.keys() - {view.name})].camera.Ks[0, 0, 0]) > 0
    else:
        with pytest.raises(InputError, match="pixels, but the dataset declares 5x5"):
            load_scene(config)


@pytest.mark.parametrize(("out", "kept"), [(0.99, True), (1.01, False)])
def test_points_a_million_times_as_far_out_as_half_of_them_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, out: float, kept: bool
) -> None:
    points = [([x, 0.0, 0.0], [1, 2, 3], 0) for x in (-1.0, 0.0, 0.0, 1.0, 1.0, -1.0)]
    points.append(([out * FARTHEST_POINT, 0.0, 0.0], [4, 5, 6], 0))
    monkeypatch.setattr("dataset_builders.POINTS", points)
    scene = load_scene(colmap(tmp_path))
    assert scene.points is not None
    assert len(scene.points.xyz) == 6 + kept
    assert bool(scene.warnings) == (not kept)


def test_points_that_float32_would_square_to_infinity_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beyond 1e18 of their median, however far apart they all are."""
    monkeypatch.setattr(
        "dataset_builders.POINTS", [([x, 0.0, 0.0], [1, 2, 3], 0) for x in (-0.9e18, 0.0, 0.0, 0.9e18, 1.1e18)]
    )
    scene = load_scene(colmap(tmp_path))
    assert scene.points is not None
    assert len(scene.points.xyz) == 4
    assert float(scene.points.xyz.abs().max()) < MAX_COORDINATE


def test_alpha_is_had_only_when_every_input_view_has_it(tmp_path: Path) -> None:
    nerf_synthetic(tmp_path)
    assert load_scene(tmp_path).has_alpha
    save_image(tmp_path / "test" / "r_0.png", mode="RGB")
    assert load_scene(tmp_path).has_alpha
    save_image(tmp_path / "train" / "r_9.png", mode="RGB")
    assert not load_scene(tmp_path).has_alpha
