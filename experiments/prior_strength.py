"""Measures the gain by guidance over the quality of the prior: an emulated prior predicts a share of the truth.

    python experiments/prior_strength.py SCENES... [--arm ...] [--views 4] [--seeds 1] [--json FILE.json] [--draw]

SCENES are posed scenes with held-out views, or folders of them. Every scene is reconstructed as `truth`, from all its
input views; as `off`, the unguided run from few; and by guided runs from the same few. The emulated prior predicts for
a camera

    (1)  y = r0 + s (y* - r0)

with r0 rendered from `off` and y* from `truth`. This reduces the error of `off` by -20 log10(1 - s) dB in every view,
consistently, which is the best that a prior of that strength can do. Runs with a record are not repeated.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from guidance import scenes
from torch import Tensor

from gsopt.benchmark.machine import machine
from gsopt.benchmark.markdown import replace_block, table
from gsopt.cli import main as gsopt
from gsopt.events import to_json, write_atomic
from gsopt.geometry.cameras import Cameras
from gsopt.results.finished_run import FinishedRun, open_run
from gsopt.sds.noise import Latents
from gsopt.sds.priors.protocol import Condition, Encoder, Images
from gsopt.sds.priors.view_conditioned import cosine_schedule

PAGE = Path(__file__).parents[1] / "docs" / "howto" / "guidance.md"
RESULT = Path(__file__).parent / "results" / "prior_strength.json"
SIZE = 128
"""Side of the prior's images, px, as of the embedded one."""
WHITE = torch.ones(3)
EXACT = math.inf
UNGUARDED = ["--guidance.guard-views", "0"]
EVERYWHERE = [*UNGUARDED, "--guidance.min-uncertainty", "0", "--guidance.certain-weight", "1"]
"""Equal weight for every view and every pixel of the object."""
UNCERTAIN = [*UNGUARDED, "--guidance.min-uncertainty", "0.05", "--guidance.certain-weight", "0"]
"""Weight by uncertainty: pixels that no input view determines."""
ARMS: dict[str, tuple[float | None, list[str]]] = {
    "off": (None, ["--lambda-sds", "0"]),
    "exact, only what is uncertain, lambda 0.05": (EXACT, [*UNCERTAIN, "--lambda-sds", "0.05"]),
    "exact, only what is uncertain": (EXACT, UNCERTAIN),
    "exact, what is certain a third": (EXACT, [*EVERYWHERE, "--guidance.certain-weight", "0.35"]),
    "exact, lambda 1": (EXACT, [*EVERYWHERE, "--lambda-sds", "1"]),
    "exact": (EXACT, EVERYWHERE),
    **{f"{repair:g} dB": (repair, EVERYWHERE) for repair in (4.0, 2.0, 1.0, 0.5)},
}
"""Gain of the prior in dB (None: no prior), and flags."""
METRICS = ("psnr", "ssim", "lpips_alex")


class Emulated:
    """Equation (1); see `gsopt.sds.priors.protocol.Prior`."""

    name = "emulated"
    size = SIZE
    x0_limit: float | None = 1.0
    class_embedding_width: int | None = None
    aligned = True

    def __init__(self, truth: FinishedRun, off: FinishedRun, repair: float) -> None:
        """`repair`: reduction of the error of `off`, dB."""
        self.schedule = cosine_schedule()
        self._truth, self._off, self._share = truth, off, 1 - 10 ** (-repair / 20)

    def encode(self, images: Images) -> Latents:
        return 2 * images - 1

    def decode(self, x0: Latents) -> Images:
        return (x0 / 2 + 0.5).clamp(0, 1)

    def denoise(self, x_t: Latents, t: Tensor, conditions: Sequence[Condition]) -> Latents:
        rows = []
        for condition in conditions:
            assert condition.camera is not None
            r0, y = (drawn(run, condition.camera) for run in (self._off, self._truth))
            rows.append(2 * (r0 + self._share * (y - r0)) - 1)
        return torch.stack(rows)

    def encoder(self) -> Encoder | None:
        return None


