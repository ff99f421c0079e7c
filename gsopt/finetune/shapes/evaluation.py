"""Judges a shape prior on shapes that it never saw: one photo each, beside the inflated silhouette and the library."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.events import Report
from gsopt.finetune.shapes.samples import FOCAL, Cameras, Scenes, photographed, placed
from gsopt.finetune.shapes.volumes import ShapeVolumes
from gsopt.geometry import cameras as geometry
from gsopt.geometry.voxels import Grid
from gsopt.init.inflation import inflated
from gsopt.init.thumbnails import Thumbnail
from gsopt.sds.noise import generator
from gsopt.shape_library.completion import completion
from gsopt.shape_library.library_file import ShapeLibrary
from gsopt.shape_library.poses import turn_matrix
from gsopt.shape_prior.completion import prior_body
from gsopt.shape_prior.cube import first_hits, lookup, voxel_centers
from gsopt.shape_prior.folder import ShapePrior
from gsopt.shape_prior.vocabulary import known_words

INFLATED, LIBRARY, PRIOR, SILENT = "inflated", "library", "prior", "prior without words"
MAX_SHAPES = 24
"""Number of judged shapes, evenly spread over those held out."""
HEIGHTS, DISTANCE = (20.0, 40.0), 3.0
"""Height of the photo's camera, degrees, and its distance in longest sides of the object."""
PHOTO_SIDE, ROOM = 128, 1.5
"""Side of the photo, px, and that of its crop over the object's own: photographers leave room."""
COMMON_SIDE = 64
"""Voxels along each side of the grid on which bodies are compared."""
UNSEEN = 8
"""Cameras that judge silhouettes."""
UNSEEN_SIDE, UNSEEN_STEPS, UNSEEN_HEIGHT = 48, 96, 30.0


@torch.no_grad()
def evaluate(prior: ShapePrior, held: ShapeVolumes, library: ShapeLibrary, seed: int, report: Report) -> dict[str, Any]:
    """Mean IoU in space and mean squared error of unseen silhouettes for each way, and the rows behind them."""
    chosen = torch.linspace(0, len(held) - 1, min(MAX_SHAPES, len(held))).round().long().tolist()
    left_out = frozenset(entry.id for entry in held.entries)
    rows = []
    for row in dict.fromkeys(chosen):
        rows.append(_judged(prior, held, row, library, left_out, seed))
        report(f"{rows[-1]['id']}: " + ", ".join(f"{name} {v['iou']:.3f}" for name, v in rows[-1]["ways"].items()))
    return {"shapes": len(rows), "mean": means(rows), "rows": rows}


def means(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Means over the shapes for each way and figure."""
    return {
        way: {figure: sum(row["ways"][way][figure] for row in rows) / len(rows) for figure in figures}
        for way, figures in (rows[0]["ways"].items() if rows else ())
    }


def _judged(
    prior: ShapePrior, held: ShapeVolumes, row: int, library: ShapeLibrary, left_out: frozenset[str], seed: int
) -> dict[str, Any]:
    scenes = scene_of(held, row, seed)
    photo = photo_of(held, scenes)
    title = held.entries[row].title
    words = known_words([title], prior.vocabulary)[0]
    whole, silent = (prior_body([photo], 1.0, prior, said, seed) for said in (words, ()))
    found = completion(photo, 1.0, library, [title], left_out)
    bodies = {
        INFLATED: inflated(photo, 1.0),
        LIBRARY: None if found is None else found.body,
        PRIOR: None if whole is None else whole.grid,
        SILENT: None if silent is None else silent.grid,
    }
    reach = float(scenes.linear[0].cpu().norm(dim=1).norm())
    points = reach * voxel_centers(COMMON_SIDE)
    own = points @ torch.linalg.inv(scenes.linear[0].cpu()).T
    true = lookup(held.occupied[row].cpu()[None, None].float(), own[None], "zeros")[0, 0] > 0.5
    target = silhouettes(true, reach)
    ways = {}
    for name, grid in bodies.items():
        cells = torch.zeros_like(true) if grid is None else occupied_at(grid, points)
        error = float((silhouettes(cells, reach) ^ target).float().mean())
        ways[name] = {"iou": float((cells & true).sum() / (cells | true).sum().clamp_min(1)), "silhouette_error": error}
    return {"id": held.entries[row].id, "words": words, "ways": ways}


def scene_of(held: ShapeVolumes, row: int, seed: int) -> Scenes:
    """A shape as it is before one camera, the same for every prior."""
    random = generator(seed, row, 0, "held-out shapes")
    turn = turn_matrix(2 * math.pi * torch.rand(1, generator=random))
    low, high = HEIGHTS
    height = (low + (high - low) * torch.rand(1, 1, generator=random)).deg2rad()
    camera = Cameras(torch.zeros(1, 1), height, torch.full((1, 1), DISTANCE), torch.zeros(1, 1, 3))
    device = held.sizes.device
    rows, one = torch.tensor([row], device=device), torch.ones(1, 3)
    return placed(held, rows, turn.to(device), one.to(device), camera, one[:, 0], torch.arange(3)[None].to(device), one)


def photo_of(held: ShapeVolumes, scenes: Scenes) -> Thumbnail:
    """The camera's photo, as a run would read it."""
    box = scenes.views.boxes
    middle, half = (box[..., :2] + box[..., 2:]) / 2, (box[..., 2:] - box[..., :2]) / 2
    roomy = replace(scenes.views, boxes=torch.cat([middle - ROOM * half, middle + ROOM * half], -1))
    image = photographed(held, replace(scenes, views=roomy), PHOTO_SIDE)[0, 0].cpu()
    scale = PHOTO_SIDE / 2 / float(roomy.crop_half()[0, 0])
    offset = PHOTO_SIDE / 2 - scale * middle[0, 0].cpu()
    K = torch.tensor([[scale * FOCAL, 0, offset[0]], [0, scale * FOCAL, offset[1]], [0, 0, 1.0]])
    camera = geometry.Cameras(scenes.views.viewmats[0].cpu(), K[None], PHOTO_SIDE, PHOTO_SIDE)
    return Thumbnail(camera, (image * 255).round().to(torch.uint8))


def occupied_at(grid: Grid, points: Float[Tensor, "N 3"]) -> Bool[Tensor, "N"]:
    """True for points in an occupied voxel."""
    cells = ((points - grid.low) / grid.voxel).floor().long()
    top = torch.tensor(grid.occupied.shape)
    within = ((cells >= 0) & (cells < top)).all(-1)
    found = grid.occupied[tuple(torch.minimum(cells.clamp_min(0), top - 1).T)]
    return found & within


def silhouettes(cells: Bool[Tensor, "N"], reach: float) -> Bool[Tensor, "V S S"]:
    """A body on the common grid from UNSEEN sides."""
    angles = 2 * math.pi * (torch.arange(UNSEEN) + 0.5) / UNSEEN
    height = torch.full((UNSEEN,), UNSEEN_HEIGHT).deg2rad() * torch.tensor([1.0, 0.0]).repeat(UNSEEN // 2)
    around = Cameras(angles[None], height[None], torch.full((1, UNSEEN), 4 * reach), torch.zeros(1, UNSEEN, 3))
    volume = cells.view(1, 1, *(COMMON_SIDE,) * 3).float()
    pose = around.viewmats()[:, :, :3] * torch.tensor([1.0, 1.0, 1.0, 1 / reach])
    K = torch.diag(torch.tensor([2.5, 2.5, 1.0]))
    return first_hits(volume, K @ pose, UNSEEN_SIDE, UNSEEN_STEPS, torch.tensor([math.sqrt(3)])).hit[0]
