"""Laws of an object that turns about one axis before a camera that stands still."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from balls import FIELD_OF_VIEW, Ball, picture
from PIL import Image

from gsopt.data.sfm import pose_search, turntable_poses
from gsopt.data.sfm.diagnosis import TURNTABLE
from gsopt.data.sfm.few_photos import Hypotheses
from gsopt.data.sfm.mapping import MappingResult, poses
from gsopt.data.sfm.pair_matches import PairMatches
from gsopt.data.sfm.pose_search import FoundPoses, PoseSearch, SecondLook
from gsopt.data.sfm.settings import SfmConfig
from gsopt.data.sfm.stage_times import StageTimes
from gsopt.data.sfm.trajectory import compare
from gsopt.data.sfm.turntable import Link, Turntable, axes_of_pairs, chained, from_middles, links
from gsopt.data.sfm.turntable_fit import Turned, fitted_angles
from gsopt.data.sfm.turntable_points import tracks
from gsopt.data.sfm.turntable_poses import find_turned, mask_outlines
from gsopt.geometry.cameras import Cameras, intrinsics, look_at

pycolmap = pytest.importorskip("pycolmap")

THING = [
    Ball((0.0, 0.0, 0.0), 0.5),
    Ball((0.5, 0.2, 0.3), 0.3),
    Ball((-0.4, 0.3, -0.35), 0.25),
    Ball((0.1, -0.55, 0.2), 0.2),
]
SIZE, COUNT, POINTS = 256, 8, 60
FOCAL = SIZE / (2 * math.tan(FIELD_OF_VIEW / 2))
ANGLES = np.radians([0, 41, 83, 130, 174, 222, 268, 315])
RING = [(n, n % COUNT + 1) for n in range(1, COUNT + 1)]
TABLE = Turntable(np.array([0.0, math.cos(0.5), math.sin(0.5)]), np.array([0.0, -math.sin(0.5), math.cos(0.5)]), FOCAL)


def turning_cameras() -> Cameras:
    """Poses of a camera that looks down by half a radian at a thing that turns."""
    around = torch.from_numpy(ANGLES)
    eyes = 4 * torch.stack(
        [around.cos() * math.cos(0.5), around.sin() * math.cos(0.5), torch.full((COUNT,), math.sin(0.5))], 1
    )
    up = torch.tensor([0.0, 0, 1], dtype=torch.float64)
    viewmats = look_at(eyes, torch.zeros(3, dtype=torch.float64), up)
    return Cameras(viewmats, intrinsics(FIELD_OF_VIEW, SIZE, SIZE).expand(COUNT, 3, 3), SIZE, SIZE)


def two_view_matches(cameras: Cameras, linked: list[tuple[int, int]], shifts: Any = None) -> PairMatches:
    """No point is seen by three photos. Each linked pair has points in common and a third of its matches is wrong, and
    what is not linked has only wrong ones."""
    drawn = np.random.default_rng(3)
    keypoints: dict[int, list[np.ndarray]] = {n: [] for n in range(1, COUNT + 1)}
    matches: dict[tuple[int, int], np.ndarray] = {}
    for pair in sorted(tuple(sorted(pair)) for pair in RING):
        points = drawn.uniform(-0.5, 0.5, (POINTS if pair in linked else 0, 3))
        rows = []
        for n in pair:
            seen = points @ cameras.viewmats[n - 1, :3, :3].numpy().T + cameras.viewmats[n - 1, :3, 3].numpy()
            pixels = FOCAL * seen[:, :2] / seen[:, 2:] + SIZE / 2 + drawn.normal(0, 0.2, (len(seen), 2))
            wrong = drawn.uniform(0.2 * SIZE, 0.8 * SIZE, (POINTS // 2, 2))
            first = sum(len(found) for found in keypoints[n])
            keypoints[n].append(np.concatenate([pixels, wrong]) + (0 if shifts is None else shifts[n]))
            rows.append(np.arange(first, first + len(pixels) + len(wrong), dtype=np.uint32))
        matches[pair] = np.stack(rows, axis=1)
    names = {n: f"{n}.png" for n in keypoints}
    return PairMatches(
        names,
        dict.fromkeys(names, (SIZE, SIZE)),
        {n: np.concatenate(k) for n, k in keypoints.items()},
        matches,
        shifts or {},
    )


def write_masks(folder: Path, cameras: Cameras, things: list[list[Ball]], shifts: Any = None) -> Path:
    folder.mkdir()
    for n, thing in enumerate(things, start=1):
        alpha = picture(cameras[n - 1], thing)[..., 3]
        alpha = alpha if shifts is None else np.roll(alpha, shifts[n][::-1].astype(int), axis=(0, 1))
        Image.fromarray(alpha).save(folder / f"{n}.png.png")
    return folder


def lens(focal: float | None) -> Any:
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal or 1.2 * SIZE, SIZE, SIZE)
    camera.has_prior_focal_length = focal is not None
    return camera


def found(pairs: PairMatches, masks: Path, focal: float | None) -> MappingResult | None:
    photos = masks.parent / "photos"
    photos.mkdir(exist_ok=True)
    for name in pairs.names.values():
        Image.new("RGB", (SIZE, SIZE), (10, 20, 30)).save(photos / name)
    project: Any = SimpleNamespace(pycolmap=pycolmap, config=SfmConfig(seed=1), photos=photos)
    return find_turned(project, lens(focal), pairs, mask_outlines(masks, pairs), lambda line: None)


CHAINED = [(1, 2), (2, 3), (3, 4), (5, 6), (6, 7), (7, 8)]
"""Two chains of four photos: what joins them is the outlines."""


@pytest.fixture(scope="module")
def cameras() -> Cameras:
    return turning_cameras()


@pytest.fixture(scope="module")
def masks(cameras: Cameras, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_masks(tmp_path_factory.mktemp("masks") / "masks", cameras, [THING] * COUNT)


@pytest.fixture(scope="module")
def with_known_lens(cameras: Cameras, masks: Path) -> MappingResult | None:
    return found(two_view_matches(cameras, CHAINED), masks, FOCAL)


@pytest.mark.parametrize("focal", [FOCAL, None])
def test_chains_without_a_point_in_common_are_joined_by_outlines(
    cameras: Cameras, masks: Path, focal: float | None, with_known_lens: MappingResult | None
) -> None:
    result = with_known_lens if focal else found(two_view_matches(cameras, CHAINED), masks, None)
    assert result is not None
    names, viewmats = poses(result.reconstruction)
    assert names == [f"{n}.png" for n in range(1, COUNT + 1)]
    off = compare(viewmats, cameras.viewmats.numpy())
    assert off.rotation_degrees.max() < (0.5 if focal else 1.5)
    assert off.position.max() < 0.03
    lenses = [camera.mean_focal_length() for camera in result.reconstruction.cameras.values()]
    assert lenses == pytest.approx([FOCAL] * COUNT, rel=1e-9 if focal else 0.04)
    assert result.reconstruction.num_points3D() > 0.8 * POINTS * len(CHAINED)
    assert result.reconstruction.compute_mean_reprojection_error() < 0.4
    colors = {tuple(point.color.tolist()) for point in result.reconstruction.points3D.values()}
    assert colors == {(10, 20, 30)}


def test_photos_cut_out_of_larger_ones_have_their_own_middles(cameras: Cameras, tmp_path: Path) -> None:
    shifts = {n: np.array([(-1) ** n * 3.0 * n, 4.0 - n]) for n in range(1, COUNT + 1)}
    shifts = {n: shift - np.mean(list(shifts.values()), axis=0).round() for n, shift in shifts.items()}
    masks = write_masks(tmp_path / "masks", cameras, [THING] * COUNT, shifts)
    result = found(two_view_matches(cameras, CHAINED, shifts), masks, FOCAL)
    assert result is not None
    off = compare(poses(result.reconstruction)[1], cameras.viewmats.numpy())
    assert off.rotation_degrees.max() < 0.5
    for n, shift in shifts.items():
        camera = result.reconstruction.cameras[n]
        middle = [camera.principal_point_x - SIZE / 2, camera.principal_point_y - SIZE / 2]
        assert middle == pytest.approx(shift.tolist(), abs=1.5)


def test_a_thing_round_about_its_axis_is_refused(cameras: Cameras, tmp_path: Path) -> None:
    """Its outlines fit at every turn: nothing contradicts features that match another side."""
    masks = write_masks(tmp_path / "masks", cameras, [[Ball((0, 0, 0), 0.5), Ball((0, 0, 0.4), 0.3)]] * COUNT)
    assert found(two_view_matches(cameras, RING[:-1]), masks, FOCAL) is None


def test_a_chain_on_one_side_does_not_tell_the_focal_length(cameras: Cameras, tmp_path: Path) -> None:
    """Four photos over 130 degrees: found with the lens that EXIF names, refused without."""
    masks = write_masks(tmp_path / "masks", cameras, [THING] * 4)
    pairs = two_view_matches(cameras, CHAINED[:3])
    some = PairMatches(
        {n: pairs.names[n] for n in range(1, 5)},
        pairs.sizes,
        pairs.keypoints,
        {pair: rows for pair, rows in pairs.matches.items() if max(pair) < 5},
    )
    known = found(some, masks, FOCAL)
    assert known is not None
    assert len(known.names) == 4
    assert found(some, masks, None) is None


def test_outlines_of_other_things_refuse_the_poses(cameras: Cameras, tmp_path: Path) -> None:
    other = [Ball((0.5, 0.5, 0.4), 0.7)]
    masks = write_masks(tmp_path / "masks", cameras, [THING, other] * (COUNT // 2))
    assert found(two_view_matches(cameras, RING[:-1]), masks, FOCAL) is None


def test_every_photo_needs_an_outline(cameras: Cameras, masks: Path, tmp_path: Path) -> None:
    masks = shutil.copytree(masks, tmp_path / "masks")
    pairs = two_view_matches(cameras, CHAINED)
    Image.fromarray(np.zeros((SIZE, SIZE), np.uint8)).save(masks / "3.png.png")
    assert sorted(mask_outlines(masks, pairs)) == [1, 2, 4, 5, 6, 7, 8]
    assert found(pairs, masks, FOCAL) is None
    (masks / "3.png.png").unlink()
    assert found(pairs, masks, FOCAL) is None


def test_photos_that_share_nothing_are_refused(cameras: Cameras, masks: Path) -> None:
    assert found(two_view_matches(cameras, []), masks, FOCAL) is None


def test_any_number_of_threads_gives_the_same_bits(
    cameras: Cameras, masks: Path, with_known_lens: MappingResult | None
) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(1 if before > 1 else 2)
    again = found(two_view_matches(cameras, CHAINED), masks, FOCAL)
    torch.set_num_threads(before)
    assert again is not None
    assert with_known_lens is not None
    assert np.array_equal(poses(again.reconstruction)[1], poses(with_known_lens.reconstruction)[1])


def test_matches_of_a_turn_lie_on_its_epipolar_lines_and_in_front(cameras: Cameras) -> None:
    ends = from_middles(two_view_matches(cameras, RING), dict.fromkeys(range(1, COUNT + 1), np.full(2, SIZE / 2)))[1, 2]
    right, wrong = slice(0, POINTS), slice(POINTS, None)
    turn = ANGLES[1:2] - ANGLES[0]
    sign = min((1, -1), key=lambda sign: float(np.abs(TABLE.errors(ends, sign * turn)[0, right]).sum()))
    assert np.abs(TABLE.errors(ends, sign * turn)[0, right]).max() < 1
    assert TABLE.support(ends, sign * turn)[0, right].min() > 0.8
    assert (TABLE.support(ends, sign * turn)[0, wrong] > 0).mean() < 0.2
    behind = (-ends[0], -ends[1])
    assert np.abs(TABLE.errors(behind, sign * turn + np.pi)[0]).max() > 3
    many = TABLE.support(ends, np.array([0.3, 0.7, -2.0]))
    for row, angle in zip(many, (0.3, 0.7, -2.0), strict=True):
        assert np.array_equal(row, TABLE.support(ends, np.array([angle]))[0])


def test_the_axis_of_a_pair_is_that_of_the_turntable(cameras: Cameras) -> None:
    points = from_middles(two_view_matches(cameras, RING), dict.fromkeys(range(1, COUNT + 1), np.full(2, SIZE / 2)))
    tables = axes_of_pairs(pycolmap, points, FOCAL, seed=0)
    assert len(tables) == 2
    for table in tables:
        assert abs(table.axis @ TABLE.axis) > math.cos(math.radians(4))
        assert table.foot @ TABLE.foot > math.cos(math.radians(4))
        assert np.linalg.norm(table.foot) == pytest.approx(1)


def test_links_stand_out_and_angles_are_fitted(cameras: Cameras) -> None:
    points = from_middles(two_view_matches(cameras, CHAINED), dict.fromkeys(range(1, COUNT + 1), np.full(2, SIZE / 2)))
    linked = links(TABLE, points)
    assert sorted(linked) == CHAINED
    groups, used = chained(linked, range(1, COUNT + 1))
    assert [sorted(group) for group in groups] == [[1, 2, 3, 4], [5, 6, 7, 8]]
    assert sorted(used) == CHAINED
    angles = np.radians([{**groups[0], **groups[1]}[n] for n in range(1, COUNT + 1)])
    rough = Turned(TABLE, tuple(range(1, COUNT + 1)), angles, np.zeros((COUNT, 2)))
    exact = fitted_angles(rough, rough.fitting({pair: points[pair] for pair in used}, 3.0))
    for rows in (slice(0, 4), slice(4, 8)):
        found, truth = (np.abs(np.degrees(turns[rows] - turns[rows][0])) for turns in (exact.angles, ANGLES))
        assert found == pytest.approx(truth, abs=0.7)


def test_the_strongest_links_chain_and_angles_add_up() -> None:
    found = {(1, 2): Link(40, 90), (2, 3): Link(-10, 80), (1, 3): Link(100, 20), (4, 5): Link(5, 30)}
    groups, used = chained(found, range(1, 7))
    assert groups == [{1: 0.0, 2: 40.0, 3: 30.0}, {4: 0.0, 5: 5.0}, {6: 0.0}]
    assert used == [(1, 2), (2, 3), (4, 5)]


def test_a_track_has_one_feature_in_each_photo(cameras: Cameras) -> None:
    """Twenty points are seen three times; a match of one with another would give a photo two features of one point."""
    same = np.repeat(np.arange(20, dtype=np.uint32)[:, None], 2, axis=1)
    crossed = np.array([[0, 1], *same[1:16].tolist()], np.uint32)
    pairs = replace(two_view_matches(cameras, RING), matches={(1, 2): same, (2, 3): same, (1, 3): crossed})
    all_fit: Any = SimpleNamespace(support=lambda ends, angle, most: np.ones((1, len(ends[0]))))
    camera: Any = SimpleNamespace(principal_point_x=SIZE / 2, principal_point_y=SIZE / 2)
    found = tracks(pairs, Turned(all_fit, (1, 2, 3), np.zeros(3), np.zeros((3, 2))), camera)
    assert found == [[(photo, n) for photo in (1, 2, 3)] for n in range(20)]


@pytest.mark.parametrize(
    ("placed", "turned", "camera", "masked", "taken"),
    [
        (8, 8, "lens", True, False),
        (7, 8, "lens", True, True),
        (7, 7, "lens", True, False),
        (0, 3, "lens", True, True),
        (7, None, "lens", True, False),
        (7, 8, None, True, False),
        (7, 8, "lens", False, False),
    ],
)
def test_a_turntable_is_taken_where_it_places_more_photos(
    placed: int, turned: int | None, camera: Any, masked: bool, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its poses are held by silhouettes like all others, and advice on what was left out is no longer true."""

    def mapped(count: int | None) -> Any:
        return None if not count else SimpleNamespace(names=set(range(count)))

    other = mapped(turned)
    monkeypatch.setattr(pose_search, "find_turned", lambda *_: other)
    monkeypatch.setattr(pose_search, "mask_outlines", lambda *_: {})
    search: Any = SimpleNamespace(
        photos=range(8),
        inputs=SimpleNamespace(masks=Path("m") if masked else None),
        report=None,
        _held=lambda project, found, turned: ("held", found, turned),
    )
    pairs: Any = "pairs"
    look = SecondLook("project", Hypotheses([], True, pairs if masked else None), camera)  # type: ignore[arg-type]
    first = FoundPoses("graph", mapped(placed), "both", ["left out"])  # type: ignore[arg-type]
    found: Any = PoseSearch._turned(search, look, first)
    again = FoundPoses("graph", other, "both", [TURNTABLE])  # type: ignore[arg-type]
    assert found == (("held", again, other) if taken else first)


