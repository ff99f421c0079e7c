"""The hostile scenes of the stress suite, a function each.

Every number is representable in float32 and stored in float64, so that the reference and a kernel see the same scene.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from raster_scenes import Case
from torch import Tensor

from gsopt.gaussians import PARAMETERS, Gaussians
from gsopt.geometry.cameras import Cameras, intrinsics, look_at
from gsopt.raster.backend import RasterSettings

TRAINED = Path(__file__).parent / "data" / "trained_patch.npz"
WIDTH, HEIGHT = 40, 28
DISTANCE = 5.0
COUNT = 24


def crowd(count: int = COUNT, seed: int = 0, **changed: Tensor) -> dict[str, Tensor]:
    """Parameters of a cloud of radius about 1 around the origin, some of them replaced."""
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng)

    plain = {
        "means": normal(count, 3),
        "quats": normal(count, 4),
        "log_scales": -1.6 + 0.5 * normal(count, 3),
        "logit_opacities": normal(count),
        "sh0": normal(count, 1, 3),
        "shN": 0.2 * normal(count, 15, 3),
    }
    return {**plain, **changed}


def ahead(width: int = WIDTH, height: int = HEIGHT, focal: float | None = None, distance: float = DISTANCE) -> Cameras:
    """A camera that looks along +z at the origin from `distance`; 0.9 rad wide unless a focal length (px) is given."""
    K = intrinsics(0.9, width, height)
    if focal is not None:
        K[0, 0] = K[1, 1] = focal
    viewmats = torch.eye(4, dtype=torch.float64)[None]
    viewmats[0, 2, 3] = distance
    return Cameras(viewmats, K[None], width, height)


def scene(parameters: dict[str, Tensor], camera: Cameras | None = None, settings: RasterSettings | None = None) -> Case:
    """The scene with every number rounded to float32."""
    gaussians = Gaussians(**parameters).to(torch.float32).to(torch.float64)
    camera = (camera or ahead()).to(torch.float32).to(torch.float64)
    background = torch.tensor([0.125, 0.25, 0.5], dtype=torch.float64)
    return Case(gaussians, camera, settings or RasterSettings(), background, seed=3)


def scales(*axes: float, count: int = COUNT) -> Float[Tensor, "N 3"]:
    """Logarithms of the same scales, three or one for all axes, for every Gaussian."""
    return torch.tensor([math.log(axis) for axis in axes]).expand(count, 3)


def scaled(*axes: float) -> Callable[[], Case]:
    """The crowd with these scales."""
    return lambda: scene(crowd(log_scales=scales(*axes)))


def scales_of_all_sizes() -> Case:
    sizes = torch.linspace(math.log(1e-12), math.log(1e6), 3 * COUNT)
    order = torch.randperm(3 * COUNT, generator=torch.Generator().manual_seed(1))
    return scene(crowd(log_scales=sizes[order].view(COUNT, 3)))


def quaternions_of_norm(norm: float) -> Callable[[], Case]:
    return lambda: scene(crowd(quats=torch.nn.functional.normalize(crowd()["quats"], dim=1) * norm))


def quaternions_with_denormal_parts() -> Case:
    quats = crowd()["quats"].clone()
    quats[torch.arange(COUNT), torch.arange(COUNT) % 4] = 1e-40
    return scene(crowd(quats=quats))


def opacities_at_both_ends() -> Case:
    return scene(crowd(logit_opacities=torch.tensor([80.0, -80.0]).repeat(COUNT // 2)))


def around_the_camera() -> Case:
    """Rows 0-6 stand in the camera, behind it, and at either side of the near plane (0.01)."""
    means = crowd()["means"] + torch.tensor([0.0, 0.0, DISTANCE])
    special = [
        (0, 0, 0),
        (1e-30, 0, 0),
        (0, 0, 1e-20),
        (0.1, 0.2, -3),
        (0.001, 0, 0.01),
        (0.003, 0, 0.0101),
        (0, 0, 0.02),
    ]
    means[: len(special)] = torch.tensor(special)
    return scene(crowd(means=means), ahead(distance=0.0))


def at_the_rim() -> Case:
    """179 degrees wide; the Gaussians stand near the camera, from 90 % to 140 % of the way to the frustum's edge."""
    half = math.radians(89.5)
    z = 0.02 + 0.05 * crowd()["means"][:, 2].abs()
    x = z * math.tan(half) * torch.linspace(0.9, 1.4, COUNT)
    means = torch.stack([x, crowd()["means"][:, 1], z], dim=1)
    return scene(crowd(means=means), ahead(focal=WIDTH / 2 / math.tan(half), distance=0.0))


