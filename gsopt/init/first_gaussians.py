"""The choice of the first Gaussians of a run, and its reason."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt import check
from gsopt.config.train import InitConfig
from gsopt.data.scene import Scene
from gsopt.errors import UsageError
from gsopt.gaussians import Gaussians
from gsopt.geometry.focus import find_focus
from gsopt.init.frustum import background_points, random_points
from gsopt.init.hull import hull_points
from gsopt.init.points import gaussians_at
from gsopt.init.thumbnails import mean_colors, small_photos

ENOUGH_POINTS = 100
"""Sparse points from which on they beat the hull and random points."""
ENOUGH_AGREED = 0.04
"""Share of the pixels on which photos must agree: four of different rooms agree on 0.03 by chance."""
FEW_PHOTOS = 16
"""Photos up to which stereo beats sparse points: it matches no more of them (docs/decisions/0041)."""
_MAX_COLOR_PHOTOS = 16
Start = tuple[Gaussians, str]
"""The Gaussians, and a description of their origin."""


def first_gaussians(scene: Scene, config: InitConfig, sh_degree: int, seed: int) -> Start:
    """The Gaussians a run starts from, and one line with the method and the reason for it.

    "auto" tries the methods of `_suited_methods` in turn. The same scene, config and seed give the same bits. Raises
    UsageError when the requested method does not fit the scene.
    """
    check.at_least("--init-count", config.count, 1, "Drop the flag for the default.")
    check.within("sh_degree", sh_degree, 0, 3, "Bands 0 to 3 are supported.")
    generator = torch.Generator().manual_seed(seed)
    requested = config.method != "auto"
    known = 0 if scene.points is None else len(scene.points.xyz)
    reason = (
        f"the scene has {known or 'no'} points and {'every view has' if scene.has_alpha else 'its views have no'} alpha"
    )
    why = "as asked" if requested else "because {}"
    for method in _suited_methods(scene, known, config):
        start = METHODS[method](scene, config.count, sh_degree, generator)
        if start is not None:
            return start[0], f"{start[1]}, {why.format(reason)}"
        if requested:
            raise UsageError(MISFITS[method])
        reason += FAILURES[method]
    xyz, rgb = _random_points(scene, config.count, generator)
    return gaussians_at(xyz, rgb, sh_degree), f"{len(xyz):,} random points where the cameras look, {why.format(reason)}"


def _suited_methods(scene: Scene, known: int, config: InitConfig) -> list[str]:
    """Methods before random points, best first: stereo without masks, unless the scene has points enough, with few
    photos as many as are wanted; else its points; the visual hull of a masked object."""
    if config.method != "auto":
        return [config.method] if config.method in METHODS else []
    enough = config.count if len(scene.train) <= FEW_PHOTOS else ENOUGH_POINTS
    wanted = [
        ("stereo", not scene.has_alpha and known < enough),
        ("points", known >= ENOUGH_POINTS),
        ("hull", scene.has_alpha),
        ("stereo", scene.has_alpha),  # alpha that hides nothing
    ]
    return [method for method, worth in wanted if worth]


def _from_points(scene: Scene, count: int, sh_degree: int, generator: torch.Generator) -> Start | None:
    points = scene.points
    if points is None or len(points.xyz) == 0:
        return None
    gaussians = gaussians_at(points.xyz, points.rgb.float() / 255, sh_degree)
    return gaussians, f"{len(gaussians):,} points that came with the scene"


def _from_hull(scene: Scene, count: int, sh_degree: int, generator: torch.Generator) -> Start | None:
    found = hull_points(scene, count, generator) if scene.has_alpha else None
    if found is None:
        return None
    gaussians = gaussians_at(found.xyz, found.rgb, sh_degree)
    body = "shapes of a library" if scene.body_colors is None else "body of a shape prior"
    guess = "inflated silhouette" if scene.body is None else body
    shape = guess if scene.guessed else f"visual hull of {found.silhouettes} silhouettes"
    return (
        gaussians,
        f"{shape}, {len(gaussians):,} points, voxel {found.voxel:.3g}",
    )


def _from_stereo(scene: Scene, count: int, sh_degree: int, generator: torch.Generator) -> Start | None:
    from gsopt.init.stereo.points import stereo_points  # its kernels are compiled, which the other ways do without

    found = stereo_points(scene, count, generator)
    if found.share < ENOUGH_AGREED:
        return None
    # Something must start where only one photo looks: far away, since nearer to others it would hang before them.
    cameras = [view.camera for view in scene.train]
    xyz = background_points(cameras, find_focus(cameras, scene.extent), count, generator)
    rgb = mean_colors(small_photos(scene.train, _MAX_COLOR_PHOTOS), xyz)
    gaussians = gaussians_at(torch.cat([found.xyz, xyz]), torch.cat([found.rgb, rgb]), sh_degree)
    agreed = f"{found.photos} photos agree on {found.share:.0%} of their pixels"
    return gaussians, f"{len(found.xyz):,} points by stereo ({agreed}) and {len(xyz):,} in the background"


def _random_points(
    scene: Scene, count: int, generator: torch.Generator
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]]:
    """Positions and colors (0..1)."""
    cameras = [view.camera for view in scene.train]
    focus = find_focus(cameras, scene.extent)
    xyz = random_points(cameras, focus, count, not scene.has_alpha, generator)
    if scene.has_alpha:
        # Most points lie beside the object: in its colors they stay there as fog (lego, 8 views: -11 dB).
        return xyz, torch.full((len(xyz), 3), 0.5)
    return xyz, mean_colors(small_photos(scene.train, _MAX_COLOR_PHOTOS), xyz)


METHODS: dict[str, Callable[[Scene, int, int, torch.Generator], Start | None]] = {
    "points": _from_points,
    "hull": _from_hull,
    "stereo": _from_stereo,
}
"""Functions of the scene, the number of points, the highest SH band and a generator; a method that does not fit the
scene returns None."""
MISFITS = {
    "points": "`--init points` needs a scene with points; it has none. Take `auto` instead.",
    "hull": "`--init hull` needs alpha or masks that outline one object in every input view; these do not agree on "
    "any. Check the masks, or take `--init random`.",
    "stereo": "`--init stereo` needs photos that overlap; too few of these show the same. Add photos between them, "
    "check the poses, or take `--init random`.",
}
FAILURES = {"hull": ", and its silhouettes enclose nothing", "stereo": ", and its photos agree on nothing"}
