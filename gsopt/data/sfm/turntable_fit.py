"""The poses of photos of a turntable on which features and outlines agree best, by Levenberg-Marquardt.

The unknowns are the axis, the focal length, an angle for each photo, and where its middle lies: a photo may be cut out
of a larger one, or the camera nod a little. The residuals are the distances of matches from their epipolar lines, the
misses of the outlines (silhouettes.py), and the shifts of the middles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.data.outlines import Outline
from gsopt.data.sfm.pair_matches import ImagePair
from gsopt.data.sfm.silhouettes import OUTLIER, RAY_WEIGHT, Coherence, Pixels, rms
from gsopt.data.sfm.turntable import Ends, Turntable
from gsopt.geometry.cameras import Cameras

POINT_SCALE = 0.5
"""Distance from its epipolar line from which on a match pulls less (Cauchy), px."""
MIDDLE = 0.003
"""Standard deviation of a photo's middle about where the background puts it, a share of the diagonal."""
MAX_STEPS, MAX_DAMPINGS, LEAST_GAIN = 40, 6, 1e-4
"""Steps, dampings tried for each, and the share of the cost below which a gain ends the fit."""

Matches = Mapping[ImagePair, Ends]
Residuals = Float[np.ndarray, "R"]


@dataclass(frozen=True)
class Turned:
    """Photos of one turntable."""

    table: Turntable
    photos: tuple[int, ...]
    angles: Float[np.ndarray, "C"]
    """Radians."""
    shifts: Float[np.ndarray, "C 2"]
    """Distance of each photo's middle from where the background puts it, px."""

    @property
    def viewmats(self) -> Float[np.ndarray, "C 4 4"]:
        return self.table.viewmats(self.angles)

    def only(self, photos: Sequence[int]) -> Turned:
        """Some of the photos."""
        rows = [self.photos.index(photo) for photo in photos]
        return Turned(self.table, tuple(photos), self.angles[rows], self.shifts[rows])

    def unplaced(self, photo: int) -> Turned:
        """Another photo, at angle 0."""
        return Turned(self.table, (photo,), np.zeros(1), np.zeros((1, 2)))

    def joined(self, other: Turned, turn: float) -> Turned:
        """With other photos of the same axis, turned by so many radians."""
        angles = np.concatenate([self.angles, other.angles + turn])
        return Turned(self.table, self.photos + other.photos, angles, np.concatenate([self.shifts, other.shifts]))

    def turn(self, pair: ImagePair) -> Float[np.ndarray, "1"]:
        """The angle from one photo to another, radians."""
        first, second = (self.photos.index(photo) for photo in pair)
        return self.angles[second : second + 1] - self.angles[first]

    def shifted(self, pair: ImagePair, ends: Ends) -> Ends:
        """Ends of matches from where the middles are."""
        first, second = (self.shifts[self.photos.index(photo)] for photo in pair)
        return ends[0] - first, ends[1] - second

    def fits(self, points: Matches, most: float) -> dict[ImagePair, Bool[np.ndarray, "M"]]:
        """Marks the matches between these photos that lie within `most` px of their epipolar lines."""
        return {
            pair: self.table.support(self.shifted(pair, ends), self.turn(pair), most)[0] > 0
            for pair, ends in points.items()
            if set(pair) <= set(self.photos)
        }

    def fitting(self, points: Matches, most: float) -> dict[ImagePair, Ends]:
        """Those matches."""
        fits = self.fits(points, most).items()
        return {pair: (points[pair][0][marks], points[pair][1][marks]) for pair, marks in fits}


@dataclass(frozen=True)
class Silhouettes:
    """The outlines of photos, their pixels that are compared, and how photos are scaled to them."""

    outlines: Mapping[int, Outline]
    pixels: Mapping[int, Pixels]
    middles: Mapping[int, Float[np.ndarray, "2"]]
    """The middle of each photo as the background says, px of the outline."""
    scale: float
    """Pixels of an outline in one of the photo."""

    def coherence(self, turned: Turned) -> Coherence:
        """The outlines as cameras of these poses see them."""
        K = torch.eye(3, dtype=torch.float64)
        K[0, 0] = K[1, 1] = self.scale * turned.table.focal
        outlines = []
        for photo, viewmat, shift in zip(turned.photos, turned.viewmats, turned.shifts, strict=True):
            K = K.clone()
            K[:2, 2] = torch.from_numpy(self.middles[photo] + self.scale * shift)
            known = self.outlines[photo]
            camera = Cameras(torch.from_numpy(viewmat)[None], K[None], known.camera.width, known.camera.height)
            outlines.append(replace(known, camera=camera))
        return Coherence(outlines, [self.pixels[photo] for photo in turned.photos])

    def misses(self, turned: Turned) -> float:
        """Root mean square of the misses, px."""
        coherence = self.coherence(turned)
        return rms(coherence.misses(coherence.distances(coherence.viewmats, coherence.across(coherence.viewmats))))

    def sparser(self, step: int) -> Silhouettes:
        """With every `step`-th pixel."""
        return replace(self, pixels={n: (x[::step], y[::step]) for n, (x, y) in self.pixels.items()})


