"""The body of one silhouette against its formula, voxel by voxel, and the views that are guessed of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from test_inflation import camera

from gsopt.data.resample import sample
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.projection import inside, project
from gsopt.geometry.sh import rgb_from_sh0
from gsopt.geometry.voxels import Grid
from gsopt.init import guessed_views, inflation
from gsopt.init.guessed_views import DrawnImages, drawn_voxels, with_guessed_views
from gsopt.init.inflation import inflated, object_box, plane_normal, silhouette_distances
from gsopt.init.thumbnails import Thumbnail

SIDE = 14


def shown(solid: torch.Tensor, elevation: float = 20.0) -> Thumbnail:
    """A photo whose principal point lies off its middle."""
    side = solid.shape[0]
    seen = camera(elevation, size=side).to(torch.float32)
    seen.Ks[0, 0, 2] += 1.5
    planes = torch.zeros(4, side, side, dtype=torch.uint8)
    planes[3] = solid.to(torch.uint8) * 255
    return Thumbnail(seen, planes)


def silhouette(side: int = 24) -> torch.Tensor:
    """A bar with a ball at its end, off the middle, and a lone pixel."""
    row, column = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    unit = side / 24
    solid = (row - 9 * unit) ** 2 + (column - 9 * unit) ** 2 <= (5 * unit) ** 2
    solid |= (row >= 8 * unit) & (row <= 11 * unit) & (column >= 9 * unit) & (column <= 19 * unit)
    solid[int(19 * unit), int(5 * unit)] = True
    return solid


def by_hand(photo: Thumbnail, factor: int = 1) -> torch.Tensor:
    """Voxels of |n . (x - c)| <= sqrt(d (2 w - d)) in the silhouette and in the framed ball, and in each block of
    pixels without one of them those nearest to the plane."""
    solid = photo.alpha()[0] > 0.5
    middle, half, frame = object_box(photo.camera, solid, 1.0)
    voxel = 2 * half / SIDE
    distances = factor * torch.stack(silhouette_distances(solid[factor // 2 :: factor, factor // 2 :: factor]))
    line = (torch.arange(SIDE) + 0.5) * voxel
    places = torch.cartesian_prod(line, line, line) + (middle - half)
    column, row, depth = project(photo.camera, places)
    visible = inside(photo.camera, column, row, depth)
    step = math.ceil(
        voxel
        * float(photo.camera.Ks[0, 0, 0])
        / float(_median(photo, places, column, row, visible, depth, middle, frame))
    )
    normal = plane_normal(photo.camera)
    found, blocks = torch.zeros(SIDE**3, dtype=torch.bool), dict[tuple[int, int], list[tuple[int, float, bool]]]()
    for i in torch.nonzero(visible)[:, 0].tolist():
        at = column[i : i + 1], row[i : i + 1]
        if float((places[i] - middle).norm()) > frame or float(sample(photo.alpha(), *at)[0]) <= 0.5:
            continue
        unit = float(depth[i]) / float(photo.camera.Ks[0, 0, 0])
        d, w = (sample(distances, at[0] / factor, at[1] / factor)[:, 0] * unit).tolist()
        away = abs(float((places[i] - middle) @ normal))
        kept = away <= math.sqrt(max(0.0, d * (2 * w - d)))
        found[i] = kept
        blocks.setdefault((int(row[i] / step), int(column[i] / step)), []).append((i, away, kept))
    for members in blocks.values():
        if not any(kept for _, _, kept in members):
            least = min(away for _, away, _ in members)
            for i, away, _ in members:
                found[i] = away <= least + voxel / 2 and away <= 2 * voxel
    return found.view(SIDE, SIDE, SIDE)


def _median(photo: Any, places: Any, column: Any, row: Any, visible: Any, depth: Any, middle: Any, frame: float) -> Any:
    cone = visible & ((places - middle).norm(dim=1) <= frame)
    cone &= sample(photo.alpha(), column.nan_to_num(0), row.nan_to_num(0))[0] > 0.5
    return depth[cone].median()


@pytest.mark.parametrize("elevation", [-10.0, 20.0, 45.0, 70.0])
def test_the_body_is_that_of_its_formula(elevation: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inflation, "SIDE", SIDE)
    photo = shown(silhouette(), elevation)
    found = inflated(photo, 1.0)
    assert found is not None
    expected = by_hand(photo)
    assert 50 < int(expected.sum()) < SIDE**3 / 2
    assert int((found.occupied ^ expected).sum()) <= 2, "a voxel on the very limit may fall to either side"
    middle, half, _ = object_box(photo.camera, photo.alpha()[0] > 0.5, 1.0)
    torch.testing.assert_close(found.low, middle - half)
    assert found.voxel == pytest.approx(2 * half / SIDE)


def test_distances_of_a_large_photo_are_taken_in_every_third_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inflation, "SIDE", SIDE)
    monkeypatch.setattr(inflation, "MAX_DISTANCE_SIDE", 24)
    photo = shown(silhouette(72))
    found = inflated(photo, 1.0)
    assert found is not None
    assert int((found.occupied ^ by_hand(photo, 3)).sum()) <= 2


def test_a_block_without_a_voxel_gets_those_nearest_to_the_plane() -> None:
    """Up to half a voxel farther than the nearest, and no farther than two voxels."""
    kept = torch.tensor([True, False, False, False, False, False, False])
    block = torch.tensor([0, 0, 1, 1, 1, 2, 3])
    away = torch.tensor([5.0, 0.1, 1.0, 1.5, 1.6, 2.0, 2.1])
    found = inflation._missing(kept, block, away, 1.0)
    assert found.tolist() == [False, False, True, True, False, True, False]


def test_the_middle_and_the_box_follow_from_the_pixels_of_the_silhouette() -> None:
    solid = torch.zeros(40, 40, dtype=torch.bool)
    solid[10:16, 20:34] = True
    photo = shown(solid)
    middle, half, frame = object_box(photo.camera, solid, 1.0)
    column, row, depth = project(photo.camera, middle[None])
    assert (float(column), float(row)) == pytest.approx((27.0, 13.0), abs=1e-3)
    K = photo.camera.Ks[0]
    assert half == pytest.approx(1.25 * float(depth) * math.hypot(7 / float(K[0, 0]), 3 / float(K[1, 1])), rel=1e-4)
    assert frame > 0


@dataclass(frozen=True)
class _Scene:
    """What guessed views are made of."""

    train: tuple[Any, ...]
    has_alpha: bool = True
    extent: float = 1.0
    body: Any = None
    body_colors: Any = None
    guessed: tuple[Any, ...] = ()


@pytest.mark.parametrize(
    ("views", "alpha", "body", "completed"),
    [
        (1, True, False, True),
        (2, True, False, False),
        (2, True, True, True),
        (1, False, False, False),
        (2, False, True, False),
    ],
)
def test_one_photo_with_alpha_or_a_body_is_completed_by_sixteen_views(
    views: int, alpha: bool, body: bool, completed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    around = Grid(torch.ones(2, 2, 2, dtype=torch.bool), torch.tensor([3.0, 4, 5]), 1.0)
    photo = shown(silhouette())
    asked: list[Any] = []
    monkeypatch.setattr(guessed_views, "small_photos", lambda views, most: [photo] * most)
    monkeypatch.setattr(guessed_views, "inflated", lambda photo, extent: around)
    monkeypatch.setattr(guessed_views, "object_middle", lambda photo, extent: torch.zeros(3))
    monkeypatch.setattr(
        guessed_views, "surrounding_cameras",
        lambda camera, middle, count: (asked.append((middle.tolist(), count)), Cameras.cat([photo.camera] * count))[1],
    )  # fmt: skip
    monkeypatch.setattr(guessed_views, "drawn_voxels", lambda *_: torch.zeros(16, 2, 2, 4, dtype=torch.uint8))
    scene: Any = _Scene((None,) * views, alpha, body=around if body else None)
    found = with_guessed_views(scene, None)  # type: ignore[arg-type]
    assert (len(found.guessed) == 16) == completed
    assert (found is scene) != completed
    if completed:
        assert asked == [([0, 0, 0] if views == 1 else [4, 5, 6], 16)]
        assert [view.name for view in found.guessed] == [f"guess_{i:02d}" for i in range(16)]
        assert {view.color for view in found.guessed} == {0.3}
        assert [view.index for view in found.guessed] == list(range(16))
    monkeypatch.setattr(guessed_views, "inflated", lambda photo, extent: None)
    if not body:
        assert with_guessed_views(scene, None) is scene  # type: ignore[arg-type]


@pytest.mark.parametrize("own", [False, True])
def test_voxels_are_drawn_in_the_photos_colors_or_in_their_own_where_no_photo_shows_them(
    own: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Straight color and alpha on black, rounded to bytes; a splat is 0.6 of a voxel."""
    grid = Grid(torch.ones(1, 1, 2, dtype=torch.bool), torch.tensor([1.0, 2, 3]), 0.5)
    monkeypatch.setattr(guessed_views, "without_rim", lambda photo: photo)
    monkeypatch.setattr(
        guessed_views, "unoccluded_colors", lambda grid, photos, points: torch.full((len(points), 3), 0.25)
    )
    monkeypatch.setattr(guessed_views, "seen_colors", lambda grid, photos, points: (None, points[:, 2] < 3.5))
    drawn: list[Any] = []

    def forward(gaussians: Any, camera: Any, settings: Any, background: Any) -> Any:
        drawn.append(gaussians)
        assert background.tolist() == [0, 0, 0]
        return SimpleNamespace(colors=torch.full((2, 3, 3), 0.3), alphas=torch.full((2, 3), 0.5))

    backend: Any = SimpleNamespace(device=torch.device("cpu"), forward=forward)
    unseen = torch.full((1, 1, 2, 3), 0.75) if own else None
    images = drawn_voxels(grid, [None], [1, 2], backend, unseen)  # type: ignore[list-item,arg-type]
    assert images.shape == (2, 2, 3, 4)
    assert {tuple(pixel) for pixel in images.view(-1, 4).tolist()} == {(153, 153, 153, 128)}
    assert torch.equal(DrawnImages(images).get(1), images[1])
    order = drawn[0].means[:, 2] > 3.5
    rgb = rgb_from_sh0(drawn[0].sh0[:, 0])[:, 0]
    assert rgb[~order].tolist() == pytest.approx([0.25] * int((~order).sum()), abs=1e-5)
    assert rgb[order].tolist() == pytest.approx([0.75 if own else 0.25] * int(order.sum()), abs=1e-5)
    assert drawn[0].scales.flatten().tolist() == pytest.approx([0.3] * drawn[0].scales.numel())
    assert float(drawn[0].opacities.min()) > 0.99
