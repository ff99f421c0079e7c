"""Steps of the agreement of masks: shadows of voxels, shares that they cover, boxes of voxels, and who is left out."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from balls import ring

from gsopt.geometry.cameras import Cameras, intrinsics
from gsopt.geometry.focus import Focus
from gsopt.geometry.projection import project
from gsopt.init import mask_agreement as steps
from gsopt.init.mask_agreement import Agreement, Voxels, has_edge, mask_agreement, shadow
from gsopt.init.thumbnails import Thumbnail

SIDE = 40


def ahead(mask: torch.Tensor | None = None, width: int = SIDE, height: int = SIDE) -> Thumbnail:
    """A photo from the origin along z with a focal length of 50 px."""
    K = torch.tensor([[50.0, 0, width / 2], [0, 50, height / 2], [0, 0, 1]])
    planes = torch.zeros(4, height, width, dtype=torch.uint8)
    if mask is not None:
        planes[3] = mask
    return Thumbnail(Cameras(torch.eye(4)[None], K[None], width, height), planes)


@pytest.mark.parametrize(("size", "depth", "reach"), [(0.1, 5.0, 1), (0.1, 3.0, 2), (0.39, 5.0, 3), (0.1, 50.0, 1)])
def test_the_shadow_of_a_voxel_is_its_pixel_and_three_quarters_of_its_edge_around(
    size: float, depth: float, reach: int
) -> None:
    assert reach == math.ceil(0.75 * size * 50 / depth)
    place = torch.tensor([[(3.5 / 50) * depth, (-6.5 / 50) * depth, depth]])
    found = shadow(ahead(), place, size)
    rows, columns = found.nonzero(as_tuple=True)
    assert (int(rows.min()), int(rows.max())) == (13 - reach, 13 + reach)
    assert (int(columns.min()), int(columns.max())) == (23 - reach, 23 + reach)
    assert int(found.sum()) == (2 * reach + 1) ** 2


def test_a_shadow_is_as_wide_as_the_finer_axis_and_the_median_depth_say() -> None:
    photo = ahead()
    photo.camera.Ks[0, 1, 1] = 100.0
    points = torch.tensor([[0.0, 0, 5], [0, 0, 5], [0, 0, 50]])
    assert int(shadow(photo, points, 0.2).sum()) == (2 * math.ceil(0.75 * 0.2 * 100 / 5) + 1) ** 2


def test_what_a_camera_does_not_see_casts_no_shadow() -> None:
    outside = torch.tensor([[0.0, 0, -5], [50, 0, 5]])
    assert not bool(shadow(ahead(), outside, 0.1).any())
    border = torch.tensor([[2.0, 0, 5.0]])  # on the image's right edge: its last pixel
    assert int(shadow(ahead(), border, 1e-6)[:, -1].sum()) > 0


@pytest.mark.parametrize(("value", "edge"), [(127, False), (128, True)])
def test_a_mask_has_an_edge_where_some_pixel_is_solid_and_some_is_not(value: int, edge: bool) -> None:
    mask = torch.full((SIDE, SIDE), 127, dtype=torch.uint8)
    mask[3, 4] = value
    assert has_edge(ahead(mask)) == edge
    whole = torch.full((SIDE, SIDE), 128, dtype=torch.uint8)
    assert not has_edge(ahead(whole))
    whole[3, 4] = 127
    assert has_edge(ahead(whole))


def test_the_covered_share_is_that_of_a_silhouettes_own_pixels() -> None:
    """Two of its four pixels lie in the shadow of 3 x 3; an empty one is covered nowhere."""
    mask = torch.zeros(SIDE, SIDE, dtype=torch.uint8)
    mask[20, 20] = mask[20, 21] = 128
    mask[2, 2] = mask[2, 3] = 255
    mask[20, 22] = 127
    point = torch.tensor([[0.1 / 50 * 5, 0.1 / 50 * 5, 5.0]])
    assert steps._covered_share(ahead(mask), point, 0.1) == 0.5
    assert steps._covered_share(ahead(), point, 0.1) == 0.0


def test_voxels_fill_a_box_and_know_who_excludes_them(monkeypatch: pytest.MonkeyPatch) -> None:
    low, extent, asked = torch.tensor([1.0, 2, 3]), torch.tensor([4.0, 2, 1]), list[float]()

    def admits(photo: Any, centers: torch.Tensor, reach: float) -> torch.Tensor:
        asked.append(reach)
        return centers[:, photo] > 2

    monkeypatch.setattr(steps, "admits", admits)
    photos: Any = [0, 1]
    found = steps._excluded(photos, low, extent, 10)
    assert found.size == pytest.approx(0.2)
    assert len(found.centers) == 20 * 10 * 5
    torch.testing.assert_close(found.centers.amin(0), low + 0.1)
    torch.testing.assert_close(found.centers.amax(0), low + extent - 0.1)
    assert found.reach == pytest.approx(0.2 * math.sqrt(3) / 2)
    assert asked == pytest.approx([found.reach] * 2)
    assert torch.equal(found.excluded, torch.stack([found.centers[:, 0] <= 2, found.centers[:, 1] <= 2]))
    around = steps._around(photos, torch.tensor([[0.0, 0, 0], [1, 2, 3]]), 0.5)
    torch.testing.assert_close(around.centers.amin(0), torch.full((3,), -0.5 + around.size / 2))
    assert around.size == pytest.approx((2 * 3 * 4) ** (1 / 3) / steps.FINE_SIDE, rel=1e-5)
    assert bool((around.centers.amax(0) + around.size / 2 - torch.tensor([1.5, 2.5, 3.5]) < around.size).all())


def test_the_hull_is_what_none_of_the_masks_excludes() -> None:
    centers = torch.arange(12.0).view(4, 3)
    voxels = Voxels(centers, 1.0, torch.tensor([[1, 0, 0, 0], [0, 1, 0, 0]], dtype=torch.bool))
    assert torch.equal(voxels.hull([0]), centers[1:])
    assert torch.equal(voxels.hull([0, 1]), centers[2:])
    assert torch.equal(voxels.hull([]), centers)


@pytest.mark.parametrize(("excluding", "stay"), [(2, True), (3, False)])
def test_a_third_of_the_masks_may_carve_a_voxel_of_the_first_box(
    monkeypatch: pytest.MonkeyPatch, excluding: int, stay: bool
) -> None:
    """Six masks look at a box of twice the focus' radius; two of them exclude its upper half, or three do."""
    boxes = []

    def excluded(photos: Any, low: torch.Tensor, extent: torch.Tensor, side: int) -> Voxels:
        boxes.append((low.tolist(), extent.tolist(), side))
        axis = torch.arange(4) - 1.5
        centers = torch.cartesian_prod(axis, axis, axis)
        rows = [(centers[:, 2] > 0) & (row < excluding) for row in range(6)]
        return Voxels(centers, 1.0, torch.stack(rows))

    monkeypatch.setattr(steps, "_excluded", excluded)
    steps._voxels([None] * 6, Focus(torch.tensor([1.0, 0, 0]), 9.0, 2.0, True))  # type: ignore[list-item]
    assert boxes[0] == ([-3, -4, -4], [8, 8, 8], steps.COARSE_SIDE)
    low, extent, side = boxes[1]
    assert (low, side) == ([-2.5, -2.5, -2.5], steps.FINE_SIDE)
    assert extent == [5, 5, 5 if stay else 3]


