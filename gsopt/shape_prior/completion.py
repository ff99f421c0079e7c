"""The body that a shape prior sees in one to three photos, with the colors of all its sides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.data.resample import sample
from gsopt.geometry.focus import find_focus, world_up
from gsopt.geometry.projection import inside, project
from gsopt.geometry.voxels import Grid
from gsopt.init.thumbnails import Thumbnail
from gsopt.shape_prior.cube import Frame, Views, lookup
from gsopt.shape_prior.diffusion import completed
from gsopt.shape_prior.evidence import evidence
from gsopt.shape_prior.folder import ShapePrior
from gsopt.shape_prior.vocabulary import encoded

SIDE = 112
"""Voxels along each side of the body's grid, as the inflated silhouette has it."""
DIAGONAL = 1.42
"""Half side of a grid along the world's axes that holds a cube turned about the vertical, over the cube's."""


@dataclass(frozen=True)
class PriorBody:
    """A body and its colors."""

    grid: Grid
    colors: Float[Tensor, "X Y Z 3"]
    """0..1."""


@dataclass(frozen=True)
class Crops:
    """Photos of one object, cropped to their silhouettes, and its cube."""

    images: Float[Tensor, "1 V 4 R R"]
    cameras: Float[Tensor, "1 V 3 4"]
    frame: Frame

    @staticmethod
    def of(photos: Sequence[Thumbnail], extent: float, side: int) -> Crops | None:
        """Crops photos; returns None if one of them holds no silhouette."""
        solid = [photo.alpha()[0] > 0.5 for photo in photos]
        if not all(bool(one.any()) for one in solid):
            return None
        boxes = torch.stack([_box(one) for one in solid])[None]
        viewmats = torch.cat([photo.camera.viewmats for photo in photos])
        views = Views(viewmats[None], torch.cat([photo.camera.Ks for photo in photos])[None], boxes)
        first = photos[0].camera
        depth = (find_focus([first], extent).point - first.centers[0]) @ first.forwards[0]
        frame = views.frame(depth[None], world_up(viewmats))
        half = views.crop_half()[0]
        images = [_crop(photo, box, float(h), side) for photo, box, h in zip(photos, boxes[0], half, strict=True)]
        return Crops(torch.stack(images)[None], views.cube_crops(frame), frame)


@torch.no_grad()
def prior_body(
    photos: Sequence[Thumbnail], extent: float, prior: ShapePrior, words: Sequence[str], seed: int
) -> PriorBody | None:
    """The completed body inside all silhouettes, or None where there is none."""
    crops = Crops.of(photos, extent, prior.image_side)
    if crops is None:
        return None
    device = next(prior.network.parameters()).device
    known = evidence(crops.images.to(device), crops.cameras.to(device), prior.config.side)
    volume = completed(prior.network, known, encoded(words, prior.vocabulary)[None].to(device), seed).cpu()
    return _in_world(volume, crops.frame, photos)


def _in_world(volume: Float[Tensor, "1 4 s s s"], frame: Frame, photos: Sequence[Thumbnail]) -> PriorBody | None:
    half = DIAGONAL * float(frame.half[0])
    grid = Grid(torch.ones(SIDE, SIDE, SIDE, dtype=torch.bool), frame.middle[0] - half, 2 * half / SIDE)
    points = grid.centers()
    place = frame.to_cube(points[None])
    # An interior without color would bleed into the surface: color is stored times the filled share.
    filled = lookup((volume[:, :1] + 1) / 2, place, "zeros")[0, 0]
    color = lookup(volume[:, 1:], place, "border")[0] / filled.clamp_min(0.25)
    occupied = (filled > 0.5) & _in_silhouettes(photos, points)
    if not bool(occupied.any()):
        return None
    shape = grid.occupied.shape
    colors = ((color + 1) / 2).clamp(0, 1).T.reshape(*shape, 3)
    return PriorBody(Grid(occupied.view(shape), grid.low, grid.voxel), colors)


def _in_silhouettes(photos: Sequence[Thumbnail], points: Float[Tensor, "N 3"]) -> Bool[Tensor, "N"]:
    kept = torch.ones(len(points), dtype=torch.bool)
    for photo in photos:
        column, row, depth = project(photo.camera, points)
        rows = torch.nonzero(inside(photo.camera, column, row, depth) & kept)[:, 0]
        kept = torch.zeros_like(kept)
        kept[rows] = sample(photo.alpha(), column[rows], row[rows])[0] > 0.5
    return kept


def _box(solid: Bool[Tensor, "H W"]) -> Float[Tensor, "4"]:
    rows, columns = (torch.nonzero(solid.any(dim=axis))[:, 0] for axis in (1, 0))
    return torch.stack([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]).float()


def _crop(photo: Thumbnail, box: Float[Tensor, "4"], half: float, side: int) -> Float[Tensor, "4 R R"]:
    """The silhouette's square at the prior's size: averaged over pixels, color times a hard alpha."""
    steps = torch.arange(2 * side) + 0.5
    column, row = ((box[i] + box[i + 2]) / 2 + half * (steps / side - 1) for i in (0, 1))
    place = torch.cartesian_prod(row, column)
    height, width = photo.planes.shape[1:]
    fine = sample(photo.planes.float() / 255, place[:, 1], place[:, 0])
    shown = (place[:, 1] >= 0) & (place[:, 1] <= width) & (place[:, 0] >= 0) & (place[:, 0] <= height)
    planes = torch.nn.functional.avg_pool2d((fine * shown).view(1, 4, 2 * side, 2 * side), 2)[0]
    solid = (planes[3:] > 0.5).float()
    return torch.cat([planes[:3] / planes[3:].clamp_min(1e-6) * solid, solid])
