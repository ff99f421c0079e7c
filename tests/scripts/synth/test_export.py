"""Every format describes the same cameras and points, as gsopt's own readers see them. No Blender."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from synth.cameras import Shot, shots
from synth.export import export, quaternion
from synth.pixels import png
from synth.settings import Settings

gsopt = pytest.importorskip("gsopt.data.scene", reason="gsopt's readers need torch, which is not installed here")

CLOUD = (
    np.array([[0.1, 0.2, 0.3], [-0.5, 0.0, 0.9]], np.float32),
    np.array([[0, 0, 1], [0, -1, 0]], np.float32),
    np.array([[255, 0, 3], [9, 80, 70]], np.uint8),
)
FORMATS = ("nerf", "nerfstudio", "colmap")
KINDS = dict(zip(FORMATS, ("nerf-synthetic", "nerfstudio", "colmap"), strict=True))


def write(folder: Path, settings: Settings) -> list[Shot]:
    views = shots(settings, 5)
    (folder / "images").mkdir(parents=True)
    width, height = settings.resolution
    for view in views:
        (folder / "images" / f"{view.name}.png").write_bytes(png(np.full((height, width, 4), 200, np.uint8)))
    export(folder, settings, views, CLOUD, {"id": "стул"})
    return views


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("jitter", [0.0, 0.2])
def test_gsopt_reads_every_format_as_the_cameras_that_were_meant(name: str, jitter: float, tmp_path: Path) -> None:
    settings = Settings(
        views=5, test_views=3, resolution=(31, 18), lens_jitter=jitter, formats=(name,), layout="sphere"
    )
    views = write(tmp_path / "d", settings)
    scene = gsopt.load_scene(tmp_path / "d")
    assert scene.kind == KINDS[name]
    assert scene.warnings == ()
    assert (len(scene.train), len(scene.test)) == (5, 3)
    assert scene.has_alpha
    by_name = {f"images/{view.name}.png": view for view in views}
    for view in (*scene.train, *scene.test):
        meant = by_name[view.name]
        opencv = np.diag([1.0, -1.0, -1.0, 1.0]) @ np.linalg.inv(meant.world_from_cam)
        K = [[meant.focal, 0, meant.center[0]], [0, meant.focal, meant.center[1]], [0, 0, 1]]
        assert np.allclose(view.camera.viewmats[0].numpy(), opencv, atol=1e-6)
        assert np.allclose(view.camera.Ks[0].numpy(), K, atol=1e-4)
        assert (view.camera.width, view.camera.height) == (31, 18)
        assert view.pixels().shape == (18, 31, 4)
    assert scene.points is not None
    assert np.allclose(scene.points.xyz.numpy(), CLOUD[0])
    assert np.array_equal(scene.points.rgb.numpy(), CLOUD[2])


@pytest.mark.parametrize("name", FORMATS)
def test_validation_views_are_no_input_views(name: str, tmp_path: Path) -> None:
    settings = Settings(views=4, test_views=2, val_views=2, resolution=(8, 8), formats=(name,))
    write(tmp_path / "d", settings)
    scene = gsopt.load_scene(tmp_path / "d")
    assert [view.name for view in scene.train] == [f"images/train_{i:03d}.png" for i in range(4)]


def test_all_formats_share_one_folder(tmp_path: Path) -> None:
    write(tmp_path / "d", Settings(views=2, test_views=1, resolution=(8, 8), formats=FORMATS))
    assert len(list((tmp_path / "d").rglob("*.png"))) == 3
    assert gsopt.load_scene(tmp_path / "d").kind == "colmap"


def test_json_has_the_keys_that_other_readers_expect(tmp_path: Path) -> None:
    views = write(tmp_path / "d", Settings(views=2, test_views=1, resolution=(320, 200), formats=FORMATS))
    nerf = json.loads((tmp_path / "d" / "transforms_train.json").read_text(encoding="utf-8"))
    assert [f["file_path"] for f in nerf["frames"]] == ["./images/train_000", "./images/train_001"]
    assert np.array_equal([f["transform_matrix"] for f in nerf["frames"]], [v.world_from_cam for v in views[:2]])
    assert 160 / np.tan(nerf["camera_angle_x"] / 2) == pytest.approx(nerf["fl_x"])
    studio = json.loads((tmp_path / "d" / "transforms.json").read_text(encoding="utf-8"))
    names = {f["file_path"] for f in studio["frames"]}
    assert {*studio["train_filenames"], *studio["val_filenames"]} == names  # nerfstudio evaluates on val
    assert studio["id"] == "стул"


def test_colmap_counts_are_those_of_the_views(tmp_path: Path) -> None:
    write(tmp_path / "d", Settings(views=3, test_views=1, resolution=(8, 8), formats=("colmap",)))
    counts = {p.name: struct.unpack("<Q", p.read_bytes()[:8])[0] for p in (tmp_path / "d" / "sparse/0").glob("*.bin")}
    assert counts == {"cameras.bin": 1, "images.bin": 4, "points3D.bin": 2}
    assert (tmp_path / "d" / "sparse/0/test.txt").read_text() == "test_000.png\n"


def test_a_quaternion_turns_as_its_matrix_does() -> None:
    rng = np.random.default_rng(0)
    for q in [*rng.normal(size=(20, 4)), *np.eye(4)]:  # the last three are half turns
        w, *v = q / np.linalg.norm(q)
        x, y, z = v
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        R = np.eye(3) + 2 * w * cross + 2 * cross @ cross  # Rodrigues
        found = quaternion(R)
        assert abs(found @ [w, *v]) == pytest.approx(1.0, abs=1e-12)
        assert found[0] >= 0
