"""The steps from depths to a surface, each by hand: boxes, distances, floaters, smoothing, colors."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from gsopt.errors import InputError
from gsopt.formats.mesh_files import Mesh
from gsopt.geometry.cameras import Cameras
from gsopt.init.thumbnails import Thumbnail
from gsopt.results.mesh import extract, surface
from gsopt.results.mesh.extract import _given, around
from gsopt.results.mesh.fusion import Box, box_around, fused, signed_distance, truncation
from gsopt.results.mesh.hull_distance import hull_distance, outlines
from gsopt.results.mesh.median_depth import DepthView, outside_of

pytest.importorskip("scipy")

SIDE, FOCAL = 20, 100.0
CAMERA = Cameras(
    torch.eye(4)[None], torch.tensor([[[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1]]]), SIDE, SIDE
)


def wall(depth: float) -> DepthView:
    """A red wall across the viewing axis; the first column of pixels shows nothing and is 3 px beside it."""
    depths, gaps = torch.full((SIDE, SIDE), depth), torch.zeros(SIDE, SIDE)
    depths[:, 0], gaps[:, 0] = math.inf, 3.0
    colors = torch.tensor([0.5, 0.0, 0.0]).expand(SIDE, SIDE, 3)
    return DepthView(CAMERA, depths, gaps, colors, torch.full((SIDE, SIDE), 0.5))


def test_a_box_has_four_voxels_to_spare_on_each_side() -> None:
    box = box_around(torch.tensor([0.0, 1, 2]), torch.tensor([2.0, 2, 2.5]), 16)
    assert box.voxel == 0.125
    assert box.shape == (16 + 9, 8 + 9, 4 + 9)
    assert box.low.tolist() == [-0.5, 0.5, 1.5]
    assert truncation(box) == pytest.approx(0.1 * 25 * 0.125)
    assert box.corners().amax(0).tolist() == [2.5, 2.5, 3.0]
    assert box.corners().amin(0).tolist() == [-0.5, 0.5, 1.5]


def test_the_points_of_a_box_run_along_z_first() -> None:
    box = Box(torch.tensor([1.0, 2, 3]), (2, 3, 4), 0.5)
    (points,) = box.chunks()
    expected = [[1 + 0.5 * x, 2 + 0.5 * y, 3 + 0.5 * z] for x in range(2) for y in range(3) for z in range(4)]
    assert points.tolist() == expected


def test_a_distance_is_followed_to_the_truncation_before_and_behind_a_surface() -> None:
    depths = torch.tensor([4.0, 4.9, 5.1, 5.1875, 5.21, -5.0, 5.0])
    points = torch.stack([torch.zeros(7), torch.zeros(7), depths], dim=1)
    points[6, 0] = 3.0  # beside the image
    distance, seen = signed_distance(wall(5.0), points, 0.1875)
    assert distance[:5].tolist() == pytest.approx([1, 0.1 / 0.1875, -0.1 / 0.1875, -1, -1.12], abs=1e-5)
    assert seen.tolist() == [True, True, True, True, False, False, False]


def test_beside_an_outline_the_distance_is_that_to_it() -> None:
    """Three pixels of a hundredth of the depth."""
    points = torch.tensor([[-0.38, 0, 4.0], [-0.19, 0, 2.0]])
    distance, seen = signed_distance(wall(5.0), points, 0.2)
    assert distance.tolist() == pytest.approx([0.12 / 0.2, 0.06 / 0.2], rel=1e-5)
    assert bool(seen.all())


def test_a_field_is_the_mean_over_the_views_that_see_a_voxel() -> None:
    box = Box(torch.tensor([0.0, 0, 4.75]), (1, 1, 3), 0.25)
    limit = truncation(box)
    assert limit == pytest.approx(0.075)
    box = Box(torch.tensor([0.0, 0, 4.97]), (1, 1, 2), 1.0)  # truncated at 0.2
    found = fused([wall(5.0), wall(5.1)], box, solid=True).flatten().tolist()
    assert found == pytest.approx([(0.15 + 0.65) / 2, -1], abs=1e-4)
    assert fused([wall(5.0), wall(5.1)], box, solid=False).flatten().tolist()[1] == 1
    assert fused([wall(5.0)], box, solid=True).flatten().tolist() == pytest.approx([0.15, -1], abs=1e-4)


def test_distances_outside_of_pixels_are_taken_to_their_edge() -> None:
    solid = torch.zeros(5, 5, dtype=torch.bool)
    solid[2, 2] = True
    found = outside_of(solid)
    assert found[2].tolist() == [1.5, 0.5, 0, 0.5, 1.5]
    assert float(found[1, 1]) == pytest.approx(math.sqrt(2) - 0.5)
    assert bool(outside_of(torch.zeros(2, 2, dtype=torch.bool)).isinf().all())


def block(columns: slice) -> Thumbnail:
    planes = torch.zeros(4, SIDE, SIDE, dtype=torch.uint8)
    planes[3, 5:15, columns] = 255
    return Thumbnail(CAMERA, planes)


def test_the_distance_outside_of_a_silhouette_is_in_scene_units_within_the_limit() -> None:
    """The silhouette's sides lie 5 px from the axis: half a unit at a depth of ten."""
    (shape,) = outlines([block(slice(5, 15))])
    assert shape.shows_all
    pixels = torch.tensor([0.5, 3.5, 7.5, 9.5, 40.0])
    points = torch.stack([pixels / FOCAL * 10, torch.full((5,), 0.05), torch.full((5,), 10.0)], dim=1)
    expected = [-0.45, -0.15, 0.25, 0.45, 1.0]
    assert hull_distance([shape], points, 1.0).tolist() == pytest.approx(expected, abs=1e-5)
    assert hull_distance([shape], points, 0.3).tolist() == pytest.approx([-0.3, -0.15, 0.25, 0.3, 0.3], abs=1e-5)
    (cut,) = outlines([block(slice(5, 20))])
    assert not cut.shows_all
    assert hull_distance([cut], points[-1:], 1.0).tolist() == [-1]
    assert hull_distance([cut, shape], points, 1.0)[2:4].tolist() == pytest.approx([0.25, 0.45], abs=1e-5)


