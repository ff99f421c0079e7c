"""Fuzzes every target in turn (`make fuzz`): python campaign.py SECONDS [TARGET...].

New inputs that reach new code are kept in tests/corpus/TARGET, which `test_corpus.py` replays; an input that breaks
the law is kept there as `broken-*` and printed. The last line is the campaign's table, as JSON.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parent.parent)]
from targets import TARGETS, seeds_of  # noqa: E402 (the path comes first)

CORPUS = HERE.parent / "corpus"
LARGEST_INPUT = 4096
"""Bytes, or twice those of the largest valid input."""
LARGEST_KEPT = 60_000
"""Bytes kept of one target: all of them stay below 2 MB."""
LIMITS = ["-timeout=20", "-print_final_stats=1", "-verbosity=1"]


def folder_of(name: str) -> Path:
    return CORPUS / name.replace(" ", "_")


def libfuzzer(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    longest = max(LARGEST_INPUT, *(2 * len(seed) for seed in seeds_of(TARGETS[name])))
    command = [sys.executable, str(HERE / "fuzz.py"), *LIMITS, f"-max_len={longest}", *arguments]
    env = {**os.environ, "FUZZ_TARGET": name}
    return subprocess.run(command, capture_output=True, text=True, errors="replace", check=False, env=env)


def fuzz(name: str, seconds: int) -> dict[str, object]:
    """One target: its number of inputs, of inputs kept, and of broken laws, and the code covered."""
    kept = folder_of(name)
    kept.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        found, broken = Path(scratch, "found"), Path(scratch, "broken")
        for folder in (found, broken):
            folder.mkdir()
        for i, seed in enumerate(seeds_of(TARGETS[name])):
            (found / f"seed-{i}").write_bytes(seed)
        began = time.monotonic()
        done = libfuzzer(name, f"-max_total_time={seconds}", f"-artifact_prefix={broken}/", str(found), str(kept))
        merged = keep(name, found)
        for path in broken.iterdir():
            (kept / f"broken-{path.name[:40]}").write_bytes(path.read_bytes())
            print(f"{name}: {path.name}\n{done.stderr[-3000:]}", flush=True)
        inputs = re.search(r"number_of_executed_units: (\d+)", done.stderr) or re.search(r"#(\d+)", done.stderr)
        return {
            "inputs": int(inputs[1]) if inputs else 0,
            "kept": sum(1 for _ in kept.iterdir()),
            "broken": sum(1 for _ in broken.iterdir()),
            "merged": merged,
            "covered": coverage_of(done.stderr),
            "seconds": round(time.monotonic() - began),
        }


def coverage_of(log: str) -> list[int]:
    """Edges of the code that the kept inputs reached, and all inputs at the end."""
    covered = [int(edges) for edges in re.findall(r"\bcov: (\d+)", log)]
    return [covered[0], covered[-1]] if covered else []


def keep(name: str, found: Path) -> bool:
    """Copies the smallest set of inputs that reaches the same code, the small ones first, up to a size; false where no
    input reaches any, as in code that is not instrumented."""
    kept = folder_of(name)
    with tempfile.TemporaryDirectory() as scratch:
        merge = libfuzzer(name, "-merge=1", scratch, str(kept), str(found))
        chosen = sorted(Path(scratch).iterdir(), key=lambda path: (path.stat().st_size, path.name))
        if not chosen:
            print(f"{name}: no input reached any code, so that its corpus stays.\n{merge.stderr[-3000:]}", flush=True)
            return False
        size = 0
        for path in kept.iterdir():
            if not path.name.startswith("broken-"):
                path.unlink()
        for path in chosen:
            size += path.stat().st_size
            if size <= LARGEST_KEPT:
                (kept / path.name).write_bytes(path.read_bytes())
    return True


def main() -> None:
    seconds, names = int(sys.argv[1]), sys.argv[2:] or list(TARGETS)
    table = {}
    for name in names:
        table[name] = fuzz(name, seconds)
        print(name, table[name], flush=True)
    print(json.dumps(table))
    if any(row["broken"] or not row["merged"] for row in table.values()):
        sys.exit(1)


if __name__ == "__main__":
    main()
