"""The web viewer: splats of a run or a file, the input cameras, and each new preview of a running training."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.config.train import TrainConfig
from gsopt.data.scene import Scene, View, load_scene
from gsopt.errors import InputError, UsageError
from gsopt.formats import load_splats
from gsopt.formats.units import Units
from gsopt.formats.validation import MAX_SH_DEGREE
from gsopt.gaussians import Gaussians
from gsopt.geometry import sh
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.quats import from_rotation_matrices
from gsopt.raster.reference import covariances
from gsopt.results.finished_run import truth
from gsopt.results.measure import units_of
from gsopt.results.report.embedded_images import shrunk
from gsopt.results.run_follower import RunFollower
from gsopt.results.unseen import marked, unseen
from gsopt.results.video import as_image
from gsopt.results.viewer_controls import HeldOutViews, RunControls, held_out_views
from gsopt.results.viewer_measure import MeasureControls
from gsopt.results.viewer_path import KeyframeControls
from gsopt.results.viewer_server import start_server
from gsopt.results.web.scene import framed

POLL_SECONDS = 0.5
PHOTO_SIDE = 160
"""Longer side of a photo in its camera, px."""
RECOLOR_SHARE = 0.03
"""An eye that moved by this share of its distance to the splats sees other colors."""
FRUSTUM_SIZE = 0.12
"""Length of a drawn camera as a fraction of the scene's radius."""
MAX_COVARIANCE = 6e4
"""Just below the largest half float, the format of covariances in the browser."""


class SplatViewer:
    """A viser server with one set of splats and the input cameras. Raises MissingDependency without viser."""

    def __init__(self, host: str, port: int) -> None:
        self._server = start_server(host, port)
        # Not Markdown: viser runs the scripts in it, and a caption may hold the name of a stranger's file.
        self._caption = self._server.gui.add_text("splats", "waiting for the first ones", disabled=True)
        show = self._server.gui.add_checkbox("input cameras and photos", initial_value=False)
        self._frames = self._server.scene.add_frame("/cameras", show_axes=False, visible=False)
        show.on_update(lambda _: setattr(self._frames, "visible", show.value))
        self._lock = threading.Lock()
        self._gaussians: Gaussians | None = None
        self._splats: Any = None
        self._scale, self._degree, self._mark = 1.0, MAX_SH_DEGREE, False
        self._cameras: list[Cameras] = []
        self._unseen: Tensor | None = None
        self._eye = self._seen_from = torch.zeros(3)
        self._add_look_controls()
        self.keyframes = KeyframeControls(self._server)
        self.measure = MeasureControls(self._server, lambda: self._gaussians)
        self._server.on_client_connect(lambda client: client.camera.on_update(self._follow_eye))

    def _add_look_controls(self) -> None:
        gui = self._server.gui
        scale = gui.add_slider("splat size", min=0.0, max=1.0, step=0.01, initial_value=1.0)
        scale.on_update(lambda _: self.set_look(scale=float(scale.value)))
        degree = gui.add_slider("SH degree", min=0, max=MAX_SH_DEGREE, step=1, initial_value=MAX_SH_DEGREE)
        degree.on_update(lambda _: self.set_look(degree=int(degree.value)))
        mark = gui.add_checkbox("mark what no photo shows", initial_value=False)
        mark.on_update(lambda _: self.set_look(mark=bool(mark.value)))
        color = gui.add_rgb("background", initial_value=(255, 255, 255))
        color.on_update(lambda _: self.set_background(color.value))

    def set_background(self, color: tuple[int, ...]) -> None:
        """Fills the space behind the splats with one color, 0 to 255."""
        self._server.scene.set_background_image(np.full((2, 2, 3), color, np.uint8))

    def set_look(self, scale: float | None = None, degree: int | None = None, mark: bool | None = None) -> None:
        """Draws the splats smaller, to points at 0, with fewer bands of their harmonics, or the unseen ones marked."""
        self._scale = self._scale if scale is None else scale
        self._degree = self._degree if degree is None else degree
        self._mark = self._mark if mark is None else mark
        with self._lock:
            if self._gaussians is not None:
                self._splats.covariances = self._covariances()
                self._splats.rgbs = self._colors()

    def _follow_eye(self, camera: Any) -> None:
        self._eye = torch.tensor(camera.position, dtype=torch.float32)

    def refresh(self) -> None:
        """Colors the splats as they look from where the newest visitor is, if he moved."""
        with self._lock:
            gaussians = self._gaussians
            if gaussians is None or not len(gaussians) or min(self._degree, gaussians.sh_degree) == 0:
                return
            reach = float((gaussians.means.median(dim=0).values - self._eye).norm())
            if float((self._eye - self._seen_from).norm()) > RECOLOR_SHARE * reach:
                self._splats.rgbs = self._colors()

    def _covariances(self) -> Any:
        assert self._gaussians is not None
        sigma = covariances(self._gaussians.quats, self._gaussians.log_scales)
        return (sigma * self._scale**2).clamp(-MAX_COVARIANCE, MAX_COVARIANCE).numpy()

    def _colors(self) -> Any:
        assert self._gaussians is not None
        g, self._seen_from = self._gaussians, self._eye
        directions = torch.nn.functional.normalize(g.means - self._eye, dim=1)
        rgb = sh.evaluate(g.sh0, g.shN, directions, min(self._degree, g.sh_degree)).clamp(0, 1)
        if self._mark and self._cameras:
            self._unseen = unseen(g, self._cameras) if self._unseen is None else self._unseen
            rgb = marked(rgb, self._unseen)
        return rgb.numpy()

    @property
    def port(self) -> int:
        """The port in use: the next free one when the requested port was taken."""
        port: int = self._server.get_port()
        return port

    def show_splats(self, gaussians: Gaussians, caption: str) -> None:
        """Replaces the splats. The browser's renderer knows no harmonics: colors are those seen from one eye."""
        with self._lock:
            self._gaussians, self._unseen = gaussians, None
            self._splats = self._server.scene.add_gaussian_splats(
                "/splats",
                centers=gaussians.means.numpy(),
                covariances=self._covariances(),
                rgbs=self._colors(),
                opacities=gaussians.opacities[:, None].numpy(),
            )
        self._caption.value = f"{caption}: {len(gaussians)} Gaussians".encode(errors="backslashreplace").decode()

    def show_cameras(self, cameras: list[Cameras], radius: float, photos: list[Any] | None = None) -> None:
        """Adds a frustum per camera, its photo [H, W, 3] as the image plane, and turns their mean up axis up.

        `radius` of the scene sets their size.
        """
        self._cameras, self._unseen = cameras, None
        self._server.scene.set_up_direction(tuple(mean_up(cameras).tolist()))
        for i, camera in enumerate(cameras):
            world_from_cam = torch.linalg.inv(camera.viewmats[0].double())
            self._server.scene.add_camera_frustum(
                f"/cameras/{i:05d}",
                fov=vertical_fov(camera),
                aspect=camera.width / camera.height,
                scale=FRUSTUM_SIZE * radius,
                thickness=0.02 * FRUSTUM_SIZE * radius,
                image=photos[i] if photos else None,
                wxyz=from_rotation_matrices(world_from_cam[:3, :3]).numpy(),
                position=world_from_cam[:3, 3].numpy(),
            )

    def look_from(
        self, eye: Float[Tensor, "3"], target: Float[Tensor, "3"], up: Tensor | None = None, fov: float | None = None
    ) -> None:
        """Sets the initial camera of browsers that connect; `fov` is vertical, in radians."""
        self._eye = eye.float()
        camera = self._server.initial_camera
        camera.position, camera.look_at = tuple(eye.tolist()), tuple(target.tolist())
        if up is not None:
            camera.up = tuple(up.tolist())
        if fov is not None:
            camera.fov = fov
        if self._gaussians is not None:
            self.set_look()

    def add_run(self, run: Path, scene: Scene | None, config: TrainConfig) -> tuple[RunControls, HeldOutViews | None]:
        """Adds progress and stop of a run, and its held-out views."""
        views = scene.test if scene else ()
        return RunControls(self._server, run), held_out_views(self._server, views, config, run)

    def set_units(self, units: Units) -> None:
        """Takes on the scale and origin of what is shown: lengths in meters, paths in the frame of the dataset."""
        self.keyframes.origin, self.measure.units = units.origin, units

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


