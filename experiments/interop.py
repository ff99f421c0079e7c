"""Do the splat files of gsopt open in splat-transform, and its files in gsopt, and what does the way there cost?

    make test-interop                                                      # installs splat-transform with npm
    python experiments/interop.py RUN --splat-transform PROGRAM [--draw]

Three ways through each format: written and read by gsopt; written by gsopt, turned into a PLY by splat-transform;
turned from our PLY by splat-transform, read by gsopt. The figure is the PSNR of the renders of the run's held-out views
(its input views where none was held out) against those of its splat.ply, over all pixels. Exits with 1 when a figure is
below the floor of its format. `--draw` rewrites the table of docs/howto/formats.md and results/interop.json.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import torch
from torch import Tensor

from gsopt.benchmark.markdown import replace_block, table
from gsopt.data.scene import load_scene
from gsopt.events import write_atomic
from gsopt.formats import SUFFIXES, load_splats, save_splats
from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.results.finished_run import FinishedRun, open_run

HERE = Path(__file__).resolve().parent
RESULT = HERE / "results/interop.json"
PAGE = HERE.parent / "docs/howto/formats.md"
FLOORS = {
    ".usda": 80.0,
    ".usdc": 80.0,
    ".ply": 90.0,
    ".compressed.ply": 45.0,
    ".splat": 30.0,
    ".spz": 40.0,
    ".sog": 35.0,
    ".glb": 80.0,
}
"""dB; a wrong axis, sign or logarithm falls far below."""
THEY_READ = {".ply", ".compressed.ply", ".splat", ".spz", ".sog"}
THEY_WRITE = {".ply", ".compressed.ply", ".spz", ".sog", ".glb"}
HALF_TURN = ["-r", "180,0,0"]
"""splat-transform leaves the axes of a .spz as they stand there: right, up, back, by the format's README."""
BEST = 120.0
"""dB of equal float32 renders."""


def renders(run: FinishedRun, gaussians: Gaussians, cameras: list[Cameras]) -> Tensor:
    """All pixels of all cameras, 0 to 1."""
    drawn = [run.backend.forward(gaussians, camera, run.settings, run.background).colors for camera in cameras]
    return torch.cat([colors.detach().clamp(0, 1).reshape(-1, 3) for colors in drawn])


def psnr(images: Tensor, expected: Tensor) -> float:
    error = float((images - expected).double().square().mean())
    return min(BEST, -10 * math.log10(error)) if error else BEST


def convert(program: Path, source: Path, target: Path) -> None:
    """Runs splat-transform; its words are shown when it fails."""
    turn = HALF_TURN if ".spz" in (source.suffix, target.suffix) else []
    slow = ["-g", "cpu", "-i", "1"] if target.suffix == ".sog" else []
    command = [str(program), "-q", "-w", *slow, str(source), *turn, str(target)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode or not target.is_file():
        sys.exit(f"{' '.join(command)}\n{done.stdout}{done.stderr}")


def files_of_all_ways(gaussians: Gaussians, program: Path, folder: Path) -> dict[tuple[str, str], Path]:
    """(format, way) -> a file that gsopt reads."""
    plain = folder / "plain.ply"
    save_splats(plain, gaussians)
    found = {}
    for suffix in SUFFIXES:
        ours = folder / f"ours{suffix}"
        save_splats(ours, gaussians)
        found[suffix, "ours"] = ours
        if suffix in THEY_READ:
            found[suffix, "to them"] = folder / f"from{suffix.replace('.', '-')}.ply"
            convert(program, ours, found[suffix, "to them"])
        if suffix in THEY_WRITE:
            found[suffix, "from them"] = folder / f"theirs{suffix}"
            convert(program, plain, found[suffix, "from them"])
    return found


def measured(run: FinishedRun, program: Path) -> list[dict]:
    """One record per format and way: PSNR, bytes, splats left out."""
    scene = load_scene(run.config.data)
    cameras = [view.camera for view in scene.test or scene.train]
    expected = renders(run, run.gaussians, cameras)
    records = []
    with tempfile.TemporaryDirectory() as folder:
        for (suffix, way), path in files_of_all_ways(run.gaussians, program, Path(folder)).items():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                gaussians = load_splats(path)
            figure = psnr(renders(run, gaussians, cameras), expected)
            records.append({"format": suffix, "way": way, "psnr": round(figure, 2), "bytes": path.stat().st_size})
            records[-1]["left_out"] = len(run.gaussians) - len(gaussians)
    return records


def draw(records: list[dict]) -> None:
    by_case = {(r["format"], r["way"]): r for r in records}
    rows = []
    for suffix in dict.fromkeys(r["format"] for r in records):
        cells = [by_case.get((suffix, way)) for way in ("ours", "to them", "from them")]
        size = f"{by_case[suffix, 'ours']['bytes'] / by_case['.ply', 'ours']['bytes']:.1%}"
        rows.append([f"`{suffix}`", size, *(f"{cell['psnr']:.1f}" if cell else "-" for cell in cells)])
    head = ["format", "size", "gsopt to gsopt", "gsopt to splat-transform", "splat-transform to gsopt"]
    replace_block(PAGE, "interop", table(head, rows))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--splat-transform", type=Path, required=True)
    parser.add_argument("--draw", action="store_true")
    flags = parser.parse_args()
    run = open_run(flags.run)
    records = measured(run, flags.splat_transform)
    asked = subprocess.run([flags.splat_transform, "--version"], capture_output=True, text=True, check=True)
    version = asked.stdout + asked.stderr
    for record in records:
        print(f"{record['format']:>15}  {record['way']:>9}  {record['psnr']:6.2f} dB  {record['bytes']:>10,} bytes")
    low = [record for record in records if record["psnr"] < FLOORS[record["format"]] or record["left_out"]]
    if flags.draw and not low:
        result = {"peer": version.strip(), "splats": len(run.gaussians), "records": records}
        write_atomic(RESULT, (json.dumps(result, indent=1) + "\n").encode())
        draw(records)
    for record in low:
        print(f"below the floor of {FLOORS[record['format']]} dB, or incomplete: {record}", file=sys.stderr)
    return 1 if low else 0


if __name__ == "__main__":
    sys.exit(main())
