"""A run is followed piece by piece: what is behind, what is cut, and when silence counts."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from blender_addon.core import run_follower
from blender_addon.core.run_follower import Follower, Run, ask_to_stop, whole


def event(kind: str, width: int = 50, **fields: Any) -> bytes:
    """One line of so many bytes."""
    text = json.dumps({"seq": 1, "v": 1, "kind": kind, **fields}, separators=(",", ":"))
    assert len(text) < width
    return text.ljust(width - 1).encode() + b"\n"


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The events of a run, of which 100 bytes are read at a time."""
    monkeypatch.setattr(run_follower, "PIECE", 100)
    return tmp_path / "events.jsonl"


def followed(log: Path, polls: int, told: int = 0) -> Run:
    follower = Follower(log.parent, told=told)
    for _ in range(polls):
        follower.poll()
    return follower.run


def test_a_run_of_which_nothing_is_known_has_no_steps_and_no_process(tmp_path: Path) -> None:
    run = Run(tmp_path)
    assert (run.status, run.step, run.total, run.count, run.pid, run.began) == ("waiting", 0, 0, 0, 0, 0)
    assert (run.psnr, run.eta, run.preview, run.messages, run.problem) == (None, None, "", [], "")
    assert (whole(None), whole("3"), whole(True), whole(-1), whole(3)) == (0, 0, 0, 0, 3)


def test_silence_counts_once_all_that_was_written_is_read(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Here any silence is too long. Two lines are a piece; the last piece ends with the file."""
    monkeypatch.setattr(run_follower, "SILENCE", -1.0)
    log.write_bytes(event("other") * 4)
    assert followed(log, 1).status == "waiting"
    run = followed(log, 2)
    assert run.status == "error"
    assert run.messages == [
        "It has said nothing for a long time and seems to have ended before its first step. See its log."
    ]


def test_half_a_line_that_is_all_there_is_leaves_nothing_behind(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_follower, "SILENCE", -1.0)
    log.write_bytes(event("other")[:30])
    assert followed(log, 1).status == "error"
    log.write_bytes(event("other") + event("other")[:30])
    assert followed(log, 1).status == "error"


def test_the_rest_of_a_line_longer_than_a_piece_is_no_event(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Though it reads like one. While such a line is skipped, silence does not count."""
    monkeypatch.setattr(run_follower, "SILENCE", -1.0)
    false, true = event("warning", 60, message="false"), event("warning", 60, message="true")
    log.write_bytes(b"x" * 100 + false + true)
    assert followed(log, 1).status == "waiting"
    assert followed(log, 3).messages[0] == "true"
    log.write_bytes(b"x" * 200 + false + true)
    assert followed(log, 5).messages[0] == "true"


def test_a_long_line_is_over_where_its_end_is_written_later(log: Path) -> None:
    """Lines that follow its end are taken, also the first line that is read then."""
    log.write_bytes(b"x" * 100)
    follower = Follower(log.parent)
    follower.poll()
    parts = (b"y" * 20, b"z\n", event("warning", 60, message="one"), event("warning", 60, message="two"))
    for part in parts:
        with log.open("ab") as file:
            file.write(part)
        follower.poll()
    assert follower.run.messages == ["one", "two"]


def test_what_is_behind_counts_from_where_the_reader_is(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader 200 bytes behind reads them all; one that is farther behind reads the last piece, from a whole line."""
    monkeypatch.setattr(run_follower, "FAR_BEHIND", 200)
    lines = b"".join(event("warning", 50, message=str(number)) for number in range(8))
    log.write_bytes(lines)
    assert followed(log, 9, told=200).messages == ["4", "5", "6", "7"]
    assert followed(log, 9, told=350).messages == ["7"]
    assert followed(log, 9, told=150).messages == ["7"]


def test_a_run_that_does_not_say_when_it_began_began_at_an_unknown_time(log: Path) -> None:
    log.write_bytes(event("started", 60, pid=os.getpid()))
    run = followed(log, 1)
    assert (run.began, run.pid) == (0, os.getpid())


def test_a_request_to_stop_may_be_taken_back_by_all_who_may_write_there(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        ask_to_stop(tmp_path)
    finally:
        os.umask(before)
    assert (tmp_path / "stop").stat().st_mode & 0o777 == 0o666
