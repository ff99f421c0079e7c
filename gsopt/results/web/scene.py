"""The cameras, the path and the look of a page."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gsopt.data.refined_poses import with_refined_poses
from gsopt.data.scene import Scene, load_scene
from gsopt.errors import GsoptError
from gsopt.formats.units import UNKNOWN, Units
from gsopt.gaussians import Gaussians
from gsopt.geometry.camera_paths import turntable_path
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.focus import find_focus, up_direction
from gsopt.results.finished_run import FinishedRun, look_at_point
from gsopt.results.measure import units_of

MAX_VIEWS = 200
PATH_POSES, PATH_SECONDS = 72, 20.0
CAMERA_SIZE = 0.06
"""Length of a drawn camera as a fraction of its distance to the focus."""
DEFAULT_SIZE = 800
FILLED, MAX_ZOOM, OUTSIDE = 0.92, 3.0, 0.002
"""Share of the opening image that the splats fill; most it is magnified; share of splats left out on each side."""
SOLID = 0.1
"""Opacity above which a splat counts there: 132 of the demo's 19,368 have more than one half, none at its feet."""
DIGITS = 7
"""Significant digits of a number in the page: float32 has as many."""


@dataclass(frozen=True)
class WebScene:
    """Cameras, path and look of a page. Names are not trusted."""

    title: str
    views: list[tuple[str, Cameras]]
    """Name and camera."""
    home: Cameras
    """The page opens here: the first view, cropped to what it shows of the splats."""
    inputs: int
    """The first views that are input cameras; the others are not drawn as cameras."""
    path: Cameras | None
    target: Tensor
    """The point [3] that dragging turns about."""
    up: Tensor
    background: tuple[float, float, float]
    antialiased: bool
    units: Units = UNKNOWN

    def to_json(self) -> dict[str, Any]:
        """The values that viewer.js reads."""
        path = [] if self.path is None else [pose(self.path[i]) for i in range(len(self.path))]
        distance = float((self.home.centers[0] - self.target.to(self.home.viewmats)).norm())
        return {
            "views": [{"name": name, **pose(camera)} for name, camera in self.views],
            "home": pose(self.home),
            "inputs": self.inputs,
            "path": path,
            "pathSeconds": PATH_SECONDS,
            "target": numbers(self.target),
            "up": numbers(self.up),
            "background": list(self.background),
            "antialiased": self.antialiased,
            "origin": list(self.units.origin),
            "metersPerUnit": self.units.meters_per_unit,
            "cameraSize": CAMERA_SIZE * max(distance, 1e-6),
        }


def pose(camera: Cameras) -> dict[str, list[float]]:
    """Eye, axes (right, down, forward) and lens (fx, fy, cx, cy, width, height) of one camera."""
    K = camera.Ks[0].double()
    lens = [*K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), camera.width, camera.height]
    axes = camera.viewmats[0, :3, :3].flatten()
    return {"eye": numbers(camera.centers[0]), "axes": numbers(axes), "lens": numbers(torch.tensor(lens))}


def numbers(values: Tensor) -> list[float]:
    return [float(f"{value:.{DIGITS}g}") for value in values.double().tolist()]


def scene_of_run(run: FinishedRun) -> WebScene:
    """Input and held-out cameras of a run; a run whose dataset is gone is shown as its splats alone."""
    try:
        scene = load_scene(run.config.data)
    except GsoptError:
        return scene_of_splats(
            run.gaussians, run.path.name, run.background, run.settings.antialiased, units_of(run.path)
        )
    return scene_of_views(run, scene)


def scene_of_views(run: FinishedRun, scene: Scene) -> WebScene:
    """The cameras of a run whose dataset was read."""
    scene = with_refined_poses(scene, run.path)
    inputs = spread([(view.name, view.camera) for view in scene.train])
    held_out = spread([(f"{view.name} (held out)", view.camera) for view in scene.test])
    cameras = Cameras.of_one_size([camera for _, camera in inputs])
    look_at = look_at_point(run.gaussians, cameras)
    focus = find_focus([camera for _, camera in inputs], scene.extent)
    return WebScene(
        title=run.path.name,
        views=[*inputs, *held_out],
        home=framed(run.gaussians, inputs[0][1]),
        inputs=len(inputs),
        path=turntable_path(cameras, PATH_POSES, look_at),
        target=focus.point if look_at is None else look_at,
        up=up_direction(cameras.viewmats),
        background=tuple(run.background.tolist()),
        antialiased=run.settings.antialiased,
        units=units_of(run.path),
    )


def framed(gaussians: Gaussians, camera: Cameras) -> Cameras:
    """The camera with another lens, so that the solid splats in its image fill it; never wider than before."""
    means = gaussians.means[gaussians.opacities > SOLID].double()
    t = means @ camera.viewmats[0, :3, :3].double().T + camera.viewmats[0, :3, 3].double()
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    pixels = t @ camera.Ks[0].double().T
    pixels = pixels[t[:, 2] > 0, :2] / pixels[t[:, 2] > 0, 2:]
    pixels = pixels[((pixels >= 0) & (pixels <= size)).all(dim=1)]
    if len(pixels) < 2:
        return camera
    ordered, outside = pixels.sort(dim=0).values, int(OUTSIDE * len(pixels))
    low, high = ordered[outside], ordered[-1 - outside]
    zoom = float((FILLED * size / (high - low).clamp_min(1)).min().clamp(1, MAX_ZOOM))
    if zoom == 1:
        return camera
    K = camera.Ks.double().clone()
    K[:, :2] *= zoom
    K[0, :2, 2] += size / 2 - zoom * (low + high) / 2
    return replace(camera, Ks=K.to(camera.Ks))


def spread(views: list[tuple[str, Cameras]]) -> list[tuple[str, Cameras]]:
    """At most MAX_VIEWS of the views, evenly chosen, the first included."""
    return views[:: -(-len(views) // MAX_VIEWS)] if views else []


def scene_of_splats(
    gaussians: Gaussians,
    title: str,
    background: Tensor | None = None,
    antialiased: bool = False,
    units: Units = UNKNOWN,
) -> WebScene:
    """One view of splats whose cameras are not known: from the front of a PLY's frame, around their solid middle."""
    means = (
        gaussians.means[gaussians.opacities >= gaussians.opacities.median()] if len(gaussians) else torch.zeros(1, 3)
    )
    center = means.median(dim=0).values
    distances = (means - center).norm(dim=1)
    radius = max(float(distances.kthvalue(math.ceil(0.9 * len(distances))).values), 1e-6)
    viewmat = torch.eye(4)
    viewmat[:3, 3] = torch.tensor([0, 0, 2.6 * radius]) - center
    f = 1.1 * DEFAULT_SIZE
    K = torch.tensor([[f, 0, DEFAULT_SIZE / 2], [0, f, DEFAULT_SIZE / 2], [0, 0, 1]])
    camera = Cameras(viewmats=viewmat[None], Ks=K[None], width=DEFAULT_SIZE, height=DEFAULT_SIZE)
    color = (0.0, 0.0, 0.0) if background is None else tuple(background.tolist())
    up = torch.tensor([0.0, -1, 0])
    return WebScene(title, [("", camera)], camera, 0, None, center, up, color, antialiased, units)
