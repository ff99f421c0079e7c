"""The renders a prior learns from, scene by scene; what is not there yet is made."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Int
from torch import Tensor

from gsopt.data.files import is_regular
from gsopt.errors import InputError
from gsopt.events import Report
from gsopt.finetune.reconstruction_pairs import Pairs, make_pairs
from gsopt.raster.backend import Backend

MADE_AS = 2
"""Of what a pair shows; counted up when that changes, so that older files are made again."""


@dataclass(frozen=True)
class Library:
    """M pairs and where they come from."""

    pairs: Pairs
    scenes: tuple[Path, ...]
    """Each has pairs."""
    scene: Int[Tensor, "M"]
    """Of each pair, an index into `scenes`."""


def _made_by(scene: Path, size: int, seed: int) -> str:
    """What a file of pairs depends on beside the fit's number: scenes of different folders may share a name."""
    return hashlib.sha256(f"{scene.resolve()} {size} {seed} {MADE_AS}".encode()).hexdigest()[:8]


def collect(
    scenes: Sequence[Path], fits: int, size: int, seed: int, folder: Path, backend: Backend, report: Report
) -> Library:
    """All pairs of the scenes; what is not in `folder` is made. A scene that cannot be fitted is named and left out."""
    folder.mkdir(parents=True, exist_ok=True)
    parts: list[Pairs] = []
    owners: list[int] = []
    fitted: list[Path] = []
    for scene in scenes:
        for fit in range(fits):
            path = folder / f"{scene.name}_{fit}_{_made_by(scene, size, seed)}.safetensors"
            if not is_regular(path):
                try:
                    make_pairs(scene, size, fit, seed, backend).save(path)
                except InputError as error:
                    report(f"{scene.name} is left out: {error}")
                    break
                report(f"fitted {scene.name}, {fit + 1} of {fits}")
            parts.append(Pairs.load(path))
            fitted += [scene] if scene not in fitted else []
            owners += [len(fitted) - 1] * len(parts[-1])
    if not parts:
        raise InputError(f"None of the {len(scenes)} scenes could be reconstructed. See the messages above.")
    return Library(Pairs.cat(parts), tuple(fitted), torch.tensor(owners))
