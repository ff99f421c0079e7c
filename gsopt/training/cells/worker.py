"""A worker that trains: `python -m gsopt.training.cells.worker` answers {"config": ..., "run": RUN} with figures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsopt.config.train import TrainConfig
from gsopt.farm.serve import serve
from gsopt.training.loop import train


def handle(request: Mapping[str, Any]) -> dict[str, Any]:
    """Trains, from the newest checkpoint where there is one, unless the file `stop` of the whole asks not to."""
    if Path(request["stop"]).exists():
        return {"stopped": True}
    result = train(TrainConfig.from_dict(request["config"]), Path(request["run"]), resume=True)
    return {
        "stopped": result.stopped,
        "steps": result.steps,
        "n": len(result.gaussians),
        "seconds": round(result.train_seconds, 3),
        "cpu_seconds": round(result.cpu_seconds, 3),
        "peak_memory_mb": result.peak_memory_mb,
        "backend": result.backend,
    }


if __name__ == "__main__":
    serve(handle)
