"""Poses for `gsopt train PHOTOS`: found only if there are none, and never twice for the same photos."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

from gsopt.data import files
from gsopt.data.scene import is_posed
from gsopt.data.sfm.photos import find_photos
from gsopt.data.sfm.settings import SfmConfig
from gsopt.data.sfm.video import is_video
from gsopt.errors import InputError
from gsopt.events import Report


def needs_poses(data: Path) -> bool:
    """True for a video or a folder of photos without poses; False for anything that `load_scene` reads or refuses."""
    if is_video(data):
        return data.is_file()
    if not data.is_dir() or is_posed(data):
        return False
    try:
        return bool(find_photos(data))
    except InputError:
        return False


def posed_scene(data: Path, folder: Path, config: SfmConfig, report: Report) -> Path:
    """FOLDER/<name>-posed with the poses of these photos: an earlier one when the photos are still the same."""
    stem = data.resolve().stem if is_video(data) else data.resolve().name
    names = (f"{stem}-posed" if number == 1 else f"{stem}-posed-{number}" for number in itertools.count(1))
    scene = next(free for free in map(folder.joinpath, names) if not free.exists() or made_from(free, data, config))
    if scene.exists():
        report(f"poses found earlier: {scene}")
        return scene
    from gsopt.data.sfm.pipeline import pose_photos

    report(f"{data} has no poses: looking for them (gsopt sfm)")
    posed = pose_photos(data, scene, config, report)
    for line in posed.diagnosis.lines():
        report(line)
    return scene


def made_from(scene: Path, data: Path, config: SfmConfig) -> bool:
    """True when the scene was made from these very files and masks, with features that `config` allows and its seed."""
    from gsopt.data.sfm.pipeline import RECORD, fingerprint, mask_fingerprint

    record = scene / RECORD
    if not files.is_regular(record) or not is_posed(scene):
        return False
    try:
        found = files.read_json(record)
        settings = found["settings"]
        same_features = config.features in ("auto", settings.get("features", "sift"))
        same = same_features and (settings["masks"], settings["seed"]) == (config.masks, config.seed)
        if not same or found["fingerprint"] != fingerprint(data):
            return False
        return bool(found.get("mask_fingerprint", []) == mask_fingerprint(config.masks, data))
    except (InputError, AttributeError, KeyError, TypeError, json.JSONDecodeError):
        return False
