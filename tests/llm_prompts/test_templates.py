"""Templates and what is made of them without a model: true to the notes, deterministic, bounded, free of repetition."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsopt.errors import InputError, UsageError
from gsopt.llm_prompts.deduplicate import is_similar
from gsopt.llm_prompts.expand import (
    MIN_PROMPTS_WITH_SIDES,
    SIDES,
    PromptSpec,
    expand,
    expert_prompt,
    fill_with_template,
    slot_of,
)
from gsopt.llm_prompts.subject import content_words, find_object, names_object, with_article
from gsopt.llm_prompts.templates import DOMAINS, fill, load_template
from gsopt.llm_prompts.tokens import ESTIMATED_COUNTER, MAX_TOKENS
from gsopt.sds.prompts import Prompt

NOTES = st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs")), min_size=1, max_size=300)


@pytest.mark.parametrize(
    ("notes", "noun"),
    [
        ("femur, osteoporotic, CT", "femur"),
        ("Worn oak kitchen chair with one broken rung", "chair"),
        ("a flat stone from a river", "stone"),
        ("bones of a cow", "bones"),
        ("a 1950s radio", "radio"),
        ("the chair", "chair"),
        ("X-ray tube (old)", "tube"),
        ("zwei alte Stühle", "stühle"),
    ],
)
def test_the_object_is_the_noun_of_the_first_phrase(notes: str, noun: str) -> None:
    assert find_object(notes) == noun


@pytest.mark.parametrize("notes", ["...", "12 3", "the of", "!?"])
def test_notes_without_an_object_ask_for_a_category(notes: str) -> None:
    with pytest.raises(UsageError, match="--category"):
        find_object(notes)


@pytest.mark.parametrize(
    ("text", "noun", "keeps"),
    [
        ("Two Chairs of oak", "chair", True),
        ("an armchair of oak", "chair", False),
        ("a chairman", "chair", False),
        ("berries on a plate", "berry", True),
        ("a glass box", "boxes", True),
        ("the knee joint, worn", "knee joint", True),
        ("a joint of the knee", "knee joint", True),
        ("a pelvis seen whole", "pelvis", True),
    ],
)
def test_a_text_keeps_the_noun_in_either_number(text: str, noun: str, keeps: bool) -> None:
    assert names_object(text, noun) == keeps


def test_articles_fit_the_noun() -> None:
    nouns = ("chair", "oak chair", "bones", "glass", "the skull", "pelvis")
    assert [with_article(noun) for noun in nouns] == [
        "a chair", "an oak chair", "bones", "a glass", "the skull", "a pelvis",
    ]  # fmt: skip


@pytest.mark.parametrize("domain", DOMAINS)
@settings(max_examples=25, deadline=None)
@given(notes=NOTES, n=st.integers(1, 12))
def test_whatever_the_notes_the_template_gives_valid_distinct_prompts(domain: str, notes: str, n: int) -> None:
    spec = PromptSpec(notes, "chair", n, 3)
    template = load_template(domain)
    prompts = expand(template, spec, ESTIMATED_COUNTER)
    assert prompts == expand(template, spec, ESTIMATED_COUNTER)
    assert {prompt.source for prompt in prompts} == {"template"}
    assert all(prompt.rationale for prompt in prompts)
    for i, prompt in enumerate(prompts):
        for other in prompts[:i]:
            overlap = "all" in (prompt.view, other.view) or prompt.view == other.view
            assert prompt.polarity != other.polarity or not overlap or not is_similar(prompt.text, other.text)
    fitting = [prompt for prompt in prompts if prompt.text.count(notes.strip()) == 0 or len(notes) < 60]
    assert all(ESTIMATED_COUNTER.count(prompt.text) <= MAX_TOKENS for prompt in fitting)


@pytest.mark.parametrize("domain", DOMAINS)
@pytest.mark.parametrize("n", [1, 2, MIN_PROMPTS_WITH_SIDES - 1, MIN_PROMPTS_WITH_SIDES, 8, 12])
def test_as_many_prompts_as_wished_one_for_each_side_when_there_is_room(domain: str, n: int) -> None:
    prompts = expand(load_template(domain), PromptSpec("worn oak chair", "chair", n, 3), ESTIMATED_COUNTER)
    positive = [prompt for prompt in prompts if prompt.polarity == "positive"]
    assert len(positive) == n
    assert len(prompts) - n == 3
    assert {p.view for p in positive if p.view != "all"} == (set(SIDES) if n >= MIN_PROMPTS_WITH_SIDES else set())
    assert all(names_object(prompt.text, "chair") for prompt in positive)


def test_what_the_template_knows_about_a_word_is_said_where_the_word_is_and_nowhere_else() -> None:
    template = load_template("medicine")

    def said(notes: str) -> str:
        return " ".join(
            prompt.text for prompt in expand(template, PromptSpec(notes, find_object(notes), 8, 0), ESTIMATED_COUNTER)
        )

    assert "thinned cortex" in said("femur, osteoporotic")
    assert "thinned cortex" not in said("femur")
    assert "linea aspera" in said("femur")
    assert "linea aspera" not in said("thigh")


def test_what_the_notes_deny_is_not_said() -> None:
    template = load_template("robotics")

    def said(notes: str) -> str:
        prompts = expand(template, PromptSpec(notes, "chair", 12, 0), ESTIMATED_COUNTER)
        return " ".join(prompt.text.replace(notes, "") for prompt in prompts)

    assert "armrests" in said("chair with arms")
    assert "armrests" not in said("chair without arms")
    assert "backrest" in said("chair, oak")
    assert "backrest" not in said("chair, no backrest, oak")
    assert "wood grain" in said("chair, no backrest, oak")


def test_negatives_never_deny_the_notes() -> None:
    template = load_template("environment")
    for notes in ("stone in water", "stone with grass", "polished stone"):
        negatives = [
            p for p in expand(template, PromptSpec(notes, "stone", 1, 9), ESTIMATED_COUNTER) if p.polarity == "negative"
        ]
        assert negatives
        assert not any(content_words(prompt.text) & content_words(notes) - {"stone"} for prompt in negatives)


def test_long_notes_are_shortened_clause_by_clause_to_what_clip_reads() -> None:
    notes = "chair, " + ", ".join(f"detail number {i} of the wood" for i in range(60))
    for prompt in expand(load_template("generic"), PromptSpec(notes, "chair", 8, 0), ESTIMATED_COUNTER):
        assert ESTIMATED_COUNTER.count(prompt.text) <= MAX_TOKENS


def test_slots_in_the_notes_are_not_filled_again() -> None:
    assert fill("{notes} {object}", {"notes": "{object} {notes}", "object": "x"}) == "{object} {notes} x"


def test_the_experts_words_come_first_and_as_they_are() -> None:
    assert expert_prompt(PromptSpec(" femur,\n osteoporotic ", "femur", 8, 0)).text == "femur, osteoporotic"
    assert expert_prompt(PromptSpec("femur", "femur", 8, 0)).source == "user"


def test_what_a_model_left_out_is_filled_up_slot_by_slot() -> None:
    spec = PromptSpec("worn oak chair", "chair", 6, 2)
    made = (Prompt("a chair from behind, three slats", view="back", source="llm:m"),)
    prompts = fill_with_template(made, load_template("generic"), spec, ESTIMATED_COUNTER)
    assert prompts[0] == made[0]
    counts = {slot: sum(slot_of(p) == slot for p in prompts) for slot in spec.slots}
    assert counts == spec.slots
    assert {prompt.source for prompt in prompts[1:]} == {"template"}


OWN = """---
name: pottery
title: ancient pottery
extends: environment
---
A comment.

