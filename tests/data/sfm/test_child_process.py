"""COLMAP in a process of its own: crashes, errors, and what killed runs leave behind."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import textured_room as room

pytest.importorskip("pycolmap", reason="the extra sfm is not installed")

from gsopt.data.sfm import child_process
from gsopt.data.sfm.pipeline import pose_photos
from gsopt.data.sfm.settings import SfmConfig
from gsopt.data.sfm.write_scene import export_model
from gsopt.data.working_folder import working_folder
from gsopt.errors import InputError, UsageError


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    room.photograph(tmp_path / "photos", room.arc(3))
    return tmp_path / "photos"


@pytest.mark.parametrize(
    ("words", "name"), [("kill -ABRT $$", "SIGABRT"), ("kill -KILL $$", "SIGKILL"), ("exit 7", "exit code 7")]
)
def test_a_crash_is_an_error_that_names_it_and_leaves_nothing(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str, name: str
) -> None:
    program = tmp_path / "crashing"
    program.write_text(f"#!/bin/sh\n{words}\n")
    program.chmod(0o755)
    monkeypatch.setattr(child_process.sys, "executable", str(program))
    with pytest.raises(InputError, match=rf"COLMAP crashed \({name}\).*MB are free"):
        pose_photos(photos, tmp_path / "scene", SfmConfig())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["crashing", "photos"]


def test_a_refusal_of_the_child_is_the_error_of_the_parent(tmp_path: Path) -> None:
    room.photograph(tmp_path / "photos", room.arc(1))
    with pytest.raises(InputError, match="One photo alone has no parallax"):
        pose_photos(tmp_path / "photos", tmp_path / "scene", SfmConfig())
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_what_a_run_left_that_was_killed_when_all_was_done_is_removed_too(tmp_path: Path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    (tmp_path / "photos").mkdir()
    (tmp_path / "scene" / "images").mkdir(parents=True)
    (tmp_path / f".scene.{ended.pid}.tmp" / "photos").mkdir(parents=True)
    with pytest.raises(UsageError, match="must not exist yet"):
        pose_photos(tmp_path / "photos", tmp_path / "scene", SfmConfig())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photos", "scene"]


class CarelessWriter:
    """Writes a model as COLMAP does, and at one call, counted down, only its beginning."""

    def __init__(self, call: int) -> None:
        self.call = call

    def write(self, folder: Path) -> None:
        self.export_PLY(folder / "points3D.bin")

    def export_PLY(self, path: Path) -> None:
        self.call -= 1
        path.write_bytes(b"header" if self.call == 0 else b"header and points")


@pytest.mark.parametrize("call", [1, 2, 3, 4])
def test_a_model_that_the_disk_took_in_part_is_an_error(tmp_path: Path, call: int) -> None:
    export_model(CarelessWriter(0), tmp_path / "a", tmp_path / "b")
    with pytest.raises(InputError, match=r"a part of (points\.ply|points3D\.bin)"):
        export_model(CarelessWriter(call), tmp_path / "c", tmp_path / "d")


def test_a_disk_that_refuses_to_remove_a_file_once_leaves_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refusals = [OSError(errno.EIO, "once")]
    unlink = os.unlink

    def refusing(*args: Any, **keywords: Any) -> None:
        if refusals:
            raise refusals.pop()
        unlink(*args, **keywords)

    with working_folder(tmp_path / "scene") as work:
        (work / "photo.jpg").write_bytes(b"")
        monkeypatch.setattr(os, "unlink", refusing)
    assert (list(tmp_path.iterdir()), refusals) == ([], [])


def test_what_a_killed_run_left_is_removed_and_that_of_a_living_one_is_kept(tmp_path: Path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    dead, living, other = (
        tmp_path / name for name in (f".scene.{ended.pid}.tmp", f".scene.{os.getppid()}.tmp", ".scene.x.tmp")
    )
    for folder in (dead, living, other):
        (folder / "photos").mkdir(parents=True)
    with working_folder(tmp_path / "scene"):
        assert not dead.exists()
    assert living.exists()
    assert other.exists()


@pytest.mark.parametrize(
    ("error", "answer"),
    [
        (InputError("x"), {"error": "InputError", "text": "x"}),
        (ValueError("first " + "x" * 300 + "\nsecond"), {"text": f"COLMAP failed: first {'x' * 194}. Check"}),
        (RuntimeError(), {"text": "COLMAP failed: RuntimeError. Check"}),
        (OSError(28, "full", "a"), {"error": "OSError", "errno": 28, "text": "full", "filename": "a"}),
        (OSError(28, "full"), {"filename": None}),
    ],
)
def test_the_last_answer_of_the_child_is_one_line(
    monkeypatch: pytest.MonkeyPatch, error: Exception, answer: dict[str, Any]
) -> None:
    def fails(*_: Any) -> None:
        raise error

    monkeypatch.setattr("gsopt.data.sfm.pipeline.write_posed_scene", fails)
    found = child_process._done({"source": "a", "work": "b", "config": {}}, print)
    assert "\n" not in found["text"]
    assert found["text"].startswith(answer.get("text", ""))
    others = {name: value for name, value in answer.items() if name != "text"}
    assert {name: found[name] for name in others} == others


def test_the_child_imports_the_package_of_its_parent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever else is installed: the first folder of its path holds this gsopt, and what was on the path stays."""
    asked: list[dict[str, str]] = []

    def started(command: list[str], env: dict[str, str], **_: Any) -> None:
        asked.append(env)
        raise InputError("Asked for a child. Nothing else is wanted.")

    monkeypatch.setattr(child_process.subprocess, "Popen", started)
    for others in ("", f"{tmp_path}{os.pathsep}elsewhere"):
        monkeypatch.setenv("PYTHONPATH", others)
        with pytest.raises(InputError, match="Asked for a child"):
            child_process.run_in_child(tmp_path, tmp_path, SfmConfig(), print)
        first, *rest = asked[-1]["PYTHONPATH"].split(os.pathsep)
        assert Path(first, *child_process.__name__.split(".")).with_suffix(".py").samefile(child_process.__file__)
        assert rest == list(filter(None, others.split(os.pathsep)))
