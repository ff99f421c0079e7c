"""docs/architecture.md names the layers of the import contract and every folder of the package."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest


def layers_of_page(page: str) -> list[str]:
    """The lines of the block `layers`."""
    block = re.search(r"```layers\n(.*?)```", page, re.DOTALL)
    return block[1].splitlines() if block else []


def layers_of_contract(pyproject: str) -> list[str]:
    (contract,) = tomllib.loads(pyproject)["tool"]["importlinter"]["contracts"]
    return [layer.replace("gsopt.", "") for layer in contract["layers"]]


def folders_of_page(page: str) -> list[str]:
    """The paths in the first column of the map."""
    return re.findall(r"^\| `([\w/]+)/` \|", page, re.MULTILINE)


def folders_of_code(root: Path, tracked: list[Path]) -> set[str]:
    """Every folder below gsopt/ that holds code, and the folders at the root of the project."""
    code = {".py", ".h", ".cpp", ".toml"}
    packages = {file.parent for file in tracked if file.suffix in code and file.is_relative_to(root / "gsopt")}
    rooms = {root / file.relative_to(root).parts[0] for file in tracked if file.parent != root}
    found = {str(folder.relative_to(root)) for folder in packages | rooms}
    return {name for name in found if not name.startswith(".") and name != "gsopt"}


def missing(root: Path, tracked: list[Path], page: str) -> set[str]:
    return folders_of_code(root, tracked) - set(folders_of_page(page))


@pytest.fixture(scope="module")
def page(root: Path) -> str:
    return (root / "docs" / "architecture.md").read_text(encoding="utf-8")


def test_the_layers_of_the_page_are_those_of_the_contract(root: Path, page: str) -> None:
    contract = layers_of_contract((root / "pyproject.toml").read_text(encoding="utf-8"))
    assert layers_of_page(page) == contract
    assert layers_of_page(page.replace("init\n", "", 1)) != contract


def test_every_folder_of_the_code_is_in_the_map(root: Path, tracked: list[Path], page: str) -> None:
    assert missing(root, tracked, page) == set(), "Add a row to the map of docs/architecture.md."
    assert missing(root, tracked, page.replace("| `gsopt/raster/cpu/` |", "| |")) == {"gsopt/raster/cpu"}


def test_every_path_of_the_page_exists(root: Path, page: str) -> None:
    names = folders_of_page(page)
    assert [name for name in names if not (root / name).is_dir()] == []
    assert len(names) == len(set(names)) > 25
    roots = [root / "gsopt", root]
    paths = set(re.findall(r"`([\w/]+(?:\.py|/))`", page.partition("## Map")[2]))
    paths |= set(re.findall(r"`(\w+\.py)`", page.partition("At the root")[2]))
    absent = {p for p in paths - {"reference.py"} if not any((base / p).exists() for base in roots)}
    assert absent == set()
