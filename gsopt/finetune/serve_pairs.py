"""A worker of a farm: `python -m gsopt.finetune.serve_pairs` writes the training pairs of one reconstruction."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsopt.farm.serve import serve
from gsopt.finetune.reconstruction_pairs import make_pairs
from gsopt.raster.api import make_backend

PAIRS = "pairs.safetensors"


def handle(request: Mapping[str, Any]) -> int:
    """Reconstructs `scene` for the time `index` and writes PAIRS to the new folder `out`; the number of pairs."""
    made = make_pairs(
        Path(request["scene"]), request["size"], request["index"], request["seed"], make_backend("cpu", 1)
    )
    out = Path(request["out"])
    out.mkdir(parents=True)
    made.save(out / PAIRS)
    return len(made)


if __name__ == "__main__":
    serve(handle)
