"""Parts of the picture of a posed scene, each by itself and small."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image, ImageDraw

from gsopt.data.sfm import overview_image as parts

SIDE = 100
RED, GREEN, BLUE = (250, 0, 0), (0, 250, 0), (0, 0, 250)
ABOVE, ASIDE = (0, 1), (0, 2)


@pytest.mark.parametrize(("plane", "up"), [(ABOVE, 1), (ASIDE, 2)])
def test_positions_fill_the_panel_but_its_margins_with_up_upwards(plane: tuple[int, int], up: int) -> None:
    """From the middle to a half width away it is 44 of 100 pixels."""
    middle, half = np.array([1.0, 2.0, 3.0]), 4.0
    positions = np.tile(middle, (5, 1))
    positions[1:3, 0] += np.array([4, -4])
    positions[3, up] += 4
    positions[4, up] -= 2
    found = parts._to_pixels(positions, plane, middle, half, SIDE)
    np.testing.assert_allclose(found, [[50, 50], [94, 50], [6, 50], [50, 6], [50, 72]])


@pytest.mark.parametrize("away", [0.0, 1e3])
def test_the_window_holds_the_cameras_and_the_bulk_of_the_points_near_them(away: float) -> None:
    """A tenth wider than they are; points beyond 4.8 times the farthest camera from their mean do not count."""
    centers = np.array([[-1.0, -2, 0], [1, 2, 0]]) + away
    middle, half = parts._window(centers, np.zeros((0, 3)))
    np.testing.assert_allclose(middle, np.full(3, away))
    assert half == pytest.approx(2 * 1.1)
    points = np.array([[0.0, 9.59, 0], [0, 0, 9.61], [9.61, 0, 0]]) + away
    middle, half = parts._window(centers, points)
    np.testing.assert_allclose(middle, np.array([0, (9.59 - 2) / 2, 0]) + away)
    assert half == pytest.approx((9.59 + 2) / 2 * 1.1)
    for count, reach in ((20, 9.0), (21, 8.1)):
        line = np.zeros((count, 3)) + away
        line[:, 1] += np.linspace(-9, 9, count)
        assert parts._window(centers, line)[1] == pytest.approx(reach * 1.1)


def test_a_lone_camera_has_a_window_of_one_unit() -> None:
    middle, half = parts._window(np.array([[3.0, 4, 5]]), np.zeros((0, 3)))
    assert middle.tolist() == [3, 4, 5]
    assert half == 1.0


def panel(points: list[list[float]], colors: list[tuple[int, int, int]], plane: tuple[int, int] = ABOVE) -> np.ndarray:
    """Two cameras that look to the right, at (-1, -1, 0) and (1, 1, 0), and points."""
    centers = np.array([[-1.0, -1, 0], [1, 1, 0]])
    looking = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # columns: right, down, forward
    shown = parts._panel(
        SIDE, plane, centers, np.stack([looking] * 2), np.array(points).reshape(-1, 3),
        np.array(colors, np.uint8).reshape(-1, 3),
    )  # fmt: skip
    return np.asarray(shown).astype(int)


def is_at(pixels: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    return np.argwhere((np.abs(pixels - np.array(color)).sum(axis=-1)) < 10)


def test_a_point_is_a_square_of_three_pixels_and_ends_at_the_border() -> None:
    """The window is 2.2 wide: a unit is 40 pixels."""
    found = is_at(panel([[0.5, -0.25, 0.3]], [RED]), RED)
    assert found.tolist() == [[row, column] for row in (60, 61, 62) for column in (70, 71, 72)]
    assert len(is_at(panel([[1.225, 0, 0.3]] * 1, [RED]), RED)) > 0


@pytest.mark.parametrize(
    ("plane", "nearer", "farther"),
    [(ABOVE, [0.5, -0.25, 0.3], [0.5, -0.25, -0.3]), (ASIDE, [0.5, -0.4, 0.3], [0.5, 0.4, 0.3])],
)
def test_what_is_nearer_hides_what_is_farther(
    plane: tuple[int, int], nearer: list[float], farther: list[float]
) -> None:
    """From above the higher point, from the side the one with the smaller y."""
    for order in (1, -1):
        points, colors = [nearer, farther][::order], [RED, GREEN][::order]
        pixels = panel(points, colors, plane)
        assert len(is_at(pixels, RED)) == 9
        assert len(is_at(pixels, GREEN)) == 0


def test_cameras_are_triangles_that_open_where_they_look_and_their_path_joins_them() -> None:
    """As long as 0.045 of the window's width, and as wide."""
    pixels = panel([], [])
    found = is_at(pixels, parts.CAMERA_COLOR)
    first = found[found[:, 1] < 50]
    tip = (90, 10)
    length = 0.045 * 2 * 1.1 * 40
    assert abs(first[:, 1].min() - tip[1]) <= 1
    assert first[:, 1].max() - tip[1] == pytest.approx(length, abs=2)
    assert np.ptp(first[:, 0]) == pytest.approx(length, abs=3)
    path = is_at(pixels, parts.PATH_COLOR)
    assert len(path) > 60
    assert np.abs(path[:, 0] + path[:, 1] - 100).max() <= 2


