"""The visual hull of a known shape."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from shapes import BLUE, RED, ellipsoid_scene, spread_cameras

from gsopt.config.train import InitConfig
from gsopt.data.scene import Scene, load_scene
from gsopt.errors import UsageError
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.focus import find_focus
from gsopt.geometry.projection import sees
from gsopt.geometry.voxels import Grid
from gsopt.init import first_gaussians, hull
from gsopt.init.hull import SURFACE_SHARE, HullPoints, carve, hull_points, in_hull
from gsopt.init.thumbnails import Thumbnail, small_photos
from gsopt.raster.threads import one_torch_thread

CENTER, RADII = (0.3, -0.2, 0.1), (0.9, 0.6, 0.4)


def radius_in_ellipsoid(points: torch.Tensor) -> torch.Tensor:
    """1 on the surface."""
    return ((points - torch.tensor(CENTER)) / torch.tensor(RADII)).norm(dim=1)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("ellipsoid")
    return load_scene(ellipsoid_scene(folder, spread_cameras(24), CENTER, RADII))


@pytest.fixture(scope="module")
def found(scene: Scene) -> HullPoints:
    points = hull_points(scene, 4000, torch.Generator().manual_seed(0))
    assert points is not None
    return points


def test_points_of_the_shape_are_in_the_hull_and_points_well_outside_are_not(scene: Scene) -> None:
    photos = small_photos(scene.train, 100)
    directions = torch.nn.functional.normalize(torch.randn(2000, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    surface = directions * torch.tensor(RADII)
    assert bool(in_hull(photos, surface * 0.93 + torch.tensor(CENTER)).all())
    assert float(in_hull(photos, surface * 1.25 + torch.tensor(CENTER)).double().mean()) < 0.01


@pytest.mark.parametrize(("weight", "colored"), [(0.0, False), (0.01, True), (1.0, True)])
def test_a_view_without_weight_gives_its_silhouette_alone(scene: Scene, weight: float, colored: bool) -> None:
    (photo,) = small_photos([replace(scene.train[0], color=weight)], 1)
    assert photo.colored == colored
    assert torch.equal(photo.planes, small_photos(scene.train[:1], 1)[0].planes)


def test_more_views_carve_more(scene: Scene) -> None:
    photos = small_photos(scene.train, 100)
    points = 2 * torch.rand(5000, 3, generator=torch.Generator().manual_seed(0)) - 1
    before = torch.ones(5000, dtype=torch.bool)
    for count in (2, 4, 8, 24):
        kept = in_hull(photos[:count], points)
        assert not bool((kept & ~before).any())
        assert int(kept.sum()) < int(before.sum())
        before = kept


def test_a_radius_only_adds_points(scene: Scene) -> None:
    photos = small_photos(scene.train, 100)
    points = 2 * torch.rand(3000, 3, generator=torch.Generator().manual_seed(0)) - 1
    exact, wide = in_hull(photos, points), in_hull(photos, points, 0.2)
    assert not bool((exact & ~wide).any())
    assert int(wide.sum()) > int(exact.sum())


def test_the_voxels_enclose_the_shape_tightly(scene: Scene) -> None:
    photos = small_photos(scene.train, 100)
    grid = carve(photos, find_focus([photo.camera for photo in photos], scene.extent))
    assert grid is not None
    volume = int(grid.occupied.sum()) * grid.voxel**3
    true = 4 / 3 * torch.pi * RADII[0] * RADII[1] * RADII[2]
    # Masks of 64 px without partial alpha take off up to a quarter pixel (4 %); 24 views leave little beside the shape.
    assert true * 0.94 < volume < true * 1.15
    centers = grid.centers(grid.occupied)
    for axis in range(3):
        assert float(centers[:, axis].amax()) == pytest.approx(CENTER[axis] + RADII[axis], abs=0.08)
        assert float(centers[:, axis].amin()) == pytest.approx(CENTER[axis] - RADII[axis], abs=0.08)


def test_every_sampled_point_is_in_the_hull_and_the_surface_has_its_share(scene: Scene, found: HullPoints) -> None:
    assert len(found.xyz) == 4000
    assert bool(in_hull(small_photos(scene.train, 100), found.xyz).all())
    radius = radius_in_ellipsoid(found.xyz)
    shell = float((radius > 1 - 2.5 * found.voxel / min(RADII)).double().mean())
    assert SURFACE_SHARE - 0.02 < shell < SURFACE_SHARE + 0.2
    assert float((radius < 0.5).double().mean()) > 0.01


def test_colors_are_those_of_the_nearest_surface(found: HullPoints) -> None:
    """Means over all views would mix both halves; only views that see the surface before a point may count."""
    away = (found.xyz[:, 0] - CENTER[0]) / RADII[0]
    for half, color in ((away > 0.35, RED), (away < -0.35, BLUE)):
        error = (found.rgb[half] - torch.tensor(color) / 255).abs().amax(dim=1)
        assert float(error.mean()) < 0.08
        assert float((error < 0.1).double().mean()) > 0.85


def test_the_hull_is_the_same_every_time_and_for_any_number_of_threads(scene: Scene, found: HullPoints) -> None:
    for count in (1, 3):
        with one_torch_thread(count):
            again = hull_points(scene, 4000, torch.Generator().manual_seed(0))
        assert again is not None
        assert torch.equal(again.xyz, found.xyz)
        assert torch.equal(again.rgb, found.rgb)
    other = hull_points(scene, 4000, torch.Generator().manual_seed(1))
    assert other is not None
    assert not torch.equal(other.xyz, found.xyz)


def test_an_object_thinner_than_a_voxel_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    carved, empty = hull._carved, []

    def watched(*args: object, cautious: bool) -> Grid:
        grid = carved(*args, cautious=cautious)  # type: ignore[arg-type]
        empty.append((cautious, not bool(grid.occupied.any())))
        return grid

    monkeypatch.setattr(hull, "_carved", watched)
    monkeypatch.setattr(hull, "_MAX_SIDE", 14)  # fine voxels of 0.05
    root = ellipsoid_scene(tmp_path, spread_cameras(4, size=256), (0.0, 0.0, 0.0), (1.0, 0.015, 0.015))
    gaussians, _ = first_gaussians(load_scene(root), InitConfig(method="hull", count=500), 0, 0)
    assert empty == [(True, False), (False, True), (True, False)]  # the box, no voxel's center, any part of a voxel
    assert float(gaussians.means[:, 0].amax()) > 0.9
    assert float(gaussians.means[:, 1:].abs().amax()) < 0.1


def test_an_object_cropped_by_some_views_keeps_its_cropped_part(tmp_path: Path) -> None:
    cameras = spread_cameras(12)
    near = spread_cameras(12, distance=1.9)
    mixed = type(cameras).cat([cameras, near[::4]])
    scene = load_scene(ellipsoid_scene(tmp_path, mixed, (0.0, 0.0, 0.0), (0.9, 0.9, 0.9)))
    found = hull_points(scene, 2000, torch.Generator().manual_seed(0))
    assert found is not None
    assert float(found.xyz.norm(dim=1).amax()) > 0.85


def blank(scene_root: Path, value: int) -> None:
    from PIL import Image

    for path in scene_root.glob("*.png"):
        Image.new("RGBA", Image.open(path).size, (90, 90, 90, value)).save(path)


@pytest.mark.parametrize("alpha", [0, 255])
def test_silhouettes_that_outline_nothing_fall_back_or_say_so(tmp_path: Path, alpha: int) -> None:
    root = ellipsoid_scene(tmp_path, spread_cameras(4), CENTER, RADII)
    blank(root, alpha)
    scene = load_scene(root)
    gaussians, said = first_gaussians(scene, InitConfig(count=50), 0, 0)
    assert len(gaussians.validate()) == 50
    assert "random" in said
    with pytest.raises(UsageError, match="--init hull"):
        first_gaussians(scene, InitConfig(method="hull", count=50), 0, 0)


def slid(photo: Thumbnail, columns: int) -> Thumbnail:
    """The same picture slid to the right, camera and all; what leaves it is cut off."""
    K = photo.camera.Ks.clone()
    K[:, 0, 2] += columns
    planes = torch.zeros_like(photo.planes)
    planes[..., columns:] = photo.planes[..., :-columns]
    return Thumbnail(replace(photo.camera, Ks=K), planes)


def beside(camera: Cameras, columns: float) -> torch.Tensor:
    """A point as far away as the object, so many pixels to the right of the picture's middle."""
    depth = float((torch.tensor(CENTER) - camera.centers[0]) @ camera.forwards[0])
    aside = camera.viewmats[0, 0, :3] * columns * depth / float(camera.Ks[0, 0, 0])
    return (camera.centers[0] + camera.forwards[0] * depth + aside)[None].float()


