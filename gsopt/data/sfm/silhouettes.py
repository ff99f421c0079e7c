"""Poses of few photos on which the silhouettes of the object agree, to fractions of a pixel.

Few photos of a smooth object share few points, which hold a pose loosely; outlines hold it too. Silhouettes of one
object cohere: on the ray of every outline pixel lies a point that no other silhouette excludes (Hernández, Schmitt &
Cipolla 2007). With s_v(x) the signed distance of x to the outline in view v, px, positive inside, an outline pixel p of
view i misses by

    (1)  r_p = max(0, -max over x on the ray of p of min over v other than i of s_v(x)).

All poses move together to where (1) is least, each held by a prior to where the points put it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from gsopt.data.outlines import MAX_DISTANCE, Outline
from gsopt.data.resample import downscaled_size, premultiplied_downscale
from gsopt.data.scene import View
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.rigid_motion import rigid_motion
from gsopt.raster.threads import one_torch_thread

MAX_SIDE = 512
"""Longer side of the masks that are compared, px."""
SAMPLES, FINER = 64, 17
"""Points along a ray, then more around the best of them."""
REACH = 1.3
"""Half the length of the rays, in radii of the object as the photos show it."""
TURN, SHIFT = math.radians(1), 0.02
"""Standard deviations of the prior: turns about the object, and shifts in its radii."""
OUTLIER = 2.0
"""Misses beyond it count linearly (Huber), px: a mask may show another thing."""
RAY_WEIGHT = 0.1
"""Weight of a ray's squared miss, px^-2; neighbors on an outline say nearly the same."""
COHERENT = 0.3
"""Root mean square of the misses up to which poses stay as they are, px: those of renders."""
MOST_MISSES_LEFT = 0.5
"""Poses stay if more than this share of the misses is left: then they are not what is wrong."""
CONTRADICTED = 2.0
"""Root mean square of the misses from which on poses or masks are wrong, px: 2.4 at best where two of 14
photos of a toy were turned by 176 degrees, their mean error 0.8 px; 1.4 with the published poses of a museum's head."""
MAX_STEPS, MAX_DAMPINGS, LEAST_GAIN, STEP = 25, 5, 1e-3, 2e-3
"""Steps, dampings tried for each, the share of the cost below which a gain ends the search, and the step of the
derivatives."""
FEWEST_AGREEING = 3
"""Views of which outlines can agree by more than chance."""
MIN_PIXELS = 20
"""Outline pixels that every photo needs."""
FREEDOM = 6

Pixels = tuple[Float[Tensor, "R"], Float[Tensor, "R"]]


@dataclass(frozen=True)
class CoherentPoses:
    """Poses with the least misses near the given ones, and the misses before and after: root mean square, px of masks
    up to MAX_SIDE large."""

    viewmats: Float[Tensor, "C 4 4"]
    before: float
    after: float

    @property
    def better(self) -> bool:
        """True where the given poses were not coherent and these are."""
        return self.before > COHERENT and self.after <= MOST_MISSES_LEFT * self.before

    @property
    def contradicted(self) -> bool:
        """True where no poses near the given ones fit the masks."""
        return self.after >= CONTRADICTED


def coherent_poses(views: Sequence[View]) -> CoherentPoses | None:
    """Poses of views with alpha on which the silhouettes agree most, or None if a photo has no outline."""
    outlines = [outline(view) for view in views]
    if any(len(outline.pixels()[0]) < MIN_PIXELS for outline in outlines):
        return None
    with one_torch_thread():
        return _refined(Coherence(outlines))


def contradicting(views: Sequence[View]) -> list[int]:
    """Numbers of the few views whose outlines contradict those of all others, which agree; none where it is not so.

    Views are left out one by one, always the one without which the others miss least, as long as more than half stay.
    """
    with one_torch_thread():
        coherence = Coherence([outline(view) for view in views])
        distances = coherence.distances(coherence.viewmats, coherence.across(coherence.viewmats))
        agreeing = list(range(len(views)))
        enough = min(CONTRADICTED, MOST_MISSES_LEFT * coherence.misses_among(agreeing, distances))
        while len(agreeing) > max(FEWEST_AGREEING, len(views) / 2 + 1):
            rests = [[view for view in agreeing if view != left_out] for left_out in agreeing]
            left, agreeing = min((coherence.misses_among(rest, distances), rest) for rest in rests)
            if left <= enough:
                return sorted(set(range(len(views))) - set(agreeing))
    return []


def outline(view: View) -> Outline:
    """A photo's silhouette at a bounded size."""
    return bounded_outline(view.pixels()[..., 3:], view.camera)


def bounded_outline(pixels: UInt8[Tensor, "H W 1"], camera: Cameras) -> Outline:
    """The outline of alpha or of a mask at a bounded size."""
    factor = max(1.0, max(pixels.shape[:2]) / MAX_SIDE)
    height, width = (downscaled_size(size, factor) for size in pixels.shape[:2])
    alpha = premultiplied_downscale(pixels, width, height) / 255
    return Outline.of(camera.resized(width, height), alpha)