def cutting(monkeypatch: pytest.MonkeyPatch, shares: Any, count: int, edges: set[int] | None = None) -> Any:
    """The agreement of so many masks, whose covered shares are given by a function of the agreeing rows."""
    monkeypatch.setattr(steps, "_voxels", lambda *_: Voxels(torch.zeros(1, 3), 1.0, torch.zeros(count, 1).bool()))
    monkeypatch.setattr(steps, "_around", lambda photos, hull, size: steps._voxels(photos, None))  # type: ignore[arg-type]
    monkeypatch.setattr(steps, "_covered", lambda photos, voxels, masks, rows: [shares(masks, row) for row in rows])
    monkeypatch.setattr(steps, "has_edge", lambda photo: edges is None or photo in edges)
    return mask_agreement(list(range(count)), None)  # type: ignore[arg-type]


def test_masks_agree_that_cover_95_hundredths_and_the_worst_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    assert cutting(monkeypatch, lambda masks, row: 0.95, 4).agreeing == [0, 1, 2, 3]
    found = cutting(monkeypatch, lambda masks, row: 0.94 if 2 in masks else 0.99, 4)
    assert found.agreeing == [0, 1, 3]
    assert found.covered == [0.99] * 4
    assert cutting(monkeypatch, lambda masks, row: 0.94, 4) is None


