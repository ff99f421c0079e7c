"""gsopt: 3D Gaussian Splatting from few images, guided by a diffusion model and by what an expert knows.

Importing this package costs nothing: each public name is loaded from its module when first used (PEP 562).
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from gsopt._version import __version__ as __version__

_HOME = {
    "Cameras": "gsopt.geometry.cameras",
    "DataConfig": "gsopt.config.train",
    "Gaussians": "gsopt.gaussians",
    "GsoptError": "gsopt.errors",
    "RasterSettings": "gsopt.raster.backend",
    "Scene": "gsopt.data.scene",
    "TrainConfig": "gsopt.config.train",
    "clean": "gsopt.results.clean_files",
    "evaluate": "gsopt.results.evaluation",
    "extract_mesh": "gsopt.results.mesh.extract",
    "load_scene": "gsopt.data.scene",
    "load_splats": "gsopt.formats",
    "measure": "gsopt.results.measure",
    "merge": "gsopt.results.merge",
    "rasterize": "gsopt.raster.api",
    "reconstruct": "gsopt.training.reconstruct",
    "save_run_page": "gsopt.results.web",
    "save_splats": "gsopt.formats",
    "train": "gsopt.training.loop",
}

__all__ = [
    "Cameras",
    "DataConfig",
    "Gaussians",
    "GsoptError",
    "RasterSettings",
    "Scene",
    "TrainConfig",
    "clean",
    "evaluate",
    "extract_mesh",
    "load_scene",
    "load_splats",
    "measure",
    "merge",
    "rasterize",
    "reconstruct",
    "save_run_page",
    "save_splats",
    "train",
]

if TYPE_CHECKING:
    from gsopt.config.train import DataConfig, TrainConfig
    from gsopt.data.scene import Scene, load_scene
    from gsopt.errors import GsoptError
    from gsopt.formats import load_splats, save_splats
    from gsopt.gaussians import Gaussians
    from gsopt.geometry.cameras import Cameras
    from gsopt.raster.api import rasterize
    from gsopt.raster.backend import RasterSettings
    from gsopt.results.clean_files import clean
    from gsopt.results.evaluation import evaluate
    from gsopt.results.measure import measure
    from gsopt.results.merge import merge
    from gsopt.results.mesh.extract import extract_mesh
    from gsopt.results.web import save_run_page
    from gsopt.training.loop import train
    from gsopt.training.reconstruct import reconstruct


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'gsopt' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
