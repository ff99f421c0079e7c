"""Measures the accuracy of the kernels on adversarial scenes and writes the table of docs/performance.md.

    python experiments/stress.py

The cases are those of tests/raster/stress_cases.py; the errors on every instruction set of this processor go to
experiments/results/stress.json.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "raster"))

from stress_cases import STRESSES, Stress  # noqa: E402
from stress_measure import Deviation, Truth, deviation  # noqa: E402

from gsopt.benchmark import schema  # noqa: E402
from gsopt.benchmark.accuracy import compiled  # noqa: E402
from gsopt.benchmark.machine import machine  # noqa: E402
from gsopt.benchmark.markdown import replace_block, table  # noqa: E402
from gsopt.events import to_json, write_atomic  # noqa: E402

RESULT = ROOT / "experiments" / "results" / "stress.json"
PAGE = ROOT / "docs" / "performance.md"
COMMAND = "python experiments/stress.py"
ROW = {"case": str, "isa": str, "image": float, "gradient": float, "worst": str, "undecided": float}


def main() -> None:
    backends = list(compiled())
    found: dict[Stress, list[Deviation]] = {}
    for stress in STRESSES:
        truth = Truth.of(stress.make())
        found[stress] = [deviation(backend, truth) for _, backend in backends]
        print(f"{stress.name}: image {image(found[stress])}, gradient {gradient(found[stress])}")
    rows = [
        {"case": stress.name, "isa": isa, **vars(result)}
        for stress, results in found.items()
        for (isa, _), result in zip(backends, results, strict=True)
    ]
    document = {"command": COMMAND, "machine": machine(), "rows": rows}
    schema.require(document, {"command": str, "machine": schema.MACHINE, "rows": [ROW]})
    write_atomic(RESULT, to_json(document))
    replace_block(PAGE, "stress", page(found, [isa for isa, _ in backends]))


def page(found: dict[Stress, list[Deviation]], sets: list[str]) -> str:
    head = ["case", "what could go wrong", "what happens", "image error", "gradient error"]
    cells = [[s.name, s.risk, s.outcome, image(results), gradient(results)] for s, results in found.items()]
    origin = (
        f"`{COMMAND}`; the worse of {', '.join(sets)} against the float64 reference: largest error of a color, "
        "alpha or depth (of the largest value, or of 1), and relative error (L2) of the worst gradient."
    )
    return f"{origin}\n\n{table(head, cells)}"


def image(results: list[Deviation]) -> str:
    return f"{max(result.image for result in results):.1e}"


def gradient(results: list[Deviation]) -> str:
    return f"{max(result.gradient for result in results):.1e}"


if __name__ == "__main__":
    main()
