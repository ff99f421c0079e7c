"""What is said about photos at the very edge of a limit, and the numbers in it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from test_answers import CHAIN, NAMES, graph, photo

from gsopt.data.sfm import diagnosis, features, photos, retrieval
from gsopt.data.sfm.features import ViewGraph, reader_options
from gsopt.data.sfm.settings import SfmConfig
from gsopt.errors import UsageError


def plain(name: str, deviation: float, sharpness: float = 1.0) -> photos.Photo:
    """A photo whose gray levels deviate by so much."""
    levels = np.full((32, 32), 100, np.float32)
    levels[:16] += 2 * deviation
    return replace(photo(name, sharpness), thumbnail=levels)


def test_a_photo_is_blurred_below_a_quarter_of_the_usual_sharpness_unless_it_is_plain() -> None:
    assert diagnosis.is_blurred(plain("a", 50, 0.249), 1.0)
    assert not diagnosis.is_blurred(plain("a", 50, 0.25), 1.0)
    assert diagnosis.is_blurred(plain("a", 4.5, 0.1), 1.0)
    assert not diagnosis.is_blurred(plain("a", 4.0, 0.1), 1.0)


@pytest.mark.parametrize(
    ("count", "sharpness", "pairs", "expected"),
    [
        (199, 1.0, {}, ("featureless", "199 features")),
        (200, 1.0, {}, ("unmatched", "200 features")),
        (3000, 0.1, {(3, 4): 29}, ("blurred", "sharpness 0.100, usual is 1.000")),
        (3000, 0.1, {(3, 4): 30}, ("weak", "best: 30 features in common with 3.jpg")),
        (199, 0.1, {(3, 4): 30}, ("blurred", "sharpness 0.100, usual is 1.000")),
        (3000, 1.0, {(3, 4): 20, (4, 5): 99}, ("weak", "best: 20 features in common with 3.jpg")),
        (3000, 1.0, {(2, 4): 21, (3, 4): 20}, ("weak", "best: 21 features in common with 2.jpg")),
    ],
)
def test_the_reason_says_what_was_counted(
    count: int, sharpness: float, pairs: dict[tuple[int, int], int], expected: tuple[str, str]
) -> None:
    found = graph({**CHAIN, **pairs})
    found.features["4.jpg"] = count
    assert diagnosis.why_unplaced(photo("4.jpg", sharpness), found, set(NAMES[:4]), 1.0) == expected


def test_without_a_graph_a_photo_is_alone_and_of_two_that_match_a_third_is_missed() -> None:
    assert diagnosis.why_unplaced(photo("0.jpg"), None, set(), 1.0) == ("alone", "")
    two = ViewGraph({"0.jpg": 900, "1.jpg": 900}, {("0.jpg", "1.jpg"): 99}, frozenset())
    assert diagnosis.why_unplaced(photo("0.jpg"), two, set(), 1.0) == ("pair", "")
    still = ViewGraph({"0.jpg": 900, "1.jpg": 900}, {("0.jpg", "1.jpg"): 99}, frozenset({("1.jpg", "0.jpg")}))
    assert diagnosis.why_unplaced(photo("0.jpg"), still, set(), 1.0) == ("still", "")
    some = graph({**CHAIN, (3, 4): 90, (2, 4): 80}, still=((3, 4),))
    assert diagnosis.why_unplaced(photo("4.jpg"), some, set(NAMES[:4]), 1.0)[0] == "weak"


def test_the_report_lists_figures_reasons_and_advice() -> None:
    found = diagnosis.Diagnosis(9, ["a"], [], ["Walk around."], "global", 0.456, 4.04, 12345)
    assert found.headline() == (
        "1 of 9 photos placed (global) | reprojection error 0.46 px | 12,345 points, each seen in 4.0 photos"
    )
    left = [diagnosis.UnplacedPhoto(f"{i}", "weak", "too weak", "best: 3" if i == 0 else "") for i in range(8)]
    lines = replace(found, left=[*left, diagnosis.UnplacedPhoto("x", "refused", "is empty")]).lines()
    assert lines[1:] == [
        "  not placed: 0 (best: 3), 1, 2, 3, 4, 5 and 2 more: too weak",
        "  not placed: x: is empty",
        "  advice: Walk around.",
    ]
    assert diagnosis._listed(list("abcdef")) == "a, b, c, d, e, f"
    assert replace(found, track_length=None).headline() == "1 of 9 photos placed"


def test_gaps_count_the_photos_in_them() -> None:
    assert diagnosis.gaps(NAMES, {"0.jpg", "2.jpg", "5.jpg"}) == [
        "Add photos between 0.jpg and 2.jpg: the one in between found no place.",
        "Add photos between 2.jpg and 5.jpg: the 2 in between found no place.",
    ]


def turned(*degrees: float) -> np.ndarray:
    """Cameras that look along directions in a plane."""
    viewmats = np.tile(np.eye(4), (len(degrees), 1, 1))
    viewmats[:, 2, :3] = [[math.cos(math.radians(d)), math.sin(math.radians(d)), 0] for d in degrees]
    return viewmats


def test_a_wide_gap_is_over_35_degrees_and_three_times_the_usual_turn() -> None:
    assert diagnosis.wide_gaps("abcd", turned(0, 10, 20, 54.9)) == []
    (advice,) = diagnosis.wide_gaps("abcd", turned(0, 10, 20, 55.2))
    assert advice == "Add photos between c and d: their directions differ by 35 degrees."
    assert diagnosis.wide_gaps("abcd", turned(0, 20, 40, 99.9)) == []
    assert len(diagnosis.wide_gaps("abcd", turned(0, 20, 40, 100.1))) == 1
    assert diagnosis.wide_gaps("ab", turned(0, 90)) == []
    zigzag = turned(*[0, 1] * 20, *[60, 0] * 4)
    assert len(diagnosis.wide_gaps([str(i) for i in range(48)], zigzag)) == 5


def test_a_group_of_three_that_match_each_other_alone_is_another_thing() -> None:
    found = graph({(0, 1): 9, (2, 3): 9, (3, 4): 9})
    assert diagnosis.split_groups(found, {"0.jpg", "1.jpg"}) == [
        "3 photos match only each other (2.jpg, 3.jpg, 4.jpg): another object or place? Run them on their own."
    ]
    assert diagnosis.split_groups(found, {"4.jpg"}) == []


@pytest.mark.parametrize(("millimeters", "known"), [(3.9, False), (4, True), (2000, True), (2001, False)])
def test_a_focal_length_that_no_lens_has_is_no_focal_length(millimeters: float, known: bool) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = millimeters
    found = photos.focal_from_exif(exif, (30, 40))
    assert found == (pytest.approx(millimeters / math.hypot(36, 24) * 50) if known else None)


@pytest.mark.parametrize("side", [159, 160])
def test_the_smallest_photo(tmp_path: Path, side: int) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (side, 500, 3), dtype=np.uint8)
    (tmp_path / "in").mkdir()
    Image.fromarray(noise).save(tmp_path / "in" / "a.png")
    read, refused = photos.read_photos([tmp_path / "in" / "a.png"], tmp_path)
    assert (len(read), len(refused)) == ((1, 0) if side == 160 else (0, 1))
    for item in refused:
        assert item.reason == "too small: 500x159 px. Take the original, not a preview"


def test_a_copy_differs_by_less_than_one_gray_level_and_has_the_same_aspect() -> None:
    one = photo("a")
    for difference, copy in ((0.99, True), (1.01, False)):
        other = replace(one, thumbnail=one.thumbnail + np.float32(difference), width=2000, height=1500)
        assert photos.is_copy(one, other) == copy
    assert not photos.is_copy(one, replace(one, width=4001))


def test_sharpness_is_the_share_of_the_laplacians_variance() -> None:
    """A checkerboard of single pixels: its Laplacian is eight times its deviation everywhere."""
    board = (np.indices((100, 60)).sum(0) % 2 * 40 + 100).astype(np.uint8)
    assert photos.sharpness(Image.fromarray(board)) == pytest.approx(64, rel=1e-3)
    assert photos.sharpness(Image.fromarray(np.full((50, 50), 9, np.uint8))) == 0
    slope = np.tile(np.arange(200, dtype=np.uint8), (50, 1))
    assert photos.sharpness(Image.fromarray(slope)) == 0
    large = Image.fromarray(board).resize((60 * 32, 100 * 32), Image.Resampling.NEAREST)
    small = large.resize((384, 640), Image.Resampling.BOX)
    assert photos.sharpness(large) == pytest.approx(photos.sharpness(small), rel=1e-6)


def test_natural_order_counts_numbers() -> None:
    names = ["a10b2", "a2b10", "a2b9", "10", "9", "a", "b1"]
    assert sorted(names, key=photos.natural) == ["9", "10", "a", "a2b9", "a2b10", "a10b2", "b1"]


def test_two_lens_terms_are_found_from_twenty_photos_on() -> None:
    class Lens:
        def __init__(self, *about: Any) -> None:
            self.about = about

        def params_to_string(self) -> str:
            return " ".join(map(str, self.about[1:]))

    fake: Any = SimpleNamespace(
        ImageReaderOptions=SimpleNamespace, Camera=SimpleNamespace(create_from_model_name=lambda *about: Lens(*about))
    )
    shared = [replace(photo(str(i)), focal=50.0) for i in range(20)]
    assert reader_options(fake, shared, SfmConfig()).camera_params == "RADIAL 50.0 4000 3000"
    assert reader_options(fake, shared[:19], SfmConfig()).camera_model == "SIMPLE_RADIAL"
    assert reader_options(fake, shared, SfmConfig(focal=70.0)).camera_params == "RADIAL 70.0 4000 3000"
    assert reader_options(fake, shared, SfmConfig(camera_model="OPENCV")).camera_model == "OPENCV"
    assert not hasattr(reader_options(fake, [photo("0")], SfmConfig()), "camera_params")


@pytest.mark.parametrize(("count", "matching"), [(200, "exhaustive"), (201, "retrieval")])
def test_what_is_compared(count: int, matching: str) -> None:
    assert features.choose_matching(SfmConfig(), count, is_video=False) == matching
    assert features.choose_matching(SfmConfig(), count, is_video=True) == "sequential"
    assert features.choose_matching(SfmConfig(matching="sequential"), count, is_video=False) == "sequential"


def test_neighbors_in_time_are_the_next_ten_and_powers_of_two() -> None:
    pairs = set(features.neighbors_in_time(range(300)))  # type: ignore[arg-type]
    assert sorted(b - a for a, b in pairs if a == 0) == [*range(1, 11), 16, 32, 64, 128, 256]
    assert sorted(b for a, b in pairs if b == 299 and a >= 289) == [299] * 10


def test_groups_and_partners_of_a_graph() -> None:
    found = graph({(0, 1): 5, (1, 2): 7, (3, 4): 9}, still=((3, 4),))
    assert found.partners("1.jpg") == {"2.jpg": 7, "0.jpg": 5}
    assert list(found.partners("1.jpg")) == ["2.jpg", "0.jpg"]
    assert found.groups() == [{"0.jpg", "1.jpg", "2.jpg"}, {"3.jpg", "4.jpg"}, {"5.jpg"}]
    assert found.is_still("4.jpg", "3.jpg")
    assert found.is_still("3.jpg", "4.jpg")
    assert not found.is_still("0.jpg", "1.jpg")


def test_a_photos_vector_is_its_residuals_from_the_nearest_words() -> None:
    words = np.zeros((2, 128), np.float32)
    words[1, 0] = 10
    rows = np.zeros((3, 128), np.float32)
    rows[0, :2], rows[1, :2], rows[2, :2] = (1, 2), (2, 0), (9, -3)
    vector = retrieval.vlad(rows, words)
    first, second = np.array([3, 2]) / math.hypot(3, 2), np.array([-1, -3]) / math.hypot(1, 3)
    assert vector[:2] == pytest.approx(first / math.sqrt(2), rel=1e-5)
    assert vector[128:130] == pytest.approx(second / math.sqrt(2), rel=1e-5)
    assert np.linalg.norm(vector) == pytest.approx(1)
    assert not retrieval.vlad(rows[:0], words).any()


def test_each_photo_is_compared_with_those_most_like_it() -> None:
    random = np.random.default_rng(0)
    kinds = random.integers(0, 200, (3, 40, 128))
    shown = [np.clip(kinds[i % 3] + random.integers(-3, 4, (40, 128)), 0, 255).astype(np.uint8) for i in range(9)]
    assert retrieval.similar_pairs(shown, 2, seed=1) == {(i, j) for j in range(9) for i in range(j) if (j - i) % 3 == 0}
    assert retrieval.similar_pairs(shown, 99, seed=1) == {(i, j) for j in range(9) for i in range(j)}


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("max_size", 64, 20_000), ("max_features", 64, 65_536), ("frames", 3, 100_000), ("seed", 0, 2**31 - 1)],
)
def test_the_bounds_of_settings_are_allowed_themselves(name: str, low: int, high: int) -> None:
    for value in (low, high):
        assert getattr(SfmConfig(**{name: value}), name) == value  # type: ignore[arg-type]
    for value in (low - 1, high + 1):
        with pytest.raises(UsageError, match=rf"--{name.replace('_', '-')}"):
            SfmConfig(**{name: value})  # type: ignore[arg-type]
    for focal, fine in ((1.0, True), (1e6, True), (0.99, False), (1e6 + 1, False)):
        if fine:
            assert SfmConfig(focal=focal).focal == focal
        else:
            with pytest.raises(UsageError, match="--focal"):
                SfmConfig(focal=focal)
