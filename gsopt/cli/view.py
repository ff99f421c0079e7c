"""`gsopt view`: look at a run or a splat file in the browser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from gsopt import check


@dataclass(frozen=True)
class Flags:
    """Show a run or a splat file in the browser. A run that is still going is followed preview by preview."""

    target: tyro.conf.Positional[Path]
    """A run directory, or a splat file (.ply and the other formats `gsopt export` writes)."""
    port: int = 8080
    """Port to serve on; the next free one is taken when it is in use. 0 = any free port."""
    host: str = "127.0.0.1"
    """Address to serve on. 0.0.0.0 lets other machines look too."""
    once: tyro.conf.FlagCreatePairsOff[bool] = False
    """Stop after showing what is there now instead of serving until Ctrl+C."""


def main(argv: Sequence[str]) -> int:
    """Serve until interrupted; 0 when `--once` ended it."""
    flags = tyro.cli(Flags, prog="gsopt view", args=argv)
    check.within("--port", flags.port, 0, 65535, "Ports above 1023 need no privileges.")

    from gsopt.results import viewer

    viewer.serve(flags.target, flags.host, flags.port, flags.once)
    return 0
