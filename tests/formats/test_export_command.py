"""`gsopt export`: one format in, another out, nothing lost by accident."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from splat_samples import WRITABLE, errors, make_splats, same_bits

from gsopt.cli import main
from gsopt.errors import InputError, UsageError
from gsopt.formats import is_antialiased, load_splats, save_splats

USAGE, INPUT = UsageError.exit_code, InputError.exit_code


@pytest.mark.parametrize("suffix", WRITABLE)
def test_every_format_can_be_the_target(tmp_path: Path, suffix: str) -> None:
    save_splats(tmp_path / "in.ply", make_splats(20))
    assert main(["export", str(tmp_path / "in.ply"), "-o", str(tmp_path / f"out{suffix}")]) == 0
    assert len(load_splats(tmp_path / f"out{suffix}")) == 20


def test_ply_through_glb_keeps_the_splats(tmp_path: Path) -> None:
    save_splats(tmp_path / "a.ply", make_splats(20))
    for source, target in (("a.ply", "b.glb"), ("b.glb", "c.ply")):
        assert main(["export", str(tmp_path / source), "-o", str(tmp_path / target)]) == 0
    assert errors(make_splats(20), load_splats(tmp_path / "c.ply")).means == 0


def test_a_run_directory_stands_for_its_result(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    save_splats(tmp_path / "run" / "splat.ply", make_splats(7))
    assert main(["export", str(tmp_path / "run"), "-o", str(tmp_path / "a.ply")]) == 0
    assert same_bits(load_splats(tmp_path / "a.ply"), make_splats(7))


def test_a_run_without_result_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "run").mkdir()
    assert main(["export", str(tmp_path / "run"), "-o", str(tmp_path / "a.ply")]) == INPUT
    assert "splat.ply" in capsys.readouterr().err


def test_an_existing_file_is_replaced_only_by_force(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_splats(tmp_path / "a.ply", make_splats(7))
    (tmp_path / "b.spz").write_bytes(b"dear")
    arguments = ["export", str(tmp_path / "a.ply"), "-o", str(tmp_path / "b.spz")]
    assert main(arguments) == USAGE
    assert "--force" in capsys.readouterr().err
    assert (tmp_path / "b.spz").read_bytes() == b"dear"
    assert main([*arguments, "--force"]) == 0
    assert len(load_splats(tmp_path / "b.spz")) == 7


def test_a_source_that_cannot_be_read_leaves_the_target(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(b"ply\nrubbish")
    (tmp_path / "b.spz").write_bytes(b"dear")
    assert main(["export", str(tmp_path / "a.ply"), "-o", str(tmp_path / "b.spz"), "--force"]) == INPUT
    assert (tmp_path / "b.spz").read_bytes() == b"dear"


def test_what_a_format_cannot_hold_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_splats(tmp_path / "a.ply", make_splats(7), antialiased=True)
    assert main(["export", str(tmp_path / "a.ply"), "-o", str(tmp_path / "a.splat")]) == 0
    notes = capsys.readouterr().err
    assert "view-dependent" in notes
    assert "antialiased" in notes
    assert main(["export", str(tmp_path / "a.ply"), "-o", str(tmp_path / "a.spz")]) == 0
    assert is_antialiased(tmp_path / "a.spz")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("target", ["a.obj", "absent/a.ply"])
def test_a_target_that_cannot_be_written_is_named_first(tmp_path: Path, target: str) -> None:
    assert main(["export", str(tmp_path / "absent.ply"), "-o", str(tmp_path / target)]) == INPUT


def test_importing_the_verb_loads_no_torch() -> None:
    code = "import sys, gsopt.cli.export; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
