"""`gsopt prompts review`: go through a prompts.json, accept, edit, reject."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from tyro.conf import Positional, arg

from gsopt.errors import UsageError

if TYPE_CHECKING:
    from gsopt.sds.prompts import PromptSet


@dataclass(frozen=True)
class Flags:
    """Go through the prompts and pictures of a file one by one; it is written when all are decided."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """A prompts.json."""


def main(argv: Sequence[str]) -> int:
    """Review a file; the exit code."""
    from gsopt.sds.prompts import read_set

    flags = tyro.cli(Flags, prog="gsopt prompts review", args=list(argv))
    return review_file(flags.file, read_set(flags.file))


def review_file(path: Path, everything: PromptSet) -> int:
    """Ask about every prompt, then replace the file. UsageError when it is left before the end: nothing is changed."""
    from gsopt.llm_prompts.review import ReviewAborted, review
    from gsopt.sds.prompts import write_set

    try:
        reviewed = review(everything, input, print)
    except ReviewAborted as left:
        raise UsageError(
            f"The review was left before its end; {path} is as it was. Start again: gsopt prompts review {path}"
        ) from left
    write_set(path, reviewed)
    accepted = sum(picture.accepted for picture in reviewed.images)
    pictures = f", {accepted} of {len(reviewed.images)} pictures" if reviewed.images else ""
    print(f"{path}: {len(reviewed.prompts)} of {len(everything.prompts)} prompts accepted{pictures}")
    return 0
