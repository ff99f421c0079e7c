"""A campaign of changes, from its command line, on a project of one module."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).resolve().parent
MODULE = """def double(x):
    return x * 2


def answer():
    return 41
"""
TEST = """from gsopt.events import answer, double


def test_a_double_is_twice_as_much():
    assert double(3) == 6


def test_an_answer_is_a_number():
    assert isinstance(answer(), int)
"""
COVERAGE = """class CoverageData:
    def __init__(self, path):
        pass

    def read(self):
        pass

    def measured_files(self):
        return ["/elsewhere/gsopt/events.py"]

    def contexts_by_lineno(self, file):
        tests = "tests/test_events.py::"
        return {2: [f"{tests}test_a_double_is_twice_as_much|run"], 6: [f"{tests}test_an_answer_is_a_number|run"]}
"""
"""Stands in for the package, which `make test` does without: which test ran which line."""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A copy of the tool over a module with two places that one test checks, and one that none does. It has settings
    of its own: without them pytest takes those of any folder above, and names the tests from there."""
    files = {
        "pyproject.toml": "[tool.pytest.ini_options]\n",
        "gsopt/__init__.py": "",
        "gsopt/events.py": MODULE,
        "tests/test_events.py": TEST,
        "tests/mutants/coverage.py": COVERAGE,
    }
    for name, content in files.items():
        (tmp_path / "project" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "project" / name).write_text(content)
    for file in ("mutate.py", "changes.py", "judge.py", "traces.py"):
        shutil.copy(TOOL / file, tmp_path / "project" / "tests" / "mutants")
    (tmp_path / "here").mkdir()
    return tmp_path / "project"


def mutate(project: Path, *arguments: str) -> str:
    """Runs the tool in a folder beside the project."""
    command = [sys.executable, project / "tests" / "mutants" / "mutate.py", *arguments]
    here = project.with_name("here")
    env = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST_", "COV_"))}
    done = subprocess.run(command, cwd=here, capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 0, done.stderr
    return done.stdout


def outcomes(project: Path) -> list[dict[str, object]]:
    return list(json.loads((project.with_name("here") / "outcomes.json").read_text())["outcomes"])


def test_a_campaign_goes_on_and_names_the_change_that_no_test_checks(project: Path) -> None:
    """Outcomes stand where the command was given: the tool works in a copy of the project, in another folder."""
    options = ("--seed", "1", "--json", "outcomes.json", "--traces", "traces")
    assert "of 2 noticed, of 3 possible" in mutate(project, *options, "--count", "2")
    first = outcomes(project)
    assert len(first) == 2
    mutate(project, *options, "--count", "9")
    found = outcomes(project)
    assert found[:2] == first
    assert {(one["line"], one["old"], bool(one["noticed_by"])) for one in found} == {
        (2, " * ", True),
        (2, "2", True),
        (6, "41", False),
    }
    assert (project / "gsopt" / "events.py").read_text() == MODULE


def test_a_change_that_no_test_checks_is_printed(project: Path) -> None:
    printed = mutate(project, "gsopt/events.py", "--count", "9", "--traces", "traces").splitlines()
    assert printed[:-1] == ["gsopt/events.py:6: '41' became '42': none of 1 tests noticed"]
    assert printed[-1].startswith("2 of 3 noticed, of 3 possible")


def test_named_tests_meet_every_change_without_a_trace(project: Path) -> None:
    (project / "tests" / "mutants" / "coverage.py").unlink()
    (project / "tests" / "test_other.py").write_text("from test_events import test_a_double_is_twice_as_much\n")
    printed = mutate(project, "gsopt/events.py", "--count", "9", "--tests", "tests/test_other.py").splitlines()
    assert printed[0] == "gsopt/events.py:6: '41' became '42': none of 1 tests noticed"
    assert printed[-1].startswith("2 of 3 noticed, of 3 possible")


def test_a_file_of_tests_that_is_not_there_is_told(project: Path) -> None:
    """None of no tests would notice anything."""
    with pytest.raises(AssertionError, match=r"no such file of tests: tests/other\.py"):
        mutate(project, "gsopt/events.py", "--tests", "tests/other.py")
