"""The loss of a quantized format stays inside the bounds that its writer's docstring states."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from splat_samples import errors, make_splats, same_bits

from gsopt.errors import InputError
from gsopt.formats import load_splats, save_splats
from gsopt.formats.compressed_ply import CHUNK
from gsopt.gaussians import Gaussians
from gsopt.geometry.morton import morton_order

BYTE = 0.5 / 255 + 1e-6
END = 1 / 255 + 1e-6
"""Bytes 0 and 255 are infinite logits elsewhere, so that no writer uses them for opacities."""
C0 = 0.28209479177387814


def round_trip(path: Path, splats: Gaussians) -> Gaussians:
    save_splats(path, splats)
    return load_splats(path)


@pytest.mark.parametrize("degree", range(4))
def test_splat_loses_what_it_says(tmp_path: Path, degree: int) -> None:
    splats = make_splats(degree=degree)
    back = round_trip(tmp_path / "a.splat", splats)
    assert back.sh_degree == 0
    lost = errors(splats.with_sh_degree(0), back)
    assert lost.means == 0
    assert lost.log_scales < 1e-5
    assert lost.opacities <= BYTE
    assert lost.sh0 <= BYTE / C0
    assert lost.quats <= 1 / 128


@pytest.mark.parametrize("degree", range(4))
def test_spz_loses_what_it_says(tmp_path: Path, degree: int) -> None:
    splats = make_splats(degree=degree)
    back = round_trip(tmp_path / "a.spz", splats)
    lost = errors(splats, back)
    assert lost.means <= 2**-17
    assert lost.log_scales <= 1 / 32 + 1e-6
    assert lost.opacities <= BYTE
    assert lost.sh0 <= 0.0131
    assert lost.sh1 <= 0.036
    assert lost.sh_rest <= 0.067
    assert lost.quats <= 0.0022


@pytest.mark.parametrize(("extent", "bits"), [(1, 16), (127, 16), (129, 15), (2047, 12), (8e6, 0)])
def test_spz_gives_large_scenes_fewer_fraction_bits(tmp_path: Path, extent: float, bits: int) -> None:
    splats = make_splats()
    splats.means[:] *= extent / splats.means.abs().max()
    assert errors(splats, round_trip(tmp_path / "a.spz", splats)).means <= 0.5 * 2.0**-bits


def test_spz_refuses_what_24_bits_cannot_hold(tmp_path: Path) -> None:
    splats = make_splats()
    splats.means[7, 1] = 1e7
    with pytest.raises(InputError, match="coordinates"):
        save_splats(tmp_path / "a.spz", splats)


@pytest.mark.parametrize("degree", range(4))
def test_compressed_ply_loses_what_it_says(tmp_path: Path, degree: int) -> None:
    splats = make_splats(count=700, degree=degree)
    back = round_trip(tmp_path / "a.compressed.ply", splats)
    splats = splats.select(morton_order(splats.means.double().flip(-1)))
    for start in range(0, len(splats), CHUNK):
        rows = torch.arange(start, min(start + CHUNK, len(splats)))
        a, b = splats.select(rows), back.select(rows)
        steps = torch.tensor([1 / 4094, 1 / 2046, 1 / 4094])
        for name in ("means", "log_scales"):
            x, y = getattr(a, name), getattr(b, name)
            assert bool(((x - y).abs() <= (x.amax(0) - x.amin(0)) * steps + 2e-6).all())
        extent = a.sh0.amax(0) - a.sh0.amin(0)
        assert bool(((a.sh0 - b.sh0).abs() <= extent / 510 + 2e-6).all())
        lost = errors(a, b)
        assert lost.opacities <= BYTE
        assert max(lost.sh1, lost.sh_rest) <= 1 / 64 + 1e-6
        assert lost.quats <= 0.0021


@pytest.mark.parametrize("degree", range(4))
def test_glb_loses_only_roundings(tmp_path: Path, degree: int) -> None:
    splats = make_splats(degree=degree)
    lost = errors(splats, round_trip(tmp_path / "a.glb", splats))
    assert (lost.means, lost.sh0, lost.sh1, lost.sh_rest) == (0, 0, 0, 0)
    assert lost.log_scales <= 1e-5
    assert lost.opacities <= 1e-7
    assert lost.quats <= 2e-7


def test_spz_of_what_spz_gave_is_the_same_file(tmp_path: Path) -> None:
    once = round_trip(tmp_path / "a.spz", make_splats())
    save_splats(tmp_path / "b.spz", once)
    assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()


def test_splat_of_what_splat_gave_differs_in_rotations_only(tmp_path: Path) -> None:
    """Rotations are made unit again, which may move a byte; colors, opacities and scales are at rest."""
    once = round_trip(tmp_path / "a.splat", make_splats())
    twice = round_trip(tmp_path / "b.splat", once)
    assert same_bits(replace(once, quats=twice.quats), twice)


IN_MORTON_ORDER = (".compressed.ply", ".sog")
LOSSY = [".splat", ".spz", ".compressed.ply", ".sog", ".glb"]
LARGEST_HARMONIC = {".spz": 1.0, ".compressed.ply": 4.0, ".sog": 100.0, ".glb": 1e30}
"""The end of each format's range of bands 1 and up; .splat has none."""


