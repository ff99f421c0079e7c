"""Which test ran which line, and for how long: pytest-cov's data, and pytest's report beside it."""

from __future__ import annotations

import ast
from collections import defaultdict
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

from changes import ROOT, Mutant

MAX_SECONDS = 60.0
"""Tests of a change, by the time that they took without it; the quick ones come first."""


class Traces:
    def __init__(self, folder: Path) -> None:
        from coverage import CoverageData  # only `make mutants` installs it

        self._data = CoverageData(str(folder / "coverage"))
        self._data.read()
        self._seconds: defaultdict[str, float] = defaultdict(float)
        for report in sorted(folder.glob("junit*.xml")):
            for case in ElementTree.parse(report).iter("testcase"):
                if not len(case):  # neither failed nor skipped
                    self._seconds[f"{case.attrib['classname']}::{case.attrib['name']}"] = float(case.attrib["time"])

    def tests_of(self, mutant: Mutant, mirror: str) -> list[str]:
        """The tests that ran the line. Where none did, as on import, those that ran the lines which use its name, or
        any line of its file; where none did that, as in a child process, those that mirror its folder."""
        contexts = self._contexts(mutant.file)
        among = [contexts.get(line, set()) for line in lines_of(mutant)]
        here = set().union(*among) or set().union(*contexts.values())
        others = set[str]()
        if not here or mutant.file.startswith("gsopt/data/sfm"):  # mostly a child process
            others = {test for file in self._data.measured_files() for test in self._tests(file, mirror)} - here
        tests, seconds = [], 0.0
        for test in (*sorted(here, key=self.seconds), *sorted(others, key=self.seconds)):
            seconds += self.seconds(test)
            if tests and seconds > MAX_SECONDS:
                break
            tests.append(test)
        return tests

    def seconds(self, test: str) -> float:
        """The time that a test took; one that did not pass comes last."""
        path, _, name = test.partition("::")
        return self._seconds.get(f"{path.removesuffix('.py').replace('/', '.')}::{name}", MAX_SECONDS)

    @cache  # noqa: B019 (one object per campaign)
    def _contexts(self, file: str) -> dict[int, set[str]]:
        measured = next((name for name in self._data.measured_files() if name.endswith(f"/{file}")), "")
        lines = self._data.contexts_by_lineno(measured) if measured else {}
        return {line: {name.rpartition("|")[0] for name in names if name} for line, names in lines.items()}

    @cache  # noqa: B019
    def _tests(self, file: str, mirror: str) -> set[str]:
        names = {name.rpartition("|")[0] for names in self._data.contexts_by_lineno(file).values() for name in names}
        return {name for name in names if name.startswith(mirror)}


def lines_of(mutant: Mutant) -> set[int]:
    """Lines that run whenever the change matters: its statement's, or for one that runs on import those which use its
    name, or the body of its function."""
    tree = ast.parse((ROOT / mutant.file).read_bytes())
    path = _path(tree, mutant.line)
    functions = [node for node in path if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    if functions and mutant.line >= functions[-1].body[0].lineno:
        first, last = path[-1].lineno, mutant.line if hasattr(path[-1], "body") else path[-1].end_lineno or mutant.line
        return {*range(first, last + 1)}
    if functions:
        return {line.lineno for line in functions[-1].body}
    names = {
        node.id
        for stmt in path
        for node in ast.walk(stmt)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
    }
    used = (node for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load))
    return {node.lineno for node in used if node.id in names}


def _path(tree: ast.AST, line: int) -> list[ast.stmt]:
    """The statements around a line, the innermost last."""
    around = [node for node in ast.walk(tree) if isinstance(node, ast.stmt) and _spans(node, line)]
    return sorted(around, key=lambda node: node.lineno)


def _spans(node: ast.stmt, line: int) -> bool:
    return node.lineno <= line <= (node.end_lineno or node.lineno)
