"""Memory and time are estimated before the first step, near what runs took, and a run that cannot fit is refused."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from run_configs import tiny_config
from tiny_scenes import cloud, write_dataset

from gsopt.cli.console import estimate_line
from gsopt.config.train import TrainConfig
from gsopt.errors import InputError, UsageError
from gsopt.events import read_events
from gsopt.geometry.cameras import Cameras
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


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize(("growing", "copies"), [(True, 8), (False, 5)])
def test_memory_is_linear_in_gaussians_pixels_and_images(degree: int, growing: bool, copies: int) -> None:
    """A Gaussian's parameters, so many times, and 700 bytes in the kernels; frozen ones without moments."""

    def memory(gaussians: int = 50, pixels: int = 9, images: int = 7, frozen: int = 0) -> int:
        return of_sizes(gaussians, degree, pixels, images, 30, frozen, growing).memory

    row = sum(4 * tensor.numel() for _, tensor in cloud(1, 0, sh_degree=degree).items())
    assert memory(51) - memory(50) == copies * row + 700
    assert memory(frozen=1) - memory() == 3 * row + 700
    assert memory(pixels=10) - memory(pixels=9) == 120
    assert memory(images=8) - memory(images=7) == 1
    assert memory(0, 0, 0) == estimates.BASE_BYTES == of_sizes(0, 3, 0, 0, 0).memory


def test_time_is_linear_in_steps_and_in_what_a_step_draws() -> None:
    def seconds(gaussians: int, pixels: int, steps: int, frozen: int = 0) -> float:
        return of_sizes(gaussians, 1, pixels, 0, steps, frozen).seconds

    assert seconds(10**6, 0, 7) == pytest.approx(7 * estimates.SECONDS_PER_GAUSSIAN * 10**6)
    assert seconds(0, 10**6, 7) == pytest.approx(7 * estimates.SECONDS_PER_PIXEL * 10**6)
    assert seconds(400, 9, 7, frozen=600) == seconds(1000, 9, 7)
    assert seconds(5, 6, 8) == pytest.approx(8 * (seconds(5, 0, 1) + seconds(0, 6, 1)))


def test_a_run_that_just_fits_is_not_refused() -> None:
    small = of_sizes(3000, 0, 100, 10**6, 10)
    small.require(small.memory)
    with pytest.raises(InputError, match=r"--max-gaussians 2000, a smaller image"):
        small.require(small.memory - 1)
    with pytest.raises(InputError, match=r"--max-gaussians 1000, a"):
        small.require(small.memory - 2000 * small.gaussian_bytes)
    with pytest.raises(InputError, match=r"Give a smaller image"):
        small.require(small.memory - 2000 * small.gaussian_bytes - 1)


@pytest.mark.parametrize(
    ("size", "text"),
    [(10**9, "1.0 GB"), (10**9 - 1, "1000 MB"), (1_550_000_000, "1.6 GB"), (1_400_000, "1 MB"), (-5, "0 MB")],
)
def test_sizes_are_told_in_megabytes_up_to_a_gigabyte(size: int, text: str) -> None:
    assert estimates.gigabytes(size) == text


@pytest.mark.parametrize("alpha", [True, False])
@pytest.mark.parametrize("strategy", ["adc", "mcmc"])
def test_the_estimate_of_a_run_counts_its_views(alpha: bool, strategy: str) -> None:
    """Decoded images of all views and float targets of the input views, each up to its cache; an mcmc run fills its
    budget, another one what its images ask for."""
    cameras = [Cameras(torch.eye(4)[None], torch.eye(3)[None], width, height) for width, height in ((10, 20), (30, 5))]
    black = torch.zeros(3, 4, 3, dtype=torch.uint8)
    views = [SimpleNamespace(camera=camera, pixels=lambda: black) for camera in cameras]
    scene: Any = SimpleNamespace(drawn=views, train=views, test=views[:1], has_alpha=alpha)
    channels = 4 if alpha else 3
    schedule = SimpleNamespace(iterations=100, max_sh_degree=2, refine_stop=50)
    plan: Any = SimpleNamespace(
        schedule=schedule, density=SimpleNamespace(max_gaussians=10**7, strategy=strategy), target_cache_mb=1e6
    )
    config = TrainConfig()
    whole = channels * (200 + 150 + 200) + 4 * channels * (200 + 150)
    assert estimates.image_bytes(config, plan, scene) == whole
    plan.target_cache_mb = 1 / 1024
    assert estimates.image_bytes(config, plan, scene) == channels * 550 + 1024
    uncached = replace(config, data=replace(config.data, cache_mb=0))
    assert estimates.image_bytes(uncached, plan, scene) == 1024
    expected = 10**7 if strategy == "mcmc" else 20_000  # the least budget: the images are tiny
    found = estimates.estimate(config, plan, scene, frozen=3)
    assert found == of_sizes(expected, 2, 200, channels * 550 + 1024, 100, 3)
    more = replace(config, init=replace(config.init, count=30_000))
    assert estimates.estimate(more, plan, scene).gaussians == max(expected, 30_000)
    schedule.refine_stop = 0
    assert estimates.estimate(config, plan, scene) == of_sizes(
        expected, 2, 200, channels * 550 + 1024, 100, growing=False
    )
