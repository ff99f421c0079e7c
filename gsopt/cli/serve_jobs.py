"""A worker that runs verbs: `python -m gsopt.cli.serve_jobs` answers {"arguments": [...]} with the exit code."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gsopt.cli import main
from gsopt.farm.serve import serve


def handle(request: Mapping[str, Any]) -> int:
    """Runs `gsopt ARGUMENTS`."""
    return main([str(word) for word in request["arguments"]])


if __name__ == "__main__":
    serve(handle)
