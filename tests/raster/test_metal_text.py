"""The kernels' text for Apple's GPUs, checked without a Mac by the front end that Metal's compiler was made of: clang.

It reads the text as C++ for OpenCL, in which, as in Metal, a pointer or a reference to memory of the GPU, of a block,
of a thread and of constants are four types that do not convert into each other. `metal` of test_backends_agree.py and
test_stress.py runs the same text.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator

import pytest
from clang.cindex import Cursor, CursorKind, Index, TranslationUnit
from fake_mps import BLOCK_BYTES, HEAD, METAL

from gsopt.raster.device.layout import kernels
from gsopt.raster.device.metal import MAX_BUFFERS, metal_program
from gsopt.raster.device.runtime import THREADS
from gsopt.raster.device.source import program

OPENCL = ["-x", "clcpp", "-cl-std=clc++2021", "-target", "spir64", "-cl-no-stdinc", "-Wno-unknown-attributes"]
NO_DOUBLE = ["-Xclang", "-cl-ext=-cl_khr_fp64,-__opencl_c_fp64"]
UNUSED = "-Wno-unused-const-variable"
CHECKED = f"-I{METAL / 'checked'}"
DECLARED = (CursorKind.PARM_DECL, CursorKind.VAR_DECL, CursorKind.FIELD_DECL)
FUNCTIONS = (
    CursorKind.FUNCTION_DECL,
    CursorKind.CXX_METHOD,
    CursorKind.CONSTRUCTOR,
    CursorKind.FUNCTION_TEMPLATE,
)


def parsed(text: str, *options: str) -> TranslationUnit:
    return Index.create().parse("k.metal", args=[*options, CHECKED], unsaved_files=[("k.metal", text)])


def problems(text: str) -> list[str]:
    """The errors and warnings that clang finds in the text."""
    return [str(found) for found in parsed(text, *OPENCL, *NO_DOUBLE, "-Wall", "-Wextra", UNUSED).diagnostics]


@functools.cache
def tree() -> TranslationUnit:
    return parsed(metal_program(), *OPENCL, *NO_DOUBLE)


def every(*kinds: CursorKind) -> Iterator[Cursor]:
    return (cursor for cursor in tree().cursor.walk_preorder() if cursor.kind in kinds)


def calls(function: Cursor) -> Iterator[Cursor]:
    return (cursor for cursor in function.walk_preorder() if cursor.kind is CursorKind.CALL_EXPR)


def test_every_pointer_keeps_to_its_memory() -> None:
    assert problems(metal_program()) == []


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("SHARED Row rows[kSegment];", "Row rows[kSegment];"),
        ("IN_BLOCK const Row& row = rows[j];", "thread const Row& row = rows[j];"),
        ("GLOBAL const float* shN = P.shN", "thread const float* shN = P.shN"),
        ("float param = of.param[i]", "float param = 0.0 * of.param[i]"),
        ("pull[t] = {};", "pull[t] = 0;"),
    ],
)
def test_the_check_sees_what_is_wrong(right: str, wrong: str) -> None:
    assert right in metal_program()
    assert problems(metal_program().replace(right, wrong))


def test_every_pointer_names_its_memory() -> None:
    """clang calls the memory of an unmarked one generic; Metal refuses it."""
    named = [cursor.type.spelling for cursor in every(*DECLARED)]
    assert sum("*" in name or "&" in name for name in named) > 200
    assert [name for name in named if "__generic" in name] == []


def test_only_a_threads_own_things_have_functions() -> None:
    """A function of a struct is one of the thread's memory, unless it says otherwise."""
    with_functions = {
        cursor.semantic_parent.spelling for cursor in every(CursorKind.CXX_METHOD) if not cursor.is_default_method()
    }
    assert {"Tile", "Channel", "Own<T>"} <= with_functions | {"Own<T>"}
    for cursor in every(*DECLARED):
        pointee = cursor.type.get_pointee().spelling or cursor.type.spelling
        if "__global" in pointee or "__local" in pointee:
            assert not with_functions & set(re.findall(r"\w+", pointee)), cursor.spelling


def test_nothing_calls_itself_and_nothing_is_a_lambda() -> None:
    """Metal has no stack to speak of, and no lambdas before macOS 15."""
    called = {
        function.get_usr(): {call.referenced.get_usr() for call in calls(function) if call.referenced}
        for function in every(*FUNCTIONS)
        if function.is_definition()
    }
    assert sum(map(len, called.values())) > 100
    reached = called
    for _ in called:
        reached = {
            name: inner.union(*(reached.get(other, set()) for other in inner)) for name, inner in reached.items()
        }
    assert [name for name, inner in reached.items() if name in inner] == []
    assert not list(every(CursorKind.LAMBDA_EXPR))


def test_the_text_is_ascii_and_needs_no_cpp17() -> None:
    """torch hands it on as ASCII, and macOS 14 compiles it as C++14."""
    assert metal_program().isascii()
    plain = [f"-D{word}=" for word in ("__global", "__local", "__private", "kernel", "constant")]
    unit = parsed(metal_program(), "-x", "c++", "-std=c++14", "-Wpedantic", "-Wno-unknown-attributes", *plain)
    assert [str(found) for found in unit.diagnostics if "extension" in str(found)] == []


def test_a_block_fits_into_its_memory() -> None:
    shared: dict[str, int] = {}
    for kernel in every(CursorKind.FUNCTION_DECL):
        variables = [inner for inner in kernel.walk_preorder() if inner.kind is CursorKind.VAR_DECL]
        sizes = [
            inner.type.get_size() for inner in variables if "__local" in inner.type.spelling.split("*")[0].split("&")[0]
        ]
        shared[kernel.spelling] = sum(sizes)
    assert all(shared[name] <= BLOCK_BYTES for name in kernels(program()))
    assert shared["blend"] > 48 * THREADS
    assert shared["blend_backward"] > 20_000


def test_every_kernel_has_its_buffers() -> None:
    heads = dict(HEAD.findall(metal_program()))
    assert set(heads) == set(kernels(program()))
    for name, head in heads.items():
        numbers = [int(number) for number in re.findall(r"\[\[buffer\((\d+)\)\]\]", head)]
        assert numbers == list(range(len(numbers))), name
        assert len(numbers) <= MAX_BUFFERS, name
