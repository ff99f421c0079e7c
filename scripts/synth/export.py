"""Cameras and points as NeRF-synthetic, nerfstudio and COLMAP write them, side by side over the same images.

Poses in the JSON kinds are world_from_cam in OpenGL axes; COLMAP's are cam_from_world in OpenCV axes.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from synth.cameras import Shot
from synth.points import ply
from synth.settings import SPLITS, Settings

if TYPE_CHECKING:
    from jaxtyping import Float, Float32, UInt8

    Cloud = tuple[Float32[np.ndarray, "P 3"], Float32[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"]]

CLOUD_NAME = "points3d.ply"
PASS_FILES = {
    "depth_file_path": "depth/{}.npy",
    "normal_file_path": "normal/{}.npy",
    "position_file_path": "position/{}.npy",
    "hard_mask_file_path": "mask/{}.png",
    "soft_mask_file_path": "alpha/{}.png",
}
"""Key of a frame: where that pass of the view lies. No `mask_path`, which trainers would multiply into alpha."""
PINHOLE = 1
"""COLMAP's id of the camera model with fx, fy, cx, cy."""


def export(
    folder: Path, settings: Settings, views: Sequence[Shot], cloud: Cloud | None, origin: dict[str, Any]
) -> None:
    """Write every format of the settings into `folder`; `origin` is added to each JSON."""
    if cloud is not None:
        (folder / CLOUD_NAME).write_bytes(ply(*cloud))
        origin = origin | {"ply_file_path": CLOUD_NAME}
    if "nerf" in settings.formats:
        for split in SPLITS:
            chosen = [view for view in views if view.split == split]
            if chosen:
                write_json(folder / f"transforms_{split}.json", transforms(folder, settings, chosen, "") | origin)
    if "nerfstudio" in settings.formats:
        write_json(folder / "transforms.json", nerfstudio(folder, settings, views) | origin)
    if "colmap" in settings.formats:
        write_colmap(folder / "sparse" / "0", settings, views, cloud)


def write_json(path: Path, content: Any) -> None:
    path.write_text(json_text(content), encoding="utf-8")


def json_text(content: Any) -> str:
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def transforms(folder: Path, settings: Settings, views: Sequence[Shot], suffix: str) -> dict[str, Any]:
    """Intrinsics that all views share, then the frames; readers of NeRF-synthetic append .png to `file_path`."""
    lenses = [lens(settings, view) for view in views]
    shared = {k: v for k, v in lenses[0].items() if all(other[k] == v for other in lenses)}
    frames = []
    for view, own in zip(views, lenses, strict=True):
        files = {key: f"./{file.format(view.name)}" for key, file in PASS_FILES.items()}
        files = {key: file for key, file in files.items() if (folder / file).exists()}
        frame = {"file_path": f"./images/{view.name}{suffix}", "transform_matrix": view.world_from_cam.tolist()}
        frames.append(frame | files | {k: v for k, v in own.items() if k not in shared})
    return shared | {"frames": frames}


def lens(settings: Settings, view: Shot) -> dict[str, float]:
    width, height = settings.resolution
    return {
        "camera_angle_x": 2.0 * math.atan(0.5 * width / view.focal),
        "camera_angle_y": 2.0 * math.atan(0.5 * height / view.focal),
        "w": width,
        "h": height,
        "fl_x": view.focal,
        "fl_y": view.focal,
        "cx": view.center[0],
        "cy": view.center[1],
    }


def nerfstudio(folder: Path, settings: Settings, views: Sequence[Shot]) -> dict[str, Any]:
    """One transforms.json with the three lists of names that nerfstudio splits by; a missing one borrows the other."""
    names = {split: [f"./images/{v.name}.png" for v in views if v.split == split] for split in SPLITS}
    lists = {
        "train_filenames": names["train"],
        "test_filenames": names["test"] or names["val"],
        "val_filenames": names["val"] or names["test"],
    }
    return {"camera_model": "OPENCV"} | transforms(folder, settings, views, ".png") | lists


def write_colmap(folder: Path, settings: Settings, views: Sequence[Shot], cloud: Cloud | None) -> None:
    """cameras.bin, images.bin and points3D.bin (COLMAP "Output Format"), and the held-out names in test.txt."""
    folder.mkdir(parents=True)
    lenses = [(view.focal, view.focal, *view.center) for view in views]
    distinct = sorted(set(lenses))
    cameras = [struct.pack("<iiQQ4d", i, PINHOLE, *settings.resolution, *c) for i, c in enumerate(distinct, start=1)]
    images = []
    for number, (view, own) in enumerate(zip(views, lenses, strict=True), start=1):
        cam_from_world = np.diag([1.0, -1.0, -1.0, 1.0]) @ np.linalg.inv(view.world_from_cam)
        pose = (*quaternion(cam_from_world[:3, :3]), *cam_from_world[:3, 3])
        record = struct.pack("<I7dI", number, *pose, distinct.index(own) + 1)
        images.append(record + f"{view.name}.png".encode() + b"\0" + struct.pack("<Q", 0))
    for name, records in (("cameras.bin", cameras), ("images.bin", images)):
        (folder / name).write_bytes(struct.pack("<Q", len(records)) + b"".join(records))
    (folder / "points3D.bin").write_bytes(colmap_points(cloud))
    held_out = [f"{view.name}.png\n" for view in views if view.split != "train"]
    if held_out:
        (folder / "test.txt").write_text("".join(held_out), encoding="utf-8")


def colmap_points(cloud: Cloud | None) -> bytes:
    """points3D.bin: id, position, color, error and an empty track per point."""
    kind = [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")]
    rows = np.zeros(0 if cloud is None else len(cloud[0]), kind)
    if cloud is not None:
        rows["id"], rows["xyz"], rows["rgb"] = np.arange(1, len(rows) + 1), cloud[0], cloud[2]
    return struct.pack("<Q", len(rows)) + rows.tobytes()


def quaternion(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """w, x, y, z of a rotation, w >= 0: the eigenvector of Bar-Itzhack's matrix (2000) with the largest eigenvalue."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = R.ravel()
    K = np.array(
        [
            [xx - yy - zz, 0.0, 0.0, 0.0],
            [yx + xy, yy - xx - zz, 0.0, 0.0],
            [zx + xz, zy + yz, zz - xx - yy, 0.0],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    x, y, z, w = np.linalg.eigh(K / 3.0, UPLO="L")[1][:, 3]
    return np.array([w, x, y, z]) * (1.0 if w >= 0 else -1.0)
