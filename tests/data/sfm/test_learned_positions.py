"""What surrounds the learned networks: where their features lie, what a mask keeps, and what counts as alike."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gsopt.data.sfm import learned_features
from gsopt.data.sfm.learned_features import LearnedFeatures, LearnedMatcher, lookalikes, turned_lookalikes
from gsopt.errors import InputError


class WhitePixels:
    """A network that finds the white pixels, where the real one does: at whole numbers, and beside them."""

    def __init__(self) -> None:
        self.asked: list[tuple[tuple[int, ...], int]] = []

    def detectAndCompute(self, image: Any, most: int) -> list[dict[str, Any]]:
        self.asked.append((tuple(image.shape), most))
        rows, columns = torch.nonzero(image[0].mean(0) > 0.99, as_tuple=True)
        places = torch.stack([columns, rows], dim=1).double() + torch.tensor(learned_features.OFFSET)
        return [{"keypoints": places, "descriptors": torch.ones(len(places), 64)}]


def matcher() -> tuple[LearnedMatcher, WhitePixels]:
    found = LearnedMatcher.__new__(LearnedMatcher)
    found._extractor = network = WhitePixels()
    return found, network


def photo(width: int, height: int, *white: tuple[int, int]) -> np.ndarray:
    pixels = np.zeros((height, width, 3), np.uint8)
    for column, row in white:
        pixels[row, column] = 255
    return pixels


def test_a_feature_of_a_pixel_lies_at_its_center() -> None:
    side = learned_features.SIDE
    found, network = matcher()
    features = found.features(photo(side, side // 2, (0, 0), (7, 3), (side - 1, side // 2 - 1)))
    expected = [[0.5, 0.5], [7.5, 3.5], [side - 0.5, side // 2 - 0.5]]
    np.testing.assert_allclose(features.keypoints, expected, atol=1e-5)
    assert features.size == (side, side // 2)
    assert network.asked == [((1, 3, side // 2, side), learned_features.MAX_KEYPOINTS)]
    assert features.descriptors.shape == (3, 64)


def test_features_stay_in_the_photo() -> None:
    """A corner at the border may be found beside it."""
    side = learned_features.SIDE
    found, network = matcher()
    network.detectAndCompute = lambda image, most: [  # type: ignore[method-assign]
        {"keypoints": torch.tensor([[0.0, side], [side, -9.0]]), "descriptors": torch.ones(2, 64)}
    ]
    keypoints = found.features(photo(side, side)).keypoints
    np.testing.assert_allclose(keypoints, [[0.05, side], [side - 0.0, 0]], atol=2e-3)
    assert (keypoints >= 0).all()
    assert (keypoints < side).all()


def test_a_photo_is_looked_at_in_one_size_and_its_features_are_where_they_were() -> None:
    side = learned_features.SIDE
    pixels = np.zeros((side, 2 * side, 3), np.uint8)
    pixels[20:40, 60:80] = 255
    found, network = matcher()
    features = found.features(pixels)
    assert network.asked[0][0] == (1, 3, side // 2, side)
    low, high = features.keypoints.min(axis=0), features.keypoints.max(axis=0)
    assert (low >= [60, 20]).all()
    assert (high <= [80, 40]).all()
    assert features.keypoints.mean(axis=0).tolist() == pytest.approx([70, 30], abs=0.5)
    thin = found.features(np.zeros((8, 3 * side, 3), np.uint8))
    assert network.asked[1][0] == (1, 3, learned_features.STEP, side)
    assert len(thin.keypoints) == 0


def test_of_a_masked_photo_the_box_of_the_mask_is_looked_at_and_the_mask_kept() -> None:
    side = learned_features.SIDE
    mask = np.zeros((100, 200), bool)
    mask[40:60, 100:140] = True
    margin = round(learned_features.MARGIN * 200)
    found, network = matcher()
    pixels = np.zeros((100, 200, 3), np.uint8)
    pixels[45:55, 95:130] = 255
    features = found.features(pixels, mask)
    width, height = 40 + 2 * margin, 20 + 2 * margin
    assert network.asked[0][0] == (1, 3, round(height * side / width), side)
    assert network.asked[0][1] == learned_features.CANDIDATES * learned_features.MAX_KEYPOINTS
    columns, rows = features.keypoints.astype(int).T
    assert mask[rows, columns].all()
    assert (columns.min(), columns.max()) == (100, 129)
    assert len(rows) <= learned_features.MAX_KEYPOINTS


def test_the_box_of_a_mask_has_a_margin_and_stays_in_the_photo() -> None:
    mask = np.zeros((100, 300), bool)
    assert learned_features._box(mask) == (0, 0, 300, 100)
    mask[50, 0] = mask[99, 120] = True
    margin = round(learned_features.MARGIN * 300)
    assert learned_features._box(mask) == (0, 50 - margin, 121 + margin, 100)
    small = np.zeros((5, 5), bool)
    small[2, 2] = True
    assert learned_features._box(small) == (1, 1, 4, 4)


def features(looks: np.ndarray) -> LearnedFeatures:
    return LearnedFeatures(np.zeros((len(looks), 2)), looks.astype(np.float32), (9, 9))


def test_lookalikes_are_each_others_best_and_alike() -> None:
    basis = np.eye(64)
    alike = learned_features.MIN_LIKENESS
    tilted = np.cos(np.arccos(alike) - 0.01) * basis[2] + np.sin(np.arccos(alike) - 0.01) * basis[10]
    apart = np.cos(np.arccos(alike) + 0.01) * basis[3] + np.sin(np.arccos(alike) + 0.01) * basis[11]
    first = features(np.stack([basis[0], basis[1], tilted, apart]))
    second = features(np.stack([basis[1], basis[0], basis[2], basis[3]]))
    assert lookalikes(first, second) == 3
    assert lookalikes(features(np.stack([basis[0], basis[0]])), features(basis[:1])) == 1
    assert lookalikes(first, features(basis[:0])) == lookalikes(features(basis[:0]), first) == 0


def test_photos_without_features_match_nothing_and_others_as_the_network_says() -> None:
    found, _ = matcher()
    asked: list[Any] = []
    found._matcher = lambda pair: asked.append(pair) or {"matches": [torch.tensor([[0, 1], [2, 0]])]}
    some, none = features(np.eye(64)[:3]), features(np.eye(64)[:0])
    assert found.match(some, none).shape == found.match(none, some).shape == (0, 2)
    assert asked == []
    assert found.match(some, some).tolist() == [[0, 1], [2, 0]]
    assert asked[0]["image0"]["keypoints"].shape == (1, 3, 2)
    assert asked[0]["image1"]["image_size"].tolist() == [[9, 9]]


def test_turned_features_are_where_their_photo_shows_them() -> None:
    pixels = np.zeros((3, 5), int)
    pixels[1, 4] = 1
    found = LearnedFeatures(
        np.array([[4.5, 1.5]]), np.eye(64)[:1], (5, 3), tuple(np.eye(64)[k : k + 1] for k in (1, 2, 3))
    )
    for quarters, view in enumerate(found.turns()):
        shown = np.rot90(pixels, quarters)
        (row,), (column,) = np.nonzero(shown)
        assert view.keypoints.tolist() == [[column + 0.5, row + 0.5]]
        assert view.size == (shown.shape[1], shown.shape[0])
        assert int(view.descriptors[0].argmax()) == quarters
        assert view.turned == ()
    assert quarters == 3
    two = LearnedFeatures(np.zeros((2, 2)), np.eye(64)[:2], (9, 9), (np.eye(64)[2:4],) * 3)
    assert len(two.strongest(1).keypoints) == len(two.strongest(1).descriptors) == 1
    assert [len(view.descriptors) for view in two.strongest(1).turns()] == [1] * 4


def test_photos_look_alike_in_the_best_turn() -> None:
    first, other = features(np.eye(64)[:3]), np.eye(64)[10:13].astype(np.float32)
    turned = (other, np.eye(64)[[0, 1, 12]].astype(np.float32), other)
    assert turned_lookalikes(first, replace(features(other), turned=turned)) == 2
    assert turned_lookalikes(first, replace(features(np.eye(64)[:3]), turned=turned)) == 3
    assert turned_lookalikes(first, features(other)) == lookalikes(first, replace(features(other), turned=turned)) == 0


@pytest.mark.parametrize("few", [16, 15])
def test_a_turn_counts_where_the_strongest_features_find_enough(few: int) -> None:
    """The second turn has more matches than the photo as it is, and goes first."""
    made, asked = matcher()[0], list[tuple[int, int, int]]()
    whole = features(np.repeat(np.eye(64), 40, axis=0)[:2000])
    second = replace(whole, turned=tuple(np.full((2000, 64), k, np.float32) for k in (1, 2, 3)))
    turned = [[3, 3], [4, 4], [5, 5], [2, 6], [0, 9]]

    def match(one: LearnedFeatures, other: LearnedFeatures) -> np.ndarray:
        turn = int(other.descriptors[0, 5])
        asked.append((turn, len(one.keypoints), len(other.keypoints)))
        if len(other.keypoints) == 1024:
            return np.zeros((few if turn == 2 else 15, 2), np.uint32)
        return np.array(turned, np.uint32)

    made.match = match  # type: ignore[method-assign]
    upright = np.array([[0, 0], [1, 1], [2, 7]], np.uint32)
    found = made.match_turned(whole, second, upright).tolist()
    assert found == ([*turned, [1, 1]] if few == 16 else upright.tolist())
    strongest = [(turn, 1024, 1024) for turn in (1, 2, 3)]
    assert asked == ([*strongest[:2], (2, 2000, 2000), strongest[2]] if few == 16 else strongest)


def test_weights_of_another_content_or_size_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "xfeat.pt"
    path.write_bytes(b"1234")
    learned_features._check(path, "03ac674216f3e15c761ee1a5e255f067953623c8b388b4459e13f978d7c846f4")
    with pytest.raises(InputError, match="are damaged"):
        learned_features._check(path, "0" * 64)
    monkeypatch.setattr(learned_features, "MAX_WEIGHT_BYTES", 4)
    learned_features._check(path, "03ac674216f3e15c761ee1a5e255f067953623c8b388b4459e13f978d7c846f4")
    monkeypatch.setattr(learned_features, "MAX_WEIGHT_BYTES", 3)
    with pytest.raises(InputError, match="no file of at most"):
        learned_features._check(path, "0" * 64)
    with pytest.raises(InputError, match="no file of at most"):
        learned_features._check(tmp_path / "absent.pt", "0" * 64)