def rows_of(splats: Gaussians, suffix: str) -> Gaussians:
    """The splats in the order in which the format's writer stores them."""
    return splats.select(morton_order(splats.means.double().flip(-1))) if suffix in IN_MORTON_ORDER else splats


@pytest.mark.parametrize("suffix", LOSSY)
def test_extremes_are_clamped_to_the_end_of_their_side(tmp_path: Path, suffix: str) -> None:
    """Values at the end of float32's range stay finite and keep their sign: no code wraps around."""
    splats = make_splats(4)
    for row, sign in ((0, -1), (1, 1)):
        splats.log_scales[row] = splats.logit_opacities[row] = splats.sh0[row] = splats.shN[row] = sign * 1e30
    splats.quats[0], splats.quats[1] = torch.tensor([1e-18, 0, 0, 0]), torch.tensor([0, 0, 1e18, 0])
    back = round_trip(tmp_path / f"a{suffix}", splats)
    low = rows_of(splats, suffix).logit_opacities.argmin()
    high = rows_of(splats, suffix).logit_opacities.argmax()
    assert back.opacities[low] <= END
    assert back.opacities[high] >= 1 - END
    assert back.log_scales[low].max() < -9
    assert back.log_scales[high].min() > 5
    assert back.sh0[low].max() <= -0.5 / C0 + 1e-5
    assert back.sh0[high].min() >= 0.5 / C0 - 1e-5
    if suffix != ".splat":
        bound = LARGEST_HARMONIC[suffix]
        assert back.shN[low].max() <= -0.93 * bound
        assert back.shN[high].min() >= 0.93 * bound


@pytest.mark.parametrize("suffix", LOSSY)
def test_an_extreme_splat_leaves_the_others_as_they_are(tmp_path: Path, suffix: str) -> None:
    """A dead splat (log-scale -1e6) coarsens its chunk to ±20 at most, and nothing else."""
    splats = make_splats(4, degree=0)
    splats.log_scales[0] = -1e6
    back, ordered = round_trip(tmp_path / f"a{suffix}", splats), rows_of(splats, suffix)
    others = (ordered.log_scales > -1e6).all(dim=1)
    step = 40 / 2046 if suffix == ".compressed.ply" else 1 / 32
    assert int(others.sum()) == 3
    assert errors(ordered.select(others), back.select(others)).log_scales <= step


