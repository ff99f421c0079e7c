"""Learned features and matches join those of SIFT: in their masks, in their order, and under their own numbers."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsopt.data.sfm import joined_features
from gsopt.data.sfm.learned_features import LearnedFeatures


class Matcher:
    """It finds what it is given."""

    def features(self, pixels: np.ndarray, mask: np.ndarray | None = None, *, turned: bool = False) -> Any:
        return pixels.shape, turned if mask is None else mask.tolist()

    def match(self, first: Any, second: Any) -> Any:
        return first, second

    def match_turned(self, first: Any, second: Any, upright: Any) -> Any:
        return first, second, upright.tolist()


def test_a_mask_shows_from_the_middle_of_its_grays_on(tmp_path: Path) -> None:
    """A photo without a mask counts everywhere."""
    for name in ("a.png", "b.png"):
        Image.new("L", (4, 2), 9).save(tmp_path / name)
    masks = tmp_path / "masks"
    masks.mkdir()
    Image.fromarray(np.array([[0, 127, 128, 255]] * 2, np.uint8)).save(masks / "a.png.png")
    matcher: Any = Matcher()
    shown = [[False, False, True, True]] * 2
    assert joined_features._features(matcher, tmp_path, masks, False, "a.png") == ((2, 4, 3), shown)
    assert joined_features._features(matcher, tmp_path, masks, False, "b.png") == ((2, 4, 3), False)
    for turned in (False, True):
        assert joined_features._features(matcher, tmp_path, None, turned, "a.png") == ((2, 4, 3), turned)


@pytest.mark.parametrize("turned", [False, True])
def test_whole_photos_are_turned_and_cut_out_objects_are_not(turned: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    nothing = LearnedFeatures(np.zeros((0, 2)), np.zeros((0, 64), np.float32), (9, 9))
    monkeypatch.setattr(joined_features, "_features", lambda *given: asked.append(given[2:]) or nothing)
    matcher: Any = Matcher()
    where = (Path("photos"), Path("masks"), ["a.png"], 1, lambda line: None)
    joined_features.learned_matches(matcher, *where, turned=turned)
    assert asked == [(None, turned, "a.png"), (Path("masks"), False, "a.png")]


def test_features_are_matched_in_the_order_of_their_pair() -> None:
    matcher: Any = Matcher()
    found: Any = {"a": "of a", "b": "of b"}
    assert joined_features._matched(matcher, found, ("a", "b")) == ("of a", "of b")
    assert joined_features._matched(matcher, found, ("b", "a")) == ("of b", "of a")
    upright = {("a", "b"): np.array([[1, 2]], np.uint32)}
    assert joined_features._matched_turned(matcher, found, upright, ("a", "b")) == ("of a", "of b", [[1, 2]])
    assert joined_features._matched_turned(matcher, found, upright, ("b", "a")) == ("of b", "of a", [])


def test_matches_of_turned_photos_stand_beside_those_of_upright_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pairs of whole photos that look alike only turned are among them; matches inside the masks come after both."""
    features = {name: LearnedFeatures(np.full((5, 2), at), np.zeros((5, 64), np.float32), (9, 9)) for at, name in
                enumerate(("a", "b", "c"))}  # fmt: skip
    monkeypatch.setattr(joined_features, "_features", lambda *given: features[given[-1]])
    monkeypatch.setattr(joined_features, "lookalikes", lambda one, other: 20 * (other.keypoints[0, 0] == 1))
    monkeypatch.setattr(joined_features, "turned_lookalikes", lambda one, other: 20 * (one.keypoints[0, 0] == 1))
    monkeypatch.setattr(joined_features, "_matched", lambda *given: np.array([[0, 0]], np.uint32))
    monkeypatch.setattr(joined_features, "_matched_turned", lambda *given: np.array([[3, 4]], np.uint32))
    where = (Path("photos"), Path("masks"), ["a", "b", "c"], 1, lambda line: None)
    found = joined_features.learned_matches(Matcher(), *where, turned=True)  # type: ignore[arg-type]
    assert {pair: rows.tolist() for pair, rows in found.matches.items()} == {("a", "b"): [[0, 0], [5, 5]]}
    turned = {pair: rows.tolist() for pair, rows in found.turned.items()}
    assert turned == {("a", "b"): [[3, 4], [5, 5]], ("b", "c"): [[3, 4]]}
    found = joined_features.learned_matches(Matcher(), *where, turned=False)  # type: ignore[arg-type]
    assert {pair: rows.tolist() for pair, rows in found.turned.items()} == {("a", "b"): [[0, 0], [5, 5]]}
    assert found.matches.keys() == found.turned.keys()


@pytest.mark.parametrize("threads", [0, 1, 3])
def test_results_are_in_the_order_of_the_items_for_any_number_of_threads(threads: int) -> None:
    assert joined_features._each(lambda item: item * item, range(20), threads) == [item * item for item in range(20)]


def test_learned_matches_come_after_those_that_are_there_and_in_the_order_of_the_database(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Photo a is number 2 and has 100 features already; b is number 1 and has 50; their match is turned around."""
    written: dict[tuple[int, int], list[list[int]]] = {}
    images = [SimpleNamespace(name=name, image_id=number) for name, number in (("a", 2), ("b", 1), ("c", 3))]
    there = {(1, 3): np.array([[7, 8]], np.uint32)}

    class Database:
        def __enter__(self) -> Any:
            return SimpleNamespace(
                read_all_images=lambda: images,
                exists_matches=lambda *pair: pair in there,
                read_matches=lambda *pair: there[pair],
                delete_matches=lambda *pair: there.pop(pair),
                write_matches=lambda a, b, rows: written.update({(a, b): rows.tolist()}),
            )

        def __exit__(self, *_: object) -> None: ...

    monkeypatch.setattr(joined_features, "_append_keypoints", lambda db, number, keypoints: 50 * number)
    points = np.zeros((9, 2))
    rows = np.array([[1, 2], [3, 4]], np.uint32)
    learned: Any = SimpleNamespace(
        keypoints=dict.fromkeys("abc", points), matches={("a", "b"): rows, ("b", "c"): rows, ("a", "c"): rows}
    )
    project: Any = SimpleNamespace(opened=Database)
    joined_features.join(project, learned)
    assert written == {
        (1, 2): [[52, 101], [54, 103]],
        (1, 3): [[7, 8], [51, 152], [53, 154]],
        (2, 3): [[101, 152], [103, 154]],
    }
    assert there == {}


@pytest.mark.parametrize(("columns", "shape"), [(2, []), (4, [1, 0]), (6, [1, 0, 0, 1])])
def test_learned_keypoints_follow_with_size_one_and_no_turn(columns: int, shape: list[int]) -> None:
    """COLMAP stores x and y, then scale and angle or a matrix of two rows."""
    written: list[np.ndarray] = []
    before = np.full((3, columns), 7.0, np.float32)
    db = SimpleNamespace(
        exists_keypoints=lambda number: True,
        read_keypoints=lambda number: before,
        update_keypoints=lambda number, rows: written.append(rows),
    )
    assert joined_features._append_keypoints(db, 4, np.array([[10.5, 20.5], [1.0, 2.0]])) == 3
    assert np.array_equal(written[0][:3], before)
    assert written[0][3:].tolist() == [[10.5, 20.5, *shape], [1, 2, *shape]]
    assert written[0].dtype == np.float32
