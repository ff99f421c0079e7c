"""Changes one place of the code at a time, at random, and looks whether a test notices: mutate.py.

The changes are chosen by the seed alone, nobody picks them. A change meets the tests that run its line (`make mutants`
records which do), the quick ones first, until one fails; a test counts only if it passes without the change. Survivors
are printed with their line: a law is missing, or the change is harmless. A campaign that was cut goes on from its
`--json`. While laws are written for one module, `mutate.py MODULE --tests FILE --count 9999` tries all of its changes
on the tests of one file, in the time that they take.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from changes import ROOT, mutants_of
from judge import Judge
from traces import Traces

TESTS = {
    "gsopt/data": "tests/data",
    "gsopt/formats/mesh_files.py": "tests/results/mesh",
    "gsopt/formats": "tests/formats",
    "gsopt/training": "tests/training",
    "gsopt/sds": "tests/sds",
    "gsopt/symmetry": "tests/symmetry",
    "gsopt/init": "tests/init",
    "gsopt/results": "tests/results",
    "gsopt/events.py": "tests/test_events.py",
    "gsopt/metrics.py": "tests/test_metrics.py",
    "blender_addon/core": "tests/blender",
}
"""Modules, and the tests that mirror them: what a line needs that no test is known to run."""
ALSO_RUN = "tests/config tests/fuzz tests/cli tests/finetune"
"""Tests of other folders that run these modules: a prior is trained on views, a command starts a run."""


def changed_since(commit: str) -> list[Path]:
    """Modules that differ from a commit."""
    listed = subprocess.run(
        ["git", "diff", "--name-only", commit], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return [ROOT / name for name in listed.stdout.split() if (ROOT / name).is_file()]


def mirror_of(file: Path) -> str:
    """The folder of a module's tests; empty for a module that is left out."""
    name = str(file.relative_to(ROOT))
    return next((tests for folder, tests in TESTS.items() if name.startswith(folder)), "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*", default=list(TESTS), help="files or folders; all that have a mirror")
    parser.add_argument("--count", type=int, default=60, help="number of changes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--since", default="", help="only modules that differ from this commit")
    parser.add_argument(
        "--json", type=_absolute, help="file for the outcome of every change; what it has is not done again"
    )
    parser.add_argument("--traces", type=_absolute, help="folder with the coverage and junit.xml of the tests")
    parser.add_argument("--tests", nargs="+", default=[], help="files of tests, instead of those that run the line")
    parser.add_argument("--print-tests", action="store_true", help="print the folders of all tests, and end")
    options = parser.parse_args()
    if missing := [name for name in options.tests if not (ROOT / name).is_file()]:
        parser.error(f"no such file of tests: {missing[0]}")
    if options.print_tests:
        print(*TESTS.values(), ALSO_RUN)
        return
    files = changed_since(options.since) if options.since else sorted(ROOT.rglob("*.py"))
    wanted = [
        file for file in files if mirror_of(file) and str(file.relative_to(ROOT)).startswith(tuple(options.modules))
    ]
    possible = [mutant for file in wanted for mutant in mutants_of(file)]
    chosen = random.Random(options.seed).sample(possible, min(options.count, len(possible)))
    outcomes = resumed(options.json, options.seed)
    traces = None if options.tests else Traces(options.traces)
    with tempfile.TemporaryDirectory() as folder:
        judge = Judge(Path(folder) / "copy")
        for mutant in chosen:
            if any(asdict(mutant).items() <= outcome.items() for outcome in outcomes):
                continue
            began = time.monotonic()
            tests = traces.tests_of(mutant, mirror_of(ROOT / mutant.file)) if traces else options.tests
            noticed_by = judge.noticed_by(mutant, tests)
            seconds = round(time.monotonic() - began, 1)
            outcomes.append({**asdict(mutant), "noticed_by": noticed_by, "tests": len(tests), "seconds": seconds})
            if options.json:
                options.json.write_text(json.dumps({"seed": options.seed, "outcomes": outcomes}, indent=1) + "\n")
            if not noticed_by:
                change = f"{mutant.old!r} became {mutant.new!r}"
                print(f"{mutant.file}:{mutant.line}: {change}: none of {len(tests)} tests noticed", flush=True)
    count, seconds = sum(bool(done["noticed_by"]) for done in outcomes), sum(done["seconds"] for done in outcomes)
    print(f"{count} of {len(outcomes)} noticed, of {len(possible)} possible, {seconds:.0f} s")


def _absolute(name: str) -> Path:
    """A path as it is here: the judge works in another folder."""
    return Path(name).resolve()


def resumed(path: Path | None, seed: int) -> list[dict[str, Any]]:
    """The outcomes of a campaign that was cut."""
    if path is None or not path.exists():
        return []
    record = json.loads(path.read_text())
    return list(record["outcomes"]) if record["seed"] == seed else []


if __name__ == "__main__":
    os.environ["OMP_NUM_THREADS"] = "1"
    main()
