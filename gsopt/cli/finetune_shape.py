"""`gsopt finetune --shape`: trains a 3D diffusion prior on a shape library."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import OmitArgPrefixes, Positional, arg

from gsopt import check
from gsopt.cli.console import report
from gsopt.finetune.shapes.training_config import ShapeTrainingConfig


@dataclass(frozen=True)
class Flags:
    """Train a 3D diffusion prior on a shape library; use it with gsopt train --prior shape:DIR.

    It learns to complete shapes that one to three cameras see, drawn as the training goes. It is meant for a GPU (some
    25 minutes); a CPU needs days. Interrupted or paused, the same command goes on.
    """

    library: Annotated[Positional[str], arg(metavar="LIBRARY")]
    """A library that `gsopt finetune --library` made, or `bundled` for the one that ships."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="DIR")]
    """Folder of the prior: weights, gsopt_shape_prior.json, README.md (what was measured), train.jsonl."""
    config: OmitArgPrefixes[ShapeTrainingConfig] = field(default_factory=ShapeTrainingConfig)
    """Length of the training and size of the network."""
    val: tuple[str, ...] = ()
    """Ids of entries that are held out and measured on; one in twelve, by the hash of its id, when none is named."""
    device: str = "auto"
    """auto (a GPU that torch finds, else the CPU), cpu or cuda."""
    pause_after: float | None = None
    """Minutes after which the training saves and stops; the same command goes on."""
    threads: int = 0
    """CPU threads; 0 = all."""


def main(argv: Sequence[str]) -> int:
    """Train, print what was measured on held-out shapes and return 0."""
    began = time.monotonic()
    flags = tyro.cli(Flags, prog="gsopt finetune --shape", args=list(argv))
    if flags.pause_after is not None:
        check.within("--pause-after", flags.pause_after, 0.0, 1e6, "Drop the flag to train to the end.")

    import torch

    from gsopt.finetune.shapes.run import ShapeTraining, find_device, finetune_shapes
    from gsopt.shape_library.library_file import BUNDLED, ShapeLibrary

    if flags.threads:
        torch.set_num_threads(flags.threads)
    library = ShapeLibrary(BUNDLED if flags.library == "bundled" else Path(flags.library))
    training = ShapeTraining(library, flags.val, flags.config, find_device(flags.device))
    until = math.inf if flags.pause_after is None else began + 60 * flags.pause_after
    measured = finetune_shapes(training, flags.out, report, until)
    if measured is None:
        return 0
    for way, figures in measured.get("mean", {}).items():
        print(f"{way}: IoU {figures['iou']:.3f}, wrong pixels of unseen silhouettes {figures['silhouette_error']:.2%}")
    print(
        f"{flags.out}: use it with gsopt train DATA --prior shape:{flags.out}; described in {flags.out / 'README.md'}"
    )
    return 0
