"""Every input that a fuzzing campaign kept still keeps its reader's law (`make fuzz` finds new ones)."""

from __future__ import annotations

from pathlib import Path

import pytest
from targets import TARGETS, place, seeds_of

CORPUS = Path(__file__).resolve().parent.parent / "corpus"


def kept(name: str) -> list[bytes]:
    return [path.read_bytes() for path in sorted((CORPUS / name.replace(" ", "_")).glob("*"))]


@pytest.mark.parametrize("name", TARGETS)
def test_inputs_that_were_kept_are_read_or_refused(name: str, tmp_path: Path) -> None:
    target = TARGETS[name]
    path = place(target, tmp_path)
    for data in (*seeds_of(target), *kept(name)):
        path.write_bytes(data)
        target.law(path)


def test_the_corpus_is_of_these_targets_and_stays_small() -> None:
    kept_of = {folder.name for folder in CORPUS.iterdir()}
    assert len(kept_of) > 20
    assert kept_of <= {name.replace(" ", "_") for name in TARGETS}
    assert sum(path.stat().st_size for path in CORPUS.rglob("*") if path.is_file()) < 2_000_000
