"""A shape for one photo: its silhouette, inflated to a body that is as deep as it is wide.

One silhouette leaves an endless cone open. With d(x) the distance of a voxel's pixel to the outline and w(x) the radius
of the largest disk in the silhouette that holds this pixel, both in scene units at the voxel's depth,

    (1)  keep x where  |n . (x - c)| <= h(x),    h(x) = sqrt(d (2 w - d)),

where c is the middle of the object and n the normal of a plane through c. An upright tube of radius w gets a round
cross-section. The plane is upright and faces the camera, because things stand on the ground: the legs of a chair lie
below its seat, not nearer to the camera. From steeply above the plane is level. A ball around c that the photo just
frames bounds the body.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gsopt.data.distances import squared_distance
from gsopt.data.resample import sample
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.focus import find_focus, world_up
from gsopt.geometry.projection import inside, project
from gsopt.geometry.voxels import Grid
from gsopt.init.rounded_hull import RADIUS_RATIO
from gsopt.init.thumbnails import Thumbnail

STEEP = math.radians(50)
"""Elevation of the camera from which on the plane is level."""
SIDE = 112
"""Voxels along each side of the grid."""
MARGIN = 1.25
"""Half side of the grid over the half diagonal of the silhouette's box: room for a tilted body."""
MAX_DISTANCE_SIDE = 200
"""Longer side of the mask that distances are taken in, px: `squared_distance` is exact up to 90."""


def inflated(photo: Thumbnail, extent: float) -> Grid | None:
    """The body of (1) on a grid around the object, or None for a silhouette that holds no pixel center. Each block
    of pixels in the silhouette holds a voxel at least."""
    solid = photo.alpha()[0] > 0.5
    if not bool(solid.any()):
        return None
    middle, half, frame = object_box(photo.camera, solid, extent)
    grid = Grid(torch.ones(SIDE, SIDE, SIDE, dtype=torch.bool), middle - half, 2 * half / SIDE)
    points = grid.centers()
    column, row, depth = project(photo.camera, points)
    rows = torch.nonzero(inside(photo.camera, column, row, depth))[:, 0]
    factor = -(-max(solid.shape) // MAX_DISTANCE_SIDE)
    distances = factor * torch.stack(silhouette_distances(solid[factor // 2 :: factor, factor // 2 :: factor]))
    column, row = column[rows], row[rows]
    inset, width = sample(distances, column / factor, row / factor) * (depth[rows] / float(photo.camera.Ks[0, 0, 0]))
    framed = (points[rows] - middle).norm(dim=1) <= frame
    cone = framed & (sample(photo.alpha(), column, row)[0] > 0.5)
    rows, column, row, inset, width = (values[cone] for values in (rows, column, row, inset, width))
    away = ((points[rows] - middle) @ plane_normal(photo.camera)).abs()
    kept = away <= (inset * (2 * width - inset)).clamp_min(0).sqrt()
    step = math.ceil(grid.voxel * float(photo.camera.Ks[0, 0, 0]) / float(depth[rows].median()))
    block = (row / step).long() * (solid.shape[1] // step + 1) + (column / step).long()
    kept |= _missing(kept, block, away, grid.voxel)
    occupied = torch.zeros(SIDE**3, dtype=torch.bool)
    occupied[rows[kept]] = True
    return Grid(occupied.view(SIDE, SIDE, SIDE), grid.low, grid.voxel) if bool(kept.any()) else None


def _missing(kept: Bool[Tensor, "M"], block: Int[Tensor, "M"], away: Float[Tensor, "M"], voxel: float) -> Tensor:
    """The voxels nearest to the plane in every block of pixels (as wide as a voxel) that holds none of those kept."""
    count = int(block.max()) + 1
    nearest = torch.full((count,), math.inf).scatter_reduce(0, block, away, "amin")
    filled = torch.zeros(count, dtype=torch.bool).index_fill(0, block[kept], True)
    return ~filled[block] & (away <= nearest[block] + voxel / 2) & (away <= 2 * voxel)


def object_box(camera: Cameras, solid: Bool[Tensor, "H W"], extent: float) -> tuple[Float[Tensor, "3"], float, float]:
    """The middle of the object, as far away as the camera's focus, half the side of a cube that holds it, and the
    radius of the ball that the photo frames there: photographers leave objects room on all sides."""
    rows, columns = (torch.nonzero(solid.any(dim=axis))[:, 0] for axis in (1, 0))
    low, high = torch.stack([columns[0], rows[0]]), torch.stack([columns[-1], rows[-1]]) + 1
    focus, K = find_focus([camera], extent), camera.Ks[0]
    depth = float((focus.point - camera.centers[0]) @ camera.forwards[0])
    ray = torch.cat([((low + high) / 2 - K[:2, 2]) / K.diagonal()[:2], torch.ones(1)])
    half = MARGIN * depth * float(((high - low) / 2 / K.diagonal()[:2]).norm())
    return camera.centers[0] + camera.viewmats[0, :3, :3].T @ ray * depth, half, focus.radius


def plane_normal(camera: Cameras) -> Float[Tensor, "3"]:
    """The normal of the plane that the object is inflated about: level, or up where the camera looks steeply down."""
    axis, up = camera.forwards[0], world_up(camera.viewmats)
    level = axis - (axis @ up) * up
    return up if float((axis @ up).abs()) > math.sin(STEEP) else level / level.norm()


def silhouette_distances(solid: Bool[Tensor, "H W"]) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """d and w of (1) for every pixel, px; the image's border counts as outline."""
    padded = torch.nn.functional.pad(solid, (1, 1, 1, 1))[..., None]
    squared = squared_distance(~padded, max(padded.shape))
    inset = squared.float().sqrt()
    width, radius = inset.clone(), float(inset.max())
    while radius > 1:
        near = squared_distance(inset >= radius, math.ceil(radius)) <= radius**2
        width[near] = width[near].clamp_min(radius)
        radius /= RADIUS_RATIO
    return inset[1:-1, 1:-1, 0], (width * padded)[1:-1, 1:-1, 0]
