"""One panel of the picture of a scene, pixel by pixel: what it shows, where, and what covers what."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsopt.data.sfm import overview_image
from gsopt.data.sfm.overview_image import (
    CAMERA_COLOR,
    FRAME_COLOR,
    INK_COLOR,
    PAPER_COLOR,
    PATH_COLOR,
    _number,
    _panel,
    _to_pixels,
    _window,
    draw_scene,
)

SIDE, ABOVE, ASIDE = 100, (0, 1), (0, 2)
CENTERS = np.array([[-1.0, -1, 0], [1, 1, 1]])
"""Cameras whose box is 2 wide, with its middle at (0, 0, 0.5): a unit is 100 * 0.44 / 1.1 = 40 px."""
RED, GREEN = (250, 0, 0), (0, 250, 0)
CROWD = np.full((100, 3), 0.5) * (1, -1, 1)
"""Points at one place; no single other one decides what is shown."""


def panel(
    points: np.ndarray, colors: list[tuple[int, int, int]], plane: tuple[int, int] = ABOVE, side: int = SIDE
) -> np.ndarray:
    axes = np.tile(np.eye(3), (2, 1, 1))
    return np.asarray(_panel(side, plane, CENTERS, axes, points, np.array(colors, dtype=np.uint8).reshape(-1, 3)))


def colored(pixels: np.ndarray, color: tuple[int, ...]) -> list[tuple[int, int]]:
    """Rows and columns of the pixels of a color."""
    return [(int(row), int(column)) for row, column in np.argwhere((pixels == color).all(-1))]


@pytest.mark.parametrize(("plane", "row"), [(ABOVE, 70), (ASIDE, 42)])
def test_a_point_is_a_block_of_three_pixels_whose_corner_is_its_place(plane: tuple[int, int], row: int) -> None:
    """The picture is reduced by two, so that it is one and a half pixels wide there."""
    pixels = panel(np.array([[0.5, -0.5, 0.7]]), [RED], plane)
    assert colored(pixels, RED) == [(row + dy, 70 + dx) for dy in range(3) for dx in range(3)]


@pytest.mark.parametrize(
    ("column", "row", "rows", "columns"),
    [
        (99, 80, [80, 81, 82], [99]),
        (98, 80, [80, 81, 82], [98, 99]),
        (100, 80, [], []),
        (-1, 20, [20, 21, 22], [0, 1]),
        (-2, 20, [20, 21, 22], [0]),
        (-3, 20, [], []),
        (30, 99, [99], [30, 31, 32]),
        (30, 100, [], []),
        (30, -1, [0, 1], [30, 31, 32]),
        (30, -2, [0], [30, 31, 32]),
        (30, -3, [], []),
    ],
)
def test_of_a_point_at_the_edge_that_is_drawn_which_lies_inside(
    column: int, row: int, rows: list[int], columns: list[int]
) -> None:
    outlier = [(column - 50) / 40, (50 - row) / 40, 0.5]
    pixels = panel(np.concatenate([CROWD, [outlier]]), [RED] * 100 + [GREEN])
    assert colored(pixels, GREEN) == [(y, x) for y in rows for x in columns]
    assert colored(pixels, RED)[0] == (70, 70)


@pytest.mark.parametrize("turned", [False, True])
def test_what_is_higher_covers_what_is_below_and_what_is_before_covers_what_is_behind(turned: bool) -> None:
    for plane, front in ((ABOVE, [0.5, -0.5, 0.8]), (ASIDE, [0.5, -0.8, 0.5])):
        points = np.array([front, CROWD[0]])
        colors = [GREEN, RED]
        pixels = panel(points[::-1] if turned else points, colors[::-1] if turned else colors, plane)
        assert (len(colored(pixels, GREEN)), len(colored(pixels, RED))) == (9, 0)


def test_cameras_that_look_up_open_to_both_sides_of_what_they_see() -> None:
    """From the side: the tip at the camera, both corners 0.045 * 2.2 units above it and half as much aside."""
    pixels = panel(np.zeros((0, 3)), [], ASIDE, side=800)
    unit = 800 * 0.44 / 1.1
    length = 0.045 * 2.2 * unit
    for x, z in ((-1, 0.0), (1, 1.0)):
        tip = np.array([400 - (z - 0.5) * unit, 400 + x * unit])
        places = np.array(colored(pixels, CAMERA_COLOR)) - tip
        own = places[np.abs(places).max(1) < 60]
        assert own.min(0) == pytest.approx([-length, -length / 2], abs=2.1)
        assert own.max(0) == pytest.approx([0, length / 2], abs=2.1)
    assert colored(pixels, PATH_COLOR)


def test_one_camera_has_no_path() -> None:
    sheet = _panel(SIDE, ABOVE, CENTERS[:1], np.eye(3)[None], np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    pixels = np.asarray(sheet)
    assert not colored(pixels, PATH_COLOR)
    assert set(map(tuple, pixels.reshape(-1, 3).tolist())) == {PAPER_COLOR, CAMERA_COLOR}


def test_a_window_is_a_tenth_wider_than_what_it_shows() -> None:
    """One camera alone is shown amid one unit on each side."""
    middle, half = _window(CENTERS, np.zeros((0, 3)))
    assert (middle.tolist(), half) == ([0, 0, 0.5], pytest.approx(1.1))
    middle, half = _window(CENTERS, np.array([[3.0, 0, 0.5]]))
    assert (middle.tolist(), half) == ([1, 0, 0.5], pytest.approx(2.2))
    middle, half = _window(np.array([[1.0, 2, 3]]), np.zeros((0, 3)))
    assert (middle.tolist(), half) == ([1, 2, 3], 1)


def test_a_point_three_times_as_far_as_the_cameras_area_is_not_looked_at() -> None:
    """The area is 1.6 times that of the cameras, here 1 away from their mean."""
    edge = 3 * 1.6
    for far, shown in ((np.nextafter(edge, 0), True), (edge, False)):
        middle, _ = _window(CENTERS, np.array([[far, 0, 0.5]]))
        assert middle[0] == pytest.approx((far - 1) / 2 if shown else 0, abs=1e-9)


@pytest.mark.parametrize(("count", "right"), [(20, 4.0), (21, 3.6)])
def test_of_more_than_twenty_points_the_outermost_twentieth_decides_nothing(count: int, right: float) -> None:
    """The points lie evenly from -4 to 4: their 95 % quantile is 3.6."""
    line = np.linspace(-4, 4, count)
    middle, half = _window(CENTERS, np.column_stack([line, 0 * line, 0 * line + 0.5]))
    assert (middle[0], half) == (pytest.approx(0, abs=1e-9), pytest.approx(1.1 * right))


def test_positions_become_pixels_to_the_right_and_upwards() -> None:
    middle = np.array([1.0, 2, 3])
    found = _to_pixels(np.array([[1.0, 2, 3], [2, 4, 6]]), ABOVE, middle, 4.4, 200)
    np.testing.assert_allclose(found, [[100, 100], [120, 60]])
    found = _to_pixels(np.array([[2.0, 4, 6]]), ASIDE, middle, 4.4, 200)
    np.testing.assert_allclose(found, [[120, 40]])


@pytest.mark.parametrize(("count", "named"), [(1, [0]), (3, [0, 1, 2]), (11, [0, 2, 4, 6, 8, 10])])
def test_six_cameras_at_most_are_named_the_first_and_the_last_among_them(
    count: int, named: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Right of each and above it, 6 and 8 px in the finished picture."""
    written: list[tuple[tuple[float, float], str]] = []

    class Pen:
        def text(self, place: tuple[float, float], text: str, *_: object, **__: object) -> None:
            written.append((place, text))

    monkeypatch.setattr(overview_image.ImageDraw, "Draw", lambda image: Pen())
    centers = np.column_stack([np.linspace(-1, 1, count), np.zeros(count), np.zeros(count)])
    _number(Image.new("RGB", (SIDE, SIDE)), ABOVE, centers, np.zeros((0, 3)), [str(i) for i in range(count)], SIDE)
    assert [text for _, text in written] == [str(i) for i in named]
    columns = [50 + (40 * x if count > 1 else 0) + 12 for x in centers[named, 0]]
    assert [place[0] for place, _ in written] == pytest.approx(columns)
    assert [place[1] for place, _ in written] == pytest.approx([50 - 16] * len(named))