def test_of_two_that_would_do_the_one_that_lacks_something_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without either the rest is covered alike, to a hundredth."""

    def shares(masks: list[int], row: int) -> float:
        if 1 not in masks or 3 not in masks:
            return 0.99 + 1e-4 * (3 not in masks)
        return 0.5 if row == 1 else 0.99

    assert cutting(monkeypatch, shares, 5).agreeing == [0, 2, 3, 4]


def test_of_two_that_would_do_the_one_with_which_all_others_lack_something_is_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def shares(masks: list[int], row: int) -> float:
        if 1 not in masks or 3 not in masks:
            return 0.99 + 1e-4 * (1 not in masks)
        return 0.99 if row == 3 else 0.5

    assert cutting(monkeypatch, shares, 5).agreeing == [0, 1, 2, 4]


@pytest.mark.parametrize(
    ("count", "good", "agree"),
    [(3, 3, True), (3, 2, True), (4, 3, True), (4, 2, False), (8, 4, True), (8, 3, False), (10, 4, True)],
)
def test_three_masks_of_four_must_agree_and_two_fifths_of_more(
    monkeypatch: pytest.MonkeyPatch, count: int, good: int, agree: bool
) -> None:
    """Of three masks two will do."""
    found = cutting(monkeypatch, lambda masks, row: 0.99 - 0.09 * sum(one >= good for one in masks), count)
    assert (found is not None) == agree
    if agree:
        assert found.agreeing == list(range(good))


def test_two_masks_are_not_told_apart_and_those_without_an_edge_do_not_vote(monkeypatch: pytest.MonkeyPatch) -> None:
    assert cutting(monkeypatch, lambda masks, row: 1.0, 2) is None
    assert cutting(monkeypatch, lambda masks, row: 1.0, 5, {0, 2, 3}).agreeing == [0, 2, 3]


def test_a_photo_that_the_object_fills_does_not_disagree() -> None:
    """Its mask has no edge, and the hull of the others covers it."""
    whole = torch.full((SIDE, SIDE), 255, dtype=torch.uint8)
    part = whole.clone()
    part[:5] = 0
    voxels = Voxels(torch.zeros(1, 3), 1.0, torch.zeros(4, 1, dtype=torch.bool))
    photos = [ahead(part), ahead(whole), ahead(whole), ahead(part)]
    found = Agreement([0], [1.0, 0.95, 0.94, 0.99], voxels, photos)
    assert found.disagreeing == [2, 3]


def ball(radius: float) -> Voxels:
    """Voxels of a ball around the origin that nobody excludes."""
    axis = torch.arange(-1, 1.001, 0.05)
    centers = torch.cartesian_prod(axis, axis, axis)
    centers = centers[centers.norm(dim=1) <= radius]
    return Voxels(centers, 0.05, torch.zeros(3, len(centers), dtype=torch.bool))


def silhouettes(radius: float) -> list[Thumbnail]:
    cameras, photos = ring(3, size=80), []
    for i in range(3):
        camera = cameras[i].to(torch.float32)
        planes = torch.zeros(4, 80, 80, dtype=torch.uint8)
        planes[3][shadow(Thumbnail(camera, planes), ball(radius).centers, 0.05)] = 255
        photos.append(Thumbnail(camera, planes))
    return photos


def test_a_mask_is_admitted_that_leaves_the_agreeing_silhouettes_covered() -> None:
    photos = silhouettes(0.8)
    found = Agreement([0, 1], [1.0] * 3, ball(0.8), photos)
    assert found.admits_mask(photos[2])
    half = Thumbnail(photos[2].camera, photos[2].planes.clone())
    half.planes[3, :40] = 0
    assert not found.admits_mask(half)


def test_a_projection_is_the_shadow_of_what_the_others_leave() -> None:
    photos, voxels = silhouettes(0.8), ball(0.8)
    voxels.excluded[0] = voxels.centers[:, 2] > 0
    voxels.excluded[1] = voxels.centers[:, 2] < 0
    found = Agreement([0, 1], [1.0] * 3, voxels, photos)
    own_left_out = shadow(photos[0], voxels.hull([1]), voxels.size)
    assert torch.equal(found.projection(0), own_left_out)
    both = shadow(photos[2], voxels.hull([0, 1]), voxels.size)
    assert torch.equal(found.projection(2), both)
    assert not torch.equal(own_left_out, shadow(photos[0], voxels.hull([0, 1]), voxels.size))


def test_the_thickness_of_a_hull_counts_its_voxels_along_the_rays() -> None:
    """Two stacks of voxels side by side, one three times as deep; a window of a voxel's edge and its half around."""
    K = intrinsics(1.0, 60, 40).float()
    camera = Cameras(torch.eye(4)[None], K[None], 60, 40)
    depths = torch.linspace(9.99, 10.01, 4)
    near = torch.stack([torch.full((1,), -1.9), torch.zeros(1), depths[:1]], 1)
    deep = torch.stack([torch.full((3,), 1.9), torch.zeros(3), depths[1:]], 1)
    voxels = Voxels(torch.cat([near, deep]), 0.3, torch.zeros(2, 4, dtype=torch.bool))
    photo = Thumbnail(camera, torch.zeros(4, 40, 60, dtype=torch.uint8))
    thick = Agreement([1], [1.0, 1.0], voxels, [photo, photo]).thickness(0)
    column, row, _ = project(camera, torch.cat([near, deep[1:2]]))
    one, three = (thick[int(row[i]), int(column[i])] for i in (0, 1))
    assert float(three / one) == pytest.approx(3, rel=1e-5)
    assert float(one) == pytest.approx(0.5, rel=1e-5)
    reach = math.ceil(0.75 * 0.3 * float(K[0, 0]) / float(depths.median()))
    assert int((thick > 0).sum()) == 2 * (2 * reach + 1) ** 2
