"""A reconstruction of few photos with masks, moved to where the silhouettes of the object agree."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsopt.config.train import DataConfig
from gsopt.data.scene import View, load_scene
from gsopt.data.sfm.features import ColmapProject
from gsopt.data.sfm.mapping import bundle_adjusted
from gsopt.data.sfm.masks import FeatureInput
from gsopt.data.sfm.silhouettes import CoherentPoses, coherent_poses, contradicting
from gsopt.data.sfm.trajectory import compare
from gsopt.data.sfm.write_scene import found_scene
from gsopt.events import Report

CONTRADICTION = (
    "The outlines in the masks do not fit these poses: they miss each other by {:.0f} px (masks of up to 512). Some "
    "poses or some masks are wrong, whatever the points say. Look at the masks, or give `--masks none`; take photos "
    "closer to each other."
)
LEFT_OUT = (
    "Left out: {}. The outlines contradict those of all other photos, which agree, and few points hold these poses: "
    "where a thing looks alike from several sides, photos can match the wrong side. Take photos in between."
)
WRONG_MASKS = (
    "The outlines in the masks of {} contradict those of all other photos, which agree, and many points hold these "
    "poses: look at the masks."
)
LOOSE = 0.25
"""Share of the usual number of shared points below which few points hold a photo. Two of 14 photos of a toy that were
turned by 176 degrees: 0.07 and 0.09."""
REFUTED = 4.0
"""Root mean square of the misses, px of 512, that refutes poses whatever the points say. Lego with 3, 9 and 16 photos
turned by 60 to 164 degrees: 4.1, 6.5 and 7.0; 12 of a museum's head turned by 121 degrees, 540 points a photo, 0.9 px:
8.6; the same with right poses and masks by a small network: 3.2."""
LEAST_POINTS_LEFT = 0.8
"""Share of the points that must still fit: else silhouettes and points contradict each other, and points are kept."""


def held_by_silhouettes(
    project: ColmapProject, reconstruction: Any, inputs: FeatureInput, folder: Path, report: Report
) -> tuple[Any | None, list[str]]:
    """The reconstruction, or a copy with poses on which the silhouettes agree, and advice where nothing near makes them
    agree; `folder` is for the work. A copy lacks photos whose outlines contradict all others and that few points hold.
    Returns no reconstruction where the outlines refute it.
    """
    views = _views(reconstruction, inputs, folder)
    found = coherent_poses(views) if views else None
    if found is None:
        return reconstruction, []
    if found.contradicted:
        wrong, numbers = _wrong(reconstruction, views)
        if not wrong:
            return reconstruction if found.after < REFUTED else None, [CONTRADICTION.format(found.before)]
        if not loosely_held(reconstruction, numbers):
            return reconstruction, [WRONG_MASKS.format(" and ".join(wrong))]
        left = _without(project, reconstruction, numbers)
        held, advice = held_by_silhouettes(project, left, inputs, folder, report)
        return held, [LEFT_OUT.format(" and ".join(wrong)), *advice]
    moved = _moved(project, reconstruction, views, found, report) if found.better else None
    return reconstruction if moved is None else moved, []


def outline_misses(reconstruction: Any, inputs: FeatureInput, folder: Path) -> float | None:
    """Misses of the outlines with the best poses near those of a reconstruction, px, without the photos that will be
    left out, or None where a photo has no outline."""
    views = _views(reconstruction, inputs, folder)
    found = coherent_poses(views) if views else None
    if found is not None and found.contradicted:
        wrong, numbers = _wrong(reconstruction, views)
        if wrong and loosely_held(reconstruction, numbers):
            found = coherent_poses([view for view in views if _name(view) not in wrong])
    return None if found is None else found.after


def _wrong(reconstruction: Any, views: Sequence[View]) -> tuple[list[str], set[int]]:
    """Names and numbers of the photos whose outlines contradict all others."""
    wrong = [_name(views[number]) for number in contradicting(views)]
    return wrong, {number for number in reconstruction.reg_image_ids() if reconstruction.image(number).name in wrong}


def _views(reconstruction: Any, inputs: FeatureInput, folder: Path) -> tuple[View, ...]:
    """The photos with their masks as a scene, or none where one has no mask."""
    names = {reconstruction.image(number).name for number in reconstruction.reg_image_ids()}
    if inputs.masks is None or names & set(inputs.unmasked):
        return ()
    shutil.rmtree(folder, ignore_errors=True)
    found = found_scene(reconstruction, folder, inputs)
    return load_scene(DataConfig(path=str(found), downscale=1, cache_mb=0)).train


def loosely_held(reconstruction: Any, photos: set[int]) -> bool:
    """True where each of these photos shares less than LOOSE of the points with the others that the median other one
    does: then its pose is what is wrong, not its mask."""
    others = set(reconstruction.reg_image_ids()) - photos
    shared = dict.fromkeys(photos | others, 0)
    for point in reconstruction.points3D.values():
        seen_by = {element.image_id for element in point.track.elements}
        for number in seen_by:
            shared[number] += bool((seen_by & others) - {number})
    usual = np.median([shared[number] for number in others])
    return all(shared[number] < LOOSE * usual for number in photos)


def _without(project: ColmapProject, reconstruction: Any, photos: set[int]) -> Any:
    """A copy that lacks these photos, adjusted."""
    left = copy.deepcopy(reconstruction)
    for number in sorted(photos):
        left.deregister_frame(left.image(number).frame_id)
    return bundle_adjusted(project, left, lens=False)


def _moved(
    project: ColmapProject, reconstruction: Any, views: Sequence[View], found: CoherentPoses, report: Report
) -> Any | None:
    """A copy with the poses found and points that fit them, or None where too few do."""
    moved = copy.deepcopy(reconstruction)
    images = {moved.image(number).name: moved.image(number) for number in moved.reg_image_ids()}
    for view, viewmat in zip(views, found.viewmats.numpy(), strict=True):
        image = images[_name(view)]
        pose = project.pycolmap.Rigid3d(np.ascontiguousarray(viewmat[:3]))
        moved.frame(image.frame_id).set_cam_from_world(image.camera_id, pose)
    moved = bundle_adjusted(project, moved, lens=False, poses=False)
    if moved.num_points3D() < LEAST_POINTS_LEFT * reconstruction.num_points3D():
        return None
    given = np.stack([view.camera.viewmats[0].double().numpy() for view in views])
    degrees = compare(found.viewmats.numpy(), given).rotation_degrees.max()
    report(
        f"silhouettes moved poses by up to {degrees:.1f} degrees: outlines now miss by {found.after:.1f} px, "
        f"{found.before:.1f} before"
    )
    return moved


def _name(view: View) -> str:
    """The photo that a view shows."""
    return view.name.removeprefix("images/")
