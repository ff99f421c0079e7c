"""Depths on which photos agree, as depth maps of the input views."""

from __future__ import annotations

from dataclasses import replace

import torch

from gsopt.data.scene import Scene
from gsopt.init.stereo.points import match_photos


def with_stereo_depths(scene: Scene, least_agreed: float, seed: int) -> Scene:
    """The scene with the points on which photos agree, and the inverse depths of the pixels that show them; without
    depths where photos agree on less than the share `least_agreed` of their pixels, as they do by chance."""
    found = match_photos(scene, torch.Generator().manual_seed(seed))
    points = found.points()
    scene = replace(scene, agreed=points)
    if points.share < least_agreed:
        return scene
    views = zip(scene.train, found.depths(), strict=True)
    return replace(scene, train=tuple(replace(view, depth=depth) for view, depth in views))