class Coherence:
    """Outlines, the rays through their pixels, and (1) for any poses of their cameras."""

    def __init__(self, outlines: Sequence[Outline], pixels: Sequence[Pixels] | None = None) -> None:
        """`pixels`: those of the outlines that are compared, if not all."""
        self.outlines = outlines
        self.viewmats = torch.cat([outline.camera.viewmats for outline in outlines]).double()
        pixels = [outline.pixels() for outline in outlines] if pixels is None else pixels
        counts = torch.tensor([len(column) for column, _ in pixels])
        self._own = torch.arange(len(outlines)).repeat_interleave(counts)
        self._directions = torch.cat([_directions(o, *p) for o, p in zip(outlines, pixels, strict=True)])
        self.center, self.radius = _ball(self.viewmats, self._own, self._directions)

    def across(self, viewmats: Float[Tensor, "C 4 4"]) -> Float[Tensor, "R S"]:
        """Depths all through the object on all rays."""
        middle = (viewmats[:, 2, :3] @ self.center + viewmats[:, 2, 3])[self._own]
        reach = torch.linspace(-1, 1, SAMPLES, dtype=torch.float64) * REACH * self.radius
        return (middle[:, None] + reach).clamp(min=1e-3 * self.radius)

    def near_optima(self, viewmats: Float[Tensor, "C 4 4"]) -> Float[Tensor, "R S"]:
        """Depths around the x of (1) on all rays."""
        depths = self.across(viewmats)
        best = self.distances(viewmats, depths).amin(0).argmax(1, keepdim=True)
        apart = 2 * REACH * self.radius / (SAMPLES - 1)
        return depths.gather(1, best) + torch.linspace(-1, 1, FINER, dtype=torch.float64) * apart

    def distances(self, viewmats: Float[Tensor, "C 4 4"], depths: Float[Tensor, "R S"]) -> Float[Tensor, "C R S"]:
        """Signed distances of points on all rays in all photos; far inside in the ray's own."""
        points = self._points(viewmats, depths, slice(None))
        found = torch.stack([self._at(view, viewmats, points) for view in range(len(viewmats))])
        found[self._own, torch.arange(len(self._own))] = MAX_DISTANCE
        return found

    def misses(self, distances: Float[Tensor, "C R S"]) -> Float[Tensor, "R"]:
        """(1) for all rays, px."""
        return (-distances.amin(0).amax(1)).clamp(min=0)

    def misses_among(self, chosen: list[int], distances: Float[Tensor, "C R S"]) -> float:
        """Root mean square of (1) without the other views, px."""
        rays = torch.isin(self._own, torch.tensor(chosen))
        return rms(self.misses(distances[chosen][:, rays]))

    def jacobian(
        self, viewmats: Float[Tensor, "C 4 4"], depths: Float[Tensor, "R S"], distances: Float[Tensor, "C R S"]
    ) -> Float[Tensor, "R D"]:
        """d(misses)/d(motions) among these points, by central differences. A camera that moves changes the distances in
        its own photo, and those of its own rays in all others."""
        columns = []
        for view in range(len(viewmats)):
            for change in STEP * torch.eye(FREEDOM, dtype=torch.float64):
                ahead, behind = (self._moved_one(viewmats, view, way * change, depths, distances) for way in (1, -1))
                columns.append((ahead - behind) / (2 * STEP))
        return torch.stack(columns, 1)

    def moved(self, viewmats: Float[Tensor, "C 4 4"], motions: Float[Tensor, "D"]) -> Float[Tensor, "C 4 4"]:
        """Cameras that see the object turned about its center, and shifted in its radii."""
        rows = zip(viewmats, motions.view(-1, FREEDOM), strict=True)
        return torch.stack([self._motion(viewmat, motion) @ viewmat for viewmat, motion in rows])

    def _motion(self, viewmat: Float[Tensor, "4 4"], motion: Float[Tensor, "6"]) -> Float[Tensor, "4 4"]:
        middle = viewmat[:3, :3] @ self.center + viewmat[:3, 3]
        found = rigid_motion(torch.cat([motion[:3], self.radius * motion[3:]]))
        found[:3, 3] += middle - found[:3, :3] @ middle
        return found

    def _moved_one(
        self,
        viewmats: Float[Tensor, "C 4 4"],
        view: int,
        change: Float[Tensor, "6"],
        depths: Float[Tensor, "R S"],
        distances: Float[Tensor, "C R S"],
    ) -> Float[Tensor, "R"]:
        """The misses after one camera has moved."""
        moved, found = viewmats.clone(), distances.clone()
        moved[view] = self._motion(viewmats[view], change) @ viewmats[view]
        own = torch.nonzero(self._own == view)[:, 0]
        found[view] = self._at(view, moved, self._points(viewmats, depths, slice(None)))
        points = self._points(moved, depths[own], own)
        for other in range(len(viewmats)):
            found[other, own] = self._at(other, moved, points)
        found[view, own] = MAX_DISTANCE
        return self.misses(found)

    def _points(
        self, viewmats: Float[Tensor, "C 4 4"], depths: Float[Tensor, "R S"], rows: slice | Int64[Tensor, "R"]
    ) -> Float[Tensor, "R S 3"]:
        """Points at depths along some rays."""
        R, t = viewmats[self._own[rows], :3, :3], viewmats[self._own[rows], :3, 3]
        seen = self._directions[rows][:, None] * depths[..., None] - t[:, None]
        return (R.mT[:, None] @ seen[..., None])[..., 0]

    def _at(self, view: int, viewmats: Float[Tensor, "C 4 4"], points: Float[Tensor, "R S 3"]) -> Float[Tensor, "R S"]:
        """Signed distances in one photo, px."""
        K = self.outlines[view].camera.Ks[0].double()
        x, y, z = (points @ viewmats[view, :3, :3].T + viewmats[view, :3, 3]).flatten(0, 1).unbind(1)
        before = z > 1e-6 * self.radius
        z = torch.where(before, z, 1.0)
        column, row = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
        found = self.outlines[view].here(column.float(), row.float()).double()
        return torch.where(before, found, -float(MAX_DISTANCE)).view(points.shape[:2])


