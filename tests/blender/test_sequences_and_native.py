"""Splats turn with their object, colors too; sequences show each set in its frames; Blender shows its own splats."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from in_panel import bring_in, fails_with
from made_splats import random_splats

from blender_addon import nodes, splat_object
from blender_addon.core.errors import UsageError
from blender_addon.core.placement import placed
from blender_addon.core.ply import read_ply, write_ply
from blender_addon.core.splats import Splats
from blender_addon.graph import Graph

TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
MATRIX = np.vstack([np.column_stack([2.5 * TURN, [1.0, -2.0, 3.0]]), [0, 0, 0, 1.0]])


def close(a: Splats, b: Splats) -> bool:
    """Equal up to the sign of a rotation."""
    signs = np.sign((a.rotations * b.rotations).sum(axis=1, keepdims=True))
    pairs = [(getattr(a, name), getattr(b, name)) for name in ("positions", "scales", "opacities", "base", "sh")]
    return all(np.allclose(x, y, rtol=1e-4, atol=1e-5) for x, y in [*pairs, (a.rotations, signs * b.rotations)])


def test_a_similarity_moves_splats_as_gsopt_does(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    formats = pytest.importorskip("gsopt.formats")
    from gsopt.formats.placement import placed as by_gsopt

    splats = random_splats(200)
    write_ply(tmp_path / "a.ply", splats)
    turn, move = torch.from_numpy(TURN), torch.tensor(MATRIX[:3, 3])
    formats.save_splats(tmp_path / "b.ply", by_gsopt(formats.load_splats(tmp_path / "a.ply"), 2.5, turn, move))
    assert close(placed(splats, MATRIX), read_ply(tmp_path / "b.ply"))


def test_a_similarity_and_back_is_the_identity() -> None:
    splats = random_splats(50)
    assert close(placed(placed(splats, MATRIX), np.linalg.inv(MATRIX)), splats)


@pytest.mark.parametrize("matrix", [np.diag([1, 1, -1, 1.0]), np.diag([1, 2, 1, 1.0]), np.zeros((4, 4))])
def test_what_is_no_similarity_is_refused(matrix: Any) -> None:
    with pytest.raises(UsageError, match="mirrored, or scaled"):
        placed(random_splats(3), matrix)


def colors(thing: Any) -> Any:
    """[N, 4] colors that the nodes give the splats for the scene's camera."""
    import bpy

    bpy.context.view_layer.update()
    mesh = thing.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    values = np.empty(4 * len(mesh.vertices), np.float32)
    mesh.attributes[nodes.COLOR].data.foreach_get("color", values)
    return values.reshape(-1, 4)


def show_colors_only(thing: Any) -> None:
    """The nodes that color splats, without those that draw them: what is drawn is no mesh that a test could read."""
    import bpy

    made = dict(zip(nodes.GROUPS, nodes.node_groups(bpy), strict=True))
    tree = bpy.data.node_groups.new("colors", "GeometryNodeTree")
    nodes.declare(tree, (nodes.GEOMETRY,), (nodes.GEOMETRY,))

    def write(graph: Any, given: dict[str, Any]) -> tuple[Any, ...]:
        inputs = {**given, "Camera": nodes.camera_position(graph), "Color by View": True, "Linear Color": False}
        return (nodes.use(graph, "gsopt color", inputs)["Geometry"],)

    nodes.fill(Graph(tree, made), write)
    splat_object.modifier_of(thing).node_group = tree


def test_harmonics_turn_with_the_object(panel: Any, tmp_path: Path) -> None:
    """Object and camera turned together show the same colors, the object alone others."""
    import bpy
    from mathutils import Matrix

    thing = bring_in(tmp_path / "a.ply")
    show_colors_only(thing)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    camera.location = (4, 1, 2)
    before, turn = colors(thing), Matrix(MATRIX.tolist())
    thing.matrix_world = turn
    assert np.abs(colors(thing) - before).max() > 0.01
    camera.matrix_world = turn @ camera.matrix_world
    assert np.abs(colors(thing) - before).max() < 1e-3


def test_an_export_in_blenders_axes_is_turned_as_the_object_is(panel: Any, tmp_path: Path) -> None:
    import bpy
    from mathutils import Matrix

    thing = bring_in(tmp_path / "a.ply")
    thing.matrix_world = Matrix(MATRIX.tolist())
    bpy.ops.gsopt.export(filepath=str(tmp_path / "b.ply"), as_placed=True)
    assert close(read_ply(tmp_path / "b.ply"), placed(read_ply(tmp_path / "a.ply"), MATRIX))
    thing.scale = (1, 2, 1)
    bpy.context.view_layer.update()
    fails_with("scaled differently", bpy.ops.gsopt.export, filepath=str(tmp_path / "c.ply"), as_placed=True)


