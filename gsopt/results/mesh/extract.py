"""`gsopt mesh`: from the splats of a finished run to a closed, decimated, colored mesh."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt import check
from gsopt._optional import require
from gsopt.data.refined_poses import with_refined_poses
from gsopt.data.scene import Scene, load_scene
from gsopt.errors import InputError
from gsopt.formats.mesh_files import Mesh
from gsopt.geometry.cameras import Cameras, look_at
from gsopt.geometry.farthest_points import farthest_points
from gsopt.geometry.focus import Focus, find_focus
from gsopt.geometry.projection import project
from gsopt.init.hull import carve
from gsopt.init.thumbnails import Thumbnail, small_photos
from gsopt.raster.threads import one_torch_thread
from gsopt.results.finished_run import FinishedRun, open_run, with_longest_side
from gsopt.results.mesh import surface
from gsopt.results.mesh.fusion import Box, box_around, fused, truncation
from gsopt.results.mesh.hull_distance import hull_distance, outlines
from gsopt.results.mesh.median_depth import DepthView, depth_view

FACES = 20_000
VOXELS = 128
"""Along the longest side of the box."""
SPHERE_CAMERAS = 64
"""Renders of an object from all around, which average out what a single view gets wrong."""
MAX_VIEWS = 64
"""Most input views used; more hardly add to the surface."""
MAX_SIDE = 512
"""Longer side of a depth map, px."""
INPUT_COLOR_WEIGHT = 20.0
"""Weight of an input view's colors; those of the other renders are extrapolated."""
SOLID_OPACITY, INNER_SHARE = 0.5, 0.98
"""A scene without masks is the box of this share of the splats of at least this opacity, within its focus."""
Corners = tuple[Float[Tensor, "3"], Float[Tensor, "3"]]
"""Lowest and highest coordinates."""


@one_torch_thread()
def extract_mesh(
    run: str | PathLike[str] | FinishedRun,
    *,
    faces: int = FACES,
    voxels: int = VOXELS,
    box: Sequence[float] | None = None,
) -> Mesh:
    """A closed mesh of a finished run with about `faces` triangles and a color at each vertex.

    An object with masks lies inside its visual hull and is solid where nobody looks; a scene without masks becomes a
    shell. `voxels`: along the longest side; `box`: x y z X Y Z, scene units, cuts the rest off. Raises
    InputError when there is no surface, and MissingDependency without the extra `mesh`.
    """
    check.within("--faces", faces, 100, 10_000_000, "20000 suit an object.")
    check.within("--voxels", voxels, 16, 512, "128 suit an object.")
    require("skimage.measure", "mesh", surface.PURPOSE)
    require("fast_simplification", "mesh", surface.PURPOSE)
    run = run if isinstance(run, FinishedRun) else open_run(Path(run))
    scene = with_refined_poses(load_scene(run.config.data), run.path)
    photos = small_photos(scene.train, MAX_VIEWS)
    focus = find_focus([photo.camera for photo in photos], scene.extent)
    corners = _corners(run, scene, photos, focus) if box is None else _given(box)
    grid = box_around(*corners, voxels)
    views, weights = depth_views(run, scene, focus, grid)
    field = _field(scene, photos, views, grid)
    if not bool((field < 0).any()):
        raise InputError(f"{run.path} has no surface inside the box {_text(corners)}. Give another --box.")
    vertices, triangles = surface.triangulated(field, grid)
    vertices, triangles = surface.decimated(surface.smoothed(vertices, triangles), triangles, faces)
    bare = Mesh(torch.from_numpy(vertices).float(), torch.from_numpy(triangles), torch.zeros(len(vertices), 3))
    return surface.colored(bare, views, weights, grid.voxel)


def depth_views(run: FinishedRun, scene: Scene, focus: Focus, grid: Box) -> tuple[list[DepthView], list[float]]:
    """Depths and colors from the input cameras and, for an object, from all around; and the weights of their colors."""
    centers = torch.cat([view.camera.centers for view in scene.train])
    chosen = sorted(farthest_points(centers, MAX_VIEWS)) if len(centers) > MAX_VIEWS else range(len(centers))
    cameras = [scene.train[row].camera for row in chosen]
    weights = [INPUT_COLOR_WEIGHT] * len(cameras)
    if scene.has_alpha:
        cameras = cameras + around(cameras[0], grid, focus.distance)
        weights += [1.0] * SPHERE_CAMERAS
    cameras = [
        camera if max(camera.width, camera.height) <= MAX_SIDE else with_longest_side(camera, MAX_SIDE)
        for camera in cameras
    ]
    return [_seen(run, camera, grid) for camera in cameras], weights


def around(camera: Cameras, grid: Box, distance: float) -> list[Cameras]:
    """Cameras with the lens of `camera` on a sphere about the box, evenly along a spiral of golden angles."""
    place = torch.arange(SPHERE_CAMERAS, dtype=torch.float64) + 0.5
    z, turn = 1 - 2 * place / SPHERE_CAMERAS, math.pi * (1 + math.sqrt(5)) * place
    flat = (1 - z * z).sqrt()
    directions = torch.stack([flat * turn.cos(), flat * turn.sin(), z], dim=1)
    middle = grid.corners().double().mean(0)
    viewmats = look_at(middle + distance * directions, middle, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    return [replace(camera, viewmats=viewmats[row : row + 1].to(camera.viewmats)) for row in range(SPHERE_CAMERAS)]


def _seen(run: FinishedRun, camera: Cameras, grid: Box) -> DepthView:
    depths = project(camera, grid.corners())[2]
    return depth_view(run.gaussians, camera, run.backend, run.settings, float(depths.min()), float(depths.max()))


def _field(scene: Scene, photos: list[Thumbnail], views: list[DepthView], grid: Box) -> Float[Tensor, "X Y Z"]:
    """Fused, bounded by the hull, without floaters."""
    field = fused(views, grid, solid=scene.has_alpha)
    if scene.has_alpha:
        limit = truncation(grid)
        shapes = outlines(photos)
        parts = [hull_distance(shapes, points, limit) for points in grid.chunks()]
        field = torch.maximum(field, torch.cat(parts).view(grid.shape) / limit)
    return surface.tidied(field)


def _corners(run: FinishedRun, scene: Scene, photos: list[Thumbnail], focus: Focus) -> Corners:
    """The box of the visual hull, or of the splats in the middle of a scene without masks."""
    if scene.has_alpha:
        hull = carve(photos, focus)
        if hull is not None:
            centers = hull.centers()
            return centers.amin(0) - hull.voxel, centers.amax(0) + hull.voxel
    near = (run.gaussians.means - focus.point).norm(dim=1) < focus.radius
    means = run.gaussians.means[near & (run.gaussians.opacities >= SOLID_OPACITY)]
    if len(means) < 2:
        raise InputError(f"{run.path} has no opaque splats where its cameras look. Give --box x y z X Y Z.")
    low, high = (torch.quantile(means, share, dim=0) for share in ((1 - INNER_SHARE) / 2, (1 + INNER_SHARE) / 2))
    return low, high


def _given(box: Sequence[float]) -> Corners:
    low, high = torch.tensor(box[:3], dtype=torch.float32), torch.tensor(box[3:], dtype=torch.float32)
    if len(box) != 6 or not bool((low < high).all()) or not all(math.isfinite(value) for value in box):
        raise InputError(f"`--box` must be x y z X Y Z with x < X, y < Y, z < Z, got {list(box)}. Give two corners.")
    return low, high


def _text(corners: Corners) -> str:
    return " ".join(f"{value:.4g}" for corner in corners for value in corner.tolist())
