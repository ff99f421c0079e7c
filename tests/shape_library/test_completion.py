"""Tests of the body that one photo, a library, and words make."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from balls import Ball, ring, write_balls

from gsopt.config.train import DataConfig
from gsopt.data.scene import load_scene
from gsopt.geometry.voxels import Grid
from gsopt.init.inflation import inflated
from gsopt.init.thumbnails import Thumbnail, small_photos
from gsopt.shape_library.alignment import Alignments, agreement_and_slope, aligned, boxed, soft
from gsopt.shape_library.completion import MAX_SHAPES, _compared, completion
from gsopt.shape_library.entry import Shape
from gsopt.shape_library.library_file import ShapeLibrary
from gsopt.shape_library.outline import Outline
from gsopt.shape_library.poses import Poses, best_poses, surface_points, turn_matrix
from gsopt.shape_library.words import word_scores

SIZE = 96


@pytest.fixture(scope="module")
def outline(tmp_path_factory: pytest.TempPathFactory) -> Outline:
    """A camera, and the silhouette of a ball; tests put other silhouettes in its place."""
    scene = load_scene(DataConfig(str(_ball(tmp_path_factory.mktemp("ball")))))
    return Outline.of(small_photos(scene.train, 1)[0], scene.extent)


def _ball(folder: Path) -> Path:
    around = ring(4, size=SIZE)
    return write_balls(folder / "ball", [Ball((0.0, 0.0, 0.0), 0.6)], around[0], around[1:])


def world(outline: Outline, shape: Shape, azimuth: float, mirror: float, size: float) -> torch.Tensor:
    """Solid points of a shape that stands at the origin."""
    cells = (torch.nonzero(torch.from_numpy(shape.occupied)) + 0.5) / shape.occupied.shape[0] - 0.5
    points = cells * torch.from_numpy(shape.sizes.copy()) * torch.tensor([mirror, 1.0, 1.0])
    return size * points @ (outline.upright @ turn_matrix(torch.tensor(azimuth))).T


def photo_of(outline: Outline, points: torch.Tensor) -> Thumbnail:
    """The silhouette of solid points, its small holes filled."""
    column, row = outline.project(points).long().T
    alpha = torch.zeros(1, 1, SIZE, SIZE)
    alpha[0, 0, row, column] = 1
    alpha = -torch.nn.functional.max_pool2d(-torch.nn.functional.max_pool2d(alpha, 5, 1, 2), 5, 1, 2)
    planes = (alpha[0] * 255).to(torch.uint8).expand(4, -1, -1).clone()
    return Thumbnail(outline.camera, planes)


def shape_called(library: ShapeLibrary, name: str) -> int:
    return next(row for row, entry in enumerate(library.entries) if name in f"{entry.id} {entry.words}")


def overlap(grid: Grid, points: torch.Tensor) -> float:
    """IoU of a body with solid points, on the body's grid."""
    cells = ((points - grid.low) / grid.voxel).long()
    cells = cells[((cells >= 0) & (cells < torch.tensor(grid.occupied.shape))).all(1)]
    true = torch.zeros_like(grid.occupied)
    true[tuple(cells.T)] = True
    true = -torch.nn.functional.max_pool3d(-torch.nn.functional.max_pool3d(true[None].float(), 3, 1, 1), 3, 1, 1)[0] > 0
    return float((true & grid.occupied).sum() / (true | grid.occupied).sum())


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_the_turn_and_the_scale_of_a_shape_are_found_again(
    outline: Outline, library: ShapeLibrary, mirror: float
) -> None:
    shape = library.shape(shape_called(library, "street sign"))
    photo = photo_of(outline, world(outline, shape, 0.6 * mirror, mirror, 1.5))
    seen = Outline.of(photo, 1.0)
    occupied, sizes = torch.from_numpy(shape.occupied)[None], torch.from_numpy(shape.sizes.copy())[None]
    points = surface_points(occupied[0], sizes[0])[None]
    poses = best_poses(seen, points, 3)
    start = boxed(seen, poses, points[poses.row])
    found = aligned(seen, start, soft(occupied[poses.row]), sizes[poses.row], (32, 24), 12)
    best = int(found.agreement.argmax())
    turn = abs(float(found.parameters[best, 0]) * float(found.poses.mirror[best])) % 3.14159
    assert min(abs(turn - 0.6), abs(turn - (3.14159 - 0.6))) < 0.15
    assert seen.size * float(found.parameters[best, 1].exp()) == pytest.approx(1.5, rel=0.12)
    assert float(found.agreement[best]) > float(boxed_agreement(seen, start, occupied, sizes).max()) - 1e-6


