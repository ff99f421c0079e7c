"""Masks by a network, for photos with and without poses (`gsopt masks`, `--masks auto`).

A network that sees a whole photo often takes the plinth for a part of the object; shown the object alone, it does not.
So a photo whose mask disagrees with the others is looked at again, cropped to where the agreeing ones say that the
object is, until all agree; without poses each photo is looked at again around its own mask.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from PIL import Image

from gsopt.config.train import DataConfig
from gsopt.data import files
from gsopt.data.images import read_gray, read_header, read_pixels
from gsopt.data.mask_network import MaskNetwork, find_model
from gsopt.data.masks import FOLDER
from gsopt.data.posed_images import PosedImage
from gsopt.data.scene import Scene, is_posed, load_scene, read_dataset
from gsopt.data.sfm.photos import find_photos, read_photos
from gsopt.data.sfm.reuse import needs_poses
from gsopt.data.sfm.video import is_video
from gsopt.data.split import split
from gsopt.data.working_folder import working_folder
from gsopt.errors import InputError, UsageError
from gsopt.events import Report, to_json, write_atomic
from gsopt.geometry.farthest_points import farthest_points
from gsopt.geometry.focus import find_focus
from gsopt.init.mask_agreement import mask_agreement
from gsopt.init.mask_repair import MAX_CHECKED
from gsopt.init.object_box import Box, area, box_around, box_of_points, object_points, overlap
from gsopt.init.thumbnails import small_photos

RECORD = "masks.json"
RECORD_VERSION = 1
MAX_ROUNDS = 3
"""Most looks at a crop."""
SAME_BOX = 0.9
"""Overlap (intersection over union) of two crops from which on the second is not looked at."""
NO_ALPHA = (".jpg", ".jpeg")
"""Endings of photos that cannot be masked themselves."""
WHOLE = 0.8
"""Share of a photo from which on a crop shows nothing new."""


@dataclass(frozen=True)
class MaskedPhoto:
    """One photo and its mask in the making."""

    name: str
    path: Path
    mask: Path


@dataclass(frozen=True)
class MaskFolder:
    """The masks that were written."""

    path: Path
    count: int
    empty: list[str] = field(default_factory=list)
    """Photos in which the network found nothing."""
    disagreeing: list[str] = field(default_factory=list)
    """Photos whose mask disagrees with the others."""
    checked: bool = False
    """True when poses were known and a majority of the masks agreed."""

    def lines(self) -> list[str]:
        """The report as text."""
        state = "checked against each other" if self.checked else "not checked: that takes poses and 3 that agree"
        lines = [f"{self.count} masks in {self.path} ({state})"]
        lines += [f"  empty: {name}: the model found no object. Take it again, or remove it." for name in self.empty]
        return lines + [f"  {name} disagrees with the others; training repairs it." for name in self.disagreeing]


def cut_out(data: DataConfig, out: Path | None, network: MaskNetwork, report: Report = lambda line: None) -> MaskFolder:
    """Write a soft mask for every photo (posed or not) that `data` chooses to `out`, by default its folder masks/.
    Held-out photos change no mask of an input view, whatever they show.

    Raises UsageError when `out` holds something, InputError for photos that cannot be read. `out` appears when it is
    complete.
    """
    out = (Path(data.path) / FOLDER if out is None else out).expanduser().absolute()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"`--out` must not exist yet, got {out}. Choose another name, or remove it first.")
    with working_folder(out) as work:
        photos = _photos(data, work)
        for number, photo in enumerate(photos, 1):
            _write(photo, network.probabilities(_colors(photo)))
            report(f"mask {number} of {len(photos)}: {photo.name}")
        disagreeing = _look_closer(data, photos, network, work, report)
        made = _finished(photos, disagreeing, out, network, data, work)
        if out.is_dir():
            out.rmdir()
        os.replace(work / FOLDER, out)
    return made


def _photos(data: DataConfig, work: Path) -> list[MaskedPhoto]:
    """The images of a dataset as they are stored, or photos turned upright as `gsopt sfm` turns them."""
    (work / FOLDER).mkdir()
    source = Path(data.path)
    if not is_posed(source):
        read, refused = read_photos(find_photos(source), work)
        if not read:
            raise InputError(f"{source} holds no photo that can be used: {refused[0].name}: {refused[0].reason}.")
        return [MaskedPhoto(photo.source.name, photo.path, _mask_path(work, photo.source.name)) for photo in read]
    photos = [MaskedPhoto(frame.name, frame.path, _mask_path(work, frame.name)) for frame in _frames(data)]
    if len({photo.mask for photo in photos}) < len(photos):
        raise InputError(f"{source} has images that differ by suffix or folder alone. Rename them.")
    return photos


def _frames(data: DataConfig) -> list[PosedImage]:
    """The chosen input views and the held-out ones of a dataset."""
    train, test = split(read_dataset(Path(data.path)), data)
    return [*train, *test]


def _mask_path(work: Path, name: str) -> Path:
    parts = PurePosixPath(name).parts
    inner = parts[-1:] if PurePosixPath(name).is_absolute() or ".." in parts else parts
    inner = inner[1:] if inner[0] in ("images", "image") and len(inner) > 1 else inner
    return work.joinpath(FOLDER, *inner).with_suffix(".png")


def _colors(photo: MaskedPhoto) -> Any:
    return read_pixels(photo.path)[..., :3].numpy()


def _write(photo: MaskedPhoto, probabilities: Float32[np.ndarray, "H W"]) -> None:
    photo.mask.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((probabilities * 255 + 0.5).astype(np.uint8)).save(photo.mask)


def _look_closer(
    data: DataConfig, photos: list[MaskedPhoto], network: MaskNetwork, work: Path, report: Report
) -> list[str] | None:
    """Run the network on crops until they stay where they are; returns the photos whose masks still disagree, None
    where they cannot be checked."""
    seen: dict[str, Box] = {}
    for _ in range(MAX_ROUNDS):
        disagreeing, boxes = _boxes(data, photos, work)
        moved = [photo for photo in photos if _is_new(photo, boxes.get(photo.name), seen.get(photo.name))]
        if not moved:
            return disagreeing
        report(f"looking closer at {len(moved)} photos")
        for photo in moved:
            seen[photo.name] = boxes[photo.name]
            _write(photo, _cropped(photo, boxes[photo.name], network))
    return _boxes(data, photos, work)[0]


def _is_new(photo: MaskedPhoto, box: Box | None, before: Box | None) -> bool:
    """True for a crop worth a look."""
    if box is None or (before is not None and overlap(box, before) > SAME_BOX):
        return False
    width, height, _ = read_header(photo.path)
    return area(box) < WHOLE * width * height


def _cropped(photo: MaskedPhoto, box: Box, network: MaskNetwork) -> Float32[np.ndarray, "H W"]:
    """The probabilities of a crop, 0 around it."""
    left, top, right, bottom = box
    colors = _colors(photo)
    whole = np.zeros(colors.shape[:2], np.float32)
    whole[top:bottom, left:right] = network.probabilities(colors[top:bottom, left:right])
    return whole


def _boxes(data: DataConfig, photos: list[MaskedPhoto], work: Path) -> tuple[list[str] | None, dict[str, Box]]:
    """Photos whose masks disagree so far, None where that is not known, and the boxes to look at: where the agreeing
    masks say that the others show the object, else around each mask."""
    found = _agreed(data, work) if is_posed(Path(data.path)) else None
    if found is not None:
        return found
    boxes = {}
    for photo in photos:
        width, height, _ = read_header(photo.path)
        box = box_around(read_gray(photo.mask, (width, height)) > 127, width, height)
        if box is not None:
            boxes[photo.name] = box
    return None, boxes


def _agreed(data: DataConfig, work: Path) -> tuple[list[str], dict[str, Box]] | None:
    """Input views that disagree, and boxes for all photos that do not agree; Returns None where the masks of the input
    views agree on nothing."""
    scene = load_scene(replace(data, masks=str(work / FOLDER), downscale=1, depth=None, cache_mb=0))
    rows = list(range(len(scene.train)))
    if len(rows) > MAX_CHECKED:
        rows = sorted(farthest_points(torch.cat([view.camera.centers for view in scene.train]), MAX_CHECKED))
    photos = small_photos([scene.train[row] for row in rows], MAX_CHECKED)
    focus = find_focus([photo.camera for photo in photos], scene.extent)
    agreement = mask_agreement(photos, focus)
    if agreement is None:
        return None
    points = object_points([photos[row] for row in agreement.agreeing], focus)
    right = {rows[row] for row in agreement.agreeing}
    boxes = {}
    for row, view in enumerate([*scene.train, *scene.test]):
        box = box_of_points(view.camera, points)
        if row not in right and box is not None:
            boxes[view.name] = box
    return [scene.train[rows[row]].name for row in agreement.disagreeing], boxes


def _finished(
    photos: list[MaskedPhoto],
    disagreeing: list[str] | None,
    out: Path,
    network: MaskNetwork,
    data: DataConfig,
    work: Path,
) -> MaskFolder:
    """The report, also written beside the masks."""
    empty = [photo.name for photo in photos if np.asarray(Image.open(photo.mask, formats=("PNG",))).max() <= 127]
    other = [name for name in disagreeing or [] if name not in empty]
    made = MaskFolder(out, len(photos), empty, other, disagreeing is not None)
    record = {
        "version": RECORD_VERSION,
        "model": network.path.name,
        "fingerprint": fingerprint(data, network.path),
        "report": made.lines(),
        "empty": made.empty,
        "disagreeing": made.disagreeing,
    }
    write_atomic(work / FOLDER / RECORD, to_json(record))
    return made


def fingerprint(data: DataConfig, model: Path) -> list[Any]:
    """The model's digest, then name, size and time of each photo, input views first: other masks come of others."""
    source = Path(data.path)
    digest = sha256(model.read_bytes()).hexdigest()
    if not is_posed(source):
        return [digest, *map(_stamp, find_photos(source))]
    train, test = split(read_dataset(source), data)
    return [digest, *(_stamp(frame.path) for frame in train), *(["held out", *_stamp(frame.path)] for frame in test)]


