"""Training samples drawn on the device: shapes turned, mirrored and stretched, and seen by one to three cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gsopt.finetune.shapes.volumes import ShapeVolumes
from gsopt.geometry.cameras import look_at
from gsopt.shape_library.poses import turn_matrix
from gsopt.shape_prior.cube import Frame, Views, first_hits, lookup, voxel_centers
from gsopt.shape_prior.evidence import COLOR, WEIGHT, evidence
from gsopt.shape_prior.vocabulary import encoded, words_of

VIEW_SHARES = (0.5, 0.25, 0.25)
"""Shares of batches with one, two and three views."""
STRETCH = 0.25
"""Largest logarithm of the scale along each axis."""
USUAL_SHARE, USUAL_HEIGHTS, ALL_HEIGHTS = 0.8, (15.0, 45.0), (-5.0, 75.0)
"""Share of usual cameras, and heights of usual and of other cameras, degrees."""
APART = (30.0, 330.0)
"""Degrees about the vertical between the first camera and a further one."""
DISTANCES = (1.6, 5.0)
"""Distances of the cameras, longest sides of the object."""
AIM, DEPTH_ERROR = 0.05, 0.05
"""Standard deviations of the aimed point, longest sides, and of the logarithm of a single photo's depth."""
FOCAL = 100.0
"""Focal length of the cameras, px; crops make it irrelevant."""
WITHOUT_WORDS, WITHOUT_COLORS, WITHOUT_EVIDENCE, KEPT_WORDS = 0.3, 0.1, 0.03, 0.7
"""Shares of samples without words, colors and all evidence; share of its words that a sample keeps."""
SHUFFLED_SHARE, DIMMING = 0.5, 0.4


@dataclass(frozen=True)
class Scenes:
    """Placed shapes and the cameras around them."""

    rows: Int[Tensor, "B"]
    linear: Float[Tensor, "B 3 3"]
    """World from the shapes' own [-1, 1]³."""
    views: Views
    depth: Float[Tensor, "B"]
    """Assumed depth of the object in the first view."""
    channels: Int[Tensor, "B 3"]
    gains: Float[Tensor, "B 3"]


@dataclass(frozen=True)
class Samples:
    """Clean volumes and what is known about them."""

    x0: Float[Tensor, "B 4 s s s"]
    known: Float[Tensor, "B C s s s"]
    words: Int[Tensor, "B L"]


@dataclass(frozen=True)
class Cameras:
    """Choice of cameras of a batch."""

    azimuth: Float[Tensor, "B V"]
    height: Float[Tensor, "B V"]
    """Radians."""
    distance: Float[Tensor, "B V"]
    aim: Float[Tensor, "B V 3"]

    def viewmats(self) -> Float[Tensor, "B V 4 4"]:
        level = self.height.cos()
        away = torch.stack([level * self.azimuth.cos(), level * self.azimuth.sin(), self.height.sin()], -1)
        eyes = (self.distance[..., None] * away).flatten(0, 1)
        up = torch.tensor([0.0, 0.0, 1.0])
        shifted = look_at(eyes - self.aim.flatten(0, 1), torch.zeros(3), up)
        shifted[:, :3, 3] = -(shifted[:, :3, :3] @ eyes[..., None])[..., 0]
        return shifted.view(*self.azimuth.shape, 4, 4)


def drawn_cameras(count: int, random: torch.Generator) -> Cameras:
    """Cameras as users hold them, as many for every object of the batch."""
    views = 1 + int(torch.multinomial(torch.tensor(VIEW_SHARES), 1, generator=random))

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, views, generator=random)

    usual = torch.rand(count, views, generator=random) < USUAL_SHARE
    height = torch.where(usual, uniform(*USUAL_HEIGHTS), uniform(*ALL_HEIGHTS)).deg2rad()
    first = 2 * math.pi * torch.rand(count, 1, generator=random)
    further = uniform(*APART).deg2rad()
    further[:, 0] = 0
    distance = uniform(*map(math.log, DISTANCES)).exp()
    return Cameras(first + further, height, distance, AIM * torch.randn(count, views, 3, generator=random))


def drawn_scenes(volumes: ShapeVolumes, count: int, random: torch.Generator) -> Scenes:
    """Random shapes, placed at random, before random cameras; `random` is a CPU's generator on every device."""
    device = volumes.sizes.device
    rows = torch.randint(len(volumes), (count,), generator=random)
    turn = turn_matrix(2 * math.pi * torch.rand(count, generator=random))
    scale = (STRETCH * (2 * torch.rand(count, 3, generator=random) - 1)).exp()
    scale[:, 0] *= 1 - 2 * torch.randint(2, (count,), generator=random)
    cameras = drawn_cameras(count, random)
    wrong = (DEPTH_ERROR * torch.randn(count, generator=random)).exp()
    order = torch.rand(count, 3, generator=random).argsort(1)
    shuffled = torch.rand(count, 1, generator=random) < SHUFFLED_SHARE
    channels = torch.where(shuffled, order, torch.arange(3))
    gains = 1 - DIMMING * torch.rand(count, 3, generator=random)
    return placed(
        volumes, rows.to(device), turn.to(device), scale.to(device), cameras, wrong, channels.to(device), gains
    )


