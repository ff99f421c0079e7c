"""One version: the package, its metadata, the Blender extension, the change log and the citation agree."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import gsopt


def versions(root: Path) -> dict[str, str]:
    text = {name: (root / name).read_text(encoding="utf-8") for name in ("CHANGELOG.md", "CITATION.cff")}
    found = {
        "pyproject.toml": tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"],
        "blender_manifest.toml": tomllib.loads((root / "blender_addon/blender_manifest.toml").read_text())["version"],
        "CHANGELOG.md": first(r"^## (\d+\.\d+\.\d+)", text["CHANGELOG.md"]),
        "CITATION.cff": first(r"^version: (\S+)", text["CITATION.cff"]),
    }
    return found


def first(pattern: str, text: str) -> str:
    match = re.search(pattern, text, re.MULTILINE)
    return match[1] if match else ""


def test_every_file_names_the_version_of_the_package(root: Path) -> None:
    assert {name: found for name, found in versions(root).items() if found != gsopt.__version__} == {}


def test_a_file_without_version_is_noticed() -> None:
    assert first(r"^version: (\S+)", "title: gsopt\n") != gsopt.__version__
