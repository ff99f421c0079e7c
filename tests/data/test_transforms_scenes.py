"""NeRF-synthetic, nerfstudio and instant-ngp folders."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from dataset_builders import SIZE, frames_of, nerf_synthetic, nerfstudio, read_document, ring, save_image, write_json
from PIL import Image
from plyfile import PlyData, PlyElement

from gsopt.config.train import DataConfig
from gsopt.data.scene import load_scene
from gsopt.data.undistort import choose_pinhole
from gsopt.errors import UsageError
from gsopt.geometry.projection import sees


def test_nerf_synthetic_poses_pixels_and_splits(tmp_path: Path) -> None:
    scene = load_scene(nerf_synthetic(tmp_path))
    assert scene.kind == "nerf-synthetic"
    assert [view.name for view in scene.train] == [f"train/r_{i}.png" for i in range(10)]
    assert [view.name for view in scene.test] == [f"test/r_{i}.png" for i in range(3)]
    assert scene.has_alpha
    assert scene.warnings == ()
    assert scene.origin == (0, 0, 0)
    want = ring(10)
    for view, viewmat in zip(scene.train, want, strict=True):
        assert torch.allclose(view.camera.viewmats[0].double(), viewmat, atol=1e-6)
        assert view.camera.Ks[0, 0, 0] == pytest.approx(SIZE / 2 / np.tan(0.35))
        assert view.camera.Ks[0, :2, 2].tolist() == [SIZE / 2, SIZE / 2]
        assert view.camera.viewmats.dtype == torch.float32
        assert bool(sees(view.camera, torch.zeros(1, 3))[0])
    straight = np.array(Image.open(tmp_path / "train" / "r_4.png"))
    assert np.array_equal(scene.train[4].pixels().numpy(), straight)


def test_the_extent_is_the_farthest_camera_from_their_mean_and_never_zero(tmp_path: Path) -> None:
    scene = load_scene(nerf_synthetic(tmp_path))
    centers = torch.cat([view.camera.centers for view in scene.train])
    far = max(float((c - centers.mean(0)).norm()) for c in centers)
    assert scene.extent == pytest.approx(1.1 * far)
    assert load_scene(DataConfig(path=str(tmp_path), views=1)).extent == 1.0


def test_val_is_held_out_where_there_is_no_test(tmp_path: Path) -> None:
    nerf_synthetic(tmp_path)
    (tmp_path / "transforms_test.json").rename(tmp_path / "transforms_val.json")
    assert [view.name for view in load_scene(tmp_path).test] == [f"test/r_{i}.png" for i in range(3)]


def test_nerfstudio_is_read_in_name_order_with_its_intrinsics(tmp_path: Path) -> None:
    scene = load_scene(nerfstudio(tmp_path))
    assert scene.kind == "nerfstudio"
    assert [view.name for view in scene.train] == [f"images/{i:03d}.png" for i in range(10)]
    assert not scene.has_alpha
    for view, viewmat in zip(scene.train, ring(10), strict=True):
        assert torch.allclose(view.camera.viewmats[0].double(), viewmat, atol=1e-6)
    assert scene.train[0].camera.Ks[0].tolist() == [[20, 0, 7.5], [0, 21, 8.25], [0, 0, 1]]
    assert scene.train[0].pixels().shape == (SIZE, SIZE, 3)


def test_a_frame_may_override_the_intrinsics(tmp_path: Path) -> None:
    document = read_document(nerfstudio(tmp_path))
    document["frames"][0]["fl_x"] = 33.0
    write_json(tmp_path, document)
    focal = [float(view.camera.Ks[0, 0, 0]) for view in load_scene(tmp_path).train]
    assert sorted(set(focal)) == [20.0, 33.0]
    assert focal.count(33.0) == 1


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_a_distorted_capture_is_undistorted(tmp_path: Path, model: str) -> None:
    nerfstudio(tmp_path, k1=0.05, k2=-0.02, p1=0.001, p2=0.002, camera_model=model)
    view = load_scene(tmp_path).train[0]
    stored = np.array(Image.open(tmp_path / view.name))
    assert not np.array_equal(view.pixels().numpy(), stored)
    assert view.pixels().shape == (SIZE, SIZE, 3)  # no pixel had to be masked
    source = view.store.sources[view.index]
    assert source.undistortion is not None
    lens = source.undistortion.lens
    assert lens.fisheye == (model == "OPENCV_FISHEYE")
    assert lens.radial == (0.05, -0.02, 0.0, 0.0)
    assert lens.tangential == ((0.0, 0.0) if lens.fisheye else (0.001, 0.002))
    again = choose_pinhole(lens, source.undistortion.K, SIZE, SIZE, "")
    assert torch.equal(again.pinhole.float(), view.camera.Ks[0])


def test_views_of_one_lens_share_one_undistortion(tmp_path: Path) -> None:
    scene = load_scene(nerfstudio(tmp_path, k1=0.05))
    assert len({id(source.undistortion) for source in scene.train[0].store.sources}) == 1


def test_masks_make_alpha(tmp_path: Path) -> None:
    document = read_document(nerfstudio(tmp_path))
    for i, frame in enumerate(document["frames"]):
        frame["mask_path"] = f"m/{i}.png"
        save_image(tmp_path / "m" / f"{i}.png", np.eye(SIZE, dtype=np.uint8) * 255)
    write_json(tmp_path, document)
    scene = load_scene(tmp_path)
    assert scene.has_alpha
    assert np.array_equal(scene.train[3].pixels()[..., 3], np.eye(SIZE) * 255)
    (tmp_path / "m" / "0.png").unlink()
    scene = load_scene(tmp_path)
    assert not scene.has_alpha
    assert "m/0.png" in scene.warnings[0]


def test_absent_images_are_named_and_the_rest_is_used(tmp_path: Path) -> None:
    nerfstudio(tmp_path)
    for i in (2, 7):
        (tmp_path / "images" / f"{i:03d}.png").unlink()
    scene = load_scene(tmp_path)
    assert len(scene.train) == 8
    assert "images/002.png" in scene.warnings[0]
    assert "images/007.png" in scene.warnings[0]


def test_test_filenames_are_held_out(tmp_path: Path) -> None:
    scene = load_scene(nerfstudio(tmp_path, test_filenames=["images/004.png"]))
    assert [view.name for view in scene.test] == ["images/004.png"]
    assert len(scene.train) == 9


def test_val_filenames_are_neither_input_nor_held_out_views(tmp_path: Path) -> None:
    nerfstudio(tmp_path, test_filenames=["images/004.png"], val_filenames=["images/001.png", "images/004.png"])
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.test] == ["images/004.png"]
    assert [view.name for view in scene.train] == [f"images/{i:03d}.png" for i in range(10) if i not in (1, 4)]


@pytest.mark.parametrize("text", [False, True])
def test_points_of_a_ply(tmp_path: Path, text: bool) -> None:
    rows = np.array(
        [(1, 2, 3, 4, 5, 6), (np.nan, 0, 0, 0, 0, 0), (-1.5, 0, 9, 255, 0, 1)],
        dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")],
    )
    nerfstudio(tmp_path, ply_file_path="cloud.ply")
    PlyData([PlyElement.describe(rows, "vertex")], text=text).write(tmp_path / "cloud.ply")
    points = load_scene(tmp_path).points
    assert points is not None
    assert points.xyz.tolist() == [[1, 2, 3], [-1.5, 0, 9]]
    assert points.rgb.tolist() == [[4, 5, 6], [255, 0, 1]]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("place", ["x", "red"])
def test_a_signaling_nan_is_left_out_in_silence(tmp_path: Path, place: str) -> None:
    rows = np.zeros(3, dtype=[(name, "f4") for name in ("x", "y", "z", "red", "green", "blue")])
    rows["y"] = 1, 2, 3
    rows[place].view(np.uint32)[1] = 0x7FA00000
    nerfstudio(tmp_path, ply_file_path="cloud.ply")
    PlyData([PlyElement.describe(rows, "vertex")]).write(tmp_path / "cloud.ply")
    points = load_scene(tmp_path).points
    assert points is not None
    assert points.xyz[:, 1].tolist() == [1, 3]


@pytest.mark.parametrize("key", ["file_path", "mask_path", "ply_file_path"])
def test_a_name_without_end_is_shortened_in_the_warning(tmp_path: Path, key: str) -> None:
    document = read_document(nerfstudio(tmp_path))
    (document if key == "ply_file_path" else document["frames"][0])[key] = "long " * 20_000
    write_json(tmp_path, document)
    (warning,) = load_scene(tmp_path).warnings
    assert "long long" in warning
    assert len(warning) < 500


def test_paths_may_lead_elsewhere_but_only_to_files(tmp_path: Path) -> None:
    root = nerfstudio(tmp_path / "scene")
    save_image(tmp_path / "else" / "a.png", mode="RGB")
    document = read_document(root)
    document["frames"][0]["file_path"] = str(tmp_path / "else" / "a.png")
    document["frames"][1]["file_path"] = "..\\else\\a.png"
    document["frames"][2]["file_path"] = "images"
    document["frames"][3]["file_path"] = "a\0b" + "c" * 5000
    document["frames"][4]["file_path"] = "/dev/zero"
    write_json(root, document)
    scene = load_scene(root)
    assert len(scene.train) == 7
    assert sum(view.store.sources[view.index].path.name == "a.png" for view in scene.train) == 2


def test_an_image_is_never_taken_for_its_own_mask(tmp_path: Path) -> None:
    root = nerfstudio(tmp_path / "scene")
    (root / "masks").mkdir()
    save_image(tmp_path / "a.png", mode="RGB")
    document = read_document(root)
    document["frames"][0]["file_path"] = str(tmp_path / "a.png")
    document["frames"][1]["file_path"] = "../a.png"
    write_json(root, document)
    assert all(source.mask is None for source in load_scene(root).train[0].store.sources)


def test_a_size_given_for_a_divisor_is_refused(tmp_path: Path) -> None:
    nerfstudio(tmp_path, size=(100, 80))
    with pytest.raises(UsageError, match=r"`--resolution` divides .* 50 leaves 2 x 2 px of .*, 100 x 80 px"):
        load_scene(DataConfig(path=str(tmp_path), downscale=50))
    assert load_scene(DataConfig(path=str(tmp_path), downscale=5)).train[0].camera.width == 20


@pytest.mark.parametrize(("factor", "size"), [(1, (30, 21)), (2, (15, 11)), (4, (8, 5)), (64, (1, 1))])
def test_downscaling_keeps_the_field_of_view(tmp_path: Path, factor: int, size: tuple[int, int]) -> None:
    nerfstudio(tmp_path, size=(30, 21))
    view = load_scene(DataConfig(path=str(tmp_path), downscale=factor)).train[0]
    assert (view.camera.width, view.camera.height) == size
    assert view.pixels().shape == (size[1], size[0], 3)
    ratio = torch.tensor([size[0] / 30, size[1] / 21, 1])
    K = torch.tensor([[20, 0, 7.5], [0, 21, 8.25], [0, 0, 1]]) * ratio[:, None]
    assert torch.allclose(view.camera.Ks[0], K)


def test_geo_referenced_scenes_are_moved_and_keep_their_detail(tmp_path: Path) -> None:
    offset = torch.tensor([4.5e6, -3.2e5, 812.0], dtype=torch.float64)
    near = ring(10)
    far = near.clone()
    far[:, :3, 3] -= (near[:, :3, :3] @ offset[:, None])[..., 0]
    document = read_document(nerfstudio(tmp_path))
    document["frames"] = frames_of(far, [f"images/{i:03d}.png" for i in range(10)])
    write_json(tmp_path, document)
    scene = load_scene(tmp_path)
    shift = torch.tensor(scene.origin, dtype=torch.float64) - offset
    assert float(shift.norm()) < 5
    assert "subtracted" in scene.warnings[0]
    for view, viewmat in zip(scene.train, near, strict=True):
        center = -viewmat[:3, :3].T @ viewmat[:3, 3]
        assert torch.allclose(view.camera.centers[0].double(), center - shift, atol=1e-5)
    chosen = load_scene(DataConfig(path=str(tmp_path), view_ids=(3, 4)))
    assert chosen.origin == scene.origin


def test_real_lego(shared_data: Path) -> None:
    root = shared_data / "views" / "nerf_synthetic_lego_400"
    scene = load_scene(root)
    assert (len(scene.train), len(scene.test)) == (100, 40)
    assert scene.has_alpha
    assert scene.train[7].name == "train/r_7.png"
    assert scene.train[0].pixels().shape == (400, 400, 4)
    assert float(scene.train[0].camera.centers.norm()) == pytest.approx(4.0311, abs=1e-3)


def test_real_fox(shared_data: Path) -> None:
    scene = load_scene(DataConfig(path=str(shared_data / "views" / "fox"), eval=True, downscale=4))
    assert (len(scene.train), len(scene.test)) == (43, 7)
    assert scene.test[0].name == "images/0001.jpg"
    assert "17 are absent" in scene.warnings[0]
    assert scene.train[0].pixels().shape == (480, 270, 3)


def test_a_test_split_without_images_is_none(tmp_path: Path) -> None:
    nerf_synthetic(tmp_path)
    (tmp_path / "transforms_test.json").rename(tmp_path / "transforms_val.json")
    document = {"camera_angle_x": 0.7, "frames": frames_of(ring(2), ["./gone/a", "./gone/b"])}
    (tmp_path / "transforms_test.json").write_text(json.dumps(document))
    assert len(load_scene(tmp_path).test) == 3
    (tmp_path / "transforms_val.json").unlink()
    assert len(load_scene(DataConfig(path=str(tmp_path), eval=True)).test) == 2
