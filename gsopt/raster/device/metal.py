"""The kernels in Metal's language, as `torch.mps.compile_shader` takes them.

Metal is C++ with three rules that the shared text does not spell out. A pointer or a reference names the memory that it
leads to: the text marks that of the GPU and of a block, and what is unmarked is the thread's own. A constant outside of
functions lies in constant memory. A kernel takes buffers, not records with pointers: here it takes a record of plain
numbers, in which a pointer is 0 or 1, and a buffer for every pointer, and puts the two together.
"""

from __future__ import annotations

import functools
import re

from gsopt.raster.device.layout import KERNEL, SCALARS, Member, declared, structs
from gsopt.raster.device.runtime import THREADS
from gsopt.raster.device.source import FOLDER, program

MAX_BUFFERS = 31
"""Buffers of a kernel, the record of numbers among them."""
POINTED = re.compile(r"\b(GLOBAL |IN_BLOCK |)(?:const )?(?:\w+::)*\w+(?:<\w+>)?[&*](?= ?\w)")


@functools.cache
def metal_program() -> str:
    """All kernels."""
    text = program(FOLDER / "metal.h")
    bodies = structs(text)
    entries = {match[0]: _entry(match[1], match[2], bodies) for match in KERNEL.finditer(text)}
    text = re.sub(r"^(namespace gsopt\b.*\{|\}  // namespace.*)$", "", text, flags=re.MULTILINE)
    text = re.sub(r"//[^\n]*", "", text)  # torch takes ASCII only
    text = re.sub(r"^constexpr ", "constant constexpr ", text, flags=re.MULTILINE)
    text = POINTED.sub(lambda match: match[0] if match[1] else f"thread {match[0]}", text)
    return KERNEL.sub(lambda match: entries[match[0]], text)


def _entry(kernel: str, arguments: str, bodies: dict[str, str]) -> str:
    """The kernel's head, which makes its record `a`."""
    buffers: list[str] = []
    record = _record(bodies[arguments], "numbers->", bodies, buffers)
    assert len(buffers) < MAX_BUFFERS, kernel
    parameters = [
        f"constant {kernel}_numbers* numbers [[buffer(0)]]",
        *buffers,
        "uint own_block [[threadgroup_position_in_grid]]",
        "uint own_thread [[thread_position_in_threadgroup]]",
    ]
    return " ".join(  # one line, as in the text: errors name the line of its file
        [
            f"struct {kernel}_numbers {{ {_numbers(bodies[arguments], bodies)} }};",
            f"[[max_total_threads_per_threadgroup({THREADS})]] kernel void {kernel}({', '.join(parameters)}) {{",
            f"const {arguments} a = {record};",
        ]
    )


def _numbers(body: str, bodies: dict[str, str]) -> str:
    """The fields of a record, a number in the place of every pointer."""
    return " ".join(f"{_number(member, bodies)};" for member in declared(body))


def _number(member: Member, bodies: dict[str, str]) -> str:
    array = f"[{member.length}]" if member.length else ""
    if member.pointer:
        return f"ulong {member.name}"
    if member.kind in SCALARS:
        return f"{member.kind} {member.name}{array}"
    return f"struct {{ {_numbers(bodies[member.kind], bodies)} }} {member.name}{array}"


def _record(body: str, at: str, bodies: dict[str, str], buffers: list[str]) -> str:
    """The record of the numbers `at` and of buffers, whose parameters are added to `buffers`."""
    return f"{{{', '.join(_field(member, at + member.name, bodies, buffers) for member in declared(body))}}}"


def _field(member: Member, at: str, bodies: dict[str, str], buffers: list[str]) -> str:
    if member.length:
        items = [_one(member, f"{at}[{k}]", bodies, buffers) for k in range(member.length)]
        return f"{{{', '.join(items)}}}"
    return _one(member, at, bodies, buffers)


def _one(member: Member, at: str, bodies: dict[str, str], buffers: list[str]) -> str:
    if member.pointer:
        number = len(buffers) + 1
        buffers.append(f"{member.qualifiers}{member.kind}* buffer{number} [[buffer({number})]]")
        return f"{at} ? buffer{number} : nullptr"
    if member.kind in SCALARS:
        return at
    return _record(bodies[member.kind], f"{at}.", bodies, buffers)
