"""A finished scene on disk: images/, sparse/0/ (COLMAP), transforms.json (nerfstudio) and points.ply."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from PIL import Image

from gsopt.config.train import DataConfig
from gsopt.data.colmap import read_colmap
from gsopt.data.image_files import write_image
from gsopt.data.images import ImageStore
from gsopt.data.posed_images import PosedImage
from gsopt.data.scene import View, load_scene
from gsopt.data.sfm.masks import FeatureInput
from gsopt.data.sfm.placement import Similarity
from gsopt.errors import InputError
from gsopt.events import to_json, write_atomic
from gsopt.geometry.cameras import opengl_from_viewmats

SCENE = "scene"
"""Name of the finished scene inside the working folder."""
JPEG_QUALITY = 97
"""High: the photos are compared with renderings pixel by pixel."""


def write_scene(
    pycolmap: ModuleType, reconstruction: Any, work: Path, inputs: FeatureInput, similarity: Similarity, undistort: bool
) -> Path:
    """Write the scene to WORK/scene and return that folder. `reconstruction` is changed to what was written."""
    reconstruction.transform(pycolmap.Sim3d(similarity.scale, _rotation(pycolmap, similarity), similarity.translation))
    found, scene = found_scene(reconstruction, work / "found", inputs), work / SCENE
    (scene / "images").mkdir(parents=True)
    if undistort:
        _write_undistorted(pycolmap, reconstruction, found, scene)
    else:
        _write_as_taken(reconstruction, found, scene)
    export_model(reconstruction, scene, work / "again")
    write_atomic(scene / "transforms.json", to_json(transforms(read_colmap(scene).frames, similarity)))
    return scene


def found_scene(reconstruction: Any, folder: Path, inputs: FeatureInput) -> Path:
    """Makes `folder` a scene of the photos as they were taken, with their masks, and returns it."""
    _model_folder(reconstruction, folder)
    work = folder.parent
    (folder / "images").symlink_to(work / "photos")
    if inputs.kind == "folder":
        (folder / "masks").symlink_to(work / "masks")
    return folder


def transforms(frames: Sequence[PosedImage], similarity: Similarity) -> dict[str, Any]:
    """nerfstudio's transforms.json. `applied_transform` and `applied_scale` record the placement of the world."""
    applied = np.column_stack([similarity.rotation, similarity.translation / similarity.scale])
    return {
        "applied_transform": applied.tolist(),
        "applied_scale": similarity.scale,
        "ply_file_path": "points.ply",
        "frames": [_frame(frame) for frame in frames],
    }


def _frame(frame: PosedImage) -> dict[str, Any]:
    lens, K = frame.lens, frame.K
    k1, k2, k3, k4 = [*lens.radial, 0.0, 0.0, 0.0, 0.0][:4]
    entry = {
        "file_path": frame.name,
        "transform_matrix": opengl_from_viewmats(frame.viewmat).tolist(),
        "w": frame.width,
        "h": frame.height,
        "fl_x": float(K[0, 0]),
        "fl_y": float(K[1, 1]),
        "cx": float(K[0, 2]),
        "cy": float(K[1, 2]),
    }
    if lens.is_pinhole:
        return {**entry, "camera_model": "PINHOLE"}
    p1, p2 = lens.tangential
    model = "OPENCV_FISHEYE" if lens.fisheye else "OPENCV"
    return {**entry, "camera_model": model, "k1": k1, "k2": k2, "k3": k3, "k4": k4, "p1": p1, "p2": p2}


def _rotation(pycolmap: ModuleType, similarity: Similarity) -> Any:
    return pycolmap.Rotation3d(np.ascontiguousarray(similarity.rotation))


def export_model(reconstruction: Any, folder: Path, again: Path) -> None:
    """Writes sparse/0/ and points.ply into `folder`, and `again`: COLMAP's writers do not notice a disk that refuses a
    part. Raises InputError where the two differ."""
    for target in (folder, again):
        _model_folder(reconstruction, target)
        reconstruction.export_PLY(target / "points.ply")
    for file in (folder / "points.ply", *sorted((folder / "sparse" / "0").iterdir())):
        if file.read_bytes() != (again / file.relative_to(folder)).read_bytes():
            raise InputError(f"The disk took only a part of {file.name}. Make room, or choose another `--out`.")


def _model_folder(reconstruction: Any, folder: Path) -> None:
    target = folder / "sparse" / "0"
    target.mkdir(parents=True)
    reconstruction.write(target)


def _write_as_taken(reconstruction: Any, found: Path, scene: Path) -> None:
    """Photos and masks as they are; the lens stays in the model."""
    for image_id in reconstruction.reg_image_ids():
        name = reconstruction.image(image_id).name
        shutil.copyfile(found / "images" / name, scene / "images" / name)
        mask = found / "masks" / f"{name}.png"
        if mask.is_file():
            (scene / "masks").mkdir(exist_ok=True)
            shutil.copyfile(mask, scene / "masks" / mask.name)


def _write_undistorted(pycolmap: ModuleType, reconstruction: Any, found: Path, scene: Path) -> None:
    """Pinhole photos, as gsopt's own loader would make them; a mask becomes their alpha."""
    views = load_scene(DataConfig(path=str(found), downscale=1, cache_mb=0)).train
    images = {reconstruction.image(i).name: reconstruction.image(i) for i in reconstruction.reg_image_ids()}
    pinholes: dict[int, list[float]] = {}
    for view in views:
        image = images[view.name.removeprefix("images/")]
        K = view.camera.Ks[0].double()
        pinholes[image.camera_id] = [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]
        image.name = _write_view(view, found, scene, image.name)
    straighten(pycolmap, reconstruction, pinholes)


def _write_view(view: View, found: Path, scene: Path, name: str) -> str:
    """Writes one photo and returns its name, which ends in .png where there is alpha."""
    assert isinstance(view.store, ImageStore)  # the scene was just loaded: its views are files
    stored = view.store.sources[view.index]
    if stored.undistortion is None and stored.mask is None:
        shutil.copyfile(found / "images" / name, scene / "images" / name)
        return name
    pixels = view.pixels().numpy()
    if pixels.shape[2] == 4:
        name = Path(name).stem + ".png"
    path = scene / "images" / name
    options: dict[str, Any] = (
        {"compress_level": 3} if path.suffix == ".png" else {"quality": JPEG_QUALITY, "subsampling": 0}
    )
    write_image(Image.fromarray(pixels), path, **options)
    return name


def straighten(pycolmap: ModuleType, reconstruction: Any, pinholes: Mapping[int, list[float]]) -> None:
    """Replace lenses by pinholes (fx, fy, cx, cy by camera) and move the observations to where they are now."""
    for image_id in reconstruction.reg_image_ids():
        image = reconstruction.image(image_id)
        fx, fy, cx, cy = pinholes[image.camera_id]
        camera = reconstruction.camera(image.camera_id)
        if len(image.points2D) == 0:
            continue
        rays = camera.cam_from_img(np.array([point.xy for point in image.points2D]))
        for point, (x, y) in zip(image.points2D, rays, strict=True):
            point.xy = np.array([fx * x + cx, fy * y + cy])
    for camera_id, params in pinholes.items():
        camera = reconstruction.camera(camera_id)
        camera.model = pycolmap.CameraModelId.PINHOLE
        camera.params = params
    reconstruction.update_point_3d_errors()
