"""OpenUSD: a prim of type ParticleField3DGaussianSplat, in text (.usda) or binary (.usdc).

Schema: OpenUSD 26.11, usdVol/schema.usda: positions, orientations, linear scales, opacities in [0, 1], and harmonics
whose coefficients are taken to be those of a PLY, degree by degree. The stage has y up, so that the frame is right, up,
back. Pixar's library (usd-core) parses the files.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsopt._optional import require
from gsopt.errors import InputError, shortened
from gsopt.formats.axes import RIGHT_UP_BACK, with_flipped_axes
from gsopt.formats.files import opened, replacing
from gsopt.formats.placement import joined, placed, similarity_parts
from gsopt.formats.units import UNKNOWN, Units, units_from_notes
from gsopt.formats.validation import MAX_SH_DEGREE, log_scales, logit, scales, storable
from gsopt.gaussians import Gaussians
from gsopt.geometry.quats import normalize

_KIND, _NOTES = "ParticleField3DGaussianSplat", "gsopt"
_SH, _DEGREE = "radiance:sphericalHarmonicsCoefficients", "radiance:sphericalHarmonicsDegree"
_OPACITY_MARGIN = 2.0**-24
_PROBE = Path(__file__).with_name("usd_probe.py")
_EXTENT = 3.0
"""Standard deviations around a mean that the extent of the prim holds."""
_Y_FROM_Z_UP = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)


def save_usd(path: Path, gaussians: Gaussians, *, units: Units = UNKNOWN) -> None:
    """Write one prim; whole file or nothing. Reading back differs as for .glb.

    `units`: metersPerUnit of the stage (1 where it is not known) and a note in its layer.
    """
    usd, geom, vol, vt = (require(f"pxr.{name}", "usd", "USD") for name in ("Usd", "UsdGeom", "UsdVol", "Vt"))
    gaussians = with_flipped_axes(storable(gaussians, path), RIGHT_UP_BACK)
    stage = usd.Stage.CreateInMemory()
    geom.SetStageUpAxis(stage, geom.Tokens.y)
    geom.SetStageMetersPerUnit(stage, units.meters_per_unit or 1.0)
    prim = vol.ParticleField3DGaussianSplat.Define(stage, "/splats").GetPrim()
    stage.SetDefaultPrim(prim)
    if units.notes():
        stage.GetRootLayer().customLayerData = {_NOTES: {k: _plain(v, vt) for k, v in units.notes().items()}}
    sizes = scales(gaussians.log_scales)
    bands = torch.cat([gaussians.sh0, gaussians.shN], dim=1).reshape(-1, 3)
    values = {
        "positions": vt.Vec3fArray.FromNumpy(gaussians.means.numpy()),
        "orientations": vt.QuatfArray.FromNumpy(normalize(gaussians.quats)[:, [1, 2, 3, 0]].contiguous().numpy()),
        "scales": vt.Vec3fArray.FromNumpy(sizes.numpy()),
        "opacities": vt.FloatArray.FromNumpy(gaussians.opacities.clamp(_OPACITY_MARGIN, 1 - _OPACITY_MARGIN).numpy()),
        _SH: vt.Vec3fArray.FromNumpy(bands.contiguous().numpy()),
        _DEGREE: gaussians.sh_degree,
    }
    if len(gaussians):
        reach = _EXTENT * sizes.amax(1, keepdim=True)
        ends = torch.stack([(gaussians.means - reach).amin(0), (gaussians.means + reach).amax(0)])
        values["extent"] = vt.Vec3fArray.FromNumpy(ends.numpy())
    for name, value in values.items():
        prim.GetAttribute(name).Set(value)
    with tempfile.TemporaryDirectory() as folder, replacing(path) as file:
        part = Path(folder) / f"splats{path.suffix.lower()}"
        stage.GetRootLayer().Export(str(part))
        with part.open("rb") as written:
            while block := written.read(1 << 20):
                file.write(block)


def _plain(value: Any, vt: Any) -> Any:
    return vt.DoubleArray(value) if isinstance(value, list) else value


def load_usd(path: Path) -> Gaussians:
    """Read every prim of splats of one file, with the transforms above it; bands above degree 3 are left out.

    Files that refer to others are refused: nothing but this one is opened.
    """
    with _as_bad_data(path):
        return with_flipped_axes(joined(_fields(path)), RIGHT_UP_BACK)


def _fields(path: Path) -> list[Gaussians]:
    """The splats of each prim, y up."""
    usd, geom = (require(f"pxr.{name}", "usd", "USD") for name in ("Usd", "UsdGeom"))
    stage = usd.Stage.Open(_layer(path), None)
    turn = _Y_FROM_Z_UP if geom.GetStageUpAxis(stage) == geom.Tokens.z else torch.eye(3, dtype=torch.float64)
    parts = []
    for prim in stage.Traverse():
        if prim.GetTypeName() != _KIND:
            continue
        world = geom.Imageable(prim).ComputeLocalToWorldTransform(usd.TimeCode.Default())
        matrix = torch.tensor(np.array(world), dtype=torch.float64)  # of rows: p' = p M
        found = similarity_parts(turn @ matrix[:3, :3].T)
        if found is None or not bool(torch.isfinite(matrix).all()):
            raise InputError(f"{path}: {prim.GetPath()} is sheared, which splats cannot follow. Export it again.")
        means = _array(prim, "positions", 3, path)
        if means is not None and len(means):
            parts.append(placed(_read(prim, torch.from_numpy(means), path), *found, turn @ matrix[3, :3]))
    if not parts:
        raise InputError(f"{path} has no prim {_KIND} with splats. Export it again.")
    return parts


@contextmanager
def _as_bad_data(path: Path) -> Iterator[None]:
    """Turns what the library raises, when it opens a file or reads a value, into InputError."""
    errors = require("pxr.Tf", "usd", "USD").ErrorException, UnicodeDecodeError  # the latter from its own message
    try:
        yield
    except errors as error:
        raise InputError(f"{path} is no USD: {shortened(_text(error))}. Copy or export it again.") from error


def _text(error: Exception) -> str:
    try:
        return str(error)
    except UnicodeDecodeError:  # a message of the library repeats the file's bytes
        return type(error).__name__


def usd_units(path: Path) -> Units:
    """Scale and origin that gsopt noted in the layer."""
    with _as_bad_data(path):
        notes = dict(_layer(path).customLayerData).get(_NOTES)
    if not isinstance(notes, dict):
        return UNKNOWN
    return units_from_notes({k: list(v) if hasattr(v, "__len__") else v for k, v in notes.items()})


def _layer(path: Path) -> Any:
    """The file alone, read anew."""
    sdf = require("pxr.Sdf", "usd", "USD")
    with opened(path):
        require_survivable(path)
        layer = sdf.Layer.OpenAsAnonymous(str(path))
    if layer is None:
        raise InputError(f"{path} is no USD. Copy or export it again.")
    others = layer.GetCompositionAssetDependencies()
    if others:
        raise InputError(f"{path} refers to other files, such as {shortened(others[0])}. Run `usdcat --flatten` first.")
    return layer


def require_survivable(path: Path) -> None:
    """InputError where the library would end this process."""
    if probe_exit_code(path) not in (0, 1):
        raise InputError(f"{path} is no USD: the library that reads USD crashes over it. Copy or export it again.")


def probe_exit_code(path: Path) -> int:
    """The end of a process that reads the file first; negative for a signal."""
    probe = [sys.executable, "-P", str(_PROBE), str(path.absolute())]
    return subprocess.run(probe, stdin=subprocess.DEVNULL, capture_output=True, check=False).returncode


def _read(prim: Any, means: Tensor, path: Path) -> Gaussians:
    """The splats in the prim's own frame; by the schema what is missing or too short has its default."""
    count, degree = len(means), prim.GetAttribute(_DEGREE).Get()
    if type(degree) is not int or not 0 <= degree <= 16:
        raise InputError(
            f"{path}: the SH degree must be 0 to {MAX_SH_DEGREE}, got {shortened(degree)}. Export it again."
        )

    def values(name: str, width: int, default: list[float], rows: int = 1) -> Tensor:
        found = _array(prim, name, width, path)
        if found is None or len(found) < count * rows:
            return torch.tensor(default).repeat(count, 1)
        return torch.from_numpy(found[: count * rows])

    harmonics = values(_SH, 3, [0.0] * 3, (degree + 1) ** 2)
    harmonics = harmonics.reshape(count, len(harmonics) // count, 3)[:, : (MAX_SH_DEGREE + 1) ** 2]
    return Gaussians(
        means=means,
        quats=values("orientations", 4, [0.0, 0, 0, 1])[:, [3, 0, 1, 2]],
        log_scales=log_scales(values("scales", 3, [1.0] * 3)),
        logit_opacities=logit(values("opacities", 1, [1.0])[:, 0].clamp(0, 1), _OPACITY_MARGIN),
        sh0=harmonics[:, :1].contiguous(),
        shN=harmonics[:, 1:].contiguous(),
    )


def _array(prim: Any, name: str, width: int, path: Path) -> NDArray[np.float32] | None:
    """[N, width] of an attribute in full or, failing that, half precision."""
    for attribute in (prim.GetAttribute(name), prim.GetAttribute(f"{name}h")):
        value = attribute.Get() if attribute else None
        if value is not None:
            try:
                return np.array(value, np.float32).reshape(len(value), width)
            except (TypeError, ValueError) as error:
                raise InputError(f"{path}: `{name}` of {prim.GetPath()} holds no vectors. Export it again.") from error
    return None
