"""The whole way and the installed extension, on every Blender that is named. Takes minutes: `make test-blender`.

GSOPT_BLENDERS names Pythons that have the module bpy, separated as in PATH.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

from blender_addon.core.ply import read_ply

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
ADDON = ROOT / "blender_addon"
BLENDERS = [path for path in os.environ.get("GSOPT_BLENDERS", "").split(os.pathsep) if path]

pytestmark = pytest.mark.skipif(not BLENDERS, reason="takes minutes: `make test-blender` runs it")


LEAVE = "import os, runpy, sys; runpy.run_path(sys.argv[1], run_name='__main__'); sys.stdout.flush(); os._exit(0)"
"""Runs a script and leaves without Python's farewell: bpy 4.5 sometimes waits there forever for a thread of its own."""


def found_by(python: str, script: str, work: Path, *words: str) -> dict[str, Any]:
    """Returns the findings of a script of this folder, run in a Blender of its own."""
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(work)}
    command = [python, "-c", LEAVE, str(HERE / script), "--", *words]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, encoding="utf-8")
    lines = [line for line in done.stdout.splitlines() if line.startswith("found ")]
    assert lines, done.stdout[-3000:] + done.stderr[-3000:]
    return json.loads(lines[-1].removeprefix("found "))


@pytest.fixture(params=BLENDERS, ids=lambda path: path.replace(os.sep, "_"))
def python(request: pytest.FixtureRequest) -> str:
    return request.param


def test_from_mesh_to_exported_splats_though_blender_dies(python: str, shared_data: Path, odd_folder: Path) -> None:
    mesh = shared_data / "meshes" / "sh3d" / "cup" / "cup.obj"
    first = found_by(python, "end_to_end.py", odd_folder, str(odd_folder), str(mesh))
    assert first["doctor"].startswith("gsopt 0.")
    assert first["dataset"] == "8 of 8 views"
    assert first["prompts"] == ["a small carved figure, 春", "blurry"]
    assert first["seen running"][0] == "running"
    assert first["seen running"][1] >= 20
    found = found_by(python, "end_to_end.py", odd_folder, str(odd_folder), "--again")
    assert found["saved"] == ["running", first["seen running"][1], first["prompts"]]
    assert found["found again"][0] == found["resumed"][0] == "running"
    assert first["seen running"][1] < found["found again"][1] <= found["stopped"][1] < found["resumed"][1]
    assert (found["stopped"][0], found["attached"]) == ("stopped", "stopped")
    assert found["imported"] > found["kept"] > 0
    assert found["misplaced"] < 0.05, "the splats stand where the mesh stands"
    assert found["cameras"] == 8
    assert found["left behind"] == []
    assert len(read_ply(odd_folder / "edited splats.ply")) == found["kept"]


def test_the_script_of_the_documentation_runs(python: str, tmp_path: Path) -> None:
    text = (ROOT / "docs" / "howto" / "blender.md").read_text(encoding="utf-8")
    (script,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    begin = (
        f"import bpy, sys\nsys.path.insert(0, {str(ROOT)!r})\nimport blender_addon\nblender_addon.register()\n"
        f"bpy.ops.wm.save_as_mainfile(filepath={str(tmp_path / 'scene.blend')!r})\n"
        "scene = bpy.context.scene.gsopt\nscene.render_views, scene.render_size, scene.render_samples = 6, 48, 2\n"
        "scene.threads = 1\n"
    )
    end = "\nprint('found {\"splats\": %d}' % len(bpy.context.view_layer.objects.active.data.vertices))\n"
    (tmp_path / "script.py").write_text(begin + script.replace("2000", "60") + end, encoding="utf-8")
    assert found_by(python, str(tmp_path / "script.py"), tmp_path)["splats"] > 0
    assert list((tmp_path / "work" / "runs").glob("*/splat.ply"))


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
