"""Laws of a farm of local processes: every job has an outcome, and a job that goes wrong costs no other."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from farm_jobs import MEGABYTE, job

from gsopt.errors import UsageError
from gsopt.farm.job import PARTIAL, Job, Outcome, relocated
from gsopt.farm.local import LocalFarm
from gsopt.farm.open import open_farm
from gsopt.farm.worker import serving
from gsopt.raster.cpu_backend import ISA_VARIABLE

DEMO = Path(__file__).resolve().parents[2] / "gsopt" / "demo"
DRIVER = """
import sys
sys.path[:0] = {paths!r}
from pathlib import Path
from farm_jobs import job
from gsopt.farm.local import LocalFarm
jobs = [job("a", folder=Path({out!r}) / "a"), job("b", "hang", Path({out!r}) / "b", pids={pids!r})]
for outcome in LocalFarm(1).run(jobs):
    print(outcome.job.name, flush=True)
"""


def by_name(farm: LocalFarm, *jobs: Job) -> dict[str, Outcome]:
    return {outcome.job.name: outcome for outcome in farm.run(jobs)}


def gone(pid: int, seconds: float = 20.0) -> bool:
    """True when a process ends in time; a zombie has ended."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            return True
        if state == "Z":
            return True
        time.sleep(0.02)
    return False


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_what_goes_wrong_is_named_and_costs_one_job(tmp_path: Path) -> None:
    ways = ("work", "bad", "defect", "die", "late death", "work", "full")
    jobs = [job(f"{n} {way}", way, tmp_path / f"{n} {way}") for n, way in enumerate(ways)]
    found = by_name(LocalFarm(2), *jobs)
    assert [found[one.name].ending for one in jobs] == ["done", "failed", "failed", "died", "died", "done", "failed"]
    assert found["1 bad"].error == "It is bad. Mend it."
    assert "ZeroDivisionError: an oversight" in found["2 defect"].error
    assert "No space left" in found["6 full"].error
    assert "report" not in found["6 full"].error, "a full disk is no defect of ours"
    assert "exit code 7" in found["3 die"].error
    assert "talks about 3 die" in found["3 die"].output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0 work", "5 work"]


def test_a_job_beyond_its_time_is_ended_with_its_children(tmp_path: Path) -> None:
    pids = tmp_path / "pids"
    hangs = job("a", "hang", tmp_path / "a", seconds=2.0, pids=str(pids))
    found = by_name(LocalFarm(1), hangs, job("b"))
    assert (found["a"].ending, found["a"].error) == ("late", "It took longer than 2 s.")
    assert found["b"].ending == "done"
    assert all(gone(int(pid)) for pid in pids.read_text().split())


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is watched where /proc reports it")
def test_a_job_beyond_its_memory_is_ended() -> None:
    found = by_name(
        LocalFarm(1), job("a", "leak", memory=150 * MEGABYTE, seconds=60.0), job("b", memory=150 * MEGABYTE)
    )
    assert (found["a"].ending, found["b"].ending) == ("memory", "done")
    assert found["a"].error == "It held more than 157 MB of memory."
    assert found["a"].peak_memory > 150 * MEGABYTE


def test_a_worker_is_kept_for_the_next_job_unless_a_fresh_one_is_asked_for() -> None:
    warm = by_name(LocalFarm(1), *(job(name) for name in "abc"))
    assert len({outcome.answer["pid"] for outcome in warm.values()}) == 1
    fresh = by_name(LocalFarm(1), *(job(name, fresh=True) for name in "abc"))
    assert len({outcome.answer["pid"] for outcome in fresh.values()}) == 3


def test_threads_and_environment_are_those_of_the_job() -> None:
    found = by_name(LocalFarm(2), job("a", cpus=2, environment={"X": "avx2"}), job("b"))
    assert found["a"].answer["environment"] == {"OMP_NUM_THREADS": "2", "X": "avx2"}
    assert found["b"].answer["environment"] == {"OMP_NUM_THREADS": "1", "X": None}


def test_results_do_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    for cpus in (1, 3):
        jobs = [job(f"m{i}", folder=tmp_path / str(cpus) / f"m{i}", text=str(i)) for i in range(6)]
        assert all(outcome.ending == "done" for outcome in LocalFarm(cpus).run(jobs))
    assert files(tmp_path / "1") == files(tmp_path / "3")
    assert len(files(tmp_path / "1")) == 6


