"""A worker that runs verbs: `python -m gsopt.cli.serve_jobs` answers {"arguments": [...]} with the exit code.

With {"picture_of": RUN, "picture": FILE} it also draws the picture of a run that has finished.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsopt.cli import main
from gsopt.farm.serve import serve


def handle(request: Mapping[str, Any]) -> int:
    """Runs `gsopt ARGUMENTS`."""
    code = main([str(word) for word in request["arguments"]])
    if code == 0 and "picture" in request and (Path(request["picture_of"]) / "metrics.json").is_file():
        from gsopt.many_scenes.page import write_picture

        write_picture(Path(request["picture_of"]), Path(request["picture"]))
    return code


if __name__ == "__main__":
    serve(handle)
