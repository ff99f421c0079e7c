"""The Python with gsopt: named, or found and allowed; what anybody else may change never runs."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from in_panel import fails_with

from blender_addon.core import interpreter
from blender_addon.core.errors import InputError, UsageError


def make_venv(folder: Path, marker: Path) -> Path:
    """A .venv whose Python touches a file when it is run."""
    python = interpreter.python_of(folder / ".venv")
    python.parent.mkdir(parents=True)
    for path in (python, python.with_name(interpreter.console_script())):
        path.write_text(f"#!/bin/sh\ntouch '{marker}'\necho 'No module named gsopt'; exit 1\n")
        path.chmod(0o755)
    return python


def test_a_named_interpreter_needs_no_consent(tmp_path: Path) -> None:
    python, other = (make_venv(tmp_path / name, tmp_path / "run") for name in ("project", "other"))
    assert interpreter.find(str(python), (), None, {}) == python
    assert interpreter.find("", (), tmp_path / "project", {"GSOPT_PYTHON": str(other)}) == other
    for wrong in (str(tmp_path / "gone"), "python", str(tmp_path)):
        with pytest.raises(UsageError, match="not there"):
            interpreter.find(wrong, (), tmp_path / "project", {})


def test_only_an_absolute_path_of_a_program_is_an_interpreter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    python = make_venv(tmp_path, tmp_path / "run")
    monkeypatch.chdir(python.parent)
    with pytest.raises(UsageError, match="not there"):
        interpreter.find(python.name, (), None, {})
    python.chmod(0o644)
    if sys.platform != "win32":
        with pytest.raises(UsageError, match="not a program"):
            interpreter.find(str(python), (), None, {})


def test_a_python_is_found_beside_gsopt_or_what_gsopt_links_to(tmp_path: Path) -> None:
    python = make_venv(tmp_path, tmp_path / "run")
    script = python.with_name(interpreter.console_script())
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / script.name).symlink_to(script)
    assert interpreter.candidates(None, {"PATH": str(tmp_path / "bin")}) == [python]
    script.unlink()
    assert interpreter.candidates(tmp_path, {"PATH": ""}) == []


def test_a_found_interpreter_is_used_once_it_is_allowed(tmp_path: Path) -> None:
    python, other = (make_venv(tmp_path / name, tmp_path / "run") for name in ("project", "other"))
    path = {"PATH": str(other.parent)}
    assert interpreter.candidates(tmp_path / "project", path) == [python, other]
    with pytest.raises(UsageError, match="have not allowed") as caught:
        interpreter.find("", (), tmp_path / "project", path)
    assert str(python) in str(caught.value)
    assert interpreter.find("", {str(other)}, tmp_path / "project", path) == other
    assert interpreter.find("", {str(other), str(python)}, tmp_path / "project", path) == python
    with pytest.raises(UsageError, match="Install gsopt"):
        interpreter.find("", {str(other)}, tmp_path / "elsewhere", {"PATH": ""})


def test_neither_folders_above_nor_the_working_folder_are_searched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    python = make_venv(tmp_path, tmp_path / "run")
    (tmp_path / "scenes").mkdir()
    for folder in (tmp_path, python.parent):
        monkeypatch.chdir(folder)
        for places in ("", ".", f".{os.pathsep}", os.path.relpath(python.parent)):
            assert interpreter.candidates(tmp_path / "scenes", {"PATH": places}) == []
            assert interpreter.candidates(None, {"PATH": places}) == []


def test_consent_to_one_venv_is_none_to_another_with_the_same_python(tmp_path: Path) -> None:
    """The Pythons of all venvs are links to the same file; what runs is in the venv."""
    pythons = []
    for name in ("trusted", "hostile"):
        pythons.append(make_venv(tmp_path / name, tmp_path / "run"))
        pythons[-1].unlink()
        pythons[-1].symlink_to(sys.executable)
    with pytest.raises(UsageError, match="have not allowed"):
        interpreter.find("", {str(pythons[0])}, tmp_path / "hostile", {"PATH": ""})
    (tmp_path / "link").mkdir()
    (tmp_path / "link" / ".venv").symlink_to(tmp_path / "trusted" / ".venv")
    assert interpreter.find("", {str(pythons[0])}, tmp_path / "link", {"PATH": ""}) == pythons[0]


@pytest.mark.skipif(sys.platform == "win32", reason="modes are POSIX")
@pytest.mark.parametrize("mode", [0o002, 0o020, 0o1022])
@pytest.mark.parametrize("place", [".venv", ".venv/bin", ".venv/bin/python", "target", "target/python"])
def test_what_others_may_write_never_runs(tmp_path: Path, place: str, mode: int) -> None:
    python = make_venv(tmp_path, tmp_path / "run")
    (tmp_path / "target").mkdir()
    (tmp_path / "target" / "python").write_bytes(python.read_bytes())
    (tmp_path / "target" / "python").chmod(0o755)
    if place.startswith("target"):
        python.unlink()
        python.symlink_to(tmp_path / "target" / "python")
    assert interpreter.find(str(python), (), None, {}) == python
    (tmp_path / place).chmod(0o755 | mode)
    for preferred, allowed in ((str(python), set()), ("", {str(python)})):
        with pytest.raises(UsageError, match="others may change") as caught:
            interpreter.find(preferred, allowed, tmp_path, {"PATH": ""})
        assert str(tmp_path / place) in str(caught.value)
        assert "chmod go-w" in str(caught.value)


@pytest.mark.skipif(sys.platform == "win32", reason="owners are POSIX")
def test_what_belongs_to_another_user_never_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    python = make_venv(tmp_path, tmp_path / "run")
    if os.geteuid():
        monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    else:
        os.chown(tmp_path / ".venv", 12345, -1)
    with pytest.raises(UsageError, match=r"others may change .*\.venv .*user"):
        interpreter.find(str(python), (), None, {})


def test_the_source_folder_is_that_with_the_venv(tmp_path: Path) -> None:
    python = make_venv(tmp_path / "a", tmp_path / "run")
    for folder in (tmp_path / "scripts", tmp_path / "a" / "scripts"):
        with pytest.raises(UsageError, match=r"synth_views\.py"):
            interpreter.checkout(python)
        folder.mkdir()
        (folder / "synth_views.py").touch()
    assert interpreter.checkout(python) == tmp_path / "a"
    with pytest.raises(UsageError, match=r"synth_views\.py"):
        interpreter.checkout(python, str(tmp_path / "nowhere"))
    if sys.platform != "win32":
        (tmp_path / "a" / "scripts").chmod(0o777)
        with pytest.raises(UsageError, match="others may change"):
            interpreter.checkout(python)


def test_a_blend_beside_a_hostile_venv_runs_nothing_unasked(
    panel: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Opening a downloaded project and pressing its buttons runs none of its code; after the dialog it does."""
    import bpy

    from blender_addon.operators_interpreter import GSOPT_OT_allow_interpreter

    project, marker = tmp_path / "download" / "scenes", tmp_path / "run"
    python = make_venv(project, marker)
    make_venv(project.parent, marker)
    (project / "photos").mkdir()
    panel.photos, panel.dataset, panel.notes = str(project / "photos"), str(project / "photos"), "lantern"
    bpy.ops.mesh.primitive_cube_add()
    bpy.ops.wm.save_as_mainfile(filepath=str(project / "a.blend"))
    monkeypatch.delenv("GSOPT_PYTHON")
    monkeypatch.setenv("PATH", "/usr/bin:/bin:.")
    monkeypatch.chdir(python.parent)
    bpy.ops.wm.open_mainfile(filepath=str(project / "a.blend"))
    gsopt = bpy.ops.gsopt
    for operator in (gsopt.test, gsopt.render_dataset, gsopt.find_poses, gsopt.propose, gsopt.launch):
        fails_with(f"{python} was found, but you have not allowed it to run", operator)
    asked: dict[str, str] = {}

    def confirm(*_: Any, **texts: str) -> set[str]:
        asked.update(texts)
        return {"RUNNING_MODAL"}

    window = SimpleNamespace(invoke_confirm=confirm)
    context = SimpleNamespace(window_manager=window, preferences=bpy.context.preferences)
    operator = SimpleNamespace()
    assert GSOPT_OT_allow_interpreter.invoke(operator, context, None) == {"RUNNING_MODAL"}
    assert str(python) in asked["message"]
    assert not marker.exists()
    for _ in range(2):  # remembered once
        gsopt.allow_interpreter(path=operator.path)
    allowed = bpy.context.preferences.addons["blender_addon"].preferences.allowed
    assert [entry.path for entry in allowed] == [str(python)]
    fails_with("No module named gsopt", gsopt.test)
    assert marker.exists()
    gsopt.forget_interpreters()
    fails_with("have not allowed", gsopt.test)


