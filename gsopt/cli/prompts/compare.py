"""`gsopt prompts compare`: sets of prompts tried on a scene by short runs, side by side on one page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from tyro.conf import Positional, arg

from gsopt import check
from gsopt.cli.console import report
from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import DataConfig, TrainConfig
from gsopt.errors import UsageError

if TYPE_CHECKING:
    from gsopt.training.guided.compare_prompts import Arm, Comparison

MAX_FILES = 12


@dataclass(frozen=True)
class Flags:
    """Try sets of prompts on a scene: short runs without one input view, judged by that view; one page shows all."""

    data: Annotated[Positional[Path], arg(metavar="DATA")]
    """Dataset folder, as for gsopt train."""
    files: Annotated[Positional[tuple[Path, ...]], arg(metavar="FILE ...")]
    """One or more prompts.json. Runs without guidance and without prompts are added."""
    prior: Annotated[str, arg(metavar="PRIOR")] = "auto"
    """embedded, sd21, a diffusers folder, or a hub id; it must take words."""
    lambda_sds: float = 0.2
    """Weight of the guidance."""
    steps: int = 240
    """Steps of each short run."""
    leave_out: int = 2
    """Input views left out, one at a time."""
    views: Annotated[int | None, arg(metavar="N")] = None
    """Learn from this many input views, well spread."""
    front_view: Annotated[int | None, arg(metavar="I")] = None
    """Input view (0-based) that shows the front."""
    clip: str = ""
    """CLIP model for alignment scores, where the prior has none."""
    resolution: Annotated[int | None, arg(aliases=["-r"])] = None
    """Divide width and height by this; by default the longer side of a larger photo becomes 1600 px."""
    seed: int = 0
    """Same seed, same data, same bits."""
    threads: int = 0
    """0 = one per core."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="FILE.html")] = Path("comparison.html")
    """The page; the figures go to FILE.json beside it."""
    force: tyro.conf.FlagCreatePairsOff[bool] = False
    """Replace the page if it exists."""


def main(argv: Sequence[str]) -> int:
    """Compare and write the page; the exit code."""
    flags = tyro.cli(Flags, prog="gsopt prompts compare", args=list(argv))
    check.writable(flags.out, flags.force)
    config = read_config(flags)
    arms = read_arms(flags)

    from gsopt.data.scene import load_scene
    from gsopt.raster.api import make_backend
    from gsopt.raster.threads import one_torch_thread
    from gsopt.sds.load_prior import open_prior
    from gsopt.sds.select_prior import select_prior
    from gsopt.training.guided.compare_prompts import compare_prompts

    choice = select_prior(config.guidance)
    if choice.name is None:  # a weight was given: a prior that is not there is an error
        raise UsageError(
            f"`--prior` {flags.prior!r:.200} guides no step, so no prompts can be compared: {choice.reason}."
        )
    prior = open_prior(choice.name, config.guidance)
    report(f"prior {prior.name}")
    with one_torch_thread():
        scene = load_scene(config.data)
        compared = compare_prompts(config, scene, make_backend("auto", flags.threads), prior, arms, report)
    write_page(flags, compared, prior.name)
    report(f"{flags.out}: open it in a browser")
    return 0


def read_config(flags: Flags) -> TrainConfig:
    """The settings every short run is made from."""
    if not flags.lambda_sds > 0:
        raise UsageError(f"`--lambda-sds` must be above 0, got {flags.lambda_sds}. Without guidance nothing differs.")
    path = str(flags.data.expanduser().absolute())
    return TrainConfig(
        data=DataConfig(path=path, views=flags.views, downscale=flags.resolution),
        guidance=GuidanceConfig(
            lambda_sds=flags.lambda_sds,
            prior=flags.prior,
            clip=flags.clip,
            front_view=flags.front_view,
            guard_views=flags.leave_out,
            guard_steps=flags.steps,
        ),
        seed=flags.seed,
        threads=flags.threads,
    )


def read_arms(flags: Flags) -> list[Arm]:
    """No guidance, guidance without prompts, then every file."""
    from gsopt.sds.prompts import accepted_images, read_prompts
    from gsopt.training.guided.compare_prompts import Arm

    if not 1 <= len(flags.files) <= MAX_FILES:
        raise UsageError(
            f"`FILE` must be given 1 to {MAX_FILES} times, got {len(flags.files)}. Name prompts.json files."
        )
    arms = [Arm("no guidance", (), weight=0.0), Arm("no prompts", (), weight=flags.lambda_sds)]
    names = distinct_names(flags.files)
    for name, file in zip(names, flags.files, strict=True):
        images = tuple(str(image) for image in accepted_images(file))
        arms.append(Arm(name, read_prompts(file), images, flags.lambda_sds))
    return arms


def distinct_names(files: Sequence[Path]) -> list[str]:
    """The files' names, with their folders where two are the same."""
    names = [file.stem for file in files]
    return [str(file) if names.count(name) > 1 else name for file, name in zip(files, names, strict=True)]


def write_page(flags: Flags, compared: Comparison, prior: str) -> None:
    """The page and its figures."""
    from gsopt.events import encoded, to_json, write_atomic
    from gsopt.results.report.prompt_comparison import Column, comparison_page

    columns = [
        Column(
            outcome.arm.name,
            tuple((f"{p.source}, {p.view}, {p.polarity}", p.text) for p in outcome.arm.prompts),
            outcome.psnrs,
            outcome.alignment,
            tuple(to_image(picture) for picture in outcome.pictures),
        )
        for outcome in compared.outcomes
    ]
    facts = f"prior {prior} · {flags.steps} steps · lambda_sds {flags.lambda_sds:g} · seed {flags.seed}"
    truths = [to_image(truth) for truth in compared.truths]
    title = flags.data.expanduser().absolute().name or "scene"
    document = {
        "prior": prior,
        "views": list(compared.views),
        "arms": [{"name": c.name, "mean": c.mean, "psnr": list(c.psnrs), "alignment": c.alignment} for c in columns],
    }
    write_atomic(flags.out, encoded(comparison_page(title, facts, compared.views, truths, columns)))
    write_atomic(flags.out.with_suffix(".json"), to_json(document))


def to_image(picture: Any) -> Any:
    """A tensor [H, W, 3] in 0..1 as an image."""
    from PIL import Image

    from gsopt.results.finished_run import to_bytes

    return Image.fromarray(to_bytes(picture).numpy())
