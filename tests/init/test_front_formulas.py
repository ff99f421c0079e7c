"""Fronts, blocks of pixels and thickness against slow formulas, on photos that are not square."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from gsopt.geometry.cameras import Cameras
from gsopt.geometry.projection import inside, project
from gsopt.geometry.voxels import Grid
from gsopt.init import mask_repair, rounded_hull, surface_colors
from gsopt.init.surface_colors import front_of
from gsopt.init.thumbnails import Thumbnail


def photo(focal: float, width: int = 37, height: int = 22) -> Thumbnail:
    """From z = -10 along z, with the principal point off the middle."""
    viewmat = torch.eye(4)
    viewmat[2, 3] = 10
    K = torch.tensor([[focal, 0, 15.0], [0, focal, 12.0], [0, 0, 1]])
    return Thumbnail(Cameras(viewmat[None], K[None], width, height), torch.zeros(4, height, width, dtype=torch.uint8))


def places(count: int = 300) -> torch.Tensor:
    spread = torch.rand(count, 3, generator=torch.Generator().manual_seed(3)) - 0.5
    return spread * torch.tensor([8.0, 6.0, 4.0])


@pytest.mark.parametrize(("voxel", "focal", "step"), [(0.05, 60.0, 1), (0.1, 60.0, 1), (0.25, 60.0, 3), (0.5, 60.0, 5)])
def test_a_front_is_the_least_depth_in_each_block_of_one_and_a_half_voxels(
    voxel: float, focal: float, step: int
) -> None:
    shown, points = photo(focal), places()
    grid = Grid(torch.ones(1, 1, 1, dtype=torch.bool), torch.zeros(3), voxel)
    front = front_of(grid, shown, points)
    assert front.step == step
    column, row, depth = project(shown.camera, points)
    seen = inside(shown.camera, column, row, depth)
    assert step == max(1, math.ceil(1.5 * voxel * focal / float(depth[seen].median())))
    height, width = math.ceil(22 / step), math.ceil(37 / step)
    expected = torch.full((height, width), math.inf)
    for i in torch.nonzero(seen)[:, 0].tolist():
        y, x = min(height - 1, int(row[i] / step)), min(width - 1, int(column[i] / step))
        expected[y, x] = min(float(expected[y, x]), float(depth[i]))
    assert torch.equal(front.depths, expected)
    buried = front.buried(points)
    for i in range(len(points)):
        if not bool(seen[i]):
            assert math.isinf(float(buried[i]))
            continue
        y, x = min(height - 1, int(row[i] / step)), min(width - 1, int(column[i] / step))
        assert float(buried[i]) == pytest.approx(float(depth[i]) - float(expected[y, x]), abs=1e-6)


def test_the_first_and_the_last_block_hold_what_lies_on_the_border() -> None:
    found = surface_colors._cells(torch.tensor([0.0, 2.9, 3.0, 11.9, 12.0]), 3, 4)
    assert found.tolist() == [0, 0, 1, 3, 3]


def test_colors_of_many_points_are_those_of_each(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = photo(60.0)
    shown.planes[:] = torch.randint(0, 200, (4, 22, 37), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))
    shown.planes[3] = 255
    grid = Grid(torch.ones(6, 5, 4, dtype=torch.bool), torch.tensor([-1.5, -1.2, -1.0]), 0.5)
    points = grid.surface()
    whole = surface_colors.unoccluded_colors(grid, [shown], points)
    monkeypatch.setattr(surface_colors, "_CHUNK", 7)
    assert torch.equal(surface_colors.unoccluded_colors(grid, [shown], points), whole)


@pytest.mark.parametrize(("voxel", "step"), [(0.05, 1), (0.1, 1), (0.3, 2), (0.6, 4)])
def test_the_thickest_in_a_pixel_is_found_in_pixels_as_wide_as_a_voxel(voxel: float, step: int) -> None:
    shown, points = photo(60.0), places()
    thick = torch.rand(len(points), generator=torch.Generator().manual_seed(4))
    found = rounded_hull.thickest(shown, points, voxel, thick)
    column, row, depth = project(shown.camera, points)
    seen = inside(shown.camera, column, row, depth)
    assert step == max(1, math.ceil(voxel * 60 / float(depth[seen].median())))
    cells = [(int(row[i] / step), int(column[i] / step)) for i in range(len(points))]
    for i in range(len(points)):
        same = [float(thick[j]) for j in range(len(points)) if bool(seen[j]) and cells[j] == cells[i]]
        assert float(found[i]) == (max(same) if bool(seen[i]) else math.inf)


@pytest.mark.parametrize("margin", [0, 1, 3])
def test_the_box_of_cells_reaches_a_margin_beyond_them_along_each_axis(margin: int) -> None:
    cells = torch.zeros(12, 11, 10, dtype=torch.bool)
    cells[4, 2, 7] = cells[6, 3, 5] = True
    found = rounded_hull._box(cells, margin)
    expected = [(4, 7), (2, 4), (5, 8)]
    sizes = (12, 11, 10)
    for axis, (low, high) in enumerate(expected):
        assert found[axis].start == max(0, low - margin)
        assert min(found[axis].stop, sizes[axis]) == min(high + margin, sizes[axis])


def test_radii_of_a_thickness_are_a_tenth_apart() -> None:
    """In a bar of 7 by 7 cells whose end narrows: every value is the largest radius over a power of 1.1."""
    cells = torch.zeros(20, 11, 11, dtype=torch.bool)
    cells[2:12, 2:9, 2:9] = True
    cells[12:18, 4:7, 4:7] = True
    found = rounded_hull.thickness(cells)
    largest = float(found.max())
    levels = [math.log(largest / value) / math.log(1.1) for value in found[cells].unique().tolist() if value]
    assert max(abs(level - round(level)) for level in levels) < 1e-3
    assert len(levels) >= 3
    assert not bool(found[~cells].any())
    assert bool((found[cells] > 0).all())


def masked(alpha: int) -> Thumbnail:
    shown = photo(60.0)
    shown.planes[:3], shown.planes[3] = 90, 254
    shown.planes[0, 3, 4:7], shown.planes[3, 3, 4:7] = 200, alpha
    return shown


def test_the_objects_colors_are_those_of_pixels_that_are_all_object() -> None:
    assert mask_repair._object_colors(masked(255)).tolist() == [[200, 90, 90]] * 3
    assert mask_repair._object_colors(masked(254)).shape == (0, 3)


def test_a_new_mask_is_tried_in_place_of_the_photos_own() -> None:
    asked: list[Thumbnail] = []
    shown = masked(255)
    agreement: Any = SimpleNamespace(photos=[None, shown], admits_mask=lambda photo: (asked.append(photo), True)[1])
    mask = torch.zeros(22, 37, dtype=torch.bool)
    mask[2:5] = True
    assert mask_repair._agrees(agreement, 1, mask)
    assert torch.equal(asked[0].planes[3], mask.to(torch.uint8) * 255)
    assert torch.equal(asked[0].planes[:3], shown.planes[:3])
    assert int(shown.planes[3, 0, 0]) == 254


@pytest.mark.parametrize("disagreeing", [[], [1]])
def test_a_scene_whose_masks_agree_is_returned_as_it_was_read(
    disagreeing: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that is repaired has the other images as they were, and alpha everywhere."""
    from gsopt.config.train import DataConfig
    from gsopt.data.scene import Scene, View

    camera = photo(60.0).camera
    stores: Any = {
        "given": SimpleNamespace(get=lambda i: "given"),
        "none": SimpleNamespace(get=lambda i: torch.zeros(1, 1, 3)),
    }
    scenes = {
        masks: Scene("a", "b", tuple(View(f"{i}", camera, store, i + 5) for i in range(2)), (), None, False, ())  # type: ignore[arg-type]
        for masks, store in stores.items()
    }
    agreement: Any = SimpleNamespace(agreeing=[], disagreeing=disagreeing)
    alpha = torch.full((1, 1), 7, dtype=torch.uint8)
    monkeypatch.setattr(mask_repair, "load_scene", lambda config: scenes[config.masks])
    monkeypatch.setattr(mask_repair, "agreement_of", lambda scene: agreement)
    monkeypatch.setattr(mask_repair, "_repaired", lambda views, unmasked, found: {1: (alpha, "finding")})
    scene, found = mask_repair.load_with_agreeing_masks(DataConfig(path="a"))
    if not disagreeing:
        assert scene is scenes["given"]
        assert found == []
        return
    assert found == ["finding"]
    assert scene.has_alpha
    assert scene.train[0].pixels() == "given"
    assert scene.train[1].pixels().flatten().tolist() == [0, 0, 0, 7]
    monkeypatch.setattr(mask_repair, "agreement_of", lambda scene: None)
    assert mask_repair.load_with_agreeing_masks(DataConfig(path="a")) == (scenes["given"], [])
