"""The evidence of photos in a cube, and the geometry between photos, cubes and shapes."""

from __future__ import annotations

import pytest
import torch
from tiny_prior import CONFIG, untrained

from gsopt.finetune.shapes.evaluation import occupied_at, photo_of, scene_of
from gsopt.finetune.shapes.samples import drawn_scenes, samples_of
from gsopt.finetune.shapes.volumes import ShapeVolumes
from gsopt.init.inflation import inflated, silhouette_distances
from gsopt.shape_library.library_file import BUNDLED, ShapeLibrary
from gsopt.shape_prior.completion import Crops, prior_body
from gsopt.shape_prior.cube import voxel_centers
from gsopt.shape_prior.diffusion import completed
from gsopt.shape_prior.evidence import COLOR, INFLATED, INSIDE, WEIGHT, disk_radii, evidence
from gsopt.shape_prior.network import base, folded, unfolded
from gsopt.shape_prior.vocabulary import encoded, known_words, vocabulary_of

SIDE, IMAGE_SIDE = 32, 48


@pytest.fixture(scope="module")
def volumes() -> ShapeVolumes:
    return ShapeVolumes.read(ShapeLibrary(BUNDLED), range(0, 600, 120), torch.device("cpu"))


def overlap(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_shapes_lie_inside_the_hull_of_their_silhouettes_whatever_the_number_of_views(volumes: ShapeVolumes) -> None:
    seen = set()
    for seed in range(6):
        scenes = drawn_scenes(volumes, 2, torch.Generator().manual_seed(seed))
        x0, known, _ = samples_of(volumes, scenes, SIDE, IMAGE_SIDE)
        solid, hull = x0[:, 0] > 0, known[:, INSIDE] > 0.5
        assert float((solid & hull).sum() / solid.sum()) > 0.95
        assert float(hull.sum()) > float(solid.sum())
        assert bool((known[:, INFLATED] > 0)[~hull].any()) is False
        seen.add(scenes.views.boxes.shape[1])
    assert len(seen) > 1


def test_a_clean_volume_has_no_color_where_it_is_empty(volumes: ShapeVolumes) -> None:
    scenes = drawn_scenes(volumes, 2, torch.Generator().manual_seed(3))
    x0, known, _ = samples_of(volumes, scenes, SIDE, IMAGE_SIDE)
    empty = x0[:, :1] == -1
    assert bool(empty.any())
    assert float((x0[:, 1:] * empty).abs().max()) == 0
    assert float(x0.abs().max()) <= 1.0001
    assert 0 <= float(known[:, COLOR].min()) <= float(known[:, COLOR].max()) <= 1.0001
    assert float(known[:, WEIGHT].max()) <= 1


def test_distances_are_those_of_the_inflation_rule() -> None:
    solid = torch.zeros(2, 40, 40, dtype=torch.bool)
    solid[0, 8:30, 5:20] = True
    solid[1, 3:36, 18:22] = True
    solid[1, 10:20, 6:34] = True
    inset, width = disk_radii(solid)
    for i in range(2):
        expected = silhouette_distances(solid[i])
        torch.testing.assert_close(inset[i], expected[0])
        torch.testing.assert_close(width[i], expected[1], rtol=1e-4, atol=1e-4)


def test_points_return_from_the_cube_and_its_middle_is_the_middle_of_a_crop(volumes: ShapeVolumes) -> None:
    scenes = scene_of(volumes, 0, 0)
    frame = scenes.views.frame(scenes.depth, torch.tensor([0.0, 0, 1]))
    points = voxel_centers(5)[None]
    torch.testing.assert_close(frame.to_cube(frame.to_world(points)), points, atol=1e-5, rtol=1e-5)
    middle = scenes.views.cube_crops(frame)[0, 0] @ torch.tensor([0.0, 0, 0, 1])
    torch.testing.assert_close(middle[:2] / middle[2], torch.zeros(2), atol=1e-4, rtol=0)
    assert float(torch.linalg.det(frame.axes[0])) == pytest.approx(1, abs=1e-5)


def test_a_photo_gives_the_evidence_that_its_shape_was_drawn_with(volumes: ShapeVolumes) -> None:
    for row in range(3):
        scenes = scene_of(volumes, row, 1)
        _, drawn, _ = samples_of(volumes, scenes, SIDE, IMAGE_SIDE)
        crops = Crops.of([photo_of(volumes, scenes)], 1.0, IMAGE_SIDE)
        assert crops is not None
        read = evidence(crops.images, crops.cameras, SIDE)
        assert overlap(drawn[:, INSIDE] > 0.5, read[:, INSIDE] > 0.5) > 0.85
        near = (drawn[:, WEIGHT] > 0.5) & (read[:, WEIGHT] > 0.5)
        assert float((drawn - read)[:, COLOR].abs().mean(1)[near].mean()) < 0.1


def test_an_untrained_prior_answers_with_the_inflated_silhouette(volumes: ShapeVolumes) -> None:
    photo = photo_of(volumes, scene_of(volumes, 0, 0))
    rule, found = inflated(photo, 1.0), prior_body([photo], 1.0, untrained(), [], 0)
    assert rule is not None
    assert found is not None
    points = rule.centers(torch.ones_like(rule.occupied))
    assert overlap(rule.occupied.flatten(), occupied_at(found.grid, points)) > 0.75
    assert found.colors.shape == (*found.grid.occupied.shape, 3)


def test_a_completion_is_empty_outside_the_silhouettes_and_depends_on_its_seed_alone(volumes: ShapeVolumes) -> None:
    _, known, _ = samples_of(volumes, scene_of(volumes, 1, 0), SIDE, IMAGE_SIDE)
    prior = untrained()
    for value in prior.network.parameters():
        value.add_(0.02 * torch.randn(value.shape, generator=torch.Generator().manual_seed(value.numel())))
    words = encoded(["chair"], prior.vocabulary)[None]
    first, again, other = (completed(prior.network, known, words, seed, 3) for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert not torch.equal(first, completed(prior.network, known, encoded([], prior.vocabulary)[None], 0, 3))
    assert float(first[:, 0][known[:, INSIDE] < 0.5].max()) == -1
    assert prior.config == CONFIG


def test_photos_without_a_silhouette_have_no_body(volumes: ShapeVolumes) -> None:
    photo = photo_of(volumes, scene_of(volumes, 0, 0))
    photo.planes.zero_()
    assert prior_body([photo], 1.0, untrained(), [], 0) is None


def test_patches_unfold_to_the_volume() -> None:
    x = torch.rand(2, 3, 8, 8, 8)
    assert torch.equal(unfolded(folded(x)), x)
    assert folded(x).shape == (2, 24, 4, 4, 4)
    assert base(torch.zeros(1, 13, 4, 4, 4))[:, 0].max() == -1


def test_words_are_found_as_the_library_finds_them() -> None:
    vocabulary = vocabulary_of(ShapeLibrary(BUNDLED).entries)
    assert "chair" in vocabulary
    known, unknown = known_words(["An oak settee, a chair", "стул"], (*vocabulary, "zzz"))
    assert "chair" in known
    assert "sofa" in known  # a settee's kin
    assert unknown == [word for word in unknown if word not in vocabulary]
    assert encoded(known, vocabulary).count_nonzero() == min(12, len(known))
    assert int(encoded(["unheard"], vocabulary).sum()) == 0
