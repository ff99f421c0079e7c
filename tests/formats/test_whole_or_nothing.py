"""A file is replaced whole or stays as it was, whatever the disk does."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from splat_samples import WRITABLE, make_splats, same_bits

from gsopt.errors import InputError
from gsopt.formats import load_splats, save_splats
from gsopt.formats.files import replacing


def disk_full(*_: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("suffix", WRITABLE)
@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_full_disk_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, step: str
) -> None:
    path = tmp_path / f"a{suffix}"
    save_splats(path, make_splats(10))
    old = path.read_bytes()
    monkeypatch.setattr(os, step, disk_full)
    with pytest.raises(InputError, match=r"full.*free some space"):
        save_splats(path, make_splats(20))
    assert path.read_bytes() == old
    assert os.listdir(tmp_path) == [path.name]


def test_a_write_that_fails_half_way_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    save_splats(path, make_splats(10))

    def write_half() -> None:
        with replacing(path) as file:
            file.write(b"ply\n")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_half()
    assert same_bits(load_splats(path), make_splats(10))
    assert os.listdir(tmp_path) == [path.name]


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Create the folder"):
        save_splats(tmp_path / "absent" / "a.ply", make_splats(1))


def test_a_name_too_long_is_an_error_with_advice(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="shorter"):
        save_splats(tmp_path / ("a" * 250 + ".ply"), make_splats(1))
