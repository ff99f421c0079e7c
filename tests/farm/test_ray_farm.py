"""Laws of a farm on Ray: the same outcomes and the same bytes as local processes, also when a node dies."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from farm_jobs import MEGABYTE, job
from test_local_farm import files, gone
from tiny_scenes import write_dataset

from gsopt.benchmark.suite import definition, result_file, runner
from gsopt.benchmark.suite.single_run import SuiteContext
from gsopt.config.train import TrainConfig
from gsopt.errors import InputError, MissingDependency, UsageError
from gsopt.farm import ray_farm
from gsopt.farm.job import Job, Outcome
from gsopt.farm.local import LocalFarm
from gsopt.farm.open import open_farm
from gsopt.farm.ray_farm import RayFarm
from gsopt.many_scenes.scenes import read_scenes
from gsopt.many_scenes.train_scenes import Limits, train_scenes
from gsopt.training.cells import run as cells_run
from gsopt.training.cells import worker
from gsopt.training.cells.run import train_in_cells

pytestmark = pytest.mark.xdist_group("ray")

DIFFERENT = ("setup_cpu_seconds", "train_cpu_seconds", "peak_memory_mb", "load", "curve", "machine")
"""Times, memory, and the machine."""

DRIVER = """
import sys
sys.path[:0] = {paths!r}
import ray
ray.__version__ = {version!r} or ray.__version__
from pathlib import Path
from farm_jobs import job
from gsopt.errors import GsoptError
from gsopt.farm.ray_farm import RayFarm
try:
    farm = RayFarm()
except GsoptError as error:
    sys.exit(f"refused: {{error}}")
out = Path({out!r})
for outcome in farm.run([job("a", folder=out / "a"), job("b", "hang", out / "b", pids={pids!r})]):
    print(outcome.job.name, flush=True)