ORIGIN = torch.tensor([1e6, -2e6, 1e6], dtype=torch.float64)
"""Of a survey in meters, as national grids have it."""


def far_survey() -> Case:
    return survey(ORIGIN)


def recentered_survey() -> Case:
    """As `load_scene` hands it on: the cameras' middle was subtracted from every position."""
    return survey(torch.zeros(3, dtype=torch.float64))


def survey(origin: Float[Tensor, "3"]) -> Case:
    """A square kilometer seen from 3 km; `origin` is where its middle stands in the coordinates that are used."""
    parameters = crowd(log_scales=crowd()["log_scales"] + math.log(500), means=500 * crowd()["means"])
    eye = torch.tensor([[900.0, 1200.0, 2500.0]], dtype=torch.float64)
    viewmats = look_at(eye, torch.zeros(3, dtype=torch.float64), torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    viewmats[0, :3, 3] -= viewmats[0, :3, :3] @ origin
    parameters["means"] = parameters["means"].double() + origin
    return scene(parameters, Cameras(viewmats, intrinsics(0.9, WIDTH, HEIGHT)[None], WIDTH, HEIGHT))


def coincident(logit: float, count: int = 10_000) -> Callable[[], Case]:
    def make() -> Case:
        one = crowd(count, log_scales=scales(0.4, 0.3, 0.2, count=count))
        quats = torch.tensor([[0.9, 0.1, 0.3, 0.2]]).expand(count, 4)
        opacity = torch.full((count,), logit)
        return scene({**one, "means": torch.zeros(count, 3), "quats": quats, "logit_opacities": opacity}, ahead(16, 16))

    return make


def at_one_depth() -> Case:
    """Half opaque Gaussians whose order, and so whose color, is decided by their index alone."""
    means = crowd(200)["means"] * torch.tensor([1.0, 1.0, 0.0])
    return scene(crowd(200, means=means, logit_opacities=torch.zeros(200)))


def through_a_lens(focal: float) -> Callable[[], Case]:
    """The crowd; before a long lens (focal length in px) so much smaller and flatter that it still fits the image."""

    def make() -> Case:
        narrow = min(1.0, 30 / focal)
        plain = crowd()
        means = plain["means"] * torch.tensor([narrow, narrow, 1.0])
        return scene(
            {**plain, "means": means, "log_scales": plain["log_scales"] + math.log(narrow)}, ahead(focal=focal)
        )

    return make


def of_size(width: int, height: int) -> Callable[[], Case]:
    """An image of this size whose longer side sees 0.9 rad."""
    focal = 0.5 * max(width, height) / math.tan(0.45)
    return lambda: scene(crowd(), ahead(width, height, focal))


def bright(factor: float) -> Callable[[], Case]:
    return lambda: scene(crowd(sh0=factor * crowd()["sh0"], shN=factor * crowd()["shN"]))


def dots(count: int = 1500) -> Case:
    """Far smaller than a pixel."""
    return scene(crowd(count, log_scales=scales(1e-4, count=count)))


def layers(count: int = 1500) -> Case:
    """Nearly opaque layers, one behind the other, over one corner of a 4x4 block of pixels: the other corner lives."""
    means = torch.tensor([-0.35, -0.35, 0.0]) + torch.linspace(0, 1, count)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    parameters = crowd(count, means=means, log_scales=scales(0.25, 0.25, 0.05, count=count))
    return scene({**parameters, "logit_opacities": torch.full((count,), 4.0)}, ahead(16, 16, focal=30.0))


def of_count(count: int) -> Callable[[], Case]:
    return lambda: scene(crowd(count))


def trained() -> Case:
    """A patch of what a long run on the demo's views left behind (data/README.md), and the camera that saw it."""
    with np.load(TRAINED, allow_pickle=False) as stored:
        tensors = {name: torch.from_numpy(stored[name]) for name in stored.files}
    camera = Cameras(tensors["viewmats"], tensors["Ks"], int(tensors["size"][0]), int(tensors["size"][1]))
    return scene({name: tensors[name] for name in PARAMETERS}, camera)


def antialiased(make: Callable[[], Case]) -> Callable[[], Case]:
    return lambda: replace(make(), settings=RasterSettings(antialiased=True))
