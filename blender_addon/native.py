"""Blender's own Gaussian splats, where the running Blender has them: a point cloud that it draws as splats.

Blender 5.3 is to bring them. No bpy that had them was to be had when this was written: the code asks Blender for what
point clouds can be, an enum with a value named after splats, not for its version.
"""

from __future__ import annotations

from typing import Any

import bpy

from . import splat_object
from .core.errors import UsageError
from .operator_errors import ReportingOperator
from .operators_inspect import METERS, active_splats

NATIVE = "gsopt_native"
"""Custom property of clouds made here: the name of the object whose splats they show."""


def splat_kind(cloud_type: Any) -> tuple[str, str] | None:
    """The property of a type of point clouds, and its value, that make one splats; or None."""
    for prop in cloud_type.bl_rna.properties:
        if prop.type == "ENUM":
            found = next((item.identifier for item in prop.enum_items if "SPLAT" in item.identifier), None)
            if found is not None:
                return prop.identifier, found
    return None


def kind_here() -> tuple[str, str] | None:
    """The same of the running Blender."""
    return splat_kind(bpy.types.PointCloud)


def fill(cloud: Any, parts: list[splat_object.Part]) -> None:
    """Give a new point cloud as many points, and the attributes that Blender's splats have."""
    cloud.resize(len(parts[0][2]) // 3)
    for name, kind, values in parts:
        if name != "opacity":  # for the nodes; Blender's splats have it in radiance:base
            splat_object.put(cloud, name, "FLOAT4" if name == "radiance:base" else kind, values)


class GSOPT_OT_native_splats(ReportingOperator, bpy.types.Operator):
    """Show the splats that are not hidden as Blender's own, in place of the nodes"""

    bl_idname = "gsopt.native_splats"
    bl_label = "Blender's Own Splats"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def do(self, context: Any) -> str:
        kind = kind_here()
        if kind is None:
            raise UsageError(f"Blender {bpy.app.version_string} has no splats of its own. Keep the nodes, or take 5.3.")
        thing = active_splats(context)
        splats = splat_object.read_mesh(thing.data).rows(~splat_object.hidden(thing.data))
        cloud = bpy.data.pointclouds.new(f"{thing.name} splats")
        fill(cloud, splat_object.parts_of(splats))
        setattr(cloud, *kind)
        cloud.update_tag()
        for old in [other for other in context.scene.objects if other.get(NATIVE) == thing.name]:
            data = old.data
            bpy.data.objects.remove(old)
            bpy.data.pointclouds.remove(data)
        shown = bpy.data.objects.new(cloud.name, cloud)
        shown[NATIVE], shown[METERS] = thing.name, thing.get(METERS, 1.0)
        context.scene.collection.objects.link(shown)
        shown.matrix_world = thing.matrix_world.copy()
        thing.hide_render = True
        thing.hide_set(True)
        return f"{len(splats):,} splats in {shown.name}; the object under the nodes is hidden"


CLASSES = (GSOPT_OT_native_splats,)