@pytest.mark.parametrize(("showing", "others", "kept"), [(2, 2, True), (2, 3, False), (1, 2, False), (3, 3, True)])
def test_what_fewer_than_half_of_the_photos_show_is_no_hull(
    scene: Scene, showing: int, others: int, kept: bool
) -> None:
    """Though all that show it have it solid, and the others carve nothing away."""
    photos = small_photos(scene.train, 100)
    point = beside(photos[0].camera, 0.75 * photos[0].camera.width)
    full = [Thumbnail(photo.camera, torch.full_like(photo.planes, 255)) for photo in photos]
    see = [bool(sees(photo.camera, point)[0]) for photo in full]
    chosen = [photo for photo, sight in zip(full, see, strict=True) if sight][:showing]
    chosen += [photo for photo, sight in zip(full, see, strict=True) if not sight][:others]
    assert len(chosen) == showing + others
    assert bool(in_hull(chosen, point)[0]) == kept


def test_what_a_photo_with_the_whole_object_does_not_show_is_no_part_of_it(scene: Scene) -> None:
    """Though every other photo has the point solid. A photo without a silhouette says nothing beyond its edge."""
    whole, *more = small_photos(scene.train, 100)
    point = beside(whole.camera, 0.75 * whole.camera.width)
    full = torch.full_like(whole.planes, 255)
    others = [Thumbnail(photo.camera, full) for photo in more if bool(sees(photo.camera, point)[0])]
    assert len(others) > 2
    assert not bool(in_hull([whole, *others], point)[0])
    assert bool(in_hull([Thumbnail(whole.camera, torch.zeros_like(full)), *others], point)[0])


