"""Matches before their geometry is verified: how they are asked for, masks, and backgrounds at rest."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsopt.data.sfm import pair_matches
from gsopt.data.sfm.pair_matches import PairMatches, inside, match_features, without_background
from gsopt.data.sfm.settings import SfmConfig

SIZE = (300, 400)
DIAGONAL = 500.0


def matched(shifts: dict[int, tuple[float, float]], wrong: dict[tuple[int, int], float] | None = None) -> PairMatches:
    """Photos of one background that lies at these places; some pairs of which match something else to the right."""
    base = np.random.default_rng(0).uniform(50, 250, (20, 2))
    numbers = sorted(shifts)
    keypoints = {n: np.concatenate([base + shifts[n], base + shifts[n]]) for n in numbers}
    matches = {}
    for a in numbers:
        for b in numbers[numbers.index(a) + 1 :]:
            rows = np.arange(20, dtype=np.uint32)
            matches[a, b] = np.column_stack([rows, rows + (20 if wrong and (a, b) in wrong else 0)])
    for (_, b), off in (wrong or {}).items():
        keypoints[b][20:, 0] += off
    return PairMatches({n: f"{n}.png" for n in numbers}, dict.fromkeys(numbers, SIZE), keypoints, matches)


@pytest.mark.parametrize(("threads", "used"), [(0, -1), (1, 1), (3, 3)])
def test_all_pairs_are_compared_by_features_alone_on_the_threads_that_are_given(
    threads: int, used: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """0 threads is one per core, which COLMAP calls -1."""
    asked: list[Any] = []
    colmap = SimpleNamespace(
        FeatureMatchingOptions=lambda: SimpleNamespace(sift=SimpleNamespace()),
        ImportedPairingOptions=lambda: SimpleNamespace(),
        match_image_pairs=lambda *given, **options: asked.append((given, options)),
    )

    class Opened:
        def __enter__(self) -> Any:
            names = ("a.jpg", "b.jpg", "c.jpg")
            return SimpleNamespace(read_all_images=lambda: [SimpleNamespace(name=name) for name in names])

        def __exit__(self, *_: object) -> None: ...

    project: Any = SimpleNamespace(
        pycolmap=colmap, config=SfmConfig(threads=threads), database=tmp_path / "database.db", opened=Opened
    )
    monkeypatch.setattr(pair_matches, "read_matches", lambda given: given.database)
    assert match_features(project) == tmp_path / "database.db"
    (((database,), options),) = asked
    matching = options["matching_options"]
    assert database == tmp_path / "database.db"
    assert (matching.num_threads, matching.skip_geometric_verification, matching.sift.max_ratio) == (used, True, 0.85)
    written = options["pairing_options"].match_list_path.read_text()
    assert written == "a.jpg b.jpg\na.jpg c.jpg\nb.jpg c.jpg\n"


def test_a_match_is_inside_the_masks_where_each_end_is_in_its_own_photo(tmp_path: Path) -> None:
    """Features 0 and 1 of both photos lie on the left and on the right; the masks show other halves."""
    halves = {1: (255, 0), 2: (127, 128)}
    for number, levels in halves.items():
        mask = np.zeros((10, 20), dtype=np.uint8)
        mask[:, :10], mask[:, 10:] = levels
        Image.fromarray(mask).save(tmp_path / f"{number}.png.png")
    keypoints = {number: np.array([[5.0, 5], [15, 5]]) for number in (1, 2, 3)}
    rows = np.array([[0, 0], [0, 1], [1, 0], [1, 1]], dtype=np.uint32)
    matches = {(1, 2): rows, (2, 3): rows}
    pairs = PairMatches({n: f"{n}.png" for n in keypoints}, dict.fromkeys(keypoints, (20, 10)), keypoints, matches)
    found = inside(pairs, tmp_path)
    assert found.matches[1, 2].tolist() == [[0, 1]]
    assert found.matches[2, 3].tolist() == [[1, 0], [1, 1]]


def corner_moved(corner: int, by: tuple[float, float]) -> np.ndarray:
    """The homography that moves one corner of a photo and leaves the other three where they are."""
    width, height = SIZE
    before = np.array([[0.0, 0], [width, 0], [width, height], [0, height]])
    after = before.copy()
    after[corner] += by
    system = []
    for (x, y), (u, v) in zip(before, after, strict=True):
        system += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
    return np.append(np.linalg.solve(np.array(system), after.ravel()), 1).reshape(3, 3)


@pytest.mark.parametrize("corner", [0, 1, 2, 3])
@pytest.mark.parametrize(("share", "rests"), [(0.14, True), (0.16, False)])
def test_a_background_that_moves_any_corner_is_not_at_rest(corner: int, share: float, rests: bool) -> None:
    inwards = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)][corner]) / np.sqrt(2)
    homography = corner_moved(corner, tuple(share * DIAGONAL * inwards))

    def estimate(first: np.ndarray, second: np.ndarray, options: Any) -> dict[str, Any]:
        return {"num_inliers": len(first), "H": homography, "inlier_mask": np.ones(len(first), bool)}

    colmap = SimpleNamespace(RANSACOptions=SimpleNamespace, estimate_homography_matrix=estimate)
    line = np.linspace(0.05, 0.95, 12)[:, None] * np.array([SIZE])
    assert pair_matches._at_rest(colmap, line, line.copy(), SIZE, 0).tolist() == [rests] * 12


def test_where_no_homography_is_found_nothing_is_at_rest() -> None:
    colmap = SimpleNamespace(RANSACOptions=SimpleNamespace, estimate_homography_matrix=lambda *_: None)
    line = np.linspace(0.05, 0.95, 12)[:, None] * np.array([SIZE])
    assert not pair_matches._at_rest(colmap, line, line.copy(), SIZE, 0).any()


def test_a_background_is_measured_in_the_first_photo_of_a_pair(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = {1: (300, 400), 2: (30, 40), 3: (60, 80)}
    pairs = matched(dict.fromkeys(sizes, (0.0, 0.0)))
    pairs.sizes.update(sizes)
    asked: list[Any] = []

    def at_rest(colmap: Any, first: np.ndarray, second: np.ndarray, size: Any, seed: int) -> np.ndarray:
        asked.append((size, seed))
        return np.ones(len(first), bool)

    monkeypatch.setattr(pair_matches, "_at_rest", at_rest)
    assert without_background(None, pairs, 7) is not None
    assert asked == [((300, 400), 7), ((300, 400), 7), ((30, 40), 7)]
    # 4 px are 0.8 % of the diagonal of photo 1 and 8 % of that of photo 2.
    shifts = {1: np.zeros(2), 2: np.array([4.0, 0]), 3: np.array([8.0, 0])}
    none = np.zeros(20, bool)
    assert pair_matches._background(pairs, (1, 2), none, shifts).all()
    assert not pair_matches._background(pairs, (2, 3), none, shifts).any()


@pytest.mark.parametrize("jointly", [False, True])
def test_what_moves_is_left_and_said_to_be_of_a_turntable_where_all_pairs_were_asked(
    jointly: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of the features move 60 px from photo to photo, before a background that does not."""
    pairs = matched({1: (0, 0), 2: (0, 0), 3: (0, 0)})
    for number, points in pairs.keypoints.items():
        points[10:20, 0] += 60 * number
    monkeypatch.setattr(pair_matches, "_at_rest", lambda *_: np.arange(20) < 10)
    moving = without_background(None, pairs, 0, jointly=True) if jointly else without_background(None, pairs, 0)
    assert moving is not None
    assert [rows[:, 0].tolist() for rows in moving.matches.values()] == [list(range(10, 20))] * 3
    assert moving.turntable == jointly
    assert not pairs.turntable


