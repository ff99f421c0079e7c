"""Laws of the command line that hold for every verb."""

from __future__ import annotations

import errno
import io
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

import gsopt
from gsopt import cli
from gsopt.cli.standard_streams import lasting
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


LONG = "x" * 300
DEEP = "/".join(["y" * 200] * 25)


@pytest.mark.parametrize("path", [LONG, DEEP])
@pytest.mark.parametrize(
    "argv",
    [
        "train PATH",
        "train DATA -m PATH",
        "train --resume -m PATH",
        "sfm PATH",
        "sfm DATA -o PATH",
        "render PATH",
        "eval PATH",
        "export PATH -o out.ply",
        "export PATH -o PATH",
        "view PATH",
        "finetune DATA -o PATH",
        "prompts generate --notes PATH",
        "prompts review PATH",
        "prompts compare DATA PATH",
        "demo -m PATH",
        "prompts generate --images PATH",
    ],
)
def test_a_name_too_long_for_the_system_is_one_line(
    argv: str, path: str, capfd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "DATA").mkdir()
    assert cli.main([path if word == "PATH" else word for word in argv.split()]) in (2, 3)
    assert "Traceback" not in capfd.readouterr().err


def test_what_the_system_refuses_is_one_line_with_the_name(verb_that, capsys) -> None:
    verb_that(raiser(OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG), "z" * 5000)))
    assert cli.main(["train"]) == InputError.exit_code
    err = capsys.readouterr().err
    assert err.startswith("gsopt: ")
    assert "File name too long" in err
    assert "zzz" in err
    assert err.count("\n") == 1
    assert len(err) < 400


PROGRAM = [sys.executable, "-m", "gsopt"]


def test_a_closed_stdout_is_no_stdout(root: Path, tmp_path: Path) -> None:
    """Nor does the next file that is opened become it."""
    for closed, argv, codes in (
        ("1>&-", ["--help"], (0,)),
        ("0<&- 1>&- 2>&-", ["export", str(tmp_path / "absent.ply"), "-o", "out.ply"], (2, 3)),
    ):
        command = ["bash", "-c", f'"$@" {closed}', "-", *PROGRAM, *argv]
        done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
        assert done.returncode in codes, done.stderr
        assert "Traceback" not in done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_beneath_stdout_is_one_line(root: Path) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [*PROGRAM, "--help"], cwd=root, stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode == InputError.exit_code
    assert "No space left on device" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_any_text_can_be_printed(encoding: str, root: Path, tmp_path: Path) -> None:
    program = "import sys; from gsopt import cli; cli.outlast_readers(); print('é → \\udcff', sys.argv[1])"
    done = subprocess.run(
        [sys.executable, "-c", program, b"name \xff"],
        cwd=root, env={**os.environ, "PYTHONIOENCODING": encoding}, capture_output=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.rstrip().endswith(b"\\udcff name \\udcff")


def test_a_full_pipe_that_does_not_block_is_waited_for() -> None:
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    os.set_blocking(reader, True)
    read: list[bytes] = []

    def drain() -> None:
        while data := os.read(reader, 1 << 16):
            read.append(data)

    thread = threading.Thread(target=drain)
    text, beneath = lasting(open(writer, "w", closefd=False))  # noqa: SIM115
    threading.Timer(0.2, thread.start).start()
    text.write("x" * 500_000)
    text.flush()
    os.close(writer)
    thread.join()
    os.close(reader)
    assert beneath.failure is None
    assert len(b"".join(read)) == 500_000


def test_a_reader_that_left_is_noted_and_stops_nothing() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as stream:
        text, beneath = lasting(stream)
        for _ in range(3):
            print("x" * 9000, file=text, flush=True)
        assert isinstance(beneath.failure, BrokenPipeError)
        assert isinstance(text, io.TextIOWrapper)
