"""Camera poses and points from matches: incremental, global, or global with incremental repair.

Everything here runs on one thread: sums over several threads would give other bits on every run.
"""

from __future__ import annotations

import copy
import itertools
import shutil
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gsopt.data.sfm.features import ColmapProject, ViewGraph
from gsopt.data.sfm.held_lens import focals_to_try, guessed_lens, hold_lens, support
from gsopt.data.sfm.photos import natural
from gsopt.data.sfm.settings import SfmConfig
from gsopt.events import Report

FEW_UP_TO = 16
"""Photos up to which the search of few_photos.py, which holds the lens too, is worth its time."""
INCREMENTAL_UP_TO = 300
"""Photos up to which `auto` maps incrementally: slower per photo, but it loses fewer."""
ENOUGH_PLACED = 0.9
"""Share of the photos below which `auto` tries the other mapper."""
HELD = "held-lens"
"""The mapper that `auto` tries where another one leaves out many of more photos than a few."""
SMALLEST_MODEL = 3
MIN_SHARED_POINTS = 15
"""Points a photo must share with another one for its pose to count."""
SEED_PHOTOS = 16
"""Best connected photos that are mapped incrementally first where global mapping needs the focal length."""
TRIANGULATIONS = 2
"""Rounds in which the points of a global model are triangulated again from all matches and the poses adjusted."""
LOSS_SCALE = 0.25
"""Error from which on an observation pulls less, px of the photo in which features are found. Learned features and
shiny things give many matches that are a little wrong: Cauchy's loss at this scale leaves half the error of poses that
Huber's at 1 px does (8 sets of 10 lego views: 0.21 -> 0.12 degrees, each gains; 33 photos of a head: 1.32 -> 0.36)."""
CENTER_FROM = 20
"""Photos of one camera from which on an adjustment may move its principal point. With 10 views of lego it moved by 1 to
5 %, and looked like a turn of all cameras by 0.3 to 0.5 degrees."""
MAX_OFF_CENTER = 0.03
"""Largest offset from the middle then, as a share of the photo's width or height. Around an object at one height, a
shift of all photos looks like a turn of all cameras: 13 % and 5 degrees on a rendered orbit."""


LENSES = (0.25, 8.0)
"""Shortest and longest focal length that is believed where EXIF names none, in longer sides of the photo: a fisheye's,
that of a lens of 290 mm on full frame. Wrong matches make it grow without end: 10 and 33 where the camera had 0.75."""


@dataclass(frozen=True)
class MappingResult:
    """The largest reconstruction that was found."""

    reconstruction: Any
    """pycolmap.Reconstruction."""
    mapper: str
    """Name of the mapper."""
    others: list[set[str]]
    """Photos of smaller reconstructions that could not be joined to it."""

    @property
    def names(self) -> set[str]:
        """Registered photos."""
        return registered(self.reconstruction)


def registered(reconstruction: Any) -> set[str]:
    """Names of the photos that have a pose."""
    return {reconstruction.image(i).name for i in reconstruction.reg_image_ids()}


def poses(reconstruction: Any) -> tuple[list[str], Float[np.ndarray, "C 4 4"]]:
    """Names in order and cam_from_world of the registered photos."""
    images = sorted(
        (reconstruction.image(i) for i in reconstruction.reg_image_ids()), key=lambda image: natural(image.name)
    )
    viewmats = np.stack([np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in images])
    return [image.name for image in images], viewmats


