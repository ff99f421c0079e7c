"""Imports flow down, and the Blender add-on and gsopt do not know each other."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest


def lint_imports(root: Path, config: Path, cache: Path) -> subprocess.CompletedProcess[str]:
    command = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    return subprocess.run(
        [sys.executable, "-c", command, "--config", str(config), "--cache-dir", str(cache), "--no-logo"],
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
    )


def test_imports_flow_down(root: Path, tmp_path: Path) -> None:
    done = lint_imports(root, root / "pyproject.toml", tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_layer_check_notices_an_import_that_flows_up(root: Path, tmp_path: Path) -> None:
    config = tmp_path / "upside_down.toml"
    config.write_text(
        '[tool.importlinter]\nroot_package = "gsopt"\n[[tool.importlinter.contracts]]\n'
        'name = "upside down"\ntype = "layers"\nlayers = ["gsopt.errors", "gsopt.check"]\n'
    )
    done = lint_imports(root, config, tmp_path)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "gsopt.check -> gsopt.errors" in done.stdout


def imported(file: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module


@pytest.mark.parametrize(
    ("folder", "stranger"), [("gsopt", "blender_addon"), ("blender_addon", "gsopt"), ("gsopt", "bpy")]
)
def test_the_run_directory_is_all_that_blender_and_gsopt_share(
    root: Path, tracked: list[Path], folder: str, stranger: str
) -> None:
    files = [file for file in tracked if file.suffix == ".py" and file.is_relative_to(root / folder)]
    guilty = [str(file) for file in files for name in imported(file) if name.partition(".")[0] == stranger]
    assert guilty == []
