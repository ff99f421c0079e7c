"""Changes one place of the code at a time, at random, and looks whether a test notices: python mutate.py [options].

The changes are chosen by the seed alone, nobody picks them. The tests of a module are those that mirror its folder;
with `--traces` (see `make mutants`), those of their files that run the line, the quick ones first. Survivors are
printed with their line: a law is missing, or the change is harmless. A campaign that was cut goes on from its `--json`.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = {
    "gsopt/data/sfm": "tests/data/sfm",
    "gsopt/data": "tests/data",
    "gsopt/formats/mesh_files.py": "tests/results/mesh",
    "gsopt/formats": "tests/formats",
    "gsopt/training": "tests/training",
    "gsopt/sds": "tests/sds",
    "gsopt/symmetry": "tests/symmetry",
    "gsopt/init": "tests/init",
    "gsopt/results": "tests/results",
    "gsopt/events.py": "tests/test_events.py tests/training",
    "gsopt/metrics.py": "tests/test_metrics.py tests/training",
    "blender_addon/core": "tests/blender",
}
"""Modules, and the tests that mirror them."""
SWAPS: dict[type, str] = {
    ast.Lt: "<=",
    ast.LtE: "<",
    ast.Gt: ">=",
    ast.GtE: ">",
    ast.Eq: "!=",
    ast.NotEq: "==",
    ast.Add: "-",
    ast.Sub: "+",
    ast.Mult: "/",
    ast.Div: "*",
    ast.And: "or",
    ast.Or: "and",
}
IN_CHILDREN = ("gsopt/data/sfm",)
"""Modules that mostly run in a child process, which leaves no trace: all tests of their folder count."""
CALLS = {"min": "max", "max": "min", "any": "all", "all": "any"}
LONGEST_SECONDS = 900
NO_TESTS = 5
"""pytest's exit code."""


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
    """Every change of one file."""
    source = Source(file)
    tree = ast.parse(source.bytes)
    left_alone = {id(inner) for found in _never_run(tree) for inner in ast.walk(found)}
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
        case ast.Constant(value=int() | float() as value):
            yield source.replaced(node, source.start(node), source.end(node), repr(value + 1))
        case ast.Call(func=ast.Name(id=name)) if name in CALLS:
            yield source.replaced(node, source.start(node), source.start(node) + len(name), CALLS[name])
        case ast.Expr(value=ast.Call() as call):
            yield source.replaced(call, source.start(call), source.end(call), "pass")


def _never_run(tree: ast.AST) -> Iterator[ast.AST]:
    """Annotations, which no test runs, and messages."""
    for node in ast.walk(tree):
        match node:
            case ast.arg(annotation=ast.expr() as hint) | ast.AnnAssign(annotation=hint):
                yield hint
            case ast.FunctionDef(returns=ast.expr() as hint):
                yield hint
            case ast.Raise() | ast.JoinedStr():
                yield node


def _text(*sides: ast.expr) -> bool:
    return any(isinstance(side, ast.JoinedStr | ast.Constant) and not _is_number(side) for side in sides)


def _is_number(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, int | float)


