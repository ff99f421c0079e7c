"""Poses from few photos where the ordinary way fails: thorough features, and several starts of which the best is kept.

matches ─► without a background at rest ─► for each focal length: verified pairs ─► mapping from several first pairs
─► bundle adjustment ─► the reconstruction that explains most. With many photos one start is as good as another; with
few of them each decision of an incremental mapper counts.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gsopt.data.sfm.consistent_matches import consistent, disagreeing, on_epipolar_lines
from gsopt.data.sfm.features import ColmapProject, ViewGraph, read_graph
from gsopt.data.sfm.guided_matches import with_guided_matches
from gsopt.data.sfm.held_lens import focals_to_try, guessed_lens, hold_lens, support
from gsopt.data.sfm.joined_features import LearnedMatches, joined_matches
from gsopt.data.sfm.mapping import (
    SMALLEST_MODEL,
    MappingResult,
    bundle_adjusted,
    has_real_lens,
    incremental_options,
    keep_coherent,
    registered,
)
from gsopt.data.sfm.pair_matches import PairMatches, inside, match_features, read_matches, without_background
from gsopt.events import Report

FIRST_PAIRS = 5
"""Pairs from which mapping is started, besides COLMAP's own choice."""
MIN_POSE_INLIERS = 15
"""Points by which a photo is placed."""
MIN_INLIERS = 18
"""Features that two photos must have in common after verification."""
MAX_ERROR = 3.0
"""Farthest from the epipolar line, px."""
MAX_TRIALS = 5000
STRONG_OBSERVATIONS = 150
"""Points seen by the median photo with which the ordinary reconstruction of few photos is trusted, if none of them is
held by fewer than MIN_OBSERVATIONS confirmed ones: one of 12 with 45 was turned by 160 degrees, the median had 276."""
MIN_OBSERVATIONS = 100
"""Points seen by the median photo below which poses are no better than a guess: 4 of 8 photos of a museum head with 86
were turned by 3 to 70 degrees, 10 of 12 with 256 by 1.4."""
MIN_CONFIRMED = 50
"""Points seen by three photos or more, or by two of three that share points pair by pair, that must hold a photo where
learned features were matched. 4 of 8 photos of the head with 10 to 29 were turned by up to 57 degrees, their mean error
0.6 px."""
MIN_SHARED = 30
"""Points that two photos share and no third one sees, from which on their pair counts as one side of a triangle."""
MIN_TURN = 6.0
"""Degrees by which an object on a turntable turns at least; what turns less is a reflection or the room."""
AMPLE_OBSERVATIONS = 400
"""Points seen by the median photo from which more matches add time and nothing else."""


@dataclass(frozen=True)
class Attempt:
    """One reconstruction and how it was begun."""

    reconstruction: Any
    hypothesis: str
    """The words for where its features lie."""

    @property
    def photos(self) -> int:
        return int(self.reconstruction.num_reg_images())

    @property
    def support(self) -> float:
        return support(self.reconstruction)


@dataclass(frozen=True)
class Hypotheses:
    """Matches to try in order, each with the words for where they lie."""

    matches: list[tuple[str, PairMatches]]
    turntable: bool
    """True when a background at rest was left out."""
    turning: PairMatches | None
    """All that moves inside the masks, as of an object on a turntable; nothing without masks."""


def match_few(project: ColmapProject, masks: Path | None, learned: LearnedMatches | None) -> Hypotheses:
    """Matches inside the masks, if there are any, and in the whole photos; without a background at rest.

    With learned features, also of turned photos, what three photos contradict is left out.
    """
    pairs = match_features(project) if learned is None else joined_matches(project, learned, turned=True)
    seed, joint = project.config.seed, learned is not None
    moving = without_background(project.pycolmap, pairs, seed, jointly=joint)
    agreed = moving or pairs
    if learned is not None:
        agreed = consistent(on_epipolar_lines(project.pycolmap, agreed, seed))
    whole = [("the whole photos", agreed)]
    if masks is None:
        return Hypotheses(whole, moving is not None, None)
    turning = moving if joint else without_background(project.pycolmap, pairs, seed, jointly=True)
    return Hypotheses(
        [("the masks", inside(agreed, masks)), *whole], moving is not None, inside(turning or pairs, masks)
    )


