"""The run directory's two files: whole or absent, and readable while they are written."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsopt import events as events_module
from gsopt.errors import InputError, UsageError
from gsopt.events import (
    LARGEST_LOG,
    WRITTEN_IN_PLACE,
    EventWriter,
    read_events,
    refuse_links,
    sweep,
    sync_folder,
    to_json,
    write_atomic,
)
from gsopt.formats.files import replacing

FIELDS = st.dictionaries(
    st.sampled_from(["step", "message", "loss", "path"]),
    st.none()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(codec="utf-8")),
)


@settings(max_examples=50, deadline=None)
@given(events=st.lists(FIELDS, max_size=5), cut=st.integers(0, 400))
def test_a_reader_that_tails_sees_every_event_once_and_in_order(tmp_path_factory, events: list[dict], cut: int) -> None:
    run = tmp_path_factory.mktemp("run")
    writer = EventWriter(run)
    for fields in events:
        writer.emit("progress", **fields)
    writer.close()
    data = (run / "events.jsonl").read_bytes()
    partial = run / "partial.jsonl"
    partial.write_bytes(data[:cut])  # wherever the writer happens to be
    first, offset = read_events(partial)
    partial.write_bytes(data)
    rest, end = read_events(partial, offset)
    assert [event["seq"] for event in first + rest] == list(range(len(events)))
    assert end == len(data)
    for told, fields in zip(first + rest, events, strict=True):
        assert {key: told[key] for key in fields} == fields


def test_a_second_session_goes_on_counting_even_after_half_a_line(tmp_path: Path) -> None:
    writer = EventWriter(tmp_path)
    writer.emit("started")
    writer.emit("progress")
    writer.close()
    with open(tmp_path / "events.jsonl", "ab") as file:
        file.write(b'{"v": 1, "seq": 2, "ki')
    writer = EventWriter(tmp_path)
    event = writer.emit("started")
    writer.close()
    assert event["seq"] == 2
    assert [told["kind"] for told in read_events(tmp_path / "events.jsonl")[0]] == ["started", "progress", "started"]


def test_strangers_are_skipped_and_a_higher_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    path.write_bytes(b'not json\n[]\n{"seq": "1"}\n' + b"[" * 100_000 + b"\n" + b'{"v": 1, "seq": 0, "kind": "new"}\n')
    events, offset = read_events(path)
    assert [event["kind"] for event in events] == ["new"]
    assert offset == path.stat().st_size
    path.write_text('{"v": 2, "seq": 0, "kind": "started"}\n')
    with pytest.raises(InputError, match="Update gsopt"):
        read_events(path)
    assert read_events(tmp_path / "absent", 7) == ([], 7)


def test_numbers_that_json_does_not_know_are_refused(tmp_path: Path) -> None:
    writer = EventWriter(tmp_path)
    with pytest.raises(ValueError, match="JSON compliant"):
        writer.emit("progress", loss=float("nan"))
    writer.close()
    assert (tmp_path / "events.jsonl").read_bytes() == b""
    with pytest.raises(ValueError, match="JSON compliant"):
        to_json({"psnr": float("inf")})


def test_one_writer_at_a_time(tmp_path: Path) -> None:
    writer = EventWriter(tmp_path)
    with pytest.raises(UsageError, match="Another process"):
        EventWriter(tmp_path)
    writer.close()
    EventWriter(tmp_path).close()


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "metrics.json"
    write_atomic(path, to_json({"psnr": 1.5, "näme": "ü"}))
    assert json.loads(path.read_bytes()) == {"psnr": 1.5, "näme": "ü"}

    def full(*args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="No space left on device"):
        write_atomic(path, b"{}")
    assert json.loads(path.read_bytes())["psnr"] == 1.5
    assert os.listdir(tmp_path) == ["metrics.json"]


def test_a_folder_that_cannot_be_written_is_an_input_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="Cannot write"):
        write_atomic(tmp_path / "file" / "metrics.json", b"{}")
    with pytest.raises(InputError, match="Cannot write"):
        EventWriter(tmp_path / "absent")


def test_a_log_without_end_and_a_folder_in_its_place_are_input_errors(tmp_path: Path) -> None:
    with open(tmp_path / "events.jsonl", "wb") as file:
        file.truncate(LARGEST_LOG + 1)
    with pytest.raises(InputError, match="256 MB of events"):
        read_events(tmp_path / "events.jsonl")
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match="Cannot read"):
        read_events(tmp_path / "folder")


def test_a_name_that_is_no_text_is_kept(tmp_path: Path) -> None:
    """File systems have names that are not UTF-8; Python holds their bytes as lone surrogates."""
    name = "caf\udce9.jpg"
    assert json.loads(to_json({"name": name})) == {"name": name}
    writer = EventWriter(tmp_path)
    writer.emit("warning", message=name)
    writer.close()
    assert read_events(tmp_path / "events.jsonl")[0][0]["message"] == name


@pytest.mark.parametrize("written", [0, 1, 20])
def test_a_full_disk_leaves_no_half_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, written: int) -> None:
    """The disk takes the first bytes of a line, then it is full; once there is space the numbering goes on."""
    writer = EventWriter(tmp_path)
    writer.emit("started")
    whole = (tmp_path / "events.jsonl").read_bytes()
    real, space = os.write, [written]

    def short_write(descriptor: int, data: bytes) -> int:
        if not space[0]:
            raise OSError(28, "No space left on device")
        count = real(descriptor, data[: space[0]])
        space[0] -= count
        return count

    monkeypatch.setattr(os, "write", short_write)
    with pytest.raises(InputError, match=r"No space left on device.*--resume"):
        writer.emit("progress", step=1)
    assert (tmp_path / "events.jsonl").read_bytes() == whole
    monkeypatch.undo()
    writer.emit("progress", step=1)
    writer.close()
    assert [event["seq"] for event in read_events(tmp_path / "events.jsonl")[0]] == [0, 1]


def test_a_disk_that_takes_a_line_in_pieces_gets_all_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = os.write
    monkeypatch.setattr(os, "write", lambda descriptor, data: real(descriptor, data[:7]))
    writer = EventWriter(tmp_path)
    writer.emit("progress", message="ü" * 40)
    writer.close()
    assert [event["message"] for event in read_events(tmp_path / "events.jsonl")[0]] == ["ü" * 40]


@pytest.mark.parametrize("version", ["", '"v": 0, ', '"v": 2, ', '"v": "1", ', '"v": null, '])
def test_events_of_any_other_version_or_of_none_are_refused(tmp_path: Path, version: str) -> None:
    path = tmp_path / "events.jsonl"
    path.write_text(f'{{{version}"seq": 0, "kind": "started"}}\n')
    with pytest.raises(InputError, match="Update gsopt"):
        read_events(path)


@pytest.mark.parametrize("name", [*WRITTEN_IN_PLACE, "renders/test", "previews/step_000500.ply"])
def test_a_link_in_a_foreign_run_is_refused(tmp_path: Path, name: str) -> None:
    run, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    (run / name).parent.mkdir(parents=True)
    elsewhere.mkdir()
    refuse_links(run)
    (run / name).symlink_to(elsewhere)
    with pytest.raises(InputError, match="symbolic link"):
        refuse_links(run)


def test_no_file_is_written_through_a_link(tmp_path: Path) -> None:
    """Neither a link at the name itself, nor one at the name of the temporary file."""
    precious = tmp_path / "precious"
    precious.write_bytes(b"precious")
    for name in ("metrics.json", f".metrics.json.{os.getpid()}.tmp", "events.jsonl", f".a.ply.{os.getpid()}.tmp"):
        (tmp_path / name).symlink_to(precious)
    write_atomic(tmp_path / "metrics.json", b"{}")
    with replacing(tmp_path / "a.ply") as file:
        file.write(b"ply")
    with pytest.raises(InputError, match="Cannot write"):
        EventWriter(tmp_path)
    assert precious.read_bytes() == b"precious"
    assert not (tmp_path / "metrics.json").is_symlink()


@pytest.mark.skipif(os.name == "nt", reason="Windows cannot be asked for a process without harm")
def test_the_next_writer_removes_what_a_dead_one_left_and_leaves_the_living_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    signals, kill = set(), os.kill

    def asked(process: int, signal: int) -> None:
        signals.add(signal)
        kill(process, 0)  # whatever was asked for: nothing must end

    monkeypatch.setattr(os, "kill", asked)
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    left = f".metrics.json.{ended.pid}.tmp"
    others = [f".metrics.json.{os.getppid()}.tmp", ".metrics.json.1.tmp", f".other.json.{ended.pid}.tmp"]
    others += [".metrics.json.0.tmp", f".metrics.json.{2**31}.tmp", ".metrics.json.12a.tmp", ".metrics.json.\u0663.tmp"]
    for name in (left, *others):
        (tmp_path / name).write_bytes(b"half")
    write_atomic(tmp_path / "metrics.json", b"{}")
    assert signals == {0}, "a process is asked for, never signaled"
    assert sorted(os.listdir(tmp_path)) == sorted([*others, "metrics.json"])
    assert (tmp_path / "metrics.json").read_bytes() == b"{}"


@pytest.mark.skipif(os.name == "nt", reason="Windows flushes no folder")
@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOTSUP, errno.EIO])
def test_a_folder_is_flushed_where_the_disk_can(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """A disk that cannot flush folders is none that broke; every descriptor is closed."""
    flushed, closed = [], []
    close, fsync = os.close, os.fsync
    monkeypatch.setattr(os, "close", lambda descriptor: (closed.append(descriptor), close(descriptor)))
    monkeypatch.setattr(
        os, "fsync", lambda descriptor: (flushed.append(os.fstat(descriptor).st_ino), fsync(descriptor))
    )
    write_atomic(tmp_path / "a", b"1")
    assert flushed[-1] == tmp_path.stat().st_ino
    assert closed

    def refuse(descriptor: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", refuse)
    before = len(closed)
    with pytest.raises(OSError, match="Input/output error") if number == errno.EIO else contextlib.nullcontext():
        sync_folder(tmp_path)
    assert len(closed) == before + 1


def test_a_log_of_exactly_the_largest_size_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "events.jsonl"
    line = b'{"v": 1, "seq": 0, "kind": "a"}\n'
    path.write_bytes(line * 3)
    monkeypatch.setattr(events_module, "LARGEST_LOG", 3 * len(line))
    assert len(read_events(path)[0]) == 3
    assert read_events(path, len(line))[1] == 3 * len(line)
    monkeypatch.setattr(events_module, "LARGEST_LOG", 3 * len(line) - 1)
    with pytest.raises(InputError, match="MB of events"):
        read_events(path)
    assert len(read_events(path, len(line))[0]) == 2


def test_a_sweep_takes_temporary_files_of_every_folder_and_nothing_else(tmp_path: Path) -> None:
    half = [".metrics.json.12.tmp", ".a.b.ply.7.tmp", ".tmpab12_Z"]
    kept = ["a.12.tmp", ".a.12.tmp~", ".a.x.tmp", ".tmpab12", ".tmpab12_Zy", "metrics.json", "..12.tmp"]
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        for name in (*half, *kept):
            (tmp_path / folder / name).write_bytes(b"")
    sweep(tmp_path / "one", tmp_path / "two")
    for folder in ("one", "two"):
        assert sorted(os.listdir(tmp_path / folder)) == sorted(kept)


def test_an_event_names_its_time_in_milliseconds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events_module.time, "time", lambda: 1234.56789)
    writer = EventWriter(tmp_path)
    event = writer.emit("started")
    writer.close()
    assert event == {"v": 1, "seq": 0, "kind": "started", "time": 1234.568}
    assert read_events(tmp_path / "events.jsonl")[0] == [event]


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such rights")
def test_the_owner_alone_may_write_a_log_and_all_may_read_it(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        EventWriter(tmp_path).close()
    finally:
        os.umask(before)
    assert (tmp_path / "events.jsonl").stat().st_mode & 0o777 == 0o644


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="the system does not list open files")
def test_a_writer_that_is_refused_keeps_no_file_open(tmp_path: Path) -> None:
    writer = EventWriter(tmp_path)
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(UsageError):
        EventWriter(tmp_path)
    assert len(os.listdir("/proc/self/fd")) == before
    writer.close()
    assert len(os.listdir("/proc/self/fd")) == before - 1
