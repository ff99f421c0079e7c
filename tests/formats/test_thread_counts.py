"""The bytes of a splat file do not depend on the number of threads."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from splat_samples import make_splats

from gsopt.formats import SUFFIXES, load_splats, save_splats
from gsopt.results.web import save_page, scene_of_splats

COUNT = 40_000
"""Splats; torch shares 32,768 numbers and more among threads."""


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".html"])
def test_any_number_of_threads_writes_and_reads_the_same(tmp_path: Path, suffix: str) -> None:
    if suffix.startswith(".usd"):
        pytest.importorskip("pxr")
    splats, threads = make_splats(COUNT, degree=1), torch.get_num_threads()
    try:
        found = []
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            path = tmp_path / f"{count}" / f"a{suffix}"
            path.parent.mkdir()
            if suffix == ".html":
                save_page(path, splats, scene_of_splats(splats, "a"))
                read = []
            else:
                save_splats(path, splats)
                read = [tensor.numpy().tobytes() for _, tensor in load_splats(path).items()]
            found.append((path.read_bytes(), read))
        assert found[0] == found[1] == found[2]
    finally:
        torch.set_num_threads(threads)