@pytest.mark.parametrize("value", [0.9, 0.97, 1.0, 1.05, 2.0, 100.0])
def test_harmonics_beyond_the_range_of_spz_are_clamped(tmp_path: Path, value: float) -> None:
    splats = make_splats(2)
    splats.shN[0], splats.shN[1] = value, -value
    back = round_trip(tmp_path / "a.spz", splats)
    assert back.shN[0].min() >= min(value, 0.99) - 0.067
    assert back.shN[1].max() <= 0.067 - min(value, 0.99)


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".splat", ".spz"])
def test_no_splats_come_back_as_no_splats(tmp_path: Path, suffix: str) -> None:
    back = round_trip(tmp_path / f"a{suffix}", make_splats(0, degree=2))
    assert len(back) == 0
    assert back.sh_degree in (0, 2)


@pytest.mark.parametrize("suffix", [".glb", ".sog"])
def test_a_file_of_no_splats_is_refused_where_the_format_has_none(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(InputError, match="at least one"):
        save_splats(tmp_path / f"a{suffix}", make_splats(0))


@pytest.mark.parametrize("degree", range(4))
def test_sog_loses_what_it_says(tmp_path: Path, degree: int) -> None:
    """Uniform values are the worst case of the codebooks: half of 1/256 of the extent, a little more at the ends."""
    splats = make_splats(count=3000, degree=degree)
    splats.shN[:] = splats.shN[:: 3000 // 100].repeat_interleave(30, dim=0)  # a palette of 375 holds 100 harmonics
    back = round_trip(tmp_path / "a.sog", splats)
    splats = rows_of(splats, ".sog")
    lost = errors(splats, back)
    bent = splats.means.abs().log1p() * splats.means.sign()
    step = (bent.amax(0) - bent.amin(0)) / 65535
    assert bool(((splats.means - back.means).abs() <= 0.51 * step * (1 + splats.means.abs()) + 1e-6).all())
    assert lost.log_scales <= 10 / 256
    assert lost.sh0 <= 3.4 / 256
    assert lost.opacities <= BYTE
    assert lost.quats <= 0.006
    assert max(lost.sh1, lost.sh_rest) <= 2.4 / 256


def test_plain_and_compressed_ply_are_told_apart_by_content(tmp_path: Path) -> None:
    save_splats(tmp_path / "a.ply", make_splats(5))
    save_splats(tmp_path / "b.compressed.ply", make_splats(5))
    (tmp_path / "a.ply").rename(tmp_path / "c.compressed.ply")
    (tmp_path / "b.compressed.ply").rename(tmp_path / "d.ply")
    assert same_bits(load_splats(tmp_path / "c.compressed.ply"), make_splats(5))
    assert len(load_splats(tmp_path / "d.ply")) == 5


@pytest.mark.parametrize("suffix", [".sog", ".compressed.ply"])
def test_log_scales_are_held_to_20(tmp_path: Path, suffix: str) -> None:
    splats = make_splats(count=2)
    splats.log_scales[:] = torch.tensor([[-30.0] * 3, [30.0] * 3])
    found = round_trip(tmp_path / f"a{suffix}", splats).log_scales
    assert sorted(found.flatten().tolist()) == pytest.approx([-20.0] * 3 + [20.0] * 3, abs=0.02)
    splats.log_scales[:] *= 19.9 / 30
    found = round_trip(tmp_path / f"b{suffix}", splats).log_scales
    assert float(found.abs().min()) == pytest.approx(19.9, abs=0.02)


def test_coefficients_of_a_sog_are_held_to_100(tmp_path: Path) -> None:
    splats = make_splats(count=2, degree=1)
    signs = torch.tensor([-1.0, 1.0])[:, None, None]
    for value, held in ((300.0, 100.0), (99.5, 99.5)):
        splats.sh0[:], splats.shN[:] = value * signs, value * signs
        found = round_trip(tmp_path / f"{value}.sog", splats)
        for values in (found.sh0, found.shN):
            assert sorted(values[:, 0, 0].tolist()) == pytest.approx([-held, held], abs=0.1)
