"""Laws of what Blender renders: where, how far, which way, which color; and that it is the same every time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from synth import worker_pool
from synth.cameras import Shot, shots
from synth.import_mesh import import_mesh, matrix_rows, normalization
from synth.mesh_items import Item, of_shapenet
from synth.mesh_normals import mend_normals, vectors
from synth.render_object import RECORD, render_object
from synth.settings import Settings
from tiny_meshes import CENTERS, CUBE, RADIUS, TEXTURE_RGB

from gsopt.errors import InputError

SHAPES = {
    "square": Settings(resolution=(64, 64)),
    "portrait, odd": Settings(resolution=(49, 71)),
    "landscape, shifted": Settings(resolution=(81, 54), lens_jitter=0.3),
    "cube": Settings(resolution=(63, 63), normalize="cube", fov=25.0),
}


def settings_like(base: Settings, **changes: Any) -> Settings:
    from dataclasses import replace

    return replace(base, views=2, test_views=1, layout="sphere", elevations=(-60.0, 60.0), threads=1, **changes)


@pytest.fixture(scope="module", params=list(SHAPES))
def rendered(
    bpy: Any, two_balls: Path, tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> tuple[Path, Settings, list[Shot]]:
    out = tmp_path_factory.mktemp("render") / "out"
    settings = settings_like(
        SHAPES[request.param], samples=64, depth=True, normals=True, masks=True, position=True, points=500
    )
    render_object(two_balls, settings, 2, out)
    return out, settings, shots(settings, 2)


def world_balls(out: Path) -> tuple[np.ndarray, float]:
    """Centers and radius in the world, through the record's matrix."""
    matrix = np.array(json.loads((out / RECORD).read_text())["normalized_from_mesh"])
    return np.array(CENTERS) @ matrix[:3, :3].T + matrix[:3, 3], RADIUS * np.linalg.norm(matrix[0, :3])


def projected(view: Shot, points: np.ndarray) -> np.ndarray:
    """Pixel coordinates of world points; pixel (column i, row j) has its center at (i + 0.5, j + 0.5)."""
    cam_from_world = np.linalg.inv(view.world_from_cam)
    x, y, z = (points @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]).T
    return np.stack([view.center[0] - view.focal * x / z, view.center[1] + view.focal * y / z], axis=1)


def test_known_balls_appear_where_the_poses_say(rendered: tuple[Path, Settings, list[Shot]]) -> None:
    """From the file's coordinates through `normalized_from_mesh`, pose and lens: alpha-weighted centroids, 0.05 px.

    A ball's outline is an ellipse whose middle lies off the projected center: for tan = r / d by a share tan² of the
    distance from the axis, which is divided out.
    """
    out, _, views = rendered
    world, radius = world_balls(out)
    errors = []
    for view in views:
        alpha = np.asarray(Image.open(out / "images" / f"{view.name}.png"), float)[..., 3]
        rows, columns = np.nonzero(alpha)
        pixels, weights = np.stack([columns + 0.5, rows + 0.5], axis=1), alpha[rows, columns]
        depth = -((world - view.eye) @ view.world_from_cam[:3, 2])
        stretch = 1.0 / (1.0 - (radius / depth) ** 2)
        expected = view.center + (projected(view, world) - view.center) * stretch[:, None]
        apart = np.linalg.norm(expected[0] - expected[1])
        assert apart > 2.5 * view.focal * radius / depth.min(), "the balls overlap: pick another seed"
        owner = np.linalg.norm(pixels[:, None] - expected, axis=2).argmin(axis=1)
        errors += [np.average(pixels[owner == k], axis=0, weights=weights[owner == k]) - expected[k] for k in range(2)]
    print("worst centroid error, px:", np.abs(errors).max())
    assert len(errors) == 2 * len(views)
    assert np.abs(errors).max() < 0.05


