"""A scene small enough for either rasterizer: a cloud of splats, drawn into a NeRF-synthetic folder."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import DataConfig, DensityConfig, InitConfig, SparseConfig, TrainConfig
from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras, intrinsics, look_at, opengl_from_viewmats
from gsopt.raster.api import make_backend
from gsopt.raster.backend import RasterSettings

SIZE = 24
FOV = 0.7


def cloud(count: int, seed: int, radius: float = 0.6, sh_degree: int = 1) -> Gaussians:
    """Small colored Gaussians around the origin."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        means=radius * 0.5 * normal(count, 3),
        quats=normal(count, 4),
        log_scales=math.log(0.08) + 0.3 * normal(count, 3),
        logit_opacities=normal(count),
        sh0=normal(count, 1, 3),
        shN=0.1 * normal(count, (sh_degree + 1) ** 2 - 1, 3),
    )


def ring(views: int, height: float) -> Cameras:
    """Cameras on a circle of radius 3 that look at the origin."""
    angles = torch.arange(views, dtype=torch.float64) * 2 * math.pi / views
    eyes = torch.stack([3 * torch.cos(angles), 3 * torch.sin(angles), torch.full_like(angles, height)], dim=1)
    viewmats = look_at(eyes, torch.zeros(3, dtype=torch.float64), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    return Cameras(viewmats, intrinsics(FOV, SIZE, SIZE).expand(views, 3, 3), SIZE, SIZE)


def write_dataset(folder: Path, train: int = 5, test: int = 2) -> Path:
    """RGBA images of one cloud from two rings of cameras, as NeRF-synthetic lays them out."""
    truth = cloud(40, seed=7)
    for split, cameras in (("train", ring(train, 1.0)), ("test", ring(test, 0.4))):
        (folder / split).mkdir(parents=True)
        frames = []
        for i in range(len(cameras)):
            frame = make_backend("reference").forward(truth, cameras[i], RasterSettings(sh_degree=1))
            color = frame.colors / frame.alphas.clamp_min(1e-6)[..., None]
            rgba = torch.cat([color, frame.alphas[..., None]], dim=-1).clamp(0, 1)
            Image.fromarray(np.asarray(rgba * 255 + 0.5).astype(np.uint8)).save(folder / split / f"r_{i}.png")
            pose = opengl_from_viewmats(cameras.viewmats[i])
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()})
        document = {"camera_angle_x": FOV, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(document))
    return folder


def tiny_config(dataset: Path, **changes: object) -> TrainConfig:
    """A run of 30 steps that grows, prunes and saves; changes replace top-level fields."""
    settings: dict[str, object] = {
        "data": DataConfig(path=str(dataset)),
        "init": InitConfig(method="random", count=60),
        "density": DensityConfig(refine_start=4, refine_every=5, refine_stop=25, grow_grad2d=5e-5, max_gaussians=90),
        "iterations": 30,
        "guidance": GuidanceConfig(lambda_sds=0.0),
        "sparse": SparseConfig(symmetry="off"),  # the search takes longer than the run
        "backend": "cpu",
        "checkpoint_every": 10,
        "preview_every": 15,
        **changes,
    }
    return TrainConfig(**settings)  # type: ignore[arg-type]