def test_no_more_runs_at_once_than_cores_and_memory_allow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each job takes its share when it starts and gives it back when it ends."""
    farm, least = LocalFarm(3, 100 * MEGABYTE), []
    real = farm._is_canceled

    def look(one: Job) -> bool:
        least.append((farm._free, farm._free_memory))
        return real(one)

    monkeypatch.setattr(farm, "_is_canceled", look)
    list(farm.run([job(f"{i}", cpus=1 + i % 2, memory=60 * MEGABYTE) for i in range(4)]))
    running = [free for free in least if free[1] < 100 * MEGABYTE]
    assert {memory for _, memory in running} == {40 * MEGABYTE}  # a second job would not fit
    assert (farm._free, farm._free_memory) == (3, 100 * MEGABYTE)


@pytest.mark.parametrize(("cpus", "memory"), [(2, None), (1, 200)])
def test_a_job_larger_than_the_farm_is_refused_before_any_is_started(cpus: int, memory: int, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"b needs .* the farm has"):
        list(LocalFarm(1, 100).run([job("a", folder=tmp_path / "a"), job("b", cpus=cpus, memory=memory)]))
    assert not (tmp_path / "a").exists()


def test_a_canceled_job_ends_whether_it_waits_or_runs(tmp_path: Path) -> None:
    farm = LocalFarm(1)
    found: dict[str, Outcome] = {}
    started: list[str] = []

    def report(line: str) -> None:
        started.append(line)
        if line.startswith("b"):
            farm.cancel("b")
            farm.cancel("c")

    for outcome in farm.run([job("a"), job("b", "hang"), job("c"), job("d")], report):
        found[outcome.job.name] = outcome
    assert {name: outcome.ending for name, outcome in found.items()} == {
        "a": "done", "b": "canceled", "c": "canceled", "d": "done",
    }  # fmt: skip
    assert started == ["a: started", "b: started", "d: started"]


def test_closing_the_outcomes_ends_what_runs(tmp_path: Path) -> None:
    pids = tmp_path / "pids"
    outcomes: Iterator[Outcome] = LocalFarm(2).run([job("a"), job("b", "hang", pids=str(pids)), job("c", "hang")])
    assert next(outcomes).job.name == "a"
    while not pids.exists() or not pids.read_text():
        time.sleep(0.02)
    outcomes.close()  # type: ignore[attr-defined]
    assert all(gone(int(pid)) for pid in pids.read_text().split())


def test_a_killed_driver_loses_no_finished_job_and_leaves_no_worker(tmp_path: Path) -> None:
    out, pids = tmp_path / "out", tmp_path / "pids"
    here = Path(__file__).resolve()
    text = DRIVER.format(paths=[str(here.parent), str(here.parents[2])], out=str(out), pids=str(pids))
    driver = subprocess.Popen([sys.executable, "-c", text], stdout=subprocess.PIPE, text=True)
    assert driver.stdout is not None
    assert driver.stdout.readline() == "a\n"
    while not pids.exists() or not pids.read_text():
        time.sleep(0.02)
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    assert all(gone(int(pid)) for pid in pids.read_text().split())
    assert list(files(out)) == ["a/below/text.txt"]


def test_a_folder_that_exists_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "mine.txt").write_text("mine")
    (tmp_path / f"{PARTIAL}1-b").mkdir()
    (tmp_path / f"{PARTIAL}1-b" / "of a killed run").touch()
    found = by_name(LocalFarm(1), job("a", folder=tmp_path / "a"), job("b", folder=tmp_path / "b"))
    assert found["a"].ending == "failed"
    assert "must be new" in found["a"].error
    assert list(files(tmp_path)) == [f"{PARTIAL}1-b/of a killed run", "a/mine.txt", "b/below/text.txt"]


def test_a_full_disk_is_an_outcome(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: Path, target: Path) -> Path:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(target))

    monkeypatch.setattr(Path, "rename", full)
    (outcome,) = LocalFarm(1).run([job("a", folder=tmp_path / "a")])
    assert outcome.ending == "failed"
    assert "No space left on device" in outcome.error
    assert list(tmp_path.iterdir()) == []


def test_a_program_that_is_missing_is_an_outcome() -> None:
    (outcome,) = LocalFarm(1).run([Job("a", ("/no/such/blender",), {})])
    assert (outcome.ending, outcome.error) == ("died", "Cannot start /no/such/blender: No such file or directory.")


def test_paths_move_whole() -> None:
    places = {Path("/data/a"): Path("/scratch/0")}
    request = {"in": "/data/a/x.obj", "beside": "/data/ab", "list": ["/data/a", 3], "deep": {"x": "not /data/a"}}
    assert relocated(request, places) == {
        "in": "/scratch/0/x.obj", "beside": "/data/ab", "list": ["/scratch/0", 3], "deep": {"x": "not /data/a"},
    }  # fmt: skip


@pytest.mark.parametrize("name", ["", "slurm", "local:", "local:0", "local:x", "local:9999", "ray:1", "ray://"])
def test_a_farm_of_another_name_is_refused(name: str) -> None:
    with pytest.raises(UsageError, match="farm"):
        open_farm(name, 1)


def test_a_farm_by_its_name() -> None:
    assert str(open_farm("local", 3)) == "this machine, 3 cores"
    assert str(open_farm("local:1", 3)) == "this machine, 1 core"


def test_a_machine_without_the_drivers_instruction_set_is_named(tmp_path: Path) -> None:
    """The bits of a run are promised per instruction set: a worker that lacks it takes no other."""
    words = ["train", str(DEMO), "-m", str(tmp_path / "run"), "--iterations", "1"]
    one = Job("demo", serving("gsopt.cli.serve_jobs"), {"arguments": words}, environment={ISA_VARIABLE: "sse9"})
    (outcome,) = LocalFarm(1).run([one])
    assert outcome.answer != 0
    assert "instruction set `sse9` is not available here" in outcome.output
    assert not (tmp_path / "run" / "splat.ply").exists()
