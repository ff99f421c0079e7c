"""prompts.json: what is written is read back, and what breaks the schema is refused by name."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import json_schema
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsopt.errors import InputError
from gsopt.sds import prompts as schema
from gsopt.sds.prompts import (
    MAX_FILE_BYTES,
    MAX_PROMPTS,
    Prompt,
    PromptSet,
    Provenance,
    ReferenceImage,
    accepted_images,
    prompts_from,
    read_prompts,
    read_set,
    set_document,
    set_from,
    write_prompts,
    write_set,
)

COMMITTED = json.loads(Path(schema.__file__).with_name("prompts.schema.json").read_text(encoding="utf-8"))

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
SETS = st.builds(
    PromptSet,
    prompts=PROMPTS.map(tuple),
    notes=st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs")), max_size=60),
    object=TEXT,
    domain=st.sampled_from(["", "medicine", "my own"]),
    reviewed=st.booleans(),
    made=st.none()
    | st.builds(Provenance, source=st.just("llm:m"), raw=st.just("prompts.raw.json"), warnings=st.just(("w",))),
    images=st.lists(st.builds(ReferenceImage, file=st.just("images/1.png"), prompt=TEXT, accepted=st.booleans())).map(
        tuple
    ),
)


@settings(max_examples=40, deadline=None)
@given(prompts=PROMPTS)
def test_written_and_read_is_the_identity(tmp_path_factory: pytest.TempPathFactory, prompts: list[Prompt]) -> None:
    path = tmp_path_factory.mktemp("prompts") / "prompts.json"
    write_prompts(path, prompts)
    assert read_prompts(path) == tuple(prompts)


@settings(max_examples=40, deadline=None)
@given(everything=SETS)
def test_a_whole_file_is_read_as_written_and_follows_the_committed_schema(
    tmp_path_factory: pytest.TempPathFactory, everything: PromptSet
) -> None:
    path = tmp_path_factory.mktemp("prompts") / "prompts.json"
    write_set(path, everything)
    assert read_set(path) == everything
    assert json_schema.is_valid(json.loads(path.read_text(encoding="utf-8")), COMMITTED)


def test_the_committed_schema_has_the_fields_of_the_records() -> None:
    records = {"prompt": Prompt, "image": ReferenceImage, "made": Provenance}
    for name, kind in records.items():
        assert set(COMMITTED["$defs"][name]["properties"]) == {field.name for field in dataclasses.fields(kind)}
    assert set(COMMITTED["properties"]) == {"version"} | {field.name for field in dataclasses.fields(PromptSet)}


def test_defaults_in_the_committed_schema_are_those_of_the_records() -> None:
    minimal = {"version": 1, "prompts": [{"text": "a"}], "images": [{"file": "a.png"}], "made": {"source": "user"}}
    document = set_document(set_from(minimal))
    for written, properties in (
        (document, COMMITTED["properties"]),
        (document["prompts"][0], COMMITTED["$defs"]["prompt"]["properties"]),
        (document["images"][0], COMMITTED["$defs"]["image"]["properties"]),
    ):
        defaults = {name: inner["default"] for name, inner in properties.items() if "default" in inner}
        left_out = {name: value for name, value in defaults.items() if name not in minimal}
        assert {name: written[name] for name in left_out} == left_out


def test_only_accepted_images_are_given_out(tmp_path: Path) -> None:
    path = tmp_path / "prompts.json"
    write_set(path, PromptSet(images=(ReferenceImage("a.png"), ReferenceImage("pictures/b.png", accepted=True))))
    assert accepted_images(path) == (tmp_path / "pictures" / "b.png",)


@pytest.mark.parametrize(
    "more",
    [
        {"promts": []},
        {"notes": 5},
        {"notes": "x" * 5000},
        {"reviewed": 1},
        {"object": None},
        {"made": []},
        {"made": {}},
        {"made": {"source": "me"}},
        {"made": {"source": "user", "warnings": "w"}},
        {"made": {"source": "user", "raw": "../x"}},
        {"images": {}},
        {"images": [{"file": "../a.png"}]},
        {"images": [{"file": "/etc/a.png"}]},
        {"images": [{"file": "a/b/c.png"}]},
        {"images": [{"file": "../.. /c.png"}]},
        {"images": [{"file": " /c.png"}]},
        {"images": [{"file": "C:\\a.png"}]},
        {"images": [{"file": "a.png\n"}]},
        {"images": [{"file": "a.png", "accepted": "yes"}]},
        {"images": [{"file": "a.png"}] * 65},
        {"version": True},
    ],
    ids=lambda more: str(more)[:60],
)
def test_records_and_committed_schema_refuse_the_same(more: dict[str, Any]) -> None:
    document = {"version": 1, "prompts": [{"text": "a"}], **more}
    assert not json_schema.is_valid(document, COMMITTED)
    with pytest.raises(InputError):
        set_from(document)


@pytest.mark.parametrize(
    "name", ["a.png", "my prompts-images/001.png", "st\u00fchle.raw.json", "_a-b/c.d.png", "\u6625/1.png"]
)
def test_files_may_have_the_names_that_people_give(name: str) -> None:
    document = {"version": 1, "prompts": [{"text": "a"}], "images": [{"file": name}]}
    assert json_schema.is_valid(document, COMMITTED)
    assert set_from(document).images[0].file == name


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
        ({"text": "a", "weight": 10**400}, "`weight`"),
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
    beyond_json_schema = "control" in named or "nan" in str(prompt)
    assert beyond_json_schema or not json_schema.is_valid({"version": 1, "prompts": [prompt]}, COMMITTED)


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("", "prompts.json"),
        ("[]", "prompts"),
        ('{"version": 1}', "prompts"),
        ('{"version": 2, "prompts": []}', "Version 2"),
        ("[" * 100_000, "prompts.json"),
        (json.dumps({"version": 1, "prompts": [{"text": "a"}] * (MAX_PROMPTS + 1)}), str(MAX_PROMPTS)),
        (" " * (MAX_FILE_BYTES + 1), "larger"),
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
