"""Limits of what the panel keeps and shows of a run and of a job."""

from __future__ import annotations

import ctypes
import json
import math
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
from job_records import record_of, wait

from blender_addon.core import job, run_follower
from blender_addon.core.errors import InputError
from blender_addon.core.run_follower import Follower, Run, earlier_runs, number, whole


def line(kind: str, seq: int = 0, **fields: Any) -> bytes:
    return json.dumps({"v": 1, "seq": seq, "kind": kind, "time": time.time(), **fields}).encode() + b"\n"


@pytest.mark.parametrize(
    ("value", "held"),
    [(0, 0), (2**31 - 1, 2**31 - 1), (2**31, 7), (-1, 7), (True, 7), (1.0, 7), ("1", 7), (None, 7)],
)
def test_whole_numbers_are_those_of_blenders_properties(value: object, held: int) -> None:
    assert whole(value, 7) == held


@pytest.mark.parametrize(
    ("value", "held"),
    [
        (0, 0.0),
        (-2.5, -2.5),
        (9.9e29, 9.9e29),
        (1e30, None),
        (-1e30, None),
        (math.nan, None),
        (False, None),
        ("1", None),
    ],
)
def test_numbers_are_those_of_blenders_properties(value: object, held: float | None) -> None:
    assert number(value) == held


@pytest.mark.parametrize("left_out", ["seq", "v"])
def test_a_line_without_one_of_its_two_numbers_is_no_event(left_out: str) -> None:
    whole_line = line("warning", message="a")
    lacking = {name: value for name, value in json.loads(whole_line).items() if name != left_out}
    lines = [json.dumps(lacking).encode(), whole_line]
    assert [event["seq"] for event in run_follower.events_in(lines, Path("events.jsonl"))] == [0]


def test_the_newest_fifty_messages_are_kept_and_none_twice_in_a_row() -> None:
    run = Run(Path())
    for i in range(60):
        for _ in range(2):
            run.say(i)
    assert run.messages == [str(i) for i in range(10, 60)]


def test_a_message_is_one_line_of_500_characters() -> None:
    run = Run(Path(), status="error")
    run.say("a\n b" + "c" * 600)
    assert run.problem == "a b" + "c" * 497
    assert replace(run, status="done").problem == ""


def test_an_idle_poll_takes_no_event_twice(tmp_path: Path) -> None:
    events = line("started", pid=os.getpid()) + line("warning", 1, message="a") + line("warning", 2, message="b")
    (tmp_path / "events.jsonl").write_bytes(events)
    follower = Follower(tmp_path)
    for _ in range(3):
        assert follower.poll().messages == ["a", "b"]


def test_a_session_begins_where_the_events_end(tmp_path: Path) -> None:
    assert run_follower.length(tmp_path) == 0
    path = tmp_path / "events.jsonl"
    path.write_bytes(line("started", pid=os.getpid(), total=5) + line("done", 1, step=5, total=5))
    follower = Follower(tmp_path, told=run_follower.length(tmp_path))
    assert follower.poll().status == "waiting"
    with open(path, "ab") as file:
        file.write(line("started", 2, pid=os.getpid(), total=9))
    assert (follower.poll().status, follower.run.total) == ("running", 9)


@pytest.mark.parametrize(
    ("events", "output", "status", "told"),
    [
        (b"", "print('gsopt: no such scene')", "error", "gsopt: no such scene"),
        (b"", "", "error", "it said nothing (exit code 0)"),
        (
            line("started", total=5),
            "print('x')",
            "killed",
            "It ended without a word. See the log. Continue it with Resume.",
        ),
        (line("started") + line("done", 1), "", "done", ""),
    ],
)
def test_a_job_that_ended_ends_its_run(tmp_path: Path, events: bytes, output: str, status: str, told: str) -> None:
    running = job.start("train", [sys.executable, "-c", output], tmp_path / "job")
    wait(running)
    if events:
        (tmp_path / "events.jsonl").write_bytes(events)
    found = Follower(tmp_path, running).poll()
    assert (found.status, found.problem) == (status, told)


def test_what_a_job_wrote_just_before_its_end_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "events.jsonl"
    path.write_bytes(line("started", total=5))
    running = job.start("train", [sys.executable, "-c", ""], tmp_path / "job")
    wait(running)

    def ends(_: job.Job) -> bool:
        with open(path, "ab") as file:
            file.write(line("done", 1, step=5))
        return False

    monkeypatch.setattr(job, "alive", ends)
    assert Follower(tmp_path, running).poll().status == "done"


