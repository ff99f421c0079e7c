"""The steps of `gsopt mesh` with stand-ins for renders: which cameras look, in which box, and what is made of it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from gsopt.errors import InputError, SettingError, UsageError
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.voxels import Grid
from gsopt.results.mesh import extract
from gsopt.results.mesh.fusion import Box


def view(x: float, side: int = 40) -> Any:
    viewmat = torch.eye(4)
    viewmat[0, 3] = -x
    camera = Cameras(viewmat[None], torch.tensor([[[50.0, 0, side / 2], [0, 50, side / 2], [0, 0, 1]]]), side, side)
    return SimpleNamespace(name=f"{x}", camera=camera)


@pytest.mark.parametrize(
    ("alpha", "views", "cameras"), [(False, 3, 3), (True, 3, 3 + 64), (False, 64, 64), (False, 65, 64)]
)
def test_up_to_64_input_cameras_look_and_64_more_around_an_object(
    alpha: bool, views: int, cameras: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Colors of input views weigh twenty times as much; of larger photos 512 px are drawn."""
    scene: Any = SimpleNamespace(train=[view(i, 600 if i == 1 else 40) for i in range(views)], has_alpha=alpha)
    grid, asked = Box(torch.zeros(3), (5, 5, 5), 0.5), list[Any]()
    monkeypatch.setattr(extract, "_seen", lambda run, camera, grid: camera)
    monkeypatch.setattr(
        extract, "farthest_points", lambda centers, count: range(len(centers) - 1, len(centers) - 1 - count, -1)
    )
    monkeypatch.setattr(
        extract, "around", lambda camera, grid, distance: (asked.append(distance), [camera] * extract.SPHERE_CAMERAS)[1]
    )
    focus: Any = SimpleNamespace(distance=7.0)
    seen, weights = extract.depth_views(None, scene, focus, grid)  # type: ignore[arg-type]
    assert len(seen) == len(weights) == cameras
    inputs = min(views, 64)
    assert weights == [20.0] * inputs + [1.0] * (cameras - inputs)
    assert asked == [7.0] * alpha
    first = 1 if views > 64 else 0
    assert [float(camera.centers[0, 0]) for camera in seen[:inputs]] == [float(i) for i in range(first, views)]  # type: ignore[attr-defined]
    sides = [camera.width for camera in seen[:inputs]]  # type: ignore[attr-defined]
    assert sides == [512 if i == 1 else 40 for i in range(first, views)]


