"""Search and agreement of symmetries against slow formulas, and the angles and shares at which they decide."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from gsopt.data import outlines
from gsopt.data.lookup import lowest
from gsopt.data.outlines import MAX_DISTANCE, Outline
from gsopt.errors import InputError
from gsopt.geometry.cameras import Cameras, intrinsics, look_at
from gsopt.geometry.projection import inside, project
from gsopt.geometry.voxels import Grid
from gsopt.init.thumbnails import Thumbnail
from gsopt.raster import _cpu  # type: ignore[attr-defined]
from gsopt.symmetry import colors, find, search, silhouettes, upright
from gsopt.symmetry.mirror import Mirror
from gsopt.symmetry.search import Ball, bounding_ball, half_circle, half_sphere, joined, refined, same, uncovered
from gsopt.symmetry.symmetry import Symmetry


def photo(azimuth: float, side: int = 24, solid: tuple[slice, slice] = (slice(4, 20), slice(6, 18))) -> Thumbnail:
    a = math.radians(azimuth)
    eye = torch.tensor([[4 * math.cos(a), 4 * math.sin(a), 1.0]])
    viewmat = look_at(eye, torch.zeros(3), torch.tensor([0.0, 0, 1]))
    planes = torch.zeros(4, side, side, dtype=torch.uint8)
    planes[3][solid] = 255
    return Thumbnail(Cameras(viewmat, intrinsics(0.6, side, side)[None].float(), side, side), planes)


def blocks(seed: int = 0) -> Grid:
    occupied = torch.rand(5, 4, 6, generator=torch.Generator().manual_seed(seed)) < 0.5
    return Grid(occupied, torch.tensor([-0.5, -0.4, -0.6]), 0.2)


def test_directions_are_spread_over_the_half_sphere_by_golden_angles() -> None:
    found = half_sphere(50)
    assert found.norm(dim=1).tolist() == pytest.approx([1] * 50)
    assert found[:, 2].tolist() == pytest.approx([(i + 0.5) / 50 for i in range(50)])
    turns = torch.atan2(found[:, 1], found[:, 0])
    golden = math.pi * (3 - math.sqrt(5))
    apart = (turns[1:] - turns[:-1] - golden + math.pi) % (2 * math.pi) - math.pi
    assert float(apart.abs().max()) < 1e-4


def test_directions_are_spread_over_the_half_circle_across_an_axis() -> None:
    up = torch.tensor([2.0, 3, 6]) / 7
    found = half_circle(12, up)
    assert float((found @ up).abs().max()) < 1e-6
    assert found.norm(dim=1).tolist() == pytest.approx([1] * 12)
    angles = (found @ found[0]).clamp(-1, 1).acos()
    assert angles.tolist() == pytest.approx([math.pi * i / 12 for i in range(12)], abs=1e-3)


@pytest.mark.parametrize(("degrees", "alike"), [(9.9, True), (10.1, False), (170.1, True), (169.9, False)])
def test_planes_are_the_same_within_an_angle_whichever_way_their_normals_point(degrees: float, alike: bool) -> None:
    a = math.radians(degrees)
    one, other = Mirror(torch.tensor([1.0, 0, 0]), 0.0), Mirror(torch.tensor([math.cos(a), math.sin(a), 0]), 0.3)
    assert same(one, other, 10.0) == alike


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_coarser_voxels_are_true_where_any_of_theirs_is(factor: int) -> None:
    grid = blocks()
    found = joined(grid, factor)
    assert found.voxel == pytest.approx(0.2 * factor)
    assert torch.equal(found.low, grid.low)
    assert list(found.occupied.shape) == [-(-size // factor) for size in grid.occupied.shape]
    for x, y, z in torch.cartesian_prod(*(torch.arange(size) for size in found.occupied.shape)).tolist():
        own = grid.occupied[tuple(slice(factor * i, factor * i + factor) for i in (x, y, z))]
        assert bool(found.occupied[x, y, z]) == bool(own.any())


def test_the_ball_holds_every_voxel_and_one_more() -> None:
    grid = blocks()
    ball = bounding_ball(grid)
    assert ball.center.tolist() == pytest.approx(grid.centers().mean(0).tolist())
    assert ball.radius == pytest.approx(float((grid.centers() - ball.center).norm(dim=1).max()) + 0.2)


def share_by_hand(grid: Grid, shown: Thumbnail, normal: Tensor, offset: float) -> float:
    """Share of a photo's pixels, a voxel wide, that no voxel covers whose image lies next to another."""
    centers = grid.centers()
    column, row, depth = project(shown.camera, centers)
    seen = inside(shown.camera, column, row, depth)
    step = max(1.0, grid.voxel * float(shown.camera.Ks[0, 0, 0]) / float(depth[seen].median()))
    pixels: dict[tuple[int, int], bool] = {}
    for i, center in enumerate(centers):
        if not bool(seen[i]):
            continue
        there = center - 2 * (float(center @ normal) - offset) * normal
        cell = [math.floor(v) for v in ((there - grid.low) / grid.voxel).tolist()]
        near = False
        for x, y, z in torch.nonzero(grid.occupied).tolist():
            near = near or max(abs(x - cell[0]), abs(y - cell[1]), abs(z - cell[2])) <= 1
        inner = all(0 <= c < size for c, size in zip(cell, grid.occupied.shape, strict=True))
        key = int(float(column[i]) / step), int(float(row[i]) / step)
        pixels[key] = pixels.get(key, False) or (near and inner)
    return 1 - sum(pixels.values()) / len(pixels)