def placed(
    volumes: ShapeVolumes,
    rows: Int[Tensor, "B"],
    turn: Float[Tensor, "B 3 3"],
    scale: Float[Tensor, "B 3"],
    cameras: Cameras,
    wrong: Float[Tensor, "B"],
    channels: Int[Tensor, "B 3"],
    gains: Float[Tensor, "B 3"],
) -> Scenes:
    """Shapes around the world's origin, with the boxes of their silhouettes."""
    device = volumes.sizes.device
    linear = turn * (volumes.sizes[rows] * scale / 2)[:, None]
    viewmats = cameras.viewmats().to(device)
    K = torch.diag(torch.tensor([FOCAL, FOCAL, 1.0], device=device)).expand(*viewmats.shape[:2], 3, 3)
    boxes = _boxes(volumes.occupied[rows], linear, viewmats)
    depth = viewmats[:, 0, 2, 3] * wrong.to(device)
    return Scenes(rows, linear, Views(viewmats, K, boxes), depth, channels, gains.to(device))


def _boxes(occupied: Tensor, linear: Tensor, viewmats: Float[Tensor, "B V 4 4"]) -> Float[Tensor, "B V 4"]:
    points = voxel_centers(occupied.shape[-1], occupied.device) @ linear.mT
    free = ~occupied.flatten(1)
    boxes = []
    for view in viewmats.unbind(1):
        seen = points @ view[:, :3, :3].mT + view[:, None, :3, 3]
        pixel = FOCAL * seen[..., :2] / seen[..., 2:].clamp_min(1e-3)
        hidden = free[..., None]
        low, high = pixel.masked_fill(hidden, math.inf).amin(1), pixel.masked_fill(hidden, -math.inf).amax(1)
        boxes.append(torch.cat([low, high], -1))
    return torch.stack(boxes, 1)


def photographed(volumes: ShapeVolumes, scenes: Scenes, side: int) -> Float[Tensor, "B V 4 R R"]:
    """Crops of the silhouettes in the shapes' coarse colors."""
    occupied = volumes.occupied[scenes.rows][:, None].float()
    unit = torch.ones(len(occupied), device=occupied.device)
    crops = scenes.views.crops(torch.zeros_like(scenes.linear[:, 0]), scenes.linear, unit)
    hits = first_hits(occupied, crops, side, 2 * occupied.shape[-1], scenes.linear.norm(dim=(1, 2)))
    color = lookup(_colors(volumes, scenes), hits.points.flatten(1, 3), "border")
    color = color.view(len(occupied), 3, *hits.hit.shape[1:]).transpose(1, 2)
    solid = hits.hit[:, :, None].float()
    return torch.cat([color * solid, solid], 2)


def _colors(volumes: ShapeVolumes, scenes: Scenes) -> Float[Tensor, "B 3 c c c"]:
    colors = volumes.colors[scenes.rows]
    order = scenes.channels[:, :, None, None, None].expand_as(colors)
    return colors.gather(1, order) * scenes.gains[:, :, None, None, None]


def truth(volumes: ShapeVolumes, scenes: Scenes, frame: Frame, side: int) -> Float[Tensor, "B 4 s s s"]:
    """Occupancy and color of the cubes."""
    count = len(scenes.rows)
    points = voxel_centers(side, scenes.linear.device).expand(count, -1, -1)
    own = frame.to_world(points) @ torch.linalg.inv(scenes.linear).mT
    filled = lookup(volumes.occupied[scenes.rows][:, None].float(), own, "zeros")
    color = lookup(_colors(volumes, scenes), own, "border")
    return torch.cat([2 * filled - 1, filled * (2 * color - 1)], 1).view(count, 4, side, side, side)


def samples_of(volumes: ShapeVolumes, scenes: Scenes, side: int, image_side: int) -> tuple[Tensor, Tensor, Frame]:
    """Clean volumes, evidence and cubes of scenes."""
    frame = scenes.views.frame(scenes.depth, torch.tensor([0.0, 0.0, 1.0], device=scenes.depth.device))
    images = photographed(volumes, scenes, image_side)
    known = evidence(images, scenes.views.cube_crops(frame), side)
    return truth(volumes, scenes, frame, side), known, frame


@torch.no_grad()
def drawn_samples(
    volumes: ShapeVolumes,
    words: Int[Tensor, "N L"],
    count: int,
    side: int,
    image_side: int,
    random: torch.Generator,
) -> Samples:
    """A batch, with conditions left out at random."""
    scenes = drawn_scenes(volumes, count, random)
    x0, known, _ = samples_of(volumes, scenes, side, image_side)
    chance = torch.rand(count, 3, generator=random).to(known.device)
    known[chance[:, 0] < WITHOUT_COLORS, WEIGHT] = 0
    known[chance[:, 0] < WITHOUT_COLORS, COLOR] = 0
    known[chance[:, 1] < WITHOUT_EVIDENCE] = 0
    said = words[scenes.rows]
    kept = (torch.rand(said.shape, generator=random) < KEPT_WORDS).to(said.device)
    kept &= (chance[:, 2] >= WITHOUT_WORDS)[:, None]
    return Samples(x0, known, said * kept)


def word_rows(volumes: ShapeVolumes, vocabulary: Sequence[str]) -> Int[Tensor, "N L"]:
    """The words of every shape."""
    rows = torch.stack([encoded(words_of(entry), vocabulary) for entry in volumes.entries])
    return rows.to(volumes.sizes.device)
