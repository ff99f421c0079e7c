"""A mesh of a run is closed, near the surface, in its colors; median depths are where half of the light is gone."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from finished_runs import splats
from PIL import Image
from plyfile import PlyData

import gsopt
from gsopt.cli import main
from gsopt.config.train import DataConfig, TrainConfig
from gsopt.events import to_json
from gsopt.formats import save_splats
from gsopt.formats.glb_container import read_container
from gsopt.formats.mesh_files import Mesh, save_mesh
from gsopt.gaussians import Gaussians
from gsopt.geometry import sh
from gsopt.geometry.cameras import Cameras, intrinsics, look_at, opengl_from_viewmats
from gsopt.raster.backend import RasterSettings
from gsopt.raster.reference import ReferenceBackend
from gsopt.results.mesh import surface
from gsopt.results.mesh.fusion import box_around, fused
from gsopt.results.mesh.median_depth import SLABS, depth_view, slab_planes

pytest.importorskip("skimage")
fast_simplification = pytest.importorskip("fast_simplification")

SIDE, FOV, RADIUS = 48, 0.8, 1.0
FLAT = RasterSettings(sh_degree=0)
COLOR = torch.tensor([0.8, 0.4, 0.2])


def ball(count: int = 500) -> Gaussians:
    """Opaque splats on a sphere, in one color."""
    place = torch.arange(count) + 0.5
    z, turn = 1 - 2 * place / count, math.pi * (1 + math.sqrt(5)) * place
    flat = (1 - z * z).sqrt()
    return Gaussians(
        means=RADIUS * torch.stack([flat * turn.cos(), flat * turn.sin(), z], dim=1),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scales=torch.full((count, 3), math.log(0.06)),
        logit_opacities=torch.full((count,), 4.0),
        sh0=sh.sh0_from_rgb(COLOR).expand(count, 1, 3).contiguous(),
        shN=torch.zeros(count, 0, 3),
    )


def cameras(count: int) -> Cameras:
    """Cameras around the origin, above and below by turns."""
    angles = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    height = torch.where(torch.arange(count) % 2 == 0, 1.5, -1.5).double()
    eyes = torch.stack([3.5 * angles.cos(), 3.5 * angles.sin(), height], dim=1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    viewmats = look_at(eyes, torch.zeros(3, dtype=torch.float64), up)
    return Cameras(viewmats.float(), intrinsics(FOV, SIDE, SIDE).float().repeat(count, 1, 1), SIDE, SIDE)


def make_run(folder: Path, *, masks: bool = True, learned: Gaussians | None = None) -> Path:
    """A finished run on six views of the ball, with or without alpha."""
    shots, truth = cameras(6), ball()
    (folder / "data").mkdir(parents=True)
    frames = []
    for row in range(len(shots)):
        frame = ReferenceBackend().forward(truth, shots[row], FLAT, None if masks else torch.ones(3))
        rgb = frame.colors / frame.alphas[..., None].clamp_min(1e-6) if masks else frame.colors
        planes = [rgb, frame.alphas[..., None]] if masks else [rgb]
        pixels = (torch.cat(planes, dim=-1).clamp(0, 1) * 255).round().byte().numpy()
        Image.fromarray(pixels).save(folder / "data" / f"{row}.png")
        pose = opengl_from_viewmats(shots.viewmats[row].double()).tolist()
        frames.append({"file_path": f"./{row}", "transform_matrix": pose})
    document = {"camera_angle_x": FOV, "frames": frames}
    (folder / "data" / "transforms_train.json").write_text(json.dumps(document))
    run = folder / "run"
    run.mkdir()
    config = TrainConfig(data=DataConfig(path=str(folder / "data")), threads=1, iterations=100)
    (run / "config.json").write_bytes(to_json({"config": config.to_dict(), "versions": {"gsopt": "test"}}))
    save_splats(run / "splat.ply", truth if learned is None else learned)
    return run


def edges_of(mesh: Mesh) -> set[tuple[int, int]]:
    return {(face[i], face[(i + 1) % 3]) for face in mesh.faces.tolist() for i in range(3)}


def volume(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, corner]].double() for corner in range(3))
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


@pytest.fixture(scope="module")
def ball_mesh(tmp_path_factory: pytest.TempPathFactory) -> Mesh:
    return gsopt.extract_mesh(make_run(tmp_path_factory.mktemp("ball")), voxels=40, faces=1500)


def test_every_depth_falls_into_one_slab() -> None:
    planes = list(slab_planes(2.0, 5.0, 0.01))
    borders = [far for _, far in planes]
    for depth in [0.02, 1.9, 3.3, *borders[:-1]]:
        assert sum(near < depth < far for near, far in planes) == 1
    assert len(planes) == SLABS


def test_the_median_depth_is_that_of_the_splat_at_which_half_of_the_light_is_gone() -> None:
    """Splat by splat, front to back, by the reference."""
    scene, shot = splats(20, seed=3), cameras(2)[0]
    near, far = 1.0, 6.0
    view = depth_view(scene, shot, ReferenceBackend(), FLAT, near, far)
    centers = scene.means @ shot.viewmats[0, :3, :3].T + shot.viewmats[0, :3, 3]
    left = torch.ones(SIDE, SIDE)
    expected = torch.full_like(left, math.inf)
    for row in centers[:, 2].argsort().tolist():
        alpha = ReferenceBackend().forward(scene.select(torch.tensor([row])), shot, FLAT).alphas
        behind = left * (1 - alpha)
        expected = torch.where((left > 0.5) & (behind <= 0.5), centers[row, 2], expected)
        left = behind
    solid = expected.isfinite()
    assert 0.1 < float(solid.float().mean()) < 0.9
    assert bool((view.depths.isfinite() == solid).float().mean() > 0.99)  # transmittances that round to one half
    both = solid & view.depths.isfinite()
    assert float((view.depths - expected)[both].abs().max()) < 1.01 * (far - near) / SLABS
    assert bool((view.gaps[view.depths.isfinite()] == 0).all())


def test_a_veil_before_a_surface_does_not_draw_the_depth_to_it() -> None:
    veil = Gaussians(
        means=torch.tensor([[2.2, 0.0, 0.94]]),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        log_scales=torch.full((1, 3), math.log(0.3)),
        logit_opacities=torch.tensor([-1.0]),
        sh0=torch.zeros(1, 1, 3),
        shN=torch.zeros(1, 0, 3),
    )
    shot = cameras(6)[0]
    bare, veiled = (
        depth_view(scene, shot, ReferenceBackend(), FLAT, 2.0, 5.5).depths for scene in (ball(), ball().append(veil))
    )
    middle = (slice(SIDE // 2 - 3, SIDE // 2 + 3),) * 2
    assert float((bare - veiled)[middle].abs().max()) < 0.1


def test_the_mesh_is_closed_wound_outwards_and_of_the_size_asked_for(ball_mesh: Mesh) -> None:
    edges = edges_of(ball_mesh)
    assert len(edges) == 3 * len(ball_mesh.faces)
    assert all((b, a) in edges for a, b in edges)
    assert 1000 < len(ball_mesh.faces) <= 1500
    assert volume(ball_mesh) > 0


def test_the_mesh_lies_on_the_surface_in_its_color(ball_mesh: Mesh) -> None:
    """Within a splat and a voxel of the sphere; the alpha of thin pixels at the rim darkens nothing."""
    away = (ball_mesh.vertices.norm(dim=1) - RADIUS).abs()
    assert float(away.mean()) < 0.08
    assert float(away.max()) < 0.25
    assert float((ball_mesh.colors - COLOR).abs().mean()) < 0.03
    outward = torch.nn.functional.normalize(ball_mesh.vertices, dim=1)
    assert float((outward * ball_mesh.normals()).sum(1).mean()) > 0.95


def test_the_same_run_gives_the_same_bits_for_any_number_of_threads(tmp_path: Path, ball_mesh: Mesh) -> None:
    run, threads = make_run(tmp_path), torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        again = gsopt.extract_mesh(run, voxels=40, faces=1500)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(again.vertices, ball_mesh.vertices)
    assert torch.equal(again.colors, ball_mesh.colors)


def test_a_scene_without_masks_becomes_a_shell_within_the_box(tmp_path: Path) -> None:
    mesh = gsopt.extract_mesh(
        make_run(tmp_path, masks=False), voxels=40, faces=4000, box=(-1.5, -1.5, 0, 1.5, 1.5, 1.5)
    )
    edges = edges_of(mesh)
    assert all((b, a) in edges for a, b in edges)
    assert float(mesh.vertices[:, 2].min()) > -0.5
    assert 0 < volume(mesh) < 4 / 3 * math.pi


def test_floaters_and_hollows_are_left_out() -> None:
    field = torch.ones(24, 24, 24)
    field[4:20, 4:20, 4:20] = -1
    field[10:13, 10:13, 10:13] = 1
    field[1, 1, 1] = -1
    tidy = surface.tidied(field)
    assert bool((tidy[4:20, 4:20, 4:20] < 0).all())
    assert float(tidy[1, 1, 1]) > 0


def test_a_floater_that_only_cells_of_zero_join_is_left_out() -> None:
    """Zero is outside: no surface lies between the floater and the object."""
    field = torch.ones(24, 24, 24)
    field[8:20, 8:20, 8:20] = -1
    field[3:8, 10, 10] = 0
    field[2, 10, 10] = -1
    assert float(surface.tidied(field)[2, 10, 10]) > 0


def test_sheets_that_touch_are_taken_apart_and_folded_faces_go() -> None:
    """Two pyramids that share an edge, and a flap: four faces along one edge before, two along every edge after."""
    first = pyramid().faces.numpy()
    names = np.array([0, 1, 4, 5])  # the second has the first's edge 0-1
    faces = np.concatenate([first, names[first], [[2, 3, 4], [2, 4, 3]]])
    vertices = np.concatenate([pyramid().vertices.numpy(), [[0, -1, 0], [0, 0, -2]]]).astype(np.float32)
    assert not surface.is_closed(faces)
    moved, apart = surface.unfolded(vertices, faces)
    assert surface.is_closed(apart)
    assert len(apart) == 8
    assert len(moved) == 8
    corners = {tuple(sorted(map(tuple, vertices[face].tolist()))) for face in faces[:8]}
    assert {tuple(sorted(map(tuple, moved[face].tolist()))) for face in apart} == corners


def test_voxels_that_nobody_sees_are_inside_an_object_and_outside_of_a_scene() -> None:
    box = box_around(torch.full((3,), -1.0), torch.full((3,), 1.0), 16)
    assert bool((fused([], box, solid=True) < 0).all())
    assert bool((fused([], box, solid=False) > 0).all())


def pyramid() -> Mesh:
    return Mesh(
        vertices=torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 2]]),
        faces=torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]),
        colors=torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0.5, 0.5]]),
    )


def test_a_ply_holds_the_mesh(tmp_path: Path) -> None:
    save_mesh(tmp_path / "m.ply", pyramid())
    data = PlyData.read(str(tmp_path / "m.ply"))
    vertex = data["vertex"]
    assert np.stack([vertex[axis] for axis in "xyz"], axis=1).tolist() == pyramid().vertices.tolist()
    assert vertex["red"].tolist() == [255, 0, 0, 128]
    assert [face.tolist() for face in data["face"]["vertex_indices"]] == pyramid().faces.tolist()


def test_an_obj_holds_the_mesh(tmp_path: Path) -> None:
    save_mesh(tmp_path / "m.obj", pyramid())
    lines = [line.split() for line in (tmp_path / "m.obj").read_text().splitlines()]
    assert [[float(x) for x in line[1:4]] for line in lines if line[0] == "v"] == pyramid().vertices.tolist()
    assert [[int(i) - 1 for i in line[1:]] for line in lines if line[0] == "f"] == pyramid().faces.tolist()


def test_a_glb_holds_the_mesh_in_the_axes_of_splats_and_linear_color(tmp_path: Path) -> None:
    path = tmp_path / "m.glb"
    save_mesh(path, pyramid())
    with path.open("rb") as file:
        document = read_container(file, path.stat().st_size, path)
        file.seek(document.start)
        body = file.read(document.length)
    assert document.length == document.root["buffers"][0]["byteLength"]
    primitive = document.root["meshes"][0]["primitives"][0]
    places = [view["byteOffset"] for view in document.root["bufferViews"]]
    positions = np.frombuffer(body, "<f4", 12, places[primitive["attributes"]["POSITION"]]).reshape(4, 3)
    assert positions.tolist() == (pyramid().vertices * torch.tensor([-1.0, -1, 1])).tolist()
    colors = np.frombuffer(body, "<u2", 16, places[primitive["attributes"]["COLOR_0"]]).reshape(4, 4)
    assert colors[3, 0] == pytest.approx(65535 * 0.21404, abs=2)  # 0.5 of IEC 61966-2-1 in linear light
    indices = np.frombuffer(body, "<u4", 12, places[primitive["indices"]])
    assert indices.tolist() == pyramid().faces.flatten().tolist()
    accessors = document.root["accessors"]
    components, widths = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}, {5123: 2, 5125: 4, 5126: 4}  # glTF 2.0, 3.6.2.2
    lengths = [one["count"] * components[one["type"]] * widths[one["componentType"]] for one in accessors]
    assert lengths == [view["byteLength"] for view in document.root["bufferViews"]]
    assert [one["componentType"] for one in accessors] == [5126, 5126, 5123, 5125]
    assert [accessor.get("normalized", False) for accessor in accessors] == [
        False,
        False,
        True,
        False,
    ]  # glTF 2.0, 3.6.2
    assert [accessor["count"] for accessor in accessors] == [4, 4, 4, 12]
    assert [accessor["bufferView"] for accessor in accessors] == [0, 1, 2, 3]
    assert accessors[0]["min"] == positions.min(axis=0).tolist()
    assert accessors[0]["max"] == positions.max(axis=0).tolist()
    assert [view["target"] for view in document.root["bufferViews"]] == [34962, 34962, 34962, 34963]


def test_the_command_writes_a_mesh_and_refuses_to_replace_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, out = make_run(tmp_path), tmp_path / "object.ply"
    assert main(["mesh", str(run), "-o", str(out), "--voxels", "24", "--faces", "500"]) == 0
    assert f"{out}: " in capsys.readouterr().out
    assert len(PlyData.read(str(out))["face"].data) <= 500
    assert main(["mesh", str(run), "-o", str(out)]) == 2
    assert "--force" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["-o", "object.stl"], 3, "must end in one of"),
        (["-o", "absent/object.ply"], 3, "does not exist"),
        (["-o", "object.ply", "--box", "1", "1", "1", "0", "0", "0"], 3, "x < X"),
        (["-o", "object.ply", "--box", "50", "50", "50", "51", "51", "51", "--voxels", "16"], 3, "no surface"),
        (["-o", "object.ply", "--voxels", "2"], 2, "--voxels"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys, arguments: list[str], code: int, message: str
) -> None:
    run = make_run(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert main(["mesh", str(run), *arguments]) == code
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1
    assert not list(tmp_path.glob("object.*"))


def test_a_run_that_has_not_finished_and_a_package_that_is_absent_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run(tmp_path)
    monkeypatch.setitem(__import__("sys").modules, "fast_simplification", None)
    assert main(["mesh", str(run), "-o", str(tmp_path / "m.ply")]) == 2
    assert "gsopt[mesh]" in capsys.readouterr().err
    (run / "splat.ply").unlink()
    assert main(["mesh", str(run), "-o", str(tmp_path / "m.ply")]) == 3
    assert "has not finished" in capsys.readouterr().err


def test_a_surface_that_few_faces_break_keeps_twice_as_many(monkeypatch: pytest.MonkeyPatch) -> None:
    axis = torch.linspace(-1, 1, 12)
    field = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")).norm(dim=0) - 0.8
    vertices, faces = surface.triangulated(field, box_around(torch.full((3,), -1.0), torch.full((3,), 1.0), 12))
    real = fast_simplification.simplify

    def breaking(points: object, corners: object, target_count: int, agg: int) -> tuple[np.ndarray, np.ndarray]:
        found = real(points, corners, target_count=target_count, agg=agg)
        return (found[0], found[1][1:]) if target_count < 120 else found

    monkeypatch.setattr(fast_simplification, "simplify", breaking)
    _, kept = surface.decimated(vertices, faces, 50)
    assert len(faces) > 400
    assert surface.is_closed(kept)
    assert 100 < len(kept) <= 200