def _directions(outline: Outline, column: Tensor, row: Tensor) -> Float[Tensor, "R 3"]:
    """Directions in the camera's axes, of depth 1."""
    K = outline.camera.Ks[0].double()
    x, y = (column.double() - K[0, 2]) / K[0, 0], (row.double() - K[1, 2]) / K[1, 1]
    return torch.stack([x, y, torch.ones_like(x)], 1)


def _ball(
    viewmats: Float[Tensor, "C 4 4"], own: Int64[Tensor, "R"], directions: Float[Tensor, "R 3"]
) -> tuple[Float[Tensor, "3"], float]:
    """Center and radius of the object: nearest to the rays through the middles of the outlines, and as wide as the
    widest outline there."""
    R, t = viewmats[:, :3, :3], viewmats[:, :3, 3]
    eyes = -(R.mT @ t[..., None])[..., 0]
    middles = torch.stack([directions[own == view].mean(0) for view in range(len(viewmats))])
    axes = torch.nn.functional.normalize((R.mT @ middles[..., None])[..., 0], dim=1)
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None]
    center = torch.linalg.solve(across.sum(0), (across @ eyes[..., None]).sum(0))[:, 0]
    depths = (R @ center + t)[:, 2]
    return center, float(((directions - middles[own]).norm(dim=1) * depths[own]).max())


def _refined(silhouettes: Coherence) -> CoherentPoses:
    """Levenberg-Marquardt over the motions of all cameras."""
    viewmats = silhouettes.viewmats
    motions = torch.zeros(FREEDOM * len(viewmats), dtype=torch.float64)
    prior = torch.tensor([TURN**-2] * 3 + [SHIFT**-2] * 3, dtype=torch.float64).repeat(len(viewmats))
    depths = silhouettes.near_optima(viewmats)
    distances = silhouettes.distances(viewmats, depths)
    misses = silhouettes.misses(distances)
    before = rms(misses)
    if before <= COHERENT:
        return CoherentPoses(viewmats, before, before)
    cost, damping = _cost(misses, motions, prior), 1e-2
    for _ in range(MAX_STEPS):
        J = silhouettes.jacobian(viewmats, depths, distances)
        weights = RAY_WEIGHT * (OUTLIER / misses.clamp(min=OUTLIER))
        A, b = J.T @ (weights[:, None] * J) + torch.diag(prior), J.T @ (weights * misses) + prior * motions
        gained = 0.0
        for _ in range(MAX_DAMPINGS):
            step = -torch.linalg.solve(A + damping * torch.diag(A.diagonal()), b)
            tried = silhouettes.moved(viewmats, step)
            ahead = silhouettes.near_optima(tried)
            there = silhouettes.distances(tried, ahead)
            left = silhouettes.misses(there)
            gained = cost - _cost(left, motions + step, prior)
            if gained > 0:
                viewmats, depths, distances, misses, motions = tried, ahead, there, left, motions + step
                damping = max(damping / 4, 1e-6)
                break
            damping *= 4
        if gained <= LEAST_GAIN * cost:
            break
        cost -= gained
    return CoherentPoses(viewmats, before, rms(misses))


def _cost(misses: Float[Tensor, "R"], motions: Float[Tensor, "D"], prior: Float[Tensor, "D"]) -> float:
    rays = torch.where(misses <= OUTLIER, misses**2 / 2, OUTLIER * (misses - OUTLIER / 2))
    return float(RAY_WEIGHT * rays.sum() + (prior * motions**2).sum() / 2)


def rms(misses: Float[Tensor, "R"]) -> float:
    return float(misses.square().mean().sqrt())
