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
from gsopt.farm.job import Farm, Job
from gsopt.farm.worker import serving
from gsopt.finetune.reconstruction_pairs import Pairs
from gsopt.finetune.serve_pairs import PAIRS
from gsopt.raster.cpu_backend import ISA_VARIABLE, workspace

PAIRS_VERSION = 3
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
    scenes: Sequence[Path], reconstructions: int, size: int, seed: int, folder: Path, farm: Farm, report: Report
) -> PairCache:
    """Returns the pairs of all scenes; a farm computes those missing in `folder`. A reconstruction that fails is
    reported and left out."""
    folder.mkdir(parents=True, exist_ok=True)
    jobs = [_job(scene, index, size, seed, folder) for scene in scenes for index in range(reconstructions)]
    wanted = [job for job in jobs if not is_regular(_pairs_of(job))]
    for number, outcome in enumerate(farm.run(wanted) if wanted else (), 1):
        name, failed = outcome.job.name, outcome.ending != "done"
        report(f"{name} is left out: {outcome.error}" if failed else f"reconstructed {name}, {number} of {len(wanted)}")
    done = [job for job in jobs if is_regular(_pairs_of(job))]
    if not done:
        raise InputError(f"None of the {len(scenes)} scenes could be reconstructed. See the messages above.")
    parts = [Pairs.load(_pairs_of(job)) for job in done]
    reconstructed = list(dict.fromkeys(job.inputs[0] for job in done))
    owners = [
        reconstructed.index(job.inputs[0]) for job, part in zip(done, parts, strict=True) for _ in range(len(part))
    ]
    return PairCache(Pairs.cat(parts), tuple(reconstructed), torch.tensor(owners))


def _job(scene: Path, index: int, size: int, seed: int, folder: Path) -> Job:
    """One reconstruction, on one core: any number of threads gives the same bits."""
    out = (folder / f"{scene.name}_{index}_{_cache_key(scene, size, seed)}").absolute()
    return Job(
        out.name,
        serving("gsopt.finetune.serve_pairs"),
        {"scene": str(scene), "index": index, "size": size, "seed": seed, "out": str(out)},
        folder=out,
        inputs=(scene,),
        environment={ISA_VARIABLE: workspace(1).isa},
    )


def _pairs_of(job: Job) -> Path:
    assert job.folder is not None
    return job.folder / PAIRS
