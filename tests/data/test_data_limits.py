"""Limits of the readers of datasets, met exactly and passed, and their numbers against independent formulas."""

from __future__ import annotations

import io
import math
import struct
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from dataset_builders import save_image
from PIL import Image

from gsopt.data import files, idr, image_files, images, llff, masks, numpy_files, pointcloud, posed_images, transforms
from gsopt.data.background import Background, mean_color
from gsopt.data.depth_maps import DepthFolder
from gsopt.data.lens import Lens
from gsopt.errors import InputError


def pose(scale: float = 1.0, last: float = 1.0, corner: float = 0.0) -> torch.Tensor:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[0, 0] = math.copysign(math.sqrt(abs(scale)), scale)
    matrix[3, 3], matrix[3, 0] = last, corner
    return matrix


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (pose(1 + 0.9e-3), ""),
        (pose(1 - 0.9e-3), ""),
        (pose(1 + 1.1e-3), "not a rotation"),
        (pose(-1.0), "mirrored"),
        (pose(-2.0), "not a rotation"),
        (pose(last=1 + 0.9e-3), ""),
        (pose(last=1 + 1.1e-3), "its last row"),
        (pose(corner=-0.9e-3), ""),
        (pose(corner=-1.1e-3), "its last row"),
    ],
)
def test_a_pose_is_rigid_to_a_thousandth(matrix: torch.Tensor, message: str) -> None:
    if not message:
        posed_images.check_pose(matrix, "a")
        return
    with pytest.raises(InputError, match=message):
        posed_images.check_pose(matrix, "a")


def test_five_names_of_255_characters_stand_in_a_warning() -> None:
    assert posed_images.summarize_names(list("abcde")) == "a, b, c, d, e"
    assert posed_images.summarize_names(list("abcdefg")) == "a, b, c, d, e and 2 more"
    assert posed_images.summarize_names(["x" * 255, "y" * 256]) == f"{'x' * 255}, {'y' * 255}..."


def test_two_images_that_exist_are_enough() -> None:
    posed_images.check_enough([None, None], ["c"], Path("a"))  # type: ignore[list-item]
    posed_images.check_enough([None], [], Path("a"))  # type: ignore[list-item]
    with pytest.raises(InputError, match="Only 1 of the 2 images"):
        posed_images.check_enough([None], ["c"], Path("a"))  # type: ignore[list-item]


@pytest.mark.parametrize(("angle", "fine"), [(1.1e-6, True), (1e-6, False), (3.1399, True), (3.14, False)])
def test_a_field_of_view_is_more_than_none_and_less_than_half_a_turn(angle: float, fine: bool) -> None:
    if fine:
        K = transforms._intrinsics({"camera_angle_x": angle}, 20, 10, "a")
        assert float(K[0, 0]) == pytest.approx(10 / math.tan(angle / 2))
        assert float(K[1, 1]) == pytest.approx(float(K[0, 0]))
        assert K[:2, 2].tolist() == [10, 5]
    else:
        with pytest.raises(InputError, match="camera_angle_x"):
            transforms._intrinsics({"camera_angle_x": angle}, 20, 10, "a")


def test_what_intrinsics_leave_out_is_square_and_centered() -> None:
    assert transforms._intrinsics({"fl_x": 9}, 20, 10, "a").tolist() == [[9, 0, 10], [0, 9, 5], [0, 0, 1]]
    given_all = {"fl_x": 9, "fl_y": 8, "cx": 3, "cy": 4, "camera_angle_x": 1}
    assert transforms._intrinsics(given_all, 20, 10, "a").tolist() == [[9, 0, 3], [0, 8, 4], [0, 0, 1]]
    for broken in ({"fl_x": 0}, {"fl_x": 9, "fl_y": 0}, {"fl_x": 9, "fl_y": -1}):
        with pytest.raises(InputError, match="must be positive"):
            transforms._intrinsics(broken, 20, 10, "a")


