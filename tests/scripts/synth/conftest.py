"""Meshes to render, and Blender where it is installed."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_meshes import CENTERS, CUBE, RADIUS, TEXTURE_RGB, ball

ROOT = Path(__file__).resolve().parents[3]
sys.path[:0] = [str(ROOT / "scripts"), str(ROOT)]  # as synth_views.py does: bpy's Pythons need no gsopt installed


EXIT_STATUS = pytest.StashKey[int]()


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    session.config.stash[EXIT_STATUS] = int(exitstatus)


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config: pytest.Config) -> None:
    """Leave without Python's farewell: after renders bpy 4.5 sometimes waits there forever for a thread of its own, and
    4.2 sometimes crashes."""
    if "bpy" in sys.modules and not hasattr(config, "workerinput"):
        sys.stdout.flush()
        os._exit(config.stash.get(EXIT_STATUS, 0))


@pytest.fixture(scope="session")
def bpy() -> Any:
    return pytest.importorskip("bpy", reason="Blender's module is not installed (pip install bpy)")


@pytest.fixture(scope="session")
def two_balls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    mesh = tmp_path_factory.mktemp("mesh") / "balls.obj"
    mesh.write_text(ball(CENTERS[0], RADIUS, 1) + ball(CENTERS[1], RADIUS, 1 + 25 * 48))
    return mesh


@pytest.fixture
def shapenet(tmp_path: Path) -> Path:
    """One model with ShapeNet's ways: texture in ../images behind a backslash, a lost map, a zero-area face."""
    from synth.pixels import png

    model = tmp_path / "ShapeNet" / "03001627" / "abc"
    (model / "models").mkdir(parents=True)
    (model / "images").mkdir()
    texture = np.broadcast_to(np.array(TEXTURE_RGB, np.uint8), (8, 8, 3))
    (model / "images" / "Texture0.png").write_bytes(png(texture))
    (model / "models" / "model_normalized.mtl").write_text(
        "newmtl wood\nKd 1 1 1\nmap_Kd ..\\images\\texture0.png\nnewmtl bare\nKd 0.1 0.2 0.7\nmap_Kd gone.jpg\n"
    )
    bare = "usemtl bare\nv 0 0 1.5\nv 0.2 0 1.5\nv 0 0.2 1.5\nf 9 10 11\nf 9 9 9\n"
    (model / "models" / "model_normalized.obj").write_text(f"mtllib model_normalized.mtl\nusemtl wood\n{CUBE}{bare}")
    return tmp_path / "ShapeNet"
