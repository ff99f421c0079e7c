"""The first Gaussians of a run: which method, and why."""

from __future__ import annotations

import torch
from torch import Tensor

from gsopt import check
from gsopt.cameras import Cameras
from gsopt.config import InitConfig
from gsopt.data.scene import Points, Scene
from gsopt.errors import UsageError
from gsopt.gaussians import Gaussians
from gsopt.init.frustum import random_points
from gsopt.init.hull import hull_points
from gsopt.init.photos import mean_colors, small_photos
from gsopt.init.points import gaussians_at
from gsopt.init.rig import find_focus
from gsopt.init.stereo.points import stereo_points

ENOUGH_POINTS = 100
"""Sparse points from which on they beat the other methods in "auto"."""
ENOUGH_AGREED = 0.05
"""Share of the pixels on which two photos must agree: photos of different rooms agree on 0.03 by chance."""
FEW_PHOTOS = 10
"""So many find their depth better by stereo, more of them from random points (docs/decisions/0003-stereo.md)."""
_COLOR_PHOTOS = 16


def first_gaussians(scene: Scene, config: InitConfig, sh_degree: int, seed: int) -> tuple[Gaussians, str]:
    """The Gaussians a run starts from, and one line that says which method made them and why.

    "auto": the scene's points when there are at least 100, else the visual hull when every input view has alpha and
    the silhouettes agree, else with few views the places on which photos agree (stereo), else random. The same scene,
    config and seed give the same bits. Raises UsageError when the method asked for does not fit the scene.
    """
    check.at_least("--init-count", config.count, 1, "Drop the flag for the default.")
    check.within("sh_degree", sh_degree, 0, 3, "Bands 0 to 3 are supported.")
    generator = torch.Generator().manual_seed(seed)
    known = 0 if scene.points is None else len(scene.points.xyz)
    if config.method == "points" or (config.method == "auto" and known >= ENOUGH_POINTS):
        return _from_points(scene.points, sh_degree)
    reason = f"the scene has {known} points, fewer than {ENOUGH_POINTS}, " if known else "the scene has no points "
    asked = config.method != "auto"
    if config.method == "hull" or (not asked and scene.has_alpha):
        found = _from_hull(scene, config.count, sh_degree, generator)
        if found is not None:
            why = "as asked" if asked else f"because {reason}and every view has alpha"
            return found[0], f"visual hull of {found[1]}, {why}"
        if asked:
            raise UsageError(
                "`--init hull` needs alpha or masks that outline one object in every input view; these do not "
                "agree on any. Check the masks, or take `--init random`."
            )
    reason += "and its silhouettes enclose nothing" if scene.has_alpha else "and its views have no alpha"
    if config.method == "stereo" or (not asked and len(scene.train) <= FEW_PHOTOS):
        found = _from_stereo(scene, config.count, sh_degree, generator)
        if found is not None:
            return found[0], f"{found[1]}, {'as asked' if asked else f'because {reason}'}"
        if asked:
            raise UsageError(
                "`--init stereo` needs photos that overlap; too few of these show the same. Add photos between "
                "them, check the poses, or take `--init random`."
            )
        reason += ", and its photos agree on nothing"
    gaussians = _random(scene, config.count, sh_degree, generator)
    why = "as asked" if asked else f"because {reason}"
    return gaussians, f"{len(gaussians):,} random points where the cameras look, {why}"


def _from_points(points: Points | None, sh_degree: int) -> tuple[Gaussians, str]:
    if points is None or len(points.xyz) == 0:
        raise UsageError("`--init points` needs a scene with points; it has none. Take `auto` instead.")
    gaussians = gaussians_at(points.xyz, points.rgb.float() / 255, sh_degree)
    return gaussians, f"{len(gaussians):,} points that came with the scene"


def _from_hull(scene: Scene, count: int, sh_degree: int, generator: torch.Generator) -> tuple[Gaussians, str] | None:
    if not scene.has_alpha:
        return None
    found = hull_points(scene, count, generator)
    if found is None:
        return None
    gaussians = gaussians_at(found.xyz, found.rgb, sh_degree)
    return gaussians, f"{found.silhouettes} silhouettes, {len(gaussians):,} points, voxel {found.voxel:.3g}"


def _from_stereo(scene: Scene, count: int, sh_degree: int, generator: torch.Generator) -> tuple[Gaussians, str] | None:
    found = stereo_points(scene, count, generator)
    if found.share < ENOUGH_AGREED:
        return None
    xyz, rgb = _random_points(
        scene, count, generator
    )  # where only one photo looks, or none agree, something must start
    gaussians = gaussians_at(torch.cat([found.xyz, xyz]), torch.cat([found.rgb, rgb]), sh_degree)
    agreed = f"{found.photos} photos agree on {found.share:.0%} of their pixels"
    return gaussians, f"{len(found.xyz):,} points by stereo ({agreed}) and {len(xyz):,} at random"


def _random(scene: Scene, count: int, sh_degree: int, generator: torch.Generator) -> Gaussians:
    xyz, rgb = _random_points(scene, count, generator)
    return gaussians_at(xyz, rgb, sh_degree)


def _random_points(scene: Scene, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Places and colours."""
    cameras: list[Cameras] = [view.camera for view in scene.train]
    focus = find_focus(cameras, scene.extent)
    xyz = random_points(cameras, focus, count, not scene.has_alpha, generator)
    if scene.has_alpha:
        # Most points lie beside the object: in its colours they stay there as fog (lego, 8 views: -11 dB).
        return xyz, torch.full((len(xyz), 3), 0.5)
    return xyz, mean_colors(small_photos(scene.train, _COLOR_PHOTOS), xyz)
