"""OpenUSD: what is written is a ParticleField and comes back; transforms, axes and defaults are those of the schema."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from splat_samples import make_splats

from gsopt.cli import main
from gsopt.errors import InputError, MissingDependency
from gsopt.formats import load_splats, save_splats
from gsopt.formats.placement import placed
from gsopt.formats.units import UNKNOWN, Units, read_units
from gsopt.geometry.quats import normalize, rotation_matrices

pytest.importorskip("pxr")
from pxr import Gf, Usd, UsdGeom, UsdVol, Vt  # type: ignore[import-not-found]


@pytest.mark.parametrize("suffix", [".usda", ".usdc"])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_splats_come_back(tmp_path: Path, suffix: str, degree: int) -> None:
    splats = make_splats(40, degree=degree)
    save_splats(tmp_path / f"a{suffix}", splats)
    found = load_splats(tmp_path / f"a{suffix}")
    torch.testing.assert_close(found.means, splats.means, rtol=1e-6, atol=0)
    torch.testing.assert_close(found.log_scales, splats.log_scales, rtol=0, atol=1e-5)
    torch.testing.assert_close(found.opacities, splats.opacities, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.sh0, splats.sh0, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(found.shN, splats.shN, rtol=1e-6, atol=1e-6)
    apart = (normalize(found.quats) * normalize(splats.quats)).sum(1).abs()
    torch.testing.assert_close(apart, torch.ones(40), rtol=0, atol=1e-6)


def test_the_prim_says_what_the_schema_asks_for(tmp_path: Path) -> None:
    splats = make_splats(5, degree=2)
    save_splats(tmp_path / "a.usda", splats, units=Units(0.25))
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    prim = stage.GetDefaultPrim()
    assert prim.IsA(UsdVol.ParticleField)
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 0.25)
    positions = np.array(prim.GetAttribute("positions").Get())
    np.testing.assert_allclose(positions, splats.means.numpy() * [1, -1, -1], rtol=1e-6)
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 2
    assert len(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get()) == 5 * 9
    low, high = np.array(prim.GetAttribute("extent").Get())
    reach = 3 * splats.scales.amax(1, keepdim=True).numpy()  # standard deviations
    np.testing.assert_allclose([low, high], [(positions - reach).min(0), (positions + reach).max(0)], rtol=1e-5)


def made(path: Path, up: str = "Y", **attributes: Any) -> tuple[Any, Any]:
    """A stage with one field of two splats under a transform, not yet saved."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, up)
    UsdGeom.Xform.Define(stage, "/world").AddTransformOp().Set(
        Gf.Matrix4d().SetRotate(Gf.Rotation((0, 0, 1), 90))
        * Gf.Matrix4d().SetScale(2.0)
        * Gf.Matrix4d().SetTranslate((5, 6, 7))
    )
    prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/world/splats").GetPrim()
    prim.GetAttribute("positions").Set(Vt.Vec3fArray([(1, 0, 0), (0, 0, 3)]))
    prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(0)
    for name, value in attributes.items():
        prim.GetAttribute(name).Set(value)
    return stage, prim


@pytest.mark.parametrize("up", ["Y", "Z"])
def test_transforms_and_the_up_axis_are_followed(tmp_path: Path, up: str) -> None:
    """(1, 0, 0) turned about z, doubled and moved is (5, 8, 7); a PLY has y down and z forward."""
    stage, _ = made(tmp_path / "a.usda", up, scales=Vt.Vec3fArray([(0.1, 0.2, 0.3)] * 2))
    stage.Save()
    found = load_splats(tmp_path / "a.usda")
    expected = [5, -8, -7] if up == "Y" else [5, -7, 8]
    assert found.means[0].tolist() == pytest.approx(expected)
    assert found.log_scales[0].tolist() == pytest.approx([math.log(0.2 * x) for x in (1, 2, 3)], abs=1e-5)
    axis = rotation_matrices(found.quats[:1])[0][:, 0]
    assert axis.abs().tolist() == pytest.approx([0, 1, 0] if up == "Y" else [0, 0, 1], abs=1e-6)


def test_what_is_missing_or_too_short_has_its_default_and_half_precision_is_read(tmp_path: Path) -> None:
    stage, prim = made(tmp_path / "a.usda", opacities=Vt.FloatArray([0.5]))
    prim.GetAttribute("scalesh").Set(Vt.Vec3hArray([(0.5, 0.5, 0.5)] * 2))
    stage.Save()
    found = load_splats(tmp_path / "a.usda")
    assert found.opacities.tolist() == pytest.approx([1.0, 1.0], abs=1e-6)
    assert found.scales.tolist() == [pytest.approx([1.0] * 3)] * 2  # 0.5 in a world that doubles
    assert found.sh0.tolist() == [[[0.0] * 3]] * 2


