"""The run directory's two files: whole or absent, and readable while they are written."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsopt.errors import InputError, UsageError
from gsopt.events import LARGEST_LOG, EventWriter, read_events, to_json, write_atomic

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
