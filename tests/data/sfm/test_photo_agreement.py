"""Poses that all matches fit are refuted by what did not match."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

pytest.importorskip("pycolmap", reason="the extra sfm is not installed")

import pycolmap
import textured_room as room

from gsopt.data.sfm import photo_agreement
from gsopt.data.sfm.photo_agreement import Agreement, agreement, correlations

NAMES = [f"room_{number:02d}.jpg" for number in range(4)]


def reconstruction(spread: float, seen_by: list[set[int]], count: int = 400) -> Any:
    """Four exact cameras around the box, and points of the floor and the walls, each seen by one of these sets."""
    found = pycolmap.Reconstruction()
    found.add_camera_with_trivial_rig(
        pycolmap.Camera(
            model="PINHOLE",
            width=room.WIDTH,
            height=room.HEIGHT,
            params=[room.FOCAL, room.FOCAL, room.WIDTH / 2, room.HEIGHT / 2],
            camera_id=1,
        )
    )
    generator = np.random.default_rng(0)
    u, v = generator.uniform(0.05, 0.95, (2, count, 1))
    planes = np.array([np.array(room.PLANES[row % 3], dtype=float) for row in range(count)])
    points = planes[:, 0] + u * (planes[:, 1] - planes[:, 0]) + v * (planes[:, 3] - planes[:, 0])
    for number, viewmat in enumerate(room.arc(4, spread=spread).numpy()):
        local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        pixels = room.FOCAL * local[:, :2] / local[:, 2:] + np.array([room.WIDTH, room.HEIGHT]) / 2
        image = pycolmap.Image(name=NAMES[number], keypoints=pixels, camera_id=1, image_id=number + 1)
        found.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.ascontiguousarray(viewmat[:3])))
    for row, point in enumerate(points):
        track = pycolmap.Track()
        for number in sorted(seen_by[row % len(seen_by)]):
            track.add_element(number + 1, row)
        found.add_point3D(point, track)
    return found


def photos(folder: Path, spread: float, other: int | None = None) -> Path:
    """The four photos, of which one may show another room."""
    room.photograph(folder, room.arc(4, spread=spread))
    if other is not None:
        room.photograph(folder, room.arc(4, spread=spread)[other : other + 1], seed=7, first=other)
    return folder


def test_photos_with_right_poses_agree_where_nothing_was_matched(tmp_path: Path) -> None:
    found = reconstruction(30, [{0, 1}, {2, 3}])
    medians = {pair[:2]: pair[2] for pair in correlations(found, photos(tmp_path, 30))}
    assert {(NAMES[1], NAMES[2]), (NAMES[2], NAMES[1])} <= medians.keys()
    assert (NAMES[0], NAMES[1]) not in medians
    assert min(medians.values()) > 0.6
    assert agreement(found, tmp_path) == Agreement(len(medians), 0)


def test_a_photo_of_another_place_contradicts_those_beside_it(tmp_path: Path) -> None:
    """Its own matches with photo 0 say nothing: they are what is wrong."""
    found = reconstruction(30, [{0, 3}, {1, 2}])
    medians = {pair[:2]: pair[2] for pair in correlations(found, photos(tmp_path, 30, other=3))}
    of_other = {pair: median for pair, median in medians.items() if NAMES[3] in pair}
    assert of_other
    assert max(of_other.values()) < 0.25 < 0.6 < min(medians[pair] for pair in medians.keys() - of_other.keys())
    seen = agreement(found, tmp_path)
    assert (seen.compared, seen.contradicted) == (len(medians), len(of_other))
    assert seen.contradicts


@pytest.mark.parametrize(("limit", "value"), [("SIDE_BY_SIDE", 3.0), ("MAX_ZOOM", 1.0), ("LEAST_CONTRAST", 200.0)])
def test_only_what_two_photos_show_alike_is_compared(
    limit: str, value: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the same side, at the same distance, and where there is something to see."""
    monkeypatch.setattr(photo_agreement, limit, value)
    assert agreement(reconstruction(30, [{0, 3}, {1, 2}]), photos(tmp_path, 30, other=3)) == Agreement(0, 0)


def test_what_every_photo_has_matched_is_not_looked_at(tmp_path: Path) -> None:
    assert agreement(reconstruction(30, [{0, 1, 2, 3}]), photos(tmp_path, 30, other=3)) == Agreement(0, 0)


def test_what_lies_behind_other_things_is_not_compared() -> None:
    """Points of the back wall, of which some lie behind the three nearest points that the photo sees."""
    camera = pycolmap.Camera(model="PINHOLE", width=400, height=300, params=[380.0, 380.0, 200.0, 150.0], camera_id=1)
    photo = photo_agreement._Photo(torch.zeros(1, 300, 400), camera, 1.0, np.eye(4)[:3], np.ones(0, bool))
    thing = np.array([[0.0, 0.0, 2.0], [0.05, 0.0, 2.0], [0.0, 0.05, 2.0], [-0.02, 0.0, 5.0]])
    behind, beside = [0.1, 0.0, 4.0], [1.0, 0.0, 4.0]
    nearly_as_far, before = [0.05, 0.05, 2.2], [0.0, 0.0, 1.0]
    hidden = photo_agreement._hidden(photo, np.array([behind, beside, nearly_as_far, before]), thing)
    assert hidden.tolist() == [True, False, False, False]
    assert photo_agreement._hidden(photo, np.array([behind]), thing[:2]).tolist() == [False]
    assert photo_agreement._hidden(photo, np.zeros((0, 3)), thing).tolist() == []


def test_few_patches_say_nothing(tmp_path: Path) -> None:
    assert agreement(reconstruction(30, [{0, 3}, {1, 2}], count=50), photos(tmp_path, 30, other=3)).compared == 0
    assert agreement(reconstruction(30, [{0, 3}], count=5), tmp_path) == Agreement(0, 0)


def test_large_photos_are_compared_reduced(tmp_path: Path) -> None:
    """The same medians, roughly, of photos four times as large."""
    found = reconstruction(30, [{0, 1}, {2, 3}])
    small = {pair[:2]: pair[2] for pair in correlations(found, photos(tmp_path, 30))}
    for number in found.cameras:
        found.cameras[number].rescale(4.0)
    for name in NAMES:
        with Image.open(tmp_path / name) as image:
            enlarged = image.resize((4 * room.WIDTH, 4 * room.HEIGHT), Image.Resampling.BICUBIC)
        enlarged.save(tmp_path / name, quality=95)
    large = {pair[:2]: pair[2] for pair in correlations(found, tmp_path)}
    assert large.keys() == small.keys()
    assert all(abs(large[pair] - small[pair]) < 0.1 for pair in small)


@pytest.mark.parametrize(
    ("compared", "contradicted", "wrong"),
    [(1, 1, False), (2, 2, True), (6, 1, False), (12, 2, True), (13, 2, False), (24, 4, True), (25, 4, False)],
)
def test_a_sixth_of_the_pairs_and_at_least_two_refute_poses(compared: int, contradicted: int, wrong: bool) -> None:
    assert Agreement(compared, contradicted).contradicts == wrong
