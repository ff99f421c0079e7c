"""A run of structure from motion leaves a picture beside its scene, and a record of what it did."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_answers import CHAIN, NAMES, graph, photo

from gsopt.data.sfm import pipeline
from gsopt.data.sfm.mapping import MappingResult
from gsopt.data.sfm.masks import FeatureInput
from gsopt.data.sfm.photos import RejectedFile
from gsopt.data.sfm.placement import Similarity
from gsopt.data.sfm.pose_search import FoundPoses
from gsopt.data.sfm.settings import SfmConfig
from gsopt.errors import InputError, UsageError

PLACED = Similarity(2.0, np.diag([1.0, -1, -1]), np.array([1.0, 2, 3]))
INPUTS = FeatureInput(Path("photos"), None, "alpha", [])


def run(folder: Path, **settings: Any) -> pipeline._Run:
    colmap: Any = SimpleNamespace(__version__="4.2")
    return pipeline._Run(colmap, folder, folder, SfmConfig(**settings), lambda line: None)


def test_known_poses_stay_and_found_ones_are_placed_by_their_cameras_and_points(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "poses", lambda made: (["names"], "viewmats"))
    monkeypatch.setattr(pipeline, "points", lambda made: ("positions", "colors"))
    monkeypatch.setattr(pipeline, "place", lambda *given: given)
    mapped = MappingResult(None, "global", [])
    known: Any = []
    assert run(tmp_path)._placed(mapped, None) == ("viewmats", "positions")
    assert run(tmp_path)._placed(mapped, known).matrix.tolist() == np.eye(4).tolist()


def test_the_picture_and_the_record_lie_in_the_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The record has the settings that were used, the inputs they were used on, and how to take the placement back."""
    monkeypatch.setattr(pipeline, "poses", lambda made: (["a.jpg"], "viewmats"))
    monkeypatch.setattr(pipeline, "points", lambda made: ("positions", "colors"))
    monkeypatch.setattr(pipeline, "draw_scene", lambda *given: repr(given).encode())
    monkeypatch.setattr(pipeline, "write_scene", lambda *given: given[2] if given[5] else None)
    source, scene = tmp_path / "source", tmp_path / "scene"
    (source / "masks").mkdir(parents=True)
    scene.mkdir()
    (source / "a.jpg").write_bytes(b"12345")
    (source / "masks" / "a.png").write_bytes(b"123")
    report = pipeline.diagnosis.explain([photo("a.jpg")], [], None, {"a.jpg"})
    how = SfmConfig(features="both", seed=5)
    mapped = MappingResult(None, "global", [])
    one = run(source)
    one.work = scene
    one.times.seconds = {"photos": 1.23456, "writing": 2.0}
    one._write(report, mapped, INPUTS, how, "exhaustive", PLACED)
    assert (scene / pipeline.OVERVIEW).read_bytes() == repr(
        ("viewmats", ["a.jpg"], "positions", "colors", "1 of 1 photos placed")
    ).encode()
    record = json.loads((scene / pipeline.RECORD).read_text())
    assert (record["settings"]["features"], record["settings"]["seed"]) == ("both", 5)
    assert [stamp[:2] for stamp in record["fingerprint"] + record["mask_fingerprint"]] == [["a.jpg", 5], ["a.png", 3]]
    assert (record["pycolmap"], record["source"], record["matching"], record["masks"]) == (
        "4.2",
        str(source),
        "exhaustive",
        "alpha",
    )
    assert record["report"] == ["1 of 1 photos placed"]
    assert (record["given"], record["registered"]) == (1, ["a.jpg"])
    assert record["placed_from_found"] == {
        "scale": 2,
        "rotation": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
        "translation": [1, 2, 3],
    }
    assert record["seconds"] == {"photos": 1.23, "writing": 2}


def looked_for(
    monkeypatch: pytest.MonkeyPatch, folder: Path, read: int, refused: int, mapped: MappingResult | None
) -> tuple[pipeline._Run, list[Any]]:
    """A run on so many photos and broken files, for which this is found; and what it writes."""
    photos = [photo(name) for name in NAMES[:read]]
    files = [RejectedFile(f"broken{number}.jpg", "is empty") for number in range(refused)]
    written: list[Any] = []

    class Search:
        matching = "exhaustive"

        def __init__(self, *given: Any, video: bool) -> None:
            assert not video

        def found(self, frames: Any) -> FoundPoses:
            return FoundPoses(graph(CHAIN), mapped, "both", ["a note"])

    made = run(folder, features="auto")
    monkeypatch.setattr(made, "_photos", lambda: (photos, files))
    monkeypatch.setattr(made, "_placed", lambda *given: "placed")
    monkeypatch.setattr(made, "_diagnose", lambda *given: "diagnosis")
    monkeypatch.setattr(made, "_write", lambda *given: written.append(given))
    monkeypatch.setattr(pipeline, "PoseSearch", Search)
    monkeypatch.setattr(pipeline, "prepare_masks", lambda *given: INPUTS)
    return made, written


@pytest.mark.parametrize(("read", "refused"), [(2, 0), (3, 2)])
def test_a_scene_is_written_with_the_features_that_were_used(
    read: int, refused: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapped = MappingResult(None, "global", [])
    made, written = looked_for(monkeypatch, tmp_path, read, refused, mapped)
    assert made.posed() == "diagnosis"
    assert written == [("diagnosis", mapped, INPUTS, SfmConfig(features="both"), "exhaustive", "placed")]
    assert set(made.times.seconds) == {"photos", "writing"}


@pytest.mark.parametrize(("read", "refused", "looked"), [(1, 0, False), (1, 2, False), (0, 2, False), (2, 0, True)])
def test_what_cannot_be_posed_is_refused_with_its_reasons(
    read: int, refused: int, looked: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One photo, or nothing but broken files, are not looked at; a search that fails adds its notes."""
    made, written = looked_for(monkeypatch, tmp_path, read, refused, None)
    with pytest.raises(InputError) as caught:
        made.posed()
    assert ("a note" in str(caught.value)) == looked
    assert written == []
    if refused:
        assert "broken1.jpg" in str(caught.value)


def test_what_a_killed_run_left_beside_a_finished_scene_goes_when_the_scene_is_refused(tmp_path: Path) -> None:
    """It was killed after its last rename. The folder of a run that still works stays."""
    out = tmp_path / "scene"
    out.mkdir()
    (out / "sfm.json").write_text("{}")
    ended = subprocess.Popen(["true"])
    ended.wait()
    dead, living = (tmp_path / f".scene.{number}.tmp" for number in (ended.pid, os.getpid()))
    dead.mkdir()
    living.mkdir()
    with pytest.raises(UsageError, match="must not exist yet"):
        pipeline.pose_photos(tmp_path, out, SfmConfig())
    assert (dead.exists(), living.exists(), (out / "sfm.json").exists()) == (False, True, True)