@pytest.mark.skipif(sys.platform == "win32", reason="modes are POSIX")
def test_a_venv_that_others_may_write_cannot_be_allowed(panel: Any, tmp_path: Path) -> None:
    import bpy

    python = make_venv(tmp_path, tmp_path / "run")
    (tmp_path / ".venv").chmod(0o777)
    machine = bpy.context.preferences.addons["blender_addon"].preferences
    fails_with("others may change", bpy.ops.gsopt.allow_interpreter, path=str(python))
    assert len(machine.allowed) == 0
    machine.interpreter = str(python)
    fails_with("others may change", bpy.ops.gsopt.test)
    assert not (tmp_path / "run").exists()
    fails_with("Set the interpreter", bpy.ops.gsopt.allow_interpreter)


ANSWER = {
    "gsopt": "0.1.0",
    "rasterizer": {"backend": "cpu", "isa": "avx2", "ms_per_step": 9.5, "problem": None},
    "missing_extras": {"sds": "pip", "": "pip"},
}


def test_the_doctors_answer_is_read() -> None:
    answer = interpreter.read_answer("a warning\n" + json.dumps(ANSWER), "python")
    assert answer.line == "gsopt 0.1.0: avx2, 9.5 ms a step; not installed: sds"
    odd = interpreter.read_answer(json.dumps({**ANSWER, "missing_extras": {"\ud800": "pip"}}), "python")
    assert odd.line.endswith("not installed: \\ud800")


@pytest.mark.parametrize(
    ("output", "said"),
    [
        ("/usr/bin/python3: No module named gsopt", "no working gsopt: /usr/bin/python3: No module named gsopt"),
        ("", "said nothing"),
        ('{"gsopt": "0.1.0"}', "no working gsopt"),
        (json.dumps({**ANSWER, "gsopt": "7.3.1"}), "gsopt 7.3.1, this extension knows 0.1"),
        (json.dumps({**ANSWER, "rasterizer": None}), "no working gsopt"),
    ],
)
def test_a_wrong_interpreter_is_told_apart(output: str, said: str) -> None:
    with pytest.raises(InputError) as caught:
        interpreter.read_answer(output, "python")
    assert said in str(caught.value)
