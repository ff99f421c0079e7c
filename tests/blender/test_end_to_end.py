"""The whole way and the installed extension, on every Blender that is named. Takes minutes: `make test-blender`.

GSOPT_BLENDERS names Pythons that have the module bpy, separated as in PATH.
"""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest

from blender_addon.core.ply import read_ply

HERE = Path(__file__).resolve().parent
ADDON = HERE.parents[1] / "blender_addon"
BLENDERS = [path for path in os.environ.get("GSOPT_BLENDERS", "").split(os.pathsep) if path]

pytestmark = pytest.mark.skipif(not BLENDERS, reason="takes minutes: `make test-blender` runs it")


def found_by(python: str, script: str, work: Path, *words: str) -> dict[str, Any]:
    """What a script of this folder found in a Blender of its own."""
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(work)}
    command = [python, str(HERE / script), "--", *words]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, encoding="utf-8")
    lines = [line for line in done.stdout.splitlines() if line.startswith("found ")]
    assert lines, done.stdout[-3000:] + done.stderr[-3000:]
    return json.loads(lines[-1].removeprefix("found "))


@pytest.fixture(params=BLENDERS, ids=lambda path: path.replace(os.sep, "_"))
def python(request: pytest.FixtureRequest) -> str:
    return request.param


def test_from_mesh_to_exported_splats(python: str, shared_data: Path, odd_folder: Path) -> None:
    mesh = shared_data / "meshes" / "sh3d" / "cup" / "cup.obj"
    found = found_by(python, "end_to_end.py", odd_folder, str(odd_folder), str(mesh))
    assert found["doctor"].startswith("gsopt 0.")
    assert found["dataset"] == "8 of 8 views"
    assert found["prompts"] == ["a small carved figure, 春", "blurry"]
    assert found["seen running"][0] == found["re-attached"][0] == "running"
    assert 20 <= found["seen running"][1] < found["re-attached"][1] <= found["stopped"][1]
    assert (found["stopped"][0], found["attached"]) == ("stopped", "stopped")
    assert found["resumed"][0] == "running"
    assert found["resumed"][1] > found["stopped"][1]
    assert found["imported"] > found["kept"] > 0
    assert found["cameras"] == 8
    assert found["left behind"] == []
    assert len(read_ply(odd_folder / "edited splats.ply")) == found["kept"]


def test_the_zip_installs_and_leaves_nothing_behind(python: str, tmp_path: Path) -> None:
    tool = subprocess.run(
        [python, "-c", "import bpy; print(bpy.utils.system_resource('SCRIPTS'))"],
        capture_output=True,
        text=True,
        check=True,
    )
    extension = Path(tool.stdout.splitlines()[-1]) / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py"
    for words in (["validate", str(ADDON)], ["build", "--source-dir", str(ADDON), "--output-dir", str(tmp_path)]):
        subprocess.run([python, str(extension), *words], check=True, capture_output=True)
    (package,) = tmp_path.glob("*.zip")
    found = found_by(python, "install.py", tmp_path, str(package))
    assert found["enabled"] and found["panel"] and found["enabled again"]  # noqa: PT018
    assert found["after disabling"] == found["after uninstalling"] == found["files left"] == []
