"""Where a prior's lessons come from: real reconstructions from few views, beside the views they never saw.

A scene with many views is reconstructed from a few of them, as a user's run would. From the cameras of the others the
Gaussians are rendered with all that guidance would show a prior (`condition_planes`), and the photo is the answer.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float, Int, UInt8
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from gsopt.config.train import DataConfig, DensityConfig, InitConfig, TrainConfig
from gsopt.data.scene import Scene, View, load_scene
from gsopt.errors import InputError
from gsopt.events import write_atomic
from gsopt.gaussians import Gaussians
from gsopt.geometry.farthest_points import farthest_points
from gsopt.init import first_gaussians
from gsopt.raster.api import expected_depth
from gsopt.raster.backend import Backend, RasterSettings
from gsopt.sds import coverage
from gsopt.sds.candidate_views import nearest, square, square_views
from gsopt.sds.noise import generator
from gsopt.sds.observed_render import depth_in
from gsopt.sds.priors.protocol import References
from gsopt.sds.priors.view_conditioned import WARPED
from gsopt.sds.warp import warp
from gsopt.training.mirror_images import with_mirrors
from gsopt.training.plan import RunPlan
from gsopt.training.trainer import Trainer

INPUTS = (3, 4, 4, 5, 6, 8)
"""Numbers of input views that fits draw from."""
LENGTHS = (600, 1000, 1600)
"""Steps of a fit; its Gaussians are looked at after a third and at the end."""
LOOKS = 8
"""Held-out views per look, and one input view: there the right answer is to change little."""
BLACK = torch.zeros(3)


@dataclass(frozen=True)
class Pairs:
    """M renders with their answers; bytes, colors premultiplied by alpha."""

    truth: UInt8[Tensor, "M 4 S S"]
    render: UInt8[Tensor, "M 4 S S"]
    uncertainty: UInt8[Tensor, "M S S"]
    warped: UInt8[Tensor, "M K 5 S S"]
    """Color and alpha of the reference, and the confidence."""

    def __len__(self) -> int:
        return len(self.truth)

    def save(self, path: Path) -> None:
        write_atomic(path, save({name: tensor.contiguous() for name, tensor in vars(self).items()}))

    @staticmethod
    def load(path: Path) -> Pairs:
        """InputError for a file that is none of ours."""
        try:
            return Pairs(**load_file(path))
        except (OSError, SafetensorError, TypeError) as error:
            raise InputError(f"Cannot read the pairs {path} ({error}). Delete the file; it is made again.") from error

    def rows(self, rows: Int[Tensor, "m"]) -> Pairs:
        """Some of them."""
        return Pairs(*(tensor[rows] for tensor in vars(self).values()))

    @staticmethod
    def cat(parts: list[Pairs]) -> Pairs:
        return Pairs(*(torch.cat([getattr(part, name) for part in parts]) for name in vars(parts[0])))


def make_pairs(folder: Path, size: int, fit: int, seed: int, backend: Backend) -> Pairs:
    """Fit number `fit` of a scene, `size` px, and what its renders have to do with the truth."""
    scene = whole_scene(folder, size)
    random = generator(seed, fit, 0, folder.name)
    inputs, others = _dealt(scene, random)
    length = LENGTHS[_below(len(LENGTHS), random)]
    config = reconstruction_config(length, seed + fit)
    scene = with_mirrors(config, replace(scene, train=tuple(inputs)))
    looks = [look(g, scene, [*others, inputs[0]], size, backend) for g in fitted(config, scene, backend)]
    return Pairs.cat(looks)


def whole_scene(folder: Path, size: int) -> Scene:
    """All views of a scene as input views, about `size` px."""
    full = load_scene(DataConfig(path=str(folder)))
    side = min(min(view.camera.width, view.camera.height) for view in full.train)
    scene = load_scene(DataConfig(path=str(folder), downscale=max(1, side // size)))
    views = scene.train + scene.test
    if len(views) < 2:
        raise InputError(f"{folder} has one view; one to learn from and one to look at are needed. Leave it out.")
    return replace(scene, train=views, test=())


def _dealt(scene: Scene, random: torch.Generator) -> tuple[list[View], list[View]]:
    """Input views, well spread in every second fit, and held-out ones."""
    count = min(INPUTS[_below(len(INPUTS), random)], len(scene.train) - 1)
    rows = torch.randperm(len(scene.train), generator=random).tolist()
    if _below(2, random):
        pool = rows[: 3 * count]
        centers = torch.cat([scene.train[row].camera.centers for row in pool])
        picked = [pool[i] for i in farthest_points(centers, count)]
        rows = picked + [row for row in rows if row not in picked]
    views = [scene.train[row] for row in rows]
    return views[:count], views[count : count + LOOKS]


def reconstruction_config(length: int, seed: int) -> TrainConfig:
    """A run of `length` steps, as a user's but for its size."""
    return TrainConfig(
        init=InitConfig(count=5000),
        density=DensityConfig(refine_start=length // 10, max_gaussians=20_000),
        checkpoint_every=0,
        preview_every=0,
        seed=seed,
    ).with_steps(length)


def fitted(config: TrainConfig, scene: Scene, backend: Backend) -> Iterator[Gaussians]:
    """The Gaussians of a run after a third of it and at its end."""
    plan = RunPlan.of(config, scene)
    gaussians, _ = first_gaussians(scene, plan.init, plan.schedule.max_sh_degree, plan.seed)
    trainer = Trainer(plan, scene, gaussians, backend)
    for end in (config.iterations // 3, config.iterations):
        while trainer.step < end:
            trainer.advance()
        yield trainer.model.gaussians


@torch.no_grad()
def look(gaussians: Gaussians, scene: Scene, views: Sequence[View], size: int, backend: Backend) -> Pairs:
    """What a guided run on `scene` would show the prior from the cameras of `views`, and the views."""
    references = square_views(scene.train, size, BLACK)
    cameras = references.cameras
    depths = torch.stack([depth_in(gaussians, cameras[k], backend) for k in range(len(cameras))])
    references = replace(references, depths=depths)
    u = coverage.uncertainty(coverage.coverage(gaussians, [view.camera for view in scene.drawn], backend))
    truths = square_views(views, size, BLACK)
    rows = [_seen(gaussians, u, view, references, size, backend) for view in views]
    renders, uncertainties, warped = (torch.stack(column) for column in zip(*rows, strict=True))
    return Pairs(
        _bytes(torch.cat([truths.images, truths.alphas], 1)), _bytes(renders), _bytes(uncertainties), _bytes(warped)
    )


def _seen(
    gaussians: Gaussians, u: Tensor, view: View, references: References, size: int, backend: Backend
) -> tuple[Float[Tensor, "4 S S"], Float[Tensor, "S S"], Float[Tensor, "K 5 S S"]]:
    """A render with alpha, its uncertainty, and the references carried into it; zeros where there are fewer."""
    camera = square(view.camera, size)
    frame = backend.forward(gaussians, camera, RasterSettings(sh_degree=gaussians.sh_degree), BLACK, depth=True)
    assert frame.depths is not None
    found = nearest(references, camera, WARPED)
    assert found is not None
    assert found.depths is not None
    depth = expected_depth(frame.depths, frame.alphas)
    colors, alphas = (
        warp(camera, depth, frame.alphas, images, found.alphas, found.depths, found.cameras)
        for images in (found.images, found.alphas.expand_as(found.images))
    )
    warped = torch.zeros(WARPED, 5, size, size)
    warped[: len(colors)] = torch.cat([colors[:, :3], alphas[:, :1], colors[:, 3:]], 1)
    render = torch.cat([frame.colors.permute(2, 0, 1), frame.alphas[None]])
    return render, coverage.uncertainty_map(gaussians, u, camera, backend), warped


def _bytes(values: Tensor) -> Tensor:
    return (values.clamp(0, 1) * 255).round().to(torch.uint8)


def _below(count: int, random: torch.Generator) -> int:
    return int(torch.randint(count, (1,), generator=random))
