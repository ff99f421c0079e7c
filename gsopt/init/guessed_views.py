"""Views of the shape that the photos suggest, from where nobody photographed it: the rest of the object, as a guess."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from gsopt.data.scene import Scene, View
from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.sh import sh0_from_rgb
from gsopt.geometry.surrounding import surrounding_cameras
from gsopt.geometry.voxels import Grid
from gsopt.init.inflation import inflated, object_box
from gsopt.init.rim_colors import without_rim
from gsopt.init.surface_colors import seen_colors, unoccluded_colors
from gsopt.init.thumbnails import Thumbnail, small_photos
from gsopt.raster.backend import Backend, RasterSettings

COUNT = 16
"""Number of guessed views."""
COLOR_WEIGHT = 0.3
"""Weight of their colors in the loss, beside 1 for the photo; at 0 the unseen sides show streaks of background."""
SPLAT_SCALE = 0.6
"""Standard deviation of the splats that draw the voxels, voxels."""
OPAQUE_LOGIT = 6.0


@dataclass(frozen=True)
class DrawnImages:
    """Images that were drawn and not read: a store of views."""

    pixels: UInt8[Tensor, "C H W 4"]

    def get(self, index: int) -> UInt8[Tensor, "H W 4"]:
        return self.pixels[index]


def with_guessed_views(scene: Scene, backend: Backend) -> Scene:
    """The scene with guessed views where it has one input view, with alpha, or a body; any other scene as it is."""
    if (len(scene.train) != 1 and scene.body is None) or not scene.has_alpha:
        return scene
    photos = small_photos(scene.train, len(scene.train))
    grid = scene.body or inflated(photos[0], scene.extent)
    if grid is None:
        return scene
    middle = object_middle(photos[0], scene.extent) if len(photos) == 1 else grid.centers().mean(0)
    cameras = surrounding_cameras(photos[0].camera, middle, COUNT)
    store = DrawnImages(drawn_voxels(grid, photos, cameras, backend, scene.body_colors))
    views = [View(f"guess_{i:02d}", cameras[i], store, i, color=COLOR_WEIGHT) for i in range(COUNT)]
    return replace(scene, guessed=tuple(views))


def object_middle(photo: Thumbnail, extent: float) -> Float[Tensor, "3"]:
    """The middle of the object in a single photo."""
    return object_box(photo.camera, photo.alpha()[0] > 0.5, extent)[0]


def drawn_voxels(
    grid: Grid,
    photos: Sequence[Thumbnail],
    cameras: Cameras,
    backend: Backend,
    unseen: Float[Tensor, "X Y Z 3"] | None = None,
) -> UInt8[Tensor, "C H W 4"]:
    """The shape in the photos' colors, which go straight through it, or in colors of its own where no photo shows it:
    straight sRGB color and alpha."""
    points = grid.surface()
    colors = unoccluded_colors(grid, [without_rim(photo) for photo in photos], points)
    if unseen is not None:
        own = unseen[tuple(((points - grid.low) / grid.voxel).long().T)]
        colors = torch.where(seen_colors(grid, photos, points)[1][:, None], colors, own)
    gaussians = voxel_gaussians(points, colors, SPLAT_SCALE * grid.voxel).to(backend.device)
    settings, black = RasterSettings(sh_degree=0), torch.zeros(3)
    images = []
    for index in range(len(cameras)):
        frame = backend.forward(gaussians, cameras[index], settings, black)
        color = frame.colors / frame.alphas.clamp_min(1e-6)[..., None]
        images.append(torch.cat([color, frame.alphas[..., None]], dim=-1))
    return (torch.stack(images).clamp(0, 1) * 255).round().to(torch.uint8).cpu()


def voxel_gaussians(points: Float[Tensor, "N 3"], rgb: Float[Tensor, "N 3"], scale: float) -> Gaussians:
    """Opaque balls."""
    count = len(points)
    return Gaussians(
        means=points,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.full((count, 3), math.log(scale)),
        logit_opacities=torch.full((count,), OPAQUE_LOGIT),
        sh0=sh0_from_rgb(rgb)[:, None],
        shN=torch.zeros(count, 0, 3),
    )
