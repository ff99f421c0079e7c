"""Matches of few photos in memory, where they can be tested and filtered before COLMAP maps them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt32
from PIL import Image

from gsopt.data.image_files import IMAGE_FORMATS
from gsopt.data.sfm.features import ColmapProject

MAX_RATIO = 0.85
"""Distance to the best match as a share of that to the second best: Lowe's 0.8 is strict, and more is checked."""
BACKGROUND_SHARE = 0.8
"""Share of the pairs that must show a background at rest before it is taken out."""
BACKGROUND_MATCHES = 12
BACKGROUND_SPAN = 0.5
"""Share of the picture, across and down, that a background at rest must cover."""
BACKGROUND_SHIFT = 0.15
"""Farthest a picture's corner moves with a background at rest, as a share of the diagonal."""
BACKGROUND_ERROR = 0.012
"""Distance from the background's homography, as a share of the diagonal: things before the wall move a little more."""

BACKGROUND_SPREAD = 0.02
"""Farthest that a match of the background moves otherwise than all of it, as a share of the diagonal."""
BACKGROUND_PARALLAX = 0.025
"""Farthest that the background of one pair may move otherwise than all pairs together say, as a share of the diagonal:
a hand-held camera moves a little. An object taken for it differed by 0.03 to 0.085."""
SHIFT_STEPS = 10

ImagePair = tuple[int, int]
Points = Float[np.ndarray, "F 2"]
Matches = UInt32[np.ndarray, "M 2"]


@dataclass(frozen=True)
class PairMatches:
    """Keypoints of each photo and matches of each pair, by the numbers of the database."""

    names: dict[int, str]
    sizes: dict[int, tuple[int, int]]
    keypoints: dict[int, Points]
    matches: dict[ImagePair, Matches]
    shifts: Mapping[int, Float[np.ndarray, "2"]] = field(default_factory=dict)
    """The places of a background at rest, which was left out, in each photo, px, zero on average; empty without one."""

    @property
    def turntable(self) -> bool:
        """True where a background at rest was left out."""
        return bool(self.shifts)

    def points(self, pair: ImagePair) -> tuple[Points, Points]:
        """Positions of the matches of a pair in both photos, px."""
        rows = self.matches[pair]
        return self.keypoints[pair[0]][rows[:, 0]], self.keypoints[pair[1]][rows[:, 1]]

    def kept(self, keep: Mapping[ImagePair, Bool[np.ndarray, "M"]]) -> PairMatches:
        """The same with some of the matches."""
        chosen = {pair: rows[keep[pair]] if pair in keep else rows for pair, rows in self.matches.items()}
        return replace(self, matches=chosen)


def match_features(project: ColmapProject) -> PairMatches:
    """Compares all photos with all by their features alone; no geometry yet."""
    pycolmap = project.pycolmap
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = project.config.threads or -1
    options.skip_geometric_verification = True
    options.sift.max_ratio = MAX_RATIO
    with project.opened() as db:
        names = [image.name for image in db.read_all_images()]
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = project.database.with_name("pairs.txt")
    pairing.match_list_path.write_text(
        "".join(f"{a} {b}\n" for a, b in itertools.combinations(names, 2)), encoding="utf-8"
    )
    pycolmap.match_image_pairs(project.database, matching_options=options, pairing_options=pairing)
    return read_matches(project)


def read_matches(project: ColmapProject) -> PairMatches:
    """The matches in a database, verified or not."""
    with project.opened() as db:
        images = {image.image_id: image for image in db.read_all_images()}
        names = {number: image.name for number, image in sorted(images.items())}
        cameras = {camera.camera_id: (camera.width, camera.height) for camera in db.read_all_cameras()}
        sizes = {number: cameras[images[number].camera_id] for number in names}
        keypoints = {number: db.read_keypoints(number)[:, :2].astype(np.float64) for number in names}
        matches = {
            pair: db.read_matches(*pair) for pair in itertools.combinations(names, 2) if db.exists_matches(*pair)
        }
    return PairMatches(names, sizes, keypoints, matches)


def inside(pairs: PairMatches, masks: Path) -> PairMatches:
    """The matches whose two ends lie inside the masks; a photo without a mask counts everywhere."""
    shows = {number: _shown(pairs, number, masks / f"{name}.png") for number, name in pairs.names.items()}
    return pairs.kept({(a, b): shows[a][rows[:, 0]] & shows[b][rows[:, 1]] for (a, b), rows in pairs.matches.items()})


def _shown(pairs: PairMatches, number: int, mask: Path) -> Any:
    points = pairs.keypoints[number]
    if not mask.is_file():
        return np.ones(len(points), dtype=bool)
    with Image.open(mask, formats=IMAGE_FORMATS) as image:
        pixels = np.asarray(image.convert("L"))
    columns = np.clip(points[:, 0].astype(int), 0, pixels.shape[1] - 1)
    rows = np.clip(points[:, 1].astype(int), 0, pixels.shape[0] - 1)
    return pixels[rows, columns] > 127


