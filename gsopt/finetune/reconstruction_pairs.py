"""Training pairs of a prior: renders of real reconstructions from few views, and the held-out views.

A scene with many views is reconstructed from a few of them, as in a user's run. The Gaussians are rendered from the
other cameras with all conditions that guidance gives a prior (`condition_planes`); the held-out view is the training
target.
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
from gsopt.sds.priors.view_conditioned import MAX_REFERENCES
from gsopt.sds.warp import warp
from gsopt.training.mirror_images import with_mirrors
from gsopt.training.plan import RunPlan
from gsopt.training.trainer import Trainer

INPUT_COUNTS = (3, 4, 4, 5, 6, 8)
"""Choices for the number of input views of a reconstruction."""
STEP_COUNTS = (600, 1000, 1600)
"""Choices for the steps of a reconstruction; its Gaussians are rendered after a third and at the end."""
HELD_OUT_VIEWS = 8
"""Number of rendered held-out views, beside one input view, where the right prediction changes little."""
BLACK = torch.zeros(3)


@dataclass(frozen=True)
class Pairs:
    """M renders with their targets; bytes, colors premultiplied by alpha."""

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
        """Raises InputError for a file in another format."""
        try:
            return Pairs(**load_file(path))
        except (OSError, SafetensorError, TypeError) as error:
            raise InputError(
                f"Cannot read the pairs {path} ({error}). Delete the file; it is computed again."
            ) from error

    def rows(self, rows: Int[Tensor, "m"]) -> Pairs:
        """Returns the pairs in these rows."""
        return Pairs(*(tensor[rows] for tensor in vars(self).values()))

    @staticmethod
    def cat(parts: list[Pairs]) -> Pairs:
        return Pairs(*(torch.cat([getattr(part, name) for part in parts]) for name in vars(parts[0])))


def make_pairs(folder: Path, size: int, index: int, seed: int, backend: Backend) -> Pairs:
    """Reconstructs a scene for the time `index` and returns its renders, `size` px, with their targets."""
    scene = whole_scene(folder, size)
    random = generator(seed, index, 0, folder.name)
    inputs, others = _split_views(scene, random)
    length = STEP_COUNTS[_below(len(STEP_COUNTS), random)]
    config = reconstruction_config(length, seed + index)
    scene = with_mirrors(config, replace(scene, train=tuple(inputs)))
    looks = [
        render_pairs(g, scene, [*others, inputs[0]], size, backend) for g in reconstructions(config, scene, backend)
    ]
    return Pairs.cat(looks)


def whole_scene(folder: Path, size: int) -> Scene:
    """Loads all views of a scene as input views, about `size` px."""
    full = load_scene(DataConfig(path=str(folder), downscale=1))
    side = min(min(view.camera.width, view.camera.height) for view in full.train)
    scene = load_scene(DataConfig(path=str(folder), downscale=max(1, side // size)))
    views = scene.train + scene.test
    if len(views) < 2:
        raise InputError(f"{folder} has one view; one input and one held-out view are needed. Leave it out.")
    return replace(scene, train=views, test=())


def _split_views(scene: Scene, random: torch.Generator) -> tuple[list[View], list[View]]:
    """Returns input views, well spread in every second reconstruction, and held-out views."""
    count = min(INPUT_COUNTS[_below(len(INPUT_COUNTS), random)], len(scene.train) - 1)
    rows = torch.randperm(len(scene.train), generator=random).tolist()
    if _below(2, random):
        pool = rows[: 3 * count]
        centers = torch.cat([scene.train[row].camera.centers for row in pool])
        picked = [pool[i] for i in farthest_points(centers, count)]
        rows = picked + [row for row in rows if row not in picked]
    views = [scene.train[row] for row in rows]
    return views[:count], views[count : count + HELD_OUT_VIEWS]


def reconstruction_config(length: int, seed: int) -> TrainConfig:
    """Returns the configuration of a small run of `length` steps, otherwise a user's defaults."""
    return TrainConfig(
        init=InitConfig(count=5000),
        density=DensityConfig(refine_start=length // 10, max_gaussians=20_000),
        checkpoint_every=0,
        preview_every=0,
        seed=seed,
    ).with_steps(length)


def reconstructions(config: TrainConfig, scene: Scene, backend: Backend) -> Iterator[Gaussians]:
    """Yields the Gaussians of a run after a third of its steps and at its end."""
    plan = RunPlan.of(config, scene)
    gaussians, _ = first_gaussians(scene, plan.init, plan.schedule.max_sh_degree, plan.seed)
    trainer = Trainer(plan, scene, gaussians, backend)
    for end in (config.iterations // 3, config.iterations):
        while trainer.step < end:
            trainer.advance()
        yield trainer.model.gaussians


@torch.no_grad()
def render_pairs(gaussians: Gaussians, scene: Scene, views: Sequence[View], size: int, backend: Backend) -> Pairs:
    """Renders the conditions that a guided run on `scene` would give the prior from `views`, with these views."""
    references = square_views(scene.train, size, BLACK)
    cameras = references.cameras
    depths = torch.stack([depth_in(gaussians, cameras[k], backend) for k in range(len(cameras))])
    references = replace(references, depths=depths)
    u = coverage.uncertainty(coverage.coverage(gaussians, [view.camera for view in scene.observed], backend))
    truths = square_views(views, size, BLACK)
    rows = [_rendered(gaussians, u, view, references, size, backend) for view in views]
    renders, uncertainties, warped = (torch.stack(column) for column in zip(*rows, strict=True))
    return Pairs(
        _bytes(torch.cat([truths.images, truths.alphas], 1)), _bytes(renders), _bytes(uncertainties), _bytes(warped)
    )


def _rendered(
    gaussians: Gaussians, u: Tensor, view: View, references: References, size: int, backend: Backend
) -> tuple[Float[Tensor, "4 S S"], Float[Tensor, "S S"], Float[Tensor, "K 5 S S"]]:
    """Returns a render with alpha, its uncertainty, and the warped references, padded with zeros."""
    camera = square(view.camera, size)
    frame = backend.forward(gaussians, camera, RasterSettings(sh_degree=gaussians.sh_degree), BLACK, depth=True)
    assert frame.depths is not None
    found = nearest(references, camera, MAX_REFERENCES)
    assert found is not None
    assert found.depths is not None
    depth = expected_depth(frame.depths, frame.alphas)
    colors, alphas = (
        warp(camera, depth, frame.alphas, images, found.alphas, found.depths, found.cameras)
        for images in (found.images, found.alphas.expand_as(found.images))
    )
    warped = torch.zeros(MAX_REFERENCES, 5, size, size)
    warped[: len(colors)] = torch.cat([colors[:, :3], alphas[:, :1], colors[:, 3:]], 1)
    render = torch.cat([frame.colors.permute(2, 0, 1), frame.alphas[None]])
    return render, coverage.uncertainty_map(gaussians, u, camera, backend), warped


def _bytes(values: Tensor) -> Tensor:
    return (values.clamp(0, 1) * 255).round().to(torch.uint8)


def _below(count: int, random: torch.Generator) -> int:
    return int(torch.randint(count, (1,), generator=random))