# Phrases

- an excavated vessel on black velvet,
  lit from the left: {notes}

# Words

- amphora => two handles and a narrow neck
- amphora @top => a flat ring-shaped lip
"""


def test_a_users_template_is_one_file_that_adds_to_what_it_extends(tmp_path: Path) -> None:
    path = tmp_path / "pottery.md"
    path.write_text(OWN, encoding="utf-8")
    own, base = load_template(str(path)), load_template("environment")
    assert own.lists["phrases"] == (
        "an excavated vessel on black velvet, lit from the left: {notes}",
        *base.lists["phrases"],
    )
    assert own.system == base.system
    texts = [prompt.text for prompt in expand(own, PromptSpec("amphora", "amphora", 6, 0), ESTIMATED_COUNTER)]
    assert "an amphora, two handles and a narrow neck" in texts
    assert "an amphora, a flat ring-shaped lip" in texts


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (("---\nname", "name"), "front matter"),
        (("title: ancient pottery\n", ""), "title"),
        (("extends: environment", "extends: nothing"), "extends"),
        (("extends: environment", "author: me"), "author"),
        (("# Phrases", "# Phrase"), "# Phrase"),
        (("# Words", "# Phrases"), "twice"),
        (("- an excavated", "an excavated"), "dash"),
        (("{notes}", "{prompt}"), "{prompt}"),
        (("@top", "@below"), "@below"),
        (("=> two", "two"), "Words"),
        (("A comment.", "x" * (300 << 10)), "larger"),
        (("A comment.", "\udcff"), "utf-8"),
    ],
)
def test_a_broken_template_is_refused_by_name(tmp_path: Path, change: tuple[str, str], named: str) -> None:
    path = tmp_path / "own.md"
    path.write_bytes(OWN.replace(*change, 1).encode("utf-8", "surrogateescape"))
    with pytest.raises(InputError, match=r"own\.md") as caught:
        load_template(str(path))
    assert named in str(caught.value)


def test_an_unknown_domain_lists_those_there_are() -> None:
    with pytest.raises(UsageError, match="environment"):
        load_template("geology")
