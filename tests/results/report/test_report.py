"""The report: self-contained, escaped, honest about what was held out, and there even when parts are missing."""

from __future__ import annotations

import itertools
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from finished_runs import make_run, splats
from PIL import Image

from gsopt.errors import InputError
from gsopt.events import EventWriter
from gsopt.results.evaluation import evaluate
from gsopt.results.report import charts, write_report
from gsopt.results.report.embedded_images import ERROR_COLORS, ERROR_FULL_SCALE, error_map
from gsopt.results.report.page import duration
from gsopt.results.report.read_run import progress_of, representative_rows
from gsopt.results.report.values import number

VOID = {"meta", "input", "link", "img", "br", "source", "line", "circle", "polyline"}
SIZE_LIMIT = 8 << 20
EVIL = "<script>alert('x')</script>&\"'"


class Page(HTMLParser):
    """Checks that tags close in order; collects tags, addresses and text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.text = ""
        self.scripts = 0
        """Scripts that run; others are data."""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.scripts += tag == "script" and not dict(attrs).get("type")
        self.addresses += [value or "" for key, value in attrs if key in ("src", "srcset", "href", "data", "action")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] not in ("style", "script"):
            self.text += data


def tell(run: Path, *, warning: str | None = None) -> None:
    """An events.jsonl of a run of 100 steps."""
    writer = EventWriter(run)
    writer.emit("started", total=100)
    if warning is not None:
        writer.emit("warning", message=warning)
    for step in range(10, 101, 10):
        writer.emit("progress", step=step, loss=1 / step, psnr=10 + step / 10, n=step * 3, seconds=step / 2)
    writer.emit("done", step=100)
    writer.close()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = make_run(tmp_path_factory.mktemp("report"), test=3, learned=splats(seed=1))
    tell(run, warning=f"two images are absent {EVIL}")
    evaluate(run)
    return run


@pytest.fixture(scope="module")
def page(run: Path) -> Page:
    return Page(write_report(run).read_text(encoding="utf-8"))


def test_the_page_needs_nothing_from_anywhere(run: Path, page: Page) -> None:
    assert page.addresses
    assert all(address.startswith("data:") for address in page.addresses)
    assert page.scripts == 1  # the viewer
    text = (run / "report.html").read_text(encoding="utf-8")
    assert not re.search(r"https?:|url\(|@import", text)
    assert len(text) < SIZE_LIMIT


def test_the_page_says_what_the_figures_say(run: Path, page: Page) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    for value in (f"{metrics['mean']['psnr']:.2f}", f"{metrics['mean']['ssim']:.4f}", metrics["protocol"], "50 s"):
        assert value in page.text
    ranked = sorted(metrics["per_view"], key=lambda row: row["psnr"])
    worst, best = ranked[0]["name"], ranked[-1]["name"]
    assert re.search(rf"Worst: {worst} .*Best: {best} ", page.text)
    assert "Held-out views" in page.text
    assert "two images are absent" in page.text


def test_nobody_who_did_not_ask_for_vgg_reads_of_it(run: Path, page: Page) -> None:
    assert "VGG" not in page.text
    metrics = json.loads((run / "metrics.json").read_text())
    (run / "metrics.json").write_text(json.dumps({**metrics, "mean": {**metrics["mean"], "lpips_vgg": 0.1234}}))
    asked = Page(write_report(run).read_text(encoding="utf-8"))
    (run / "metrics.json").write_text(json.dumps(metrics))
    assert "LPIPS (VGG)" in asked.text
    assert "0.1234" in asked.text


def test_the_time_is_that_of_the_metrics_or_else_of_the_last_progress(run: Path, page: Page) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    assert "train_seconds" not in metrics
    assert re.search(r"Training\s*50 s", page.text)
    (run / "metrics.json").write_text(json.dumps({**metrics, "train_seconds": 12.0}))
    timed = Page(write_report(run).read_text(encoding="utf-8"))
    (run / "metrics.json").write_text(json.dumps(metrics))
    assert re.search(r"Training\s*12 s", timed.text)


def test_strings_from_files_stay_text(run: Path, page: Page) -> None:
    assert EVIL in page.text
    assert EVIL not in (run / "report.html").read_text(encoding="utf-8")


def test_hostile_names_and_values_in_metrics_stay_text_or_vanish(tmp_path: Path) -> None:
    run = make_run(tmp_path, train=1, test=1)
    row = {"name": EVIL, "psnr": EVIL, "ssim": [], "lpips_alex": True, "lpips_vgg": 1e999}
    document = {"mean": {"psnr": EVIL}, "per_view": [row, 7], "protocol": EVIL, "notes": [EVIL], "reason": EVIL}
    (run / "metrics.json").write_text(json.dumps({**document, "train_seconds": "long"}))
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps({**config, "versions": {EVIL: EVIL}, "gaussians_init": EVIL}))
    page = Page(write_report(run).read_text(encoding="utf-8"))
    assert page.scripts == 1
    assert page.text.count(EVIL) >= 5


def test_training_views_are_never_called_held_out(tmp_path: Path) -> None:
    run = make_run(tmp_path, train=2, test=0)
    evaluate(run)
    text = Page(write_report(run).read_text(encoding="utf-8")).text
    assert "Training views (not held out)" in text
    assert "No view was held out" in text
    assert "Held-out views" not in text


def test_a_report_without_evaluation_events_dataset_or_splats_says_so(tmp_path: Path) -> None:
    run = make_run(tmp_path, train=1, test=1)
    assert "Not evaluated yet" in Page(write_report(run).read_text(encoding="utf-8")).text
    (run / "splat.ply").unlink()
    assert "no splat.ply" in Page(write_report(run).read_text(encoding="utf-8")).text
    (tmp_path / "data").rename(tmp_path / "elsewhere")
    text = Page(write_report(run).read_text(encoding="utf-8")).text
    assert "Some images are missing" in text
    assert "Not recorded." in text
    (run / "config.json").unlink()
    with pytest.raises(InputError, match=r"config\.json"):
        write_report(run)


def test_broken_metrics_and_events_do_not_stop_a_report(tmp_path: Path) -> None:
    run = make_run(tmp_path, train=1, test=1)
    (run / "metrics.json").write_text("{" * 100_000)
    (run / "events.jsonl").write_text('{"v": 9, "seq": 0, "kind": "started"}\n')
    text = Page(write_report(run).read_text(encoding="utf-8")).text
    assert "metrics.json cannot be read" in text
    assert "protocol version 9" in text


def test_the_same_run_gives_the_same_page(run: Path) -> None:
    assert write_report(run).read_bytes() == write_report(run).read_bytes()


def test_what_a_resumed_run_took_back_is_not_drawn() -> None:
    steps = [10, 20, 30, 25, 35]
    progress_charts = progress_of([{"kind": "progress", "step": step, "loss": i} for i, step in enumerate(steps)])
    assert [(moment.step, moment.loss) for moment in progress_charts] == [(10, 0), (20, 1), (25, 3), (35, 4)]


def test_steps_before_the_first_are_not_drawn() -> None:
    events = [{"kind": "progress", "step": step, "loss": 1.0} for step in (-5, -4, -0.5, 0, 1)]
    assert [moment.step for moment in progress_of(events)] == [0, 1]


def test_the_views_between_the_ends_are_evenly_chosen() -> None:
    """Of 32 between four at each end, the middles of four runs of eight."""
    shown = representative_rows([float(value) for value in range(40)])
    assert shown == [0, 1, 2, 3, 8, 16, 24, 32, 36, 37, 38, 39]


@pytest.mark.parametrize("count", [1, 2, 12, 13, 40, 200])
def test_the_views_shown_include_both_ends_in_order(count: int) -> None:
    psnrs = np.random.default_rng(count).permutation(count).astype(float).tolist()
    shown = [psnrs[row] for row in representative_rows(psnrs)]
    assert shown == sorted(shown)
    assert len(set(shown)) == len(shown) == min(count, 12)
    ends = min(count, 4)
    assert shown[:ends] == list(range(ends))
    assert shown[-ends:] == list(range(count - ends, count))


def test_an_error_map_goes_from_the_first_to_the_last_color() -> None:
    truth = Image.new("RGB", (3, 1))
    levels = (0, 255 * ERROR_FULL_SCALE / 2, 255)
    render = Image.fromarray(np.array([[[level] * 3 for level in levels]]).round().astype(np.uint8))
    first, middle, last = np.asarray(error_map(render, truth))[0]
    assert tuple(first) == ERROR_COLORS[0][1:]
    assert tuple(last) == ERROR_COLORS[-1][1:]
    assert np.abs(middle - np.array(ERROR_COLORS[2][1:])).max() <= 4


@pytest.mark.parametrize(("low", "high"), [(0, 7), (0.013, 0.9), (-3, 1e6), (5, 5), (0, 0), (1e-9, 2e-9)])
def test_ticks_are_round_and_cover_the_range(low: float, high: float) -> None:
    marks = charts.ticks(low, high, 4)
    assert marks[0] <= low
    assert marks[-1] >= high
    assert 2 <= len(marks) <= 7
    steps = np.diff(marks)
    assert np.allclose(steps, steps[0])


@pytest.mark.parametrize(("low", "high"), [(0.013, 0.9), (1e-6, 3), (0.5, 0.5), (1, 1), (0.02, 0.021)])
def test_logarithmic_ticks_start_below_and_rise(low: float, high: float) -> None:
    marks = charts.log_ticks(low, high)
    assert marks[0] <= low * (1 + 1e-9)
    assert 2 <= len(marks) <= 8
    assert all(b > a for a, b in itertools.pairwise(marks))


def test_logarithmic_ticks_of_three_decades_are_all_there() -> None:
    assert charts.log_ticks(5, 1000) == [5, 10, 20, 50, 100, 200, 500, 1000]


def test_a_chart_stays_inside_its_frame_and_keeps_the_last_value() -> None:
    points = [(float(step), 1 / (step + 1)) for step in range(5000)]
    svg = charts.line_chart("Loss", points, log=True)
    drawn = [tuple(map(float, pair.split(","))) for pair in re.search(r'points="([^"]+)"', svg).group(1).split()]
    assert len(drawn) <= charts.MAX_POINTS + 1
    assert all(charts.LEFT <= x <= charts.WIDTH and 0 <= y <= charts.HEIGHT for x, y in drawn)
    assert all(b[0] > a[0] and b[1] >= a[1] for a, b in itertools.pairwise(drawn))
    assert "<b>0.0002</b>" in svg


@pytest.mark.parametrize("log", [False, True])
def test_a_chart_of_any_numbers_is_drawn(log: bool) -> None:
    points = [(0.0, 5e-324), (1.0, 9e299), (2.0, -9e299), (3.0, 1e-299), (4.0, 1.0)]
    assert all(number(y) is not None for _, y in points)
    assert "nan" not in charts.line_chart("Loss", points, log=log)
    assert [number(value) for value in (10**400, 1e301, float("nan"), True)] == [None] * 4


def test_a_chart_of_nothing_says_so() -> None:
    assert "Not recorded" in charts.line_chart("Loss", [(1.0, 2.0)])
    assert "Not recorded" in charts.line_chart("Loss", [(1.0, 0.0), (2.0, -1.0)], log=True)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(8.24, "8.2 s"), (9.96, "10 s"), (59.4, "59 s"), (59.6, "1:00 min"), (185, "3:05 min"), (7620, "2:07 h")],
)
def test_durations_read_like_a_clock(seconds: float, text: str) -> None:
    assert duration(seconds) == text
