"""The material of splats: their color as light, as much of it as they are opaque. For Cycles and EEVEE alike."""

from __future__ import annotations

from typing import Any

from .graph import Graph, Value
from .nodes import COLOR, CORNER, INSTANCED

NAME = "gsopt splats"
VERSION = 2
LEAST_ALPHA = 1 / 255
MOST_ALPHA = 0.99
AS_COLOR, AS_VECTOR, AS_NUMBER, AS_ALPHA = range(4)
"""Outputs of the attribute node; their names changed with Blender 5."""
DEPTH = 1024
"""Splats behind one another that Cycles looks through, the most it can; with too few, what lies behind turns black."""


def splat_material(bpy: Any) -> Any:
    """The material, made once per file."""
    found = bpy.data.materials.get(NAME)
    if found is not None and found.get("gsopt_version") == VERSION:
        return found
    material = bpy.data.materials.new(NAME)
    material["gsopt_version"] = VERSION
    if material.node_tree is None:
        material.use_nodes = True
    material.surface_render_method = "DITHERED"
    write(Graph(material.node_tree))
    return material


def write(graph: Graph) -> None:
    """alpha = o exp(-r²/2), cut off below 1/255 as gsopt does; r is 0 on anything but a Gaussian's square.

    The square reaches to r² = 2 ln(255 o), so that at the place c of its corners' frame alpha = o (255 o)^-|c|².
    """
    graph.tree.nodes.clear()
    corner = attribute(graph, CORNER, "GEOMETRY", AS_VECTOR)
    instanced = attribute(graph, INSTANCED, "GEOMETRY", AS_NUMBER)
    color = mixed(graph, instanced, AS_COLOR)
    opacity = mixed(graph, instanced, AS_ALPHA)
    levels = graph.math("MAXIMUM", opacity * 255.0, 1.0)
    falloff = graph.math("POWER", levels, graph.dot(corner, corner) * -1.0)
    alpha = graph.math("MINIMUM", opacity * falloff, MOST_ALPHA)
    visible = alpha * graph.math("GREATER_THAN", alpha, LEAST_ALPHA)
    light = graph.call("ShaderNodeEmission", {"Color": color, "Strength": 1.0})
    clear = graph.call("ShaderNodeBsdfTransparent", [])
    node = graph.node("ShaderNodeMixShader")
    for socket, term in zip(node.inputs, (visible, clear, light), strict=True):
        graph.feed(socket, term)
    leave = graph.node("ShaderNodeOutputMaterial")
    graph.feed(leave.inputs["Surface"], graph.out(node))


def attribute(graph: Graph, name: str, of: str, out: int) -> Value:
    node = graph.node("ShaderNodeAttribute", attribute_name=name, attribute_type=of)
    return graph.out(node, out)


def mixed(graph: Graph, instanced: Value, out: int) -> Value:
    """An attribute of the instance, or of the point where nothing is instanced."""
    own, of_instance = attribute(graph, COLOR, "GEOMETRY", out), attribute(graph, COLOR, "INSTANCER", out)
    if out == AS_ALPHA:
        return own + (of_instance - own) * instanced
    node = graph.node("ShaderNodeMix", data_type="RGBA")
    used = [socket for socket in node.inputs if socket.enabled]
    for socket, term in zip(used, (instanced, own, of_instance), strict=True):
        graph.feed(socket, term)
    return graph.out(node)


def let_cycles_see_through(scene: Any) -> None:
    """Raise the number of transparent surfaces that Cycles follows, and the first ones it follows without dice: light
    and transparency alone then give a picture without noise."""
    cycles = getattr(scene, "cycles", None)
    if cycles is not None:
        cycles.transparent_max_bounces = DEPTH
        cycles.min_transparent_bounces = DEPTH
