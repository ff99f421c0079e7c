"""Forged files cost no more memory than docs/howto/formats.md promises, measured in a process of its own."""

from __future__ import annotations

import gzip
import io
import json
import os
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsopt.formats.spz_codes import stream_sizes

pytestmark = pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="needs Linux")

FLOOR = 32 << 20
"""Bytes that any .spz or .sog that can be read may take."""
REFUSED_RATIO, REFUSED_FLOOR = 10, 8 << 20
"""A file that is refused may take so many times its size, or so many bytes."""
CHILD = """
import sys, warnings
from pathlib import Path
import torch
from gsopt.errors import GsoptError
from gsopt.formats import compressed_ply, gltf, ksplat, load_splats, sog, splat, spz

def status(key):
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith(key)) * 1024

warnings.simplefilter("ignore")
torch.set_num_threads(1)
for name in sys.argv[1:]:
    if not name.endswith(".compressed.ply"):  # what the libraries take at their first use
        load_splats(Path(name).with_name("small" + Path(name).suffix))
    open("/proc/self/clear_refs", "w").write("5")
    before = status("VmRSS")
    try:
        found = len(load_splats(name))
    except GsoptError as error:
        found = 0
    print(Path(name).name, status("VmHWM") - before, found)
"""
SPLAT = "KHR_gaussian_splatting"


def ply(count: int, degree: int, value: int = 1) -> bytes:
    """All properties as bytes, the smallest type."""
    rest = [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    names = ["x", "y", "z", *[f"f_dc_{i}" for i in range(3)], *rest, "opacity"]
    names += [*[f"scale_{i}" for i in range(3)], *[f"rot_{i}" for i in range(4)]]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property uchar {name}" for name in names]
    return "\n".join([*lines, "end_header", ""]).encode() + bytes([value]) * count * len(names)


def compressed_ply(count: int, extreme: float) -> bytes:
    """Chunks whose extremes are all that number."""
    ends = [f"{end}_{name}" for end in ("min", "max") for name in ("x", "y", "z")]
    ends += [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
    chunks = -(-count // 256)
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {chunks}"]
    lines += [*(f"property float {name}" for name in ends), f"element vertex {count}"]
    lines += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    values = np.full(12 * chunks, extreme, "<f4").tobytes()
    return "\n".join([*lines, "end_header", ""]).encode() + values + b"\x55" * 16 * count


def splat(count: int, every: int) -> bytes:
    """Some rotations have no length: what stays is copied."""
    rows = np.full((count, 32), 60, np.uint8)
    rows[::every, 28:] = 128
    return rows.tobytes()


def glb(count: int, *, shared: bool, value: int = 0x60) -> bytes:
    """Attributes of bytes, in their own places or all in the same."""
    bands = [f"{SPLAT}:SH_DEGREE_{d}_COEF_{i}" for d in range(4) for i in range(2 * d + 1)]
    widths = {"POSITION": 3, f"{SPLAT}:ROTATION": 4, f"{SPLAT}:SCALE": 3, f"{SPLAT}:OPACITY": 1} | dict.fromkeys(
        bands, 3
    )
    views, accessors = [], []
    for width in widths.values():
        begin = 0 if shared else sum(view["byteLength"] for view in views)
        views.append({"buffer": 0, "byteOffset": begin, "byteLength": 12 * count if shared else width * count})
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[width]
        accessor = {
            "bufferView": len(accessors),
            "componentType": 5121,
            "normalized": True,
            "count": count,
            "type": kind,
        }
        accessors.append(accessor)
    length = 12 * count if shared else sum(view["byteLength"] for view in views)
    primitive = {"attributes": {name: i for i, name in enumerate(widths)}, "extensions": {SPLAT: {"kernel": "ellipse"}}}
    root = {"meshes": [{"primitives": [primitive]}], "nodes": [{"mesh": 0, "scale": [2, 2, 2]}]}
    root |= {"accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": length}]}
    return glb_of(json.dumps(root), bytes([value]) * length)


def glb_of(text: str, data: bytes) -> bytes:
    body, padded = data + b"\0" * (-len(data) % 4), text.encode() + b" " * (-len(text) % 4)
    header = struct.pack("<4sII", b"glTF", 2, 28 + len(padded) + len(body))
    return header + struct.pack("<I4s", len(padded), b"JSON") + padded + struct.pack("<I4s", len(body), b"BIN\0") + body


def ksplat(count: int, rotation: int = 9) -> bytes:
    """A section without harmonics, and one splat of degree 3, which makes all of that degree."""
    head = bytearray(4096)
    struct.pack_into("<BB2xI12xH", head, 0, 0, 1, 2, 2)
    body = b""
    for number, degree in ((count, 0), (1, 3)):
        section = bytearray(1024)
        struct.pack_into("<IIIIfH2xI4xII", section, 0, number, number, number, 1, 1.0, 12, 32767, 1, 0)
        struct.pack_into("<H", section, 40, degree)
        head += section
        row = struct.pack("<3H3e4e4B", 1, 1, 1, 1, 1, 1, rotation, 0, 0, 0, 9, 9, 9, 200) + bytes(
            3 * ((degree + 1) ** 2 - 1)
        )
        body += struct.pack("<3f", 0, 0, 0) + row * number
    return bytes(head) + body


def spz(count: int, noise: int) -> bytes:
    """Splats of zeros, which compress to nothing, after so many bytes that do not."""
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, count, 3, 12, 0, 0)
    random = np.random.default_rng(0).integers(0, 256, noise, np.uint8).tobytes()
    return gzip.compress(header + random + b"\0" * (sum(stream_sizes(count, 3, 3)) - noise), 6)


