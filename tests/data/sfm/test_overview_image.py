"""The picture of a posed scene."""

from __future__ import annotations

import io

import numpy as np
import torch
from PIL import Image

from gsopt.data.sfm.overview_image import CAMERA_COLOR, PANEL_SIDE, draw_scene
from gsopt.geometry.cameras import look_at


def test_cameras_open_where_they_look() -> None:
    """Two cameras that look to the right, seen from above: triangles as wide as long, with the tip at the left."""
    eyes = torch.tensor([[0.0, 0, 0], [4, 4, 0]])
    viewmats = torch.cat(
        [look_at(eye[None], eye + torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 0, 1])) for eye in eyes]
    )
    picture = draw_scene(viewmats.double().numpy(), ["a", "b"], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "two")
    pixels = np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")).astype(int)[:PANEL_SIDE, :PANEL_SIDE]
    rows, columns = np.nonzero(np.abs(pixels - CAMERA_COLOR).sum(-1) < 90)
    for one in (columns < PANEL_SIDE // 2, columns >= PANEL_SIDE // 2):
        length, width = (int(np.ptp(values[one])) for values in (columns, rows))
        assert 0.9 * length < width < 1.2 * length
        tip, mouth = (rows[one & (columns == end)] for end in (columns[one].min() + 4, columns[one].max() - 4))
        assert np.ptp(tip) < 0.5 * np.ptp(mouth)
