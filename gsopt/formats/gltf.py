"""glTF 2.0 binary (.glb) with KHR_gaussian_splatting: splats as a primitive of points.

Attributes POSITION, KHR_gaussian_splatting:ROTATION (unit, x y z w), :SCALE (linear), :OPACITY (0..1) and
:SH_DEGREE_l_COEF_n; COLOR_0, linear as in all of glTF, colors the points where the extension is not known. Sources:
Khronos, glTF 2.0, sections 3.6 and 4.4, and extensions/2.0/Khronos/KHR_gaussian_splatting/README.md, a release
candidate. The frame is left, up, forward.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from torch import Tensor

from gsopt._version import __version__
from gsopt.errors import InputError
from gsopt.formats.axes import LEFT_UP_FORWARD, with_flipped_axes
from gsopt.formats.files import opened, replacing
from gsopt.formats.glb_container import BINARY, CHUNK, HEADER, JSON, MAGIC, Document, read_container
from gsopt.formats.glb_splats import EXTENSION, Accessor, Primitive, splat_primitives
from gsopt.formats.linear_color import linear_from_srgb, srgb_from_linear_color
from gsopt.formats.placement import joined, placed
from gsopt.formats.units import UNKNOWN, Units
from gsopt.formats.validation import MAX_SH_DEGREE, log_scales, logit, scales, storable
from gsopt.gaussians import Gaussians
from gsopt.geometry import sh
from gsopt.geometry.quats import normalize

_FLOAT, _SHORT = 5126, 5123
_COMPONENT_TYPES = {torch.float32: _FLOAT, torch.uint16: _SHORT}
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_MAX_SIZE = (1 << 32) - 1
_OPACITY_MARGIN = 2.0**-24
"""Least distance of a float32 below 1 from it: opacities keep it from 0 and 1, so that their logits are finite."""


def save_glb(path: Path, gaussians: Gaussians, *, units: Units = UNKNOWN) -> None:
    """Write one primitive of points; whole file or nothing, 4 GiB at most (about 17 million splats of degree 3).

    Reading back differs by at most: means and spherical harmonics 0; log-scales 1e-5 within ±87; opacity 1e-7; each
    component of the unit quaternion 1e-7. The order of the rows is kept.
    """
    if len(gaussians) == 0:
        raise InputError(f"{path}: a .glb must hold at least one splat, got 0. Use .ply.")
    gaussians = with_flipped_axes(storable(gaussians, path), LEFT_UP_FORWARD)
    attributes = list(_attributes(gaussians))
    text = json.dumps(_document(attributes, units), separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    length = sum(tensor.numel() * tensor.element_size() for _, tensor in attributes)
    total = HEADER.size + 2 * CHUNK.size + len(text) + length
    if total > _MAX_SIZE:
        raise InputError(f"{path}: a .glb holds {_MAX_SIZE} bytes, got {total}. Use .spz, or lower the SH degree.")
    with replacing(path) as file:
        file.write(HEADER.pack(MAGIC, 2, total))
        file.write(CHUNK.pack(len(text), JSON) + text)
        file.write(CHUNK.pack(length, BINARY))
        for _, tensor in attributes:
            file.write(np.ascontiguousarray(tensor.numpy()).data)


def _attributes(gaussians: Gaussians) -> Iterator[tuple[str, Tensor]]:
    """(semantic, values [N, components]); every element is 4 bytes or a multiple, so nothing needs padding."""
    rgb = linear_from_srgb(sh.rgb_from_sh0(gaussians.sh0[:, 0]).clamp(0, 1))
    rgba = torch.cat([rgb, gaussians.opacities[:, None]], dim=1)
    yield "POSITION", gaussians.means
    yield "COLOR_0", (rgba * 65535).round().to(torch.int32).to(torch.uint16)
    yield f"{EXTENSION}:ROTATION", normalize(gaussians.quats.double()).float()[:, [1, 2, 3, 0]]
    yield f"{EXTENSION}:SCALE", scales(gaussians.log_scales)
    yield f"{EXTENSION}:OPACITY", gaussians.opacities[:, None].clamp(_OPACITY_MARGIN, 1 - _OPACITY_MARGIN)
    yield f"{EXTENSION}:SH_DEGREE_0_COEF_0", gaussians.sh0[:, 0]
    for degree in range(1, gaussians.sh_degree + 1):
        for order in range(2 * degree + 1):
            yield f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}", gaussians.shN[:, degree**2 - 1 + order]


def _document(attributes: list[tuple[str, Tensor]], units: Units) -> dict[str, object]:
    views: list[dict[str, object]] = []
    accessors: list[dict[str, object]] = []
    offset = 0
    for name, tensor in attributes:
        size = tensor.numel() * tensor.element_size()
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": size, "target": 34962})
        accessor: dict[str, object] = {
            "bufferView": len(accessors),
            "componentType": _COMPONENT_TYPES[tensor.dtype],
            "count": len(tensor),
            "type": _TYPES[tensor.shape[1]],
        }
        if tensor.dtype == torch.uint16:
            accessor["normalized"] = True
        if name == "POSITION":
            accessor |= {"min": tensor.amin(dim=0).tolist(), "max": tensor.amax(dim=0).tolist()}
        accessors.append(accessor)
        offset += size
    primitive = {
        "mode": 0,
        "attributes": {name: i for i, (name, _) in enumerate(attributes)},
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    return {
        "asset": {"version": "2.0", "generator": f"gsopt {__version__}"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **({"extras": units.notes()} if units.notes() else {})}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }


def load_glb(path: Path) -> Gaussians:
    """Read every primitive of splats, one after the other, padded to the highest SH degree among them.

    Nodes may turn, mirror, scale and move them. Splats of linear color are re-coded, which is exact for the base color
    and approximate for the bands above. Refused with InputError: other color spaces and kernels, compression, sparse or
    shared accessors, files that are not self-contained, and nodes that shear or scale their axes differently.
    """
    with opened(path) as (file, size):
        document = read_container(file, size, path)
        parts = [_read_primitive(file, primitive, document) for primitive in splat_primitives(document)]
    return with_flipped_axes(joined(parts), LEFT_UP_FORWARD)


def _read_primitive(file: BinaryIO, primitive: Primitive, document: Document) -> Gaussians:
    gaussians = _read(file, primitive.attributes, document)
    if primitive.linear_color:
        gaussians = srgb_from_linear_color(gaussians)
    scale, axes, translation = primitive.placement
    identity = scale == 1 and torch.equal(axes, torch.eye(3, dtype=axes.dtype)) and not bool(translation.any())
    return gaussians if identity else placed(gaussians, scale, axes, translation)


def _read(file: BinaryIO, primitive: dict[str, Accessor], document: Document) -> Gaussians:
    count = primitive["POSITION"].count if "POSITION" in primitive else 0
    degrees = [d for d in range(MAX_SH_DEGREE + 1) if any(f":SH_DEGREE_{d}_" in name for name in primitive)]
    base, *bands = (
        f"{EXTENSION}:SH_DEGREE_{d}_COEF_{i}" for d in range(max(degrees, default=0) + 1) for i in range(2 * d + 1)
    )
    widths = {"POSITION": 3, f"{EXTENSION}:ROTATION": 4, f"{EXTENSION}:SCALE": 3, f"{EXTENSION}:OPACITY": 1}
    for name, components in (widths | dict.fromkeys([base, *bands], 3)).items():
        accessor = primitive.get(name)
        if accessor is None or (accessor.count, accessor.components) != (count, components):
            got = "nothing" if accessor is None else f"{accessor.count} times {accessor.components}"
            document.fail(f"{name} must have {count} times {components} values, got {got}")

    def values(name: str) -> Tensor:
        return torch.from_numpy(primitive[name].read(file, document))

    scale, opacity = values(f"{EXTENSION}:SCALE"), values(f"{EXTENSION}:OPACITY")[:, 0]
    if bool((scale < 0).any()):
        document.fail("a scale is negative: the file follows an early draft of the extension, with logarithms")
    if bool(((opacity < 0) | (opacity > 1)).any()):
        document.fail("opacities must lie in [0, 1]")
    shN = torch.empty(count, len(bands), 3)
    for i, name in enumerate(bands):
        shN[:, i] = values(name)
    return Gaussians(
        means=values("POSITION"),
        quats=values(f"{EXTENSION}:ROTATION")[:, [3, 0, 1, 2]],
        log_scales=log_scales(scale),
        logit_opacities=logit(opacity, _OPACITY_MARGIN),
        sh0=values(base)[:, None],
        shN=shN,
    )
