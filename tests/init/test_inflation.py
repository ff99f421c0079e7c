"""The body that one silhouette suggests, and views of it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from shapes import RED, ellipsoid_scene, spread_cameras

from gsopt.config.train import InitConfig
from gsopt.data.scene import Scene, load_scene
from gsopt.geometry.cameras import Cameras, intrinsics, look_at
from gsopt.geometry.focus import world_up
from gsopt.geometry.projection import project
from gsopt.init import first_gaussians
from gsopt.init.guessed_views import COLOR_WEIGHT, COUNT, with_guessed_views
from gsopt.init.inflation import inflated, silhouette_distances
from gsopt.init.thumbnails import Thumbnail, small_photos
from gsopt.raster.api import make_backend

SIZE = 96


def camera(elevation: float, roll: float = 0.0, distance: float = 4.0, size: int = SIZE) -> Cameras:
    """A camera that looks at the origin from so many degrees above the horizon, rolled about its axis (degrees)."""
    angle, tilt = math.radians(elevation), math.radians(roll)
    eye = torch.tensor([[distance * math.cos(angle), 0.0, distance * math.sin(angle)]], dtype=torch.float64)
    viewmats = look_at(eye, torch.zeros(3, dtype=torch.float64), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    turn = torch.eye(4, dtype=torch.float64)
    turn[:2, :2] = torch.tensor([[math.cos(tilt), -math.sin(tilt)], [math.sin(tilt), math.cos(tilt)]])
    return Cameras(turn @ viewmats, intrinsics(0.7, size, size)[None], size, size)


def photo_of(camera: Cameras, solid: torch.Tensor) -> Thumbnail:
    planes = torch.zeros(4, SIZE, SIZE, dtype=torch.uint8)
    planes[3] = solid.to(torch.uint8) * 255
    return Thumbnail(camera.to(torch.float32), planes)


def one_photo(tmp_path: Path, elevation: float, radii: tuple[float, float, float], center=(0.0, 0.0, 0.0)) -> Scene:
    """An ellipsoid, seen once."""
    return load_scene(ellipsoid_scene(tmp_path, camera(elevation), center, radii))


@pytest.mark.parametrize(("elevation", "share"), [(0, 0.95), (30, 0.75), (60, 0.75), (89, 0.95)])
def test_a_ball_stays_nearly_a_ball_from_any_elevation(tmp_path: Path, elevation: float, share: float) -> None:
    scene = one_photo(tmp_path, elevation, (0.7, 0.7, 0.7))
    grid = inflated(small_photos(scene.train, 1)[0], scene.extent)
    assert grid is not None
    inside = grid.centers().norm(dim=1)
    volume = len(inside) * grid.voxel**3 / (4 / 3 * math.pi * 0.7**3)
    assert 0.8 < volume < 1.4  # sheared by up to 30 degrees against the ray
    assert float((inside < 0.8).double().mean()) > share


def test_a_large_photo_gives_the_same_body_as_a_small_one(tmp_path: Path) -> None:
    volumes = []
    for size in (96, 480):
        folder = ellipsoid_scene(tmp_path / str(size), camera(0, size=size), (0, 0, 0), (1.0, 1.0, 1.0))
        scene = load_scene(folder)
        grid = inflated(small_photos(scene.train, 1)[0], scene.extent)
        assert grid is not None
        volumes.append(int(grid.occupied.sum()) * grid.voxel**3)
    assert volumes[1] == pytest.approx(volumes[0], rel=0.1)


def test_a_tall_body_stands_upright_though_the_camera_looks_down(tmp_path: Path) -> None:
    scene = one_photo(tmp_path, 35, (0.25, 0.25, 0.9))
    grid = inflated(small_photos(scene.train, 1)[0], scene.extent)
    assert grid is not None
    points = grid.centers() - grid.centers().mean(0)
    longest = torch.linalg.eigh((points.T @ points).double()).eigenvectors[:, -1]
    assert float(longest[2].abs()) > math.cos(math.radians(12))


def test_the_body_fills_the_silhouette_and_nothing_beside_it(tmp_path: Path) -> None:
    scene = one_photo(tmp_path, 20, (0.5, 0.8, 0.3), center=(0.2, 0.3, -0.1))
    photo = small_photos(scene.train, 1)[0]
    grid = inflated(photo, scene.extent)
    assert grid is not None
    column, row, _ = project(photo.camera, grid.centers())
    solid = photo.alpha()[0] > 0.5
    drawn = torch.zeros(8, 8, dtype=torch.bool)
    drawn[(row / 8).long().clamp(max=7), (column / 8).long().clamp(max=7)] = True
    blocks = solid[:64, :64].view(8, 8, 8, 8).all(3).all(1)
    assert bool(drawn[blocks].all())
    near = torch.nn.functional.max_pool2d(solid.float()[None], 3, 1, 1)[0] > 0
    assert bool(near[row.long(), column.long()].all())


def test_distances_of_a_bar_are_to_its_sides_and_its_half_width() -> None:
    solid = torch.zeros(40, 60, dtype=torch.bool)
    solid[15:25, 5:55] = True
    inset, width = silhouette_distances(solid)
    assert inset[19, 30] == 5
    assert inset[15, 30] == 1
    assert 4.5 <= float(width[15, 30]) <= 5
    assert float(inset[0, 0]) == float(width[0, 0]) == 0


def test_the_border_of_the_image_counts_as_outline() -> None:
    inset, _ = silhouette_distances(torch.ones(9, 9, dtype=torch.bool))
    assert float(inset.max()) == float(inset[4, 4]) == 5


def test_a_silhouette_of_one_pixel_is_a_small_body_and_an_empty_one_none() -> None:
    solid = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    assert inflated(photo_of(camera(30), solid), 1.0) is None
    solid[40, 50] = True
    grid = inflated(photo_of(camera(30), solid), 1.0)
    assert grid is None or float((grid.centers().amax(0) - grid.centers().amin(0)).max()) < 0.2


@pytest.mark.parametrize(("roll", "is_z"), [(0, True), (2, True), (20, False), (180, False)])
def test_up_is_z_unless_the_photo_is_rolled_against_it(roll: float, is_z: bool) -> None:
    up = world_up(camera(30, roll).to(torch.float32).viewmats)
    assert (float(up[2]) > 0.999) == is_z
    assert float(up.norm()) == pytest.approx(1, abs=1e-5)


def test_first_gaussians_of_one_photo_fill_the_body(tmp_path: Path) -> None:
    scene = with_guessed_views(one_photo(tmp_path, 30, (0.7, 0.7, 0.7)), make_backend("cpu", 1))
    gaussians, why = first_gaussians(scene, InitConfig(count=500), 0, 0)
    assert "inflated silhouette" in why
    assert float((gaussians.means.norm(dim=1) < 1.0).double().mean()) > 0.8


def test_guessed_views_surround_the_object_and_show_it_in_the_photos_colors(tmp_path: Path) -> None:
    scene = with_guessed_views(one_photo(tmp_path, 0, (0.7, 0.7, 0.7)), make_backend("cpu", 1))
    assert len(scene.guessed) == COUNT
    assert scene.observed == scene.train
    assert scene.drawn == scene.train + scene.guessed
    for view in scene.guessed:
        assert view.color == COLOR_WEIGHT
        pixels = view.pixels().float()
        area = float((pixels[..., 3] > 127).double().mean())
        assert area == pytest.approx(math.pi * (0.7 / 4 / (2 * math.tan(0.35))) ** 2, rel=0.35)
    away = torch.stack([view.camera.centers[0] for view in scene.guessed])
    assert bool(((away.norm(dim=1) - 4).abs() < 0.1).all())
    behind = scene.guessed[int((away @ scene.train[0].camera.centers[0]).argmin())].pixels()
    solid = behind[behind[..., 3] > 250][:, :3].double()
    assert float((solid - torch.tensor(RED).double()).abs().amax(dim=1).median()) < 12


def test_only_a_single_photo_with_alpha_is_completed(tmp_path: Path) -> None:
    backend = make_backend("cpu", 1)
    two = load_scene(ellipsoid_scene(tmp_path / "two", spread_cameras(2), (0, 0, 0), (0.5, 0.5, 0.5)))
    assert with_guessed_views(two, backend) is two
    opaque = replace(one_photo(tmp_path / "one", 30, (0.5, 0.5, 0.5)), has_alpha=False)
    assert with_guessed_views(opaque, backend) is opaque
