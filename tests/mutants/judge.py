"""Runs tests on a copy of the tree with one change, each time in a fork of a process that has imported the packages."""

from __future__ import annotations

import importlib
import os
import resource
import shutil
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

import pytest
from changes import ROOT, Mutant

PACKAGES = ("numpy", "torch", "PIL.Image", "hypothesis", "safetensors.torch", "plyfile", "jaxtyping", "rich.console")
LONGEST_SECONDS = 300
"""For the tests of one change, which take half of it at most without the change."""
UNINSTALLED = (
    "import sys; sys.meta_path[:] = [finder for finder in sys.meta_path if 'Inplace' not in type(finder).__name__]"
)
"""An editable install finds the checkout's modules before those of PYTHONPATH, in every process."""
MEMORY = 12 << 30
"""A change may ask for any amount."""


class FirstFailure:
    """A plugin of pytest: runs the named tests, or files of them, in order, and writes down the first that fails."""

    def __init__(self, tests: list[str], note: Path) -> None:
        self._ranks, self._note = {name: rank for rank, name in enumerate(tests)}, note

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        ranks = {item: self._ranks.get(item.nodeid, self._ranks.get(_file(item.nodeid), -1)) for item in items}
        items[:] = sorted((item for item in items if ranks[item] >= 0), key=ranks.__getitem__)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.note(report)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        self.note(report)

    def note(self, report: pytest.TestReport | pytest.CollectReport) -> None:
        if report.failed and not self._note.exists():
            self._note.write_text(report.nodeid)


class Judge:
    def __init__(self, copy: Path) -> None:
        self._copy, self._sound, self._unsound = copy, set[str](), set[str]()
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", ".venv", "build", "dist", "runs"))
        for name in PACKAGES:
            importlib.import_module(name)
        (copy / "sitecustomize.py").write_text(UNINSTALLED)
        exec(UNINSTALLED)
        sys.path.insert(0, str(copy))
        sys.dont_write_bytecode = True
        os.environ.update(PYTHONPATH=str(copy), PYTHONDONTWRITEBYTECODE="1")
        os.chdir(copy)

    def noticed_by(self, mutant: Mutant, tests: list[str]) -> str:
        """The test that fails with the change and passes without, or the time limit; empty when all tests pass."""
        path = self._copy / mutant.file
        whole = path.read_bytes()
        while tests := [test for test in tests if test not in self._unsound]:
            path.write_bytes(whole[: mutant.start] + mutant.new.encode() + whole[mutant.end :])
            try:
                failed = self._first_failure(tests)
            finally:
                path.write_bytes(whole)
            if not failed or failed.endswith(" s") or self._passes(failed):
                return failed
        return ""

    def _passes(self, test: str) -> bool:
        """Does a test, or a file of tests, pass without a change?"""
        if test not in self._sound | self._unsound:
            (self._unsound if self._first_failure([test]) else self._sound).add(test)
        return test in self._sound

    def _first_failure(self, tests: list[str]) -> str:
        note = self._copy.with_name("first_failure")
        note.unlink(missing_ok=True)
        child = os.fork()
        if child == 0:
            self._run(tests, note)
        began, ended = time.monotonic(), 0
        while not ended and time.monotonic() - began < LONGEST_SECONDS:
            time.sleep(0.05)
            ended, status = os.waitpid(child, os.WNOHANG)
        with suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # and whatever the tests have started
        if not ended:
            os.waitpid(child, 0)
            return f"{LONGEST_SECONDS} s"
        if note.exists():
            return note.read_text()
        return "" if status == 0 else tests[0]

    def _run(self, tests: list[str], note: Path) -> NoReturn:
        os.setsid()
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        output = os.open(note.with_name("output"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        files = dict.fromkeys(_file(test) for test in tests)
        assert "gsopt" not in sys.modules
        code = pytest.main(["-x", "-q", "-p", "no:cacheprovider", *files], plugins=[FirstFailure(tests, note)])
        os._exit(0 if code == pytest.ExitCode.NO_TESTS_COLLECTED else int(code))


def _file(test: str) -> str:
    return test.partition("::")[0]
