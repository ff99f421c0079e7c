"""Distance outside the visual hull, as smooth as its silhouettes: no voxel rounds it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gsopt._optional import require
from gsopt.data.resample import sample
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.projection import inside, project
from gsopt.init.thumbnails import Thumbnail


@dataclass(frozen=True)
class Outline:
    """The silhouette of one photo."""

    camera: Cameras
    distances: Float[Tensor, "1 H W"]
    """Distance outside of the silhouette, px; negative inside."""
    shows_all: bool


def outlines(photos: Sequence[Thumbnail]) -> list[Outline]:
    """Silhouettes as signed distances in their images."""
    distance = require("scipy.ndimage", "mesh", "A mesh").distance_transform_edt
    found = []
    for photo in photos:
        solid = photo.planes[3].numpy() > 127
        signed = (distance(~solid) - distance(solid)).astype(np.float32)
        signed -= np.sign(signed) * np.float32(0.5)  # the outline lies between two pixel centers
        found.append(Outline(photo.camera, torch.from_numpy(signed)[None], photo.shows_all()))
    return found


def hull_distance(shapes: Sequence[Outline], points: Float[Tensor, "N 3"], limit: float) -> Float[Tensor, "N"]:
    """Most distance outside of a silhouette over all views, scene units, within ±limit.

    A view that shows all of the object excludes what lies beside its image; another excludes nothing there.
    """
    most = torch.full((len(points),), -limit)
    for shape in shapes:
        column, row, depth = project(shape.camera, points)
        shown = inside(shape.camera, column, row, depth)
        column, row = (torch.where(shown, coordinate, 0.0) for coordinate in (column, row))
        outside = sample(shape.distances, column, row)[0] * depth / float(shape.camera.Ks[0, 0, 0])
        most = torch.maximum(most, torch.where(shown, outside, limit if shape.shows_all else -limit))
    return most.clamp(-limit, limit)
