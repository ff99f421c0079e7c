"""Stages of a search for poses: how many photos are enough, how a second look is taken, which points stay."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_answers import CHAIN, graph

from gsopt.data.sfm import few_photos, known_poses, mapping, pipeline
from gsopt.data.sfm.features import ColmapProject
from gsopt.data.sfm.mapping import MappingResult
from gsopt.data.sfm.settings import SfmConfig
from gsopt.errors import InputError, UsageError


@pytest.mark.parametrize("posed", [False, True])
def test_three_photos_are_enough_for_a_reconstruction(posed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    found = MappingResult(SimpleNamespace(), "found", [])
    monkeypatch.setattr(mapping, "find_poses", lambda *_: found)
    monkeypatch.setattr(known_poses, "triangulate", lambda *_: found.reconstruction)
    run = pipeline._Run(SimpleNamespace(), Path(), Path(), SfmConfig(), print)  # type: ignore[arg-type]
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
    monkeypatch.setattr(
        pipeline.features, "extract", lambda project, photos, masks, thorough=False: looks.append(thorough)
    )
    nothing = SimpleNamespace(matches=[], turntable=False)
    monkeypatch.setattr(few_photos, "trust", lambda *_: 0)
    monkeypatch.setattr(few_photos, "match_few", lambda *_: nothing)
    monkeypatch.setattr(few_photos, "find_few_poses", lambda *_: (None, "another graph"))
    run = pipeline._Run(SimpleNamespace(), Path(), tmp_path, SfmConfig(), lambda line: None)  # type: ignore[arg-type]
    project: Any = ColmapProject(SimpleNamespace(), tmp_path / "database.db", tmp_path, SfmConfig())  # type: ignore[arg-type]
    inputs: Any = SimpleNamespace(kind="none", masks=None)
    assert run._few(project, [], inputs, graph(CHAIN), None) == ("another graph", None)
    assert looks == [True]


def second_look(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    trust: int,
    placed: tuple[int | None, int | None],
    misses: tuple[float | None, float | None] = (None, None),
) -> bool:
    """True where six photos are looked at twice and the second result is taken; photos placed and misses by look."""
    looks = [None if n is None else SimpleNamespace(names=[""] * n, reconstruction=row) for row, n in enumerate(placed)]
    monkeypatch.setattr(pipeline.features, "extract", lambda *_, **__: None)
    monkeypatch.setattr(pipeline, "outline_misses", lambda reconstruction, *_: misses[reconstruction])
    monkeypatch.setattr(few_photos, "trust", lambda *_: trust)
    monkeypatch.setattr(few_photos, "match_few", lambda *_: SimpleNamespace(matches=[], turntable=True))
    monkeypatch.setattr(few_photos, "find_few_poses", lambda *_: (looks[1], "another graph"))
    run = pipeline._Run(SimpleNamespace(), Path(), tmp_path, SfmConfig(), lambda line: None)  # type: ignore[arg-type]
    project: Any = ColmapProject(SimpleNamespace(), tmp_path / "database.db", tmp_path, SfmConfig())  # type: ignore[arg-type]
    inputs: Any = SimpleNamespace(kind="none", masks=None)
    found: Any = run._few(project, [None] * 6, inputs, "graph", looks[0])  # type: ignore[list-item, arg-type]
    taken = found[0] == "another graph"
    assert found == (("another graph", looks[1]) if taken else ("graph", looks[0]))
    assert len(run.notes) == int(taken)
    return taken


@pytest.mark.parametrize(
    ("trust", "again", "taken"),
    [(100, None, False), (99, None, True), (100, 4, False), (100, 5, True), (149, 3, False), (149, 6, True)],
)
def test_a_second_look_must_place_more_photos_than_a_first_one_that_can_be_trusted(
    trust: int, again: int | None, taken: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert second_look(tmp_path, monkeypatch, trust, (4, again)) == taken


@pytest.mark.parametrize(
    ("placed", "misses", "taken"),
    [
        ((6, 5), (1.99, 0.1), False),
        ((6, 5), (2.0, 1.9), True),
        ((6, 5), (2.0, 2.0), False),
        ((6, 6), (8.6, 2.5), True),
        ((6, None), (8.6, None), False),
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


@pytest.mark.parametrize("posed", [False, True])
def test_poses_that_are_given_are_not_looked_for(posed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither with learned features nor thoroughly, nor are they moved by silhouettes."""
    looked: list[str] = []

    def look(name: str) -> Any:
        return lambda *args: looked.append(name) or args[-2:]

    run = pipeline._Run(SimpleNamespace(), Path(), tmp_path, SfmConfig(), lambda line: None)  # type: ignore[arg-type]
    found = MappingResult(SimpleNamespace(), "found", [])
    stages: dict[str, Any] = {
        "_photos": lambda: ([1, 2, 3], []),
        "_prior_frames": lambda photos: [] if posed else None,
        "_chosen_features": lambda photos: "sift",
        "_graph": lambda *_: (graph(CHAIN), "exhaustive"),
        "_mapped": lambda *_: found,
        "_wants_learned": lambda *_: True,
        "_learned": look("learned"),
        "_is_few": lambda *_: True,
        "_few": look("few"),
        "_held": lambda project, mapped, inputs: looked.append("held") or mapped,
        "_diagnose": lambda *_: "diagnosis",
        "_placed": lambda *_: None,
        "_write": lambda *_, **__: tmp_path / "scene",
    }
    for name, stage in stages.items():
        monkeypatch.setattr(run, name, stage)
    monkeypatch.setattr(pipeline, "prepare_masks", lambda *_: SimpleNamespace(photos=tmp_path))
    assert run.posed() == (tmp_path / "scene", "diagnosis")
    assert looked == ([] if posed else ["learned", "few", "held"])


@pytest.mark.parametrize(("read", "refused", "looked"), [(0, 2, False), (1, 0, False), (2, 0, True), (2, 1, True)])
def test_features_of_two_photos_are_compared_and_of_one_are_not(
    read: int, refused: int, looked: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The refusal of two names what they lack; one alone, or none that can be read, is refused at once."""
    run = pipeline._Run(SimpleNamespace(), Path(), tmp_path, SfmConfig(), lambda line: None)  # type: ignore[arg-type]
    stages: dict[str, Any] = {
        "_photos": lambda: (["photo"] * read, ["refused"] * refused),
        "_prior_frames": lambda photos: None,
        "_chosen_features": lambda photos: "sift",
        "_graph": lambda *_: (graph(CHAIN), "exhaustive"),
        "_mapped": lambda *_: None,
        "_wants_learned": lambda *_: False,
        "_is_few": lambda *_: False,
    }
    for name, stage in stages.items():
        monkeypatch.setattr(run, name, stage)
    monkeypatch.setattr(pipeline, "prepare_masks", lambda *_: SimpleNamespace(photos=tmp_path))
    monkeypatch.setattr(pipeline.diagnosis, "explain", lambda *_: SimpleNamespace(advice=[]))
    monkeypatch.setattr(pipeline, "too_few", lambda report, graph: InputError("alone" if graph is None else "compared"))
    with pytest.raises(InputError, match="compared" if looked else "alone"):
        run.posed()


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
