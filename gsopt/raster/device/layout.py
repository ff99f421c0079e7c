"""The records that kernels take, as ctypes: read from the kernels' text, so that their layout has one home."""

from __future__ import annotations

import ctypes
import functools
import re
from typing import Any

SCALARS: dict[str, Any] = {
    "int": ctypes.c_int32,
    "float": ctypes.c_float,
    "bool": ctypes.c_bool,
    "Index": ctypes.c_int64,
}
STRUCT = re.compile(r"\bstruct (\w+) \{\n(.*?)\n\};", re.DOTALL)
DECLARATION = re.compile(r"(?:const )?(\w+)(\W[^;]*);")
DECLARATOR = re.compile(r"(\*?)\s*(\w+)(?:\[(\d+)\])?")
Layout = type[ctypes.Structure]
KERNEL = re.compile(r"^KERNEL\((\w+), (\w+)\) \{", re.MULTILINE)


@functools.cache
def kernels(text: str) -> dict[str, Layout]:
    """Every kernel of the text and the record that it takes."""
    bodies = {match[1]: match[2] for match in STRUCT.finditer(re.sub(r"//[^\n]*", "", text))}
    made: dict[str, Layout] = {}
    return {match[1]: _structure(match[2], bodies, made) for match in KERNEL.finditer(text)}


def members(layout: Layout) -> dict[str, Any]:
    """Names and types of its fields."""
    return {field[0]: field[1] for field in layout._fields_}


def filled(layout: Layout, values: dict[str, Any]) -> ctypes.Structure:
    """A record of these values; a list fills an array."""
    record = layout()
    for name, kind in members(layout).items():
        value = values[name]
        setattr(record, name, kind(*value) if isinstance(value, (list, tuple)) else value)
    return record


def _structure(name: str, bodies: dict[str, str], made: dict[str, Layout]) -> Layout:
    if name not in made:
        parts = [
            _part(kind, declarator.strip(), bodies, made)
            for kind, declarators in DECLARATION.findall(bodies[name])
            for declarator in declarators.split(",")
        ]
        made[name] = type(name, (ctypes.Structure,), {"_fields_": parts})
    return made[name]


def _part(kind: str, declarator: str, bodies: dict[str, str], made: dict[str, Layout]) -> tuple[str, Any]:
    """`float`, `* name` or `name[3]`: the name and its type."""
    match = DECLARATOR.fullmatch(declarator)
    assert match, declarator
    pointer, name, length = match.groups()
    if pointer:
        return name, ctypes.c_void_p
    element = SCALARS[kind] if kind in SCALARS else _structure(kind, bodies, made)
    return name, element * int(length) if length else element
