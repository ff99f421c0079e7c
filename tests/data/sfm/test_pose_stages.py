"""Stages of a search for poses: how many photos are enough, how a second look is taken, which points stay."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_answers import CHAIN, graph

from gsopt.data.sfm import few_photos, known_poses, mapping, pipeline, pose_search
from gsopt.data.sfm.features import ColmapProject
from gsopt.data.sfm.mapping import MappingResult
from gsopt.data.sfm.photo_agreement import Agreement
from gsopt.data.sfm.pose_search import FoundPoses, PoseSearch
from gsopt.data.sfm.settings import SfmConfig
from gsopt.data.sfm.stage_times import StageTimes
from gsopt.errors import InputError, UsageError


def search(work: Path, count: int, **settings: Any) -> PoseSearch:
    """A search for the poses of so many photos without masks."""
    inputs: Any = SimpleNamespace(kind="none", masks=None, photos=work)
    photos: Any = [SimpleNamespace(name=f"{i}.png") for i in range(count)]
    pycolmap: Any = SimpleNamespace()
    return PoseSearch(pycolmap, work, SfmConfig(**settings), photos, inputs, StageTimes(), lambda line: None)


@pytest.mark.parametrize("posed", [False, True])
def test_three_photos_are_enough_for_a_reconstruction(posed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    found = MappingResult(SimpleNamespace(), "found", [])
    monkeypatch.setattr(mapping, "find_poses", lambda *_: found)
    monkeypatch.setattr(known_poses, "triangulate", lambda *_: found.reconstruction)
    run = search(Path(), 5)
    for photos in range(5):
        view_graph = SimpleNamespace(features=dict.fromkeys(range(photos), 900))
        mapped = run._mapped(SimpleNamespace(), view_graph, [] if posed else None)  # type: ignore[arg-type]
        assert (mapped is not None) == (photos >= 3), photos


def rays(pycolmap: Any, angles: list[float], off: dict[int, float]) -> Any:
    """Three cameras in a row; for each angle a point, which the outer ones see so many degrees apart. `off`: px by
    which the first camera misses a point."""
    found = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=1000, height=1000, params=[1000.0, 500.0, 500.0, 0.0], camera_id=1
    )
    found.add_camera_with_trivial_rig(camera)
    depth = 0.5 / np.tan(np.radians(angles) / 2)
    points = np.stack([np.zeros(len(depth)), np.random.default_rng(0).uniform(-0.4, 0.4, len(depth)) * depth, depth], 1)
    for number, x in enumerate((-0.5, 0.0, 0.5), 1):
        center = np.array([x, 0.0, 0.0])
        pixels = 1000 * (points - center)[:, :2] / points[:, 2:] + 500
        if number == 1:
            pixels[list(off), 0] += list(off.values())
        image = pycolmap.Image(name=f"{number}.png", keypoints=pixels, camera_id=1, image_id=number)
        found.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(), -center))
    for row, point in enumerate(points):
        track = pycolmap.Track()
        for number in (1, 2, 3):
            track.add_element(number, row)
        found.add_point3D(point, track)
    return found


@pytest.mark.parametrize("off", [0.0, 1.0, 60.0])
def test_points_seen_from_one_side_or_far_from_their_pixels_are_left_out(off: float) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    sound = [5.0, 6, 7, 8, 9, 10, 12, 14, 16, 20] * 4
    flat = [1.0, 1.4] if off == 0 else []  # too close to one side
    angles = [*sound, 1.6, 2.4, 10.0, *flat]
    project: Any = SimpleNamespace(pycolmap=pycolmap, config=SfmConfig(focal=1000.0))
    model = rays(pycolmap, angles, off={len(sound) + 2: off})
    kept = mapping.bundle_adjusted(project, model)
    tracks = [kept.points3D[i + 1].track.length() if i + 1 in kept.points3D else 0 for i in range(len(angles))]
    assert tracks[: len(sound)] == [3] * len(sound)
    assert max(tracks[len(sound) + 3 :], default=0) == 0
    if off == 0:
        assert tracks[len(sound) :][:3] == [3, 3, 3]
    else:
        assert tracks[len(sound) + 2] == (3 if off < 4 else 2)
    assert all(point.error <= 4 for point in kept.points3D.values())


def test_a_second_look_is_thorough(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    looks: list[bool] = []

    def extract(project: Any, photos: list[Any], masks: Path | None, *, thorough: bool) -> None:
        looks.append(thorough)
        project.database.touch()

    monkeypatch.setattr(pose_search.features, "extract", extract)
    nothing = SimpleNamespace(matches=[], turntable=False, turning=None)
    monkeypatch.setattr(few_photos, "trust", lambda *_: 0)
    monkeypatch.setattr(few_photos, "match_few", lambda *_: nothing)
    monkeypatch.setattr(few_photos, "find_few_poses", lambda *_: (None, "another graph"))
    run = search(tmp_path, 0)
    first = FoundPoses(graph(CHAIN), None, "sift")
    found, look = run._few(run._project(tmp_path, "sift"), first)
    assert found == FoundPoses("another graph", None, "sift")  # type: ignore[arg-type]
    assert look is not None
    assert (look.hypotheses, look.lens, look.notes) == (nothing, None, [])
    assert looks == [True]


def second_look(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    trust: int,
    placed: tuple[int | None, int | None],
    misses: tuple[float | None, float | None] = (None, None),
) -> bool:
    """True where six photos are looked at twice and the second result is taken; photos placed and misses by look."""
    looks: list[Any] = [
        None if n is None else SimpleNamespace(names=[""] * n, reconstruction=row) for row, n in enumerate(placed)
    ]
    monkeypatch.setattr(pose_search.features, "extract", lambda project, *_, **__: project.database.touch())
    monkeypatch.setattr(pose_search, "outline_misses", lambda reconstruction, *_: misses[reconstruction])
    monkeypatch.setattr(few_photos, "trust", lambda *_: trust)
    monkeypatch.setattr(few_photos, "keep_confirmed", lambda _: None)
    monkeypatch.setattr(few_photos, "confirmed_points", lambda _: Counter({1: 150}))
    monkeypatch.setattr(few_photos, "match_few", lambda *_: SimpleNamespace(matches=[], turntable=True, turning=None))
    monkeypatch.setattr(few_photos, "find_few_poses", lambda *_: (looks[1], "another graph"))
    run = search(tmp_path, 6)
    first = FoundPoses("graph", looks[0], "both")  # type: ignore[arg-type]
    found: Any = run._few(run._project(tmp_path, "both"), first)[0]
    taken = bool(found.graph == "another graph")
    assert (found.graph, found.mapped) == (("another graph", looks[1]) if taken else ("graph", looks[0]))
    assert (found.features, len(found.notes)) == ("both", int(taken))
    return taken


@pytest.mark.parametrize(
    ("trust", "again", "taken"),
    [(100, None, False), (99, None, True), (100, 3, False), (100, 4, True), (149, 3, False), (149, 6, True)],
)
def test_a_second_look_must_place_as_many_photos_as_a_first_one_that_can_be_trusted(
    trust: int, again: int | None, taken: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert second_look(tmp_path, monkeypatch, trust, (4, again)) == taken


def test_poses_that_outlines_contradict_and_little_holds_do_not_stay(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert second_look(tmp_path, monkeypatch, 99, (4, None), (8.6, None))


@pytest.mark.parametrize(
    ("placed", "misses", "taken"),
    [
        ((6, 5), (1.99, 0.1), False),
        ((6, 5), (2.0, 1.9), True),
        ((6, 5), (2.0, 2.0), False),
        ((6, 6), (8.6, 2.5), True),
        ((6, None), (8.6, None), False),
        ((6, None), (1.0, None), False),
        ((4, 5), (8.6, 9.0), False),
        ((6, 5), (8.6, None), True),
        ((None, 3), (None, 9.0), True),
        ((None, None), (None, None), True),
    ],
)
def test_poses_that_the_outlines_contradict_are_replaced_by_those_they_contradict_less(
    placed: tuple[int | None, int | None],
    misses: tuple[float | None, float | None],
    taken: bool,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """However many points hold them."""
    assert second_look(tmp_path, monkeypatch, 0 if placed[0] is None else 500, placed, misses) == taken


@pytest.mark.parametrize(
    ("found", "repaired"), [([], False), ([5], False), ([4], True), ([5, 3], False), ([4, 3], True), ([3, 2], True)]
)
def test_the_largest_of_global_reconstructions_is_repaired_where_photos_are_missing(
    found: list[int], repaired: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    calls: list[list[Any]] = []
    models = [SimpleNamespace(count=count, num_reg_images=lambda count=count: count) for count in found]
    monkeypatch.setattr(mapping, "_global", lambda *_: list(models))
    monkeypatch.setattr(mapping, "keep_coherent", lambda model: None)
    monkeypatch.setattr(mapping, "registered", lambda model: {f"{i}.png" for i in range(model.count)})
    monkeypatch.setattr(mapping, "_repaired", lambda project, models, target: calls.append(models) or models)
    project: Any = SimpleNamespace(
        pycolmap=SimpleNamespace(set_random_seed=lambda seed: None), config=SfmConfig(), database=tmp_path / "a.db"
    )
    placed = mapping.run_mapper(project, "hybrid", SimpleNamespace(features=dict.fromkeys(range(5), 9)))  # type: ignore[arg-type]
    assert bool(calls) == repaired
    assert [model.count for model in placed] == [count for count in found if count >= 3]


@pytest.mark.parametrize(
    ("features", "nothing", "contradicted", "others_hold", "kept"),
    [
        ("auto", (), (), False, "both"),
        ("auto", (), (), True, "sift"),
        ("auto", (), ("both",), False, "sift"),
        ("auto", (), ("both", "sift"), True, None),
        ("auto", (), ("sift",), True, "both"),
        ("auto", ("sift",), ("both",), True, None),
        ("auto", ("both",), (), False, "sift"),
        ("auto", ("both",), ("sift",), False, None),
        ("both", (), ("both",), True, None),
        ("both", (), (), True, "both"),
        ("sift", (), ("sift",), True, None),
        ("sift", (), (), True, "sift"),
    ],
)
def test_sift_alone_replaces_poses_of_few_photos_that_the_photos_or_more_points_contradict(
    features: str,
    nothing: tuple[str, ...],
    contradicted: tuple[str, ...],
    others_hold: bool,
    kept: str | None,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """Features that the user has asked for are not replaced, and poses that the photos contradict are refused."""
    run = search(tmp_path, 6, features=features)
    monkeypatch.setattr(pose_search, "_learned_installed", lambda: True)
    monkeypatch.setattr(run, "_graph", lambda project, frames=None: f"graph of {project.config.features}")

    def mapped(project: ColmapProject, *_: object) -> Any:
        kind = project.config.features
        return None if kind in nothing else SimpleNamespace(reconstruction=kind, names=["a"] * 6)

    monkeypatch.setattr(run, "_mapped", mapped)
    monkeypatch.setattr(run, "_looked_thoroughly", lambda project, found: found)
    monkeypatch.setattr(pose_search, "_holds_others", lambda one, other: others_hold)
    monkeypatch.setattr(
        pose_search, "agreement", lambda reconstruction, photos: Agreement(9, 2 * (reconstruction in contradicted))
    )
    found = run.found(None)
    assert (found.mapped and found.mapped.reconstruction) == kept
    assert found.graph == f"graph of {kept or ('sift' if features == 'sift' else 'both')}"
    refuted = kept is None and "both" not in nothing
    assert ["2 of 9 times" in note for note in found.notes] == ([True] if refuted else [])


@pytest.mark.parametrize(
    ("turned", "more", "fewer", "holds"),
    [(0.0, True, False, False), (2.0, True, False, False), (6.0, True, False, True), (60.0, False, False, False),
     (60.0, True, True, False)],
)  # fmt: skip
def test_other_poses_of_as_many_photos_with_more_support_replace_the_first(
    turned: float, more: bool, fewer: bool, holds: bool
) -> None:
    pycolmap = pytest.importorskip("pycolmap")

    def result(step: float, points: int, photos: int) -> MappingResult:
        """Cameras that each turn by so many degrees from the one before."""
        found = pycolmap.Reconstruction()
        camera = pycolmap.Camera(model="PINHOLE", width=9, height=9, params=[9.0, 9.0, 4.5, 4.5], camera_id=1)
        found.add_camera_with_trivial_rig(camera)
        keypoints = np.full((points, 2), 4.5)
        for number in range(photos):
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, np.radians(step * number), 0.0])), np.zeros(3))
            image = pycolmap.Image(name=f"{number}.png", keypoints=keypoints, camera_id=1, image_id=number + 1)
            found.add_image_with_trivial_frame(image, pose)
        for row in range(points):
            track = pycolmap.Track()
            for number in (1, 2):
                track.add_element(number, row)
            found.points3D[found.add_point3D(np.array([0.0, 0.0, 5.0]), track)].error = 0.1
        return MappingResult(found, "found", [])

    first, second = result(20, 10, 4), result(20 + turned, 20 if more else 5, 3 if fewer else 4)
    assert pose_search._holds_others(second, first) == holds


@pytest.mark.parametrize("posed", [False, True])
def test_poses_that_are_given_are_not_looked_for(posed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither with learned features nor thoroughly, nor are they moved by silhouettes."""
    looked: list[str] = []
    run = search(tmp_path, 3)
    first = MappingResult(SimpleNamespace(), "found", [])
    stages: dict[str, Any] = {
        "_chosen_features": lambda: "sift",
        "_graph": lambda *_: graph(CHAIN),
        "_mapped": lambda *_: first,
        "_wants_learned": lambda mapped: True,
        "_with_learned": lambda found: looked.append("learned") or found,
        "_few": lambda project, found: (looked.append("few") or found, None),
        "_held": lambda project, found, mapped: looked.append("held") or found,
        "_agreement": lambda found: looked.append("agreement") or Agreement(0, 0),
        "_advised": lambda found: found,
    }
    for name, stage in stages.items():
        monkeypatch.setattr(run, name, stage)
    found = run.found([] if posed else None)
    assert (found.mapped, found.features, found.notes) == (first, "sift", [])
    assert looked == ([] if posed else ["learned", "few", "held", "agreement"])


