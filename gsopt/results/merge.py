"""Merges two runs of one object: the splats of the second come into the frame of the first, each place from one run.

The similarity between the frames follows from photos that both runs have. In a place that both have splats in, those
stay that explain the input views of both runs better: both together would be twice as dense. The error of a splat is
the mean of |render - truth| over the pixels of all these views, weighted by transmittance times alpha.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gsopt.data.refined_poses import with_refined_poses
from gsopt.data.scene import Scene, View, load_scene
from gsopt.data.sfm.placement import Similarity
from gsopt.data.sfm.trajectory import align, centers, compare
from gsopt.errors import InputError
from gsopt.formats.placement import placed
from gsopt.gaussians import Gaussians
from gsopt.results.clean import pixel_sums
from gsopt.results.finished_run import FinishedRun, draw, open_run, truth

MIN_SHARED = 3
MAX_DEGREES, MAX_SHIFT = 2.0, 0.05
"""Most by which the median photo may stand otherwise in the second run: turned, and moved, in radii of the cameras."""
CELLS = 12
"""Cells along the largest side of the solid splats; each takes its splats from one run. Measured in howto/merge.md."""
FARTHEST = 1 << 18
"""Cells beyond this one count as this one."""
TIE = 1e-6
SOLID, INNER_SHARE = 0.5, 0.98
"""The solid splats are those of at least this opacity, the farthest few left out."""
REMEDY = (
    "Give both runs three or more photos in common, under the same names: add some of the first's photos to the second "
    "(gsopt sfm finds the poses), or train one run on all photos."
)


@dataclass(frozen=True)
class Alignment:
    """The second run in the frame of the first."""

    similarity: Similarity
    photos: int
    """Photos that both have."""
    degrees: float
    """Angle between the median photo's two directions."""
    shift: float
    """Distance of the median photo's two places, in radii of the cameras."""

    def place(self, gaussians: Gaussians) -> Gaussians:
        """Splats of the second run in the frame of the first."""
        found = self.similarity
        return placed(gaussians, found.scale, torch.from_numpy(found.rotation), torch.from_numpy(found.translation))

    def place_back(self, gaussians: Gaussians) -> Gaussians:
        """Splats of the first run in the frame of the second."""
        scale, turn = 1 / self.similarity.scale, torch.from_numpy(self.similarity.rotation.T.copy())
        return placed(gaussians, scale, turn, -scale * turn @ torch.from_numpy(self.similarity.translation))


@dataclass(frozen=True)
class Merged:
    """The splats of both runs in the frame of the first."""

    gaussians: Gaussians
    alignment: Alignment
    kept: tuple[int, int]
    """Splats of the first and of the second that stay."""


def merge(first: Path | str | FinishedRun, second: Path | str | FinishedRun) -> Merged:
    """Both runs in one. InputError where no photos in common say how they lie to each other."""
    first, second = (run if isinstance(run, FinishedRun) else open_run(Path(run)) for run in (first, second))
    if first.settings.antialiased != second.settings.antialiased:
        raise InputError("One run was trained with --antialiased, the other without. Train both alike.")
    scenes = [with_refined_poses(load_scene(run.config.data), run.path) for run in (first, second)]
    alignment = align_by_photos(*scenes)
    a, b = first.gaussians, alignment.place(second.gaussians)
    errors = [
        error_sums(first, scenes[0].train, here) + error_sums(second, scenes[1].train, there)
        for here, there in ((a, alignment.place_back(a)), (b, second.gaussians))
    ]
    stays = better(a, b, *errors)
    degree = max(a.sh_degree, b.sh_degree)
    both = with_degree(a.select(stays[0]), degree).append(with_degree(b.select(stays[1]), degree))
    return Merged(both, alignment, (int(stays[0].sum()), int(stays[1].sum())))


def align_by_photos(first: Scene, second: Scene) -> Alignment:
    """The similarity that the poses of photos of one name give; InputError where they are few or disagree."""
    there = {view.name: view for view in (*first.train, *first.test)}
    shared = [view for view in (*second.train, *second.test) if view.name in there]
    if len(shared) < MIN_SHARED:
        raise InputError(f"The runs must share {MIN_SHARED} photos to be merged, got {len(shared)}. {REMEDY}")
    poses, fixed = stacked(shared), stacked([there[view.name] for view in shared])
    error = compare(poses, fixed)
    degrees, shift = float(np.median(error.rotation_degrees)), float(np.median(error.position))
    if not (degrees <= MAX_DEGREES and shift <= MAX_SHIFT):
        raise InputError(
            f"{len(shared)} photos have the same names in both runs, but stand otherwise in each: the median one by "
            f"{degrees:.1f} degrees and {shift:.0%} of the cameras' radius. Are they the same photos? {REMEDY}"
        )
    return Alignment(align(centers(poses), centers(fixed)), len(shared), degrees, shift)


