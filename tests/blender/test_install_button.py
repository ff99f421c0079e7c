"""Install gsopt: a click makes an environment without a compiler, tells why it could not, and runs nothing unasked."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from in_panel import fails_with

from blender_addon.core import interpreter

METADATA = "Metadata-Version: 2.1\nName: gsopt\nVersion: 0.2.0\n"
WHEEL = "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
ENTRY = "[console_scripts]\ngsopt = gsopt:main\n"


@pytest.fixture
def wheel(tmp_path: Path) -> Path:
    """A package called gsopt that needs nothing."""
    path = tmp_path / "gsopt-0.2.0-py3-none-any.whl"
    info = "gsopt-0.2.0.dist-info"
    files = {f"{info}/METADATA": METADATA, f"{info}/WHEEL": WHEEL, f"{info}/entry_points.txt": ENTRY}
    files["gsopt/__init__.py"] = "def main(): print('hello')\n"
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in {**files, f"{info}/RECORD": ""}.items():
            archive.writestr(name, text)
    return path


@pytest.fixture
def machine(panel: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The preferences, with the environment in the test's folder."""
    import bpy

    from blender_addon import operators_interpreter

    monkeypatch.setattr(operators_interpreter, "environment_folder", lambda: tmp_path / "environment")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    panel.folder = str(tmp_path / "work")
    return bpy.context.preferences.addons["blender_addon"].preferences


def test_a_wheel_is_installed_and_its_python_is_used(machine: Any, wheel: Path, tmp_path: Path) -> None:
    import bpy

    machine.package = str(wheel)
    assert bpy.ops.gsopt.install() == {"FINISHED"}
    python = interpreter.python_of(tmp_path / "environment")
    assert machine.interpreter == str(python)
    assert (python.parent / interpreter.console_script()).is_file()
    assert bpy.context.scene.gsopt.job_install.state == "DONE"


def test_what_cannot_be_installed_leaves_the_interpreter_and_says_why(machine: Any, tmp_path: Path) -> None:
    import bpy

    machine.interpreter, machine.package = sys.executable, str(tmp_path / "broken.whl")
    (tmp_path / "broken.whl").write_bytes(b"no wheel")
    fails_with("broken.whl", bpy.ops.gsopt.install)
    machine.package = " "
    fails_with("No package is named", bpy.ops.gsopt.install)
    assert machine.interpreter == sys.executable


def test_without_leave_to_go_online_nothing_is_started(
    machine: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import bpy

    from blender_addon import operators_interpreter

    shut = SimpleNamespace(app=SimpleNamespace(online_access=False), utils=bpy.utils)
    monkeypatch.setattr(operators_interpreter, "bpy", shut)
    machine.package = "gsopt"
    fails_with("may not go online", bpy.ops.gsopt.install)
    assert not (tmp_path / "environment").exists()


def test_the_button_asks_first(machine: Any, tmp_path: Path) -> None:
    import bpy

    from blender_addon.operators_interpreter import GSOPT_OT_install

    asked: dict[str, str] = {}

    def confirm(*_: Any, **texts: str) -> set[str]:
        asked.update(texts)
        return {"RUNNING_MODAL"}

    context = SimpleNamespace(
        window_manager=SimpleNamespace(invoke_confirm=confirm), preferences=bpy.context.preferences
    )
    assert GSOPT_OT_install.invoke(SimpleNamespace(), context, None) == {"RUNNING_MODAL"}
    assert "gsopt[sfm]" in asked["message"]
    assert not (tmp_path / "environment").exists()
