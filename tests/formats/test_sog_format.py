"""The .sog bundle: known pixels read as known values, and bundles that lie are refused before they take memory."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from splat_laws import require_short
from splat_samples import make_splats

from gsopt.errors import InputError
from gsopt.formats import is_antialiased, load_splats, save_splats, sog_codes

Members = dict[str, bytes]


def members(path: Path) -> Members:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def write(path: Path, files: Members, meta: dict[str, Any] | None = None, method: int = zipfile.ZIP_STORED) -> None:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(name, json.dumps(meta) if name == "meta.json" and meta is not None else data)


def webp(pixels: Any) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.asarray(pixels, np.uint8)).save(buffer, "WEBP", lossless=True, exact=True)
    return buffer.getvalue()


@pytest.fixture
def bundle(tmp_path: Path) -> tuple[Members, dict[str, Any]]:
    save_splats(tmp_path / "a.sog", make_splats(70, degree=1))
    files = members(tmp_path / "a.sog")
    return files, json.loads(files["meta.json"])


def test_known_pixels_read_as_known_values(tmp_path: Path) -> None:
    codebook = [i / 100 for i in range(256)]
    pixel = {
        "means_l.webp": [255, 0, 0, 255],
        "means_u.webp": [255, 0, 128, 255],
        "scales.webp": [0, 100, 255, 255],
        "quats.webp": [255, 0, 0, 253],
        "sh0.webp": [50, 0, 255, 51],
        "l.webp": [1, 0, 0, 255],
    }
    files = {name: webp([[value]]) for name, value in pixel.items()}
    row = np.zeros((1, 64 * 3, 4), np.uint8)
    row[0, 3:6, :3] = [[10, 20, 30], [40, 50, 60], [70, 80, 90]]
    files |= {"c.webp": webp(row), "meta.json": b""}
    meta: dict[str, Any] = {"version": 2, "count": 1, "quats": {"files": ["quats.webp"]}}
    meta["means"] = {"mins": [-1, -2, -3], "maxs": [1, 2, 3], "files": ["means_l.webp", "means_u.webp"]}
    meta |= {key: {"codebook": codebook, "files": [f"{key}.webp"]} for key in ("scales", "sh0")}
    meta["shN"] = {"count": 2, "bands": 1, "codebook": codebook, "files": ["c.webp", "l.webp"]}
    write(tmp_path / "a.sog", files, meta)
    splats = load_splats(tmp_path / "a.sog")
    z = -3 + 6 * 32768 / 65535
    assert splats.means[0].tolist() == pytest.approx([np.e - 1, 1 - np.e**2, np.expm1(z)])
    assert splats.log_scales[0].tolist() == pytest.approx([0, 1, 2.55])
    assert splats.sh0[0, 0].tolist() == pytest.approx([0.5, 0, 2.55])
    assert splats.opacities.item() == pytest.approx(0.2)
    assert splats.quats[0].tolist() == pytest.approx([0.5**0.5, 0, -(0.5**0.5), -(0.5**0.5)])  # clamped, then unit
    assert splats.shN[0].tolist() == [pytest.approx(row) for row in ([0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [0.7, 0.8, 0.9])]


@pytest.mark.parametrize(
    ("mark", "expected"),
    [
        ({"model": "antialiased"}, True),
        ({"antialias": True}, True),
        ({"antialias": False}, False),
        ({"antialias": "yes"}, False),
        ({}, False),
    ],
)
def test_either_mark_of_antialiasing_is_read(
    tmp_path: Path, bundle: tuple[Members, dict[str, Any]], mark: dict[str, Any], expected: bool
) -> None:
    files, meta = bundle
    write(tmp_path / "b.sog", files, meta | mark)
    assert is_antialiased(tmp_path / "b.sog") is expected


def test_equal_splats_give_one_palette_entry_each(tmp_path: Path) -> None:
    """1000 copies of 8 splats: every one comes back, whatever the order."""
    few = make_splats(8)
    many = few.select(torch.arange(8000) % 8)
    save_splats(tmp_path / "a.sog", many)
    back = load_splats(tmp_path / "a.sog")
    nearest = (back.means[:, None] - few.means[None]).norm(dim=2).argmin(dim=1)
    assert float((back.shN - few.shN[nearest]).abs().max()) <= 1.8 / 256


def test_an_entry_of_the_palette_has_a_number_of_two_bytes_however_many_splats(monkeypatch: pytest.MonkeyPatch) -> None:
    """A million splats, of which five stand apart in groups of one: each of these takes a whole entry."""
    apart, n = 5, 1 << 20
    rows = np.zeros((n, 1), np.float32)
    rows[:apart, 0] = np.arange(1, apart + 1)

    def clusters(rows: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """As many centers as asked for; the first call makes the groups."""
        labels = rows[:, 0].astype(np.int64) if len(rows) == n else np.arange(len(rows)) % count
        return np.zeros((count, 1), np.float32), labels

    monkeypatch.setattr(sog_codes, "_clusters", clusters)
    palette, labels = sog_codes._palette(rows)
    assert len(palette) == 1 << 16
    assert sorted(set(labels.tolist())) == list(range(1 << 16))


CHANGES: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "version": (lambda m: m.update(version=1), "version must be 2"),
    "no version": (lambda m: m.pop("version"), "version must be 2"),
    "a huge count": (lambda m: m.update(count=10**8), "claims to decode|pixels for"),
    "more splats than pixels": (lambda m: m.update(count=9999), "pixels for 9999"),
    "no count": (lambda m: m.update(count=True), "`count`"),
    "a short codebook": (lambda m: m["scales"]["codebook"].pop(), "256 finite"),
    "a codebook with NaN": (lambda m: m["sh0"]["codebook"].__setitem__(3, float("nan")), "256 finite"),
    "no files": (lambda m: m["quats"].pop("files"), "must name 1 images"),
    "a file that is not there": (lambda m: m["quats"].update(files=["../../etc/passwd"]), "lacks"),
    "a section of another type": (lambda m: m.update(means=[]), "must be an object"),
    "extremes of another type": (lambda m: m["means"].update(mins=["a", 1, 2]), "3 finite"),
    "a minimum below -88": (lambda m: m["means"].update(mins=[-1, -88.1, 0]), "must lie within 88"),
    "a maximum above 88": (lambda m: m["means"].update(maxs=[1, 88.1, 0]), "must lie within 88"),
    "degree 4": (lambda m: m["shN"].update(bands=4), "`bands`"),
    "another degree": (lambda m: m["shN"].update(bands=2), "pixels for"),
    "a small palette": (lambda m: m["shN"].update(count=65), "palette entry"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_meta_that_lies_is_refused(tmp_path: Path, bundle: tuple[Members, dict[str, Any]], change: str) -> None:
    files, meta = bundle
    alter, message = CHANGES[change]
    alter(meta)
    write(tmp_path / "b.sog", files, meta)
    with pytest.raises(InputError, match=message):
        load_splats(tmp_path / "b.sog")


@pytest.mark.parametrize("text", [b"[" * 100_000, b"{", b"[]", b"\xff"])
def test_a_broken_meta_is_refused(tmp_path: Path, bundle: tuple[Members, dict[str, Any]], text: bytes) -> None:
    write(tmp_path / "b.sog", {**bundle[0], "meta.json": text})
    with pytest.raises(InputError):
        load_splats(tmp_path / "b.sog")


def test_an_image_that_is_none_is_refused(tmp_path: Path, bundle: tuple[Members, dict[str, Any]]) -> None:
    write(tmp_path / "b.sog", {**bundle[0], "quats.webp": b"RIFF0000WEBPVP8L rubbish"})
    with pytest.raises(InputError, match="no image"):
        load_splats(tmp_path / "b.sog")


def test_a_member_under_another_name_is_refused_in_few_words(
    tmp_path: Path, bundle: tuple[Members, dict[str, Any]]
) -> None:
    long, path = "n" * 3000, tmp_path / "bad.sog"
    write(path, {long: json.dumps(bundle[1]).encode()})
    data = path.read_bytes()
    start = data.rindex(long.encode())  # the archive's directory, behind the member's own header
    path.write_bytes(data[:start] + b"meta.json".ljust(len(long), b"\0") + data[start + len(long) :])
    with pytest.raises(InputError, match="damaged") as refused:
        load_splats(path)
    require_short(refused.value, path)


def test_bombs_are_not_unpacked(tmp_path: Path, bundle: tuple[Members, dict[str, Any]]) -> None:
    """A deflated member of zeros, and an image of one color: both are refused by what they claim."""
    resource = pytest.importorskip("resource")
    files, meta = bundle
    write(tmp_path / "zip.sog", {**files, "quats.webp": bytes(300_000_000)}, meta, zipfile.ZIP_DEFLATED)
    meta["count"] = 70
    write(tmp_path / "image.sog", {**files, "quats.webp": webp(np.zeros((8000, 8000, 4)))}, meta)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for name, message in (("zip.sog", "more than"), ("image.sog", "8000 x 8000 pixels for 70")):
        with pytest.raises(InputError, match=message):
            load_splats(tmp_path / name)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 30_000  # kB


def test_every_truncation_is_refused(tmp_path: Path) -> None:
    save_splats(tmp_path / "a.sog", make_splats(3, degree=1))
    data = (tmp_path / "a.sog").read_bytes()
    for size in range(0, len(data), 97):
        (tmp_path / "b.sog").write_bytes(data[:size])
        with pytest.raises(InputError):
            load_splats(tmp_path / "b.sog")