@pytest.mark.parametrize("of_runs", [True, False])
def test_a_sequence_shows_each_set_in_its_frames(panel: Any, tmp_path: Path, of_runs: bool) -> None:
    import bpy

    files = (
        [f"run-{i}/splat.ply" for i in range(3)]
        if of_runs
        else ["previews/step_000500.ply", "previews/step_001000.ply"]
    )
    files += [] if of_runs else ["splat.ply"]
    for number, name in enumerate(files):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).parent.joinpath("config.json").write_text("{}")
        write_ply(tmp_path / name, random_splats(10 + number))
    scene = bpy.context.scene
    scene.frame_current, scene.frame_end = 3, 4
    assert bpy.ops.gsopt.import_sequence(directory=str(tmp_path), frames=5) == {"FINISHED"}
    home = bpy.context.view_layer.objects.active
    things = sorted(home.children, key=lambda thing: len(thing.data.vertices))
    assert [len(thing.data.vertices) for thing in things] == [10, 11, 12]
    for frame in range(1, 25):
        scene.frame_set(frame)
        shown = [i for i, thing in enumerate(things) if not thing.hide_viewport and not thing.hide_render]
        assert shown == [min(max(frame - 3, 0) // 5, 2)], frame
    assert scene.frame_end == 17


def test_a_folder_without_a_sequence_is_refused(panel: Any, tmp_path: Path) -> None:
    import bpy

    fails_with("two or more splats", bpy.ops.gsopt.import_sequence, directory=str(tmp_path))
    fails_with("No folder is named", bpy.ops.gsopt.import_sequence)


def test_a_blender_without_splats_of_its_own_says_so(panel: Any, tmp_path: Path) -> None:
    import bpy

    from blender_addon import native

    if native.kind_here():
        pytest.skip("this Blender has them")
    bring_in(tmp_path / "a.ply")
    fails_with("has no splats of its own", bpy.ops.gsopt.native_splats)


def test_blenders_own_splats_hold_what_is_shown(panel: Any, tmp_path: Path) -> None:
    """No released bpy has them: point clouds get an enum as Blender 5.3 is to have one."""
    import bpy
    from mathutils import Matrix

    from blender_addon import native

    if not hasattr(bpy.data.pointclouds.new("probe"), "resize"):
        pytest.skip("this Blender's point clouds cannot be filled")
    own = native.kind_here() is not None
    if not own:
        items = [("POINTS", "Points", ""), ("SPLATS", "Splats", "")]
        bpy.types.PointCloud.render_as = bpy.props.EnumProperty(items=items)
    try:
        thing = bring_in(tmp_path / "a.ply")
        thing.matrix_world = Matrix(MATRIX.tolist())
        panel.least_opacity = 0.5
        bpy.ops.gsopt.filter()
        for _ in range(2):  # the second takes the place of the first
            assert bpy.ops.gsopt.native_splats() == {"FINISHED"}
        (shown,) = [other for other in bpy.context.scene.objects if other.type == "POINTCLOUD"]
        kind = native.kind_here()
        assert kind is not None
        assert getattr(shown.data, kind[0]) == kind[1]
        splats = read_ply(tmp_path / "a.ply")
        kept = splats.rows(splats.opacities >= 0.5)
        assert 0 < len(kept) < len(splats)
        base = np.column_stack([kept.base, kept.opacities])
        expected = {"position": kept.positions, "scale": kept.scales, "rotation": kept.rotations, "radiance:base": base}
        expected |= {f"radiance:sh_{k}": kept.sh[:, k] for k in range(kept.sh.shape[1])}
        for name, values in expected.items():
            attribute = shown.data.attributes[name]
            found = np.empty(values.size, np.float32)
            attribute.data.foreach_get("value" if attribute.data_type == "QUATERNION" else "vector", found)
            assert np.allclose(found.reshape(values.shape), values, atol=1e-6), name
        assert np.allclose(np.array(shown.matrix_world), MATRIX, atol=1e-5)
        assert thing.hide_render
        assert math.isclose(shown["gsopt_meters"], 1.0)
    finally:
        if not own:
            del bpy.types.PointCloud.render_as
