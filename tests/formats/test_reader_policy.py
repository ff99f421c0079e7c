"""Files that other tools write open: infinite logits are clamped, what cannot be drawn is left out and counted once."""

from __future__ import annotations

import gzip
import struct
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData
from splat_samples import make_splats, same_bits

from gsopt.cli import main
from gsopt.errors import InputError, InputWarning
from gsopt.formats import load_splats, save_splats
from gsopt.formats.validation import BYTE_OPACITY_MARGIN
from gsopt.gaussians import Gaussians
from gsopt.raster.backend import ALPHA_MAX, ALPHA_MIN

BYTE_FORMATS = (".splat", ".spz", ".compressed.ply")


def write_raw(path: Path, splats: Gaussians) -> None:
    """An Inria PLY of values that our own writer would refuse."""
    save_splats(path, make_splats(len(splats), degree=splats.sh_degree))
    table = PlyData.read(path, mmap=False)["vertex"].data
    columns = {"opacity": splats.logit_opacities, "x": splats.means[:, 0], "f_rest_0": splats.shN[:, 0, 0]}
    columns |= {f"scale_{i}": splats.log_scales[:, i] for i in range(3)}
    columns |= {f"rot_{i}": splats.quats[:, i] for i in range(4)}
    for name, values in columns.items():
        table[name] = values.numpy()
    head, _ = path.read_bytes().split(b"end_header\n", 1)
    path.write_bytes(head + b"end_header\n" + table.tobytes())


def spoiled() -> Gaussians:
    """Eight splats: two with infinite logits, five that cannot be drawn, one that is fine."""
    splats = make_splats(8, degree=1)
    splats.logit_opacities[:2] = torch.tensor([-torch.inf, torch.inf])
    splats.log_scales[2, 1] = -torch.inf
    splats.means[3, 0] = torch.inf
    splats.quats[4] = 0
    splats.shN[5, 0, 0] = torch.nan
    splats.logit_opacities[6] = torch.nan
    return splats


def test_bad_splats_are_left_out_and_counted_in_one_warning(tmp_path: Path) -> None:
    write_raw(tmp_path / "a.ply", spoiled())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        splats = load_splats(tmp_path / "a.ply")
    assert [(w.category, "5 of 8 splats" in str(w.message)) for w in caught] == [(InputWarning, True)]
    assert torch.equal(splats.quats, make_splats(8, degree=1).quats[[0, 1, 7]])


def test_an_infinite_logit_renders_as_0_or_1_does(tmp_path: Path) -> None:
    write_raw(tmp_path / "a.ply", replace(make_splats(2, degree=1), logit_opacities=torch.tensor([-1.0, 1]) / 0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        low, high = load_splats(tmp_path / "a.ply").opacities.tolist()
    assert low < ALPHA_MIN
    assert high >= ALPHA_MAX
    assert (low, high) == pytest.approx((BYTE_OPACITY_MARGIN, 1 - BYTE_OPACITY_MARGIN), rel=1e-4)  # as of bytes


def test_strict_refuses_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_raw(tmp_path / "a.ply", spoiled())
    with pytest.raises(InputError, match="row"):
        load_splats(tmp_path / "a.ply", strict=True)
    assert main(["export", str(tmp_path / "a.ply"), "-o", str(tmp_path / "b.ply"), "--strict"]) == 3
    assert not (tmp_path / "b.ply").exists()
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_the_command_prints_one_line_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_raw(tmp_path / "a.ply", spoiled())
    for _ in range(2):  # a second run in one process says it again
        assert main(["export", str(tmp_path / "a.ply"), "-o", str(tmp_path / "b.ply"), "--force"]) == 0
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("gsopt: warning: ")
    assert len(load_splats(tmp_path / "b.ply", strict=True)) == 3


def test_a_file_without_a_usable_splat_is_refused(tmp_path: Path) -> None:
    write_raw(tmp_path / "a.ply", replace(make_splats(3, degree=1), quats=torch.zeros(3, 4)))
    with pytest.raises(InputError, match="no splat that can be drawn"):
        load_splats(tmp_path / "a.ply")


def test_a_good_file_keeps_its_bits(tmp_path: Path) -> None:
    save_splats(tmp_path / "a.ply", make_splats())
    assert same_bits(load_splats(tmp_path / "a.ply"), load_splats(tmp_path / "a.ply", strict=True))


def opacity_codes(path: Path) -> np.ndarray:
    """The stored opacities: bytes, or float32 of a .glb, read without gsopt."""
    data = path.read_bytes()
    match "".join(path.suffixes):
        case ".splat":
            return np.frombuffer(data, np.uint8).reshape(-1, 32)[:, 27]
        case ".spz":
            plain = gzip.decompress(data)
            (count,) = struct.unpack_from("<I", plain, 8)
            return np.frombuffer(plain, np.uint8)[16 + 9 * count : 16 + 10 * count]
        case _:
            return PlyData.read(path)["vertex"].data["packed_color"].astype(np.uint32) & 255


@pytest.mark.parametrize("suffix", BYTE_FORMATS)
def test_no_writer_stores_an_opacity_that_is_an_infinite_logit_elsewhere(tmp_path: Path, suffix: str) -> None:
    splats = replace(make_splats(4, degree=0), logit_opacities=torch.tensor([-200.0, -9, 9, 200]))
    path = tmp_path / f"a{suffix}"
    save_splats(path, splats)
    assert set(opacity_codes(path).tolist()) == {1, 254}


def test_a_glb_stores_opacities_between_0_and_1(tmp_path: Path) -> None:
    splats = replace(make_splats(2, degree=0), logit_opacities=torch.tensor([-200.0, 200]))
    save_splats(tmp_path / "a.glb", splats)
    opacities = load_splats(tmp_path / "a.glb").logit_opacities
    data = (tmp_path / "a.glb").read_bytes()
    assert opacities.abs().max() < 17
    assert np.float32(1 - 2**-24).tobytes() in data
