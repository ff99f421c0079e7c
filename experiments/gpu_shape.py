"""Trains and judges a 3D shape prior where a GPU is at hand, within a budget of minutes.

    python experiments/gpu_shape.py --minutes 25 --out FOLDER                  # on a GPU
    python experiments/gpu_shape.py --minutes 25 --out FOLDER --pause-after 9  # repeat until it says that it is done
    python experiments/gpu_shape.py --tiny --minutes 1 --out FOLDER            # the same on this CPU, much smaller

The first steps are timed, and as many planned as fit the budget beside the evaluation. FOLDER gets plan.json,
prior/ (for gsopt train --prior shape:FOLDER/prior) with train.jsonl, and result.json: IoU and silhouette errors on
held-out shapes beside the inflated silhouette and the library. It needs torch, numpy, pillow, plyfile, safetensors,
jaxtyping and the extension of a wheel in gsopt/raster, but no compiler.
"""

from __future__ import annotations

import argparse
import math
import platform
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import torch  # noqa: E402

from gsopt.data.files import read_json  # noqa: E402
from gsopt.events import to_json, write_atomic  # noqa: E402
from gsopt.finetune.shapes.run import ShapeTraining, find_device, finetune_shapes  # noqa: E402
from gsopt.finetune.shapes.training_config import ShapeTrainingConfig  # noqa: E402
from gsopt.shape_library.library_file import BUNDLED, ShapeLibrary  # noqa: E402

TRAINING_SHARE = 0.82
"""Share of the budget for training; the rest is for timing, loading and the evaluation."""
WARM_STEPS, TIMED_STEPS = 6, 24
TINY = {"batch": 2, "side": 16, "widths": (16, 24), "blocks": 1, "image_side": 16, "save_every": 5}
TINY_STEPS = 12
TINY_ENTRIES = ("VW-new-beetle", "apples")
"""Held out of a tiny training."""


def planned(training: ShapeTraining, minutes: float, began: float) -> ShapeTrainingConfig:
    """The settings with as many steps as the budget allows: steps are timed one view, two and three alike."""
    trainer, shapes, _ = training.trainer()
    for _ in range(WARM_STEPS):
        trainer.advance(shapes)
    started = time.monotonic()
    for _ in range(TIMED_STEPS):
        trainer.advance(shapes)  # it returns a number, so the device is done
    seconds = (time.monotonic() - started) / TIMED_STEPS
    left = TRAINING_SHARE * 60 * minutes - (time.monotonic() - began)
    return replace(training.config, steps=max(1, math.floor(left / seconds)))


def settings(plan: Path, training: ShapeTraining, minutes: float, began: float) -> ShapeTrainingConfig:
    """The plan of an earlier call, or a new one."""
    if plan.exists():
        kept = read_json(plan)["config"]
        return ShapeTrainingConfig(**{**kept, "widths": tuple(kept["widths"])})
    config = planned(training, minutes, began)
    write_atomic(plan, to_json({"minutes": minutes, "config": asdict(config)}))
    return config


def about(device: torch.device) -> dict[str, Any]:
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or "CPU"
    return {"device": name, "torch": torch.__version__, "python": platform.python_version()}


def main() -> None:
    began = time.monotonic()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=25.0)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--library", type=Path, default=BUNDLED)
    parser.add_argument("--pause-after", type=float, default=math.inf)
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--tiny", action="store_true")
    flags = parser.parse_args()
    flags.out.mkdir(parents=True, exist_ok=True)
    device = find_device("cpu" if flags.tiny else flags.device)
    if device.type == "cuda":
        torch.backends.cudnn.benchmark = True
    start = ShapeTrainingConfig(**TINY) if flags.tiny else ShapeTrainingConfig(batch=flags.batch)
    training = ShapeTraining(ShapeLibrary(flags.library), TINY_ENTRIES if flags.tiny else (), start, device)
    config = settings(flags.out / "plan.json", training, flags.minutes, began)
    if flags.tiny:
        config = replace(config, steps=min(config.steps, TINY_STEPS))
    print(f"{config.steps} steps of {config.batch} samples on {about(device)['device']}", flush=True)
    training = replace(training, config=config)
    until = began + 60 * flags.pause_after
    measured = finetune_shapes(training, flags.out / "prior", lambda line: print(line, flush=True), until)
    if measured is None:
        return
    peak = torch.cuda.max_memory_allocated(device) if device.type == "cuda" else None
    document = {"command": "python experiments/gpu_shape.py", "machine": about(device), "minutes": flags.minutes}
    document |= {"config": asdict(config), "peak_bytes": peak, "measured": measured}
    write_atomic(flags.out / "result.json", to_json(document))
    print("done:", {way: {k: round(v, 4) for k, v in one.items()} for way, one in measured["mean"].items()})


if __name__ == "__main__":
    main()
