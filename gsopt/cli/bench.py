"""`gsopt bench`: measure gsopt on this machine, and draw what was measured."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import arg

from gsopt import check
from gsopt.errors import UsageError

Part = Literal["cases", "growth", "accuracy"]


@dataclass(frozen=True)
class Kernels:
    """Time the compiled kernels in full training iterations and write one record per case."""

    json: Annotated[Path, arg(metavar="FILE")]
    """Result file. What it holds of other cases and parts is kept."""
    case: Annotated[tuple[str, ...], arg(metavar="WxH/N")] = (
        "200x200/20k",
        "400x400/50k",
        "800x800/100k",
        "800x800/300k",
    )
    """Image size and number of Gaussians, e.g. 800x800/100k."""
    threads: Annotated[str, arg(metavar="N,M")] = "1,2"
    """Numbers of threads to measure with."""
    parts: tuple[Part, ...] = ("cases",)
    """cases: speed; growth: time and memory over Gaussians (1k to 3M) and pixels (64² to 2048²), takes minutes;
    accuracy: time against error of every backend."""
    repetitions: int = 25
    """Per case; the median and the distance between the quartiles are kept."""


@dataclass(frozen=True)
class Draw:
    """Write the tables and charts of a page from a result file, without measuring anything."""

    json: Annotated[Path, arg(metavar="FILE")]
    """What `gsopt bench kernels` wrote."""
    page: Annotated[Path, arg(metavar="FILE.md")] = Path("docs/performance.md")
    """The page that has the block `kernels`; charts go to img/ beside it."""


def main(argv: Sequence[str]) -> int:
    """Measure or draw, say where it went, and return 0."""
    verbs: dict[str, Any] = {"kernels": Kernels, "draw": Draw}
    flags = tyro.extras.subcommand_cli_from_dict(verbs, prog="gsopt bench", description=__doc__, args=list(argv))
    if isinstance(flags, Draw):
        return draw(flags)
    return kernels(flags, argv)


def kernels(flags: Kernels, argv: Sequence[str]) -> int:
    """`gsopt bench kernels`."""
    threads = read_threads(flags.threads)
    check.within("--repetitions", flags.repetitions, 1, 10_000, "25 give a steady median.")

    import torch

    from gsopt.benchmark import results
    from gsopt.benchmark.kernels import Case
    from gsopt.benchmark.machine import calibration, machine

    cases = [Case.parse(name) for name in flags.case]
    if flags.json.exists():
        results.read(flags.json)  # refused now rather than after minutes of measuring
    torch.set_num_threads(1)  # only the kernels' own threads may run
    command = "gsopt bench " + shlex.join(argv)
    measured: dict[str, Any] = {"command": command, "machine": machine(), "calibration": calibration()}
    measured |= {
        part: measure(part, cases, threads, flags.repetitions, measured["calibration"]) for part in flags.parts
    }
    results.update(flags.json, measured)
    print(f"Written: {flags.json}")
    return 0


def measure(part: Part, cases: Sequence[Any], threads: Sequence[int], repetitions: int, rates: dict[str, Any]) -> Any:
    """One part of the result file; prints as it goes."""
    if part == "accuracy":
        from gsopt.benchmark.accuracy import accuracy

        return accuracy()
    if part == "growth":
        from gsopt.benchmark.growth import by_count, by_pixels

        return [by_count(), by_pixels()]
    from gsopt.benchmark import kernels

    records = []
    for case in cases:
        for count in threads:
            records.append(kernels.measure(case, count, repetitions, rates))
            print(line(records[-1]), flush=True)
    return records


def line(record: dict[str, Any]) -> str:
    """A case in one line of the printed table."""
    forward, backward = (record["pairs_per_second"][way] / 1e9 for way in ("forward", "backward"))
    shares = " / ".join(f"{100 * record['share_of_bound'][way]:.0f} %" for way in ("forward", "backward"))
    return (
        f"{record['case']:<14} {record['threads']} threads {record['isa']:<8} "
        f"{record['cpu_ms']['median']:8.2f} ms CPU (IQR {record['cpu_ms']['iqr']:.2f})  "
        f"{record['wall_ms']['median']:8.2f} ms wall  {record['useful_pairs'] / 1e6:6.2f} M pairs  "
        f"{forward:.2f} / {backward:.2f} G/s  {shares} of the bound  "
        f"{record['render']['frames_per_second']:.0f} frames/s"
    )


def draw(flags: Draw) -> int:
    """`gsopt bench draw`."""
    from gsopt.benchmark import results
    from gsopt.benchmark.kernel_page import write_page

    write_page(results.read(flags.json), flags.page)
    print(f"Written: {flags.page}")
    return 0


def read_threads(text: str) -> list[int]:
    """1,2 as numbers."""
    try:
        threads = [int(part) for part in text.split(",")]
    except ValueError as error:
        raise UsageError(f"`--threads` must be whole numbers and commas, got {text!r}. Try 1,2.") from error
    for count in threads:
        check.within("--threads", count, 1, 256, "Give numbers of threads, e.g. 1,2.")
    return threads
