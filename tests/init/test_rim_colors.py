"""Tests of photos without the rim of their silhouette."""

from __future__ import annotations

import pytest
import torch

from gsopt.geometry.cameras import Cameras
from gsopt.init import rim_colors
from gsopt.init.inflation import silhouette_distances
from gsopt.init.rim_colors import LEAST_PIXELS, RIM, continued, without_rim
from gsopt.init.thumbnails import Thumbnail

SIDE, RADIUS = 64, 24.0


def disk(rim: float) -> Thumbnail:
    """A red disk with a green rim, on transparent black."""
    y, x = torch.meshgrid(torch.arange(SIDE) + 0.5, torch.arange(SIDE) + 0.5, indexing="ij")
    inset = RADIUS - ((x - SIDE / 2) ** 2 + (y - SIDE / 2) ** 2).sqrt()
    planes = torch.zeros(4, SIDE, SIDE)
    planes[0, inset >= rim], planes[1, (inset > 0) & (inset < rim)], planes[3, inset > 0] = 200, 150, 255
    camera = Cameras(torch.eye(4)[None], torch.eye(3)[None] * 50, SIDE, SIDE)
    return Thumbnail(camera, planes.to(torch.uint8))


def test_the_rim_takes_the_colors_within() -> None:
    found = without_rim(disk(rim=0.6 * RIM * RADIUS)).planes
    assert set(found[0].unique().tolist()) == {200}
    assert set(found[1].unique().tolist()) == {0}
    assert set(found[3].unique().tolist()) == {255}


def test_inner_pixels_keep_their_bits() -> None:
    photo = disk(rim=0.0)
    photo.planes[2, 20:40, 20:40] = torch.arange(20, dtype=torch.uint8)
    assert torch.equal(without_rim(photo).planes[:, 20:40, 20:40], photo.planes[:, 20:40, 20:40])


def test_a_silhouette_that_is_all_rim_stays() -> None:
    photo = disk(rim=0.0)
    thin = photo.planes.clone()
    thin[:, :, int(LEAST_PIXELS) + 1 :] = 0
    photo = Thumbnail(photo.camera, thin)
    assert without_rim(photo) is photo


def test_what_is_unknown_lies_between_what_is_known() -> None:
    planes = torch.zeros(1, 5, 7)
    weight = torch.zeros(1, 5, 7)
    planes[0, :, 0], planes[0, :, 6] = 10.0, 30.0
    weight[0, :, [0, 6]] = 1.0
    found = continued(planes, weight)
    assert torch.equal(found[0, :, 0], torch.full((5,), 10.0))
    assert bool(((found >= 10) & (found <= 30)).all())
    assert bool((found[0, :, 5] > found[0, :, 1]).all())


@pytest.mark.parametrize(
    ("shape", "measured"), [((120, 400), (60, 200)), ((400, 120), (200, 60)), ((200, 90), (200, 90))]
)
def test_distances_are_measured_on_200_px_at_most(
    shape: tuple[int, int], measured: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are exact up to 90 px: the longer side decides."""
    seen: list[tuple[int, ...]] = []

    def watched(solid: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        seen.append(tuple(solid.shape))
        return silhouette_distances(solid)

    monkeypatch.setattr(rim_colors, "silhouette_distances", watched)
    planes = torch.zeros(4, *shape, dtype=torch.uint8)
    planes[3, 5:-5, 5:-5] = 255
    without_rim(Thumbnail(Cameras(torch.eye(4)[None], torch.eye(3)[None] * 50, shape[1], shape[0]), planes))
    assert seen == [measured]
