"""Depths that photos confirm, with maps made by hand: cameras side by side before a wall."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gsopt.geometry.cameras import Cameras
from gsopt.init.stereo.agreement import LEAST_BESIDE, LEAST_STRUCTURE, NEIGHBORHOOD, agreed
from gsopt.init.stereo.image import StereoImage
from gsopt.init.stereo.search import PlaneMap

HEIGHT, WIDTH, FOCAL = 48, 64, 50.0
WALL, NEAR = 4.0, 2.0
UNMATCHED = 1.0


def map_of(x: float, y: float, rgb: torch.Tensor) -> PlaneMap:
    """The wall as a camera at (x, y, 0) shows it that looks along z, matched everywhere."""
    viewmat = torch.eye(4)
    viewmat[:2, 3] = -torch.tensor([x, y])
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    planes = torch.zeros(3, HEIGHT, WIDTH)
    planes[2] = 1 / WALL
    image = StereoImage(Cameras(viewmat[None], K[None], WIDTH, HEIGHT), rgb)
    return PlaneMap(image, planes, torch.zeros(HEIGHT, WIDTH))


@pytest.fixture
def plain() -> torch.Tensor:
    return torch.full((3, HEIGHT, WIDTH), 0.5)


def test_a_wall_that_all_match_is_believed(plain: torch.Tensor) -> None:
    for kept in agreed([map_of(-0.1, 0, plain), map_of(0.1, 0, plain)]):
        assert float(kept.float().mean()) > 0.9


@pytest.mark.parametrize("knows_better", [True, False])
def test_a_point_that_more_photos_see_through_is_not_believed(plain: torch.Tensor, knows_better: bool) -> None:
    """Two photos agree on a patch in the air; two others see the wall behind it, or nothing."""
    left, right, below, above = (map_of(*at, plain) for at in ((-0.1, 0.0), (0.1, 0.0), (0.0, -0.1), (0.0, 0.1)))
    shift = round(FOCAL * 0.2 / NEAR)
    patch = slice(18, 26), slice(28, 40)
    left.planes[2][patch] = 1 / NEAR
    right.planes[2][18:26, 28 - shift : 40 - shift] = 1 / NEAR
    if not knows_better:
        below, above = (replace(each, costs=torch.full_like(each.costs, UNMATCHED)) for each in (below, above))
    believed = agreed([left, right, below, above])[0][patch]
    assert float(believed.float().mean()) == (0 if knows_better else 1)


@pytest.mark.parametrize("structured", [True, False])
def test_a_speck_is_believed_where_the_photo_has_structure(plain: torch.Tensor, structured: bool) -> None:
    noise = torch.rand(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    here, other = (map_of(x, 0, noise if structured else plain) for x in (-0.1, 0.1))
    here.costs[:, 20:] = UNMATCHED
    speck = slice(30, 32), slice(50, 52)
    assert LEAST_BESIDE * NEIGHBORHOOD**2 > 4
    here.costs[speck] = 0
    kept = agreed([here, other])[0]
    assert bool(kept[speck].all()) == bool(kept[speck].any()) == structured
    assert float(kept[:, 5:20].float().mean()) > 0.9, "a large part needs no structure"
    assert not bool(kept[:, 20:45].any())


def test_structure_is_what_changes_in_every_direction(plain: torch.Tensor) -> None:
    columns = torch.linspace(0, 1, WIDTH).expand(3, HEIGHT, -1).contiguous()
    edge, noise = plain.clone(), torch.rand(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1))
    edge[:, :, 30:] = 0.9
    for rgb in (plain, columns, edge):
        assert float(map_of(0, 0, rgb).image.structure.max()) < 0.1 * LEAST_STRUCTURE
    assert float(map_of(0, 0, noise).image.structure.min()) > LEAST_STRUCTURE
    corner = plain.clone()
    corner[:, 24:, 30:] = 0.9
    found = map_of(0, 0, corner).image.structure
    assert float(found[22:26, 28:32].min()) > LEAST_STRUCTURE
    assert float(found[:15].max()) < 0.1 * LEAST_STRUCTURE


def test_no_photo_and_a_single_one_confirm_nothing(plain: torch.Tensor) -> None:
    assert agreed([]) == []
    assert not bool(agreed([map_of(0, 0, plain)])[0].any())
