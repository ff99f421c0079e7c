"""A differentiable rasterize that nobody holds any more is freed: its images, its workspace and its threads."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
import torch
from raster_scenes import make_case

import gsopt
from gsopt.gaussians import Gaussians
from gsopt.raster.api import make_backend
from gsopt.raster.backend import Backend

ITERATIONS = 2000
WARM_UP = 100
GROWTH = 48 << 20  # bytes: what the allocator may keep; a frame that is never freed costs 0.2 MB or more
THREADS = 2


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def running() -> int:
    return len(os.listdir("/proc/self/task"))


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("backward", [True, False])
@pytest.mark.parametrize("named", [True, False])
def test_memory_and_threads_stay_flat(named: bool, backward: bool) -> None:
    case = make_case(3, width=64, height=64)
    leaves = Gaussians(**{name: tensor.float().requires_grad_() for name, tensor in case.gaussians.items()})
    backend: Backend | str = "cpu" if named else make_backend("cpu", THREADS)
    memory = threads = 0
    for iteration in range(ITERATIONS):
        colors = gsopt.rasterize(leaves, case.camera, case.settings, backend=backend, threads=THREADS).colors
        if backward:
            torch.autograd.grad(colors.sum(), [tensor for _, tensor in leaves.items()])
        del colors
        if iteration == WARM_UP:
            memory, threads = resident(), running()
        elif iteration > WARM_UP and iteration % 50 == 0:
            assert running() <= threads + THREADS, iteration
            assert resident() <= memory + GROWTH, iteration
