"""Figures of a finished run beside metrics.json: quality over time, masks and depth, images for the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.benchmark.scenes import quality_over_time
from gsopt.benchmark.suite.result_file import CURVE_POINT
from gsopt.data.scene import Scene, View
from gsopt.results.evaluation import METRIC_DIGITS, evenly_spread
from gsopt.results.finished_run import FinishedRun, truth
from gsopt.results.report.embedded_images import data_uri, error_map, shrunk
from gsopt.results.video import as_image

CURVE_VIEWS = 8
"""Held-out views that are evaluated during the run, evenly spread."""
MASK_ALPHA = 0.5
"""Alpha above which a pixel belongs to the object."""
IMAGE_SIDE = 256
MAX_DEPTH_BYTES = 1 << 28

Event = Mapping[str, Any]


def curve(finished: FinishedRun, scene: Scene, events: Sequence[Event], setup: float) -> list[dict[str, Any]]:
    """Held-out quality at every preview and at the end (`result_file.CURVE_POINT`), over CPU seconds."""
    points = quality_over_time(finished, evenly_spread(scene.test, CURVE_VIEWS), events)
    points = [{**point, "cpu_seconds": round(setup + point["cpu_seconds"], 2)} for point in points]
    return [{key: point[key] for key in CURVE_POINT} for point in points]


@torch.no_grad()
def shape(finished: FinishedRun, scene: Scene) -> dict[str, list[float | None]]:
    """Mask IoU and mean depth error (scene units) per held-out view, or None where the truth is missing."""
    rows = [_shape_of(finished, scene, view) for view in scene.test]
    return {"mask_iou": [iou for iou, _ in rows], "depth_error": [depth for _, depth in rows]}


def _shape_of(finished: FinishedRun, scene: Scene, view: View) -> tuple[float | None, float | None]:
    pixels = view.pixels()
    depth = read_depth(scene.path, view)
    if pixels.shape[2] < 4 and depth is None:
        return None, None
    camera = view.camera.to(finished.gaussians.means.dtype)
    frame = finished.backend.forward(
        finished.gaussians.to(finished.backend.device), camera, finished.settings, None, depth=True
    )
    alphas = frame.alphas.cpu()
    solid = alphas > MASK_ALPHA
    iou = overlap(solid, pixels[..., 3] > 255 * MASK_ALPHA) if pixels.shape[2] == 4 else None
    if depth is None or frame.depths is None:
        return iou, None
    both = solid & (depth > 0)
    if not bool(both.any()):
        return iou, None
    error = (frame.depths.cpu()[both] / alphas[both] - depth[both]).abs().double().mean()
    return iou, round(float(error), METRIC_DIGITS)


def overlap(a: Tensor, b: Tensor) -> float:
    """Intersection over union of two masks; 1 where both are empty."""
    union = int((a | b).sum())
    return round(int((a & b).sum()) / union, METRIC_DIGITS) if union else 1.0


def read_depth(root: Path, view: View) -> Float[Tensor, "H W"] | None:
    """Depth map depth/NAME.npy as synth_views writes it: z in scene units, 0 in empty space. Returns None for a missing
    file, another size, or anything but a plain array of numbers."""
    path = root / "depth" / f"{Path(view.name).stem}.npy"
    if not path.is_file() or path.stat().st_size > MAX_DEPTH_BYTES:
        return None
    try:
        values = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None
    if not isinstance(values, np.ndarray) or values.shape != (view.camera.height, view.camera.width):
        return None
    return torch.from_numpy(values.astype(np.float32))


@torch.no_grad()
def images(finished: FinishedRun, scene: Scene) -> tuple[dict[str, str], dict[str, str]]:
    """(images that all runs of a scene share, images of this run), as data URIs: the held-out view that is farthest
    from all input views, a choice that depends on no result, and the input view nearest to it."""
    view, nearest = remote_view(scene)
    target, render = as_image(truth(view, finished.background)), as_image(finished.draw(view.camera))
    shared = {"view": view.name, "truth": data_uri(shrunk(target, IMAGE_SIDE)), "input_view": nearest.name}
    shared["input"] = data_uri(shrunk(as_image(truth(nearest, finished.background)), IMAGE_SIDE))
    error = error_map(render, target)
    return shared, {"render": data_uri(shrunk(render, IMAGE_SIDE)), "error": data_uri(shrunk(error, IMAGE_SIDE))}


def remote_view(scene: Scene) -> tuple[View, View]:
    """The held-out view whose nearest input camera is farthest away, and that input view."""
    inputs = torch.cat([view.camera.centers for view in scene.train])
    distances = torch.stack([(inputs - view.camera.centers).norm(dim=1) for view in scene.test])
    row = int(distances.min(dim=1).values.numpy().argmax())
    return scene.test[row], scene.train[int(distances[row].numpy().argmin())]
