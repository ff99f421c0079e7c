"""The matching kernel against a float64 one that is written down plainly."""

from __future__ import annotations

import pytest
import textured_room as room
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from gsopt.geometry.cameras import Cameras
from gsopt.init.stereo.image import StereoImage
from gsopt.init.stereo.matching import LEAST_VARIANCE, TAPS, UNSEEN_COST, Matcher, windows
from gsopt.raster import _cpu
from gsopt.raster.cpu_backend import ISA_VARIABLE, workspace

EPSILON = 2.0**-24
"""Half a unit in the last place of 1 in float32."""
PLACE_ROUNDINGS = 48
"""A tap's place is a quotient of sums of products: some 24 roundings, of numbers as large as the image, in each half.
Brightness changes by about the window's own deviation per pixel, so the cost by as much as the place in pixels."""
VARIANCE_ROUNDINGS = 12
"""The variance is mean square less squared mean: E[v²] / variance times the roundings of two sums of 25 (a deviation
of 3 in all, four of them) are its relative error, of which the correlation has as large a share."""
BORDER = 1e-3
"""Windows whose outermost tap lies so near the other image's border, in pixels, are left out: it decides all."""


def image(seed: int, viewmat: Tensor, width: int = 40, height: int = 30) -> StereoImage:
    generator = torch.Generator().manual_seed(seed)
    K = torch.tensor([[1.1 * width, 0, 0.45 * width], [0, 1.2 * width, 0.55 * height], [0, 0, 1]])
    coarse = torch.rand(1, 3, 6, 8, generator=generator)
    rgb = torch.nn.functional.interpolate(coarse, (height, width), mode="bilinear")[0]
    return StereoImage(Cameras(viewmat[None].float(), K[None], width, height), rgb)