def test_depth_is_camera_z_at_the_pixel_center(rendered: tuple[Path, Settings, list[Shot]]) -> None:
    out, settings, views = rendered
    world, radius = world_balls(out)
    width, height = settings.resolution
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    for view in views:
        depth, position, normals = (
            np.load(out / kind / f"{view.name}.npy") for kind in ("depth", "position", "normal")
        )
        hard = np.asarray(Image.open(out / "mask" / f"{view.name}.png"))
        soft = np.asarray(Image.open(out / "alpha" / f"{view.name}.png"))
        rgba = np.asarray(Image.open(out / "images" / f"{view.name}.png"))
        assert (depth.dtype, position.dtype, normals.dtype) == (np.float32, np.float32, np.float16)
        seen = depth > 0
        assert set(np.unique(hard)) == {0, 255}
        assert np.array_equal(hard > 0, seen)
        assert np.array_equal(soft, rgba[..., 3])
        assert not normals[~seen].any()
        assert not position[~seen].any()
        cam = np.stack([(x - view.center[0]) / view.focal, -(y - view.center[1]) / view.focal, -np.ones_like(x)], 2)
        unprojected = (cam * depth[..., None]) @ view.world_from_cam[:3, :3].T + view.eye
        assert np.abs(unprojected - position)[seen].max() < 1e-4  # 0.003 of a pixel
        from_center = position[seen][:, None] - world
        nearest = np.linalg.norm(from_center, axis=2).argmin(axis=1)
        outward = from_center[np.arange(len(nearest)), nearest]
        # The ball is a polyhedron of 24 x 48 faces: up to 1 - cos(7.5°) below the sphere, shaded smoothly.
        assert np.abs(np.linalg.norm(outward, axis=1) - radius).max() < 0.01 * radius
        unit = normals[seen].astype(float)
        assert np.allclose(np.linalg.norm(unit, axis=1), 1.0, atol=2e-3)
        inner = soft[seen] == 255
        cosines = (unit * outward).sum(axis=1)[inner] / radius
        assert np.percentile(cosines, 5) > 0.97


