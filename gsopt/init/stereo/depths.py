"""Depths on which photos agree, as depth maps of the input views."""

from __future__ import annotations

from dataclasses import replace

import torch

from gsopt.data.scene import Scene
from gsopt.geometry.focus import find_focus
from gsopt.init.stereo.points import MAX_PHOTOS, agreed, plane_maps
from gsopt.init.thumbnails import small_photos


def with_stereo_depths(scene: Scene, least_agreed: float, seed: int) -> Scene:
    """The scene with the inverse depths of each pixel on which another photo agrees; as it is where photos agree on
    less than the share `least_agreed` of their pixels, as they do by chance."""
    photos = small_photos(scene.train, MAX_PHOTOS)
    focus = find_focus([view.camera for view in scene.train], scene.extent)
    maps = plane_maps(photos, focus, torch.Generator().manual_seed(seed))
    kept = [agreed(each, [other for other in maps if other is not each]) for each in maps]
    if sum(int(keep.sum()) for keep in kept) < least_agreed * sum(keep.numel() for keep in kept):
        return scene
    depths = [each.inverse_depths().masked_fill(~keep, torch.nan) for each, keep in zip(maps, kept, strict=True)]
    return replace(scene, train=tuple(replace(v, depth=d) for v, d in zip(scene.train, depths, strict=True)))