def changed_since(commit: str) -> list[Path]:
    """Modules that differ from a commit."""
    listed = subprocess.run(
        ["git", "diff", "--name-only", commit], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return [ROOT / name for name in listed.stdout.split() if (ROOT / name).is_file()]


def tests_of(file: str) -> list[str]:
    """The tests that mirror the module's folder; those named after the module come first."""
    folders = next((tests.split() for folder, tests in FOLDERS.items() if file.startswith(folder)), [])
    word = Path(file).stem.strip("_").split("_")[0]
    named = [str(test.relative_to(ROOT)) for folder in folders for test in (ROOT / folder).rglob(f"test_*{word}*.py")]
    return [*named, *folders]


class Traces:
    """Which files of tests ran which line, and for how long: pytest-cov's data, and pytest's report beside it."""

    def __init__(self, folder: Path) -> None:
        from coverage import CoverageData

        self._data = CoverageData(str(folder / "coverage"))
        self._data.read()
        self._seconds: defaultdict[str, float] = defaultdict(float)
        for case in ElementTree.parse(folder / "junit.xml").iter("testcase"):
            words = case.attrib["classname"].split(".")
            self._seconds["/".join(words) + ".py"] += float(case.attrib["time"])

    def tests_of(self, mutant: Mutant) -> list[str]:
        """The files of the module's tests that ran its line; where none did, as on import, those that ran any."""
        if mutant.file.startswith(IN_CHILDREN):
            return tests_of(mutant.file)
        contexts = next(
            (self._contexts(file) for file in self._data.measured_files() if file.endswith(mutant.file)), {}
        )
        places = tests_of(mutant.file)
        here = self._among(contexts.get(mutant.line, []), places)
        return here or self._among([test for tests in contexts.values() for test in tests], places) or places

    def _contexts(self, file: str) -> dict[int, list[str]]:
        return self._data.contexts_by_lineno(file)

    def _among(self, contexts: list[str], places: list[str]) -> list[str]:
        files = {context.partition("::")[0] for context in contexts}
        return sorted((file for file in files if file.startswith(tuple(places))), key=lambda file: self._seconds[file])


def noticed_by(mutant: Mutant, tests: list[str], copy: Path) -> str:
    """The test that fails, or the time limit, on a copy of the tree with this change; empty when all tests pass."""
    path = copy / mutant.file
    whole = path.read_bytes()
    path.write_bytes(whole[: mutant.start] + mutant.new.encode() + whole[mutant.end :])
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    env = {**os.environ, "PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            command, cwd=copy, env=env, capture_output=True, text=True, timeout=LONGEST_SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        return f"{LONGEST_SECONDS} s"
    finally:
        path.write_bytes(whole)
    if done.returncode == NO_TESTS:
        sys.exit(f"no tests in {' '.join(tests)}")
    named = [line.split()[1] for line in done.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    return "" if done.returncode == 0 else [*named, "import"][0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60, help="number of changes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--since", default="", help="only modules that differ from this commit")
    parser.add_argument("--json", type=Path, help="file for the outcome of every change; what it has is not done again")
    parser.add_argument("--traces", type=Path, help="folder with the coverage and junit.xml of the tests")
    parser.add_argument("--print-tests", action="store_true", help="print the folders of all tests, and end")
    options = parser.parse_args()
    if options.print_tests:
        print(*dict.fromkeys(" ".join(FOLDERS.values()).split()))
        return
    files = changed_since(options.since) if options.since else sorted(ROOT.rglob("*.py"))
    mutants = [m for file in files if tests_of(str(file.relative_to(ROOT))) for m in mutants_of(file)]
    chosen = random.Random(options.seed).sample(mutants, min(options.count, len(mutants)))
    outcomes, tests_for = resumed(options.json, options.seed), tests_of_file
    if options.traces:
        tests_for = Traces(options.traces).tests_of
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", ".venv", "build", "dist", "runs"))
        for mutant in chosen:
            known = next((outcome for outcome in outcomes if asdict(mutant).items() <= outcome.items()), None)
            if known is None:
                began = time.monotonic()
                found = noticed_by(mutant, tests_for(mutant), copy)
                known = {**asdict(mutant), "noticed_by": found, "seconds": round(time.monotonic() - began, 1)}
                outcomes.append(known)
                if options.json:
                    options.json.write_text(json.dumps({"seed": options.seed, "outcomes": outcomes}, indent=1) + "\n")
            if not known["noticed_by"]:
                print(f"{mutant.file}:{mutant.line}: {mutant.old!r} became {mutant.new!r}: no test noticed", flush=True)
    count = sum(bool(outcome["noticed_by"]) for outcome in outcomes)
    seconds = sum(outcome["seconds"] for outcome in outcomes)
    print(f"{count} of {len(outcomes)} noticed, of {len(mutants)} possible, {seconds:.0f} s")


def tests_of_file(mutant: Mutant) -> list[str]:
    """All tests of the module."""
    return tests_of(mutant.file)


def resumed(path: Path | None, seed: int) -> list[dict[str, Any]]:
    """The outcomes of a campaign that was cut."""
    if path is None or not path.exists():
        return []
    record = json.loads(path.read_text())
    return list(record["outcomes"]) if record["seed"] == seed else []


if __name__ == "__main__":
    main()
