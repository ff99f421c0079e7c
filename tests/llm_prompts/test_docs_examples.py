"""The worked examples in docs/howto/prompts.md: every command there gives the committed file, bit by bit."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from gsopt import cli
from gsopt.llm_prompts.templates import load_template

PAGE = Path(__file__).resolve().parents[2] / "docs" / "howto" / "prompts.md"
COMMANDS = re.findall(r"^gsopt (prompts --notes .* -o \w+\.json)$", PAGE.read_text(encoding="utf-8"), re.M)


def test_there_are_three_for_three_domains() -> None:
    domains = [shlex.split(command)[shlex.split(command).index("--domain") + 1] for command in COMMANDS]
    assert domains == ["robotics", "medicine", "environment"]


@pytest.mark.parametrize("command", COMMANDS)
def test_the_command_gives_the_committed_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = shlex.split(command)
    assert cli.main(arguments) == 0
    committed = PAGE.parent / "prompts" / arguments[-1]
    assert (tmp_path / arguments[-1]).read_bytes() == committed.read_bytes()


def test_the_templates_on_the_page_can_be_loaded(tmp_path: Path) -> None:
    text = re.search(r"```markdown\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
    assert text is not None
    (tmp_path / "pottery.md").write_text(text[1], encoding="utf-8")
    assert load_template(str(tmp_path / "pottery.md")).name == "pottery"
    assert load_template(str(PAGE.parent / "prompts" / "small-models.md")).name == "small-models"
