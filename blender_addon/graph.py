"""Node trees written as formulas: values that are sockets, with the operators of arithmetic."""

from __future__ import annotations

from typing import Any

Term = Any
"""A Value, a number or a triple."""


class Value:
    """The output of a node."""

    def __init__(self, graph: Graph, socket: Any) -> None:
        self.graph, self.socket = graph, socket

    def __add__(self, other: Term) -> Value:
        return self.graph.math("ADD", self, other)

    def __sub__(self, other: Term) -> Value:
        return self.graph.math("SUBTRACT", self, other)

    def __mul__(self, other: Term) -> Value:
        return self.graph.math("MULTIPLY", self, other)

    def __truediv__(self, other: Term) -> Value:
        return self.graph.math("DIVIDE", self, other)

    __radd__ = __add__
    __rmul__ = __mul__

    @property
    def is_vector(self) -> bool:
        return self.socket.type in ("VECTOR", "RGBA")


class Graph:
    """A node tree that is being written; nodes are laid out in columns as they are made."""

    def __init__(self, tree: Any, groups: dict[str, Any] | None = None) -> None:
        self.tree = tree
        self.groups = groups or {}
        """Trees that this one may use, by name."""
        self.made = 0

    def node(self, kind: str, **settings: Any) -> Any:
        node = self.tree.nodes.new(kind)
        node.location = (180 * (self.made // 8), -170 * (self.made % 8))
        self.made += 1
        for name, value in settings.items():
            setattr(node, name, value)
        return node

    def feed(self, socket: Any, term: Term) -> None:
        """Link a value to an input, or write a constant into it."""
        if isinstance(term, Value):
            self.tree.links.new(term.socket, socket)
        elif term is not None:
            socket.default_value = term

    def out(self, node: Any, name: str | int = 0) -> Value:
        """An output that is in use in this mode of the node."""
        if isinstance(name, int):
            return Value(self, [s for s in node.outputs if s.enabled][name])
        return Value(self, next(s for s in node.outputs if s.enabled and s.name == name))

    def call(self, kind: str, inputs: dict[str, Term] | list[Term], out: str | int = 0, **settings: Any) -> Value:
        """Make a node, feed its inputs by name or in order, and return an output."""
        node = self.node(kind, **settings)
        used = [s for s in node.inputs if s.enabled]
        if isinstance(inputs, dict):
            for name, term in inputs.items():
                self.feed(next(s for s in used if s.name == name), term)
        else:
            for socket, term in zip(used, inputs, strict=False):
                self.feed(socket, term)
        return self.out(node, out)

    def use(self, name: str, inputs: dict[str, Term]) -> dict[str, Value]:
        """The outputs of another tree, by name."""
        node = self.node("GeometryNodeGroup", node_tree=self.groups[name])
        for socket, term in inputs.items():
            self.feed(node.inputs[socket], term)
        return {socket.name: Value(self, socket) for socket in node.outputs}

    def math(self, operation: str, *terms: Term, clamp: bool = False) -> Value:
        """A scalar operation, or its component-wise form as soon as a vector takes part."""
        if any(isinstance(t, tuple) or (isinstance(t, Value) and t.is_vector) for t in terms):
            spread = [(t, t, t) if isinstance(t, (int, float)) else t for t in terms]
            return self.call("ShaderNodeVectorMath", spread, operation=operation)
        return self.call("ShaderNodeMath", list(terms), operation=operation, use_clamp=clamp)

    def dot(self, a: Term, b: Term) -> Value:
        return self.call("ShaderNodeVectorMath", [a, b], "Value", operation="DOT_PRODUCT")

    def cross(self, a: Term, b: Term) -> Value:
        return self.call("ShaderNodeVectorMath", [a, b], operation="CROSS_PRODUCT")

    def unit(self, a: Term) -> Value:
        return self.call("ShaderNodeVectorMath", [a], operation="NORMALIZE")

    def length(self, a: Term) -> Value:
        return self.call("ShaderNodeVectorMath", [a], "Value", operation="LENGTH")

    def split(self, a: Value) -> tuple[Value, Value, Value]:
        node = self.node("ShaderNodeSeparateXYZ")
        self.feed(node.inputs[0], a)
        return self.out(node, 0), self.out(node, 1), self.out(node, 2)

    def join(self, x: Term, y: Term, z: Term) -> Value:
        return self.call("ShaderNodeCombineXYZ", [x, y, z])

    def compare(self, operation: str, a: Term, b: Term) -> Value:
        """A boolean of geometry nodes: LESS_THAN, GREATER_EQUAL and so on."""
        return self.call("FunctionNodeCompare", [a, b], data_type="FLOAT", operation=operation)

    def both(self, a: Term, b: Term) -> Value:
        return self.call("FunctionNodeBooleanMath", [a, b], operation="AND")

    def switch(self, kind: str, condition: Term, if_false: Term, if_true: Term) -> Value:
        return self.call("GeometryNodeSwitch", [condition, if_false, if_true], input_type=kind)

    def attribute(self, name: str, data_type: str) -> Value:
        """A named attribute of the geometry; zeros where it has none."""
        return self.call("GeometryNodeInputNamedAttribute", {"Name": name}, "Attribute", data_type=data_type)

    def store(self, geometry: Value, name: str, data_type: str, value: Term, domain: str = "POINT") -> Value:
        inputs = {"Geometry": geometry, "Name": name, "Value": value}
        return self.call("GeometryNodeStoreNamedAttribute", inputs, data_type=data_type, domain=domain)
