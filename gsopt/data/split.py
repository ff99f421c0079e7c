"""Splits a dataset into input and held-out views."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.config.train import DataConfig
from gsopt.data.posed_images import Dataset, PosedImage
from gsopt.errors import UsageError
from gsopt.geometry.farthest_points import farthest_points
from gsopt.geometry.focus import AXIS_DAMPING, nearest_to_axes, up_direction

HOLD_OUT_EVERY = 8
"""As Mip-NeRF 360 and 3DGS do."""
TELLING_ELEVATION = 30.0
"""Degrees."""


def split(dataset: Dataset, config: DataConfig) -> tuple[list[PosedImage], list[PosedImage]]:
    """(train, test): the dataset's own test frames, else every 8th by name when `config.eval`, else no test."""
    train, test = dataset.frames, dataset.held_out
    if test is None:
        by_name = sorted(train, key=lambda frame: frame.name)
        test = by_name[::HOLD_OUT_EVERY] if config.eval else []
        held_out = {id(frame) for frame in test}
        train = [frame for frame in train if id(frame) not in held_out]
    return _chosen(train, config, dataset.kind) if train else [], test


def _chosen(train: list[PosedImage], config: DataConfig, kind: str) -> list[PosedImage]:
    if config.view_ids is not None:
        return _by_ids(train, config.view_ids, kind)
    if config.views is None:
        return train
    if config.views > len(train):
        raise UsageError(
            f"`--views` must be at most the {len(train)} input views there are, got {config.views}. Lower it."
        )
    centers = torch.stack([-frame.viewmat[:3, :3].T @ frame.viewmat[:3, 3] for frame in train])
    if config.views == 1:
        return [train[telling_view(centers, torch.stack([frame.viewmat for frame in train]))]]
    return [train[row] for row in sorted(farthest_points(centers, config.views))]


def telling_view(centers: Float[Tensor, "N 3"], viewmats: Float[Tensor, "N 4 4"]) -> int:
    """Row of the camera whose elevation above the focus is nearest to TELLING_ELEVATION: from there one photo shows
    front, side and top of an object. Ties go to the lowest row."""
    offsets = centers - nearest_to_axes(centers, viewmats[:, 2, :3], AXIS_DAMPING)
    sines = (offsets @ up_direction(viewmats)) / offsets.norm(dim=1).clamp_min(1e-12)
    return int((sines.clamp(-1, 1).asin() - math.radians(TELLING_ELEVATION)).abs().numpy().argmin())


def _by_ids(train: list[PosedImage], ids: tuple[int, ...], kind: str) -> list[PosedImage]:
    # NeRF-synthetic counts rows of the file, so that ids keep their meaning when an image is absent.
    rows = {frame.position: frame for frame in train} if kind == "nerf-synthetic" else dict(enumerate(train))
    for view in ids:
        if view not in rows:
            last = max(rows)
            reason = "its image is absent" if 0 <= view <= last else f"ids go from 0 to {last}"
            raise UsageError(f"`--view-ids` names {view}, but {reason}. Choose another id.")
    if len(set(ids)) < len(ids):
        raise UsageError(f"`--view-ids` names a view twice: {list(ids)}. Name each once.")
    return [rows[view] for view in ids]