def fitted_angles(turned: Turned, points: Matches) -> Turned:
    """The axis and the angles that fit matches best; focal length and middles stay."""
    count = len(turned.photos)
    start = np.zeros(3 + count - 1)

    def moved(p: Residuals) -> Turned:
        return _moved(turned, np.concatenate([p[:3], [0.0], p[3:], np.zeros(2 * count)]))

    best = _least_squares(lambda p, _: (_point_residuals(moved(p), points), None), start, np.full(len(start), 1e-4))
    return moved(best)


def fitted(turned: Turned, points: Matches, silhouettes: Silhouettes, diagonal: float, *, focal: bool) -> Turned:
    """Axis, angles, middles and, where `focal`, the focal length that fit matches and outlines best."""
    count = len(turned.photos)
    steps = np.concatenate([np.full(3 + count, 1e-3), np.full(2 * count, 0.2)])
    free = np.flatnonzero(np.arange(len(steps)) != 3) if not focal else np.arange(len(steps))

    def moved(p: Residuals) -> Turned:
        whole = np.zeros(len(steps))
        whole[free] = p
        return _moved(turned, whole)

    def residuals(p: Residuals, depths: Tensor | None) -> tuple[Residuals, Tensor | None]:
        here = moved(p)
        coherence = silhouettes.coherence(here)
        depths = coherence.near_optima(coherence.viewmats) if depths is None else depths
        misses = coherence.misses(coherence.distances(coherence.viewmats, depths)).numpy()
        huber = np.where(misses <= OUTLIER, misses, np.sqrt(OUTLIER * np.maximum(2 * misses - OUTLIER, 0.0)))
        held = here.shifts.ravel() / (MIDDLE * diagonal)
        return np.concatenate([_point_residuals(here, points), math.sqrt(RAY_WEIGHT) * huber, held]), depths

    return moved(_least_squares(residuals, np.zeros(len(free)), steps[free]))


def _moved(turned: Turned, p: Residuals) -> Turned:
    """Photos whose axis is tilted by two numbers and moved by one, whose focal length grows by exp of the fourth, and
    whose angles, but for the first, and middles change by the rest."""
    table, count = turned.table, len(turned.photos)
    aside = table.foot
    beside = np.cross(table.axis, aside)
    axis = table.axis + p[0] * aside + p[1] * beside
    axis /= np.linalg.norm(axis)
    foot = table.foot - axis * (axis @ table.foot)
    foot /= np.linalg.norm(foot)
    foot = math.cos(p[2]) * foot + math.sin(p[2]) * np.cross(axis, foot)
    angles = turned.angles + np.concatenate([[0.0], p[4 : 3 + count]])
    shifts = turned.shifts + p[3 + count :].reshape(count, 2)
    return Turned(Turntable(axis, foot, table.focal * math.exp(p[3])), turned.photos, angles, shifts)


def _point_residuals(turned: Turned, points: Matches) -> Residuals:
    """Their squares add up to Cauchy's loss."""
    errors = [turned.table.errors(turned.shifted(pair, ends), turned.turn(pair))[0] for pair, ends in points.items()]
    scaled = np.concatenate([*errors, np.zeros(0)]) / POINT_SCALE
    return POINT_SCALE * np.sign(scaled) * np.sqrt(np.log1p(scaled**2))


def _least_squares(
    residuals: Callable[[Residuals, Tensor | None], tuple[Residuals, Tensor | None]],
    start: Residuals,
    steps: Sequence[float] | Residuals,
) -> Residuals:
    """Levenberg-Marquardt with central differences. The second argument and value of `residuals` is what stays as it
    is while derivatives are taken."""
    p, damping = start, 1e-3
    r, held = residuals(p, None)
    for _ in range(MAX_STEPS):
        moves = np.diag(steps)
        J = np.stack([(residuals(p + m, held)[0] - residuals(p - m, held)[0]) / (2 * m.sum()) for m in moves], axis=1)
        A, b = J.T @ J, J.T @ r
        gained = 0.0
        for _ in range(MAX_DAMPINGS):
            step = np.linalg.solve(A + damping * np.diag(A.diagonal() + 1e-12), -b)
            tried, there = residuals(p + step, None)
            gained = float(r @ r - tried @ tried)
            if gained > 0:
                break
            damping *= 5
        if gained <= LEAST_GAIN * float(r @ r):
            return p + step if gained > 0 else p
        p, r, held, damping = p + step, tried, there, max(damping / 5, 1e-7)
    return p