def test_scale_and_origin_travel(tmp_path: Path) -> None:
    units = Units(0.125, (500000.5, -4e6, 12.0))
    for suffix in (".usda", ".usdc"):
        save_splats(tmp_path / f"a{suffix}", make_splats(3), units=units)
        assert read_units(tmp_path / f"a{suffix}") == units
        save_splats(tmp_path / f"b{suffix}", make_splats(3))
        assert read_units(tmp_path / f"b{suffix}") == UNKNOWN


def test_a_file_that_opens_others_is_refused(tmp_path: Path) -> None:
    save_splats(tmp_path / "a.usda", make_splats(3))
    for number, text in enumerate(("(\n    subLayers = [@a.usda@]\n)", 'def "x" (references = @a.usda@</splats>) {}')):
        path = tmp_path / f"b{number}.usda"
        path.write_text(f"#usda 1.0\n{text}\n")
        with pytest.raises(InputError, match="refers to other files"):
            load_splats(path)


def test_a_damaged_file_is_one_line_and_exit_code_3(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    save_splats(tmp_path / "a.usdc", make_splats(50))
    data = (tmp_path / "a.usdc").read_bytes()
    broken = [b"", b"PXR-USDC", data[: len(data) // 2], data[:88] + b"\xff" * (len(data) - 88), b"#usda 1.0\ndef {"]
    broken += [b'#usda 1.0\ndef Sphere "a" {}\n', b'#usda 1.0\ndef ParticleField3DGaussianSplat "a" {}\n']
    field = '#usda 1.0\ndef ParticleField3DGaussianSplat "a" {{\n{}\n}}\n'
    broken.append(field.format('string[] positions = ["x"]').encode())
    broken.append(
        field.format("point3f[] positions = [(0, 0, 0)]\nuniform int radiance:sphericalHarmonicsDegree = 99").encode()
    )
    for bytes_ in broken:
        (tmp_path / "b.usdc").write_bytes(bytes_)
        (tmp_path / "b.usda").write_bytes(bytes_)
        for name in ("b.usdc", "b.usda"):
            capfd.readouterr()
            assert main(["export", str(tmp_path / name), "-o", str(tmp_path / "c.ply")]) == 3, bytes_[:40]
            assert len([line for line in capfd.readouterr().err.splitlines() if line.startswith("gsopt: ")]) == 1
    assert not (tmp_path / "c.ply").exists()


def test_bytes_that_are_no_text_are_refused_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The library's own message repeats them, which cannot be printed."""
    monkeypatch.setattr("gsopt.formats.usd.require_survivable", lambda path: None)  # half a second each
    save_splats(tmp_path / "a.usda", make_splats(2))
    data = (tmp_path / "a.usda").read_bytes()
    for at in range(0, len(data), 7):
        (tmp_path / "b.usda").write_bytes(data[:at] + b"\xf6" + data[at + 1 :])
        with contextlib.suppress(InputError):
            load_splats(tmp_path / "b.usda")


def test_a_file_over_which_the_library_ends_its_process_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two changes of one byte that usd-core 26 aborts over; then any program that ends so."""
    save_splats(tmp_path / "a.usdc", make_splats(3, degree=1))
    data = (tmp_path / "a.usdc").read_bytes()
    for at, value in ((97, b"\xff"), (99, b"\1")):
        (tmp_path / "b.usdc").write_bytes(data[:at] + value + data[at + 1 :])
        with contextlib.suppress(InputError):
            load_splats(tmp_path / "b.usdc")
    (tmp_path / "ends.py").write_text("import os; os.abort()")
    monkeypatch.setattr("gsopt.formats.usd._PROBE", tmp_path / "ends.py")
    with pytest.raises(InputError, match=r"a\.usdc is no USD: the library that reads USD crashes over it"):
        load_splats(tmp_path / "a.usdc")


def test_sheared_splats_are_refused(tmp_path: Path) -> None:
    stage, prim = made(tmp_path / "a.usda")
    UsdGeom.Xformable(prim).AddScaleOp().Set((1, 2, 1))
    stage.Save()
    with pytest.raises(InputError, match="sheared"):
        load_splats(tmp_path / "a.usda")


def test_without_usd_core_the_message_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "pxr.Usd", None)
    with pytest.raises(MissingDependency, match=r"gsopt\[usd\]"):
        save_splats(tmp_path / "a.usda", make_splats(3))


def test_a_mirrored_field_is_a_mirrored_picture(tmp_path: Path) -> None:
    splats = make_splats(4)
    save_splats(tmp_path / "a.usda", splats)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    UsdGeom.Xformable(stage.GetDefaultPrim()).AddScaleOp().Set((-1, 1, 1))
    stage.GetRootLayer().Export(str(tmp_path / "b.usda"))
    expected = placed(splats, 1.0, torch.diag(torch.tensor([-1.0, 1, 1], dtype=torch.float64)), torch.zeros(3))
    found = load_splats(tmp_path / "b.usda")
    torch.testing.assert_close(found.means, expected.means, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(found.shN, expected.shN, rtol=1e-5, atol=1e-5)
