"""A whole run on a GPU: its kernels run on this CPU, and its tensors say that they lie elsewhere (pretend_gpu.py)."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from analytic_priors import PixelPrior, gaussian_posterior
from fake_mps import fake_mps
from pretend_gpu import Place, pretend_gpu
from run_configs import configs
from simt_runtime import SimtRuntime
from tiny_scenes import tiny_config

from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import TrainConfig
from gsopt.errors import NumericalError
from gsopt.events import read_events
from gsopt.formats import load_splats
from gsopt.raster.api import make_backend
from gsopt.raster.device.backend import DeviceBackend
from gsopt.raster.device.memory import Memory
from gsopt.raster.device.mps import mps_runtime
from gsopt.training import loop
from gsopt.training.checkpoint import saved
from gsopt.training.guided import start
from gsopt.training.loop import train
from gsopt.training.trainer import Trainer

STEPS = 12
MOST_MOVED = 32
NAMES = ("adc", "mcmc", "few views", "random background", "coarse to fine", "skipping", "refined poses")


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[DeviceBackend]:
    """Runs take this backend, whatever they ask for; cuda:0, or the device that the test names."""
    device = getattr(request, "param", "cuda:0")
    # Slow where every operation passes through Python.
    monkeypatch.setattr(loop, "with_recorded_mirrors", lambda config, scene, directory: scene)
    monkeypatch.setattr("torch.cuda.mem_get_info", lambda _: (10**12, 10**12))
    with fake_mps() if device == "mps:0" else pretend_gpu(torch.device(device)):
        backend = DeviceBackend(mps_runtime() if device == "mps:0" else SimtRuntime(device=device))
        monkeypatch.setattr(loop, "make_backend", lambda *_: backend)
        yield backend


def trained(config: TrainConfig, run: Path) -> bytes:
    train(config, run)
    return (run / "splat.ply").read_bytes()


@pytest.mark.parametrize("gpu", ["cuda:0", "cuda:1", "mps:0"], indirect=True)
@pytest.mark.parametrize("name", NAMES)
def test_everything_of_a_step_lies_on_the_gpu(name: str, dataset: Path, tmp_path: Path, gpu: DeviceBackend) -> None:
    """An operation on tensors of two places, or of two GPUs, would raise; on Apple's one that it lacks, too."""
    trained(configs(dataset)[name].with_steps(STEPS), tmp_path / "run")
    started = next(e for e in read_events(tmp_path / "run" / "events.jsonl")[0] if e["kind"] == "started")
    assert started["device"] == str(gpu.device)
    assert load_splats(tmp_path / "run" / "splat.ply").means.isfinite().all()


