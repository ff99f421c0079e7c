"""An object that turns about one axis before a camera that stands still: what each pair of photos says of its turn.

Photos that move freely leave the length of every baseline open, so that a chain of pairs falls apart where no three
photos share points. A turntable has one axis, and each photo one angle θ:

    (1)  x = R(a, θ) (X - c) + c,

with the direction a of the axis and its point c nearest the camera, both in the camera's axes. The unit of length is
|c|, so that three numbers describe the axis, one the lens, and one each photo: a pair with 30 features in common is
held firmly, and matches of something else do not fit. Photos may be cut out of larger ones: each has its own middle.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from gsopt.data.sfm.pair_matches import ImagePair, PairMatches

MIN_TURN = 10.0
"""Degrees by which an object turns at least between two photos; less is a reflection, or the room."""
MAX_ERROR = 3.0
"""Farthest from the epipolar line, px."""
DEPTHS = (0.4, 1.6)
"""Nearest and farthest depth of the object's points, in distances of the axis."""
ANGLE_STEP = 2
"""Degrees between the turns that are tried."""
ANOTHER_TURN = 20
"""Degrees from the best turn at which another one begins."""
STANDS_OUT, MIN_SUPPORT = 2.0, 30.0
"""A pair is linked where its best turn has so many times the support of any other turn, and as many features at least.
8 photos of a museum head: 2.0 to 16 for photos side by side, 1.6 at most for others."""
FEWEST_MATCHES = 15
STARTS = 2
"""Pairs whose axes are tried."""
MAX_TURN, MAX_SCREW = 120.0, 0.3
"""A pair whose own motion says where the axis is turns by less, degrees, and moves less along it, a share."""

Ends = tuple[Float[np.ndarray, "M 2"], Float[np.ndarray, "M 2"]]
"""Places of the matches of a pair in both photos, px from the middle of each."""


@dataclass(frozen=True)
class Turntable:
    """The axis before the camera, and the focal length, px."""

    axis: Float[np.ndarray, "3"]
    foot: Float[np.ndarray, "3"]
    """Its point nearest the camera, 1 away."""
    focal: float

    def motions(self, angles: Float[np.ndarray, "A"]) -> tuple[Float[np.ndarray, "A 3 3"], Float[np.ndarray, "A 3"]]:
        """R and t of (1) for angles in radians: R x + t."""
        cross = skew(self.axis)
        sine, versine = np.sin(angles)[:, None, None], 1 - np.cos(angles)[:, None, None]
        R = np.eye(3) + sine * cross + versine * (cross @ cross)  # Rodrigues
        return R, self.foot - R @ self.foot

    def viewmats(self, angles: Float[np.ndarray, "C"]) -> Float[np.ndarray, "C 4 4"]:
        """Camera poses for angles in radians; the world is what the camera sees at angle 0."""
        found = np.tile(np.eye(4), (len(angles), 1, 1))
        found[:, :3, :3], found[:, :3, 3] = self.motions(angles)
        return found

    def errors(self, ends: Ends, angles: Float[np.ndarray, "A"]) -> Float[np.ndarray, "A M"]:
        """Signed distances of matches from the epipolar lines of each turn (Sampson), px."""
        R, t = self.motions(angles)
        x, y = (_rays(points, self.focal) for points in ends)
        E = skew(t) @ R
        along, back = x @ np.swapaxes(E, 1, 2), y @ E
        slope = (along[..., :2] ** 2).sum(2) + (back[..., :2] ** 2).sum(2)
        return (along * y).sum(2) / np.sqrt(slope + 1e-18) * self.focal

    def support(self, ends: Ends, angles: Float[np.ndarray, "A"], most: float = MAX_ERROR) -> Float[np.ndarray, "A M"]:
        """For each match max(0, 1 - (error / most)^2), and 0 where the point would not lie on the turntable."""
        R, t = self.motions(angles)
        x, y = (_rays(points, self.focal) for points in ends)
        turned = x @ np.swapaxes(R, 1, 2)
        across = turned[..., :2] - y[:, :2] * turned[..., 2:]  # depth * across = shift
        shift = y[:, :2] * t[:, None, 2:] - t[:, None, :2]
        depth = (across * shift).sum(2) / np.maximum((across**2).sum(2), 1e-18)
        seen = (depth > DEPTHS[0]) & (depth < DEPTHS[1]) & (depth * turned[..., 2] + t[:, None, 2] > 0)
        return np.maximum(0.0, 1 - (self.errors(ends, angles) / most) ** 2) * seen


@dataclass(frozen=True)
class Link:
    """The turn between two photos, degrees, and how many features say so."""

    turn: float
    support: float


