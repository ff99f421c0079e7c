"""The mesh comes into an empty Blender scene, is mended and moved to the origin at unit size."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsopt.errors import InputError
from synth.coincident_faces import separate_coincident_faces
from synth.mesh_normals import mend_normals, vectors
from synth.meshfile import check_mesh, find_near

if TYPE_CHECKING:
    from jaxtyping import Float

Y_UP = (".obj", ".glb", ".gltf")
Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
UNSHADED = (".obj", ".ply", ".stl")
"""Kinds whose faces have no shading of their own when the file has no normals."""
SOLIDS = ("MESH", "CURVE", "SURFACE", "FONT", "META")


@dataclass(frozen=True)
class ImportedMesh:
    """The triangles of a mesh in Blender's scene, normalized."""

    triangles: Float[np.ndarray, "T 3 3"]
    """World corners of every triangle."""
    normalized_from_mesh: Float[np.ndarray, "4 4"]
    """World from the file's coordinates; for FBX and .blend from those that Blender reads (meters, z up)."""
    warnings: list[str]


def import_mesh(bpy: Any, mesh: Path, normalize: str) -> ImportedMesh:
    """Fill an empty scene with the mesh. InputError when it cannot be read or has nothing to render."""
    warnings = check_mesh(mesh)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    read_mesh_file(bpy, mesh)
    for other in [o for o in bpy.data.objects if o.type in ("CAMERA", "LIGHT", "LIGHT_PROBE", "SPEAKER")]:
        bpy.data.objects.remove(other)
    warnings += mend_textures(bpy, mesh)
    if mesh.suffix.lower() == ".obj":
        cut_out_textures(bpy)
    turned = wrong = twins = 0
    for shape in bpy.data.meshes:
        mended = mend_normals(bpy, shape, mesh.suffix.lower() in UNSHADED)
        turned, wrong = turned + mended.turned, wrong + mended.wrong
        twins += separate_coincident_faces(shape)
        if not any(shape.materials):
            shape.materials.append(plain_material(bpy, shape))
    if turned:
        warnings.append("faces wound both ways: turned alike, normals computed anew")
    if wrong:
        warnings.append(f"normals that pointed away from their face took its own: {wrong}")
    if twins:
        warnings.append(f"faces back to back in one plane, parted so that neither shadows the other: {twins}")
    imported = world_triangles(bpy)
    if not len(imported):
        raise InputError(f"{mesh} holds no faces to render. Export the surface, not only points, lines or empties.")
    matrix = normalization(imported.reshape(-1, 3), normalize)
    roots = [o for o in bpy.data.objects if o.parent is None]
    anchor = bpy.data.objects.new("normalized_from_imported", None)
    for root in roots:
        root.parent = anchor
    bpy.context.scene.collection.objects.link(anchor)
    anchor.matrix_world = matrix_rows(matrix)
    up = Z_UP_FROM_Y_UP if mesh.suffix.lower() in Y_UP else np.eye(4)
    return ImportedMesh(imported @ matrix[:3, :3].T + matrix[:3, 3], matrix @ up, warnings)


def read_mesh_file(bpy: Any, mesh: Path) -> None:
    importers = {
        ".obj": bpy.ops.wm.obj_import,
        ".ply": bpy.ops.wm.ply_import,
        ".stl": bpy.ops.wm.stl_import,
        ".fbx": bpy.ops.import_scene.fbx,
        ".blend": lambda filepath: append_scene(bpy, filepath),
    }
    try:
        importers.get(mesh.suffix.lower(), bpy.ops.import_scene.gltf)(filepath=str(mesh.resolve()))
    except Exception as error:  # importers in C++ raise RuntimeError, those in Python whatever they stumbled over
        *_, reason = [type(error).__name__, *str(error).strip().splitlines()]
        reason = reason.removeprefix("Error: ").rstrip(". ")
        raise InputError(f"Blender cannot read {mesh}: {reason}. Export it again or convert it.") from None


def append_scene(bpy: Any, filepath: str) -> None:
    """The objects of a .blend's first scene: opening the file would bring its render settings and scripts along."""
    with bpy.data.libraries.load(filepath) as (source, target):
        target.scenes = source.scenes[:1]
    for scene in target.scenes:
        for shape in [o for o in scene.objects if not o.hide_render]:
            bpy.context.scene.collection.objects.link(shape)
        bpy.data.scenes.remove(scene)