"""


class InProcess:
    """A farm whose jobs take no seconds to start."""

    def run(self, jobs: list[Job]) -> Iterator[Outcome]:
        return (Outcome(one, "done", worker.handle(one.request)) for one in jobs)


def by_name(farm: Any, *jobs: Job) -> dict[str, Outcome]:
    return {outcome.job.name: outcome for outcome in farm.run(jobs)}


def six(out: Path, source: Path, seconds: float = 0.0) -> list[Job]:
    return [job(f"m{i}", "work", out / f"m{i}", source=str(source), inputs=(source,), seconds=600.0) for i in range(6)]


def test_what_goes_wrong_is_named_and_costs_one_job(cluster: Any, tmp_path: Path) -> None:
    ways = ("work", "bad", "die", "late death", "work")
    jobs = [job(f"{n} {way}", way, tmp_path / f"{n} {way}") for n, way in enumerate(ways)]
    jobs.append(job("5 hang", "hang", tmp_path / "5 hang", seconds=2.0))
    jobs.append(job("6 leak", "leak", memory=150 * MEGABYTE))
    found = by_name(RayFarm(), *jobs)
    endings = ["done", "failed", "died", "died", "done", "late", "memory"]
    assert [found[one.name].ending for one in jobs] == endings
    assert found["1 bad"].error == "It is bad. Mend it."
    assert "exit code 7" in found["2 die"].error
    assert found["0 work"].host == socket.gethostname()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0 work", "4 work"]


def test_three_nodes_of_which_one_dies_write_what_local_workers_write(cluster: Any, tmp_path: Path) -> None:
    source = tmp_path / "source.txt"
    source.write_text("from the driver")
    assert all(outcome.ending == "done" for outcome in LocalFarm(2).run(six(tmp_path / "local", source)))
    assert all(outcome.ending == "done" for outcome in RayFarm().run(six(tmp_path / "one", source)))
    nodes = [cluster.add_node(num_cpus=1, object_store_memory=100 << 20) for _ in range(2)]
    cluster.wait_for_nodes()
    out = tmp_path / "three"
    jobs = [
        Job(one.name, one.command, {**one.request, "seconds": 1.5}, one.folder, one.inputs) for one in six(out, source)
    ]
    found: list[Outcome] = []
    for outcome in RayFarm().run(jobs):
        found.append(outcome)
        if len(found) == 1:
            cluster.remove_node(nodes[0], allow_graceful=False)
    cluster.remove_node(nodes[1], allow_graceful=False)
    assert {outcome.ending for outcome in found} == {"done"}
    assert len(found) == 6
    assert files(tmp_path / "local") == files(tmp_path / "one") == files(out)
    assert len(files(out)) == 6


def test_a_node_without_the_drivers_disk_gets_inputs_and_sends_results(cluster: Any, tmp_path: Path) -> None:
    source = tmp_path / "source.txt"
    source.write_text("sent")
    found = list(RayFarm(transfer=True).run(six(tmp_path / "out", source)))
    assert {outcome.ending for outcome in found} == {"done"}
    assert {outcome.answer["text"] for outcome in found} == {"sent"}
    assert sorted(files(tmp_path / "out").values()) == [f"m{i} sent".encode() for i in range(6)]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [f"m{i}" for i in range(6)]


def test_a_job_that_writes_in_place_wants_a_shared_folder(
    cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert by_name(RayFarm(), job("a", writes=(tmp_path,)))["a"].ending == "done"
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(ray_farm, "_mark", lambda folders: {str(folder): "/not/here" for folder in folders})
    (outcome,) = RayFarm().run([job("a", writes=(tmp_path,))])
    assert outcome.ending == "failed"
    assert f"does not see {tmp_path}" in outcome.error


def test_a_node_with_another_gsopt_is_named(cluster: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_farm, "__version__", "0.0.1")
    (outcome,) = RayFarm().run([job("a")])
    assert outcome.ending == "failed"
    assert "the driver 0.0.1" in outcome.error


def test_a_full_disk_is_an_outcome(cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(content: bytes, place: Path) -> None:
        raise OSError(28, "No space left on device", str(place))

    monkeypatch.setattr(ray_farm, "unpacked", full)
    (outcome,) = RayFarm(transfer=True).run([job("a", folder=tmp_path / "a")])
    assert (outcome.ending, outcome.error) == ("failed", "Its result cannot be written: No space left on device.")
    assert list(tmp_path.iterdir()) == []


def test_a_job_larger_than_every_node_is_refused(cluster: Any) -> None:
    with pytest.raises(UsageError, match="needs 5 cores"):
        list(RayFarm().run([job("a", cpus=5)]))


def test_a_canceled_job_ends(cluster: Any, tmp_path: Path) -> None:
    farm, pids = RayFarm(), tmp_path / "pids"
    found: dict[str, Outcome] = {}
    for outcome in farm.run([job("a"), job("b", "hang", pids=str(pids)), job("c")]):
        found[outcome.job.name] = outcome
        farm.cancel("b")
    assert {name: outcome.ending for name, outcome in found.items()} == {"a": "done", "b": "canceled", "c": "done"}
    if pids.exists():
        worker, child = map(int, pids.read_text().split())
        assert gone(worker)
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)


def driver(cluster: Any, tmp_path: Path, version: str = "") -> subprocess.Popen[str]:
    here = Path(__file__).resolve()
    text = DRIVER.format(
        paths=[str(here.parent), str(here.parents[2])], version=version, out=str(tmp_path / "out"),
        pids=str(tmp_path / "pids"),
    )  # fmt: skip
    environment = {**os.environ, "RAY_ADDRESS": cluster.address}
    return subprocess.Popen(
        [sys.executable, "-c", text], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )


def test_a_killed_driver_loses_no_finished_job_and_leaves_no_worker(cluster: Any, tmp_path: Path) -> None:
    killed = driver(cluster, tmp_path)
    assert killed.stdout is not None
    assert killed.stdout.readline() == "a\n"
    pids, deadline = tmp_path / "pids", time.monotonic() + 60
    while time.monotonic() < deadline and not (pids.exists() and pids.read_text()):
        time.sleep(0.05)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    worker, child = map(int, pids.read_text().split())
    assert gone(worker, 60)
    with contextlib.suppress(ProcessLookupError):
        os.kill(child, signal.SIGKILL)  # Ray ends the worker before it could end a child that reads no input
    assert list(files(tmp_path / "out" / "a")) == ["below/text.txt"]
    assert not (tmp_path / "out" / "b").exists()
    (again,) = RayFarm().run([job("b", folder=tmp_path / "out" / "b")])
    assert again.ending == "done"


def test_a_ray_of_another_version_is_refused(cluster: Any, tmp_path: Path) -> None:
    refused = driver(cluster, tmp_path, version="1.2.3")
    _, error = refused.communicate(timeout=120)
    assert refused.returncode == 1, error
    assert "refused: The Ray cluster refused this driver, which has Ray 1.2.3" in error


def test_a_wrong_address_is_an_error(ray: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{unused.getsockname()[1]}"
        with pytest.raises(InputError, match=f"No Ray cluster answers at {address}"):
            open_farm(f"ray://{address}", 1)


def test_without_ray_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingDependency, match=r"gsopt\[ray\]"):
        open_farm("ray", 1)


def test_scenes_are_trained_to_the_same_bits_as_on_this_machine(cluster: Any, tmp_path: Path) -> None:
    scenes, flags = tmp_path / "scenes", ("--iterations", "8", "--lambda-sds", "0", "--init", "random")
    for name in ("a", "b"):
        write_dataset(scenes / name)
    runs = [tmp_path / "local", tmp_path / "ray"]
    for out, farm in zip(runs, (LocalFarm(2), RayFarm()), strict=True):
        found = train_scenes(read_scenes(scenes, flags), out, farm, Limits(), lambda line: None)
        assert [record["state"] for record in found] == ["done", "done"], found
    splats = [(out / name / "splat.ply").read_bytes() for out in runs for name in ("a", "b")]
    assert len(set(splats)) == 1


def test_a_scene_in_cells_has_the_same_bits_as_on_this_machine(
    cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = write_dataset(tmp_path / "cloud")
    few = {"density": {"max_gaussians": 90}, "init": {"method": "random", "count": 60}, "sparse": {"below_views": 0}}
    config = TrainConfig.of(iterations=16, cells="2", threads=1, data={"path": str(data)}, **few)
    for name, farm in (("local", InProcess()), ("ray", RayFarm())):
        monkeypatch.setattr(cells_run, "open_farm", lambda name, cpus, farm=farm: farm)
        train_in_cells(config, tmp_path / name, name)
    plans, splats = (
        [(tmp_path / name / file).read_bytes() for name in ("local", "ray")] for file in ("plan.json", "splat.ply")
    )
    assert plans[0] == plans[1]
    assert splats[0] == splats[1]


def test_a_suite_has_the_same_figures_as_on_this_machine(cluster: Any, tmp_path: Path) -> None:
    suite = definition.load("smoke")
    cases = [case for case in definition.cases(suite, 1) if case.arm == "ours-0"]
    documents = []
    for name, farm in (("local", LocalFarm(1)), ("ray", RayFarm())):
        file = tmp_path / name / "r.json"
        context = SuiteContext(definition.find_root(suite, None), runner.work_folder(file), 1)
        assert runner.run_suite(file, suite, "c", cases, context, lambda line: None, farm) == []
        (run,) = result_file.read(file)["runs"]
        documents.append({key: value for key, value in run.items() if key not in DIFFERENT})
    assert documents[0] == documents[1]