def test_earlier_runs_are_told_from_the_newest_on(tmp_path: Path) -> None:
    for age, name in enumerate("dbca"):
        (tmp_path / name).mkdir()
        (tmp_path / name / ("config.json" if age % 2 else "events.jsonl")).touch()
        os.utime(tmp_path / name, (0, 1000 - age))
    assert [run.name for run in earlier_runs(tmp_path)] == list("dbca")
    assert [run.name for run in earlier_runs(tmp_path, 2)] == list("db")


@pytest.mark.parametrize(("seconds", "status"), [(890, "waiting"), (910, "error")])
def test_a_folder_that_is_silent_for_a_quarter_of_an_hour_holds_no_run(
    tmp_path: Path, seconds: int, status: str
) -> None:
    os.utime(tmp_path, (0, time.time() - seconds))
    assert Follower(tmp_path).poll().status == status


def test_a_sequence_is_of_two_splats_at_least(tmp_path: Path) -> None:
    (tmp_path / "previews").mkdir()
    names = ["previews/step_000500.ply", "previews/step_001000.ply"]
    (tmp_path / names[0]).touch()
    (tmp_path / "previews" / ".step_000001.ply").touch()
    with pytest.raises(InputError, match="two or more"):
        run_follower.sequence_of(tmp_path)
    (tmp_path / names[1]).touch()
    assert run_follower.sequence_of(tmp_path) == [tmp_path / name for name in names]


@pytest.mark.parametrize(("after", "lives"), [(0.0, True), (1.5, True), (2.5, False)])
def test_a_process_is_the_one_that_was_there_two_seconds_after_the_word_of_it(
    monkeypatch: pytest.MonkeyPatch, after: float, lives: bool
) -> None:
    sleeper = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    try:
        monkeypatch.setattr(job, "birth", lambda pid: 1000.0 + after)
        assert job.process_alive(sleeper.pid, 1000.0) == lives
        assert not job.process_alive(0, 2000.0)
    finally:
        sleeper.kill()
        sleeper.wait()


@pytest.mark.skipif(not Path("/proc/uptime").is_file(), reason="Linux tells when a process began")
def test_the_birth_of_a_process_is_when_it_was_started() -> None:
    before = time.time()
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    try:
        born = job.birth(child.pid)
        assert born is not None
        assert before - 0.5 < born < time.time() + 0.5
    finally:
        child.kill()
        while job.proc_fields(child.pid)[0] != "Z":
            time.sleep(0.01)
        assert job.birth(child.pid) == math.inf
        child.wait()
    assert job.birth(child.pid) is None


def test_the_bounds_of_a_record_are_allowed_themselves(tmp_path: Path) -> None:
    for name in ("pid", "total"):
        for value in (0, 2**31 - 1):
            record_of(tmp_path, {name: value})
            assert getattr(job.read_job(tmp_path), name) == value
        record_of(tmp_path, {name: 2**31})
        with pytest.raises(InputError, match=r"below 2\^31"):
            job.read_job(tmp_path)


def finished(folder: Path, text: str) -> job.Job:
    """A job that has printed a text."""
    found = job.Job("train", str(folder), ("python",), 0, 0.0)
    (folder / job.OUTPUT).write_text(text, encoding="utf-8")
    return found


def test_the_last_line_that_says_something_is_told(tmp_path: Path) -> None:
    assert job.last_words(finished(tmp_path, "")) == ""
    assert job.last_words(finished(tmp_path, "a\n  b \n\n│ ─ ╯\n")) == "b"
    assert job.last_words(finished(tmp_path, "1 %\r2 %\r3 %")) == "3 %"
    assert job.last_words(finished(tmp_path, "x" * 600)) == "x" * 500


def test_the_last_line_that_complains_is_told_without_its_frame(tmp_path: Path) -> None:
    framed = "gsopt: first\n│ ValueError: second │\nTook 3 s\n\n"
    assert job.complaint(finished(tmp_path, framed)) == "ValueError: second"
    assert job.complaint(finished(tmp_path, "one\n╭── two ──╮\n")) == "two"
    assert job.complaint(finished(tmp_path, " \n")) == "it said nothing (exit code None)"
    assert job.complaint(finished(tmp_path, "error:" + "x" * 600)) == "error:" + "x" * 494


