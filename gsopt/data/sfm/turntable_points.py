"""The reconstruction of photos on a turntable: their cameras, and the points that their matches meet in."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from gsopt.data.sfm.features import ColmapProject
from gsopt.data.sfm.mapping import bundle_adjusted
from gsopt.data.sfm.pair_matches import PairMatches
from gsopt.data.sfm.turntable import MAX_ERROR, from_middles
from gsopt.data.sfm.turntable_fit import Turned
from gsopt.geometry.focus import nearest_to_axes

Feature = tuple[int, int]
"""The number of a photo and of a feature in it."""


def reconstructed(project: ColmapProject, camera: Any, pairs: PairMatches, turned: Turned) -> Any:
    """A reconstruction with these poses, a camera for each photo, and colored points fitted to them."""
    pycolmap = project.pycolmap
    model = pycolmap.Reconstruction()
    for photo, viewmat in zip(turned.photos, turned.viewmats, strict=True):
        model.add_camera_with_trivial_rig(_camera(camera, pairs, turned, photo))
        image = pycolmap.Image(
            name=pairs.names[photo], keypoints=pairs.keypoints[photo], camera_id=photo, image_id=photo
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.ascontiguousarray(viewmat[:3])))
    for track in tracks(pairs, turned, camera):
        elements = [pycolmap.TrackElement(*feature) for feature in track]
        model.add_point3D(_meeting(model, track), pycolmap.Track(elements))
    model.extract_colors_for_all_images(project.photos)
    return bundle_adjusted(project, model, lens=False, poses=False)


def tracks(pairs: PairMatches, turned: Turned, camera: Any) -> list[list[Feature]]:
    """Features that matches between placed photos on their epipolar lines join, at most one in each photo."""
    joined: dict[Feature, set[Feature]] = {}
    for pair, rows in _fitting_rows(pairs, turned, camera):
        for row in rows.tolist():
            one, other = (joined.setdefault(end, {end}) for end in zip(pair, row, strict=True))
            if one is not other and not {photo for photo, _ in one} & {photo for photo, _ in other}:
                one |= other
                joined |= dict.fromkeys(other, one)
    return [sorted(track) for track in {id(track): track for track in joined.values()}.values() if len(track) > 1]


def _fitting_rows(pairs: PairMatches, turned: Turned, camera: Any) -> Iterator[tuple[Feature, Any]]:
    """The pairs, those with the most in common first, and their matches that fit."""
    middles = {photo: middle(camera, pairs, photo) for photo in pairs.names}
    fits = turned.fits(from_middles(pairs, middles), MAX_ERROR)
    found = {pair: pairs.matches[pair][marks] for pair, marks in fits.items()}
    yield from sorted(found.items(), key=lambda item: (-len(item[1]), item[0]))


def middle(camera: Any, pairs: PairMatches, photo: int) -> Float[np.ndarray, "2"]:
    """The point where the axis of the lens meets a photo, as its background says."""
    return np.array([camera.principal_point_x, camera.principal_point_y]) + pairs.shifts.get(photo, np.zeros(2))


def _camera(camera: Any, pairs: PairMatches, turned: Turned, photo: int) -> Any:
    """The camera of one photo."""
    own = copy.deepcopy(camera)
    own.camera_id = photo
    params = np.array(own.params)
    params[own.focal_length_idxs()] *= turned.table.focal / own.mean_focal_length()
    params[own.principal_point_idxs()] = middle(camera, pairs, photo) + turned.shifts[turned.photos.index(photo)]
    own.params = params
    return own


def _meeting(model: Any, track: list[Feature]) -> Float[np.ndarray, "3"]:
    """The point nearest to the rays of features."""
    centers, ways = [], []
    for photo, feature in track:
        image = model.image(photo)
        pose = image.cam_from_world().inverse()
        ray = np.append(model.camera(photo).cam_from_img(image.points2D[feature].xy), 1.0)
        centers.append(pose.translation)
        ways.append(pose.rotation.matrix() @ (ray / np.linalg.norm(ray)))
    return nearest_to_axes(torch.from_numpy(np.array(centers)), torch.from_numpy(np.array(ways)), damping=0.0).numpy()
