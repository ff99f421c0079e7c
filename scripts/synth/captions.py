"""A sentence for an object and one for each of its views, from what is known and what the pixels show."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from synth.cameras import Shot
from synth.mesh_items import Item

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8

SHARE_TO_NAME = 0.25
"""A second color is named when it covers at least this share of the object."""
APART = 100.0
"""A second color is named when it is at least this far from the first: gray says nothing new beside light gray."""
PALETTE: tuple[tuple[str, tuple[int, int, int]], ...] = (
    ("white", (235, 235, 235)),
    ("light gray", (185, 185, 185)),
    ("gray", (125, 125, 125)),
    ("dark gray", (70, 70, 70)),
    ("black", (25, 25, 25)),
    ("red", (190, 40, 40)),
    ("red", (110, 30, 30)),
    ("orange", (225, 130, 45)),
    ("yellow", (225, 205, 60)),
    ("green", (70, 145, 65)),
    ("green", (40, 80, 35)),
    ("green", (105, 130, 80)),
    ("turquoise", (70, 180, 175)),
    ("blue", (55, 95, 185)),
    ("blue", (35, 50, 100)),
    ("blue", (70, 90, 120)),
    ("blue", (130, 165, 210)),
    ("purple", (125, 65, 150)),
    ("pink", (225, 140, 170)),
    ("brown", (110, 70, 40)),
    ("brown", (150, 85, 45)),
    ("beige", (215, 190, 150)),
)
"""Names and colors they stand for; a name may come in several shades."""


def object_caption(item: Item, counts: dict[str, int]) -> str:
    """ "a brown and white chair", "red apples"; the source's own caption where it has one."""
    if item.caption:
        return item.caption
    noun = item.noun.lower() if item.noun.isascii() else item.noun
    phrase = f"{' and '.join(main_colors(counts))} {noun}".strip()
    if re.search("[^su]s$", noun.partition(" with ")[0]):  # several: "apples", not "glass" or "cactus"
        return phrase
    return f"{'an' if phrase[0] in 'aeiou' else 'a'} {phrase}"


def main_colors(counts: dict[str, int]) -> list[str]:
    """The most frequent color, and the next that covers enough and differs clearly."""
    ranked = sorted((name for name in counts if counts[name]), key=lambda name: (-counts[name], name))
    enough = SHARE_TO_NAME * sum(counts.values())
    other = [name for name in ranked[1:] if counts[name] >= enough and distance(ranked[0], name) >= APART]
    return ranked[:1] + other[:1]


def distance(name: str, other: str) -> float:
    """Between the nearest shades of two names, in the space that `count_colors` compares in."""
    near, far = (opponent(np.array([rgb for n, rgb in PALETTE if n == key], float)) for key in (name, other))
    return float(np.linalg.norm(near[:, None] - far, axis=2).min())


def view_caption(caption: str, shot: Shot, front: tuple[float, float] | None) -> str:
    """The object's caption and where it is seen from: the side only where the source says which way is front."""
    eye = shot.eye / np.linalg.norm(shot.eye)
    places = [] if front is None or abs(eye[2]) > 0.9 else [f"{side_of(eye, front)} view"]
    elevation = math.degrees(math.asin(float(np.clip(eye[2], -1.0, 1.0))))
    if abs(elevation) > 20.0:
        high = "directly " if abs(elevation) > 65.0 else ""
        places.append(f"seen from {high}{'above' if elevation > 0 else 'below'}")
    return ", ".join([caption, *places])


def side_of(eye: Float[np.ndarray, "3"], front: tuple[float, float]) -> str:
    """Returns the side of the object that faces a camera at `eye`."""
    turn = math.degrees(math.atan2(eye[1], eye[0]) - math.atan2(front[1], front[0])) % 360.0
    return ("front", "left side", "back", "right side")[int((turn + 45.0) // 90.0) % 4]


def count_colors(rgba: UInt8[np.ndarray, "H W 4"]) -> dict[str, int]:
    """Counts the opaque pixels nearest to each color of the palette (in coded values, hue weighing double)."""
    seen = rgba[rgba[..., 3] > 127][::7, :3].astype(np.float64)
    shades = opponent(np.array([rgb for _, rgb in PALETTE], float))
    nearest = np.linalg.norm(opponent(seen)[:, None] - shades, axis=2).argmin(axis=1)
    return total_colors([{PALETTE[i][0]: int(n)} for i, n in zip(*np.unique(nearest, return_counts=True), strict=True)])


def opponent(rgb: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Lightness, red against green, blue against yellow."""
    red, green, blue = rgb.T
    return np.stack([(red + green + blue) / 3.0, 2.0 * (red - green), 2.0 * (blue - 0.5 * (red + green))], axis=1)


def total_colors(counts: Sequence[dict[str, int]]) -> dict[str, int]:
    names = dict.fromkeys(name for name, _ in PALETTE)
    return {name: sum(c.get(name, 0) for c in counts) for name in names if any(name in c for c in counts)}