def skew(v: Float[np.ndarray, "*A 3"]) -> Float[np.ndarray, "*A 3 3"]:
    """Matrices whose products with a vector are the cross products with it."""
    x, y, z = np.moveaxis(v, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*v.shape, 3)


def from_middles(pairs: PairMatches, middles: Mapping[int, Float[np.ndarray, "2"]]) -> dict[ImagePair, Ends]:
    """Both ends of the matches of each pair that has enough, px from the middles of their photos."""
    found = {}
    for (a, b), rows in sorted(pairs.matches.items()):
        if len(rows) >= FEWEST_MATCHES:
            first, second = pairs.points((a, b))
            found[a, b] = (first - middles[a], second - middles[b])
    return found


def links(table: Turntable, points: Mapping[ImagePair, Ends]) -> dict[ImagePair, Link]:
    """The pairs of which one turn stands out from all others."""
    found: dict[ImagePair, Link] = {}
    turns = np.arange(-180, 180, ANGLE_STEP)
    turns = turns[np.abs(turns) >= MIN_TURN]
    for pair, ends in points.items():
        supports = table.support(ends, np.radians(turns)).sum(1)
        best = int(supports.argmax())
        apart = np.abs((turns - turns[best] + 180) % 360 - 180)
        if supports[best] >= max(MIN_SUPPORT, STANDS_OUT * supports[apart > ANOTHER_TURN].max()):
            found[pair] = Link(float(turns[best]), float(supports[best]))
    return found


def chained(found: Mapping[ImagePair, Link], photos: Iterable[int]) -> tuple[list[dict[int, float]], list[ImagePair]]:
    """Groups of photos with their angles, degrees, largest first, and the pairs that chain them: the maximum spanning
    forest by support. The angles of a group count from its first photo."""
    groups = {photo: {photo: 0.0} for photo in photos}
    used = []
    for a, b in sorted(found, key=lambda pair: (-found[pair].support, pair)):
        kept, joined = groups[a], groups[b]
        if kept is joined:
            continue
        shift = kept[a] + found[a, b].turn - joined[b]
        kept |= {photo: angle + shift for photo, angle in joined.items()}
        groups |= dict.fromkeys(joined, kept)
        used.append((a, b))
    apart = {id(group): group for group in groups.values()}.values()
    return sorted(apart, key=lambda group: (-len(group), min(group))), used


def axes_of_pairs(pycolmap: Any, points: Mapping[ImagePair, Ends], focal: float, seed: int) -> list[Turntable]:
    """The axes about which the pairs with the most in common turn, where they move little along it."""
    tables: list[Turntable] = []
    for pair in sorted(points, key=lambda pair: (-len(points[pair][0]), pair)):
        if len(tables) == STARTS:
            break
        camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1, height=1, params=[focal, 0.0, 0.0])
        pose = _relative_pose(pycolmap, camera, points[pair], seed)
        table = None if pose is None else _axis(*pose, focal)
        tables += [] if table is None else [table]
    return tables


def _relative_pose(
    pycolmap: Any, camera: Any, ends: Ends, seed: int
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]] | None:
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed, options.ransac.max_error = seed, MAX_ERROR
    options.ransac.max_num_trials, options.ransac.min_inlier_ratio = 5000, 0.1
    options.compute_relative_pose, options.detect_watermark = True, False
    rows = np.repeat(np.arange(len(ends[0]), dtype=np.uint32)[:, None], 2, axis=1)
    found = pycolmap.estimate_calibrated_two_view_geometry(camera, ends[0], camera, ends[1], rows, options)
    if found.cam2_from_cam1 is None or len(found.inlier_matches) < FEWEST_MATCHES:
        return None
    return found.cam2_from_cam1.rotation.matrix(), np.asarray(found.cam2_from_cam1.translation)


def _axis(R: Float[np.ndarray, "3 3"], t: Float[np.ndarray, "3"], focal: float) -> Turntable | None:
    """The axis of a motion that is nearly a pure turn."""
    turn = np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)))
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    if not MIN_TURN < turn < MAX_TURN:
        return None
    axis /= np.linalg.norm(axis)
    along = float(t @ axis)
    if abs(along) > MAX_SCREW * np.linalg.norm(t):
        return None
    foot = np.linalg.solve(np.eye(3) - R + np.outer(axis, axis), t - along * axis)
    foot -= axis * (axis @ foot)
    return Turntable(axis, foot / np.linalg.norm(foot), focal)


def _rays(points: Float[np.ndarray, "M 2"], focal: float) -> Float[np.ndarray, "M 3"]:
    return np.column_stack([points / focal, np.ones(len(points))])
