"""The report of a run: photos placed, photos without a pose and the reasons, and advice."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int64

from gsopt.data.sfm.features import ViewGraph
from gsopt.data.sfm.photos import Photo, RejectedFile, natural

BLURRED_SHARE = 0.25
"""Share of the set's median sharpness below which a photo counts as blurred."""
FEW_FEATURES = 200
MIN_COMMON_FEATURES = 30
"""Features in common below which a pair cannot carry a pose."""
PLAIN_CONTRAST = 4.0
"""Gray levels a photo must vary by before lack of detail can be blur."""
WIDE_GAP_DEGREES = 35.0
"""Degrees between neighboring viewing directions above which more photos are advised."""
REASONS = {
    "blurred": "blurred",
    "featureless": "too few features to hold on to",
    "alone": "nothing to compare it with",
    "pair": "two photos that match, and no third to confirm where they stood",
    "unmatched": "no match: nothing in it is found again in another photo",
    "still": "no depth: it differs from its matches by a turn on the spot, or shows one plane",
    "apart": "matches only photos outside the scene",
    "weak": "its matches are too weak or do not agree with the others",
}
REMEDIES = {
    "blurred": "Take the blurred ones again with a steadier hand or more light.",
    "featureless": "Plain or glossy surfaces give no features: put something patterned (newspaper) around the object.",
    "unmatched": "Take photos so that each shares two thirds of its picture with the one before.",
    "still": "Turning on the spot gives no depth: walk around the object instead.",
    "apart": "Photos of different things or places do not belong into one folder: run each group on its own.",
    "weak": "Take more photos between those that match weakly, each sharing two thirds of its picture with the next.",
}

TURNTABLE = (
    "The background stands still in all photos: the object was turned, not the camera, and only what turns was used. "
    "Turn it by 20 degrees between photos, on a patterned cloth that turns with it; masks help: outlines join photos "
    "from all around that share few features."
)


@dataclass(frozen=True)
class UnplacedPhoto:
    """A photo without a pose."""

    name: str
    kind: str
    """A key of REASONS, or "refused"."""
    reason: str
    detail: str = ""
    """Figures of this photo."""


@dataclass
class Diagnosis:
    """Findings about one run."""

    given: int
    """Number of input files."""
    registered: list[str]
    left: list[UnplacedPhoto]
    advice: list[str] = field(default_factory=list)
    mapper: str = ""
    reprojection_error: float | None = None
    """Mean reprojection error, px of the full-size photos."""
    track_length: float | None = None
    """Mean number of photos per point."""
    points: int = 0

    def headline(self) -> str:
        """One line of figures."""
        text = f"{len(self.registered)} of {self.given} photos placed"
        if self.reprojection_error is None or self.track_length is None:
            return text
        return (
            f"{text} ({self.mapper}) | reprojection error {self.reprojection_error:.2f} px | "
            f"{self.points:,} points, each seen in {self.track_length:.1f} photos"
        )

    def lines(self) -> list[str]:
        """The whole report as text: headline, photos by reason, advice."""
        lines = [self.headline()]
        by_reason: dict[str, list[str]] = {}
        for left in self.left:
            by_reason.setdefault(left.reason, []).append(f"{left.name} ({left.detail})" if left.detail else left.name)
        lines += [f"  not placed: {_listed(names)}: {reason}" for reason, names in by_reason.items()]
        return lines + [f"  advice: {text}" for text in self.advice]


def explain(
    photos: Sequence[Photo], refused: Sequence[RejectedFile], graph: ViewGraph | None, registered: set[str]
) -> Diagnosis:
    """Reasons for every file without a pose, and advice that follows from them."""
    left = [UnplacedPhoto(item.name, "refused", item.reason) for item in refused]
    usual = statistics.median(photo.sharpness for photo in photos) if photos else 0.0
    for photo in photos:
        if photo.name not in registered:
            kind, detail = why_unplaced(photo, graph, registered, usual)
            left.append(UnplacedPhoto(photo.name, kind, REASONS[kind], detail))
    names = [photo.name for photo in photos if photo.name in registered]
    diagnosis = Diagnosis(len(photos) + len(refused), names, left)
    diagnosis.advice += [
        f"{photo.name} is placed but blurred: the splats learn its blur. Take it again, or leave it out."
        for photo in photos
        if photo.name in registered and is_blurred(photo, usual)
    ]
    diagnosis.advice += gaps([photo.name for photo in photos], registered)
    kinds = {item.kind for item in left}
    diagnosis.advice += [text for kind, text in REMEDIES.items() if kind in kinds]
    return diagnosis


def why_unplaced(photo: Photo, graph: ViewGraph | None, registered: set[str], usual: float) -> tuple[str, str]:
    """(kind, figures) of a photo that was read but has no pose."""
    if graph is None:
        return "alone", ""
    features, partners = graph.features.get(photo.name, 0), graph.partners(photo.name)
    few = features < FEW_FEATURES
    if is_blurred(photo, usual) and (few or sum(partners.values()) < MIN_COMMON_FEATURES):
        return "blurred", f"sharpness {photo.sharpness:.3f}, usual is {usual:.3f}"
    if few:
        return "featureless", f"{features} features"
    if not partners:
        return "unmatched", f"{features:,} features"
    if all(graph.is_still(photo.name, other) for other in partners):
        return "still", ""
    if registered and not registered & set(partners):
        return "apart", ""
    if len(graph.features) == 2:
        return "pair", ""
    known = {name: count for name, count in partners.items() if name in registered} or partners
    name, count = next(iter(known.items()))
    return "weak", f"best: {count} features in common with {name}"


