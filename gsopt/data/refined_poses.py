"""Poses that a run with `--refine-poses` corrected, put back into its scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.data import files
from gsopt.data.posed_images import read_pose
from gsopt.data.scene import Scene, View
from gsopt.errors import InputError


def with_refined_poses(scene: Scene, run: Path) -> Scene:
    """The scene with its input views where RUN/poses.json has them; as it is where there is no such file.

    A view that the file does not name stays. Raises InputError for a file that cannot be understood.
    """
    path = run / "poses.json"
    if not files.is_regular(path):
        return scene
    views = files.read_json(path).get("views")
    if not isinstance(views, list):
        raise InputError(f"{path} has no list `views`. Remove it to use the poses as they were given.")
    origin = torch.tensor(scene.origin, dtype=torch.float64)
    found = dict(_pose(view, f"views[{row}] in {path}", origin) for row, view in enumerate(views))
    return replace(scene, train=tuple(_moved(view, found.get(view.name)) for view in scene.train))


def _pose(view: Any, where: str, origin: Float[Tensor, "3"]) -> tuple[str, Float[Tensor, "4 4"]]:
    """Name and cam_from_world in the scene's frame, which is the source's less `origin`."""
    name = view.get("name") if isinstance(view, dict) else None
    if not isinstance(name, str):
        raise InputError(f"{where} must be an object with a string `name`. Remove the file to use the poses as given.")
    viewmat = read_pose(view, "cam_from_world", where)
    viewmat[:3, 3] += viewmat[:3, :3] @ origin
    return name, viewmat


def _moved(view: View, viewmat: Float[Tensor, "4 4"] | None) -> View:
    if viewmat is None:
        return view
    return replace(view, camera=replace(view.camera, viewmats=viewmat[None].to(view.camera.viewmats)))
