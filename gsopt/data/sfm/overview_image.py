"""A PNG of cameras and points, seen from above and from the side; drawn in memory, so no display is needed."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image, ImageDraw, ImageFont

PANEL_SIDE = 720
OVERSAMPLING = 2
MARGIN = 0.06
CAMERA_SIZE = 0.045
"""Length of a drawn camera, share of the panel."""
CAMERA_AREA = 1.6
"""The panel shows the cameras' box times this."""
PAPER_COLOR, FRAME_COLOR, INK_COLOR, PATH_COLOR = (250, 249, 246), (228, 226, 220), (60, 58, 54), (200, 196, 188)
CAMERA_COLOR = (196, 78, 36)
MAX_POINTS = 40_000
_VIEWS = (("from above", (0, 1)), ("from the side", (0, 2)))


def draw_scene(
    viewmats: Float[np.ndarray, "C 4 4"],
    names: Sequence[str],
    points: Float[np.ndarray, "P 3"],
    colors: UInt8[np.ndarray, "P 3"],
    headline: str,
) -> bytes:
    """PNG of a placed scene (z up). Cameras are orange triangles that open where they look."""
    world_from_cam = np.linalg.inv(viewmats)
    centers, axes = world_from_cam[:, :3, 3], world_from_cam[:, :3, :3]
    side = PANEL_SIDE * OVERSAMPLING
    sheet = Image.new("RGB", (len(_VIEWS) * side, side + 48 * OVERSAMPLING), PAPER_COLOR)
    step = max(1, len(points) // MAX_POINTS)
    for column, (title, plane) in enumerate(_VIEWS):
        panel = _panel(side, plane, centers, axes, points[::step], colors[::step])
        _label(panel, title)
        _number(panel, plane, centers, points, names, side)
        sheet.paste(panel, (column * side, 0))
    draw = ImageDraw.Draw(sheet)
    draw.text((side * MARGIN, side + 8 * OVERSAMPLING), headline, INK_COLOR, font=_font(17))
    buffer = io.BytesIO()
    sheet.resize((sheet.width // OVERSAMPLING, sheet.height // OVERSAMPLING), Image.Resampling.LANCZOS).save(
        buffer, format="PNG", optimize=True
    )
    return buffer.getvalue()


def _panel(
    side: int,
    plane: tuple[int, int],
    centers: Float[np.ndarray, "C 3"],
    axes: Float[np.ndarray, "C 3 3"],
    points: Float[np.ndarray, "P 3"],
    colors: UInt8[np.ndarray, "P 3"],
) -> Image.Image:
    """Points as pixels in their own colors, nearer ones over farther ones, then the cameras in order."""
    middle, half = _window(centers, points)
    pixels = np.full((side, side, 3), PAPER_COLOR, dtype=np.uint8)
    depth_axis = 3 - plane[0] - plane[1]
    order = np.argsort(points[:, depth_axis] * (1 if depth_axis == 2 else -1))
    columns, rows = _to_pixels(points[order], plane, middle, half, side).round().astype(int).T
    colors = colors[order]
    for dy in range(OVERSAMPLING + 1):
        for dx in range(OVERSAMPLING + 1):
            inside = (columns + dx >= 0) & (columns + dx < side) & (rows + dy >= 0) & (rows + dy < side)
            pixels[rows[inside] + dy, columns[inside] + dx] = colors[inside]
    panel = Image.fromarray(pixels)
    draw = ImageDraw.Draw(panel)
    path = [(float(x), float(y)) for x, y in _to_pixels(centers, plane, middle, half, side)]
    if len(path) > 1:
        draw.line(path, fill=PATH_COLOR, width=OVERSAMPLING)
    length = CAMERA_SIZE * 2 * half
    for center, axis in zip(centers, axes, strict=True):
        corners = center + length * np.stack([axis[:, 2] + 0.5 * axis[:, 0], axis[:, 2] - 0.5 * axis[:, 0]])
        shape = _to_pixels(np.vstack([center, corners]), plane, middle, half, side)
        draw.polygon([(float(x), float(y)) for x, y in shape], outline=CAMERA_COLOR, width=OVERSAMPLING + 1)
    return panel


def _window(
    centers: Float[np.ndarray, "C 3"], points: Float[np.ndarray, "P 3"]
) -> tuple[Float[np.ndarray, "3"], float]:
    """Middle and half width of what is shown: the cameras, and the bulk of the points as far as it lies near them."""
    spread = float(np.abs(centers - centers.mean(axis=0)).max()) * CAMERA_AREA
    near = points[np.abs(points - centers.mean(axis=0)).max(axis=1) < 3 * spread] if len(points) else points
    bulk = np.quantile(near, [0.05, 0.95], axis=0) if len(near) > 20 else near
    shown = np.vstack([centers, bulk])
    low, high = shown.min(axis=0), shown.max(axis=0)
    return (low + high) / 2, float((high - low).max()) / 2 * 1.1 or 1.0


def _to_pixels(
    positions: Float[np.ndarray, "N 3"], plane: tuple[int, int], middle: Float[np.ndarray, "3"], half: float, side: int
) -> Float[np.ndarray, "N 2"]:
    scale = side * (0.5 - MARGIN) / half
    offsets = (positions - middle)[:, plane] * scale
    return np.stack([side / 2 + offsets[:, 0], side / 2 - offsets[:, 1]], axis=1)


def _number(
    panel: Image.Image,
    plane: tuple[int, int],
    centers: Float[np.ndarray, "C 3"],
    points: Float[np.ndarray, "P 3"],
    names: Sequence[str],
    side: int,
) -> None:
    """The names of a few cameras, so that the path can be followed."""
    middle, half = _window(centers, points)
    draw = ImageDraw.Draw(panel)
    chosen: Int[np.ndarray, "K"] = np.unique(np.linspace(0, len(names) - 1, min(6, len(names))).round().astype(int))
    for i in chosen:
        x, y = _to_pixels(centers[i : i + 1], plane, middle, half, side)[0]
        draw.text((x + 6 * OVERSAMPLING, y - 8 * OVERSAMPLING), names[i], INK_COLOR, font=_font(13))


def _label(panel: Image.Image, title: str) -> None:
    draw = ImageDraw.Draw(panel)
    draw.rectangle((0, 0, panel.width - 1, panel.height - 1), outline=FRAME_COLOR, width=OVERSAMPLING)
    draw.text((panel.width * MARGIN, panel.height * MARGIN / 2), title, INK_COLOR, font=_font(17))


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size * OVERSAMPLING)
