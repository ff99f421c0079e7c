"""Measure gsopt on this machine, and draw the results. Whole benchmarks, also of your own scenes (FILE.toml): see
`gsopt bench --suite NAME --help`."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import arg

from gsopt import check
from gsopt.config.presets import Preset
from gsopt.errors import InputError, UsageError

Part = Literal["cases", "growth", "accuracy"]


@dataclass(frozen=True)
class Kernels:
    """Time the compiled kernels in full training iterations and write one record per case."""

    json: Annotated[Path, arg(metavar="FILE")]
    """Result file. Its records of other cases and parts are kept."""
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
class Scenes:
    """Train a scene with every preset and over a grid of budgets and lengths; quality over CPU time, one record per
    run."""

    json: Annotated[Path, arg(metavar="FILE")]
    """Result file. Its records of other scenes and runs are kept."""
    data: Annotated[Path | None, arg(metavar="DATA")] = None
    """Dataset folder; the scene that ships with gsopt when not given."""
    resolution: Annotated[int, arg(aliases=["-r"])] = 1
    """Divide width and height by this."""
    eval: bool = False
    """Hold out every 8th image when the dataset has no test split of its own."""
    presets: tuple[Preset, ...] = ("draft", "default", "high")
    """Each is judged several times on its way."""
    counts: Annotated[tuple[str, ...], arg(metavar="N")] = ("3k", "6k", "12k", "24k")
    """Budgets of Gaussians of the grid, e.g. 12k."""
    lengths: Annotated[tuple[int, ...], arg(metavar="STEPS")] = (500, 1000, 2000, 4000)
    """Lengths of the grid's runs. `--counts --lengths` without a number leave the grid out."""
    missing: bool = False
    """Only what the file has no record of."""


@dataclass(frozen=True)
class Draw:
    """Write the tables and charts of a page from a result file, without measuring anything."""

    json: Annotated[Path, arg(metavar="FILE")]
    """Result file of `gsopt bench kernels`, `gsopt bench scenes` or `gsopt bench --suite`."""
    page: Annotated[Path, arg(metavar="FILE.md")] = Path("docs/performance.md")
    """The page that has the block `kernels`, `scenes` or that of the suite (docs/results.md); charts go to img/ beside
    it, of a suite a page with pictures too."""


@dataclass(frozen=True)
class Suite:
    """Train every arm on every scene of a suite and record all figures; runs that have a record are not made again."""

    suite: Annotated[str, arg(metavar="sparse|paper|smoke|FILE.toml")]
    """A built-in suite, or a file that declares one of your own scenes as gsopt/benchmark/suites/smoke.toml does."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="FILE.json")]
    """Result file, written after every run; at the end FILE.html is drawn beside it."""
    root: Annotated[Path | None, arg(metavar="DATA")] = None
    """Folder that holds the suite's scenes; smoke brings its own, FILE.toml has them beside it when not given."""
    seeds: int = 3
    """Seeds 0 to N-1 of every run, the first of all runs before the second."""
    arms: Annotated[tuple[str, ...], arg(metavar="ARM")] = ()
    """3dgs, ours-0, ours, ours-user, ours-template, ours-llm; all of the suite when not given."""
    groups: Annotated[tuple[str, ...], arg(metavar="GROUP")] = ()
    """Parts of the suite, in its own order; all when not given."""
    threads: int = 1
    """Threads of every run. The figures do not depend on it."""
    farm: Annotated[str, arg(metavar="local[:CORES]|ray[://HOST:PORT]")] = "local"
    """Machine of the runs; this one, one run after the other, when not given."""
    prior: Annotated[str, arg(metavar="PRIOR")] = ""
    """Guides the guided arms, as `gsopt train --prior`; gsopt's own choice when not given."""
    llm: Annotated[str, arg(metavar="URL")] = ""
    """Language model of the arm ours-llm, as `gsopt prompts --llm`."""
    model: Annotated[str, arg(metavar="NAME")] = ""
    """Its name there."""
    estimate: bool = False
    """Only print what the runs without a record will take: a trial of 100 steps of each scene, guided and not."""


def main(argv: Sequence[str]) -> int:
    """Measure or draw, say where it went, and return 0. `--suite` needs no word before it."""
    if any(word.partition("=")[0] == "--suite" for word in argv) and argv[0].startswith("-"):
        return suite(tyro.cli(Suite, prog="gsopt bench", args=list(argv)))
    verbs: dict[str, Any] = {"kernels": Kernels, "scenes": Scenes, "draw": Draw}
    flags = tyro.extras.subcommand_cli_from_dict(verbs, prog="gsopt bench", description=__doc__, args=list(argv))
    if isinstance(flags, Draw):
        return draw(flags)
    if isinstance(flags, Scenes):
        return scenes(flags, argv)
    return kernels(flags, argv)


def kernels(flags: Kernels, argv: Sequence[str]) -> int:
    """`gsopt bench kernels`."""
    threads = read_threads(flags.threads)
    check.within("--repetitions", flags.repetitions, 1, 10_000, "25 give a steady median.")

    import torch

    from gsopt.benchmark import result_files
    from gsopt.benchmark.kernels import Case
    from gsopt.benchmark.machine import calibration, machine

    cases = [Case.parse(name) for name in flags.case]
    if flags.json.exists():
        result_files.read(flags.json)  # refused now rather than after minutes of measuring
    torch.set_num_threads(1)  # only the kernels' own threads may run
    command = "gsopt bench " + shlex.join(argv)
    measured: dict[str, Any] = {"command": command, "machine": machine(), "calibration": calibration()}
    measured |= {
        part: measure(part, cases, threads, flags.repetitions, measured["calibration"]) for part in flags.parts
    }
    result_files.update(flags.json, measured)
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