def test_coefficients_of_a_lens_stand_where_nerfstudio_puts_them() -> None:
    values = {"k1": 1, "k2": 2, "k3": 3, "k4": 4, "p1": 5, "p2": 6}
    assert transforms._lens(values, "a") == Lens(radial=(1, 2, 3, 4), tangential=(5, 6))
    for fisheye in ({"is_fisheye": True}, {"camera_model": "opencv_fisheye"}):
        assert transforms._lens(values | fisheye, "a") == Lens(radial=(1, 2, 3, 4), fisheye=True)
    assert transforms._lens({"is_fisheye": 1}, "a").is_pinhole
    with pytest.raises(InputError, match="camera_model"):
        transforms._lens({"camera_model": "EQUIRECTANGULAR"}, "a")


@pytest.mark.parametrize(("size", "fine"), [((1, 1), True), ((0, 5), False), ((5, 0), False), ((0.6, 1.4), True)])
def test_a_declared_size_is_a_pixel_at_least(size: tuple[float, float], fine: bool) -> None:
    values = {"w": size[0], "h": size[1]}
    if fine:
        assert transforms._size(values, Path("absent"), "a") == (1, 1)
    else:
        with pytest.raises(InputError, match="at least 1"):
            transforms._size(values, Path("absent"), "a")


def points_ply(folder: Path, kind: str, rows: bytes, count: int | str) -> Path:
    names = "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + names + "end_header\n"
    (folder / "a.ply").write_bytes(head.encode() + rows)
    return folder / "a.ply"


def test_colors_of_points_are_bytes_or_shares(tmp_path: Path) -> None:
    shares = struct.pack("<6f", 1, 2, 3, 0.0, 0.5, 1.0) + struct.pack("<6f", 4, 5, 6, -1.0, 0.999, 2.0)
    xyz, rgb = pointcloud.read_points_ply(points_ply(tmp_path, "float", shares, 2))
    assert xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert rgb.tolist() == [[0, 127, 255], [0, 254, 255]]
    whole = struct.pack("<3f3B", 1, 2, 3, 0, 1, 255)
    assert pointcloud.read_points_ply(points_ply(tmp_path, "uchar", whole, 1))[1].tolist() == [[0, 1, 255]]
    (tmp_path / "b.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
        "property float z\nend_header\n1 2 3\n"
    )
    assert pointcloud.read_points_ply(tmp_path / "b.ply")[1].tolist() == [[128, 128, 128]]


def test_a_cloud_may_claim_a_row_for_each_byte_of_its_file(tmp_path: Path) -> None:
    """More cannot be there; whether as many are is seen when they are read."""
    size = points_ply(tmp_path, "uchar", b"", 100).stat().st_size
    pointcloud._check_counts(points_ply(tmp_path, "uchar", b"", size))
    with pytest.raises(InputError, match=f"declares {size + 1} rows but is only {size} bytes"):
        pointcloud._check_counts(points_ply(tmp_path, "uchar", b"", size + 1))


class Pictures:
    """Input views of one color each."""

    def __init__(self, levels: list[int]) -> None:
        self.levels = levels
        self.train = [self.View(level) for level in levels]
        self.has_alpha = False

    class View:
        def __init__(self, level: int) -> None:
            self.level = level
            self.camera = type("Camera", (), {"width": 2, "height": 3})()

        def pixels(self) -> torch.Tensor:
            return torch.tensor([self.level, 0, 255, 9], dtype=torch.uint8).expand(3, 2, 4)


def test_the_mean_color_is_that_of_16_views_evenly_spread() -> None:
    levels = [level * 3 for level in range(40)]
    chosen = [levels[i * 40 // 16] for i in range(16)]
    red, green, blue = mean_color(Pictures(levels))  # type: ignore[arg-type]
    assert (red, green, blue) == (round(sum(chosen) / 16 / 255, 3), 0.0, 1.0)
    assert mean_color(Pictures([51]))[0] == 0.2  # type: ignore[arg-type]
    assert Background((0.1, 0.2, 0.3)).constant().tolist() == pytest.approx([0.1, 0.2, 0.3])  # type: ignore[union-attr]
    assert Background(random=True).constant() is None


@pytest.mark.parametrize(("stored", "fine"), [((1000, 1009), True), ((1000, 1011), False), ((1000, 991), True)])
def test_a_copy_of_another_size_may_be_rounded_by_a_hundredth(stored: tuple[int, int], fine: bool) -> None:
    if fine:
        K = llff._intrinsics(500.0, (2000.0, 2000.0), stored, "a")
        assert K[0, 0] == 250
        assert float(K[1, 1]) == pytest.approx(500 * stored[1] / 2000)
        assert K[:2, 2].tolist() == [500, stored[1] / 2]
    else:
        with pytest.raises(InputError, match="another aspect"):
            llff._intrinsics(500.0, (2000.0, 2000.0), stored, "a")


def projection() -> tuple[np.ndarray, np.ndarray]:
    K = np.array([[50.0, 0, 7], [0, 60, 8], [0, 0, 1]])
    a = 0.3
    R = np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])
    P = np.eye(4)
    P[:3] = K @ np.column_stack([R, [0.1, 0.2, 3.0]])
    return P, K