def find_few_poses(
    project: ColmapProject, hypotheses: list[tuple[str, PairMatches]], report: Report
) -> tuple[MappingResult | None, ViewGraph]:
    """The best reconstruction of all starts, or None, and the view graph it was made from."""
    attempts: list[Attempt] = []
    count = len(hypotheses[0][1].names)
    focals = focals_to_try(project)
    for where, pairs in hypotheses:
        attempts += _attempts(project, pairs, where, focals)
        placed = max((attempt.photos for attempt in attempts), default=0)
        report(f"features of {where} place {placed} of {count} photos")
        if placed == count:
            break
    if not attempts:
        verify(project, hypotheses[-1][1])
        return None, read_graph(project)
    best = max(attempts, key=lambda attempt: attempt.support)
    pairs = dict(hypotheses)[best.hypothesis]
    verify(project, pairs, best.reconstruction)
    graph = read_graph(project)
    found, learned = best.reconstruction, project.config.features != "sift"
    if learned:
        keep_confirmed(found)
    if observations(found) < MIN_OBSERVATIONS or found.num_reg_images() < SMALLEST_MODEL:
        report(f"{best.photos} photos share too few points to be trusted: {observations(found)} in the median photo")
        return None, graph
    if observations(found) < AMPLE_OBSERVATIONS or learned:
        found = with_guided_matches(project, pairs, found)
    if found.num_reg_images() < count:
        found = _grown(project, pairs, found)
        if learned:
            keep_confirmed(found)
    keep_coherent(found)
    sound = found.num_reg_images() >= SMALLEST_MODEL and has_real_lens(project, found, report)
    return (MappingResult(found, "few photos", []) if sound else None), graph


def observations(reconstruction: Any) -> int:
    """Points that the median photo sees."""
    counts = [reconstruction.image(number).num_points3D for number in reconstruction.reg_image_ids()]
    return int(np.median(counts)) if counts else 0


def keep_confirmed(reconstruction: Any) -> None:
    """Takes back the poses of photos that too few points hold which something else checks.

    Points of two photos fit wherever the second one stands along its baseline. A third photo that sees them fixes that,
    and so do three photos any two of which share points: their baselines form a triangle.
    """
    while seen := confirmed_points(reconstruction):
        weakest = min(seen, key=lambda number: (seen[number], number))
        if seen[weakest] >= MIN_CONFIRMED:
            return
        reconstruction.deregister_frame(reconstruction.image(weakest).frame_id)


def confirmed_points(reconstruction: Any) -> Counter[int]:
    """Points by registered photo that three photos see, or two of three that share points pair by pair."""
    points = reconstruction.points3D.values()
    tracks = [tuple(sorted({element.image_id for element in point.track.elements})) for point in points]
    alone = Counter(photos for photos in tracks if len(photos) == 2)
    sides = sides_of_triangles({pair for pair, count in alone.items() if count >= MIN_SHARED})
    seen = Counter(dict.fromkeys(reconstruction.reg_image_ids(), 0))
    for photos in tracks:
        if len(photos) > 2 or photos in sides:
            seen.update(photos)
    return seen


def sides_of_triangles(pairs: set[tuple[int, ...]]) -> set[tuple[int, ...]]:
    """The pairs (smaller number first) whose two photos each make another pair with the same third one."""
    partners: dict[int, set[int]] = {}
    for a, b in pairs:
        partners.setdefault(a, set()).add(b)
        partners.setdefault(b, set()).add(a)
    return {(a, b) for a, b in pairs if partners[a] & partners[b]}


def trust(project: ColmapProject, mapped: MappingResult | None) -> int:
    """Points that the median photo of an ordinary reconstruction sees; 0 if it shows a background at rest."""
    if mapped is None or without_background(project.pycolmap, read_matches(project), project.config.seed) is not None:
        return 0
    return observations(mapped.reconstruction)


def _grown(project: ColmapProject, pairs: PairMatches, model: Any) -> Any:
    """The reconstruction with those of the missing photos that its exact points and lens now hold."""
    missing = pairs.names.keys() - set(model.reg_image_ids())
    verify(project, pairs, model, only=missing)
    start = project.database.with_name("start")
    shutil.rmtree(start, ignore_errors=True)
    start.mkdir()
    model.write(start)
    grown = _mapped(project, None, start)
    if not grown or grown[0].num_reg_images() <= model.num_reg_images():
        return model
    return with_guided_matches(project, pairs, bundle_adjusted(project, grown[0], lens=False))


def _attempts(project: ColmapProject, pairs: PairMatches, where: str, focals: list[float | None]) -> Iterator[Attempt]:
    """The best reconstruction with each focal length, adjusted. Several starts are mapped at a time, each on one
    thread, so that nothing depends on their number."""
    for focal in focals:
        counts = verify(project, pairs, focal=focal)
        firsts = [None, *sorted(counts, key=lambda pair: (-counts[pair], pair))[:FIRST_PAIRS]]
        with ThreadPoolExecutor(project.config.threads or os.cpu_count()) as pool:
            mapped = [model for models in pool.map(partial(_mapped, project), firsts) for model in models]
        if mapped:
            most = max((Attempt(model, where) for model in mapped), key=lambda attempt: attempt.support)
            yield Attempt(bundle_adjusted(project, most.reconstruction, lens=False), where)