@pytest.mark.parametrize(("read", "refused", "looked"), [(0, 2, False), (1, 0, False), (2, 0, True), (2, 1, True)])
def test_features_of_two_photos_are_compared_and_of_one_are_not(
    read: int, refused: int, looked: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The refusal of two names what they lack; one alone, or none that can be read, is refused at once."""
    run = pipeline._Run(SimpleNamespace(), Path(), tmp_path, SfmConfig(), lambda line: None)  # type: ignore[arg-type]
    monkeypatch.setattr(run, "_photos", lambda: (["photo"] * read, ["refused"] * refused))
    monkeypatch.setattr(run, "_prior_frames", lambda photos: None)
    monkeypatch.setattr(PoseSearch, "found", lambda self, frames: FoundPoses(graph(CHAIN), None, "sift", ["note"]))
    monkeypatch.setattr(pipeline, "prepare_masks", lambda *_: SimpleNamespace(photos=tmp_path))
    report = SimpleNamespace(advice=[])
    monkeypatch.setattr(pipeline.diagnosis, "explain", lambda *_: report)
    monkeypatch.setattr(pipeline, "too_few", lambda report, graph: InputError("alone" if graph is None else "compared"))
    with pytest.raises(InputError, match="compared" if looked else "alone"):
        run.posed()
    assert report.advice == (["note"] if looked else [])


def test_an_empty_folder_is_filled_and_another_one_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def child(source: Path, work: Path, *_: Any) -> tuple[None, dict[str, float]]:
        (work / pipeline.SCENE).mkdir()
        (work / pipeline.SCENE / "images.bin").touch()
        return None, {}

    monkeypatch.setattr(pipeline, "run_in_child", child)
    out = tmp_path / "out"
    out.mkdir()
    assert pipeline.pose_photos(tmp_path, out, SfmConfig()).path == out
    assert [path.name for path in out.iterdir()] == ["images.bin"]
    with pytest.raises(UsageError, match="must not exist yet"):
        pipeline.pose_photos(tmp_path, out, SfmConfig())


@pytest.mark.parametrize("grows", [True, False])
def test_a_repair_grows_the_largest_global_model_or_leaves_all(
    grows: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def model(count: int) -> Any:
        return SimpleNamespace(
            num_reg_images=lambda: count, write=lambda folder: (folder / "images.bin").write_text(str(count))
        )

    def incremental(project: Any, target: Path, start: Path) -> list[str]:
        assert target.is_dir()
        assert (start / "images.bin").read_text() == "5"
        return ["grown"] if grows else []

    monkeypatch.setattr(mapping, "_incremental", incremental)
    models = [model(3), model(5), model(4)]
    assert mapping._repaired(SimpleNamespace(), models, tmp_path) == (["grown"] if grows else models)  # type: ignore[arg-type]