@pytest.mark.parametrize(("off", "fine"), [(0.9e-3, True), (1.1e-3, False)])
def test_spheres_of_one_object_agree_to_a_thousandth(off: float, fine: bool) -> None:
    P, K = projection()
    sphere = np.diag([2.0, 2, 2, 1])
    other = sphere.copy()
    other[0, 3] += 2 * off
    matrices = {"world_mat_0": P, "scale_mat_0": sphere, "world_mat_1": P, "scale_mat_1": other}
    found = idr._camera(matrices, 0, Path("a"))[1].numpy()
    np.testing.assert_allclose(found[:2, :2], K[:2, :2], atol=1e-9)
    np.testing.assert_allclose(found[:2, 2], K[:2, 2] + 0.5, atol=1e-9)
    if fine:
        idr._camera(matrices, 1, Path("a"))
    else:
        with pytest.raises(InputError, match="One object has one sphere"):
            idr._camera(matrices, 1, Path("a"))


@pytest.mark.parametrize(("flat", "fine"), [(2e-12, True), (0.5e-12, False)])
def test_a_projection_that_shows_no_depth_is_no_camera(flat: float, fine: bool) -> None:
    P = np.column_stack([np.diag([1.0, 1.0, flat]), [0, 0, 1]])
    if fine:
        assert idr.split_projection(P, "a")[2][2, 2] == 1
    else:
        with pytest.raises(InputError, match="singular"):
            idr.split_projection(P, "a")


