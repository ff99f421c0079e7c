"""A checkpoint gives back what was put in, or says why not."""

from __future__ import annotations

import errno
import json
import os
import stat
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from gsopt.errors import InputError
from gsopt.training.checkpoint import load_newest, read_checkpoint, save_checkpoint, saved

TENSORS = {
    "a": torch.randn(5, 3, generator=torch.Generator().manual_seed(0)),
    "rng": torch.Generator().manual_seed(1).get_state(),
    "order": torch.tensor([3, 1, 2]),
    "none": torch.empty(0, 4),
    "view": torch.arange(12.0).view(3, 4).T,
}
META = {"step": 7, "psnr": 0.1 + 0.2, "tiny": 5e-324, "nested": {"loss": None, "flag": True}}


def fail(message: str) -> None:
    pytest.fail(message)


def test_what_is_saved_is_read_back_bit_for_bit(tmp_path: Path) -> None:
    path = save_checkpoint(tmp_path, 7, TENSORS, META)
    again = read_checkpoint(path)
    assert path.name == "step_000007.safetensors"
    assert again.meta == {**META, "version": 1}
    assert set(again.tensors) == set(TENSORS)
    for name, tensor in TENSORS.items():
        assert again.tensors[name].dtype == tensor.dtype
        assert torch.equal(again.tensors[name], tensor)


def test_only_the_newest_two_are_kept_by_step_and_not_by_name(tmp_path: Path) -> None:
    for step in (9, 999_999, 1_000_000, 1_000_001):
        save_checkpoint(tmp_path, step, TENSORS, {"step": step})
    assert [path.name for path in saved(tmp_path)] == ["step_1000001.safetensors", "step_1000000.safetensors"]
    assert load_newest(tmp_path, fail).meta["step"] == 1_000_001  # type: ignore[union-attr]


def test_no_checkpoint_is_none(tmp_path: Path) -> None:
    assert load_newest(tmp_path, fail) is None
    assert load_newest(tmp_path / "absent", fail) is None


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: b"",
        lambda data: data[:10],
        lambda data: data[:-1],
        lambda data: b"\xff" * 8 + data[8:],
        lambda data: data.replace(b'"__metadata__"', b'"__metadatb__"'),
    ],
)
def test_a_damaged_one_is_told_and_skipped(tmp_path: Path, damage) -> None:
    save_checkpoint(tmp_path, 1, TENSORS, {"step": 1})
    newest = save_checkpoint(tmp_path, 2, TENSORS, {"step": 2})
    newest.write_bytes(damage(newest.read_bytes()))
    messages: list[str] = []
    assert load_newest(tmp_path, messages.append).meta["step"] == 1  # type: ignore[union-attr]
    assert len(messages) == 1
    assert newest.name in messages[0]


@pytest.mark.parametrize("header", [None, {}, {"gsopt": "{"}, {"gsopt": "[]"}, {"gsopt": json.dumps({"version": 99})}])
def test_a_stranger_is_refused(tmp_path: Path, header: dict[str, str] | None) -> None:
    path = tmp_path / "step_000001.safetensors"
    save_file({"a": torch.zeros(2)}, path, metadata=header)
    with pytest.raises(InputError, match="cannot be read"):
        read_checkpoint(path)


def test_a_folder_that_cannot_be_written_is_an_input_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="Free some space"):
        save_checkpoint(tmp_path / "file", 1, TENSORS, {})


@pytest.mark.parametrize("broken", ["fsync", "replace"])
def test_a_disk_that_refuses_leaves_the_old_checkpoints_and_no_temporary(
    broken: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*args: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    for step in (1, 2):
        save_checkpoint(tmp_path, step, TENSORS, {"step": step})
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.setattr(os, broken, refuse)
    for step in (2, 3):
        with pytest.raises(InputError, match="No space left on device"):
            save_checkpoint(tmp_path, step, {"a": torch.ones(9)}, {})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.skipif(os.name == "nt", reason="Windows has no umask and flushes no folder")
def test_others_may_read_it_as_the_umask_says(tmp_path: Path) -> None:
    for mask in (0o022, 0o077, 0o002):
        before = os.umask(mask)
        try:
            path = save_checkpoint(tmp_path, 1, TENSORS, {})
        finally:
            os.umask(before)
        assert path.stat().st_mode & 0o777 == 0o666 & ~mask


@pytest.mark.skipif(os.name == "nt", reason="Windows has no umask and flushes no folder")
def test_the_new_name_is_on_the_disk_before_an_old_checkpoint_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for step in (1, 2):
        save_checkpoint(tmp_path, step, TENSORS, {})
    done: list[str] = []
    fsync, replace, unlink = os.fsync, os.replace, Path.unlink

    def flush(descriptor: int) -> None:
        done.append("folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", flush)
    monkeypatch.setattr(os, "replace", lambda *names: (done.append("rename"), replace(*names)))
    monkeypatch.setattr(Path, "unlink", lambda path, **known: (done.append("unlink"), unlink(path, **known)))
    save_checkpoint(tmp_path, 3, TENSORS, {})
    assert done[-4:] == ["file", "rename", "folder", "unlink"]
