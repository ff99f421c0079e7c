"""The page itself. Every string that comes from a file goes through `escape`."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from importlib import resources
from typing import Any

from gsopt._version import __version__
from gsopt.config.train import TrainConfig
from gsopt.results.report.charts import line_chart
from gsopt.results.report.embedded_images import animation_uri, data_uri, error_legend, error_map, shrunk
from gsopt.results.report.read_run import EvaluatedView, Report
from gsopt.results.report.values import number, text
from gsopt.results.web import page as web_page

VIEW_SIDE = 400
NO_VALUE = "\N{EN DASH}"
"""Replaces a missing value."""
TURNTABLE_FPS = 12.0
TITLES = {"psnr": "PSNR", "ssim": "SSIM", "lpips_alex": "LPIPS (Alex)"}
OPTIONAL_TITLES = {
    "lpips_vgg": "LPIPS (VGG)",
    "cc_psnr": "PSNR, color-corrected",
    "psnr_object": "PSNR of the object",
    "cc_psnr_object": "the same, color-corrected",
}
"""Metrics that somebody asked for, and inside masks where the views have some."""
HINTS = {
    "psnr": "dB, higher is better",
    "ssim": "higher is better",
    "cc_psnr": "dB after a fit of exposure and white balance",
    "psnr_object": "dB inside the masks",
    "cc_psnr_object": "dB inside the masks after this fit",
}
DIGITS = {"ssim": 4, "lpips_alex": 4, "lpips_vgg": 4}
"""Decimals; those of a PSNR are 2."""
# A page loads nothing: images are data URIs, styles are inline, and there are no scripts but the viewer's.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def html_document(title: str, body: str, extra_style: str = "", policy: str = POLICY) -> str:
    """A self-contained page with the report's style sheet; `body` is finished HTML."""
    style = (resources.files("gsopt.results.report") / "style.css").read_text(encoding="utf-8")
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1"><meta name="color-scheme" '
        f'content="light dark"><link rel="icon" href="data:,"><title>{escape(title)}</title>'
        f"<style>\n{style}{extra_style}</style></head>\n<body>{body}</body></html>\n"
    )


def page(report: Report) -> str:
    """The whole document."""
    sections = [header(report), messages(report), views(report), inputs(report), report.library, report.cameras]
    sections += [report.guidance]
    sections += [progress_charts(report), settings(report)]
    body = f"<main>\n{''.join(sections)}</main>\n{footer(report)}"
    title = f"{report.name} · gsopt report"
    return (
        html_document(title, body, web_page.style(), web_page.policy()) if report.viewer else html_document(title, body)
    )


def header(report: Report) -> str:
    """Name, viewer or turntable, and the key figures."""
    facts = [_count(report.input_count, "input view"), _count(report.test_count, "held-out view")]
    facts += ["" if report.steps is None else f"{report.steps:,} steps", report.config.density.strategy]
    line = " · ".join(escape(fact) for fact in facts if fact)
    return (
        '<header><p class="eyebrow">gsopt report</p>'
        f'<h1>{escape(report.name)}</h1><p class="muted">{line}</p></header>\n'
        f'<section class="hero">{_turntable(report)}<div>{_scope(report)}<dl class="tiles">'
        f"{''.join(_tiles(report))}</dl></div></section>\n"
    )


def _turntable(report: Report) -> str:
    if report.viewer:
        return report.viewer
    if not report.turntable:
        return '<div class="turntable empty"><p class="muted">No turntable.</p></div>'
    still, animation = data_uri(report.turntable[0]), animation_uri(report.turntable, TURNTABLE_FPS)
    return (
        f'<picture class="turntable"><source media="(prefers-reduced-motion: reduce)" srcset="{still}">'
        f'<img src="{animation}" alt="Turntable of the result"></picture>'
    )


def _scope(report: Report) -> str:
    if report.mean and report.held_out:
        return '<p class="scope">Means over held-out views</p>'
    if report.mean:
        return '<p class="scope warn">No view was held out. Means over <b>training views</b></p>'
    return '<p class="scope warn">Not evaluated yet: run <code>gsopt eval</code></p>'


