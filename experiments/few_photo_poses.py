"""Poses from few photos alone: which are found, and how far are they from poses made of all photos?

    python experiments/few_photo_poses.py HEAD FOX --arm ARM [--all ALL] [--only head-8 ...] [--flags="--features both"]

HEAD is the folder ethiopianHead_800 (66 photos of a museum head on a turntable, with masks; CC BY-NC-SA, not part of
gsopt), FOX 50 photos of a fox with transforms.json. Of both, well-spread photos are copied into an empty folder (the
head's with and without their masks) and given to `gsopt sfm`. Found poses are aligned with the published ones by the
best similarity; the head's also with ALL, the scene that `gsopt sfm` made of all 66 photos and masks, because the
published poses are off by up to 3 degrees (silhouette_poses.py). ARM names the rows in
experiments/results/few_photo_poses.json; rows that are there are not repeated.
"""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsopt.benchmark.machine import machine
from gsopt.data.posed_images import PosedImage
from gsopt.data.scene import read_dataset
from gsopt.data.sfm.placement import rotation_to_z
from gsopt.data.sfm.trajectory import centers, compare
from gsopt.events import to_json, write_atomic
from gsopt.geometry.farthest_points import farthest_points

RESULTS = Path(__file__).parent / "results" / "few_photo_poses.json"
HEAD_COUNTS, FOX_COUNTS = (4, 6, 8, 12, 22, 33, 66), (8,)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("head", type=Path)
    parser.add_argument("fox", type=Path)
    parser.add_argument("--arm", required=True)
    parser.add_argument("--flags", default="", help="more words for `gsopt sfm`")
    parser.add_argument("--only", nargs="*", default=[], metavar="CASE", help="such as head-8, head-8-masks, fox-8")
    parser.add_argument("--all", type=Path, help="scene of all photos of the head, posed by gsopt")
    parser.add_argument("--keep", type=Path, help="folder for the scenes that were found")
    args = parser.parse_args()
    cases = {f"head-{count}{kind}": (args.head, count, bool(kind)) for count in HEAD_COUNTS for kind in ("", "-masks")}
    cases |= {f"fox-{count}": (args.fox, count, False) for count in FOX_COUNTS}
    for name, (data, count, with_masks) in cases.items():
        rows = read()
        if f"{args.arm} {name}" in rows or (args.only and name not in args.only):
            continue
        kept = args.keep / name if args.keep else None
        row = measured(data, count, with_masks, shlex.split(args.flags), kept, args.all if data == args.head else None)
        print(name, json.dumps(row), flush=True)
        write({**read(), f"{args.arm} {name}": {"flags": args.flags, **row}})


def well_spread(data: Path, count: int) -> list[PosedImage]:
    """The photos that `gsopt train --views` would take of all."""
    frames = read_dataset(data).frames
    eyes = torch.from_numpy(centers(viewmats(frames)))
    return [frames[row] for row in sorted(farthest_points(eyes, count))]


def viewmats(frames: list[PosedImage]) -> Any:
    return np.stack([frame.viewmat.numpy() for frame in frames])


def measured(
    data: Path, count: int, with_masks: bool, flags: list[str], keep: Path | None, posed_all: Path | None
) -> dict[str, Any]:
    """One call of `gsopt sfm` on a folder that holds nothing but the photos (and their masks)."""
    frames = well_spread(data, count)
    with tempfile.TemporaryDirectory() as temporary:
        photos, scene = Path(temporary, "photos"), Path(temporary, "scene")
        copied(frames, photos, with_masks)
        command = [sys.executable, "-m", "gsopt", "sfm", str(photos), "-o", str(scene), "--threads", "1", *flags]
        began = time.perf_counter()
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        row: dict[str, Any] = {"photos": count, "seconds": round(time.perf_counter() - began, 1)}
        if ended.returncode != 0:
            text = [line for line in ended.stderr.splitlines() if line.strip()]
            return {**row, "posed": 0, "exit_code": ended.returncode, "report": text}
        if keep is not None:
            shutil.copytree(scene, keep, dirs_exist_ok=True)
        row |= agreement(frames, scene)
        return row if posed_all is None else {**row, **agreement_with_all(posed_all, scene)}


def copied(frames: list[PosedImage], photos: Path, with_masks: bool) -> None:
    photos.mkdir()
    for frame in frames:
        shutil.copyfile(frame.path, photos / frame.path.name)
        if with_masks:
            (photos / "masks").mkdir(exist_ok=True)
            mask = frame.path.parents[1] / "masks" / f"{frame.path.stem}.png"
            shutil.copyfile(mask, photos / "masks" / mask.name)


def agreement(frames: list[PosedImage], scene: Path) -> dict[str, Any]:
    """Found poses against the published ones, after the best similarity."""
    record = json.loads((scene / "sfm.json").read_text())
    truth = {frame.path.stem: frame for frame in frames}
    found = {Path(frame.name).stem: frame for frame in read_dataset(scene).frames}
    names = sorted(found)
    row: dict[str, Any] = {
        "posed": len(names),
        "without_pose": sorted(truth.keys() - found.keys()),
        "focal_ratio": round(float(found[names[0]].K[0, 0] / truth[names[0]].K[0, 0]), 4),
        "points": record["points"],
        "track_length": round(record["track_length"], 3),
        "reprojection_error_px": round(record["reprojection_error"], 3),
    }
    return {**row, **errors(found, truth)}


def agreement_with_all(posed_all: Path, scene: Path) -> dict[str, float]:
    """Found poses against those that were made of all photos."""
    found, truth = (
        {Path(frame.name).stem: frame for frame in read_dataset(path).frames} for path in (scene, posed_all)
    )
    return {f"{name}_against_all": value for name, value in errors(found, truth).items()}


def looking(frame: PosedImage) -> Any:
    """The pose whose axis goes through the middle of the photo, also where that of the lens does not: photos may be cut
    out of larger ones, and the published poses take their middles for the lens's."""
    aside = (np.array([frame.width, frame.height]) / 2 - frame.K[:2, 2].numpy()) / frame.K[0, 0].item()
    ray = np.append(aside, 1.0) / np.linalg.norm(np.append(aside, 1.0))
    turned = np.eye(4)
    turned[:3, :3] = rotation_to_z(ray)
    return turned @ frame.viewmat.numpy()


def errors(found: dict[str, PosedImage], truth: dict[str, PosedImage]) -> dict[str, float]:
    """Root mean square and maximum, after the best similarity."""
    names = sorted(found)
    error = compare(*(np.stack([looking(poses[name]) for name in names]) for poses in (found, truth)))
    return {key: value for key, value in error.summary().items() if not key.endswith("median")}


def read() -> dict[str, Any]:
    return dict(json.loads(RESULTS.read_text())["rows"]) if RESULTS.is_file() else {}


def write(rows: dict[str, Any]) -> None:
    write_atomic(RESULTS, to_json({"command": __doc__.split("\n\n")[1].strip(), "machine": machine(), "rows": rows}))


if __name__ == "__main__":
    main()
