"""Codes of .sog, .spz and .ksplat by hand: single values, the sizes of images and palettes, buckets and bands."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from splat_samples import make_splats

from gsopt.errors import InputError
from gsopt.formats import ksplat, sog_codes, spz_codes


@pytest.mark.parametrize("count", [1, 2, 4, 5, 16, 17, 63, 64, 65, 145])
def test_an_image_of_a_sog_is_a_little_wider_than_high_and_four_pixels_divide_its_width(count: int) -> None:
    """No row is empty; pixels without a splat are black and opaque."""
    images, meta = sog_codes.encode(make_splats(count, degree=0))
    assert meta["count"] == count
    for pixels in images.values():
        height, width = pixels.shape[:2]
        assert width % 4 == 0
        assert (height - 1) * width < count <= height * width
        assert height <= width <= math.sqrt(count) + 8
        rest = pixels.reshape(-1, 4)[count:]
        assert rest.tolist() == [[0, 0, 0, 255]] * len(rest)


@pytest.mark.parametrize(
    ("wxyz", "codes"),
    [
        ([1, 0, 0, 0], [128, 128, 128, 252]),
        ([0, 1, 0, 0], [128, 128, 128, 253]),
        ([0, 0, -1, 0], [128, 128, 128, 254]),
        ([0, 0, 0, 1], [128, 128, 128, 255]),
        ([math.sqrt(0.5), -math.sqrt(0.5), 0, 0], [0, 128, 128, 252]),
        ([-math.sqrt(0.5), 0, 0, -math.sqrt(0.5)], [128, 128, 255, 252]),
        ([-0.8, 0, 0.6, 0], [128, round((0.5 - 0.6 * math.sqrt(0.5)) * 255), 128, 252]),
    ],
)
def test_a_rotation_of_a_sog_is_its_smaller_components_and_the_name_of_the_largest(
    wxyz: list[float], codes: list[int]
) -> None:
    packed = sog_codes._pack_quats(np.array([wxyz], dtype=float))
    assert packed.tolist() == [codes]
    back = sog_codes._unpack_quats(packed)[0]
    assert abs(float(back @ np.array(wxyz))) == pytest.approx(1, abs=1e-4)


def test_a_rotation_of_a_sog_without_a_valid_mark_is_none() -> None:
    pixels = np.array([[3, 200, 90, 251], [0, 0, 0, 0]], dtype=np.uint8)
    assert sog_codes._unpack_quats(pixels).tolist() == [[1, 0, 0, 0]] * 2


def test_positions_of_a_sog_are_even_steps_of_the_logarithm_between_its_ends() -> None:
    """Along x from -(e - 1) to e^2 - 1; all lie in one plane of y, which divides by nothing."""
    ends = [-math.expm1(1), 0.0, math.expm1(2)]
    means = np.array([[x, 5.0, x] for x in ends])
    with np.errstate(all="raise"):
        low, high, mins, maxs = sog_codes._pack_means(means)
    assert mins == pytest.approx([-1, math.log(6), -1])
    assert maxs == pytest.approx([2, math.log(6), 2])
    codes = low.astype(int) + 256 * high.astype(int)
    assert codes[:, 0].tolist() == codes[:, 2].tolist() == [0, round(65535 / 3), 65535]
    assert codes[:, 1].tolist() == [0, 0, 0]
    back = sog_codes.unpack_means(low, high, np.array(mins, np.float32), np.array(maxs, np.float32))
    np.testing.assert_allclose(back, means, atol=1e-4, rtol=1e-5)


def test_a_codebook_holds_up_to_256_values_exactly_and_gives_each_the_nearest_level() -> None:
    few = np.repeat(np.array([-7.0, -1.0, 0.5, 3.0], np.float32), [1, 10, 300, 4])
    levels, codes = sog_codes.codebook(few)
    assert np.array(levels)[codes].tolist() == few.tolist()
    many = np.random.default_rng(0).normal(size=(3000, 3)).astype(np.float32)
    levels, codes = sog_codes.codebook(many)
    assert levels == sorted(levels)
    assert len(levels) == 256
    off = np.abs(many[..., None] - np.array(levels))
    np.testing.assert_allclose(np.take_along_axis(off, codes[..., None].astype(int), 2)[..., 0], off.min(2), atol=1e-7)


def halves(rows: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """As many centers as asked for."""
    return np.zeros((count, rows.shape[1]), np.float32), np.arange(len(rows)) % count


@pytest.mark.parametrize(
    ("splats", "entries"),
    [(1, 1), (300, 300), (1024, 1024), (5000, 1024), (8192, 1024), (8208, 1026), (16384, 2048), (20480, 2560)],
)
def test_a_palette_has_an_entry_for_eight_splats_or_1024_or_one_each(
    splats: int, entries: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sog_codes, "_clusters", halves)
    palette, labels = sog_codes._palette(np.zeros((splats, 1), np.float32))
    assert abs(len(palette) - entries) <= splats // 256  # each group rounds down
    assert len(palette) <= entries
    assert sorted(set(labels.tolist())) == list(range(len(palette)))


def test_groups_without_splats_take_no_entries_of_a_palette(monkeypatch: pytest.MonkeyPatch) -> None:
    """2048 splats in groups 0, 1, 2 and 7: of 1024 entries each gets 256."""

    def clusters(rows: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        centers, labels = halves(rows, count)
        return centers, np.array([0, 1, 2, 7])[np.arange(2048) % 4] if len(rows) == 2048 else labels

    monkeypatch.setattr(sog_codes, "_clusters", clusters)
    palette, labels = sog_codes._palette(np.zeros((2048, 1), np.float32))
    assert len(palette) == 1024
    assert np.bincount(labels).tolist() == [2] * 1024


def test_clusters_are_means_of_what_is_nearest_to_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the size of the blocks in which distances are computed."""
    apart = np.array([[0.0, 0, 0], [100, 0, 0], [0, 100, 0]], np.float32)
    spread = np.array([[-1.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, -2, 0]], np.float32)
    rows = (apart[:, None] + spread).reshape(-1, 3)
    for block in (1, 5, 12, 1 << 13):
        monkeypatch.setattr(sog_codes, "_BLOCK", block)
        centers, labels = sog_codes._clusters(rows, 3)
        assert labels.tolist() == [0] * 4 + [1] * 4 + [2] * 4
        np.testing.assert_allclose(centers, apart, atol=1e-5)
        assert sog_codes._clusters(rows[:4], 1)[1].tolist() == [0] * 4


