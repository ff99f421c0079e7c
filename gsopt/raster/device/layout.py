"""The records that kernels take, as ctypes: read from the kernels' text, so that their layout has one home."""

from __future__ import annotations

import ctypes
import functools
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

SCALARS: dict[str, Any] = {
    "int": ctypes.c_int32,
    "float": ctypes.c_float,
    "bool": ctypes.c_bool,
    "Index": ctypes.c_int64,
}
NUMBERS = frozenset(SCALARS.values())
STRUCT = re.compile(r"\bstruct (\w+) \{\n(.*?)\n\};", re.DOTALL)
DECLARATION = re.compile(r"((?:GLOBAL )?(?:const )?)(\w+)(\W[^;]*);")
DECLARATOR = re.compile(r"(\*?)\s*(\w+)(?:\[(\d+)\])?")
Layout = type[ctypes.Structure]
Pointer = Callable[[Tensor | None], int | None]
KERNEL = re.compile(r"^KERNEL\((\w+), (\w+)\) \{", re.MULTILINE)


@dataclass(frozen=True)
class Member:
    """A field of a record, as the text declares it: `GLOBAL const float* name`, `float name[3]`."""

    qualifiers: str
    kind: str
    pointer: bool
    name: str
    length: int
    """Length of an array, else 0."""


def structs(text: str) -> dict[str, str]:
    """The bodies of the text's structs, without comments."""
    return {match[1]: match[2] for match in STRUCT.finditer(re.sub(r"//[^\n]*", "", text))}


def declared(body: str) -> list[Member]:
    """The fields of a struct that has nothing but fields."""
    return [
        _member(qualifiers, kind, declarator.strip())
        for qualifiers, kind, declarators in DECLARATION.findall(body)
        for declarator in declarators.split(",")
    ]


@functools.cache
def kernels(text: str) -> dict[str, Layout]:
    """Every kernel of the text and the record that it takes."""
    bodies, made = structs(text), dict[str, Layout]()
    return {match[1]: _structure(match[2], bodies, made) for match in KERNEL.finditer(text)}


@functools.cache
def members(layout: Layout) -> dict[str, Any]:
    """Names and types of its fields."""
    return {field[0]: field[1] for field in layout._fields_}


def address(tensor: Tensor | None) -> int | None:
    """The address of its numbers, which must live until the kernel has started."""
    return None if tensor is None else tensor.data_ptr()


def filled(layout: Layout, values: Mapping[str, Any], pointer: Pointer = address) -> Any:
    """A record of these values: a list fills an array, a mapping a record, `pointer` of a tensor or None a pointer.

    Pointers are asked for in the order of the fields.
    """
    record = layout()
    for name, kind in members(layout).items():
        setattr(record, name, _filled_field(kind, values[name], pointer))
    return record


def _filled_field(kind: Any, value: Any, pointer: Pointer) -> Any:
    if kind in NUMBERS:  # first: most fields are, and a step fills ten records
        return value
    if kind is ctypes.c_void_p:
        return pointer(value)
    if isinstance(value, Mapping):
        return filled(kind, value, pointer)
    if isinstance(value, (list, tuple)):
        return kind(*(_filled_field(kind._type_, item, pointer) for item in value))
    return value


def _structure(name: str, bodies: dict[str, str], made: dict[str, Layout]) -> Layout:
    if name not in made:
        parts = [(member.name, _type(member, bodies, made)) for member in declared(bodies[name])]
        made[name] = type(name, (ctypes.Structure,), {"_fields_": parts})
    return made[name]


def _type(member: Member, bodies: dict[str, str], made: dict[str, Layout]) -> Any:
    if member.pointer:
        return ctypes.c_void_p
    element = SCALARS[member.kind] if member.kind in SCALARS else _structure(member.kind, bodies, made)
    return element * member.length if member.length else element


def _member(qualifiers: str, kind: str, declarator: str) -> Member:
    match = DECLARATOR.fullmatch(declarator)
    assert match, declarator
    return Member(qualifiers, kind, bool(match[1]), match[2], int(match[3] or 0))
