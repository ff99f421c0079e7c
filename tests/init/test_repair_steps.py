"""Steps of the repair of masks and of the hull, with stand-ins for what is costly: who decides, how far a box goes."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from gsopt.geometry.cameras import Cameras
from gsopt.geometry.focus import Focus
from gsopt.geometry.voxels import Grid, dilated, eroded
from gsopt.init import hull, mask_repair
from gsopt.init.mask_repair import LEVELS, RepairedAlphas, RepairedMask, _colored_part, _kind, agreement_of
from gsopt.init.thumbnails import Thumbnail


def view(channels: int, name: str = "a") -> Any:
    camera = SimpleNamespace(height=8, width=12)
    return SimpleNamespace(pixels=lambda: torch.zeros(2, 2, channels), camera=camera, name=name)


@pytest.mark.parametrize(
    ("masked", "views", "checked"),
    [
        (3, 3, True),
        (2, 2, False),
        (2, 3, False),
        (3, 5, True),
        (3, 6, False),
        (4, 7, True),
        (32, 32, True),
        (33, 33, False),
    ],
)
def test_masks_are_checked_where_three_and_most_views_have_one_and_they_are_few(
    masked: int, views: int, checked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []
    monkeypatch.setattr(mask_repair, "small_photos", lambda views, most: (asked.append(most), [])[1])
    monkeypatch.setattr(mask_repair, "find_focus", lambda cameras, extent: None)
    monkeypatch.setattr(mask_repair, "mask_agreement", lambda photos, focus: "agreement")
    train = [view(4)] * masked + [view(3)] * (views - masked)
    scene: Any = SimpleNamespace(train=train, extent=1.0)
    assert (agreement_of(scene) == "agreement") == checked
    assert asked == [32] * checked


def photo(mask: torch.Tensor, color: int = 0) -> Thumbnail:
    height, width = mask.shape
    planes = torch.full((4, height, width), color, dtype=torch.uint8)
    planes[3] = mask
    return Thumbnail(Cameras(torch.eye(4)[None], torch.eye(3)[None], width, height), planes)


@pytest.mark.parametrize(
    ("value", "part", "covered", "kind"),
    [
        (0, 0, 0.0, "empty"),
        (127, 0, 0.0, "empty"),
        (128, 0, 0.5, "too large"),
        (255, 0, 0.949, "too large"),
        (255, 5, 0.949, "too large"),
        (255, 5, 0.95, "lost"),
        (255, 0, 0.95, "lost"),
    ],
)
def test_a_mask_is_empty_too_large_or_lacks_something(value: int, part: int, covered: float, kind: str) -> None:
    mask = torch.full((8, 8), value, dtype=torch.uint8)
    mask[:part] = 0
    agreement: Any = SimpleNamespace(photos=[photo(mask)], covered=[covered])
    assert _kind(agreement, 0) == kind


def test_a_finding_is_told_and_recorded_with_its_share() -> None:
    found = RepairedMask("a.png", "too large", 0.81234, "colors")
    assert found.to_dict() == {"name": "a.png", "kind": "too large", "covered": 0.8123, "repair": "colors"}
    assert "(the hull of the others covers 81% of it)" in found.about


def test_repaired_images_have_their_own_colors_and_the_new_mask() -> None:
    """Others are as they were."""
    stored, bare = torch.zeros(2, 3, 4, dtype=torch.uint8), torch.full((2, 3, 4), 7, dtype=torch.uint8)
    alpha = torch.arange(6, dtype=torch.uint8).view(2, 3)
    store = RepairedAlphas(SimpleNamespace(get=lambda i: stored), SimpleNamespace(get=lambda i: bare), {1: alpha})  # type: ignore[arg-type]
    assert store.get(0) is stored
    assert torch.equal(store.get(1)[..., 3], alpha)
    assert bool((store.get(1)[..., :3] == 7).all())


def repaired(
    projected: int, by_color: int, monkeypatch: pytest.MonkeyPatch, agrees: bool = True, channels: int = 4
) -> tuple[str, str, torch.Tensor]:
    """Kind, repair and alpha of a view where so many pixels show the hull and so many were found by color."""
    flat = torch.arange(96).view(8, 12)
    shown = photo(torch.full((8, 12), 255, dtype=torch.uint8))
    agreement: Any = SimpleNamespace(
        photos=[shown, shown], agreeing=[0], disagreeing=[1], covered=[1.0, 0.25],
        projection=lambda row: flat < projected, thickness=lambda row: torch.ones(8, 12),
    )  # fmt: skip
    monkeypatch.setattr(mask_repair, "small_photos", lambda views, most: [shown])
    monkeypatch.setattr(mask_repair, "_colored_part", lambda *_: flat < by_color)
    monkeypatch.setattr(mask_repair, "_agrees", lambda *_: agrees)
    monkeypatch.setattr(mask_repair, "cleaned", lambda mask: mask)
    views = (view(4), view(channels, "b"))
    ((row, (alpha, finding)),) = mask_repair._repaired(views, views, agreement).items()
    assert (row, finding.name, finding.covered) == (1, "b", 0.25)
    return finding.kind, finding.repair, alpha


@pytest.mark.parametrize(
    ("by_color", "agrees", "repair", "pixels"),
    [(16, True, "colors", 16), (15, True, "hull", 50), (16, False, "hull", 50), (0, True, "hull", 50)],
)
def test_a_mask_found_by_color_agrees_and_covers_three_tenths_of_the_hull(
    by_color: int, agrees: bool, repair: str, pixels: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind, how, alpha = repaired(50, by_color, monkeypatch, agrees)
    assert (kind, how) == ("too large", repair)
    assert alpha.shape == (8, 12)
    assert int((alpha == 255).sum()) == pixels


def test_a_photo_that_does_not_show_the_hull_is_cleared_and_one_without_mask_is_missing_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kind, how, alpha = repaired(0, 50, monkeypatch)
    assert (kind, how) == ("too large", "cleared")
    assert not bool(alpha.any())
    assert repaired(50, 40, monkeypatch, channels=3)[0] == "missing"


def colored(kind: str, monkeypatch: pytest.MonkeyPatch, object_color: int = 200, solid: Any = None) -> torch.Tensor:
    """The part found in a photo of 8 x 12 px: columns 2 to 7 have the object's color, the hull shows columns 0 to 9."""
    colors = torch.full((3, 8, 12), 20, dtype=torch.uint8)
    colors[:, :, 2:8] = object_color
    inside = mask_repair._histogram(torch.full((400, 3), object_color, dtype=torch.uint8))
    shows = torch.zeros(8, 12, dtype=torch.bool)
    shows[:, :10] = True
    mask = torch.zeros(8, 12, dtype=torch.uint8)
    mask[:, :5] = 255 if solid is None else solid
    monkeypatch.setattr(mask_repair, "walked", lambda colors, likely: likely)
    monkeypatch.setattr(mask_repair, "cleaned", lambda found: found)
    return _colored_part(colors, shows, torch.ones(8, 12), inside, photo(mask), kind)


