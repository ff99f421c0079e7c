"""The words and figures of the report's page, from a report in memory."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import pytest
from PIL import Image

from gsopt.config.train import TrainConfig
from gsopt.results.report.page import (
    duration,
    figure,
    footer,
    header,
    inputs,
    messages,
    page,
    progress_charts,
    settings,
    views,
)
from gsopt.results.report.read_run import EvaluatedView, Progress, Report

GRAY = Image.new("RGB", (4, 3), "gray")


def report(**changes: Any) -> Report:
    parts: dict[str, Any] = {"name": "cup", "config": TrainConfig(), "recorded": {}, "metrics": {}, "progress": []}
    return Report(**{**parts, "messages": [], **changes})


def evaluated(name: str, psnr: float, badge: str = "") -> EvaluatedView:
    return EvaluatedView(name, badge, {"psnr": psnr, "ssim": 0.5, "lpips_alex": None}, GRAY, GRAY)


def plain(html: str) -> str:
    """Text without tags."""
    return re.sub(r"<[^>]*>", " ", html)


@pytest.mark.parametrize(
    ("given", "held_out", "words"),
    [
        (1, 2, ["1 input view ", "2 held-out views"]),
        (3, 1, ["3 input views", "1 held-out view "]),
        (None, 0, ["0 held-out views"]),
    ],
)
def test_the_header_counts_views_and_steps(given: int | None, held_out: int, words: list[str]) -> None:
    text = plain(header(report(input_count=given, test_count=held_out, steps=12_000)))
    assert all(word in text for word in [*words, "12,000 steps"])
    assert ("input view" in text) == (given is not None)
    assert "steps" not in plain(header(report(input_count=1, test_count=1)))


@pytest.mark.parametrize(
    ("key", "text"),
    [("psnr", "0.12"), ("ssim", "0.1235"), ("lpips_alex", "0.1235"), ("lpips_vgg", "0.1235"), ("cc_psnr", "0.12")],
)
def test_decibels_have_two_decimals_and_shares_four(key: str, text: str) -> None:
    assert figure(key, 0.123456) == text
    assert figure(key, None) == "\N{EN DASH}"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(9.94, "9.9 s"), (9.95, "10 s"), (60, "1:00 min"), (3599.4, "59:59 min"), (3600, "1:00 h"), (3661, "1:01 h")],
)
def test_the_units_of_a_duration_change_at_a_minute_and_an_hour(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_means_are_called_what_they_are() -> None:
    mean = {"psnr": 31.234, "ssim": 0.9, "lpips_alex": None, "psnr_object": 25.0, "lpips_vgg": None}
    held_out = plain(header(report(mean=mean)))
    assert "Means over held-out views" in held_out
    assert "31.23" in held_out
    assert "PSNR of the object" in held_out
    assert "VGG" not in held_out
    training = plain(header(report(mean=mean, held_out=False)))
    assert "No view was held out" in training
    assert "over held-out" not in training
    assert "Not evaluated yet" in plain(header(report()))


def test_the_key_figures_name_splats_time_backend_and_memory() -> None:
    known = report(
        n_gaussians=12345, backend="cpu", metrics={"train_seconds": 75, "peak_memory_mb": 1234.4}, progress=[]
    )
    text = " ".join(plain(header(known)).split())
    assert "Gaussians 12,345" in text
    assert "Training 1:15 min backend cpu" in text
    assert "Peak memory 1,234 MB" in text
    bare = " ".join(plain(header(report())).split())
    assert "Gaussians \N{EN DASH} Training \N{EN DASH}" in bare
    assert "Peak memory" not in bare
    followed = report(progress=[Progress(1, 5.0, None, None, None), Progress(2, 8.24, None, None, None)])
    assert "Training 8.2 s" in " ".join(plain(header(followed)).split())


def test_a_message_stands_once_after_the_reason_and_before_the_notes() -> None:
    found = messages(report(messages=["a < b", "twice", "twice", ""], metrics={"notes": ["n"], "reason": "why"}))
    assert re.findall("<li>(.*?)</li>", found) == ["why", "a &lt; b", "twice", "n"]
    assert messages(report()) == ""


def test_the_views_say_how_many_of_how_many_they_are() -> None:
    rows = [{"name": name, "psnr": psnr, "ssim": 0.5, "lpips_alex": None} for name, psnr in (("a", 20), ("b", 30))]
    both = report(evaluated=[evaluated("a", 20, "worst"), evaluated("b", 30, "best")], per_view=rows)
    text = " ".join(plain(views(both)).split())
    assert "Held-out views" in text
    assert "Worst: a (20.00 dB). Best: b (30.00 dB). All 2 are shown" in text
    assert "Figures of all 2 views" in text
    assert "a worst PSNR 20.00 · SSIM 0.5000" in text
    assert "LPIPS (Alex) None" not in text
    assert views(both).count("<img") == 2 * 3
    some = replace(both, per_view=[*rows, {**rows[0], "name": "c"}], held_out=False)
    words = " ".join(plain(views(some)).split())
    assert "Training views (not held out)" in words
    assert "2 of 3 are shown" in words
    assert views(report()) == ""


def test_the_inputs_say_how_many_of_how_many_they_are() -> None:
    shown = [("a", GRAY), ("<b>", GRAY)]
    assert "2 of 3" in plain(inputs(report(inputs=shown, input_count=3)))
    assert " of " not in plain(inputs(report(inputs=shown, input_count=2)))
    assert "&lt;b&gt;" in inputs(report(inputs=shown))
    assert inputs(report(input_count=3)) == ""


def test_charts_leave_out_what_was_not_recorded() -> None:
    moments = [Progress(1, 1, 0.5, None, 10), Progress(2, 2, 0.25, 20.0, 30), Progress(3, 3, None, None, 50)]
    found = progress_charts(report(progress=moments))
    assert found.count("polyline") == 2
    assert "Not recorded." in found
    assert "<b>0.25</b>" in found
    assert "<b>50</b>" in found


def test_settings_that_differ_from_the_default_are_bold() -> None:
    default = settings(report())
    assert "changed" not in default
    assert ">None<" not in default
    assert "<td>\N{EN DASH}</td>" in default
    assert default.count('class="group"') > 3
    found = settings(report(config=TrainConfig(iterations=77, seed=5)))
    assert found.count('class="changed"') == 2
    assert re.search(r'<tr class="changed"><th scope="row">iterations</th><td>77</td>', found)
    first = re.search(r'scope="row(group)?">', found)
    assert first is not None
    assert first[1] is None, "plain settings come before groups"


def test_settings_name_the_first_gaussians_and_mirrors() -> None:
    recorded = {"gaussians_init": "100 points", "symmetry": [{"about": "left and right"}, {"about": "front"}, 3, {}]}
    text = " ".join(plain(settings(report(recorded=recorded))).split())
    assert "first Gaussians 100 points symmetry left and right; front" in text
    assert "symmetry " not in plain(settings(report(recorded={"symmetry": "none"})))[:120]


def test_the_footer_names_protocol_versions_and_seed() -> None:
    told = report(metrics={"protocol": "PSNR <b>"}, recorded={"versions": {"gsopt": "9.9", "torch": 2}})
    text = footer(told)
    assert "<p>PSNR &lt;b&gt;</p>" in text
    assert "gsopt 9.9 · torch 2 · seed 0" in text
    assert "gsopt " in footer(report(metrics={"protocol": 3}))
    assert "<p>3" not in footer(report(metrics={"protocol": 3}))


def test_only_a_page_with_the_viewer_allows_its_script() -> None:
    assert "script-src" not in page(report())
    assert "script-src 'sha256-" in page(report(viewer="<p>splats</p>"))
    assert "No turntable." in page(report())
    turned = page(report(turntable=[GRAY, GRAY]))
    assert 'alt="Turntable of the result"' in turned
    assert "prefers-reduced-motion" in turned
