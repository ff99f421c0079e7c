"""Poses are looked for once: which inputs need them, and which earlier scene is taken again."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gsopt.data.sfm import pipeline
from gsopt.data.sfm.reuse import made_from, needs_poses, posed_scene
from gsopt.data.sfm.settings import SfmConfig

CONFIG = SfmConfig(features="sift", seed=3)


def photos(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "a.jpg").write_bytes(b"photo")
    return folder


def scene_of(data: Path, scene: Path, config: SfmConfig = CONFIG, **record: Any) -> Path:
    """A posed scene with the record of a run on these photos."""
    scene.mkdir(parents=True)
    (scene / "transforms.json").write_text("{}")
    settings = {"masks": config.masks, "seed": config.seed, "features": config.features}
    masks = pipeline.mask_fingerprint(config.masks, data)
    found = {"settings": settings, "fingerprint": pipeline.fingerprint(data), "mask_fingerprint": masks, **record}
    (scene / pipeline.RECORD).write_text(json.dumps(found))
    return scene


def test_photos_and_videos_need_poses_and_nothing_else_does(tmp_path: Path) -> None:
    (tmp_path / "film.mp4").write_bytes(b"film")
    (tmp_path / "splat.ply").write_bytes(b"ply")
    (tmp_path / "folder.mp4").mkdir()
    (tmp_path / "empty").mkdir()
    (photos(tmp_path / "posed") / "transforms.json").write_text("{}")
    photos(tmp_path / "below" / "images")
    photos(tmp_path / "plain")
    needing = ("film.mp4", "plain", "below")
    for name in (*needing, "splat.ply", "folder.mp4", "empty", "posed", "absent", "absent.mp4"):
        assert needs_poses(tmp_path / name) == (name in needing), name


def test_a_scene_of_the_same_photos_masks_features_and_seed_is_taken_again(tmp_path: Path) -> None:
    data = photos(tmp_path / "box")
    scene = scene_of(data, tmp_path / "scene")
    assert made_from(scene, data, CONFIG)
    assert made_from(scene, data, replace(CONFIG, features="auto"))
    for other in ({"features": "both"}, {"masks": "none"}, {"seed": 4}):
        assert not made_from(scene, data, replace(CONFIG, **other)), other


def test_a_scene_of_changed_photos_or_masks_is_not_taken_again(tmp_path: Path) -> None:
    data = photos(tmp_path / "box")
    scene = scene_of(data, tmp_path / "scene")
    (data / "masks").mkdir()
    assert made_from(scene, data, CONFIG)
    (data / "masks" / "a.png").write_bytes(b"mask")
    assert not made_from(scene, data, CONFIG)
    masked = scene_of(data, tmp_path / "masked")
    assert made_from(masked, data, CONFIG)
    (data / "b.jpg").write_bytes(b"another")
    assert not made_from(masked, data, CONFIG)
    (data / "b.jpg").unlink()
    assert made_from(masked, data, CONFIG)
    os.utime(data / "a.jpg", ns=(1, 1))
    assert not made_from(masked, data, CONFIG)


def test_a_record_from_before_there_were_learned_features_is_one_of_sift_without_masks(tmp_path: Path) -> None:
    data = photos(tmp_path / "box")
    scene = scene_of(data, tmp_path / "scene")
    record = json.loads((scene / pipeline.RECORD).read_text())
    del record["settings"]["features"], record["mask_fingerprint"]
    (scene / pipeline.RECORD).write_text(json.dumps(record))
    assert made_from(scene, data, CONFIG)
    assert not made_from(scene, data, replace(CONFIG, features="xfeat"))


@pytest.mark.parametrize("text", ["", "not JSON", "[]", "{}", '{"settings": 1}', '{"settings": {"features": "sift"}}'])
def test_a_folder_without_poses_or_without_a_readable_record_is_not_taken(tmp_path: Path, text: str) -> None:
    data = photos(tmp_path / "box")
    broken, bare, unposed = (scene_of(data, tmp_path / name) for name in ("broken", "bare", "unposed"))
    (broken / pipeline.RECORD).write_text(text)
    (bare / pipeline.RECORD).unlink()
    (unposed / "transforms.json").unlink()
    assert [made_from(scene, data, CONFIG) for scene in (broken, bare, unposed)] == [False] * 3


@pytest.mark.parametrize(
    ("name", "stem"), [("box", "box"), ("box.v2", "box.v2"), ("film.mp4", "film"), ("a.b.mov", "a.b")]
)
def test_poses_are_written_beside_the_first_scenes_that_are_of_something_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, stem: str
) -> None:
    """The user reads why, and the diagnosis; the next run takes what is there."""
    data, folder = tmp_path / name, tmp_path / "runs"
    if data.suffix in (".mp4", ".mov"):
        data.write_bytes(b"film")
    else:
        photos(data)
    asked: list[Any] = []

    def pose(*given: Any) -> Any:
        asked.append(given)
        scene_of(given[0], given[1])
        return SimpleNamespace(diagnosis=SimpleNamespace(lines=lambda: ["all placed", "3 weak"]))

    monkeypatch.setattr(pipeline, "pose_photos", pose)
    for number in range(1, 4):
        said: list[str] = []
        want = folder / (f"{stem}-posed" if number == 1 else f"{stem}-posed-{number}")
        assert posed_scene(data, folder, CONFIG, said.append) == want
        assert asked.pop() == (data, want, CONFIG, said.append)
        assert said == [f"{data} has no poses: looking for them (gsopt sfm)", "all placed", "3 weak"]
        said.clear()
        assert posed_scene(data, folder, CONFIG, said.append) == want
        assert (asked, said) == ([], [f"poses found earlier: {want}"])
        (want / pipeline.RECORD).unlink()
