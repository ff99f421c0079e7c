"""Steps of the search for planes: which candidates are taken, how voxels share a pixel, and how a step is damped."""

from __future__ import annotations

import itertools
import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from test_symmetry_limits import blocks, photo
from torch import Tensor

from gsopt.geometry.cameras import Cameras, look_at
from gsopt.geometry.projection import inside, project
from gsopt.geometry.voxels import Grid
from gsopt.symmetry import search
from gsopt.symmetry.mirror import Mirror
from gsopt.symmetry.search import Ball, candidates, half_circle, refined
from gsopt.symmetry.silhouettes import Silhouettes, _rays

CENTER = torch.tensor([1.0, 2.0, 3.0])
BALL = Ball(CENTER, 10.0)


def found(normals: Tensor, shares: Any, monkeypatch: pytest.MonkeyPatch, apart: float = 20.0) -> list[Any]:
    """The candidates where a function of factor, normal and offset from the center says what is left unexplained."""

    def uncovered(factor: int, photos: Any, normals: Tensor, offsets: Tensor) -> Tensor:
        assert photos == "photos"
        around = offsets - (normals * CENTER).sum(1)
        return torch.tensor([shares(factor, n, float(d)) for n, d in zip(normals.tolist(), around, strict=True)])

    monkeypatch.setattr(search, "joined", lambda grid, factor: factor)
    monkeypatch.setattr(search, "uncovered", uncovered)
    return candidates(None, "photos", BALL, normals, apart)  # type: ignore[arg-type]


def directions(*degrees: float) -> Tensor:
    angles = torch.tensor(degrees).deg2rad()
    return torch.stack([angles.cos(), angles.sin(), torch.zeros_like(angles)], 1)


