"""The feature database: cameras, SIFT features, the compared pairs, and their matches."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from gsopt.data.sfm.photos import Photo
from gsopt.data.sfm.retrieval import similar_pairs
from gsopt.data.sfm.settings import SfmConfig
from gsopt.events import Report

Pair = tuple[str, str]

RADIAL_FROM = 20
"""Photos with one camera from which on two lens terms are found reliably. Both axes always have one focal length:
cameras that go round an object at one height leave the vertical one open (a rendered orbit: 7 times the true one)."""
EXHAUSTIVE_UP_TO = 200
NEIGHBORS_IN_TIME = 10
LOOP_PARTNERS, SIMILAR_PARTNERS = 5, 30
"""Similar photos that each photo is compared with: to close loops of a video, and instead of all others."""
THOROUGH_FACTOR, FAINT_PEAK = 2, 0.003
"""Features of few photos, as a multiple of the setting, and how faint they may be."""
_PAIRS_PER_BATCH = 400
"""Pairs between two lines of progress."""


@dataclass(frozen=True)
class ColmapProject:
    """COLMAP at work on one set of photos."""

    pycolmap: ModuleType
    database: Path
    photos: Path
    """Folder of the images that features are read from."""
    config: SfmConfig

    def opened(self) -> Any:
        return self.pycolmap.Database.open(self.database)


@dataclass(frozen=True)
class ViewGraph:
    """Features and matches, by photo name."""

    features: dict[str, int]
    inliers: dict[Pair, int]
    """Features two photos have in common after geometric verification; pairs without any are absent."""
    still: frozenset[Pair]
    """Pairs explained by a plane or by turning on the spot: they carry no depth on their own."""

    def partners(self, name: str) -> dict[str, int]:
        """Photos that `name` has features in common with, and how many."""
        found = {b if a == name else a: n for (a, b), n in self.inliers.items() if name in (a, b)}
        return dict(sorted(found.items(), key=lambda item: (-item[1], item[0])))

    def is_still(self, a: str, b: str) -> bool:
        """True when the pair alone carries no depth."""
        return (a, b) in self.still or (b, a) in self.still

    def groups(self) -> list[set[str]]:
        """Photos connected by matches, largest group first; a photo without a match is a group of its own."""
        group = {name: {name} for name in self.features}
        for a, b in self.inliers:
            if group[a] is not group[b]:
                merged = group[a] | group[b]
                group.update(dict.fromkeys(merged, merged))
        distinct = {id(members): members for members in group.values()}.values()
        return sorted(distinct, key=lambda members: (-len(members), min(members)))


def extract(project: ColmapProject, photos: Sequence[Photo], masks: Path | None, *, thorough: bool = False) -> None:
    """SIFT features of all photos (none with `--features xfeat`), one camera for each lens, zoom and size.

    `thorough` finds features again from 40 degrees to the side, at five times the cost: affine shapes (Mikolajczyk and
    Schmid 2004), descriptors pooled over sizes (Dong and Soatto 2015), and fainter features.
    """
    pycolmap, database, config = project.pycolmap, project.database, project.config
    project.opened().close()  # makes it
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = config.threads or -1
    options.max_image_size = config.max_size
    options.sift.max_num_features = config.max_features * (THOROUGH_FACTOR if thorough else 1)
    if thorough:
        options.sift.estimate_affine_shape = options.sift.domain_size_pooling = True
        options.sift.peak_threshold = FAINT_PEAK
    for shared in cameras(photos):
        reader = reader_options(pycolmap, shared, config)
        if masks is not None:
            reader.mask_path = masks
        names = [photo.name for photo in shared]
        # Listed first, in order: threads that finish in any order would number the photos in any order.
        pycolmap.import_images(database, project.photos, pycolmap.CameraMode.SINGLE, names, reader)
        if config.features == "xfeat":
            continue
        pycolmap.extract_features(
            database,
            project.photos,
            image_names=names,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
        )


def cameras(photos: Iterable[Photo]) -> list[list[Photo]]:
    """Photos that share a camera, in order of first appearance."""
    groups: dict[str, list[Photo]] = {}
    for photo in photos:
        groups.setdefault(photo.camera, []).append(photo)
    return list(groups.values())


def reader_options(pycolmap: ModuleType, shared: Sequence[Photo], config: SfmConfig) -> Any:
    """Lens model and first guess for photos of one camera."""
    model = config.camera_model
    if model == "auto":
        model = "RADIAL" if len(shared) >= RADIAL_FROM else "SIMPLE_RADIAL"
    options = pycolmap.ImageReaderOptions()
    options.camera_model = model
    focal = config.focal or shared[0].focal
    if focal is not None:
        camera = pycolmap.Camera.create_from_model_name(0, model, focal, shared[0].width, shared[0].height)
        options.camera_params = camera.params_to_string()
    return options


def choose_matching(config: SfmConfig, count: int, is_video: bool) -> str:
    """The matching that `auto` resolves to."""
    if config.matching != "auto":
        return config.matching
    if is_video:
        return "sequential"
    return "exhaustive" if count <= EXHAUSTIVE_UP_TO else "retrieval"


def match(project: ColmapProject, names: Sequence[str], matching: str, report: Report) -> ViewGraph:
    """Compare the photos that `matching` picks, verify each pair geometrically, and return the graph."""
    pycolmap, database, config = project.pycolmap, project.database, project.config
    pairs = pairs_to_match(project, names, matching)
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = config.threads or -1
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = config.seed
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = database.with_name("pairs.txt")
    began = time.monotonic()
    for start in range(0, len(pairs), _PAIRS_PER_BATCH):
        part = pairs[start : start + _PAIRS_PER_BATCH]
        pairing.match_list_path.write_text("".join(f"{a} {b}\n" for a, b in part), encoding="utf-8")
        pycolmap.match_image_pairs(
            database, matching_options=options, pairing_options=pairing, verification_options=verification
        )
        done = start + len(part)
        minutes = (time.monotonic() - began) / 60 * (len(pairs) / done - 1)
        left = f", about {minutes:.0f} min left" if minutes >= 1 else ""
        report(f"compared {done:,} of {len(pairs):,} pairs of photos ({matching}){left}")
    return read_graph(project)


def pairs_to_match(project: ColmapProject, names: Sequence[str], matching: str) -> list[Pair]:
    """Pairs in an order that does not depend on how they were found."""
    if matching == "exhaustive":
        return list(itertools.combinations(names, 2))
    pairs = set(neighbors_in_time(names))
    if len(names) > NEIGHBORS_IN_TIME:
        descriptors = read_descriptors(project, names)
        most = LOOP_PARTNERS if matching == "sequential" else SIMILAR_PARTNERS
        pairs |= {(names[i], names[j]) for i, j in similar_pairs(descriptors, most, project.config.seed)}
    rank = {name: position for position, name in enumerate(names)}
    return sorted(pairs, key=lambda pair: (rank[pair[0]], rank[pair[1]]))


def neighbors_in_time(names: Sequence[str]) -> Iterable[Pair]:
    """Each photo with the next ten, and with those 16, 32, 64, ... later."""
    steps = [*range(1, NEIGHBORS_IN_TIME + 1), *(2**power for power in range(4, 9))]
    return ((names[i], names[i + step]) for step in steps for i in range(len(names) - step))


def read_descriptors(project: ColmapProject, names: Sequence[str]) -> list[Any]:
    """SIFT descriptors of each photo, uint8 [F, 128]."""
    with project.opened() as db:
        ids = {image.name: image.image_id for image in db.read_all_images()}
        return [db.read_descriptors(ids[name]).data for name in names]


def read_graph(project: ColmapProject) -> ViewGraph:
    """The graph stored in a database."""
    pycolmap = project.pycolmap
    kinds = pycolmap.TwoViewGeometryConfiguration
    without_depth = {int(kinds.PANORAMIC), int(kinds.PLANAR_OR_PANORAMIC), int(kinds.PLANAR)}
    inliers: dict[Pair, int] = {}
    still: set[Pair] = set()
    with project.opened() as db:
        names = {image.image_id: image.name for image in db.read_all_images()}
        features = {name: db.num_keypoints_for_image(image_id) for image_id, name in names.items()}
        for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            count = len(geometry.inlier_matches)
            if count == 0:
                continue
            pair = (names[first], names[second])
            inliers[pair] = count
            if geometry.config in without_depth:
                still.add(pair)
    return ViewGraph(features, inliers, frozenset(still))