def is_blurred(photo: Photo, usual: float) -> bool:
    """True for a photo much less sharp than is usual in its set, which is not plain."""
    return photo.sharpness < BLURRED_SHARE * usual and photo.contrast > PLAIN_CONTRAST


def gaps(names: Sequence[str], registered: set[str]) -> list[str]:
    """Runs of photos without a pose between two with one."""
    advice: list[str] = []
    before: str | None = None
    missing = 0
    for name in names:
        if name not in registered:
            missing += 1
            continue
        if missing and before is not None:
            few = "the one" if missing == 1 else f"the {missing}"
            advice.append(f"Add photos between {before} and {name}: {few} in between found no place.")
        before, missing = name, 0
    return advice


def wide_gaps(names: Sequence[str], viewmats: Float[np.ndarray, "C 4 4"]) -> list[str]:
    """Neighbors in name order whose viewing directions differ much more than usual: too little overlap."""
    forwards = viewmats[:, 2, :3]
    turns = np.degrees(np.arccos(np.clip(np.einsum("ci,ci->c", forwards[:-1], forwards[1:]), -1, 1)))
    if len(turns) < 2:
        return []
    limit = max(WIDE_GAP_DEGREES, 3 * float(np.median(turns)))
    return [
        f"Add photos between {names[i]} and {names[i + 1]}: their directions differ by {turns[i]:.0f} degrees."
        for i in np.flatnonzero(turns > limit)[:5]
    ]


def weak_links(names: Sequence[str], shared: Int64[np.ndarray, "C C"]) -> list[str]:
    """Two or more photos whose place among the others hangs on little (`shared`: points of each pair): on one photo
    that shares points with both sides, or on pairs that share few. All of them may be off together, and their points do
    not show it."""
    linked = shared >= MIN_COMMON_FEATURES
    parts = sorted(_parts(linked, np.ones(len(names), dtype=bool)), key=np.sum, reverse=True)
    if len(parts) < 2:
        return _hinge(names, linked)
    return [_apart(names, shared, part) for part in parts[1:] if part.sum() > 1]


def _apart(names: Sequence[str], shared: Int64[np.ndarray, "C C"], part: Bool[np.ndarray, "C"]) -> str:
    """Advice for a part of the photos that no pair joins well to the others."""
    across = np.where(part[:, None] & ~part, shared, -1)
    inside, outside = divmod(int(np.argmax(across)), len(names))
    return (
        f"{_chosen(names, part)} share few points with the other photos, at best {across.max()} ({names[inside]} with "
        f"{names[outside]}): all of them may be off together. Add photos between {names[inside]} and {names[outside]}."
    )


def _hinge(names: Sequence[str], linked: Bool[np.ndarray, "C C"]) -> list[str]:
    """Advice for two or more photos that one photo alone joins to the others."""
    everyone = np.ones(len(names), dtype=bool)
    hanging, at = np.zeros(len(names), dtype=bool), -1
    for i in range(len(names)):
        for part in _parts(linked, everyone & (np.arange(len(names)) != i)):
            if hanging.sum() < part.sum() <= (len(names) - 1) // 2:
                hanging, at = part, i
    if hanging.sum() < 2:  # the first and the last photo of an arc may have one neighbor
        return []
    return [
        f"{_chosen(names, hanging)} share points with the other photos through {names[at]} alone: where its pose is "
        f"off, theirs are. Add photos on both sides of {names[at]}."
    ]


def _parts(linked: Bool[np.ndarray, "C C"], among: Bool[np.ndarray, "C"]) -> Iterator[Bool[np.ndarray, "C"]]:
    """The sets of photos among these that links join, directly or through others."""
    while among.any():
        part = _reached(linked, among)
        among = among & ~part
        yield part


def _chosen(names: Sequence[str], chosen: Bool[np.ndarray, "C"]) -> str:
    return _listed([name for name, named in zip(names, chosen, strict=True) if named])


def _reached(linked: Bool[np.ndarray, "C C"], among: Bool[np.ndarray, "C"]) -> Bool[np.ndarray, "C"]:
    """The photos among these that links join to the first of them."""
    reached = np.zeros_like(among)
    reached[np.argmax(among)] = True
    new = reached
    while new.any():
        new = linked[new].any(0) & among & ~reached
        reached = reached | new
    return reached


def split_groups(graph: ViewGraph, registered: set[str]) -> list[str]:
    """Photos that match each other but nothing in the scene: another object or place in the same folder."""
    others = [group for group in graph.groups() if len(group) > 2 and not group & registered]
    return [
        f"{len(group)} photos match only each other ({_listed(sorted(group, key=natural))}): another object or place? "
        "Run them on their own."
        for group in others
    ]


def _listed(names: Sequence[str], most: int = 6) -> str:
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")
