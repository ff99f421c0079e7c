"""Photos with masks as people take them: a background that moves, an object that the frame cuts off, a photo that does
not show it, two objects, masks of another size."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from balls import Ball, picture, ring
from PIL import Image
from test_mask_agreement import SIZE, photos
from tiny_scenes import tiny_config

from gsopt.config.train import DataConfig, InitConfig
from gsopt.data.scene import Scene, load_scene
from gsopt.init import first_gaussians
from gsopt.init.mask_repair import load_with_agreeing_masks
from gsopt.training.loop import train

pytestmark = pytest.mark.usefixtures("coarse_hull")

COUNT = 5
CUT = 1
"""The photo that cuts the object off, looks elsewhere, or whose mask lacks one of two objects."""
APART = [Ball((-0.55, 0, 0), 0.3), Ball((0.55, 0, 0.1), 0.3)]
"""Two objects."""


def test_a_background_that_moves_changes_no_bit_inside_masks(tmp_path: Path) -> None:
    """Passers-by stand outside the masks, others in every photo, and then others again."""
    data = photos(tmp_path / "data", COUNT)
    mask = tmp_path / "data" / "masks" / "train"
    for path in mask.iterdir():  # hard edges: no pixel is half background
        Image.open(path).point(lambda value: 255 if value == 255 else 0).save(path)
    before = trained(data, tmp_path / "before")
    for index in range(COUNT):
        path = tmp_path / "data" / "train" / f"r_{index}.png"
        photo, inside = np.array(Image.open(path)), np.array(Image.open(mask / path.name)) > 0
        passers_by = np.random.default_rng(7 + index).integers(0, 256, photo.shape, dtype=np.uint8)
        Image.fromarray(np.where(inside[..., None], photo, passers_by)).save(path)
    assert trained(data, tmp_path / "after") == before


def trained(data: DataConfig, run: Path) -> bytes:
    start = InitConfig(method="hull", count=200)
    train(tiny_config(Path(data.path), init=start, checkpoint_every=0, preview_every=0, iterations=20), run)
    return (run / "splat.ply").read_bytes()


def test_an_object_that_the_frame_cuts_off_is_not_carved_there(tmp_path: Path) -> None:
    """A photo says nothing about what lies beyond its frame: no mask is blamed, and the hull is whole."""
    whole = load_scene(photos(tmp_path / "whole", COUNT))
    config = photos(tmp_path / "cut", COUNT)
    shifted(tmp_path / "cut", [SIZE // 3, 0])
    scene, repaired = load_with_agreeing_masks(config)
    assert repaired == []
    solid = scene.train[CUT].pixels()[..., 3] > 127
    assert bool(solid[:, 0].any() | solid[:, -1].any()), "the frame must cut the object off"
    sizes = [hull_extent(one) for one in (whole, scene)]
    torch.testing.assert_close(sizes[0], sizes[1], rtol=0.12, atol=0)


def test_a_photo_that_does_not_show_the_object_carves_nothing_and_is_named(tmp_path: Path) -> None:
    whole = load_scene(photos(tmp_path / "whole", COUNT))
    config = photos(tmp_path / "away", COUNT)
    shifted(tmp_path / "away", [3 * SIZE, 0])
    scene, (found,) = load_with_agreeing_masks(config)
    assert (found.name, found.kind, found.repair) == (f"train/r_{CUT}.png", "empty", "cleared")
    assert not bool(scene.train[CUT].pixels()[..., 3].any()), "it still shows nothing"
    torch.testing.assert_close(hull_extent(scene), hull_extent(whole), rtol=0.12, atol=0)


def test_two_objects_that_all_masks_show_are_both_kept(tmp_path: Path) -> None:
    scene, repaired = load_with_agreeing_masks(photos(tmp_path, COUNT, balls=APART))
    assert repaired == []
    means = first_gaussians(scene, InitConfig(method="hull", count=2000), 0, 0)[0].means
    for ball in APART:
        assert int(((means - torch.tensor(ball.center)).norm(dim=1) < 1.3 * ball.radius).sum()) > 500


def test_a_mask_that_shows_one_of_two_objects_is_named_and_costs_neither(tmp_path: Path) -> None:
    config = photos(tmp_path, COUNT, balls=APART)
    one = picture(ring(COUNT)[CUT], APART[:1])[..., 3].astype(np.uint8)
    Image.fromarray(one).save(tmp_path / "masks" / "train" / f"r_{CUT}.png")
    scene, (found,) = load_with_agreeing_masks(config)
    assert (found.name, found.kind) == (f"train/r_{CUT}.png", "lost")
    both = torch.from_numpy(picture(ring(COUNT)[CUT], APART)[..., 3].copy()) > 127
    kept = scene.train[CUT].pixels()[..., 3] > 127
    assert float((both & kept).sum()) > 0.9 * float(both.sum())


def test_masks_of_another_size_and_the_same_aspect_are_scaled(tmp_path: Path) -> None:
    whole = load_scene(photos(tmp_path / "whole", COUNT))
    config = photos(tmp_path / "half", COUNT)
    for path in (tmp_path / "half" / "masks" / "train").iterdir():
        Image.open(path).resize((SIZE // 2, SIZE // 2), Image.Resampling.BOX).save(path)
    scene, repaired = load_with_agreeing_masks(config)
    assert repaired == []
    assert scene.train[0].pixels().shape == (SIZE, SIZE, 4)
    torch.testing.assert_close(hull_extent(scene), hull_extent(whole), rtol=0.06, atol=0)


def shifted(root: Path, by: list[int]) -> None:
    """Photo CUT by a camera whose frame is moved by so many pixels: the principal point of that frame says so."""
    document = json.loads((root / "transforms_train.json").read_text())
    focal = SIZE / 2 / np.tan(document["camera_angle_x"] / 2)
    for row, frame in enumerate(document["frames"]):
        center = [SIZE / 2 - (by[axis] if row == CUT else 0) for axis in (0, 1)]
        frame |= {"fl_x": focal, "fl_y": focal, "cx": center[0], "cy": center[1], "w": SIZE, "h": SIZE}
        frame["file_path"] = frame["file_path"] + ".png"
    (root / "transforms_train.json").unlink()
    (root / "transforms.json").write_text(json.dumps({"frames": document["frames"]}))
    for folder, paint in (("train", (20, 150, 60)), ("masks/train", 0)):
        path = root / folder / f"r_{CUT}.png"
        photo = Image.open(path)
        moved = Image.new(photo.mode, photo.size, paint)
        moved.paste(photo, (-by[0], -by[1]))
        moved.save(path)


def hull_extent(scene: Scene) -> torch.Tensor:
    """Size of the box of points on the hull."""
    means = first_gaussians(scene, InitConfig(method="hull", count=2000), 0, 0)[0].means
    return means.quantile(0.98, dim=0) - means.quantile(0.02, dim=0)