@pytest.mark.parametrize(("version", "rotation"), [(2, 3), (3, 4), (4, 4)])
@pytest.mark.parametrize(("degree", "bands"), [(0, 0), (1, 3), (2, 8), (3, 15)])
def test_streams_of_an_spz_have_the_bytes_of_its_layout(version: int, rotation: int, degree: int, bands: int) -> None:
    sizes = spz_codes.stream_sizes(10, degree, version)
    assert sizes == (90, 10, 30, 30, 10 * rotation, 30 * bands)


@pytest.mark.parametrize(
    ("farthest", "bits"),
    [(0.0, 16), (1.0, 16), ((2**23 - 1) / 2**16, 16), (128.0, 15), (255.9, 15), (2.0**23 - 1, 0)],
)
def test_positions_of_an_spz_have_as_many_fraction_bits_as_the_farthest_one_leaves(farthest: float, bits: int) -> None:
    means = torch.tensor([[0.0, -farthest, 0.0]])
    assert spz_codes._fraction_bits(means, Path("a.spz")) == bits
    assert spz_codes._fraction_bits(means[:0], Path("a.spz")) == 16


def test_positions_of_an_spz_are_24_bits_in_twos_complement() -> None:
    means = torch.tensor([[1.5, -0.25, 0.0], [-2.0, 0.1, 0.15]])
    codes = spz_codes._pack_positions(means, 2)
    assert codes.tolist() == [[[6, 0, 0], [255, 255, 255], [0, 0, 0]], [[248, 255, 255], [0, 0, 0], [1, 0, 0]]]
    assert spz_codes._unpack_positions(codes, 2).tolist() == [[1.5, -0.25, 0], [-2, 0, 0.25]]
    ends = torch.tensor([[2.0**23 - 1, -(2.0**23) + 1, 70000.0]])
    assert spz_codes._unpack_positions(spz_codes._pack_positions(ends, 0), 0).tolist() == ends.tolist()


def test_harmonics_of_an_spz_keep_five_bits_in_band_1_and_four_beyond() -> None:
    """128 is zero and a 128th is one: steps are of 8 and of 16, to the nearest."""

    def code(value: float, row: int) -> int:
        shN = torch.zeros(1, 15, 3)
        shN[0, row, 1] = value / 128
        return int(spz_codes._pack_bands(shN)[0, row, 1])

    for row, step in ((0, 8), (2, 8), (3, 16), (14, 16)):
        half = step // 2
        assert [code(value, row) for value in (0, half - 1, half, step, -half, -half - 1)] == [
            128,
            128,
            128 + step,
            128 + step,
            128,
            128 - step,
        ]
        assert (code(500, row), code(-500, row)) == (255, 0)


