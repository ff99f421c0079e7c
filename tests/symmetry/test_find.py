"""Mirrors that are found, and planes that are not."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from balls import Ball, mirrored, ring, write_balls
from PIL import Image

from gsopt.data.outlines import MAX_DISTANCE, Outline, signed_distance
from gsopt.data.scene import Scene, View, load_scene
from gsopt.geometry.voxels import Grid
from gsopt.init.thumbnails import Thumbnail, small_photos
from gsopt.symmetry.colors import MIN_PAIRS, disagreement
from gsopt.symmetry.find import MAX_MISSES, find_symmetries, with_mirror_images
from gsopt.symmetry.mirror import Mirror
from gsopt.symmetry.silhouettes import Silhouettes
from gsopt.symmetry.symmetry import MAX_DISAGREEMENT, Symmetry

HALF = [Ball((0.5, 0.1, 0.0), 0.35), Ball((0.35, 0.5, 0.3), 0.2, (40, 90, 220)), Ball((0.6, -0.4, -0.2), 0.15)]
"""Beside the plane x = 0; with their mirror images nothing else about them is symmetric."""
LOPSIDED = [*HALF, Ball((-0.4, 0.0, 0.5), 0.3), Ball((-0.2, -0.5, -0.4), 0.25)]


def slanted() -> Mirror:
    return Mirror(torch.nn.functional.normalize(torch.tensor([0.9, 0.35, 0.25]), dim=0), 0.07)


def degrees_between(a: Mirror, b: Mirror) -> float:
    return math.degrees(math.acos(min(1.0, abs(float((a.normal * b.normal).sum())))))


def scene_of(folder: Path, balls: list[Ball], views: int = 4) -> Scene:
    return load_scene(write_balls(folder, balls, ring(views)))


@pytest.mark.parametrize("mirror", [Mirror(torch.tensor([1.0, 0, 0]), 0.0), slanted()], ids=["x", "slanted"])
def test_the_mirror_of_a_symmetric_thing_is_found(mirror: Mirror, tmp_path: Path) -> None:
    found = find_symmetries(scene_of(tmp_path / "thing", mirrored(HALF, mirror)))
    assert len(found) == 1
    assert degrees_between(found[0].element, mirror) < 1
    middle = torch.zeros(3) + mirror.offset * mirror.normal
    assert abs(float(found[0].element.distance(middle))) < 0.02
    assert found[0].misses <= MAX_MISSES / 4
    assert found[0].colored


def test_a_miss_is_a_share_of_the_object_wherever_the_world_begins(tmp_path: Path) -> None:
    mirror = slanted()
    scene = scene_of(tmp_path / "thing", mirrored(HALF, mirror))
    step = torch.tensor([3.0, -5.0, 4.0])

    def moved(view: View) -> View:
        viewmats = view.camera.viewmats.clone()
        viewmats[:, :3, 3] -= viewmats[:, :3, :3] @ step
        return replace(view, camera=replace(view.camera, viewmats=viewmats))

    here, there = find_symmetries(scene), find_symmetries(replace(scene, train=tuple(map(moved, scene.train))))
    assert len(here) == len(there) == 1
    assert there[0].misses == pytest.approx(here[0].misses, rel=0.1)


def test_a_lopsided_thing_has_none(tmp_path: Path) -> None:
    assert find_symmetries(scene_of(tmp_path / "thing", LOPSIDED)) == []


def test_a_thing_with_two_mirrors_has_both(tmp_path: Path) -> None:
    x, y = (Mirror(normal, 0.0) for normal in torch.eye(3)[:2])
    quarter = [Ball((0.4, 0.3, 0.2), 0.3), Ball((0.6, 0.2, -0.3), 0.2), Ball((0.2, 0.5, -0.5), 0.15)]
    found = find_symmetries(scene_of(tmp_path / "thing", mirrored(mirrored(quarter, x), y)))
    assert len(found) == 2
    assert all(min(degrees_between(symmetry.element, mirror) for symmetry in found) < 1 for mirror in (x, y))


def test_paint_that_is_not_symmetric_is_noticed(tmp_path: Path) -> None:
    found = find_symmetries(scene_of(tmp_path / "thing", mirrored(HALF, slanted(), repaint=True)))
    assert [degrees_between(symmetry.element, slanted()) < 1 for symmetry in found] == [True]
    assert found[0].disagreement > MAX_DISAGREEMENT
    assert not found[0].colored


def test_pictures_without_masks_have_no_outline(tmp_path: Path) -> None:
    scene = scene_of(tmp_path / "thing", mirrored(HALF, slanted()))
    assert find_symmetries(replace(scene, has_alpha=False)) == []
    assert find_symmetries(replace(scene, train=scene.train[:1])) == []


def test_opaque_pictures_have_no_outline_either(tmp_path: Path) -> None:
    """Their frusta are as symmetric as the cameras: that says nothing about what stands in them."""
    scene = scene_of(tmp_path / "thing", mirrored(HALF, slanted()))
    for path in (tmp_path / "thing" / "train").glob("*.png"):
        Image.open(path).convert("RGB").convert("RGBA").save(path)
    opaque = load_scene(scene.path)
    assert opaque.has_alpha
    assert find_symmetries(opaque) == []


def test_the_border_of_a_picture_is_no_outline(tmp_path: Path) -> None:
    """A ball that fills it from top to bottom has only its sides as outline."""
    scene = load_scene(write_balls(tmp_path / "ball", [Ball((0.0, 0.0, 0.0), 1.0)], ring(4, distance=3.6)))
    (photo,) = small_photos(scene.train[:1], 1)
    column, row = Outline.of(photo.camera, photo.alpha()).pixels()
    assert len(row) > 0
    assert float((column - 48).square().add((row - 48).square()).sqrt().std()) < 0.3


def test_points_of_an_outline_lie_on_it(tmp_path: Path) -> None:
    """To a fraction of a pixel, whichever way the outline runs."""
    scene = scene_of(tmp_path / "thing", LOPSIDED)
    for photo in small_photos(scene.train, 1):
        outline = Outline.of(photo.camera, photo.alpha())
        missed = outline.here(*outline.pixels()).abs()
        assert len(missed) > 50
        assert float(missed.quantile(0.9)) < 0.1


def test_candidates_that_end_in_one_mirror_are_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    n, across = slanted().normal, torch.nn.functional.normalize(torch.tensor([-0.35, 0.9, 0.0]), dim=0)
    tilted = [
        Mirror(torch.nn.functional.normalize(n + tilt * across, dim=0), slanted().offset) for tilt in (0.04, -0.04, 0)
    ]
    monkeypatch.setattr("gsopt.symmetry.find.candidates", lambda *args: tilted)
    found = find_symmetries(scene_of(tmp_path / "thing", mirrored(HALF, slanted())))
    assert [degrees_between(symmetry.element, slanted()) < 1 for symmetry in found] == [True]


@pytest.mark.parametrize(("side", "known"), [(3, False), (12, True)])
def test_few_pairs_tell_nothing_about_the_colors(side: int, known: bool) -> None:
    """Though everything has one color: a handful of voxels could agree by chance."""
    cameras = ring(4)
    photos = [Thumbnail(cameras[i], torch.full((4, 96, 96), 255, dtype=torch.uint8)) for i in range(4)]
    grid = Grid(torch.ones(side, side, side, dtype=torch.bool), torch.full((3,), -0.5), 1.0 / side)
    pairs = int((grid.surface()[:, 0].abs() > 0.1).sum()) // 2
    assert (pairs >= MIN_PAIRS) == known
    assert disagreement(grid, photos, Mirror(torch.tensor([1.0, 0, 0]), 0.0), 1.0) == (0.0 if known else 1.0)


def test_twice_the_same_bits(tmp_path: Path) -> None:
    scene = scene_of(tmp_path / "thing", mirrored(HALF, slanted()))
    first, second = ([symmetry.to_dict() for symmetry in find_symmetries(scene)] for _ in range(2))
    assert first == second
    again = Symmetry.from_dict(first[0])
    assert again.to_dict() == first[0]
    assert torch.equal(again.element.normal, Symmetry.from_dict(second[0]).element.normal)


@pytest.mark.parametrize("views", [4, 8])
def test_the_first_look_on_coarser_voxels_loses_no_mirror(
    views: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scene_of(tmp_path / "thing", mirrored(HALF, slanted()), views)
    looked = [symmetry.to_dict() for symmetry in find_symmetries(scene)]
    monkeypatch.setattr("gsopt.symmetry.search.HOPELESS", 1.0)
    assert looked == [symmetry.to_dict() for symmetry in find_symmetries(scene)]
    assert looked


def test_mirror_images_are_flipped_photos_seen_from_behind(tmp_path: Path) -> None:
    scene = scene_of(tmp_path / "thing", mirrored(HALF, slanted()))
    plain, painted = Symmetry(slanted(), 0.0, 0.0), Symmetry(slanted(), 0.0, 1.0)
    whole = with_mirror_images(scene, [plain, painted])
    assert whole.train == scene.train
    assert len(whole.mirrored) == 8
    assert len(whole.drawn) == 12
    assert len({view.name for view in whole.drawn}) >= 8
    for photo, image, outline in zip(whole.train, whole.mirrored[:4], whole.mirrored[4:], strict=True):
        assert torch.equal(image.pixels(), photo.pixels().flip(1))
        assert torch.equal(image.camera.viewmats, slanted().camera(photo.camera).viewmats)
        assert (photo.color, outline.color) == (1, 0)
        assert 0 < image.color <= 1


@pytest.mark.parametrize("finer", [2, 4])
def test_the_signed_distance_is_that_to_the_outline(finer: int, tmp_path: Path) -> None:
    """A disc has a known distance at every pixel."""
    scene = scene_of(tmp_path / "disc", [Ball((0.0, 0.0, 0.0), 0.6)])
    (photo,) = small_photos(scene.train[:1], 1)
    distance = signed_distance(photo.alpha(), finer)[0]
    y, x = (torch.arange(size, dtype=torch.float64) + 0.5 for size in distance.shape)
    from_center = ((x / finer - 48) ** 2 + (y[:, None] / finer - 48) ** 2).sqrt()
    radius = math.sqrt(float(photo.alpha().sum()) / math.pi)
    expected = (radius - from_center).clamp(-MAX_DISTANCE, MAX_DISTANCE)
    assert float((distance - expected).abs().max()) < 0.2 + 0.6 / finer


def test_outlines_miss_more_the_further_the_mirror_is_off(tmp_path: Path) -> None:
    photos = small_photos(scene_of(tmp_path / "thing", mirrored(HALF, slanted())).train, 4)
    silhouettes = Silhouettes(photos, torch.zeros(3), 1.2)
    n = slanted().normal
    across = torch.nn.functional.normalize(torch.linalg.cross(n, torch.tensor([0.0, 0, 1])), dim=0)
    left = []
    for degrees in (0, 1, 2, 4):
        angle = math.radians(degrees)
        mirror = Mirror(math.cos(angle) * n + math.sin(angle) * across, 0.07)
        left.append(float(silhouettes.misses(mirror, silhouettes.near_optima(mirror)).norm()))
    assert left == sorted(left)
    assert left[1] > 2 * left[0]
