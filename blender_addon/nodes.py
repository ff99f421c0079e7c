"""The geometry nodes that show splats: chosen, colored for the camera, then as points, spheres, ellipsoids or
camera-facing Gaussians.

A Gaussian seen from direction d covers, in the plane across d, an ellipse with the covariance P Σ P, P = 1 - d dᵀ: that
is what gsopt's image model draws, to first order. Its principal axes carry a square, as large as the Gaussian of this
opacity o is visible: exp(-r²/2) o falls to 1/255 at r² = 2 ln(255 o). The material paints it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

from .core.harmonics import C0, HARMONICS
from .graph import Graph, Value

GROUP = "gsopt splats"
VERSION = 3
MARK = "gsopt"
"""Custom property of the trees made here: their name and version."""
DISPLAYS = ("Points", "Spheres", "Ellipsoids", "Gaussians")
COLOR, CORNER, INSTANCED, HIDDEN = "gsopt_color", "gsopt_corner", "gsopt_instanced", "gsopt_hidden"

Socket = tuple[str, str, Any, Any, Any]
"""Name, type, default, least and most."""


def plain(name: str, kind: str) -> Socket:
    return name, kind, None, None, None


INPUTS: tuple[Socket, ...] = (
    plain("Geometry", "Geometry"),
    plain("Display", "Menu"),
    ("Size", "Float", 1.0, 0.0, 10.0),
    ("Extent", "Float", 2.0, 0.01, 10.0),
    ("Point Radius", "Float", 0.002, 0.0, 1e6),
    ("Least Opacity", "Float", 0.0, 0.0, 1.0),
    ("Most Shown", "Int", 10_000_000, 1, 2**31 - 1),
    ("Color by View", "Bool", True, None, None),
    ("Linear Color", "Bool", True, None, None),
    ("Pixel Filter", "Float", 0.0, 0.0, 1.0),
    plain("Material", "Material"),
)
"""Extent: standard deviations that spheres and ellipsoids reach to. Pixel Filter: variance added to a Gaussian, in
units of its squared distance."""


def node_group(bpy: Any) -> Any:
    """The node group on top, made once per file."""
    return list(node_groups(bpy))[-1]


def node_groups(bpy: Any) -> Iterator[Any]:
    """Every node group, those used by others first, each made once per file. Small ones on purpose: Blender looks
    through the whole tree for every node that is added, and a timer can pause between two of them."""
    made: dict[str, Any] = {}
    for name, (inputs, outputs, write) in GROUPS.items():
        mark = f"{name} {VERSION}"
        tree = next((tree for tree in bpy.data.node_groups if tree.get(MARK) == mark), None)
        if tree is None:
            tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
            tree[MARK] = mark
            tree.is_modifier = name == GROUP
            declare(tree, inputs, outputs)
            fill(Graph(tree, made), write)
        made[name] = tree
        yield tree


def declare(tree: Any, inputs: tuple[Socket, ...], outputs: tuple[Socket, ...]) -> None:
    for way, sockets in (("OUTPUT", outputs), ("INPUT", inputs)):
        for name, kind, default, least, most in sockets:
            socket = tree.interface.new_socket(name, in_out=way, socket_type=f"NodeSocket{kind}")
            if default is not None:
                socket.default_value = default
            if least is not None:
                socket.min_value, socket.max_value = least, most


def fill(graph: Graph, write: Callable[[Graph, dict[str, Value]], tuple[Value, ...]]) -> None:
    """Between the inputs and the outputs of a tree."""
    entry = graph.node("NodeGroupInput")
    given = {socket.name: Value(graph, socket) for socket in entry.outputs if socket.name}
    results = write(graph, given)
    leave = graph.node("NodeGroupOutput")
    for socket, result in zip(leave.inputs, results, strict=False):
        graph.feed(socket, result)


def write_all(graph: Graph, given: dict[str, Value]) -> tuple[Value, ...]:
    """The tree on top: one line per step."""
    camera = camera_position(graph)
    chosen = use(graph, "gsopt choose", given)["Geometry"]
    colored = use(graph, "gsopt color", given | {"Geometry": chosen, "Camera": camera})["Geometry"]
    return (show(graph, given, colored, camera),)


def use(graph: Graph, name: str, given: dict[str, Any]) -> dict[str, Value]:
    """Another tree, with those of the values that it takes."""
    return graph.use(name, {socket[0]: given[socket[0]] for socket in GROUPS[name][0]})


def camera_position(graph: Graph) -> Value:
    """Position of the scene's camera in the splats' own frame."""
    camera = graph.call("GeometryNodeInputActiveCamera", [])
    return graph.call("GeometryNodeObjectInfo", {"Object": camera}, "Location", transform_space="RELATIVE")


def choose(graph: Graph, given: dict[str, Value]) -> tuple[Value, ...]:
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
    return (graph.call("GeometryNodeSeparateGeometry", [given["Geometry"], keep], "Selection", domain="POINT"),)


def color(graph: Graph, given: dict[str, Value]) -> tuple[Value, ...]:
    """Stores the sRGB-coded or linear color with the opacity as alpha."""
    base = graph.attribute("radiance:base", "FLOAT_COLOR")
    same = base * (C0, C0, C0) + (0.5, 0.5, 0.5)
    direction = graph.unit(graph.call("GeometryNodeInputPosition", []) - given["Camera"])
    seen = same
    for degree in (1, 2, 3):
        seen = seen + use(graph, f"gsopt band {degree}", {"Direction": direction})["Color"]
    coded = graph.math("MAXIMUM", graph.switch("VECTOR", given["Color by View"], same, seen), (0.0, 0.0, 0.0))
    decoded = graph.join(*(use(graph, "gsopt linear", {"Coded": part})["Linear"] for part in graph.split(coded)))
    final = graph.switch("VECTOR", given["Linear Color"], coded, decoded)
    node = graph.node("FunctionNodeCombineColor")
    for socket, part in zip(node.inputs, (*graph.split(final), graph.attribute("opacity", "FLOAT")), strict=False):
        graph.feed(socket, part)
    return (graph.store(given["Geometry"], COLOR, "FLOAT_COLOR", graph.out(node)),)


def band(degree: int) -> Callable[[Graph, dict[str, Value]], tuple[Value, ...]]:
    """Writes Σ sh_k Y_k(d) over the harmonics of one degree, in gsopt's order and signs (gsopt/geometry/sh.py)."""

    def write(graph: Graph, given: dict[str, Value]) -> tuple[Value, ...]:
        x, y, z = graph.split(given["Direction"])
        total = None
        for k, harmonic in enumerate(HARMONICS[degree](x, y, z), degree**2 - 1):
            coefficient = graph.attribute(f"radiance:sh_{k}", "FLOAT_VECTOR")
            scaled = along(graph, coefficient, harmonic)
            total = scaled if total is None else total + scaled
        assert total is not None
        return (total,)

    return write


