"""Masks checked against each other: right ones stay as they are, a wrong one is found, named and repaired."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from balls import Ball, picture, ring, write_balls
from PIL import Image

from gsopt.config.train import DataConfig
from gsopt.data.scene import Scene, load_scene
from gsopt.geometry.focus import find_focus
from gsopt.init.mask_agreement import Agreement, mask_agreement
from gsopt.init.mask_parts import cleaned, labels
from gsopt.init.mask_repair import load_with_agreeing_masks
from gsopt.init.thumbnails import small_photos

pytestmark = pytest.mark.usefixtures("coarse_hull")

BALLS = [Ball((0.0, 0, 0), 0.5), Ball((0.3, 0.1, 0.45), 0.25), Ball((-0.35, -0.2, -0.2), 0.3)]
SIZE = 96
WRONG = 2
"""The view whose mask is broken."""


def empty(mask: np.ndarray) -> None:
    mask[:] = 0


def full(mask: np.ndarray) -> None:
    mask[:] = 255


def plinth(mask: np.ndarray) -> None:
    mask[72:, 8:88] = 255


def half(mask: np.ndarray) -> None:
    mask[:48] = 0


BREAKS = {"empty": empty, "full": full, "plinth": plinth, "half": half}
KINDS = {"empty": "empty", "full": "too large", "plinth": "too large", "half": "lost"}


def photos(root: Path, count: int, broken: str = "", balls: list[Ball] = BALLS) -> DataConfig:
    """Opaque photos of brown balls before green, with masks of which one may be broken."""
    write_balls(root, balls, ring(count))
    for index in range(count):
        drawn = picture(ring(count)[index], balls).astype(float)
        noise = np.random.default_rng(index).integers(0, 40, (SIZE, SIZE, 3))
        alpha = drawn[..., 3:] / 255
        colors = alpha * drawn[..., :3] + (1 - alpha) * (np.array([20, 150, 60]) + noise)
        Image.fromarray(colors.astype(np.uint8)).save(root / "train" / f"r_{index}.png")
        mask = drawn[..., 3].astype(np.uint8)
        if broken and index == WRONG:
            BREAKS[broken](mask)
        (root / "masks" / "train").mkdir(parents=True, exist_ok=True)
        Image.fromarray(mask).save(root / "masks" / "train" / f"r_{index}.png")
    return DataConfig(path=str(root))


def agreement(scene: Scene) -> Agreement:
    shown = small_photos(scene.train, 32)
    found = mask_agreement(shown, find_focus([photo.camera for photo in shown], scene.extent))
    assert found is not None
    return found


@pytest.mark.parametrize("count", [3, 4, 8])
def test_right_masks_agree_and_the_scene_keeps_its_bits(tmp_path: Path, count: int) -> None:
    config = photos(tmp_path, count)
    before = load_scene(config)
    assert agreement(before).disagreeing == []
    assert min(agreement(before).covered) > 0.99
    scene, repaired = load_with_agreeing_masks(config)
    assert repaired == []
    for a, b in zip(before.train, scene.train, strict=True):
        assert torch.equal(a.pixels(), b.pixels())


@pytest.mark.parametrize("count", [4, 6, 8])
@pytest.mark.parametrize("broken", list(BREAKS))
def test_a_wrong_mask_is_found_and_its_neighbors_are_not_blamed(tmp_path: Path, count: int, broken: str) -> None:
    assert agreement(load_scene(photos(tmp_path, count, broken))).disagreeing == [WRONG]


@pytest.mark.parametrize("broken", list(BREAKS))
def test_a_wrong_mask_is_repaired_and_named(tmp_path: Path, broken: str) -> None:
    config = photos(tmp_path, 6, broken)
    scene, (repaired,) = load_with_agreeing_masks(config)
    assert repaired.name == f"train/r_{WRONG}.png"
    assert repaired.kind == KINDS[broken]
    assert repaired.repair == "colors"
    assert repaired.name in repaired.about
    assert json.dumps(repaired.to_dict())
    true = torch.from_numpy(picture(ring(6)[WRONG], BALLS)[..., 3].copy()) > 127
    found = scene.train[WRONG].pixels()[..., 3] > 127
    assert float((true & found).sum() / (true | found).sum()) > 0.95
    assert agreement(scene).disagreeing == []


def test_colors_that_a_wrong_mask_hid_come_back_at_a_lower_resolution(tmp_path: Path) -> None:
    """Downscaling loses what alpha 0 hides: the repaired view must read its photo again."""
    whole, _ = load_with_agreeing_masks(DataConfig(path=photos(tmp_path / "a", 4).path, downscale=2))
    mended, repaired = load_with_agreeing_masks(DataConfig(path=photos(tmp_path / "b", 4, "empty").path, downscale=2))
    assert len(repaired) == 1
    middle = SIZE // 4
    expected, got = (scene.train[WRONG].pixels()[middle, middle, :3].int() for scene in (whole, mended))
    assert int((expected - got).abs().max()) <= 3


def test_a_photo_without_mask_among_masked_ones_gets_one(tmp_path: Path) -> None:
    config = photos(tmp_path, 5)
    (tmp_path / "masks" / "train" / f"r_{WRONG}.png").unlink()
    scene, (repaired,) = load_with_agreeing_masks(config)
    assert repaired.kind == "missing"
    assert scene.has_alpha


def test_where_colors_tell_nothing_the_hull_of_the_others_is_taken(tmp_path: Path) -> None:
    """A gray thing before the same gray: the projected hull carves nothing away."""
    config = photos(tmp_path, 6, "empty")
    for path in (tmp_path / "train").iterdir():
        Image.new("RGB", (SIZE, SIZE), (128, 128, 128)).save(path)
    scene, (repaired,) = load_with_agreeing_masks(config)
    assert repaired.repair == "hull"
    assert agreement(scene).disagreeing == []


def test_masks_that_agree_on_nothing_are_left_alone(tmp_path: Path) -> None:
    config = photos(tmp_path, 4)
    for index in range(4):  # four corners that no thing can fill
        mask = np.zeros((SIZE, SIZE), np.uint8)
        mask[5:15, 5:15] = 255 if index % 2 else 0
        mask[-15:-5, -15:-5] = 0 if index % 2 else 255
        Image.fromarray(mask).save(tmp_path / "masks" / "train" / f"r_{index}.png")
    assert load_with_agreeing_masks(config)[1] == []


def test_the_largest_part_stays_and_small_holes_are_filled() -> None:
    mask = torch.zeros(40, 60, dtype=torch.bool)
    mask[5:30, 5:40] = True
    mask[10:12, 10:12] = False  # a small hole
    mask[15:25, 20:35] = False  # a large one, as in a handle
    mask[2:8, 50:58] = True  # another thing
    expected = mask.clone()
    expected[10:12, 10:12] = True
    expected[2:8, 50:58] = False
    assert torch.equal(cleaned(mask), expected)


@pytest.mark.parametrize("value", [False, True])
def test_a_mask_of_one_value_has_no_parts_to_drop(value: bool) -> None:
    mask = torch.full((5, 7), value)
    assert torch.equal(cleaned(mask), mask)
    assert int(labels(mask).max()) == int(value)


def test_a_ray_is_as_thick_as_its_way_through_the_hull(tmp_path: Path) -> None:
    """The hull of a ball from many sides: the chord of each pixel's ray, over the mean of the chords."""
    root = write_balls(tmp_path, [Ball((0.0, 0, 0), 0.6)], ring(10, size=SIZE))
    found = agreement(load_scene(DataConfig(path=str(root))))
    thick = found.thickness(0)
    camera = found.photos[0].camera
    row, column = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    offset = torch.hypot(row + 0.5 - camera.height / 2, column + 0.5 - camera.width / 2) / float(camera.Ks[0, 0, 0])
    chord = 2 * (0.6**2 - (4.0 * offset) ** 2).clamp_min(0).sqrt()
    expected = chord / chord[chord > 0].mean()
    assert float((thick - expected).abs()[chord > 0].mean()) < 0.3  # a hull of nine views, by a pixel's reach wider
    assert float(thick[offset > 0.8 / 4].abs().max()) == 0


