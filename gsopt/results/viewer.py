"""The web viewer: splats of a run or a file, the input cameras, and each new preview of a running training."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.config.train import TrainConfig
from gsopt.data.scene import load_scene
from gsopt.errors import InputError, UsageError
from gsopt.events import LAST, read_events
from gsopt.formats import load_splats
from gsopt.gaussians import Gaussians
from gsopt.geometry import sh
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.quats import from_rotation_matrices
from gsopt.raster.reference import covariances
from gsopt.results.viewer_server import start_server

POLL_SECONDS = 0.5
FRUSTUM_SIZE = 0.05
"""Length of a drawn camera as a fraction of the scene's radius."""
MAX_COVARIANCE = 6e4
"""Just below the largest half float, the format of covariances in the browser."""


@dataclass(frozen=True)
class Update:
    """A change to display."""

    splats: Path | None
    """File to load, or None when the event is only text."""
    caption: str


class RunFollower:
    """Reads a run's new events and returns its newest splats."""

    def __init__(self, run: Path) -> None:
        self.run = run
        self._offset = 0

    def poll(self) -> Update | None:
        """The newest update since the last call, or None; older previews are skipped."""
        events, self._offset = read_events(self.run / "events.jsonl", self._offset)
        updates = [update for event in events if (update := self._update(event)) is not None]
        drawn = [update for update in updates if update.splats is not None]
        if not updates:
            return None
        return Update(drawn[-1].splats if drawn else None, updates[-1].caption)

    def _update(self, event: dict[str, Any]) -> Update | None:
        kind = event.get("kind")
        if kind == "preview":
            step = event.get("step")
            return Update(self._inside(event.get("path")), f"step {step}" if type(step) is int else "preview")
        if kind in LAST:
            return Update(self._inside("splat.ply"), str(kind))
        return None

    def _inside(self, name: object) -> Path | None:
        """The file `name` of the run, or None when it is missing or outside the run directory."""
        if not isinstance(name, str):
            return None
        try:
            path = (self.run / name).resolve()
            return path if path.is_relative_to(self.run.resolve()) and path.is_file() else None
        except (OSError, ValueError, RuntimeError):  # too long, no text or a NUL, a circle of links
            return None


class SplatViewer:
    """A viser server with one set of splats and the input cameras. Raises MissingDependency without viser."""

    def __init__(self, host: str, port: int) -> None:
        self._server = start_server(host, port)
        # Not Markdown: viser runs the scripts in it, and a caption may hold the name of a stranger's file.
        self._caption = self._server.gui.add_text("splats", "waiting for the first ones", disabled=True)
        show = self._server.gui.add_checkbox("input cameras", initial_value=True)
        self._frames = self._server.scene.add_frame("/cameras", show_axes=False)
        show.on_update(lambda _: setattr(self._frames, "visible", show.value))

    @property
    def port(self) -> int:
        """The port in use: the next free one when the requested port was taken."""
        port: int = self._server.get_port()
        return port

    def show_splats(self, gaussians: Gaussians, caption: str) -> None:
        """Replaces the splats. Colors are those of SH degree 0: the browser's renderer supports no other bands."""
        sigma = covariances(gaussians.quats, gaussians.log_scales).clamp(-MAX_COVARIANCE, MAX_COVARIANCE)
        self._server.scene.add_gaussian_splats(
            "/splats",
            centers=gaussians.means.numpy(),
            covariances=sigma.numpy(),
            rgbs=sh.rgb_from_sh0(gaussians.sh0[:, 0]).clamp(0, 1).numpy(),
            opacities=gaussians.opacities[:, None].numpy(),
        )
        self._caption.value = f"{caption}: {len(gaussians)} Gaussians".encode(errors="backslashreplace").decode()

    def show_cameras(self, cameras: list[Cameras], radius: float) -> None:
        """Adds a frustum per camera and turns their mean up axis up; `radius` of the scene sets their size."""
        self._server.scene.set_up_direction(tuple(mean_up(cameras).tolist()))
        for i, camera in enumerate(cameras):
            world_from_cam = torch.linalg.inv(camera.viewmats[0].double())
            self._server.scene.add_camera_frustum(
                f"/cameras/{i:05d}",
                fov=vertical_fov(camera),
                aspect=camera.width / camera.height,
                scale=FRUSTUM_SIZE * radius,
                thickness=0.02 * FRUSTUM_SIZE * radius,
                wxyz=from_rotation_matrices(world_from_cam[:3, :3]).numpy(),
                position=world_from_cam[:3, 3].numpy(),
            )

    def look_from(self, eye: Float[Tensor, "3"], target: Float[Tensor, "3"]) -> None:
        """Sets the initial camera of browsers that connect."""
        self._server.initial_camera.position = tuple(eye.tolist())
        self._server.initial_camera.look_at = tuple(target.tolist())

    def stop(self) -> None:
        self._server.stop()


