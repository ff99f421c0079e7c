"""The report's section about guidance: its prior, the number of guided steps, and renders before and after."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from pathlib import Path
from typing import Any

from PIL import Image

from gsopt.data.files import is_regular, read_json
from gsopt.errors import InputError
from gsopt.results.report.embedded_images import data_uri, read_image
from gsopt.results.report.values import number, text

IMAGE_SIDE = 256
MAX_ROWS = 8
"""Most rows of images per table."""
MAX_PIXELS = 2048 * 2048
BEFORE_AFTER = ("before", "before_uncertainty", "after", "after_uncertainty")
PROPOSAL = ("render", "proposal", "uncertainty")

Row = tuple[str, list[Image.Image | None]]
"""A line of text and the images above it."""


def guidance_section(run: Path, messages: list[str]) -> str:
    """HTML, empty for a run without guidance; unreadable parts are left out and named in `messages`."""
    folder = run / "guidance"
    if not is_regular(folder / "summary.json"):
        return ""
    try:
        summary = read_json(folder / "summary.json")
    except InputError as error:
        messages.append(f"Guidance is missing from this report. {error}")
        return ""
    views = [_view(folder, view) for view in _numbers(summary.get("views"))]
    steps = [_step(folder, sample) for sample in _objects(summary.get("samples"))]
    return (
        f"<section><h2>Guidance</h2><p>{escape(summary_text(summary))}</p>"
        + _cards("Least certain views before the first guided step and after training", BEFORE_AFTER, views)
        + _cards("Inputs and predictions of the prior", PROPOSAL, steps)
        + "</section>\n"
    )


def summary_text(summary: dict[str, Any]) -> str:
    """The prior, the number of guided steps, and the reasons for unguided ones."""
    guided, wanted, decided, failed = (_whole(summary.get(key)) for key in ("guided", "wanted", "decided", "failed"))
    guard = summary.get("guard")
    reason = guard.get("reason") if isinstance(guard, dict) else None
    weight, factor = summary.get("lambda_sds"), guard.get("factor", 1.0) if isinstance(guard, dict) else 1.0
    if (weight_number := number(weight)) is not None and (factor_number := number(factor)) is not None:
        weight = f"{weight_number * factor_number:g}"
    sentences = [
        f"{text(summary.get('model', 'A diffusion prior'))}, policy {text(summary.get('policy', 'unknown'))}, "
        f"lambda {'unknown' if weight is None else text(weight)}" + (f" ({text(reason)})." if reason else "."),
        f"{guided} of {wanted} steps scheduled for guidance were guided.",
    ]
    if decided:
        sentences.append(f"{decided} were skipped because the input views determine every pixel.")
    if failed:
        sentences.append(
            f"{failed} failed." + (" The run then continued without guidance." if summary.get("ended") else "")
        )
    return " ".join(sentences)


def _view(folder: Path, view: int) -> Row:
    files = (f"{when}_{view:02d}{what}" for when in ("before", "after") for what in ("", "_uncertainty"))
    return "", _images(folder, files)


def _step(folder: Path, sample: dict[str, Any]) -> Row:
    step = _whole(sample.get("step"))
    prompt = text(sample.get("text") or "")[:200]
    images = _images(folder, (f"step_{step:06d}_{kind}" for kind in PROPOSAL))
    return f"step {step:,}" + (f": {prompt}" if prompt else ""), images


def _images(folder: Path, names: Iterable[str]) -> list[Image.Image | None]:
    return [read_image(folder / f"{name}.png", IMAGE_SIDE, MAX_PIXELS) for name in names]


def _cards(title: str, kinds: Iterable[str], rows: list[Row]) -> str:
    shown = [(line, images) for line, images in rows if any(images)]
    if not shown:
        return ""
    cards = "".join(
        '<article class="card"><div class="strip">'
        + "".join(
            f'<figure><img loading="lazy" src="{data_uri(image)}" alt="{escape(kind)}">'
            f"<figcaption>{escape(kind.replace('_', ', '))}</figcaption></figure>"
            for kind, image in zip(kinds, images, strict=True)
            if image is not None
        )
        + f'</div><p class="muted">{escape(line)}</p></article>'
        for line, images in shown
    )
    return f'<h3>{escape(title)}</h3><div class="cards">{cards}</div>'


def _whole(value: object) -> int:
    return value if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 10**9 else 0


def _numbers(value: object) -> list[int]:
    return [_whole(item) for item in value[:MAX_ROWS]] if isinstance(value, list) else []


def _objects(value: object) -> list[dict[str, Any]]:
    return [item for item in value[:MAX_ROWS] if isinstance(item, dict)] if isinstance(value, list) else []
