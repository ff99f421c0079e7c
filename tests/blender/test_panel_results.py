"""A finished run gets a mesh proxy and its true size in the panel, or the reason why not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from in_panel import fails_with, stand_in
from made_splats import random_splats

from blender_addon.core.ply import write_ply

PYRAMID = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face 4
property list uchar int vertex_indices
end_header
0 0 0 255 0 0
1 0 0 0 255 0
0 1 0 0 0 255
0 0 2 128 128 128
3 0 2 1
3 0 1 3
3 1 2 3
3 2 0 3
"""


def test_a_mesh_proxy_stands_for_the_splats_or_the_reason_is_told(panel: Any, tmp_path: Path) -> None:
    """`-m gsopt mesh RUN -o OUT --force`; a second proxy of the same run replaces the first."""
    import bpy

    fails_with("no finished run", bpy.ops.gsopt.mesh_proxy)
    run = tmp_path / "run"
    run.mkdir()
    (run / "splat.ply").write_bytes(b"splats")
    (tmp_path / "pyramid").write_text(PYRAMID)
    panel.run_path, panel.up = str(run), "MINUS_Y"
    stand_in(tmp_path, "echo 'gsopt: There is no surface.'; exit 3")
    fails_with("There is no surface", bpy.ops.gsopt.mesh_proxy)
    stand_in(tmp_path, 'echo nothing > "$6"')
    fails_with("mesh.ply", bpy.ops.gsopt.mesh_proxy)
    stand_in(tmp_path, f'cp "{tmp_path}/pyramid" "$6"')
    for _ in range(2):
        bpy.ops.gsopt.mesh_proxy()
    proxies = [thing for thing in bpy.context.scene.objects if thing.get("gsopt_proxy")]
    assert len(proxies) == 1
    proxy = proxies[0]
    assert not proxy.visible_camera
    assert proxy.visible_shadow
    assert not proxy.is_shadow_catcher
    assert proxy.display_type == "WIRE"
    assert [modifier.type for modifier in proxy.modifiers] == ["COLLISION"]
    assert [polygon.loop_total for polygon in proxy.data.polygons] == [3] * 4
    top = proxy.matrix_world @ proxy.data.vertices[1].co
    assert [round(x, 5) for x in top] == [1, 0, 0]
    tip = proxy.matrix_world @ proxy.data.vertices[3].co
    assert [round(x, 5) for x in tip] == [0, 2, 0], "splats and proxy are turned alike"


def test_a_known_length_gives_splats_and_proxy_their_true_size(panel: Any, tmp_path: Path) -> None:
    """`-m gsopt measure RUN --from=.. --to=.. --unit-length ..m`, by a stand-in; a second one replaces the first."""
    import bpy

    run = tmp_path / "run"
    run.mkdir()
    write_ply(run / "splat.ply", random_splats(5, 0))
    (run / "config.json").write_text("{}")
    (run / "mesh.ply").write_text(PYRAMID)
    fails_with("No splats are active", bpy.ops.gsopt.set_scale)
    panel.run_path, panel.known_length = str(run), 0.5
    assert bpy.ops.gsopt.import_splats(filepath=str(run)) == {"FINISHED"}
    thing = bpy.context.view_layer.objects.active
    for vertex in thing.data.vertices:
        vertex.select = vertex.index == 0
    fails_with("1 splats are selected", bpy.ops.gsopt.set_scale)
    thing.data.vertices[3].select = True
    stand_in(tmp_path, "echo 'gsopt: The two points must lie apart.'; exit 2")
    fails_with("lie apart", bpy.ops.gsopt.set_scale)
    for scale in (0.25, 4.0):
        stand_in(
            tmp_path, f'echo "$7 $8" > "{tmp_path}/words"; echo \'{{"meters_per_unit": {scale}}}\' > "$4/units.json"'
        )
        bpy.ops.gsopt.set_scale()
        assert [round(x, 5) for x in thing.matrix_world.to_scale()] == [scale] * 3
    assert (tmp_path / "words").read_text().split() == ["--unit-length", "0.5m"]
    stand_in(tmp_path, "true")
    from blender_addon.mesh_proxy import add_proxy

    assert round(add_proxy(bpy.context.scene, run / "mesh.ply").matrix_world.to_scale()[0], 5) == 4.0
    assert bpy.ops.gsopt.import_splats(filepath=str(run)) == {"FINISHED"}
    assert round(bpy.context.view_layer.objects.active.matrix_world.to_scale()[0], 5) == 4.0


def test_a_splat_file_that_carries_its_scale_comes_in_at_its_size(tmp_path: Path) -> None:
    from blender_addon.core.units import meters_per_unit

    for comment, scale in (("Meters per unit: 0.125", 0.125), ("meters per unit: nan", 1.0), ("", 1.0)):
        path = tmp_path / "a.ply"
        path.write_bytes(f"ply\ncomment {comment}\nelement vertex 0\nend_header\n".encode())
        assert meters_per_unit(path) == scale
    for text in ("no json", "[]", '{"meters_per_unit": -1}'):
        (tmp_path / "units.json").write_text(text)
        assert meters_per_unit(tmp_path) == 1.0
