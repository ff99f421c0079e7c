"""House rules that can be read off the source: size, banned calls, error texts."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from types import UnionType

import pytest

import gsopt.errors

LONGEST_FILE = 400
MOST_STATEMENTS = 40
CODE = {".py", ".cpp", ".h"}
BANNED_MODULES = {"pickle", "cPickle", "dill", "joblib", "marshal", "shelve"}
BANNED_CALLS = {"eval", "exec"}
BANNED_ATTRIBUTES = {"nan_to_num", "nan_to_num_"}
BINDERS = ast.Name | ast.arg
INLINED = ast.ListComp | ast.SetComp | ast.DictComp
ERRORS = {name for name, thing in vars(gsopt.errors).items() if isinstance(thing, type)}
# Raised by protocol of the language, not by mistake: __getattr__ and the way out of a program.
OTHER_RAISES = {"AttributeError", "SystemExit", "KeyboardInterrupt"}


def shipped(root: Path, tracked: list[Path]) -> list[Path]:
    """Python that runs at a user's: everything but tests."""
    return [file for file in tracked if file.suffix == ".py" and not file.is_relative_to(root / "tests")]


def parse(source: str) -> ast.Module:
    return ast.parse(source)


def statements(function: ast.AST) -> int:
    """Statements in a function, those of inner functions included, its docstrings not."""
    inside = [node for node in ast.walk(function) if isinstance(node, ast.stmt) and node is not function]
    return sum(not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)) for node in inside)


def long_functions(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and statements(node) > MOST_STATEMENTS:
            yield f"{node.name}: {statements(node)} statements"


def banned(tree: ast.Module) -> Iterator[str]:
    """Calls and imports that run code out of data or hide a value that is not finite."""
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=names):
                yield from (name.name for name in names if name.name.partition(".")[0] in BANNED_MODULES)
            case ast.ImportFrom(module=str(module)) if module.partition(".")[0] in BANNED_MODULES:
                yield module
            case ast.Call(func=ast.Name(id=name)) if name in BANNED_CALLS:
                yield f"{name}()"
            case ast.Attribute(attr=name) if name in BANNED_ATTRIBUTES:
                yield name
            case ast.keyword(arg="allow_pickle", value=value) if ast.unparse(value) != "False":
                yield "allow_pickle"
            case ast.Call(func=ast.Attribute(value=ast.Name(id="torch"), attr="load")):
                yield "torch.load"