def _stamp(path: Path) -> list[Any]:
    return [path.name, path.stat().st_size, path.stat().st_mtime_ns]


def made_from(folder: Path, data: DataConfig, model: Path) -> bool:
    """True when the masks in `folder` were made by this model from these very photos, and the same ones held out."""
    record = folder / RECORD
    try:
        return files.is_regular(record) and files.read_json(record)["fingerprint"] == fingerprint(data, model)
    except (InputError, KeyError):
        return False


def with_made_masks(config: DataConfig, folder: Path, report: Report) -> DataConfig:
    """The data with the masks it comes with, or else with masks made by a network in `folder` (`--masks auto`)."""
    given = replace(config, masks="given")
    if has_masks(load_scene(given)):
        report("masks: those of the dataset")
        return given
    source, network = Path(config.path), MaskNetwork.open(find_model(config.mask_model))
    number = 1
    while (out := folder / f"{source.name}-masks{'' if number == 1 else f'-{number}'}").exists():
        if made_from(out, config, network.path):
            report(f"masks made earlier: {out}")
            return replace(config, masks=str(out))
        number += 1
    for line in cut_out(config, out, network, report).lines():
        report(line)
    return replace(config, masks=str(out))


def require_mask_model(config: DataConfig) -> None:
    """MissingDependency where `--masks auto` will need a network and none is here: before poses are sought, which takes
    minutes."""
    photos = Path(config.path)
    if config.masks == "auto" and needs_poses(photos) and not may_bring_masks(photos):
        find_model(config.mask_model)


def may_bring_masks(photos: Path) -> bool:
    """False for a video and for a folder of JPEG files, which have no alpha, without masks beside them."""
    if is_video(photos):
        return False
    return (photos / FOLDER).is_dir() or any(path.suffix.lower() not in NO_ALPHA for path in find_photos(photos))


def has_masks(scene: Scene) -> bool:
    """True when most input views have alpha; the others are repaired in training."""
    masked = sum(view.pixels().shape[2] == 4 for view in scene.train)
    return 2 * masked > len(scene.train)
