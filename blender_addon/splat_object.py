"""Splats as an object: vertices with attributes under the node group, written and read back attribute by attribute.

Names and types are those of Blender's native Gaussian splats where a mesh can hold them: `position`, `scale`,
`rotation`, `radiance:base` (coefficients, and the opacity as alpha), `radiance:sh_0` and up, and `opacity` on its own
for the nodes. The data stays in the frame of the file; the object's matrix turns it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from . import nodes
from .core.errors import InputError
from .core.splats import Splats
from .material import splat_material

MARK = "gsopt_splats"
"""Custom property of the meshes made here."""
MODIFIER = "gsopt"
HIDDEN = nodes.HIDDEN


def is_splats(thing: Any) -> bool:
    """True when an object holds splats of gsopt."""
    return bool(thing is not None and thing.type == "MESH" and thing.data.get(MARK))


Part = tuple[str, str, Any]
"""Name, type and flat values of an attribute."""


def parts_of(splats: Splats) -> list[Part]:
    """All attributes as Blender takes them; plain numpy, so that a thread can make them."""
    base = np.concatenate([splats.base, splats.opacities[:, None]], axis=1)
    parts = [("position", "FLOAT_VECTOR", splats.positions), ("scale", "FLOAT_VECTOR", splats.scales)]
    parts += [("rotation", "QUATERNION", splats.rotations), ("radiance:base", "FLOAT_COLOR", base)]
    parts += [("opacity", "FLOAT", splats.opacities)]
    parts += [(f"radiance:sh_{k}", "FLOAT_VECTOR", splats.sh[:, k]) for k in range(splats.sh.shape[1])]
    return [(name, kind, np.ascontiguousarray(values, np.float32).reshape(-1)) for name, kind, values in parts]


def mesh_in_steps(bpy: Any, name: str, parts: list[Part]) -> Iterator[Any]:
    """Makes the nodes, the material and, bit by bit, the mesh: yields None after every bit, so that a timer can pause
    in between, then the mesh."""
    yield from (None for _ in nodes.node_groups(bpy))
    material = splat_material(bpy)
    mesh = bpy.data.meshes.new(name)
    mesh[MARK] = 1
    mesh.vertices.add(len(parts[0][2]) // 3)
    yield None
    for part in parts:
        put(mesh, *part)
        yield None
    mesh.materials.append(material)
    mesh.update_tag()
    yield mesh


def make_mesh(bpy: Any, name: str, splats: Splats) -> Any:
    """The mesh at once."""
    return next(step for step in mesh_in_steps(bpy, name, parts_of(splats)) if step is not None)


KEYS = {
    "FLOAT": "value",
    "QUATERNION": "value",
    "BOOLEAN": "value",
    "FLOAT_VECTOR": "vector",
    "FLOAT_COLOR": "color",
    "FLOAT4": "vector",
}
WIDTHS = {"FLOAT": 1, "QUATERNION": 4, "BOOLEAN": 1, "FLOAT_VECTOR": 3, "FLOAT_COLOR": 4}


def put(mesh: Any, name: str, kind: str, values: Any) -> None:
    """Write an attribute, made where it is missing."""
    attribute = mesh.attributes.get(name) or mesh.attributes.new(name, kind, "POINT")
    dtype = bool if kind == "BOOLEAN" else np.float32
    attribute.data.foreach_set(KEYS[kind], np.ascontiguousarray(values, dtype).reshape(-1))


def get(mesh: Any, name: str) -> Any:
    """[N, width] of an attribute. InputError where the mesh has none."""
    attribute = mesh.attributes.get(name)
    if attribute is None or attribute.domain != "POINT" or attribute.data_type not in KEYS:
        raise InputError(f"The object has lost its attribute `{name}`. Undo, or import the splats again.")
    kind = attribute.data_type
    values = np.empty(len(mesh.vertices) * WIDTHS[kind], bool if kind == "BOOLEAN" else np.float32)
    attribute.data.foreach_get(KEYS[kind], values)
    return values.reshape(len(mesh.vertices), WIDTHS[kind])


def read_mesh(mesh: Any, harmonics: bool = True) -> Splats:
    """The splats of a mesh, in its own frame. InputError where attributes are missing.

    Without `harmonics` only the base color is read, which is a quarter of the data.
    """
    bands = 0
    while harmonics and f"radiance:sh_{bands}" in mesh.attributes:
        bands += 1
    bands = max(known for known in (0, 3, 8, 15) if known <= bands)
    sh = np.empty((len(mesh.vertices), bands, 3), np.float32)
    for k in range(bands):
        sh[:, k] = get(mesh, f"radiance:sh_{k}")
    rotations = get(mesh, "rotation")
    lengths = np.linalg.norm(rotations, axis=1, keepdims=True)
    rotations = np.where(lengths > 0, rotations / np.maximum(lengths, 1e-30), np.array([1, 0, 0, 0], np.float32))
    base = np.ascontiguousarray(get(mesh, "radiance:base")[:, :3])
    return Splats(get(mesh, "position"), get(mesh, "scale"), rotations, get(mesh, "opacity")[:, 0], base, sh)


class MeshShapes:
    """A mesh as filters see it: each attribute is read when it is asked for."""

    def __init__(self, mesh: Any) -> None:
        self._mesh = mesh

    @property
    def positions(self) -> Any:
        return get(self._mesh, "position")

    @property
    def scales(self) -> Any:
        return get(self._mesh, "scale")

    @property
    def opacities(self) -> Any:
        return get(self._mesh, "opacity")[:, 0]


def hidden(mesh: Any) -> Any:
    """[N] which splats a filter hides."""
    if HIDDEN not in mesh.attributes:
        return np.zeros(len(mesh.vertices), bool)
    return get(mesh, HIDDEN)[:, 0]


def hide(mesh: Any, mask: Any) -> None:
    """Hide those splats; nothing is lost."""
    put(mesh, HIDDEN, "BOOLEAN", mask)
    mesh.update_tag()


def make_object(bpy: Any, collection: Any, mesh: Any, median_size: float, most_shown: int, display: str) -> Any:
    """An object under the node group."""
    thing = bpy.data.objects.new(mesh.name, mesh)
    collection.objects.link(thing)
    modifier = thing.modifiers.new(MODIFIER, "NODES")
    modifier.node_group = nodes.node_group(bpy)
    set_input(modifier, "Point Radius", 0.3 * median_size)
    set_input(modifier, "Most Shown", most_shown)
    set_input(modifier, "Material", splat_material(bpy))
    set_input(modifier, "Display", display)
    return thing


def replace_mesh(bpy: Any, thing: Any, mesh: Any) -> None:
    """Give an object other splats; the old ones go when nobody else uses them."""
    old = thing.data
    thing.data = mesh
    if old.users == 0:
        bpy.data.meshes.remove(old)


def remove(bpy: Any, thing: Any) -> None:
    """The object, and its splats when nobody else uses them."""
    mesh = thing.data
    bpy.data.objects.remove(thing)
    if mesh.users == 0:
        bpy.data.meshes.remove(mesh)


def modifier_of(thing: Any) -> Any:
    """The modifier that shows the splats, or None."""
    return next(
        (
            m
            for m in thing.modifiers
            if m.type == "NODES" and m.node_group and m.node_group.name.startswith(nodes.GROUP)
        ),
        None,
    )


def identifier(modifier: Any, name: str) -> str:
    items = modifier.node_group.interface.items_tree
    return next(i.identifier for i in items if i.item_type == "SOCKET" and i.in_out == "INPUT" and i.name == name)


def set_input(modifier: Any, name: str, value: Any) -> None:
    """Set an input of the node group by its name; the display by the name of the menu's item."""
    key = identifier(modifier, name)
    if hasattr(modifier, "properties"):  # Blender 5.2
        getattr(modifier.properties.inputs, key).value = value
    else:
        modifier[key] = nodes.DISPLAYS.index(value) if name == "Display" else value
    modifier.id_data.update_tag()


def pixel_filter(angle_x: float, width: int, variance: float = 0.3) -> float:
    """gsopt's 0.3 px² as a share of the squared distance, for a camera of that width in pixels."""
    return variance * (2 * math.tan(0.5 * angle_x) / width) ** 2
