"""One call from photos to a report: poses, training, evaluation."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

from gsopt.config.guidance import GuidanceConfig, library_of, shape_prior_of
from gsopt.config.train import DataConfig, TrainConfig
from gsopt.data.sfm.reuse import needs_poses, posed_scene
from gsopt.data.sfm.settings import SfmConfig
from gsopt.errors import UsageError
from gsopt.events import Report, to_json, write_atomic
from gsopt.gaussians import Gaussians
from gsopt.init.cut_out import require_mask_model, with_made_masks
from gsopt.results.evaluation import OnView, evaluate, networks, read_metrics
from gsopt.training.interrupt import Stopped, StopRequest
from gsopt.training.loop import PROGRESS_SECONDS, TrainResult, train
from gsopt.training.run_directory import Listener, RunDirectory, first_difference, opened, refuse_another_run


@dataclass(frozen=True)
class Reconstruction:
    """The result of `reconstruct`."""

    run: Path
    """Folder with splat.ply, metrics.json and report.html."""
    gaussians: Gaussians
    metrics: Mapping[str, Any] | None
    """The content of metrics.json, or None after a request to stop early."""
    report: Path | None
    """Path of report.html, or None likewise."""


def reconstruct(
    data: Path | str | DataConfig | None,
    run: Path | str,
    *,
    config: TrainConfig | None = None,
    resume: bool = False,
    vgg: bool = False,
    farm: str = "local",
    on_progress: Listener | None = None,
    log: Report = lambda line: None,
    **settings: Any,
) -> Reconstruction:
    """Find poses if `data` has none, train, evaluate on the held-out views and write the report: `gsopt train`.

    `data`: a dataset, a folder of photos, a video, a DataConfig, or None for that of `config` or, with `resume`, the
    settings in `run`. `settings`: fields of TrainConfig, a section as a dict: `preset="draft"`,
    `guidance={"prompt": ["a red chair"]}`; or give a whole `config`. `vgg`: LPIPS by VGG too. `farm`: where the runs of
    `cells` go. `on_progress` is called
    with every event, `log` with lines for people. Raises a GsoptError; a wrong setting, prompt or prior, an unreadable
    held-out image, missing weights or a missing mask model raise it before any work.
    """
    run = Path(run)
    config = _with_absolute_paths(_configured(data, run, config, resume, settings))
    resume = resume or goes_on(config, run)
    if not resume:
        refuse_another_run(run)
        _require_prior(config.guidance)
        require_mask_model(config.data)
    networks(vgg)
    read_metrics(run)
    config = _with_masks(_with_poses(config, run, log), run, log)
    with StopRequest(run / "stop") as stop:
        if config.cells:
            from gsopt.training.cells.run import train_in_cells

            result = train_in_cells(config, run, farm, resume=resume, on_progress=on_progress)
        else:
            result = train(config, run, resume=resume, on_progress=on_progress, done=False)
        if result.stopped:
            return Reconstruction(result.run, result.gaussians, None, None)
        if config.clean:
            result = _cleaned(result, log)
        log(f"trained in {timedelta(seconds=round(result.train_seconds))}; evaluating {result.run / 'splat.ply'}")
        metrics, report = _evaluated(config, result, vgg, on_progress, stop)
    return Reconstruction(result.run, result.gaussians, metrics, report)


def goes_on(config: TrainConfig, run: Path) -> bool:
    """True when the folder holds a run in cells with the same settings: the same command goes on with it."""
    if not config.cells or not (run / "config.json").is_file():
        return False
    return first_difference(TrainConfig.read(run / "config.json").to_dict(), config.to_dict()) is None


def _configured(
    data: Path | str | DataConfig | None, run: Path, config: TrainConfig | None, resume: bool, settings: dict[str, Any]
) -> TrainConfig:
    """The settings of the run as given, or as recorded."""
    if config is not None and settings:
        raise UsageError(f"`config` and `{next(iter(settings))}` were both given. Keep one of them.")
    if data is None and config is None:
        if not resume or settings:
            raise UsageError("A dataset is needed, got none. Give its folder, or only a run and resume=True.")
        return TrainConfig.read(run / "config.json")
    made = TrainConfig.of(**settings) if config is None else config
    if data is None:
        return made
    return replace(made, data=data if isinstance(data, DataConfig) else replace(made.data, path=str(data)))


def _with_absolute_paths(config: TrainConfig) -> TrainConfig:
    """Paths made absolute, so that the run can be resumed from anywhere; names of models stay."""
    guidance = replace(
        config.guidance,
        prompts=_absolute(config.guidance.prompts),
        prior=_absolute(config.guidance.prior),
        clip=_absolute(config.guidance.clip),
        tiny_vae=_absolute(config.guidance.tiny_vae),
        ref_image=tuple(map(_absolute, config.guidance.ref_image)),
    )
    data = replace(
        config.data,
        path=str(Path(config.data.path).expanduser().absolute()),
        masks=_absolute_masks(config.data.masks),
        depth=_absolute(config.data.depth) if config.data.depth else None,
        mask_model=_absolute(config.data.mask_model) if config.data.mask_model else None,
    )
    return replace(config, data=data, guidance=guidance)


def _absolute_masks(choice: str) -> str:
    """A folder of masks as an absolute path; a word as it is."""
    return choice if choice in ("given", "auto", "none") else _absolute(choice)


def _absolute(name: str) -> str:
    """The absolute path of something that exists, any other name as it is; `library:PATH` and `shape:DIR` keep their
    kind."""
    for kind, named in (("library", library_of(name)), ("shape", shape_prior_of(name))):
        if named:
            return f"{kind}:{_absolute(named)}"
    path = Path(name).expanduser()
    return str(path.absolute()) if name and path.exists() else name


def _require_prior(config: GuidanceConfig) -> None:
    """UsageError or InputError before any work for a prior, prompts or reference images that cannot be had."""
    if config == GuidanceConfig():
        return
    from gsopt.training.guided.start import require_guidance
    from gsopt.training.library_body import require_library
    from gsopt.training.shape_prior_body import require_shape_prior

    require_guidance(config)
    require_library(config)
    require_shape_prior(config)


def _with_poses(config: TrainConfig, run: Path, log: Report) -> TrainConfig:
    """Photos or a video without poses become a posed scene beside the run; anything else is left as it is.

    A folder of masks becomes the alpha of that scene: its photos have another lens than the one it was made for.
    """
    data, features = Path(config.data.path), config.data.features
    if not needs_poses(data):
        if features in ("xfeat", "both"):
            log(f"{data} has poses: `--features {features}` changes nothing")
        return config
    masks = "auto" if config.data.masks == "given" else config.data.masks
    sfm = SfmConfig(features=features, masks=masks, seed=config.seed, threads=config.threads)
    scene = posed_scene(data, run.absolute().parent, sfm, log)
    left = config.data.masks if masks in ("auto", "none") else "given"
    return replace(config, data=replace(config.data, path=str(scene), masks=left))


def _with_masks(config: TrainConfig, run: Path, log: Report) -> TrainConfig:
    """`--masks auto` becomes the dataset's own masks, or a folder beside the run with masks of a network."""
    if config.data.masks != "auto":
        return config
    return replace(config, data=with_made_masks(config.data, run.absolute().parent, log))


