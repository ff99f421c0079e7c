"""The search for poses of few photos: which matches it tries, which reconstruction it takes, and what it then adds."""

from __future__ import annotations

import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from test_mapping_rules import Pairs, Reconstruction, shared

from gsopt.data.sfm import few_photos
from gsopt.data.sfm.few_photos import match_few, trust
from gsopt.data.sfm.settings import SfmConfig

NAMES = {1: "a", 2: "b", 3: "c", 4: "d"}


def model(photos: int, points: int) -> Reconstruction:
    """Photos that all see so many points."""
    numbers = range(1, photos + 1)
    return Reconstruction(list(numbers), shared(points, *numbers))


class Looked:
    """What a search for four photos does, by the reconstructions that each kind of matches gives."""

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        found: dict[str, list[Reconstruction]],
        features: str = "sift",
        **kept: Any,
    ) -> None:
        self.asked: list[str] = []
        self.verified: list[Any] = []
        self.steps: list[str] = []
        self.lines: list[str] = []

        def attempts(project: object, pairs: object, where: str, focals: object) -> list[few_photos.Attempt]:
            self.asked.append(where)
            return [few_photos.Attempt(one, where) for one in found[where]]

        def step(name: str, changes: bool = True) -> Any:
            def taken(*about: Any) -> Any:
                self.steps.append(name)
                return about[-1] if changes else None

            return taken

        def coherent(one: Reconstruction) -> None:
            self.steps.append("coherent")
            one.photos &= kept.get("coherent", one.photos)

        monkeypatch.setattr(few_photos, "focals_to_try", lambda project: [None])
        monkeypatch.setattr(few_photos, "_attempts", attempts)
        monkeypatch.setattr(
            few_photos, "verify", lambda project, pairs, one=None: self.verified.append((pairs.of, one))
        )
        monkeypatch.setattr(few_photos, "read_graph", lambda project: f"graph {len(self.verified)}")
        monkeypatch.setattr(few_photos, "keep_confirmed", step("confirmed", changes=False))
        monkeypatch.setattr(few_photos, "with_guided_matches", step("guided"))
        monkeypatch.setattr(few_photos, "_grown", step("grown"))
        monkeypatch.setattr(few_photos, "keep_coherent", coherent)
        monkeypatch.setattr(few_photos, "has_real_lens", lambda *_: kept.get("real", True))
        project: Any = SimpleNamespace(config=SfmConfig(features=features))  # type: ignore[arg-type]
        hypotheses: Any = [(where, SimpleNamespace(names=NAMES, of=where)) for where in found]
        self.result, self.graph = few_photos.find_few_poses(project, hypotheses, self.lines.append)
        self.model = self.result.reconstruction if self.result is not None else None


def test_matches_are_tried_until_some_place_all_photos(monkeypatch: pytest.MonkeyPatch) -> None:
    """A smaller reconstruction beside the largest is no reason to go on."""
    found = {"masks": [model(3, 500), model(2, 500)], "whole": [model(4, 500), model(2, 9)], "never": []}
    looked = Looked(monkeypatch, found)
    assert looked.asked == ["masks", "whole"]
    assert looked.lines == ["features of masks place 3 of 4 photos", "features of whole place 4 of 4 photos"]


