"""Finds the splats of a glTF document: primitives, accessors, bytes.

Sources: Khronos, glTF 2.0, section 3.6 (accessors and their normalized integers), and KHR_gaussian_splatting.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsopt.errors import shortened
from gsopt.formats.files import read_exactly
from gsopt.formats.glb_container import Document
from gsopt.formats.glb_nodes import UNMOVED, Placement, mesh_placements

EXTENSION = "KHR_gaussian_splatting"
_UNDERSTOOD = {EXTENSION, "KHR_mesh_quantization"}
_COMPONENTS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_KINDS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_SRGB, _LINEAR = "srgb_rec709_display", "lin_rec709_display"


@dataclass(frozen=True)
class Accessor:
    """A checked view of `count` elements inside the file."""

    offset: int
    """Bytes from the start of the file."""
    stride: int
    count: int
    components: int
    kind: np.dtype
    normalized: bool

    @property
    def size(self) -> int:
        """Bytes of all elements, without what lies between them."""
        return self.count * self.components * self.kind.itemsize

    def read(self, file: BinaryIO, document: Document) -> NDArray[np.float32]:
        """Values [count, components] as float32, normalized integers mapped to [0, 1] or [-1, 1]."""
        element = self.components * self.kind.itemsize
        file.seek(self.offset)
        data = read_exactly(file, self.stride * (self.count - 1) + element, document.path, "an accessor")
        shape, strides = (self.count, self.components), (self.stride, self.kind.itemsize)
        values = np.ndarray(shape, self.kind, data, 0, strides).astype(np.float32)
        if self.normalized and self.kind.kind != "f":
            values /= np.float32(np.iinfo(self.kind).max)
            np.maximum(values, np.float32(-1), out=values)
        return values


@dataclass(frozen=True)
class Primitive:
    """Splats of one mesh under one node."""

    attributes: dict[str, Accessor]
    """By semantic."""
    linear_color: bool
    placement: Placement


def splat_primitives(document: Document) -> list[Primitive]:
    """Every primitive of splats, once per node that shows it; InputError when there is none or one is not supported."""
    unknown = sorted(set(document.names("extensionsRequired")) - _UNDERSTOOD)
    if unknown:
        document.fail(f"needs extensions that gsopt does not know: {', '.join(unknown)[:80]}")
    found, claimed = [], 0
    placements = mesh_placements(document)
    for mesh, description in enumerate(document.objects(document.root, "meshes")):
        for primitive in document.objects(description, "primitives"):
            if EXTENSION in document.object(primitive, "extensions"):
                linear = _linear_color(document, document.object(document.object(primitive, "extensions"), EXTENSION))
                attributes = document.object(primitive, "attributes")
                accessors = {name: _accessor(document, attributes, name) for name in attributes if _wanted(name)}
                claimed += sum(accessor.size for accessor in accessors.values())
                found += [Primitive(accessors, linear, place) for place in placements.get(mesh, [UNMOVED])]
    if not found:
        document.fail(f"has no primitive with {EXTENSION}, so it holds no splats")
    # Attributes that share their bytes, and many nodes with one mesh, would multiply what a small file takes.
    counts = (part.attributes["POSITION"].count for part in found if "POSITION" in part.attributes)
    if claimed > document.length or 12 * sum(counts) > document.length:
        document.fail("its primitives share their bytes")
    return found


def _wanted(name: str) -> bool:
    return name == "POSITION" or name.startswith(f"{EXTENSION}:")


def _linear_color(document: Document, extension: Mapping[str, Any]) -> bool:
    """True for splats of linear color; InputError for what is not supported."""
    known = {"kernel": ("ellipse",), "colorSpace": (_SRGB, _LINEAR)}
    for key, values in known.items():
        if extension.get(key, values[0]) not in values:
            document.fail(f"`{key}` must be {' or '.join(values)}, got {shortened(extension[key])}")
    if document.object(extension, "extensions"):
        document.fail(f"its splats are compressed ({', '.join(extension['extensions'])[:80]})")
    return extension.get("colorSpace", _SRGB) == _LINEAR


def _accessor(document: Document, attributes: Mapping[str, Any], name: str) -> Accessor:
    description = document.item("accessors", document.integer(attributes, name))
    if "sparse" in description:
        document.fail(f"the accessor of {name} is sparse, which is not read")
    view = document.item("bufferViews", document.integer(description, "bufferView"))
    if document.integer(view, "buffer") or "uri" in document.item("buffers", 0) or "extensions" in view:
        document.fail(f"{name} must lie uncompressed in the file's own binary chunk")
    count = document.integer(description, "count")
    kind, components = description.get("componentType"), description.get("type")
    if (
        not isinstance(kind, int)
        or not isinstance(components, str)
        or kind not in _KINDS
        or components not in _COMPONENTS
    ):
        document.fail(f"{name} must be numbers or vectors, got {shortened(components)} of {shortened(kind)}")
    dtype, width = np.dtype(_KINDS[kind]), _COMPONENTS[components]
    element = width * dtype.itemsize
    stride = document.integer(view, "byteStride", element)
    begin = document.integer(view, "byteOffset", 0)
    length = document.integer(view, "byteLength")
    inside = document.integer(description, "byteOffset", 0)
    if not (element <= stride <= max(252, element)) or count < 1 or begin + length > document.length:
        document.fail(f"{name}: {count} elements every {stride} bytes do not fit {document.length} bytes")
    if inside + stride * (count - 1) + element > length:
        document.fail(f"{name} claims {count} elements, but its view has {length} bytes")
    normalized = description.get("normalized") is True
    return Accessor(document.start + begin + inside, stride, count, width, dtype, normalized)
