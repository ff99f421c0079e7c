"""The geometry nodes that show splats: chosen, colored for the camera, then as points, spheres, ellipsoids or
camera-facing Gaussians.

A Gaussian seen from direction d covers, in the plane across d, an ellipse with the covariance P Σ P, P = 1 - d dᵀ: that
is what gsopt's image model draws, to first order. Its principal axes carry a square, as large as the Gaussian of this
opacity o is visible: exp(-r²/2) o falls to 1/255 at r² = 2 ln(255 o). The material paints it.
"""

from __future__ import annotations

import math
from typing import Any

from .graph import Graph, Value

GROUP = "gsopt splats"
VERSION = 2
DISPLAYS = ("Points", "Spheres", "Ellipsoids", "Gaussians")
COLOR, CORNER, INSTANCED, HIDDEN = "gsopt_color", "gsopt_corner", "gsopt_instanced", "gsopt_hidden"

C0 = math.sqrt(1 / math.pi) / 2
C1 = math.sqrt(3 / math.pi) / 2
C2_XY = math.sqrt(15 / math.pi) / 2
C2_ZZ = math.sqrt(5 / math.pi) / 4
C2_XX = math.sqrt(15 / math.pi) / 4
C3_XXX = math.sqrt(35 / (2 * math.pi)) / 4
C3_XYZ = math.sqrt(105 / math.pi) / 2
C3_XZZ = math.sqrt(21 / (2 * math.pi)) / 4
C3_ZZZ = math.sqrt(7 / math.pi) / 4
C3_XXZ = math.sqrt(105 / math.pi) / 4

INPUTS: tuple[tuple[str, str, Any, Any, Any], ...] = (
    ("Size", "Float", 1.0, 0.0, 10.0),
    ("Extent", "Float", 2.0, 0.01, 10.0),
    ("Point Radius", "Float", 0.002, 0.0, 1e6),
    ("Least Opacity", "Float", 0.0, 0.0, 1.0),
    ("Most Shown", "Int", 10_000_000, 1, 2**31 - 1),
    ("Color by View", "Bool", True, None, None),
    ("Linear Color", "Bool", True, None, None),
    ("Pixel Filter", "Float", 0.0, 0.0, 1.0),
    ("Material", "Material", None, None, None),
)
"""Name, type, default, least and most. Extent: standard deviations that spheres and ellipsoids reach to. Pixel Filter:
variance added to a Gaussian, in units of its squared distance."""


def node_group(bpy: Any) -> Any:
    """The node group, made once per file."""
    found = bpy.data.node_groups.get(GROUP)
    if found is not None and found.get("gsopt_version") == VERSION:
        return found
    tree = bpy.data.node_groups.new(GROUP, "GeometryNodeTree")
    tree["gsopt_version"] = VERSION
    tree.is_modifier = True
    declare(tree)
    write(Graph(tree))
    return tree


def declare(tree: Any) -> None:
    face = tree.interface
    face.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    face.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    face.new_socket("Display", in_out="INPUT", socket_type="NodeSocketMenu")
    for name, kind, default, least, most in INPUTS:
        socket = face.new_socket(name, in_out="INPUT", socket_type=f"NodeSocket{kind}")
        if default is not None:
            socket.default_value = default
        if least is not None:
            socket.min_value, socket.max_value = least, most


def write(graph: Graph) -> None:
    """The whole tree: one line per step."""
    entry = graph.node("NodeGroupInput")
    given = {socket.name: Value(graph, socket) for socket in entry.outputs if socket.name}
    camera = camera_position(graph)
    chosen = choose(graph, given)
    colored = graph.store(chosen, COLOR, "FLOAT_COLOR", color(graph, given, camera))
    shown = show(graph, given, colored, camera)
    leave = graph.node("NodeGroupOutput")
    graph.feed(leave.inputs[0], shown)


def camera_position(graph: Graph) -> Value:
    """Of the scene's camera, in the splats' own frame."""
    camera = graph.call("GeometryNodeInputActiveCamera", [])
    return graph.call("GeometryNodeObjectInfo", {"Object": camera}, "Location", transform_space="RELATIVE")