def _tiles(report: Report) -> Iterable[str]:
    for key, title in titles(report).items():
        yield _tile(title, figure(key, report.mean.get(key)), HINTS.get(key, "lower is better"))
    yield _tile("Gaussians", NO_VALUE if report.n_gaussians is None else f"{report.n_gaussians:,}", "")
    seconds = number(report.metrics.get("train_seconds"))
    if seconds is None and report.progress:
        seconds = report.progress[-1].seconds
    yield _tile(
        "Training", NO_VALUE if seconds is None else duration(seconds), report.backend and f"backend {report.backend}"
    )
    memory = number(report.metrics.get("peak_memory_mb"))
    if memory is not None:
        yield _tile("Peak memory", f"{memory:,.0f}", "MB")


def titles(report: Report) -> dict[str, str]:
    """Titles of the metrics that this run has: the usual ones, and others where they were computed."""
    computed = {key: title for key, title in OPTIONAL_TITLES.items() if report.mean.get(key) is not None}
    return TITLES | computed


def _tile(title: str, value: str, hint: str | None) -> str:
    return f"<div><dt>{escape(title)}</dt><dd>{escape(value)}</dd><dd class='hint'>{escape(hint or '')}</dd></div>"


def messages(report: Report) -> str:
    """Warnings (each once), the reason when nothing was held out, and notes of the evaluation."""
    notes = report.metrics.get("notes")
    texts = [*report.messages, *(map(text, notes) if isinstance(notes, list) else [])]
    reason = report.metrics.get("reason")
    if isinstance(reason, str):
        texts.insert(0, reason)
    items = "".join(f"<li>{escape(line)}</li>" for line in dict.fromkeys(texts) if line)
    return f'<section class="messages"><h2>Notes</h2><ul>{items}</ul></section>\n' if items else ""


def views(report: Report) -> str:
    """Renders beside truth and error, worst first."""
    if not report.evaluated:
        return ""
    kind = "Held-out views" if report.held_out else "Training views (not held out)"
    worst, best = report.evaluated[0], report.evaluated[-1]
    shown, evaluated = len(report.evaluated), len(report.per_view)
    count = f"All {evaluated} are" if shown == evaluated else f"{shown} of {evaluated} are"
    lead = (
        f"Worst: <b>{escape(worst.name)}</b> ({figure('psnr', worst.figures['psnr'])} dB). "
        f"Best: <b>{escape(best.name)}</b> ({figure('psnr', best.figures['psnr'])} dB). "
        f"{count} shown, sorted by PSNR."
    )
    cards = f'{error_legend()}<div class="cards">{"".join(map(_card, report.evaluated))}</div>'
    return f"<section><h2>{kind}</h2><p>{lead}</p>{cards}{_table(report)}</section>\n"


def _card(view: EvaluatedView) -> str:
    shown = (("render", view.render), ("truth", view.truth), ("error", error_map(view.render, view.truth)))
    name = escape(view.name)
    figures_html = "".join(
        f'<figure><img loading="lazy" src="{data_uri(shrunk(image, VIEW_SIDE))}" alt="{title} of {name}">'
        f"<figcaption>{title}</figcaption></figure>"
        for title, image in shown
    )
    badge = f'<span class="badge {view.badge}">{view.badge}</span>' if view.badge else ""
    figures = " · ".join(
        f"{(TITLES | OPTIONAL_TITLES)[key]} {figure(key, value)}"
        for key, value in view.figures.items()
        if value is not None
    )
    return (
        f'<article class="card"><div class="triple">{figures_html}</div>'
        f'<p><b>{name}</b> {badge}<br><span class="muted">{figures}</span></p></article>'
    )


def _table(report: Report) -> str:
    shown = titles(report)
    head = "".join(f'<th scope="col">{title}</th>' for title in ("View", *shown.values()))
    rows = "".join(
        f'<tr><th scope="row">{escape(row["name"])}</th>'
        + "".join(f"<td>{figure(key, row[key])}</td>" for key in shown)
        + "</tr>"
        for row in report.per_view
    )
    return (
        f"<details><summary>Figures of all {len(report.per_view)} views</summary>"
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div></details>'
    )


