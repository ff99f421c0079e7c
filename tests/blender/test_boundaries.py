"""Import rules: the run directory is all that the extension and gsopt share, and `core` needs no Blender."""

from __future__ import annotations

import ast
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ADDON = ROOT / "blender_addon"
BLENDERS = {"bpy", "bmesh", "mathutils", "bpy_extras", "gpu", "blf"}


def imported(file: Path) -> set[str]:
    """Top-level modules, relative ones as dots."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {name.name.partition(".")[0] for name in node.names}
        if isinstance(node, ast.ImportFrom):
            found.add("." * node.level if node.level else str(node.module).partition(".")[0])
    return found


def stranger(modules: set[str], allowed: set[str]) -> set[str]:
    import sys

    return modules - allowed - set(sys.stdlib_module_names) - {"__future__"}


@pytest.mark.parametrize("file", sorted((ADDON / "core").glob("*.py")), ids=lambda file: file.stem)
def test_core_needs_numpy_alone(file: Path) -> None:
    assert stranger(imported(file), {"numpy", "."}) == set()


@pytest.mark.parametrize("file", sorted(ADDON.glob("*.py")), ids=lambda file: file.stem)
def test_the_rest_needs_blender_and_numpy_alone(file: Path) -> None:
    assert stranger(imported(file), {"numpy", ".", *BLENDERS}) == set()


def test_gsopt_does_not_know_the_extension() -> None:
    assert [file for file in (ROOT / "gsopt").rglob("*.py") if "blender_addon" in imported(file)] == []


def test_the_manifest_keeps_the_rules_of_the_platform() -> None:
    manifest = tomllib.loads((ADDON / "blender_manifest.toml").read_text(encoding="utf-8"))
    assert manifest["blender_version_min"] == "4.2.0"
    assert len(manifest["tagline"]) <= 64
    assert not manifest["tagline"].endswith(".")
    assert all(len(reason) <= 64 for reason in manifest["permissions"].values())
    assert "wheels" not in manifest
    assert "SPDX:GPL-3.0-or-later" in manifest["license"]


def test_versions_agree() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    manifest = tomllib.loads((ADDON / "blender_manifest.toml").read_text(encoding="utf-8"))["version"]
    from blender_addon.core.interpreter import KNOWN

    assert manifest == project
    assert ".".join(project.split(".")[:2]) in KNOWN