def scenes(flags: Scenes, argv: Sequence[str]) -> int:
    """`gsopt bench scenes`."""
    check.at_least("--resolution", flags.resolution, 1, "1 keeps the size, 2 halves it, and so on.")

    from gsopt.benchmark import result_files, schema
    from gsopt.benchmark import scenes as runs
    from gsopt.benchmark.machine import machine

    known = (
        {result_files.run_key(run) for run in result_files.read(flags.json, schema.SCENES)["runs"]}
        if flags.json.exists()
        else set()
    )
    command = "gsopt bench " + shlex.join(argv)
    for task in tasks(flags):
        if flags.missing and task.key() in known:
            continue
        record = runs.measure(task)
        result_files.update_runs(flags.json, command, machine(), record)
        print(run_line(record), flush=True)
    print(f"Written: {flags.json}")
    return 0


def tasks(flags: Scenes) -> list[Any]:
    """The presets, then the grid, shortest first."""
    from gsopt.benchmark.kernels import read_count
    from gsopt.benchmark.scenes import Task
    from gsopt.cli.demo import SCENE
    from gsopt.config.train import DataConfig

    data = DataConfig(str((flags.data or SCENE).absolute()), downscale=flags.resolution, eval=flags.eval)
    name = "demo" if flags.data is None else flags.data.resolve().name
    name += f"-{flags.resolution}" if flags.resolution > 1 else ""
    found = [Task(name, data, preset) for preset in flags.presets]
    counts = [read_count("--counts", count) for count in flags.counts]
    grid = [
        Task(name, data, iterations=steps, max_gaussians=count) for steps in sorted(flags.lengths) for count in counts
    ]
    return found + grid


def run_line(record: dict[str, Any]) -> str:
    """A run in one line of the printed table."""
    last = record["points"][-1]
    what = record["preset"] if record["kind"] == "curve" else f"at most {record['max_gaussians']:,}"
    return (
        f"{record['scene']} {what}: {last['step']:,} steps, {last['gaussians']:,} Gaussians, "
        f"{last['cpu_seconds']:.1f} s CPU, {last['psnr']:.2f} dB"
    )


def suite(flags: Suite) -> int:
    """`gsopt bench --suite`: 0, or 3 when some runs failed."""
    check.within("--seeds", flags.seeds, 1, 1000, "3 is usual.")
    check.within("--threads", flags.threads, 1, 256, "The figures do not depend on it.")

    from gsopt.benchmark.suite import definition as declared
    from gsopt.farm.open import open_farm

    farm = open_farm(flags.farm, flags.threads)
    whole = declared.load(flags.suite)
    part = declared.with_groups(whole, flags.groups)
    cases = list(declared.cases(part, flags.seeds, flags.arms))
    root = declared.find_root(part, flags.root)

    from gsopt.benchmark.suite import result_file
    from gsopt.benchmark.suite.html_page import write_html
    from gsopt.benchmark.suite.runner import estimate_suite, run_suite, work_folder
    from gsopt.benchmark.suite.single_run import SuiteContext

    output = flags.out.absolute()
    folder = Path(flags.prior or "").expanduser()  # a run starts in another folder; any other name is an id
    prior = str(folder.absolute()) if flags.prior and folder.is_dir() else flags.prior
    options = SuiteContext(root, work_folder(output), flags.threads, prior, flags.llm, flags.model)
    command = suite_command(flags)

    def report(text: str) -> None:
        print(text, flush=True)

    if flags.estimate:
        return InputError.exit_code if estimate_suite(output, whole, command, cases, options, report) else 0
    failed = run_suite(output, whole, command, cases, options, report, farm)
    drawn = output.with_suffix(".html")
    write_html(result_file.read(output), result_file.read_images(output), drawn)
    print(f"Written: {output}, {drawn}")
    return InputError.exit_code if failed else 0


def suite_command(flags: Suite) -> str:
    """The call as it stands with the results: folders of this machine say nothing to others."""
    words = ["gsopt", "bench", "--suite", Path(flags.suite).name, *(("--root", "DATA") if flags.root else ())]
    words += ["--seeds", str(flags.seeds), *(("--arms", *flags.arms) if flags.arms else ())]
    words += ["--groups", *flags.groups] if flags.groups else []
    words += ["--prior", Path(flags.prior).name] if flags.prior else []
    return shlex.join([*words, "-o", flags.out.name])


def draw(flags: Draw) -> int:
    """`gsopt bench draw`."""
    from gsopt.benchmark import kernel_page, result_files, scene_page, schema

    document = result_files.parsed(flags.json)
    if "suite" in document:
        draw_suite(flags)
    elif "runs" in document:
        scene_page.write_page(result_files.read(flags.json, schema.SCENES), flags.page)
    else:
        kernel_page.write_page(result_files.read(flags.json), flags.page)
    print(f"Written: {flags.page}")
    return 0


def draw_suite(flags: Draw) -> None:
    """The block of the suite in the page, its charts and the grid of pictures beside it, and the page of its own."""
    from gsopt.benchmark.suite import html_page, result_file, tables

    document, images = result_file.read(flags.json), result_file.read_images(flags.json)
    tables.write_page(document, flags.page)
    html_page.write_grid(document, images, flags.page.parent / "img" / f"suite-{document['suite']}.jpg")
    html_page.write_html(document, images, flags.page.with_name(f"{flags.page.stem}-{document['suite']}.html"))


def read_threads(text: str) -> list[int]:
    """1,2 as numbers."""
    try:
        threads = [int(part) for part in text.split(",")]
    except ValueError as error:
        raise UsageError(f"`--threads` must be whole numbers and commas, got {text!r}. Try 1,2.") from error
    for count in threads:
        check.within("--threads", count, 1, 256, "Give numbers of threads, e.g. 1,2.")
    return threads
