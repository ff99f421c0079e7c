"""Repair of masks that disagree with the others: the hull of the others says where, the colors say what.

Parts of an agreeing mask that this hull does not touch are no part of the object, and are cut off.

Within the projection of the hull a pixel belongs to the object where its color is more frequent in the agreeing
silhouettes than in this photo's surroundings; pixels without an edge between them go the same way. If the outcome
disagrees again, the whole projection is taken: it can carve nothing away.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from gsopt.config.train import DataConfig
from gsopt.data.scene import PixelStore, Scene, View, load_scene, read_ahead
from gsopt.geometry.focus import find_focus
from gsopt.init.mask_agreement import MIN_COVERED, MIN_MASKS, Agreement, has_edge, mask_agreement
from gsopt.init.mask_parts import cleaned, touched
from gsopt.init.random_walker import walked
from gsopt.init.thumbnails import Thumbnail, small_photos

MAX_CHECKED = 32
"""Most masks that are checked: the time grows with their square, and among more one is lost without harm."""
LEVELS = 16
"""Bins of a color histogram along each channel."""
SOLID = 0.4
"""Probability from which on a pixel belongs to the object: below a half, since the surroundings of the hull are certain
and pull, and nothing is certain of the object."""
THICKNESS = 1.0
"""Weight of the logarithm of the hull's thickness (over its mean) in the evidence: where the hull is thin, it is
rather what few silhouettes left beside the object."""
LEAST_EVIDENCE = 0.1
"""Divergence (Kullback & Leibler 1951) of the object's colors from its surroundings' below which they tell nothing."""
LEAST_SHARE = 0.3
"""Share of the hull's projection that a mask found by colors covers at least; less of it is a failure of the colors."""
KINDS = {
    "missing": "there is none",
    "empty": "it is empty",
    "too large": "it shows more than the object",
    "lost": "it lacks a part of the object",
    "stray": "it shows pieces beside the object",
}
REPAIRS = {
    "freed": "freed of the pieces that the hull of the others does not touch",
    "colors": "found again by color inside the hull of the others",
    "cleared": "cleared, since the hull of the others lies outside the photo, which does not show the object",
    "hull": "replaced by the projected hull of the others, since colors do not tell the object from its surroundings",
}


@dataclass(frozen=True)
class RepairedMask:
    """A mask that disagreed with the others, or showed pieces beside the object."""

    name: str
    """Name of its view."""
    kind: str
    """A key of KINDS."""
    covered: float
    """Share of the silhouette that the hull of the other masks covers."""
    repair: str
    """A key of REPAIRS."""

    @property
    def about(self) -> str:
        """One line for logs and reports."""
        share = (
            "" if self.kind in ("missing", "empty") else f" (the hull of the others covers {self.covered:.0%} of it)"
        )
        said = f"The mask of {self.name} disagrees with the others: {KINDS[self.kind]}{share}."
        return f"{said} It was {REPAIRS[self.repair]}."

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return {"name": self.name, "kind": self.kind, "covered": round(self.covered, 4), "repair": self.repair}


@dataclass(frozen=True)
class RepairedAlphas:
    """A store with other masks for some images."""

    store: PixelStore
    unmasked: PixelStore
    """The same images without mask files: what a mask hides is lost where images are downscaled."""
    alphas: Mapping[int, UInt8[Tensor, "H W"]]
    """By row."""

    def get(self, index: int) -> UInt8[Tensor, "H W C"]:
        if index not in self.alphas:
            return self.store.get(index)
        return torch.cat([self.unmasked.get(index)[..., :3], self.alphas[index][..., None]], dim=2)


Repairs = dict[int, tuple[UInt8[Tensor, "H W"], RepairedMask | None]]
"""New alphas by row, and what was found about each that is worth a word."""


def load_with_agreeing_masks(config: DataConfig) -> tuple[Scene, list[RepairedMask]]:
    """The scene with wrong masks of input views repaired, and which those are; as `load_scene` reads it where all masks
    agree, or where nothing tells the wrong ones."""
    scene = load_scene(config)
    agreement = agreement_of(scene)
    if agreement is None:
        return scene, []
    found = _freed(scene.train, agreement)
    if not found and not agreement.disagreeing:
        return scene, []
    unmasked = load_scene(replace(config, masks="none")).train
    found |= _repaired(scene.train, unmasked, agreement)
    alphas = {scene.train[row].index: alpha for row, (alpha, _) in found.items()}
    store = RepairedAlphas(scene.train[0].store, unmasked[0].store, alphas)
    views = tuple(replace(view, store=store) for view in scene.train)
    findings = [finding for _, finding in found.values() if finding is not None]
    return replace(scene, train=views, has_alpha=True), findings


def agreement_of(scene: Scene) -> Agreement | None:
    """The agreement of the input views' masks; Returns None where too few have one, or there are too many to check."""
    if len(scene.train) > MAX_CHECKED:
        return None
    read_ahead(scene.train)
    masked = [view.pixels().shape[2] == 4 for view in scene.train]
    if sum(masked) < MIN_MASKS or 2 * sum(masked) <= len(masked):
        return None
    photos = small_photos(scene.train, MAX_CHECKED)
    return mask_agreement(photos, find_focus([photo.camera for photo in photos], scene.extent))