def archive(folder: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(folder / "a.npz", "w") as target:
        for name, data in members.items():
            target.writestr(name, data)
    return folder / "a.npz"


def npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def test_members_of_an_archive_are_matrices_of_4096_bytes_at_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    matrix = np.arange(16.0).reshape(4, 4)
    long = npy(matrix).ljust(4096, b"\0")
    many = {"a.npy": npy(matrix), "f.npy": npy(np.asfortranarray(matrix)), "b.npy": long, "c.npy": long + b"\0"}
    found = numpy_files.read_matrices(archive(tmp_path, {**many, "d.npy": npy(matrix[:3]), "e.txt": npy(matrix)}))
    assert sorted(found) == ["a", "b", "f"]
    assert all(np.array_equal(values, matrix) for values in found.values())
    monkeypatch.setattr(numpy_files, "MAX_MEMBERS", 4)
    assert len(numpy_files.read_matrices(archive(tmp_path, many))) == 3
    with pytest.raises(InputError, match="5 arrays, more than the 4"):
        numpy_files.read_matrices(archive(tmp_path, {**many, "e": b""}))


def test_files_of_exactly_the_largest_size_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    path.write_text('{"a": 1}')
    monkeypatch.setattr(files, "MAX_JSON_BYTES", 8)
    assert files.read_json(path) == {"a": 1}
    monkeypatch.setattr(files, "MAX_JSON_BYTES", 7)
    with pytest.raises(InputError, match="8 bytes, more than the 7"):
        files.read_json(path)
    path.write_text("1234\n12\n")
    monkeypatch.setattr(files, "MAX_LINE", 5)
    assert list(files.read_lines(path)) == ["1234\n", "12\n"]
    monkeypatch.setattr(files, "MAX_LINE", 4)
    with pytest.raises(InputError, match="more than 4 characters"):
        list(files.read_lines(path))


@pytest.mark.parametrize("broken", [True, None, "1", math.nan, math.inf, 10**400, [1]])
def test_a_number_of_a_dataset_is_finite(broken: object) -> None:
    assert files.number(-2, "a") == -2.0
    with pytest.raises(InputError, match="must be a finite number"):
        files.number(broken, "a")


@pytest.mark.parametrize(("got", "fine"), [((200, 101), True), ((200, 102), True), ((200, 103), False)])
def test_a_mask_may_be_rounded_by_a_pixel_of_its_image(got: tuple[int, int], fine: bool) -> None:
    """200 x 102 for 100 x 50: the products of the sides differ by 200, the longest side, and no more."""
    if fine:
        images.check_mask_size(Path("m"), got, (100, 50))
    else:
        with pytest.raises(InputError, match="another aspect"):
            images.check_mask_size(Path("m"), got, (100, 50))


def test_a_mask_times_the_alpha_of_its_image_is_rounded_to_the_nearest() -> None:
    pixels = torch.full((1, 4, 4), 9, dtype=torch.uint8)
    pixels[..., 3] = torch.tensor([[255, 100, 1, 254]])
    mask = torch.tensor([[128, 200, 127, 254]], dtype=torch.uint8)
    found = masks.apply_mask(pixels, mask, Path("m"))[..., 3].tolist()
    assert found == [[round(a * b / 255) for a, b in zip([128, 200, 127, 254], [255, 100, 1, 254], strict=True)]]
    two = torch.tensor([[0, 1, 2, 1]], dtype=torch.uint8)
    assert masks.apply_mask(pixels[..., :3], two, Path("m"))[..., 3].tolist() == [[0, 1, 2, 1]]
    assert masks.apply_mask(pixels[..., :3], two.clamp(max=1), Path("m"))[..., 3].tolist() == [[0, 255, 255, 255]]


@pytest.mark.parametrize(("width", "fine"), [(1019, True), (1021, False), (981, True), (979, False)])
def test_the_aspect_of_a_depth_map_may_differ_by_two_hundredths(tmp_path: Path, width: int, fine: bool) -> None:
    np.save(tmp_path / "a.npy", np.full((10, width), 2.0, np.float32))
    folder = DepthFolder(tmp_path, inverse=False)
    if fine:
        kept = folder.read(tmp_path / "a.npy", (1000, 10), None, (1000, 10))
        assert kept.shape == (5, 512)
        assert kept.unique().tolist() == [0.5]
    else:
        with pytest.raises(InputError, match="another aspect"):
            folder.read(tmp_path / "a.npy", (1000, 10), None, (1000, 10))


def test_a_depth_map_keeps_a_pixel_of_a_thin_photo(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.full((1, 2000), 2.0, np.float32))
    assert DepthFolder(tmp_path, inverse=True).read(tmp_path / "a.npy", (2000, 1), None, (2000, 1)).shape == (1, 512)
    np.save(tmp_path / "a.npy", np.full((3, 4), 2.0, np.float32))
    assert DepthFolder(tmp_path, inverse=True).read(tmp_path / "a.npy", (4, 3), None, (512, 384)).shape == (384, 512)


def test_sixteen_bits_become_eight_and_a_mask_of_few_levels_stays(tmp_path: Path) -> None:
    for levels, as_mask, as_photo in (
        ([0, 255], [0, 255], [0, 0]),
        ([0, 256], [0, 1], [0, 1]),
        ([0, 65535], [0, 255], [0, 255]),
    ):
        Image.fromarray(np.array([levels], dtype=np.uint16)).save(tmp_path / "a.png")
        assert images.read_gray(tmp_path / "a.png", (2, 1)).tolist() == [as_mask]
        assert images.read_pixels(tmp_path / "a.png")[0, :, 0].tolist() == as_photo


def test_images_in_order_are_images_by_name(tmp_path: Path) -> None:
    for name in ("b.PNG", "a.jpg"):
        save_image(tmp_path / name, np.zeros((2, 2, 3), np.uint8))
    (tmp_path / "c.txt").touch()
    (tmp_path / "d.png").mkdir()
    assert [path.name for path in posed_images.images_in_order(tmp_path)] == ["a.jpg", "b.PNG"]


def test_an_image_may_have_134_megapixels(tmp_path: Path) -> None:
    """2^27, whatever the size of its file."""
    with open(tmp_path / "a.png", "wb") as file:
        file.truncate(1 << 30)
    for width, fine in ((134_217_728, True), (134_217_729, False)):
        image: Any = SimpleNamespace(width=width, height=1)
        assert (image_files.bomb(image, tmp_path / "a.png") == "") == fine
