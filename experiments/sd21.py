"""Counts the GPU memory of a guided step with Stable Diffusion 2.1 and writes the table of docs/howto/guidance.md.

    python experiments/sd21.py

Needs no weights and computes nothing: tests/sds/real_memory.py counts the tensors that the networks of real size would
allocate. The workspace of convolutions and the memory of CUDA itself are not counted.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "sds")]

from real_memory import account  # noqa: E402

from gsopt.benchmark.machine import machine  # noqa: E402
from gsopt.benchmark.markdown import replace_block, table  # noqa: E402
from gsopt.events import to_json, write_atomic  # noqa: E402

RESULT = ROOT / "experiments" / "results" / "sd21.json"
PAGE = ROOT / "docs" / "howto" / "guidance.md"
COMMAND = "python experiments/sd21.py"
SIDES = (512, 768)
ARMS: dict[str, dict[str, bool]] = {
    "as it is, `--guidance.sequential`": {"sequential": True},
    "both halves in one call (default)": {},
    "nothing recomputed": {"sequential": True, "checkpointed": False},
    "`--guidance.tiny-vae`": {"sequential": True, "tiny": True},
}
COLUMNS = {
    "unet": "U-Net",
    "vae": "autoencoder",
    "kept": "kept by its encoder",
    "call": "U-Net's call",
    "backward": "encoder backwards",
    "total": "peak",
    "picture": "picture for the report",
}


def measure(side: int, options: dict[str, bool]) -> dict[str, int]:
    """Bytes, float16."""
    found = account(side, **options)
    weights = sum(found.weights.values())
    return {
        "unet": found.weights["unet"],
        "vae": found.weights["vae"],
        "kept": found.phases["encode"].kept,
        "call": found.phases["denoise"].peak,
        "backward": found.phases["backward"].peak,
        "total": found.total,
        "picture": weights + found.phases["decode"].peak,
    }


def shown(rows: list[dict[str, Any]]) -> str:
    """Gigabytes."""
    body = [[str(row["side"]), row["arm"], *(f"{row[column] / 1e9:.2f}" for column in COLUMNS)] for row in rows]
    return table(["px", "", *COLUMNS.values()], body)


def main() -> None:
    rows: list[dict[str, Any]] = []
    for side in SIDES:
        for arm, options in ARMS.items():
            rows.append({"side": side, "arm": arm, **measure(side, options)})
            print(rows[-1], flush=True)
    write_atomic(RESULT, to_json({"command": COMMAND, "machine": machine(), "rows": rows}))
    replace_block(PAGE, "sd21", shown(rows))


if __name__ == "__main__":
    main()
