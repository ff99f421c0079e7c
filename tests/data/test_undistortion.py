"""Lens models against an independent writing of their formulas, and the pinhole that replaces them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gsopt.data.colmap import _camera_model
from gsopt.data.colmap_files import CameraRecord
from gsopt.data.lens import Lens
from gsopt.data.resample import premultiply, unpremultiply
from gsopt.data.undistort import ZOOM_MIN, choose_pinhole, undistort
from gsopt.errors import InputError
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.projection import project

WIDTH, HEIGHT = 320, 240
FOX = (0.0578421, -0.0805099, -0.000980296, 0.00015575)


def brown(p, u, v, denominators=(0, 0, 0)):
    k1, k2, p1, p2, k3 = p
    r2 = u**2 + v**2
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (
        1 + denominators[0] * r2 + denominators[1] * r2**2 + denominators[2] * r2**3
    )
    return (
        u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u**2),
        v * radial + p1 * (r2 + 2 * v**2) + 2 * p2 * u * v,
    )


def fisheye(ks, u, v):
    r = math.hypot(u, v)
    theta = math.atan2(r, 1)
    scaled = theta * (1 + sum(k * theta ** (2 * i + 2) for i, k in enumerate(ks)))
    return u / r * scaled, v / r * scaled


def thin_prism(p, u, v):
    k1, k2, p1, p2, k3, k4, sx, sy = p
    r = math.hypot(u, v)
    theta = math.atan2(r, 1)
    u, v = u / r * theta, v / r * theta
    t2 = theta**2
    radial = k1 * t2 + k2 * t2**2 + k3 * t2**3 + k4 * t2**4
    return (
        u + u * radial + 2 * p1 * u * v + p2 * (t2 + 2 * u * u) + sx * t2,
        v + v * radial + 2 * p2 * u * v + p1 * (t2 + 2 * v * v) + sy * t2,
    )


# model, COLMAP's parameters, normalized (u, v) -> normalized distorted, fx, fy, cx, cy
MODELS = {
    "SIMPLE_PINHOLE": ((200, 160, 120), lambda u, v: (u, v)),
    "PINHOLE": ((200, 210, 158, 123), lambda u, v: (u, v)),
    "SIMPLE_RADIAL": ((200, 158, 123, -0.1), lambda u, v: brown((-0.1, 0, 0, 0, 0), u, v)),
    "RADIAL": ((200, 158, 123, 0.06, -0.08), lambda u, v: brown((0.06, -0.08, 0, 0, 0), u, v)),
    "OPENCV": ((200, 210, 158, 123, *FOX), lambda u, v: brown((*FOX, 0), u, v)),
    "FULL_OPENCV": (
        (200, 210, 158, 123, 0.2, -0.05, 1e-3, -2e-3, 0.01, 0.15, 0.02, -0.01),
        lambda u, v: brown((0.2, -0.05, 1e-3, -2e-3, 0.01), u, v, (0.15, 0.02, -0.01)),
    ),
    "OPENCV_FISHEYE": (
        (150, 155, 158, 123, 0.02, -0.01, 0.003, -0.001),
        lambda u, v: fisheye((0.02, -0.01, 0.003, -0.001), u, v),
    ),
    "SIMPLE_RADIAL_FISHEYE": ((150, 158, 123, 0.03), lambda u, v: fisheye((0.03,), u, v)),
    "RADIAL_FISHEYE": ((150, 158, 123, 0.03, -0.01), lambda u, v: fisheye((0.03, -0.01), u, v)),
    "THIN_PRISM_FISHEYE": (
        (150, 155, 158, 123, 0.02, -0.01, 1e-3, -2e-3, 0.003, -0.001, 2e-3, -1e-3),
        lambda u, v: thin_prism((0.02, -0.01, 1e-3, -2e-3, 0.003, -0.001, 2e-3, -1e-3), u, v),
    ),
}


def lens_and_K(model: str) -> tuple[torch.Tensor, Lens]:
    params = tuple(float(p) for p in MODELS[model][0])
    return _camera_model(CameraRecord(1, model, WIDTH, HEIGHT, params), model)


def focal_and_center(model: str) -> tuple[float, float, float, float]:
    params = MODELS[model][0]
    shared = model.startswith(("SIMPLE", "RADIAL"))
    return (params[0], params[0], params[1], params[2]) if shared else params[:4]


@pytest.mark.parametrize("model", MODELS)
def test_points_through_the_lens_meet_points_through_the_undistorted_camera(model: str) -> None:
    K, lens = lens_and_K(model)
    rays = torch.rand(200, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    undistortion = choose_pinhole(lens, K, WIDTH, HEIGHT, model)
    camera = Cameras(torch.eye(4, dtype=torch.float64)[None], undistortion.pinhole[None], WIDTH, HEIGHT)
    spread = torch.tensor([0.6, 0.45], dtype=torch.float64)
    points = torch.cat([(rays - 0.5) * 2 * spread, torch.ones(200, 1, dtype=torch.float64)], dim=1) * 3.7
    column, row, _ = project(camera, points)
    found = undistortion.source_from_target(torch.stack([column, row], dim=-1))
    fx, fy, cx, cy = focal_and_center(model)
    for (x, y, z), pixel in zip(points.tolist(), found.tolist(), strict=True):
        u, v = MODELS[model][1](x / z, y / z)
        assert pixel == pytest.approx((fx * u + cx, fy * v + cy), abs=1e-6)


@pytest.mark.parametrize("model", MODELS)
def test_no_target_pixel_falls_outside_the_stored_image_and_the_zoom_is_the_least(model: str) -> None:
    K, lens = lens_and_K(model)
    undistortion = choose_pinhole(lens, K, WIDTH, HEIGHT, model)
    grid = undistortion.sample_grid()
    source = (grid.double() + 1) / 2 * torch.tensor([WIDTH, HEIGHT], dtype=torch.float64)
    assert float(source.min()) > 0.49
    assert float((source - torch.tensor([WIDTH, HEIGHT])).max()) < -0.49
    zoom = float(undistortion.pinhole[0, 0] / K[0, 0])
    assert zoom == pytest.approx(float(undistortion.pinhole[1, 1] / K[1, 1]))
    margin = min(float((source[..., a]).min()) - 0.5 for a in (0, 1))
    far = min(size - 0.5 - float(source[..., a].max()) for a, size in ((0, WIDTH), (1, HEIGHT)))
    assert zoom == pytest.approx(ZOOM_MIN) or min(margin, far) < 0.01


def pattern(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A smooth image over directions."""
    waves = [np.sin(7 * u + 2 * v), np.cos(5 * v - 3 * u), np.sin(4 * u * v + 6 * v)]
    return (np.stack(waves, axis=-1) * 100 + 128).astype(np.uint8)


