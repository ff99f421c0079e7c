"""Bundle adjustment believes the many exact matches, however many others are a little wrong."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gsopt.data.sfm import mapping
from gsopt.data.sfm.mapping import bundle_adjusted
from gsopt.data.sfm.settings import SfmConfig
from gsopt.data.sfm.trajectory import compare

pycolmap = pytest.importorskip("pycolmap")

COUNT, POINTS, SIDE = 5, 300, 1000


def orbit() -> np.ndarray:
    """Cameras on an arc around the origin, cam_from_world."""
    viewmats = np.tile(np.eye(4), (COUNT, 1, 1))
    for row, angle in enumerate(np.radians([-30, -15, 0, 15, 30])):
        c, s = np.cos(angle), np.sin(angle)
        viewmats[row, :3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        viewmats[row, :3, 3] = [0, 0.02 * row**2, 4]
    return viewmats


def photographed(share: float, shift: float) -> Any:
    """A reconstruction of what the cameras saw; in one of them a share of the matches is shifted."""
    made, viewmats, generator = pycolmap.Reconstruction(), orbit(), np.random.default_rng(0)
    lens = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=SIDE, height=SIDE, params=[1200.0, SIDE / 2, SIDE / 2, 0.0], camera_id=1
    )
    made.add_camera_with_trivial_rig(lens)
    points = generator.uniform(-1, 1, (POINTS, 3))
    for number, viewmat in enumerate(viewmats, 1):
        seen = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        pixels = 1200 * seen[:, :2] / seen[:, 2:] + SIDE / 2
        if number == 3:
            pixels[: round(share * POINTS), 0] += shift
        image = pycolmap.Image(name=f"{number}.png", keypoints=pixels, camera_id=1, image_id=number)
        made.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.ascontiguousarray(viewmat[:3])))
    for row, point in enumerate(points):
        track = pycolmap.Track()
        for number in range(1, COUNT + 1):
            track.add_element(number, row)
        made.add_point3D(point, track)
    made.update_point_3d_errors()
    return made


def project(**changed: Any) -> Any:
    return SimpleNamespace(pycolmap=pycolmap, config=SfmConfig(focal=1200.0, **changed))


def turned(made: Any) -> float:
    """Degrees by which the worst camera is off."""
    viewmats = [np.vstack([made.image(i).cam_from_world().matrix(), [0, 0, 0, 1]]) for i in range(1, COUNT + 1)]
    return float(compare(np.stack(viewmats), orbit()).rotation_degrees.max())


def test_matches_that_are_a_little_wrong_move_no_camera() -> None:
    """A third of the matches of one photo lie 2 px to the right. Huber's loss at 1 px turns it by 0.01 degrees."""
    assert turned(bundle_adjusted(project(), photographed(0.0, 0.0), lens=False)) < 1e-4
    assert turned(bundle_adjusted(project(), photographed(0.35, 2.0), lens=False)) < 0.003


def test_the_scale_of_errors_is_that_of_the_photo_in_which_features_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Features of a large photo are found in a smaller copy, and are as much less exact."""
    scales: list[float] = []

    class Solver:
        def __init__(self, options: Any, *_: Any) -> None:
            scales.append(options.ceres.loss_function_scale)

        def solve(self) -> None: ...

    made = photographed(0.0, 0.0)
    monkeypatch.setattr(pycolmap, "create_default_bundle_adjuster", Solver)
    for max_size in (SIDE // 2, SIDE, 2 * SIDE):
        bundle_adjusted(project(max_size=max_size), made)
    assert scales == [2 * mapping.LOSS_SCALE, mapping.LOSS_SCALE, mapping.LOSS_SCALE]
