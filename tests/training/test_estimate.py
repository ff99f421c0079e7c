"""Memory and time are estimated before the first step, near what runs took, and a run that cannot fit is refused."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from run_configs import tiny_config
from tiny_scenes import write_dataset

from gsopt.cli.console import estimate_line
from gsopt.config.train import TrainConfig
from gsopt.errors import InputError, UsageError
from gsopt.events import read_events
from gsopt.training import estimate as estimates
from gsopt.training.estimate import free_memory, of_sizes
from gsopt.training.loop import train

ROOT = Path(__file__).resolve().parents[2]
# Width, height, channels of the scenes of the suite, and the spherical harmonics of the arm `3dgs`.
SIZES = {"fox": (270, 480, 3), "lego": (400, 400, 4)}
MEMORY_TOLERANCE = 0.2
"""Share of the measured peak: Python's allocator, and the images that a decoder holds at full size."""
TIME_TOLERANCE = 2.6
"""Factor of the measured CPU time: scenes differ in how many splats share a pixel, few photos of a room most."""


def measured() -> list[tuple[str, dict]]:
    """Runs of the arm `3dgs`, which keeps its Gaussians and its resolution from the first step."""
    runs = json.loads((ROOT / "experiments/results/suite-sparse.json").read_text(encoding="utf-8"))["runs"]
    names = [(next((name for name in SIZES if name in run["scene"]), ""), run) for run in runs]
    return [(name, run) for name, run in names if name and run["arm"] == "3dgs" and run["seed"] == 0]


@pytest.mark.parametrize(("scene", "run"), measured(), ids=lambda v: v if isinstance(v, str) else v["key"])
def test_the_estimate_is_near_what_runs_took(scene: str, run: dict) -> None:
    width, height, channels = SIZES[scene]
    seen, held_out = run["views_in"], len(run["views_out"])
    images = width * height * channels * (5 * seen + held_out)
    found = of_sizes(run["n_gaussians"], 3, width * height, images, run["iterations"])
    assert found.memory / 1e6 == pytest.approx(run["peak_memory_mb"], rel=MEMORY_TOLERANCE)
    ratio = found.seconds / run["train_cpu_seconds"]
    assert 1 / TIME_TOLERANCE < ratio < TIME_TOLERANCE


def test_a_run_that_cannot_fit_is_refused_with_what_would(tmp_path: Path) -> None:
    config = tiny_config(write_dataset(tmp_path / "data"))
    tight = replace(config, max_memory="200MB")
    with pytest.raises(InputError, match=r"needs about .* there are 200 MB.*-r 2"):
        train(tight, tmp_path / "run")
    assert not list((tmp_path / "run").glob("checkpoints/*"))
    result = train(replace(config, max_memory="4GB"), tmp_path / "run", resume=True)
    assert not result.stopped


def test_the_advice_fits() -> None:
    large = of_sizes(1_000_000, 3, 400 * 400, 10**8, 7000)
    with pytest.raises(InputError) as refusal:
        large.require(10**9)
    advised = re.search(r"--max-gaussians (\d+)", str(refusal.value))
    assert advised is not None
    of_sizes(int(advised[1]), 3, 400 * 400, 10**8, 7000).require(10**9)
    with pytest.raises(InputError):
        of_sizes(int(advised[1]) + 2000, 3, 400 * 400, 10**8, 7000).require(10**9)


def test_the_estimate_stands_in_the_run(tmp_path: Path) -> None:
    config = tiny_config(write_dataset(tmp_path / "data"))
    train(config, tmp_path / "run")
    started = next(event for event in read_events(tmp_path / "run" / "events.jsonl")[0] if event["kind"] == "started")
    expected = json.loads((tmp_path / "run" / "config.json").read_bytes())["estimate"]
    assert started["estimate"] == expected
    if expected is not None:
        assert re.fullmatch(r"estimate: about 0\.3 GB of memory, 0:0\d of one core", estimate_line(expected))


def test_free_memory_is_that_of_the_machine_or_of_its_container(tmp_path: Path) -> None:
    assert free_memory(tmp_path) is None
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc" / "meminfo").write_text("MemTotal: 9000 kB\nMemAvailable:    8000 kB\n")
    assert free_memory(tmp_path) == 8000 * 1024
    group = tmp_path / "sys" / "fs" / "cgroup"
    group.mkdir(parents=True)
    (group / "memory.current").write_text("1000\n")
    (group / "memory.max").write_text("max\n")
    assert free_memory(tmp_path) == 8000 * 1024
    (group / "memory.max").write_text("5000\n")
    assert free_memory(tmp_path) == 4000


def test_a_machine_that_reports_no_memory_refuses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimates, "free_memory", lambda: None)
    assert estimates.memory_limit(TrainConfig()) is None
    assert estimates.memory_limit(TrainConfig(max_memory="2GB")) == 2_000_000_000


@pytest.mark.parametrize("text", ["much", "-1GB", "0GB", "8XB", "1e99GB"])
def test_a_size_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="--max-memory"):
        TrainConfig(max_memory=text)
