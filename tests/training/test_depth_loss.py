"""The loss of depth maps: its gradient is autograd's, it heeds neither scale nor shift, and it mends what few photos
leave open."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import textured_room as room
import torch

from gsopt import load_scene
from gsopt.config.train import TrainConfig
from gsopt.geometry.cameras import opengl_from_viewmats
from gsopt.training.frame_loss import MAX_ERROR, agreed_gradients, depth_gradients
from gsopt.training.reconstruct import reconstruct
from gsopt.training.targets import Target

STEPS = 250


def target_of(inverse_depths: torch.Tensor, alphas: torch.Tensor | None = None) -> Target:
    height, width = inverse_depths.shape
    camera = None
    return Target(camera, torch.zeros(height, width, 3), alphas, (height, width), inverse_depths=inverse_depths)  # type: ignore[arg-type]


@pytest.fixture
def rendered() -> tuple[torch.Tensor, torch.Tensor]:
    """Depths times alphas, and alphas; some of these too faint to count."""
    generator = torch.Generator().manual_seed(6)
    alphas = torch.rand(12, 14, generator=generator).double()
    return alphas * (1 + 4 * torch.rand(12, 14, generator=generator).double()), alphas


def test_the_gradient_is_that_of_autograd(rendered: tuple[torch.Tensor, torch.Tensor]) -> None:
    generator = torch.Generator().manual_seed(7)
    wanted = torch.rand(12, 14, generator=generator).double()
    wanted[2:4] = torch.nan
    masks = torch.rand(12, 14, generator=generator).double()
    for mask in (None, masks):
        depths, alphas = (tensor.clone().requires_grad_() for tensor in rendered)
        known = torch.isfinite(wanted) & (alphas > 0.5) & (True if mask is None else mask > 0.5)
        pair = torch.stack([(alphas / depths)[known], wanted[known]])
        (0.3 * (1 - torch.corrcoef(pair)[0, 1])).backward()
        found = depth_gradients(*rendered, target_of(wanted, mask), 0.3)
        torch.testing.assert_close(found[0], depths.grad)
        torch.testing.assert_close(found[1], alphas.grad)


def test_neither_scale_nor_shift_of_a_map_counts(rendered: tuple[torch.Tensor, torch.Tensor]) -> None:
    wanted = torch.rand(12, 14, generator=torch.Generator().manual_seed(8)).double()
    one, other = (depth_gradients(*rendered, target_of(each), 1.0) for each in (wanted, 40 * wanted - 7))
    assert float(one[0].abs().max()) > 0
    torch.testing.assert_close(one, other)


def test_a_map_that_says_nothing_has_no_gradient(rendered: tuple[torch.Tensor, torch.Tensor]) -> None:
    """Flat ones, unknown ones, and those of a handful of pixels; a render that is flat or empty."""
    flat, unknown = torch.full((12, 14), 0.37).double(), torch.full((12, 14), torch.nan).double()
    few = unknown.clone()
    few[0, :9] = torch.arange(9)
    for wanted in (flat, unknown, few):
        assert not any(bool(part.any()) for part in depth_gradients(*rendered, target_of(wanted), 1.0))
    slope = torch.arange(12 * 14).double().view(12, 14)
    ones = torch.ones(12, 14).double()
    assert not any(bool(part.any()) for part in depth_gradients(2 * ones, ones, target_of(slope), 1.0))
    assert not any(bool(part.any()) for part in depth_gradients(0 * ones, 0 * ones, target_of(slope), 1.0))


def test_agreed_depths_pull_by_their_relative_error_unless_it_is_large(
    rendered: tuple[torch.Tensor, torch.Tensor],
) -> None:
    generator = torch.Generator().manual_seed(9)
    right = rendered[1] / rendered[0]
    wanted = right * (1 + 0.6 * (torch.rand(12, 14, generator=generator).double() - 0.5))
    wanted[2:4] = torch.nan
    known = torch.isfinite(wanted) & (rendered[1] > 0.5)
    near = known & ((right / wanted - 1).abs() < MAX_ERROR)
    assert 0 < int(near.sum()) < int(known.sum())
    depths, alphas = (tensor.clone().requires_grad_() for tensor in rendered)
    error = alphas[near] / depths[near] / wanted[near] - 1
    (0.3 * error.abs().sum() / near.numel()).backward()
    found = agreed_gradients(*rendered, target_of(wanted), 0.3)
    torch.testing.assert_close(found[0], depths.grad)
    torch.testing.assert_close(found[1], alphas.grad)


def room_dataset(folder: Path, inputs: int, held_out: int) -> Path:
    """Photos of the room on one arc, the held-out ones between the others, and exact depth maps beside them."""
    viewmats = room.arc(inputs + held_out)
    names = room.photograph(folder / "images", viewmats)
    (folder / "depth").mkdir()
    poses = opengl_from_viewmats(viewmats)
    frames = {"train": [], "test": []}  # type: dict[str, list[dict[str, object]]]
    for row, (name, pose) in enumerate(zip(names, poses, strict=True)):
        frames["test" if row % 2 else "train"].append(
            {"file_path": f"images/{name}", "transform_matrix": pose.tolist()}
        )
        np.save(folder / "depth" / f"{Path(name).stem}.npy", room_depths(viewmats[row]).astype(np.float32))
    for split, rows in frames.items():
        lens = {"fl_x": room.FOCAL, "fl_y": room.FOCAL, "cx": room.WIDTH / 2, "cy": room.HEIGHT / 2}
        document = {**lens, "w": room.WIDTH, "h": room.HEIGHT, "frames": rows}
        (folder / f"transforms_{split}.json").write_text(json.dumps(document))
    return folder


def room_depths(viewmat: torch.Tensor) -> np.ndarray:
    """Distance along the viewing axis of what the room's planes show, drawn in the order that `room.draw` paints."""
    x = (torch.arange(room.WIDTH).double() + 0.5 - room.WIDTH / 2) / room.FOCAL
    y = (torch.arange(room.HEIGHT).double() + 0.5 - room.HEIGHT / 2) / room.FOCAL
    rays = torch.stack((*torch.meshgrid(x, y, indexing="xy"), torch.ones(room.HEIGHT, room.WIDTH).double()), dim=-1)
    depths = torch.zeros(room.HEIGHT, room.WIDTH).double()
    for plane in room.PLANES:
        corners = torch.tensor(plane).double() @ viewmat[:3, :3].mT + viewmat[:3, 3]
        origin, right, down = corners[0], corners[1] - corners[0], corners[3] - corners[0]
        normal = torch.linalg.cross(right, down)
        z = (origin @ normal) / (rays @ normal)
        local = rays * z[..., None] - origin
        u, v = (local @ right) / (right @ right), (local @ down) / (down @ down)
        shown = (z > 0) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
        depths = torch.where(shown, z, depths)
    return depths.numpy()


