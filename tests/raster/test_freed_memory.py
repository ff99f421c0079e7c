"""Freed memory stays at hand: arrays of a few MB are made and dropped all the time."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

# Arrays of 100 MB in all, made and dropped ten times: the number of pages that the system hands out meanwhile.
FAULTS = """
import resource, torch
from gsopt.raster.cpu_backend import workspace
kept = workspace(1)
def pages():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(2):
    arrays = [torch.ones(1_000_000) for _ in range(25)]
    del arrays
before = pages()
for _ in range(10):
    arrays = [torch.ones(1_000_000) for _ in range(25)]
    del arrays
print(pages() - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc says how much it keeps")
@pytest.mark.skipif("asan" in os.environ.get("LD_PRELOAD", ""), reason="the address sanitizer has its own memory")
def test_a_workspace_keeps_what_is_freed() -> None:
    """100 MB are 24,400 pages, which the system would hand out ten times."""
    out = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, text=True, check=True).stdout
    assert int(out) < 24_400
