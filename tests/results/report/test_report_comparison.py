"""The page that compares sets of prompts: means, differences, the best one, and what stands beside what."""

from __future__ import annotations

import re

import pytest
from PIL import Image

from gsopt.results.report.prompt_comparison import Column, comparison_page

PICTURE = Image.new("RGB", (4, 4), "gray")


def column(name: str, *psnrs: float, alignment: float | None = None, prompts: tuple = ()) -> Column:
    return Column(name, prompts, psnrs, alignment, (PICTURE,) * len(psnrs))


def rows(columns: list[Column], views: tuple[str, ...]) -> list[list[str]]:
    """Text of the table's cells."""
    html = comparison_page("cup", "facts", views, (PICTURE,) * len(views), columns)
    body = html.split("<tbody>")[1].split("</tbody>")[0]
    cells = [re.findall(r"<t[hd]>(.*?)</t[hd]>", row) for row in re.findall(r"<tr>(.*?)</tr>", body)]
    return [[re.sub(r"<[^>]*>", "", cell) for cell in row] for row in cells]


def test_a_row_has_the_mean_the_lead_over_the_first_and_each_view() -> None:
    found = rows([column("none", 20, 21), column("text", 22, 20.5, alignment=0.25678)], ("a", "b"))
    assert found == [
        ["none", "20.50", "+0.00", "20.00", "21.00", "\N{EN DASH}"],
        ["text best", "21.25", "+0.75", "22.00", "20.50", "0.257"],
    ]
    behind = rows([column("none", 21), column("text", 20)], ("a",))
    assert behind[1][1:3] == ["20.00", "-1.00"]


@pytest.mark.parametrize(("second", "badges"), [(20.0625, 1), (20.03125, 0), (20.0, 0), (19.9375, 1)])
def test_the_best_leads_by_a_twentieth_of_a_decibel(second: float, badges: int) -> None:
    found = rows([column("a", 20.0), column("b", second), column("c", 10.0)], ("v",))
    assert sum("best" in row[0] for row in found) == badges
    if badges:
        assert "best" in found[int(second > 20)][0]


def test_a_lone_set_is_the_best() -> None:
    assert rows([column("a", 20.0)], ("v",))[0][0] == "a best"


def test_pictures_stand_beside_the_photo_and_words_below() -> None:
    prompts = (("front", "a <red> cup"),)
    columns = [column("none", 20, 21), column("text", 22, 20.5, prompts=prompts)]
    html = comparison_page("<cup>", "facts & more", ("r_1", "r_2"), (PICTURE, PICTURE), columns)
    captions = re.findall("<figcaption>(.*?)</figcaption>", html)
    assert captions == ["photo", "none · 20.00 dB", "text · 22.00 dB", "photo", "none · 21.00 dB", "text · 20.50 dB"]
    assert html.count("<summary>") == 1
    assert "<summary>text</summary>" in html
    assert "a &lt;red&gt; cup" in html
    assert "<h1>&lt;cup&gt;</h1>" in html
    assert "facts &amp; more" in html
