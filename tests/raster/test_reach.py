"""The margins of common/reach.h: no pixel that a splat colors is skipped, and little is visited in vain."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras, intrinsics
from gsopt.raster import _cpu  # type: ignore[attr-defined]
from gsopt.raster.backend import ALPHA_MIN, RasterSettings, RenderedFrame
from gsopt.raster.cpu_backend import ISA_VARIABLE, CpuBackend
from gsopt.raster.reference import raw_alphas, splat

TILE = 16


def needles(seed: int, count: int, width: int, height: int, spread: float) -> tuple[Gaussians, Cameras]:
    """Splats from rounder than a pixel to thousands of times longer than wide, also around the image."""
    rng = torch.Generator().manual_seed(seed)
    normal = torch.randn(count, 14, generator=rng)
    gaussians = Gaussians(
        means=normal[:, :3] * torch.tensor([1.5 * width / height, 1.5, 1.0]) + torch.tensor([0.0, 0.0, 5.0]),
        quats=normal[:, 3:7],
        log_scales=spread * normal[:, 7:10] - 3.5,
        logit_opacities=2 * normal[:, 10],
        sh0=normal[:, None, 11:14],
        shN=torch.zeros(count, 0, 3),
    )
    K = intrinsics(0.9, height, height).float()[None]
    K[0, 0, 2], K[0, 1, 2] = width / 2 + 0.25, height / 2
    return gaussians, Cameras(torch.eye(4)[None], K, width, height)


def drawn(gaussians: Gaussians, camera: Cameras, settings: RasterSettings, skip: bool) -> RenderedFrame:
    engine = CpuBackend(1)
    engine._workspace.skip_tiles = skip
    return engine.forward(gaussians, camera, settings, torch.full((3,), 0.5), depth=True)


@pytest.mark.parametrize("eps2d", [0.3, 1e-3, 0.0])
@pytest.mark.parametrize("isa", _cpu.instruction_sets())
def test_no_pixel_of_a_needle_is_missed(isa: str, eps2d: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(ISA_VARIABLE, isa)
    settings = RasterSettings(sh_degree=0, eps2d=eps2d)
    for seed, (width, height, spread) in enumerate([(150, 90, 0.5), (150, 90, 2.0), (3000, 20, 2.0), (20, 900, 1.0)]):
        scene = needles(seed, 1500, width, height, spread)
        some, every = (drawn(*scene, settings, skip) for skip in (True, False))
        for name in ("colors", "alphas", "depths"):
            assert torch.equal(getattr(some, name), getattr(every, name)), (name, seed)


def touched_tiles(gaussians: Gaussians, camera: Cameras, settings: RasterSettings) -> int:
    """(splat, tile) pairs with a pixel of alpha >= 1/255, in float64."""
    splats = splat(gaussians.to(torch.float64), camera.to(torch.float64), settings, torch.zeros(len(gaussians), 2))
    y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    pixels = torch.stack([x, y], dim=-1).view(-1, 2)
    tiles = pixels[:, 1] // TILE * -(-camera.width // TILE) + pixels[:, 0] // TILE

    def hit(part: Tensor) -> Tensor:
        deltas = pixels[:, None] + 0.5 - splats.means2d[part]
        return raw_alphas(deltas, splats.conics[part], splats.opacities[part]) >= ALPHA_MIN

    hits = torch.cat([hit(part) for part in torch.arange(len(splats.rows)).split(64)], dim=1)
    counts = torch.zeros(int(tiles.max()) + 1, hits.shape[1]).index_add(0, tiles, hits.float())
    return int((counts > 0).sum())


@pytest.mark.parametrize("isa", _cpu.instruction_sets())
def test_hardly_a_tile_is_listed_in_vain(isa: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ends of strips are found between rows too, where a pixel's center may be missed by a fraction of a pixel."""
    monkeypatch.setenv(ISA_VARIABLE, isa)
    scene = needles(7, 400, 150, 90, 1.0)
    settings = RasterSettings(sh_degree=0)
    exact = touched_tiles(*scene, settings)
    listed = drawn(*scene, settings, True).context.frame.intersections  # type: ignore[attr-defined]
    assert exact <= listed <= 1.03 * exact
