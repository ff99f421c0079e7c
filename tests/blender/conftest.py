"""The extension as a package, splats to try it on, and Blender's module where it is installed."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from made_splats import random_splats  # noqa: E402

from blender_addon.core.splats import Splats  # noqa: E402


@pytest.fixture
def some_splats() -> Splats:
    return random_splats(300)


@pytest.fixture
def odd_folder(tmp_path: Path) -> Path:
    """A folder whose name has spaces, letters of other scripts and what shells stumble over."""
    folder = tmp_path / "мой проект 春 $(x) 'q'"
    folder.mkdir()
    return folder


@pytest.fixture
def gsopt_python(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """GSOPT_PYTHON names a Python that runs this checkout's gsopt, unless it names one already."""
    program = tmp_path_factory.mktemp("python") / "gsopt-python"
    words = shlex.join([f"PYTHONPATH={ROOT}", sys.executable])
    program.write_text(f'#!/bin/sh\nexec env {words} "$@"\n', encoding="utf-8")
    program.chmod(0o755)
    monkeypatch.setenv("GSOPT_PYTHON", os.environ.get("GSOPT_PYTHON", str(program)))


@pytest.fixture
def panel(tmp_path: Path, gsopt_python: None) -> Iterator[Any]:
    """An empty scene with the extension enabled; its settings."""
    bpy = pytest.importorskip("bpy", reason="Blender's module is not installed (pip install bpy)")
    import blender_addon

    bpy.ops.wm.read_factory_settings(use_empty=True)
    entry = bpy.context.preferences.addons.new()
    entry.module = "blender_addon"
    blender_addon.register()
    try:
        bpy.context.scene.gsopt.folder = str(tmp_path / "work")
        yield bpy.context.scene.gsopt
    finally:
        blender_addon.unregister()
        bpy.context.preferences.addons.remove(entry)