def test_a_camera_draws_between_the_nearest_and_the_farthest_corner(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(extract, "depth_view", lambda *args: asked.append(args[-2:]))
    run: Any = SimpleNamespace(gaussians=None, backend=None, settings=None)
    extract._seen(run, view(0.0).camera, Box(torch.tensor([0.0, 0, 3]), (5, 5, 9), 0.5))
    assert asked == [(3.0, 7.0)]


@pytest.mark.parametrize("alpha", [False, True])
def test_the_field_of_an_object_ends_at_its_hull(alpha: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    grid = Box(torch.zeros(3), (2, 2, 2), 0.5)
    limit = extract.truncation(grid)
    asked: list[bool] = []
    monkeypatch.setattr(
        extract, "fused", lambda views, grid, solid: (asked.append(solid), torch.full((2, 2, 2), -0.5))[1]
    )
    monkeypatch.setattr(extract, "outlines", lambda photos: "shapes")
    monkeypatch.setattr(
        extract, "hull_distance", lambda shapes, points, most: torch.linspace(-1, 1, len(points)) * most
    )
    monkeypatch.setattr(extract.surface, "tidied", lambda field: field)
    scene: Any = SimpleNamespace(has_alpha=alpha)
    field = extract._field(scene, [], [], grid)
    expected = torch.linspace(-1, 1, 8).clamp_min(-0.5) if alpha else torch.full((8,), -0.5)
    torch.testing.assert_close(field.flatten(), expected)
    assert asked == [alpha]
    assert limit > 0


@pytest.mark.parametrize("carved", [True, False])
def test_the_box_is_that_of_the_hull_or_of_the_opaque_splats_in_the_middle(
    carved: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A voxel wider than the hull; of splats a hundredth on each side is left out, and so are faint and far ones."""
    hull = Grid(torch.ones(2, 3, 4, dtype=torch.bool), torch.tensor([1.0, 2, 3]), 0.5)
    monkeypatch.setattr(extract, "carve", lambda photos, focus: hull if carved else None)
    means = torch.zeros(103, 3)
    means[:101] = torch.linspace(-1, 1, 101)[:, None]
    means[101], means[102] = torch.tensor([1.5, 0.0, 0.0]), torch.tensor([5.0, 0, 0])
    opacities = torch.full((103,), 0.5)
    opacities[101] = 0.49
    gaussians = SimpleNamespace(means=means, opacities=opacities)
    run: Any = SimpleNamespace(gaussians=gaussians, path=Path("run"))
    scene: Any = SimpleNamespace(has_alpha=True)
    focus: Any = SimpleNamespace(point=torch.zeros(3), radius=2.0)
    low, high = extract._corners(run, scene, [], focus)
    if carved:
        assert (low.tolist(), high.tolist()) == ([0.75, 1.75, 2.75], [2.25, 3.75, 5.25])
    else:
        assert low.tolist() == pytest.approx([-0.98] * 3, abs=1e-3)
        assert high.tolist() == pytest.approx([0.98] * 3, abs=1e-3)


def extracted(monkeypatch: pytest.MonkeyPatch, field: torch.Tensor, **options: Any) -> tuple[Any, list[Any]]:
    done: list[Any] = []
    camera = view(0.0).camera
    scene = SimpleNamespace(train=[None] * 3, extent=2.0, has_alpha=True)
    run = SimpleNamespace(path=Path("run"), config=SimpleNamespace(data=None))
    box = Box(torch.zeros(3), (4, 4, 4), 0.25)
    monkeypatch.setattr(extract, "open_run", lambda path: run)
    monkeypatch.setattr(extract, "load_scene", lambda data: scene)
    monkeypatch.setattr(extract, "with_refined_poses", lambda scene, path: scene)
    monkeypatch.setattr(
        extract, "small_photos", lambda views, most: (done.append(most), [SimpleNamespace(camera=camera)])[1]
    )
    monkeypatch.setattr(extract, "find_focus", lambda cameras, extent: "focus")
    monkeypatch.setattr(extract, "_corners", lambda *_: (torch.zeros(3), torch.ones(3)))
    monkeypatch.setattr(
        extract, "box_around", lambda low, high, voxels: (done.append((low.tolist(), high.tolist(), voxels)), box)[1]
    )
    monkeypatch.setattr(extract, "depth_views", lambda *_: ("views", "weights"))
    monkeypatch.setattr(extract, "_field", lambda *_: field)
    corners, faces = np.zeros((4, 3)), np.zeros((2, 3), np.int64)
    monkeypatch.setattr(extract.surface, "triangulated", lambda field, grid: (corners, faces))
    monkeypatch.setattr(extract.surface, "smoothed", lambda corners, faces: corners + 1)
    monkeypatch.setattr(
        extract.surface,
        "decimated",
        lambda corners, faces, most: (done.append((float(corners[0, 0]), most)), (corners, faces))[1],
    )
    monkeypatch.setattr(
        extract.surface, "colored", lambda bare, views, weights, voxel: (done.append((views, weights, voxel)), bare)[1]
    )
    return extract.extract_mesh("run", **options), done


def test_a_surface_is_smoothed_then_decimated_then_colored(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, done = extracted(monkeypatch, torch.full((4, 4, 4), -1.0))
    assert done == [64, ([0] * 3, [1] * 3, 128), (1.0, 20_000), ("views", "weights", 0.25)]
    assert set(mesh.vertices.flatten().tolist()) == {1.0}
    _, done = extracted(monkeypatch, torch.full((4, 4, 4), -1.0), faces=100, voxels=16, box=(-1.0, -2, -3, 1, 2, 3))
    assert done[1:3] == [([-1, -2, -3], [1, 2, 3], 16), (1.0, 100)]


def test_a_box_without_a_surface_and_sizes_that_suit_no_object_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="has no surface inside the box 0 0 0 1 1 1"):
        extracted(monkeypatch, torch.zeros(4, 4, 4))
    for options in ({"faces": 99}, {"faces": 10_000_001}, {"voxels": 15}, {"voxels": 513}):
        with pytest.raises((UsageError, SettingError)):
            extracted(monkeypatch, torch.full((4, 4, 4), -1.0), **options)
    for options in ({"faces": 10_000_000}, {"voxels": 512}):
        extracted(monkeypatch, torch.full((4, 4, 4), -1.0), **options)
