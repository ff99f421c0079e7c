"""A run in cells: coarse model, plan, a run per cell, crop at the borders, and a joint polish.

The scene is learned roughly as a whole, then each cell finely while the rest stays as the coarse model has it, as in
CityGaussian (Liu et al. 2024). Every step is an ordinary run in a folder of its own, which resumes to the same bits.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from gsopt.config.cells import CellConfig
from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import TrainConfig
from gsopt.data.scene import Scene, read_ahead
from gsopt.errors import InputError, UsageError, shortened
from gsopt.farm.open import open_farm
from gsopt.formats import load_splats
from gsopt.formats.ply import save_ply
from gsopt.gaussians import Gaussians
from gsopt.init.mask_repair import load_with_agreeing_masks
from gsopt.raster.api import make_backend
from gsopt.raster.threads import available_cores
from gsopt.sds.select_prior import guidance_flags
from gsopt.training.cells.divide import divide
from gsopt.training.cells.plan import CellPlan, read_plan, sha256
from gsopt.training.cells.size import cell_sizes
from gsopt.training.cells.stages import FROZEN, START, Stages, cell_stage, coarse_stage, polish_stage
from gsopt.training.interrupt import Stopped, StopRequest
from gsopt.training.loop import TrainResult, peak_memory_mb
from gsopt.training.plan import RunPlan
from gsopt.training.run_directory import Listener, RunDirectory, make_folder, opened

CACHE_MB = 64
"""Decoded images that the driver keeps: its runs keep the others."""


def train_in_cells(
    config: TrainConfig, run: Path, farm: str, *, resume: bool = False, on_progress: Listener | None = None
) -> TrainResult:
    """Learn the scene in `config.cells` cells on `farm` and write `run`, all but the evaluation; goes on where an
    earlier call ended. Raises UsageError or InputError, before any work, for settings, a scene or a farm that do not
    do."""
    require_plain(config)
    threads = config.threads or available_cores()
    workers = open_farm(farm, threads)
    with opened(run, config, resume, on_progress) as directory, StopRequest(directory.stop_file) as stop:
        scene, _ = load_with_agreeing_masks(replace(config.data, cache_mb=min(CACHE_MB, config.data.cache_mb)))
        read_ahead(scene.test)
        count, polished, max_gaussians = _sizes(config, scene, directory)
        stages = Stages(directory, workers, stop, threads)
        try:
            stages.run([coarse_stage(config, count, max_gaussians)])
            plan = _plan(config, scene, directory, count, max_gaussians)
            stop.check()
            stages.run([cell_stage(config, cell, len(scene.train), run.absolute()) for cell in plan.cells])
            gaussians = _merged(plan, run)
            if polished:
                save_ply(_made(run / "polish") / START, gaussians, antialiased=config.antialiased)
                stages.run([polish_stage(config, len(gaussians), run.absolute())])
                gaussians = load_splats(run / "polish" / "splat.ply")
            save_ply(run / "splat.ply", gaussians, antialiased=config.antialiased)
            stopped = False
        except Stopped:
            gaussians, stopped = _none(), True
            directory.emit("stopped", step=round(stages.total("steps")), n=0, seconds=round(stages.total("seconds"), 3))
        peaks = [peak for peak in (stages.most("peak_memory_mb"), peak_memory_mb()) if peak is not None]
        return TrainResult(
            run=run,
            gaussians=gaussians,
            scene=scene,
            backend=make_backend(config.backend, 1, config.device).name,
            init=f"{count} cells of a coarse run",
            steps=round(stages.total("steps")),
            stopped=stopped,
            train_seconds=stages.total("seconds"),
            cpu_seconds=stages.total("cpu_seconds"),
            peak_memory_mb=max(peaks, default=None),
        )


def require_plain(config: TrainConfig) -> None:
    """UsageError for settings that would give every cell its own world: poses, exposures, or a prior's guesses."""
    refused = [("--refine-poses", config.poses.refine), ("--exposure", config.exposure.learn)]
    refused += [(flag, config.guidance.lambda_sds != 0) for flag in guidance_flags(config.guidance)]
    refused += [("--cell", config.cell != CellConfig())]
    if given := [flag for flag, is_given in refused if is_given]:
        raise UsageError(f"`--cells` and `{given[0]}` do not go together. Leave one of them out.")


