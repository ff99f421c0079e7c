"""Poses of few photos of an object on a turntable, from pairs (turntable.py) that outlines join (turntable_fit.py).

for each focal length: the axis of the best pairs ─► angles of the photos that features chain ─► groups turned to where
the outlines agree ─► of all focal lengths the one with the fewest misses ─► everything fitted together ─► points.
Features alone do not tell the focal length: a wrong one makes all angles too large or too small, and what looks right
from one side fits no outline from the other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from gsopt.data.image_files import IMAGE_FORMATS
from gsopt.data.outlines import Outline
from gsopt.data.sfm.features import ColmapProject
from gsopt.data.sfm.held_lens import guessed_lens
from gsopt.data.sfm.mapping import SMALLEST_MODEL, MappingResult
from gsopt.data.sfm.pair_matches import ImagePair, PairMatches
from gsopt.data.sfm.silhouettes import MIN_PIXELS, bounded_outline
from gsopt.data.sfm.turntable import MAX_ERROR, Link, Turntable, axes_of_pairs, chained, from_middles, links
from gsopt.data.sfm.turntable_fit import Matches, Silhouettes, Turned, fitted, fitted_angles
from gsopt.data.sfm.turntable_points import middle, reconstructed
from gsopt.events import Report
from gsopt.geometry.cameras import Cameras
from gsopt.raster.threads import one_torch_thread

TURNTABLE = "turntable"
"""The mapper in reports."""
FOCALS = (0.65, 0.9, 1.25, 1.75, 2.4)
"""Focal lengths to begin with where EXIF has none, in longer sides of the photo: a phone's to a portrait lens's."""
ROUNDS = 2
"""Times that the axis is fitted to the pairs that are linked."""
TURNS = np.arange(0, 360, 8)
"""Degrees by which a group is turned in a trial."""
NUDGES = np.arange(-12, 13, 2)
"""Degrees by which each group that was joined is turned again when another one is."""
ANOTHER_TURN = 24
STANDS_OUT = 0.6
"""A group is joined, and a photo held, where outlines miss by at most this share of their misses at any other turn,
and by COHERENT there: what looks alike from all sides says nothing. 8 photos of a museum head: 0.4, and 0.2 held."""
COHERENT = 1.0
"""Root mean square of the misses from which on poses are not believed, px of 512; 8 photos of the head: 0.4."""
MAX_GAP = 120.0
"""Degrees between two photos that follow each other, where the focal length is not known. A chain on one side fits any:
3 photos of the head came out 8 degrees off, their outlines by 0.1 px."""
REACH = 6.0
"""Farthest from its epipolar line that a match takes part in the fit, px."""
FEWEST = 12
"""Matches of a pair that take part."""
SPARSE = 3
"""Every third pixel of an outline is compared while groups are turned."""
FITS = 2
"""Times that photos which outlines do not hold are turned to another place, and everything is fitted again."""


@dataclass(frozen=True)
class Shown:
    """Matches and outlines of photos of a turntable."""

    points: Matches
    """Ends of the matches of each pair, px from the middles of their photos."""
    silhouettes: Silhouettes
    photos: tuple[int, ...]
    diagonal: float

    def misses(self, turned: Turned) -> float:
        """Root mean square of the misses of the outlines, px of 512."""
        return self.silhouettes.misses(turned)

    def fitted(self, turned: Turned, *, focal: bool, every: int = 1) -> Turned:
        """Fitted to the matches that are near and to every so many pixels of the outlines."""
        near = {pair: ends for pair, ends in turned.fitting(self.points, REACH).items() if len(ends[0]) >= FEWEST}
        return fitted(turned, near, self.silhouettes.sparser(every), self.diagonal, focal=focal)


def one_lens(project: ColmapProject) -> Any | None:
    """The camera of all photos, or None where there are several."""
    with project.opened() as db:
        cameras = db.read_all_cameras()
    return cameras[0] if len(cameras) == 1 else None


def find_turned(
    project: ColmapProject, camera: Any, pairs: PairMatches, outlines: Mapping[int, Outline], report: Report
) -> MappingResult | None:
    """The poses on which the matches and the outlines of photos by one camera agree, or None."""
    if outlines.keys() != pairs.names.keys():
        return None
    known, side = camera.has_prior_focal_length, max(camera.width, camera.height)
    focals = [float(camera.mean_focal_length())] if known else [focal * side for focal in FOCALS]
    camera = camera if known else guessed_lens(project.pycolmap, camera, FOCALS[0])
    shown = _shown(camera, pairs, outlines)
    with one_torch_thread():
        found = [_with_focal(project, shown, focal, known=known) for focal in focals]
        tried = [turned for turned in found if turned is not None and _holds(turned, known)]
        best = min(tried, key=lambda turned: (-len(turned.photos), shown.misses(turned)), default=None)
        best = None if best is None else _settled(shown, best, known)
    if best is None:
        return None
    misses = shown.misses(best)
    report(
        f"turned about one axis, {len(best.photos)} of {len(pairs.names)} photos have outlines that miss by "
        f"{misses:.1f} px"
    )
    if misses > COHERENT:
        return None
    return MappingResult(reconstructed(project, camera, pairs, best), TURNTABLE, [])


def _settled(shown: Shown, best: Turned, focal_known: bool) -> Turned | None:
    """Everything fitted together, and photos that outlines do not hold turned to where they do, or None."""
    for round_ in range(FITS + 1):
        best = _held_by_outlines(shown, shown.fitted(best, focal=not focal_known))
        if not _holds(best, focal_known):
            return None
        if round_ < FITS:
            best = _joined(shown, best, [best.unplaced(photo) for photo in shown.photos if photo not in best.photos])
    return best


def _holds(turned: Turned, focal_known: bool) -> bool:
    """True for enough photos, which must be from all around where nothing else tells the focal length."""
    angles = np.sort(np.degrees(turned.angles) % 360)
    gaps = np.diff(np.append(angles, angles[:1] + 360))
    return len(angles) >= SMALLEST_MODEL and (focal_known or bool(gaps.max() <= MAX_GAP))


def mask_outlines(masks: Path, pairs: PairMatches) -> dict[int, Outline]:
    """The outlines of the photos that have a mask with one, at a bounded size."""
    found = {}
    for photo, name in pairs.names.items():
        if (masks / f"{name}.png").is_file():
            outline = _outline(masks / f"{name}.png")
            if len(outline.pixels()[0]) >= MIN_PIXELS:
                found[photo] = outline
    return found


def _outline(mask: Path) -> Outline:
    with Image.open(mask, formats=IMAGE_FORMATS) as image:
        pixels = torch.from_numpy(np.array(image.convert("L")))[..., None]
    height, width = pixels.shape[:2]
    return bounded_outline(pixels, Cameras(torch.eye(4)[None], torch.eye(3)[None], width, height))


def _shown(camera: Any, pairs: PairMatches, outlines: Mapping[int, Outline]) -> Shown:
    middles = {photo: middle(camera, pairs, photo) for photo in pairs.names}
    scale = next(iter(outlines.values())).camera.width / camera.width
    silhouettes = Silhouettes(
        outlines,
        {photo: outline.pixels() for photo, outline in outlines.items()},
        {photo: scale * place for photo, place in middles.items()},
        scale,
    )
    diagonal = float(np.hypot(camera.width, camera.height))
    return Shown(from_middles(pairs, middles), silhouettes, tuple(pairs.names), diagonal)


def _with_focal(project: ColmapProject, shown: Shown, focal: float, *, known: bool) -> Turned | None:
    """All photos that can be placed with a focal length, which changes with the outlines of the largest chain."""
    axes = axes_of_pairs(project.pycolmap, shown.points, focal, project.config.seed)
    started = [(table, links(table, shown.points)) for table in axes]
    started = [(table, found) for table, found in started if found]
    if not started:
        return None
    turned, groups = _chained(shown, *max(started, key=lambda start: _support(start[1])))
    if len(groups[0]) >= SMALLEST_MODEL:
        table = shown.fitted(turned.only(groups[0]), focal=not known, every=SPARSE).table
        turned, groups = _chained(shown, table, links(table, shown.points))
    if len(groups[0]) < 2:  # nothing to turn another photo against
        return None
    return _joined(shown, turned.only(groups[0]), [turned.only(group) for group in groups[1:]])


def _support(found: Mapping[ImagePair, Link]) -> float:
    return sum(link.support for link in found.values())


def _chained(shown: Shown, table: Turntable, found: dict[ImagePair, Link]) -> tuple[Turned, list[list[int]]]:
    """All photos with angles that are right within the groups that features chain, and the groups."""
    count = len(shown.photos)
    turned = Turned(table, shown.photos, np.zeros(count), np.zeros((count, 2)))
    groups: list[dict[int, float]] = []
    for _ in range(ROUNDS):
        groups, chain = chained(found, shown.photos)
        angles = {photo: angle for group in groups for photo, angle in group.items()}
        turned = replace(turned, angles=np.radians([angles[photo] for photo in shown.photos]))
        turned = fitted_angles(turned, turned.fitting({pair: shown.points[pair] for pair in chain}, MAX_ERROR))
        found = links(turned.table, shown.points)
    return turned, [sorted(group) for group in groups]


def _joined(shown: Shown, placed: Turned, waiting: list[Turned]) -> Turned:
    """With those of other groups of photos whose outlines fit at one turn alone, the clearest first. Photos of a group
    that fits nowhere are tried one by one: the turn between them may be wrong."""
    sparse = shown.silhouettes.sparser(SPARSE)
    joined: list[Turned] = []
    while waiting:
        rows = [_misses_by_turn(sparse, placed, group) for group in waiting]
        clear = [_clearness(misses, int(misses.argmin())) for misses in rows]
        chosen = int(np.argmin(clear))
        if clear[chosen] <= STANDS_OUT:
            joined.append(waiting.pop(chosen))
            placed = placed.joined(joined[-1], np.radians(TURNS[rows[chosen].argmin()]))
            for group in joined:
                placed = _nudged(sparse, placed, group.photos)
        elif all(len(group.photos) == 1 for group in waiting):
            break
        else:
            waiting = [group.only([photo]) for group in waiting for photo in group.photos]
    return placed


def _nudged(silhouettes: Silhouettes, placed: Turned, group: Sequence[int]) -> Turned:
    """A group turned a little to where the outlines miss least."""
    rest, own = placed.only([photo for photo in placed.photos if photo not in group]), placed.only(group)
    return min((rest.joined(own, np.radians(turn)) for turn in NUDGES), key=silhouettes.misses)


def _held_by_outlines(shown: Shown, placed: Turned) -> Turned:
    """The photos whose outlines fit at no other turn: a thing that looks alike from several sides can be matched on the
    wrong one."""
    sparse = shown.silhouettes.sparser(SPARSE)
    held: list[int] = []
    for photo in placed.photos:
        others = placed.only([other for other in placed.photos if other != photo])
        if _clearness(_misses_by_turn(sparse, others, placed.only([photo])), 0) <= STANDS_OUT:
            held.append(photo)
    return placed.only(held)


def _misses_by_turn(silhouettes: Silhouettes, placed: Turned, group: Turned) -> Float[np.ndarray, "T"]:
    """Misses of the outlines with a group at each of the TURNS from where it is."""
    return np.array([silhouettes.misses(placed.joined(group, np.radians(turn))) for turn in TURNS])


def _clearness(misses: Float[np.ndarray, "T"], best: int) -> float:
    """The misses at one of the TURNS as a share of the least at those that are not near it; infinite where these do not
    exclude a turn."""
    other = float(misses[np.abs((TURNS - TURNS[best] + 180) % 360 - 180) > ANOTHER_TURN].min())
    return float(misses[best]) / other if other >= COHERENT else math.inf
