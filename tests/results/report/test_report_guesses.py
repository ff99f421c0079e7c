"""The report's parts about shapes that are a guess: a library's, and a shape prior's."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from gsopt.results.report import library_section, shape_prior_section

Section = Callable[[Path, list[str]], str]


def write(folder: Path, summary: object) -> None:
    folder.mkdir()
    (folder / "summary.json").write_text(summary if isinstance(summary, str) else json.dumps(summary))


@pytest.mark.parametrize(
    ("section", "name", "about"),
    [
        (library_section.library_section, "library", "The shape library is missing"),
        (shape_prior_section.shape_prior_section, "shape_prior", "The shape prior is missing"),
    ],
)
def test_a_run_without_a_guess_has_no_such_part_and_a_broken_one_is_named(
    tmp_path: Path, section: Section, name: str, about: str
) -> None:
    messages: list[str] = []
    assert section(tmp_path, messages) == ""
    assert messages == []
    write(tmp_path / name, "{")
    assert section(tmp_path, messages) == ""
    assert len(messages) == 1
    assert about in messages[0]


def test_a_library_shows_its_eight_first_shapes_with_names_and_shares(tmp_path: Path) -> None:
    shape = {"name": "<cup>", "share": 0.256, "agreement": 0.876, "creator": "Ada", "license": "CC0", "words": 1.0}
    shapes = [3, shape, {"id": "x7"}, *({"name": f"s{i}"} for i in range(9))]
    write(tmp_path / "library", {"shapes": shapes, "texts": ["a cup", 7, "red"], "entries": 40, "library": "toys"})
    for row in range(10):
        Image.new("RGB", (512, 512), "red").save(tmp_path / "library" / f"shape_{row:02d}.png")
    Image.new("RGB", (513, 512), "red").save(tmp_path / "library" / "shape_01.png")
    html = library_section.library_section(tmp_path, [])
    assert html.count("<figure>") == 8
    assert html.count("<img") == 7, "a picture of more pixels is left out"
    caption = "<b>&lt;cup&gt;</b><br>share 26%, silhouette 0.88, meant by the words<br>Ada, CC0</figcaption>"
    assert caption in html
    assert "<b>x7</b><br><br></figcaption>" in html
    assert "<b>s5</b>" in html
    assert "<b>s6</b>" not in html
    assert "The words: a cup; red." in html
    assert "40 shapes of the toys library" in html


@pytest.mark.parametrize("summary", [{}, {"shapes": 3, "texts": 4}, {"texts": []}])
def test_a_library_of_nothing_says_so(tmp_path: Path, summary: dict) -> None:
    write(tmp_path / "library", summary)
    html = library_section.library_section(tmp_path, [])
    assert "No words were given." in html
    assert "some shapes of the library library" in html
    assert "<figure" not in html


def test_a_shape_prior_shows_four_sides_and_says_which_words_it_knew(tmp_path: Path) -> None:
    summary = {"words": ["chair", 3, "red"], "unknown_words": ["zyx"], "prior": "<p>", "digest": "abc"}
    write(tmp_path / "shape_prior", summary)
    for row in (0, 1, 3, 4):
        Image.new("RGB", (8, 8), "red").save(tmp_path / "shape_prior" / f"side_{row:02d}.png")
    html = shape_prior_section.shape_prior_section(tmp_path, [])
    assert html.count("<img") == 3
    assert "It was told: chair, red." in html
    assert "It does not know: zyx." in html
    assert "&lt;p&gt; (abc)" in html


def test_a_shape_prior_that_was_told_nothing_says_so(tmp_path: Path) -> None:
    write(tmp_path / "shape_prior", {"words": [], "unknown_words": 3})
    html = shape_prior_section.shape_prior_section(tmp_path, [])
    assert "It was told no word that it knows." in html
    assert "does not know" not in html
    assert "<img" not in html