def bad_checksum(data: bytes) -> bytes:
    """The same gzip stream, of which only the last bytes tell that it is damaged."""
    return data[:-8] + bytes(byte ^ 1 for byte in data[-8:-4]) + data[-4:]


def zstandard_spz(count: int, noise: int) -> bytes:
    """Version 4, of which only the checksum of the last stream tells that it is damaged."""
    zstandard = pytest.importorskip("zstandard")
    sizes = stream_sizes(count, 3, 4)
    random = np.random.default_rng(0).integers(0, 256, noise, np.uint8).tobytes()
    plain = [random + b"\0" * (sizes[0] - noise), *(b"\0" * size for size in sizes[1:])]
    packer = zstandard.ZstdCompressor(write_checksum=True)
    streams = [packer.compress(stream) for stream in plain]
    table = b"".join(struct.pack("<QQ", len(s), size) for s, size in zip(streams, sizes, strict=True))
    streams[-1] = streams[-1][:-1] + bytes([streams[-1][-1] ^ 1])
    head = struct.pack("<4sIIBBBB", b"NGSP", 4, count, 3, 12, 0, len(sizes)) + struct.pack("<I12x", 32)
    return head + table + b"".join(streams)


def webp(width: int, height: int, value: int) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGBA", (width, height), (value, value, value, 253)).save(buffer, "WEBP", lossless=True)
    return buffer.getvalue()


def sog(
    count: int, side: int, noise: int = 0, extra: str = "", *, extreme: float = 1, label: int = 0, cut: int = 0
) -> bytes:
    """Images of one color, of side x side pixels, the last one cut, and a member that nobody reads."""
    book = [0.1] * 256
    meta = {"version": 2, "count": count, "means": {"mins": [-1] * 3, "maxs": [extreme] * 3, "files": ["a", "a"]}}
    meta |= {"scales": {"codebook": book, "files": ["a"]}, "quats": {"files": ["a"]}}
    meta |= {"sh0": {"codebook": book, "files": ["a"]}}
    meta |= {"shN": {"count": 64, "bands": 3, "codebook": book, "files": ["c", "l"]}}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", extra or json.dumps(meta))
        labels = webp(side, side, label)
        labels = labels[: len(labels) - cut]
        for name, data in (("a", webp(side, side, 128)), ("c", webp(64 * 15, 1, 9)), ("l", labels)):
            archive.writestr(name, data)
        archive.writestr("pad", np.random.default_rng(0).integers(0, 256, noise, np.uint8).tobytes())
    return buffer.getvalue()