def test_thirteen_planes_across_two_fifths_of_the_radius_are_tried_for_every_direction(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """First on voxels joined by six; those that are not hopeless again, joined by three."""
    tried: list[tuple[int, float, float]] = []

    def shares(factor: int, normal: list[float], offset: float) -> float:
        tried.append((factor, round(normal[0], 3), round(offset, 3)))
        return 0.1 if normal[0] > 0.9 else 0.11

    assert found(directions(0, 90), shares, monkeypatch) == []
    offsets = [round(-2 + 4 * i / 12, 3) for i in range(13)]
    assert [one for one in tried if one[0] == 6] == [(6, x, d) for x in (1.0, 0.0) for d in offsets]
    assert [one for one in tried if one[0] == 3] == [(3, 1.0, d) for d in offsets]
    assert len(tried) == 39
    assert found(directions(90), shares, monkeypatch) == []


def test_the_best_planes_come_first_and_each_direction_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The plane at 0 degrees that explains most; one 19 degrees off is the same, one 21 degrees off is another."""

    def shares(factor: int, normal: list[float], offset: float) -> float:
        degrees = math.degrees(math.atan2(normal[1], normal[0]))
        return 0.01 + abs(offset - 1) / 100 + (0.02 if degrees > 20 else 0.0)

    mirrors = found(directions(21, 19, 0), shares, monkeypatch)
    assert [round(math.degrees(math.atan2(float(m.normal[1]), float(m.normal[0])))) for m in mirrors] == [19]
    mirrors = found(directions(21, 0), shares, monkeypatch)
    assert [round(math.degrees(math.atan2(float(m.normal[1]), float(m.normal[0])))) for m in mirrors] == [0, 21]
    for mirror in mirrors:
        assert mirror.offset - float(mirror.normal @ CENTER) == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize(("share", "taken"), [(0.0499, True), (0.0501, False)])
def test_a_candidate_leaves_a_twentieth_unexplained_at_most(
    share: float, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    mirrors = found(directions(0), lambda factor, *_: 0.1 if factor == 6 else share, monkeypatch)
    assert len(mirrors) == int(taken)


def test_six_candidates_are_taken_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    eight = torch.nn.functional.normalize(torch.randn(8, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    assert len(found(eight, lambda *_: 0.0, monkeypatch, apart=0.1)) == 6
    assert len(found(eight[:5], lambda *_: 0.0, monkeypatch, apart=0.1)) == 5


def test_directions_across_an_axis_turn_towards_its_left() -> None:
    up = torch.tensor([0.0, 0.0, 1.0])
    around = half_circle(4, up)
    for before, after in itertools.pairwise(around):
        assert float(torch.linalg.cross(before, after) @ up) == pytest.approx(math.sin(math.pi / 4), abs=1e-5)


@pytest.mark.parametrize("side", [24, 25])
def test_two_voxels_share_a_pixel_where_they_share_its_row_and_column(side: int) -> None:
    """Pixels a voxel wide, over the whole image, and its border too."""
    shown, voxel = photo(20, side=side), 0.3
    line = torch.linspace(-1.6, 1.6, 15)
    centers = torch.cartesian_prod(line, line, line[::3])
    rows, pixel, count = search._pixels(shown, centers, voxel)
    column, row, depth = project(shown.camera, centers)
    assert rows.tolist() == torch.nonzero(inside(shown.camera, column, row, depth))[:, 0].tolist()
    step = voxel * float(shown.camera.Ks[0, 0, 0]) / float(depth[rows].median())
    assert step > 1
    cells = [(int(row[i] / step), int(column[i] / step)) for i in rows.tolist()]
    numbers = {}
    for cell, number in zip(cells, pixel.tolist(), strict=True):
        assert numbers.setdefault(cell, number) == number
    assert sorted(numbers.values()) == list(range(count))
    assert count == len(set(cells))


def test_a_pixel_is_no_finer_than_the_photos_own() -> None:
    shown = photo(0)
    centers = Grid(torch.ones(3, 3, 3, dtype=torch.bool), torch.full((3,), -0.03), 0.02).centers()
    rows, _, count = search._pixels(shown, centers, 0.02)
    column, row, _ = project(shown.camera, centers)
    places = {(int(row[i]), int(column[i])) for i in rows.tolist()}
    assert count == len(places)


class Tried:
    """A plane that moves along one number, and all numbers that were tried."""

    freedom = 1

    def __init__(self, at: float, log: list[float]) -> None:
        self.at, self.log = at, log

    def moved(self, change: Tensor, center: Tensor, radius: float) -> Tried:
        self.log.append(float(change[0]))
        return Tried(self.at + float(change[0]), self.log)


def test_a_step_that_helps_nothing_is_damped_four_times_and_given_up() -> None:
    """Misses of slope 1 at 1, and 2 everywhere else: steps of 1 / (1 + damping), each four times as damped."""
    tried: list[float] = []

    def misses(plane: Tried, near: Any) -> Tensor:
        there = plane.at if abs(plane.at - 1) < 0.01 else 2.0
        return torch.full((3,), there, dtype=torch.float64)

    outlines: Any = SimpleNamespace(near_optima=lambda plane: None, misses=misses)
    refined(Tried(1.0, tried), outlines, Ball(torch.zeros(3), 1.0), 1e9)  # type: ignore[type-var]
    steps = [-step for step in tried if abs(step) > 0.01]
    assert steps == pytest.approx([1 / (1 + 0.01 * 4**k) for k in range(4)], rel=1e-3)


def test_a_step_that_helps_is_damped_less_next_time() -> None:
    """Misses x: each step leaves damping / (1 + damping) of them, and the damping falls to a quarter."""
    tried: list[float] = []
    outlines: Any = SimpleNamespace(
        near_optima=lambda plane: None, misses=lambda plane, near: torch.full((3,), plane.at, dtype=torch.float64)
    )
    refined(Tried(1000.0, tried), outlines, Ball(torch.zeros(3), 1.0), 1e9)  # type: ignore[type-var]
    steps = [-step for step in tried if abs(abs(step) - 2e-3) > 1e-6]
    left = [1000.0]
    for step in steps[:2]:
        left.append(left[-1] - step)
    assert left[1] / left[0] == pytest.approx(0.01 / 1.01, rel=1e-2)
    assert left[2] / left[1] == pytest.approx(0.0025 / 1.0025, rel=2e-2)


def test_voxels_join_into_coarser_ones_of_the_same_corner() -> None:
    assert search.joined(blocks(), 6).occupied.shape == (1, 1, 1)


def test_rays_pass_their_pixels_whatever_the_lens() -> None:
    """Their samples lie within the radius of a center that is not the origin, along the view."""
    eye, center = torch.tensor([[4.0, 1.0, 0.5]]), torch.tensor([0.3, -0.2, 0.4])
    viewmat = look_at(eye, torch.tensor([0.5, 0.2, 0.0]), torch.tensor([0.0, 0, 1]))
    K = torch.tensor([[60.0, 0, 13], [0, 45, 31], [0, 0, 1]])
    camera = Cameras(viewmat, K[None], 50, 40)
    pixels = torch.tensor([3.5, 20.5, 49.5]), torch.tensor([39.5, 0.5, 17.5])
    outline: Any = SimpleNamespace(camera=camera, pixels=lambda: pixels)
    origins, directions, depths = _rays(outline, center, 1.25)
    middle = float(viewmat[0, 2, :3] @ center + viewmat[0, 2, 3])
    torch.testing.assert_close(depths, torch.linspace(middle - 1.25, middle + 1.25, 64).expand(3, 64))
    for sample in (0, 31, 63):
        column, row, depth = project(camera, origins + directions * depths[:, sample, None])
        torch.testing.assert_close(torch.stack([column, row]), torch.stack(pixels), atol=1e-3, rtol=0)
        torch.testing.assert_close(depth, depths[:, sample])
    assert float(_rays(outline, center, 50.0)[2][0, 0]) == pytest.approx(1e-3 * middle, rel=1e-4)


@pytest.mark.parametrize("best", [0, 20, 63])
def test_nine_points_are_tried_around_the_best_sample_as_far_as_the_next(
    best: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: Any = object.__new__(Silhouettes)
    depths = torch.linspace(2.0, 5.15, 64).expand(1, 64)
    found._origins, found._directions, found._depths = torch.zeros(1, 3), torch.tensor([[0.5, 0.0, 1.0]]), depths
    found._pictures = [None]
    found._kept = torch.ones(1, 64, dtype=torch.bool)
    found._kept_points, found._kept_others = found._points(depths)[found._kept], torch.full((64,), 3.0)
    values = -(torch.arange(64) - best).abs().float()
    monkeypatch.setattr(Silhouettes, "_behind", lambda self, mirror, points: values)
    near = found.near_optima(Mirror(torch.tensor([1.0, 0, 0]), 0.0))
    expected = float(depths[0, best]) + 0.05 * torch.linspace(-1, 1, 9)
    torch.testing.assert_close(near.points[0, :, 2], expected)
    torch.testing.assert_close(near.points[0, :, 0], 0.5 * expected)


def test_points_that_other_photos_exclude_by_more_than_a_pixel_and_a_half_are_not_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    others = torch.linspace(-3.0, 3.0, 64)
    monkeypatch.setattr(Silhouettes, "_among_others", lambda self, points: others.expand(points.shape[:-1]))
    outlined = Silhouettes([photo(0), photo(90)], torch.zeros(3), 1.5)
    assert torch.equal(outlined._kept, (others > -1.5).expand(outlined._kept.shape))
    assert len(outlined._kept_points) == len(outlined._kept_others) == int(outlined._kept.sum())
    assert float(outlined._kept_others.min()) > -1.5
