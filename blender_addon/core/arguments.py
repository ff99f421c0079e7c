"""Turns the panel's settings into argument lists: no shell, no quoting, every value its own word."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Training:
    """Options of `gsopt train`."""

    preset: str = ""
    """draft, default or high; empty: steps and size as given here."""
    iterations: int = 4000
    downscale: int = 0
    """Width and height are divided by this; 0: photos have at most 1600 px on a side."""
    max_gaussians: int = 0
    """0: as many as the images call for."""
    views: int = 0
    """Learn from this many, well spread; 0: all."""
    hold_out: bool = False
    strategy: str = "adc"
    background: str = "auto"
    seed: int = 0
    threads: int = 0
    backend: str = "auto"


STEPS = {"draft": 2000, "default": 4000, "high": 15_000}
"""About as many as gsopt's presets take: decides how often a preview comes."""


@dataclass(frozen=True)
class Guidance:
    """Options that guide a run where the photos leave the scene open."""

    prior: str = "auto"
    """auto (gsopt decides), off, embedded, sd21, or a folder or hub id."""
    weight: float = 0.2
    prompts: Path | None = None
    references: tuple[Path, ...] = ()
    device: str = "auto"
    front_view: int = -1
    """Input view that shows the front; -1: not said."""


def train(python: Path, data: Path, run: Path, training: Training, guidance: Guidance) -> list[str]:
    """`gsopt train` with a live preview about twenty times."""
    words = [str(python), "-m", "gsopt", "train", str(data), "-m", str(run)]
    words += ["--preset", training.preset] if training.preset else own(training)
    steps = STEPS.get(training.preset, training.iterations)
    words += ["--preview-every", str(max(25, min(500, steps // 20))), "--seed", str(training.seed)]
    words += ["--threads", str(training.threads), "--backend", training.backend]
    words += ["--max-gaussians", str(training.max_gaussians)] if training.max_gaussians else []
    words += ["--views", str(training.views)] if training.views else []
    return words + guide(guidance)


def own(training: Training) -> list[str]:
    """Options that the panel offers in place of a preset."""
    words = ["--iterations", str(training.iterations), "--strategy", training.strategy]
    words += ["--background", training.background]
    words += ["--resolution", str(training.downscale)] if training.downscale else []
    return words + (["--eval"] if training.hold_out else [])


def guide(guidance: Guidance) -> list[str]:
    if guidance.prior == "off":
        return ["--lambda-sds", "0"]
    words = [] if guidance.prior == "auto" else ["--prior", guidance.prior, "--lambda-sds", f"{guidance.weight:g}"]
    words += ["--prompts", str(guidance.prompts)] if guidance.prompts else []
    for path in guidance.references:
        words += ["--ref-image", str(path)]
    words += ["--guidance.front-view", str(guidance.front_view)] if guidance.front_view >= 0 else []
    return words + (["--guidance.device", guidance.device] if guidance.device != "auto" else [])


def resume(python: Path, run: Path, threads: int = 0) -> list[str]:
    """Go on from the newest checkpoint, with the settings the run was started with."""
    return [str(python), "-m", "gsopt", "train", "--resume", "-m", str(run), "--threads", str(threads)]


def poses(python: Path, photos: Path, out: Path, seed: int = 0, threads: int = 0) -> list[str]:
    """`gsopt sfm` for a folder of photos or a video."""
    words = [str(python), "-m", "gsopt", "sfm", str(photos), "-o", str(out)]
    return [*words, "--seed", str(seed), "--threads", str(threads)]


def masks(python: Path, data: Path) -> list[str]:
    """`gsopt masks` for the photos of a dataset: writes its folder masks/."""
    return [str(python), "-m", "gsopt", "masks", str(data)]


@dataclass(frozen=True)
class Writing:
    """Options of `gsopt prompts`."""

    notes: str
    domain: str = "generic"
    count: int = 8
    llm: str = "none"
    """Address of an OpenAI-compatible server; none: templates."""
    model: str = ""
    images: tuple[Path, ...] = ()


def prompts(python: Path, writing: Writing, out: Path) -> list[str]:
    """`gsopt prompts`: proposals from an expert's notes."""
    words = [str(python), "-m", "gsopt", "prompts", f"--notes={writing.notes}", "--domain", writing.domain]
    words += ["-n", str(writing.count), "--llm", writing.llm or "none", "-o", str(out)]
    words += [f"--model={writing.model}"] if writing.model else []
    return words + (["--images", *map(str, writing.images)] if writing.images else [])


def install(folder: Path, package: str) -> list[str]:
    """`core/install_gsopt.py`, run by Blender's own Python."""
    return [sys.executable, str(Path(__file__).with_name("install_gsopt.py")), str(folder), package]


def page(python: Path, run: Path, out: Path) -> list[str]:
    """`gsopt export`: one page for any browser."""
    return [str(python), "-m", "gsopt", "export", str(run), "-o", str(out), "--force"]


def clean(python: Path, run: Path) -> list[str]:
    """`gsopt clean`: the run's splats without those that no input view needs."""
    return [str(python), "-m", "gsopt", "clean", str(run)]


def mesh(python: Path, run: Path, out: Path) -> list[str]:
    """`gsopt mesh`: a closed mesh of the run."""
    return [str(python), "-m", "gsopt", "mesh", str(run), "-o", str(out), "--force"]


def measure(python: Path, run: Path, start: Sequence[float], end: Sequence[float], length: float) -> list[str]:
    """`gsopt measure`: the scale of the run from a known length, meters."""
    points = [f"--{name}={','.join(f'{x:.9g}' for x in point)}" for name, point in (("from", start), ("to", end))]
    return [str(python), "-m", "gsopt", "measure", str(run), *points, "--unit-length", f"{length:.9g}m"]


def doctor(python: Path) -> list[str]:
    return [str(python), "-m", "gsopt", "doctor", "--json"]


@dataclass(frozen=True)
class Rendering:
    """Options of scripts/synth_views.py."""

    views: int = 50
    test_views: int = 10
    resolution: int = 256
    layout: str = "hemisphere"
    samples: int = 32
    lighting: str = "studio"
    seed: int = 0
    threads: int = 0
    masks: bool = False

    @property
    def total(self) -> int:
        """Pictures."""
        return self.views + self.test_views


def render(blender: str, python: Path | str, script: Path, mesh: Path, out: Path, rendering: Rendering) -> list[str]:
    """synth_views.py inside Blender in the background, or with a Python that has the module bpy when there is none."""
    inside = [blender, "--background", "--factory-startup", "--python", str(script), "--"]
    words = [*(inside if blender else [str(python), str(script)]), str(mesh), "-o", str(out)]
    words += ["--views", str(rendering.views), "--test-views", str(rendering.test_views)]
    words += ["--resolution", str(rendering.resolution), "--layout", rendering.layout]
    words += ["--samples", str(rendering.samples), "--lighting", rendering.lighting]
    words += ["--seed", str(rendering.seed), "--threads", str(rendering.threads), "--points", "10000"]
    return words + (["--masks"] if rendering.masks else [])