@pytest.mark.parametrize(("kind", "columns"), [("empty", range(2, 8)), ("too large", range(2, 5)), ("lost", range(8))])
def test_colors_decide_within_the_hull_and_the_mask_where_its_word_can_be_taken(
    kind: str, columns: range, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that shows too much holds the object, one that lost a part shows nothing else."""
    found = colored(kind, monkeypatch)
    assert torch.nonzero(found.any(0))[:, 0].tolist() == list(columns)
    assert bool(found[:, columns.start : columns.stop].all())
    if kind == "too large":
        assert not bool(colored(kind, monkeypatch, solid=127).any())


@pytest.mark.parametrize(("share", "told"), [(0.70, False), (0.74, True)])
def test_colors_tell_something_from_a_divergence_of_a_tenth_on(
    share: float, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two colors that are as frequent around the object one makes up 70 or 74 percent of it: 0.08 or 0.12."""
    around, inside = torch.full((LEVELS**3,), 1e-9), torch.full((LEVELS**3,), 1e-9)
    around[:2] = 0.5
    inside[0], inside[1] = share, 1 - share
    monkeypatch.setattr(mask_repair, "_histogram", lambda colors: around)
    monkeypatch.setattr(mask_repair, "walked", lambda colors, likely: likely)
    monkeypatch.setattr(mask_repair, "cleaned", lambda mask: mask)
    shows, empty = torch.ones(4, 4, dtype=torch.bool), photo(torch.zeros(4, 4, dtype=torch.uint8))
    colors = torch.zeros(3, 4, 4, dtype=torch.uint8)
    assert bool(_colored_part(colors, shows, torch.ones(4, 4), inside, empty, "empty").any()) == told


@pytest.mark.parametrize(("thickness", "found"), [(1.0, True), (0.68, True), (0.66, False), (0.0, False)])
def test_a_thin_place_of_the_hull_is_rather_no_object(
    thickness: float, found: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without evidence its probability is t / (1 + t), and 0.4 are asked for: two thirds of the mean thickness."""
    monkeypatch.setattr(mask_repair, "walked", lambda colors, likely: likely)
    monkeypatch.setattr(mask_repair, "cleaned", lambda mask: mask)
    monkeypatch.setattr(mask_repair, "LEAST_EVIDENCE", -1.0)
    even = torch.full((LEVELS**3,), 1 / LEVELS**3)
    monkeypatch.setattr(mask_repair, "_histogram", lambda colors: even)
    shows = torch.ones(4, 4, dtype=torch.bool)
    empty = photo(torch.zeros(4, 4, dtype=torch.uint8))
    colors = torch.zeros(3, 4, 4, dtype=torch.uint8)
    assert bool(_colored_part(colors, shows, torch.full((4, 4), thickness), even, empty, "empty").any()) == found


def block(side: int, low: int, high: int) -> Grid:
    occupied = torch.zeros(side, side, side, dtype=torch.bool)
    occupied[low:high, low:high, low:high] = True
    return Grid(occupied, torch.tensor([-1.0, 0, 2]), 0.5)


def test_the_second_grid_holds_the_first_and_a_voxel_around_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first one spans two radii to every side of the focus; no part of the object may be missed there."""
    calls: list[Any] = []
    grids = iter([block(8, 2, 5), block(9, 1, 3)])

    def carved(photos: Any, low: Any, size: Any, side: int, *, cautious: bool) -> Grid:
        calls.append((low.tolist(), size.tolist(), side, cautious))
        return next(grids)

    monkeypatch.setattr(hull, "_carved", carved)
    found = hull.carve([None] * 50, Focus(torch.tensor([1.0, 2.0, 3.0]), 9.0, 1.5, True))  # type: ignore[list-item]
    assert found is not None
    assert calls[0] == ([-2, -1, 0], [6, 6, 6], 48, True)
    low, size, side, cautious = calls[1]
    assert low == [-1 + 0.5, 0.5, 2.5]
    assert size == [2.5, 2.5, 2.5]
    assert (side, cautious) == (int((6e7 / 50) ** (1 / 3)), False)


@pytest.mark.parametrize(("photos", "side"), [(1, 112), (42, 112), (44, 110), (600, 48), (9999, 48)])
def test_voxels_are_as_fine_as_the_number_of_photos_permits(
    photos: int, side: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    sides: list[int] = []

    def carved(photos: Any, low: Any, size: Any, side: int, *, cautious: bool) -> Grid:
        sides.append(side)
        return block(4, 1, 3)

    monkeypatch.setattr(hull, "_carved", carved)
    hull.carve([None] * photos, Focus(torch.zeros(3), 9.0, 1.5, True))  # type: ignore[list-item]
    assert sides == [48, side]


def test_a_thing_thinner_than_a_voxel_is_looked_for_cautiously_and_an_empty_hull_is_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for counts, cautions, found in (
        ((1, 0, 1), [True, False, True], True),
        ((1, 0, 0), [True, False, True], False),
        ((0,), [True], False),
    ):
        left, asked = iter(counts), list[bool]()

        def carved(*_: Any, cautious: bool, left: Any = left, asked: Any = asked) -> Grid:
            asked.append(cautious)
            return block(4, 1, 1 + next(left))

        monkeypatch.setattr(hull, "_carved", carved)
        grid = hull.carve([None] * 9, Focus(torch.zeros(3), 9.0, 1.5, True))  # type: ignore[list-item]
        assert (grid is not None) == found
        assert asked == cautions


def test_a_carved_box_is_filled_with_cubes_and_cautious_by_half_their_diagonal(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []

    def inside(photos: Any, points: torch.Tensor, radius: float) -> torch.Tensor:
        asked.append(radius)
        return points[:, 2] > 0.5

    monkeypatch.setattr(hull, "in_hull", inside)
    for cautious in (True, False):
        grid = hull._carved([], torch.zeros(3), torch.tensor([4.0, 2.0, 1.0]), 10, cautious=cautious)
        assert list(grid.occupied.shape) == [20, 10, 5]
        assert grid.voxel == pytest.approx(0.2)
        assert torch.equal(grid.occupied, (torch.arange(5) * 0.2 + 0.1 > 0.5).expand(20, 10, 5))
    assert asked == pytest.approx([0.1 * math.sqrt(3), 0.0])


@pytest.mark.parametrize(("low", "high", "surface"), [(2, 9, 70), (4, 6, 100)])
def test_seven_tenths_of_the_points_lie_at_the_surface_where_there_is_an_inside(
    low: int, high: int, surface: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = block(12, low, high)
    asked: list[tuple[int, int]] = []

    def accepted(grid: Grid, cells: torch.Tensor, photos: Any, count: int, generator: Any) -> torch.Tensor:
        asked.append((int(cells.sum()), count))
        return torch.zeros(max(0, count - 5), 3)

    monkeypatch.setattr(hull, "_accepted", accepted)
    hull._sample_points(grid, [], 100, torch.Generator())
    core = eroded(grid.occupied)
    rim = dilated(grid.occupied) & ~core
    assert asked == [(int(rim.sum()), surface), (int(core.sum()), 100 - (surface - 5))]


def test_points_fill_their_cells_evenly_and_only_those_in_the_hull_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hull, "in_hull", lambda photos, points: points[:, 0] > 0.25)
    grid = block(6, 2, 4)
    points = hull._accepted(grid, grid.occupied, [], 2000, torch.Generator().manual_seed(0))
    assert len(points) == 2000
    spread = torch.stack([(points[:, 0] - 0.25) / 0.75, points[:, 1] - 1, points[:, 2] - 3])
    for axis in spread:
        assert float((axis.sort().values - torch.linspace(0, 1, 2000)).abs().max()) < 0.05
    monkeypatch.setattr(hull, "in_hull", lambda photos, points: torch.zeros(len(points), dtype=torch.bool))
    assert hull._accepted(grid, grid.occupied, [], 9, torch.Generator()).shape == (0, 3)
    assert hull._accepted(grid, grid.occupied & False, [], 9, torch.Generator()).shape == (0, 3)


@pytest.mark.parametrize(
    ("shown", "admitted", "kept"),
    [([1, 1, 0, 0], [1, 1, 1, 1], True), ([1, 0, 0, 0], [1, 1, 1, 1], False), ([1, 1, 1, 1], [1, 1, 1, 0], False)],
)
def test_a_point_of_the_hull_is_shown_by_half_of_the_photos_and_carved_by_none(
    shown: list[int], admitted: list[int], kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lowest(photos: list[int], points: Any, **more: float) -> tuple[torch.Tensor, torch.Tensor]:
        """The alphas that the photos have at every point, and how many show it."""
        alpha = min(float(admitted[photo]) for photo in photos)
        return torch.full((len(points),), alpha), torch.full((len(points),), sum(shown[photo] for photo in photos))

    monkeypatch.setattr(hull, "_picture", lambda photo, radius, points: photo)
    monkeypatch.setattr(hull, "lowest", lowest)
    assert hull.in_hull([0, 1, 2, 3], torch.zeros(2, 3)).tolist() == [kept, kept]  # type: ignore[list-item]


@pytest.mark.parametrize(("solid", "outlined"), [(97, True), (99, False)])
def test_silhouettes_that_cover_nearly_all_outline_nothing(
    solid: int, outlined: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More than 0.98 of the pixels; below sixteen photos the hull is rounded, and only colored photos give colors."""
    mask = torch.zeros(100, dtype=torch.uint8)
    mask[:solid] = 255
    rounded: list[int] = []

    def shape(occupied: torch.Tensor, centers: Any, voxel: float, photos: list[Any]) -> torch.Tensor:
        rounded.append(len(photos))
        return occupied

    monkeypatch.setattr(hull, "find_focus", lambda cameras, extent: None)
    monkeypatch.setattr(hull, "carve", lambda photos, focus: block(4, 1, 3))
    monkeypatch.setattr(hull, "rounded", shape)
    monkeypatch.setattr(hull, "_sample_points", lambda grid, photos, count, generator: torch.zeros(count, 3))
    monkeypatch.setattr(
        hull, "unoccluded_colors", lambda grid, photos, xyz: torch.full((len(xyz), 3), float(len(photos)))
    )
    for count in (15, 16):
        shown = [photo(mask.view(10, 10))] * (count - 1) + [
            Thumbnail(photo(mask.view(10, 10)).camera, photo(mask.view(10, 10)).planes, False)
        ]
        monkeypatch.setattr(hull, "small_photos", lambda views, most, shown=shown: shown)
        scene: Any = SimpleNamespace(observed=(), guessed=(), body=None, extent=1.0)
        found = hull.hull_points(scene, 5, torch.Generator())
        assert (found is not None) == outlined
        if found is not None:
            assert (found.silhouettes, found.voxel, len(found.xyz)) == (count, 0.5, 5)
            assert set(found.rgb.flatten().tolist()) == {count - 1.0}
    assert rounded == ([15] if outlined else [])
