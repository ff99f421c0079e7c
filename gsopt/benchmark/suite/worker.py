"""A worker of a suite: `python -m gsopt.benchmark.suite.worker` executes one run after the other."""

from __future__ import annotations

from gsopt.benchmark.suite.single_run import answer
from gsopt.farm.serve import serve

if __name__ == "__main__":
    serve(answer)
