"""Following a run: whatever stands in events.jsonl, a poll is short, tells what is known and never raises."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from blender_addon.core import run_follower
from blender_addon.core.errors import InputError
from blender_addon.core.run_follower import PIECE, Follower, earlier_runs, splats_of


def line(kind: str, seq: int = 0, v: int = 1, **fields: Any) -> bytes:
    return json.dumps({"v": v, "seq": seq, "kind": kind, "time": 1.8e9, **fields}).encode() + b"\n"


def append(run: Path, data: bytes) -> None:
    with open(run / "events.jsonl", "ab") as file:
        file.write(data)


STARTED = line("started", total=100, step=0, pid=os.getpid(), n=5)


def test_events_are_told_as_they_come(tmp_path: Path) -> None:
    follower = Follower(tmp_path)
    assert follower.poll().status == "waiting"
    append(tmp_path, STARTED)
    assert (follower.poll().status, follower.run.total, follower.run.count) == ("running", 100, 5)
    append(tmp_path, line("progress", 1, step=40, total=100, psnr=21.5, eta_seconds=3.0, n=9, loss=0.1))
    run = follower.poll()
    assert (run.step, run.total, run.psnr, run.eta, run.count) == (40, 100, 21.5, 3.0, 9)
    append(tmp_path, line("warning", 2, message="thin\x00 air\nhere"))
    assert follower.poll().messages == ["thin\x00 air here"]
    append(tmp_path, line("done", 3, step=100, n=12, seconds=1.0))
    assert (follower.poll().status, follower.run.step, follower.run.count) == ("done", 100, 12)
    append(tmp_path, STARTED)
    assert follower.poll().status == "running", "a resumed run goes on"


def test_half_a_line_waits_for_its_rest(tmp_path: Path) -> None:
    follower = Follower(tmp_path)
    event = line("progress", 1, step=7, total=10)
    for at in range(1, len(event) - 1, 9):
        (tmp_path / "events.jsonl").write_bytes(STARTED + event[:at])
        assert follower.poll().step == 0
    append(tmp_path, event[at:])
    assert follower.poll().step == 7


@pytest.mark.parametrize(
    "garbage",
    [
        b"\n",
        b"not json\n",
        b"\xff\xfe\x00\n",
        b"[1, 2]\n",
        b"null\n",
        b'{"kind": "done"}\n',
        b'{"v": 1, "seq": "x", "kind": "done"}\n',
        b"[" * 100_000 + b"\n",
        line("sang a song", 5, tune=1),
        line("progress", 5, step="x", total=None, n=-4, psnr="high", eta_seconds=[]),
        line("progress", 5, step=10**30, n=True),
        line("preview", 5, path="../../etc/passwd"),
        line("preview", 5, path=["x"]),
    ],
)
def test_garbage_is_skipped(tmp_path: Path, garbage: bytes) -> None:
    append(tmp_path, STARTED + garbage + line("progress", 9, step=3, total=100, n=6))
    run = Follower(tmp_path).poll()
    assert (run.status, run.step, run.total, run.count, run.preview) == ("running", 3, 100, 6, "")


def test_a_higher_protocol_is_refused_with_words(tmp_path: Path) -> None:
    append(tmp_path, STARTED + line("started", 1, v=2))
    follower = Follower(tmp_path)
    assert follower.poll().status == "unreadable"
    assert "protocol version 2" in follower.run.problem
    append(tmp_path, line("done", 2))
    assert follower.poll().status == "unreadable"


def test_100_mb_of_log_take_a_piece_per_poll(tmp_path: Path) -> None:
    with open(tmp_path / "events.jsonl", "wb") as file:
        file.write(STARTED)
        block = line("progress", 1, step=1, total=100, psnr=1.0) * 8000
        while file.tell() < 100 << 20:
            file.write(block)
        file.write(line("progress", 2, step=99, total=100, psnr=30.0))
    follower = Follower(tmp_path)
    began = time.process_time()
    polls = 0
    while follower.poll().step != 99:
        polls += 1
        assert polls < 5
    print("CPU seconds of the polls:", time.process_time() - began)
    assert follower.run.status == "running"


def test_a_run_whose_beginning_was_skipped_is_over_once_it_is_silent(tmp_path: Path) -> None:
    append(tmp_path, STARTED + line("progress", 1, step=1, total=100) * (run_follower.FAR_BEHIND // 64))
    follower = Follower(tmp_path)
    assert (follower.poll().status, follower.run.pid) == ("running", 0)
    os.utime(tmp_path / "events.jsonl", (0, time.time() - run_follower.SILENCE - 1))
    assert follower.poll().status == "killed"


@pytest.mark.parametrize("fields", [{"psnr": 10**400}, {"eta_seconds": 1e308}, {"step": 10**400}, {"n": -1}])
def test_numbers_that_no_property_holds_are_nothing(tmp_path: Path, fields: dict[str, Any]) -> None:
    append(tmp_path, STARTED + line("progress", 1, **fields) + line("preview", 2, path="a\x00b"))
    run = Follower(tmp_path).poll()
    assert (run.status, run.step, run.psnr, run.eta, run.count, run.preview) == ("running", 0, None, None, 5, "")


def test_a_line_longer_than_a_piece_is_skipped(tmp_path: Path) -> None:
    append(tmp_path, STARTED + b"x" * (3 * PIECE) + b"\n" + line("progress", 2, step=9, total=100))
    follower = Follower(tmp_path)
    for _ in range(6):
        follower.poll()
    assert follower.run.step == 9


def test_previews_inside_the_run_are_announced(tmp_path: Path) -> None:
    append(tmp_path, STARTED + line("preview", 1, step=5, path="previews/step_000005.ply"))
    assert Follower(tmp_path).poll().preview == str((tmp_path / "previews" / "step_000005.ply").resolve())


def test_a_killed_run_is_noticed_without_its_parent(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    append(tmp_path, line("started", total=10, step=0, pid=process.pid))
    follower = Follower(tmp_path)
    assert follower.poll().status == "running"
    process.kill()
    process.wait()
    assert follower.poll().status == "killed"
    assert "Resume" in follower.run.problem


def test_a_run_that_never_began_is_over_after_a_while(tmp_path: Path) -> None:
    follower = Follower(tmp_path)
    assert follower.poll().status == "waiting"
    os.utime(tmp_path, (0, time.time() - run_follower.SILENCE - 1))
    assert follower.poll().status == "error"
    append(tmp_path, STARTED)
    assert follower.poll().status == "running", "it was only slow"


def test_another_program_with_the_same_process_id_is_not_the_run(tmp_path: Path) -> None:
    if run_follower.jobs.birth(os.getpid()) is None:
        pytest.skip("this system does not say when a process began")
    event = json.loads(line("started", total=10, step=0, pid=os.getpid()))
    append(tmp_path, json.dumps({**event, "time": 1000.0}).encode() + b"\n")
    assert Follower(tmp_path).poll().status == "killed"


def test_a_log_that_shrank_is_read_anew(tmp_path: Path) -> None:
    append(tmp_path, STARTED + line("progress", 1, step=80, total=100))
    follower = Follower(tmp_path)
    assert follower.poll().step == 80
    (tmp_path / "events.jsonl").write_bytes(STARTED)
    assert follower.poll().step == 0


def test_text_that_no_property_holds_is_escaped(tmp_path: Path) -> None:
    append(tmp_path, STARTED + line("warning", 1, message="a\ud800b") + line("preview", 2, path="\udcff.ply"))
    append(tmp_path, line("warning", 3, message=["x"]))
    run = Follower(tmp_path).poll()
    assert (run.messages, run.preview) == (["a\\ud800b", ""], "")


def test_a_request_to_stop_follows_no_symlink(tmp_path: Path) -> None:
    run, target = tmp_path / "run", tmp_path / "target"
    run.mkdir()
    for _ in range(2):  # asked twice, the file is there already
        run_follower.ask_to_stop(run)
    assert (run / "stop").is_file()
    (run / "stop").unlink()
    (run / "stop").symlink_to(target)
    with pytest.raises(InputError, match="Cannot write"):
        run_follower.ask_to_stop(run)
    assert not target.exists()
    target.write_text("kept")
    os.utime(target, (0, 0))
    with pytest.raises(InputError, match="Cannot write"):
        run_follower.ask_to_stop(run)
    assert (target.read_text(), target.stat().st_mtime) == ("kept", 0)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes with names are POSIX")
def test_a_request_to_stop_waits_for_no_pipe(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "stop")
    with pytest.raises(InputError, match="Cannot write"):
        run_follower.ask_to_stop(tmp_path)


def test_the_newest_splats_and_runs_are_found(tmp_path: Path) -> None:
    run = tmp_path / "a"
    (run / "previews").mkdir(parents=True)
    assert splats_of(run) is None
    for step in (25, 1000, 500):
        (run / "previews" / f"step_{step:06}.ply").touch()
    assert splats_of(run) == run / "previews" / "step_001000.ply"
    (run / "splat.ply").touch()
    assert splats_of(run) == run / "splat.ply"
    (run / "config.json").touch()
    (tmp_path / "no run").mkdir()
    assert earlier_runs(tmp_path) == [run]
    assert earlier_runs(tmp_path / "gone") == []