def view_file(viewer: SplatViewer, path: Path) -> None:
    """Show one splat file."""
    gaussians = load_splats(path)
    center, radius = center_and_radius(gaussians.means)
    viewer.set_units(units_of(path))
    viewer.show_splats(gaussians, path.name)
    viewer.look_from(center + radius * torch.tensor([2.0, 2.0, 1.0]), center)


def view_run(viewer: SplatViewer, run: Path) -> Iterator[str]:
    """Shows a run and follows it without end; yields a line per update, or "" when nothing is new."""
    follower = RunFollower(run)
    config = TrainConfig.read(run / "config.json")
    scene, notice = scene_or_notice(config)
    if notice:
        yield notice
    viewer.set_units(units_of(run))
    controls, held_out = viewer.add_run(run, scene, config)
    framed = False
    while True:
        update = follower.poll()
        controls.show(follower.share)
        viewer.refresh()
        if update is not None and update.splats is not None:
            gaussians = load_splats(update.splats)
            if not framed:
                frame_run(viewer, gaussians, scene)
            framed = True
            viewer.show_splats(gaussians, update.caption)
            if held_out is not None:
                held_out.update(gaussians)
        yield update.caption if update else ""


def scene_or_notice(config: TrainConfig) -> tuple[Scene | None, str]:
    """(scene, ""), or (None, reason), so that a run can be viewed after its photos have moved."""
    try:
        return load_scene(config.data), ""
    except (InputError, UsageError) as error:
        return None, f"no input cameras: {error}"


def frame_run(viewer: SplatViewer, gaussians: Gaussians, scene: Scene | None) -> None:
    """Opens the browser at the first input camera, its view filled by the splats; without cameras from aside."""
    center, radius = center_and_radius(gaussians.means)
    if scene is None:
        viewer.look_from(center + radius * torch.tensor([2.0, 2.0, 1.0]), center)
        return
    viewer.show_cameras([view.camera for view in scene.train], radius, [photo(view) for view in scene.train])
    viewer.look_from(*home_view(gaussians, scene.train[0].camera, center))


def home_view(
    gaussians: Gaussians, camera: Cameras, center: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"], Float[Tensor, "3"], float]:
    """(eye, target, up, vertical field of view) of the camera, turned and zoomed until the splats fill its image."""
    lens = framed(gaussians, camera)
    middle = torch.tensor([lens.width / 2, lens.height / 2, 1.0], dtype=torch.float64)
    cam_from_world = camera.viewmats[0, :3, :3].double()
    ray = cam_from_world.T @ torch.linalg.solve(lens.Ks[0].double(), middle)
    eye = camera.centers[0].double()
    distance = float((center.double() - eye) @ cam_from_world[2])
    return eye, eye + ray * (distance if distance > 0 else 1.0), -cam_from_world[1], vertical_fov(lens)


def photo(view: View) -> Any:
    """[H, W, 3] a thumbnail of an input view on white."""
    return np.asarray(shrunk(as_image(truth(view, torch.ones(3))), PHOTO_SIDE))


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
                viewer.refresh()
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