def linear(graph: Graph, given: dict[str, Value]) -> tuple[Value, ...]:
    """Linear from sRGB-coded (IEC 61966-2-1)."""
    c = given["Coded"]
    low, high = c * (1 / 12.92), graph.math("POWER", (c + 0.055) * (1 / 1.055), 2.4)
    return (graph.switch("FLOAT", graph.compare("LESS_THAN", c, 0.04045), high, low),)


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
    seen = use(graph, "gsopt footprint", given | {"Camera": camera})
    as_gaussians = instances(graph, points, square(graph), seen["Rotation"], seen["Scale"])
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


def footprint(graph: Graph, given: dict[str, Value]) -> tuple[Value, ...]:
    """Rotation and half sides of the square that a Gaussian fills across the line of sight.

    With u, v across d and columns c_i = s_i R e_i: a = Σ (u·c_i)², b = Σ (u·c_i)(v·c_i), c = Σ (v·c_i)²; the axes are
    turned by atan2(2b, a - c) / 2 and have the variances (a + c)/2 ± √(((a - c)/2)² + b²).
    """
    scale, rotation = graph.attribute("scale", "FLOAT_VECTOR"), graph.attribute("rotation", "QUATERNION")
    offset = graph.call("GeometryNodeInputPosition", []) - given["Camera"]
    d = graph.unit(offset)
    dz = graph.split(d)[2]
    # Whichever axis lies farther from d makes a stable pair across it.
    steep = graph.compare("GREATER_THAN", graph.math("ABSOLUTE", dz), 0.9)
    helper = graph.switch("VECTOR", steep, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    u = graph.unit(graph.cross(helper, d))
    v = graph.cross(d, u)
    across = {"U": u, "V": v, "Rotation": rotation}
    columns = [
        use(graph, "gsopt column", across | {"Axis": axis, "Scale": s})
        for axis, s in zip(((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0)), graph.split(scale), strict=True)
    ]
    size2 = given["Size"] * given["Size"]
    blur = graph.dot(offset, offset) * given["Pixel Filter"]
    (u1, v1), (u2, v2), (u3, v3) = (tuple(c.values()) for c in columns)
    a = (u1 * u1 + u2 * u2 + u3 * u3) * size2 + blur
    b = (u1 * v1 + u2 * v2 + u3 * v3) * size2
    c = (v1 * v1 + v2 * v2 + v3 * v3) * size2 + blur
    found = use(graph, "gsopt ellipse", {"A": a, "B": b, "C": c})
    cosine, sine = (graph.math(name, found["Angle"]) for name in ("COSINE", "SINE"))
    long = along(graph, u, cosine) + along(graph, v, sine)
    turn = graph.call("FunctionNodeAxesToRotation", [d, long], primary_axis="Z", secondary_axis="X")
    levels = graph.math("MAXIMUM", graph.attribute("opacity", "FLOAT") * 255.0, 1.0)
    reach2 = graph.math("LOGARITHM", levels, math.e) * 2.0
    most, least = (graph.math("SQRT", found[name] * reach2) for name in ("Most", "Least"))
    return turn, graph.join(most, least, 1.0)


def along(graph: Graph, axis: Value, share: Value) -> Value:
    return graph.call("ShaderNodeVectorMath", {"Vector": axis, "Scale": share}, operation="SCALE")


def column(graph: Graph, given: dict[str, Value]) -> tuple[Value, ...]:
    """u·c and v·c of c = s R e."""
    turned = graph.call("FunctionNodeRotateVector", [given["Axis"], given["Rotation"]])
    return tuple(graph.dot(given[name], turned) * given["Scale"] for name in ("U", "V"))


def ellipse(graph: Graph, given: dict[str, Value]) -> tuple[Value, ...]:
    """Direction of the long axis of the covariance a, b, c, and the variances along both axes."""
    a, b, c = (given[name] for name in "ABC")
    half, middle = (a - c) * 0.5, (a + c) * 0.5
    spread = graph.math("SQRT", half * half + b * b)
    most, least = (graph.math("MAXIMUM", variance, 0.0) for variance in (middle + spread, middle - spread))
    return graph.math("ARCTAN2", b, half) * 0.5, most, least


def floats(*names: str) -> tuple[Socket, ...]:
    return tuple(plain(name, "Float") for name in names)


def vectors(*names: str) -> tuple[Socket, ...]:
    return tuple(plain(name, "Vector") for name in names)


GEOMETRY, ROTATION = plain("Geometry", "Geometry"), plain("Rotation", "Rotation")
GROUPS = {
    "gsopt choose": ((GEOMETRY, *floats("Least Opacity"), plain("Most Shown", "Int")), (GEOMETRY,), choose),
    "gsopt band 1": (vectors("Direction"), vectors("Color"), band(1)),
    "gsopt band 2": (vectors("Direction"), vectors("Color"), band(2)),
    "gsopt band 3": (vectors("Direction"), vectors("Color"), band(3)),
    "gsopt linear": (floats("Coded"), floats("Linear"), linear),
    "gsopt color": (
        (GEOMETRY, *vectors("Camera"), plain("Color by View", "Bool"), plain("Linear Color", "Bool")),
        (GEOMETRY,),
        color,
    ),
    "gsopt column": ((*vectors("U", "V", "Axis"), ROTATION, *floats("Scale")), floats("Along U", "Along V"), column),
    "gsopt ellipse": (floats("A", "B", "C"), floats("Angle", "Most", "Least"), ellipse),
    "gsopt footprint": (
        (*vectors("Camera"), *floats("Size", "Pixel Filter")),
        (ROTATION, *vectors("Scale")),
        footprint,
    ),
    GROUP: (INPUTS, (GEOMETRY,), write_all),
}
"""Inputs, outputs and content of each tree; those used by others come first."""