def mend_textures(bpy: Any, mesh: Path) -> list[str]:
    """Find textures whose path is wrong; take lost ones out, so that the material's own color shows."""
    lost = []
    for image in [i for i in bpy.data.images if i.source == "FILE" and i.packed_file is None and not i.size[0]]:
        named = image.filepath_raw.removeprefix("//") or image.name
        found = find_near(mesh, named)
        mended = load_image(bpy, found) if found else None
        if mended:
            image.user_remap(mended)
        else:
            bare = named.replace("\\", "/").rpartition("/")[2]
            lost.append(f"the texture {bare} is {'unreadable' if found else 'missing'}: its surfaces are plain")
        bpy.data.images.remove(image)
    for material in bpy.data.materials:
        nodes = material.node_tree.nodes if material.node_tree else []
        for node in [n for n in nodes if n.type == "TEX_IMAGE" and n.image is None]:
            nodes.remove(node)
    return sorted(lost)


def cut_out_textures(bpy: Any) -> None:
    """Textures with holes make their surfaces transparent there, as exporters of leaves and lattices mean it: OBJ
    has `map_d` for that, which they leave out. The other formats say themselves what is transparent."""
    for tree in [m.node_tree for m in bpy.data.materials if m.node_tree]:
        for surface in [n for n in tree.nodes if n.type == "BSDF_PRINCIPLED"]:
            color, alpha = surface.inputs["Base Color"], surface.inputs["Alpha"]
            texture = color.links[0].from_node if color.is_linked and not alpha.is_linked else None
            if texture is not None and texture.type == "TEX_IMAGE" and has_holes(texture.image):
                tree.links.new(texture.outputs["Alpha"], alpha)


def has_holes(image: Any) -> bool:
    """True when some of an image is transparent and some is not; alpha that is 0 all over means nothing."""
    if image.channels != 4:
        return False
    values = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(values)
    return bool(values[3::4].min() < 0.5 < values[3::4].max())


def load_image(bpy: Any, file: Path) -> Any:
    """An image, or None when the file holds none."""
    try:
        image = bpy.data.images.load(str(file.resolve()))
    except RuntimeError:
        return None
    return image if image.size[0] else None


def plain_material(bpy: Any, shape: Any) -> Any:
    """A matte material that shows the mesh's vertex colors where it has some, else light gray."""
    material = bpy.data.materials.new("plain")
    if material.node_tree is None:  # before Blender 5
        material.use_nodes = True
    nodes = material.node_tree.nodes
    surface = nodes["Principled BSDF"]
    surface.inputs["Base Color"].default_value = (0.6, 0.6, 0.6, 1.0)
    surface.inputs["Roughness"].default_value = 0.9
    if len(shape.color_attributes):
        colors = nodes.new("ShaderNodeVertexColor")
        colors.layer_name = shape.color_attributes[0].name
        material.node_tree.links.new(colors.outputs["Color"], surface.inputs["Base Color"])
    return material


def world_triangles(bpy: Any) -> Float[np.ndarray, "T 3 3"]:
    """Corners of every triangle that a render shows, instances and modifiers included."""
    return np.concatenate([np.empty((0, 3, 3)), *solid_triangles(bpy)])


def solid_triangles(bpy: Any) -> Iterator[Float[np.ndarray, "T 3 3"]]:
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        solid = instance.object
        if solid.type not in SOLIDS or solid.hide_render:
            continue
        shape = solid.to_mesh()
        shape.calc_loop_triangles()
        corners = np.empty(3 * len(shape.loop_triangles), np.int32)
        shape.loop_triangles.foreach_get("vertices", corners)
        world = np.array(instance.matrix_world, np.float64)
        yield (vectors(shape.vertices, "co") @ world[:3, :3].T + world[:3, 3])[corners].reshape(-1, 3, 3)
        solid.to_mesh_clear()


def normalization(vertices: Float[np.ndarray, "V 3"], normalize: str) -> Float[np.ndarray, "4 4"]:
    """The similarity that moves the middle of the bounding box to the origin and scales to the unit sphere (the
    farthest vertex at distance 1) or to the cube of side 1 (the longest side is 1).

    InputError when a coordinate is not finite or the mesh has no extent.
    """
    if not np.isfinite(vertices).all():
        bad = int(np.nonzero(~np.isfinite(vertices).all(axis=1))[0][0])
        raise InputError(
            f"The mesh must have finite coordinates, got {vertices[bad].tolist()}. Repair or export it again."
        )
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    center = 0.5 * (low + high)
    radius = float(np.linalg.norm(vertices - center, axis=1).max())
    if not 1e-12 < radius < 1e12:
        raise InputError(f"The mesh must have an extent, got a radius of {radius:g}. Check the export's units.")
    scale = 1.0 / (radius if normalize == "sphere" else float((high - low).max()))
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[:3, 3] = -scale * center
    return matrix


def matrix_rows(matrix: Float[np.ndarray, "4 4"]) -> Any:
    """A matrix as bpy properties take it: a mathutils.Matrix, since a plain list is read column by column."""
    from mathutils import Matrix

    return Matrix(matrix.tolist())