def any_format(tree: ast.Module) -> Iterator[str]:
    """Images opened by whichever decoder claims them: Pillow's for EPS starts Ghostscript."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("Image.open"):
            formats = [keyword.value for keyword in node.keywords if keyword.arg == "formats"]
            if not formats or ast.unparse(formats[0]) == "None":
                yield ast.unparse(node)


def two_meanings(tree: ast.Module) -> Iterator[str]:
    """Names that one comprehension of a function binds and another takes from outside: CPython 3.12.1 mixes them up."""
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            found = list(outermost(function, INLINED))
            inside = {id(node) for comprehension in found for node in ast.walk(comprehension)}
            kept = {id(node.target) for node in ast.walk(function) if isinstance(node, ast.NamedExpr)}
            outside = [node for node in ast.walk(function) if id(node) not in inside - kept]
            own = {node.id if isinstance(node, ast.Name) else node.arg for node in outside if isinstance(node, BINDERS)}
            bound = [names_of(*bindings_in(comprehension)) for comprehension in found]
            free = [names_of(comprehension) - names for comprehension, names in zip(found, bound, strict=True)]
            yield from sorted(set().union(*bound) & set().union(*free) - own)


def outermost(node: ast.AST, kinds: type | UnionType) -> Iterator[ast.AST]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, kinds):
            yield child
        else:
            yield from outermost(child, kinds)


def names_of(*nodes: ast.AST) -> set[str]:
    return {name.id for node in nodes for name in ast.walk(node) if isinstance(name, ast.Name)}


def bindings_in(node: ast.AST) -> Iterator[ast.expr]:
    """Targets of the comprehensions in an expression."""
    return (inner.target for inner in ast.walk(node) if isinstance(inner, ast.comprehension))


def message(call: ast.Call) -> str | None:
    """The text of an error with its values as `{}`, or None for a text built elsewhere."""
    if not call.args:
        return ""
    match call.args[0]:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=parts):
            return "".join(part.value if isinstance(part, ast.Constant) else "{}" for part in parts)
    return None


def says_what_got_do(text: str) -> bool:
    """Two sentences at least: what was wrong with what was got, then what to do."""
    sentences = [part for part in re.split(r"(?<=[.!?;:])\s+", text.strip()) if part]
    return len(sentences) >= 2


def raises(tree: ast.AST) -> Iterator[tuple[str, ast.Call]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and isinstance(node.exc.func, ast.Name):
            yield node.exc.func.id, node.exc


def curt_messages(tree: ast.Module) -> Iterator[str]:
    for kind, call in raises(tree):
        text = message(call)
        if kind in ERRORS and text is not None and not says_what_got_do(text):
            yield text


def caught_in_place(tree: ast.Module) -> set[ast.Call]:
    """Errors raised in a `try` whose own handler turns them into something else."""
    caught: set[ast.Call] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Try):
            kinds = {ast.unparse(kind) for handler in node.handlers if handler.type for kind in ast.walk(handler.type)}
            body = ast.Module(body=node.body, type_ignores=[])
            caught |= {call for kind, call in raises(body) if kind in kinds}
    return caught


def in_private_functions(tree: ast.Module) -> set[ast.Call]:
    """Errors of functions named _so, which the public function that calls them turns into something else."""
    functions = (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and re.match("_[^_]", node.name))
    return {call for function in functions for _, call in raises(function)}


def foreign_raises(tree: ast.Module) -> Iterator[str]:
    """Exceptions of Python that a public function raises, where its caller should get a GsoptError."""
    inside = caught_in_place(tree) | in_private_functions(tree)
    for kind, call in raises(tree):
        if kind.endswith("Error") and kind not in ERRORS | OTHER_RAISES and call not in inside:
            yield kind


def test_no_file_is_longer_than_a_reader_holds(root: Path, tracked: list[Path]) -> None:
    code = [file for file in tracked if file.suffix in CODE]
    lengths = {str(file.relative_to(root)): len(file.read_text(encoding="utf-8").splitlines()) for file in code}
    assert {name: length for name, length in lengths.items() if length > LONGEST_FILE} == {}
    assert len(lengths) > 20


def found_in(files: list[Path], root: Path, rule) -> list[str]:
    trees = ((file, parse(file.read_text(encoding="utf-8"))) for file in files)
    return [f"{file.relative_to(root)}: {finding}" for file, tree in trees for finding in rule(tree)]


def test_no_function_is_longer_than_forty_statements(root: Path, tracked: list[Path]) -> None:
    assert found_in([file for file in tracked if file.suffix == ".py"], root, long_functions) == []


@pytest.mark.parametrize("rule", [banned, any_format, curt_messages, two_meanings], ids=lambda rule: rule.__name__)
def test_shipped_python_keeps_the_rule(root: Path, tracked: list[Path], rule) -> None:
    assert found_in(shipped(root, tracked), root, rule) == []


def test_gsopt_raises_its_own_errors(root: Path, tracked: list[Path]) -> None:
    files = [file for file in shipped(root, tracked) if file.is_relative_to(root / "gsopt")]
    assert found_in(files, root, foreign_raises) == []


@pytest.mark.parametrize(
    ("rule", "source"),
    [
        (banned, "import pickle"),
        (banned, "from torch import load, nan_to_num\ntorch.nan_to_num(x)"),
        (banned, "from pickle import loads"),
        (banned, "eval(text)"),
        (banned, "np.load(path, allow_pickle=True)"),
        (banned, "torch.load(path)"),
        (any_format, "with Image.open(path) as image:\n    pass"),
        (any_format, "PIL.Image.open(path, formats=None)"),
        (curt_messages, "raise UsageError('Bad value')"),
        (curt_messages, "raise InputError(f'Bad value, got {x}.')"),
        (foreign_raises, "def public():\n    raise ValueError('x')"),
        (foreign_raises, "try:\n    raise ValueError('x')\nexcept OSError:\n    pass"),
        (two_meanings, "def f(a):\n    return [x for x in a], [x(y) for y in a]"),
        (two_meanings, "def f(a):\n    b = {x for x in a}\n    return {y: x for y in b}"),
        (long_functions, "def f():\n" + "    x = 1\n" * 41),
    ],
)
def test_a_rule_notices_what_breaks_it(rule, source: str) -> None:
    assert list(rule(parse(source))) != []


@pytest.mark.parametrize(
    ("rule", "source"),
    [
        (banned, "model.eval()\nnp.load(path, allow_pickle=False)\nevaluate(x)"),
        (any_format, "Image.open(path, formats=IMAGE_FORMATS)\nopen(path)"),
        (curt_messages, "raise UsageError(f'`--n` must be at least 1, got {n}. Drop the flag.')"),
        (foreign_raises, "def _private():\n    raise ValueError('x')"),
        (foreign_raises, "raise\nraise error\nraise InputError('x')"),
        (
            foreign_raises,
            "try:\n    raise ValueError('x')\nexcept (OSError, ValueError) as e:\n    raise InputError() from e",
        ),
        (two_meanings, "def f(a):\n    return [x for x in a], [x for x in a if x], list(x(y) for y in a)"),
        (two_meanings, "def f(a):\n    for x in a:\n        g([x for x in a], [x(y) for y in a])"),
        (two_meanings, "def f(a, x):\n    return [x for x in a], [x(y) for y in a]"),
        (two_meanings, "def f(a):\n    return [[b(x, y) for y in a] for x in a]"),
        (two_meanings, "def f(a):\n    b = [x for y in a if (x := y)]\n    return [x for x in b]"),
        (two_meanings, "def f(a):\n    return [y(x) for x in [z for z in a]]"),
        (long_functions, "def f():\n    '''Doc.'''\n" + "    x = 1\n" * 40),
    ],
)
def test_a_rule_lets_pass_what_keeps_it(rule, source: str) -> None:
    assert list(rule(parse(source))) == []
