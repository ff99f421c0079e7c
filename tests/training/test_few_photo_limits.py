"""Warnings about few photos, at the edges of their limits."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from gsopt.geometry.cameras import Cameras, intrinsics, look_at
from gsopt.training import few_photos
from gsopt.training.few_photos import NO_MASKS, few_photo_warnings

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def views(*degrees: float, outward: bool = False) -> list[Any]:
    """Cameras around the origin that look at it, or away from it."""
    found = []
    for i, angle in enumerate(degrees):
        eye = 3 * torch.tensor([[math.cos(math.radians(angle)), math.sin(math.radians(angle)), 0.0]]).double()
        viewmat = look_at(eye, 2 * eye[0] if outward else torch.zeros(3).double(), UP)
        found.append(SimpleNamespace(name=f"{i}.png", camera=Cameras(viewmat, intrinsics(0.6, 8, 8)[None], 8, 8)))
    return found


def scene(train: list[Any], *, has_alpha: bool = True) -> Any:
    return SimpleNamespace(train=train, has_alpha=has_alpha, extent=3.0, completed=False)


def thumbnail(solid: int, side: int = 100, *, whole: bool = True) -> Any:
    """An image of side x side pixels, so many of them opaque."""
    planes = torch.zeros(4, side, side)
    planes[3].view(-1)[:solid] = 128
    planes[3].view(-1)[solid:] = 127
    return SimpleNamespace(planes=planes, shows_all=lambda: whole)


def test_three_photos_without_masks_are_warned_of_and_four_are_not() -> None:
    assert few_photo_warnings(scene(views(0, 90, 180), has_alpha=False)) == (NO_MASKS.format(3),)
    assert few_photo_warnings(scene(views(0, 60, 120, 180), has_alpha=False)) == ()


@pytest.mark.parametrize(
    ("solid", "told"),
    [
        (63, "holds 63 pixels, too few for a shape"),
        (64, ""),
        (9800, ""),
        (9801, "covers 98% of it and outlines nothing"),
        (10_000, "covers 100% of it and outlines nothing"),
    ],
)
def test_a_mask_of_64_pixels_up_to_98_percent_has_a_shape(solid: int, told: str) -> None:
    found = list(few_photos._mask_faults(views(0)[0], thumbnail(solid)))
    assert (told in found[0]) if told else (found == [])


def test_an_object_at_the_border_is_cut_off() -> None:
    (found,) = few_photos._mask_faults(views(0)[0], thumbnail(5000, whole=False))
    assert found == "0.png cuts the object off at its border: what lies beyond is not completed. Step back."


@pytest.mark.parametrize(("angle", "alike"), [(0, True), (9.9, True), (10.1, False), (170, False)])
def test_cameras_within_ten_degrees_show_the_same_side(angle: float, alike: bool) -> None:
    found = list(few_photos._direction_faults(scene(views(0, angle))))
    assert bool(found) == alike
    if alike:
        assert f"0.png and 1.png look the same way within {angle:.0f} degrees" in found[0]


def test_every_pair_that_looks_alike_is_named_and_then_nothing_else() -> None:
    found = list(few_photos._direction_faults(scene(views(0, 5, 90, outward=True))))
    assert len(found) == 1
    assert "0.png and 1.png" in found[0]
    (apart,) = few_photos._direction_faults(scene(views(0, 90, 200, outward=True)))
    assert "no two show the same object" in apart
    assert list(few_photos._direction_faults(scene(views(0, outward=True)))) == []


def test_two_cameras_that_look_apart_show_no_common_object() -> None:
    (apart,) = few_photos._direction_faults(scene(views(0, 90, outward=True)))
    assert "no two show the same object" in apart


@pytest.mark.parametrize(
    ("guessed", "body", "colors", "told"),
    [
        (False, False, False, few_photos.TURNED),
        (True, False, False, few_photos.GUESSED),
        (True, True, False, few_photos.LIKENED),
        (True, True, True, few_photos.COMPLETED),
    ],
)
def test_a_completed_scene_says_where_its_other_sides_come_from(
    guessed: bool, body: bool, colors: bool, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(few_photos, "small_photos", lambda train, most: [thumbnail(5000)] * len(train))
    one = scene(views(0))
    assert few_photo_warnings(one) == ()
    one.completed, one.guessed = True, (None,) * guessed
    one.body, one.body_colors = (object() if given else None for given in (body, colors))
    assert few_photo_warnings(one) == (told,)
    assert len({few_photos.TURNED, few_photos.GUESSED, few_photos.LIKENED, few_photos.COMPLETED}) == 4
