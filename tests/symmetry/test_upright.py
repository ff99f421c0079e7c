"""One to three photos prove an upright axis or an upright mirror, and nothing else."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import pytest
import torch
from balls import Ball, mirrored, ring, write_balls

from gsopt.data.scene import Scene, load_scene
from gsopt.errors import InputError
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.projection import project
from gsopt.init.thumbnails import Thumbnail
from gsopt.symmetry.axis import Axis, _middle_ray, middle_axis
from gsopt.symmetry.find import find_symmetries, with_mirror_images
from gsopt.symmetry.mirror import Mirror
from gsopt.symmetry.symmetry import Symmetry

UP = torch.tensor([0.0, 0.0, 1.0])
BOTTLE = [Ball((0.1, -0.05, -0.4), 0.45), Ball((0.1, -0.05, 0.1), 0.3), Ball((0.1, -0.05, 0.5), 0.2, (40, 90, 220))]
HANDLE = Ball((-0.06, 0.48, -0.1), 0.15)
HALF = [Ball((0.5, 0.1, 0.0), 0.35), Ball((0.35, 0.5, 0.3), 0.2, (40, 90, 220)), Ball((0.6, -0.4, -0.2), 0.15)]
LOPSIDED = [*HALF, Ball((-0.4, 0.0, 0.5), 0.3), Ball((-0.2, -0.5, -0.4), 0.25)]


def scene_of(folder: Path, balls: list[Ball], views: int, turn: float = 0.3) -> Scene:
    around = ring(7, elevation=0.4, size=160, turn=turn)
    return load_scene(write_balls(folder, balls, Cameras.cat([around[row] for row in (0, 2, 3)[:views]])))


def axis() -> Axis:
    return Axis(UP, torch.tensor([0.1, -0.05, 0.0]), 8)


@pytest.mark.parametrize("pixel", [(0, 0), (3, 7), (11, 2), None])
def test_the_middle_of_a_silhouette_is_that_of_its_pixels(pixel: tuple[int, int] | None) -> None:
    """Pixel (row, column) has its center half a pixel farther; None: the whole photo, whose middle the axis passes."""
    photo = ring(5)[2].resized(8, 12)
    rgba = torch.zeros(4, 12, 8, dtype=torch.uint8)
    rgba[(3, *pixel) if pixel else (3,)] = 255
    ray = _middle_ray(Thumbnail(photo, rgba))
    column, row, _ = project(photo, (photo.centers[0] + 3.7 * ray)[None])
    expected = (4.0, 6.0) if pixel is None else (pixel[1] + 0.5, pixel[0] + 0.5)
    assert (float(column), float(row)) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("views", [1, 2, 3])
def test_the_axis_of_a_round_thing_is_found(views: int, tmp_path: Path) -> None:
    scene = scene_of(tmp_path / "bottle", BOTTLE, views)
    (found,) = find_symmetries(scene)
    assert isinstance(found.element, Axis)
    assert found.element.turns == 8
    off = found.element.point - axis().point
    seen = scene.train[0].camera.forwards[0] if views == 1 else UP  # a single photo leaves the distance open
    across = torch.linalg.cross(torch.nn.functional.normalize(seen * torch.tensor([1.0, 1, views > 1]), dim=0), off)
    assert float(across[2].abs() if views == 1 else across.norm()) < 0.01
    assert found.colored


def crown(corners: int, height: float = 0.0) -> list[Ball]:
    """Balls at the corners of a polygon; the first one higher than the others."""
    angles = [2 * math.pi * corner / corners + 0.1 for corner in range(corners)]
    heights = [height] + [0.0] * (corners - 1)
    return [Ball((0.7 * math.cos(a), 0.7 * math.sin(a), h), 0.2) for a, h in zip(angles, heights, strict=True)]


@pytest.mark.parametrize(("corners", "views"), [(6, 2), (4, 2), (4, 3)])
def test_a_hexagon_and_a_square_are_not_round_but_have_their_axis(corners: int, views: int, tmp_path: Path) -> None:
    axis, *mirrors = find_symmetries(scene_of(tmp_path / "crown", crown(corners), views))
    assert isinstance(axis.element, Axis)
    assert axis.element.turns == corners
    normals = [one.element.normal for one in mirrors if isinstance(one.element, Mirror)]
    assert len(normals) == len(mirrors)
    assert (len(normals) > 1) == (views == 3)  # two photos would prove false ones
    for a, b in itertools.combinations(normals, 2):
        steps = math.degrees(math.acos(min(1.0, abs(float(a @ b))))) / (180 / corners)
        assert round(steps) > 0
        assert steps == pytest.approx(round(steps), abs=0.05)


@pytest.mark.parametrize("views", [2, 3])
def test_a_square_with_one_corner_higher_has_no_axis(views: int, tmp_path: Path) -> None:
    found = find_symmetries(scene_of(tmp_path / "crown", crown(4, height=0.15), views))
    assert not any(isinstance(symmetry.element, Axis) for symmetry in found)


@pytest.mark.parametrize("views", [1, 2, 3])
def test_a_handle_is_seen_and_nothing_is_believed_of_a_lopsided_thing(views: int, tmp_path: Path) -> None:
    found = find_symmetries(scene_of(tmp_path / "jug", [*BOTTLE, HANDLE], views))
    assert not any(isinstance(symmetry.element, Axis) for symmetry in found)
    assert len(found) < views
    assert find_symmetries(scene_of(tmp_path / "thing", LOPSIDED, views)) == []


@pytest.mark.parametrize("views", [2, 3])
def test_an_upright_mirror_is_found_and_a_tilted_one_is_not_believed(views: int, tmp_path: Path) -> None:
    upright = Mirror(torch.tensor([0.8, 0.6, 0.0]), 0.05)
    (found,) = find_symmetries(scene_of(tmp_path / "upright", mirrored(HALF, upright), views))
    assert isinstance(found.element, Mirror)
    assert abs(float(found.element.normal @ upright.normal)) > math.cos(math.radians(1))
    assert found.colored
    tilted = Mirror(torch.nn.functional.normalize(torch.tensor([0.8, 0.3, 0.5]), dim=0), 0.05)
    assert find_symmetries(scene_of(tmp_path / "tilted", mirrored(HALF, tilted), views)) == []


def test_a_single_photo_proves_no_mirror(tmp_path: Path) -> None:
    upright = Mirror(torch.tensor([0.8, 0.6, 0.0]), 0.05)
    assert find_symmetries(scene_of(tmp_path / "thing", mirrored(HALF, upright), 1)) == []


def test_a_turned_camera_sees_the_turned_point_where_the_camera_saw_the_point() -> None:
    camera, points = ring(1)[0], torch.rand(20, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    slanted = Axis(torch.tensor([0.6, 0.0, 0.8]), torch.tensor([0.2, 0.1, -0.3]), 6)
    before = torch.stack(project(camera, points))
    pairs = list(zip(slanted.cameras(camera), slanted.images(points), strict=True))
    assert len(pairs) == 5
    for turned, image in pairs:
        assert torch.allclose(torch.stack(project(turned, image)), before, atol=1e-3)
        assert not torch.allclose(image, points, atol=0.01)
    half = 2 * (slanted.point + _along(slanted, points)) - points
    assert torch.allclose(pairs[2][1], half, atol=1e-5)


def _along(axis: Axis, points: torch.Tensor) -> torch.Tensor:
    return ((points - axis.point) @ axis.direction)[:, None] * axis.direction


def test_images_of_one_photo_have_colors_even_where_the_paint_differs(tmp_path: Path) -> None:
    painted = Symmetry(axis(), 0.0, 1.0)
    one, two = (with_mirror_images(scene_of(tmp_path / str(n), BOTTLE, n), [painted]) for n in (1, 2))
    assert [len(scene.mirrored) for scene in (one, two)] == [7, 14]
    assert {view.color for view in two.mirrored} == {0.0}
    assert all(0 < view.color < 1 for view in one.mirrored)
    assert not any(view.mirrored for view in one.mirrored)
    assert one.completed
    assert not two.completed


def test_a_record_gives_the_same_axis_and_a_garbled_one_an_error() -> None:
    record = Symmetry(axis(), 0.001, 0.2).to_dict()
    again = Symmetry.from_dict(record)
    assert again.to_dict() == record
    assert "8 turns about an upright axis" in record["about"]
    for change in ({"turns": 1}, {"turns": 10**9}, {"turns": True}, {"point": [0, 0]}, {"direction": [0, 0, 2]}):
        with pytest.raises(InputError, match="the axis"):
            Symmetry.from_dict(record | change)


def test_an_axis_moves_sideways_by_shares_of_the_radius() -> None:
    slanted = Axis(torch.tensor([0.6, 0.0, 0.8]), torch.tensor([0.2, 0.1, -0.3]), 6)
    one, other, both = (
        slanted.moved(torch.tensor(change), torch.zeros(3), 3.0).point - slanted.point
        for change in ([0.1, 0.0], [0.0, 0.2], [0.1, 0.2])
    )
    assert (float(one.norm()), float(other.norm())) == pytest.approx((0.3, 0.6))
    assert [float(a @ b) for a, b in ((one, other), (one, slanted.direction), (other, slanted.direction))] == (
        pytest.approx([0.0] * 3, abs=1e-6)
    )
    torch.testing.assert_close(both, one + other)
    assert slanted.freedom == 2


def test_the_distance_from_an_axis_is_that_to_its_nearest_point() -> None:
    slanted = Axis(torch.tensor([0.6, 0.0, 0.8]), torch.tensor([0.2, 0.1, -0.3]), 6)
    points = torch.rand(7, 3, generator=torch.Generator().manual_seed(2))
    along = torch.linspace(-3, 3, 60_001)[:, None] * slanted.direction + slanted.point
    torch.testing.assert_close(slanted.distance(points), torch.cdist(points, along).amin(1), atol=1e-4, rtol=0)


def test_the_middle_axis_passes_the_middles_of_silhouettes_at_the_height_of_the_focus() -> None:
    """One opaque pixel in each of two photos, where they show one point."""
    around, point, focus = ring(8, size=800), torch.tensor([0.2, -0.1, 0.3]), torch.tensor([-0.3, 0.1, 0.05])
    photos = []
    for camera in (around[0].to(torch.float32), around[2].to(torch.float32)):
        column, row, _ = project(camera, point[None])
        rgba = torch.zeros(4, camera.height, camera.width, dtype=torch.uint8)
        rgba[3, int(row), int(column)] = 255
        photos.append(Thumbnail(camera, rgba))
    found = middle_axis(photos, UP, focus)
    assert found.tolist() == pytest.approx([0.2, -0.1, 0.05], abs=0.005)
