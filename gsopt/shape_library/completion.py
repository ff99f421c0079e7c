"""The body that a library and an expert's words make of one photo: aligned shapes, mixed with the inflated silhouette.

Every shape in its pose is a hypothesis. Its evidence is

    (1)  e = LIKENESS s + AGREEMENT q + RULE IoU(shape, inflated body) + WORDS t + CONSENSUS mean IoU(shape, others),

s: likeness of silhouettes in their boxes, q: agreement after the alignment, t: how much the words mean it (0 to 1); the
others count by their own evidence. The body is what more than half of all believe in, inside the silhouette:

    (2)  occupied where  (1 - INFLATED) sum_i softmax(SHARPNESS e)_i o_i + INFLATED [inflated body] > 1/2.

So words tip the scales between shapes that the photo allows, and cannot make it show another thing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gsopt.data.resample import sample
from gsopt.geometry.projection import inside, project
from gsopt.geometry.voxels import Grid
from gsopt.init.inflation import inflated
from gsopt.init.thumbnails import Thumbnail
from gsopt.shape_library.alignment import Alignments, aligned, boxed, occupancy, soft
from gsopt.shape_library.entry import Entry
from gsopt.shape_library.library_file import ShapeLibrary
from gsopt.shape_library.outline import Outline
from gsopt.shape_library.poses import Poses, best_poses, surface_points
from gsopt.shape_library.words import word_scores

LIKENESS, AGREEMENT, RULE, WORDS, CONSENSUS = 1.0, 0.5, 0.6, 0.25, 1.0
SHARPNESS = 10.0
INFLATED = 0.35
"""Chosen with the others on the `val` objects (docs/decisions/0013-shape-library.md)."""
MAX_SHAPES = 1500
"""Shapes of a library that are compared with the photo: those that the words mean, and others spread over the rest."""
POSES_PER_SHAPE = 3
FIRST, SECOND = 48, 20
"""Hypotheses that a short, then a longer alignment sees."""
SPOKEN_SHARE = 1 / 3
"""Least share of the hypotheses for shapes that the words mean."""
FIRST_RASTER, SECOND_RASTER = (32, 24), (44, 36)
FIRST_STEPS, SECOND_STEPS = 8, 12
LEAST_SCORE = 0.35
"""Share of the best text score from which on the words mean an entry."""


@dataclass(frozen=True)
class Hypothesis:
    """A shape that took part."""

    entry: Entry
    share: float
    """Its part of the sum in (2)."""
    agreement: float
    """IoU of its silhouette with the photo's, less the cost of stretching it."""
    words: float
    """Degree to which the words mean it, 0 to 1."""


@dataclass(frozen=True)
class Completion:
    """The body, and the shapes it was made from."""

    body: Grid
    hypotheses: tuple[Hypothesis, ...]
    """By their share, the largest first."""


@torch.no_grad()
def completion(
    photo: Thumbnail, extent: float, library: ShapeLibrary, texts: Sequence[str], left_out: frozenset[str] = frozenset()
) -> Completion | None:
    """The body of (2), or None for a silhouette that is empty. `left_out`: ids of entries that are not used."""
    rule = inflated(photo, extent)
    if rule is None:
        return None
    outline = Outline.of(photo, extent)
    spoken = _spoken(library, texts)
    rows = _compared(spoken, [entry.id in left_out for entry in library.entries])
    shapes = _Shapes.read(library, rows, spoken)
    found = _search(outline, shapes)
    filled = _Filled.of(outline, rule, shapes, found)
    evidence = (
        LIKENESS * found.poses.likeness
        + AGREEMENT * found.agreement
        + RULE * filled.overlap_with(rule)
        + WORDS * shapes.spoken[found.poses.row]
    )
    share = torch.softmax(SHARPNESS * (evidence + CONSENSUS * filled.consensus(evidence)), dim=0)
    belief = (1 - INFLATED) * share @ filled.values + INFLATED * filled.rule.float()
    body = filled.grid_where(belief > 0.5, rule)
    return Completion(body if bool(body.occupied.any()) else rule, _hypotheses(library, rows, shapes, found, share))


def _spoken(library: ShapeLibrary, texts: Sequence[str]) -> list[float]:
    """Degrees to which the texts mean each entry, 0 to 1."""
    scores = word_scores(library.entries, texts)
    best = max(scores)
    return [score / best if best > 0 and score >= LEAST_SCORE * best else 0.0 for score in scores]


