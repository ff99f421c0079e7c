"""The picture of a posed scene."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch
from PIL import Image

from gsopt.data.sfm import overview_image
from gsopt.data.sfm.overview_image import CAMERA_COLOR, FRAME_COLOR, INK_COLOR, PANEL_SIDE, PAPER_COLOR, draw_scene
from gsopt.geometry.cameras import look_at


def test_cameras_open_where_they_look() -> None:
    """Two cameras that look to the right, seen from above: triangles as wide as long, with the tip at the left."""
    eyes = torch.tensor([[0.0, 0, 0], [4, 4, 0]])
    viewmats = torch.cat(
        [look_at(eye[None], eye + torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 0, 1])) for eye in eyes]
    )
    picture = draw_scene(viewmats.double().numpy(), ["a", "b"], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "two")
    pixels = np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")).astype(int)[:PANEL_SIDE, :PANEL_SIDE]
    rows, columns = np.nonzero(np.abs(pixels - CAMERA_COLOR).sum(-1) < 90)
    for one in (columns < PANEL_SIDE // 2, columns >= PANEL_SIDE // 2):
        length, width = (int(np.ptp(values[one])) for values in (columns, rows))
        assert 0.9 * length < width < 1.2 * length
        tip, mouth = (rows[one & (columns == end)] for end in (columns[one].min() + 4, columns[one].max() - 4))
        assert np.ptp(tip) < 0.5 * np.ptp(mouth)


CORNERS = torch.tensor([[-1.0, -1, 0], [1, 1, 1]], dtype=torch.float64)
"""Two cameras whose box is shown: 2 wide, its middle at (0, 0, 0.5), so that a unit is 720 * 0.44 / 1.1 = 288 px."""
UNIT, MIDDLE = 288, np.array([0, 0, 0.5])


def drawn(
    points: list[list[float]], colors: list[tuple[int, int, int]], names: tuple[str, ...] = ("", "")
) -> np.ndarray:
    viewmats = look_at(CORNERS, torch.tensor([0.0, 0, 0.4], dtype=torch.float64), torch.tensor([0.0, 0, 1]).double())
    shown = np.array(points, dtype=float).reshape(-1, 3), np.array(colors, dtype=np.uint8).reshape(-1, 3)
    with Image.open(io.BytesIO(draw_scene(viewmats.numpy(), names, *shown, "headline"))) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def place(position: list[float], panel: int, unit: float = UNIT) -> tuple[int, int]:
    """Row and column of a position in the panel from above (0) or from the side (1)."""
    x, y, z = (np.array(position) - MIDDLE) * unit
    return round(PANEL_SIDE / 2 - (z if panel else y)), round(PANEL_SIDE / 2 + x) + panel * PANEL_SIDE


def near(pixels: np.ndarray, row: int, column: int, color: tuple[int, int, int], reach: int = 1) -> bool:
    """Is there a pixel of about this color?"""
    around = pixels[row - reach : row + reach + 1, column - reach : column + reach + 1]
    return bool((np.abs(around - np.array(color)).max(-1) < 40).any())


def test_points_stand_where_they_are_seen_and_hide_what_is_behind_them() -> None:
    """From above the higher point covers the lower one, from the side (towards +y) the one in front the one behind."""
    red, green, blue = (250, 0, 0), (0, 250, 0), (0, 0, 250)
    points = [[0.5, -0.5, 0.9], [0.5, -0.5, 0.1], [0.2, 0.8, 0.3], [0.2, -0.8, 0.3]]
    for order in ([0, 1, 2, 3], [3, 2, 1, 0]):
        colors = [red, green, green, blue]
        pixels = drawn([points[i] for i in order], [colors[i] for i in order])
        assert near(pixels, *place(points[0], 0), red)
        assert not near(pixels, *place(points[1], 0), green)
        assert near(pixels, *place(points[2], 0), green)
        assert near(pixels, *place(points[3], 0), blue)
        assert near(pixels, *place(points[0], 1), red)
        assert near(pixels, *place(points[1], 1), green)
        assert near(pixels, *place(points[3], 1), blue)
        assert not near(pixels, *place(points[2], 1), green)


def test_cameras_are_joined_in_order_and_named() -> None:
    pixels = drawn([], [], ("first.jpg", "last.jpg"))
    for panel in (0, 1):
        for corner in CORNERS.tolist():
            row, column = place(corner, panel)
            assert near(pixels, row, column, CAMERA_COLOR, 3)
            named = pixels[row - 12 : row + 12, column + 6 : column + 60]
            assert (np.abs(named - INK_COLOR).max(-1) < 60).sum() > 30
            assert (np.abs(pixels[row - 12 : row + 12, column - 60 : column - 6] - INK_COLOR).max(-1) < 30).sum() == 0
    row, column = place([0, 0, 0.5], 0)
    assert near(pixels, row, column, overview_image.PATH_COLOR)


def test_titles_stand_in_the_margins_and_the_headline_below() -> None:
    pixels = drawn([], [])
    ink = np.abs(pixels - INK_COLOR).max(-1) < 40
    assert pixels.shape == (PANEL_SIDE + 48, 2 * PANEL_SIDE, 3)
    assert pixels[5, 5].tolist() == list(PAPER_COLOR)
    for place_ in (pixels[0, 300], pixels[PANEL_SIDE - 1, 300], pixels[300, 0], pixels[300, PANEL_SIDE - 1]):
        assert np.abs(place_ - np.array(FRAME_COLOR)).max() < 4
    for left in (0, PANEL_SIDE):
        title = ink[18:48, left + 40 : left + 200]
        assert title.sum() > 100
        assert ink[:PANEL_SIDE, left : left + PANEL_SIDE].sum() == title.sum()
    below = ink[PANEL_SIDE + 8 : PANEL_SIDE + 36, 40:200]
    assert below.sum() > 100
    assert ink[PANEL_SIDE:].sum() == below.sum()


@pytest.mark.parametrize(("far", "unit"), [(4.7, 720 * 0.44 / (1.1 * 5.7 / 2)), (4.9, UNIT), (1000.0, UNIT)])
def test_points_far_beyond_the_cameras_do_not_shrink_them(far: float, unit: float) -> None:
    """Farther from their mean than 3 * 1.6 times the farthest camera."""
    pixels = drawn([[far, 0, 0.5]], [(0, 0, 250)])
    middle = (far - 1) / 2 if far < 4.8 else 0.0
    for corner in CORNERS.tolist():
        assert near(pixels, *place([corner[0] - middle, *corner[1:]], 0, unit), CAMERA_COLOR, 3)


def test_of_many_points_the_outermost_twentieth_on_each_side_decides_nothing() -> None:
    line = np.linspace(-4.0, 4.0, 41)
    pixels = drawn([[x, 0, 0.5] for x in line], [(0, 0, 250)] * 41)
    for corner in CORNERS.tolist():
        assert near(pixels, *place(corner, 0, 720 * 0.44 / (3.6 * 1.1)), CAMERA_COLOR, 3)


def test_six_names_at_most_and_one_camera_alone_are_drawn() -> None:
    eyes = torch.stack([torch.linspace(-1, 1, 11).double(), torch.zeros(11).double(), torch.zeros(11).double()], dim=1)
    viewmats = look_at(eyes, torch.tensor([0.0, 9, 0]).double(), torch.tensor([0.0, 0, 1]).double()).numpy()
    empty = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    with Image.open(io.BytesIO(draw_scene(viewmats, ["x"] * 11, *empty, ""))) as image:
        ink = np.abs(np.asarray(image.convert("RGB")).astype(int) - INK_COLOR).max(-1) < 60
    columns = [360 + 288 * x for x in np.linspace(-1, 1, 11)]
    named = [bool(ink[350:372, round(x) + 6 : round(x) + 16].any()) for x in columns]
    assert named == [True, False] * 5 + [True]
    assert draw_scene(viewmats[:1], ["x"], *empty, "")


def test_what_is_near_lies_near_the_cameras_wherever_these_are() -> None:
    """Cameras and points moved alike, far from the origin, are shown alike."""
    generator = np.random.default_rng(0)
    centers, points = generator.normal(size=(4, 3)), generator.normal(size=(50, 3))
    middle, half = overview_image._window(centers, points)
    away = np.array([300.0, -200.0, 100.0])
    moved_middle, moved_half = overview_image._window(centers + away, points + away)
    assert moved_middle - away == pytest.approx(middle)
    assert moved_half == pytest.approx(half)
