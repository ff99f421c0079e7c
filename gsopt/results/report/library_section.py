"""The report's section about a shape library: the shapes that the unseen sides follow, with names and licenses."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

from gsopt.data.files import is_regular, read_json
from gsopt.errors import InputError
from gsopt.results.report.embedded_images import data_uri, read_image
from gsopt.results.report.values import number, text

MAX_SHOWN = 8
IMAGE_SIDE = 160
MAX_PIXELS = 512 * 512


def library_section(run: Path, messages: list[str]) -> str:
    """HTML, empty for a run without a library; unreadable parts are left out and named in `messages`."""
    folder = run / "library"
    if not is_regular(folder / "summary.json"):
        return ""
    try:
        summary = read_json(folder / "summary.json")
    except InputError as error:
        messages.append(f"The shape library is missing from this report. {error}")
        return ""
    shapes = summary.get("shapes")
    listed = [one for one in shapes if isinstance(one, dict)][:MAX_SHOWN] if isinstance(shapes, list) else []
    cards = "".join(_card(folder / f"shape_{i:02d}.png", one) for i, one in enumerate(listed))
    return (
        f"<section><h2>Shape library</h2><p>{escape(summary_text(summary))}</p>"
        f'<div class="strip shapes">{cards}</div></section>\n'
    )


def summary_text(summary: dict[str, Any]) -> str:
    """The guess, its sources and the words."""
    texts = summary.get("texts")
    asked = "; ".join(text(one) for one in texts if isinstance(one, str)) if isinstance(texts, list) else ""
    words = f"The words: {asked}." if asked else "No words were given."
    return (
        "The sides that the photo does not show are a guess. They follow these shapes, turned and stretched to its "
        f"silhouette and mixed with the inflated silhouette; {text(summary.get('entries', 'some'))} shapes of the "
        f"{text(summary.get('library', 'library'))} library were at hand. {words}"
    )


def _card(file: Path, shape: dict[str, Any]) -> str:
    """A picture above name, share, agreement, creator and license."""
    image = read_image(file, IMAGE_SIDE, MAX_PIXELS)
    name = text(shape.get("name") or shape.get("id") or "a shape")
    share, agreement, words = (number(shape.get(key)) for key in ("share", "agreement", "words"))
    facts = [
        "" if share is None else f"share {share:.0%}",
        "" if agreement is None else f"silhouette {agreement:.2f}",
        "meant by the words" if words else "",
    ]
    source = ", ".join(text(shape[key]) for key in ("creator", "license") if shape.get(key))
    picture = "" if image is None else f'<img src="{data_uri(image)}" alt="{escape(name)}" loading="lazy">'
    caption = f"<b>{escape(name)}</b><br>{escape(', '.join(fact for fact in facts if fact))}<br>{escape(source)}"
    return f"<figure>{picture}<figcaption>{caption}</figcaption></figure>"
