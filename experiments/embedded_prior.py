"""Measures the time of the embedded prior to load, and for one prediction.

    python experiments/embedded_prior.py [--threads 2]

Cold: a fresh process that imports, opens and loads the prior and evaluates it once, at the size of its training.
Warm: the median of further calls with all inputs (render, references, text), at 64 pixels and at that size. Writes
experiments/results/embedded_prior.json.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from gsopt.events import to_json, write_atomic

ROOT = Path(__file__).resolve().parents[1]
RESULT = ROOT / "experiments" / "results" / "embedded_prior.json"
COMMAND = "python experiments/embedded_prior.py"
CALLS = 15


def measure(threads: int) -> dict[str, Any]:
    """Seconds, in a fresh process."""
    began = time.perf_counter()
    import torch

    from gsopt.config.guidance import GuidanceConfig
    from gsopt.sds.load_prior import open_prior
    from gsopt.sds.priors.view_conditioned import INPUT_CHANNELS, TOKEN_WIDTH, TextTokens, ViewPrior, predict

    torch.set_num_threads(threads)
    prior = open_prior("embedded", GuidanceConfig())
    assert isinstance(prior, ViewPrior)
    said = TextTokens(torch.zeros(1, 8, TOKEN_WIDTH), torch.ones(1, 8, dtype=torch.bool))

    def call_seconds(side: int) -> float:
        start = time.perf_counter()
        x_t, planes = torch.zeros(1, 3, side, side), torch.zeros(1, INPUT_CHANNELS - 3, side, side)
        with torch.no_grad():
            predict(prior.unet, x_t, torch.tensor([300]), planes, said)
        return time.perf_counter() - start

    call_seconds(prior.size)
    cold = time.perf_counter() - began
    warm = {str(side): statistics.median(call_seconds(side) for _ in range(CALLS)) for side in (64, prior.size)}
    return {
        "threads": threads,
        "cold_seconds": round(cold, 2),
        "warm_seconds": {s: round(t, 4) for s, t in warm.items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--child", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        print(json.dumps(measure(options.child)))
        return
    from gsopt.benchmark.machine import machine

    runs = []
    for threads in options.threads:
        child = subprocess.run([sys.executable, __file__, "--child", str(threads)], check=True, stdout=subprocess.PIPE)
        runs.append(json.loads(child.stdout.splitlines()[-1]))
        print(f"{threads} threads: cold {runs[-1]['cold_seconds']} s, warm {runs[-1]['warm_seconds']} s")
    write_atomic(RESULT, to_json({"command": COMMAND, "machine": machine(), "runs": runs}))


if __name__ == "__main__":
    main()
