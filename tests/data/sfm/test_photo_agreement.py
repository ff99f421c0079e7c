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


def photo(
    pixels: np.ndarray, center: tuple[float, float, float] = (0, 0, -4), sees: int = 1, scale: float = 1.0
) -> Any:
    """A photo with a focal length of 128 px that looks along z: all its positions are exact."""
    height, width = pixels.shape
    lens = [128.0, 128.0, width / scale / 2, height / scale / 2]
    camera = pycolmap.Camera(
        model="PINHOLE", width=int(width / scale), height=int(height / scale), params=lens, camera_id=1
    )
    pose = np.column_stack([np.eye(3), -np.array(center, dtype=float)])
    gray = torch.from_numpy(pixels.astype(np.float32))[None]
    return photo_agreement._Photo(gray, camera, scale, pose, np.ones(sees, bool))


def test_a_point_is_shown_where_a_patch_around_it_is_inside_the_picture() -> None:
    """Eight px from each edge, at any depth before the camera."""
    shown = photo(np.zeros((300, 400)), center=(0, 0, 0))
    pixels = np.array([[8, 150], [7.5, 150], [392, 150], [392.5, 150], [200, 8], [200, 7.5], [200, 292], [200, 292.5]])
    for depth in (0.5, 4.0):
        points = np.column_stack([(pixels - [200, 150]) / 128, np.ones(8)]) * depth
        found, inside = shown.project(points)
        assert found.tolist() == pixels.tolist()
        assert inside.tolist() == [True, False] * 4
    assert not shown.project(np.array([[0.0, 0, -1], [0, 0, 0]]))[1].any()


@pytest.mark.parametrize(
    ("degrees", "ratio", "alike"), [(24.8, 1, True), (25.2, 1, False), (0, 1.59, True), (0, 1.61, False)]
)
def test_two_photos_show_a_point_alike_from_one_side_and_one_distance(
    degrees: float, ratio: float, alike: bool
) -> None:
    """Up to 25 degrees apart, and up to 1.6 times as far."""
    x, z = 4 * ratio * np.sin(np.radians(degrees)), 4 * ratio * np.cos(np.radians(degrees))
    one, other = (photo(np.zeros((600, 800)), center) for center in ((0, 0, -4), (float(x), 0, -float(z))))
    point = np.zeros((1, 3))
    assert photo_agreement._shown_alike(one, other, point).tolist() == [alike]
    assert photo_agreement._shown_alike(other, one, point).tolist() == [alike]


@pytest.mark.parametrize(
    ("third", "depth", "hidden"), [(79.5, 3.5, True), (80.0, 3.5, False), (20.0, 3.59, True), (20.0, 3.6, False)]
)
def test_three_points_within_80_px_and_before_nine_tenths_of_its_depth_hide_a_point(
    third: float, depth: float, hidden: bool
) -> None:
    """However many others lie farther away."""
    shown = photo(np.zeros((300, 400)), center=(0, 0, 0))
    near = np.array([[0, 0, 1.0], [10 / 128, 0, 1], [0, third / 128, 1]]) * depth
    far = np.array([[1, 1, 1.0], [-1, 1, 1], [-1, -1, 1]]) * 9
    for seen in (near, np.concatenate([far, near])):
        assert photo_agreement._hidden(shown, np.array([[0, 0, 4.0]]), seen).tolist() == [hidden]


def slope(along: int, steepness: float) -> np.ndarray:
    """Gray values that rise along an axis of the picture by so much per px."""
    return 100 + steepness * np.indices((300, 400))[1 - along]


@pytest.mark.parametrize("along", [0, 1])
def test_a_patch_has_eleven_samples_within_eight_px_and_a_deviation_of_three_gray_levels(along: int) -> None:
    """Of n samples from -1 to 1 the variance is (n + 1) / (3 (n - 1))."""
    least = 3 / (8 * np.sqrt(12 / 30))
    point, normal = np.zeros((1, 3)), np.array([[0, 0, 1.0]])
    rich = photo(slope(along, 5.0))
    for steepness, shown in ((1.003 * least, True), (0.997 * least, False)):
        poor = photo(slope(along, steepness))
        found = photo_agreement._of_patches(poor, rich, point, normal)
        assert np.isfinite(found).tolist() == [shown]
        assert not shown or found == pytest.approx([1], abs=1e-5)
        assert photo_agreement._of_patches(rich, poor, point, normal) == pytest.approx([1], abs=1e-4)
    falling, black = photo(slope(along, -1.0)), photo(np.zeros((300, 400)))
    assert photo_agreement._of_patches(rich, falling, point, normal) == pytest.approx([-1], abs=1e-5)
    assert photo_agreement._of_patches(rich, black, point, normal).tolist() == [0]


