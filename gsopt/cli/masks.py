"""`gsopt masks`: a soft mask of the object for every photo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, arg

from gsopt.cli.console import report


@dataclass(frozen=True)
class Flags:
    """Cut the object out of photos: write a mask for each, checked against the others where poses are known."""

    photos: Annotated[Positional[Path], arg(metavar="PHOTOS")]
    """Folder of photos, or a dataset with poses."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="DIR")] = None
    """Folder to write; PHOTOS/masks when not given, where gsopt finds it by itself."""
    model: Annotated[Path | None, arg(metavar="FILE")] = None
    """ONNX file of U2-Net or IS-Net; by default $GSOPT_MASK_MODEL, else one that rembg has fetched."""


def main(argv: Sequence[str]) -> int:
    """Write the masks, print the report and return 0."""
    flags = tyro.cli(Flags, prog="gsopt masks", args=list(argv))

    from gsopt.config.train import DataConfig
    from gsopt.data.mask_network import MaskNetwork, find_model
    from gsopt.init.cut_out import cut_out

    network = MaskNetwork.open(find_model(None if flags.model is None else str(flags.model)))
    for line in cut_out(DataConfig(path=str(flags.photos)), flags.out, network, report).lines():
        print(line)
    return 0
