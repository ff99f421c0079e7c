"""Looks at a mesh file before Blender opens it: what would hang, crash or silently lose geometry is refused here.

Files come from strangers. Blender's importers trust counts in headers, so each is compared with the bytes there are.
"""

from __future__ import annotations

import json
import mmap
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from gsopt.errors import InputError

SUFFIXES = (".obj", ".glb", ".gltf", ".ply", ".stl", ".fbx", ".blend")
MAX_BYTES = 1 << 30
"""Above any model of ShapeNet; Blender needs some ten times a file's size in memory."""
MAX_HEADER = 1 << 16
MAX_GLTF_JSON = 256 << 20
MAX_EXPANSION = 64
"""Most elements per byte that a compressed or zero-filled glTF accessor may unfold to."""
PLY_TYPES = {
    name: code
    for code, names in {
        "i1": (b"char", b"int8"),
        "u1": (b"uchar", b"uint8"),
        "i2": (b"short", b"int16"),
        "u2": (b"ushort", b"uint16"),
        "i4": (b"int", b"int32"),
        "u4": (b"uint", b"uint32"),
        "f4": (b"float", b"float32"),
        "f8": (b"double", b"float64"),
    }.items()
    for name in names
}
FACE_VERTEX = re.compile(rb"[ \t]-?(\d{1,18})")
COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


def check_mesh(mesh: Path) -> list[str]:
    """Warnings about a mesh file; InputError unless it is of a kind and a size that Blender can open here."""
    kinds = ", ".join(SUFFIXES)
    suffix = mesh.suffix.lower()
    try:
        if not mesh.is_file():
            raise InputError(f"There is no mesh at {mesh}. Give a file of these kinds: {kinds}.")
        if suffix not in SUFFIXES:
            raise InputError(f"A mesh must be one of {kinds}; got {mesh.name}. Convert it first.")
        size = mesh.stat().st_size
        if not 0 < size <= MAX_BYTES:
            raise InputError(f"{mesh} must hold 1 to {MAX_BYTES:,} bytes, got {size:,}. Export or decimate it again.")
        return {".ply": check_ply, ".stl": check_stl, ".glb": check_glb, ".gltf": check_gltf, ".obj": check_obj}.get(
            suffix, lambda mesh, size: []
        )(mesh, size)
    except OSError as error:
        raise InputError(f"Cannot read {mesh}: {error.strerror or error}. Check its permissions.") from None


def too_many(mesh: Path, count: object, what: str, size: int) -> InputError:
    return InputError(
        f"{mesh} announces {str(count)[:20]} {what}, more than its {size:,} bytes hold: it is cut short or broken. "
        "Export it again."
    )


def check_ply(mesh: Path, size: int) -> list[str]:
    """Every element of a PLY takes at least a byte."""
    begin = read_start(mesh, MAX_HEADER)
    header = begin.split(b"end_header")[0]
    if b"format ascii" in header:
        check_numbers(mesh, rb"^[^a-z\n]*\b(?:nan|inf)")
    else:
        end = re.search(rb"end_header[ \t]*\r?\n", begin)
        check_ply_vertices(mesh, header, end.end() if end else len(begin))
    for words in [line.split() for line in header.splitlines()]:
        if len(words) == 3 and words[0] == b"element" and not (words[2].isdigit() and int(words[2][:20]) <= size):
            raise too_many(
                mesh, words[2][:20].decode("ascii", "replace"), words[1][:20].decode("ascii", "replace"), size
            )
    return []


def check_stl(mesh: Path, size: int) -> list[str]:
    """A binary STL is an 80-byte header, a count and 50 bytes a triangle; a text STL says `facet`."""
    start = read_start(mesh, 4096)
    if start.lstrip().startswith(b"solid") and b"facet" in start:
        check_numbers(mesh, rb"^\s*vertex\s.*\b(?:nan|inf)")
        return []
    count = struct.unpack_from("<I", start, 80)[0] if len(start) >= 84 else 0
    if 84 + 50 * count > size:
        raise too_many(mesh, count, "triangles", size)
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    if not np.isfinite(np.fromfile(mesh, record, count, offset=84)["corners"]).all():
        raise not_finite(mesh)
    return []


