"""Markdown tables, and the blocks of a document that come from measurements."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gsopt.errors import InputError
from gsopt.events import write_atomic


def replace_block(path: Path, name: str, body: str) -> None:
    """Writes `body` between `<!-- begin NAME -->` and `<!-- end NAME -->` of a text file."""
    begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror}. Give the folder that holds the documents.") from error
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise InputError(f"{path} has no pair of lines {begin} and {end}. Restore them where the table belongs.")
    before, after = text[: text.index(begin) + len(begin)], text[text.index(end) :]
    write_atomic(path, f"{before}\n{body.rstrip()}\n{after}".encode())


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