def test_an_object_that_its_photo_cuts_off_goes_on_beyond_the_edge(scene: Scene) -> None:
    whole, *others = small_photos(scene.train, 100)
    cut = slid(whole, whole.camera.width // 2)
    directions = torch.nn.functional.normalize(torch.randn(2000, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    inner = directions * torch.tensor(RADII) * 0.93 + torch.tensor(CENTER)
    assert not bool(sees(cut.camera, inner).all())
    assert bool(in_hull([cut, *others], inner).all())


def test_a_ball_that_may_reach_into_the_photo_is_not_carved(scene: Scene) -> None:
    """Its center lies just outside the whole object's photo; a ball far outside is carved, and so is every point."""
    whole, *more = small_photos(scene.train, 100)
    half = whole.camera.width / 2
    near, far = beside(whole.camera, half + 1), beside(whole.camera, 4 * half)
    pixel = float((beside(whole.camera, 1) - beside(whole.camera, 0)).norm())
    full = Thumbnail(whole.camera, torch.full_like(whole.planes, 255))
    edge = full.planes.clone()
    edge[3, :, 0] = edge[3, :, -1] = edge[3, 0] = edge[3, -1] = 0
    solid = Thumbnail(whole.camera, edge)
    assert solid.shows_all()
    assert bool(in_hull([solid], beside(whole.camera, 0), 3 * pixel)[0])
    others = [Thumbnail(photo.camera, full.planes) for photo in more if bool(sees(photo.camera, near)[0])][:3]
    assert bool(in_hull([solid, *others], near, 3 * pixel)[0])
    assert not bool(in_hull([solid, *others], near)[0])
    assert not bool(in_hull([solid, *others], far, 3 * pixel)[0])