def check_numbers(mesh: Path, pattern: bytes) -> None:
    """InputError for a NaN or an infinity in a text file: Blender's importers read it as zero."""
    with mesh.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
        if re.search(pattern, text, re.MULTILINE | re.IGNORECASE):
            raise not_finite(mesh)


def not_finite(mesh: Path) -> InputError:
    return InputError(f"{mesh} must have finite coordinates, got NaN or infinity. Repair or export it again.")


def check_ply_vertices(mesh: Path, header: bytes, start: int) -> None:
    """InputError for a NaN or an infinity in a binary PLY whose vertices come first, at byte `start`, as exporters
    write them."""
    order = ">" if b"binary_big_endian" in header else "<"
    first = header.partition(b"element ")[2].partition(b"element ")[0]
    vertex, *properties = [line.split() for line in first.splitlines()] or [[]]
    properties = [words for words in properties if words[:1] == [b"property"]]
    plain = all(len(words) == 3 and words[1] in PLY_TYPES for words in properties)
    if len(vertex) != 2 or vertex[0] != b"vertex" or not vertex[1].isdigit() or not (properties and plain):
        return
    record = np.dtype([(str(i), order + PLY_TYPES[words[1]]) for i, words in enumerate(properties)])
    count = min(int(vertex[1][:20]), max(0, mesh.stat().st_size - start) // record.itemsize)
    rows = np.fromfile(mesh, record, count, offset=start)
    for i, words in enumerate(properties):
        if words[2] in (b"x", b"y", b"z") and not np.isfinite(rows[str(i)]).all():
            raise not_finite(mesh)


def check_obj(mesh: Path, size: int) -> list[str]:
    """InputError when the last line breaks off or faces name vertices that are not there, which importers drop; a
    warning for a material file that is not there."""
    with mesh.open("rb") as file:
        start = file.read(MAX_HEADER)
        file.seek(max(0, size - 4096))
        tail = file.read()
    last = tail.rstrip().rpartition(b"\n")[2].split()
    wanted = {b"v": 3, b"vn": 3, b"vt": 1, b"f": 3}.get(last[0] if last else b"", 0)
    if len(last) - 1 < wanted or (wanted and last[-1].endswith(b"/")):
        raise InputError(f"{mesh} breaks off in its last line ({b' '.join(last)[:40]!r}). Export or copy it again.")
    check_numbers(mesh, rb"^[ \t]*v[ \t].*\b(?:nan|inf)")
    check_obj_faces(mesh)
    lines = [line.strip().decode("utf-8", "replace") for line in start.splitlines() if line.startswith(b"mtllib ")]
    lost = [name for name in (line[len("mtllib ") :].strip() for line in lines) if not find_near(mesh, name)]
    return [f"the material file {name} is missing: surfaces are plain" for name in lost]


def check_obj_faces(mesh: Path) -> None:
    """InputError when a face names a vertex that the file does not hold, counted from either end."""
    vertices = reach = 0
    with mesh.open("rb") as file:
        for line in map(bytes.lstrip, file):
            if line.startswith((b"v ", b"v\t")):
                vertices += 1
            elif line.startswith((b"f ", b"f\t")):
                reach = max(reach, *map(int, FACE_VERTEX.findall(line)), 0)
    if reach > vertices:
        raise InputError(
            f"{mesh} has a face at vertex {reach}, but only {vertices} vertices: it is cut short or broken. "
            "Export or copy it again."
        )


def find_near(mesh: Path, name: str) -> Path | None:
    """A file that `mesh` names: where it says (either slash), else by its bare name beside the mesh and in ShapeNet's
    ../images, whatever the case."""
    relative = name.replace("\\", "/")
    folder = mesh.parent
    if relative and (folder / relative).is_file():
        return folder / relative
    bare = relative.rpartition("/")[2].lower()
    for place in (folder, folder.parent / "images", folder / "images", folder / "textures"):
        for file in sorted(place.iterdir()) if place.is_dir() else ():
            if file.name.lower() == bare and file.is_file():
                return file
    return None


def check_glb(mesh: Path, size: int) -> list[str]:
    """A GLB is a 12-byte header, then chunks of length, kind and content: JSON first, then the binary buffer."""
    with mesh.open("rb") as file:
        start = file.read(20)
        if len(start) < 20 or start[:4] != b"glTF" or start[16:20] != b"JSON":
            raise InputError(f"{mesh} is not a GLB file: its header is missing. Export it again.")
        _, length, json_length = struct.unpack_from("<III", start, 4)
        if length > size or 20 + json_length > size:
            raise too_many(mesh, max(length, json_length), "bytes", size)
        text = file.read(json_length)
        binary = file.read(8)
    inside = struct.unpack_from("<I", binary)[0] if len(binary) == 8 else 0
    if 28 + json_length + inside > size and inside:
        raise too_many(mesh, inside, "bytes of binary data", size)
    return check_gltf_document(mesh, text, inside)


def check_gltf(mesh: Path, size: int) -> list[str]:
    return check_gltf_document(mesh, read_start(mesh, MAX_GLTF_JSON), 0)


def check_gltf_document(mesh: Path, text: bytes, inside: int) -> list[str]:
    """Every accessor must lie within its buffer view, every view within its buffer, every buffer within its file."""
    try:
        document = json.loads(text)
        buffers = [buffer_bytes(mesh, buffer, inside) for buffer in document.get("buffers", [])]
        views = document.get("bufferViews", [])
        for view in views:
            if view.get("byteOffset", 0) + view["byteLength"] > buffers[view["buffer"]]:
                raise too_many(mesh, view["byteLength"], "bytes in a buffer view", buffers[view["buffer"]])
        for accessor in document.get("accessors", []):
            check_accessor(mesh, accessor, views, sum(buffers))
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError) as error:
        raise InputError(f"{mesh} is not valid glTF: {error or type(error).__name__}. Export it again.") from None
    names = [image["uri"] for image in document.get("images", []) if not image.get("uri", "data:").startswith("data:")]
    return [f"the texture {name} is missing: its surfaces are plain" for name in names if not find_near(mesh, name)]


