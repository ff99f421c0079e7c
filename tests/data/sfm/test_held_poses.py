"""What silhouettes change in a reconstruction: who is left out, which poses are set, and what is said of it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from gsopt.data.sfm import held_by_silhouettes as held
from gsopt.data.sfm.settings import SfmConfig
from gsopt.data.sfm.silhouettes import CoherentPoses

pycolmap = pytest.importorskip("pycolmap")


def row_of_cameras(count: int) -> Any:
    """Cameras side by side that all see ten points."""
    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=90, height=90, params=[90.0, 90.0, 45.0, 45.0], camera_id=1)
    )
    for number in range(1, count + 1):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([float(number), 0, 0]))
        image = pycolmap.Image(name=f"{number}.png", keypoints=np.zeros((10, 2)), camera_id=1, image_id=number)
        made.add_image_with_trivial_frame(image, pose)
    for row in range(10):
        track = pycolmap.Track()
        for number in range(1, count + 1):
            track.add_element(number, row)
        made.add_point3D(np.array([0.0, 0, 5]), track)
    return made


PROJECT: Any = SimpleNamespace(pycolmap=pycolmap, config=SfmConfig())


def test_photos_are_left_out_of_a_copy_that_is_adjusted_with_its_lens(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[dict[str, bool]] = []
    monkeypatch.setattr(held, "bundle_adjusted", lambda project, model, **free: asked.append(free) or model)
    made = row_of_cameras(5)
    left = held._without(PROJECT, made, {4, 2})
    assert sorted(left.reg_image_ids()) == [1, 3, 5]
    assert sorted(made.reg_image_ids()) == [1, 2, 3, 4, 5]
    assert asked == [{"lens": False}]


@pytest.mark.parametrize(("lost", "moves"), [(2, True), (3, False)])
def test_each_photo_gets_the_pose_of_its_view_if_four_fifths_of_the_points_fit(
    lost: int, moves: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The views may be in another order; the largest turn of all is said."""

    def adjusted(project: object, model: Any, **free: bool) -> Any:
        assert free == {"lens": False, "poses": False}
        for number in list(model.points3D)[:lost]:
            model.delete_point3D(number)
        return model

    monkeypatch.setattr(held, "bundle_adjusted", adjusted)
    monkeypatch.setattr(held, "compare", lambda *_: SimpleNamespace(rotation_degrees=np.array([0.5, 2.25, 1.0])))
    lines: list[str] = []
    made = row_of_cameras(3)
    viewmats = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    viewmats[:, 1, 3] = torch.tensor([30.0, 10.0, 20.0], dtype=torch.float64)
    views: Any = [
        SimpleNamespace(name=f"images/{n}.png", camera=SimpleNamespace(viewmats=torch.eye(4)[None])) for n in (3, 1, 2)
    ]
    moved = held._moved(PROJECT, made, views, CoherentPoses(viewmats, 1.26, 0.34), lines.append)
    assert (moved is not None) == moves
    assert [made.image(n).cam_from_world().translation.tolist() for n in (1, 2, 3)] == [[n, 0, 0] for n in (1, 2, 3)]
    if moves:
        assert [moved.image(n).cam_from_world().translation[1] for n in (1, 2, 3)] == [10, 20, 30]
    said = "silhouettes moved poses by up to 2.2 degrees: outlines now miss by 0.3 px, 1.3 before"
    assert lines == ([said] if moves else [])


@pytest.mark.parametrize(("misses", "kept"), [(3.99, True), (4.0, False)])
def test_poses_are_refuted_by_misses_of_four_px_where_no_few_photos_are_to_blame(
    misses: float, kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The advice names the misses of the given poses."""
    found = CoherentPoses(torch.eye(4)[None], 7.4, misses)
    monkeypatch.setattr(held, "_views", lambda *_: ("view",))
    monkeypatch.setattr(held, "coherent_poses", lambda views: found)
    monkeypatch.setattr(held, "contradicting", lambda views: [])
    given: Any = SimpleNamespace(reg_image_ids=list)
    made, advice = held.held_by_silhouettes(PROJECT, given, None, None, lambda line: None)  # type: ignore[arg-type]
    assert made is (given if kept else None)
    assert len(advice) == 1
    assert "they miss each other by 7 px" in advice[0]


@pytest.mark.parametrize(("shared", "loose"), [(4, True), (5, False)])
def test_a_photo_that_shares_four_of_the_usual_seventeen_points_is_loosely_held(shared: int, loose: bool) -> None:
    tracks = [(1, 2)] * 17 + [(1, 3)] * shared
    points = {
        i: SimpleNamespace(track=SimpleNamespace(elements=[SimpleNamespace(image_id=number) for number in track]))
        for i, track in enumerate(tracks)
    }
    found = SimpleNamespace(points3D=points, reg_image_ids=lambda: [1, 2, 3])
    assert held.loosely_held(found, {3}) == loose
