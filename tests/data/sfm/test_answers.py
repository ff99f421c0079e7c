"""Answers to the user: reasons, advice, placement of the world, and figures of a trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import textured_room as room
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Int64

from gsopt.data.sfm import diagnosis, mapping
from gsopt.data.sfm.features import ViewGraph, choose_matching, neighbors_in_time, reader_options
from gsopt.data.sfm.mapping import mappers_to_try, off_center, seed_photos
from gsopt.data.sfm.photos import Photo, RejectedFile
from gsopt.data.sfm.placement import Similarity, place
from gsopt.data.sfm.refusal import too_few
from gsopt.data.sfm.retrieval import similar_pairs
from gsopt.data.sfm.settings import SfmConfig
from gsopt.data.sfm.trajectory import compare
from gsopt.errors import UsageError


def photo(name: str, sharpness: float = 1.0) -> Photo:
    thumbnail = np.random.default_rng(len(name)).uniform(0, 255, (32, 32)).astype(np.float32)
    return Photo(name, None, None, 4000, 3000, "camera", None, sharpness, False, thumbnail)  # type: ignore[arg-type]


NAMES = tuple(f"{i}.jpg" for i in range(6))


def graph(
    pairs: dict[tuple[int, int], int], features: int = 3000, still: tuple[tuple[int, int], ...] = ()
) -> ViewGraph:
    named = {(NAMES[a], NAMES[b]): count for (a, b), count in pairs.items()}
    return ViewGraph(dict.fromkeys(NAMES, features), named, frozenset((NAMES[a], NAMES[b]) for a, b in still))


CHAIN = {(0, 1): 500, (1, 2): 400, (2, 3): 300}


@pytest.mark.parametrize(
    ("mapper", "runs"),
    [("incremental", "_incremental"), ("held-lens", "_held"), ("global", "_global"), ("hybrid", "_global")],
)
def test_the_mapper_that_is_asked_for_runs(
    mapper: str, runs: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[str] = []
    for name in ("_incremental", "_held", "_global"):
        monkeypatch.setattr(mapping, name, lambda *_, name=name: ran.append(name) or [])
    colmap = SimpleNamespace(set_random_seed=ran.append)
    project = SimpleNamespace(pycolmap=colmap, config=SfmConfig(seed=7), database=tmp_path / "database.db")
    assert mapping.run_mapper(project, mapper, graph(CHAIN)) == []  # type: ignore[arg-type]
    assert ran == [7, runs]


@pytest.mark.parametrize(
    ("left", "found", "kind"),
    [
        (photo("4.jpg", sharpness=0.01), graph(CHAIN), "blurred"),
        (photo("4.jpg"), graph(CHAIN, features=50), "featureless"),
        (photo("4.jpg"), graph(CHAIN), "unmatched"),
        (photo("4.jpg"), graph({**CHAIN, (3, 4): 200}, still=((3, 4),)), "still"),
        (photo("4.jpg"), graph({**CHAIN, (4, 5): 200}), "apart"),
        (photo("4.jpg"), graph({**CHAIN, (3, 4): 20}), "weak"),
    ],
)
def test_every_photo_without_a_pose_has_its_reason_and_a_remedy(left: Photo, found: ViewGraph, kind: str) -> None:
    photos = [photo(name) for name in NAMES[:4]] + [left]
    report = diagnosis.explain(photos, [RejectedFile("x.jpg", "is empty")], found, set(NAMES[:4]))
    assert [(item.name, item.kind) for item in report.left] == [("x.jpg", "refused"), ("4.jpg", kind)]
    assert report.given == 6
    assert diagnosis.REMEDIES[kind] in report.advice
    assert report.headline() == "4 of 6 photos placed"


def test_gaps_name_the_photos_on_both_sides() -> None:
    assert diagnosis.gaps(NAMES, {"0.jpg", "1.jpg", "4.jpg", "5.jpg"}) == [
        "Add photos between 1.jpg and 4.jpg: the 2 in between found no place."
    ]
    assert diagnosis.gaps(NAMES, set(NAMES[1:4])) == [], "before the first and after the last there is no gap"


def test_a_wide_turn_between_neighbors_is_pointed_out() -> None:
    viewmats = room.arc(7, spread=60).numpy()
    assert diagnosis.wide_gaps([str(i) for i in range(7)], viewmats) == []
    (advice,) = diagnosis.wide_gaps(["a", "b", "c", "d"], np.stack([*viewmats[:3], room.arc(2, spread=75).numpy()[1]]))
    assert advice.startswith("Add photos between c and d: their directions differ by ")


def sharing(groups: Sequence[str], count: int = 30) -> Int64[np.ndarray, "7 7"]:
    """Counts for photos 0 to 6: those of a group share so many points with each other."""
    shared = np.zeros((7, 7), dtype=np.int64)
    for group in groups:
        shared[np.ix_([int(i) for i in group], [int(i) for i in group])] = count
    return shared


def test_photos_that_hang_on_one_other_photo_are_named() -> None:
    """The smaller side of the one photo is named; where a second photo joins it too, nothing is."""
    names = [f"{i}.jpg" for i in range(7)]
    (advice,) = diagnosis.weak_links(names, sharing(["01234", "456"]))
    assert advice.startswith("5.jpg, 6.jpg share points with the other photos through 4.jpg alone")
    assert advice.endswith("Add photos on both sides of 4.jpg.")
    (weakly,) = diagnosis.weak_links(names, np.maximum(sharing(["01234", "456"]), sharing(["0123456"], 29)))
    assert weakly == advice
    assert diagnosis.weak_links(names, sharing(["01234", "456", "26"])) == []
    assert diagnosis.weak_links(names, sharing(["012345", "56"])) == []  # one photo at the end
    assert diagnosis.weak_links([], np.zeros((0, 0), dtype=np.int64)) == []


def test_photos_that_share_few_points_with_the_others_are_named() -> None:
    """The smaller part is named, with the pair that joins it best; photos that share few with any are no part."""
    names = [f"{i}.jpg" for i in range(7)]
    (advice,) = diagnosis.weak_links(names, np.maximum(sharing(["0123", "456"]), sharing(["35"], 29)))
    assert advice.startswith(
        "4.jpg, 5.jpg, 6.jpg share few points with the other photos, at best 29 (5.jpg with 3.jpg)"
    )
    assert advice.endswith("Add photos between 5.jpg and 3.jpg.")
    assert [text.partition(" share ")[0] for text in diagnosis.weak_links(names, sharing(["012", "34", "56"]))] == [
        "3.jpg, 4.jpg",
        "5.jpg, 6.jpg",
    ]
    assert diagnosis.weak_links(names, sharing(["01234"])) == []
    assert diagnosis.weak_links(names, sharing(["0123456"], 29)) == []


def test_of_several_photos_that_others_hang_on_the_one_that_carries_most_is_named() -> None:
    (advice,) = diagnosis.weak_links([str(i) for i in range(7)], sharing(["01", "12", "23", "34", "45", "56"]))
    assert advice.startswith("0, 1, 2 share points with the other photos through 3 alone")


def test_refusals_offer_the_object_path_only_where_it_can_help() -> None:
    nothing = diagnosis.explain([], [RejectedFile("x.jpg", "is empty")], None, set())
    assert "None of the files can be used" in str(too_few(nothing, None))
    assert "--lambda-sds" not in str(too_few(nothing, None))
    one = diagnosis.explain([photo("0.jpg")], [], None, set())
    assert "invented there, not measured" in str(too_few(one, None))
    many = diagnosis.explain([photo(name) for name in NAMES], [], graph({}), set())
    assert "Take 20 or more photos" in str(too_few(many, graph({})))


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**31 - 1), scale=st.floats(0.01, 100))
def test_placement_does_not_depend_on_the_frame_poses_came_in(seed: int, scale: float) -> None:
    """Moved, turned and scaled poses are placed alike, up to a turn about the vertical."""
    rng = np.random.default_rng(seed)
    viewmats, points = room.arc(6).numpy(), rng.normal(size=(50, 3))
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    moved = viewmats.copy()
    moved[:, :3, :3] = viewmats[:, :3, :3] @ rotation.T
    shift = rng.normal(size=3)
    moved[:, :3, 3] = scale * viewmats[:, :3, 3] - np.einsum("cij,j->ci", moved[:, :3, :3], shift)
    a, b = place(viewmats, points), place(moved, scale * points @ rotation.T + shift)
    assert b.scale == pytest.approx(a.scale / scale, rel=1e-6)
    first, second = (placed_centers(v, s) for v, s in ((viewmats, a), (moved, b)))
    np.testing.assert_allclose(second[:, 2], first[:, 2], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(second, axis=1), np.linalg.norm(first, axis=1), atol=1e-6)


def placed_centers(viewmats: np.ndarray, similarity: Similarity) -> np.ndarray:
    centers = -np.einsum("cij,ci->cj", viewmats[:, :3, :3], viewmats[:, :3, 3])
    return similarity.scale * centers @ similarity.rotation.T + similarity.translation


def test_placement_makes_up_z_and_the_distance_one() -> None:
    centers = placed_centers(room.arc(6).numpy(), place(room.arc(6).numpy(), np.zeros((1, 3))))
    assert np.median(np.linalg.norm(centers, axis=1)) == pytest.approx(1)
    assert (centers[:, 2] > 0.2).all(), "these cameras look down"


def test_a_trajectory_error_is_zero_up_to_similarity_and_measures_what_was_added() -> None:
    truth = room.arc(8).numpy()
    angle = np.radians(0.5)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    found = truth.copy()
    found[:, :3, 3] *= 3.0
    assert compare(found, truth).rotation_degrees.max() < 1e-6
    assert compare(found, truth).position.max() < 1e-9
    found[2, :3] = turn @ found[2, :3]
    error = compare(found, truth).rotation_degrees
    assert error[2] == pytest.approx(0.5, abs=1e-6)
    assert np.delete(error, 2).max() < 1e-6


def test_what_auto_becomes() -> None:
    auto = SfmConfig()
    assert choose_matching(auto, 200, is_video=False) == "exhaustive"
    assert choose_matching(auto, 201, is_video=False) == "retrieval"
    assert choose_matching(auto, 50, is_video=True) == "sequential"
    assert choose_matching(replace(auto, matching="retrieval"), 5, is_video=True) == "retrieval"
    assert mappers_to_try(auto, 16) == ["incremental", "hybrid"]
    assert mappers_to_try(auto, 300) == ["incremental", "held-lens", "hybrid"]
    assert mappers_to_try(auto, 301) == ["hybrid", "incremental", "held-lens"]
    assert mappers_to_try(replace(auto, mapper="global"), 10) == ["global"]


@pytest.mark.parametrize("count", [3, 19, 20, 200])
def test_a_lens_that_is_not_named_has_one_focal_length_and_a_center_near_the_middle(count: int) -> None:
    """Photos from around an object fix neither a second focal length nor a center far off."""
    pycolmap = pytest.importorskip("pycolmap")
    photos = [replace(photo(f"{i}.jpg"), focal=3000.0) for i in range(count)]
    model = reader_options(pycolmap, photos, SfmConfig()).camera_model
    lens = pycolmap.Camera.create_from_model_name(0, model, 3000.0, 4000, 3000)
    assert len(lens.focal_length_idxs()) == 1
    assert off_center(lens) == 0
    lens.principal_point_y = 1500 + 0.2 * 3000
    assert off_center(lens) == pytest.approx(0.2)


def test_the_seed_is_the_best_connected_photos_and_leaves_pairs_without_depth_out() -> None:
    pairs = {(0, 1): 900, (1, 2): 400, (2, 3): 300, (4, 5): 800, (0, 5): 10}
    names = list(NAMES)
    assert sorted(seed_photos(graph(pairs, still=((0, 1),)), 2)) == names[4:]
    assert seed_photos(graph(pairs), 4) == [names[0], names[1], names[2], names[3]]
    assert set(seed_photos(graph(pairs), 16)) == set(names)
    assert seed_photos(graph({}), 3) == names[:3]


def test_neighbors_in_time_reach_over_short_gaps_and_far_ahead() -> None:
    pairs = set(neighbors_in_time([f"{i:03d}" for i in range(100)]))
    assert ("000", "010") in pairs
    assert ("000", "011") not in pairs
    assert ("000", "064") in pairs
    assert all(a < b for a, b in pairs)


def test_look_alikes_are_found_without_a_vocabulary_and_with_a_seed() -> None:
    """Four places, three photos each, whose features are those of the place and some of their own."""
    rng = np.random.default_rng(0)
    places = [rng.integers(0, 256, (300, 128), dtype=np.uint8) for _ in range(4)]
    own = [rng.integers(0, 256, (60, 128), dtype=np.uint8) for _ in range(12)]
    photos = [np.concatenate([places[i // 3], own[i]]) for i in range(12)]
    pairs = similar_pairs(photos, most=2, seed=0)
    assert pairs == {(i, j) for i in range(12) for j in range(i + 1, 12) if i // 3 == j // 3}
    assert similar_pairs(photos, most=2, seed=0) == pairs


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"mapper": "fast"}, "--mapper"),
        ({"matching": "none"}, "--matching"),
        ({"frames": 2}, "--frames"),
        ({"max_size": 10}, "--max-size"),
        ({"focal": 0.0}, "--focal"),
        ({"focal": 500.0, "poses": "prior"}, "Keep one: the prior has its own focal"),
    ],
)
def test_settings_that_make_no_sense_are_usage_errors(settings: dict[str, object], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        SfmConfig(**settings)  # type: ignore[arg-type]
