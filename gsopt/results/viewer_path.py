"""A camera path in the web viewer: a visitor's own camera as keyframes, played, and saved as nerfstudio's JSON."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import torch

from gsopt.formats.units import NOWHERE, Point
from gsopt.geometry.camera_paths import interpolated_path
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.quats import rotation_matrices
from gsopt.results.camera_path_file import encoded_camera_path

SEGMENT_SECONDS, FPS = 2, 24
"""Time from keyframe to keyframe, and frames per second."""
FILE = "camera-path.json"


class KeyframeControls:
    """Buttons that add the camera of who presses them, take the last one back, play the path and save it."""

    def __init__(self, server: Any) -> None:
        self.origin: Point = NOWHERE
        """Added to every position of a saved path: the frame of the dataset."""
        self._keyframes: list[Cameras] = []
        with server.gui.add_folder("camera path", expand_by_default=False):
            self._state = server.gui.add_text("keyframes", "0", disabled=True)
            for label, action in (
                ("add this camera", self.add),
                ("remove the last", self.remove),
                ("play", self.play),
                ("save for gsopt render --path", self.save),
            ):
                server.gui.add_button(label).on_click(lambda event, action=action: action(event.client))

    def add(self, client: Any) -> None:
        """Adds a visitor's camera."""
        self._keyframes.append(camera_of(client.camera))
        self._show()

    def remove(self, client: Any) -> None:
        """Takes the last keyframe back."""
        del self._keyframes[-1:]
        self._show()

    def _show(self) -> None:
        self._state.value = str(len(self._keyframes))

    def path(self) -> Cameras | None:
        """The cameras along the keyframes, None with fewer than two; all have the image size of the first."""
        if len(self._keyframes) < 2:
            return None
        cameras = Cameras.of_one_size(self._keyframes)
        return interpolated_path(cameras, FPS * SEGMENT_SECONDS * (len(cameras) - 1) + 1)

    def play(self, client: Any) -> None:
        """Moves a visitor's camera along the path."""
        path = self.path()
        for shot in [] if path is None else [path[i] for i in range(len(path))]:
            show(client, shot)
            time.sleep(1 / FPS)

    def save(self, client: Any) -> None:
        """Sends the path to a visitor's browser as a file."""
        path = self.path()
        if path is None:
            client.add_notification("camera path", "A path needs two keyframes. Add this camera, move, add another.")
            return
        shots = [path[i] for i in range(len(path))]
        client.send_file_download(FILE, encoded_camera_path(shots, FPS, self.origin))


def camera_of(seen: Any) -> Cameras:
    """A browser's camera; even sides, which films need."""
    width, height = (max(2, int(side) // 2 * 2) for side in (seen.image_width, seen.image_height))
    world_from_cam = torch.eye(4, dtype=torch.float64)
    world_from_cam[:3, :3] = rotation_matrices(torch.tensor(seen.wxyz, dtype=torch.float64)[None])[0]
    world_from_cam[:3, 3] = torch.tensor(seen.position, dtype=torch.float64)
    focal = height / 2 / math.tan(float(seen.fov) / 2)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    return Cameras(torch.linalg.inv(world_from_cam)[None], K[None], width, height)


def show(client: Any, shot: Cameras) -> None:
    """Puts a visitor's camera where one of the path stands."""
    R, eye = shot.viewmats[0, :3, :3].numpy(), shot.centers[0].numpy()
    reach = float(np.linalg.norm(np.subtract(client.camera.look_at, client.camera.position)))
    with client.atomic():
        client.camera.position = tuple(eye)
        client.camera.up_direction = tuple(-R[1])
        client.camera.look_at = tuple(eye + reach * R[2])
        client.camera.fov = 2 * math.atan(shot.height / 2 / float(shot.Ks[0, 1, 1]))
