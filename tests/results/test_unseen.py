"""Splats that no input view shows are marked, and no others."""

from __future__ import annotations

import pytest
import torch
from pretend_gpu import pretend_gpu
from simt_runtime import SimtRuntime

from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras, intrinsics, look_at
from gsopt.raster.device.backend import DeviceBackend
from gsopt.results.unseen import MARK, marked, unseen


def balls(centers: list[tuple[float, float, float]]) -> Gaussians:
    count = len(centers)
    return Gaussians(
        means=torch.tensor(centers),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        log_scales=torch.full((count, 3), -2.0),
        logit_opacities=torch.full((count,), 8.0),
        sh0=torch.zeros(count, 1, 3),
        shN=torch.zeros(count, 0, 3),
    )


def camera(x: float) -> Cameras:
    eye, up = torch.tensor([[x, 0.0, 0.0]], dtype=torch.float64), torch.tensor([0.0, 0, 1], dtype=torch.float64)
    return Cameras(look_at(eye, torch.zeros(3, dtype=torch.float64), up), intrinsics(0.8, 64, 64)[None], 64, 64)


def test_what_another_hides_or_the_frame_leaves_out_is_unseen() -> None:
    front, back, beside = (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 9.0, 0.0)
    model = balls([front, back, beside])
    assert unseen(model, [camera(4.0)]).tolist() == [False, True, True]
    assert unseen(model, [camera(-4.0)]).tolist() == [True, False, True]
    assert unseen(model, [camera(4.0), camera(-4.0)]).tolist() == [False, False, True]


def test_the_same_are_found_where_torch_sees_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    front, back, beside = (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 9.0, 0.0)
    with pretend_gpu():
        gpu = DeviceBackend(SimtRuntime(device="cuda:0"))
        monkeypatch.setattr("gsopt.results.unseen.make_backend", lambda *_: gpu)
        assert unseen(balls([front, back, beside]), [camera(4.0)]).tolist() == [False, True, True]


def test_only_hidden_colors_are_mixed_with_the_mark() -> None:
    rgb = torch.tensor([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    mixed = marked(rgb, torch.tensor([False, True]))
    assert torch.equal(mixed[0], rgb[0])
    assert float((mixed[1] - MARK).norm()) < float((rgb[1] - MARK).norm()) / 2


def test_seven_tenths_of_a_marked_color_are_the_mark() -> None:
    mixed = marked(torch.tensor([[0.0, 1.0, 0.5]]), torch.tensor([True]))
    torch.testing.assert_close(mixed, torch.tensor([[0.7, 0.3 + 0.07, 0.15 + 0.56]]))
