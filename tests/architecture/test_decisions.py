"""Every page in docs/decisions/ has one header: Status, Date, Context, Decision, Consequences."""

from __future__ import annotations

import re
from pathlib import Path

HEADER = r"# (\d{4}): .+\n\n- Status: (?:accepted|superseded by \d{4})\n- Date: \d{4}-\d\d-\d\d\n\n## Context\n"


def faults(name: str, page: str) -> list[str]:
    match = re.match(HEADER, page)
    sections = re.findall(r"^## (.+)", page, re.MULTILINE)
    found = [] if match and name.startswith(match[1]) else [f"{name}: header"]
    return found + ([] if sections == ["Context", "Decision", "Consequences"] else [f"{name}: sections {sections}"])


def test_every_decision_has_the_header_and_the_three_sections(root: Path) -> None:
    pages = sorted((root / "docs" / "decisions").glob("*.md"))
    assert [fault for page in pages for fault in faults(page.name, page.read_text(encoding="utf-8"))] == []
    assert [int(page.name[:4]) for page in pages] == list(range(1, len(pages) + 1))


def test_a_page_without_header_is_noticed() -> None:
    assert faults("0001-x.md", "# 0001: x\n\nDecided today.\n\n## Why\n") != []
    assert faults("0002-x.md", "# 0001: x\n\n- Status: accepted\n- Date: 2026-01-01\n\n## Context\n") != []