def test_points_lie_on_the_surface_and_face_out(rendered: tuple[Path, Settings, list[Shot]]) -> None:
    out, _, _ = rendered
    world, radius = world_balls(out)
    content = (out / "points3d.ply").read_bytes()
    kind = np.dtype([("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
    points = np.frombuffer(content.split(b"end_header\n", 1)[1], kind)
    assert 200 < len(points) <= 500
    from_center = points["xyz"][:, None] - world
    nearest = np.linalg.norm(from_center, axis=2).argmin(axis=1)
    outward = from_center[np.arange(len(points)), nearest]
    assert np.abs(np.linalg.norm(outward, axis=1) - radius).max() < 0.01 * radius
    assert ((outward * points["normal"]).sum(axis=1) > 0).all()
    assert points["rgb"].min() > 20  # the studio's light, not the black behind the ball


def test_the_same_files_for_any_threads_and_whatever_was_rendered_before(
    bpy: Any, two_balls: Path, shapenet: Path, tmp_path: Path
) -> None:
    base = Settings(resolution=(32, 32), samples=4, depth=True, normals=True, points=100, captions=True, preview=True)
    digests = []
    for number, threads in enumerate((1, 2)):
        settings = settings_like(base, formats=("nerf", "nerfstudio", "colmap"))
        render_object(two_balls, settings, 7, tmp_path / str(number))
        digests.append(json.loads((tmp_path / str(number) / RECORD).read_text()) | {"threads": threads})
        render_object(next(shapenet.rglob("*.obj")), settings_like(base, lighting="flat"), 1, tmp_path / f"x{number}")
    assert digests[0]["files_sha256"] == digests[1]["files_sha256"]
    assert digests[0] | {"threads": 2} == digests[1]


def test_shapenet_comes_textured_and_flat_light_keeps_its_colors(bpy: Any, shapenet: Path, tmp_path: Path) -> None:
    (item,) = of_shapenet(shapenet, ())
    settings = settings_like(Settings(lighting="flat", resolution=(48, 48), samples=4, captions=True))
    render_object(item.mesh, settings, 0, tmp_path / "out", item)
    record = json.loads((tmp_path / "out" / RECORD).read_text())
    assert any("gone.jpg" in warning for warning in record["warnings"])
    assert record["category"] == "chair"
    assert record["caption"].endswith(" chair")
    found = []
    for path in (tmp_path / "out" / "images").iterdir():
        rgba = np.asarray(Image.open(path))
        found += rgba[rgba[..., 3] == 255][:, :3].tolist()
    values, counts = np.unique(np.array(found), axis=0, return_counts=True)
    assert np.abs(values[counts.argmax()] - np.array(TEXTURE_RGB)).max() <= 1
    assert counts.max() / counts.sum() > 0.8


def test_a_sheet_modeled_from_both_sides_is_lit_on_both(bpy: Any, tmp_path: Path) -> None:
    """Front and back lie in one plane, cut into triangles along different diagonals."""
    square = "v -1 0 -1\nv 1 0 -1\nv 1 0 1\nv -1 0 1\n"
    (tmp_path / "sheet.obj").write_text(f"{square}{square}f 3 2 1\nf 4 3 1\nf 5 6 8\nf 6 7 8\n")
    settings = Settings(resolution=(24, 24), samples=16, views=2, test_views=0, layout="sphere", depth=True)
    render_object(tmp_path / "sheet.obj", settings, 0, tmp_path / "out")
    record = json.loads((tmp_path / "out" / RECORD).read_text())
    assert [warning.rpartition(" ")[2] for warning in record["warnings"]] == ["4"]
    for name in ("train_000", "train_001"):
        rgba = np.asarray(Image.open(tmp_path / "out" / "images" / f"{name}.png"))
        inside = rgba[rgba[..., 3] == 255][:, :3]
        assert len(inside) > 50
        assert inside.min() > 60


@pytest.mark.parametrize("holes", ["half", "all"])
def test_a_texture_with_holes_cuts_them_out(bpy: Any, holes: str, tmp_path: Path) -> None:
    """Half of a square has alpha 0. Alpha that is 0 all over is an exporter's mistake and hides nothing."""
    from synth.pixels import png

    picture = np.full((8, 8, 4), (*TEXTURE_RGB, 255), np.uint8)
    picture[:, 4 if holes == "half" else 0 :] = 0, 0, 0, 0
    (tmp_path / "leaf.png").write_bytes(png(picture))
    (tmp_path / "leaf.mtl").write_text("newmtl leaf\nKd 1 1 1\nmap_Kd leaf.png\n")
    square = "v -1 0 -1\nv 1 0 -1\nv 1 0 1\nv -1 0 1\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 4/4 3/3 2/2 1/1\n"
    (tmp_path / "leaf.obj").write_text(f"mtllib leaf.mtl\nusemtl leaf\n{square}")
    settings = Settings(
        resolution=(32, 32), samples=4, lighting="flat", masks=True, views=1, test_views=0, elevations=(90.0, 90.0)
    )
    render_object(tmp_path / "leaf.obj", settings, 0, tmp_path / "out")
    rgba = np.asarray(Image.open(tmp_path / "out" / "images" / "train_000.png"))
    mask = np.asarray(Image.open(tmp_path / "out" / "mask" / "train_000.png"))
    side = 2.0 / np.sqrt(2.0) * settings.focal / settings.distance
    expected = side**2 * (0.5 if holes == "half" else 1.0)
    for covered in (rgba[..., 3].sum() / 255.0, (mask > 0).sum()):
        assert covered == pytest.approx(expected, rel=0.1)
    if holes == "half":
        assert np.abs(rgba[rgba[..., 3] == 255][:, :3].astype(int) - TEXTURE_RGB).max() <= 40


def test_a_background_takes_the_alpha_away(bpy: Any, two_balls: Path, tmp_path: Path) -> None:
    settings = settings_like(Settings(background="#204060", resolution=(24, 24), samples=1))
    render_object(two_balls, settings, 0, tmp_path / "out")
    picture = np.asarray(Image.open(tmp_path / "out" / "images" / "train_000.png"))
    assert picture.shape == (24, 24, 3)
    assert picture[0, 0].tolist() == [0x20, 0x40, 0x60]


def test_an_environment_lights_the_object(bpy: Any, two_balls: Path, tmp_path: Path) -> None:
    from synth.pixels import png

    (tmp_path / "sky.png").write_bytes(png(np.broadcast_to(np.array([0, 0, 255], np.uint8), (4, 8, 3))))
    base = Settings(lighting="hdri", hdri=str(tmp_path / "sky.png"), resolution=(24, 24), samples=1)
    render_object(two_balls, settings_like(base), 0, tmp_path / "out")
    rgba = np.asarray(Image.open(tmp_path / "out" / "images" / "train_000.png")).astype(int)
    inside = rgba[rgba[..., 3] == 255]
    assert inside[:, 2].min() > 100
    assert inside[:, :2].max() < 20
    (tmp_path / "sky.png").write_text("no image")
    with pytest.raises(InputError, match="hdri"):
        render_object(two_balls, settings_like(base), 0, tmp_path / "dark")
    assert not (tmp_path / "dark").exists()


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".glb", ".fbx", ".blend"])
def test_every_format_comes_in_at_the_same_place(bpy: Any, suffix: str, two_balls: Path, tmp_path: Path) -> None:
    before = import_mesh(bpy, two_balls, "sphere")
    copy = tmp_path / ("copy" + suffix)
    exporters = {
        ".ply": bpy.ops.wm.ply_export,
        ".stl": bpy.ops.wm.stl_export,
        ".glb": bpy.ops.export_scene.gltf,
        ".fbx": bpy.ops.export_scene.fbx,
        ".blend": bpy.ops.wm.save_as_mainfile,
    }
    exporters[suffix](filepath=str(copy))
    after = import_mesh(bpy, copy, "sphere")
    for bound in (np.min, np.max):
        extreme = [bound(imported.triangles.reshape(-1, 3), axis=0) for imported in (before, after)]
        assert np.allclose(*extreme, atol=1e-5)
    # The copy is of the normalized mesh: nothing but the change of axes is left to do; the source was larger.
    assert np.allclose(np.linalg.det(after.normalized_from_mesh), 1.0, atol=1e-4)
    assert np.linalg.det(before.normalized_from_mesh) < 0.5


def test_faces_wound_both_ways_are_turned_alike(bpy: Any, tmp_path: Path) -> None:
    mesh = tmp_path / "cube.obj"
    mesh.write_text(CUBE.replace("f 5/1 6/2 7/3 8/4", "f 8/4 7/3 6/2 5/1"))
    imported = import_mesh(bpy, mesh, "sphere")
    assert "wound" in imported.warnings[0]
    a, b, c = imported.triangles.swapaxes(0, 1)
    assert (np.cross(b - a, c - a) * (a + b + c)).sum(axis=1).min() > 0  # all outward
    mesh.write_text(CUBE)
    assert import_mesh(bpy, mesh, "sphere").warnings == []


def test_normals_that_point_away_from_their_face_take_its_own(bpy: Any, tmp_path: Path) -> None:
    (tmp_path / "cube.obj").write_text(CUBE)
    import_mesh(bpy, tmp_path / "cube.obj", "sphere")
    shape = bpy.data.meshes[0]
    outward = np.repeat(vectors(shape.polygon_normals, "vector"), 4, axis=0)
    shape.normals_split_custom_set((np.roll(outward, 1, axis=1) - 0.3 * outward).tolist())
    shape.update()
    assert mend_normals(bpy, shape, unshaded=False) == (False, 24)
    assert ((vectors(shape.corner_normals, "vector") * outward).sum(axis=1) > 0.99).all()


@pytest.mark.parametrize("normalize", ["sphere", "cube"])
def test_normalization_can_be_undone(normalize: str) -> None:
    vertices = np.random.default_rng(0).normal(size=(50, 3)) * (1, 20, 3) + (5, -300, 0)
    matrix = normalization(vertices, normalize)
    moved = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.allclose(moved.min(axis=0), -moved.max(axis=0), atol=1e-9)
    size = np.linalg.norm(moved, axis=1).max() if normalize == "sphere" else np.ptp(moved, axis=0).max()
    assert size == pytest.approx(1.0)
    inverse = np.linalg.inv(matrix)
    assert np.allclose(moved @ inverse[:3, :3].T + inverse[:3, 3], vertices)


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
POINTS = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("garbage.obj", "\x00\x01 not a mesh"),
        ("faceless.obj", TRIANGLE),
        ("flat.obj", "v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n"),
        ("garbage.ply", "plything"),
        ("points.ply", POINTS + "0 0 0\n1 1 1\n"),
        ("garbage.stl", "soli"),
        ("garbage.fbx", "Kaydara, but not really"),
        ("garbage.blend", "BLENDER, but not really"),
    ],
)  # fmt: skip
def test_what_cannot_be_rendered_is_an_input_error_and_leaves_nothing(
    bpy: Any, name: str, text: str, tmp_path: Path
) -> None:
    mesh = tmp_path / "in" / name
    mesh.parent.mkdir()
    mesh.write_text(text)
    with pytest.raises(InputError) as caught:
        render_object(mesh, settings_like(Settings(resolution=(8, 8), samples=1)), 0, tmp_path / "out")
    assert name in str(caught.value) or "extent" in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == ["in"]


