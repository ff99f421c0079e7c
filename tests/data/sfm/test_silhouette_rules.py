"""Numbers of the search for coherent silhouettes: rays, costs, limits, and who is named, each met exactly."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from balls import Ball, picture, ring

from gsopt.data.lookup import lowest
from gsopt.data.outlines import MAX_DISTANCE, Outline
from gsopt.data.sfm import silhouettes
from gsopt.data.sfm.silhouettes import Coherence, coherent_poses, contradicting
from gsopt.geometry.cameras import Cameras

BALL = Ball((0.2, -0.1, 0.15), 0.5)


def outlines(cameras: Cameras, ball: Ball = BALL) -> list[Outline]:
    pictures = [torch.from_numpy(picture(cameras[i], [ball])[..., 3]) for i in range(len(cameras))]
    return [Outline.of(cameras[i], alpha[None] / 255) for i, alpha in enumerate(pictures)]


@pytest.fixture(scope="module")
def coherence() -> Coherence:
    return Coherence(outlines(ring(4)))


@pytest.mark.parametrize("radius", [15, 19, 25, 40, 55, 70, 90, 110])
def test_outline_pixels_are_evenly_spaced_around_a_disk(radius: int) -> None:
    """On it to a tenth of a pixel, as many on each side, and never two or three times as far apart as they are."""
    row, column = (
        (torch.arange(256) + 0.5).expand(256, 256).T - 127.6,
        (torch.arange(256) + 0.5).expand(256, 256) - 128.3,
    )
    alpha = (radius - torch.hypot(row, column) + 0.5).clamp(0, 1)
    outline = Outline.of(Cameras(torch.eye(4)[None], torch.eye(3)[None], 256, 256), alpha[None])
    columns, rows = outline.pixels()
    assert 60 <= len(columns) <= 120
    assert (columns.mean().item(), rows.mean().item()) == pytest.approx((128.3, 127.6), abs=0.03 * radius)
    assert torch.hypot(columns - 128.3, rows - 127.6).tolist() == pytest.approx([radius] * len(rows), abs=0.2)
    angles = torch.atan2(rows - 127.6, columns - 128.3).sort().values
    apart = torch.cat([angles.diff(), angles[:1] + 2 * math.pi - angles[-1:]])
    assert apart.max() < 2.2 * 2 * math.pi / len(angles)


def test_a_near_point_has_its_distance_and_one_behind_the_camera_is_far_outside() -> None:
    intrinsics = torch.tensor([[[100.0, 0, 32], [0, 100, 32], [0, 0, 1]]])
    outline = Outline.of(Cameras(torch.eye(4)[None], intrinsics, 64, 64), torch.ones(1, 64, 64))
    points = torch.tensor([[0.0, 0, 0.01], [0, 0, 0.5], [0, 0, 0], [0, 0, -1]])
    assert lowest([outline.picture], points)[0].tolist() == pytest.approx(
        [MAX_DISTANCE, MAX_DISTANCE, -MAX_DISTANCE, -MAX_DISTANCE], abs=0.5
    )


@pytest.mark.parametrize(("height", "finer"), [(256, 4), (257, 2)])
def test_the_longer_side_decides_how_fine_an_outline_lies(height: int, finer: int) -> None:
    outline = Outline.of(Cameras(torch.eye(4)[None], torch.eye(3)[None], 40, height), torch.ones(1, height, 40))
    assert outline.distance.shape == (1, finer * height, finer * 40)


def test_the_ball_around_an_object_is_the_ball_that_is_seen(coherence: Coherence) -> None:
    assert coherence.center.tolist() == pytest.approx(BALL.center, abs=0.02)
    assert coherence.radius == pytest.approx(BALL.radius, rel=0.05)


def test_64_points_of_each_ray_reach_1_3_radii_before_and_behind_the_middle(coherence: Coherence) -> None:
    depths = coherence.across(coherence.viewmats)
    middle = (coherence.viewmats @ torch.tensor([*coherence.center, 1.0], dtype=torch.float64))[:, 2]
    assert depths.shape[1] == 64
    ends = (depths[:, [0, -1]] - middle[coherence._own][:, None]) / coherence.radius
    assert ends.flatten(0).tolist() == pytest.approx([-1.3, 1.3] * len(depths), abs=1e-9)
    assert depths.diff().flatten().tolist() == pytest.approx(
        [2.6 * coherence.radius / 63] * (63 * len(depths)), rel=1e-6
    )


def test_no_point_of_a_ray_lies_behind_its_camera(coherence: Coherence) -> None:
    """Where the camera stands in the middle of the object, a thousandth of its radius before it is the nearest."""
    inside = coherence.viewmats.clone()
    inside[:, :3, 3] = -(inside[:, :3, :3] @ coherence.center)
    depths = coherence.across(inside)
    assert depths.min(1).values.tolist() == pytest.approx([1e-3 * coherence.radius] * len(depths))
    assert depths.max().item() == pytest.approx(1.3 * coherence.radius)


def test_17_points_are_then_taken_one_step_before_and_behind_the_best(coherence: Coherence) -> None:
    coarse = coherence.across(coherence.viewmats)
    depths = coherence.near_optima(coherence.viewmats)
    distances = coherence.distances(coherence.viewmats, coarse).amin(0)
    assert depths.shape[1] == 17
    step = (coarse[0, 1] - coarse[0, 0]).item()
    best = coarse[torch.arange(len(coarse)), distances.argmax(1)]
    for column, away in ((0, -step), (8, 0.0), (16, step)):
        torch.testing.assert_close(depths[:, column], best + away, atol=1e-9, rtol=0)


def test_a_point_behind_a_camera_is_far_outside_and_one_on_its_own_ray_far_inside(coherence: Coherence) -> None:
    centers = torch.linalg.inv(coherence.viewmats)[:, :3, 3]
    behind = (centers - 2 * (coherence.center - centers))[:, None]
    for view in range(4):
        assert coherence._at(view, coherence.viewmats, behind[view : view + 1]).tolist() == [[-MAX_DISTANCE]]
    found = coherence.distances(coherence.viewmats, coherence.across(coherence.viewmats))
    for ray in (0, len(coherence._own) - 1):
        assert found[coherence._own[ray], ray].tolist() == [MAX_DISTANCE] * 64


def test_misses_among_some_views_are_those_of_their_own_rays_in_their_own_photos(coherence: Coherence) -> None:
    distances = torch.full((4, len(coherence._own), 1), 5.0, dtype=torch.float64)
    distances[3] = -9.0
    first = torch.nonzero(coherence._own == 0)[:, 0]
    distances[1, first] = -2.0
    counts = [int((coherence._own == view).sum()) for view in range(4)]
    assert coherence.misses_among([0, 1, 2], distances) == pytest.approx(2 * math.sqrt(counts[0] / sum(counts[:3])))
    assert coherence.misses_among([1, 2], distances) == 0
    assert coherence.misses_among([2, 3], distances) == pytest.approx(9)


def test_a_miss_costs_its_square_up_to_two_px_and_then_grows_evenly() -> None:
    """A tenth of half the square; 2 (m - 1) beyond. A turn by a degree and a shift by 0.02 cost a half each."""
    none, prior = torch.zeros(6, dtype=torch.float64), torch.full((6,), 4.0, dtype=torch.float64)

    def cost(*misses: float) -> float:
        return silhouettes._cost(torch.tensor(misses, dtype=torch.float64), none, prior)

    assert [cost(miss) for miss in (0, 1, 2, 3, 6)] == pytest.approx([0, 0.05, 0.2, 0.4, 1.0])
    assert cost(1, 2, 3) == pytest.approx(0.65)
    moved = torch.tensor([0.5, 0, 0, 0, 0, 1.0], dtype=torch.float64)
    assert silhouettes._cost(torch.ones(1, dtype=torch.float64), moved, prior) == pytest.approx(0.05 + 2.5)


def test_a_turn_by_a_degree_weighs_as_much_as_a_shift_by_a_fiftieth_of_the_radius(
    coherence: Coherence, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[torch.Tensor] = []
    real = silhouettes._cost

    def cost(misses: torch.Tensor, motions: torch.Tensor, prior: torch.Tensor) -> float:
        seen.append(prior)
        return real(misses, motions, prior)

    monkeypatch.setattr(silhouettes, "_cost", cost)
    monkeypatch.setattr(silhouettes, "COHERENT", 0.0)
    shifted = Coherence(outlines(ring(3, size=48)))
    shifted.viewmats[0, 0, 3] += 0.05
    silhouettes._refined(shifted)
    one = [math.radians(1) ** -2] * 3 + [0.02**-2] * 3
    assert seen[0].tolist() == pytest.approx(one * 3)


@pytest.mark.parametrize(("pixels", "enough"), [(20, True), (19, False)])
def test_every_photo_needs_twenty_outline_pixels(pixels: int, enough: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    counts: Any = [90, pixels, 90]
    monkeypatch.setattr(silhouettes, "outline", lambda n: SimpleNamespace(pixels=lambda: (range(n), range(n))))
    monkeypatch.setattr(silhouettes, "Coherence", len)
    monkeypatch.setattr(silhouettes, "_refined", lambda number: f"{number} refined")
    assert coherent_poses(counts) == ("3 refined" if enough else None)


@pytest.mark.parametrize(
    ("size", "compared"), [((1536, 1024), (512, 341)), ((1000, 2048), (250, 512)), ((512, 300), (512, 300))]
)
def test_masks_are_compared_at_512_px_at_most(size: tuple[int, int], compared: tuple[int, int]) -> None:
    """Half a pixel of alpha stays where it is, as a share of the picture."""
    width, height = size
    pixels = torch.zeros(height, width, 4, dtype=torch.uint8)
    pixels[: height // 2, :, 3] = 255
    K = torch.tensor([[[float(width), 0, width / 2], [0, float(width), height / 2], [0, 0, 1]]])
    view: Any = SimpleNamespace(pixels=lambda: pixels, camera=Cameras(torch.eye(4)[None], K, width, height))
    outline = silhouettes.outline(view)
    assert (outline.camera.width, outline.camera.height) == compared
    assert tuple(outline.alpha.shape) == (1, compared[1], compared[0])
    assert outline.alpha.mean().item() == pytest.approx(0.5, abs=1e-3)
    assert outline.alpha.max().item() == pytest.approx(1)
    assert outline.camera.Ks[0, 0, 0].item() == pytest.approx(compared[0], rel=2e-3)


def named(monkeypatch: pytest.MonkeyPatch, count: int, misses: dict[frozenset[int], float]) -> list[int]:
    """Who is named where so many views miss by this much without some of them."""

    class Missing:
        viewmats = torch.eye(4)[None]

        def __init__(self, views: list[Any]) -> None:
            self.all = frozenset(range(len(views)))

        def across(self, viewmats: Any) -> None: ...

        def distances(self, viewmats: Any, depths: Any) -> None: ...

        def misses_among(self, chosen: list[int], distances: None) -> float:
            return misses.get(self.all - frozenset(chosen), 99.0)

    monkeypatch.setattr(silhouettes, "outline", lambda view: view)
    monkeypatch.setattr(silhouettes, "Coherence", Missing)
    views: Any = list(range(count))
    return contradicting(views)


@pytest.mark.parametrize(
    ("whole", "rest", "found"),
    [(9.0, 2.0, True), (9.0, 2.01, False), (3.0, 1.5, True), (3.0, 1.51, False)],
)
def test_others_agree_that_miss_by_two_px_at_most_and_by_half_of_what_all_miss(
    whole: float, rest: float, found: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    misses = {frozenset[int](): whole, frozenset([2]): rest, frozenset([1]): rest + 1}
    assert named(monkeypatch, 6, misses) == ([2] if found else [])


@pytest.mark.parametrize(("count", "most"), [(3, 0), (4, 1), (5, 2), (6, 2), (7, 3), (8, 3)])
def test_views_are_left_out_one_by_one_while_more_than_half_stay(
    count: int, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three at least, which agree by more than chance."""
    for wrong in range(1, count):
        order = [frozenset(range(left)) for left in range(wrong + 1)]
        misses = {left: 9.0 - 0.1 * row for row, left in enumerate(order[:-1])} | {order[-1]: 0.1}
        assert named(monkeypatch, count, misses) == (list(range(wrong)) if wrong <= most else []), wrong