def undistorted_source(lens: Lens, K: torch.Tensor) -> np.ndarray:
    """The pattern as the lens sees it: each stored pixel's direction by inverting the lens step by step."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    distorted = torch.from_numpy(
        np.stack([(x - float(K[0, 2])) / float(K[0, 0]), (y - float(K[1, 2])) / float(K[1, 1])], -1)
    )
    ideal = distorted.clone()
    for _ in range(60):
        ideal = ideal + (distorted - lens.distort(ideal))
    if lens.fisheye:
        r = distorted.norm(dim=-1, keepdim=True)
        theta = r
        for _ in range(60):
            theta = r / (1 + sum(k * theta ** (2 * i + 2) for i, k in enumerate(lens.radial)))
        ideal = distorted / r * theta.tan()
    assert float((lens.distort(ideal) - distorted).abs().max()) < 1e-6
    return pattern(ideal[..., 0].numpy(), ideal[..., 1].numpy())


@pytest.mark.parametrize("model", ["OPENCV", "SIMPLE_RADIAL", "OPENCV_FISHEYE"])
def test_the_undistorted_image_is_the_scene_through_the_pinhole(model: str) -> None:
    K, lens = lens_and_K(model)
    undistortion = choose_pinhole(lens, K, WIDTH, HEIGHT, model)
    stored = torch.from_numpy(undistorted_source(lens, K))
    got = unpremultiply(undistort(premultiply(stored), undistortion.sample_grid())).numpy().astype(int)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    P = undistortion.pinhole.numpy()
    want = pattern((x - P[0, 2]) / P[0, 0], (y - P[1, 2]) / P[1, 1]).astype(int)
    assert np.abs(got - want).max() <= 3  # rounding twice, and the curvature bilinear sampling misses
    wrong = pattern((x - float(K[0, 2])) / float(K[0, 0]), (y - float(K[1, 2])) / float(K[1, 1])).astype(int)
    assert np.abs(got - wrong).max() > 6  # the lens left in is seen


def test_a_lens_that_folds_back_is_refused() -> None:
    K = torch.tensor([[20.0, 0, 160], [0, 20.0, 120], [0, 0, 1]], dtype=torch.float64)
    with pytest.raises(InputError, match="folds back or leaves the image"):
        choose_pinhole(Lens(radial=(-0.9,)), K, WIDTH, HEIGHT, "photo.jpg")


def test_a_principal_point_outside_the_image_is_refused() -> None:
    K = torch.tensor([[200.0, 0, -50], [0, 200.0, 120], [0, 0, 1]], dtype=torch.float64)
    with pytest.raises(InputError, match=r"photo\.jpg"):
        choose_pinhole(Lens(radial=(0.1,)), K, WIDTH, HEIGHT, "photo.jpg")
