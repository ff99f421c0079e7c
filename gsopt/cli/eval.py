"""`gsopt eval`: judge a finished run by its held-out views."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro


@dataclass(frozen=True)
class Flags:
    """Draw the held-out views of a finished run, compare them with the truth and write metrics.json and the renders."""

    run: tyro.conf.Positional[Path]
    """The run directory that `gsopt train` wrote."""
    vgg: bool = False
    """Also compute LPIPS (VGG), at many times the cost of the rest; needs its weights."""
    report: bool = True
    """Write report.html anew with these figures."""
    backend: Literal["auto", "cpu", "cuda", "mps", "reference"] | None = None
    """Draw with this backend instead of the run's."""
    threads: int | None = None
    """Draw with this many threads instead of the run's; 0 = one per core."""


def main(argv: Sequence[str]) -> int:
    """Evaluate, print the means and return 0."""
    flags = tyro.cli(Flags, prog="gsopt eval", args=argv)

    from gsopt.results.evaluation import evaluate

    metrics = evaluate(
        flags.run,
        backend=flags.backend,
        threads=flags.threads,
        vgg=flags.vgg,
        on_view=_follow if _is_watched() else None,
    )
    print(summary(metrics))
    print(f"Written: {flags.run / 'metrics.json'}")
    if flags.report:
        from gsopt.results.report import write_report

        print(f"Written: {write_report(flags.run)}")
    return 0


def summary(metrics: dict[str, Any]) -> str:
    """The means as one line, or the reason when there are none."""
    lines: list[str] = []
    if metrics["mean"] is not None:
        lines.append(f"Held-out views ({len(metrics['per_view'])}): {_figures(metrics['mean'])}")
    else:
        train = metrics["train"]
        lines += [metrics["reason"], f"Training views ({len(train['per_view'])}): {_figures(train['mean'])}"]
    return "\n".join(lines)


def _figures(mean: dict[str, float | None]) -> str:
    columns = {"psnr": ("PSNR", ".2f", " dB"), "ssim": ("SSIM", ".4f", "")}
    columns |= {"lpips_alex": ("LPIPS (Alex)", ".4f", ""), "lpips_vgg": ("LPIPS (VGG)", ".4f", "")}
    further = {"cc_psnr": "PSNR color-corrected", "psnr_object": "PSNR inside the masks"}
    further["cc_psnr_object"] = "the same color-corrected"
    columns |= {key: (title, ".2f", " dB") for key, title in further.items() if mean.get(key) is not None}
    parts = []
    for key, (title, digits, unit) in columns.items():
        if key in mean:
            value = mean[key]
            parts.append(f"{title} {'not computed' if value is None else format(value, digits) + unit}")
    return ", ".join(parts)


def _is_watched() -> bool:
    return sys.stderr.isatty()


def _follow(done: int, total: int) -> None:
    print(f"\rView {done} of {total}", end="\n" if done == total else "", file=sys.stderr, flush=True)
