"""`gsopt prompts`: turns an expert's notes into the prompts that guide a reconstruction."""

from __future__ import annotations

import importlib
from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """Run `gsopt prompts`, `gsopt prompts review` or `gsopt prompts compare`; the exit code."""
    given = argv[0] if argv else ""
    name, rest = (given, argv[1:]) if given in ("review", "compare") else ("generate", argv)
    code: int = importlib.import_module(f"gsopt.cli.prompts.{name}").main(rest)
    return code