def _freed(views: tuple[View, ...], agreement: Agreement) -> Repairs:
    """Alphas of agreeing views without the parts that the hull of the others does not touch, which networks leave
    beside an object: too small to disagree, but a photo's colors would hang in the air there. Parts that are faint
    everywhere need no word. Returns them by row."""
    found: Repairs = {}
    for row in agreement.agreeing:
        planes = agreement.photos[row].planes
        shown = planes[3] > 0
        stray = shown & ~touched(shown, agreement.projection(row))
        if not bool(stray.any()):
            continue
        alpha = views[row].pixels()[..., 3].clone()
        alpha[_enlarged(stray, *alpha.shape) > 0] = 0
        finding = RepairedMask(views[row].name, "stray", agreement.covered[row], "freed")
        found[row] = alpha, finding if int(planes[3][stray].max()) > 127 else None
    return found


def _repaired(views: tuple[View, ...], unmasked: tuple[View, ...], agreement: Agreement) -> Repairs:
    """Alphas of the disagreeing views, and what was found about each, by row."""
    inside = _histogram(torch.cat([_object_colors(agreement.photos[row]) for row in agreement.agreeing]))
    found: Repairs = {}
    for row in agreement.disagreeing:
        kind = _kind(agreement, row) if views[row].pixels().shape[2] == 4 else "missing"
        hull, camera = agreement.projection(row), views[row].camera
        if not bool(hull.any()):
            finding = RepairedMask(views[row].name, kind, agreement.covered[row], "cleared")
            found[row] = torch.zeros(camera.height, camera.width, dtype=torch.uint8), finding
            continue
        colors = small_photos([unmasked[row]], 1)[0].planes[:3]
        by_color = _colored_part(colors, hull, agreement.thickness(row), inside, agreement.photos[row], kind)
        fits = _agrees(agreement, row, by_color) and float(by_color.sum()) > LEAST_SHARE * float(hull.sum())
        alpha = _enlarged(by_color if fits else cleaned(hull), camera.height, camera.width)
        finding = RepairedMask(views[row].name, kind, agreement.covered[row], "colors" if fits else "hull")
        found[row] = alpha, finding
    return found


def _kind(agreement: Agreement, row: int) -> str:
    photo = agreement.photos[row]
    if not has_edge(photo) and not bool((photo.planes[3] > 127).any()):
        return "empty"
    return "too large" if agreement.covered[row] < MIN_COVERED else "lost"


def _colored_part(
    colors: UInt8[Tensor, "3 H W"],
    hull: Bool[Tensor, "H W"],
    thickness: Float[Tensor, "H W"],
    inside: Float[Tensor, "B"],
    photo: Thumbnail,
    kind: str,
) -> Bool[Tensor, "H W"]:
    """The largest part of the hull's projection that has the object's colors; with the mask's word where it can be
    taken. Empty where colors tell nothing."""
    evidence = (inside / _histogram(colors[:, ~hull].T)).log()
    if float(inside @ evidence) < LEAST_EVIDENCE:
        return torch.zeros_like(hull)
    by_pixel = evidence[_bins(colors.flatten(1).T)].view(hull.shape)
    likely = torch.sigmoid(by_pixel + THICKNESS * thickness.clamp_min(1e-3).log()) * hull
    solid = photo.planes[3] > 127
    if kind == "too large":
        likely *= solid
    if kind == "lost":
        likely[solid & hull] = 1
    return cleaned((walked(colors, likely) > SOLID) & hull)


def _object_colors(photo: Thumbnail) -> UInt8[Tensor, "N 3"]:
    """Colors of the pixels that are all object."""
    return photo.planes[:3, photo.planes[3] == 255].T


def _histogram(colors: UInt8[Tensor, "N 3"]) -> Float[Tensor, "B"]:
    """Frequencies of colors, spread over neighboring bins and nowhere 0."""
    counts = torch.bincount(_bins(colors), minlength=LEVELS**3).float().view(1, 1, LEVELS, LEVELS, LEVELS)
    spread = torch.nn.functional.avg_pool3d(counts, 3, 1, 1).flatten() + 0.5 / LEVELS
    return spread / spread.sum()


def _bins(colors: UInt8[Tensor, "N 3"]) -> Tensor:
    red, green, blue = (colors.long() * LEVELS // 256).unbind(1)
    return (red * LEVELS + green) * LEVELS + blue


def _agrees(agreement: Agreement, row: int, mask: Bool[Tensor, "H W"]) -> bool:
    """True when the other silhouettes stay covered with this mask in place of the photo's own."""
    planes = agreement.photos[row].planes.clone()
    planes[3] = mask.to(torch.uint8) * 255
    return agreement.admits_mask(replace(agreement.photos[row], planes=planes))


def _enlarged(mask: Bool[Tensor, "H W"], height: int, width: int) -> UInt8[Tensor, "h w"]:
    """A mask of a thumbnail as the alpha of its view."""
    planes = torch.nn.functional.interpolate(mask[None, None].float(), (height, width), mode="bilinear")[0, 0]
    return (planes * 255).round().to(torch.uint8)
