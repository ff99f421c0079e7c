"""`gsopt finetune`: trains a prior on one's own scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, arg

from gsopt.cli.console import report
from gsopt.finetune.training_config import PriorTrainingConfig

ON_VIEWS, LIBRARY, SHAPE = "--on-views", "--library", "--shape"
"""Flags that select the training on images, the making of a shape library and the training on one, which have flags of
their own."""


@dataclass(frozen=True)
class Flags:
    """Train a view-conditioned prior on posed scenes with many views each; use it with gsopt train --prior PRIOR.

    Every scene is reconstructed several times from a few of its views, as a run would; the prior learns to turn renders
    of these reconstructions into the views that were left out. Interrupted, the same command goes on.
    """

    data: Annotated[Positional[tuple[Path, ...]], arg(metavar="DATA...")]
    """Posed scenes, or folders of them (scripts/synth_views.py makes such folders from meshes)."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="PRIOR")]
    """Folder of the prior: unet/, README.md (what it was made from, what was measured), samples/, train.jsonl."""
    config: OmitArgPrefixes[PriorTrainingConfig] = field(default_factory=PriorTrainingConfig)
    """Length and speed of the training."""
    val: tuple[str, ...] = ()
    """Names of scenes that are held out and measured on; every tenth when none is named."""
    fits: int = 3
    """Reconstructions of each scene."""
    size: int = 128
    """Side of the renders, px."""
    base: Annotated[str | None, arg(metavar="PRIOR")] = None
    """Prior to start from: `embedded` or a folder; random weights when not given."""
    threads: int = 0
    """CPU threads of the network, and reconstructions at a time on this machine; 0 = one per core."""
    farm: Annotated[str, arg(metavar="local|ray")] = "local"
    """The machines that reconstruct: local, local:CORES, ray or ray://HOST:PORT."""
    on_views: FlagCreatePairsOff[bool] = False
    """Train Stable Diffusion on images instead, by LoRA: gsopt finetune --on-views --help lists its flags."""
    library: FlagCreatePairsOff[bool] = False
    """Make a shape library of meshes instead: gsopt finetune --library --help lists its flags."""
    shape: FlagCreatePairsOff[bool] = False
    """Train a 3D prior on a shape library instead: gsopt finetune --shape --help lists its flags."""


def main(argv: Sequence[str]) -> int:
    """Train, print the gain on held-out scenes and return 0; `--on-views`, `--library` and `--shape` do
    other work."""
    if LIBRARY in argv:
        from gsopt.cli.finetune_library import main as make_library

        return make_library([argument for argument in argv if argument != LIBRARY])
    if SHAPE in argv:
        from gsopt.cli.finetune_shape import main as on_shapes

        return on_shapes([argument for argument in argv if argument != SHAPE])
    others = [argument for argument in argv if argument.replace("_", "-") != ON_VIEWS]
    if len(others) < len(argv):
        from gsopt.cli.finetune_on_views import main as on_views

        return on_views(others)
    flags = tyro.cli(Flags, prog="gsopt finetune", args=list(argv))

    from gsopt.finetune.run import start
    from gsopt.finetune.scenes import TrainingScenes, find_scenes

    train, held = find_scenes(flags.data, flags.val)
    scenes = TrainingScenes(train, held, flags.fits, flags.size, flags.config.seed)
    evaluation = start(scenes, flags.config, flags.out, flags.base, flags.threads, flags.farm, report)
    if evaluation:
        best = max(evaluation["repair"].values())
        print(f"held out: renders {evaluation['render']:.2f} dB, repaired {best:.2f} dB")
    print(f"{flags.out}: use it with gsopt train DATA --prior {flags.out}; described in {flags.out / 'README.md'}")
    return 0
