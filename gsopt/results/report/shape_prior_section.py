"""The report's section about a shape prior: what it was told, and pictures of the body that it saw."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

from gsopt.data.files import is_regular, read_json
from gsopt.errors import InputError
from gsopt.results.report.embedded_images import data_uri, read_image
from gsopt.results.report.values import text

MAX_SHOWN = 4
IMAGE_SIDE = 200
MAX_PIXELS = 4096 * 4096


def shape_prior_section(run: Path, messages: list[str]) -> str:
    """HTML, empty for a run without a shape prior; unreadable parts are left out and named in `messages`."""
    folder = run / "shape_prior"
    if not is_regular(folder / "summary.json"):
        return ""
    try:
        summary = read_json(folder / "summary.json")
    except InputError as error:
        messages.append(f"The shape prior is missing from this report. {error}")
        return ""
    images = [read_image(folder / f"side_{i:02d}.png", IMAGE_SIDE, MAX_PIXELS) for i in range(MAX_SHOWN)]
    shown = "".join(
        f'<figure><img src="{data_uri(image)}" alt="a side of the guessed body" loading="lazy"></figure>'
        for image in images
        if image is not None
    )
    return (
        f"<section><h2>Shape prior</h2><p>{escape(summary_text(summary))}</p>"
        f'<div class="strip shapes">{shown}</div></section>\n'
    )


def summary_text(summary: dict[str, Any]) -> str:
    """The guess, its source and the words."""
    words, unknown = (_listed(summary.get(key)) for key in ("words", "unknown_words"))
    told = f"It was told: {words}." if words else "It was told no word that it knows."
    return (
        "The sides that no photo shows are a guess in shape and color, drawn here with the photos' colors where these "
        f"show it. It comes from the shape prior {text(summary.get('prior', 'prior'))} "
        f"({text(summary.get('digest', 'no digest'))}). {told}" + (f" It does not know: {unknown}." if unknown else "")
    )


def _listed(words: Any) -> str:
    return ", ".join(text(word) for word in words if isinstance(word, str)) if isinstance(words, list) else ""