def choose(graph: Graph, given: dict[str, Value]) -> Value:
    """Splats that no filter hides, opaque enough, and every k-th where there are too many."""
    size = graph.node("GeometryNodeAttributeDomainSize")
    graph.feed(size.inputs[0], given["Geometry"])
    stride = graph.math("CEIL", graph.out(size, "Point Count") / given["Most Shown"])
    number = graph.call("GeometryNodeInputIndex", [])
    kth = graph.compare("LESS_THAN", graph.math("MODULO", number, graph.math("MAXIMUM", stride, 1.0)), 0.5)
    opaque = graph.compare("GREATER_EQUAL", graph.attribute("opacity", "FLOAT"), given["Least Opacity"])
    hidden = graph.attribute(HIDDEN, "BOOLEAN")
    shown = graph.call("FunctionNodeBooleanMath", [hidden], operation="NOT")
    keep = graph.both(graph.both(kth, opaque), shown)
    return graph.call("GeometryNodeSeparateGeometry", [given["Geometry"], keep], "Selection", domain="POINT")


def color(graph: Graph, given: dict[str, Value], camera: Value) -> Value:
    """sRGB-coded or linear color with the opacity as alpha."""
    base = graph.attribute("radiance:base", "FLOAT_COLOR")
    same = base * (C0, C0, C0) + (0.5, 0.5, 0.5)
    position = graph.call("GeometryNodeInputPosition", [])
    seen = graph.switch(
        "VECTOR", given["Color by View"], same, add_harmonics(graph, same, graph.unit(position - camera))
    )
    coded = graph.math("MAXIMUM", seen, (0.0, 0.0, 0.0))
    final = graph.switch("VECTOR", given["Linear Color"], coded, linear(graph, coded))
    node = graph.node("FunctionNodeCombineColor")
    for socket, part in zip(node.inputs, (*graph.split(final), graph.attribute("opacity", "FLOAT")), strict=False):
        graph.feed(socket, part)
    return graph.out(node)


def add_harmonics(graph: Graph, start: Value, direction: Value) -> Value:
    """start + Σ sh_k Y_k(d), in gsopt's order and with its signs (gsopt/sh.py)."""
    x, y, z = graph.split(direction)
    xx, yy, zz = x * x, y * y, z * z
    harmonics = [y * -C1, z * C1, x * -C1]
    harmonics += [x * y * C2_XY, y * z * -C2_XY, (zz * 2.0 - xx - yy) * C2_ZZ, x * z * -C2_XY, (xx - yy) * C2_XX]
    harmonics += [
        y * (xx * 3.0 - yy) * -C3_XXX,
        x * y * z * C3_XYZ,
        y * (zz * 4.0 - xx - yy) * -C3_XZZ,
        z * (zz * 2.0 - xx * 3.0 - yy * 3.0) * C3_ZZZ,
        x * (zz * 4.0 - xx - yy) * -C3_XZZ,
        z * (xx - yy) * C3_XXZ,
        x * (xx - yy * 3.0) * -C3_XXX,
    ]
    total = start
    for k, harmonic in enumerate(harmonics):
        coefficient = graph.attribute(f"radiance:sh_{k}", "FLOAT_VECTOR")
        scaled = graph.call("ShaderNodeVectorMath", {"Vector": coefficient, "Scale": harmonic}, operation="SCALE")
        total = total + scaled
    return total


def linear(graph: Graph, coded: Value) -> Value:
    """Linear from sRGB-coded (IEC 61966-2-1)."""
    parts = []
    for c in graph.split(coded):
        low = c * (1 / 12.92)
        high = graph.math("POWER", (c + 0.055) * (1 / 1.055), 2.4)
        parts.append(graph.switch("FLOAT", graph.compare("LESS_THAN", c, 0.04045), high, low))
    return graph.join(*parts)


def show(graph: Graph, given: dict[str, Value], points: Value, camera: Value) -> Value:
    """The four displays behind one menu."""
    scale, rotation = graph.attribute("scale", "FLOAT_VECTOR"), graph.attribute("rotation", "QUATERNION")
    sx, sy, sz = graph.split(scale)
    mean = graph.math("POWER", graph.math("ABSOLUTE", sx * sy * sz), 1 / 3)
    reach = given["Size"] * given["Extent"]
    as_points = as_cloud(graph, points, given["Size"] * given["Point Radius"])
    as_spheres = as_cloud(graph, points, mean * reach)
    ball = graph.call("GeometryNodeMeshIcoSphere", {"Radius": 1.0, "Subdivisions": 2}, "Mesh")
    smooth = graph.call("GeometryNodeSetShadeSmooth", [ball])
    as_ellipsoids = instances(
        graph, points, graph.store(smooth, INSTANCED, "FLOAT", 1.0), rotation, scale * vector(graph, reach)
    )
    turn, stretch = footprint(graph, given, camera, scale, rotation)
    as_gaussians = instances(graph, points, square(graph), turn, stretch)
    menu = graph.node("GeometryNodeMenuSwitch", data_type="GEOMETRY")
    for place, name in enumerate(DISPLAYS):  # the first two are there: kept, they make the stored values 0, 1, 2, 3
        if place < len(menu.enum_items):
            menu.enum_items[place].name = name
        else:
            menu.enum_items.new(name)
    graph.feed(menu.inputs[0], given["Display"])
    for name, value in zip(DISPLAYS, (as_points, as_spheres, as_ellipsoids, as_gaussians), strict=True):
        graph.feed(menu.inputs[name], value)
    shown = graph.out(menu)
    return graph.call("GeometryNodeSetMaterial", {"Geometry": shown, "Material": given["Material"]})


