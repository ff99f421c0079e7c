"""Formulas of pose search against others: similarities, alignment, background at rest, frames of a video, lenses."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from PIL import Image

from gsopt.data.lens import Lens
from gsopt.data.posed_images import PosedImage
from gsopt.data.sfm import pair_matches, placement, trajectory, video
from gsopt.data.sfm.known_poses import camera_key, lens_parameters
from gsopt.data.sfm.pair_matches import PairMatches
from gsopt.data.sfm.video import FrameMeasurement, choose
from gsopt.errors import InputError

DIRECTIONS = st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 0.1)


def turn(degrees: float, axis: int = 2) -> np.ndarray:
    """A rotation about an axis of the world."""
    a = math.radians(degrees)
    found = np.eye(3)
    i, j = (k for k in range(3) if k != axis)
    found[[i, i, j, j], [i, j, i, j]] = [math.cos(a), -math.sin(a), math.sin(a), math.cos(a)]
    return found


def viewmats(centers: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    found = np.tile(np.eye(4), (len(centers), 1, 1))
    found[:, :3, :3], found[:, :3, 3] = rotations, -np.einsum("cij,cj->ci", rotations, centers)
    return found


@given(DIRECTIONS)
@example([0.0, 1.192092896e-07, -1.0])
@example([1e-200, 0.0, -1.0])
def test_up_is_turned_to_z_by_the_smallest_rotation(direction: list[float]) -> None:
    up = np.array(direction) / np.linalg.norm(direction)
    rotation = placement.rotation_to_z(up)
    np.testing.assert_allclose(rotation @ up, [0, 0, 1], atol=1e-7)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-7)
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert (np.trace(rotation) - 1) / 2 == pytest.approx(up[2], abs=1e-7)


def test_down_is_turned_over_and_a_similarity_is_its_matrix() -> None:
    np.testing.assert_array_equal(placement.rotation_to_z(np.array([0.0, 0, -1])), np.diag([1, -1, -1]))
    found = placement.Similarity(2.0, turn(90), np.array([1.0, 2, 3]))
    np.testing.assert_allclose(found.matrix @ [1, 0, 0, 1], [1, 4, 3, 1], atol=1e-12)
    np.testing.assert_array_equal(placement.Similarity.identity().matrix, np.eye(4))


def test_the_focus_lies_on_the_axes_in_front_of_nine_tenths_of_the_cameras() -> None:
    centers = np.array([[math.cos(a), math.sin(a), 0.3] for a in np.arange(12) * math.pi / 6])
    points = np.array([[9.0, 9, 9], [9, 9, 9], [0, 0, 0]])
    forwards = -centers / np.linalg.norm(centers, axis=1, keepdims=True)
    np.testing.assert_allclose(placement.common_focus(centers, forwards, points), [0, 0, 0], atol=1e-6)
    forwards[0] *= -1
    np.testing.assert_allclose(placement.common_focus(centers, forwards, points), [0, 0, 0], atol=1e-6)
    forwards[1] *= -1
    np.testing.assert_array_equal(placement.common_focus(centers, forwards, points), [9, 9, 9])
    np.testing.assert_allclose(placement.common_focus(centers, forwards, points[:0]), centers.mean(axis=0))
    same = np.tile([[0.0, 1, 0]], (12, 1))
    np.testing.assert_array_equal(placement.common_focus(centers, same, points), [9, 9, 9])


@given(st.integers(0, 10**6), st.floats(0.1, 10))
def test_alignment_takes_back_any_similarity(seed: int, scale: float) -> None:
    random = np.random.default_rng(seed)
    source = random.normal(size=(6, 3))
    rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
    rotation[:, 0] *= np.linalg.det(rotation)
    shift = random.normal(size=3)
    found = trajectory.align(source, scale * source @ rotation.T + shift)
    assert found.scale == pytest.approx(scale)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-7)
    np.testing.assert_allclose(found.translation, shift, atol=1e-6)
    flat = source * [1, 1, 0]
    assert np.linalg.det(trajectory.align(flat, flat * [1, -1, 1]).rotation) == pytest.approx(1)


def test_errors_are_degrees_and_shares_of_the_path() -> None:
    centers = np.array([[2.0, 0, 0], [-2, 0, 0], [0, 2, 0], [0, -2, 0], [0, 0, 1], [0, 0, -1]])
    truth = viewmats(centers, np.tile(np.eye(3), (6, 1, 1)))
    found = viewmats(centers, np.stack([turn(30) if i == 0 else np.eye(3) for i in range(6)]))
    error = trajectory.compare(found, truth)
    assert error.rotation_degrees.tolist() == pytest.approx([30, 0, 0, 0, 0, 0], abs=1e-6)
    assert error.position.tolist() == pytest.approx([0] * 6, abs=1e-6)
    apart = trajectory.TrajectoryError(np.array([3.0, 4, 0]), np.array([0.0, 0.3, 0.4]))
    assert apart.summary() == {
        "rotation_degrees_median": 3.0,
        "rotation_degrees_rms": pytest.approx(math.sqrt(25 / 3), abs=1e-6),
        "rotation_degrees_max": 4.0,
        "position_median": 0.3,
        "position_rms": pytest.approx(0.5 / math.sqrt(3), abs=1e-6),
        "position_max": 0.4,
    }
    moved = centers + np.array([[0.0, 0, d] for d in (0.1, 0.1, -0.1, -0.1, 0, 0)])
    error = trajectory.compare(viewmats(moved, np.tile(np.eye(3), (6, 1, 1))), truth)
    assert error.position[:4].tolist() == pytest.approx([0.05] * 4, rel=0.02)


def test_turns_are_compared_in_the_median_pair_and_need_no_common_axes() -> None:
    """Of three cameras the third is turned otherwise by 40 degrees: in two of three pairs."""
    first = viewmats(np.zeros((3, 3)), np.stack([turn(0), turn(10), turn(30)]))
    second = viewmats(np.ones((3, 3)), np.stack([turn(0), turn(10), turn(70)]))
    assert trajectory.turns_apart(first, second) == pytest.approx(40)
    second[:, :3, :3] = second[:, :3, :3] @ turn(77, axis=0)
    assert trajectory.turns_apart(first, second) == pytest.approx(40)
    assert trajectory.turns_apart(first[:2], second[:2]) == pytest.approx(0, abs=1e-5)
    assert trajectory.turns_apart(first[1:], second[1:]) == pytest.approx(40)
    assert trajectory.turns_apart(first[:1], second[:1]) == 0


def test_equal_turns_are_no_turn_apart_whatever_rounding_says() -> None:
    """The cosine of a pair of equal turns can exceed 1 by a rounding."""
    axes = np.random.default_rng(0).normal(size=(200, 2, 3, 3))
    for pair in np.linalg.qr(axes)[0]:
        cameras = viewmats(np.zeros((2, 3)), pair)
        assert trajectory.turns_apart(cameras, cameras) == pytest.approx(0, abs=1e-5)


def path(*motions: float, sharpness: tuple[float, ...] = ()) -> list[FrameMeasurement]:
    sharp = sharpness or (1.0,) * len(motions)
    return [FrameMeasurement(i, i / 30, s, m) for i, (m, s) in enumerate(zip(motions, sharp, strict=True))]


@pytest.mark.parametrize(("most", "stretch"), [(4, 0.8004 / 4), (10, 0.08004), (30, 0.02668), (99, 0.02)])
def test_a_frame_is_kept_for_every_stretch_of_the_way(most: int, stretch: float) -> None:
    """A way of 0.8004 in as many stretches as frames may be kept, each a fiftieth of the longer side at least."""
    way = path(*np.linspace(0, 0.8004, 2002))
    kept = choose(way, most)
    assert [int(way[i].motion / stretch) for i in kept] == list(range(min(most, 41)))
    assert choose(path(0.0, 0.0, 0.0), 5) == [0]


def test_the_sharpest_frame_of_the_middle_of_a_stretch_is_taken() -> None:
    """The middle six tenths of a stretch of 0.1: from 0.02 to 0.08."""
    frames = path(0.0, 0.021, 0.05, 0.079, 0.081, sharpness=(9.0, 2.0, 1.0, 3.0, 8.0))
    assert video._sharpest(frames, 0.1).index == 3
    later = [replace(frame, motion=frame.motion + 0.7001) for frame in frames]
    assert video._sharpest(later, 0.1).index == 3
    assert video._sharpest([frames[0], frames[4]], 0.1).index == 0


@pytest.mark.parametrize(("dy", "dx"), [(0, 3), (5, 0), (-4, 3), (0, -7)])
def test_motion_is_the_length_of_the_shift_over_the_longer_side(dy: int, dx: int) -> None:
    noise = np.random.default_rng(0).uniform(0, 255, (160, 280)).astype(np.float32)
    before, after = noise[20:140, 20:260], noise[20 + dy : 140 + dy, 20 + dx : 260 + dx]
    assert video.motion_between(before, after) == pytest.approx(math.hypot(dy, dx) / 240, rel=0.02)
    other = np.random.default_rng(1).uniform(0, 255, (120, 240)).astype(np.float32)
    assert video.motion_between(before, other) == video.MAX_MOTION
    assert video.motion_between(before, before.copy()) == 0


def test_trembling_is_no_way_and_a_new_size_a_new_anchor() -> None:
    noise = np.random.default_rng(0).uniform(0, 255, (300, 300)).astype(np.uint8)

    def frame(shift: int, side: int = 256) -> Image.Image:
        return Image.fromarray(np.ascontiguousarray(noise[:side, shift : shift + side]))

    shown = [frame(s) for s in (0, 2, 0, 2, 3, 6)] + [frame(6, 128)]
    measured = video.measure(iter([(i, i / 2, image) for i, image in enumerate(shown)]))
    assert [m.motion * 256 for m in measured] == pytest.approx([0, 0, 0, 0, 3, 6, 6], abs=0.05)
    assert [m.seconds for m in measured] == [i / 2 for i in range(7)]


def matched(rows: dict[tuple[int, int], int], seed: int = 0) -> PairMatches:
    random = np.random.default_rng(seed)
    keypoints = {number: random.uniform(0, 100, (200, 2)) for number in (1, 2, 3)}
    matches = {pair: np.stack([np.arange(count)] * 2, axis=1).astype(np.uint32) for pair, count in rows.items()}
    return PairMatches({1: "a", 2: "b", 3: "c"}, dict.fromkeys((1, 2, 3), (100, 100)), keypoints, matches)


def test_a_mask_keeps_matches_whose_two_ends_are_lighter_than_half(tmp_path: Path) -> None:
    pairs = matched({(1, 2): 4, (2, 3): 3})
    pairs.keypoints[1][:4] = [[0.5, 0.5], [99.9, 99.9], [50, 10], [120, -5]]
    levels = np.full((100, 100), 128, np.uint8)
    levels[0, 0], levels[10, 50] = 127, 255
    Image.fromarray(levels).save(tmp_path / "a.png")
    found = pair_matches.inside(pairs, tmp_path)
    assert found.matches[1, 2][:, 0].tolist() == [1, 2, 3]
    assert found.matches[2, 3][:, 0].tolist() == [0, 1, 2]
    assert found.points((1, 2))[0].tolist() == pairs.keypoints[1][[1, 2, 3]].tolist()


def test_a_match_is_shown_by_the_pixel_that_it_lies_in(tmp_path: Path) -> None:
    levels = np.random.default_rng(3).integers(0, 2, (5, 7)).astype(np.uint8) * 255
    Image.fromarray(levels).save(tmp_path / "a.png")
    rows, columns = np.indices(levels.shape).reshape(2, -1)
    pairs = matched({(1, 2): levels.size})
    pairs.keypoints[1][: levels.size] = np.column_stack([columns, rows]) + 0.5
    kept = pair_matches.inside(pairs, tmp_path).matches[1, 2][:, 0]
    assert kept.tolist() == np.flatnonzero(levels).tolist()


def test_the_background_of_all_photos_is_shifted_as_most_pairs_say() -> None:
    """Three photos whose backgrounds lie at 0, 4 and 10 px; one pair that disagrees by 30 px pulls little."""
    pairs = matched({(1, 2): 20, (1, 3): 20, (2, 3): 20})
    for number, shift in ((2, 4.0), (3, 10.0)):
        pairs.keypoints[number] = pairs.keypoints[1] + [shift, -shift]
    everything = {pair: np.ones(20, bool) for pair in pairs.matches}
    found = pair_matches._shifts(pairs, everything)
    assert [found[n][0] - found[1][0] for n in (1, 2, 3)] == pytest.approx([0, 4, 10], abs=1e-6)
    assert [found[n][1] - found[1][1] for n in (1, 2, 3)] == pytest.approx([0, -4, -10], abs=1e-6)
    assert sum(shift[0] for shift in found.values()) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("off", "own", "taken"), [(0.011, True, True), (0.013, True, False), (0.019, False, True), (0.021, False, False)]
)
def test_what_moves_as_the_background_does_is_background(off: float, own: bool, taken: bool) -> None:
    """Within 1.2 % of the diagonal beside a background of the pair's own, within 2 % without one."""
    pairs = matched({(1, 2): 20})
    diagonal = math.hypot(100, 100)
    pairs.keypoints[2] = pairs.keypoints[1].copy()
    pairs.keypoints[2][0, 0] += off * diagonal
    still = np.zeros(20, bool)
    still[10:] = own
    shifts = {1: np.zeros(2), 2: np.zeros(2)}
    found = pair_matches._background(pairs, (1, 2), still, shifts)
    assert found[0] == taken
    assert found[1:].all()


