"""LLFF, IDR and masked Blender datasets: the same cameras and masks whichever file holds them."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from dataset_builders import SIZE, nerf_synthetic, nerfstudio, ring, save_image

from gsopt.config.train import DataConfig
from gsopt.data.idr import split_projection
from gsopt.data.scene import load_scene
from gsopt.errors import InputError
from gsopt.geometry.cameras import opengl_from_viewmats

COUNT = 5
FOCAL = 20.0
HEAD = Path(__file__).resolve().parents[3] / "shared" / "data" / "views" / "ethiopianHead_800"


def llff_rows(viewmats: torch.Tensor, size: float = SIZE, focal: float = FOCAL) -> np.ndarray:
    """poses_bounds.npy of cameras, by its definition: down = -up, right, backward."""
    right, up, backward, center = opengl_from_viewmats(viewmats)[:, :3].unbind(2)
    intrinsics = torch.tensor([size, size, focal], dtype=torch.float64).expand(len(viewmats), 3)
    matrices = torch.stack([-up, right, backward, center, intrinsics], dim=2)
    return np.concatenate([matrices.reshape(-1, 15).numpy(), np.tile([1.0, 9.0], (len(viewmats), 1))], axis=1)


def llff(root: Path, rows: np.ndarray | None = None) -> Path:
    for i in range(COUNT):
        save_image(root / "images" / f"im_{i}.png", mode="RGB", seed=i)
    np.save(root / "poses_bounds.npy", llff_rows(ring(COUNT)) if rows is None else rows)
    return root


def idr(root: Path, change: Callable[[dict[str, np.ndarray]], None] = lambda matrices: None) -> Path:
    """An archive whose world is the ring's, shrunk and moved by scale_mat."""
    K = torch.tensor([[FOCAL, 0, 7.5], [0, 21.0, 8.0], [0, 0, 1]], dtype=torch.float64)
    scale = torch.diag(torch.tensor([300.0, 300, 300, 1], dtype=torch.float64))
    scale[:3, 3] = torch.tensor([5.0, -7, 640])
    matrices: dict[str, np.ndarray] = {}
    for i, viewmat in enumerate(ring(COUNT)):
        P = torch.eye(4, dtype=torch.float64)
        P[:3] = K @ viewmat[:3]
        matrices[f"world_mat_{i}"] = (-0.25 * P @ torch.linalg.inv(scale)).numpy()  # any factor, negative too
        matrices[f"scale_mat_{i}"] = scale.numpy()
        save_image(root / "image" / f"{i:06d}.png", mode="RGB", seed=i)
        save_image(root / "mask" / f"{i:03d}.png", np.full((SIZE, SIZE), 50 * i, np.uint8))
    change(matrices)
    np.savez(root / "cameras_sphere.npz", **matrices)
    return root


def test_llff_cameras_are_those_that_were_written(tmp_path: Path) -> None:
    scene = load_scene(llff(tmp_path))
    found = torch.cat([view.camera.viewmats for view in scene.train])
    torch.testing.assert_close(found, ring(COUNT).float(), atol=1e-6, rtol=0)
    assert scene.kind == "llff"
    assert scene.train[0].camera.Ks[0].tolist() == [[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]]


def test_only_files_that_are_images_are_paired_by_position(tmp_path: Path) -> None:
    root = llff(tmp_path)
    (root / "images" / "a folder.png").mkdir()
    (root / "images" / "notes.txt").write_text("taken in May")
    assert [view.name for view in load_scene(root).train] == [f"images/im_{i}.png" for i in range(COUNT)]


def test_llff_focal_lengths_follow_the_size_of_the_stored_images(tmp_path: Path) -> None:
    scene = load_scene(llff(tmp_path, llff_rows(ring(COUNT), size=5 * SIZE, focal=5 * FOCAL)))
    assert scene.train[0].camera.Ks[0, 0, 0] == FOCAL


def test_idr_cameras_are_in_the_frame_of_the_sphere(tmp_path: Path) -> None:
    scene = load_scene(idr(tmp_path))
    found = torch.cat([view.camera.viewmats for view in scene.train])
    torch.testing.assert_close(found, ring(COUNT).float(), atol=1e-5, rtol=0)
    K = scene.train[0].camera.Ks[0]
    torch.testing.assert_close(K, torch.tensor([[FOCAL, 0, 8.0], [0, 21.0, 8.5], [0, 0, 1]]), atol=1e-4, rtol=0)
    assert scene.has_alpha
    assert [int(view.pixels()[0, 0, 3]) for view in scene.train] == [0, 50, 100, 150, 200]