def moved(seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    x, y, z = (torch.rand(3, generator=generator, dtype=torch.float64) - 0.5) * 0.3
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = torch.matrix_exp(skew)
    motion[:3, 3] = (torch.rand(3, generator=generator, dtype=torch.float64) - 0.5) * 0.6
    return motion


def plain_costs(reference: StereoImage, source: StereoImage, planes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Cost of every pixel in float64, how near its window comes to the source's border (px), and E[v²] / variance."""
    weights, centered = (t.double() for t in windows(reference.gray))
    K, K2 = reference.camera.Ks[0].double(), source.camera.Ks[0].double()
    motion = source.camera.viewmats[0].double() @ torch.linalg.inv(reference.camera.viewmats[0].double())
    values, slack = [], []
    for dx, dy in TAPS:
        column, row = (each.double() + d for each, d in zip(reference.pixels, (dx, dy), strict=True))
        x, y = (column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1]
        depth = 1 / (planes[0] * x + planes[1] * y + planes[2])
        there = torch.stack([x * depth, y * depth, depth], -1) @ motion[:3, :3].T + motion[:3, 3]
        seen = there @ K2.T
        u, v = seen[..., 0] / seen[..., 2], seen[..., 1] / seen[..., 2]
        height, width = source.gray.shape
        grid = torch.stack([u * 2 / width - 1, v * 2 / height - 1], -1)
        image = source.gray.double()[None, None]
        values.append(
            torch.nn.functional.grid_sample(image, grid[None], padding_mode="border", align_corners=False)[0, 0]
        )
        room_left = torch.stack([u - 0.5, width - 0.5 - u, v - 0.5, height - 0.5 - v]).amin(0)
        # The sign of the depth along the ray: behind the source where a point is on the other side of its own camera.
        slack.append(torch.where(there[..., 2] / depth > 0, room_left, -100.0))
    value = torch.stack(values)
    difference = value - (weights * value).sum(0)
    variance, own = (weights * difference.square()).sum(0), (weights * centered.square()).sum(0)
    product = (weights * centered * difference).sum(0)
    cost = 1 - product / ((variance + LEAST_VARIANCE) * (own + LEAST_VARIANCE)).sqrt()
    least = torch.stack(slack).amin(0)
    condition = (weights * value.square()).sum(0) / (variance + LEAST_VARIANCE)
    return torch.where(least >= 0, cost, UNSEEN_COST), least, condition


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
@example(seed=89)
@pytest.mark.parametrize("isa", _cpu.instruction_sets())
def test_costs_are_those_of_float64(isa: str, seed: int) -> None:
    reference, source = image(seed, torch.eye(4)), image(seed + 1, moved(seed))
    generator = torch.Generator().manual_seed(seed)
    planes = torch.rand(3, *reference.gray.shape, generator=generator) * torch.tensor([0.4, 0.4, 1.0])[:, None, None]
    planes[2] += 0.3
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(ISA_VARIABLE, isa)
        (cost,) = Matcher(reference, [source], workspace(1)).costs(planes)
    wanted, slack, condition = plain_costs(reference, source, planes.double())
    decided = slack.abs() > BORDER
    assert float(decided.double().mean()) > 0.98
    seen = wanted < UNSEEN_COST
    assert bool((cost == UNSEEN_COST)[decided & ~seen].all())
    roundings = PLACE_ROUNDINGS * reference.gray.shape[1] + VARIANCE_ROUNDINGS * (1 - wanted).abs() * condition
    errors = ((cost - wanted).abs() / (EPSILON * roundings))[decided & seen]
    assert errors.numel() == 0 or float(errors.max()) < 1


def test_some_windows_are_seen_and_some_are_not() -> None:
    """Else the test above would compare constants."""
    reference, source = image(3, torch.eye(4)), image(3, moved(3))
    planes = torch.zeros(3, *reference.gray.shape)
    planes[2] = 0.8
    wanted, _, _ = plain_costs(reference, source, planes.double())
    assert 0.2 < float((wanted < UNSEEN_COST).double().mean()) < 0.98


def test_a_image_matches_itself_and_not_its_negative() -> None:
    one = image(5, torch.eye(4))
    negative = StereoImage(one.camera, 1 - one.rgb)
    planes = torch.ones(3, *one.gray.shape)
    same, opposite = Matcher(one, [one, negative], workspace(1)).costs(planes)
    seen = same < UNSEEN_COST
    textured = windows(one.gray)[1].square().mean(0) > 1e-3
    assert bool((seen & textured).any())
    assert float(same[seen & textured].max()) < 0.02
    assert float(opposite[seen & textured].min()) > 1.98


def test_what_shows_nothing_matches_nothing() -> None:
    blank = StereoImage(image(1, torch.eye(4)).camera, torch.full((3, 30, 40), 0.4))
    (cost,) = Matcher(blank, [blank], workspace(1)).costs(torch.ones(3, 30, 40))
    assert float((cost[cost < UNSEEN_COST] - 1).abs().max()) < 0.05


def test_planes_that_are_not_numbers_or_lie_behind_are_unseen() -> None:
    one = image(2, torch.eye(4))
    for value in (float("nan"), float("inf"), -float("inf")):
        planes = torch.full((3, 30, 40), value)
        (cost,) = Matcher(one, [image(2, moved(2))], workspace(1)).costs(planes)
        assert bool((cost == UNSEEN_COST).all())


def test_the_rooms_own_floor_matches_better_than_another(tmp_path) -> None:
    from rooms import room_scene

    from gsopt.init.thumbnails import small_photos

    scene = room_scene(tmp_path / "room", room.arc(4))
    first, second = (StereoImage.of(photo, 8000) for photo in small_photos(scene.train, 4)[:2])
    R, center = first.camera.viewmats[0, :3, :3], first.camera.centers[0]
    # The floor z = 0 seen from the camera: depth * (Rᵀ ray)_z + center_z = 0.
    floor = [(-R[k, 2] / center[2]).item() for k in range(3)]
    planes = torch.tensor(floor)[:, None, None].expand(3, *first.gray.shape)
    true, wrong = (Matcher(first, [second], workspace(1)).costs(scale * planes)[0] for scale in (1.0, 1.1))
    bottom = first.gray.shape[0] * 3 // 4  # the last rows show only the floor
    assert float(true[bottom:].median()) < 0.15
    assert float(wrong[bottom:].median()) > 0.5