def inputs(report: Report) -> str:
    """Input views."""
    if not report.inputs:
        return ""
    left_out = (report.input_count or 0) - len(report.inputs)
    more = f' <span class="muted">{len(report.inputs)} of {report.input_count}</span>' if left_out > 0 else ""
    figures_html = "".join(
        f'<figure><img loading="lazy" src="{data_uri(image)}" alt=""><figcaption title="{escape(name)}">{escape(name)}'
        "</figcaption></figure>"
        for name, image in report.inputs
    )
    return f'<section><h2>Input views{more}</h2><div class="inputs">{figures_html}</div></section>\n'


def progress_charts(report: Report) -> str:
    """Loss, PSNR and number of Gaussians over the run."""
    charts = (
        line_chart("Loss", _series(report, "loss"), log=True),
        line_chart("PSNR of input views", _series(report, "psnr"), unit=" dB"),
        line_chart("Gaussians", _series(report, "n")),
    )
    return f'<section><h2>Training progress</h2><div class="charts">{"".join(charts)}</div></section>\n'


def _series(report: Report, key: str) -> list[tuple[float, float]]:
    pairs = ((moment.step, getattr(moment, key)) for moment in report.progress)
    return [(step, value) for step, value in pairs if value is not None]


def settings(report: Report) -> str:
    """Every setting; those that differ from the default are bold."""
    default = TrainConfig().to_dict()
    rows = "".join(_setting_rows(report.config.to_dict(), default))
    facts = {"first Gaussians": report.recorded.get("gaussians_init"), "symmetry": _symmetry(report)}
    extra = "".join(
        f"<tr><th scope='row'>{name}</th><td>{escape(text(fact))}</td></tr>" for name, fact in facts.items() if fact
    )
    return (
        "<section><details><summary>Settings</summary><p class='muted'>Values other than the default are bold.</p>"
        f'<div class="scroll"><table class="settings"><tbody>{extra}{rows}</tbody></table></div></details></section>\n'
    )


def _symmetry(report: Report) -> str:
    """The detected mirror planes, and whether mirrored colors were used for training."""
    mirrors = report.recorded.get("symmetry")
    if not isinstance(mirrors, list):
        return ""
    return "; ".join(text(mirror["about"]) for mirror in mirrors if isinstance(mirror, dict) and "about" in mirror)


def _setting_rows(values: dict[str, Any], default: dict[str, Any], prefix: str = "") -> Iterable[str]:
    for key, value in sorted(values.items(), key=lambda item: isinstance(item[1], dict)):
        if isinstance(value, dict):
            yield f'<tr class="group"><th colspan="2" scope="rowgroup">{escape(key)}</th></tr>'
            yield from _setting_rows(value, default[key], f"{prefix}{key}.")
            continue
        changed = ' class="changed"' if value != default[key] else ""
        shown = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
        shown = NO_VALUE if value is None or value == [] else shown
        yield f'<tr{changed}><th scope="row">{escape(prefix + key)}</th><td>{escape(shown)}</td></tr>'


def footer(report: Report) -> str:
    """Evaluation protocol, versions and seed."""
    protocol = report.metrics.get("protocol")
    note = f"<p>{escape(protocol)}</p>" if isinstance(protocol, str) else ""
    versions = report.recorded.get("versions")
    pairs = versions.items() if isinstance(versions, dict) else [("gsopt", __version__)]
    line = " · ".join(f"{escape(name)} {escape(text(version))}" for name, version in pairs)
    return f"<footer>{note}<p>{line} · seed {report.config.seed}</p></footer>\n"


def figure(key: str, value: float | None) -> str:
    return NO_VALUE if value is None else f"{value:.{DIGITS.get(key, 2)}f}"


def duration(seconds: float) -> str:
    """8.2 s, 48 s, 3:05 min, 2:07 h."""
    whole = round(seconds)
    if whole < 60:
        return f"{seconds:.1f} s" if seconds < 9.95 else f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    minutes = round(seconds / 60)
    return f"{minutes // 60}:{minutes % 60:02d} h"


def _count(count: int | None, thing: str) -> str:
    return "" if count is None else f"{count} {thing}{'' if count == 1 else 's'}"
