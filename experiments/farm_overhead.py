"""The cost of Ray beside local processes: 64 jobs of one second on two cores, in pairs; and what a job costs a driver.

    PYTHONPATH=. python experiments/farm_overhead.py

Writes experiments/results/farm_overhead.json after every pair. Wants `pip install 'gsopt[ray]'` and an idle machine.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsopt.benchmark.machine import machine
from gsopt.events import to_json, write_atomic
from gsopt.farm.job import Farm, Job
from gsopt.farm.local import LocalFarm
from gsopt.farm.serve import serve

RESULTS = Path(__file__).parent / "results" / "farm_overhead.json"
CORES = 2


def jobs(count: int, seconds: float) -> list[Job]:
    command = (sys.executable, str(Path(__file__).resolve()), "--worker")
    return [Job(f"job-{number}", command, {"seconds": seconds}) for number in range(count)]


def sleep(request: Mapping[str, Any]) -> float:
    """A job that takes a second and no core: what is measured is the farm, not the machine's load."""
    time.sleep(request["seconds"])
    return time.time()


def measure(farm: Farm, count: int, seconds: float) -> dict[str, float]:
    """Wall and driver CPU seconds of a call."""
    began, used = time.perf_counter(), time.process_time()
    endings = [outcome.ending for outcome in farm.run(jobs(count, seconds))]
    assert endings == ["done"] * count
    return {"wall_seconds": time.perf_counter() - began, "driver_cpu_seconds": time.process_time() - used}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=64)
    parser.add_argument("--short-jobs", type=int, default=400, help="jobs of no length, for the driver's cost of one")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    flags = parser.parse_args()
    if flags.worker:
        serve(sleep)

    import ray

    from gsopt.farm.ray_farm import RayFarm

    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    ray.init(num_cpus=CORES, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    result: dict[str, Any] = {
        "command": "python experiments/farm_overhead.py",
        "machine": machine(),
        "ray": ray.__version__,
    }
    result |= {"jobs": flags.jobs, "short_jobs": flags.short_jobs, "pairs": [], "message_bytes": message_bytes()}
    local, remote = LocalFarm(CORES), RayFarm()
    measure(remote, CORES, 0.0)  # Ray's worker processes start
    for _ in range(flags.pairs):
        pair = {name: measure(farm, flags.jobs, 1.0) for name, farm in (("local", local), ("ray", remote))}
        pair |= {
            f"{name}_short": measure(farm, flags.short_jobs, 0.0) for name, farm in (("local", local), ("ray", remote))
        }
        result["pairs"].append(pair)
        ratios = sorted(one["ray"]["wall_seconds"] / one["local"]["wall_seconds"] for one in result["pairs"])
        result["ray_over_local"] = {"median": ratios[len(ratios) // 2], "least": ratios[0], "most": ratios[-1]}
        write_atomic(RESULTS, to_json(result))
        print(json.dumps({"pair": pair, "ray_over_local": result["ray_over_local"]}), flush=True)


def message_bytes() -> dict[str, int]:
    """Size of what a job of `gsopt train-many` sends and gets, as JSON."""
    request = {
        "arguments": ["train", "/data/scenes/chair", "-m", "/data/runs/chair", "--threads", "1"],
        "stamps": [0] * 2,
    }
    return {"request": len(to_json(request)), "output": 1 << 16}


if __name__ == "__main__":
    main()
