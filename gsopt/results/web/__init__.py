"""A page that shows splats in a browser, alone: viewer, cameras and splats in one file, without network."""

from __future__ import annotations

from pathlib import Path

from gsopt.formats.files import replacing
from gsopt.gaussians import Gaussians
from gsopt.results.finished_run import open_run
from gsopt.results.web.page import viewer_page
from gsopt.results.web.payload import packed_splats
from gsopt.results.web.scene import WebScene, scene_of_run, scene_of_splats

__all__ = ["WebScene", "save_page", "save_run_page", "scene_of_splats"]


def save_page(path: Path, gaussians: Gaussians, scene: WebScene) -> None:
    """Write a page of splats; whole file or nothing. Raises InputError for what cannot be written."""
    text = viewer_page(scene, packed_splats(gaussians, path))
    with replacing(path) as file:
        file.write(text.encode("utf-8", "replace"))


def save_run_page(path: Path | str, run: Path | str) -> int:
    """Write the page of a finished run with its input cameras and camera path, and return the number of splats."""
    finished = open_run(Path(run))
    save_page(Path(path), finished.gaussians, scene_of_run(finished))
    return len(finished.gaussians)
