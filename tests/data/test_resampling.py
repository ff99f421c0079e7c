"""Laws of the area filter and of premultiplied pixels."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gsopt.data.resample import ROWS, area_downscale, downscaled, downscaled_size, premultiply, unpremultiply

sizes = st.integers(1, 40)


@settings(max_examples=50, deadline=None)
@given(sizes, sizes, st.integers(1, 40), st.integers(1, 40))
def test_each_target_pixel_is_the_mean_of_its_exact_footprint(w: int, h: int, new_w: int, new_h: int) -> None:
    new_w, new_h = min(w, new_w), min(h, new_h)
    planes = torch.rand(2, h, w, generator=torch.Generator().manual_seed(w * 41 + h), dtype=torch.float64)
    # Enlarge without interpolation to a common multiple, then average whole blocks.
    fine = planes.repeat_interleave(new_h, dim=1).repeat_interleave(new_w, dim=2)
    want = fine.view(2, new_h, h, new_w, w).mean(dim=(2, 4))
    got = area_downscale(planes.float(), new_w, new_h)
    assert torch.allclose(got.double(), want, atol=1e-5)


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("height", [1, ROWS - 1, ROWS, ROWS + 1, 3 * ROWS + 7])
def test_rows_at_a_time_give_the_bits_of_the_whole_image(height: int, channels: int) -> None:
    pixels = torch.randint(0, 256, (height, 37, channels), generator=torch.Generator().manual_seed(0)).byte()
    size = (11, -(-height // 3))
    assert torch.equal(downscaled(pixels, *size), unpremultiply(area_downscale(premultiply(pixels), *size)))


def test_enlarging_is_refused() -> None:
    with pytest.raises(ValueError, match="cannot enlarge"):
        area_downscale(torch.zeros(1, 4, 4), 5, 4)


@pytest.mark.parametrize(
    ("extent", "factor", "want"), [(4946, 4, 1237), (3286, 4, 822), (7, 2, 4), (5, 8, 1), (1, 100, 1)]
)
def test_sizes_are_rounded_as_the_published_folders_are(extent: int, factor: int, want: int) -> None:
    assert downscaled_size(extent, factor) == want


def test_premultiplying_and_back_keeps_every_opaque_and_half_transparent_color() -> None:
    alpha = torch.tensor([255, 254, 128, 1, 0], dtype=torch.uint8)
    pixels = torch.randint(0, 256, (5, 64, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    rgba = torch.cat([pixels, alpha[:, None, None].expand(5, 64, 1)], dim=2)
    back = unpremultiply(premultiply(rgba))
    assert torch.equal(back[:4], rgba[:4])
    assert int(back[4].max()) == 0


def test_transparent_colors_do_not_bleed_into_the_edge() -> None:
    rgba = torch.zeros(2, 2, 4, dtype=torch.uint8)
    rgba[0, 0] = torch.tensor([200, 100, 50, 255])
    rgba[1, 1] = torch.tensor([0, 255, 255, 0])
    small = unpremultiply(area_downscale(premultiply(rgba), 1, 1))
    assert small[0, 0].tolist() == [200, 100, 50, 64]