@pytest.mark.parametrize("isa", _cpu.instruction_sets())
@pytest.mark.parametrize("offset", [-0.35, 0.02, 0.31])
def test_what_a_plane_leaves_unexplained_is_counted_pixel_by_pixel(
    offset: float, isa: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There are more planes than bits in a word of the kernel."""
    monkeypatch.setenv("GSOPT_ISA", isa)
    grid = Grid(blocks(3).occupied & (torch.arange(6) < 4), blocks().low, 0.2)
    photos = [photo(20), photo(140)]
    normals = half_sphere(66)
    found = uncovered(grid, photos, normals, torch.full((66,), offset))
    expected = [sum(share_by_hand(grid, one, normal, offset) for one in photos) / 2 for normal in normals]
    assert found.tolist() == pytest.approx(expected, abs=1e-6)
    assert max(expected) > 0


def test_a_photo_that_shows_nothing_leaves_nothing_unexplained() -> None:
    far = Grid(torch.ones(2, 2, 2, dtype=torch.bool), torch.tensor([900.0, 900, 900]), 0.1)
    assert uncovered(far, [photo(0)], torch.tensor([[1.0, 0, 0]]), torch.zeros(1)).tolist() == [0]


@dataclass(frozen=True)
class Slider:
    """A plane that slides along one number, and whose misses are a function of it."""

    at: float
    freedom = 1

    def moved(self, change: Tensor, center: Tensor, radius: float) -> Slider:
        return Slider(self.at + radius * float(change[0]))


def sliding(start: float, wanted: float, misses: Any) -> tuple[Slider, float]:
    outlines: Any = SimpleNamespace(near_optima=lambda slider: None, misses=lambda slider, near: misses(slider.at))
    found, left = refined(Slider(start), outlines, Ball(torch.zeros(3), 1.0), wanted)  # type: ignore[type-var]
    return found, left  # type: ignore[return-value]


def test_a_refinement_steps_as_gauss_and_newton_do_and_gives_up_what_stays_far() -> None:
    """Every undamped step takes 1 from the x of misses e^x: after four steps a hopeless plane is left alone."""

    def steep(x: float) -> Tensor:
        return torch.full((5,), math.exp(x), dtype=torch.float64)

    found, left = sliding(3.0, 1e-9, steep)
    damped = [1 / (1 + 1e-2 / 4**i) for i in range(4)]
    assert found.at == pytest.approx(3.0 - sum(damped), abs=0.02)
    assert left == pytest.approx(math.exp(found.at), rel=1e-5)
    near, _ = sliding(3.0, 1e9, steep)
    assert near.at == pytest.approx(3.0 - 15, abs=0.1)


def test_a_refinement_arrives_where_nothing_is_missed_and_stays_where_nothing_helps() -> None:
    found, left = sliding(0.7, 1.0, lambda x: torch.tensor([x - 0.2, 2 * (x - 0.2)]))
    assert found.at == pytest.approx(0.2, abs=2e-3)
    assert left < 1e-2
    still, left = sliding(0.7, 1.0, lambda x: torch.tensor([3.0, 4.0]))
    assert still.at == 0.7
    assert left == pytest.approx(math.sqrt(12.5))


@pytest.mark.parametrize(
    ("turns", "degrees", "fits"),
    [
        (2, 88.1, True), (2, 87.9, False), (2, 46.0, False), (2, 3.0, False),
        (4, 43.1, True), (4, 42.9, False), (4, 89.0, True), (4, 0.5, False),
        (6, 31.9, True), (6, 32.1, False), (6, 60.0, True), (6, 14.9, False), (6, 1.0, False),
    ],
)  # fmt: skip
def test_mirrors_of_a_thing_stand_at_the_angles_of_its_turns(turns: int, degrees: float, fits: bool) -> None:
    a = math.radians(degrees)
    one, other = Mirror(torch.tensor([1.0, 0, 0]), 0.0), Mirror(torch.tensor([-math.cos(a), math.sin(a), 0]), 0.0)
    assert upright._fits(one, other, turns) == fits


def test_the_radius_of_a_silhouette_is_half_the_diagonal_of_its_box() -> None:
    assert upright._silhouette_radius(photo(0, solid=(slice(3, 6), slice(10, 14)))) == pytest.approx(2.5)
    assert upright._silhouette_radius(photo(0, solid=(slice(0, 24), slice(0, 10)))) == pytest.approx(13.0)


@pytest.mark.parametrize(
    ("places", "margin", "span"),
    [([], 2, (0, 0)), ([3], 0, (3, 4)), ([3], 2, (1, 6)), ([1, 5], 2, (0, 8)), ([0, 9], 1, (0, 11))],
)
def test_a_span_reaches_a_margin_beyond_both_ends(places: list[int], margin: int, span: tuple[int, int]) -> None:
    occupied = torch.zeros(10, dtype=torch.bool)
    occupied[places] = True
    found = outlines._span(occupied, margin)
    assert (found.start, found.stop) == span


def outline_of(thumbnail: Thumbnail) -> Outline:
    return Outline.of(thumbnail.camera, thumbnail.alpha())


@pytest.mark.parametrize(("side", "finer"), [(256, 4), (257, 2)])
def test_outlines_are_four_times_finer_up_to_1024(side: int, finer: int) -> None:
    assert outline_of(photo(0, side=side)).distance.shape == (1, finer * side, finer * side)


def test_what_lies_behind_a_camera_is_far_outside() -> None:
    outline = outline_of(photo(0))
    behind = torch.tensor([[9.0, 0, 1], [40.0, 3, 2]])
    assert lowest([outline.picture], behind)[0].tolist() == [-MAX_DISTANCE, -MAX_DISTANCE]
    assert float(lowest([outline.picture], torch.zeros(1, 3))[0]) > 0


def test_rays_run_through_the_object_from_its_near_to_its_far_side() -> None:
    outline = outline_of(photo(30))
    origins, directions, depths = silhouettes._rays(outline, torch.zeros(3), 1.5)
    camera = outline.camera
    distance = math.hypot(4, 1)
    assert depths[0, 0] == pytest.approx(distance - 1.5, rel=1e-5)
    assert depths[0, -1] == pytest.approx(distance + 1.5, rel=1e-5)
    points = origins + directions * depths[:, 7:8]
    column, row, depth = project(camera, points)
    found = outline.pixels()
    torch.testing.assert_close(column, found[0], atol=1e-3, rtol=0)
    torch.testing.assert_close(row, found[1], atol=1e-3, rtol=0)
    torch.testing.assert_close(depth, depths[:, 7], atol=1e-4, rtol=0)
    near = silhouettes._rays(outline, torch.zeros(3), 9.0)[2]
    assert near[0, 0] == pytest.approx(1e-3 * distance, rel=1e-4)


def test_a_few_rays_of_each_photo_outline_something() -> None:
    least = SimpleNamespace(_origins=torch.zeros(40, 3), outlines=[None, None])
    assert silhouettes.Silhouettes.outline_something.fget(least)  # type: ignore[attr-defined]
    least._origins = torch.zeros(39, 3)
    assert not silhouettes.Silhouettes.outline_something.fget(least)  # type: ignore[attr-defined]


def test_colors_are_blind_to_the_order_of_two_sets() -> None:
    random = torch.Generator().manual_seed(0)
    a, b = torch.rand(20, 3, generator=random), torch.rand(20, 3, generator=random)
    expected = (a[:, None] - b[None]).square().mean()
    torch.testing.assert_close(colors._blind(a, b), expected)


@pytest.mark.parametrize(("disagreement", "colored", "weight"), [(0.45, True, 0.3), (0.451, False, 0.0)])
def test_colors_count_a_little_where_they_agree(disagreement: float, colored: bool, weight: float) -> None:
    symmetry = Symmetry(Mirror(torch.tensor([1.0, 0, 0]), 0.0), 0.0, disagreement)
    assert symmetry.colored == colored
    views = [_View("a", photo(0).camera), _View("b", photo(90).camera)]
    for train, expected in ((views, weight), (views[:1], 0.3)):
        found = find.with_mirror_images(_Scene(tuple(train)), [symmetry])  # type: ignore[arg-type]
        assert [view.color for view in found.mirrored] == [expected] * len(train)
        assert all(view.mirrored for view in found.mirrored)


@dataclass(frozen=True)
class _View:
    name: str
    camera: Cameras
    color: float = 1.0
    mirrored: bool = False


@dataclass(frozen=True)
class _Scene:
    train: tuple[_View, ...]
    mirrored: tuple[_View, ...] = ()


@pytest.mark.parametrize(
    ("changed", "fine"),
    [
        ({"turns": 2}, True),
        ({"turns": 64}, True),
        ({"turns": 1}, False),
        ({"turns": 65}, False),
        ({"turns": 2.0}, False),
        ({"direction": [0, 0, 1.00009]}, True),
        ({"direction": [0, 0, 1.00011]}, False),
        ({"direction": [0, 1]}, False),
        ({"point": [0, 0, math.inf]}, False),
        ({"point": [0, 0]}, False),
    ],
)
def test_an_axis_in_a_record_has_a_unit_direction_and_two_to_64_turns(changed: dict[str, Any], fine: bool) -> None:
    record = {"direction": [0, 0, 1], "point": [1, 2, 3], "turns": 4, "misses": 0.1, "disagreement": 0.2, **changed}
    if fine:
        assert Symmetry.from_dict(record).element.turns == record["turns"]  # type: ignore[union-attr]
    else:
        with pytest.raises(InputError, match="the axis"):
            Symmetry.from_dict(record)


def test_the_radius_of_a_ball_shrinks_with_its_distance() -> None:
    shown = photo(0)
    ball = Ball(torch.zeros(3), 0.5)
    expected = 0.5 * float(shown.camera.Ks[0, 0, 0]) / math.hypot(4, 1)
    assert find._projected_radius(shown, ball) == pytest.approx(expected, rel=1e-5)
    assert search.MAX_OFFSET < 1


@pytest.mark.parametrize(
    ("misses", "tilt", "disagreement", "believed"),
    [
        (0.00079, 0.0, 1.0, True),
        (0.00081, 0.0, 1.0, False),
        (0.00319, 0.0, 0.1, True),
        (0.00321, 0.0, 0.1, False),
        (0.0, 1.9, 1.0, True),
        (0.0, 2.1, 1.0, False),
    ],
)
def test_a_level_mirror_misses_by_little_and_stands_upright(
    monkeypatch: pytest.MonkeyPatch, misses: float, tilt: float, disagreement: float, believed: bool
) -> None:
    """Shares of a radius of 50 px; a plane that must be that good is refined for that."""
    a, wanted = math.radians(tilt), []
    mirror = Mirror(torch.tensor([math.cos(a), 0, math.sin(a)]), 0.0)

    def refine(candidate: Mirror, silhouettes: Any, ball: Any, most: float) -> tuple[Mirror, float]:
        wanted.append(most)
        return candidate, 50 * misses

    monkeypatch.setattr(upright, "candidates", lambda *_: [mirror])
    monkeypatch.setattr(upright, "refined", refine)
    monkeypatch.setattr(upright, "_symmetry", lambda element, misses, *_: Symmetry(element, misses, disagreement))
    nothing: Any = None
    up = torch.tensor([0.0, 0, 1])
    found = upright._level_mirrors([], nothing, Ball(torch.zeros(3), 1.0), blocks(), up, 50.0, 2)
    assert len(found) == int(believed)
    assert wanted == [pytest.approx(0.0008 * 50)]
    assert [one.misses for one in found] == [pytest.approx(misses)] * len(found)


@pytest.mark.parametrize(("slope", "stays"), [(0.05, True), (0.2, False)])
def test_a_step_that_leaves_nearly_all_is_not_taken(slope: float, stays: bool) -> None:
    """Of the misses 1 and slope x at x = 1, a step to 0 leaves 99.9 or 98 percent; 99.5 are too much."""
    found, _ = sliding(1.0, 1.0, lambda x: torch.tensor([1.0, slope * x], dtype=torch.float64))
    assert found.at == (1.0 if stays else pytest.approx(0.0, abs=0.02))


def test_a_pixel_misses_by_no_more_than_four() -> None:
    """The images of a mirror far out lie in no silhouette."""
    outlined = silhouettes.Silhouettes([photo(0), photo(120)], torch.zeros(3), 1.5)
    far = Mirror(torch.tensor([1.0, 0, 0]), 5.0)
    misses = outlined.misses(far, outlined.near_optima(far))
    assert len(misses) > 20
    assert misses.tolist() == [4.0] * len(misses)
