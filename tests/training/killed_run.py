"""Trains until a chosen moment and kills itself there, as `kill -9` would: no handler, no flush, no goodbye.

python killed_run.py CONFIG.json RUN MOMENT
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import tiny_scenes  # noqa: F401
import torch

from gsopt.config.train import TrainConfig
from gsopt.training import loop, trainer

torch.set_num_threads(1)


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def before(owner: Any, name: str, call: int) -> None:
    """Die when `owner.name` is called for the `call`-th time."""
    original: Callable[..., Any] = getattr(owner, name)
    calls = 0

    def counted(*args: Any, **kwargs: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == call:
            die()
        return original(*args, **kwargs)

    setattr(owner, name, counted)


MOMENTS = {
    "while config.json is completed": lambda: before(os, "replace", 2),
    "in the middle of a step": lambda: before(trainer.Trainer, "_update", 17),
    "between writing a checkpoint and renaming it": lambda: before(os, "replace", 5),
    "between the last checkpoint and the splats": lambda: before(loop, "save_ply", 3),
}

if __name__ == "__main__":
    config, run, moment = sys.argv[1:]
    MOMENTS[moment]()
    loop.train(TrainConfig.from_dict(json.loads(Path(config).read_text())), Path(run), resume=True)
