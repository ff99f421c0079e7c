"""Measures the time that the kernels' own skips save on the state of a real run, and checks that they change no bit.

    python experiments/kernel_skips.py RUN [RUN ...]

RUN is a run directory with a checkpoint, e.g. runs/skips/lego-all. Its input views are drawn forward and backward with
each skip switched off in turn. Needs kernels with the switches `skip_tiles` and `skip_terminated` on their Workspace.
Results go to experiments/results/kernel_skips.json, and into the block `kernel-skips` of docs/performance.md.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import torch

from gsopt.benchmark import schema
from gsopt.benchmark.machine import machine
from gsopt.benchmark.markdown import replace_block, table
from gsopt.benchmark.stopwatch import read, spread
from gsopt.config.train import OptimizerConfig, TrainConfig
from gsopt.data.scene import Scene, load_scene
from gsopt.events import to_json, write_atomic
from gsopt.gaussians import PARAMETERS, Gaussians
from gsopt.raster.backend import Gradients, RasterSettings
from gsopt.raster.cpu_backend import CpuBackend
from gsopt.training.checkpoint import load_newest
from gsopt.training.optimizer import OptimizedGaussians, adam_step
from gsopt.training.targets import Target, Targets

ROOT = Path(__file__).resolve().parents[1]
RESULT = ROOT / "experiments" / "results" / "kernel_skips.json"
PAGE = ROOT / "docs" / "performance.md"
COMMAND = "python experiments/kernel_skips.py RUN [RUN ...]"
SWITCHES = {
    "none": (),
    "exact ellipse-tile tests": ("skip_tiles",),
    "early termination": ("skip_terminated",),
    "both": ("skip_tiles", "skip_terminated"),
}
"""Switches that are off."""
VIEWS = 16
ROW = {"run": str, "step": int, "gaussians": int, "without": str, "ms": schema.SPREAD, "same_bits": bool}
DOCUMENT = {"command": str, "machine": schema.MACHINE, "rows": [ROW]}


class State:
    """The state of a run at its newest checkpoint."""

    def __init__(self, run: Path) -> None:
        self.config = TrainConfig.read(run / "config.json")
        checkpoint = load_newest(run / "checkpoints", print)
        if checkpoint is None:
            raise SystemExit(f"{run} has no checkpoint.")
        parts = {name: checkpoint.tensors[f"gaussians.{name}"] for name in PARAMETERS}
        self.model = OptimizedGaussians.start(Gaussians(**parts))
        self.step = int(checkpoint.meta["step"])
        scene: Scene = load_scene(self.config.data)
        targets = Targets(scene.train, torch.ones(3), 1 << 32)
        stride = max(1, len(scene.train) // VIEWS)
        self.targets = [targets.get(i, 1, torch.ones(3)) for i in range(0, len(scene.train), stride)]
        self.backend = CpuBackend(1)
        self.gradients: Gradients | None = None

    def switch(self, off: tuple[str, ...]) -> None:
        for name in ("skip_tiles", "skip_terminated"):
            if not hasattr(self.backend._workspace, name):
                raise SystemExit(f"These kernels have no switch {name}.")
            setattr(self.backend._workspace, name, name not in off)

    def iterate(self, target: Target) -> tuple[torch.Tensor, Gradients]:
        """A full iteration with learning rates of 0, which leaves the state as it is."""
        settings = RasterSettings()
        frame = self.backend.forward(self.model.gaussians, target.camera, settings, torch.ones(3))
        loss = self.backend.photometric(frame.colors, target.colors, 0.2)
        self.gradients = self.backend.backward(frame, loss.v_colors, bands=False, into=self.gradients)
        rates = dict.fromkeys(PARAMETERS, 0.0)
        adam_step(self.model, self.gradients, rates, OptimizerConfig(), self.backend, target.camera, settings)
        return frame.colors, self.gradients


def rows(run: Path) -> list[dict[str, Any]]:
    """One row per switch; every view is measured with all switches, so that all of them meet the same load."""
    state = State(run)
    seconds: dict[str, list[float]] = {name: [] for name in SWITCHES}
    same = dict.fromkeys(SWITCHES, True)
    for target in [state.targets[0], *state.targets]:  # the first one twice, to warm up
        truth: list[torch.Tensor] = []
        for name, off in SWITCHES.items():
            state.switch(off)
            seconds[name].append(read(lambda target=target: state.iterate(target)).cpu)
            colors, gradients = state.iterate(target)
            got = [colors, *(getattr(gradients, key).clone() for key in PARAMETERS if key != "shN")]
            truth = truth or got
            same[name] &= all(torch.equal(a, b) for a, b in zip(got, truth, strict=True))
    about = {"run": run.name, "step": state.step, "gaussians": len(state.model)}
    return [{**about, "without": name, "ms": spread(seconds[name][1:]), "same_bits": same[name]} for name in SWITCHES]


def page(found: list[dict[str, Any]]) -> str:
    cells = []
    for row in found:
        base = next(r["ms"]["median"] for r in found if r["run"] == row["run"] and r["without"] == "none")
        more = 100 * (row["ms"]["median"] / base - 1)
        ms = f"{row['ms']['median']:.1f} (IQR {row['ms']['iqr']:.1f})"
        bits = "same bits" if row["same_bits"] else "other bits"
        cells.append([row["run"], f"{row['gaussians']:,}", row["without"], ms, f"{more:+.0f} %", bits])
    head = ["state of", "Gaussians", "switched off", "iteration, CPU ms", "", "image and gradients"]
    return f"`{COMMAND}`, one thread:\n\n{table(head, cells)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    options = parser.parse_args()
    torch.set_num_threads(1)
    with torch.no_grad():
        found = [row for run in options.runs for row in rows(run)]
    document = {"command": COMMAND, "machine": machine(), "rows": found}
    schema.require(document, DOCUMENT)
    write_atomic(RESULT, to_json(document))
    text = page(found)
    replace_block(PAGE, "kernel-skips", text)
    sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
