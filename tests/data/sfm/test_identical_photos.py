"""Copies of one photo are one photo: no pose comes of it, and the user is told what to do."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from gsopt.cli import main


@pytest.mark.parametrize("verb", ["sfm", "reconstruct"])
def test_copies_of_one_photo_end_with_code_3(
    verb: str, room_photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = tmp_path / "photos", tmp_path / "out"
    folder.mkdir()
    first = sorted(room_photos.iterdir())[0]
    for number in range(6):
        shutil.copy(first, folder / f"copy_{number}.jpg")
    flags = ["-o", str(out)] if verb == "sfm" else ["-m", str(out), "--masks", "none"]
    assert main([verb, str(folder), *flags]) == 3
    said = capsys.readouterr()
    assert "a copy of copy_0.jpg" in said.out + said.err
    assert "invented there, not measured" in said.err
    assert not (out / "splat.ply").exists()
