"""Placements of meshes by the nodes of a glTF document.

Source: Khronos, glTF 2.0, section 3.5.3: a node's matrix, or T R S, times its parent's. Splats can be turned, mirrored,
moved and scaled alike in all axes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from gsopt.formats.glb_container import Document
from gsopt.formats.placement import similarity_parts
from gsopt.geometry.quats import rotation_matrices

Placement = tuple[float, Tensor, Tensor]
"""Scale, orthogonal axes [3,3] and translation [3]."""
UNMOVED: Placement = (1.0, torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
_LENGTHS = {"matrix": 16, "translation": 3, "rotation": 4, "scale": 3}


def mesh_placements(document: Document) -> dict[int, list[Placement]]:
    """Mesh number -> one placement per node that shows it. Visits each node once, from the roots down."""
    nodes = document.objects(document.root, "nodes")
    children = [_children(document, node, len(nodes)) for node in nodes]
    inner = {child for row in children for child in row}
    if sum(map(len, children)) != len(inner):
        document.fail("a node has two parents")
    pending = [(i, torch.eye(4, dtype=torch.float64)) for i in range(len(nodes)) if i not in inner]
    visited = 0
    placements: dict[int, list[Placement]] = {}
    while pending:
        i, parent = pending.pop()
        visited += 1
        world = parent @ _matrix(document, nodes[i]) if _LENGTHS.keys() & nodes[i].keys() else parent
        if "mesh" in nodes[i]:
            placements.setdefault(document.integer(nodes[i], "mesh"), []).append(_placement(document, world, i))
        pending += [(child, world) for child in children[i]]
    if visited != len(nodes):
        document.fail("its nodes form a circle")
    return placements


def _children(document: Document, node: Mapping[str, Any], count: int) -> list[int]:
    value = node.get("children", [])
    if not isinstance(value, list) or not all(type(child) is int and 0 <= child < count for child in value):
        document.fail(f"`children` must be numbers of nodes below {count}")
    return value


def _placement(document: Document, world: Tensor, node: int) -> Placement:
    if torch.equal(world, torch.eye(4, dtype=torch.float64)):
        return UNMOVED
    parts = similarity_parts(world[:3, :3])
    if parts is None or not bool(torch.isfinite(world).all()):
        document.fail(f"node {node} shears or scales its axes differently, which splats cannot follow")
    return (*parts, world[:3, 3])


def _matrix(document: Document, node: Mapping[str, Any]) -> Tensor:
    """The node's own transform [4,4]."""
    values = {key: _numbers(document, node, key) for key in _LENGTHS if key in node}
    if "matrix" in values:
        return values["matrix"].reshape(4, 4).T
    local = torch.eye(4, dtype=torch.float64)
    if "rotation" in values:
        x, y, z, w = values["rotation"].tolist()
        if not 1e-6 < math.hypot(x, y, z, w) < 1e6:
            document.fail("a node's `rotation` must be a quaternion")
        local[:3, :3] = rotation_matrices(torch.tensor([w, x, y, z], dtype=torch.float64))
    if "scale" in values:
        local[:3, :3] *= values["scale"]
    if "translation" in values:
        local[:3, 3] = values["translation"]
    return local


def _numbers(document: Document, node: Mapping[str, Any], key: str) -> Tensor:
    value, length = node[key], _LENGTHS[key]
    fine = isinstance(value, list) and len(value) == length
    if not fine or not all(type(x) in (int, float) and abs(x) < 1e30 for x in value):
        document.fail(f"a node's `{key}` must be {length} finite numbers")
    return torch.tensor([float(x) for x in value], dtype=torch.float64)