def test_a_projection_is_the_product_of_its_parts() -> None:
    rng = np.random.default_rng(3)
    P = rng.normal(size=(3, 4))
    R, t, K = split_projection(P, "P")
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
    center = -np.linalg.solve(P[:, :3], P[:, 3])
    np.testing.assert_allclose(R @ center + t, 0, atol=1e-9)
    assert K[2, 2] == 1
    assert K[0, 0] > 0
    assert K[1, 1] > 0


def npy(header: str, data: bytes = b"") -> bytes:
    """A .npy file with any header."""
    padded = header.ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(padded).to_bytes(2, "little") + padded.encode() + data


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "no array that NumPy reads safely"),
        (b"PK\x03\x04", "no array that NumPy reads safely"),
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999, 17), }"), "no array that NumPy"),
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (2, 16), }", bytes(256)), r"shape \[N, 17\]"),
        (npy("{'descr': '|O', 'fortran_order': False, 'shape': (1, 17), }", b"\x80\x04N."), "no array that NumPy"),
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1, 17), }", bytes(136)), "poses 1 images"),
        (npy("{'descr': '<i8', 'fortran_order': False, 'shape': (5, 17), }", bytes(680)), r"shape \[N, 17\]"),
    ],
)
def test_a_broken_poses_file_is_refused_before_memory_is_taken(tmp_path: Path, content: bytes, message: str) -> None:
    (llff(tmp_path) / "poses_bounds.npy").write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        load_scene(tmp_path)
    assert "poses_bounds.npy" in str(caught.value)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        (0, np.nan, "not finite in row 2"),
        (0, 3.0, "not a rotation"),
        (14, -1.0, "must be positive"),
        (4, 2.0 * SIZE, "another aspect"),
    ],
)
def test_a_broken_row_of_poses_is_named(tmp_path: Path, column: int, value: float, message: str) -> None:
    rows = llff_rows(ring(COUNT))
    rows[2, column] = value
    with pytest.raises(InputError, match=message):
        load_scene(llff(tmp_path, rows))


def delete(name: str) -> Callable[[dict[str, np.ndarray]], None]:
    def change(matrices: dict[str, np.ndarray]) -> None:
        del matrices[name]

    return change