def _sizes(config: TrainConfig, scene: Scene, directory: RunDirectory) -> tuple[int, bool, int]:
    """Number of cells, whether a polish follows, and the number of Gaussians: decided once, then recorded."""
    plan = RunPlan.of(replace(config, guidance=GuidanceConfig(lambda_sds=0.0)), scene)
    recorded = directory.recorded("cells")
    names = [view.name for view in scene.train]
    if recorded is None:
        sizes = cell_sizes(config, plan, scene)
        recorded = {"count": sizes.count, "polished": sizes.polished, "max_gaussians": plan.density.max_gaussians}
        directory.record(
            cells=recorded, plan=plan.to_dict(), train_views=names, origin=list(scene.origin),
            gaussians_init=f"{sizes.count} cells of a coarse run",
        )  # fmt: skip
        directory.emit("cells", message=str(sizes), **recorded)
        if not sizes.polished:
            directory.warn("The joint polish does not fit into memory and is left out: the cells stay as cropped.")
    if names != directory.recorded("train_views"):
        raise InputError(f"{scene.path} has other views than when the run began. Start in another folder.")
    try:
        count, polished, most = (recorded[key] for key in ("count", "polished", "max_gaussians"))
        if type(count) is not int or type(most) is not int or not 2 <= count <= len(names) or most < 1:
            raise ValueError
    except (TypeError, ValueError, KeyError) as error:
        config_file = directory.path / "config.json"
        raise InputError(f"`cells` in {config_file} is garbled: {shortened(recorded)}. Restore the file.") from error
    return count, bool(polished), most


def _plan(config: TrainConfig, scene: Scene, directory: RunDirectory, count: int, max_gaussians: int) -> CellPlan:
    """The plan of an earlier call, or a new one, written after the splats that its runs begin with."""
    run, path = directory.path, directory.path / "plan.json"
    splats = run / "coarse" / "splat.ply"
    if not path.exists():
        coarse = load_splats(splats)
        backend = make_backend(config.backend, config.threads, config.device)
        division = divide(coarse, sha256(splats), scene.train, backend, count, max_gaussians)
        places = division.plan.places(coarse.means)
        for cell, outside in zip(division.plan.cells, division.surroundings, strict=True):
            folder = _made(run / "cells" / cell.name)
            save_ply(folder / START, coarse.select(cell.holds(places, wide=True)), antialiased=config.antialiased)
            save_ply(folder / FROZEN, coarse.select(outside), antialiased=config.antialiased)
        division.plan.write(path)
        views = ", ".join(str(len(cell.views)) for cell in division.plan.cells)
        directory.emit("cells", message=f"planned: {views} of {len(scene.train)} views")
    return read_plan(path, splats, {view.name: view for view in scene.train}, count)


def _merged(plan: CellPlan, run: Path) -> Gaussians:
    """The Gaussians of each cell within its bounds."""
    merged = _none()
    for cell in plan.cells:
        gaussians = load_splats(run / "cells" / cell.name / "splat.ply")
        mine = gaussians.select(cell.holds(plan.places(gaussians.means)))
        merged = merged.append(mine) if len(merged) else mine
    return merged


def _made(folder: Path) -> Path:
    make_folder(folder)
    return folder


def _none() -> Gaussians:
    empty = torch.zeros(0, 1, 3)
    return Gaussians(empty[:, 0], torch.zeros(0, 4), empty[:, 0], torch.zeros(0), empty, empty[:, :0])