def buffer_bytes(mesh: Path, buffer: dict[str, Any], inside: int) -> int:
    """Returns the true number of bytes of a buffer."""
    uri = buffer.get("uri")
    if uri is None:
        return inside
    if uri.startswith("data:"):
        return len(uri)
    from urllib.parse import unquote

    file = find_near(mesh, unquote(uri))
    if file is None:
        raise InputError(f"{mesh} keeps its geometry in {uri}, which is missing. Put it beside the mesh.")
    return file.stat().st_size


def check_accessor(mesh: Path, accessor: dict[str, Any], views: list[dict[str, Any]], total: int) -> None:
    count = accessor["count"]
    if "bufferView" not in accessor:  # zeros, or unfolded from a compressed view
        if not 0 <= count <= MAX_EXPANSION * total:
            raise too_many(mesh, count, "elements", total)
        return
    view = views[accessor["bufferView"]]
    element = COMPONENT_BYTES[accessor["componentType"]] * COMPONENTS[accessor["type"]]
    stride = view.get("byteStride", element)
    if not 0 <= count <= (view["byteLength"] - accessor.get("byteOffset", 0) - element) // max(stride, 1) + 1:
        raise too_many(mesh, count, "elements", view["byteLength"])


def read_start(mesh: Path, most: int) -> bytes:
    with mesh.open("rb") as file:
        return file.read(most)


def mesh_files(folder: Path) -> Iterator[Path]:
    """Every mesh below a folder, in name order. InputError when a folder cannot be listed."""
    try:
        entries = sorted(folder.iterdir())
    except OSError as error:
        raise InputError(f"Cannot list the folder {folder}: {error.strerror}. Check its permissions.") from None
    for entry in entries:
        if entry.is_dir() and not entry.is_symlink():
            yield from mesh_files(entry)
        elif entry.suffix.lower() in SUFFIXES and entry.is_file():
            yield entry