@pytest.mark.parametrize("second", [False, True])
@pytest.mark.parametrize("placed", [False, True])
def test_a_turntable_is_looked_for_after_silhouettes_left_photos_out(
    second: bool, placed: bool, tmp_path: Path
) -> None:
    steps: list[str] = []
    first = FoundPoses("graph", "mapped" if placed else None, "both")  # type: ignore[arg-type]

    def step(name: str, result: Any) -> Any:
        return lambda *given: steps.append(name) or result

    search: Any = SimpleNamespace(
        times=StageTimes(),
        _few=step("few", (first, "look" if second else None)),
        _held=step("held", first),
        _turned=step("turned", "turned"),
    )
    project: Any = "project"
    found: Any = PoseSearch._looked_thoroughly(search, project, first)
    assert found == ("turned" if second else first)
    assert steps == ["few", *(["held"] if placed else []), *(["turned"] if second else [])]


def test_photos_of_several_lenses_are_no_turntable(tmp_path: Path) -> None:
    database = tmp_path / "photos.db"
    project: Any = SimpleNamespace(opened=lambda: pycolmap.Database.open(database))
    with project.opened() as db:
        db.write_camera(lens(100.0))
    one = turntable_poses.one_lens(project)
    assert one is not None
    assert one.mean_focal_length() == 100
    with project.opened() as db:
        db.write_camera(lens(200.0))
    assert turntable_poses.one_lens(project) is None