def put(name: str, value: np.ndarray) -> Callable[[dict[str, np.ndarray]], None]:
    return lambda matrices: matrices.update({name: value})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (delete("world_mat_3"), "no 4x4 matrix `world_mat_3`"),
        (put("world_mat_3", np.zeros((4, 4))), "singular"),
        (put("world_mat_3", np.full((4, 4), np.inf)), "not finite"),
        (put("world_mat_3", np.ones((5, 4))), "no 4x4 matrix `world_mat_3`"),
        (put("world_mat_3", np.array([[None] * 4] * 4)), "no 4x4 matrix `world_mat_3`"),
        (put("scale_mat_3", np.eye(4)), "differs from `scale_mat_0`"),
    ],
)
def test_a_broken_archive_of_cameras_is_named(tmp_path: Path, change: Callable[..., None], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        load_scene(idr(tmp_path, change))
    assert "cameras_sphere.npz" in str(caught.value)


def test_a_matrix_that_promises_more_than_it_holds_is_refused(tmp_path: Path) -> None:
    idr(tmp_path)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("world_mat_0.npy", npy("{'descr': '<f8', 'fortran_order': False, 'shape': (4, 4), }", b"1234"))
    (tmp_path / "cameras_sphere.npz").write_bytes(packed.getvalue())
    with pytest.raises(InputError, match="no archive of arrays"):
        load_scene(tmp_path)


def test_a_missing_mask_of_a_pair_by_position_is_an_error(tmp_path: Path) -> None:
    (idr(tmp_path) / "mask" / "002.png").unlink()
    with pytest.raises(InputError, match="4 masks for 5 images"):
        load_scene(tmp_path)


def without_alpha(root: Path) -> Path:
    """A Blender-style dataset whose alpha lies in masks/, in a folder for each split."""
    nerf_synthetic(root, train=3, test=2)
    for split, count in (("train", 3), ("test", 2)):
        for i in range(count):
            save_image(root / split / f"r_{i}.png", mode="RGB", seed=i)
            value = 10 * i + (100 if split == "test" else 0)
            save_image(root / "masks" / split / f"r_{i}.png", np.full((SIZE, SIZE), value, np.uint8))
    return root


def alphas(views: tuple) -> list[int]:
    return [int(view.pixels()[0, 0, 3]) for view in views]


def test_masks_of_a_blender_dataset_keep_the_splits_apart(tmp_path: Path) -> None:
    scene = load_scene(without_alpha(tmp_path))
    assert alphas(scene.train) == [0, 10, 20]
    assert alphas(scene.test) == [100, 110]


def test_a_flat_folder_gives_no_mask_to_two_images(tmp_path: Path) -> None:
    root = without_alpha(tmp_path)
    for path in list((root / "masks" / "train").iterdir()):
        path.rename(root / "masks" / path.name)
    shutil.rmtree(root / "masks" / "train")
    shutil.rmtree(root / "masks" / "test")
    scene = load_scene(root)
    assert not any(view.pixels().shape[2] == 4 for view in scene.test)
    assert any("no mask for" in warning for warning in scene.warnings)


def masked(root: Path, names: list[str], size: tuple[int, int] = (SIZE, SIZE)) -> DataConfig:
    nerfstudio(root / "data", count=3)
    for name in names:
        save_image(root / "cut" / name, np.full((size[1], size[0]), 200, np.uint8))
    return DataConfig(path=str(root / "data"), masks=str(root / "cut"))


@pytest.mark.parametrize("pattern", ["{:03d}.png", "{:03d}.png.png", "{:03d}.jpg"])
def test_masks_of_another_folder_match_by_name(tmp_path: Path, pattern: str) -> None:
    scene = load_scene(masked(tmp_path, [pattern.format(i) for i in range(3)]))
    assert scene.has_alpha
    assert alphas(scene.train) == [200] * 3


def test_a_mask_folder_of_other_names_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has a mask for none of the 3 images"):
        load_scene(masked(tmp_path, ["a.png", "b.png", "c.png"]))


def test_a_mask_folder_that_lacks_some_says_which(tmp_path: Path) -> None:
    scene = load_scene(masked(tmp_path, ["000.png", "002.png"]))
    assert not scene.has_alpha
    assert any("images/001.png" in warning for warning in scene.warnings)


def test_masks_of_another_aspect_are_refused_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="another aspect"):
        load_scene(masked(tmp_path, [f"{i:03d}.png" for i in range(3)], size=(SIZE, 2 * SIZE)))


def test_no_folder_of_masks_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="`--masks` names no folder"):
        load_scene(DataConfig(path=str(nerfstudio(tmp_path)), masks=str(tmp_path / "nowhere")))


def test_masks_none_leaves_the_files_alone(tmp_path: Path) -> None:
    config = DataConfig(path=str(without_alpha(tmp_path)), masks="none")
    assert not load_scene(config).has_alpha


@pytest.mark.skipif(not HEAD.is_dir(), reason=f"{HEAD} is private test data and not on this machine")
def test_published_poses_of_real_photos_make_their_silhouettes_meet() -> None:
    """The hull of all 66 published masks fills each of them: axes, focal lengths and pairing are right."""
    from gsopt.geometry.focus import find_focus
    from gsopt.geometry.projection import project
    from gsopt.init.hull import carve
    from gsopt.init.thumbnails import small_photos

    scene = load_scene(DataConfig(path=str(HEAD), downscale=8))
    photos = small_photos(scene.train, 12)
    grid = carve(photos, find_focus([photo.camera for photo in photos], scene.extent))
    assert grid is not None
    for photo in photos:
        column, row, _ = project(photo.camera, grid.centers(grid.occupied))
        covered = torch.zeros(photo.camera.height, photo.camera.width, dtype=torch.bool)
        covered[row.long().clamp(0, covered.shape[0] - 1), column.long().clamp(0, covered.shape[1] - 1)] = True
        solid = photo.planes[3] > 127
        assert float((covered & solid).sum() / solid.sum()) > 0.9


def test_a_transforms_file_wins_over_poses_bounds(tmp_path: Path) -> None:
    """LLFF files lie beside the transforms.json of some exports."""
    nerfstudio(tmp_path, count=3)
    np.save(tmp_path / "poses_bounds.npy", np.zeros((7, 17)))
    assert load_scene(tmp_path).kind == "nerfstudio"
    assert json.loads((tmp_path / "transforms.json").read_text())["frames"]
