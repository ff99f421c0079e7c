"""Caches the training renders of a prior, scene by scene."""

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

PAIRS_VERSION = 2
"""Version of the pairs' content; raised with a change of it, so that older files are recomputed."""


@dataclass(frozen=True)
class PairCache:
    """M pairs and their scenes."""

    pairs: Pairs
    scenes: tuple[Path, ...]
    """The scenes that have pairs."""
    scene: Int[Tensor, "M"]
    """Index into `scenes` of each pair."""


def _cache_key(scene: Path, size: int, seed: int) -> str:
    """Returns a hash of everything but the reconstruction's number: scenes of different folders may share a name."""
    return hashlib.sha256(f"{scene.resolve()} {size} {seed} {PAIRS_VERSION}".encode()).hexdigest()[:8]


def collect_pairs(
    scenes: Sequence[Path], reconstructions: int, size: int, seed: int, folder: Path, backend: Backend, report: Report
) -> PairCache:
    """Returns the pairs of all scenes and computes those missing in `folder`. A scene that fails is reported and
    skipped."""
    folder.mkdir(parents=True, exist_ok=True)
    parts: list[Pairs] = []
    owners: list[int] = []
    reconstructed: list[Path] = []
    for scene in scenes:
        for index in range(reconstructions):
            path = folder / f"{scene.name}_{index}_{_cache_key(scene, size, seed)}.safetensors"
            if not is_regular(path):
                try:
                    make_pairs(scene, size, index, seed, backend).save(path)
                except InputError as error:
                    report(f"{scene.name} is skipped: {error}")
                    break
                report(f"reconstructed {scene.name}, {index + 1} of {reconstructions}")
            parts.append(Pairs.load(path))
            reconstructed += [scene] if scene not in reconstructed else []
            owners += [len(reconstructed) - 1] * len(parts[-1])
    if not parts:
        raise InputError(f"None of the {len(scenes)} scenes could be reconstructed. See the messages above.")
    return PairCache(Pairs.cat(parts), tuple(reconstructed), torch.tensor(owners))
