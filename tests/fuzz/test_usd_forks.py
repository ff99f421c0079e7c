"""Forks of the fuzzer report the same of a file as the product's own process."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("pxr")
from tiny_scenes import cloud
from usd_forks import exit_code

from gsopt.formats import save_splats
from gsopt.formats.usd import probe_exit_code


def test_a_fork_ends_as_the_process_does(tmp_path: Path) -> None:
    """A sound file, text that is no USD, no file, and two changes of one byte that usd-core 26 aborts over."""
    sound = tmp_path / "sound.usdc"
    save_splats(sound, cloud(3, seed=0))
    data = sound.read_bytes()
    (tmp_path / "text.usda").write_bytes(b"PK")
    for at in (96, 99):
        (tmp_path / f"{at}.usdc").write_bytes(data[:at] + b"\xff" + data[at + 1 :])
    assert exit_code(sound) == 0
    for name in ("sound.usdc", "text.usda", "absent.usda", "96.usdc", "99.usdc"):
        assert exit_code(tmp_path / name) == probe_exit_code(tmp_path / name), name