@pytest.mark.parametrize(("size", "stays"), [(9, False), (10, True)])
def test_a_part_of_a_two_hundredth_of_the_largest_is_no_floater(size: int, stays: bool) -> None:
    field = torch.ones(30, 16, 16)
    field[2:22, 2:12, 2:12] = -1  # 2000 voxels
    field[26, 3, 3 : 3 + size] = -1
    assert bool((surface.tidied(field)[26, 3, 3 : 3 + size] < 0).all()) == stays


FACES = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
OCTAHEDRON = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float32)


def test_an_octahedron_is_smoothed_by_the_factors_of_taubin() -> None:
    """The neighbors of each corner have the middle as their mean: each round multiplies by (1 - 0.5) (1 + 0.53)."""
    found = surface.smoothed(OCTAHEDRON + 3, FACES)
    np.testing.assert_allclose(found, OCTAHEDRON * (0.5 * 1.53) ** 5 + 3, atol=1e-5)


def test_corners_that_no_view_shows_take_the_mean_of_their_neighbors() -> None:
    total = torch.zeros(6, 4)
    total[0], total[1] = torch.tensor([0.5, 0, 0, 0.5]), torch.tensor([0.0, 0, 0.01, 0.01])
    found = surface._spread(total, torch.from_numpy(FACES))
    assert found[0].tolist() == pytest.approx([1, 0, 0])
    assert found[1].tolist() == pytest.approx([0, 0, 1])
    torch.testing.assert_close(found[2:], torch.tensor([0.5, 0, 0.5]).expand(4, 3))
    assert bool((surface._spread(torch.zeros(6, 4), torch.from_numpy(FACES)) == 0.5).all())
    total[:, 3] *= 0.09  # the second has less alpha than a thousandth
    assert surface._spread(total, torch.from_numpy(FACES))[1].tolist() == pytest.approx([1, 0, 0], abs=1e-4)


