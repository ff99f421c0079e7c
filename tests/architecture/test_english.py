"""English of the house: American spelling, no docstring sentence that opens with a fragment (docs/conventions.md)."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

SHIPPED = ("gsopt", "scripts", "blender_addon")
FRAGMENTS = re.compile(
    r"(?:Of|What|Where|Whether|How|Whose|None|So many|So much|From where|From what|By how|Which|That|When)\b"
)
BRITISH = re.compile(
    r"\b\w*(?:colour|centre(?!d?\w*=)|neighbour|behaviour|favour|honour|modell(?:ed|ing)|labell(?:ed|ing)|travell(?:ed|ing)|"
    r"(?:optim|regular|normal|minim|maxim|initial|quant|raster|serial|real|organ|recogn|summar|visual)is(?:e|ed|es|ing|er|ation)\b|"
    r"catalogue|analyse)\w*|\bgrey\b|\blicence\b|\bmetres?\b",
    re.IGNORECASE,
)
FOREIGN = {"rasterise", "rasterised"}
"""Names that a test expects not to exist."""


def sentences(text: str) -> Iterator[str]:
    """Sentences, and clauses after a colon or semicolon that begin with a capital."""
    parts = re.split(r"(?<=[.:;!?])\s+", " ".join(text.split()))
    yield from (part for i, part in enumerate(parts) if i == 0 or part[:1].isupper())


def fragments(source: str) -> Iterator[str]:
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Expr(value=ast.Constant(value=str(text))):
                yield from (f"{node.lineno}: {part[:60]}" for part in sentences(text) if FRAGMENTS.match(part))


def british(text: str) -> Iterator[str]:
    for number, line in enumerate(text.splitlines(), 1):
        yield from (f"{number}: {word[0]}" for word in BRITISH.finditer(line) if word[0] not in FOREIGN)


def prose(page: str) -> str:
    """A Markdown page without its blocks of code: these quote what others typed."""
    return re.sub(r"```.*?```", "", page, flags=re.DOTALL)


def faults(files: list[Path], root: Path, rule, read=str) -> list[str]:
    texts = ((file, read(file.read_text(encoding="utf-8"))) for file in files)
    return [f"{file.relative_to(root)}:{fault}" for file, text in texts for fault in rule(text)]


def test_no_sentence_of_a_docstring_opens_with_a_fragment(root: Path, tracked: list[Path]) -> None:
    shipped = [file for file in tracked if file.suffix == ".py" and file.relative_to(root).parts[0] in SHIPPED]
    assert faults(shipped, root, fragments) == []


def test_code_and_documents_have_american_spelling(root: Path, tracked: list[Path]) -> None:
    here = Path(__file__)
    code = [file for file in tracked if file.suffix in {".py", ".h", ".cpp"} and file != here]
    pages = [file for file in tracked if file.suffix == ".md" and "templates" not in file.parts]
    assert faults(code, root, british) == []
    assert faults(pages, root, british, prose) == []


def test_a_fragment_and_a_british_word_are_noticed() -> None:
    assert list(fragments('"""What a step minimizes."""')) != []
    assert list(fragments('def f():\n    """Returns x. Whose rows: Of every pixel."""')) != []
    assert list(fragments('"""Returns what is left; when done, 0."""')) == []
    for word in ("colour", "centre", "neighbouring", "optimised", "behaviour", "grey", "modelled"):
        assert list(british(f"the {word} of it")) != []
    for word in ("color", "center", "optimistic", "precise", "raised", "noise", "parameter", "kilometer", "realistic"):
        assert list(british(f"the {word} of it")) == []
