"""A reconstruction of few photos with masks, moved to where the silhouettes of the object agree."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np

from gsopt.config.train import DataConfig
from gsopt.data.scene import load_scene
from gsopt.data.sfm.features import ColmapProject
from gsopt.data.sfm.mapping import bundle_adjusted
from gsopt.data.sfm.masks import FeatureInput
from gsopt.data.sfm.silhouettes import coherent_poses
from gsopt.data.sfm.trajectory import compare
from gsopt.data.sfm.write_scene import found_scene
from gsopt.events import Report

CONTRADICTION = (
    "The outlines in the masks do not fit these poses: they miss each other by {:.0f} px (masks of up to 512). Some "
    "poses or some masks are wrong, whatever the points say. Look at the cameras in the picture and at the masks, and "
    "take photos closer to each other."
)
LEAST_POINTS_LEFT = 0.8
"""Share of the points that must still fit: else silhouettes and points contradict each other, and points are kept."""


def held_by_silhouettes(
    project: ColmapProject, reconstruction: Any, inputs: FeatureInput, folder: Path, report: Report
) -> tuple[Any, list[str]]:
    """The reconstruction, or a copy with poses on which the silhouettes agree, and advice where nothing near makes them
    agree; `folder` is for the work."""
    images = {reconstruction.image(number).name: number for number in reconstruction.reg_image_ids()}
    if inputs.masks is None or images.keys() & set(inputs.unmasked):
        return reconstruction, []
    views = load_scene(DataConfig(path=str(found_scene(reconstruction, folder, inputs)), cache_mb=0)).train
    found = coherent_poses(views)
    if found is not None and found.contradicted:
        return reconstruction, [CONTRADICTION.format(found.before)]
    if found is None or not found.better:
        return reconstruction, []
    moved = copy.deepcopy(reconstruction)
    for view, viewmat in zip(views, found.viewmats.numpy(), strict=True):
        image = moved.image(images[view.name.removeprefix("images/")])
        pose = project.pycolmap.Rigid3d(np.ascontiguousarray(viewmat[:3]))
        moved.frame(image.frame_id).set_cam_from_world(image.camera_id, pose)
    moved = bundle_adjusted(project, moved, lens=False, poses=False)
    if moved.num_points3D() < LEAST_POINTS_LEFT * reconstruction.num_points3D():
        return reconstruction, []
    given = np.stack([view.camera.viewmats[0].double().numpy() for view in views])
    degrees = compare(found.viewmats.numpy(), given).rotation_degrees.max()
    report(
        f"silhouettes moved poses by up to {degrees:.1f} degrees: outlines now miss by {found.after:.1f} px, "
        f"{found.before:.1f} before"
    )
    return moved, []
