"""Every answer of a server ends in valid prompts that say who wrote them, or in one clear error; the docs list them."""

from __future__ import annotations

import json
import os
from collections import Counter
from pathlib import Path

import json_schema
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reply_cases import CASES, GOOD, KEY, LLM, VALID, Case
from scripted_server import Says, completion, error, free_port, serving

from gsopt import cli
from gsopt.errors import GsoptError, UsageError
from gsopt.llm_prompts import client
from gsopt.llm_prompts.client import connect, find_key, read_url
from gsopt.llm_prompts.reply import LISTED
from gsopt.sds import prompts
from gsopt.sds.prompts import read_set

pytest.importorskip("pydantic", reason="needs the extra gsopt[llm]")

PAGE = Path(__file__).resolve().parents[2] / "docs" / "howto" / "prompts.md"
COMMITTED = json.loads(Path(prompts.__file__).with_name("prompts.schema.json").read_text(encoding="utf-8"))
REPLY = [entry["text"] for entries in GOOD.values() for entry in entries]
NOTES = ["--notes", "worn oak chair", "-n", "2", "--negatives", "1"]


@pytest.fixture(autouse=True)
def key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(client.KEY_VARIABLE, KEY)
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)


def run(folder: Path, url: str, *more: str, timeout: str = "300") -> int:
    output = ["-o", str(folder / "prompts.json")]
    return cli.main(["prompts", *NOTES, "--llm", url, "--model", "tiny", "--timeout", timeout, *output, *more])


def ended(folder: Path, code: int, err: str, url: str) -> str:
    """In the words of the table."""
    if code:
        return "error: " + err.removeprefix("gsopt: ").replace(url, "URL")
    sources = Counter(p.source for p in read_set(folder / "prompts.json").prompts if p.source != "user")
    return ", ".join(f"{count} {source}" for source, count in sorted(sources.items()))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.does)
def test_an_answer_ends_in_valid_prompts_or_in_a_clear_error(tmp_path: Path, capsys, case: Case) -> None:
    slow = any(entry.wait or entry.drip for entry in case.script)
    with serving(case.script) as server:
        code = run(tmp_path, server.url, timeout="1" if slow else "300")
        out, err = capsys.readouterr()
    found = ended(tmp_path, code, err, server.url)
    assert found.startswith(case.ends) if code else found == case.ends
    assert "Traceback" not in err
    written = tmp_path / "prompts.json"
    assert written.exists() == (code == 0)
    if case.ends == LLM:  # the reply itself, no draft and no example before it
        assert [p.text for p in read_set(written).prompts if p.source == LLM.split()[1]] == REPLY
    if code == 0:
        assert json_schema.is_valid(json.loads(written.read_text(encoding="utf-8")), COMMITTED)
    everything = out + err + "".join(file.read_text(encoding="utf-8") for file in tmp_path.iterdir())
    assert KEY not in everything
    assert "\x1b" not in everything
    assert len(err) < 3000


def test_the_docs_list_exactly_these_cases() -> None:
    rows = [f"| {case.does} | `{case.ends}` |" for case in CASES]
    page = PAGE.read_text(encoding="utf-8")
    if os.environ.get("GSOPT_WRITE_DOCS"):
        begin, end = page.index("<!-- replies -->"), page.index("<!-- end of replies -->")
        table = "\n".join(["<!-- replies -->", "| The server answers with | It ends in |", "|---|---|", *rows, ""])
        page = page[:begin] + table + page[end:]
        PAGE.write_text(page, encoding="utf-8")
    listed = [line for line in page[page.index("<!-- replies -->") :].splitlines() if line.startswith("| ")]
    assert listed[1:] == rows


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(["choices", "message", "content", "error", "usage", "prompt_tokens", "text"]),
            inner,
            max_size=3,
        )
    ),
    max_leaves=8,
)


@settings(max_examples=80, deadline=None)
@given(
    body=st.binary(max_size=80) | JSON.map(json.dumps).map(str.encode),
    status=st.sampled_from([200, 201, 204, 299, 300, 400, 418, 500, 599]),
    announced=st.none() | st.integers(0, 100),
)
def test_any_bytes_are_an_answer_or_a_refusal(body: bytes, status: int, announced: int | None) -> None:
    with serving([Says(body, status, announced=announced)]) as server:
        try:
            said = client.chat(connect(server.url, "tiny", 60.0, {}), {"messages": []}).finish
        except client.ServerError as refusal:
            said = str(refusal)
    assert said.isprintable()
    assert len(said) < 1000