def test_the_slope_of_the_agreement_is_a_central_difference(outline: Outline) -> None:
    generator = torch.Generator().manual_seed(3)
    volumes = torch.nn.functional.avg_pool3d(torch.rand(2, 1, 14, 14, 14, generator=generator), 5, 1, 2).double()
    exact = replace(outline, **{name: getattr(outline, name).double() for name in ("alpha", "middle", "upright")})
    poses = Poses(torch.zeros(2, dtype=torch.long), torch.zeros(2), torch.tensor([1.0, -1.0]), torch.zeros(2))
    first = torch.tensor([[0.3, -0.1, 0.2, 0.05, -0.03]]).repeat(2, 1).double()
    start = Alignments(poses, first - 0.04, torch.zeros(2))
    points, alpha = outline.rays(16, 12)
    rays, alpha, sizes = points.flatten(0, 1).double(), alpha.flatten().double(), torch.ones(2, 3).double()

    def agreement(parameters: torch.Tensor) -> torch.Tensor:
        return agreement_and_slope(exact, start, volumes, sizes, parameters, rays, alpha)[0]

    slope = agreement_and_slope(exact, start, volumes, sizes, first, rays, alpha)[1]
    for column in range(5):
        step = torch.zeros_like(first)
        step[:, column] = 1e-6
        difference = (agreement(first + step) - agreement(first - step)) / 2e-6
        assert torch.allclose(slope[:, column], difference, rtol=1e-4, atol=1e-6)


def boxed_agreement(seen: Outline, start: object, occupied: torch.Tensor, sizes: torch.Tensor) -> torch.Tensor:
    """What the first guesses agree, without a step."""
    rows = start.poses.row  # type: ignore[attr-defined]
    return aligned(seen, start, soft(occupied[rows]), sizes[rows], (32, 24), 0).agreement  # type: ignore[arg-type]


def test_a_table_gets_its_legs_from_the_library_and_not_from_the_rule(outline: Outline, library: ShapeLibrary) -> None:
    points = world(outline, library.shape(shape_called(library, "oak_table")), 0.5, 1.0, 1.6)
    photo = photo_of(outline, points)
    rule = inflated(photo, 1.0)
    found = completion(photo, 1.0, library, ["a wooden desk"])
    assert rule is not None
    assert found is not None
    assert found.hypotheses[0].entry.name == "oak table"
    assert found.hypotheses[0].words == 1.0
    assert overlap(found.body, points) > overlap(rule, points) + 0.1


def test_words_tip_the_scales_and_the_photo_decides(outline: Outline, library: ShapeLibrary) -> None:
    photo = photo_of(outline, world(outline, library.shape(shape_called(library, "oak_table")), 0.5, 1.0, 1.6))
    shares = {}
    for words in ("a tower", "", "a table"):
        found = completion(photo, 1.0, library, [words] if words else [])
        assert found is not None
        shares[words] = sum(one.share for one in found.hypotheses if one.entry.name == "oak table")
    assert shares["a tower"] < shares[""] < shares["a table"]
    assert shares["a tower"] > 0.5


def test_the_same_question_has_the_same_answer(outline: Outline, library: ShapeLibrary) -> None:
    photo = photo_of(outline, world(outline, library.shape(0), 0.3, 1.0, 1.4))
    first, second = (completion(photo, 1.0, library, ["a tower"]) for _ in range(2))
    assert first is not None
    assert second is not None
    assert torch.equal(first.body.occupied, second.body.occupied)
    assert first.hypotheses == second.hypotheses


def test_an_entry_that_is_left_out_takes_no_part(outline: Outline, library: ShapeLibrary) -> None:
    photo = photo_of(outline, world(outline, library.shape(0), 0.3, 1.0, 1.4))
    found = completion(photo, 1.0, library, [], frozenset({library.entries[0].id}))
    assert found is not None
    assert library.entries[0] not in [one.entry for one in found.hypotheses]


def test_a_silhouette_without_a_pixel_has_no_body_and_one_of_a_pixel_has_one(
    outline: Outline, library: ShapeLibrary
) -> None:
    planes = torch.zeros(4, SIZE, SIZE, dtype=torch.uint8)
    assert completion(Thumbnail(outline.camera, planes), 1.0, library, []) is None
    planes[:, SIZE // 2, SIZE // 2] = 255
    found = completion(Thumbnail(outline.camera, planes), 1.0, library, ["a tower"])
    assert found is not None
    assert bool(found.body.occupied.any())


def test_of_many_entries_those_that_are_meant_are_compared_first() -> None:
    spoken = [0.0] * 10_000
    spoken[9_999], spoken[17] = 1.0, 0.5
    rows = _compared(spoken, [row == 3 for row in range(10_000)])
    assert len(rows) == MAX_SHAPES
    assert {17, 9_999} <= set(rows)
    assert 3 not in rows
    assert max(rows[1:-1]) > 9_900


def test_words_rank_ten_thousand_entries(library: ShapeLibrary) -> None:
    entries = list(library.entries) * 3_334
    scores = word_scores(entries, ["a tower"])
    assert len(scores) == len(entries) > 10_000
    assert max(scores) == scores[shape_called(library, "tower")]