@pytest.mark.parametrize(
    ("xyzw", "largest", "fields"),
    [
        ([0, 0, 0, 1], 3, [0, 0, 0]),
        ([1, 0, 0, 0], 0, [0, 0, 0]),
        ([0, -1, 0, 0], 1, [0, 0, 0]),
        ([math.sqrt(0.5), 0, -math.sqrt(0.5), 0], 0, [0, 512 + 511, 0]),
        ([-0.8, 0.6, 0, 0], 0, [512 + round(0.6 / math.sqrt(0.5) * 511), 0, 0]),
    ],
)
def test_a_rotation_of_an_spz_is_the_name_of_its_largest_component_and_three_fields_of_ten_bits(
    xyzw: list[float], largest: int, fields: list[int]
) -> None:
    """A sign and nine bits of magnitude each, from the first of the others down; the largest one is not negative."""
    quat = torch.tensor([[xyzw[3], *xyzw[:3]]], dtype=torch.float64).float()
    code = int(spz_codes._pack_smallest_three(quat)[0])
    found = [code >> 20 & 1023, code >> 10 & 1023, code & 1023]
    assert code >> 30 == largest
    assert [field & 511 for field in found] == [field & 511 for field in fields]
    assert [field >> 9 for field in found if field & 511] == [field >> 9 for field in fields if field & 511]
    back = spz_codes._unpack_smallest_three(np.array([code], "<u4").view(np.uint8))[0]
    assert abs(float(back @ quat[0])) == pytest.approx(1, abs=1e-4)


def section(**changed: Any) -> ksplat._Section:
    """Two full buckets of three splats and two partly filled ones."""
    given = {
        "count": 9,
        "capacity": 9,
        "bucket_size": 3,
        "buckets": 4,
        "block": 5.0,
        "bucket_bytes": 12,
        "half_range": 32767,
        "full_buckets": 2,
        "partial_buckets": 2,
        "bands": 0,
    }
    return ksplat._Section(**{**given, **changed})


def test_splats_of_a_ksplat_fill_whole_buckets_first_and_then_the_others_by_their_sizes() -> None:
    sizes = np.array([1, 2], np.uint32)
    assert ksplat._bucket_of_rows(section(), sizes, Path("a")).tolist() == [0, 0, 0, 1, 1, 1, 2, 3, 3]
    assert ksplat._bucket_of_rows(section(count=4), sizes, Path("a")).tolist() == [0, 0, 0, 1]
    alone = section(full_buckets=0, count=3, buckets=2)
    assert ksplat._bucket_of_rows(alone, sizes, Path("a")).tolist() == [0, 1, 1]
    none = section(full_buckets=0, partial_buckets=0, count=0, buckets=0, bucket_size=0)
    assert ksplat._bucket_of_rows(none, sizes[:0], Path("a")).tolist() == []


def test_buckets_of_a_ksplat_that_hold_too_few_splats_or_are_not_there_are_refused() -> None:
    sizes = np.array([1, 2], np.uint32)
    with pytest.raises(InputError, match="fewer than its 10 splats"):
        ksplat._bucket_of_rows(section(count=10), sizes, Path("a"))
    with pytest.raises(InputError, match="fewer than its 7 splats"):
        ksplat._bucket_of_rows(section(count=7), sizes[:0], Path("a"))
    with pytest.raises(InputError, match="bucket 3 of 3"):
        ksplat._bucket_of_rows(section(buckets=3), sizes, Path("a"))


@pytest.mark.parametrize(("bands", "degree"), [(0, 0), (3, 1), (8, 2), (15, 3)])
def test_harmonics_of_a_ksplat_are_read_band_by_band_and_color_by_color(bands: int, degree: int) -> None:
    """Of band l there are 2 l + 1 of red, then of green, then of blue."""
    rest = torch.arange(3.0 * bands)[None]
    found = ksplat._bands(rest, bands)
    assert found.shape == (1, bands, 3)
    begin = row = 0
    for band in range(1, degree + 1):
        width = 2 * band + 1
        for color in range(3):
            assert found[0, row : row + width, color].tolist() == list(range(begin, begin + width))
            begin += width
        row += width


@pytest.mark.parametrize(("count", "degree", "bands"), [(5, 1, 3), (64, 1, 3), (65, 1, 3), (300, 1, 3), (70, 3, 15)])
def test_a_palette_of_a_sog_has_64_entries_a_row_and_each_splat_the_number_of_its_own(
    count: int, degree: int, bands: int
) -> None:
    """The coefficients of an entry stand beside each other, a pixel for red, green and blue; the rest is white."""
    values = np.linspace(-0.5, 0.5, 16).astype(np.float32)
    shN = np.random.default_rng(0).choice(values, (count, bands, 3))
    image, halves, found = sog_codes._pack_bands(shN, degree)
    rows = math.ceil(found["count"] / 64)
    assert (image.shape, found["bands"]) == ((rows, 64 * bands, 4), degree)
    assert found["files"] == ["shN_centroids.webp", "shN_labels.webp"]
    levels = np.array(found["codebook"])
    for splat, (low, high) in enumerate(halves.tolist()):
        row, place = divmod(low + 256 * high, 64)
        pixels = image[row, place * bands : (place + 1) * bands]
        np.testing.assert_allclose(levels[pixels[:, :3]], shN[splat], atol=1e-6)
    assert (image[..., 3] == 255).all()
    assert (image.reshape(-1, 4)[found["count"] * bands :] == 255).all()