NESTED = "[],"
FILES: dict[str, tuple[Callable[[], bytes], int]] = {
    "bytes.ply": (lambda: ply(200_000, 0), 10),
    "bands.ply": (lambda: ply(60_000, 3), 10),
    "zeros.ply": (lambda: ply(60_000, 3, 0), 0),
    "chunks.compressed.ply": (lambda: compressed_ply(100_000, 0.5), 12),
    "nan.compressed.ply": (lambda: compressed_ply(100_000, float("nan")), 0),
    "holes.splat": (lambda: splat(100_000, 7), 10),
    "none.splat": (lambda: splat(100_000, 1), 0),
    "bytes.glb": (lambda: glb(40_000, shared=False), 10),
    "zeros.glb": (lambda: glb(40_000, shared=False, value=0), 0),
    "shared.glb": (lambda: glb(200_000, shared=True), 0),
    "text.glb": (lambda: glb_of('{"x":[' + NESTED * 340_000 + "0]}", b""), 0),
    "padded.ksplat": (lambda: ksplat(100_000), 10),
    "turned.ksplat": (lambda: ksplat(100_000, 0), 0),
    "few.spz": (lambda: spz(35_000, 0), 100),
    "bomb.spz": (lambda: spz(5_000_000, 0), 0),
    "full.spz": (lambda: spz(200_000, 1_000_000), 130),
    "checksum.spz": (lambda: bad_checksum(spz(200_000, 1_000_000)), 0),
    "short.spz": (lambda: spz(200_000, 1_000_000)[:-1], 0),
    "streams.spz": (lambda: zstandard_spz(200_000, 1_000_000), 0),
    "few.sog": (lambda: sog(35_000, 188), 100),
    "wide.sog": (lambda: sog(30_000, 1448), 0),
    "full.sog": (lambda: sog(200_000, 448, 1_000_000), 130),
    "far.sog": (lambda: sog(200_000, 448, 1_000_000, extreme=1e29), 0),
    "label.sog": (lambda: sog(200_000, 448, 1_000_000, label=200), 0),
    "cut.sog": (lambda: sog(200_000, 448, 1_000_000, cut=6), 0),
    "text.sog": (lambda: sog(1, 1, 0, '{"version":2,"count":1,"x":[' + NESTED * 340_000 + "0]}"), 0),
}
"""Bytes of each file and, where it can be read, most memory in times its size (beyond FLOOR for .spz and .sog)."""


def test_forged_files_cost_no_more_than_the_manual_says(tmp_path: Path) -> None:
    for name, (make, _) in FILES.items():
        (tmp_path / name).write_bytes(make())
    small = {"ply": ply(8, 0), "splat": splat(8, 7), "glb": glb(8, shared=False), "ksplat": ksplat(8)}
    for ending, data in (small | {"spz": spz(8, 0), "sog": sog(8, 4)}).items():
        (tmp_path / f"small.{ending}").write_bytes(data)
    root = Path(__file__).resolve().parents[2]
    environment = os.environ | {"MALLOC_MMAP_THRESHOLD_": "65536", "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    child = [sys.executable, "-c", CHILD, *(str(tmp_path / name) for name in FILES)]
    lines = subprocess.run(child, capture_output=True, text=True, check=True, env=environment).stdout.splitlines()
    assert [line.split()[0] for line in lines] == list(FILES)
    for line in lines:
        name, peak, found = line.split()
        _, ratio = FILES[name]
        floor = REFUSED_FLOOR if not ratio else FLOOR if name.endswith((".spz", ".sog")) else 0
        assert int(peak) <= max(floor, (ratio or REFUSED_RATIO) * (tmp_path / name).stat().st_size), line
        assert bool(int(found)) == bool(ratio), line