def test_a_view_colors_what_faces_it_within_four_voxels_of_its_surface() -> None:
    depths = torch.tensor([5.0, 5.0, 5.0, 5.39, 4.61, 5.41, 4.59])
    points = torch.stack([torch.zeros(7), torch.zeros(7), depths], dim=1)
    normals = torch.tensor([[0.0, 0, -1]]).repeat(7, 1)
    normals[1], normals[2] = torch.tensor([0, math.sqrt(0.75), -0.5]), torch.tensor([0.0, 0, 1])
    rgba, facing = surface._shown(wall(5.0), points, normals, surface.COLOR_TOLERANCE * 0.1)
    assert facing.tolist() == pytest.approx([1, 0.25, 0, 1, 1, 0, 0], abs=1e-5)
    assert rgba[0].tolist() == [0.5, 0, 0, 0.5]


def test_a_mesh_takes_the_colors_of_views_by_their_weight() -> None:
    red = wall(5.0)
    blue = DepthView(CAMERA, red.depths, red.gaps, red.colors.flip(-1), red.alphas)
    vertices = torch.tensor([[0.0, 0, 5], [0.1, 0, 5], [0, 0.1, 5], [0, 0, 5.02]])
    mesh = Mesh(vertices, torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]), torch.zeros(4, 3))
    if float(mesh.normals()[0, 2]) > 0:
        mesh = Mesh(vertices, mesh.faces.flip(1), mesh.colors)
    found = surface.colored(mesh, [red, blue], [3.0, 1.0], 0.1)
    torch.testing.assert_close(found.colors, torch.tensor([0.75, 0, 0.25]).expand(4, 3))


def test_cameras_around_a_box_look_at_its_middle_from_evenly_spread_places() -> None:
    box = Box(torch.tensor([1.0, 2, 3]), (5, 3, 9), 0.5)
    found = around(CAMERA, box, 7.0)
    assert len(found) == 64
    middle = torch.tensor([2.0, 2.5, 5.0])
    directions = torch.cat([camera.centers for camera in found]) - middle
    torch.testing.assert_close(directions.norm(dim=1), torch.full((64,), 7.0), rtol=1e-4, atol=0)
    for camera, direction in zip(found, directions, strict=True):
        torch.testing.assert_close(camera.forwards[0], -direction / 7, atol=1e-4, rtol=0)
        assert abs(float(camera.viewmats[0, 0, 2])) < 1e-4, "it stands upright"
    nearest = torch.cdist(directions, directions).fill_diagonal_(math.inf).amin(1) / 7
    assert float(nearest.min()) > 0.3, "64 caps of equal area have centers some 0.44 apart"
    assert float(directions.mean(0).norm()) < 0.1


@pytest.mark.parametrize(
    "box", [(0, 0, 0, 1, 1, 0), (0, 0, 0, 0, 1, 1), (0, 0, 0, 1, 1), (0, 0, 0, 1, 1, math.inf), (0, 0, 0, 1, -1, 1)]
)
def test_a_box_that_is_none_is_refused(box: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="Give two corners"):
        _given(box)
    low, high = _given((0, 1, 2, 3, 4, 5))
    assert (low.tolist(), high.tolist()) == ([0, 1, 2], [3, 4, 5])


def test_two_opaque_splats_where_the_cameras_look_make_a_box_and_one_does_not() -> None:
    """Between the 1st and the 99th hundredth of what lies within 4 units, whatever the third, transparent one says."""
    means = torch.tensor([[0.0, 0, 0], [1, 2, 3], [0, 3, 0], [9, 9, 9]])
    scene: Any = SimpleNamespace(has_alpha=False)
    focus: Any = SimpleNamespace(point=torch.zeros(3), radius=4.0)

    def run(opacities: list[float]) -> Any:
        return SimpleNamespace(gaussians=SimpleNamespace(means=means, opacities=torch.tensor(opacities)), path="run")

    low, high = extract._corners(run([0.9, 0.9, 0.1, 0.9]), scene, [], focus)
    torch.testing.assert_close(low + high, means[1])
    assert (high - low > 0.9 * means[1]).all()
    with pytest.raises(InputError, match="no opaque splats"):
        extract._corners(run([0.9, 0.1, 0.1, 0.9]), scene, [], focus)