def test_a_patch_keeps_its_width_where_its_plane_is_tilted_or_the_photo_is_reduced() -> None:
    """By 60 degrees, about the axis from left to right."""
    tilted = np.array([[0, np.sin(np.radians(60)), np.cos(np.radians(60))]])
    rising = photo(slope(0, 1.0))
    assert photo_agreement._of_patches(rising, rising, np.zeros((1, 3)), tilted) == pytest.approx([1], abs=1e-5)
    reduced = photo(slope(0, 0.6), scale=0.5)  # shown above 0.593 per px, whatever the size of the original
    found = photo_agreement._of_patches(reduced, reduced, np.zeros((1, 3)), np.array([[0, 0, 1.0]]))
    assert found == pytest.approx([1], abs=1e-4)
    reduced = photo(slope(0, 0.585), scale=0.5)
    assert np.isnan(photo_agreement._of_patches(reduced, reduced, np.zeros((1, 3)), np.array([[0, 0, 1.0]]))).all()


def test_a_point_and_its_eleven_neighbors_span_the_plane_of_its_patch() -> None:
    generator = np.random.default_rng(0)
    plane = np.column_stack([generator.uniform(-1, 1, (12, 2)), np.zeros(12)])
    others = generator.uniform(-1, 1, (20, 3)) + np.array([0, 5, 9])
    normals = photo_agreement._normals(np.concatenate([plane, others]))
    assert np.abs(normals[:12]) == pytest.approx(np.tile([0, 0, 1.0], (12, 1)), abs=1e-9)


def two_photos(folder: Path, count: int, plain: int) -> Any:
    """Two equal photos from one place; features of the first one see the points, `plain` of which show nothing."""
    generator = np.random.default_rng(1)
    pixels = generator.integers(0, 256, (300, 400), dtype=np.uint8)
    pixels[:, 200:] = 128
    found = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=400, height=300, params=[128.0, 128.0, 200.0, 150.0], camera_id=1)
    found.add_camera_with_trivial_rig(camera)
    keypoints = np.column_stack([generator.uniform(20, 180, count), generator.uniform(20, 280, count)])
    keypoints[:plain, 0] += 200
    for number, name in enumerate(("a.png", "b.png"), 1):
        Image.fromarray(pixels).save(folder / name)
        image = pycolmap.Image(name=name, keypoints=keypoints, camera_id=1, image_id=number)
        found.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for row, (x, y) in enumerate(keypoints):
        track = pycolmap.Track()
        track.add_element(1, row)
        found.add_point3D(np.array([(x - 200) / 32, (y - 150) / 32, 4.0]), track)
    return found


@pytest.mark.parametrize(("count", "plain", "compared"), [(30, 0, True), (29, 0, False), (31, 1, True), (31, 2, False)])
def test_thirty_patches_that_show_something_compare_two_photos(
    count: int, plain: int, compared: bool, tmp_path: Path
) -> None:
    found = list(correlations(two_photos(tmp_path, count, plain), tmp_path))
    assert found == ([("a.png", "b.png", pytest.approx(1, abs=1e-4))] if compared else [])


def test_of_too_many_points_every_second_one_is_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = two_photos(tmp_path, 59, 0)
    for most, compared in ((59, True), (58, True), (29, False)):
        monkeypatch.setattr(photo_agreement, "MAX_POINTS", most)
        assert bool(list(correlations(found, tmp_path))) == compared
    monkeypatch.setattr(photo_agreement, "MAX_POINTS", 57)
    found.delete_point3D(1)
    assert not list(correlations(found, tmp_path))


def test_two_photos_contradict_each_other_below_a_correlation_of_a_quarter(monkeypatch: pytest.MonkeyPatch) -> None:
    medians = [("a", "b", 0.25), ("b", "a", 0.2499), ("a", "c", -1.0), ("c", "a", 0.9)]
    monkeypatch.setattr(photo_agreement, "correlations", lambda *_: iter(medians))
    assert agreement(None, Path()) == Agreement(4, 2)


@pytest.mark.parametrize(
    ("size", "compared"), [((1600, 1200), (600, 800)), ((600, 900), (800, 533)), ((800, 90), (90, 800))]
)
def test_photos_are_compared_at_800_px_at_most(
    size: tuple[int, int], compared: tuple[int, int], tmp_path: Path
) -> None:
    Image.new("RGB", size, (90, 90, 90)).save(tmp_path / "a.png")
    gray = photo_agreement._gray(tmp_path / "a.png")
    assert tuple(gray.shape) == (1, *compared)
    assert gray.unique().tolist() == [90]


def test_a_large_jpeg_is_decoded_at_a_size_near_that_of_the_comparison(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The decoder halves a photo as long as both of its sides keep 800 px."""
    Image.new("RGB", (4000, 3000), (9, 99, 199)).save(tmp_path / "a.jpg")
    converted, decoded = Image.Image.convert, list[tuple[int, int]]()

    def watched(image: Image.Image, mode: str) -> Image.Image:
        decoded.append(image.size)
        return converted(image, mode)

    monkeypatch.setattr(Image.Image, "convert", watched)
    gray = photo_agreement._gray(tmp_path / "a.jpg")
    assert decoded == [(2000, 1500)]
    assert gray.shape == (1, 600, 800)
