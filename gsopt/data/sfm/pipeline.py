"""`pose_photos`: from a folder of photos or a video to a posed scene folder, or to a report of the reasons.

photos ─► poses (pose_search.py) ─► placement ─► undistorted scene + sfm.json + sfm.png
Nothing is left behind but the finished folder: all work happens under a hidden name beside it.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float, Int64

from gsopt._optional import require
from gsopt._version import __version__
from gsopt.data.posed_images import PosedImage
from gsopt.data.scene import read_dataset
from gsopt.data.sfm import diagnosis, known_poses
from gsopt.data.sfm.child_process import run_in_child
from gsopt.data.sfm.diagnosis import Diagnosis
from gsopt.data.sfm.mapping import MappingResult, poses
from gsopt.data.sfm.masks import FeatureInput, mask_folder, prepare_masks
from gsopt.data.sfm.overview_image import draw_scene
from gsopt.data.sfm.photos import Photo, RejectedFile, find_photos, read_photos
from gsopt.data.sfm.placement import Similarity, place
from gsopt.data.sfm.pose_search import FoundPoses, PoseSearch
from gsopt.data.sfm.refusal import too_few
from gsopt.data.sfm.settings import SfmConfig
from gsopt.data.sfm.stage_times import StageTimes
from gsopt.data.sfm.turntable_poses import TURNTABLE
from gsopt.data.sfm.video import extract_frames, is_video
from gsopt.data.sfm.write_scene import SCENE, write_scene
from gsopt.data.working_folder import sweep, working_folder
from gsopt.errors import InputError, UsageError
from gsopt.events import Report, to_json, write_atomic

RECORD, OVERVIEW = "sfm.json", "sfm.png"
RECORD_VERSION = 1


@dataclass(frozen=True)
class PosedScene:
    """A scene that was written."""

    path: Path
    diagnosis: Diagnosis
    seconds: dict[str, float]
    """Wall time by stage."""


def pose_photos(source: Path, out: Path, config: SfmConfig, report: Report = lambda line: None) -> PosedScene:
    """Find the poses of the photos in `source` (or of the frames of a video) and write the scene folder `out`.

    Raises InputError with the whole report when fewer than three photos can be placed, UsageError when `out` exists,
    MissingDependency without pycolmap. In each case `out` is as it was.
    """
    source, out = source.expanduser().absolute(), out.expanduser().absolute()
    if not source.exists():
        raise InputError(f"{source} does not exist. Give a folder of photos or a video.")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        sweep(out)  # one that was killed after its last rename is complete
        raise UsageError(f"`--out` must not exist yet, got {out}. Choose another name, or remove it first.")
    with working_folder(out) as work:
        found, seconds = run_in_child(source, work, config, report)
        if out.is_dir():
            out.rmdir()
        os.replace(work / SCENE, out)
    return PosedScene(out, found, seconds)


def write_posed_scene(
    source: Path, work: Path, config: SfmConfig, report: Report
) -> tuple[Diagnosis, dict[str, float]]:
    """Write WORK/scene; returns its diagnosis and the time by stage."""
    pycolmap = require("pycolmap", "sfm", "Finding camera poses")
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL.value)  # the diagnosis reports what matters
    run = _Run(pycolmap, source, work, config, report)
    return run.posed(), run.times.seconds


class _Run:
    """One pass through the stages, with their times."""

    def __init__(self, pycolmap: ModuleType, source: Path, work: Path, config: SfmConfig, report: Report) -> None:
        self.pycolmap, self.source, self.work, self.config, self.report = pycolmap, source, work, config, report
        self.times = StageTimes()

    def posed(self) -> Diagnosis:
        """Writes the scene folder inside the working folder; returns its diagnosis."""
        with self.times.of("photos"):
            photos, refused = self._photos()
            frames = self._prior_frames(photos)
            if len(photos) == 1 or (not photos and refused):
                raise too_few(diagnosis.explain(photos, refused, None, set()), None)
            inputs = prepare_masks(self.config.masks, self.source, photos, self.work)
        where, video = (self.work, self.config, photos, inputs), is_video(self.source)
        search = PoseSearch(self.pycolmap, *where, self.times, self.report, video=video)
        found = search.found(frames)
        if found.mapped is None:
            report = diagnosis.explain(photos, refused, found.graph, set())
            report.advice += found.notes
            raise too_few(report, found.graph)
        report = self._diagnose(photos, refused, found, found.mapped)
        with self.times.of("writing"):
            how = replace(self.config, features=found.features)
            self._write(report, found.mapped, inputs, how, search.matching, self._placed(found.mapped, frames))
        return report

    def _photos(self) -> tuple[list[Photo], list[RejectedFile]]:
        if not is_video(self.source):
            paths = find_photos(self.source)
        else:
            chosen = extract_frames(self.source, self.work / "frames", self.config.frames)
            self.report(f"took {len(chosen.paths)} of {chosen.decoded:,} frames ({chosen.seconds:.1f} s of video)")
            paths = chosen.paths
        photos, refused = read_photos(paths, self.work)
        self.report(f"read {len(photos)} photos" + (f", refused {len(refused)}" if refused else ""))
        return photos, refused

    def _prior_frames(self, photos: list[Photo]) -> list[PosedImage] | None:
        """The known poses of these photos (`--poses prior`)."""
        if self.config.poses != "prior":
            return None
        dataset = read_dataset(self.source)
        frames = [*dataset.frames, *(dataset.held_out or [])]
        known = {frame.path.name: frame for frame in frames}
        unknown = [photo.name for photo in photos if photo.source.name not in known]
        if unknown:
            raise InputError(
                f"`--poses prior` needs a pose for every photo; {len(unknown)} have none: {unknown[0]}, ... "
                "Remove them, or drop the flag to find all poses."
            )
        for i, photo in enumerate(photos):
            frame = known[photo.source.name]
            photos[i] = replace(photo, camera=known_poses.camera_key(frame))
        return [replace(known[photo.source.name], name=photo.name) for photo in photos]

    def _diagnose(
        self, photos: list[Photo], refused: list[RejectedFile], found: FoundPoses, mapped: MappingResult
    ) -> Diagnosis:
        report = diagnosis.explain(photos, refused, found.graph, mapped.names)
        report.mapper = mapped.mapper
        report.reprojection_error = mapped.reconstruction.compute_mean_reprojection_error()
        report.track_length = mapped.reconstruction.compute_mean_track_length()
        report.points = mapped.reconstruction.num_points3D()
        report.advice += found.notes + diagnosis.split_groups(found.graph, mapped.names)
        names, viewmats = poses(mapped.reconstruction)
        report.advice += diagnosis.wide_gaps(names, viewmats)
        if mapped.mapper != TURNTABLE:  # its axis holds what few points do
            report.advice += diagnosis.weak_links(names, shared_points(mapped.reconstruction, names))
        return report

    def _placed(self, mapped: MappingResult, frames: list[PosedImage] | None) -> Similarity:
        """Known poses stay where they are; found ones get axes, origin and scale."""
        if frames is not None:
            return Similarity.identity()
        return place(poses(mapped.reconstruction)[1], points(mapped.reconstruction)[0])

    def _write(
        self,
        report: Diagnosis,
        mapped: MappingResult,
        inputs: FeatureInput,
        how: SfmConfig,
        matching: str,
        similarity: Similarity,
    ) -> None:
        scene = write_scene(self.pycolmap, mapped.reconstruction, self.work, inputs, similarity, self.config.undistort)
        names, viewmats = poses(mapped.reconstruction)
        xyz, rgb = points(mapped.reconstruction)
        write_atomic(scene / OVERVIEW, draw_scene(viewmats, names, xyz, rgb, report.headline()))
        record = {
            "version": RECORD_VERSION,
            "gsopt": __version__,
            "pycolmap": self.pycolmap.__version__,
            "source": str(self.source),
            "fingerprint": fingerprint(self.source),
            "mask_fingerprint": mask_fingerprint(self.config.masks, self.source),
            "settings": asdict(how),
            "matching": matching,
            "masks": inputs.kind,
            "report": report.lines(),
            **asdict(report),
            "placed_from_found": {
                "scale": similarity.scale,
                "rotation": similarity.rotation.tolist(),
                "translation": similarity.translation.tolist(),
            },
            "seconds": {stage: round(seconds, 2) for stage, seconds in self.times.seconds.items()},
        }
        write_atomic(scene / RECORD, to_json(record))


def points(reconstruction: Any) -> tuple[Float[np.ndarray, "P 3"], Any]:
    """Positions and colors (uint8)."""
    found = list(reconstruction.points3D.values())
    xyz = np.array([point.xyz for point in found], dtype=np.float64).reshape(-1, 3)
    return xyz, np.array([point.color for point in found], dtype=np.uint8).reshape(-1, 3)


def shared_points(reconstruction: Any, names: Sequence[str]) -> Int64[np.ndarray, "C C"]:
    """The number of points that each pair of photos has in common; rows in the order of the names."""
    rows = {i: names.index(reconstruction.image(i).name) for i in reconstruction.reg_image_ids()}
    shared = np.zeros((len(names), len(names)), dtype=np.int64)
    for point in reconstruction.points3D.values():
        track = sorted({rows[element.image_id] for element in point.track.elements})
        shared[np.ix_(track, track)] += 1
    return shared


def fingerprint(source: Path) -> list[list[Any]]:
    """Name, size and time of each input file: a scene with another fingerprint is out of date."""
    return _stamps([source] if is_video(source) else find_photos(source))


def mask_fingerprint(choice: str, source: Path) -> list[list[Any]]:
    """The same of the folder that `--masks` selects; empty where it selects none."""
    folder = mask_folder(choice, source)
    return [] if folder is None else _stamps(sorted(path for path in folder.iterdir() if path.is_file()))


def _stamps(paths: list[Path]) -> list[list[Any]]:
    return [[path.name, path.stat().st_size, path.stat().st_mtime_ns] for path in paths]
