"""Laws of the dataset renderer: camera layouts and json without Blender; poses, determinism and refusals with it."""

from __future__ import annotations

import hashlib
import json
import math
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

import synth_layout
import synth_views
from synth_layout import RenderSettings, camera_directions, look_at_origin

from gsopt.errors import GsoptError, InputError, UsageError

LAYOUTS = ("hemisphere", "sphere", "orbit")


@pytest.fixture(scope="module")
def bpy() -> Any:
    return pytest.importorskip("bpy", reason="Blender's module is not installed (pip install bpy)")


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[N, M] degrees between unit vectors."""
    return np.degrees(np.arccos(np.clip(a @ b.T, -1.0, 1.0)))


@pytest.mark.parametrize("layout", LAYOUTS)
@examples(max_examples=15, deadline=None)
@given(views=st.integers(1, 60), test_views=st.integers(0, 30), seed=st.integers(0, 2**31))
def test_directions_are_unit_and_held_out_views_never_leave_the_band(
    layout: Any, views: int, test_views: int, seed: int
) -> None:
    settings = RenderSettings(views=views, test_views=test_views, layout=layout)
    train, test = camera_directions(settings, seed)
    low, high = settings.elevation_range
    assert train.shape == (views, 3)
    assert test.shape == (test_views, 3)
    assert np.allclose(np.linalg.norm(np.concatenate([train, test]), axis=1), 1.0)
    elevations = np.degrees(np.arcsin(np.clip(train[:, 2], -1, 1)))
    assert elevations.min() >= low - 1e-5
    assert elevations.max() <= high + 1e-5
    if test_views:
        assert test[:, 2].min() >= train[:, 2].min() - 1e-12
        assert test[:, 2].max() <= train[:, 2].max() + 1e-12


@pytest.mark.parametrize("layout", ["hemisphere", "sphere"])
@pytest.mark.parametrize("count", [8, 24, 100])
def test_views_are_spread_evenly(layout: Any, count: int) -> None:
    settings = RenderSettings(views=count, layout=layout)
    train, _ = camera_directions(settings, 3)
    low, high = (math.sin(math.radians(e)) for e in settings.elevation_range)
    between = angles(train, train) + 360.0 * np.eye(count)
    # Side of the square that has each view's share of the band's area, as an angle: an ideal spread comes close to it.
    share = math.degrees(math.sqrt(2.0 * math.pi * (high - low) / count))
    assert between.min() > 0.6 * share
    assert between.min(axis=1).max() < 1.5 * share


@pytest.mark.parametrize("layout", LAYOUTS)
def test_held_out_views_stand_between_the_input_views(layout: Any) -> None:
    train, test = camera_directions(RenderSettings(views=8, test_views=12, layout=layout), 0)
    spacing = (angles(train, train) + 360.0 * np.eye(8)).min()
    assert angles(test, train).min() > 0.1 * spacing


def test_seed_turns_the_cameras_about_z_and_nothing_else() -> None:
    settings = RenderSettings(views=9, test_views=5)
    first, second = camera_directions(settings, 1)[0], camera_directions(settings, 2)[0]
    assert np.array_equal(first, camera_directions(settings, 1)[0])
    assert np.allclose(first[:, 2], second[:, 2])
    turns = (first[:, 0] + 1j * first[:, 1]) / (second[:, 0] + 1j * second[:, 1])
    assert np.allclose(turns, turns[0])
    assert abs(turns[0] - 1.0) > 1e-3


@examples(max_examples=15, deadline=None)
@given(st.tuples(*[st.floats(-3, 3)] * 3).filter(lambda e: math.hypot(*e) > 1e-3))
def test_cameras_look_at_the_origin_with_z_up(eye: tuple[float, float, float]) -> None:
    pose = look_at_origin(np.array([eye]))[0]
    R, t = pose[:3, :3], pose[:3, 3]
    assert np.allclose(R.T @ R, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert np.allclose(-R.T @ t, [0.0, 0.0, -math.hypot(*eye)], atol=1e-9)
    assert R[2, 1] >= -1e-9
    assert abs(R[2, 0]) < 1e-9


def test_a_camera_over_the_pole_is_still_a_rotation() -> None:
    for pose in look_at_origin(np.array([(0.0, 0.0, 2.0), (0.0, 0.0, -2.0)])):
        assert np.allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3))
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)


@examples(max_examples=15, deadline=None)
@given(fov=st.floats(10, 120))
def test_the_default_radius_keeps_the_unit_sphere_in_the_frame(fov: float) -> None:
    settings = RenderSettings(fov=fov)
    outline = math.tan(math.asin(1.0 / settings.distance))
    assert outline == pytest.approx(0.96 * math.tan(0.5 * settings.fov_x))


@examples(max_examples=15, deadline=None)
@given(
    st.lists(st.tuples(*[st.floats(-1e4, 1e4)] * 3), min_size=2, max_size=20).filter(
        lambda v: float(np.ptp(np.array(v), axis=0).max()) > 1e-3
    )
)
def test_normalization_puts_the_mesh_into_the_unit_sphere(points: list[tuple[float, float, float]]) -> None:
    vertices = np.array(points)
    matrix = synth_layout.normalization(vertices)
    moved = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.linalg.norm(moved, axis=1).max() == pytest.approx(1.0, abs=1e-6)
    assert np.allclose(moved.min(axis=0), -moved.max(axis=0), atol=1e-6)
    inverse = np.linalg.inv(matrix)
    assert np.allclose(moved @ inverse[:3, :3].T + inverse[:3, 3], vertices, atol=1e-6)


@pytest.mark.parametrize("bad", [[[0, 0, math.nan], [1, 1, 1]], [[2, 2, 2], [2, 2, 2]]])
def test_normalization_refuses_what_has_no_size(bad: list[list[float]]) -> None:
    with pytest.raises(InputError):
        synth_layout.normalization(np.array(bad, float))


def test_json_has_the_layout_of_nerf_synthetic() -> None:
    settings = RenderSettings(resolution=320, fov=35.0)
    poses = look_at_origin(np.array([(2.0, 1.0, 1.0), (0.0, -3.0, 1.0)]))
    content = json.loads(json.dumps(synth_layout.transforms("train", poses, settings)))
    assert content["camera_angle_x"] == math.radians(35.0)
    assert content["fl_x"] == pytest.approx(160 / math.tan(math.radians(35.0) / 2))
    assert [f["file_path"] for f in content["frames"]] == ["./train/r_000", "./train/r_001"]
    assert np.array_equal([f["transform_matrix"] for f in content["frames"]], poses)


def test_names_sort_as_they_are_numbered() -> None:
    names = synth_layout.frame_names("test", 1200)
    assert names == sorted(names)


@pytest.mark.parametrize(
    "wrong",
    [
        {"views": 0},
        {"test_views": -1},
        {"resolution": 0},
        {"samples": 0},
        {"fov": math.nan},
        {"fov": 179.0},
        {"radius": 0.5},
        {"layout": "cube"},
        {"elevations": (40.0, 10.0)},
        {"elevations": (-91.0, 0.0)},
        {"elevations": (math.nan, 0.0)},
    ],
)
def test_settings_out_of_range_are_usage_errors(wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="must"):
        RenderSettings(**wrong)


def test_arguments_after_the_dashes_are_ours() -> None:
    assert synth_views.own_arguments(["/opt/blender", "-b", "-P", "x.py", "--", "a.obj"]) == ["a.obj"]
    assert synth_views.own_arguments(["scripts/synth_views.py", "a.obj"]) == ["a.obj"]
    assert synth_views.own_arguments(["/opt/blender", "-b", "-P", "x.py"]) == []


def test_command_line_reaches_the_settings() -> None:
    line = "m.obj --out o --views 3 --test-views 2 --fov 30 --layout orbit --elevations 0 10 --seed 4 --radius 5"
    mesh, settings, seed, out = synth_views.parse(line.split())
    assert (mesh, seed, out) == (Path("m.obj"), 4, Path("o"))
    assert settings == RenderSettings(
        views=3, test_views=2, fov=30.0, layout="orbit", elevations=(0.0, 10.0), radius=5.0
    )


@pytest.mark.parametrize("kind", ["absent", "empty", "folder", "suffix"])
def test_what_is_no_mesh_is_refused_before_blender_starts(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = tmp_path / ("mesh.txt" if kind == "suffix" else "mesh.obj")
    if kind == "folder":
        mesh.mkdir()
    elif kind != "absent":
        mesh.write_text("v 0 0 0" if kind == "suffix" else "")
    assert synth_views.main(["synth_views.py", str(mesh), "--out", str(tmp_path / "out")]) == 3
    assert capsys.readouterr().err.startswith("error: ")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("count", ["2000000000", "-1", "9" * 5000, "many"])
def test_a_ply_that_announces_more_than_it_holds_is_refused(count: str, tmp_path: Path) -> None:
    mesh = tmp_path / "mesh.ply"
    mesh.write_text(PLY_POINTS.replace("vertex 2", f"vertex {count}"))
    with pytest.raises(InputError, match="announces"):
        synth_views.check_mesh(mesh)
    mesh.write_text(PLY_POINTS)
    synth_views.check_mesh(mesh)


def test_a_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"

    def fail_halfway() -> None:
        with synth_views.new_folder(out) as folder:
            (folder / "half").write_text("x")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_halfway()
    assert list(out.parent.iterdir()) == []
    with synth_views.new_folder(out) as folder:
        (folder / "all").write_text("x")
        assert not out.exists()
    assert [p.name for p in out.parent.rglob("*")] == ["out", "all"]
    with pytest.raises(InputError, match="exists"), synth_views.new_folder(out):
        pytest.fail("entered an existing folder")
    assert (out / "all").read_text() == "x"


@pytest.mark.parametrize("blocker", ["file", "dangling link"])
def test_nothing_in_the_way_is_replaced(blocker: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    if blocker == "file":
        out.write_text("mine")
    else:
        os.symlink(tmp_path / "nowhere", out)
    with pytest.raises(InputError), synth_views.new_folder(out):
        pytest.fail("entered")
    with pytest.raises(InputError), synth_views.new_folder(tmp_path / "out" / "below"):
        pytest.fail("entered")
    assert out.is_symlink() or out.read_text() == "mine"


def test_dropping_metadata_keeps_the_pixels(tmp_path: Path) -> None:
    from PIL.PngImagePlugin import PngInfo

    pixels = np.random.default_rng(0).integers(0, 256, (50, 60, 4), dtype=np.uint8)
    note = PngInfo()
    note.add_text("File", "secret/path")
    path = tmp_path / "a.png"
    Image.fromarray(pixels, "RGBA").save(path, pnginfo=note)
    synth_views.drop_metadata(path)
    assert b"secret" not in path.read_bytes()
    assert np.array_equal(np.asarray(Image.open(path)), pixels)


# With Blender


def ball(center: tuple[float, float, float], radius: float, first: int) -> str:
    """OBJ text of a sphere of 24 x 12 faces; `first` is the 1-based index of its first vertex."""
    rings, steps = 12, 24
    theta = np.pi * np.arange(rings + 1) / rings
    phi = 2 * np.pi * np.arange(steps) / steps
    t, p = np.meshgrid(theta, phi, indexing="ij")
    xyz = np.stack([np.cos(t), np.sin(t) * np.cos(p), np.sin(t) * np.sin(p)], axis=-1).reshape(-1, 3)
    lines = ["v {:.9f} {:.9f} {:.9f}".format(*(np.array(center) + radius * q)) for q in xyz]
    for i in range(rings):
        for j in range(steps):
            a, b = i * steps + j, i * steps + (j + 1) % steps
            lines.append("f " + " ".join(str(first + k) for k in (a, a + steps, b + steps, b)))
    return "\n".join(lines) + "\n"


CENTERS = ((3.0, 1.0, -2.0), (1.0, 4.0, 1.0))


@pytest.fixture(scope="module")
def two_balls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    mesh = tmp_path_factory.mktemp("mesh") / "balls.obj"
    mesh.write_text(ball(CENTERS[0], 0.15, 1) + ball(CENTERS[1], 0.15, 1 + 13 * 24))
    return mesh


@pytest.fixture(scope="module")
def rendered(bpy: Any, two_balls: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("render") / "out"
    settings = RenderSettings(
        views=3, test_views=2, resolution=64, samples=64, layout="sphere", elevations=(-60, 60), threads=1
    )
    synth_views.render_object(two_balls, settings, 0, out)
    return out


def projected(content: dict[str, Any], frame: dict[str, Any], point: np.ndarray) -> np.ndarray:
    """Pixel coordinates of a world point; pixel (column i, row j) has its centre at (i + 0.5, j + 0.5)."""
    focal = 0.5 * content["w"] / math.tan(0.5 * content["camera_angle_x"])
    x, y, z, _ = np.linalg.inv(np.array(frame["transform_matrix"])) @ np.append(point, 1.0)
    return np.array([content["w"] / 2 + focal * x / -z, content["h"] / 2 - focal * y / -z])


def test_known_spheres_appear_where_the_poses_say(rendered: Path) -> None:
    """From the file's coordinates through `normalized_from_mesh` and the pose: alpha-weighted centroids, 0.05 px."""
    errors = []
    for split in ("train", "test"):
        content = json.loads((rendered / f"transforms_{split}.json").read_text())
        matrix = np.array(content["normalized_from_mesh"])
        world = [(matrix @ np.append(c, 1.0))[:3] for c in CENTERS]
        for frame in content["frames"]:
            alpha = np.asarray(Image.open(rendered / (frame["file_path"] + ".png")), float)[..., 3]
            rows, columns = np.nonzero(alpha)
            pixels, weights = np.stack([columns + 0.5, rows + 0.5], axis=1), alpha[rows, columns]
            expected = np.stack([projected(content, frame, p) for p in world])
            assert np.linalg.norm(expected[0] - expected[1]) > 5, "the balls overlap: pick another seed"
            owner = np.linalg.norm(pixels[:, None] - expected, axis=2).argmin(axis=1)
            for k in (0, 1):
                centroid = np.average(pixels[owner == k], axis=0, weights=weights[owner == k])
                errors.append(centroid - expected[k])
    print("worst centroid error, px:", np.abs(errors).max())
    assert len(errors) == 10
    assert np.abs(errors).max() < 0.05


