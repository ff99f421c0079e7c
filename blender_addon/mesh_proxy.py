"""3 Run, when it is done: a closed mesh of the run, which stands for the splats where those can do nothing.

Splats have no surface that collides, blocks light or is mirrored. The proxy has, lies where the splats lie, and shows
nothing of itself: a wire in the viewport, hidden from the camera in renders. A shadow catcher would hide the splats
behind it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from . import splat_object
from .core import arguments, job
from .core.errors import InputError
from .core.units import meters_per_unit
from .job_results import FINISH
from .operator_errors import WaitingOperator
from .operators_inspect import METERS, activate, data_of, frame
from .operators_result import work_on_run

PRODUCT = "mesh.ply"
PROXY = "gsopt_proxy"
"""Custom property of proxies: the run that they stand for."""
COLORS = "Col"
"""Name that Blender gives to the colors of a PLY."""


class GSOPT_OT_mesh_proxy(WaitingOperator, bpy.types.Operator):
    """Make a closed mesh of the run, which collides and casts shadows in place of the splats"""

    bl_idname = "gsopt.mesh_proxy"
    bl_label = "Mesh Proxy"

    def do(self, context: Any) -> str:
        return work_on_run(context, self, PRODUCT, "mesh", arguments.mesh)


def add_proxy(scene: Any, path: Path) -> Any:
    """Bring a mesh of gsopt in, in place of an earlier one of the same run. InputError for a file that is none."""
    before = set(bpy.data.objects)
    try:
        with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
            bpy.ops.wm.ply_import(filepath=str(path), forward_axis="Y", up_axis="Z", import_colors="SRGB")
    except RuntimeError as error:
        raise InputError(f"{path.name} could not be read: {error}. Make the mesh again.") from error
    made = [thing for thing in bpy.data.objects if thing not in before]
    if len(made) != 1 or not len(made[0].data.polygons):
        raise InputError(f"{path.name} holds no mesh. Make the mesh again.")
    thing, run = made[0], path.parent
    for old in [thing for thing in scene.objects if thing.get(PROXY) == str(run)]:
        splat_object.remove(bpy, old)
    thing.name = thing.data.name = f"{run.name} proxy"
    thing[PROXY] = str(run)
    thing[METERS] = meters_per_unit(run)
    thing.matrix_world = frame(scene.gsopt, data_of(run), thing[METERS])
    thing.display_type, thing.visible_camera = "WIRE", False
    thing.modifiers.new("Collision", "COLLISION")
    thing.data.materials.append(colored_material())
    return thing


def colored_material() -> Any:
    """The colors of the mesh, matt: for when the proxy is shown."""
    name = "gsopt proxy"
    material = bpy.data.materials.get(name)
    if material is None:
        material = bpy.data.materials.new(name)
        material.use_nodes = True
        tree = material.node_tree
        colors = tree.nodes.new("ShaderNodeVertexColor")
        colors.layer_name = COLORS
        surface = next(node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
        surface.inputs["Roughness"].default_value = 0.9
        tree.links.new(colors.outputs["Color"], surface.inputs["Base Color"])
    return material


def finish_mesh(scene: Any, work: job.Job) -> None:
    """Bring in what `gsopt mesh` wrote."""
    product = Path(work.product)
    if not product.is_file() or product.stat().st_mtime < work.started - 1:
        raise InputError(job.complaint(work))
    activate(add_proxy(scene, product))


FINISH["mesh"] = finish_mesh  # here, because the timer imports the others
CLASSES = (GSOPT_OT_mesh_proxy,)