@pytest.mark.parametrize("gpu", ["cuda:0", "mps:0"], indirect=True)
@pytest.mark.parametrize("name", NAMES)
def test_a_step_moves_a_few_numbers(
    name: str, dataset: Path, tmp_path: Path, gpu: DeviceBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Parameters, moments, gradients and, once every one was drawn, images stay on the GPU: what comes back is the
    length of the lists and the loss. An image has 1728 numbers here, a step of 60 Gaussians 3540."""
    moved = moved_by_steps(configs(dataset)[name].with_steps(30), tmp_path / "run", monkeypatch)
    assert all(numbers <= MOST_MOVED for numbers in moved[25:])
    assert any(moved[25:])


def test_without_a_cache_images_move(
    dataset: Path, tmp_path: Path, gpu: DeviceBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The counts are right: images that may not stay go there in every step."""
    original = Trainer.__init__

    def uncached(self: Trainer, plan: Any, *args: Any) -> None:
        original(self, replace(plan, target_cache_mb=0.0), *args)

    monkeypatch.setattr(Trainer, "__init__", uncached)
    moved = moved_by_steps(tiny_config(dataset).with_steps(12), tmp_path / "run", monkeypatch)
    assert sum(numbers > MOST_MOVED for numbers in moved) >= 8


def moved_by_steps(config: TrainConfig, run: Path, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many numbers went to the GPU or came from it, step by step; 0 where density control changed the Gaussians."""
    moved: list[int] = []
    advance = Trainer.advance

    def counted(self: Trainer) -> Any:
        Place.crossings.clear()
        before = len(self.model)
        result = advance(self)
        moved.append(sum(Place.crossings) if len(self.model) == before else 0)
        return result

    monkeypatch.setattr(Trainer, "advance", counted)
    train(config, run)
    return moved


@pytest.mark.parametrize("gpu", ["cuda:0", "mps:0"], indirect=True)
@pytest.mark.parametrize("policy", ["sds", "recon"])
def test_a_guided_run(
    policy: str, dataset: Path, tmp_path: Path, gpu: DeviceBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The prior sees pictures on the CPU, and its answer goes back."""
    monkeypatch.setattr(start, "open_prior", lambda name, config: PixelPrior(gaussian_posterior(0.2, 0.5), size=16))
    guidance = GuidanceConfig(
        prior="toy/prior", start=0.2, stop=1.0, every=2, min_uncertainty=0.0, guard_views=0, policy=policy
    )
    config = tiny_config(dataset, guidance=guidance).with_steps(STEPS)
    train(config, tmp_path / "run")
    summary = json.loads((tmp_path / "run" / "guidance" / "summary.json").read_text())
    assert summary["guided"] > 0
    assert summary["failed"] == 0


def test_the_same_bits_come_again(dataset: Path, tmp_path: Path, gpu: DeviceBackend) -> None:
    config = configs(dataset)["mcmc"].with_steps(STEPS)
    assert trained(config, tmp_path / "one") == trained(config, tmp_path / "two")


@pytest.mark.parametrize(
    ("gpu", "error"),
    [
        ("cuda:0", torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")),
        ("mps:0", RuntimeError("MPS backend out of memory (other allocations: 2 GB). Tried to allocate 2.00 GiB")),
    ],
    indirect=["gpu"],
)
@pytest.mark.parametrize(("owner", "name"), [(DeviceBackend, "_blend"), (Trainer, "_update")])
def test_a_run_that_lost_its_gpu_goes_on_with_the_cpu(
    owner: type,
    name: str,
    error: Exception,
    dataset: Path,
    tmp_path: Path,
    gpu: DeviceBackend,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The memory ends in step 12: the checkpoint of step 10 is good, and the same run finishes here."""
    asked = {"backend": gpu.device.type, "device": str(gpu.device)}
    config, run = replace(tiny_config(dataset), **asked).with_steps(14), tmp_path / "run"
    original, steps = getattr(owner, name), itertools.count()

    def ends(*args: Any, **kwargs: Any) -> Any:
        if saved(run / "checkpoints") and next(steps) == 1:
            raise error
        return original(*args, **kwargs)

    monkeypatch.setattr(owner, name, ends)
    with pytest.raises(NumericalError, match=r"memory ended in step 12.*Tried to allocate 2\.00 GiB") as told:
        train(config, run)
    assert "step_000010.safetensors" in str(told.value)
    assert "--resume --backend cpu" in str(told.value)
    monkeypatch.setattr(owner, name, original)
    monkeypatch.setattr(loop, "make_backend", make_backend)
    result = train(replace(config, backend="cpu", device=""), run, resume=True)
    assert (result.steps, result.backend) == (14, "cpu")


@pytest.mark.parametrize(
    ("garbler", "message"),
    [("ssim_of_tiles", "`loss` became nan on view .* in step 11"), ("blend_backward", "`means` .*nan.* in step 14")],
)
def test_what_a_kernel_garbles_stops_the_run(
    garbler: str, message: str, dataset: Path, tmp_path: Path, gpu: DeviceBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    launch = SimtRuntime.launch

    def garbled(self: SimtRuntime, kernel: str, blocks: int, arguments: Any) -> None:
        launch(self, kernel, blocks, arguments)
        if kernel == garbler and saved(tmp_path / "run" / "checkpoints"):
            arguments["sums"].fill_(math.nan)

    monkeypatch.setattr(SimtRuntime, "launch", garbled)
    with pytest.raises(NumericalError, match=message + r".*The last good state is .*10"):
        train(tiny_config(dataset).with_steps(14), tmp_path / "run")


def test_memory_that_will_not_do_is_told_before_the_first_step(
    dataset: Path, tmp_path: Path, gpu: DeviceBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.mem_get_info", lambda _: (4 * 10**8, 8 * 10**9))
    with pytest.raises(
        NumericalError, match=r"needs about 0\.6 GB on cuda:0 .* has 0\.4 GB free. Lower --max-gaussians"
    ):
        train(tiny_config(dataset), tmp_path / "run")
    assert not saved(tmp_path / "run" / "checkpoints")


def test_a_run_of_two_million_gaussians_is_estimated() -> None:
    """Seven gigabytes at 800 px beside a prior of 2 GB: parameters alone are 0.5."""
    memory = Memory.of(2_000_000, 3, 800 * 800, 10**9, 2 * 10**9)
    assert 4 * 59 * 4 * 2_000_000 < memory.gaussians < memory.total - 3 * 10**9 < 10**10
    memory.require(torch.device("cuda:0"), memory.total)
    with pytest.raises(NumericalError, match=r"2\.0 GB for the prior"):
        memory.require(torch.device("cuda:0"), memory.total - 1)
