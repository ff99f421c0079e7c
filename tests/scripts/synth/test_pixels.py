"""Laws of what becomes of a pass: coding, compositing, PNG, EXR, contact sheets, points, captions. No Blender."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from PIL import Image
from synth import captions, pixels
from synth.cameras import look_at_origin, shot
from synth.exr import read_passes
from synth.mesh_items import Item
from synth.points import SurfacePoints, sample_surface
from synth.settings import Settings

from gsopt.errors import GsoptError


def test_coding_is_that_of_the_standard() -> None:
    """IEC 61966-2-1: 8-bit codes survive decoding to light by the inverse formula and coding again."""
    code = np.arange(256) / 255.0
    light = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    assert np.array_equal(np.rint(255 * pixels.srgb_from_linear(light)), np.arange(256))
    assert np.allclose(pixels.srgb_from_linear(np.array([-1.0, 7.0])), [0.0, 1.0], atol=1e-12)


@pytest.mark.parametrize("alpha", [0.1, 0.5, 1.0])
def test_alpha_is_straight(alpha: float) -> None:
    """A premultiplied color of any coverage comes out as the color itself."""
    color = np.array([0.8, 0.2, 0.05])
    render = np.concatenate([alpha * color, [alpha]]).astype(np.float32).reshape(1, 1, 4)
    coded = pixels.straight_rgba(render)[0, 0]
    assert np.array_equal(coded[:3], np.rint(255 * pixels.srgb_from_linear(color)))
    assert coded[3] == round(255 * alpha)
    assert np.array_equal(pixels.straight_rgba(0 * render)[0, 0], [0, 0, 0, 0])


def test_a_background_shows_where_nothing_covers_it() -> None:
    rgba = np.array([[[200, 100, 0, 0], [200, 100, 0, 255], [200, 100, 0, 51]]], np.uint8)
    assert pixels.over(rgba, (10, 20, 30)).tolist() == [[[10, 20, 30], [200, 100, 0], [48, 36, 24]]]


@examples(max_examples=20, deadline=None)
@given(st.integers(1, 9), st.integers(1, 9), st.sampled_from([None, 3, 4]), st.integers(0, 99))
def test_png_keeps_every_pixel(height: int, width: int, channels: int | None, seed: int) -> None:
    shape = (height, width) if channels is None else (height, width, channels)
    picture = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    content = pixels.png(picture)
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(content))), picture)
    assert content == pixels.png(picture)


def test_a_contact_sheet_shows_all_tiles_in_their_order() -> None:
    colors = np.arange(11, dtype=np.uint8) * 20
    tiles = np.broadcast_to(colors[:, None, None, None], (11, 30, 40, 3))
    sheet = pixels.contact_sheet([tiles, tiles[:3]], most=160)
    assert sheet.shape == (3 * (30 // 2), 8 * (40 // 2), 3)
    centers = sheet[7::15, 10::20, 0]
    assert centers[0].tolist() == colors[:8].tolist()
    assert centers[1, :3].tolist() == colors[8:].tolist()
    assert centers[2, :3].tolist() == colors[:3].tolist()


def exr(channels: dict[str, np.ndarray], version: int = 2, compression: int = 0) -> bytes:
    """A scanline EXR of float channels, rows stored bottom first."""
    height, width = next(iter(channels.values())).shape
    names = sorted(channels)

    def attribute(name: str, kind: str, value: bytes) -> bytes:
        return f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value

    listing = b"".join(n.encode() + b"\0" + struct.pack("<iIii", 2, 0, 1, 1) for n in names) + b"\0"
    header = struct.pack("<ii", 20000630, version)
    header += attribute("channels", "chlist", listing) + attribute("compression", "compression", bytes([compression]))
    header += attribute("dataWindow", "box2i", struct.pack("<4i", 0, 0, width - 1, height - 1)) + b"\0"
    rows = b""
    for y in reversed(range(height)):
        row = b"".join(channels[n][y].astype("<f4").tobytes() for n in names)
        rows += struct.pack("<ii", y, len(row)) + row
    return header + bytes(8 * height) + rows


def test_passes_come_out_of_an_exr_the_right_way_up(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    names = [f"L.Combined.{c}" for c in "RGBA"] + ["L.Depth.Z"] + [f"L.Normal.{c}" for c in "XYZ"] + ["L.Mist.Z"]
    planes = {name: rng.normal(size=(3, 5)).astype(np.float32) for name in names}
    (tmp_path / "a.exr").write_bytes(exr(planes))
    passes = read_passes(tmp_path / "a.exr")
    assert sorted(passes) == ["color", "depth", "normals"]
    assert np.array_equal(passes["color"], np.stack([planes[f"L.Combined.{c}"] for c in "RGBA"], axis=2))
    assert np.array_equal(passes["depth"][..., 0], planes["L.Depth.Z"])
    assert np.array_equal(passes["normals"], np.stack([planes[f"L.Normal.{c}"] for c in "XYZ"], axis=2))


@pytest.mark.parametrize("kind", [{"compression": 3}, {"version": 0x1002}])
def test_another_kind_of_exr_is_refused(kind: dict[str, int], tmp_path: Path) -> None:
    (tmp_path / "a.exr").write_bytes(exr({"L.Depth.Z": np.zeros((1, 1))}, **kind))
    with pytest.raises(GsoptError, match="scanline"):
        read_passes(tmp_path / "a.exr")


SQUARES = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0, 5], [3, 0, 5], [0, 3, 5]], [[9, 9, 9]] * 3], float)


def test_samples_are_spread_by_area_and_lie_on_their_triangles() -> None:
    xyz, normals = sample_surface(SQUARES, 20_000, np.random.default_rng(1))
    large = xyz[:, 2] > 2
    assert large.mean() == pytest.approx(0.9, abs=0.02)
    assert np.array_equal(np.unique(xyz[:, 2]), [0.0, 5.0])  # never on the triangle without area
    assert np.allclose(normals, [0, 0, 1])
    assert (xyz[large, :2].sum(axis=1) <= 3 + 1e-9).all()
    assert np.allclose(xyz[large, :2].mean(axis=0), 1.0, atol=0.05)  # the centroid: no corner is favored


def test_a_point_takes_the_color_of_its_pixel_and_hidden_ones_are_dropped() -> None:
    settings = Settings(resolution=(40, 20))
    view = shot(settings, "train_000", "train", look_at_origin(np.array([(0.0, 0.0, 4.0)]))[0])
    triangles = np.array(
        [[[-0.5, -0.3, 0], [0.5, -0.3, 0], [0, 0.3, 0]], [[-0.5, -0.3, -1], [0.5, -0.3, -1], [0, 0.3, -1]]]
    )
    points = SurfacePoints(triangles[:, ::-1], 200, 0)
    rgba = np.zeros((20, 40, 4), np.uint8)
    rgba[..., 0], rgba[..., 1], rgba[..., 3] = np.arange(40), np.arange(20)[:, None], 255
    points.see(view, rgba, np.full((20, 40), 4.0, np.float32))
    xyz, normals, rgb = points.found()
    assert len(xyz) == 200
    assert np.array_equal(xyz[:, 2], np.zeros(200))  # the lower triangle is behind the depth
    assert np.allclose(normals, [0, 0, 1])  # the winding said down, the camera is above
    assert np.array_equal(rgb[:, 0], np.floor(20 + settings.focal * xyz[:, 0] / 4))
    assert np.array_equal(rgb[:, 1], np.floor(10 - settings.focal * xyz[:, 1] / 4))


def test_captions_say_what_is_known() -> None:
    rgba = np.full((20, 20, 4), 255, np.uint8)
    rgba[:, :8, :3] = (120, 70, 35)
    counts = captions.total_colors([captions.count_colors(rgba)] * 2)
    chair = Item("a", Path("a.obj"), category="chair", front=(0.0, 1.0))
    assert captions.object_caption(chair, counts) == "a white and brown chair"
    assert captions.object_caption(Item("a", Path("a.obj")), {"orange": 3}) == "an orange object"
    assert captions.object_caption(Item("a", Path("a.obj"), caption="my own words"), counts) == "my own words"
    apples, glass = (Item("a", Path("a.obj"), name=name) for name in ("Apples", "Glass"))
    assert captions.object_caption(apples, {"red": 9, "green": 1}) == "red apples"
    assert captions.object_caption(glass, {"light gray": 5, "white": 4}) == "a light gray glass"
    assert captions.object_caption(glass, {"black": 5, "white": 4}) == "a black and white glass"
    for name, rgb in captions.PALETTE:
        assert captions.count_colors(np.broadcast_to(np.array([*rgb, 255], np.uint8), (7, 7, 4))) == {name: 7}
    poses = look_at_origin(np.array([(0.0, 3.0, 0.1), (3.0, 0.0, 2.0), (0.0, -3.0, -2.0), (0.0, 0.1, 3.0)]))
    seen = [captions.view_caption("x", shot(Settings(), "v", "train", p), chair.front) for p in poses]
    # Facing +y, its own left hand points to -x: a camera on +x sees its right side.
    assert seen == ["x, front view", "x, right side view, seen from above", "x, back view, seen from below",
                    "x, seen from directly above"]  # fmt: skip
    assert captions.view_caption("x", shot(Settings(), "v", "train", poses[0]), None) == "x"