def vector(graph: Graph, value: Value) -> Value:
    return graph.join(value, value, value)


def as_cloud(graph: Graph, points: Value, radius: Value) -> Value:
    return graph.call("GeometryNodeMeshToPoints", {"Mesh": points, "Radius": radius})


def instances(graph: Graph, points: Value, shape: Value, rotation: Value, scale: Value) -> Value:
    inputs = {"Points": points, "Instance": shape, "Rotation": rotation, "Scale": scale}
    return graph.call("GeometryNodeInstanceOnPoints", inputs)


def square(graph: Graph) -> Value:
    """From -1 to 1, each corner knowing its place."""
    grid = graph.call("GeometryNodeMeshGrid", {"Size X": 2.0, "Size Y": 2.0, "Vertices X": 2, "Vertices Y": 2}, "Mesh")
    placed = graph.store(grid, CORNER, "FLOAT_VECTOR", graph.call("GeometryNodeInputPosition", []))
    return graph.store(placed, INSTANCED, "FLOAT", 1.0)


def footprint(
    graph: Graph, given: dict[str, Value], camera: Value, scale: Value, rotation: Value
) -> tuple[Value, Value]:
    """Rotation and half sides of the square that a Gaussian fills across the line of sight.

    With u, v across d and columns c_i = s_i R e_i: a = Σ (u·c_i)², b = Σ (u·c_i)(v·c_i), c = Σ (v·c_i)²; the axes are
    turned by atan2(2b, a - c) / 2 and have the variances (a + c)/2 ± √(((a - c)/2)² + b²).
    """
    offset = graph.call("GeometryNodeInputPosition", []) - camera
    d = graph.unit(offset)
    dz = graph.split(d)[2]
    # Whichever axis lies farther from d makes a stable pair across it.
    steep = graph.compare("GREATER_THAN", graph.math("ABSOLUTE", dz), 0.9)
    helper = graph.switch("VECTOR", steep, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    u = graph.unit(graph.cross(helper, d))
    v = graph.cross(d, u)
    turned = [
        graph.call("FunctionNodeRotateVector", [axis, rotation]) for axis in ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0))
    ]
    pairs = [
        (graph.dot(u, column) * s, graph.dot(v, column) * s)
        for column, s in zip(turned, graph.split(scale), strict=True)
    ]
    size2 = given["Size"] * given["Size"]
    blur = graph.dot(offset, offset) * given["Pixel Filter"]
    (u1, v1), (u2, v2), (u3, v3) = pairs
    a = (u1 * u1 + u2 * u2 + u3 * u3) * size2 + blur
    b = (u1 * v1 + u2 * v2 + u3 * v3) * size2
    c = (v1 * v1 + v2 * v2 + v3 * v3) * size2 + blur
    half, middle = (a - c) * 0.5, (a + c) * 0.5
    spread = graph.math("SQRT", half * half + b * b)
    angle = graph.math("ARCTAN2", b, half) * 0.5
    long = along(graph, u, graph.math("COSINE", angle)) + along(graph, v, graph.math("SINE", angle))
    turn = graph.call("FunctionNodeAxesToRotation", [d, long], primary_axis="Z", secondary_axis="X")
    levels = graph.math("MAXIMUM", graph.attribute("opacity", "FLOAT") * 255.0, 1.0)
    reach2 = graph.math("LOGARITHM", levels, math.e) * 2.0
    most = graph.math("SQRT", graph.math("MAXIMUM", middle + spread, 0.0) * reach2)
    least = graph.math("SQRT", graph.math("MAXIMUM", middle - spread, 0.0) * reach2)
    return turn, graph.join(most, least, 1.0)


def along(graph: Graph, axis: Value, share: Value) -> Value:
    return graph.call("ShaderNodeVectorMath", {"Vector": axis, "Scale": share}, operation="SCALE")