@pytest.mark.parametrize(("apart", "own"), [(0.024, True), (0.026, False)])
def test_a_background_of_its_own_must_move_as_all_pairs_say(apart: float, own: bool) -> None:
    pairs = matched({(1, 2): 20})
    pairs.keypoints[2] = pairs.keypoints[1].copy()
    still = np.zeros(20, bool)
    still[10:] = True
    shifts = {1: np.zeros(2), 2: np.array([apart * math.hypot(100, 100), 0])}
    found = pair_matches._background(pairs, (1, 2), still, shifts)
    assert found.tolist() == [False] * 10 + [own] * 10


def posed(**lens: Any) -> PosedImage:
    K = torch.tensor([[50.0, 0, 20], [0, 60, 15], [0, 0, 1]], dtype=torch.float64)
    return PosedImage("a.png", Path("a.png"), None, torch.eye(4, dtype=torch.float64), K, 40, 30, Lens(**lens), 0)


def test_a_lens_becomes_the_model_that_has_its_terms() -> None:
    pinhole = [50.0, 60.0, 20.0, 15.0]
    assert lens_parameters(posed()) == ("PINHOLE", pinhole)
    assert lens_parameters(posed(radial=(0.1, 0.2), tangential=(0.3, 0.4))) == (
        "FULL_OPENCV",
        [*pinhole, 0.1, 0.2, 0.3, 0.4, 0.0, 0.0, 0.0, 0.0],
    )
    assert lens_parameters(posed(radial=(0.1, 0.2, 0.5)))[1] == [*pinhole, 0.1, 0.2, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0]
    assert lens_parameters(posed(radial=(0.1, 0.2, 0.3, 0.4), fisheye=True)) == (
        "OPENCV_FISHEYE",
        [*pinhole, 0.1, 0.2, 0.3, 0.4],
    )
    for kept_by_none in ({"radial": (0.1, 0, 0, 0.1)}, {"radial": (0.1,), "tangential": (0.1, 0.0), "fisheye": True}):
        with pytest.raises(InputError, match="terms that cannot be kept"):
            lens_parameters(posed(**kept_by_none))
    assert camera_key(posed()) == "PINHOLE 40x30 [50.0, 60.0, 20.0, 15.0]"