@pytest.mark.parametrize(("points", "best"), [(500, "whole"), (300, "masks")])
def test_the_reconstruction_with_most_support_is_taken_and_its_pairs_are_verified_by_it(
    points: int, best: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = {"masks": [model(3, 200), model(3, 401)], "whole": [model(3, points)]}
    looked = Looked(monkeypatch, found)
    assert looked.model is found[best][-1]
    assert looked.verified == [(best, looked.model)]
    assert looked.graph == "graph 1"
    assert looked.result is not None
    assert (looked.result.mapper, looked.result.others) == ("few photos", [])


def test_where_nothing_is_placed_the_graph_is_that_of_the_last_matches(monkeypatch: pytest.MonkeyPatch) -> None:
    looked = Looked(monkeypatch, {"masks": [], "whole": []})
    assert (looked.result, looked.graph, looked.verified) == (None, "graph 1", [("whole", None)])
    assert looked.lines == ["features of masks place 0 of 4 photos", "features of whole place 0 of 4 photos"]
    assert looked.steps == []


@pytest.mark.parametrize(
    ("photos", "points", "trusted"), [(4, 100, True), (4, 99, False), (3, 100, True), (2, 500, False)]
)
def test_three_photos_whose_median_one_sees_a_hundred_points_are_trusted(
    photos: int, points: int, trusted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked = Looked(monkeypatch, {"whole": [model(photos, points)]})
    assert (looked.result is not None) == trusted
    refusal = f"{photos} photos share too few points to be trusted: {points} in the median photo"
    assert looked.lines[1:] == ([] if trusted else [refusal])
    assert trusted or looked.graph == "graph 1"


@pytest.mark.parametrize(
    ("photos", "points", "features", "steps"),
    [
        (4, 399, "sift", ["guided", "coherent"]),
        (4, 400, "sift", ["coherent"]),
        (4, 400, "both", ["confirmed", "guided", "coherent"]),
        (4, 399, "both", ["confirmed", "guided", "coherent"]),
        (3, 400, "sift", ["grown", "coherent"]),
        (3, 400, "xfeat", ["confirmed", "guided", "grown", "confirmed", "coherent"]),
    ],
)
def test_matches_are_added_below_four_hundred_points_and_photos_where_some_are_missing(
    photos: int, points: int, features: str, steps: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Learned features are always confirmed, and get more matches."""
    assert Looked(monkeypatch, {"whole": [model(photos, points)]}, features).steps == steps


@pytest.mark.parametrize(
    ("coherent", "real", "sound"), [({1, 2, 3}, True, True), ({1, 2}, True, False), ({1, 2, 3, 4}, False, False)]
)
def test_three_photos_must_cohere_and_the_lens_must_be_real(
    coherent: set[int], real: bool, sound: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked = Looked(monkeypatch, {"whole": [model(4, 500)]}, coherent=coherent, real=real)
    assert (looked.result is not None) == sound
    assert looked.graph == "graph 1"


@pytest.mark.parametrize("masks", [None, Path("masks")])
@pytest.mark.parametrize("turntable", [False, True])
@pytest.mark.parametrize("learned", [False, True])
def test_matches_inside_the_masks_come_first_and_learned_ones_must_be_consistent(
    masks: Path | None, turntable: bool, learned: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def moving(pycolmap: object, pairs: str, seed: int, *, jointly: bool) -> str | None:
        assert seed == 7
        return f"moving{' jointly' if jointly else ''} {pairs}" if turntable else None

    monkeypatch.setattr(few_photos, "match_features", lambda project: "sift")
    monkeypatch.setattr(few_photos, "joined_matches", lambda project, learned, *, turned: learned if turned else "")
    monkeypatch.setattr(few_photos, "without_background", moving)
    monkeypatch.setattr(few_photos, "on_epipolar_lines", lambda pycolmap, pairs, seed: f"{pairs} on lines")
    monkeypatch.setattr(few_photos, "consistent", lambda pairs: f"{pairs}, consistent")
    monkeypatch.setattr(few_photos, "inside", lambda pairs, masks: f"{pairs}, inside {masks}")
    project: Any = SimpleNamespace(pycolmap=None, config=SfmConfig(seed=7))
    given: Any = "joined" if learned else None
    found = match_few(project, masks, given)
    moved = ("moving jointly " if learned else "moving ") if turntable else ""
    whole = moved + ("joined on lines, consistent" if learned else "sift")
    inside = [] if masks is None else [("the masks", f"{whole}, inside masks")]
    assert found.matches == [*inside, ("the whole photos", whole)]
    assert found.turntable == turntable
    turning = ("moving jointly " if turntable else "") + ("joined" if learned else "sift")
    assert found.turning == (None if masks is None else f"{turning}, inside masks")


def test_a_background_at_rest_takes_all_trust(monkeypatch: pytest.MonkeyPatch) -> None:
    project: Any = SimpleNamespace(pycolmap=None, config=SfmConfig())
    mapped: Any = SimpleNamespace(reconstruction=model(3, 170))
    monkeypatch.setattr(few_photos, "read_matches", lambda project: "pairs")
    for moving, points in ((None, 170), ("moving", 0)):
        monkeypatch.setattr(few_photos, "without_background", lambda pycolmap, pairs, seed, moving=moving: moving)
        assert trust(project, mapped) == points
        assert trust(project, None) == 0


@pytest.mark.parametrize(("turntable", "least_turn"), [(True, 6.0), (False, 0.0)])
def test_features_lie_within_three_px_of_their_lines_and_a_turntable_turns_by_six_degrees(
    turntable: bool, least_turn: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What one of ten matches says is found; the lenses may be of a focal length or of a reconstruction."""
    asked: list[Any] = []
    monkeypatch.setattr(
        few_photos, "_lenses", lambda project, db, model, focal: asked.append((model, focal)) or {1: ""}
    )
    monkeypatch.setattr(few_photos, "disagreeing", lambda counts, turns, least: asked.append(least) or [])
    options = SimpleNamespace(ransac=SimpleNamespace())
    colmap = SimpleNamespace(TwoViewGeometryOptions=lambda: options)
    project: Any = SimpleNamespace(pycolmap=colmap, config=SfmConfig(features="both"), opened=Pairs)
    pairs: Any = SimpleNamespace(matches={}, keypoints={}, turntable=turntable)
    few_photos.verify(project, pairs, focal=1.9)
    assert asked == [(None, 1.9), least_turn]
    assert (options.ransac.max_error, options.ransac.min_inlier_ratio, options.min_num_inliers) == (3.0, 0.1, 18)
    few_photos.verify(project, pairs, "model", only={1})
    assert asked[2:] == [("model", None)]


def test_of_equal_results_the_first_start_wins_even_where_it_ends_last(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = threading.Semaphore(0)

    def mapped(project: object, first: tuple[int, int] | None) -> list[Reconstruction]:
        if first is not None:
            ended.release()
        elif not (ended.acquire(timeout=60) and ended.acquire(timeout=60)):
            raise TimeoutError("The other starts wait for the first one.")
        return [model(3 if first is None else 4, 0)]

    monkeypatch.setattr(few_photos, "verify", lambda *_, focal: {(1, 2): 50, (1, 3): 90})
    monkeypatch.setattr(few_photos, "_mapped", mapped)
    monkeypatch.setattr(few_photos, "bundle_adjusted", lambda project, one, lens: one)
    project: Any = SimpleNamespace(config=SfmConfig(threads=2))
    pairs: Any = None
    (attempt,) = few_photos._attempts(project, pairs, "the masks", [None])
    assert attempt.photos == 3