@pytest.mark.parametrize(("count", "shade"), [(4, 255), (6, 128), (6, 127)])
def test_a_piece_beside_the_object_is_cut_off_and_named(tmp_path: Path, count: int, shade: int) -> None:
    """It is too small for its mask to disagree. All else of that mask, and the others, keep their bits. A faint one
    needs no word."""
    config = photos(tmp_path, count)
    before = [view.pixels() for view in load_scene(config).train]
    path = tmp_path / "masks" / "train" / f"r_{WRONG}.png"
    mask = np.array(Image.open(path))
    assert not mask[2:10, 2:10].any()
    mask[4:7, 3:8] = shade
    Image.fromarray(mask).save(path)
    assert agreement(load_scene(config)).disagreeing == []
    scene, found = load_with_agreeing_masks(config)
    named = [(freed.name, freed.kind, freed.repair) for freed in found]
    assert named == [(f"train/r_{WRONG}.png", "stray", "freed")] * (shade > 127)
    assert all("shows pieces beside the object" in freed.about for freed in found)
    for pixels, view in zip(before, scene.train, strict=True):
        assert torch.equal(pixels[..., 3], view.pixels()[..., 3])


def test_a_piece_and_a_wrong_mask_are_both_mended(tmp_path: Path) -> None:
    config = photos(tmp_path, 8, "empty")
    path = tmp_path / "masks" / "train" / "r_5.png"
    mask = np.array(Image.open(path))
    mask[4:7, 3:8] = 255
    Image.fromarray(mask).save(path)
    scene, found = load_with_agreeing_masks(config)
    assert {(mask.name, mask.repair) for mask in found} == {("train/r_5.png", "freed"), ("train/r_2.png", "colors")}
    assert not bool(scene.train[5].pixels()[2:9, 2:10, 3].any())


def test_a_part_that_hangs_in_the_air_in_all_masks_stays(tmp_path: Path) -> None:
    """Two balls apart are one object."""
    config = photos(tmp_path, 6, balls=[Ball((-0.3, 0, 0), 0.4), Ball((0.5, 0.1, 0.3), 0.12)])
    assert load_with_agreeing_masks(config)[1] == []