def test_same_seed_same_bytes_for_any_thread_count(bpy: Any, two_balls: Path, tmp_path: Path) -> None:
    digests = []
    for number, threads in enumerate((1, 2)):
        out = tmp_path / str(number)
        settings = RenderSettings(views=2, test_views=1, resolution=32, samples=4, threads=threads)
        synth_views.render_object(two_balls, settings, 7, out)
        files = sorted(p for p in out.rglob("*") if p.is_file())
        digests.append([(p.relative_to(out).as_posix(), hashlib.sha256(p.read_bytes()).hexdigest()) for p in files])
    assert digests[0] == digests[1]
    assert len(digests[0]) == 5


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".glb"])
def test_every_format_comes_in_at_the_same_place(bpy: Any, suffix: str, two_balls: Path, tmp_path: Path) -> None:
    obj_matrix = synth_views.import_mesh(bpy, two_balls)
    bpy.context.view_layer.update()
    before = normalized_vertices(bpy)
    copy = tmp_path / ("copy" + suffix)
    exporters = {".ply": bpy.ops.wm.ply_export, ".stl": bpy.ops.wm.stl_export, ".glb": bpy.ops.export_scene.gltf}
    exporters[suffix](filepath=str(copy))
    matrix = synth_views.import_mesh(bpy, copy)
    bpy.context.view_layer.update()
    after = normalized_vertices(bpy)
    assert np.allclose(before.min(axis=0), after.min(axis=0), atol=1e-5)
    assert np.allclose(before.max(axis=0), after.max(axis=0), atol=1e-5)
    assert np.linalg.norm(after, axis=1).max() == pytest.approx(1.0, abs=1e-5)
    # The copy is of the normalised mesh: nothing but the change of axes is left to do; the source was larger.
    assert np.allclose(np.linalg.det(matrix), 1.0, atol=1e-4)
    assert np.linalg.det(obj_matrix) < 0.5