def test_a_fallback_is_named_template_and_says_why(tmp_path: Path, capsys) -> None:
    with serving([completion("no")]) as server:
        assert run(tmp_path, server.url, "--fallback") == 0
    made = read_set(tmp_path / "prompts.json")
    assert {prompt.source for prompt in made.prompts} == {"user", "template"}
    assert made.made is not None
    assert "nothing that can be used" in made.made.warnings[0]
    assert "nothing that can be used" in capsys.readouterr().out


@pytest.mark.parametrize("fallback", [False, True])
def test_a_server_that_is_not_there(tmp_path: Path, capsys, fallback: bool) -> None:
    url = f"http://127.0.0.1:{free_port()}/v1"
    code = run(tmp_path, url, *(["--fallback"] if fallback else []))
    assert code == (0 if fallback else 3)
    assert f"No usable answer came from {url}" in "".join(capsys.readouterr())
    assert (tmp_path / "prompts.json").exists() == fallback


def test_what_the_model_said_is_kept_beside_the_prompts(tmp_path: Path, capsys) -> None:
    answer = 'Voilà \x1b[31m {"all": [], "negative": []}'
    with serving([completion(answer), VALID]) as server:
        assert run(tmp_path, server.url, "--price", "1,2") == 0
    raw = tmp_path / "prompts.raw.json"
    assert raw.read_bytes().isascii()
    record = json.loads(raw.read_bytes())
    assert [each["answer"] for each in record["rounds"]] == [answer, json.dumps(GOOD)]
    assert "worn oak chair" in record["rounds"][0]["asked"]
    made = read_set(tmp_path / "prompts.json").made
    assert made is not None
    assert (made.source, made.raw) == ("llm:tiny", "prompts.raw.json")
    assert "2 answers, 200 tokens in, 40 out" in (out := capsys.readouterr().out)
    assert "cost 0.0003" in out


def test_at_most_two_repairs_and_each_names_what_was_wrong(tmp_path: Path) -> None:
    with serving([completion('{"all": ["a cat on a mat"]}')]) as server:
        assert run(tmp_path, server.url) == 3
    assert len(server.asked) == 3
    for request in server.asked[1:]:
        assert 'does not name the object "chair"' in request["body"]["messages"][-1]["content"]
        assert len(request["body"]["messages"]) == 4


def test_structured_output_is_asked_for_with_the_schema_of_what_is_wanted(tmp_path: Path) -> None:
    with serving([VALID]) as server:
        assert run(tmp_path, server.url) == 0
    body = server.asked[0]["body"]
    wanted = body["response_format"]["json_schema"]["schema"]
    assert json_schema.is_valid(GOOD, wanted)
    assert not json_schema.is_valid({**GOOD, "front": []}, wanted)
    assert server.asked[0]["headers"]["Authorization"] == f"Bearer {KEY}"
    assert server.asked[0]["path"] == "/v1/chat/completions"


def test_for_a_library_the_model_is_asked_for_kind_material_parts_and_proportions(tmp_path: Path) -> None:
    with serving([VALID]) as server:
        assert run(tmp_path, server.url) == 0
        assert run(tmp_path, server.url, "--prior", "library", "--force") == 0
    plain, asked = (request["body"]["messages"][1]["content"] for request in server.asked)
    for wanted in ("kind of thing is a chair", "made of, in one word", "parts stand out", "typical proportions"):
        assert wanted in asked
        assert wanted not in plain


@pytest.mark.parametrize("thought", [None, "", "<think>The chair"])
def test_a_model_that_spent_all_on_its_thoughts_gets_more_room(tmp_path: Path, thought: str | None) -> None:
    with serving([completion(thought, "length"), VALID]) as server:
        assert run(tmp_path, server.url) == 0
    first, second = (request["body"]["max_tokens"] for request in server.asked)
    assert second == 4 * first


def test_pictures_go_to_a_server_that_takes_them_and_are_left_out_where_not(tmp_path: Path, photo: Path) -> None:
    with serving([VALID]) as server:
        assert run(tmp_path, server.url, "--images", str(photo)) == 0
    parts = server.asked[0]["body"]["messages"][1]["content"]
    assert [part["type"] for part in parts] == ["text", "image_url"]
    assert parts[1]["image_url"]["url"].startswith("data:image/jpeg;base64,/9j/")
    picky = type(VALID)(VALID.body, only_without="image_url")
    with serving([picky]) as server:
        assert run(tmp_path, server.url, "--images", str(photo), "--force") == 0
    assert isinstance(server.asked[0]["body"]["messages"][1]["content"], str)
    made = read_set(tmp_path / "prompts.json").made
    assert made is not None
    assert any("with pictures" in warning for warning in made.warnings)
    assert "base64" not in (tmp_path / "prompts.raw.json").read_text()


