"""A finished run and its renders: cameras in, 8-bit images out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from gsopt.config.train import BACKGROUNDS, TrainConfig
from gsopt.data import files
from gsopt.data.refined_poses import with_refined_poses
from gsopt.data.resample import premultiply
from gsopt.data.scene import View, load_scene
from gsopt.errors import InputError
from gsopt.formats import load_splats
from gsopt.gaussians import Gaussians
from gsopt.geometry.camera_paths import ellipse_path, interpolated_path, orbit_path, turntable_path
from gsopt.geometry.cameras import Cameras
from gsopt.raster.api import make_backend
from gsopt.raster.backend import Backend, RasterSettings
from gsopt.raster.threads import one_torch_thread
from gsopt.results.camera_path_file import read_camera_path
from gsopt.results.video import safe_name, save_stills, save_video

NamedCamera = tuple[str, Cameras]
"""A file name without suffix, and the one camera to draw it from."""


@dataclass(frozen=True)
class FinishedRun:
    """The splats and settings of a run directory, ready to render."""

    path: Path
    config: TrainConfig
    gaussians: Gaussians
    backend: Backend
    settings: RasterSettings
    background: Float[Tensor, "3"]

    def draw(self, camera: Cameras) -> UInt8[Tensor, "H W 3"]:
        """The render of one camera on the run's background."""
        return draw(self.gaussians, camera, self.backend, self.settings, self.background)


def open_run(run: Path, backend: str | None = None, threads: int | None = None) -> FinishedRun:
    """Read config.json and splat.ply. `backend` and `threads` replace those of the configuration.

    Raises InputError when the folder is no run, or the run has not finished.
    """
    if not run.is_dir():
        raise InputError(f"{run} is not a folder. Give the run directory that `gsopt train` wrote.")
    config = TrainConfig.read(run / "config.json")
    if not (run / "splat.ply").is_file():
        raise InputError(
            f"{run} has no splat.ply: the run has not finished. Wait for it, or continue it with --resume."
        )
    gaussians = load_splats(run / "splat.ply")
    return FinishedRun(
        path=run,
        config=config,
        gaussians=gaussians,
        backend=backend_of(config, backend, threads),
        settings=RasterSettings(sh_degree=gaussians.sh_degree, antialiased=config.antialiased),
        background=background_of(run),
    )


def backend_of(config: TrainConfig, backend: str | None = None, threads: int | None = None) -> Backend:
    """The backend that a run was configured with, or another one."""
    device = config.device if backend in (None, config.backend) else ""
    return make_backend(backend or config.backend, config.threads if threads is None else threads, device)


def background_of(run: Path) -> Float[Tensor, "3"]:
    """The background that held-out views are evaluated on: the color of the run's plan, or what its settings name where
    it has none yet. InputError for a plan that is garbled."""
    document = files.read_json(run / "config.json")
    plan = document.get("plan")
    if not isinstance(plan, dict):
        named = TrainConfig.read(run / "config.json").data.background
        return torch.tensor(BACKGROUNDS.get(named, BACKGROUNDS["white"]))
    background = plan.get("background")
    color = background.get("color") if isinstance(background, dict) else None
    if not isinstance(color, list) or len(color) != 3:
        raise InputError(f"`plan.background` in {run / 'config.json'} is no color. Restore the file.")
    where = f"`plan.background` in {run / 'config.json'}"
    return torch.tensor([files.number(value, where) for value in color]).clamp(0, 1)


@one_torch_thread()
def draw(
    gaussians: Gaussians, camera: Cameras, backend: Backend, settings: RasterSettings, background: Float[Tensor, "3"]
) -> UInt8[Tensor, "H W 3"]:
    """The render of one camera, clamped to 0..1 and rounded to 8 bit."""
    camera = camera.to(gaussians.means.dtype)
    background = background.to(gaussians.means.dtype)
    return to_bytes(backend.forward(gaussians.to(backend.device), camera, settings, background).colors)


def truth(view: View, background: Float[Tensor, "3"]) -> UInt8[Tensor, "H W 3"]:
    """The view's own pixels on the background, rounded to 8 bit."""
    pixels = view.pixels()
    if pixels.shape[2] == 3:
        return pixels
    planes = premultiply(pixels) / 255
    return to_bytes(torch.addcmul(planes[:3].permute(1, 2, 0), 1 - planes[3][..., None], background))


def to_bytes(colors: Float[Tensor, "H W 3"]) -> UInt8[Tensor, "H W 3"]:
    return (colors.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu()


def cameras_along(run: FinishedRun, path: str, count: int, longest: int | None = None) -> list[NamedCamera]:
    """Cameras of `--path`: the input or held-out views, `count` cameras along a path, or those of a file (.json).

    `longest`: length of the longer side after scaling, px. Raises InputError when nothing was held out.
    """
    scene = with_refined_poses(load_scene(run.config.data), run.path)
    if path in ("train", "test"):
        views = scene.train if path == "train" else scene.test
        if not views:
            raise InputError(
                f"{run.path} held out no views to render, got 0. Choose another --path, or train with --eval."
            )
        shots = [(safe_name(index, view.name), view.camera) for index, view in enumerate(views)]
    elif path.endswith(".json"):
        shots = [(f"{i:04d}", camera) for i, camera in enumerate(read_camera_path(Path(path), scene.origin))]
    else:
        cameras = Cameras.of_one_size([view.camera for view in scene.train])
        path_cameras = camera_path(run, cameras, path, count)
        shots = [(f"{index:04d}", path_cameras[index]) for index in range(len(path_cameras))]
    return [(name, camera if longest is None else with_longest_side(camera, longest)) for name, camera in shots]


def camera_path(run: FinishedRun, cameras: Cameras, path: str, count: int) -> Cameras:
    """`count` cameras on an orbit, a turntable, an ellipse or through the given cameras (interpolated)."""
    if path == "interpolated":
        return interpolated_path(cameras, count)
    make = {"orbit": orbit_path, "turntable": turntable_path, "ellipse": ellipse_path}[path]
    return make(cameras, count, look_at_point(run.gaussians, cameras))


def look_at_point(gaussians: Gaussians, cameras: Cameras) -> Float[Tensor, "3"] | None:
    """Target of a path around a single camera: the median of the more opaque half of the Gaussians."""
    if len(cameras) > 1 or len(gaussians) == 0:
        return None
    solid = gaussians.means[gaussians.opacities >= gaussians.opacities.median()]
    return solid.median(dim=0).values


def with_longest_side(camera: Cameras, longest: int) -> Cameras:
    """The same camera with its longer side scaled to `longest` px."""
    scale = longest / max(camera.width, camera.height)
    return camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))


def render_stills(run: FinishedRun, shots: list[NamedCamera], folder: Path, *, overwrite: bool = False) -> None:
    """Writes PNG frames into a folder."""
    save_stills(folder, ((name, run.draw(camera)) for name, camera in shots), overwrite=overwrite)


def render_video(
    run: FinishedRun, shots: list[NamedCamera], output: Path, fps: float, *, overwrite: bool = False
) -> None:
    """Writes a video in the format that the suffix of `output` names."""
    save_video(output, (run.draw(camera) for _, camera in shots), fps, overwrite=overwrite)
