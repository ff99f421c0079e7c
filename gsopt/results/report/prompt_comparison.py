"""One self-contained page that compares sets of prompts: metrics, texts, renders."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from PIL import Image

from gsopt._version import __version__
from gsopt.results.report.embedded_images import data_uri
from gsopt.results.report.page import NO_VALUE, html_document

MIN_LEAD = 0.05
"""Least lead of the best set of prompts, dB."""


@dataclass(frozen=True)
class Column:
    """One set of prompts. Strings are unescaped: the page escapes them."""

    name: str
    prompts: tuple[tuple[str, str], ...]
    """(source, view, polarity in a few words; text)."""
    psnrs: tuple[float, ...]
    """PSNR per left-out view, dB."""
    alignment: float | None
    images: tuple[Image.Image, ...]

    @property
    def mean(self) -> float:
        return sum(self.psnrs) / len(self.psnrs)


def comparison_page(
    title: str, facts: str, views: Sequence[str], truths: Sequence[Image.Image], columns: Sequence[Column]
) -> str:
    """The whole document. Differences refer to the first column."""
    return html_document(
        f"{title} · gsopt prompts",
        f'<main>\n<header><p class="eyebrow">gsopt prompts compare</p><h1>{escape(title)}</h1>'
        f'<p class="muted">{escape(facts)}</p></header>\n'
        f"{_table(views, columns)}{_images(views, truths, columns)}{_words(columns)}</main>\n"
        f"<footer><p>gsopt {escape(__version__)}. Short runs on small images rank prompts; they do not measure the "
        "final quality. Differences of a few tenths of a dB may be chance.</p></footer>",
    )


def _table(views: Sequence[str], columns: Sequence[Column]) -> str:
    means = sorted((column.mean for column in columns), reverse=True)
    best = means[0] if len(means) == 1 or means[0] - means[1] >= MIN_LEAD else math.inf
    head = "".join(f"<th>{escape(view)}</th>" for view in (f"to {columns[0].name}", *views))
    rows = []
    for column in columns:
        badge = ' <span class="badge best">best</span>' if column.mean == best else ""
        figures = "".join(f"<td>{value:.2f}</td>" for value in column.psnrs)
        aligned = NO_VALUE if column.alignment is None else f"{column.alignment:.3f}"
        rows.append(
            f"<tr><th>{escape(column.name)}{badge}</th><td>{column.mean:.2f}</td>"
            f"<td>{column.mean - columns[0].mean:+.2f}</td>{figures}<td>{aligned}</td></tr>"
        )
    return (
        '<section><h2>PSNR of views that were left out <span class="muted">dB, higher is better</span></h2>'
        f'<div class="scroll"><table><thead><tr><th>prompts</th><th>mean</th>{head}'
        f"<th>CLIP alignment</th></tr></thead><tbody>{''.join(rows)}</tbody></table></div></section>\n"
    )


def _images(views: Sequence[str], truths: Sequence[Image.Image], columns: Sequence[Column]) -> str:
    rows = []
    for number, view in enumerate(views):
        shown = [("photo", truths[number])]
        shown += [(f"{column.name} · {column.psnrs[number]:.2f} dB", column.images[number]) for column in columns]
        figures = "".join(
            f'<figure><img src="{data_uri(image)}" alt=""><figcaption>{escape(name)}</figcaption></figure>'
            for name, image in shown
        )
        rows.append(f'<div class="card"><p>{escape(view)}, left out</p><div class="strip">{figures}</div></div>')
    return f"<section><h2>Side by side</h2>{''.join(rows)}</section>\n"


def _words(columns: Sequence[Column]) -> str:
    lists = []
    for column in columns:
        if not column.prompts:
            continue
        rows = "".join(f"<tr><th>{escape(what)}</th><td>{escape(text)}</td></tr>" for what, text in column.prompts)
        table = f'<table class="settings"><tbody>{rows}</tbody></table>'
        lists.append(f"<details open><summary>{escape(column.name)}</summary>{table}</details>")
    return f"<section><h2>Prompts</h2>{''.join(lists)}</section>\n"