def without_background(pycolmap: Any, pairs: PairMatches, seed: int, *, jointly: bool = False) -> PairMatches | None:
    """The matches that move, or None if behind them no background stands still in the picture.

    An object on a turntable before a fixed camera has such a background. It is most of what matches there, fits a
    camera that never moved, and would be reconstructed in place of the object. A homography close to the identity
    explains it in every pair of photos, also from opposite sides; a camera that walks around sees no such thing.
    `jointly`, all pairs say together how the background of each photo is shifted, and one that disagrees is corrected.
    """
    compared = [pair for pair, rows in pairs.matches.items() if len(rows) >= BACKGROUND_MATCHES]
    still = {pair: _at_rest(pycolmap, *pairs.points(pair), pairs.sizes[pair[0]], seed) for pair in compared}
    found = {pair: rows for pair, rows in still.items() if rows.any()}
    if len(found) < 3 or len(found) < BACKGROUND_SHARE * len(compared):
        return None
    if not jointly:
        return pairs.kept({pair: ~rows for pair, rows in found.items()})
    shifts = _shifts(pairs, found)
    moving = pairs.kept({pair: ~_background(pairs, pair, still[pair], shifts) for pair in compared})
    return replace(moving, shifts=shifts)


def _shifts(pairs: PairMatches, still: Mapping[ImagePair, Bool[np.ndarray, "M"]]) -> dict[int, Float[np.ndarray, "2"]]:
    """Positions of the background in each photo, px, that fit all pairs with the least sum of distances.

    One pair alone may take an object that turned a little for the background.
    """
    numbers = sorted(pairs.names)
    signs = np.array([[(n == b) - (n == a) for n in numbers] for a, b in still], dtype=float)
    moved = np.array([np.median(np.subtract(*pairs.points(pair)[::-1])[rows], axis=0) for pair, rows in still.items()])
    weights = np.ones(len(signs))
    for _ in range(SHIFT_STEPS):  # Weiszfeld's weights; the last row sets the mean to zero
        system = np.vstack([signs * weights[:, None], np.ones(len(numbers))])
        found = np.linalg.lstsq(system, np.vstack([moved * weights[:, None], np.zeros(2)]), rcond=None)[0]
        weights = 1 / np.sqrt(np.maximum(np.linalg.norm(signs @ found - moved, axis=1), 1.0))
    return dict(zip(numbers, found, strict=True))


def _background(
    pairs: PairMatches, pair: ImagePair, still: Bool[np.ndarray, "M"], shifts: Mapping[int, Float[np.ndarray, "2"]]
) -> Bool[np.ndarray, "M"]:
    """Marks what moves as the background of the two photos does, and the pair's own background where it is the same."""
    moved = np.subtract(*pairs.points(pair)[::-1])
    expected = shifts[pair[1]] - shifts[pair[0]]
    diagonal = float(np.hypot(*pairs.sizes[pair[0]]))
    apart = np.linalg.norm(moved - expected, axis=1) / diagonal
    own = still.any() and np.linalg.norm(np.median(moved[still], axis=0) - expected) < BACKGROUND_PARALLAX * diagonal
    return still | (apart < BACKGROUND_ERROR) if own else apart < BACKGROUND_SPREAD


def _at_rest(pycolmap: Any, first: Points, second: Points, size: tuple[int, int], seed: int) -> Bool[np.ndarray, "M"]:
    """Marks the matches that lie on a wide background at rest."""
    width, height = size
    diagonal = float(np.hypot(width, height))
    marks = np.zeros(len(first), dtype=bool)
    near = np.flatnonzero(np.linalg.norm(second - first, axis=1) < BACKGROUND_SHIFT * diagonal)
    if len(near) < BACKGROUND_MATCHES:
        return marks
    options = pycolmap.RANSACOptions()
    options.max_error = BACKGROUND_ERROR * diagonal
    options.random_seed = seed
    options.max_num_trials = 3000
    found = pycolmap.estimate_homography_matrix(first[near], second[near], options)
    if found is None or found["num_inliers"] < BACKGROUND_MATCHES:
        return marks
    corners = np.array([[0.0, 0.0, 1.0], [width, 0.0, 1.0], [width, height, 1.0], [0.0, height, 1.0]])
    moved = corners @ np.asarray(found["H"]).T
    shift = np.linalg.norm(moved[:, :2] / moved[:, 2:] - corners[:, :2], axis=1).max() / diagonal
    rows = near[np.asarray(found["inlier_mask"], dtype=bool)]
    span = np.ptp(first[rows], axis=0) / (width, height)
    if shift < BACKGROUND_SHIFT and span.min() > BACKGROUND_SPAN:
        marks[rows] = True
    return marks
