"""Programs that the panel starts: begun with a clean environment, watched, ended, and what they report."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from job_records import HOSTILE_RECORDS, record_of, wait

from blender_addon.core import job
from blender_addon.core.errors import InputError, UsageError


def test_blenders_python_variables_do_not_reach_another_python() -> None:
    blenders = {"PYTHONPATH": "/b", "PYTHONHOME": "/b", "BLENDER_USER_RESOURCES": "/b", "VIRTUAL_ENV": "/b"}
    loader = {"LD_LIBRARY_PATH": "/opt/Blender/lib"}
    ours = {"PATH": "/usr/bin", "HOME": "/home/a", "LANG": "C"}
    clean = job.clean_environment({**blenders, **loader, **ours})
    assert not set(clean) & {*blenders, *loader}
    assert ours.items() <= clean.items()


def test_arguments_arrive_as_they_are(odd_folder: Path) -> None:
    words = ["a b", "$(touch x)", "; rm -rf .", "'", '"', "öß春", "*"]
    script = "import json, os, sys; print(json.dumps([sys.argv[1:], os.getcwd(), sys.flags.utf8_mode]))"
    running = job.start("doctor", [sys.executable, "-c", script, *words], odd_folder / "job")
    wait(running)
    heard = json.loads((odd_folder / "job" / job.OUTPUT).read_text(encoding="utf-8"))
    assert heard == [words, str((odd_folder / "job").resolve()), 1]
    assert job.exit_code(running) == 0
    assert job.read_job(odd_folder / "job") == running


def test_a_job_is_ended_with_all_it_started(tmp_path: Path) -> None:
    script = "import subprocess, sys, time\nsubprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
    running = job.start("train", [sys.executable, "-c", script + "print('up'); time.sleep(60)"], tmp_path)
    until = time.monotonic() + 20
    while job.last_words(running) != "up":
        assert time.monotonic() < until
        time.sleep(0.02)
    if hasattr(os, "getpgid"):
        assert os.getpgid(running.pid) == running.pid, "a group of its own: Blender's end does not end it"
    job.end(running)
    wait(running)
    job.end(running)
    assert not job.alive(running)


def test_what_was_said_last_and_why_it_failed(tmp_path: Path) -> None:
    script = "print('gsopt: There is no dataset in /x. Give one.'); print(); raise SystemExit(3)"
    running = job.start("train", [sys.executable, "-c", script], tmp_path)
    wait(running)
    assert job.complaint(running) == "gsopt: There is no dataset in /x. Give one."
    assert job.exit_code(running) == 3


def test_a_program_that_cannot_start_is_an_error_of_ours(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no-such-python"):
        job.start("train", [str(tmp_path / "no-such-python")], tmp_path / "a")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="Choose another folder"):
        job.start("train", [sys.executable], tmp_path / "file" / "below")


@pytest.mark.parametrize("record", ["", "[]", "{}", '{"version": 9}', '{"version": 1, "arguments": 3}'])
def test_a_damaged_record_is_refused(tmp_path: Path, record: str) -> None:
    (tmp_path / job.RECORD).write_text(record)
    with pytest.raises(InputError, match=r"job\.json"):
        job.read_job(tmp_path)


@pytest.mark.parametrize("changed", HOSTILE_RECORDS, ids=lambda changed: f"{changed!a:.40}")
def test_a_hostile_record_is_refused(tmp_path: Path, changed: dict[str, Any]) -> None:
    record_of(tmp_path, changed)
    with pytest.raises(InputError, match=r"job\.json is damaged"):
        job.read_job(tmp_path)


def test_a_record_speaks_of_its_own_folder_only(tmp_path: Path) -> None:
    (tmp_path / "private").mkdir()
    (tmp_path / "private" / job.OUTPUT).write_text("a secret")
    record_of(tmp_path / "a", {"folder": str(tmp_path / "private")})
    assert job.last_words(job.read_job(tmp_path / "a")) == ""


def test_a_record_that_names_a_foreign_process_neither_lives_nor_ends_it(tmp_path: Path) -> None:
    """A downloaded job.json may name any process id; only what was started as this job counts."""
    sleep = "import time; time.sleep(60)"
    foreign = subprocess.Popen([sys.executable, "-c", sleep], start_new_session=True)
    ours = job.start("train", [sys.executable, "-c", sleep], tmp_path / "ours")
    try:
        for pid in (foreign.pid, ours.pid):
            record_of(tmp_path / f"{pid}", {"pid": pid, "started": time.time()})
            found = job.read_job(tmp_path / f"{pid}")
            for record in (found, replace(found, identity="")):
                assert not job.alive(record)
                job.end(record, force=True)
        time.sleep(0.2)
        assert foreign.poll() is None
        assert job.alive(ours)
    finally:
        foreign.kill()
        foreign.wait()
        job.end(ours, force=True)
        wait(ours)


@pytest.mark.skipif(not job.BOOT.is_file(), reason="Linux names its starts")
def test_a_record_from_before_a_restart_names_no_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    running = job.start("train", [sys.executable, "-c", "import time; time.sleep(60)"], tmp_path / "job")
    assert job.alive(running)
    with monkeypatch.context() as patch:
        patch.setattr(job, "BOOT", tmp_path / "boot_id")
        (tmp_path / "boot_id").write_text("another\n")
        assert not job.alive(running)
    job.end(running, force=True)
    wait(running)


def test_where_no_process_can_be_identified_only_children_live(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(job, "identity", lambda pid: "")
    running = job.start("train", [sys.executable, "-c", "import time; time.sleep(60)"], tmp_path / "job")
    assert job.alive(running)
    assert not job.alive(replace(running, pid=os.getpid()))
    job.end(running, force=True)
    wait(running)


def test_what_no_record_can_hold_is_an_error_of_ours(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No JSON file can hold"):
        job.start("train", [sys.executable, "-c", "", "\udcff"], tmp_path)
    assert not (tmp_path / job.RECORD).exists()


def test_a_job_outlives_a_killed_blender_and_is_found_again(tmp_path: Path) -> None:
    root = Path(__file__).resolve().parents[2]
    script = (
        f"import os, pathlib, sys\nsys.path.insert(0, {str(root)!r})\nfrom blender_addon.core import job\n"
        f"job.start('train', [sys.executable, '-c', 'import time; time.sleep(60)'], pathlib.Path({str(tmp_path)!r}))\n"
        "os.kill(os.getpid(), 9)\n"
    )
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode != 0
    found = job.read_job(tmp_path)
    assert job.alive(found)
    assert job.exit_code(found) is None
    job.end(found)
    until = time.monotonic() + 20
    while job.alive(found):
        assert time.monotonic() < until
        time.sleep(0.02)


def test_a_program_whose_record_cannot_be_written_does_not_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = set(job._children)
    with pytest.raises(InputError, match="No JSON file can hold"):
        job.start("train", [sys.executable, "-c", "import time; time.sleep(60)", "\udcff"], tmp_path)
    (pid,) = set(job._children) - known
    assert job._children[pid].wait(10) != 0
