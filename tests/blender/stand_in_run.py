"""Stands in for `gsopt train` where a window is tested: writes events and previews of given splats, some per second.

python stand_in_run.py RUN SPLATS.ply SECONDS
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from blender_addon.core.ply import read_ply, write_ply  # noqa: E402

STEPS, TICKS = 2000, 40


def main(run: Path, source: Path, seconds: float) -> None:
    (run / "previews").mkdir(parents=True)
    (run / "config.json").write_text("{}")
    splats = read_ply(source)
    with open(run / "events.jsonl", "ab", buffering=0) as file:

        def emit(seq: int, kind: str, **fields: object) -> None:
            file.write(json.dumps({"v": 1, "seq": seq, "kind": kind, "time": time.time(), **fields}).encode() + b"\n")

        emit(0, "started", total=STEPS, step=0, pid=os.getpid(), n=len(splats) // 10)
        for tick in range(1, TICKS + 1):
            time.sleep(seconds / TICKS)
            if (run / "stop").exists():
                emit(3 * tick, "stopped", step=STEPS * tick // TICKS, n=len(splats), seconds=seconds)
                return
            share, step = tick / TICKS, STEPS * tick // TICKS
            left = seconds * (1 - share)
            psnr = 18 + 12 * share**0.4
            emit(3 * tick, "progress", step=step, total=STEPS, psnr=psnr, loss=0.1, n=len(splats), eta_seconds=left)
            if tick % 8 == 0:
                name = f"previews/step_{step:06}.ply"
                write_ply(run / name, splats.at_most(round(len(splats) * share)))
                emit(3 * tick + 1, "preview", step=step, path=name)
        write_ply(run / "splat.ply", splats)
        emit(3 * TICKS + 2, "done", step=STEPS, n=len(splats), seconds=seconds)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]))
