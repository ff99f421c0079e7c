"""The estimate of token counts against CLIP's own vocabulary.

Opt-in: GSOPT_CLIP_BPE names bpe_simple_vocab_16e6.txt.gz, which the PyPI package open_clip_torch carries (MIT).
"""

from __future__ import annotations

import gzip
import json
import os
import re
from pathlib import Path

import pytest

from gsopt.llm_prompts.tokens import counter_for, estimate_tokens

FILE = os.environ.get("GSOPT_CLIP_BPE", "")
pytestmark = pytest.mark.skipif(not FILE, reason="opt-in: GSOPT_CLIP_BPE")
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def true_count(tmp_path_factory: pytest.TempPathFactory):
    """Counts with vocab.json and merges.txt made from the file, as Radford et al. 2021 build them."""
    pytest.importorskip("tokenizers")
    lines = gzip.decompress(Path(FILE).read_bytes()).decode("utf-8").split("\n")
    merges = lines[1 : 49_152 - 256 - 2 + 1]
    letters = [*range(33, 127), *range(161, 173), *range(174, 256)]
    extra = [byte for byte in range(256) if byte not in letters]
    alphabet = [chr(code) for code in letters] + [chr(256 + i) for i in range(len(extra))]
    words = alphabet + [letter + "</w>" for letter in alphabet] + ["".join(merge.split()) for merge in merges]
    words += ["<|startoftext|>", "<|endoftext|>"]
    assert len(words) == 49_408
    folder = tmp_path_factory.mktemp("clip") / "tokenizer"
    folder.mkdir()
    (folder / "vocab.json").write_text(json.dumps({word: i for i, word in enumerate(words)}), encoding="utf-8")
    (folder / "merges.txt").write_text("#version: 0.2\n" + "\n".join(merges), encoding="utf-8")
    (folder / "tokenizer_config.json").write_text("{}")
    return counter_for(folder.parent).count


def sentences(files: list[Path]) -> list[str]:
    text = "\n".join(file.read_text(encoding="utf-8") for file in files)
    return [part.strip() for part in re.split(r"[.\n;|]", text) if 15 < len(part.strip()) < 300]


def test_known_counts(true_count) -> None:
    assert true_count("a photo of a chair") == 7
    assert true_count("") == 2


def test_the_estimate_is_hardly_ever_too_low(true_count) -> None:
    """On the templates' phrases, the texts this is for, and on all of docs/, much of which is code."""
    templates = sentences(sorted((ROOT / "gsopt" / "llm_prompts" / "templates").glob("*.md")))
    docs = sentences(sorted((ROOT / "docs").rglob("*.md")))
    for texts, most_too_low in ((templates, 0.0), (docs, 0.005)):
        ratios = [estimate_tokens(text) / true_count(text) for text in texts]
        too_low = sum(ratio < 1 for ratio in ratios)
        print(f"{len(texts)} texts, {too_low} too low, mean ratio {sum(ratios) / len(ratios):.2f}")
        assert too_low <= most_too_low * len(texts)