def test_labels_lie_in_the_margin_above_and_names_beside_their_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    """Six of eleven cameras have their name; a frame runs around."""
    written: list[tuple[str, float, float]] = []
    monkeypatch.setattr(
        ImageDraw.ImageDraw, "text", lambda self, at, text, *_, **__: written.append((text, float(at[0]), float(at[1])))
    )
    image = Image.new("RGB", (SIDE, SIDE), parts.PAPER_COLOR)
    parts._label(image, "from above")
    assert written == [("from above", 6.0, 3.0)]
    pixels = np.asarray(image).astype(int)
    assert len(is_at(pixels, parts.FRAME_COLOR)) == SIDE**2 - (SIDE - 4) ** 2
    centers = np.zeros((11, 3))
    centers[:, 0] = np.linspace(-1, 1, 11)
    written.clear()
    parts._number(image, ABOVE, centers, np.zeros((0, 3)), [f"n{i}" for i in range(11)], SIDE)
    assert [text for text, _, _ in written] == ["n0", "n2", "n4", "n6", "n8", "n10"]
    assert [x for _, x, _ in written] == pytest.approx([50 + 40 * x + 12 for x in np.linspace(-1, 1, 6)])
    assert {y for _, _, y in written} == {50.0 - 16}
    written.clear()
    parts._number(image, ABOVE, centers[:2], np.zeros((0, 3)), ["a", "b"], SIDE)
    assert [text for text, _, _ in written] == ["a", "b"]


def test_a_drawing_is_two_panels_above_a_headline_and_takes_every_kth_of_many_points(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[tuple[tuple[int, int], int, int]] = []

    def draw(
        side: int, plane: tuple[int, int], centers: np.ndarray, axes: np.ndarray, points: np.ndarray, colors: np.ndarray
    ) -> Image.Image:
        seen.append((plane, len(points), len(colors)))
        np.testing.assert_allclose(centers, [[-1, -2, -3]])
        return Image.new("RGB", (side, side), RED if plane == ABOVE else BLUE)

    monkeypatch.setattr(parts, "PANEL_SIDE", 60)
    monkeypatch.setattr(parts, "MAX_POINTS", 10)
    monkeypatch.setattr(parts, "_panel", draw)
    monkeypatch.setattr(parts, "_label", lambda panel, title: None)
    monkeypatch.setattr(parts, "_number", lambda *_: None)
    viewmat = np.eye(4)
    viewmat[:3, 3] = [1, 2, 3]
    import io

    for count, kept in ((9, 9), (19, 19), (20, 10), (35, 12)):
        seen.clear()
        data = parts.draw_scene(viewmat[None], ["a"], np.zeros((count, 3)), np.zeros((count, 3), np.uint8), "x")
        assert seen == [(ABOVE, kept, kept), (ASIDE, kept, kept)]
    with Image.open(io.BytesIO(data)) as image:
        assert image.size == (120, 60 + 48)
        pixels = np.asarray(image.convert("RGB")).astype(int)
    assert pixels[30, 20].tolist() == list(RED)
    assert pixels[30, 80].tolist() == list(BLUE)
    assert np.abs(pixels[100, 110] - parts.PAPER_COLOR).max() <= 2
