"""`gsopt finetune`: train a prior of one's own on scenes of one's own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, arg

from gsopt.cli.sfm import say
from gsopt.finetune.training_config import Course

ON_VIEWS = "--on-views"
"""Asks for another training, with flags of its own."""


def finetune(
    data: Annotated[Positional[tuple[Path, ...]], arg(metavar="DATA...")],
    out: Annotated[Path, arg(aliases=["-o"], metavar="PRIOR")],
    course: OmitArgPrefixes[Course],
    val: tuple[str, ...] = (),
    fits: int = 3,
    size: int = 128,
    base: Annotated[str | None, arg(metavar="PRIOR")] = None,
    threads: int = 0,
    on_views: FlagCreatePairsOff[bool] = False,
) -> int:
    """Train a view-conditioned prior on posed scenes with many views each; use it with gsopt train --prior PRIOR.

    Every scene is reconstructed several times from a few of its views, as a run would; the prior learns to turn renders
    of these reconstructions into the views that were left out. Interrupted, the same command goes on.

    Args:
        data: Posed scenes, or folders of them (scripts/synth_views.py makes such folders from meshes).
        out: Folder of the prior: unet/, README.md (what it was made from, what was measured), samples/, train.jsonl.
        course: How long and how fast.
        val: Names of scenes that are held out and measured on; every tenth when none is named.
        fits: Reconstructions of each scene.
        size: Side of the renders, px.
        base: Prior to start from: `embedded` or a folder; random weights when not given.
        threads: CPU threads of the reconstructions and of the network; 0 = all.
        on_views: Train Stable Diffusion on images instead, by LoRA: gsopt finetune --on-views --help tells its flags.
    """
    assert not on_views, "main() hands it on"
    from gsopt.finetune.run import Lessons, find_scenes, start

    train, held = find_scenes(data, val)
    lessons = Lessons(train, held, fits, size, course.seed)
    measured = start(lessons, course, out, base, threads, say)
    if measured:
        best = max(measured["repair"].values())
        print(f"held out: renders {measured['render']:.2f} dB, repaired {best:.2f} dB")
    print(f"{out}: use it with gsopt train DATA --prior {out}; what it is stands in {out / 'README.md'}")
    return 0


def main(argv: Sequence[str]) -> int:
    """Parse the arguments after `gsopt finetune` and run it; the exit code."""
    others = [argument for argument in argv if argument.replace("_", "-") != ON_VIEWS]
    if len(others) < len(argv):
        from gsopt.cli.finetune_on_views import main as on_views

        return on_views(others)
    return tyro.cli(finetune, args=list(argv), prog="gsopt finetune")
