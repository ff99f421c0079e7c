"""Stable Diffusion 2.1 at its real size: what a guided step needs, counted per tensor; and one that is really made.

The count computes nothing, but every variant takes seconds: only the first always runs. The step takes 2.6 GB of disk,
8 GB of memory and minutes. Opt-in: `make test-sd21`, or GSOPT_SD21=full.
"""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

import pytest
import torch

pytest.importorskip("diffusers", reason="needs the extra gsopt[sds]")
import real_memory
import real_sd21
import tiny_sd21
from real_memory import Account
from real_step import Step, guided_step

from gsopt.sds.priors.stable_diffusion import LARGE_UNET_BYTES, choose_dtype

opt_in = pytest.mark.skipif(os.environ.get("GSOPT_SD21") != "full", reason="opt-in: make test-sd21")
GPU = 6e9
"""Bytes of the smallest GPU that is to do."""
CONTEXT = 0.8e9
"""Share for CUDA itself and the workspaces of its convolutions: a guess."""


@cache
def account(side: int, **options: bool) -> Account:
    """In float16, with the halves of classifier-free guidance one after the other unless said otherwise."""
    return real_memory.account(side, **{"sequential": True, **options})


def test_the_architecture_is_the_published_one() -> None:
    for name, model in real_sd21.models("meta").items():
        assert sum(p.numel() for p in model.parameters()) == real_sd21.PARAMETERS[name]
    weights = account(512).weights
    assert weights == {name: 2 * real_sd21.PARAMETERS[name] for name in ("unet", "vae")}


@pytest.mark.parametrize("side", [512, pytest.param(768, marks=opt_in)])
def test_a_step_fits_a_gpu_of_6_gb(side: int) -> None:
    assert account(side).total < GPU - CONTEXT


@opt_in
def test_halves_one_after_the_other_need_half_the_activations() -> None:
    together, apart = (account(512, sequential=s).phases["denoise"].peak for s in (False, True))
    assert 1.8 < together / apart < 2.2


@opt_in
def test_the_encoder_keeps_little_for_its_backward_pass() -> None:
    """Recomputed blocks: a quarter is kept, and the step needs two fifths beside its weights."""
    kept, all_of_it = (account(512, checkpointed=c).phases for c in (True, False))
    assert kept["encode"].kept < 0.25 * all_of_it["encode"].kept
    assert kept["step"].peak < 0.4 * all_of_it["step"].peak


@opt_in
def test_a_tiny_autoencoder_needs_less_still() -> None:
    assert account(512, tiny=True).total < account(512).total


def in_the_training_run(folder: Path, tmp_path: Path, *flags: str) -> Step:
    from tiny_scenes import write_dataset

    scene = write_dataset(tmp_path / "scene", train=4, test=1)
    return guided_step(folder, scene, tmp_path / "run", "--guidance.sequential", "--prompt", "a chair", *flags)


def require_as_counted(step: Step, counted: Account) -> None:
    """A finite gradient, the text encoder gone, one row per call, and every part within what was counted."""
    assert step.code == 0
    (gradients,) = step.gradients
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh0"):
        assert torch.isfinite(getattr(gradients, name)).all()
    assert float(gradients.sh0.abs().max()) > 0
    assert step.rows == [1, 1]
    assert step.text_encoders == 0
    assert step.weights == counted.weights
    assert {phase.name for phase in step.phases} == {"encode", "denoise", "grad", "decode"}
    for phase in step.phases:
        same = counted.phases[{"grad": "backward"}.get(phase.name, phase.name)]
        assert phase.peak == pytest.approx(same.peak, rel=0.05)


def test_the_count_is_that_of_a_step_that_is_made(sd21: Path, tmp_path: Path) -> None:
    """On the tiny pipeline, in float32."""
    counted = real_memory.account(
        tiny_sd21.SIZE, torch.float32, sequential=True, unet=tiny_sd21.UNET, vae=tiny_sd21.VAE
    )
    require_as_counted(in_the_training_run(sd21, tmp_path), counted)


@opt_in
def test_one_guided_step_at_the_real_size(tmp_path: Path) -> None:
    """Random weights, 512 px, on the CPU, in the number format that gsopt takes there by itself."""
    folder = real_sd21.build(tmp_path / "sd21")
    step = in_the_training_run(folder, tmp_path, "--guidance.size", "512")
    dtype = choose_dtype("auto", torch.device("cpu"), LARGE_UNET_BYTES)
    require_as_counted(step, real_memory.account(512, dtype, sequential=True))
    print(f"{step.cpu_seconds:.0f} CPU s, peak RSS {step.peak_rss / 1e9:.1f} GB")
    assert step.peak_rss < 4e9 * dtype.itemsize