def verify(
    project: ColmapProject,
    pairs: PairMatches,
    model: Any | None = None,
    *,
    focal: float | None = None,
    only: set[int] | None = None,
) -> dict[tuple[int, int], int]:
    """Puts the geometry of each pair into the database, by lenses of a focal length or of a reconstruction.

    With learned features, a pair that turns otherwise than the chain of better ones between its photos is left out.
    With `only`, what the database has is kept, save for pairs with one of these photos. Returns the number of
    features in common by pair, for pairs that have enough.
    """
    pycolmap = project.pycolmap
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = project.config.seed
    options.ransac.max_error = MAX_ERROR
    options.ransac.max_num_trials = MAX_TRIALS
    options.ransac.min_inlier_ratio = 0.1
    options.min_num_inliers = MIN_INLIERS
    options.compute_relative_pose = True
    options.detect_watermark = False
    counts: dict[tuple[int, int], int] = {}
    turns: dict[tuple[int, int], Any] = {}
    with project.opened() as db:
        if only is None:
            db.clear_two_view_geometries()
        lenses = _lenses(project, db, model, focal)
        cameras = {image.image_id: lenses[image.camera_id] for image in db.read_all_images()}
        for (a, b), rows in sorted(pairs.matches.items()):
            if len(rows) < MIN_INLIERS or (only is not None and not only & {a, b}):
                continue
            points = pairs.keypoints[a], pairs.keypoints[b]
            found = pycolmap.estimate_calibrated_two_view_geometry(
                cameras[a], points[0], cameras[b], points[1], rows, options
            )
            if db.exists_two_view_geometry(a, b):
                db.delete_two_view_geometry(a, b)
            if len(found.inlier_matches) >= MIN_INLIERS and found.cam2_from_cam1 is not None:
                db.write_two_view_geometry(a, b, found)
                counts[a, b] = len(found.inlier_matches)
                turns[a, b] = found.cam2_from_cam1.rotation.matrix()
        learned = project.config.features != "sift" and only is None
        for a, b in disagreeing(counts, turns, MIN_TURN if pairs.turntable else 0.0) if learned else []:
            db.delete_two_view_geometry(a, b)
            del counts[a, b]
    return counts


def _lenses(project: ColmapProject, db: Any, model: Any | None, focal: float | None) -> dict[int, Any]:
    """Cameras by number; those without a known focal length get the given one, and none of them distorts."""
    lenses = {camera.camera_id: camera for camera in db.read_all_cameras()}
    for number, camera in lenses.items():
        if model is not None and number in model.cameras:
            lenses[number] = model.cameras[number]
        elif focal is not None:
            lenses[number] = guessed_lens(project.pycolmap, camera, focal)
            db.update_camera(lenses[number])
    return lenses


def _mapped(project: ColmapProject, first: tuple[int, int] | None, start: Path | str = "") -> list[Any]:
    """Incremental reconstructions with the lens held, from a first pair or from a reconstruction. In a copy of the
    database: COLMAP writes to a database that it opens, and refuses one that another thread has just locked."""
    options = incremental_options(project)
    options.min_num_matches = MIN_INLIERS
    options.extract_colors = False
    options.structure_less_registration_fallback = False  # takes minutes, and places wrongly what has few matches
    hold_lens(options)
    options.triangulation.ignore_two_view_tracks = False
    mapper = options.mapper
    mapper.init_min_num_inliers = MIN_INLIERS
    mapper.init_min_tri_angle = 6.0
    mapper.abs_pose_min_num_inliers = MIN_POSE_INLIERS
    mapper.abs_pose_min_inlier_ratio = 0.25
    if first is not None:
        options.init_image_id1, options.init_image_id2 = first
        options.init_num_trials = 1  # a pair that does not suit would be tried 800 times, for a minute
    options.multiple_models = False
    project.pycolmap.set_random_seed(project.config.seed)  # each thread has numbers of its own
    with tempfile.TemporaryDirectory(dir=project.database.parent) as folder:
        database = Path(shutil.copyfile(project.database, Path(folder, "database.db")))
        models = project.pycolmap.incremental_mapping(
            database, project.photos, Path(folder), options=options, input_path=start
        )
    for model in models.values():
        keep_coherent(model)
    return [model for _, model in sorted(models.items()) if len(registered(model)) >= SMALLEST_MODEL]