def test_the_end_of_an_output_is_read(tmp_path: Path) -> None:
    path = tmp_path / "log.txt"
    assert job.tail(path) == ""
    path.write_bytes(b"abcdef")
    assert [job.tail(path, size) for size in (1, 5, 6, 7)] == ["f", "bcdef", "abcdef", "abcdef"]
    path.write_bytes(b"x" * 70_000)
    assert len(job.tail(path)) == 65_536


def test_a_new_folder_has_the_first_number_that_is_free(tmp_path: Path) -> None:
    for expected in ("a-1", "a-2"):
        assert job.free_folder(tmp_path, "a").name == expected
        (tmp_path / expected).symlink_to(tmp_path / "nowhere")
    assert job.free_folder(tmp_path, "a").name == "a-3"


def test_another_python_gets_utf8_and_no_buffers() -> None:
    clean = job.clean_environment({"pythonpath": "/b", "Blender_X": "1", "LD_PRELOAD": "/lib/a.so", "A": "1"})
    assert clean == {"LD_PRELOAD": "/lib/a.so", "A": "1", "PYTHONUTF8": "1", "PYTHONUNBUFFERED": "1"}


class Kernel:
    """A stand-in for kernel32 of Windows, where process 7 runs, 8 has ended and no other is there."""

    codes: ClassVar[dict[int, int]] = {7: 259, 8: 0}

    def __init__(self) -> None:
        self.open: list[int] = []

    def OpenProcess(self, access: int, inherit: bool, pid: int) -> int:
        assert (access, inherit) == (0x1000, False)
        self.open += [pid] if pid in self.codes else []
        return pid if pid in self.codes else 0

    def GetExitCodeProcess(self, handle: int, code: Any) -> int:
        code._obj.value = self.codes[handle]
        return 1

    def GetProcessTimes(self, handle: int, created: Any, *others: Any) -> int:
        if handle:
            created._obj.value = 1000 + handle
        return int(handle > 0 and len(others) == 3)

    def CloseHandle(self, handle: int) -> int:
        self.open = [one for one in self.open if one != handle]
        return 1


def test_on_windows_a_process_lives_while_it_has_no_exit_code(monkeypatch: pytest.MonkeyPatch) -> None:
    kernel = Kernel()
    monkeypatch.setattr(ctypes, "windll", SimpleNamespace(kernel32=kernel), raising=False)
    assert [job._alive_on_windows(pid) for pid in (7, 8, 9)] == [True, False, False]
    assert [job._birth_on_windows(pid) for pid in (7, 8, 9)] == ["7 1007", "8 1008", ""]
    assert kernel.open == []


@pytest.mark.parametrize(("more", "total"), [(0, 5), (1, 0)])
def test_a_reader_skips_ahead_when_it_is_more_than_two_mebibytes_behind(tmp_path: Path, more: int, total: int) -> None:
    began = line("started", pid=os.getpid(), total=5)
    (tmp_path / "events.jsonl").write_bytes(began.ljust((2 << 20) + more, b"\n"))
    assert Follower(tmp_path).poll().total == total


def test_a_reader_that_skips_ahead_reads_the_last_quarter_of_a_mebibyte(tmp_path: Path) -> None:
    early, late, piece = line("warning", 1, message="early"), line("warning", 2, message="late"), 1 << 18
    before = early.rjust(3 << 20, b"\n")
    (tmp_path / "events.jsonl").write_bytes(before + (b"\n" + late).ljust(piece, b"\n"))
    follower = Follower(tmp_path)
    assert [follower.poll().messages for _ in range(2)] == [["late"], ["late"]]


def test_a_hundred_earlier_runs_are_told_where_nobody_asks_for_fewer(tmp_path: Path) -> None:
    for i in range(101):
        (tmp_path / str(i)).mkdir()
        (tmp_path / str(i) / "config.json").touch()
    assert len(earlier_runs(tmp_path)) == 100


@pytest.mark.parametrize(("age", "status"), [(895, "running"), (905, "killed")])
def test_a_run_of_an_unknown_process_goes_on_for_900_seconds_after_its_last_event(
    tmp_path: Path, age: int, status: str
) -> None:
    (tmp_path / "events.jsonl").write_bytes(line("progress", step=1, total=5))
    os.utime(tmp_path / "events.jsonl", (0, time.time() - age))
    assert Follower(tmp_path).poll().status == status
