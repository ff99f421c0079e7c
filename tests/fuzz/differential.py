"""Compares gsopt's readers with splat-transform on mutated splat files: python differential.py PROGRAM [--count 50].

PROGRAM is what `make test-interop` installs. Valid files of both writers are changed in a few bytes, those of
compressed formats before compression. A file that both read must hold the same splats; what only one of them reads is
counted and listed, because each may be as strict as it likes.
"""

from __future__ import annotations

import argparse
import gzip
import io
import json
import random
import subprocess
import sys
import tempfile
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from torch import Tensor

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent.parent)]
from tiny_scenes import cloud  # noqa: E402 (the path comes first)

from gsopt.errors import InputError  # noqa: E402
from gsopt.events import write_atomic  # noqa: E402
from gsopt.formats import load_splats, save_splats  # noqa: E402
from gsopt.gaussians import Gaussians  # noqa: E402
from gsopt.geometry.quats import normalize, rotation_matrices  # noqa: E402

RESULT = HERE.parents[1] / "experiments/results/differential.json"
SPLATS = 40
SECONDS = 60
TOLERANCES = {"means": 1e-3, "log_scales": 0.02, "opacities": 0.005, "sh0": 0.02}
"""Largest difference per value, beyond the share 1e-3 of its size; quantized values are the same in both readers."""
LIMITS = (-20.0, 1e6)
"""Logarithms of scales below are 0 for either reader."""
COVARIANCE = 0.05
HALF_TURN = ["-r", "180,0,0"]
"""splat-transform leaves the axes of a .spz as they stand there."""
Change = Callable[[bytes, random.Random], bytes]


def bytes_changed(content: bytes, chance: random.Random) -> bytes:
    """One to four bytes replaced, or the end cut off."""
    found = bytearray(content)
    if chance.random() < 0.1:
        return bytes(found[: chance.randrange(len(found))])
    body = 0 if chance.random() < 0.2 else content.find(b"end_header\n") + 1  # most changes spare a PLY's header
    for _ in range(chance.randint(1, 4)):
        found[chance.randrange(body, len(found))] = chance.choice((0, 1, 127, 128, 255, chance.randrange(256)))
    return bytes(found)


def stream_changed(content: bytes, chance: random.Random) -> bytes:
    """The same under gzip."""
    return gzip.compress(bytes_changed(gzip.decompress(content), chance), mtime=0)


def member_changed(content: bytes, chance: random.Random) -> bytes:
    """The same in one member of a zip archive."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = chance.choice(sorted(members))
    members[name] = bytes_changed(members[name], chance)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for member, data in members.items():
            archive.writestr(member, data)
    return packed.getvalue()


FORMATS: dict[str, Change] = {
    ".ply": bytes_changed,
    ".compressed.ply": bytes_changed,
    ".splat": bytes_changed,
    ".spz": stream_changed,
    ".sog": member_changed,
}


def ours(path: Path) -> Gaussians | None:
    """Reads a file with gsopt; returns None where it refuses."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return load_splats(path)
        except InputError:
            return None


def theirs(program: Path, path: Path, folder: Path) -> Gaussians | None:
    """Reads a file with splat-transform, by way of the PLY that it writes; returns None where it fails."""
    target = folder / "theirs.ply"
    target.unlink(missing_ok=True)
    turn = HALF_TURN if path.suffix == ".spz" else []
    command = [str(program), "-q", "-w", str(path), *turn, str(target)]
    try:
        done = subprocess.run(command, capture_output=True, check=False, timeout=SECONDS)
    except subprocess.TimeoutExpired:
        return None
    return ours(target) if done.returncode == 0 and target.is_file() else None


def difference(a: Gaussians, b: Gaussians) -> str:
    """The first attribute in which two sets differ, or nothing."""
    if len(a) != len(b):
        return f"{len(a)} and {len(b)} splats"
    for name, tolerance in TOLERANCES.items():
        one, other = (getattr(gaussians, name).clamp(*LIMITS) for gaussians in (a, b))
        excess = (one - other).abs() - 1e-3 * other.abs() - tolerance
        if len(excess) and float(excess.max()) > 0:
            return f"{name} by {float((one - other).abs().max()):.3g}"
    one, other = covariances(a), covariances(b)
    apart = (one - other).flatten(1).norm(dim=1) / other.flatten(1).norm(dim=1).clamp_min(1e-30)
    return f"covariances by {float(apart.max()):.3g}" if len(a) and float(apart.max()) > COVARIANCE else ""


def covariances(gaussians: Gaussians) -> Tensor:
    """R diag(s^2) R^T: flips of an ellipsoid's own axes do not change it."""
    turned = rotation_matrices(normalize(gaussians.quats)) * gaussians.log_scales.clamp(-20, 20).exp()[:, None]
    return turned @ turned.mT


def outcome(program: Path, path: Path, folder: Path) -> str:
    """`same`, `refused`, `only gsopt`, `only splat-transform`, or what differs."""
    mine, other = ours(path), theirs(program, path, folder)
    if mine is None:
        return "refused" if other is None else "only splat-transform"
    return "only gsopt" if other is None else difference(mine, other) or "same"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", type=Path)
    parser.add_argument("--count", type=int, default=50, help="files per format")
    parser.add_argument("--keep", type=Path, help="folder for files that both read differently")
    flags = parser.parse_args()
    counts: dict[str, Counter[str]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for suffix, change in FORMATS.items():
            save_splats(folder / f"valid{suffix}", cloud(SPLATS, seed=0))
            content, chance = (folder / f"valid{suffix}").read_bytes(), random.Random(suffix)
            counts[suffix] = Counter()
            for number in range(flags.count):
                path = folder / f"case{suffix}"
                path.write_bytes(change(content, chance))
                found = outcome(flags.program, path, folder)
                known = found in ("same", "refused", "only gsopt", "only splat-transform")
                counts[suffix][found if known else "different"] += 1
                if not known or found.startswith("only"):
                    print(f"{suffix} {number}: {found}", flush=True)
                if not known and flags.keep:
                    flags.keep.mkdir(parents=True, exist_ok=True)
                    (flags.keep / f"{number}{suffix}").write_bytes(path.read_bytes())
    print(json.dumps(counts, indent=1))
    write_atomic(RESULT, (json.dumps({"files": flags.count, "outcomes": counts}, indent=1) + "\n").encode())
    return 1 if any(found["different"] for found in counts.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
