"""Laws of the command line that hold for every verb."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

import gsopt
from gsopt import cli
from gsopt.errors import GsoptError, InputError, MissingDependency, NumericalError, UsageError


@pytest.fixture
def verb_that(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], int]], None]:
    """Puts a function in place of the verb `train`."""

    def install(act: Callable[[], int]) -> None:
        module = ModuleType("gsopt.cli.train")
        module.main = lambda argv: act()  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "gsopt.cli.train", module)

    return install


def raiser(error: BaseException) -> Callable[[], int]:
    def act() -> int:
        raise error

    return act


@pytest.mark.parametrize("kind", [GsoptError, UsageError, InputError, NumericalError, MissingDependency])
def test_an_error_becomes_its_message_and_its_exit_code(verb_that, capsys, kind: type[GsoptError]) -> None:
    verb_that(raiser(kind("what, got. Do this.")))
    assert cli.main(["train"]) == kind.exit_code != 0
    out, err = capsys.readouterr()
    assert "what, got. Do this." in err
    assert "Traceback" not in err
    assert out == ""


@pytest.mark.parametrize(
    ("stop", "code"),
    [(KeyboardInterrupt(), 130), (SystemExit(None), 0), (SystemExit(2), 2), (SystemExit("text"), 1)],
)
def test_interrupts_and_parser_exits_become_exit_codes(verb_that, stop: BaseException, code: int) -> None:
    verb_that(raiser(stop))
    assert cli.main(["train"]) == code


def test_a_bug_is_not_hidden(verb_that) -> None:
    verb_that(raiser(ZeroDivisionError()))
    with pytest.raises(ZeroDivisionError):
        cli.main(["train"])


@pytest.mark.parametrize(("typed", "meant"), [("trian", "train"), ("rendr", "render"), ("docter", "doctor")])
def test_a_misspelt_verb_is_named_and_mended(capsys, typed: str, meant: str) -> None:
    assert cli.main([typed]) == 2
    err = capsys.readouterr().err
    assert repr(typed) in err
    assert meant in err


@pytest.mark.parametrize("argv", [[], ["zzzz"], ["--zzzz"], ["__init__"], ["../../"]])
def test_what_is_no_verb_lists_all_verbs(capsys, argv: list[str]) -> None:
    assert cli.main(argv) == 2
    err = capsys.readouterr().err
    assert all(verb in err for verb in cli.VERBS)


@pytest.mark.parametrize("verb", cli.VERBS)
def test_a_wrong_flag_is_a_usage_error(capsys, verb: str) -> None:
    assert cli.main([verb, "--no-such-flag-exists"]) == 2
    assert f"gsopt {verb} --help" in capsys.readouterr().err


@pytest.mark.parametrize("verb", cli.VERBS)
def test_help_of_a_verb_names_the_verb(capsys, verb: str) -> None:
    assert cli.main([verb, "--help"]) == 0
    assert f"gsopt {verb}" in capsys.readouterr().out


def test_python_dash_m_is_the_same_program(root: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "gsopt", "--version"], cwd=root, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, f"gsopt {gsopt.__version__}\n")


@pytest.mark.parametrize("argv", [["--help"], ["train", "--help"]])
def test_a_closed_pipe_is_not_a_traceback(root: Path, argv: list[str]) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-m", "gsopt", *argv], cwd=root, stdout=writer, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, "")