def find_poses(project: ColmapProject, graph: ViewGraph, report: Report) -> MappingResult | None:
    """The best reconstruction of the mappers that `config.mapper` allows, or None if no three photos fit together."""
    best: MappingResult | None = None
    count = len(graph.features)
    for mapper in mappers_to_try(project.config, count):
        models = run_mapper(project, mapper, graph)
        if not models:
            report(f"{mapper} mapping placed no photo")
            continue
        largest = models[0]
        others = [registered(model) - registered(largest) for model in models[1:]]
        mapped = MappingResult(largest, mapper, [names for names in others if names])
        report(f"{mapper} mapping placed {len(mapped.names)} of {count} photos")
        if best is None or len(mapped.names) > len(best.names):
            best = mapped
        if len(best.names) >= ENOUGH_PLACED * count:
            break
    if best is None:
        return None
    if best.mapper not in ("incremental", HELD):
        best = replace(best, reconstruction=_settled(project, best.reconstruction))
    best = replace(best, reconstruction=adjusted(project, best.reconstruction))
    keep_coherent(best.reconstruction)
    sound = len(best.names) >= SMALLEST_MODEL and has_real_lens(project, best.reconstruction, report)
    return best if sound else None


def has_real_lens(project: ColmapProject, reconstruction: Any, report: Report) -> bool:
    """True where the focal lengths are known, or such as cameras have."""
    if project.config.focal is not None:
        return True
    for camera in reconstruction.cameras.values():
        sides = camera.mean_focal_length() / max(camera.width, camera.height)
        if not camera.has_prior_focal_length and not LENSES[0] <= sides <= LENSES[1]:
            report(f"no camera has the lens that these poses need: a focal length of {sides:.2g} sides of the photo")
            return False
    return True


def mappers_to_try(config: SfmConfig, count: int) -> list[str]:
    """Mappers in order: `auto` is a first choice, and others in case that leaves many photos out."""
    if config.mapper != "auto":
        return [config.mapper]
    if count <= FEW_UP_TO:
        return ["incremental", "hybrid"]
    return ["incremental", HELD, "hybrid"] if count <= INCREMENTAL_UP_TO else ["hybrid", "incremental", HELD]


def run_mapper(project: ColmapProject, mapper: str, graph: ViewGraph) -> list[Any]:
    """Reconstructions, the one with most photos first."""
    project.pycolmap.set_random_seed(project.config.seed)
    target = project.database.with_name(mapper)
    target.mkdir()
    if mapper == HELD:
        models = _held(project, target)
    else:
        models = _incremental(project, target) if mapper == "incremental" else _global(project, target, graph)
    for model in models:
        keep_coherent(model)
    if mapper == "hybrid" and models and len(registered(models[0])) < len(graph.features):
        models = _repaired(project, models, target)
    placed = [model for model in models if model.num_reg_images() >= SMALLEST_MODEL]
    return sorted(placed, key=lambda model: (-model.num_reg_images(), min(registered(model))))


def adjusted(project: ColmapProject, reconstruction: Any) -> Any:
    """The reconstruction after bundle adjustment; the principal point of a camera of many photos may move."""
    if reconstruction.num_reg_images() >= CENTER_FROM * len(reconstruction.cameras):
        moved = bundle_adjusted(project, reconstruction, center=True)
        if all(off_center(camera) <= MAX_OFF_CENTER for camera in moved.cameras.values()):
            return moved
    return bundle_adjusted(project, reconstruction)


def off_center(camera: Any) -> float:
    """Distance of the principal point from the middle of the photo, as a share of its width or height."""
    x, y = camera.principal_point_x / camera.width, camera.principal_point_y / camera.height
    return float(max(abs(x - 0.5), abs(y - 0.5)))


def bundle_adjusted(
    project: ColmapProject, reconstruction: Any, *, center: bool = False, lens: bool = True, poses: bool = True
) -> Any:
    """A copy after bundle adjustment; `center` moves principal points, `lens` the terms of distortion. Without `poses`
    cameras keep their poses and focal lengths."""
    pycolmap = project.pycolmap
    reconstruction = copy.deepcopy(reconstruction)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_rig_from_world = poses
    options.refine_focal_length = poses and project.config.focal is None
    options.refine_principal_point = center
    options.refine_extra_params = lens
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    sides = [max(camera.width, camera.height) for camera in reconstruction.cameras.values()]
    options.ceres.loss_function_scale = LOSS_SCALE * max(1.0, max(sides) / project.config.max_size)
    options.ceres.solver_options.num_threads = 1
    everything = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        everything.add_image(image_id)
    if poses:
        everything.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, everything, reconstruction).solve()
    pycolmap.ObservationManager(reconstruction).filter_all_points3D(4.0, 1.5)
    reconstruction.update_point_3d_errors()
    return reconstruction


