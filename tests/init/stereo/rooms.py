"""Scenes of the textured room, whose every surface is a known plane."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import textured_room as room
import torch

from gsopt.data.scene import Scene, load_scene


def room_scene(root: Path, viewmats: torch.Tensor, seeds: list[int] | None = None) -> Scene:
    """Posed opaque photos; one seed per photo makes each show a room of its own."""
    root.mkdir(parents=True)
    frames = []
    for index, viewmat in enumerate(viewmats):
        name = f"{index}.png"
        room.draw(viewmat, seeds[index] if seeds else 0).save(root / name)
        pose = torch.linalg.inv(viewmat) @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    lens = {"fl_x": room.FOCAL, "fl_y": room.FOCAL, "cx": room.WIDTH / 2, "cy": room.HEIGHT / 2}
    document = {"camera_model": "PINHOLE", "w": room.WIDTH, "h": room.HEIGHT, **lens, "frames": frames}
    (root / "transforms.json").write_text(json.dumps(document))
    return load_scene(root)


def distance_to_the_room(points: torch.Tensor) -> torch.Tensor:
    """To the nearest of the room's surfaces: rectangles."""
    found = []
    for plane in room.PLANES:
        corner, right, _, down = (torch.tensor(np.array(p), dtype=torch.float32) for p in plane)
        across, along = right - corner, down - corner
        local = points - corner
        u = ((local @ across) / across.square().sum()).clamp(0, 1)
        v = ((local @ along) / along.square().sum()).clamp(0, 1)
        found.append((local - u[:, None] * across - v[:, None] * along).norm(dim=1))
    return torch.stack(found).amin(0)