def vertical_fov(camera: Cameras) -> float:
    """Vertical field of view in radians."""
    return 2 * math.atan(0.5 * camera.height / float(camera.Ks[0, 1, 1]))


def mean_up(cameras: list[Cameras]) -> Float[Tensor, "3"]:
    """Mean of the cameras' up axes (-y in OpenCV axes), unit length; +z when they cancel."""
    up = -torch.stack([camera.viewmats[0, 1, :3].double() for camera in cameras]).mean(dim=0)
    return up / up.norm() if up.norm() > 1e-3 else torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def center_and_radius(means: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "3"], float]:
    """Median and a robust radius (90th percentile of the distance to it, scene units) of points."""
    if len(means) == 0:
        return torch.zeros(3), 1.0
    center = means.median(dim=0).values
    distances = (means - center).norm(dim=-1).sort().values
    return center, max(float(distances[int(0.9 * (len(distances) - 1))]), 1e-6)


def input_cameras(run: Path) -> list[Cameras]:
    """The input cameras of a run. Raises InputError when its dataset is gone."""
    return [view.camera for view in load_scene(TrainConfig.read(run / "config.json").data).train]


def view_file(viewer: SplatViewer, path: Path) -> None:
    """Show one splat file."""
    gaussians = load_splats(path)
    center, radius = center_and_radius(gaussians.means)
    viewer.show_splats(gaussians, path.name)
    viewer.look_from(center + radius * torch.tensor([2.0, 2.0, 1.0]), center)


def view_run(viewer: SplatViewer, run: Path) -> Iterator[str]:
    """Shows a run and follows it without end; yields a line per update, or "" when nothing is new."""
    follower = RunFollower(run)
    cameras, notice = cameras_or_notice(run)
    if notice:
        yield notice
    framed = False
    while True:
        update = follower.poll()
        if update is not None and update.splats is not None:
            gaussians = load_splats(update.splats)
            if not framed:
                frame_run(viewer, gaussians, cameras)
            framed = True
            viewer.show_splats(gaussians, update.caption)
        yield update.caption if update else ""


def cameras_or_notice(run: Path) -> tuple[list[Cameras], str]:
    """(input cameras, ""), or ([], reason), so that a run can be viewed after its photos have moved."""
    try:
        return input_cameras(run), ""
    except (InputError, UsageError) as error:
        return [], f"no input cameras: {error}"


def frame_run(viewer: SplatViewer, gaussians: Gaussians, cameras: list[Cameras]) -> None:
    """Place the browser's camera, and the frusta where there are any."""
    center, radius = center_and_radius(gaussians.means)
    eye = center + radius * torch.tensor([2.0, 2.0, 1.0])
    if cameras:
        viewer.show_cameras(cameras, radius)
        # Behind and above the first camera, so that its own frustum does not cover the view.
        first = cameras[0].centers[0].float()
        eye = first + 0.25 * (first - center) + 0.25 * (first - center).norm() * mean_up(cameras).float()
    viewer.look_from(eye, center)


def serve(target: Path, host: str, port: int, once: bool) -> None:
    """Shows `target` until interrupted; with `once`, returns after the first update.

    Raises InputError when `target` is neither a run directory nor a splat file.
    """
    is_run = target.is_dir()
    if is_run and not (target / "events.jsonl").is_file():
        raise InputError(f"{target} must be a run directory, got a folder without events.jsonl. Give what -m named.")
    if not is_run and not target.is_file():
        raise InputError(f"{target} must be a run directory or a splat file, got nothing there. Check the path.")
    viewer = SplatViewer(host, port)
    if port not in (0, viewer.port):
        print(f"port {port} is taken, using {viewer.port}")
    print(f"http://{host}:{viewer.port}  (Ctrl+C stops)", flush=True)
    try:
        if is_run:
            follow(view_run(viewer, target), once)
        else:
            view_file(viewer, target)
            while not once:
                time.sleep(POLL_SECONDS)
    finally:
        viewer.stop()


def follow(lines: Iterator[str], once: bool) -> None:
    """Prints the lines of `view_run`; with `once`, returns when nothing is new."""
    for line in lines:
        if line:
            print(line, flush=True)
        elif once:
            return
        else:
            time.sleep(POLL_SECONDS)