def _compared(spoken: list[float], out: list[bool]) -> list[int]:
    """Rows of the entries that are compared with the photo: at most MAX_SHAPES, those meant first."""
    meant = sorted((row for row, score in enumerate(spoken) if score > 0 and not out[row]), key=lambda r: -spoken[r])
    meant = meant[:MAX_SHAPES]
    rest = sorted(set(range(len(spoken))) - set(meant) - {row for row, gone in enumerate(out) if gone})
    room = MAX_SHAPES - len(meant)
    if len(rest) > room:
        rest = [rest[i * len(rest) // room] for i in range(room)]
    return sorted(meant + rest)


@dataclass(frozen=True)
class _Shapes:
    """Shapes in memory."""

    occupied: Bool[Tensor, "N s s s"]
    sizes: Float[Tensor, "N 3"]
    points: Float[Tensor, "N P 3"]
    spoken: Float[Tensor, "N"]

    @staticmethod
    def read(library: ShapeLibrary, rows: list[int], spoken: list[float]) -> _Shapes:
        read = [library.shape(row) for row in rows]
        occupied = torch.stack([torch.from_numpy(shape.occupied) for shape in read])
        sizes = torch.stack([torch.from_numpy(shape.sizes.copy()) for shape in read])
        points = torch.stack([surface_points(*pair) for pair in zip(occupied, sizes, strict=True)])
        return _Shapes(occupied, sizes, points, torch.tensor([spoken[row] for row in rows]))


def _search(outline: Outline, shapes: _Shapes) -> Alignments:
    """The hypotheses: best poses of all shapes, the best of these aligned, the best of those aligned again."""
    poses = best_poses(outline, shapes.points, POSES_PER_SHAPE)
    poses = poses[_best(poses.likeness, shapes.spoken[poses.row], FIRST)]
    start = boxed(outline, poses, shapes.points[poses.row])
    found = aligned(outline, start, *_volumes(shapes, poses), FIRST_RASTER, FIRST_STEPS)
    worth = LIKENESS * found.poses.likeness + AGREEMENT * found.agreement
    found = found[_best(worth, shapes.spoken[found.poses.row], SECOND)]
    return aligned(outline, found, *_volumes(shapes, found.poses), SECOND_RASTER, SECOND_STEPS)


def _best(worth: Float[Tensor, "B"], spoken: Float[Tensor, "B"], count: int) -> Int[Tensor, "C"]:
    """Rows of the `count` most worth, words included; a share of them is for those that the words mean."""
    order = torch.sort(worth + WORDS * spoken, descending=True, stable=True).indices
    meant = order[spoken[order] > 0][: round(SPOKEN_SHARE * count)]
    others = order[~torch.isin(order, meant)][: count - len(meant)]
    return torch.cat([meant, others])


def _volumes(shapes: _Shapes, poses: Poses) -> tuple[Float[Tensor, "B 1 s s s"], Float[Tensor, "B 3"]]:
    return soft(shapes.occupied[poses.row]), shapes.sizes[poses.row]


@dataclass(frozen=True)
class _Filled:
    """Soft occupancy of the hypotheses in those voxels of the inflated body's grid that the silhouette holds."""

    rows: Int[Tensor, "M"]
    values: Float[Tensor, "B M"]
    rule: Bool[Tensor, "M"]

    @staticmethod
    def of(outline: Outline, rule: Grid, shapes: _Shapes, found: Alignments) -> _Filled:
        points = rule.centers(torch.ones_like(rule.occupied))
        column, row, depth = project(outline.camera, points)
        rows = torch.nonzero(inside(outline.camera, column, row, depth))[:, 0]
        rows = rows[sample(outline.alpha, column[rows], row[rows])[0] > 0.5]
        volumes, sizes = _volumes(shapes, found.poses)
        values = [
            occupancy(
                outline,
                volumes[i : i + 1],
                sizes[i : i + 1],
                found.poses.mirror[i : i + 1],
                parameters[None],
                points[rows],
            )[0]
            for i, parameters in enumerate(found.parameters)
        ]
        return _Filled(rows, torch.stack(values), rule.occupied.flatten()[rows])

    def overlap_with(self, rule: Grid) -> Float[Tensor, "B"]:
        """Soft IoU with the inflated body, whole."""
        shared = self.values[:, self.rule].sum(1)
        return shared / (self.values.sum(1) + rule.occupied.sum() - shared)

    def consensus(self, evidence: Float[Tensor, "B"]) -> Float[Tensor, "B"]:
        """Mean soft IoU with the other hypotheses, weighted by their evidence."""
        totals = self.values.sum(1)
        shared = torch.stack([torch.minimum(one, self.values).sum(1) for one in self.values])
        alike = shared / (totals[:, None] + totals - shared).clamp_min(1e-6)
        weight = torch.softmax(SHARPNESS * evidence, dim=0)
        return (alike @ weight - alike.diagonal() * weight) / (1 - weight).clamp_min(0.05)

    def grid_where(self, kept: Bool[Tensor, "M"], rule: Grid) -> Grid:
        """The voxels that are kept, on the grid of the inflated body."""
        occupied = torch.zeros(rule.occupied.numel(), dtype=torch.bool)
        occupied[self.rows[kept]] = True
        return Grid(occupied.view_as(rule.occupied), rule.low, rule.voxel)


def _hypotheses(
    library: ShapeLibrary, rows: list[int], shapes: _Shapes, found: Alignments, share: Float[Tensor, "B"]
) -> tuple[Hypothesis, ...]:
    """One for each entry, shares of its poses added up."""
    best: dict[int, Hypothesis] = {}
    for index in torch.sort(share, descending=True, stable=True).indices.tolist():
        row = int(found.poses.row[index])
        part, known = float(share[index]), best.get(row)
        if known is None:
            agreement, spoken = float(found.agreement[index]), float(shapes.spoken[row])
            best[row] = Hypothesis(library.entries[rows[row]], part, agreement, spoken)
        else:
            best[row] = Hypothesis(known.entry, known.share + part, known.agreement, known.words)
    return tuple(sorted(best.values(), key=lambda one: -one.share))