def test_one_pair_of_six_that_contradicts_the_others_moves_no_background() -> None:
    """Least squares would move its photos by a fourth of its 40 px; the least sum of distances by nothing."""
    places = {1: (0.0, 0.0), 2: (4.0, -3.0), 3: (10.0, 2.0), 4: (-6.0, 5.0)}
    for wrong in ({}, {(1, 4): 40.0}):
        pairs = matched(places, wrong)
        found = pair_matches._shifts(pairs, {pair: np.ones(20, bool) for pair in pairs.matches})
        mean = np.mean(list(places.values()), axis=0)
        for number, place in places.items():
            np.testing.assert_allclose(found[number], place - mean, atol=0.8 if wrong else 1e-9)


def test_a_background_of_its_own_that_is_shifted_as_all_pairs_say_counts() -> None:
    """It lies 40 px farther to the right in the second photo, where all pairs expect it."""
    pairs = matched({1: (0, 0), 2: (40, 0)})
    pairs.keypoints[2][0, 0] += 0.018 * DIAGONAL
    still = np.arange(20) >= 10
    shifts = {1: np.zeros(2), 2: np.array([40.0, 0])}
    found = pair_matches._background(pairs, (1, 2), still, shifts)
    assert found.tolist() == [False] + [True] * 19
    assert pair_matches._background(pairs, (1, 2), np.zeros(20, bool), shifts).all()