def normalized_vertices(bpy: Any) -> np.ndarray:
    found = []
    for shape in [o for o in bpy.context.scene.objects if o.type == "MESH"]:
        world = np.array(shape.matrix_world)
        positions = np.array([v.co for v in shape.data.vertices])
        found.append(positions @ world[:3, :3].T + world[:3, 3])
    return np.concatenate(found)


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
PLY_POINTS = (
    "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    "end_header\n0 0 0\n1 1 1\n"
)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("garbage.obj", "\x00\x01 not a mesh"),
        ("faceless.obj", TRIANGLE),
        ("flat.obj", "v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n"),
        ("garbage.glb", "glTF but not really"),
        ("garbage.ply", "plything"),
        ("points.ply", PLY_POINTS),
        ("garbage.stl", "soli"),
        ("lost.obj", "mtllib lost.mtl\nusemtl a\n" + TRIANGLE + "vt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"),
    ],
)
def test_what_cannot_be_rendered_is_an_input_error_and_leaves_nothing(
    bpy: Any, name: str, text: str, tmp_path: Path
) -> None:
    (tmp_path / "in").mkdir()
    mesh = tmp_path / "in" / name
    mesh.write_text(text)
    (tmp_path / "in" / "lost.mtl").write_text("newmtl a\nmap_Kd nowhere.png\n")
    with pytest.raises(InputError) as caught:
        synth_views.render_object(mesh, RenderSettings(views=1, resolution=8, samples=1), 0, tmp_path / "out")
    assert isinstance(caught.value, GsoptError)
    assert name in str(caught.value) or "extent" in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == ["in"]
