"""Threads of the CPU backend: bounded, fewer where the system refuses more, none of a parent in a forked child."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from gsopt.config.train import TrainConfig
from gsopt.errors import SettingError

USED_BACKEND = """
import os, resource, sys, torch
from raster_scenes import make_case
from gsopt.raster.api import make_backend, rasterize
case = make_case(3, width=64, height=64)
gaussians = case.gaussians.to(torch.float32)
def draw(backend):
    return rasterize(gaussians, case.camera, case.settings, backend=backend).colors
"""
FORK = """
backend = make_backend("cpu", 4)
before = draw(backend)
child = os.fork()
if child == 0:
    same = torch.equal(draw(backend), before) and torch.equal(draw(make_backend("cpu", 4)), before)
    del backend
    os._exit(0 if same else 1)
_, status = os.waitpid(child, 0)
assert os.waitstatus_to_exitcode(status) == 0
assert torch.equal(draw(backend), before)
"""
REFUSED = """
before = draw(make_backend("cpu", 1))
resource.setrlimit(resource.RLIMIT_AS, (int(open("/proc/self/statm").read().split()[0]) * 4096 + (200 << 20),) * 2)
backend = make_backend("cpu", 1024)
assert 1 <= backend.threads < 1024, backend.threads
assert torch.equal(draw(backend), before)
del backend
"""


@pytest.mark.skipif(sys.platform != "linux", reason="forks, and limits memory")
@pytest.mark.parametrize("program", [FORK, REFUSED], ids=["fork", "refused"])
def test_a_pool_without_its_threads_draws_the_same_image(program: str) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    subprocess.run([sys.executable, "-c", USED_BACKEND + program], env=environment, check=True, timeout=120)


def test_the_number_of_threads_is_bounded() -> None:
    with pytest.raises(SettingError, match=r"`threads` must lie in \[0, 1024\], got 1025"):
        TrainConfig(threads=1025)
