"""Changes of one place of a module: another operator, another number, a call left out."""

from __future__ import annotations

import ast
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SWAPS: dict[type, str] = {
    ast.Lt: "<=",
    ast.LtE: "<",
    ast.Gt: ">=",
    ast.GtE: ">",
    ast.Eq: "!=",
    ast.NotEq: "==",
    ast.Is: "is not",
    ast.IsNot: "is",
    ast.Add: "-",
    ast.Sub: "+",
    ast.Mult: "/",
    ast.Div: "*",
    ast.And: "or",
    ast.Or: "and",
}
CALLS = {"min": "max", "max": "min", "any": "all", "all": "any"}
HARMLESS_KEYWORDS = {
    "frozen": "forbids what no code does",
    "slots": "saves memory",
    "kw_only": "forbids what no code does",
    "indent": "the layout of JSON",
    "strict": "of zip: an internal check of what this code has made equally long",
    "stacklevel": "the line that a warning names",
}
"""Arguments whose change alters nothing that the product promises, and why."""
HARMLESS_CALLS = {
    "print": "what a command prints while it works",
    "filterwarnings": "what a package prints",
    "simplefilter": "what a package prints",
}
"""Statements whose absence alters nothing that the product promises, and why."""
OTHER_PLATFORMS = ("== 'win32'", "== 'darwin'", "== 'nt'")
"""Branches for these do not run where the changes are made."""


ROUND_LIMIT = 100
"""A round limit from here on moves by one percent at most when one is added."""


@dataclass(frozen=True)
class Mutant:
    """One change: the text between two positions of a file's bytes, and what takes its place."""

    file: str
    line: int
    start: int
    end: int
    old: str
    new: str


class Source:
    """A file's bytes, by the lines and columns of its tree."""

    def __init__(self, file: Path) -> None:
        self.name = str(file.relative_to(ROOT))
        self.bytes = file.read_bytes()
        self._starts = [0, *(i + 1 for i, byte in enumerate(self.bytes) if byte == ord("\n"))]

    def start(self, node: ast.expr) -> int:
        return self._starts[node.lineno - 1] + node.col_offset

    def end(self, node: ast.expr) -> int:
        return self._starts[(node.end_lineno or 0) - 1] + (node.end_col_offset or 0)

    def replaced(self, node: ast.expr, start: int, end: int, new: str) -> Mutant:
        return Mutant(self.name, node.lineno, start, end, self.bytes[start:end].decode(), new)

    def between(self, left: ast.expr, right: ast.expr, new: str) -> Mutant:
        """Another operator; parentheses around it stay."""
        start, end = self.end(left), self.start(right)
        gap = self.bytes[start:end].decode()
        opening = gap[len(gap.rstrip(" (\n")) :] or " "
        closing = gap[: len(gap) - len(gap.lstrip(" )\n"))] or " "
        return self.replaced(left, start, end, f"{closing}{new}{opening}")


def mutants_of(file: Path) -> Iterator[Mutant]:
    """Every change of one file that could do harm."""
    source = Source(file)
    tree = ast.parse(source.bytes)
    left_alone = {id(inner) for found in _harmless(tree) for inner in ast.walk(found)}
    for node in ast.walk(tree):
        if id(node) not in left_alone:
            yield from (*_operators(node, source), *_values(node, source))


def _operators(node: ast.AST, source: Source) -> Iterator[Mutant]:
    match node:
        case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in SWAPS:
            yield source.between(left, right, SWAPS[type(op)])
        case ast.BinOp(left=left, op=op, right=right) if type(op) in SWAPS and not _text(left, right):
            yield source.between(left, right, SWAPS[type(op)])
        case ast.BoolOp(op=op, values=[left, right]):
            yield source.between(left, right, SWAPS[type(op)])
        case ast.UnaryOp(op=ast.Not()):
            yield source.replaced(node, source.start(node), source.start(node) + len("not"), "True and")


def _values(node: ast.AST, source: Source) -> Iterator[Mutant]:
    match node:
        case ast.Constant(value=bool() as value):
            yield source.replaced(node, source.start(node), source.end(node), str(not value))
        case ast.Constant(value=int() | float() as value) if value + 1 != value:  # a float from 2^53 on swallows it
            yield source.replaced(node, source.start(node), source.end(node), repr(value + 1))
        case ast.Call(func=ast.Name(id=name)) if name in CALLS:
            yield source.replaced(node, source.start(node), source.start(node) + len(name), CALLS[name])
        case ast.Expr(value=ast.Call() as call):
            yield source.replaced(call, source.start(call), source.end(call), "pass")


def _harmless(tree: ast.AST) -> Iterator[ast.AST]:
    """Annotations, which nothing runs; messages; what the lists above name."""
    for node in ast.walk(tree):
        match node:
            case ast.arg(annotation=ast.expr() as hint) | ast.AnnAssign(annotation=hint):
                yield hint
            case ast.FunctionDef(returns=ast.expr() as hint):
                yield hint
            case ast.Raise() | ast.JoinedStr():
                yield node
            case ast.keyword(arg=str() as name) if name in HARMLESS_KEYWORDS:
                yield node
            case ast.Expr(value=ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name))) if name in HARMLESS_CALLS:
                yield node
            case ast.Assign(targets=[ast.Name(id=name)], value=ast.Constant(value=int() | float() as value)) if (
                name.isupper() and value >= ROUND_LIMIT and (value % 50 == 0 or math.log2(value).is_integer())
            ):
                yield node
            case ast.If(test=test, body=body) if any(word in ast.unparse(test) for word in OTHER_PLATFORMS):
                yield from (test, *body)
            case ast.If(test=ast.Name(id="TYPE_CHECKING") | ast.Compare(left=ast.Name(id="__name__"))):
                yield node


def _text(*sides: ast.expr) -> bool:
    return any(isinstance(side, ast.JoinedStr | ast.Constant) and not _is_number(side) for side in sides)


def _is_number(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, int | float)