def stacked(views: list[View]) -> Float[np.ndarray, "C 4 4"]:
    """The views' poses, cam_from_world."""
    return np.concatenate([view.camera.viewmats.double().numpy() for view in views])


def error_sums(run: FinishedRun, views: Sequence[View], gaussians: Gaussians) -> Float[Tensor, "N 2"]:
    """Sums over the views of a run for each splat: its weight in pixels, and the weight times their error (0..1)."""
    total = torch.zeros(len(gaussians), 2)
    settings = replace(run.settings, sh_degree=gaussians.sh_degree)
    for view in views:
        drawn = draw(gaussians, view.camera, run.backend, settings, run.background)
        error = (drawn.float() - truth(view, run.background).float()).abs().mean(2) / 255
        total += pixel_sums(gaussians, view, run.backend, torch.stack([torch.ones_like(error), error], dim=2))[0]
    return total


def better(
    a: Gaussians, b: Gaussians, sums_a: Float[Tensor, "N 2"], sums_b: Float[Tensor, "M 2"]
) -> tuple[Bool[Tensor, "N"], Bool[Tensor, "M"]]:
    """Splats that stay: in each cell, with the cells around it, those of the run with the smaller mean error.

    `sums_a`, `sums_b`: of `error_sums`. A draw goes to the first run. Splats of b that no view sees do not stay.
    """
    means = torch.cat([a.means, b.means]).double()
    opacities = torch.cat([a.opacities, b.opacities])
    cells, rows = torch.unique(cells_of(means, means[opacities >= SOLID]), dim=0, return_inverse=True)
    places = rows.split([len(a), len(b)])
    errors = []
    for place, sums in zip(places, (sums_a, sums_b), strict=True):
        total = torch.zeros(len(cells), 2, dtype=torch.float64).index_add_(0, place, sums.double())
        total = with_neighbors(cells, total)
        errors.append(torch.where(total[:, 0] > 0, total[:, 1] / total[:, 0].clamp_min(1e-300), math.inf))
    second = errors[1] < errors[0] * (1 - TIE)
    return ~second[places[0]], second[places[1]] & (sums_b[:, 0] > 0)


def cells_of(means: Float[Tensor, "N 3"], solid: Float[Tensor, "S 3"]) -> Int[Tensor, "N 3"]:
    """The cell in which each mean lies."""
    points = solid if len(solid) else means
    ordered = points.sort(dim=0).values
    margin = int((1 - INNER_SHARE) / 2 * len(points))
    low, high = ordered[margin], ordered[-1 - margin]
    edge = max(float((high - low).max()) / CELLS, 1e-12)
    return ((means - low) / edge).floor().clamp(-FARTHEST, FARTHEST).long()


def with_neighbors(cells: Int[Tensor, "C 3"], sums: Float[Tensor, "C 2"]) -> Float[Tensor, "C 2"]:
    """The sums of each cell and its 26 neighbors; the cells are different and in order."""
    stride = torch.tensor([(4 * FARTHEST) ** 2, 4 * FARTHEST, 1])
    keys, total = cells @ stride, torch.zeros_like(sums)
    for step in torch.cartesian_prod(*[torch.tensor([-1, 0, 1])] * 3):
        wanted = (cells + step) @ stride
        row = torch.searchsorted(keys, wanted).clamp(max=len(keys) - 1)
        total += torch.where((keys[row] == wanted)[:, None], sums[row], 0)
    return total


def with_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """The same splats with as many bands, the new ones 0."""
    missing = (degree + 1) ** 2 - 1 - gaussians.shN.shape[1]
    return replace(gaussians, shN=torch.nn.functional.pad(gaussians.shN, (0, 0, 0, missing)))


def turned_degrees(similarity: Similarity) -> float:
    """Angle of a similarity's rotation."""
    return math.degrees(math.acos(min(1.0, max(-1.0, (float(np.trace(similarity.rotation)) - 1) / 2))))