@pytest.mark.parametrize(("count", "step"), [(39, 1), (40, 1), (79, 1), (80, 2), (120, 3)])
def test_of_many_points_every_second_or_third_one_is_drawn(
    count: int, step: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[tuple[list[float], list[int]]] = []

    def record(side: int, plane: object, centers: object, axes: object, points: np.ndarray, colors: np.ndarray) -> Any:
        drawn.append((points[:, 0].tolist(), colors[:, 0].tolist()))
        return Image.new("RGB", (side, side))

    monkeypatch.setattr(overview_image, "MAX_POINTS", 40)
    monkeypatch.setattr(overview_image, "PANEL_SIDE", 20)
    monkeypatch.setattr(overview_image, "_panel", record)
    points = np.arange(float(count))[:, None] * [1, 0, 0]
    colors = np.arange(count, dtype=np.uint8)[:, None] * np.ones(3, dtype=np.uint8)
    draw_scene(np.tile(np.eye(4), (2, 1, 1)), ["", ""], points, colors, "")
    assert drawn == [(list(range(0, count, step)), list(range(0, count, step)))] * 2


def test_a_sheet_has_two_panels_with_frames_titles_and_a_headline_below(monkeypatch: pytest.MonkeyPatch) -> None:
    """The titles begin 6 % from the left of their panels, the headline as far from the left and 8 px below."""
    monkeypatch.setattr(overview_image, "PANEL_SIDE", 200)
    viewmats = np.tile(np.eye(4), (2, 1, 1))
    viewmats[:, :3, 3] = -CENTERS
    empty = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    sheets = [draw_scene(viewmats, ["", ""], *empty, headline) for headline in ("", "Headline")]
    bare, pixels = (np.asarray(Image.open(io.BytesIO(sheet)).convert("RGB")).astype(int) for sheet in sheets)
    assert pixels.shape == (248, 400, 3)
    for left in (0, 200):
        frame = [pixels[0, left : left + 200], pixels[199, left : left + 200], pixels[:200, left]]
        frame.append(pixels[:200, left + 199])
        for line in frame:
            assert np.abs(line[5:-5] - FRAME_COLOR).max() < 8
        rows, columns = np.nonzero(np.abs(bare[:40, left + 4 : left + 196] - INK_COLOR).max(-1) < 60)
        assert 10 <= columns.min() + 4 <= 14
        assert 6 <= rows.min() <= 13
        assert 15 < rows.max() < 28
    assert (bare[:200] == pixels[:200]).all()
    assert (bare[204:] == PAPER_COLOR).all()
    rows, columns = np.nonzero(np.abs(pixels[200:] - INK_COLOR).max(-1) < 60)
    assert 10 <= columns.min() <= 15
    assert (8 <= rows.min() <= 14, 19 <= rows.max() <= 30) == (True, True)