def test_the_only_model_of_a_server_is_taken_and_a_choice_is_left_to_the_user(tmp_path: Path, capsys) -> None:
    arguments = ["prompts", *NOTES, "-o", str(tmp_path / "prompts.json"), "--llm"]
    listing = completion("")
    listing.body = b'{"data": [{"id": "only/one"}]}'
    with serving([listing, VALID]) as server:
        assert cli.main([*arguments, server.url]) == 0
    assert server.asked[0]["path"] == "/v1/models"
    assert "llm:only/one" in (tmp_path / "prompts.json").read_text()
    listing.body = b'{"data": [{"id": "a"}, {"id": "b\\u001b[1m"}]}'
    with serving([listing]) as server:
        assert cli.main([*arguments, server.url, "--force"]) == 2
    assert "It lists: a, b[1m." in capsys.readouterr().err


def test_a_refused_repair_keeps_what_is_there(tmp_path: Path) -> None:
    with serving([completion('["a worn oak chair with arms"]'), error(401, "expired")]) as server:
        assert run(tmp_path, server.url) == 0
    made = read_set(tmp_path / "prompts.json")
    assert [p.source for p in made.prompts].count("llm:tiny") == 1
    assert made.made is not None
    assert any("expired" in warning for warning in made.made.warnings)


@pytest.mark.parametrize(
    ("url", "base"),
    [
        ("http://localhost:11434", "http://localhost:11434/v1"),
        ("http://localhost:11434/v1/", "http://localhost:11434/v1"),
        ("https://example.com/api/v2/chat/completions", "https://example.com/api/v2"),
    ],
)
def test_an_address_is_read_with_and_without_its_ending(url: str, base: str) -> None:
    assert read_url(url) == base


@pytest.mark.parametrize(
    "url",
    [
        "ollama",
        "ftp://h/v1",
        "http://",
        "http://h:99999/v1",
        "http://[::1",
        "http://[x]:1/v1",
        "file:///etc/passwd",
        "http://u:p@h/v1",
        "http://h/v1?key=1",
        "http://h /v1",
    ],
)
def test_an_address_that_cannot_be_used_is_a_usage_error(url: str) -> None:
    with pytest.raises(UsageError, match="`--llm`"):
        read_url(url)


def test_an_answer_of_newlines_is_read_in_a_moment() -> None:
    """A search that starts anew at every line takes a quarter of an hour for it."""
    assert LISTED.findall("\n" * 200_000 + "- a chair\n  2. a table\n-\nno") == ["a chair", "a table"]


def test_a_key_goes_to_nobody_it_is_not_for() -> None:
    openai = {"OPENAI_API_KEY": KEY}
    assert find_key("https://api.openai.com/v1", openai) == KEY
    assert find_key("https://api.openai.com.example.net/v1", openai) == ""
    assert find_key("http://localhost:8080/v1", {client.KEY_VARIABLE: KEY}) == KEY
    with pytest.raises(UsageError, match="unencrypted"):
        find_key("http://example.com/v1", {client.KEY_VARIABLE: KEY})
    with pytest.raises(UsageError, match="characters"):
        find_key("https://example.com/v1", {client.KEY_VARIABLE: "a\r\nX-Evil: 1"})


def test_a_server_does_not_show_its_key() -> None:
    server = connect("http://localhost:9/v1", "tiny", 1.0, {client.KEY_VARIABLE: KEY})
    assert server.key == KEY
    assert KEY not in repr(server)


@pytest.mark.parametrize(
    "more",
    [["-n", "0"], ["--timeout", "0"], ["--price", "x"], ["--price", "-1,2"], ["--notes", " "], ["--domain", "nowhere"]],
)
def test_wrong_flags_are_usage_errors_before_anyone_is_asked(tmp_path: Path, capsys, more: list[str]) -> None:
    with serving([VALID]) as server:
        assert run(tmp_path, server.url, *more) == UsageError.exit_code
    assert server.asked == []
    assert issubclass(UsageError, GsoptError)
    assert more[0].lstrip("-") in capsys.readouterr().err


def test_a_file_that_exists_is_not_overwritten(tmp_path: Path, capsys) -> None:
    (tmp_path / "prompts.json").write_text("mine")
    with serving([VALID]) as server:
        assert run(tmp_path, server.url) == 2
    assert server.asked == []
    assert (tmp_path / "prompts.json").read_text() == "mine"
    assert "--force" in capsys.readouterr().err
