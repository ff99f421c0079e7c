"""`gsopt train-many`: a run for every scene of a folder or manifest; called again, it makes what is missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, arg

from gsopt import check
from gsopt.errors import InputError


@dataclass(frozen=True)
class Flags:
    """Train on every scene. Flags of `gsopt train` for all of them stand after `--`; one page, RUNS/index.html, has a
    row, a picture and a link for each. The same command goes on where a stopped or killed one ended."""

    scenes: Annotated[Positional[Path], arg(metavar="SCENES")]
    """Folder whose subfolders are scenes or photos, or FILE.json: {"scenes": [{"data": DIR, "flags": [...]}]}."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="RUNS")]
    """Folder of the runs."""
    farm: Annotated[str, arg(metavar="local[:CORES]|ray[://HOST:PORT]")] = "local"
    """Machines of the runs; every core of this one when not given."""
    threads: int = 1
    """Threads of every run. The results do not depend on it."""
    max_memory: Annotated[str | None, arg(metavar="8GB")] = None
    """Memory that a run may hold; it is ended beyond."""
    time_limit: Annotated[float, arg(metavar="S")] = 86_400.0
    """Seconds that a run may take."""


def main(argv: Sequence[str]) -> int:
    """Run `gsopt train-many`: 0, or 3 when some scenes failed."""
    words = list(argv)
    at = words.index("--") if "--" in words else len(words)
    flags = tyro.cli(Flags, prog="gsopt train-many", args=words[:at])
    check.within("--threads", flags.threads, 1, check.MAX_THREADS, "One is most efficient where scenes are many.")
    check.at_least("--time-limit", flags.time_limit, 1.0, "Give seconds.")
    memory = check.byte_count("--max-memory", flags.max_memory) if flags.max_memory else None

    bound = ("--max-memory", flags.max_memory) if flags.max_memory else ()

    from gsopt.cli.train import read_flags
    from gsopt.cli.train_flags import flags_in_errors, parse
    from gsopt.farm.open import available_cores, open_farm
    from gsopt.many_scenes.scenes import read_scenes

    scenes = read_scenes(flags.scenes, bound + tuple(words[at + 1 :]))
    for settings in {scene.flags: scene for scene in scenes}.values():  # a wrong flag is noticed now
        with flags_in_errors():
            read_flags(parse([str(settings.data), *settings.flags]))
    farm = open_farm(flags.farm, max(available_cores(), flags.threads))

    from gsopt.many_scenes.train_scenes import PAGE, Limits, train_scenes

    limits = Limits(flags.threads, memory, flags.time_limit)
    records = train_scenes(scenes, flags.out, farm, limits, lambda line: print(line, flush=True))
    failed = [record["name"] for record in records if record["state"] != "done"]
    print(f"{len(records) - len(failed)} of {len(records)} scenes: {flags.out / PAGE}")
    return InputError.exit_code if failed else 0
