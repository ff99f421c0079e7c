"""Which photos need poses, and when a scene that was made earlier is taken again, without COLMAP."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from PIL import Image

from gsopt.data.sfm import pipeline, reuse
from gsopt.data.sfm.reuse import made_from, needs_poses, posed_scene
from gsopt.data.sfm.settings import SfmConfig


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "chair"
    folder.mkdir()
    for name in "ab":
        Image.new("RGB", (64, 64)).save(folder / f"{name}.png")
    return folder


def test_photos_and_videos_without_poses_need_some(photos: Path, tmp_path: Path) -> None:
    assert needs_poses(photos)
    assert not needs_poses(photos / "a.png")
    assert not needs_poses(tmp_path / "gone")
    (tmp_path / "empty").mkdir()
    assert not needs_poses(tmp_path / "empty")
    film = tmp_path / "film.mp4"
    assert not needs_poses(film)
    film.touch()
    assert needs_poses(film)
    (photos / "transforms.json").write_text("{}")
    assert not needs_poses(photos)


def made(scene: Path, photos: Path, config: SfmConfig, **changed: Any) -> Path:
    """A scene with the record of these photos and settings, or another one."""
    scene.mkdir(exist_ok=True)
    (scene / "transforms.json").write_text("{}")
    settings = {"features": config.features, "masks": config.masks, "seed": config.seed, **changed.pop("settings", {})}
    record = {
        "settings": settings,
        "fingerprint": pipeline.fingerprint(photos),
        "mask_fingerprint": pipeline.mask_fingerprint(config.masks, photos),
        **changed,
    }
    (scene / "sfm.json").write_text(json.dumps({name: value for name, value in record.items() if value is not None}))
    return scene


@pytest.mark.parametrize(
    ("changed", "same"),
    [
        ({}, True),
        ({"settings": {"features": "both"}}, False),
        ({"settings": {"masks": "none"}}, False),
        ({"settings": {"seed": 7}}, False),
        ({"fingerprint": [["a.png", 1, 2]]}, False),
        ({"fingerprint": None}, False),
        ({"mask_fingerprint": [["a.png", 1, 2]]}, False),
        ({"mask_fingerprint": None}, True),
        ({"settings": None}, False),
    ],
)
def test_a_scene_is_taken_again_for_the_same_files_features_masks_and_seed(
    photos: Path, tmp_path: Path, changed: dict[str, Any], same: bool
) -> None:
    config = SfmConfig(features="sift")
    scene = tmp_path / "scene"
    if "settings" in changed and changed["settings"] is None:
        made(scene, photos, config)
        (scene / "sfm.json").write_text('{"settings": null}')
    else:
        made(scene, photos, config, **dict(changed))
    assert made_from(scene, photos, config) == same


def test_any_features_will_do_where_nobody_names_some_and_old_records_mean_sift(photos: Path, tmp_path: Path) -> None:
    both = made(tmp_path / "both", photos, SfmConfig(features="both"))
    assert made_from(both, photos, SfmConfig(features="auto"))
    old = made(tmp_path / "old", photos, SfmConfig(features="sift"))
    record = json.loads((old / "sfm.json").read_text())
    del record["settings"]["features"]
    (old / "sfm.json").write_text(json.dumps(record))
    assert made_from(old, photos, SfmConfig(features="sift"))
    assert not made_from(old, photos, SfmConfig(features="both"))


def test_a_scene_without_a_record_or_without_poses_or_with_a_broken_record_is_another(
    photos: Path, tmp_path: Path
) -> None:
    config = SfmConfig(features="sift")
    scene = made(tmp_path / "scene", photos, config)
    (scene / "transforms.json").unlink()
    assert not made_from(scene, photos, config)
    (scene / "transforms.json").write_text("{}")
    for broken in ("", "[]", "{}", "{"):
        (scene / "sfm.json").write_text(broken)
        assert not made_from(scene, photos, config)
    (scene / "sfm.json").unlink()
    assert not made_from(scene, photos, config)


def test_poses_are_sought_once_and_other_photos_get_a_number(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command tells what it does: the search and its report, or the earlier scene."""
    config, asked, told = SfmConfig(features="sift"), list[Path](), list[str]()

    def pose(data: Path, scene: Path, config: SfmConfig, report: Any) -> Any:
        asked.append(scene)
        made(scene, data, config)
        return SimpleNamespace(diagnosis=SimpleNamespace(lines=lambda: ["placed all"]))

    monkeypatch.setattr(pipeline, "pose_photos", pose)
    first = posed_scene(photos, tmp_path, config, told.append)
    assert first == tmp_path / "chair-posed"
    assert told == [f"{photos} has no poses: looking for them (gsopt sfm)", "placed all"]
    told.clear()
    assert posed_scene(photos, tmp_path, config, told.append) == first
    assert told == [f"poses found earlier: {first}"]
    for number in (2, 3):
        other = replace(config, seed=number)
        assert posed_scene(photos, tmp_path, other, told.append) == tmp_path / f"chair-posed-{number}"
    assert posed_scene(photos, tmp_path, replace(config, seed=2), told.append) == tmp_path / "chair-posed-2"
    assert asked == [tmp_path / f"chair-posed{end}" for end in ("", "-2", "-3")]


def test_the_scene_of_a_video_has_its_name_without_the_suffix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    film = tmp_path / "walk.2.mp4"
    film.touch()
    (tmp_path / "walk.2-posed").mkdir()
    monkeypatch.setattr(reuse, "made_from", lambda scene, data, config: True)
    assert posed_scene(film, tmp_path, SfmConfig(), lambda line: None) == tmp_path / "walk.2-posed"
