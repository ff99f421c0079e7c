"""Tiny finished runs: a dataset rendered from known splats, and a run directory with these splats."""

from __future__ import annotations

import json
import math
from pathlib import Path

import torch
from PIL import Image

from gsopt.config.train import DataConfig, TrainConfig
from gsopt.events import to_json
from gsopt.formats import save_splats
from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras, intrinsics, look_at, opengl_from_viewmats
from gsopt.raster.backend import RasterSettings
from gsopt.raster.reference import ReferenceBackend
from gsopt.results.finished_run import draw

WIDTH, HEIGHT, FOV = 40, 32, 0.8
WHITE = torch.ones(3)


def splats(count: int = 12, seed: int = 0) -> Gaussians:
    """A few colored blobs around the origin, float32."""
    generator = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=0.6 * torch.randn(count, 3, generator=generator),
        quats=torch.randn(count, 4, generator=generator),
        log_scales=torch.full((count, 3), math.log(0.25)),
        logit_opacities=torch.full((count,), 2.0),
        sh0=torch.randn(count, 1, 3, generator=generator),
        shN=torch.zeros(count, 0, 3),
    )


def ring(count: int, phase: float = 0.0) -> Cameras:
    """Cameras around the origin that look at it."""
    angles = phase + 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    eyes = torch.stack([4 * angles.cos(), 4 * angles.sin(), torch.full_like(angles, 1.5)], dim=1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    viewmats = look_at(eyes, torch.zeros(3, dtype=torch.float64), up)
    return Cameras(viewmats.float(), intrinsics(FOV, WIDTH, HEIGHT).float().repeat(count, 1, 1), WIDTH, HEIGHT)


def write_split(folder: Path, name: str, cameras: Cameras, gaussians: Gaussians) -> None:
    """transforms_NAME.json of NeRF-synthetic and its images, rendered on white."""
    (folder / name).mkdir(parents=True)
    frames = []
    for index in range(len(cameras)):
        picture = draw(gaussians, cameras[index], ReferenceBackend(), RasterSettings(sh_degree=0), WHITE)
        Image.fromarray(picture.numpy()).save(folder / name / f"r_{index}.png")
        pose = opengl_from_viewmats(cameras.viewmats[index].double()).tolist()
        frames.append({"file_path": f"./{name}/r_{index}", "transform_matrix": pose})
    (folder / f"transforms_{name}.json").write_text(json.dumps({"camera_angle_x": FOV, "frames": frames}))


def make_run(folder: Path, *, train: int = 4, test: int = 2, learned: Gaussians | None = None) -> Path:
    """A dataset in FOLDER/data and a run in FOLDER/run whose splats are the dataset's own unless others are given."""
    truth = splats()
    write_split(folder / "data", "train", ring(train), truth)
    if test:
        write_split(folder / "data", "test", ring(test, 0.4), truth)
    run = folder / "run"
    run.mkdir()
    config = TrainConfig(data=DataConfig(path=str(folder / "data")), backend="reference", iterations=100)
    (run / "config.json").write_bytes(to_json({"config": config.to_dict(), "versions": {"gsopt": "test"}}))
    save_splats(run / "splat.ply", learned or truth)
    return run