def drawn(run: FinishedRun, camera: Cameras) -> Tensor:
    """The render on white, 0..1."""
    return run.backend.forward(run.gaussians, camera, run.settings, WHITE).colors.permute(2, 0, 1).clamp(0, 1)


def train(scene: Path, folder: Path, flags: Sequence[str]) -> dict[str, Any]:
    """The metrics of a new run."""
    shutil.rmtree(folder, ignore_errors=True)
    quiet = ["--threads", "1", "--checkpoint-every", "0", "--preview-every", "0"]
    if code := gsopt(["train", str(scene), "-m", str(folder), *quiet, *flags]):
        raise SystemExit(f"{folder.name}: gsopt train ended with {code}")
    summary = folder / "guidance" / "summary.json"
    return {
        **{name: json.loads((folder / "metrics.json").read_text())["mean"][name] for name in METRICS},
        "guided_steps": json.loads(summary.read_text())["guided"] if summary.exists() else 0,
    }


def make(scene: Path, views: int, seed: int, arms: Sequence[str], runs: Path, known: dict[str, Any]) -> None:
    """Adds to `known` the runs of one scene that it lacks, by arm."""
    folder = runs / f"{scene.name}_{views}_{seed}"
    few = ["--views", str(views), "--seed", str(seed)]
    if "truth" not in known or not (folder / "truth" / "splat.ply").exists():
        known["truth"] = train(
            scene, folder / "truth", ["--lambda-sds", "0", "--seed", str(seed), "--iterations", "5000"]
        )
    if "off" not in known or not (folder / "off" / "splat.ply").exists():
        known["off"] = train(scene, folder / "off", [*few, *ARMS["off"][1]])
    truth, off = (open_run(folder / name, threads=1) for name in ("truth", "off"))
    for arm in arms:
        repair, flags = ARMS[arm]
        if arm in known or repair is None:
            continue
        with patch("gsopt.training.guided.start.open_prior", return_value=Emulated(truth, off, repair)):
            known[arm] = train(scene, folder / "guided", [*few, "--prior", "embedded", *flags])


def shown(records: dict[str, Any]) -> str:
    """Every arm against `off`: means over the scenes where it has a record."""
    rows = []
    for arm in ARMS:
        pairs = [(record[arm], record["off"]) for record in records.values() if arm in record]
        if not pairs or arm == "off":
            continue
        change = [[guided[name] - off[name] for guided, off in pairs] for name in METRICS]
        mean = [sum(values) / len(values) for values in change]
        steps = sum(guided["guided_steps"] for guided, _ in pairs) / len(pairs)
        worst = f"{min(change[0]):+.2f} to {max(change[0]):+.2f}"
        rows.append(
            [arm, f"{len(pairs)}", f"{steps:.0f}", f"{mean[0]:+.2f}", worst, f"{mean[1]:+.4f}", f"{mean[2]:+.4f}"]
        )
    return table(["prior", "runs", "guided steps", "PSNR, dB", "one by one", "SSIM", "LPIPS (Alex)"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("--arm", nargs="*", choices=list(ARMS), default=list(ARMS))
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--runs", type=Path, default=Path("runs/prior_strength"))
    parser.add_argument("--json", type=Path, default=RESULT)
    parser.add_argument("--draw", action="store_true", help="write the table into docs/howto/guidance.md")
    options = parser.parse_args()
    document = json.loads(options.json.read_text()) if options.json.exists() else {"machine": machine(), "records": {}}
    records = document["records"]
    for seed in range(options.seeds):
        for scene in scenes(options.scenes):
            known = records.setdefault(f"{scene.name}, {options.views} views, seed {seed}", {})
            make(scene, options.views, seed, options.arm, options.runs, known)
            write_atomic(options.json, to_json(document))
    print(shown(records))
    if options.draw:
        replace_block(PAGE, "prior_strength", shown(records))


if __name__ == "__main__":
    main()