def test_depth_maps_of_unknown_scale_improve_views_that_nobody_took(tmp_path: Path) -> None:
    """Three photos of a room, from random points: without depth a point stays wherever its own photo has its color."""
    data = room_dataset(tmp_path / "room", inputs=3, held_out=2)
    for path in (data / "depth").iterdir():
        np.save(path, 7 * np.load(path))
    figures = {}
    for name, weight in (("with", 0.1), ("without", 0.0)):
        config = TrainConfig.of(
            data={"path": str(data), "downscale": 5, "depth": str(data / "depth")},
            loss={"lambda_depth": weight},
            init={"method": "random", "count": 4000},
            guidance={"lambda_sds": 0.0},
            iterations=STEPS,
            preview_every=0,
            checkpoint_every=0,
            threads=1,
            backend="cpu",
        )
        metrics = reconstruct(None, tmp_path / name, config=config).metrics
        assert metrics is not None
        figures[name] = metrics["mean"]["psnr"]
    assert figures["with"] > figures["without"] + 0.5, figures


def test_views_without_a_map_learn_from_their_colors_alone(tmp_path: Path) -> None:
    """A warning names them; a mirror image of a photo has the mirror image of its map."""
    data = room_dataset(tmp_path / "room", inputs=3, held_out=2)
    (data / "depth" / "room_00.npy").unlink()
    scene = load_scene(TrainConfig.of(data={"path": str(data), "depth": str(data / "depth")}).data)
    assert any("no depth map for 1 of 3 input images: images/room_00.jpg" in text for text in scene.warnings)
    assert scene.train[0].inverse_depths(30, 40) is None
    seen = scene.train[1].inverse_depths(30, 40)
    flipped = replace(scene.train[1], mirrored=True).inverse_depths(30, 40)
    assert seen is not None
    assert flipped is not None
    assert torch.equal(flipped.nan_to_num(), seen.flip(1).nan_to_num())
    assert all(view.depth is None for view in scene.test)
