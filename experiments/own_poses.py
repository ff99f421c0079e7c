"""Trains on few photos with poses found from these photos alone, and evaluates held-out views.

    python experiments/own_poses.py DATA OUT --views 8 [--flags="--features both"] [--train="-r 4 --threads 1"]

DATA has published poses: 50 photos of a fox with transforms.json, or the folder ethiopianHead_800. Every 8th photo is
held out, and the input photos are those that `gsopt train DATA --eval --views N` takes. They are copied into an empty
folder (with their masks, where DATA has some) and given to `gsopt sfm`. The held-out views follow the found cameras:
the found lens, and the published pose after the similarity of the input cameras' centers and the mean turn that is left
between found and published input cameras (another principal point looks like a turn). No held-out photo takes part.
The same photos with their published poses are trained on beside it. Rows go to experiments/results/own_poses.json.
"""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsopt.benchmark.machine import machine
from gsopt.config.train import DataConfig
from gsopt.data.posed_images import PosedImage
from gsopt.data.scene import load_scene, read_dataset
from gsopt.data.sfm.trajectory import align, centers, compare
from gsopt.events import to_json, write_atomic
from gsopt.geometry.cameras import opengl_from_viewmats

RESULTS = Path(__file__).parent / "results" / "own_poses.json"
MEANS = ("psnr", "psnr_object", "ssim", "lpips_alex", "cc_psnr")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path, help="folder for photos, scenes and runs; what is there is not made again")
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--flags", default="", help="more words for `gsopt sfm`")
    parser.add_argument("--train", default="-r 4 --lambda-sds 0 --threads 1", help="words for `gsopt train`")
    args = parser.parse_args()
    inputs, held_out = split(args.data, args.views)
    name = f"{args.data.name} {args.views} {args.flags}".strip()
    folder = args.out / name.replace(" ", "-")
    scene = posed(inputs, folder, shlex.split(args.flags))
    words = shlex.split(args.train)
    rows = {f"{name}: own poses": trained(aligned(scene, inputs, held_out, folder), folder / "own", words)}
    rows[f"{name}: own poses"] |= agreement(scene, inputs)
    published = ["--eval", "--views", str(args.views)]
    rows[f"{name}: published poses"] = trained(args.data, folder / "published", [*words, *published])
    known = dict(json.loads(RESULTS.read_text())["rows"]) if RESULTS.is_file() else {}
    document = {"command": "python experiments/own_poses.py DATA OUT", "train": args.train, "machine": machine()}
    write_atomic(RESULTS, to_json({**document, "rows": {**known, **rows}}))
    print(json.dumps(rows, indent=1))


def split(data: Path, views: int) -> tuple[list[PosedImage], list[PosedImage]]:
    """Input photos and held-out ones, as `gsopt train --eval --views` takes them."""
    scene = load_scene(DataConfig(path=str(data), views=views, eval=True))
    dataset = read_dataset(data)
    frames = {frame.name: frame for frame in [*dataset.frames, *(dataset.held_out or [])]}
    return [frames[view.name] for view in scene.train], [frames[view.name] for view in scene.test]


def mask_of(frame: PosedImage) -> Path | None:
    mask = frame.path.parents[1] / "masks" / f"{frame.path.stem}.png"
    return mask if mask.is_file() else None


def posed(inputs: list[PosedImage], folder: Path, flags: list[str]) -> Path:
    """The scene that `gsopt sfm` makes of a folder with nothing but the input photos (and their masks)."""
    photos, scene = folder / "photos", folder / "scene"
    if not scene.exists():
        shutil.rmtree(photos, ignore_errors=True)
        photos.mkdir(parents=True)
        for frame in inputs:
            shutil.copyfile(frame.path, photos / frame.path.name)
            if mask := mask_of(frame):
                (photos / "masks").mkdir(exist_ok=True)
                shutil.copyfile(mask, photos / "masks" / mask.name)
        words = ["sfm", str(photos), "-o", str(scene), "--no-undistort", "--threads", "1", *flags]
        subprocess.run([sys.executable, "-m", "gsopt", *words], check=True)
    return scene


def pairs(scene: Path, inputs: list[PosedImage]) -> tuple[Any, Any]:
    """cam_from_world of the photos that were placed: found, and published."""
    found = {Path(frame.name).stem: frame.viewmat.numpy() for frame in read_dataset(scene).frames}
    placed = [frame for frame in inputs if frame.path.stem in found]
    return np.stack([found[frame.path.stem] for frame in placed]), np.stack([f.viewmat.numpy() for f in placed])


def agreement(scene: Path, inputs: list[PosedImage]) -> dict[str, Any]:
    found, published = pairs(scene, inputs)
    error = compare(found, published).summary()
    return {"posed": len(found), **{key: value for key, value in error.items() if not key.endswith("median")}}


def aligned(scene: Path, inputs: list[PosedImage], held_out: list[PosedImage], folder: Path) -> Path:
    """A dataset of the found input cameras and of the held-out ones in their world."""
    data = folder / "data"
    shutil.rmtree(data, ignore_errors=True)
    (data / "images").mkdir(parents=True)
    found, published = pairs(scene, inputs)
    to_found = align(centers(published), centers(found))
    turned = published[:, :3, :3] @ to_found.rotation.T
    turn = mean_rotation(found[:, :3, :3] @ np.swapaxes(turned, 1, 2))
    document = json.loads((scene / "transforms.json").read_text())
    lens = {key: value for key, value in document["frames"][0].items() if key not in ("file_path", "transform_matrix")}
    entries = []
    for frame in held_out:
        pose = frame.viewmat.numpy().copy()
        center = to_found.scale * to_found.rotation @ centers(pose[None])[0] + to_found.translation
        pose[:3, :3] = turn @ pose[:3, :3] @ to_found.rotation.T
        pose[:3, 3] = -pose[:3, :3] @ center
        matrix = opengl_from_viewmats(torch.from_numpy(pose)).tolist()
        entries.append({**lens, "file_path": f"images/{frame.path.name}", "transform_matrix": matrix})
    shutil.copytree(scene / "images", data / "images", dirs_exist_ok=True)
    for frame in held_out:
        shutil.copyfile(frame.path, data / "images" / frame.path.name)
    for frame in [*inputs, *held_out]:
        if mask := mask_of(frame):
            (data / "masks").mkdir(exist_ok=True)
            shutil.copyfile(mask, data / "masks" / mask.name)
    shutil.copyfile(scene / "points.ply", data / "points.ply")
    write_atomic(data / "transforms_train.json", to_json(document))
    write_atomic(data / "transforms_test.json", to_json({"frames": entries}))
    return data


def mean_rotation(rotations: Any) -> Any:
    """The rotation next to the mean matrix (chordal mean)."""
    U, _, Vt = np.linalg.svd(rotations.mean(axis=0))
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt


def trained(data: Path, run: Path, words: list[str]) -> dict[str, Any]:
    if not (run / "metrics.json").is_file():
        shutil.rmtree(run, ignore_errors=True)
        command = [sys.executable, "-m", "gsopt", "train", str(data), "-m", str(run), *words]
        subprocess.run(command, check=True)
    metrics = json.loads((run / "metrics.json").read_text())
    means = {name: round(metrics["mean"][name], 4) for name in MEANS if metrics["mean"].get(name) is not None}
    return {**means, "held_out": len(metrics["per_view"]), "steps": metrics["steps"]}


if __name__ == "__main__":
    main()