def keep_coherent(reconstruction: Any) -> None:
    """Take back the poses of photos that no chain of shared points holds to the largest part of the reconstruction.

    Global mapping places all photos of a connected view graph, also groups whose common points it lost on the way:
    each group then stands anywhere (seen on real photos: 36, 10 and 4 of 50, without one point in common).
    """
    coherent = max(covisible_groups(reconstruction), key=lambda group: (len(group), -min(group)), default=set())
    for image_id in set(reconstruction.reg_image_ids()) - coherent:
        reconstruction.deregister_frame(reconstruction.image(image_id).frame_id)


def covisible_groups(reconstruction: Any) -> list[set[int]]:
    """Registered photos connected by pairs that share at least MIN_SHARED_POINTS points; others are left out.

    Pairs are counted along each point's track, which reaches every photo that sees the point.
    """
    shared: Counter[tuple[int, int]] = Counter()
    for point in reconstruction.points3D.values():
        seen_by = sorted({element.image_id for element in point.track.elements})
        shared.update(itertools.combinations(seen_by, 2))
    group: dict[int, set[int]] = {}
    for (a, b), count in shared.items():
        if count >= MIN_SHARED_POINTS and group.setdefault(a, {a}) is not group.setdefault(b, {b}):
            merged = group[a] | group[b]
            group.update(dict.fromkeys(merged, merged))
    return list({id(members): members for members in group.values()}.values())


def incremental_options(project: ColmapProject) -> Any:
    options = project.pycolmap.IncrementalPipelineOptions()
    options.min_model_size = SMALLEST_MODEL
    options.num_threads = 1
    options.random_seed = project.config.seed
    options.ba_refine_focal_length = project.config.focal is None
    return options


def _incremental(project: ColmapProject, target: Path, start: Path | str = "") -> list[Any]:
    options = incremental_options(project)
    options.multiple_models = not start
    models = project.pycolmap.incremental_mapping(
        project.database, project.photos, target, options=options, input_path=start
    )
    return [model for _, model in sorted(models.items())]


def _held(project: ColmapProject, target: Path) -> list[Any]:
    """The largest reconstruction with the first focal length that places enough photos, adjusted, and what is beside
    it; else the best of all focal lengths."""
    options = incremental_options(project)
    hold_lens(options)
    found: list[list[Any]] = []
    for number, focal in enumerate(focals_to_try(project)):
        folder = target / str(number)
        folder.mkdir()
        guessed = _with_focal(project, folder, focal)
        models = project.pycolmap.incremental_mapping(guessed.database, project.photos, folder, options=options)
        if not models:
            continue
        largest, *others = sorted(models.values(), key=lambda model: (-model.num_reg_images(), min(registered(model))))
        found.append([bundle_adjusted(project, largest), *others])
        if largest.num_reg_images() >= ENOUGH_PLACED * largest.num_images():
            break
    return max(found, key=lambda models: (models[0].num_reg_images(), support(models[0])), default=[])


def _with_focal(project: ColmapProject, folder: Path, focal: float | None) -> ColmapProject:
    """A copy of the database in `folder` in which cameras without a known focal length have this one."""
    guessed = replace(project, database=folder / "database.db")
    shutil.copyfile(project.database, guessed.database)
    if focal is not None:
        with guessed.opened() as db:
            for camera in db.read_all_cameras():
                if not camera.has_prior_focal_length:
                    db.update_camera(guessed_lens(project.pycolmap, camera, focal))
    return guessed