def _cleaned(result: TrainResult, log: Report) -> TrainResult:
    """Without the splats that no input view needs, where views that were left out of the decision do not lose."""
    from gsopt.results.clean_files import clean_where_it_helps

    cleaning, change = clean_where_it_helps(result.run)
    judged = f"views without a part in the decision change by {change:+.4f} dB"
    if math.isnan(change):
        judged = "one input view leaves none to judge by"
    if cleaning is None:
        log(f"not cleaned: {judged}")
        return result
    log(f"cleaned: {cleaning.left_out:,} of {len(result.gaussians):,} splats go; {judged}")
    return replace(result, gaussians=cleaning.gaussians)


def _evaluated(
    config: TrainConfig, result: TrainResult, vgg: bool, listener: Listener | None, stop: StopRequest
) -> tuple[dict[str, Any] | None, Path | None]:
    """Evaluate, write the report, and end the run with the event `done`.

    It is `error` when one of these fails, and `stopped`, with neither metrics nor report, when someone asked for it.
    """
    facts = {
        "train_seconds": round(result.train_seconds, 3),
        "train_cpu_seconds": round(result.cpu_seconds, 3),
        "peak_memory_mb": None if result.peak_memory_mb is None else round(result.peak_memory_mb, 1),
        "n_gaussians": len(result.gaussians),
        "steps": result.steps,
        "init": result.init,
    }
    with opened(result.run, config, resume=True, listener=listener) as directory:
        write_atomic(result.run / "metrics.json", to_json({**read_metrics(result.run), **facts}))
        ended = {"step": result.steps, "n": len(result.gaussians), "seconds": facts["train_seconds"]}
        follow = _follower(directory, stop)
        try:
            metrics = evaluate(result.run, threads=config.threads, vgg=vgg, scene=result.scene, on_view=follow)
        except Stopped:
            directory.emit("stopped", **ended)
            return None, None
        from gsopt.results.report import write_report

        report = write_report(result.run)
        directory.emit("done", **ended)
    return metrics, report


def _follower(directory: RunDirectory, stop: StopRequest) -> OnView:
    """Reports evaluated views about twice per second and at the end; raises Stopped when someone asked to stop."""
    reported = time.perf_counter()

    def follow(views: int, total: int) -> None:
        nonlocal reported
        stop.check()
        if views == total or time.perf_counter() - reported >= PROGRESS_SECONDS:
            reported = time.perf_counter()
            directory.emit("evaluation", views=views, total=total)

    return follow
