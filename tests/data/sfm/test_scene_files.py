"""A finished scene holds photos and masks, cameras without distortion, points, and the way back."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image, JpegImagePlugin

from gsopt.config.train import DataConfig
from gsopt.data.lens import Lens
from gsopt.data.posed_images import PosedImage
from gsopt.data.scene import load_scene
from gsopt.data.sfm.masks import FeatureInput
from gsopt.data.sfm.placement import Similarity
from gsopt.data.sfm.write_scene import export_model, found_scene, straighten, transforms, write_scene
from gsopt.errors import InputError

pycolmap = pytest.importorskip("pycolmap")

WIDTH, HEIGHT, FOCAL = 64, 48, 50.0
QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
PLACED = Similarity(2.0, QUARTER, np.array([1.0, 2.0, 3.0]))
POINTS = np.random.default_rng(0).uniform(-0.4, 0.4, (12, 3))


def reconstruction(*names: str, model: str = "PINHOLE", distortion: tuple[float, ...] = (), seen: int = 12) -> Any:
    """Cameras beside each other, 3 before the points, which all of them see exactly where they are."""
    made = pycolmap.Reconstruction()
    focals = [FOCAL] if model == "SIMPLE_RADIAL" else [FOCAL, FOCAL + 2]
    params = [*focals, WIDTH / 2 + 1, HEIGHT / 2 - 1, *distortion]
    made.add_camera_with_trivial_rig(
        pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params, camera_id=1)
    )
    for number, name in enumerate(names, 1):
        away = np.array([0.1 * number, 0, 3])
        pixels = made.camera(1).img_from_cam(POINTS[:seen] + away) if seen else np.zeros((0, 2))
        image = pycolmap.Image(name=name, keypoints=pixels, camera_id=1, image_id=number)
        made.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(), away))
    for row, point in enumerate(POINTS[:seen]):
        track = pycolmap.Track()
        for number in range(1, len(names) + 1):
            track.add_element(number, row)
        made.add_point3D(point, track, np.array([10 * row, 20, 30], dtype=np.uint8))
    return made


def taken(work: Path, *names: str, masks: tuple[str, ...] = ()) -> FeatureInput:
    """Photos of noise in the working folder, and white masks with a black row for some of them."""
    (work / "photos").mkdir(parents=True)
    for number, name in enumerate(names):
        pixels = np.random.default_rng(number).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(work / "photos" / name, **({"quality": 90} if name.endswith("jpg") else {}))
    (work / "masks").mkdir()
    for name in masks:
        mask = np.full((HEIGHT, WIDTH), 255, dtype=np.uint8)
        mask[0] = 0
        Image.fromarray(mask).save(work / "masks" / f"{name}.png")
    return FeatureInput(work / "photos", work / "masks" if masks else None, "folder" if masks else "none", [])


def names_in(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def shown(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def test_photos_of_a_pinhole_without_masks_are_copied_bit_by_bit(tmp_path: Path) -> None:
    inputs = taken(tmp_path, "a.jpg", "b.png")
    scene = write_scene(pycolmap, reconstruction("a.jpg", "b.png"), tmp_path, inputs, Similarity.identity(), True)
    assert scene == tmp_path / "scene"
    for name in ("a.jpg", "b.png"):
        assert (scene / "images" / name).read_bytes() == (tmp_path / "photos" / name).read_bytes()
    assert {"transforms.json", "points.ply", "sparse/0/cameras.bin", "images/a.jpg"} <= set(names_in(scene))
    assert not (scene / "masks").exists()


def test_a_mask_becomes_the_alpha_of_a_png_that_loses_nothing(tmp_path: Path) -> None:
    """A photo without a mask stays what it was."""
    inputs = taken(tmp_path, "a.jpg", "b.jpg", masks=("a.jpg",))
    made = reconstruction("a.jpg", "b.jpg")
    scene = write_scene(pycolmap, made, tmp_path, inputs, Similarity.identity(), True)
    pixels, original = shown(scene / "images" / "a.png"), shown(tmp_path / "photos" / "a.jpg")
    assert pixels.shape == (HEIGHT, WIDTH, 4)
    assert (pixels[0, :, 3].max(), pixels[1:, :, 3].min()) == (0, 255)
    assert (pixels[1:, :, :3] == original[1:]).all()
    assert (scene / "images" / "b.jpg").read_bytes() == (tmp_path / "photos" / "b.jpg").read_bytes()
    frames = json.loads((scene / "transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == ["images/a.png", "images/b.jpg"]
    assert [made.image(i).name for i in (1, 2)] == ["a.png", "b.jpg"]


def test_masks_that_are_not_those_of_a_folder_stay_out_of_the_scene(tmp_path: Path) -> None:
    """Alpha is in the photos already."""
    taken(tmp_path, "a.png", masks=("a.png",))
    for kind in ("alpha", "folder"):
        inputs = FeatureInput(tmp_path / "photos", tmp_path / "masks", kind, [])
        found = found_scene(reconstruction("a.png"), tmp_path / kind, inputs)
        assert (found / "masks").exists() == (kind == "folder")
        assert shown(found / "images" / "a.png").tolist() == shown(tmp_path / "photos" / "a.png").tolist()
        assert (found / "sparse" / "0" / "cameras.bin").is_file()


def test_photos_as_they_were_taken_keep_their_lens_and_their_masks(tmp_path: Path) -> None:
    inputs = taken(tmp_path, "a.jpg", "b.jpg", "c.jpg", masks=("a.jpg", "c.jpg"))
    made = reconstruction("a.jpg", "b.jpg", "c.jpg", model="SIMPLE_RADIAL", distortion=(0.1,))
    scene = write_scene(pycolmap, made, tmp_path, inputs, Similarity.identity(), False)
    for name in ("images/a.jpg", "images/b.jpg", "images/c.jpg", "masks/a.jpg.png", "masks/c.jpg.png"):
        assert (scene / name).read_bytes() == (tmp_path / name.replace("images", "photos")).read_bytes()
    assert len(names_in(scene / "masks")) == 2
    assert made.camera(1).params.tolist() == [FOCAL, WIDTH / 2 + 1, HEIGHT / 2 - 1, 0.1]
    frame = json.loads((scene / "transforms.json").read_text())["frames"][0]
    assert (frame["camera_model"], frame["k1"], frame["fl_x"]) == ("OPENCV", 0.1, FOCAL)


@pytest.mark.parametrize("longest", [1600, WIDTH // 2])
def test_an_undistorted_scene_sees_its_points_through_pinholes_exactly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, longest: int
) -> None:
    """These are the pinholes of the photos as gsopt undistorts them, at their size, even where training reduces it.
    JPEGs keep the colors of every pixel."""
    monkeypatch.setattr("gsopt.data.scene.LONGEST_SIDE", longest)
    names = ("a.jpg", "b.jpg")
    inputs = taken(tmp_path, *names)
    made = reconstruction(*names, model="OPENCV", distortion=(0.1, 0.0, 0.0, 0.0))
    scene = write_scene(pycolmap, made, tmp_path, inputs, PLACED, True)
    K = load_scene(DataConfig(path=str(tmp_path / "found"), downscale=1)).train[0].camera.Ks[0]
    assert made.camera(1).params.tolist() == [float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))]
    assert len(set(made.camera(1).params)) == 4
    assert made.camera(1).model.name == "PINHOLE"
    assert made.compute_mean_reprojection_error() < 1e-9
    for name in names:
        with Image.open(scene / "images" / name) as image:
            assert JpegImagePlugin.get_sampling(image) == 0
            assert image.size == (made.camera(1).width, made.camera(1).height) == (WIDTH, HEIGHT)
    read = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    assert read.camera(1).params.tolist() == made.camera(1).params.tolist()


def test_the_placement_moves_points_and_cameras_alike(tmp_path: Path) -> None:
    inputs = taken(tmp_path, "a.png", "b.png")
    made = reconstruction("a.png", "b.png")
    write_scene(pycolmap, made, tmp_path, inputs, PLACED, True)
    moved = np.array([made.point3D(i).xyz for i in sorted(made.point3D_ids())])
    np.testing.assert_allclose(moved, 2 * POINTS @ QUARTER.T + [1, 2, 3], atol=1e-9)
    center = made.image(1).projection_center()
    np.testing.assert_allclose(center, 2 * QUARTER @ [-0.1, 0, -3] + [1, 2, 3], atol=1e-9)


def test_pinholes_replace_lenses_also_in_photos_that_see_nothing() -> None:
    made = reconstruction("a.png", "b.png", model="SIMPLE_RADIAL", distortion=(0.2,), seen=0)
    straighten(pycolmap, made, {1: [40.0, 41.0, 30.0, 20.0]})
    assert made.camera(1).model.name == "PINHOLE"
    assert made.camera(1).params.tolist() == [40, 41, 30, 20]


def test_an_observation_moves_to_where_the_pinhole_sees_its_ray() -> None:
    """The ray of a point at (x, y, z) meets the picture at (fx x / z + cx, fy y / z + cy), also of a single point."""
    for seen in (1, 12):
        made = reconstruction("a.png", model="SIMPLE_RADIAL", distortion=(0.2,), seen=seen)
        straighten(pycolmap, made, {1: [40.0, 80.0, 30.0, 20.0]})
        x, y, z = (POINTS[:seen] + np.array([0.1, 0, 3])).T
        observed = np.array([point.xy for point in made.image(1).points2D])
        np.testing.assert_allclose(observed, np.stack([40 * x / z + 30, 80 * y / z + 20], 1), atol=1e-7)
        assert [made.point3D(i).error for i in made.point3D_ids()] == pytest.approx([0] * seen, abs=1e-7)


def test_a_model_that_a_full_disk_cut_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """COLMAP does not notice it; the second copy differs."""

    class Cut:
        def __init__(self, name: str) -> None:
            self.name = name

        def write(self, folder: Path) -> None:
            for name in ("cameras.bin", "points3D.bin"):
                cut = name == self.name and "again" not in folder.parts
                (folder / name).write_bytes(b"12" if cut else b"1234")

        def export_PLY(self, path: Path) -> None:
            path.write_bytes(b"p" if self.name == path.name and "again" not in path.parts else b"ply")

    for number, name in enumerate(("cameras.bin", "points3D.bin", "points.ply")):
        with pytest.raises(InputError, match=f"only a part of {name}"):
            export_model(Cut(name), tmp_path / str(number) / "scene", tmp_path / str(number) / "again")
    export_model(Cut("none"), tmp_path / "scene", tmp_path / "again")
    shutil.rmtree(tmp_path / "again")
    assert names_in(tmp_path / "scene") == ["points.ply", "sparse/0/cameras.bin", "sparse/0/points3D.bin"]


def posed_image(lens: Lens) -> PosedImage:
    K = torch.tensor([[50.0, 0, 31], [0, 52, 25], [0, 0, 1]], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    return PosedImage("images/a.png", Path("a.png"), None, viewmat, K, 64, 48, lens, 0)


@pytest.mark.parametrize(
    ("lens", "model", "terms"),
    [
        (Lens(), "PINHOLE", None),
        (Lens(radial=(0.1,)), "OPENCV", (0.1, 0, 0, 0, 0, 0)),
        (Lens(tangential=(0.5, 0.6)), "OPENCV", (0, 0, 0, 0, 0.5, 0.6)),
        (Lens(radial=(0.1, 0.2), tangential=(0.5, 0.6)), "OPENCV", (0.1, 0.2, 0, 0, 0.5, 0.6)),
        (Lens(radial=(0.1, 0.2, 0.3, 0.4), fisheye=True), "OPENCV_FISHEYE", (0.1, 0.2, 0.3, 0.4, 0, 0)),
    ],
)
def test_transforms_hold_the_lens_in_the_words_of_nerfstudio(
    lens: Lens, model: str, terms: tuple[float, ...] | None
) -> None:
    """A camera at -t that looks along +z has its y and z axes turned around in OpenGL's frame."""
    (frame,) = transforms([posed_image(lens)], PLACED)["frames"]
    assert (frame["camera_model"], frame["file_path"]) == (model, "images/a.png")
    assert [frame[name] for name in ("w", "h", "fl_x", "fl_y", "cx", "cy")] == [64, 48, 50, 52, 31, 25]
    assert frame["transform_matrix"] == [[1, 0, 0, -1], [0, -1, 0, -2], [0, 0, -1, -3], [0, 0, 0, 1]]
    names = ("k1", "k2", "k3", "k4", "p1", "p2")
    assert tuple(frame[name] for name in names if name in frame) == (terms or ())


def test_the_placement_is_recorded_as_nerfstudio_applies_it() -> None:
    """It turns and shifts first and scales then: scale (R x + t / scale) is the placed point."""
    found = transforms([], PLACED)
    assert (found["applied_scale"], found["ply_file_path"]) == (2.0, "points.ply")
    applied = np.array(found["applied_transform"])
    point = np.array([math.pi, -1.0, 0.5])
    placed = found["applied_scale"] * (applied @ [*point, 1])
    np.testing.assert_allclose(placed, (PLACED.matrix @ [*point, 1])[:3])
    np.testing.assert_allclose(placed, [3.0, 2 * math.pi + 2, 4.0])
