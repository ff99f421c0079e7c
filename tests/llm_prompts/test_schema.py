"""prompts.json: what is written is read back, and what breaks the schema is refused by name."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsopt.errors import InputError
from gsopt.llm_prompts.schema import LARGEST_FILE, MOST_PROMPTS, Prompt, prompts_from, read_prompts, write_prompts

TEXT = st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs")), min_size=1, max_size=60).filter(str.strip)
PROMPTS = st.lists(
    st.builds(
        Prompt,
        text=TEXT,
        weight=st.floats(0, 1000),
        view=st.sampled_from(["all", "front", "side", "back", "top"]),
        polarity=st.sampled_from(["positive", "negative"]),
        source=st.sampled_from(["user", "template", "llm:tiny/model-1.0"]),
        rationale=TEXT,
        score=st.none() | st.floats(-1, 1),
    ),
    max_size=5,
)


@settings(max_examples=40, deadline=None)
@given(prompts=PROMPTS)
def test_written_and_read_is_the_identity(tmp_path_factory: pytest.TempPathFactory, prompts: list[Prompt]) -> None:
    path = tmp_path_factory.mktemp("prompts") / "prompts.json"
    write_prompts(path, prompts)
    assert read_prompts(path) == tuple(prompts)


def test_only_the_text_is_needed() -> None:
    assert prompts_from({"version": 1, "prompts": [{"text": "a chair 🪑"}]}) == (Prompt("a chair 🪑"),)


@pytest.mark.parametrize(
    ("prompt", "named"),
    [
        ({"text": ""}, "empty"),
        ({"text": " \n "}, "empty"),
        ({"text": "x" * 10_000}, "10000"),
        ({"text": "a\x1b[31mchair"}, "control character"),
        ({"text": 5}, "`text`"),
        ({"text": "a", "weight": "much"}, "`weight`"),
        ({"text": "a", "weight": -1}, "`weight`"),
        ({"text": "a", "weight": float("nan")}, "`weight`"),
        ({"text": "a", "weight": True}, "`weight`"),
        ({"text": "a", "view": "below"}, "`view`"),
        ({"text": "a", "view": []}, "`view`"),
        ({"text": "a", "polarity": "maybe"}, "`polarity`"),
        ({"text": "a", "source": "gpt"}, "`source`"),
        ({"text": "a", "source": "llm:<b>"}, "`source`"),
        ({"text": "a", "score": 2}, "`score`"),
        ({"text": "a", "wieght": 1}, "wieght"),
        ({"weight": 1}, "text"),
        ("a chair", "text"),
    ],
)
def test_a_prompt_that_breaks_the_schema_is_named(prompt: object, named: str) -> None:
    with pytest.raises(InputError, match="Prompt 1") as caught:
        prompts_from({"version": 1, "prompts": [{"text": "a chair"}, prompt]})
    assert named in str(caught.value)


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("", "prompts.json"),
        ("[]", "prompts"),
        ('{"version": 1}', "prompts"),
        ('{"version": 2, "prompts": []}', "Version 2"),
        ("[" * 100_000, "prompts.json"),
        (json.dumps({"version": 1, "prompts": [{"text": "a"}] * (MOST_PROMPTS + 1)}), str(MOST_PROMPTS)),
        (" " * (LARGEST_FILE + 1), "larger"),
    ],
)
def test_a_file_that_breaks_the_schema_is_named(tmp_path: Path, content: str, named: str) -> None:
    path = tmp_path / "prompts.json"
    path.write_text(content)
    with pytest.raises(InputError, match=r"prompts\.json") as caught:
        read_prompts(path)
    assert named in str(caught.value)


def test_a_file_that_is_not_there_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="absent"):
        read_prompts(tmp_path / "absent.json")