def test_a_killed_run_resumes_to_the_same_files(bpy: Any, two_balls: Path, tmp_path: Path) -> None:
    """Two workers, killed with the first object done; one worker goes on. Another run is never interrupted."""
    folder = tmp_path / "名前 with spaces"
    folder.mkdir()
    for name in ("a b", "椅子", "c"):
        (folder / f"{name}.obj").write_bytes(two_balls.read_bytes())
    size = ["--views", "4", "--test-views", "0", "--resolution", "32", "--samples", "4", "--threads", "1", "--depth"]

    def command(out: str, *more: str) -> list[str]:
        return [sys.executable, str(worker_pool.SCRIPT), str(folder), "-o", str(tmp_path / out), *size, *more]

    killed = subprocess.Popen(command("killed", "--workers", "2"), stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob(f"killed/[!.]*/{RECORD}")) and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(killed.pid, signal.SIGKILL)
    killed.wait()
    kept = {p: p.stat().st_mtime_ns for p in tmp_path.glob(f"killed/[!.]*/{RECORD}")}
    assert kept
    time.sleep(1.0)  # the workers notice that the run is gone
    resumed = subprocess.run(command("killed", "--resume"), check=False, capture_output=True, text=True)
    assert resumed.returncode == 0, resumed.stderr
    assert {p: p.stat().st_mtime_ns for p in kept} == kept
    subprocess.run(command("whole"), check=True, capture_output=True)
    files = [
        {p.relative_to(tmp_path / out): p.read_bytes() for p in (tmp_path / out).rglob("*") if p.is_file()}
        for out in ("killed", "whole")
    ]
    for run in files:
        del run[Path("timings.json")], run[Path("log.txt")]
    assert files[0] == files[1]
    assert len(files[1]) == 3 * (4 + 4 + 2) + 2


def test_the_caller_can_name_what_it_renders(bpy: Any, two_balls: Path, tmp_path: Path) -> None:
    item = Item("шар", two_balls, name="Ball", license="CC0-1.0", creator="me")
    render_object(two_balls, settings_like(Settings(resolution=(8, 8), samples=1)), 3, tmp_path / "x", item)
    record = json.loads((tmp_path / "x" / RECORD).read_text(encoding="utf-8"))
    assert (record["id"], record["license"], record["creator"], record["seed"]) == ("шар", "CC0-1.0", "me", 3)


def test_a_matrix_arrives_row_by_row(bpy: Any) -> None:
    rows = np.arange(16.0).reshape(4, 4)
    assert np.array_equal(np.array(matrix_rows(rows)), rows)