def _global(project: ColmapProject, target: Path, graph: ViewGraph) -> list[Any]:
    """Global mapping of a copy of the database: calibrating the view graph writes to it."""
    pycolmap, config, calibrated = project.pycolmap, project.config, target / "database.db"
    shutil.copyfile(project.database, calibrated)
    if config.focal is None:
        _calibrate_by_seed(replace(project, database=calibrated), target, graph)
        calibration = pycolmap.ViewGraphCalibrationOptions()
        calibration.random_seed = config.seed
        pycolmap.calibrate_view_graph(calibrated, calibration)
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = 1
    options.random_seed = config.seed
    options.min_model_size = SMALLEST_MODEL
    options.mapper.bundle_adjustment.refine_focal_length = config.focal is None
    models = pycolmap.global_mapping(calibrated, project.photos, target, options)
    return [model for _, model in sorted(models.items())]


def _calibrate_by_seed(project: ColmapProject, target: Path, graph: ViewGraph) -> None:
    """Put the lenses into the database that a small incremental reconstruction finds, for photos without EXIF.

    Fundamental matrices alone do not fix the focal length of cameras that look at one point (Sturm 2001), which is how
    objects are photographed: on such photos the guess of 1.2 image widths stayed 70 % too long, and global mapping fell
    apart into groups.
    """
    with project.opened() as db:
        unknown = {camera.camera_id for camera in db.read_all_cameras() if not camera.has_prior_focal_length}
    if not unknown:
        return
    folder = target / "seed"
    folder.mkdir()
    options = incremental_options(project)
    options.multiple_models = False
    options.image_names = seed_photos(graph, SEED_PHOTOS)
    models = project.pycolmap.incremental_mapping(project.database, project.photos, folder, options=options)
    if not models:
        return
    seed = max(models.values(), key=lambda model: model.num_reg_images())
    used = {seed.image(i).camera_id for i in seed.reg_image_ids()}
    with project.opened() as db:
        for camera_id in sorted(unknown & used):
            camera = seed.camera(camera_id)
            camera.has_prior_focal_length = True
            db.update_camera(camera)


def seed_photos(graph: ViewGraph, most: int) -> list[str]:
    """Well connected photos: the pair with depth and most matches, then always the one with most to those chosen."""
    matches = {pair: count for pair, count in graph.inliers.items() if pair not in graph.still}
    if not matches:
        return sorted(graph.features)[:most]
    best, _ = max(matches.items(), key=lambda item: (item[1], item[0]))
    chosen = list(best)
    while len(chosen) < most:
        sums: Counter[str] = Counter()
        for (a, b), count in matches.items():
            if (a in chosen) != (b in chosen):
                sums[b if a in chosen else a] += count
        if not sums:
            break
        chosen.append(max(sums, key=lambda name: (sums[name], name)))
    return chosen


def _repaired(project: ColmapProject, models: list[Any], target: Path) -> list[Any]:
    """The largest global model, grown incrementally by the photos it left out."""
    start, grown = target / "start", target / "grown"
    start.mkdir()
    grown.mkdir()
    largest = max(models, key=lambda model: model.num_reg_images())
    largest.write(start)
    return _incremental(project, grown, start) or models


def _settled(project: ColmapProject, model: Any) -> Any:
    """A global model whose points come from all matches again, and whose poses were adjusted to them.

    Global positioning drops tracks for good while the poses are still rough. 50 photos of a fox: the worst photo was
    turned by 2.4 degrees before, and by 0.24 after.
    """
    options = incremental_options(project)
    for i in range(TRIANGULATIONS):
        model = adjusted(project, model)
        folder = project.database.with_name(f"points{i}")
        folder.mkdir()
        refined = project.config.focal is None
        model = project.pycolmap.triangulate_points(
            model, project.database, project.photos, folder, options=options, refine_intrinsics=refined
        )
    return model
