"""`gsopt train`: learn Gaussians from posed images, evaluate them on the held-out views, write a report."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gsopt.cli.train_flags import Flags, flags_in_errors, parse
from gsopt.config.train import TrainConfig
from gsopt.errors import UsageError

RUNS = Path("runs")

# Flags that may stand beside --resume when DATA does not: they choose where and how fast, not what.
WITH_RESUME = ("run", "resume", "vgg", "farm", "threads", "max_memory", "checkpoint_every", "preview_every")


def main(argv: Sequence[str]) -> int:
    """Run `gsopt train` with these arguments: 0 when done or stopped, else a GsoptError or KeyboardInterrupt."""
    with flags_in_errors():
        flags = parse(argv)
        config, run = read_flags(flags)
        if flags.farm != Flags().farm and not config.cells:
            raise UsageError(f"`--farm` is for runs in cells, got {flags.farm} without. Add --cells auto, or drop it.")

        from gsopt.cli.console import RunConsole
        from gsopt.training.reconstruct import reconstruct

        console = RunConsole(run)
        try:
            how: dict[str, Any] = {"resume": flags.resume, "vgg": flags.vgg, "farm": flags.farm}
            result = reconstruct(None, run, config=config, on_progress=console, log=console.say, **how)
            console.close()
            if result.metrics is None:
                if (run / "splat.ply").is_file():
                    console.say(f"splats so far: {run / 'splat.ply'}")
            else:
                console.say(summary(result.metrics))
                console.say(f"report: {result.report}")
        finally:
            console.close()
    return 0


def summary(metrics: Mapping[str, Any]) -> str:
    """One line of figures, and whose they are."""
    held_out = metrics["mean"] is not None
    judged = metrics if held_out else metrics["train"]
    names = {"psnr": "PSNR {:.2f} dB", "ssim": "SSIM {:.4f}", "lpips_alex": "LPIPS {:.4f}", "lpips_vgg": "(VGG {:.4f})"}
    names["psnr_object"] = "{:.2f} dB inside the masks"
    mean = judged["mean"]
    figures = [text.format(mean[name]) for name, text in names.items() if mean.get(name) is not None]
    count = len(judged["per_view"])
    whose = f"{count} held-out view{'s' * (count != 1)}" if held_out else "input views (none was held out)"
    memory = "" if metrics["peak_memory_mb"] is None else f", peak memory {metrics['peak_memory_mb']:.0f} MB"
    return f"{'  '.join(figures)} over {whose}; {metrics['n_gaussians']:,} Gaussians{memory}"


def read_flags(flags: Flags) -> tuple[TrainConfig, Path]:
    """The configuration and the run directory that the flags name; UsageError where they contradict each other."""
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


def make_config(flags: Flags, data: Path) -> TrainConfig:
    """All settings of a new run."""
    background = flags.settings.data.background
    if flags.white_background and background not in ("auto", "white"):
        raise UsageError(f"`-w` and `--background {background}` contradict each other. Keep one of them.")
    chosen = "white" if flags.white_background else background
    path = str(data.expanduser().absolute())
    return replace(flags.settings, data=replace(flags.settings.data, path=path, background=chosen))


def recorded_config(flags: Flags, run: Path) -> TrainConfig:
    """The settings a run was started with; flags that would change them are refused."""
    given = changed(flags, Flags())
    if refused := [name for name in given if name not in WITH_RESUME]:
        raise UsageError(
            f"`{refused[0]}` was given with --resume, which takes all settings from {run / 'config.json'}. Drop what "
            "is given there, or give DATA and all flags of the run again."
        )
    free = ("threads", "max_memory", "checkpoint_every", "preview_every")
    values = {name: getattr(flags.settings, name) for name in free if name in given}
    return replace(TrainConfig.read(run / "config.json"), **values)


def changed(flags: Any, default: Any, within: str = "") -> list[str]:
    """Names of the settings that differ, those of a section last and named after it: density.strategy."""
    names: list[str] = []
    for item in dataclasses.fields(flags):
        one, other = getattr(flags, item.name), getattr(default, item.name)
        if isinstance(one, TrainConfig):
            names += changed(one, other)
        elif dataclasses.is_dataclass(one):
            names += changed(one, other, f"{within}{item.name}.")
        elif one != other:
            names.append(f"{within}{item.name}")
    return sorted(names, key=lambda name: "." in name)


def free_folder(data: Path) -> Path:
    """The first of runs/<dataset>-1, runs/<dataset>-2, ... that does not exist."""
    name = data.expanduser().resolve().name or "scene"
    return next(folder for n in itertools.count(1) if not (folder := RUNS / f"{name}-{n}").exists())
