"""Are poses better on which the silhouettes agree? Held-out views of one scene, with its poses and with moved ones.

    python experiments/silhouette_poses.py SCENE OUT [--published DATASET] [--train="-r 4 --threads 1"]

SCENE is a posed scene of photos with alpha: 12 photos of the museum head as `gsopt sfm --features both` posed them from
these photos and masks alone, before silhouettes held poses. All its poses are moved together (gsopt/data/sfm/
silhouettes.py); then every third photo is held out, in three turns, with both poses, and with those that DATASET has of
the same photos. A held-out photo's mask takes part in moving its pose, its colors never do. The head stood on a
turntable, so that right poses lie on a circle: how far they do not is an error that no other poses must be known for.
Rows go to experiments/results/silhouette_poses.json.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.benchmark.machine import machine
from gsopt.data.scene import load_scene, read_dataset
from gsopt.data.sfm.silhouettes import coherent_poses
from gsopt.data.sfm.trajectory import align, centers
from gsopt.events import to_json, write_atomic
from gsopt.geometry.cameras import opengl_from_viewmats

RESULTS = Path(__file__).parent / "results" / "silhouette_poses.json"
TURNS = 3
METRICS = ("psnr", "psnr_object", "ssim", "lpips_alex")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--published", type=Path, help="posed dataset with the same photos")
    parser.add_argument("--train", default="-r 4 --threads 1", help="more words for `gsopt train`")
    args = parser.parse_args()
    views = load_scene(args.scene).train
    names = [view.name for view in views]
    moved = coherent_poses(views)
    assert moved is not None
    found = torch.cat([view.camera.viewmats for view in views]).double()
    poses = {"found": cameras(names, found), "moved": cameras(names, moved.viewmats)}
    off_circle = {"found": from_circle(found), "moved": from_circle(moved.viewmats)}
    if args.published:
        published, focal = of_dataset(args.published, names, found)
        poses["published"] = cameras(names, published, focal)
        off_circle["published"] = from_circle(published)
    rows = []
    for turn in range(TURNS):
        for kind, chosen in poses.items():
            data = split(args.scene, args.out / f"{turn}-{kind}", names[turn::TURNS], chosen)
            rows.append({"turn": turn, "poses": kind, **trained(data, shlex.split(args.train))})
            print(json.dumps(rows[-1]), flush=True)
    misses = {"before": moved.before, "after": moved.after}
    document = {"command": __doc__.split("\n\n")[1].strip(), "machine": machine(), "misses_px": misses}
    write_atomic(RESULTS, to_json({**document, "off_circle_share_of_radius": off_circle, "rows": rows}))


def cameras(
    names: list[str], viewmats: Float[Tensor, "C 4 4"], focal: dict[str, float] | None = None
) -> dict[str, dict[str, Any]]:
    """Entries of transforms.json by photo."""
    matrices = opengl_from_viewmats(viewmats).tolist()
    return {name: {"transform_matrix": matrix, **(focal or {})} for name, matrix in zip(names, matrices, strict=True)}


def of_dataset(
    folder: Path, names: list[str], found: Float[Tensor, "C 4 4"]
) -> tuple[Float[Tensor, "C 4 4"], dict[str, float]]:
    """The dataset's poses of these photos after the similarity that takes them closest to the found ones, and its focal
    length."""
    frames = {Path(frame.name).stem: frame for frame in read_dataset(folder).frames}
    chosen = [frames[Path(name).stem] for name in names]
    viewmats = np.stack([frame.viewmat.numpy() for frame in chosen])
    similarity = align(centers(viewmats), centers(found.numpy()))
    rotations = viewmats[:, :3, :3] @ similarity.rotation.T
    eyes = similarity.scale * centers(viewmats) @ similarity.rotation.T + similarity.translation
    placed = np.tile(np.eye(4), (len(names), 1, 1))
    placed[:, :3, :3], placed[:, :3, 3] = rotations, -np.einsum("cij,cj->ci", rotations, eyes)
    K = chosen[0].K
    return torch.from_numpy(placed), {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1])}


def from_circle(viewmats: Float[Tensor, "C 4 4"]) -> float:
    """Root mean square distance of the eyes from their best circle, a share of its radius."""
    eyes = centers(viewmats.numpy())
    eyes = eyes - eyes.mean(axis=0)
    x, y, height = np.linalg.svd(eyes, full_matrices=False)[2] @ eyes.T
    a, b, c = np.linalg.lstsq(np.column_stack([2 * x, 2 * y, np.ones_like(x)]), x**2 + y**2, rcond=None)[0]
    radius = np.sqrt(c + a**2 + b**2)
    off = np.hypot(np.hypot(x - a, y - b) - radius, height)
    return float(np.sqrt(np.square(off).mean()) / radius)


def split(scene: Path, data: Path, held_out: list[str], poses: dict[str, dict[str, Any]]) -> Path:
    """The scene with these poses, and some views held out."""
    document = json.loads((scene / "transforms.json").read_text())
    frames = [{**frame, **poses[frame["file_path"]]} for frame in document["frames"]]
    data.mkdir(parents=True, exist_ok=True)
    if not (data / "images").exists():
        (data / "images").symlink_to((scene / "images").resolve())
        (data / "points.ply").symlink_to((scene / "points.ply").resolve())
    for name, held in (("train", False), ("test", True)):
        chosen = [frame for frame in frames if (frame["file_path"] in held_out) == held]
        write_atomic(data / f"transforms_{name}.json", to_json({**document, "frames": chosen}))
    return data


def trained(data: Path, flags: list[str]) -> dict[str, float]:
    """Held-out figures of one run."""
    run = data / "run"
    if not (run / "metrics.json").is_file():
        command = [sys.executable, "-m", "gsopt", "train", str(data), "-m", str(run), "--lambda_sds", "0", *flags]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    mean = json.loads((run / "metrics.json").read_text())["mean"]
    return {name: round(mean[name], 4) for name in METRICS}


if __name__ == "__main__":
    main()
