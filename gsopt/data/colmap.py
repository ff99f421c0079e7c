"""COLMAP folders: sparse/0 or sparse (.bin or .txt), images/; optionally images_2/4/8, masks/ and sparse/0/test.txt.

Written from COLMAP's documented format ("Output Format"); poses are world to camera in OpenCV axes, pixel centers at
+0.5. Counts in a file are checked against its size before anything is allocated.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.data import files
from gsopt.data.colmap_files import CameraRecord, ImageRecord, read_cameras, read_images, read_points
from gsopt.data.lens import Lens
from gsopt.data.posed_images import Dataset, PosedImage, check_enough, check_pose, summarize_names
from gsopt.errors import InputError

SUPPORTED_MODELS = (
    "SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV, OPENCV_FISHEYE, SIMPLE_RADIAL_FISHEYE, "
    "RADIAL_FISHEYE, THIN_PRISM_FISHEYE"
)


@dataclass(frozen=True)
class ColmapModel:
    """Folder and file format of a reconstruction."""

    folder: Path
    suffix: str
    """.bin or .txt."""

    def file(self, stem: str) -> Path:
        return self.folder / (stem + self.suffix)


def find_model(root: Path) -> ColmapModel | None:
    """The reconstruction below `root`: sparse/0 before sparse, .bin before .txt."""
    for folder in (root / "sparse" / "0", root / "sparse"):
        for suffix in (".bin", ".txt"):
            model = ColmapModel(folder, suffix)
            if files.is_regular(model.file("cameras")) and files.is_regular(model.file("images")):
                return model
    return None


def read_colmap(root: Path) -> Dataset:
    """Read the reconstruction of `root`. Raises InputError."""
    model = find_model(root)
    if model is None:
        raise InputError(f"{root} has no sparse/0/cameras.bin or .txt. Run COLMAP or `gsopt sfm` first.")
    if not (root / "images").is_dir():
        raise InputError(f"{root} has a COLMAP model but no folder images/. Put the photos there.")
    cameras = read_cameras(model.file("cameras"))
    records = sorted(read_images(model.file("images")), key=lambda record: record.name)
    warnings: list[str] = []
    frames = _frames(root, records, cameras, model.file("images"), warnings)
    held_out, frames = _held_out(model.folder / "test.txt", frames)
    xyz, rgb = None, None
    if files.is_regular(model.file("points3D")):
        positions, colors = read_points(model.file("points3D"))
        finite = np.isfinite(positions).all(axis=1)
        xyz, rgb = torch.from_numpy(positions[finite]), torch.from_numpy(colors[finite])
    return Dataset("colmap", frames, held_out, xyz, rgb, warnings)


def _frames(
    root: Path, records: list[ImageRecord], cameras: dict[int, CameraRecord], path: Path, warnings: list[str]
) -> list[PosedImage]:
    frames: list[PosedImage] = []
    absent: list[str] = []
    for record in records:
        image = files.child(root / "images", record.name)
        where = f"image {record.name!r} in {path}"
        if record.camera_id not in cameras:
            raise InputError(
                f"The {where} refers to camera {record.camera_id}, which is not listed. Export the model again."
            )
        if not files.is_regular(image):
            absent.append(record.name)
            continue
        frames.append(_frame(root, record, cameras[record.camera_id], image, where, len(frames)))
    check_enough(frames, absent, path)
    if absent:
        warnings.append(
            f"{path.name} poses {len(records)} images, {len(absent)} of them are absent from images/ and left out: "
            f"{summarize_names(absent)}."
        )
    return frames


def _frame(root: Path, record: ImageRecord, camera: CameraRecord, image: Path, where: str, position: int) -> PosedImage:
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = _rotation(record.quat, where)
    viewmat[:3, 3] = torch.tensor(record.translation, dtype=torch.float64)
    check_pose(viewmat, where)
    K, lens = _camera_model(camera, where)
    name = files.relative_name(image, root)
    return PosedImage(name, image, None, viewmat, K, camera.width, camera.height, lens, position)


def _rotation(quat: tuple[float, float, float, float], where: str) -> Float[Tensor, "3 3"]:
    """Rotation matrix of a wxyz quaternion, normalized first."""
    q = torch.tensor(quat, dtype=torch.float64)
    norm = float(q.norm())
    if not 1e-6 < norm < 1e6:
        raise InputError(f"The pose of {where} is not rigid: its quaternion is {list(quat)}. Correct or remove it.")
    w, x, y, z = (q / norm).tolist()
    return torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ],
        dtype=torch.float64,
    )


def _camera_model(camera: CameraRecord, where: str) -> tuple[Float[Tensor, "3 3"], Lens]:
    """Intrinsics and lens of COLMAP's parameter lists (src/colmap/sensor/models.h)."""
    p, model = camera.params, camera.model
    shared_focal = model.startswith(("SIMPLE_", "RADIAL"))
    fx, fy, cx, cy = (p[0], p[0], p[1], p[2]) if shared_focal else p[:4]
    rest = p[3:] if shared_focal else p[4:]
    if not min(fx, fy) > 0 or camera.width < 1 or camera.height < 1:
        raise InputError(
            f"Camera {camera.camera_id} of {where} has focal lengths {fx}, {fy} and size {camera.width}x"
            f"{camera.height}; all must be positive. Export the model again."
        )
    K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
    if model in ("SIMPLE_PINHOLE", "PINHOLE"):
        return K, Lens()
    if model in ("SIMPLE_RADIAL", "RADIAL"):
        return K, Lens(radial=rest)
    if model in ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"):
        return K, Lens(radial=rest, fisheye=True)
    if model == "OPENCV":
        return K, Lens(radial=rest[:2], tangential=(rest[2], rest[3]))
    if model == "FULL_OPENCV":
        k1, k2, p1, p2, k3, *divisor = rest
        return K, Lens(radial=(k1, k2, k3), divisor=tuple(divisor), tangential=(p1, p2))
    if model == "THIN_PRISM_FISHEYE":
        k1, k2, p1, p2, k3, k4, s1, s2 = rest
        return K, Lens(radial=(k1, k2, k3, k4), tangential=(p1, p2), prism=(s1, s2), fisheye=True)
    raise InputError(
        f"The {where} uses camera model {model}; read are {SUPPORTED_MODELS}. Undistort it with COLMAP first."
    )


def _held_out(path: Path, frames: list[PosedImage]) -> tuple[list[PosedImage] | None, list[PosedImage]]:
    """(test, rest) by the names in test.txt, one a line, as in images.txt; (None, all) without that file."""
    if not files.is_regular(path):
        return None, frames
    names = {"images/" + line.strip() for line in files.read_lines(path)}
    test = [frame for frame in frames if frame.name in names]
    if not test:
        raise InputError(f"{path} names no image of the model. Write one image name a line, or remove the file.")
    return test, [frame for frame in frames if frame.name not in names]
