"""Estimates the time and memory of a suite: a short trial of every scene, guided and not, scaled to the runs due."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from gsopt.benchmark.suite.arm_flags import is_guided
from gsopt.benchmark.suite.definition import Case
from gsopt.benchmark.suite.single_run import SuiteContext, call, machine_flags
from gsopt.data.files import read_json
from gsopt.events import read_events

TRIAL_STEPS = 100


@dataclass(frozen=True)
class Trial:
    """A run cut to TRIAL_STEPS on this machine."""

    setup: float
    """Seconds before the first step: data, first Gaussians, the prior, the guard's short runs."""
    step: float
    """Seconds of a step, in the mean over guided and other steps."""
    memory_mb: float

    def seconds(self, steps: int) -> float:
        """Expected time of a run with so many steps."""
        return self.setup + self.step * steps


def estimate(cases: Sequence[Case], context: SuiteContext) -> Iterator[str]:
    """One line per scene and kind of arm, and one for all runs; each trial is made before its line."""
    groups: dict[tuple[str, str, bool], list[Case]] = {}
    for case in cases:
        groups.setdefault((case.scene, case.views, is_guided(case.arm)), []).append(case)
    total = 0.0
    for (scene, views, guided), due in groups.items():
        tried = trial(due[0], context)
        seconds = sum(tried.seconds(case.iterations) for case in due)
        total += seconds
        kind = "guided" if guided else "unguided"
        steps = sum(case.iterations for case in due)
        yield (
            f"{scene}, {views} views, {kind}: {len(due)} runs, {steps:,} steps, {tried.step * 1000:.0f} ms each, "
            f"{hours(seconds)}, {tried.memory_mb / 1000:.1f} GB"
        )
    yield (
        f"{len(cases)} runs are due: at least {hours(total)} on this machine, one after the other. Steps become slower "
        "as Gaussians are added. Without --estimate they begin, and go on where they are stopped."
    )


def trial(case: Case, context: SuiteContext) -> Trial:
    """Trains TRIAL_STEPS steps with the flags of a run. RunFailed where `gsopt train` fails."""
    with tempfile.TemporaryDirectory(prefix="run-", dir=context.work) as folder:
        run = Path(folder) / "run"
        flags = [flag for flag in (*case.flags, *machine_flags(case, context)) if flag != "--vgg"]
        flags[flags.index("--iterations") + 1] = str(TRIAL_STEPS)
        call(["train", str(context.root / case.scene), "-m", str(run), *flags])
        config = read_json(run / "config.json")
        started, *_, done = read_events(run / "events.jsonl")[0]
        memory = float((config.get("estimate") or {}).get("memory_mb", 0.0))
    return Trial(float(started["setup_cpu_seconds"]), float(done["seconds"]) / TRIAL_STEPS, memory)


def hours(seconds: float) -> str:
    """90061 s as 25:01 h."""
    minutes = round(seconds / 60)
    return f"{minutes // 60}:{minutes % 60:02d} h"
